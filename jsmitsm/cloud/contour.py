"""Boundary particles of a signed-distance-like function in 1D and 2D: ends of intervals, closed curves with corners."""

from __future__ import annotations

import numpy as np

from jsmitsm.cloud import filling, levelset
from jsmitsm.cloud.filling import Spacing

_CORNER = np.cos(np.deg2rad(8.0))  # normals that differ by more, however close, make a corner


def line(region: levelset.SdfRegion, spacing: Spacing) -> levelset.Boundary:
    """Ends of the intervals in 1D."""
    cells, coarse = levelset.cells_near(region, spacing, 0.5)
    x = np.concatenate([cells.centers, coarse.centers])
    x = x[np.argsort(x[:, 0])]
    negative = region.evaluate(x)[0] < 0
    change = np.flatnonzero(negative[1:] != negative[:-1])
    points = levelset.root(region, x[change], x[change + 1], 1e-15)
    points, _ = region.project(points, np.full(len(points), 1e-6 * region.size))
    return levelset.Boundary(points, np.where(negative[change + 1], -1.0, 1.0)[:, None])


def contour(region: levelset.SdfRegion, spacing: Spacing, forced: np.ndarray | None = None) -> levelset.Boundary:
    """The zero level in 2D: closed polylines from marching triangles, cut at corners, divided evenly.

    forced (C, 2): points of which those on the zero level become particles.
    """
    cells, coarse = levelset.cells_near(region, spacing, 0.4)
    loops = _without_tips(region, _polylines(region, cells, coarse), spacing)
    if not loops:
        raise ValueError("spacing: too coarse for the shape, no boundary was found; reduce it below the shape's width")
    parts = [_divided_loop(region, loop, spacing, forced) for loop in loops]
    boundary = levelset.Boundary(*(np.concatenate(arrays) for arrays in zip(*parts)))
    _check_seen(region, cells, np.concatenate([*loops, boundary.points]))
    return boundary


def corners(region: levelset.SdfRegion, spacing: Spacing) -> np.ndarray:
    """The corners (C, 2) of the zero level in 2D."""
    cells, coarse = levelset.cells_near(region, spacing, 0.4)
    loops = _without_tips(region, _polylines(region, cells, coarse), spacing)
    return np.concatenate([np.zeros((0, 2)), *(_corners(region, loop)[1].points for loop in loops)])


def _without_tips(region: levelset.SdfRegion, loops: list[np.ndarray], spacing: Spacing) -> list[np.ndarray]:
    """Drop pieces of the domain's sharp tips that the triangles cut off: the corners come back exactly.

    Raises for a small loop that is a hole or stands alone.
    """
    from scipy.spatial import cKDTree

    lengths = [filling.path_lengths(np.concatenate([loop, loop[:1]]), spacing)[-1] for loop in loops]
    large = [loop for loop, length in zip(loops, lengths) if length >= levelset.LEAST]
    tree = cKDTree(np.concatenate(large)) if large else None
    for loop, length in zip(loops, lengths):
        if length < levelset.LEAST:
            middle = loop.mean(axis=0, keepdims=True)
            lone = tree is None or tree.query(loop)[0].min() > float(spacing(loop).max())
            if lone or region.evaluate(middle)[0][0] > 0:
                raise ValueError(
                    f"spacing: too coarse for the shape, a closed boundary near {loop[0]} is only {length:.2g} "
                    f"spacings round, at least {levelset.LEAST:g} are needed; reduce the spacing there (it may be a "
                    "function of the position)"
                )
    return large


def _polylines(region: levelset.SdfRegion, cells: filling.Cells, coarse: filling.Cells) -> list[np.ndarray]:
    """Closed polylines (M, 2) of the zero level on a Delaunay triangulation of the cells' centres."""
    from scipy.spatial import Delaunay

    # A little disorder keeps the triangulation clear of cocircular points and of symmetric zeros.
    every = np.concatenate([cells.centers, coarse.centers])
    width = np.concatenate([cells.widths, coarse.widths])
    every = every + np.random.default_rng(0).uniform(-0.1, 0.1, every.shape) * width[:, None]
    negative = region.evaluate(every)[0] < 0
    triangles = Delaunay(every).simplices
    triangles = triangles[(negative[triangles].sum(axis=1) % 3) != 0]
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    crossed = negative[edges[..., 0]] != negative[edges[..., 1]]  # two edges of every such triangle
    ends, number = np.unique(edges[crossed], axis=0, return_inverse=True)
    links: list[list[int]] = [[] for _ in range(len(ends))]
    for i, j in number.reshape(-1, 2).tolist():
        links[i].append(j)
        links[j].append(i)
    points = levelset.root(region, every[ends[:, 0]], every[ends[:, 1]], 1e-7)
    loops, seen = [], [False] * len(ends)
    for first in range(len(ends)):
        loop, at = [], first
        while not seen[at]:
            seen[at] = True
            loop.append(at)
            at = next((j for j in links[at] if not seen[j]), at)
        if len(loop) > 2:
            loops.append(_without_specks(points[loop]))
    return [loop for loop in loops if len(loop) > 2]


