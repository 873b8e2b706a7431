"""Which normals conditions take at a corner within a group.

There the cloud's normal is the bisector of the sides', and what is said of the slope along a side's normal says
something else along the bisector. Between two groups it is the own side's already.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud, kept
from jsmitsm.cloud.levelset import SdfRegion
from jsmitsm.runtime.tracers import concrete, is_traced

# Nearest particles of the group that are asked, by dimension.
_AROUND = {2: 6, 3: 20}
# A side is flat where the particle lies in its plane but for this part of the distance, and normals agree but for this.
_FLAT, _EQUAL = 1e-6, 1e-9
# Normals at a smaller angle (its cosine) are the side's own; two ways in a plane differ by more than this (its sine).
_OWN, _ACROSS = np.cos(np.radians(1.0)), 0.1
# Sides come in the order of their normals in this direction, whatever the order of particles; no corner has more.
_FIRST, _SIDES = np.array([1.0, 0.6, 0.36]), 4
# Where neighbours' normals turn by more (its cosine) there may be a corner, and the shape is asked this part of their
# distance away; at a tip, however sharp, normals go on turning by more than this part of it.
_TURN, _BESIDE, _STEADY = np.cos(np.radians(4.0)), 1e-5, 0.1


def side_normals(cloud: Cloud) -> Any:
    """The normals (N, D) of a cloud that has them, those of one side at corners within a group.

    Between curved sides the shape is asked; where it is not known the normals stay: a tip of an ellipse looks alike.
    """
    at, sides = _known(cloud)
    curved, theirs = _known_curved(cloud)
    return _replaced(_replaced(cloud.normals, at, lambda given: given[sides[:, 0]]), curved, lambda _: theirs[:, 0])


def mean_normals(cloud: Cloud) -> Any:
    """The same, at reentrant corners with the means of all sides' normals, shorter than one.

    What is linear in the normal and holds for every side holds for them. Solutions are singular there: one side alone
    makes three times their errors, while at other corners it is better than the mean.
    """
    at, sides = _known(cloud)
    there = (sides >= 0)[..., None]
    flat = _replaced(cloud.normals, at, lambda given: (given[sides] * there).sum(axis=1) / there.sum(axis=1))
    curved, theirs = _known_curved(cloud)
    return _replaced(flat, curved, lambda _: np.nanmean(theirs, axis=1))


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


def _known_curved(cloud: Cloud) -> tuple[np.ndarray, np.ndarray]:
    """The particles (C,) at other corners within their group, and the normals (C, 2, 2) of their sides, NaN for none.

    In space no particles lie on edges between curved sides.
    """
    points, normals = concrete(cloud.points), concrete(cloud.normals)
    if cloud.dim != 2 or points is None or normals is None or not isinstance(cloud._shape, SdfRegion):
        return np.zeros(0, int), np.zeros((0, 2, cloud.dim))
    known = _known(cloud)[0]
    return kept(cloud, "curved corners", lambda: _curved(np.asarray(points), np.asarray(normals), cloud, known))


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


def _curved(points: np.ndarray, normals: np.ndarray, cloud: Cloud, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import cKDTree

    bounds = np.concatenate([np.zeros(0, int), *(ids for name, ids in cloud.groups.items() if name != INTERIOR)])
    bounds = bounds[np.isfinite(normals[bounds]).all(axis=1)]
    if len(bounds) < 3:
        return np.zeros(0, int), np.zeros((0, 2, 2))
    away, near = cKDTree(points[bounds]).query(points[bounds], k=[2, 3])
    turns = np.einsum("bd,bkd->bk", normals[bounds], normals[bounds][near]).min(axis=1) < _TURN
    some = turns & (away[:, 0] > 0) & ~np.isin(bounds, known)
    at, normal, step = points[bounds[some]], normals[bounds[some]], _BESIDE * away[some, 0]
    across = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    ways = np.stack([across, -across], axis=1)

    def beside(far: float) -> np.ndarray:
        there = at[:, None] + far * step[:, None, None] * ways
        return cloud._shape.distance(there.reshape(-1, 2))[1].reshape(there.shape)

    once, twice = beside(1.0), beside(2.0)
    sides = 2.0 * once - twice
    sides /= np.maximum(np.linalg.norm(sides, axis=2, keepdims=True), 1e-300)
    turn = np.linalg.norm(sides[:, 0] - sides[:, 1], axis=1)
    steady = np.linalg.norm(once - twice, axis=2).max(axis=1) < _STEADY * turn
    own = np.einsum("bd,bkd->bk", normal, sides).max(axis=1) > _OWN
    corner = steady & ~own & (np.einsum("bd,bd->b", sides[:, 0], sides[:, 1]) < _OWN)
    order = np.argsort(-sides @ _FIRST[:2], axis=1)[..., None]
    first, second = np.moveaxis(np.take_along_axis(sides, order, axis=1), 1, 0)
    way = np.take_along_axis(ways, order, axis=1)[:, 1]
    along = way - np.einsum("bd,bd->b", way, second)[:, None] * second
    # The second side counts where it lies before the first one.
    second[np.einsum("bd,bd->b", along, first) <= 0.0] = np.nan
    return bounds[some][corner], np.stack([first, second], axis=1)[corner]
