"""Boundary particles of a signed-distance-like function in 1D and 2D: ends of intervals, closed curves with corners.

contourpy would need values on a whole lattice, of the finest spacing where it varies: 2.8 s against 0.3 s for a star
in a box of 1000 spacings, and it rounds corners off.
"""

from __future__ import annotations

import numpy as np

from jsmitsm.cloud import filling, levelset
from jsmitsm.cloud.packing import octree, relaxation
from jsmitsm.cloud.packing.octree import Spacing
from jsmitsm.runtime.errors import TooCoarse

_CORNER = np.cos(np.deg2rad(8.0))  # normals that differ by more, however close, make a corner


def line(region: levelset.SdfRegion, spacing: Spacing) -> levelset.Boundary:
    """Ends of the intervals in 1D."""
    cells, coarse = levelset.cells_near(region, spacing, 0.5)
    x = np.concatenate([cells.centers, coarse.centers])
    x = x[np.argsort(x[:, 0])]
    negative = region.values(x) < 0
    change = np.flatnonzero(negative[1:] != negative[:-1])
    points = levelset.root(region, x[change], x[change + 1], 1e-15)
    points = region.project(points, np.full(len(points), 1e-6 * region.size))[0]
    return levelset.Boundary(points, np.where(negative[change + 1], -1.0, 1.0)[:, None])


def contour(region: levelset.SdfRegion, spacing: Spacing, forced: np.ndarray | None = None) -> levelset.Boundary:
    """The zero level in 2D: closed polylines from marching triangles, cut at corners, divided evenly.

    forced (C, 2): points of which those on the zero level become particles.
    """
    cells, coarse = levelset.cells_near(region, spacing, 0.4)
    loops = _without_tips(region, _polylines(region, cells, coarse), spacing)
    if not loops:
        raise TooCoarse("spacing: too coarse for the shape, no boundary was found; reduce it below the shape's width")
    parts = [_divided_loop(region, loop, spacing, forced) for loop in loops]
    boundary = levelset.Boundary(*(np.concatenate(arrays) for arrays in zip(*parts)))
    _check_seen(region, cells, np.concatenate([*(loop.points for loop in loops), boundary.points]))
    return boundary


def corners(region: levelset.SdfRegion, spacing: Spacing) -> np.ndarray:
    """The corners (C, 2) of the zero level in 2D."""
    cells, coarse = levelset.cells_near(region, spacing, 0.4)
    loops = _without_tips(region, _polylines(region, cells, coarse), spacing)
    return np.concatenate([np.zeros((0, 2)), *(_corners(region, *loop)[1].points for loop in loops)])


def _without_tips(
    region: levelset.SdfRegion, loops: list[levelset.Boundary], spacing: Spacing
) -> list[levelset.Boundary]:
    """Drop pieces of the domain's sharp tips that the triangles cut off: the corners come back exactly.

    Raises for a small loop that is a hole or stands alone.
    """
    lengths = [filling.path_lengths(np.concatenate([x, x[:1]]), spacing)[-1] for x, _ in loops]
    large = [loop for loop, length in zip(loops, lengths) if length >= levelset.LEAST]
    for (loop, _), length in zip(loops, lengths):
        if length < levelset.LEAST:
            from scipy.spatial import cKDTree

            middle = loop.mean(axis=0, keepdims=True)
            tree = cKDTree(np.concatenate([other for other, _ in large])) if large else None
            lone = tree is None or tree.query(loop)[0].min() > float(spacing(loop).max())
            if lone or region.values(middle)[0] > 0:
                raise TooCoarse(
                    f"spacing: too coarse for the shape, a closed boundary near {loop[0]} is only "
                    f"{length:.2g} times as long as the spacing, at least {levelset.LEAST:g} are needed; reduce the "
                    "spacing there (it may be a "
                    "function of the position)"
                )
    return large