def _without_specks(loop: np.ndarray) -> np.ndarray:
    """Drop points of a closed polyline much closer to the one before than those around: their normals tell nothing."""
    length = np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1)
    around = np.max([np.roll(length, k) for k in (-2, -1, 1, 2)], axis=0)
    return loop[length > 0.02 * around]


def _check_seen(region: levelset.SdfRegion, cells: filling.Cells, found: np.ndarray) -> None:
    """Raise if some part of the zero level is too small to show up in the polylines."""
    from scipy.spatial import cKDTree

    close = np.abs(cells.distance) < 1.5 * cells.widths
    x, width = cells.centers[close], cells.widths[close]
    x, arrived = region.project(x, width)
    gap = cKDTree(found).query(x)[0]
    missed = arrived & (gap > 3 * width) & (np.linalg.norm(x - cells.centers[close], axis=1) < 2 * width)
    x, width = x[missed], width[missed]
    outward = region.distance(x)[1]
    # Where two shapes of a union touch, zero is reached from inside on both sides: that is no boundary.
    shift = 1e-4 * width[:, None] * outward
    real = (region.evaluate(x + shift)[0] > 0) & (region.evaluate(x - shift)[0] < 0)
    if real.any():
        raise ValueError(
            f"spacing: too coarse for the shape, whose boundary near {x[real][0]} is smaller than half a spacing; "
            "reduce the spacing there (it may be a function of the position)"
        )


def _divided_loop(
    region: levelset.SdfRegion, loop: np.ndarray, spacing: Spacing, forced: np.ndarray | None = None
) -> levelset.Boundary:
    """Evenly spaced particles on a closed polyline of the zero level, its corners and ``forced`` points among them."""
    after, corners = _corners(region, loop)
    if forced is not None and len(forced):
        after, corners = _with_forced(region, loop, after, corners, forced, spacing)
    if len(after):
        loop = np.roll(loop, -(after[0] + 1), axis=0)  # begins right behind the first corner
        after = after - after[0] - 1
        bounds = np.concatenate([after[1:], [len(loop) - 1]]) + 1
        starts = np.concatenate([[0], bounds[:-1]])
        parts = []
        for k, (i, j) in enumerate(zip(starts, bounds)):
            end = corners.points[(k + 1) % len(corners.points)]
            path = np.concatenate([corners.points[k][None], loop[i:j], end[None]])
            parts.append(filling.divide(path, spacing)[0][1:-1])
        smooth = np.concatenate(parts)
    else:
        smooth = filling.divide(np.concatenate([loop, loop[:1]]), spacing)[0][:-1]
    smooth = _on_level(region, smooth, spacing)
    points = np.concatenate([corners.points, smooth])
    normals = np.concatenate([corners.normals, region.normals(smooth)])
    kept = filling.uncrowded(points, spacing(points), len(after))
    return levelset.Boundary(points[kept], normals[kept])


def _with_forced(
    region: levelset.SdfRegion, loop: np.ndarray, after: np.ndarray, corners: levelset.Boundary, forced: np.ndarray,
    spacing: Spacing,
) -> tuple[np.ndarray, levelset.Boundary]:  # fmt: skip
    """The corners of a polyline with further points of the zero level, in the order of the polyline."""
    from scipy.spatial import cKDTree

    h = spacing(forced)
    on = np.abs(region.distance(forced)[0]) < 1e-9 * region.size
    # The polyline is finer than the spacing; points of other loops are far from it.
    on &= cKDTree(loop).query(forced)[0] < 0.5 * h
    if len(corners.points):
        on &= cKDTree(corners.points).query(forced)[0] > 1e-9 * region.size
    forced = np.unique(forced[on], axis=0)
    start, step = loop, np.roll(loop, -1, axis=0) - loop
    square = np.maximum((step * step).sum(axis=1), 1e-300)
    along = np.clip(((forced[:, None] - start) * step).sum(axis=2) / square, 0.0, 1.0)
    away = np.linalg.norm(start + along[..., None] * step - forced[:, None], axis=2)
    place = away.argmin(axis=1)
    position = np.concatenate([after + 0.5, place + along[np.arange(len(forced)), place]])
    # Two on one piece of the polyline would leave none between them; they are farther apart than that.
    order = np.argsort(position, kind="stable")
    points = np.concatenate([corners.points, forced])[order]
    normals = np.concatenate([corners.normals, region.normals(forced)])[order]
    return np.concatenate([after, place])[order], levelset.Boundary(points, normals)


