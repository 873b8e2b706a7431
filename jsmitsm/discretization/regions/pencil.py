"""The pencil of a problem with several regions: those of the regions, and the rows of copies where they meet.

A copy's row speaks of the sources of all its sides, each fitted to the values in its own region. Where two sides have
one value up to a jump, the difference of their rows is that condition alone, without a source: one of the two is kept,
and the other follows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.discretization.health import DEFECT
from jsmitsm.discretization.layout import Class
from jsmitsm.discretization.local_data import around, right_sides
from jsmitsm.discretization.pencil.assemble import (
    Layout,
    Pencil,
    condition_values,
    default_depth,
    laid_out,
    pencil_of,
)
from jsmitsm.discretization.pencil.grades import Fitness
from jsmitsm.discretization.pencil.local import source_stencil_size, source_stencils
from jsmitsm.discretization.pencil.sparse import Sparse
from jsmitsm.discretization.regions.layout import Regions, discretize_regions
from jsmitsm.discretization.regions.rows import Joints, RegionNumbers, joint_rows, joints, region_numbers, spread
from jsmitsm.equation.problem import Problem
from jsmitsm.particle import batches
from jsmitsm.particle.batches import Operands
from jsmitsm.particle.moments import Row
from jsmitsm.runtime.errors import SolveError, some
from jsmitsm.runtime.tracers import is_traced

Entries = list[tuple[Any, np.ndarray, np.ndarray]]


def assemble_regions_pencil(
    problem: Problem, cloud: RegionCloud, *, order: int, mass: Sequence[bool] | None = None,
    stencils: Stencils | None = None, depth: int | str = 0,
) -> Pencil:  # fmt: skip
    """The pencil of a linear problem with several regions; arguments as of ``assemble_pencil``."""
    if depth == "auto":
        depth = default_depth(depth, cloud.dim)
        try:
            return assemble_regions_pencil(problem, cloud, order=order, mass=mass, stencils=stencils, depth=depth)
        except SolveError:
            if not depth:
                raise
        depth = 0  # a region may have too few particles for it
    near = None if stencils is None else np.asarray(stencils.indices)
    regions = discretize_regions(problem, cloud, order, int(depth), near)
    if not regions.linear:
        raise ValueError(
            "problem: an equation or a condition is nonlinear in u, but a pencil, and modes, are those of a linear "
            "operator; linearise it about a state first"
        )
    nums = region_numbers(regions)
    massed = np.ones(problem.fields, bool) if mass is None else np.asarray(mass, bool)
    fields = problem.fields
    entries: dict[str, Entries] = {"A": [], "B": [], "Bg": []}
    held, slaved, told, laid, start = [], [], [], [], 0
    for part, own in zip(regions.parts, nums.parts):
        layout, made = laid_out(part.disc, own, massed)
        one, at = pencil_of(layout, made, own), _numbers(part.ids, fields)
        entries["A"].append((one.A.values, at[one.A.rows], at[one.A.cols]))
        entries["B"].append((one.B.values, at[one.B.rows], at[one.B.cols]))
        entries["Bg"].append((one.Bg.values, at[one.Bg.rows], one.Bg.cols + start))
        start += one.Bg.shape[1]
        held.append(at[one.held])
        slaved.append(at[one.slaved])
        told += [f"In the region {part.name!r}: {line}" for line in one.health]
        laid.append(layout)
    starts = _starts(regions, nums)
    for meeting in joints(regions, nums):
        slaved.append(_add(regions, nums, meeting, starts, entries))
    n = len(cloud) * fields
    free = np.flatnonzero(~regions.held)
    classes = [pair for layout in laid for pair in layout.classes]
    return Pencil(
        _joined(entries["A"], (n, n)), _joined(entries["B"], (n, n)), _joined(entries["Bg"], (n, starts[1])),
        nums.held, regions_conditions(nums), free, np.concatenate(held),
        np.sort(np.concatenate(slaved)), tuple(told), Layout(regions, classes, _worst(laid)),  # type: ignore[arg-type]
    )  # fmt: skip


def regions_conditions(nums: RegionNumbers) -> Any:
    """The values (G,) of all conditions: those of every region, then those between them."""
    every = [condition_values(own) for own in nums.parts] + [value.reshape(-1) for _, value in nums.between.values()]
    return (jnp if is_traced(every) else np).concatenate(every)


def regions_held(regions: Regions, values: list[Any]) -> Any:
    """Held values (N, F) from those of every region."""
    return spread(regions, values, regions.held.shape)


def _starts(regions: Regions, nums: RegionNumbers) -> tuple[dict[str, int], int]:
    """Where the values of every region's and every interface's conditions start, and how many there are in all."""
    at, out = 0, {}
    for part, own in zip(regions.parts, nums.parts):
        out[part.name] = at
        at += int(np.prod(np.shape(own.given))) + int(np.prod(np.shape(own.gamma)))
    for name, (_, value) in nums.between.items():
        out[name] = at
        at += int(np.prod(value.shape))
    return out, at


def _numbers(ids: np.ndarray, fields: int) -> np.ndarray:
    """The numbers of the values of some particles, particle by particle."""
    return (np.asarray(ids)[..., None] * fields + np.arange(fields)).reshape(*np.shape(ids)[:-1], -1)


def _add(regions: Regions, nums: RegionNumbers, made: Joints, starts: Any, entries: dict[str, Entries]) -> np.ndarray:
    """Append the rows of the copies of one shape; returns the numbers of the values that follow others."""
    fields, (first, _) = regions.rec.fields, starts
    classes, rows = joint_rows(regions, nums, made)
    _check_determined(classes, rows)
    columns = _condition_columns(regions, nums, made, first)
    leader = _leaders(regions, made)  # (sides, F)
    following = []
    for k, (cls, row) in enumerate(zip(classes, rows)):
        whose = np.where(regions.held[cls.ids], -1, _numbers(cls.ids[:, None], fields))  # (n, F)
        led = np.flatnonzero(leader[k] != k)
        alone = np.where(np.isin(np.arange(fields), led), -1, whose)
        near = np.where(cls.neighbours[..., None] >= 0, cls.neighbours[..., None] * fields + np.arange(fields), -1)
        _append(entries["A"], row.weights, alone[:, :, None, None], near[:, None], -1.0)
        condition = row.condition
        for f in led:
            chief = int(leader[k, f])
            other = made.ids[:, chief] * fields + f
            _append(entries["A"], np.ones(len(other)), whose[:, f], other, -1.0)
            change = (np.arange(fields) == f)[:, None] * np.ones(condition.shape[2])
            condition = condition - change * rows[chief].condition
            following.append(whose[:, f])
        _append(entries["Bg"], condition, whose[:, :, None], columns[:, None, :])
        for far, sources in _sources(regions, nums, made, row):
            numbers = np.where(far[..., None] >= 0, far[..., None] * fields + np.arange(fields), -1)
            _append(entries["B"], sources, alone[:, :, None, None], numbers[:, None])
    found = np.concatenate([np.zeros(0, int), *following])
    return found[found >= 0]


def _leaders(regions: Regions, made: Joints) -> np.ndarray:
    """For every side and field the side whose value it has up to a jump, (M, F); itself where there is none."""
    fields, m = regions.rec.fields, len(made.parts)
    out = np.repeat(np.arange(m)[:, None], fields, axis=1)
    for name, _, (p, q), _ in (*made.pairs, *made.dropped):
        (condition,) = regions.problem.bcs[name]
        if "sides" not in condition.parts or condition.parts.get("resistance") is not None:
            continue
        for f in range(fields):
            one, two = sorted((out[p, f], out[q, f]))
            out[out[:, f] == two, f] = one
    return out


def _condition_columns(regions: Regions, nums: RegionNumbers, made: Joints, first: dict[str, int]) -> np.ndarray:
    """The columns (n, C) of the values that the rows' conditions take."""
    columns = []
    for name, at, _, keep in made.pairs:
        count = nums.between[name][1].shape[1]
        columns.append(first[name] + at[:, None] * count + keep)
    for k, scheme, ids in zip(made.parts, made.scheme.sides, made.ids.T):
        part, own = regions.parts[k], nums.parts[k]
        if scheme.n_own:
            at = np.searchsorted(own.own_ids, np.searchsorted(part.ids, ids))
            columns.append(first[part.name] + at[:, None] * np.shape(own.given)[1] + np.arange(scheme.n_own))
    return np.concatenate(columns, axis=1)