def _polylines(region: levelset.SdfRegion, cells: octree.Cells, coarse: octree.Cells) -> list[levelset.Boundary]:
    """Closed polylines of the zero level, with normals, domain on the left: marching triangles."""
    found = _crossings(region, cells)
    if found is None:  # the boundary leaves the cells near it: the function is far from a distance
        found = _crossings(region, octree.join([cells, coarse]))
    assert found is not None  # beyond the box everything is positive
    ends, share, after = found
    follow, loops, seen = after.tolist(), [], [False] * len(after)
    for first in range(len(follow)):
        loop, at = [], first
        while not seen[at]:
            seen[at] = True
            loop.append(at)
            at = follow[at]
        if len(loop) > 2:
            loops.append(np.array(loop))
    if not loops:
        return []
    order = np.concatenate(loops)
    points, normals = _on_edges(region, ends[order], share[order])
    ends = np.cumsum([len(loop) for loop in loops])
    parts = [_without_specks(points[i:j], normals[i:j]) for i, j in zip([0, *ends[:-1]], ends)]
    return [part for part in parts if len(part.points) > 2]


def _crossings(
    region: levelset.SdfRegion, cells: octree.Cells
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """The ends (E, 2, 2) of the edges of triangles that cross the zero level, about where they do (E,), and the edge
    that follows each, domain on the left; None where the boundary leaves the cells.

    Every cell is a fan of triangles around its centre, over its corners and those of finer cells on its sides.
    """
    order = np.argsort(cells.widths, kind="stable")
    width = cells.widths[order]
    unit = width[0] / 2
    origin = cells.centers.min(axis=0) - width[-1]
    middle = np.rint((cells.centers[order] - origin) / unit).astype(np.int64)
    half = np.rint(width / 2 / unit).astype(np.int64)
    row = int(middle.max()) + int(half[-1]) + 2
    name = lambda place: place[..., 0] * row + place[..., 1]  # noqa: E731
    corner = middle[:, None] + half[:, None, None] * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    names, number = np.unique(name(corner), return_inverse=True)
    place = np.stack(np.divmod(names, row), axis=1)
    nodes = np.concatenate([origin + place * unit, cells.centers[order]])
    value = region.values(nodes)
    negative = value < 0
    number = number.reshape(-1, 4)
    center, a, b = np.repeat(np.arange(len(number)), 4), number.ravel(), np.roll(number, -1, axis=1).ravel()
    while width[0] < width[-1]:  # sides with corners of finer cells on them
        between = place[a] + place[b]
        at = np.minimum(np.searchsorted(names, name(between // 2)), len(names) - 1)
        cut = (names[at] == name(between // 2)) & (between % 2 == 0).all(axis=1)
        if not cut.any():
            break
        center = np.concatenate([center, center[cut]])
        a, b = np.concatenate([a, at[cut]]), np.concatenate([np.where(cut, at, b), b[cut]])
    corners = np.stack([center + len(names), a, b], axis=1)
    corners = corners[(negative[corners].sum(axis=1) % 3) != 0]
    ahead = np.roll(corners, -1, axis=1)
    sign, sign_ahead = negative[corners], negative[ahead]
    # Round a triangle the domain is left over one side and entered over another.
    leaving, entering = sign & ~sign_ahead, ~sign & sign_ahead
    edges = np.stack([corners, ahead], axis=2)
    leave, enter = edges[leaving], edges[entering][:, ::-1]
    keys = np.concatenate([leave, enter]) @ np.array([len(nodes), 1])
    kept, first, which = np.unique(keys, return_index=True, return_inverse=True)
    left, entered = which[: len(leave)], which[len(leave) :]
    if not (len(left) == len(kept) and (np.sort(left) == np.sort(entered)).all()):
        return None
    after = np.empty(len(kept), np.int64)
    after[entered] = left
    i, j = np.concatenate([leave, enter])[first].T
    return np.stack([nodes[i], nodes[j]], axis=1), value[i] / (value[i] - value[j]), after


def _on_edges(region: levelset.SdfRegion, ends: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of the zero level (E, 2) where edges (E, 2, 2) cross it, about at the given shares, and normals there."""
    a, b = ends[:, 0], ends[:, 1]
    start = a + share[:, None] * (b - a)
    distance, before = region.distance(start)
    reach = np.linalg.norm(b - a, axis=1)
    points = start - np.clip(distance, -reach, reach)[:, None] * before
    distance, normals = region.distance(points)
    turned = (np.abs(distance) > 1e-3 * reach) | (np.einsum("md,md->m", normals, before) < _CORNER)
    turned |= np.einsum("md,md->m", normals, np.roll(normals, -1, axis=0)) < _CORNER
    near = np.flatnonzero(turned | np.roll(turned, 1) | np.roll(turned, -1))
    if len(near):  # at corners a step off the edge may end on either side
        points[near] = levelset.root(region, a[near], b[near], 1e-7)
        normals[near] = region.distance(points[near])[1]
    return points, normals


def _without_specks(loop: np.ndarray, normals: np.ndarray) -> levelset.Boundary:
    """Drop points of a closed polyline much closer to the one before than those around: their normals tell nothing."""
    length = np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1)
    around = np.max([np.roll(length, k) for k in (-2, -1, 1, 2)], axis=0)
    kept = length > 0.02 * around
    return levelset.Boundary(loop[kept], normals[kept])


def _check_seen(region: levelset.SdfRegion, cells: octree.Cells, found: np.ndarray) -> None:
    """Raise if some part of the zero level is too small to show up in the polylines."""
    from scipy.spatial import cKDTree

    tree = cKDTree(found)
    x, width, distance = cells.centers, cells.widths, np.abs(cells.distance)
    doubtful = (distance < 1.5 * width) & (tree.query(x)[0] > distance + 0.7 * width)  # the rest sees what was found
    x, width = x[doubtful], width[doubtful]
    if not len(x):
        return
    foot, arrived, outward = region.project(x, width, 1e-3 * float(width.min()), 2.0 * width)
    missed = arrived & (tree.query(foot)[0] > 3 * width) & (np.linalg.norm(foot - x, axis=1) < 2 * width)
    x, width, outward = foot[missed], width[missed], outward[missed]
    # Where two shapes of a union touch, zero is reached from inside on both sides: that is no boundary.
    shift = 1e-4 * width[:, None] * outward
    real = (region.values(x + shift) > 0) & (region.values(x - shift) < 0)
    if real.any():
        raise TooCoarse(
            f"spacing: too coarse for the shape, whose boundary near {x[real][0]} is smaller than half a spacing; "
            "reduce the spacing there (it may be a function of the position)"
        )


def _divided_loop(
    region: levelset.SdfRegion, found: levelset.Boundary, spacing: Spacing, forced: np.ndarray | None = None
) -> levelset.Boundary:
    """Evenly spaced particles on a closed polyline of the zero level, its corners and ``forced`` points among them."""
    loop = found.points
    after, corners = _corners(region, *found)
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
    smooth, outward = _on_level(region, smooth, spacing)
    points = np.concatenate([corners.points, smooth])
    normals = np.concatenate([corners.normals, levelset.crossing_normals(smooth, outward)])
    kept = relaxation.uncrowded(points, normals, spacing(points), len(after))
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


def _on_level(region: levelset.SdfRegion, x: np.ndarray, spacing: Spacing) -> tuple[np.ndarray, np.ndarray]:
    """Points near the zero level moved onto it, and normals; where Newton fails, by bisection along the gradient."""
    h = spacing(x)
    found, arrived, normals = region.project(x, h / 4)
    arrived &= np.linalg.norm(found - x, axis=1) < h / 2
    lost = np.flatnonzero(~arrived)
    if len(lost):
        shift = 0.3 * h[lost, None] * region.distance(x[lost])[1]
        a, b = x[lost] - shift, x[lost] + shift
        bracket = (region.values(a) < 0) & (region.values(b) > 0)
        found[lost[bracket]] = levelset.root(region, a[bracket], b[bracket], 1e-16)
        normals[lost] = region.distance(found[lost])[1]
    return found, normals


def _corners(
    region: levelset.SdfRegion, loop: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, levelset.Boundary]:
    """Corners of a closed polyline: the points they come after, their places, bisectors as normals."""
    after = np.flatnonzero(np.einsum("md,md->m", normal, np.roll(normal, -1, axis=0)) < _CORNER)
    if not len(after):
        return after, levelset.Boundary(np.zeros((0, 2)), np.zeros((0, 2)))
    a, b = loop[after], np.roll(loop, -1, axis=0)[after]
    reach = np.linalg.norm(b - a, axis=1)
    (a, _, na), (b, _, nb) = region.project(a, reach), region.project(b, reach)
    points, off = _tangents_meet(region, a, b, na, nb)
    turn = np.einsum("md,md->m", na, nb)
    # Straight sides: their lines meet on the zero level.
    far = np.linalg.norm(points - a, axis=1) > 3 * reach
    curved = np.flatnonzero((off > 1e-12 * region.size) | (turn > _CORNER) | far)
    if len(curved):
        a[curved], b[curved], na[curved], nb[curved] = _jumps(region, *(v[curved] for v in (a, b, na, nb)))
        curved = curved[np.einsum("md,md->m", na[curved], nb[curved]) < _CORNER]
    if len(curved):
        points[curved], na[curved], nb[curved] = _meeting(region, *(v[curved] for v in (a, b, na, nb)))
    sharp = np.flatnonzero(np.einsum("md,md->m", na, nb) < _CORNER)
    after, points, na, nb = (v[sharp] for v in (after, points, na, nb))
    bisector = na + nb
    length = np.linalg.norm(bisector, axis=1, keepdims=True)
    return after, levelset.Boundary(points, np.where(length > 1e-6, bisector / np.maximum(length, 1e-300), na))


def _tangents_meet(
    region: levelset.SdfRegion, a: np.ndarray, b: np.ndarray, na: np.ndarray, nb: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the lines through a and b (M, 2) with normals na and nb meet, and how far that is from the zero level."""
    cross = na[:, 0] * nb[:, 1] - na[:, 1] * nb[:, 0]
    cross = np.where(np.abs(cross) > 1e-6, cross, 1.0)
    ra, rb = np.einsum("md,md->m", na, a), np.einsum("md,md->m", nb, b)
    meet = np.stack([ra * nb[:, 1] - rb * na[:, 1], rb * na[:, 0] - ra * nb[:, 0]], axis=1) / cross[:, None]
    return meet, np.abs(region.distance(meet)[0])


def _meeting(
    region: levelset.SdfRegion, a: np.ndarray, b: np.ndarray, na: np.ndarray, nb: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Corners (M, 2) between the sides through a and b with normals na and nb, and the normals there.

    A corner is where the sides' tangents meet, once the points of tangency have come close to it.
    """
    best, best_a, best_b = a.copy(), na.copy(), nb.copy()
    error = np.abs(region.distance(best)[0]) + np.linalg.norm(b - a, axis=1)  # not a corner yet, so far off
    for _ in range(8):
        meet, off = _tangents_meet(region, a, b, na, nb)
        far_a, far_b = np.linalg.norm(a - meet, axis=1), np.linalg.norm(b - meet, axis=1)
        off += 1e-8 * np.maximum(far_a, far_b)
        better = off < error
        best[better], best_a[better], best_b[better], error[better] = meet[better], na[better], nb[better], off[better]
        near = np.maximum(0.1 * np.maximum(far_a, far_b), 1e-9 * region.size)
        (a, _, na), (b, _, nb) = (
            region.project(meet + (near / np.maximum(far, 1e-300))[:, None] * (x - meet), near)
            for x, far in ((a, far_a), (b, far_b))
        )
    return best, best_a, best_b


def _jumps(
    region: levelset.SdfRegion, a: np.ndarray, b: np.ndarray, na: np.ndarray, nb: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Close in on the greatest turn of the normal between points a and b (M, D) of the zero level.

    Returns the two sides and their normals; where the boundary is smooth these end up nearly parallel.
    """
    live, reach = np.arange(len(a)), np.linalg.norm(b - a, axis=1)
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
        on, arrived, n = region.project(middle, gap, 1e-6 * float(gap.min()), 3.0 * gap)
        astray = np.flatnonzero(~arrived | (np.linalg.norm(on - middle, axis=1) > 2 * gap))
        if len(astray):
            on[astray] = middle[astray]
            n[astray] = region.distance(on[astray])[1]
        first = np.einsum("md,md->m", na[live], n) < np.einsum("md,md->m", nb[live], n)
        b[live[first]], nb[live[first]] = on[first], n[first]
        a[live[~first]], na[live[~first]] = on[~first], n[~first]
    return a, b, na, nb
