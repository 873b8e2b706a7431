"""Shapes filled in parts: every process has the particles of its slab, and all together those of one process."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jsmitsm.cloud import contour, filling, levelset, surface
from jsmitsm.cloud.cloud import INTERIOR
from jsmitsm.cloud.packing.lattice import lattice_part
from jsmitsm.cloud.packing.octree import morton
from jsmitsm.cloud.shapes import checked_bounds, checked_seed, from_sdf, grouped, own_normals
from jsmitsm.parallel.distributed import ParallelCloud, Slab, placed
from jsmitsm.parallel.team import Team, team
from jsmitsm.runtime.errors import explaining


@explaining
def cloud_from(make: Callable[..., Any], *arguments: Any, **options: Any) -> ParallelCloud:
    """A shape filled by all processes, each its own slab of it.

    Parameters
    ----------
    make : js.from_sdf
        What fills the shape: ``js.from_sdf``, in 2D or 3D, with one spacing everywhere.
    *arguments, **options
        Its own: sdf, bounds, spacing, seed, groups.

    Returns
    -------
    ParallelCloud
        The slab of this process. The boundary is that of ``make``. The interior is the same lattice, with another
        disorder: one that hangs on the place alone, so that any number of processes fills a shape with the same
        particles. Every process finds the whole boundary, and no more of the interior than its slab.

    Raises
    ------
    ValueError
        As ``make``, on all processes; and for other makers and spacings that vary, which cannot be made in parts:
        make such a cloud once, and let every process map it by ``jp.read``.

    Examples
    --------
    ``cloud = jp.cloud_from(js.from_sdf, js.sdf.sphere((0, 0, 0), 1.0), ((-1, -1, -1), (1, 1, 1)), 0.02)``
    """
    us = team()
    with us.phase():
        if make is not from_sdf:
            name = getattr(make, "__name__", repr(make))
            raise ValueError(
                f"make: {name} is not made in parts, js.from_sdf is; save its points, groups and normals as .npy, and "
                "use jp.read"
            )
        given = inspect.signature(from_sdf).bind(*arguments, **options)
        given.apply_defaults()
        slab = _filled(us, **given.arguments)
    return ParallelCloud(_numbered(us, *slab))


def _filled(
    us: Team, sdf: Any, bounds: Any, spacing: Any, seed: Any, groups: Mapping[str, Any] | None
) -> tuple[np.ndarray, levelset.Boundary, dict[str, np.ndarray], np.ndarray]:
    """The own interior particles, the whole boundary with its groups, and the slab's ends."""
    lo, hi = checked_bounds(bounds)
    if callable(spacing):
        raise ValueError(
            "spacing: one that varies is not made in parts, since the particles repel each other everywhere; make the "
            "cloud once by js.from_sdf, save it, and use jp.read"
        )
    if len(lo) == 1:
        raise ValueError("bounds: a shape in 1D has no need of several processes; use js.from_sdf")
    rule, seed = filling.spacing_function(spacing), checked_seed(seed)
    region = levelset.SdfRegion(sdf, lo, hi)
    boundary = surface.surface(region, rule, seed) if len(lo) == 3 else contour.contour(region, rule)
    boundary = levelset.checked(region, boundary)
    named = grouped(boundary.points, groups) if groups is not None else {"boundary": np.arange(len(boundary.points))}
    axis = int(np.argmax(hi - lo))
    ends = lo[axis] + (hi[axis] - lo[axis]) * np.arange(us.size + 1) / us.size
    ends[0], ends[-1] = -np.inf, np.inf
    inside = lattice_part(region, float(spacing), lo, hi, boundary.points, seed, axis, ends[us.rank : us.rank + 2])
    inside = inside[np.argsort(morton(inside, lo, hi), kind="stable")]
    boundary = levelset.Boundary(boundary.points, own_normals(region, rule, boundary, named))
    here = (boundary.points[:, axis] >= ends[us.rank]) & (boundary.points[:, axis] < ends[us.rank + 1])
    return inside, boundary, named, here


def _numbered(
    us: Team, inside: np.ndarray, boundary: levelset.Boundary, named: dict[str, np.ndarray], here: np.ndarray
) -> Slab:
    """Interior particles numbered process by process, then those of the boundary."""
    counts = us.gather(len(inside))
    with us.phase():
        if not sum(counts):
            raise ValueError("spacing: too coarse for the shape, which has no interior particle; reduce it")
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
