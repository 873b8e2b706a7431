"""Clouds of irregular domains, given by a signed distance or by polygons."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from jsmitsm.cloud import contour, filling, levelset, polygons, surface
from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.cloud.filling import SpacingLike
from jsmitsm.cloud.packing.octree import Region, Spacing
from jsmitsm.runtime.arrays import ArrayLike
from jsmitsm.runtime.errors import TooCoarse, explaining, is_whole, numbers, short
from jsmitsm.runtime.progress import bar

# The cosine of 5 degrees: boundary particles whose normals differ by more may stand on two sides of a corner.
_ALIKE = np.cos(np.radians(5.0))
# Normals of neighbours on one side differ by less than 30 degrees.
_SMOOTH = np.cos(np.radians(30.0))
Predicate = Callable[[np.ndarray], Any]


@explaining
@bar("cloud")
def from_sdf(
    sdf: Callable[[Any], Any],
    bounds: tuple[ArrayLike, ArrayLike],
    spacing: SpacingLike,
    seed: int = 0,
    groups: Mapping[str, Predicate] | None = None,
) -> Cloud:
    """Particles of the domain {sdf < 0} in 1D, 2D or 3D, evenly spaced, those of the boundary on the zero level.

    Parameters
    ----------
    sdf : function
        A function of one point x (D,) -> scalar in ``jax.numpy``, negative inside; see ``js.sdf`` for ready ones.
        It need not be a true distance, but must be continuous and cross zero with a slope.
    bounds : pair of array_like (D,)
        (lo, hi), each (D,): a box that contains the domain.
    spacing : float or function
        Distance between neighbours in length units, a number or a function (M, D) -> (M,) of numpy arrays.
    seed : int
        The same seed gives the same cloud.
    groups : mapping, optional
        Maps a name to a predicate: a batch of boundary points, a numpy array (M, D), to (M,) booleans. The first
        that claims a particle gets it. Without it there is the one group ``"boundary"``.

    Returns
    -------
    Cloud
        Interior particles first, then the boundary's. Corners of 2D shapes are particles. Normals are the unit
        gradients of ``sdf``, at corners the normalised bisector, between two groups that of the own side. No
        interior particle is closer to the boundary than about half a spacing. Use ``js.quality`` to see how even
        the cloud is.

    Raises
    ------
    ValueError
        If sdf is nowhere negative in the bounds, not finite, not a scalar, or negative on a face of the bounds; if
        the spacing is too coarse for the shape; if a predicate returns something else than (M,) booleans, claims
        nothing, or some particle is claimed by none.

    Notes
    -----
    The boundary is found by marching triangles on an octree refined to the spacing and projected with Newton's
    method. The interior is a lattice, a little disordered, relaxed near the boundary by short-range repulsion; where
    the spacing varies it is filled by dithering and relaxed everywhere (in the spirit of Fornberg and Flyer, Comput.
    Math. Appl. 69, 2015, and of Slak and Kosec, SIAM J. Sci. Comput. 41, 2019).

    Examples
    --------
    >>> import jsmitsm as js
    >>> plate = js.sdf.difference(
    ...     js.sdf.rectangle((0, 0), (2, 1)), js.sdf.circle((1, 0.5), 0.25)
    ... )
    >>> cloud = js.from_sdf(
    ...     plate,
    ...     ((0, 0), (2, 1)),
    ...     0.05,
    ...     groups={
    ...         "hole": lambda x: abs(x - [1, 0.5]).max(axis=1) < 0.3,
    ...         "outer": lambda x: x[:, 0] > -1,
    ...     },
    ... )
    >>> sorted(cloud.groups), len(cloud.groups["hole"])
    (['hole', 'interior', 'outer'], 31)
    """
    lo, hi = checked_bounds(bounds)
    rule = filling.spacing_function(spacing)
    region = levelset.SdfRegion(sdf, lo, hi)
    seed = checked_seed(seed)
    if len(lo) == 3:
        boundary = surface.surface(region, rule, seed)
    else:
        boundary = (contour.line if len(lo) == 1 else contour.contour)(region, rule)
    boundary = levelset.checked(region, boundary)
    named = grouped(boundary.points, groups) if groups is not None else {"boundary": np.arange(len(boundary.points))}
    return _cloud(region, rule, lo, hi, boundary, named, seed, not callable(spacing))


@explaining
@bar("cloud")
def from_polygon(
    vertices: ArrayLike,
    spacing: SpacingLike,
    holes: Sequence[ArrayLike] = (),
    seed: int = 0,
    groups: Mapping[str, Predicate] | None = None,
) -> Cloud:
    """Particles of a polygon with holes, evenly spaced, the boundary's exactly on the edges.

    Parameters
    ----------
    vertices : array_like (V, 2)
        (V, 2), in order, either way round, the last joined to the first.
    spacing : float or function
        Distance between neighbours in length units, a number or a function (M, 2) -> (M,) of numpy arrays.
    holes : sequence of array_like (V, 2)
        Polygons (V, 2) cut out of it.
    seed : int
        The same seed gives the same cloud.
    groups : mapping, optional
        Predicates as for ``js.from_sdf``. Without them the groups are ``"boundary"`` for the outer polygon and
        ``"hole0"``, ``"hole1"``, ... for the holes.

    Returns
    -------
    Cloud
        Interior particles first, then the boundary's. Every corner is a particle, its normal the normalised
        bisector of its edges', between two groups that of the own edge. Where many short edges stand for a curve
        (turns of less than 20 degrees, edges shorter than the spacing), particles are spread evenly along them
        instead.

    Raises
    ------
    ValueError
        For a polygon that crosses or touches itself, a hole that is not inside or meets another, repeated vertices,
        a spacing too coarse for the shape, or wrong groups.

    Examples
    --------
    >>> import jsmitsm as js
    >>> cloud = js.from_polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], 0.1)
    >>> len(cloud.groups["boundary"])
    80
    """
    rule = filling.spacing_function(spacing)
    loops = [polygons.checked_loop("vertices", vertices)]
    loops += [polygons.checked_loop(f"holes[{k}]", hole)[::-1] for k, hole in enumerate(polygons.checked_holes(holes))]
    names = ["vertices"] + [f"holes[{k}]" for k in range(len(loops) - 1)]
    polygons.check_crossings(loops, names)
    polygons.check_nesting(loops, names)
    seed = checked_seed(seed)
    parts = [polygons.edge_particles(loop, spacing=rule, name=name) for loop, name in zip(loops, names)]
    boundary = levelset.Boundary(*(np.concatenate(arrays) for arrays in zip(*parts)))
    if groups is None:
        ends = np.cumsum([0] + [len(part.points) for part in parts])
        labels = ["boundary"] + [f"hole{k}" for k in range(len(loops) - 1)]
        named = {label: np.arange(i, j) for label, i, j in zip(labels, ends[:-1], ends[1:])}
    else:
        named = grouped(boundary.points, groups)
    lo, hi = loops[0].min(axis=0), loops[0].max(axis=0)
    return _cloud(polygons.PolygonRegion(loops, rule), rule, lo, hi, boundary, named, seed, not callable(spacing))


def _cloud(
    region: Region,
    spacing: Spacing,
    lo: np.ndarray,
    hi: np.ndarray,
    boundary: levelset.Boundary,
    named: dict[str, np.ndarray],
    seed: int,
    uniform: bool,
) -> Cloud:
    """Fill the interior and put everything together."""
    inside = filling.fill(region, spacing, lo, hi, boundary.points, seed, uniform)
    if not len(inside):
        raise TooCoarse(
            "spacing: too coarse for the shape, no interior particle fits half a spacing away from its "
            f"{len(boundary.points)} boundary particles; reduce it well below the width of the shape"
        )
    boundary = levelset.Boundary(boundary.points, own_normals(region, spacing, boundary, named))
    index = {INTERIOR: np.arange(len(inside))}
    index |= {name: members + len(inside) for name, members in named.items()}
    normals = np.concatenate([np.full(inside.shape, np.nan), boundary.normals])
    made = Cloud(np.concatenate([inside, boundary.points]), index, normals)
    made._shape = region
    return made


def own_normals(
    region: Region, spacing: Spacing, boundary: levelset.Boundary, named: dict[str, np.ndarray]
) -> np.ndarray:
    """The normals (B, D), at corners between groups those of the own side: what is said of a side holds to its end."""
    points, normals = boundary
    dim = points.shape[1]
    if len(named) == 1 or dim == 1:
        return normals
    from scipy.spatial import cKDTree

    label = np.empty(len(points), int)
    for k, members in enumerate(named.values()):
        label[members] = k
    away, near = cKDTree(points).query(points, k=min(6 * dim - 7, len(points)))
    around = away <= 1.6 * spacing(points)[:, None]
    around &= np.einsum("md,mkd->mk", normals, normals[near]) < _ALIKE
    own = around & (label[near] == label[:, None])
    own &= (around & (label[near] != label[:, None])).any(axis=1)[:, None]
    at, which = np.nonzero(own)
    # A little towards a neighbour on the own side the distance grows along that side's normal.
    step, little = points[near[at, which]] - points[at], 1e-7
    if getattr(region, "piecewise", False):  # known by distances to edges: off them, and farther for the digits
        step += 0.1 * np.linalg.norm(step, axis=1, keepdims=True) * normals[at]
        little = 1e-3
    side = region.distance(points[at] + little * step)[1]
    # In space a neighbour may lie on the same edge: its normal is that of no side.
    side[(dim == 3) & (np.einsum("md,md->m", side, normals[near[at, which]]) < _SMOOTH)] = 0.0
    total = np.zeros(points.shape)
    np.add.at(total, at, side)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1.0), normals)


def grouped(points: np.ndarray, groups: Mapping[str, Predicate]) -> dict[str, np.ndarray]:
    """Indices of the boundary points that each predicate is the first to claim."""
    if not isinstance(groups, Mapping) or not groups or not all(map(callable, groups.values())):
        raise ValueError(
            f"groups: expected a dict of names and functions (M, D) -> (M,) booleans, got {groups!r}; "
            "leave it out for one group 'boundary'"
        )
    if INTERIOR in groups:
        raise ValueError(f"groups: the name {INTERIOR!r} is taken by the interior particles; choose another")
    free = np.ones(len(points), bool)
    named = {}
    for name, predicate in groups.items():
        claimed = np.asarray(predicate(points.copy()))
        if claimed.shape != (len(points),) or claimed.dtype != bool:
            raise ValueError(
                f"groups[{name!r}]: the predicate returned {claimed.dtype} of shape {claimed.shape} for points of "
                f"shape {points.shape}, expected bool of shape {(len(points),)}; compare columns, as in x[:, 0] < 1e-6"
            )
        named[name] = np.flatnonzero(claimed & free)
        if not len(named[name]):
            raise ValueError(
                f"groups[{name!r}]: claims no boundary particle ({claimed.sum()} match, all taken by groups before "
                "it; the first match wins); correct the predicate (rounding? use a tolerance) or drop the group"
            )
        free &= ~claimed
    if free.any():
        raise ValueError(
            f"groups: {free.sum()} boundary particles are claimed by none of {list(groups)}, e.g. at "
            f"{points[free][0]}; widen a predicate (rounding? use a tolerance) or add a last one that takes the rest"
        )
    return named


def checked_seed(seed: Any) -> int:
    if not is_whole(seed, 0):
        raise ValueError(f"seed: expected a whole number >= 0, got {seed!r}")
    return int(seed)


def checked_bounds(bounds: Any) -> tuple[np.ndarray, np.ndarray]:
    """The corners of the box as two float arrays (D,)."""
    try:
        lo, hi = (np.atleast_1d(numbers("bounds", corner)) for corner in bounds)
        good = lo.shape == hi.shape and lo.ndim == 1 and len(lo) in (1, 2, 3)
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good:
        raise ValueError(f"bounds: expected (lo, hi) with D = 1, 2 or 3 numbers each, got {short(bounds)}")
    if not (np.isfinite(lo).all() and np.isfinite(hi).all() and (hi > lo).all()):
        raise ValueError(f"bounds: hi = {hi} must be greater than lo = {lo} along every axis, all finite")
    return lo, hi
