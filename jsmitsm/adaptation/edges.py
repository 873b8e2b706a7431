"""Where smoothness most often ends: boundary particles at which the boundary turns, or the conditions change."""

from __future__ import annotations

import numpy as np

from jsmitsm.cloud.cloud import Cloud

# Normals of the nearest boundary particles with less of a common direction stand on two sides of an edge. Beside one
# particle around which they turn by so many times as much another is none: next to a sharp corner its normal counts.
_TURNED, _SHARPER = 0.6, 1.5


def edges(cloud: Cloud, seen: np.ndarray) -> np.ndarray:
    """Which particles (N,) are corners, lie on edges, or at the ends of groups; on a line all of the boundary.

    seen (N, w): every particle and the neighbours that it sees, -1 where there are no more. Across a slit there are
    none, and its sides are no edges.
    """
    found, rim = np.zeros(len(cloud), bool), np.asarray(cloud.boundary)
    if cloud.dim == 1 or len(rim) <= 2 * cloud.dim:
        found[rim] = True
        return found
    near = _beside(cloud, rim, seen)
    group = np.full(len(cloud), -1)
    for k, ids in enumerate(cloud.groups.values()):
        group[ids] = k
    turned = (group[near] != group[rim][:, None]).any(axis=1)
    if cloud.normals is not None:
        turn = np.zeros(len(cloud))
        turn[rim] = 1.0 - _in_common(np.asarray(cloud.normals, float)[near])
        turned |= (turn[rim] > 1.0 - _TURNED) & (turn[near].max(axis=1) < _SHARPER * turn[rim])
    found[rim[turned]] = True
    return found


def _beside(cloud: Cloud, rim: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The nearest boundary particles (B, k) that those of the boundary see; fewer again and again."""
    points, on = np.asarray(cloud.points), np.zeros(len(cloud), bool)
    on[rim] = True
    near = np.where((seen[rim] >= 0) & (seen[rim] < len(points)), seen[rim], rim[:, None])
    away = np.linalg.norm(points[near] - points[rim][:, None], axis=2)
    away = np.where(on[near] & (near != rim[:, None]), away, np.inf)
    first = np.argsort(away, axis=1, kind="stable")[:, : 2 * cloud.dim - 2]
    first = np.where(np.isfinite(np.take_along_axis(away, first, axis=1)), first, first[:, :1])
    return np.take_along_axis(near, first, axis=1)


def turns(normals: np.ndarray) -> np.ndarray:
    """Whether normals (N, k, D) are of more than one side, (N,)."""
    return _in_common(normals) < _TURNED


def _in_common(normals: np.ndarray) -> np.ndarray:
    """The least cosine between any two of the normals (N, k, D), (N,)."""
    return np.einsum("nad,nbd->nab", normals, normals).min(axis=(1, 2))
