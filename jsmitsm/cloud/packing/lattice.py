"""Interior particles of one spacing everywhere: the densest lattice, relaxed where the boundary cuts it off."""

from __future__ import annotations

import itertools

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
