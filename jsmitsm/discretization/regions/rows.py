"""The rows of a problem with several regions: those of each region, and those of the copies where regions meet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.regions.region_cloud import sides
from jsmitsm.discretization.coefficients import Numbers, numbers, slot_series
from jsmitsm.discretization.held_particles import with_held_expansions
from jsmitsm.discretization.layout import Class, rounded_width, table
from jsmitsm.discretization.least_squares import added_up
from jsmitsm.discretization.leave_one_out import loads
from jsmitsm.discretization.local_data import own_conditions, particles_first, right_sides, shared_elimination
from jsmitsm.discretization.regions.ends import independent
from jsmitsm.discretization.regions.layout import Meeting, Part, Regions
from jsmitsm.discretization.regions.squares import squared_loads
from jsmitsm.discretization.rows import all_coefficients
from jsmitsm.equation.regions.between import Between
from jsmitsm.particle import joint
from jsmitsm.particle.joint import JointScheme, Side
from jsmitsm.particle.moments import Block, Row
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program

# Jumps around a point where several interfaces meet add up to zero, up to this part of the largest.
_CLOSED = 1e-8


@dataclass
class RegionNumbers:
    """The numbers of every region, those of the interfaces' conditions, coef (P, rows, S) and value (P, rows), and
    all held values (N, F)."""

    parts: list[Numbers]
    between: dict[str, tuple[Any, Any]]
    held: Any

    @property
    def of_matrix(self) -> list[Any]:
        """What the rows are made of; the rest stands on the right."""
        return [x for own in self.parts for x in own.of_matrix] + [coef for coef, _ in self.between.values()]

    degenerate = None  # told region by region


@dataclass
class Joints:
    """Meetings of one shape: ``ids`` (n, M), the copies of each, and what stands between them.

    pairs: for each condition its interface and the pairs on it (n,), the two sides it binds, and which of its rows
    count (those that follow from others do not).
    """

    scheme: JointScheme
    parts: tuple[int, ...]
    ids: np.ndarray
    pairs: list[tuple[str, np.ndarray, tuple[int, int], np.ndarray]]
    dropped: list[tuple[str, np.ndarray, tuple[int, int], np.ndarray]]


def region_numbers(regions: Regions, taylor: Any = None, everywhere: bool = False) -> RegionNumbers:
    """The numbers of a linear problem, or of one linearised at the expansions ``taylor`` (N, F, K)."""
    parts = [
        numbers(p.disc, p.disc.problem, None if taylor is None else taylor[p.ids], everywhere) for p in regions.parts
    ]
    found = {}
    for name, b in regions.interfaces.items():
        at = None if b.linear else _slot_values(regions, name, b, taylor)
        found[name] = b.numbers(at)
    return RegionNumbers(parts, found, spread(regions, [n.held for n in parts], regions.held.shape))


def contrast(regions: Regions, nums: RegionNumbers) -> float:
    """How many times more the better side of an interface conducts than the other, by the conditions; at least one."""
    most = 1.0
    for name, b in regions.interfaces.items():
        coef = np.asarray(nums.between[name][0])
        size = []
        for side in (0, 1):
            first = [k for k, (s, (_, a)) in enumerate(b.slots) if s == side and sum(a) == 1]
            size.append(float(np.sqrt((coef[:, :, first] ** 2).sum(axis=(1, 2)).max(initial=0.0))) if first else 0.0)
        if min(size) > 0:
            most = max(most, max(size) / min(size))
    return most


def _slot_values(regions: Regions, name: str, b: Between, taylor: Any) -> Any:
    """The derivatives (S, P) of the expansions in the slots of the two sides."""
    pairs, names = regions.cloud.interfaces[name], [p.name for p in regions.parts]
    out = []
    for side, slot in b.slots:
        rec = regions.parts[names.index(sides(name)[side])].disc.rec
        out.append(slot_series(rec, (slot,), taylor[pairs[:, side]], 0)[0, 0])
    return (jnp if is_traced(out) else np).stack(out)


def spread(regions: Regions, values: list[Any], shape: tuple[int, ...]) -> Any:
    """Values of every region's particles as those of the whole cloud."""
    return spread_values(values, [p.ids for p in regions.parts], shape)


def spread_values(values: list[Any], places: list[np.ndarray], shape: tuple[int, ...]) -> Any:
    """Values of some particles each as those of all."""
    return _spread(values, places, np.zeros(shape))


