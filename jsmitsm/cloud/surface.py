"""Boundary particles of a signed-distance-like function in 3D: a surface, evenly covered."""

from __future__ import annotations

import numpy as np

from jsmitsm.cloud import levelset
from jsmitsm.cloud.packing import relaxation
from jsmitsm.cloud.packing.octree import Spacing
from jsmitsm.runtime.errors import TooCoarse

_CORNER = np.cos(np.deg2rad(8.0))  # sides whose normals differ by more meet in an edge


def surface(region: levelset.SdfRegion, spacing: Spacing, seed: int) -> levelset.Boundary:
    """The zero level in 3D: foot points of small cells, thinned, relaxed on the surface, holes filled."""
    cells, _ = levelset.cells_near(region, spacing, 0.5)
    # One random point per cell: a lattice of feet could only be thinned to a few distinct densities.
    rng = np.random.default_rng(seed)
    offset = rng.uniform(-0.5, 0.5, cells.centers.shape) * cells.widths[:, None]
    height = cells.distance + np.einsum("md,md->m", offset, cells.outward)
    close = np.abs(height) < 0.6 * cells.widths
    starts, width = cells.centers[close] + offset[close], cells.widths[close]
    feet, arrived, normals = region.project(starts, width)
    arrived &= np.linalg.norm(feet - starts, axis=1) < 2 * width
    arrived[arrived] = _crossing(region, feet[arrived], normals[arrived])
    feet, area = feet[arrived], width[arrived] ** 2 / 1.2  # volume of the layer over its thickness
    if not len(feet):
        raise TooCoarse("spacing: too coarse for the shape, no boundary was found; reduce it below the shape's width")
    h = spacing(feet)
    points = _sparse(feet, h, float((area / h**2).sum()), rng)
    for steps in (8, 5):
        points = _relax_surface(region, points, spacing, steps)
        points = points[relaxation.thin(points, 0.65 * spacing(points), np.arange(len(points)))]
        points = _refill(points, feet, h)
    return levelset.Boundary(points, _surface_normals(region, points, spacing(points)))


def _sparse(feet: np.ndarray, h: np.ndarray, area: float, rng: np.random.Generator) -> np.ndarray:
    """A random even choice of feet, as many as hexagons of one spacing cover ``area`` (in squared spacings)."""
    priority = rng.permutation(len(feet))
    radius, wanted = 0.72, 2.0 / np.sqrt(3.0) * area
    pairs = relaxation.near_pairs(feet, 0.9 * h)
    for _ in range(4):
        chosen = relaxation.thin(feet, radius * h, priority, pairs)
        if abs(len(chosen) - wanted) < 0.03 * wanted:
            break
        radius = min(0.9, radius * np.clip(np.sqrt(len(chosen) / wanted), 0.7, 1.2))
    _check_components(feet, pairs, chosen)
    return feet[chosen]


def _crossing(region: levelset.SdfRegion, x: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Mask of the points where the function changes sign, not merely touches zero."""
    shift = 1e-7 * region.size * normals
    return (region.values(x + shift) > 0) & (region.values(x - shift) < 0)


def _check_components(feet: np.ndarray, pairs: tuple[np.ndarray, np.ndarray, np.ndarray], chosen: np.ndarray) -> None:
    """Raise if a connected part of the surface got too few particles to tell its shape."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    row, column, _ = pairs
    graph = coo_matrix((np.ones(len(row), bool), (row, column)), shape=(len(feet), len(feet)))
    label = connected_components(graph, directed=False)[1]
    count = np.bincount(label[chosen], minlength=label.max() + 1)
    if count.min() < 10:
        raise TooCoarse(
            f"spacing: too coarse for the shape, only {count.min()} particles fit on the closed boundary near "
            f"{feet[label == count.argmin()][0]}, at least 10 are needed; reduce the spacing there"
        )


def _relax_surface(region: levelset.SdfRegion, points: np.ndarray, spacing: Spacing, steps: int) -> np.ndarray:
    """Let particles repel each other along the surface; those that lose it stay where they were."""
    from scipy.spatial import cKDTree

    at, normal = points, region.distance(points)[1]
    for step in range(steps):
        if step % 4 == 0:
            h = spacing(at)
            found = cKDTree(at).query(at, k=min(11, len(at)))[1][:, 1:]
            scale = relaxation.scaling(h, h[found], 2)
        move = h[:, None] * relaxation.repulsion(at, at, found, scale)
        at = at + move - np.einsum("md,md->m", move, normal)[:, None] * normal
        distance, normal = region.distance(at)
        at -= np.clip(distance, -0.3 * h, 0.3 * h)[:, None] * normal
    new, arrived, _ = region.project(at, 0.3 * h)
    # Most move by some tenths of a spacing in all.
    arrived &= np.linalg.norm(new - points, axis=1) < 1.5 * h
    return np.where(arrived[:, None], new, points)


def _refill(points: np.ndarray, feet: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Put particles on feet (M, 3) of spacing h (M,) that lie in holes."""
    from scipy.spatial import cKDTree

    gap = cKDTree(points).query(feet)[0] / h
    hole = np.flatnonzero(gap > 0.85)  # hexagons leave gaps of 0.58
    return np.concatenate([points, feet[hole[relaxation.thin(feet[hole], 0.85 * h[hole], -gap[hole])]]])


def _surface_normals(region: levelset.SdfRegion, points: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Unit gradients; on an edge or a corner, the normalised sum of those of its two or three sides."""
    normal = region.normals(points)
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(normal, across)
    # A ring of probes just below the surface sees all sides that meet here, whatever the gradient at the edge itself.
    sides = []
    for angle in np.arange(8) * np.pi / 4:
        ring = np.cos(angle) * across + np.sin(angle) * other
        sides.append(points + 1e-5 * h[:, None] * (0.7 * ring - 0.3 * normal))
    seen = region.distance(np.concatenate(sides))[1].reshape(8, len(points), 3)
    total, row = seen[0], np.arange(len(points))
    likeness = np.einsum("kmd,md->km", seen, seen[0])
    edge = likeness.min(axis=0) < _CORNER
    for _ in range(2):
        which = likeness.argmin(axis=0)
        new = likeness[which, row] < _CORNER
        total = total + np.where(new[:, None], seen[which, row], 0.0)
        likeness = np.maximum(likeness, np.einsum("kmd,md->km", seen, seen[which, row]))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(edge[:, None] & (length > 1e-6), total / np.maximum(length, 1e-300), normal)
