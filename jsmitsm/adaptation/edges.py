"""Where smoothness most often ends: boundary particles at which the boundary turns, or the conditions change."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from jsmitsm.cloud.cloud import Cloud

# Normals of so many nearest boundary particles, by dimension, with less of a common direction stand on two sides of an
# edge.
_AROUND, _TURNED = {2: 3, 3: 4}, 0.6
# They are found among so many; normals that look at each other with so little of a common direction are across a slit.
_SOUGHT, _OPPOSITE = 12, -0.5
# Beside a particle around which they turn by so many times as much, or by about as much while they are so many times
# nearer, another is none: next to a sharp corner its normal counts, and next to any the other side is seen.
_SHARPER, _ALIKE, _NEARER = 1.5, 0.99, 1.2


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
