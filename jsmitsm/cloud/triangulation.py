"""Triangles and tetrahedra between the particles of a cloud, holes and notches left out: for pictures and files.

Qhull makes them, by scipy; which of them lie in the domain no library knows. A cut is one for matplotlib, where
pyvista, ten times as fast (3 ms for 53,000 tetrahedra), is not installed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.inside import inside_of
from jsmitsm.cloud.regions.region_cloud import RegionCloud

# A simplex whose longest edge exceeds this many usual edges of its corners bridges a gap; the first
# number is for clouds without boundary, the second for simplices with boundary particles only, the suspects.
_LONG = (3.0, 1.8)


def simplices(cloud: Cloud) -> np.ndarray:
    """Intervals, triangles or tetrahedra (M, D + 1) between the particles, those outside of the domain dropped.

    A simplex with boundary particles at all its corners lies outside where the shape says so, or, where the cloud knows
    none, where the normals point into it. Where normals are missing too, fitted ones do, and it is dropped as well if
    its longest edge is much longer than the usual edges of its corners.
    Those of a cloud of several regions do not cross an interface.

    >>> import jsmitsm as js
    >>> simplices(js.rectangle((0, 0), (1, 1), (3, 3))).shape
    (8, 3)
    """
    if isinstance(cloud, RegionCloud):
        return np.concatenate([ids[simplices(cloud.region(name))] for name, ids in cloud.regions.items()])
    points = _scaled(cloud)
    cells = _intervals(points) if cloud.dim == 1 else _delaunay(points).simplices
    return cells[_solid(points, cells) & ~_outside(cloud, points, cells)]


def boundary_facets(cloud: Cloud) -> tuple[np.ndarray, np.ndarray]:
    """Facets (M, D) between boundary particles that enclose the domain, and their unit outward normals (M, D).

    >>> import jsmitsm as js
    >>> facets, normals = boundary_facets(js.rectangle((0, 0), (1, 1), (3, 3)))
    >>> facets.shape, normals.sum(axis=0).tolist()
    ((8, 2), [0.0, 0.0])
    """
    points = _scaled(cloud)
    if cloud.dim == 1:
        cells = simplices(cloud)
        left, right = np.setdiff1d(*cells.T), np.setdiff1d(*cells.T[::-1])
        return np.concatenate([left, right])[:, None], np.repeat([-1.0, 1.0], [len(left), len(right)])[:, None]
    delaunay = _delaunay(points)
    cells, beside = delaunay.simplices, delaunay.neighbors
    facets = np.stack([np.delete(cells, k, axis=1) for k in range(cells.shape[1])], axis=1)
    normal = _across(points[facets])
    size = np.linalg.norm(normal, axis=2)
    inside = ~_outside(cloud, points, cells)
    thin, outer = ~_solid(points, cells), np.zeros(size.shape, bool)
    while True:
        outer = inside[:, None] & ((beside < 0) | ~inside[beside])
        # Flat simplices within the domain count, or their neighbours' facets would face nothing. Those on its boundary
        # do not: over a notch they would be a skin with nothing behind it.
        flat = np.flatnonzero(inside & thin)
        skin = flat[_bare(flat, beside, size, outer)]
        if not len(skin):
            break
        inside[skin] = False
    # Particles on one line make facets without area, which face nowhere.
    outer &= size > 1e-9 * np.ptp(points[facets], axis=2).max(axis=2) ** (cloud.dim - 1)
    normal = normal[outer] / size[outer][:, None]
    own, opposite = np.nonzero(outer)
    inward = points[cells[own, opposite]] - points[facets[outer][:, 0]]
    return facets[outer], -np.copysign(1.0, np.einsum("md,md->m", inward, normal))[:, None] * normal


def _bare(flat: np.ndarray, beside: np.ndarray, size: np.ndarray, outer: np.ndarray) -> np.ndarray:
    """Mask of the flat simplices half of whose facets, or more, are outer ones; if of none, heaps of them together."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    free = np.where(outer[flat], size[flat], 0.0).sum(axis=1)
    found = free > 0.49 * size[flat].sum(axis=1)
    if found.any() or not free.any():
        return found
    place = np.full(len(size), -1)
    place[flat] = np.arange(len(flat))
    other = np.where(beside[flat] < 0, -1, place[beside[flat]])
    touching = (other >= 0) & (size[flat] > 1e-9 * size.max())
    one, k = np.nonzero(touching)
    graph = coo_matrix((np.ones(len(one), bool), (one, other[one, k])), shape=(len(flat), len(flat)))
    heap = connected_components(graph, directed=False)[1]
    behind = np.where(outer[flat] | touching, 0.0, size[flat]).sum(axis=1)
    free, behind = (np.bincount(heap, weights=x)[heap] for x in (free, behind))
    return (free > 0.98 * behind) & (free > 0.0)


