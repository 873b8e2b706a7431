"""Which normals conditions take at a corner within a group.

There the cloud's normal is the bisector of the sides', and what is said of the slope along a side's normal says
something else along the bisector. Between two groups it is the own side's already.
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
# Sides come in the order of their normals in this direction, whatever the order of particles; no corner has more.
_FIRST, _SIDES = np.array([1.0, 0.6, 0.36]), 4


def side_normals(cloud: Cloud) -> Any:
    """The normals (N, D) of a cloud that has them, those of a flat side at corners within a group.

    Corners between curved sides keep theirs: a particle at the tip of an ellipse looks alike.
    """
    at, sides = _known(cloud)
    return _replaced(cloud.normals, at, lambda given: given[sides[:, 0]])


def mean_normals(cloud: Cloud) -> Any:
    """The same, at reentrant corners with the means of all flat sides' normals, shorter than one.

    What is linear in the normal and holds for every side holds for them. Solutions are singular there: one side alone
    makes three times their errors, while at other corners it is better than the mean.
    """
    at, sides = _known(cloud)
    there = (sides >= 0)[..., None]
    return _replaced(cloud.normals, at, lambda given: (given[sides] * there).sum(axis=1) / there.sum(axis=1))


def _replaced(normals: Any, at: np.ndarray, found: Any) -> Any:
    if not len(at):
        return normals
    if is_traced(normals):
        return jnp.asarray(normals).at[at].set(found(jnp.asarray(normals)))
    new = np.array(normals)
    new[at] = found(new)
    return new


def _known(cloud: Cloud) -> tuple[np.ndarray, np.ndarray]:
    """The particles (C,) at corners within their group, and for each one particle of every flat side (C, k), or -1."""
    points, normals = concrete(cloud.points), concrete(cloud.normals)
    if cloud.dim == 1 or points is None or normals is None:
        return np.zeros(0, int), np.zeros((0, _SIDES), int)
    return kept(cloud, "corners", lambda: _corners(np.asarray(points), np.asarray(normals), cloud.groups))


def _corners(points: np.ndarray, normals: np.ndarray, groups: Any) -> tuple[np.ndarray, np.ndarray]:
    found = [_in_group(points, normals, np.asarray(ids)) for name, ids in groups.items() if name != INTERIOR]
    none = np.zeros(0, int), np.zeros((0, _SIDES), int)
    at, sides = (np.concatenate(part) for part in zip(*(found or [none])))
    return at, sides


def _in_group(points: np.ndarray, normals: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import cKDTree

    ids = ids[np.isfinite(normals[ids]).all(axis=1)]
    if len(ids) < 3:
        return np.zeros(0, int), np.zeros((0, _SIDES), int)
    at, normal, dim = points[ids], normals[ids], points.shape[1]
    away, near = cKDTree(at).query(at, k=range(2, min(_AROUND[dim] + 1, len(ids)) + 1))
    theirs, way = normal[near], (at[near] - at[:, None]) / np.maximum(away, 1e-300)[..., None]
    flat = (np.abs(np.einsum("bkd,bkd->bk", way, theirs)) <= _FLAT) & (away > 0)
    flat &= np.einsum("bd,bkd->bk", normal, theirs) < _OWN
    some = np.flatnonzero(flat.sum(axis=1) >= dim)
    way, theirs, flat = way[some], theirs[some], flat[some]
    # Another particle of the same side: in space not on the same edge, whose normal is that of no side.
    same = np.einsum("bkd,bld->bkl", theirs, theirs) > 1.0 - _EQUAL
    alike = flat[:, :, None] & flat[:, None, :] & same
    if dim == 3:
        alike &= np.linalg.norm(np.cross(way[:, :, None], way[:, None, :]), axis=3) > _ACROSS
    alike &= ~np.eye(alike.shape[1], dtype=bool)
    score = np.where(alike.any(axis=2), theirs @ _FIRST[:dim], -np.inf)
    sides, rows = np.full((len(some), _SIDES), -1), np.arange(len(some))
    main = score.argmax(axis=1)
    ahead = np.isfinite(score) & (np.einsum("bkd,bd->bk", way, theirs[rows, main]) > _ACROSS)
    for k in range(_SIDES):
        first = score.argmax(axis=1)
        good = np.isfinite(score[rows, first]) & (ahead.any(axis=1) | (k == 0))
        sides[good, k] = near[some[good], first[good]]
        score = np.where(same[rows, first], -np.inf, score)
    good = sides[:, 0] >= 0
    return ids[some[good]], np.where(sides[good] >= 0, ids[sides[good]], -1)
