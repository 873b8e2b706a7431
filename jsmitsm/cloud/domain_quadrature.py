"""Integrals over the domain: Gauss points in the simplices between the particles and in what curved boundaries add.

Between a facet of the outermost simplices and the boundary lies a thin layer. The boundary is the graph, over the plane
of the facet, of the polynomial through the boundary particles around it; the layer is swept along the particles'
normals, interpolated, so that neighbouring layers fit together.
"""

from __future__ import annotations

import math

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.triangulation import boundary_facets, lying_on, normals_of, simplices
from jsmitsm.taylor.multi_indices import multi_indices

# A particle's normal counts at a facet if it is within 30 degrees of the facet's own; beyond, there is a corner.
_SMOOTH = math.cos(math.radians(30.0))
_STEPS = 8


def domain_rule(cloud: Cloud, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (Q, D) and weights (Q,) for integrals over the domain of functions that polynomials of a degree follow."""
    points = np.asarray(cloud.points, float)
    at, weights = _simplex_rule(cloud.dim, degree // 2 + 1)
    corners = points[simplices(cloud)]
    sides = corners[:, 1:] - corners[:, :1]
    volume = np.abs(np.linalg.det(sides))
    inner = np.einsum("qk,mkd->mqd", at, corners), volume[:, None] * weights
    parts = [inner] if cloud.dim == 1 else [inner, _layers(cloud, degree)]
    return tuple(np.concatenate([part[k].reshape(-1, *part[k].shape[2:]) for part in parts]) for k in (0, 1))  # type: ignore


def _layers(cloud: Cloud, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (M, Q, D) and signed weights (M, Q) between the facets and the boundary."""
    points = np.asarray(cloud.points, float)
    facets, normal = boundary_facets(cloud)
    facets, normal = (x[~lying_on(cloud, facets)] for x in (facets, normal))
    if not len(facets):
        return np.zeros((0, 1, cloud.dim)), np.zeros((0, 1))
    corners = points[facets]
    height = _graphs(cloud, corners, facets, normal, degree)
    flat = np.broadcast_to(normal[:, None], corners.shape)
    own = normals_of(cloud)[facets]
    swept = np.where((np.sum(own * flat, axis=2) >= _SMOOTH)[..., None], own, flat)
    at, weights = _simplex_rule(cloud.dim - 1, degree // 2 + 1)
    base, way = (np.einsum("qk,mkd->mqd", at, x) for x in (corners, swept))
    reach = height(base, way)
    x, w = np.polynomial.legendre.leggauss(degree // 2 + 1)
    found, measure = [], []
    for share, part in zip((x + 1.0) / 2.0, w / 2.0):
        found.append(base + (share * reach)[..., None] * way)
        along = (corners[:, 1:] - corners[:, :1])[:, None] + (share * reach)[..., None, None] * (
            swept[:, 1:] - swept[:, :1])[:, None]  # fmt: skip
        frame = np.concatenate([along, way[:, :, None]], axis=2)
        upright = np.concatenate([corners[:, 1:] - corners[:, :1], normal[:, None]], axis=1)
        measure.append(part * weights * reach * np.linalg.det(frame) * np.sign(np.linalg.det(upright))[:, None])
    return np.concatenate(found, axis=1), np.concatenate(measure, axis=1)


def _graphs(cloud: Cloud, corners: np.ndarray, facets: np.ndarray, normal: np.ndarray, degree: int):
    """How far from points of the facets, along given ways, the boundary is: a function of both (M, Q, D) -> (M, Q)."""
    from scipy.spatial import cKDTree

    points, rim, dim = np.asarray(cloud.points, float), cloud.boundary, cloud.dim
    middle = corners.mean(axis=1)
    tangents = np.linalg.svd(normal[:, None])[2][:, 1:]  # (M, D - 1, D)
    some = np.array(multi_indices(dim - 1, degree))
    count = min(len(rim), degree + 2 if dim == 2 else 2 * len(some))
    distance, near = cKDTree(points[rim]).query(middle, k=range(1, count + 1))
    near = rim[near]
    alike = np.einsum("mkd,md->mk", np.nan_to_num(normals_of(cloud)[near]), normal) > 0.5
    # A facet's own corners are on its side, whatever normal they have.
    alike |= (near[:, :, None] == facets[:, None, :]).any(axis=2)
    size = np.where(alike, distance, 0.0).max(axis=1)
    offset = (points[near] - middle[:, None]) / size[:, None, None]
    place, level = np.einsum("mkd,mtd->mkt", offset, tangents), np.einsum("mkd,md->mk", offset, normal)
    weight = np.where(alike, np.exp(-((1.5 * distance / size[:, None]) ** 2)), 0.0)
    matrix = np.prod(place[:, :, None] ** some, axis=3) * weight[..., None]
    fitted = np.einsum("mak,mk->ma", np.linalg.pinv(matrix, rcond=1e-10), weight * level)
    fitted[np.abs(weight * level).max(axis=1) < 1e-13] = 0.0

    def reach(base: np.ndarray, way: np.ndarray) -> np.ndarray:
        t = np.zeros(base.shape[:2])
        for _ in range(_STEPS):
            at = (base + t[..., None] * way - middle[:, None]) / size[:, None, None]
            xi, rise = np.einsum("mqd,mtd->mqt", at, tangents), np.einsum("mqd,md->mq", at, normal)
            miss = rise - np.einsum("mqa,ma->mq", np.prod(xi[:, :, None] ** some, axis=3), fitted)
            t = t - miss * size[:, None] / np.einsum("mqd,md->mq", way, normal)
        return t

    return reach


def _simplex_rule(dim: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points as barycentric coordinates (Q, dim + 1) in a simplex, collapsed from a cube, and weights."""
    x, w = np.polynomial.legendre.leggauss(count + (dim > 1))
    x, w = (x + 1.0) / 2.0, w / 2.0
    grid = np.stack([v.ravel() for v in np.meshgrid(*[x] * dim, indexing="ij")], axis=1)
    weight = np.prod(np.stack([v.ravel() for v in np.meshgrid(*[w] * dim, indexing="ij")], axis=1), axis=1)
    left, at = np.ones(len(grid)), []
    for k in range(dim):
        at.append(left * grid[:, k])
        weight = weight * left if k else weight
        left = left * (1.0 - grid[:, k])
    return np.stack([*at, left], axis=1), weight
