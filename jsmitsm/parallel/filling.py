"""Shapes filled in parts: every process has the particles of its slab, whatever their number; others dealt out."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jsmitsm.cloud import contour, filling, levelset, surface
from jsmitsm.cloud.cloud import INTERIOR
from jsmitsm.cloud.packing.graded import Blocks, blocks, graded_part, owners
from jsmitsm.cloud.packing.lattice import lattice_part
from jsmitsm.cloud.packing.octree import morton
from jsmitsm.cloud.shapes import checked_bounds, checked_seed, from_sdf, grouped, own_normals
from jsmitsm.parallel.distributed import ParallelCloud, Slab, placed, slab_of
from jsmitsm.parallel.team import Team, collective, team
from jsmitsm.runtime.errors import TooCoarse, short

# A graded shape of fewer particles is made whole by the first process: each part would start from all of them.
WHOLE = 20_000


@collective
def cloud_from(make: Callable[..., Any], *arguments: Any, **options: Any) -> ParallelCloud:
    """A cloud made by all processes, each its own slab of it; or by the first one, which deals it out.

    Parameters
    ----------
    make : function
        ``js.from_sdf``, in 2D or 3D, is filled in parts; where the spacing varies from some 20,000 particles on. All
        else that returns a cloud is made whole by the first process: polygons, lattices.
    *arguments, **options
        Its own, as in sdf, bounds, spacing, seed, groups.

    Returns
    -------
    ParallelCloud
        What this process has of it. Filled in parts the boundary is that of ``make``. The interior is the same lattice,
        or relaxed as often, with another disorder: one that hangs on the place alone, so that any number of processes
        fills a shape with the same particles. Every process finds the whole boundary, and of the interior its part and
        what is carried into it, over 31 spacings. What the first process makes is the cloud of ``make``; it alone holds
        the whole of it, and only until it is dealt out.

    Raises
    ------
    ValueError
        As ``make``, on all processes; and where it makes no cloud, or one in 1D or of several regions.

    Examples
    --------
    On every process::

        ball = js.sdf.ball((0, 0, 0), 1.0)
        box = ((-1, -1, -1), (1, 1, 1))
        cloud = jp.cloud_from(js.from_sdf, ball, box, 0.02)
    """
    us = team()
    with us.phase():
        if not callable(make):
            raise ValueError(f"make: expected a function that returns a cloud, as js.from_sdf, got {short(make)}")
        given = None
        if make is from_sdf:
            given = inspect.signature(from_sdf).bind(*arguments, **options)
            given.apply_defaults()
    if given is not None:
        with us.phase():
            shape = _shape(given.arguments)
        if shape.grid is None or shape.grid.share.sum() >= WHOLE:
            with us.phase():
                parts = _filled(us, shape, given.arguments["groups"])
            return ParallelCloud(_numbered(us, *parts))
    return ParallelCloud(placed(us, _dealt(us, lambda: make(*arguments, **options))))


class _Shape(NamedTuple):
    """What ``js.from_sdf`` was asked for; grid: of a spacing that varies, the blocks that are dealt out."""

    region: levelset.SdfRegion
    rule: Any
    lo: np.ndarray
    hi: np.ndarray
    seed: int
    grid: Blocks | None


def _shape(given: Mapping[str, Any]) -> _Shape:
    lo, hi = checked_bounds(given["bounds"])
    if len(lo) == 1:
        raise ValueError("bounds: a shape in 1D has no need of several processes; use js.from_sdf")
    rule, seed = filling.spacing_function(given["spacing"]), checked_seed(given["seed"])
    region = levelset.SdfRegion(given["sdf"], lo, hi)
    return _Shape(region, rule, lo, hi, seed, blocks(region, rule, lo, hi) if callable(given["spacing"]) else None)


def _dealt(us: Team, make: Callable[[], Any]) -> Slab:
    """The own slab of a cloud that the first process makes."""
    with us.phase():
        parcels: list[Any] = [None] * us.size
        if us.rank == 0:
            cloud = make()
            parcels = [slab_of(us, cloud, rank) for rank in range(us.size)]
            if cloud.dim == 1:
                raise ValueError("cloud: one in 1D has no need of several processes; use js.solve")
    return us.trade(parcels)[0]


def _filled(
    us: Team, shape: _Shape, groups: Mapping[str, Any] | None
) -> tuple[np.ndarray, levelset.Boundary, dict[str, np.ndarray], np.ndarray]:
    """The own interior particles, the whole boundary with its groups, and which of it is this process's."""
    region, rule, lo, hi, seed, grid = shape
    boundary = surface.surface(region, rule, seed) if len(lo) == 3 else contour.contour(region, rule)
    boundary = levelset.checked(region, boundary)
    named = grouped(boundary.points, groups) if groups is not None else {"boundary": np.arange(len(boundary.points))}
    if grid is None:
        axis = int(np.argmax(hi - lo))
        ends = lo[axis] + (hi[axis] - lo[axis]) * np.arange(us.size + 1) / us.size
        ends[0], ends[-1] = -np.inf, np.inf
        low, high = ends[us.rank : us.rank + 2]
        inside = lattice_part(region, rule.value, lo, hi, boundary.points, seed, axis, np.array([low, high]))
        here = (boundary.points[:, axis] >= low) & (boundary.points[:, axis] < high)
    else:
        mine = owners(grid, us.size) == us.rank
        inside = graded_part(region, rule, lo, hi, boundary.points, seed, grid, mine)
        here = mine[grid.at(boundary.points)]
    inside = inside[np.argsort(morton(inside, lo, hi), kind="stable")]
    return inside, levelset.Boundary(boundary.points, own_normals(region, rule, boundary, named)), named, here


def _numbered(
    us: Team, inside: np.ndarray, boundary: levelset.Boundary, named: dict[str, np.ndarray], here: np.ndarray
) -> Slab:
    """Interior particles numbered process by process, then those of the boundary."""
    counts = us.gather(len(inside))
    with us.phase():
        if not sum(counts):
            raise TooCoarse("spacing: too coarse for the shape, which has no interior particle; reduce it")
    group = np.zeros(len(boundary.points), int)
    for k, members in enumerate(named.values()):
        group[members] = k + 1
    own = np.flatnonzero(here)
    number = np.concatenate([sum(counts[: us.rank]) + np.arange(len(inside)), sum(counts) + own])
    points = np.concatenate([inside, boundary.points[own]])
    normals = np.concatenate([np.full(inside.shape, np.nan), boundary.normals[own]])
    every = np.concatenate([np.zeros(len(inside), int), group[own]])
    whole = sum(counts) + len(group)
    slab = Slab((INTERIOR, *named), whole, number, points, normals, every, np.zeros(len(number), int), True)
    slab = placed(us, slab)
    for k, members in enumerate(named.values()):  # boundary particles are numbered without regard to slabs
        some = np.flatnonzero(every == k + 1)
        slab.place[some] = np.searchsorted(np.sort(members), own[some - len(inside)])
    return slab
