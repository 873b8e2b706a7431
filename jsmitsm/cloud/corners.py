"""Which side's normal a condition takes at a corner.

At a corner within a group the cloud's normal is the bisector of the sides', and what is said of the slope along a
side's normal says something else along the bisector. Between two groups it is the own side's already.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud, kept
from jsmitsm.runtime.tracers import concrete, is_traced

# Nearest particles of the group that are asked, by dimension.
_AROUND = {2: 6, 3: 20}
# A side is flat where the particle lies in its plane but for this part of the distance, and normals agree but for this.
_FLAT, _EQUAL = 1e-6, 1e-9
# Normals at a smaller angle (its cosine) are the side's own; two ways in a plane differ by more than this (its sine).
_OWN, _ACROSS = np.cos(np.radians(1.0)), 0.1
# Of several sides that one is taken whose normal is the largest in this direction, whatever the order of particles.
_FIRST = np.array([1.0, 0.6, 0.36])


def side_normals(cloud: Cloud) -> Any:
    """The normals (N, D) of a cloud that has them, those of a flat side at corners within a group.

    Corners between curved sides keep theirs: a particle at the tip of an ellipse looks alike.
    """
    points, normals = concrete(cloud.points), concrete(cloud.normals)
    if cloud.dim == 1 or points is None or normals is None:
        return cloud.normals
    at, side = kept(cloud, "corners", lambda: _corners(np.asarray(points), np.asarray(normals), cloud.groups))
    if not len(at):
        return cloud.normals
    if is_traced(cloud.normals):
        given = jnp.asarray(cloud.normals)
        return given.at[at].set(given[side])
    found = np.array(normals)
    found[at] = found[side]
    return found


def _corners(points: np.ndarray, normals: np.ndarray, groups: Any) -> tuple[np.ndarray, np.ndarray]:
    """The particles at corners within their group, and for each one of a flat side that it belongs to."""
    found = [_in_group(points, normals, np.asarray(ids)) for name, ids in groups.items() if name != INTERIOR]
    at, side = (np.concatenate(part) for part in zip(*found)) if found else (np.zeros(0, int), np.zeros(0, int))
    return at, side


def _in_group(points: np.ndarray, normals: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import cKDTree

    ids = ids[np.isfinite(normals[ids]).all(axis=1)]
    if len(ids) < 3:
        return np.zeros(0, int), np.zeros(0, int)
    at, normal, dim = points[ids], normals[ids], points.shape[1]
    away, near = cKDTree(at).query(at, k=range(2, min(_AROUND[dim] + 1, len(ids)) + 1))
    theirs, way = normal[near], (at[near] - at[:, None]) / np.maximum(away, 1e-300)[..., None]
    flat = (np.abs(np.einsum("bkd,bkd->bk", way, theirs)) <= _FLAT) & (away > 0)
    flat &= np.einsum("bd,bkd->bk", normal, theirs) < _OWN
    some = np.flatnonzero(flat.sum(axis=1) >= dim)
    way, theirs, flat = way[some], theirs[some], flat[some]
    # Another particle of the same side: in space not on the same edge, whose normal is that of no side.
    alike = flat[:, :, None] & flat[:, None, :] & (np.einsum("bkd,bld->bkl", theirs, theirs) > 1.0 - _EQUAL)
    if dim == 3:
        alike &= np.linalg.norm(np.cross(way[:, :, None], way[:, None, :]), axis=3) > _ACROSS
    alike &= ~np.eye(alike.shape[1], dtype=bool)
    score = np.where(alike.any(axis=2), theirs @ _FIRST[:dim], -np.inf)
    first, good = score.argmax(axis=1), np.isfinite(score).any(axis=1)
    return ids[some[good]], ids[near[some[good], first[good]]]