def _across(at: np.ndarray) -> np.ndarray:
    """Vectors (..., D) across facets (..., D, D), as long as these are large."""
    sides = at[..., 1:, :] - at[..., :1, :]
    if at.shape[-1] == 2:
        return np.stack([sides[..., 0, 1], -sides[..., 0, 0]], axis=-1)
    return np.cross(sides[..., 0, :], sides[..., 1, :])


def lying_on(cloud: Cloud, facets: np.ndarray) -> np.ndarray:
    """Mask (M,) of the facets that are the boundary, not chords of it; of none where the cloud knows no shape."""
    if cloud._shape is None or not len(facets):
        return np.zeros(len(facets), bool)
    points = np.asarray(cloud.points, float)
    return np.abs(cloud._shape.distance(points[facets].mean(axis=1))[0]) < 1e-10 * np.ptp(points, axis=0).max()


def _intervals(points: np.ndarray) -> np.ndarray:
    order = np.argsort(points[:, 0])
    return np.stack([order[:-1], order[1:]], axis=1)


def _scaled(cloud: Cloud) -> np.ndarray:
    """The particles (N, D) in the unit box."""
    points = np.asarray(cloud.points, dtype=np.float64)
    if len(points) < cloud.dim + 1:
        raise ValueError(f"cloud: {len(points)} particles make no {cloud.dim}D simplex; add particles")
    return (points - points.min(axis=0)) / np.ptp(points, axis=0).max()


def _delaunay(points: np.ndarray) -> Any:
    from scipy.spatial import Delaunay, QhullError

    try:
        return Delaunay(points)
    except QhullError:
        raise ValueError(
            f"cloud: its {len(points)} particles lie on one line or plane, no {points.shape[1]}D simplices can be made"
        ) from None


