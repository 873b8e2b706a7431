"""Clouds of the random cases, a few sizes and seeds of each domain, so that compiled programs serve many cases."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

import jsmitsm as js
from benchmarks import scenes

SIZES = {1: (15, 21, 41, 61), 2: (9, 13, 17), 3: (5, 6, 7)}


def _box(dim: int, n: int, jitter: float, seed: int) -> js.Cloud:
    return scenes.lattice((0.0,) * dim, (1.0,) * dim, n, jitter, seed)()


def _moved(cloud: js.Cloud, inside: np.ndarray) -> js.Cloud:
    points = np.array(cloud.points)
    points[cloud.groups["interior"]] = inside
    return js.Cloud(points, cloud.groups, cloud.normals)


def lattice(dim: int, n: int, seed: int) -> js.Cloud:
    return _box(dim, n, 0.0, 0)


def jittered(dim: int, n: int, seed: int) -> js.Cloud:
    return _box(dim, n, 0.3, seed)


def scattered(dim: int, n: int, seed: int) -> js.Cloud:
    """Uniformly random particles inside."""
    cloud = _box(dim, n, 0.0, 0)
    rng = np.random.default_rng(seed)
    gap, count = 0.3 / (n - 1), len(cloud.groups["interior"])
    inside = rng.uniform(gap, 1.0 - gap, (50 * count, dim))
    kept: list[np.ndarray] = []
    for x in inside:  # none nearer than a quarter of the spacing to another
        if len(kept) < count and (not kept or ((np.array(kept) - x) ** 2).sum(axis=1).min() > (0.25 / (n - 1)) ** 2):
            kept.append(x)
    while len(kept) < count:
        kept.append(inside[len(kept)])
    return _moved(cloud, np.array(kept))


def graded(dim: int, n: int, seed: int) -> js.Cloud:
    """A lattice drawn towards one end of the first axis, some four times as fine there."""
    cloud = _box(dim, n, 0.2 if dim > 1 else 0.0, seed)
    points = np.array(cloud.points)
    points[:, 0] = (np.exp(1.4 * points[:, 0]) - 1.0) / (np.exp(1.4) - 1.0)
    return js.Cloud(points, cloud.groups, cloud.normals)


def _halves(points: np.ndarray) -> np.ndarray:
    return points[:, 0] < 0.45


_GROUPS = {"west": _halves, "east": lambda points: ~_halves(points)}


def _filled(sdf: Callable, n: int, dim: int, seed: int) -> js.Cloud:
    bounds = ((-0.1,) * dim, (1.1,) * dim)
    return js.from_sdf(sdf, bounds, 1.0 / (n - 1), seed=seed, groups=_GROUPS)


def ball(dim: int, n: int, seed: int) -> js.Cloud:
    return _filled(lambda x: jnp.sqrt(jnp.sum((x - 0.5) ** 2) + 1e-30) - 0.5, n, dim, seed)


def star(dim: int, n: int, seed: int) -> js.Cloud:
    def sdf(x):
        y = x - 0.5
        return jnp.sqrt(y @ y + 1e-30) - 0.45 * (1.0 + 0.2 * jnp.sin(5.0 * jnp.arctan2(y[1], y[0] + 1e-30) + 0.6)) / 1.1

    return _filled(sdf, n, dim, seed)


def hollow(dim: int, n: int, seed: int) -> js.Cloud:
    """A box with a spherical hole, its edges kept by the shape."""
    box = js.sdf.rectangle((0.0,) * dim, (1.0,) * dim) if dim == 2 else js.sdf.box((0.0,) * dim, (1.0,) * dim)
    hole = js.sdf.circle((0.55, 0.45), 0.2) if dim == 2 else js.sdf.sphere((0.5, 0.5, 0.45), 0.25)
    return _filled(js.sdf.difference(box, hole), n, dim, seed)


def notched(dim: int, n: int, seed: int) -> js.Cloud:
    corner = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.6, 1.0), (0.6, 0.5), (0.4, 0.5), (0.4, 1.0), (0.0, 1.0))
    return js.from_polygon(np.array(corner), 1.0 / (n - 1), seed=seed)


def pierced(dim: int, n: int, seed: int) -> js.Cloud:
    outer = np.array([(0.0, 0.0), (1.0, 0.1), (0.9, 1.0), (0.1, 0.8)])
    hole = np.array([(0.4, 0.4), (0.65, 0.45), (0.5, 0.65)])
    return js.from_polygon(outer, 1.0 / (n - 1), holes=(hole,), seed=seed)


BOXES = (lattice, jittered, scattered, graded)
DOMAINS = {
    1: BOXES,
    2: (*BOXES, ball, star, hollow, notched, pierced),
    3: (lattice, jittered, scattered, graded, ball, hollow),
}
BY_NAME = {f.__name__: f for domains in DOMAINS.values() for f in domains}


@lru_cache(maxsize=256)
def cloud(name: str, dim: int, n: int, seed: int) -> js.Cloud:
    """The cloud of a domain with about n particles along an edge; no names of files, nothing random beside the seed."""
    return BY_NAME[name](dim, n, seed)


def spacing(made: js.Cloud) -> float:
    """The edge of the cube that each particle has for itself."""
    points = np.asarray(made.points)
    return float((np.prod(np.ptp(points, axis=0)) / len(points)) ** (1.0 / made.dim))


def widest(made: js.Cloud) -> float:
    """The widest gap that a particle has on any side, about: to the farthest of its 2 D nearest neighbours."""
    points = np.asarray(made.points)
    return float(cKDTree(points).query(points, k=2 * made.dim + 1)[0].max())