@in_one_program
def _spread(values: list[Any], places: list[np.ndarray], out: Any) -> Any:
    if is_traced(values):
        for at, value in zip(places, values):
            out = jnp.asarray(out).at[at].set(value)
        return out
    out = np.array(out)
    for at, value in zip(places, values):
        out[at] = value
    return out


# ------------------------------------------------------------------ who meets whom, by shape


def joints(regions: Regions, nums: RegionNumbers) -> list[Joints]:
    """All meetings, those of one shape together."""
    shapes: dict[Any, list[Meeting]] = {}
    place = [dict(zip(p.ids.tolist(), range(len(p.ids)))) for p in regions.parts]
    for m in regions.meetings:
        own = tuple(_own_shape(regions.parts[k], place[k][i]) for k, i in zip(m.parts, m.copies))
        at = [place[k][i] for k, i in zip(m.parts, m.copies)]
        kept = independent(regions, nums, m, at, [count for count, _ in own], _kept_rows(regions, m))
        key = m.parts, tuple(name for name, _ in m.pairs), own, kept
        shapes.setdefault(key, []).append(m)
    return [_joints(regions, nums, key, found) for key, found in shapes.items()]


def _own_shape(part: Part, i: int) -> tuple[int, int]:
    """The conditions that a copy carries from the outer boundary, and the rows of its recursion that add nothing."""
    disc = part.disc
    own = int(disc.n_own[i]) - (0 if disc.dropped is None else int(disc.dropped[i]))
    return own, 0 if disc.lost is None else int(disc.lost[i])


def _kept_rows(regions: Regions, m: Meeting) -> tuple[tuple[bool, ...], ...]:
    """Which rows of each condition count: jumps around a closed way follow from the others, and so does the jump of a
    value that an outer condition holds on both sides."""
    names = [p.name for p in regions.parts]
    copy, group, out = dict(zip(m.parts, m.copies)), {k: k for k in m.parts}, []
    for name, _ in m.pairs:
        p, q = (names.index(side) for side in sides(name))
        of_values = regions.interfaces[name].of_values
        keep = [not (alone and group[p] == group[q]) for alone in of_values]
        for f in range(regions.rec.fields):
            if of_values[f] and regions.held[copy[p], f] and regions.held[copy[q], f]:
                keep[f] = False
        if any(of_values):
            group = {k: group[p] if g == group[q] else g for k, g in group.items()}
        out.append(tuple(keep))
    return tuple(out)


def _joints(regions: Regions, nums: RegionNumbers, key: Any, found: list[Meeting]) -> Joints:
    parts, names, own, kept = key
    part_names = [p.name for p in regions.parts]
    schemes = []
    for k, (n_own, lost) in zip(parts, own):
        schemes.append(replace(regions.parts[k].disc.scheme.with_own(n_own, lost), sourced=True))
    slots: dict[Any, None] = {}
    pairs, dropped = [], []
    for t, (name, keep) in enumerate(zip(names, kept)):
        both = tuple(parts.index(part_names.index(side)) for side in sides(name))
        at, rows = np.array([m.pairs[t][1] for m in found]), np.flatnonzero(keep)
        pairs.append((name, at, (both[0], both[1]), rows))
        if not all(keep):
            dropped.append((name, at, (both[0], both[1]), np.flatnonzero(~np.array(keep))))
        slots.update({(both[side], slot): None for side, slot in regions.interfaces[name].slots})
    count = sum(len(rows) for *_, rows in pairs)
    scheme = JointScheme(tuple(schemes), tuple(slots), count)
    made = Joints(scheme, parts, np.array([m.copies for m in found]), pairs, dropped)
    _check_closed(regions, nums, made)
    return made


def _check_closed(regions: Regions, nums: RegionNumbers, made: Joints) -> None:
    """Jumps around a point must add up to zero; ValueError where they do not."""
    held_rows = range(regions.rec.fields)
    for name, at, (p, q), rows in made.dropped:
        value = nums.between[name][1]
        if is_traced(nums.between) or len(made.parts) < 3:
            continue
        for f in (r for r in rows if r in held_rows):
            known = {p: np.zeros(len(at))}
            for _ in made.parts:  # along the conditions that count
                for other, where, (i, j), kept in made.pairs:
                    if f not in kept or not regions.interfaces[other].of_values[f]:
                        continue
                    step = np.asarray(nums.between[other][1])[where, f]
                    if i in known and j not in known:
                        known[j] = known[i] - step
                    elif j in known and i not in known:
                        known[i] = known[j] + step
            if q not in known:
                continue
            jump = np.asarray(value)[at, f]
            scale = max(float(np.abs(x).max()) for x in (*known.values(), jump)) or 1.0
            off = np.abs(known[p] - known[q] - jump)
            if (off > _CLOSED * scale).any():
                where = np.asarray(regions.points)[made.ids[int(off.argmax()), 0]]
                raise ValueError(
                    f"bcs[{name!r}]: the jumps of the interfaces that meet at {where} do not add up to zero around "
                    f"that point ({off.max():.3g} is left); correct them"
                )