def _sources(regions: Regions, nums: RegionNumbers, made: Joints, row: Row) -> list[tuple[np.ndarray, Any]]:
    """For every side the particles (n, v) whose sources take part, and their weights (n, F, v, E)."""
    out, start = [], 0
    for k, scheme, ids in zip(made.parts, made.scheme.sides, made.ids.T):
        part, own = regions.parts[k], nums.parts[k]
        disc, local = part.disc, np.searchsorted(part.ids, ids)
        count = right_sides(disc, own, Class(local, local[:, None], replace(scheme, n_own=0)))[0].shape[1]
        near = np.asarray(disc.stencils.indices)[local]
        size = source_stencil_size(disc.rec, int((near >= 0).sum(axis=1).max()))
        far = source_stencils(disc, local, size, disc.rec.degree, strict=True)
        n = len(local)
        bare = replace(disc.scheme, n_own=0, n_data=0, own=(), data=(), lost=0)
        given = Operands(np.zeros((1, 1, 1, 1)), np.zeros((n, 0, 0)), np.zeros((len(disc.points), 0, 0)), None)
        each = (row.source[:, :, start : start + count],)
        made_ = batches.sources(bare, around(disc, own).points, None, local, far, given, each)
        out.append((np.where(far >= 0, part.ids[np.maximum(far, 0)], -1), made_))
        start += count
    return out