def _on_level(region: levelset.SdfRegion, x: np.ndarray, spacing: Spacing) -> np.ndarray:
    """Points near the zero level moved onto it; where Newton fails, by bisection along the gradient."""
    h = spacing(x)
    found, arrived = region.project(x, h / 4)
    arrived &= np.linalg.norm(found - x, axis=1) < h / 2
    lost = np.flatnonzero(~arrived)
    if len(lost):
        shift = 0.3 * h[lost, None] * region.distance(x[lost])[1]
        a, b = x[lost] - shift, x[lost] + shift
        bracket = (region.evaluate(a)[0] < 0) & (region.evaluate(b)[0] > 0)
        found[lost[bracket]] = levelset.root(region, a[bracket], b[bracket], 1e-16)
    return found


def _corners(region: levelset.SdfRegion, loop: np.ndarray) -> tuple[np.ndarray, levelset.Boundary]:
    """Corners of a closed polyline: the points they come after, their places, bisectors as normals."""
    normal = region.distance(loop)[1]
    turning = np.einsum("md,md->m", normal, np.roll(normal, -1, axis=0)) < _CORNER
    after = np.flatnonzero(turning)
    a, b, na, nb = _jumps(region, loop[after], np.roll(loop, -1, axis=0)[after])
    sharp = np.einsum("md,md->m", na, nb) < _CORNER
    after, a, b, na, nb = (v[sharp] for v in (after, a, b, na, nb))
    points, na, nb = _meeting(region, a, b, na, nb)
    bisector = na + nb
    length = np.linalg.norm(bisector, axis=1, keepdims=True)
    return after, levelset.Boundary(points, np.where(length > 1e-6, bisector / np.maximum(length, 1e-300), na))


def _meeting(
    region: levelset.SdfRegion, a: np.ndarray, b: np.ndarray, na: np.ndarray, nb: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Corners (M, 2) between the sides through a and b with normals na and nb, and the normals there.

    A corner is where the sides' tangents meet, once the points of tangency have come close to it.
    """
    best, best_a, best_b = a.copy(), na.copy(), nb.copy()
    error = np.abs(region.distance(best)[0]) + np.linalg.norm(b - a, axis=1)  # not a corner yet, so far off
    for _ in range(8):
        cross = na[:, 0] * nb[:, 1] - na[:, 1] * nb[:, 0]
        cross = np.where(np.abs(cross) > 1e-6, cross, 1.0)
        ra, rb = np.einsum("md,md->m", na, a), np.einsum("md,md->m", nb, b)
        meet = np.stack([ra * nb[:, 1] - rb * na[:, 1], rb * na[:, 0] - ra * nb[:, 0]], axis=1) / cross[:, None]
        far_a, far_b = np.linalg.norm(a - meet, axis=1), np.linalg.norm(b - meet, axis=1)
        off = np.abs(region.distance(meet)[0]) + 1e-8 * np.maximum(far_a, far_b)
        better = off < error
        best[better], best_a[better], best_b[better], error[better] = meet[better], na[better], nb[better], off[better]
        near = np.maximum(0.1 * np.maximum(far_a, far_b), 1e-9 * region.size)
        a, b = (
            region.project(meet + (near / np.maximum(far, 1e-300))[:, None] * (x - meet), near)[0]
            for x, far in ((a, far_a), (b, far_b))
        )
        na, nb = region.distance(a)[1], region.distance(b)[1]
    return best, best_a, best_b


def _jumps(region: levelset.SdfRegion, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, ...]:
    """Close in on the greatest turn of the normal between points a and b (M, D) of the zero level.

    Returns the two sides and their normals; where the boundary is smooth these end up nearly parallel.
    """
    reach = np.linalg.norm(b - a, axis=1)
    a, b = region.project(a, reach)[0], region.project(b, reach)[0]
    na, nb = region.distance(a)[1], region.distance(b)[1]
    live = np.arange(len(a))
    rng = np.random.default_rng(0)
    for _ in range(30):
        gap = np.linalg.norm(b[live] - a[live], axis=1)
        turn = np.einsum("md,md->m", na[live], nb[live])
        going = (gap > 1e-4 * reach[live]) & (turn < _CORNER)  # what is rounder is a smooth curve
        live, gap = live[going], gap[going]
        if not len(live):
            break
        # Not the exact middle, which may well be a corner of a symmetric shape.
        middle = a[live] + rng.uniform(0.4, 0.6, (len(live), 1)) * (b - a)[live]
        on, arrived = region.project(middle, gap)
        astray = ~arrived | (np.linalg.norm(on - middle, axis=1) > 2 * gap)
        on[astray] = middle[astray]
        n = region.distance(on)[1]
        first = np.einsum("md,md->m", na[live], n) < np.einsum("md,md->m", nb[live], n)
        b[live[first]], nb[live[first]] = on[first], n[first]
        a[live[~first]], na[live[~first]] = on[~first], n[~first]
    return a, b, na, nb