# ------------------------------------------------------------------ their rows


def joint_rows(regions: Regions, nums: RegionNumbers, made: Joints) -> tuple[list[Class], list[Row]]:
    """The equations of all copies: for every side of the joints a class, and rows over the neighbours of all sides."""
    given, near = _operands(regions, nums, made)
    rows = joint.joint_rows(made.scheme, *given)
    classes = [Class(made.ids[:, k], near, s) for k, s in enumerate(made.scheme.sides)]
    return classes, list(rows)


def _operands(regions: Regions, nums: RegionNumbers, made: Joints) -> tuple[Any, Any]:
    """What the joints' programs take, and the neighbours of all sides (n, w) in the numbers of the whole cloud."""
    points, each, near = [], [], []
    for k, scheme, ids in zip(made.parts, made.scheme.sides, made.ids.T):
        part = regions.parts[k]
        cls, own = _side_class(part, scheme, ids), nums.parts[k]
        disc = part.disc
        jac, shared = own.jac, None
        if disc.traced.constant and disc.rec.scale_free:
            shared, jac = shared_elimination(disc, own), np.zeros((1, 1, 1, 1))
        elif jac.shape[-1] > 1:
            jac = particles_first(jac, np.searchsorted(own.ids, cls.ids), len(ids))
        else:
            jac = particles_first(jac, None, 1)
        points.append(disc.points)
        each.append(Side(cls.ids, cls.neighbours, jac, own_conditions(own, cls), shared))
        near.append(np.where(cls.neighbours >= 0, part.ids[cls.neighbours], -1))
    coef, _ = between_numbers(regions, nums, made)
    return (tuple(points), tuple(each), coef), np.concatenate(near, axis=1)


def _side_class(part: Part, scheme: Any, ids: np.ndarray) -> Class:
    """The copies of one side as a class of their region."""
    own = np.searchsorted(part.ids, ids)
    near = np.asarray(part.disc.stencils.indices)[own]
    width = int(np.max(np.where(near >= 0, np.arange(near.shape[1]), 0), initial=0)) + 1
    wide = rounded_width(width, 8)  # one program for joints of all pairs
    return Class(own, np.pad(near[:, :wide], ((0, 0), (0, max(0, wide - near.shape[1]))), constant_values=-1), scheme)


def between_numbers(regions: Regions, nums: RegionNumbers, made: Joints) -> tuple[Any, Any]:
    """The conditions between the copies over the joints' slots: coef (n, rows, S), value (n, rows)."""
    coefs, values, places, rows = [], [], [], []
    for name, at, both, keep in made.pairs:
        coef, value = nums.between[name]
        b = regions.interfaces[name]
        coefs.append(coef)
        values.append(value)
        places.append(np.array([made.scheme.slots.index((both[side], slot)) for side, slot in b.slots]))
        rows.append((at, keep))
    return _gathered(coefs, values, places, rows, np.zeros(len(made.scheme.slots)))


@in_one_program
def _gathered(coefs: Any, values: Any, places: Any, rows: Any, none: Any) -> tuple[Any, Any]:
    xp: Any = jnp if is_traced(coefs, values) else np
    spread_, right = [], []
    for coef, value, place, (at, keep) in zip(coefs, values, places, rows):
        chosen = xp.asarray(coef)[at][:, keep]
        spread_.append(chosen @ (place[:, None] == np.arange(len(none))).astype(float))
        right.append(xp.asarray(value)[at][:, keep])
    return xp.concatenate(spread_, axis=1), xp.concatenate(right, axis=1)


def joint_sides(regions: Regions, nums: RegionNumbers, made: Joints) -> tuple[Any, Any]:
    """The right-hand sides of the joints: sources (n, rows of all sides), values of all conditions (n, conditions)."""
    sources, given = [], [between_numbers(regions, nums, made)[1]]
    for k, scheme, ids in zip(made.parts, made.scheme.sides, made.ids.T):
        part = regions.parts[k]
        source, own = right_sides(part.disc, nums.parts[k], _side_class(part, scheme, ids))
        sources.append(source)
        given.append(own)
    return _beside(sources), _beside(given)