def _check_determined(classes: list[Class], rows: list[Row]) -> None:
    for cls, row in zip(classes, rows):
        if is_traced(row):
            continue
        bad = cls.ids[~(np.isfinite(np.asarray(row.lebesgue)).all(axis=1) & (np.asarray(row.defect) < DEFECT))]
        if len(bad):
            raise SolveError(
                f"the moment systems of {len(bad)} particle(s) on interfaces do not determine the solution, first "
                f"{some(bad)}; refine the cloud there, or lower the order",
                [int(i) for i in bad[:100]],
            )


def _append(out: Entries, values: Any, rows: np.ndarray, cols: np.ndarray, sign: float = 1.0) -> None:
    """Append those of the values whose row and column exist."""
    rows, cols = (np.broadcast_to(x, np.shape(values)) for x in (rows, cols))
    keep = np.flatnonzero((rows >= 0) & (cols >= 0))
    chosen = (values if is_traced(values) else np.asarray(values)).reshape(-1)[keep]
    out.append((sign * chosen, rows.reshape(-1)[keep], cols.reshape(-1)[keep]))


def _joined(entries: Entries, shape: tuple[int, int]) -> Sparse:
    values, rows, cols = zip(*entries)
    join: Any = jnp.concatenate if is_traced(values) else np.concatenate
    return Sparse(join(values), np.concatenate(rows), np.concatenate(cols), shape)


def _worst(laid: list[Layout]) -> Fitness | None:
    """The fitness of all regions together: its largest numbers."""
    found = [layout.fitness for layout in laid if layout.fitness is not None]
    if len(found) < len(laid):
        return None
    return Fitness(*(max(getattr(f, name) for f in found) for name in ("worst", "lebesgue", "dominance")))
