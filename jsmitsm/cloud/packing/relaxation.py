"""Particles that repel each other: relaxed, kept clear of the boundary, thinned, holes between them filled."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jsmitsm.cloud.packing.octree import Region, Spacing

# Particles per spacing^D of the densest even arrangement: hexagons in 2D; in 3D a little below the
# 1.41 of a face-centred lattice, which relaxation from a random start does not find.
DENSITY = {1: 1.0, 2: 2.0 / np.sqrt(3.0), 3: 1.25}
_NEIGHBOURS = {2: 8, 3: 14}
# Where the spacing varies, a force that scales with the mean of two spacings drives particles to the coarse side:
# there are more of them on the fine side. This weight of the neighbour's spacing stops the drift (found by trial).
_LEAN = {2: 0.6, 3: 0.75}
# A new particle goes where an empty ball has more than this many spacings as radius; 0.58 is a gap between hexagons.
_HOLE = 0.85
_PROBES = 6
# No interior particle comes closer to the boundary than this many spacings.
CLEARANCE = 0.5
# Where only a part is relaxed: particles up to so many spacings away move, further ones up to as many push them.
_MOVING, HELD = 3.5, 5.7
# Particles lie unevenly where the nearest is closer than the first, or so many are not all closer than the last.
_CLOSE, _AROUND, _APART = 0.8, {2: 5, 3: 9}, 1.45


def settled(
    region: Region, points: np.ndarray, boundary: np.ndarray, spacing: Spacing,
    directions: Callable[[np.ndarray, int], np.ndarray],
) -> np.ndarray:  # fmt: skip
    """Scattered particles spread evenly: relaxed, thinned, holes between them filled.

    directions: of particles (M, D) and a count n as many times n random directions (n M, D), of any length.
    """
    points = points[clear(region, points, boundary, spacing(points), 0.9 * CLEARANCE)]
    if not len(points):
        return points
    points = relax(region, points, boundary, len(boundary), spacing, 8)
    points = repair(region, points, boundary, spacing, directions)
    points = relax(region, points, boundary, len(boundary), spacing, 4)
    for _ in range(2):
        points = relax_uneven(region, points, boundary, spacing, 6)
    return points[clear(region, points, boundary, spacing(points), 0.8 * CLEARANCE)]


def relax(
    region: Region, points: np.ndarray, fixed: np.ndarray, walls: int, spacing: Spacing, steps: int
) -> np.ndarray:
    """Let the particles repel each other and fixed ones, the first ``walls`` of which lie on the boundary."""
    from scipy.spatial import cKDTree

    points, count = points.copy(), len(points)
    k = min(_NEIGHBOURS[points.shape[1]] + 1, count + len(fixed))
    given = spacing(fixed)
    for step in range(steps):
        every = np.concatenate([points, fixed])
        if step % 6 == 0:  # particles move by a few hundredths of a spacing, neighbours outlast some steps
            h = np.concatenate([spacing(points), given])
            found = cKDTree(every, balanced_tree=False, compact_nodes=False).query(points, k=k)[1][:, 1:]
            scale = scaling(h[:count], h[found], points.shape[1])
            reach = (scale * np.linalg.norm(points[:, None] - every[found], axis=2)) < 2.0
            near = np.flatnonzero(((found >= count) & (found < count + walls) & reach).any(axis=1))
        points += h[:count, None] * repulsion(points, every, found, scale)
        if len(near) and step % 3 == 2:
            distance, outward = region.distance(points[near])
            push = np.clip(distance + CLEARANCE * h[near], 0.0, 0.3 * h[near])
            points[near] -= push[:, None] * outward
    return points


def relax_near(
    region: Region, points: np.ndarray, boundary: np.ndarray, away: np.ndarray, spacing: Spacing, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Relaxed where ``away`` (M,), in spacings, is small; new points (M, D), and the numbers of those that moved."""
    moving, held = np.flatnonzero(away < _MOVING), np.flatnonzero((away >= _MOVING) & (away < HELD))
    points = points.copy()
    fixed = np.concatenate([boundary, points[held]])
    points[moving] = relax(region, points[moving], fixed, len(boundary), spacing, steps)
    return points, moving


def relax_uneven(
    region: Region, points: np.ndarray, boundary: np.ndarray, spacing: Spacing, steps: int
) -> np.ndarray:
    """Relaxed where particles are crowded or leave gaps."""
    from scipy.spatial import cKDTree

    h, around = spacing(points), _AROUND[points.shape[1]]
    gap = cKDTree(np.concatenate([points, boundary])).query(points, k=[2, around + 1])[0] / h[:, None]
    uneven = (gap[:, 0] < _CLOSE) | (gap[:, 1] > _APART)
    if not uneven.any():
        return points
    away = cKDTree(points[uneven]).query(points)[0] / h
    return relax_near(region, points, boundary, away, spacing, steps)[0]


def scaling(h: np.ndarray, other: np.ndarray, dim: int) -> np.ndarray:
    """One over the spacing (M, k) that counts between particles with h (M,) and their neighbours with other (M, k)."""
    return 1.0 / ((1.0 - _LEAN[dim]) * h[:, None] + _LEAN[dim] * other)


