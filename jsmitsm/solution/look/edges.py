"""Where smoothness most often ends: boundary particles at which the boundary turns, or the conditions change."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.discretization.layout import Discretization

# Normals of so many nearest boundary particles, by dimension, with less of a common direction stand on two sides of an
# edge.
_AROUND, _TURNED = {2: 3, 3: 4}, 0.6
# They are found among so many; normals that look at each other with so little of a common direction are across a slit.
_SOUGHT, _OPPOSITE = 12, -0.5
# Beside a particle around which they turn by so many times as much, or by about as much while they are so many times
# nearer, another is none: next to a sharp corner its normal counts, and next to any the other side is seen.
_SHARPER, _ALIKE, _NEARER = 1.5, 0.99, 1.2
# Smoothness does end there where neighbours' polynomials part within the first of so many spacings by so many times as
# much as from there to the second. Measured: 5 to 150 on singular points, up to 2 of what is smooth and resolved.
_RING, _ALONE = (2.5, 6.0), 4.0


def edges(cloud: Cloud) -> np.ndarray:
    """Which particles (N,) are corners, lie on edges, or at the ends of groups; on a line all of the boundary."""
    found, rim = np.zeros(len(cloud), bool), np.asarray(cloud.boundary)
    if cloud.dim == 1 or len(rim) <= 2 * cloud.dim:
        found[rim] = True
        return found
    near, away = _beside(cloud, rim)
    group = np.full(len(cloud), -1)
    for k, ids in enumerate(cloud.groups.values()):
        group[ids] = k
    nearest = near[:, : 2 * cloud.dim - 2]
    turned = (group[nearest] != group[rim][:, None]).any(axis=1)
    if cloud.normals is not None:
        turned |= _sharpest(np.asarray(cloud.normals, float), rim, near, away)
    found[rim[turned]] = True
    return found


def singular(disc: Discretization, missed: np.ndarray) -> np.ndarray:
    """Which values (N, F) are beside corners and changes of conditions where the solution is singular.

    missed (N, F): what the polynomials leave of their neighbours. Where all of the boundary around is held the error
    stays where it is made, and is not meant here; of one field neither are corners between open sides, r^2 at the
    right angle.
    """
    cloud, found = disc.cloud, np.zeros(missed.shape, bool)
    points, rim = np.asarray(cloud.points, float), np.asarray(cloud.boundary)
    if cloud.dim == 1 or len(points) <= 2 * cloud.dim:
        return found
    ends, free, held = np.flatnonzero(edges(cloud)), np.zeros(len(points), bool), np.zeros(len(points), bool)
    free[rim] = ~disc.held[rim].all(axis=1)
    held[rim] = ~free[rim] | (disc.rec.fields > 1)
    if not len(ends):
        return found
    tree = cKDTree(points)
    spacing = tree.query(points, k=2 * cloud.dim + 1)[0][:, 1:].mean(axis=1)
    away = cKDTree(points[ends]).query(points)[0] > _RING[0] * spacing
    beside, around = (tree.query_ball_point(points[ends], part * spacing[ends]) for part in _RING)
    for some, more in zip(beside, around):
        ring = np.array(more, int)[away[more]]
        if free[some].any() and held[some].any() and len(ring):
            alone = missed[some].max(axis=0) > _ALONE * missed[ring].max(axis=0)
            found[np.array(some, int)[:, None], np.flatnonzero(alone)] = True
    return found


def _sharpest(normals: np.ndarray, rim: np.ndarray, near: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Whether the boundary turns around the particles ``rim`` (B,), and around none of those beside them more or
    nearer."""
    cosine = np.einsum("nad,nbd->nab", normals[near], normals[near])
    turn, reach = np.zeros(len(normals)), np.full(len(normals), np.inf)
    turn[rim] = 1.0 - cosine.min(axis=(1, 2))
    reach[rim] = np.where(cosine < _TURNED, np.maximum(away[:, :, None], away[:, None]), np.inf).min(axis=(1, 2))
    own, beside = turn[rim][:, None], turn[near]
    sharper = (beside >= _SHARPER * own) | ((beside >= _ALIKE * own) & (_NEARER * reach[near] < reach[rim][:, None]))
    return (turn[rim] > 1.0 - _TURNED) & ~sharper.any(axis=1)


def _beside(cloud: Cloud, rim: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest boundary particles (B, k) to those of the boundary, and how far away, without those across a slit;
    fewer again and again."""
    points = np.asarray(cloud.points)[rim]
    away, near = cKDTree(points).query(points, k=range(2, min(_SOUGHT, len(rim)) + 1))
    if cloud.normals is not None:
        normals, offset = np.asarray(cloud.normals, float)[rim], points[near] - points[:, None]
        across = np.einsum("bkd,bd->bk", normals[near], normals) < _OPPOSITE
        across &= np.einsum("bkd,bd->bk", offset, normals) > 0
        across &= np.einsum("bkd,bkd->bk", offset, normals[near]) < 0
        away = np.where(across, np.inf, away)
    first = np.argsort(away, axis=1, kind="stable")[:, : _AROUND[cloud.dim]]
    first = np.where(np.isfinite(np.take_along_axis(away, first, axis=1)), first, first[:, :1])
    return rim[np.take_along_axis(near, first, axis=1)], np.take_along_axis(away, first, axis=1)


def turns(normals: np.ndarray) -> np.ndarray:
    """Whether normals (N, k, D) are of more than one side, (N,)."""
    return _in_common(normals) < _TURNED


def _in_common(normals: np.ndarray) -> np.ndarray:
    """The least cosine between any two of the normals (N, k, D), (N,)."""
    return np.einsum("nad,nbd->nab", normals, normals).min(axis=(1, 2))