@in_one_program
def _beside(parts: list[Any]) -> Any:
    return (jnp if is_traced(parts) else np).concatenate(parts, axis=1)


def in_whole(part: Part, cls: Class) -> Class:
    """A class of a region in the numbers of the whole cloud."""
    near = np.asarray(part.disc.images.owners(cls.neighbours))
    return replace(cls, ids=part.ids[cls.ids], neighbours=np.where(near >= 0, part.ids[near], -1))


def whole_right_side(
    regions: Regions, nums: RegionNumbers, rows: list[tuple[list[Class], list[Any]]], bound: list[Any]
) -> Any:
    """The right-hand side (n,) of the whole system.

    rows: classes and rows of every region, in its own numbers, or blocks where it takes the least-squares form; bound:
    of the joints, as ``(joints, classes, rows)``.
    """
    unknown = regions.unknowns
    parts, places, squares = [], [], []
    for part, own, (classes, made) in zip(regions.parts, nums.parts, rows):
        if in_squares(made):
            squares.append(squared_loads(regions, part, own, (classes, made)))
            continue
        for cls, row in zip(classes, made, strict=True):
            source, given = right_sides(part.disc, own, cls)
            whole = in_whole(part, cls)
            at = unknown[whole.ids]
            used = source if cls.scheme.sourced else None
            parts.append((row, used, given, whole.neighbours, np.flatnonzero(at >= 0)))
            places.append(at[at >= 0])
    for joined, classes, made in bound:
        source, given = joint_sides(regions, nums, joined)
        for cls, row in zip(classes, made, strict=True):
            at = unknown[cls.ids]
            parts.append((row, source, given, cls.neighbours, np.flatnonzero(at >= 0)))
            places.append(at[at >= 0])
    none = np.zeros((len(regions.cloud), 0))
    found = loads(parts, nums.held, none, np.argsort(np.concatenate(places))) if parts else np.zeros(0)
    if not squares:
        return found
    where, values = (sum((s[k] for s in squares), []) for k in (0, 1))
    if parts:
        where, values = [*where, np.sort(np.concatenate(places))], [*values, found]
    return added_up(where, values, np.zeros(int(unknown.max(initial=-1)) + 1))


def in_squares(made: list[Any]) -> bool:
    """Whether what a region is made of are blocks of the least-squares form, and no rows."""
    return bool(made) and isinstance(made[0], Block)


def whole_coefficients(regions: Regions, nums: RegionNumbers, values: Any) -> Any:
    """Taylor coefficients (N, F, K) of all particles that carry equations, from all values (N, F)."""
    found = []
    for part, own in zip(regions.parts, nums.parts):
        found.append(all_coefficients(part.disc, own, values[part.ids]))
    out = spread(regions, found, (*regions.held.shape, regions.rec.size))
    for made in joints(regions, nums):
        out = _placed(out, list(made.ids.T), list(expanded_copies(regions, nums, made, values)))
    return out


def expanded_copies(regions: Regions, nums: RegionNumbers, made: Joints, values: Any) -> tuple[Any, ...]:
    """Taylor coefficients (n, F, K) of the copies on every side of the joints."""
    (points, each, coef), _ = _operands(regions, nums, made)
    data = tuple(regions.parts[k].disc.images.extend_values(values[regions.parts[k].ids]) for k in made.parts)
    return joint.joint_coefficients(made.scheme, points, each, coef, (data, *joint_sides(regions, nums, made)))


@in_one_program
def _placed(out: Any, places: list[np.ndarray], values: list[Any]) -> Any:
    if is_traced(out, values):
        for at, value in zip(places, values):
            out = jnp.asarray(out).at[at].set(value)
        return out
    out = np.array(out)
    for at, value in zip(places, values):
        out[at] = value
    return out


def with_held(regions: Regions, taylor: Any) -> Any:
    """Expansions (N, F, K) with those of held particles continued from their neighbours' in the same region."""
    found = [with_held_expansions(p.disc, taylor[p.ids]) for p in regions.parts]
    return spread(regions, found, (*regions.held.shape, regions.rec.size))


def whole_table(regions: Regions) -> np.ndarray:
    """All stencils in one padded array (N, w), repaired ones too."""
    tables = [np.asarray(table(p.disc)) for p in regions.parts]
    out = np.full((len(regions.cloud), max(t.shape[1] for t in tables)), -1, np.int32)
    for p, near in zip(regions.parts, tables):
        out[p.ids[:, None], np.arange(near.shape[1])] = np.where(near >= 0, p.ids[near], -1)
    return out
