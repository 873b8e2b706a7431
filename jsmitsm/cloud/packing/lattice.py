"""Interior particles of one spacing everywhere: the densest lattice, relaxed where the boundary cuts it off."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from jsmitsm.cloud.packing.octree import Region
from jsmitsm.cloud.packing.relaxation import CLEARANCE, HELD, clear, relax_near

# The lattice's basis in spacings: in 3D a little wider, as the boundary's particles lie less densely.
_BASIS = {
    2: np.array([(1.0, 0.0), (0.5, np.sqrt(0.75))]),
    3: 1.042 * np.sqrt(0.5) * np.array([(1.0, 1.0, 0.0), (1.0, 0.0, 1.0), (0.0, 1.0, 1.0)]),
}
_INVERSE = {dim: np.linalg.inv(basis) for dim, basis in _BASIS.items()}
# Its disorder (a bare lattice is two to three times less accurate at order 6), and how near to the boundary it goes.
_JITTER, _KEPT = 0.06, {2: 0.433, 3: 0.40}
_STEPS = 12
# Relaxation carries to a neighbour in every step, some two spacings, and what is held beyond.
_CARRIED = 2.0 * _STEPS + HELD + 1.0


def lattice(
    region: Region, h: float, lo: np.ndarray, hi: np.ndarray, boundary: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Interior particles for a spacing h that is the same everywhere: the densest lattice, turned and moved at random
    and a little disordered, relaxed where the boundary cuts it off."""
    from scipy.spatial import cKDTree

    points = _densest(h, lo, hi, rng)
    points = points[clear(region, points, boundary, np.full(len(points), h), _KEPT[len(lo)])]
    if not len(points):
        return points
    away = cKDTree(boundary).query(points, distance_upper_bound=HELD * h)[0] / h
    points, moved = relax_near(region, points, boundary, away, lambda x: np.full(len(x), h), _STEPS)
    kept = np.ones(len(points), bool)
    kept[moved] = clear(region, points[moved], boundary, np.full(len(moved), h), 0.8 * CLEARANCE)
    return points[kept]


def lattice_part(
    region: Region, h: float, lo: np.ndarray, hi: np.ndarray, boundary: np.ndarray, seed: int, axis: int,
    ends: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Of such a lattice the particles between two ends along an axis, whose disorder hangs on their place alone.

    Parts with the same seed have the particles of the whole: each is relaxed with as much around it as may push it.
    """
    from scipy.spatial import cKDTree

    dim, rng = len(lo), np.random.default_rng(seed)
    low, high = lo.copy(), hi.copy()
    low[axis], high[axis] = max(lo[axis], ends[0] - _CARRIED * h), min(hi[axis], ends[1] + _CARRIED * h)
    basis = h * _BASIS[dim] @ _rotation(dim, rng)
    shift = rng.uniform(size=dim)
    corners = (np.array(list(itertools.product(*zip(low, high)))) - lo) @ np.linalg.inv(basis) - shift
    ticks = [np.arange(np.floor(a), np.ceil(b) + 1) for a, b in zip(corners.min(axis=0), corners.max(axis=0))]
    index = _in_box(ticks, lo + shift @ basis, basis, low, high)
    place = lo + (index + shift) @ basis
    points = place + _JITTER * h * disorder(index, seed)
    kept = clear(region, points, boundary, np.full(len(points), h), _KEPT[dim])
    place, points = place[kept], points[kept]
    if not len(points):
        return points
    away = cKDTree(boundary).query(points, distance_upper_bound=HELD * h)[0] / h
    points, moved = relax_near(region, points, boundary, away, lambda x: np.full(len(x), h), _STEPS)
    kept = (place[:, axis] >= ends[0]) & (place[:, axis] < ends[1])
    kept[moved] &= clear(region, points[moved], boundary, np.full(len(moved), h), 0.8 * CLEARANCE)
    return points[kept]


def _in_box(ticks: list[np.ndarray], origin: np.ndarray, basis: np.ndarray, low: Any, high: Any) -> np.ndarray:
    """The whole-numbered coordinates (M, D) of a lattice's points in a box, layer by layer."""
    rest = np.stack(np.meshgrid(*ticks[1:], indexing="ij"), axis=-1).reshape(-1, len(ticks) - 1)
    beside, found = origin + rest @ basis[1:], []
    for first in ticks[0]:
        x = beside + first * basis[0]
        some = rest[((x >= low) & (x <= high)).all(axis=1)]
        found.append(np.concatenate([np.full((len(some), 1), first), some], axis=1))
    return np.concatenate(found)


def disorder(index: np.ndarray, seed: int) -> np.ndarray:
    """Numbers (M, D) between -1 and 1 that hang on whole-numbered coordinates (M, D) and the seed (splitmix64)."""
    def mixed(z: np.ndarray) -> np.ndarray:
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))

    golden = 0x9E3779B97F4A7C15
    state = mixed(np.full(len(index), (seed + golden) % 2**64, np.uint64))
    for column in index.T:
        state = mixed(state + column.astype(np.int64).view(np.uint64) + np.uint64(golden))
    bits = [mixed(state + np.uint64((k + 1) * golden % 2**64)) for k in range(index.shape[1])]
    return np.stack([(b >> np.uint64(11)).astype(float) for b in bits], axis=1) * 2.0**-52 - 1.0


def _densest(h: float, lo: np.ndarray, hi: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The points (M, D) of a lattice of hexagons, in 3D of close-packed balls, that lie in a box."""
    dim = len(lo)
    turn = _rotation(dim, rng)
    basis = h * _BASIS[dim] @ turn
    corners = np.array(list(itertools.product(*zip(lo, hi)))) - lo
    reach = corners @ turn.T @ _INVERSE[dim] / h
    ticks = [np.arange(np.floor(a) - 1, np.ceil(b) + 2) for a, b in zip(reach.min(axis=0), reach.max(axis=0))]
    ticks = [t + u for t, u in zip(ticks, rng.uniform(size=dim))]
    points = lo + ticks[0][:, None] * basis[0]
    for k in range(1, dim):
        points = (points[:, None] + ticks[k][:, None] * basis[k]).reshape(-1, dim)
    points = points[np.logical_and.reduce([(x >= a) & (x <= b) for x, a, b in zip(points.T, lo, hi)])]
    return points + _JITTER * h * rng.uniform(-1, 1, points.shape)


def _rotation(dim: int, rng: np.random.Generator) -> np.ndarray:
    """A random rotation (D, D)."""
    first, second = rng.normal(size=(2, dim))
    first /= np.linalg.norm(first)
    if dim == 2:
        return np.stack([first, [-first[1], first[0]]])
    second -= (first @ second) * first
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)])