def _solid(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Mask of the simplices that are not flat: rounding makes flat ones along straight sides."""
    sides = points[cells[:, 1:]] - points[cells[:, :1]]
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    return np.abs(np.linalg.det(sides)) > 1e-9 * longest ** points.shape[1]


def _outside(cloud: Cloud, points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Mask of the simplices that cover a hole or a notch."""
    suspect = np.isin(cells, cloud.boundary).all(axis=1)  # an interior particle proves a simplex innocent
    if cloud._shape is not None and cloud.dim > 1:  # at the end of a side its normal says nothing of the next one
        out, which = np.zeros(len(cells), bool), np.flatnonzero(suspect)
        middle = np.asarray(cloud.points)[cells[which]].mean(axis=1)
        out[which] = cloud._shape.distance(middle)[0] > 1e-9 * np.ptp(middle) if len(which) else False
        return out
    if not len(cloud.boundary):  # then long simplices alone show a hole
        return _stretch(points, cells) > _LONG[0]
    ahead = points[cells].mean(axis=1)[:, None] - points[cells]
    # Zero up to rounding where all corners lie on one straight side.
    out = suspect & ((ahead * normals_of(cloud)[cells]).sum(axis=(1, 2)) > 1e-9)
    if cloud.normals is None and cloud.dim > 1:
        long = _stretch(points, cells) > _LONG[1]
        out |= long & suspect | _bridges(points, cells, np.isin(cells, cloud.boundary))
    return out


def normals_of(cloud: Cloud) -> np.ndarray:
    """The normals (N, D) of a cloud, those of its boundary particles fitted where it has none."""
    if cloud.normals is not None:
        return np.asarray(cloud.normals)
    out, inside = np.full(cloud.points.shape, np.nan), inside_of(cloud)
    if inside is not None:  # it is none of points that JAX traces, which have no simplices either
        out[cloud.boundary] = inside.normals
    return out


def _bridges(points: np.ndarray, cells: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Mask of the simplices with one interior corner, close behind the boundary, that reach across a notch.

    They have an edge between boundary particles that is much longer than those along the boundary.
    """
    n, (some, which) = len(points), _edges(cells)
    inner = np.ones(n, bool)
    inner[cells[rim]] = False
    pairs = some[~inner[some].any(axis=1)]
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    nearest = np.full(n, np.inf)
    np.minimum.at(nearest, pairs, length[:, None])
    ends = some[which]  # (M, edges, 2)
    span = np.linalg.norm(points[ends[..., 0]] - points[ends[..., 1]], axis=2)
    long = ~inner[ends].any(axis=2) & (span > _LONG[0] * nearest[ends].max(axis=2))
    return (rim.sum(axis=1) == cells.shape[1] - 1) & long.any(axis=1)


def _edges(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different edges (E, 2) of simplices, and which of them each simplex has."""
    corners = [(a, b) for a in range(cells.shape[1]) for b in range(a)]
    every = np.sort(np.stack([cells[:, c] for c in corners], axis=1), axis=2)
    edges, which = np.unique(every.reshape(-1, 2), axis=0, return_inverse=True)
    return edges, which.reshape(every.shape[:2])


def _stretch(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The longest edge of each simplex over the shortest of its corners' usual edges."""
    n = len(points)
    corners = [(a, b) for a in range(cells.shape[1]) for b in range(a)]
    pairs, _ = _edges(cells)
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    # Their median: few edges of a particle cross a hole, and on a stretched lattice at most half are short.
    owner, both = pairs.T.ravel(), np.tile(length, 2)
    order = np.lexsort((both, owner))
    start = np.searchsorted(owner[order], np.arange(n + 1))
    usual = both[order][np.minimum(start[:-1] + (0.5 * np.diff(start)).astype(int), len(both) - 1)]
    longest = np.max([np.linalg.norm(points[cells[:, a]] - points[cells[:, b]], axis=1) for a, b in corners], axis=0)
    return longest / usual[cells].min(axis=1)


def cut(points: np.ndarray, cells: np.ndarray, axis: int, position: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a plane across ``axis`` cuts tetrahedra: triangles (T, 3) between points (P, 3) on edges (P, 2).

    Point p lies on the straight line between the particles of its edge; all triangles lie in the plane.
    """
    height = points[:, axis] - position
    # A plane through particles would cut at corners; shifted by a trifle it cuts edges only.
    height = np.where(height == 0, 1e-7 * np.ptp(points[:, axis]), height)
    above = height[cells] > 0
    count = above.sum(axis=1)
    triangles = [np.zeros((0, 3, 2), np.int64)]
    for lone, mask in ((count == 1, above), (count == 3, ~above)):
        cell = cells[lone]
        one = mask[lone].argmax(axis=1)
        rest = np.stack([(one + k) % 4 for k in (1, 2, 3)], axis=1)
        row = np.arange(len(cell))
        triangles.append(np.stack([np.stack([cell[row, one], cell[row, rest[:, k]]], 1) for k in range(3)], axis=1))
    cell, side = cells[count == 2], above[count == 2]
    order = np.argsort(~side, axis=1, kind="stable")
    a, b, c, d = np.take_along_axis(cell, order, axis=1).T  # a and b above the plane, c and d below
    ac, ad, bc, bd = (np.stack(pair, axis=1) for pair in ((a, c), (a, d), (b, c), (b, d)))
    triangles += [np.stack([ac, ad, bd], axis=1), np.stack([ac, bd, bc], axis=1)]
    edges, place = np.unique(np.sort(np.concatenate(triangles), axis=2).reshape(-1, 2), axis=0, return_inverse=True)
    low, high = height[edges].T
    share = (low / (low - high))[:, None]
    return place.reshape(-1, 3), points[edges[:, 0]] * (1 - share) + points[edges[:, 1]] * share, edges
