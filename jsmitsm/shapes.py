"""Clouds of irregular domains, given by a signed distance or by polygons."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from jsmitsm import levelset, packing
from jsmitsm.clouds import INTERIOR, Cloud
from jsmitsm.packing import Quality as Quality
from jsmitsm.packing import Spacing
from jsmitsm.packing import quality as quality

Predicate = Callable[[np.ndarray], Any]

_SHARP = np.deg2rad(20.0)  # a vertex that turns by more is a corner of the shape, not a sample of a curve


def from_sdf(
    sdf: Callable,
    bounds: tuple[Any, Any],
    spacing: Any,
    seed: int = 0,
    groups: Mapping[str, Predicate] | None = None,
) -> Cloud:
    """Particles of the domain {sdf < 0} in 1D, 2D or 3D, evenly spaced, those of the boundary on the zero level.

    Parameters
    ----------
    sdf : a function of one point x (D,) -> scalar in ``jax.numpy``, negative inside; see :mod:`jsmitsm.sdf` for
        ready ones. It need not be a true distance, but must be continuous and cross zero with a slope.
    bounds : (lo, hi), each (D,): a box that contains the domain.
    spacing : distance between neighbours in length units, a number or a function (M, D) -> (M,) of numpy arrays.
    seed : the same seed gives the same cloud.
    groups : maps a name to a predicate: a batch of boundary points, a numpy array (M, D), to (M,) booleans. The
        first that claims a particle gets it. Without it there is the one group ``"boundary"``.

    Returns
    -------
    Cloud : interior particles first, then the boundary's. Corners of 2D shapes are particles. Normals are the unit
        gradients of ``sdf``, at corners the normalised bisector. No interior particle is closer to the boundary
        than about half a spacing. Use :func:`quality` to see how even the cloud is.

    Raises
    ------
    ValueError
        If sdf is nowhere negative in the bounds, not finite, not a scalar, or negative on a face of the bounds; if
        the spacing is too coarse for the shape; if a predicate returns something else than (M,) booleans, claims
        nothing, or some particle is claimed by none.

    The boundary is found by marching triangles on an octree refined to the spacing and projected with Newton's
    method; the interior is filled by dithering and relaxed by short-range repulsion (in the spirit of Fornberg and
    Flyer, Comput. Math. Appl. 69, 2015, and of Slak and Kosec, SIAM J. Sci. Comput. 41, 2019).

    >>> import jsmitsm as js
    >>> plate = js.sdf.difference(js.sdf.rectangle((0, 0), (2, 1)), js.sdf.circle((1, 0.5), 0.25))
    >>> cloud = js.from_sdf(plate, ((0, 0), (2, 1)), 0.05, groups={
    ...     "hole": lambda x: abs(x - [1, 0.5]).max(axis=1) < 0.3, "outer": lambda x: x[:, 0] > -1})
    >>> sorted(cloud.groups), len(cloud.groups["hole"])
    (['hole', 'interior', 'outer'], 31)
    """
    lo, hi = _checked_bounds(bounds)
    rule = packing.spacing_function(spacing)
    region = levelset.SdfRegion(sdf, lo, hi)
    boundary = levelset.boundary_of(region, rule, _checked_seed(seed))
    named = _grouped(boundary.points, groups) if groups is not None else {"boundary": np.arange(len(boundary.points))}
    return _cloud(region, rule, lo, hi, boundary, named, seed, not callable(spacing))


def from_polygon(
    vertices: Any,
    spacing: Any,
    holes: Sequence[Any] = (),
    seed: int = 0,
    groups: Mapping[str, Predicate] | None = None,
) -> Cloud:
    """Particles of a polygon with holes, evenly spaced, the boundary's exactly on the edges.

    Parameters
    ----------
    vertices : (V, 2), in order, either way round, the last joined to the first.
    spacing : distance between neighbours in length units, a number or a function (M, 2) -> (M,) of numpy arrays.
    holes : polygons (V, 2) cut out of it.
    seed : the same seed gives the same cloud.
    groups : predicates as for :func:`from_sdf`. Without them the groups are ``"boundary"`` for the outer polygon and
        ``"hole0"``, ``"hole1"``, ... for the holes.

    Returns
    -------
    Cloud : interior particles first, then the boundary's. Every corner is a particle, its normal the normalised
        bisector of its edges'. Where many short edges stand for a curve (turns of less than 20 degrees, edges shorter
        than the spacing), particles are spread evenly along them instead.

    Raises
    ------
    ValueError
        For a polygon that crosses or touches itself, a hole that is not inside or meets another, repeated vertices,
        a spacing too coarse for the shape, or wrong groups.

    >>> import jsmitsm as js
    >>> cloud = js.from_polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], 0.1)
    >>> len(cloud.groups["boundary"])
    80
    """
    rule = packing.spacing_function(spacing)
    loops = [_checked_loop("vertices", vertices)]
    loops += [_checked_loop(f"holes[{k}]", hole)[::-1] for k, hole in enumerate(_checked_holes(holes))]
    names = ["vertices"] + [f"holes[{k}]" for k in range(len(loops) - 1)]
    _check_crossings(loops, names)
    _check_nesting(loops, names)
    seed = _checked_seed(seed)
    parts = [_edge_particles(loop, rule, name) for loop, name in zip(loops, names)]
    boundary = levelset.Boundary(*(np.concatenate(arrays) for arrays in zip(*parts)))
    if groups is None:
        ends = np.cumsum([0] + [len(part.points) for part in parts])
        labels = ["boundary"] + [f"hole{k}" for k in range(len(loops) - 1)]
        named = {label: np.arange(i, j) for label, i, j in zip(labels, ends[:-1], ends[1:])}
    else:
        named = _grouped(boundary.points, groups)
    lo, hi = loops[0].min(axis=0), loops[0].max(axis=0)
    return _cloud(_PolygonRegion(loops, rule), rule, lo, hi, boundary, named, seed, not callable(spacing))


def _cloud(
    region: packing.Region,
    spacing: Spacing,
    lo: np.ndarray,
    hi: np.ndarray,
    boundary: levelset.Boundary,
    named: dict[str, np.ndarray],
    seed: int,
    uniform: bool,
) -> Cloud:
    """Fill the interior and put everything together."""
    inside = packing.fill(region, spacing, lo, hi, boundary.points, seed, uniform)
    if not len(inside):
        raise ValueError(
            "spacing: too coarse for the shape, no interior particle fits half a spacing away from its "
            f"{len(boundary.points)} boundary particles; reduce it well below the width of the shape"
        )
    index = {INTERIOR: np.arange(len(inside))}
    index |= {name: members + len(inside) for name, members in named.items()}
    normals = np.concatenate([np.full(inside.shape, np.nan), boundary.normals])
    return Cloud(np.concatenate([inside, boundary.points]), index, normals)


def _grouped(points: np.ndarray, groups: Mapping[str, Predicate]) -> dict[str, np.ndarray]:
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


def _checked_seed(seed: Any) -> int:
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed: expected a whole number >= 0, got {seed!r}")
    return int(seed)


def _checked_bounds(bounds: Any) -> tuple[np.ndarray, np.ndarray]:
    """The corners of the box as two float arrays (D,)."""
    try:
        lo, hi = (np.atleast_1d(np.asarray(corner, dtype=np.float64)) for corner in bounds)
        good = lo.shape == hi.shape and lo.ndim == 1 and len(lo) in (1, 2, 3)
    except (TypeError, ValueError):
        good = False
    if not good:
        raise ValueError(f"bounds: expected (lo, hi) with D = 1, 2 or 3 numbers each, got {bounds!r}")
    if not (np.isfinite(lo).all() and np.isfinite(hi).all() and (hi > lo).all()):
        raise ValueError(f"bounds: hi = {hi} must be greater than lo = {lo} along every axis, all finite")
    return lo, hi


def _checked_holes(holes: Any) -> list[Any]:
    if isinstance(holes, (str, Mapping)) or not hasattr(holes, "__iter__"):
        raise ValueError(f"holes: expected a sequence of polygons (V, 2), got {holes!r}")
    holes = list(holes)
    if any(np.ndim(hole) == 1 for hole in holes):
        raise ValueError("holes: expected a sequence of polygons (V, 2), got one polygon; pass holes=[vertices]")
    return holes


def _checked_loop(name: str, vertices: Any) -> np.ndarray:
    """Vertices (V, 2) of a polygon, counter-clockwise, not closed."""
    try:
        loop = np.asarray(vertices, dtype=np.float64)
    except (TypeError, ValueError):
        loop = np.zeros(0)
    if loop.ndim != 2 or loop.shape[1] != 2:
        raise ValueError(f"{name}: expected an array of shape (V, 2), got {np.shape(loop)}")
    if not np.isfinite(loop).all():
        raise ValueError(f"{name}: not finite at vertex {np.flatnonzero(~np.isfinite(loop).all(axis=1))[0]}")
    if len(loop) > 1 and (loop[0] == loop[-1]).all():
        loop = loop[:-1]  # many programs repeat the first vertex to close the polygon
    if len(loop) < 3:
        raise ValueError(f"{name}: {len(loop)} different vertices, at least 3 are needed for a polygon")
    same = np.flatnonzero((loop == np.roll(loop, -1, axis=0)).all(axis=1))
    if len(same):
        raise ValueError(f"{name}: vertex {same[0]} at {loop[same[0]]} is repeated by the next; drop one")
    return loop if _area(loop) > 0 else loop[::-1]


def _area(loop: np.ndarray) -> float:
    """Signed area by the shoelace formula, about the first vertex to keep digits."""
    x, y = (loop - loop[0]).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2


def _check_crossings(loops: list[np.ndarray], names: list[str]) -> None:
    """Raise if edges meet anywhere but at the vertex they share."""
    a = np.concatenate(loops)
    b = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    owner = np.repeat(np.arange(len(loops)), [len(loop) for loop in loops])
    number = np.concatenate([np.arange(len(loop)) for loop in loops])
    after = np.concatenate([np.roll(np.arange(len(loop)), -1) for loop in loops])

    def side(p, q, r):  # which side of pq is r on; zero within round-off
        u, v = q - p, r - p
        turn = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
        noise = 1e-12 * np.linalg.norm(u, axis=-1) * np.maximum(np.linalg.norm(v, axis=-1), np.linalg.norm(u, axis=-1))
        return np.where(np.abs(turn) <= noise, 0.0, np.sign(turn))

    for i in range(len(a) - 1):
        p, q, c, d = a[i], b[i], a[i + 1 :], b[i + 1 :]
        boxes = (np.maximum(c, d) >= np.minimum(p, q)).all(axis=1) & (np.minimum(c, d) <= np.maximum(p, q)).all(axis=1)
        j = np.flatnonzero(boxes) + i + 1
        c, d = a[j], b[j]
        meet = (side(p, q, c) * side(p, q, d) <= 0) & (side(c, d, p) * side(c, d, q) <= 0)
        follows = (owner[j] == owner[i]) & ((after[i] == number[j]) | (after[j] == number[i]))
        # Neighbours meet at their vertex; they overlap only where one folds back onto the other.
        folded = (side(p, q, c) == 0) & (side(p, q, d) == 0) & ((d - c) @ (q - p) < 0)
        bad = j[meet & (~follows | folded)]
        if len(bad):
            k = bad[0]
            one, two = names[owner[i]], names[owner[k]]
            what = f"{one}: crosses or touches itself" if one == two else f"{two}: crosses or touches {one}"
            raise ValueError(
                f"{what}, the edge from {a[i]} to {b[i]} meets the one from {a[k]} to {b[k]}; "
                "reorder or move the vertices (polygons that meet must be joined into one)"
            )


def _check_nesting(loops: list[np.ndarray], names: list[str]) -> None:
    """Raise unless every hole is inside of the outer polygon and of no other hole."""
    for k in range(1, len(loops)):
        if not _inside(loops[k][:1], loops[:1])[0]:
            raise ValueError(
                f"{names[k]}: lies outside of the polygon (its vertex {loops[k][0]}); holes must be inside of `vertices`"
            )
        for other in range(1, len(loops)):
            if other != k and _inside(loops[k][:1], [loops[other]])[0]:
                raise ValueError(f"{names[k]}: lies inside of {names[other]}; a hole in a hole cuts nothing, drop it")


def _inside(x: np.ndarray, loops: list[np.ndarray]) -> np.ndarray:
    """Even-odd rule for points (M, 2), in horizontal bands so that each point meets few edges."""
    a = np.concatenate(loops)
    b = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    low, high = np.minimum(a[:, 1], b[:, 1]), np.maximum(a[:, 1], b[:, 1])
    bands = int(np.clip(len(a) // 8, 1, 512))
    cuts = np.linspace(low.min(), high.max(), bands + 1)
    band = np.clip(np.searchsorted(cuts, x[:, 1], side="right") - 1, 0, bands - 1)
    order = np.argsort(band, kind="stable")
    ends = np.searchsorted(band[order], np.arange(bands + 1))
    result = np.zeros(len(x), bool)
    for k in range(bands):
        rows = order[ends[k] : ends[k + 1]]
        for edge in np.flatnonzero((low <= cuts[k + 1]) & (high >= cuts[k]) & (high > low)) if len(rows) else ():
            (ax, ay), (bx, by) = a[edge], b[edge]
            px, py = x[rows].T
            across = (ay > py) != (by > py)
            result[rows] ^= across & (px < ax + (py - ay) * (bx - ax) / (by - ay))
    return result


def _edge_particles(loop: np.ndarray, spacing: Spacing, name: str) -> levelset.Boundary:
    """Particles (B, 2) on the edges of a polygon and at its corners, outward normals right of the way."""
    ahead = np.roll(loop, -1, axis=0)
    edge = ahead - loop
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    before = np.roll(normal, 1, axis=0)
    turn = np.arctan2(np.abs(before[:, 0] * normal[:, 1] - before[:, 1] * normal[:, 0]), (before * normal).sum(axis=1))
    paths = [_sampled(a, b, spacing) for a, b in zip(loop, ahead)]
    lengths = np.array([packing.path_lengths(path, spacing)[-1] for path in paths])
    if lengths.sum() < levelset.LEAST:
        raise ValueError(
            f"spacing: too coarse for the shape, {name} is only {lengths.sum():.2g} spacings round, "
            f"at least {levelset.LEAST:g} are needed"
        )
    sharp = turn > _SHARP
    tight = np.flatnonzero(sharp & np.roll(sharp, -1) & (lengths < 0.1))
    if len(tight):
        raise ValueError(
            f"spacing: too coarse for the shape, the edge of {name} from {loop[tight[0]]} to {ahead[tight[0]]} is only "
            f"{lengths[tight[0]]:.2g} spacings long; reduce the spacing there or simplify the polygon"
        )
    kept = sharp | (np.minimum(lengths, np.roll(lengths, 1)) > 0.75)
    points, normals = [], []
    first = int(np.argmax(kept))  # the first vertex if none is kept
    stops = np.flatnonzero(np.roll(kept, -first))
    stops = np.append(stops if len(stops) else [0], len(loop))
    for i, j in zip(stops[:-1], stops[1:]):
        numbers = (first + np.arange(i, j)) % len(loop)
        path = np.concatenate([paths[k][:-1] for k in numbers] + [ahead[numbers[-1]][None]])
        piece = np.concatenate([np.full(len(paths[k]) - 1, k) for k in numbers])
        at, where = packing.divide(path, spacing)
        points.append(at[:-1])
        normals.append(normal[piece[where[:-1]]])
        bisector = before[numbers[0]] + normal[numbers[0]]
        normals[-1][0] = bisector / np.linalg.norm(bisector)
    return levelset.Boundary(np.concatenate(points), np.concatenate(normals))


def _sampled(a: np.ndarray, b: np.ndarray, spacing: Spacing) -> np.ndarray:
    """Points along an edge, close enough together to follow a variable spacing."""
    path = a + np.linspace(0.0, 1.0, 17)[:, None] * (b - a)
    count = min(100_000, int(8 * packing.path_lengths(path, spacing)[-1]))
    return path if count < 17 else a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)


class _PolygonRegion:
    """Signed distance of a polygon with holes, by the nearest of many short pieces of its edges."""

    def __init__(self, loops: list[np.ndarray], spacing: Spacing):
        from scipy.spatial import cKDTree

        self._loops = loops
        chains = [
            packing.divide(_sampled(a, b, spacing), spacing)[0]
            for loop in loops
            for a, b in zip(loop, np.roll(loop, -1, axis=0))
        ]
        self._start = np.concatenate([chain[:-1] for chain in chains])
        self._step = np.concatenate([np.diff(chain, axis=0) for chain in chains])
        self._tree = cKDTree(self._start + self._step / 2)

    def distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance (M,), negative inside, and the unit direction of its growth (M, 2)."""
        if not len(x):
            return np.zeros(0), np.zeros((0, 2))
        near = self._tree.query(x, k=min(6, len(self._start)))[1]
        offset, step = x[:, None] - self._start[near], self._step[near]
        along = np.clip((offset * step).sum(axis=2) / (step * step).sum(axis=2), 0.0, 1.0)
        away = offset - along[..., None] * step
        square = (away * away).sum(axis=2)
        best = square.argmin(axis=1)
        row = np.arange(len(x))
        size = np.sqrt(square[row, best])
        sign = np.where(_inside(x, self._loops), -1.0, 1.0)
        return sign * size, away[row, best] * (sign / np.maximum(size, 1e-300))[:, None]
