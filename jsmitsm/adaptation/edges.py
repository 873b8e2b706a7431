"""Where smoothness most often ends: boundary particles at which the boundary turns, or the conditions change."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from jsmitsm.cloud.cloud import Cloud

# Normals of the nearest boundary particles with less of a common direction stand on two sides of an edge.
_TURNED = 0.6


def edges(cloud: Cloud) -> np.ndarray:
    """Which particles (N,) are corners, lie on edges, or at the ends of groups; on a line all of the boundary."""
    found, rim = np.zeros(len(cloud), bool), np.asarray(cloud.boundary)
    if cloud.dim == 1 or len(rim) <= 2 * cloud.dim:
        found[rim] = True
        return found
    near = cKDTree(np.asarray(cloud.points)[rim]).query(np.asarray(cloud.points)[rim], k=2 * cloud.dim - 1)[1]
    group = np.full(len(cloud), -1)
    for k, ids in enumerate(cloud.groups.values()):
        group[ids] = k
    turned = (group[rim][near] != group[rim][:, None]).any(axis=1)
    if cloud.normals is not None:
        turned |= turns(np.asarray(cloud.normals, float)[rim][near[:, 1:]])
    found[rim[turned]] = True
    return found


def turns(normals: np.ndarray) -> np.ndarray:
    """Whether normals (N, k, D) are of more than one side, (N,)."""
    return np.einsum("nad,nbd->nab", normals, normals).min(axis=(1, 2)) < _TURNED