def repulsion(points: np.ndarray, every: np.ndarray, found: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """One step (M, D) in spacings: forces q^-4 of the scaled distance q, cut off at 1.7 by the second shell."""
    # Axis by axis: contiguous (M, k) arrays are several times faster here than (M, k, D) ones.
    away = [x[:, None] - y[found] for x, y in zip(points.T, np.ascontiguousarray(every.T))]
    square = sum(a * a for a in away)
    q = np.maximum(square * scale * scale, 0.1)
    force = np.maximum(1.0 / (q * q) - 1.7**-4, 0.0) / np.sqrt(np.maximum(square, 1e-300))
    move = 0.05 * np.stack([(force * a).sum(axis=1) for a in away], axis=1)
    size = np.linalg.norm(move, axis=1)
    return move * np.minimum(1.0, 0.15 / np.maximum(size, 1e-300))[:, None]


def clear(region: Region, points: np.ndarray, boundary: np.ndarray, h: np.ndarray, clearance: float) -> np.ndarray:
    """Mask of the points inside and away from the boundary by ``clearance`` spacings."""
    from scipy.spatial import cKDTree

    distance = region.distance(points)[0]
    clear = distance < -clearance * h
    # A first-order distance may be far too small where the function is steep; nobody near, nothing to keep clear of.
    doubtful = np.flatnonzero((distance < 0) & ~clear)
    clear[doubtful] = cKDTree(boundary).query(points[doubtful])[0] > 1.5 * h[doubtful]
    return clear


def repair(
    region: Region, points: np.ndarray, boundary: np.ndarray, spacing: Spacing,
    directions: Callable[[np.ndarray, int], np.ndarray],
) -> np.ndarray:  # fmt: skip
    """Drop particles that are crowded, put new ones into holes."""
    from scipy.spatial import cKDTree

    h = spacing(points)
    gap, other = cKDTree(np.concatenate([points, boundary])).query(points, k=2)
    crowded = gap[:, 1] < 0.6 * h
    # Of a crowded pair of interior particles only one goes.
    crowded &= ~((other[:, 1] > np.arange(len(points))) & (other[:, 1] < len(points)))
    points, h = points[~crowded], h[~crowded]
    every = np.concatenate([points, boundary])
    tree = cKDTree(every)
    # A hole is seen from the particles around it: step off in some directions, then away from whatever is nearest.
    direction = directions(points, _PROBES)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    h = np.tile(h, _PROBES)
    probes = np.tile(points, (_PROBES, 1)) + 0.8 * h[:, None] * direction
    for step in range(6):
        gap, nearest = tree.query(probes)
        far = gap > (0.65 if step < 3 else 0.75) * h
        probes, h, gap, nearest = probes[far], h[far], gap[far], nearest[far]
        if step < 5:
            probes = probes + (0.2 * h / gap)[:, None] * (probes - every[nearest])
    probes = probes[region.distance(probes)[0] < 0]  # elsewhere a user's spacing need not be defined
    h = spacing(probes)
    gap = tree.query(probes)[0]
    hole = np.flatnonzero(gap > _HOLE * h)
    hole = hole[clear(region, probes[hole], boundary, h[hole], CLEARANCE)]
    return np.concatenate([points, probes[hole[thin(probes[hole], _HOLE * h[hole], -gap[hole] / h[hole])]]])


def near_pairs(points: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ordered pairs of points closer than the larger of their radii, and their distances; where radii differ much only
    the nearest 48 of each."""
    from scipy.spatial import cKDTree

    tree, most = cKDTree(points), float(radii.max())
    if most < 2.0 * radii.min():
        at, other = tree.query_pairs(most, output_type="ndarray").T
        gap = np.linalg.norm(points[at] - points[other], axis=1)
    else:
        gap, other = tree.query(points, k=range(2, min(48, len(points)) + 1), distance_upper_bound=most)
        at, which = np.nonzero(gap < radii[:, None])
        gap, other = gap[at, which], other[at, which]
    return np.concatenate([at, other]), np.concatenate([other, at]), np.concatenate([gap, gap])


def thin(
    points: np.ndarray,
    radii: np.ndarray,
    priority: np.ndarray,
    pairs: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Indices of a maximal subset with no two points closer than the smaller of their radii; low priority values first.

    pairs: what ``near_pairs`` finds for radii as large.
    """
    if len(points) < 2:
        return np.arange(len(points))
    rank = np.empty(len(points), int)
    rank[np.argsort(priority, kind="stable")] = np.arange(len(points))
    a, b, gap = near_pairs(points, radii) if pairs is None else pairs
    close = (gap < np.minimum(radii[a], radii[b])) & (rank[b] < rank[a])
    a, b = a[close], b[close]  # b goes before a
    state = np.zeros(len(points), int)  # 0 undecided, 1 taken, -1 dropped
    while (state == 0).any():
        live = (state[a] == 0) & (state[b] == 0)
        a, b = a[live], b[live]
        beaten = np.zeros(len(points), bool)
        beaten[a] = True
        winners = (state == 0) & ~beaten
        state[winners] = 1
        state[a[winners[b]]] = -1
    return np.flatnonzero(state == 1)


def uncrowded(points: np.ndarray, normals: np.ndarray, h: np.ndarray, corners: int) -> np.ndarray:
    """Indices without the boundary points closer than half a spacing to others across a sharp tip.

    normals: outward. Points on both sides of a slit, with what is outside between them, stay, and so do the first
    ``corners`` points.
    """
    order = np.concatenate([np.zeros(corners), np.ones(len(points) - corners)])
    a, b, gap = near_pairs(points, 0.5 * h)
    step = points[b] - points[a]
    apart = (normals[a] * normals[b]).sum(axis=1) < 0.0
    apart &= ((step * normals[a]).sum(axis=1) > 0.0) & ((step * normals[b]).sum(axis=1) < 0.0)
    pairs = a[~apart], b[~apart], gap[~apart]
    return np.union1d(thin(points, 0.5 * h, order, pairs), np.arange(corners))
