"""Places on the way from particles to their nearest neighbours, where nothing was asked to hold."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from jsmitsm.discretization.layout import Class, Discretization

# On the way to a neighbour one looks at these parts of it, by dimension; from both ends they are nearly twice as many.
WAYS = {1: (0.5, 0.11, 0.21, 0.31, 0.41), 2: (0.5, 0.25), 3: (0.5,)}
# So many places are looked at together: fewer calls of what is evaluated there, and arrays that fit into the cache.
_TOGETHER = 8_192

Left = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def nearest_of(disc: Discretization, cls: Class, count: int) -> np.ndarray:
    """The nearest neighbours (n, count) of the particles of a class, -1 for want of more; stencils need no order."""
    near, points = np.asarray(cls.neighbours), np.asarray(disc.points, float)
    there = (near >= 0) & (near != cls.ids[:, None])
    square = np.square(points[np.where(there, near, 0)] - points[cls.ids][:, None]).sum(axis=2)
    first = np.argsort(np.where(there, square, np.inf), axis=1, kind="stable")[:, :count]
    found = np.where(np.take_along_axis(there, first, axis=1), np.take_along_axis(near, first, axis=1), -1)
    return np.pad(found, ((0, 0), (0, count - found.shape[1])), constant_values=-1)


def looked_at(disc: Discretization, classes: list[Class]) -> tuple[np.ndarray, np.ndarray]:
    """Particles (n,) and the neighbours (n, k) on the way to which one looks: on a lattice those along its axes and
    across its cells."""
    count = 2 * disc.rec.dim + (2**disc.rec.dim if disc.rec.dim > 1 else 0)
    ids = [cls.ids for cls in classes]
    near = [nearest_of(disc, cls, count) for cls in classes]
    return np.concatenate([np.zeros(0, int), *ids]), np.concatenate([np.zeros((0, count), int), *near])


def pairs(near: np.ndarray, ways: int = 1) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows and columns of what is there in ``near`` (n, k), some rows at a time; ways: places looked at of each."""
    step = max(1, _TOGETHER // max(1, near.shape[1] * ways))
    for low in range(0, len(near), step):
        row, column = np.nonzero(near[low : low + step] >= 0)
        yield low + row, column


def around(
    disc: Discretization, classes: list[Class], left: Left, ways: tuple[float, ...] = (0.5,)
) -> tuple[np.ndarray, np.ndarray]:
    """The particles (n,) of some classes, and for each the mean (E, n) of what vanishes there and not around.

    left: makes it (E, m) on the way from particles (m,), at points (m, D), which are so far (m, D) from them. ways: the
    parts of the way to a neighbour at which one looks, and takes what is largest.
    """
    (ids, near), points = looked_at(disc, classes), np.asarray(disc.points, float)
    total, count = np.zeros((len(disc.rec.orders), len(ids))), np.ones(len(ids))
    for row, column in pairs(near, len(ways)):
        if not len(row):
            continue
        here = ids[row]
        way = points[near[row, column]] - points[here]
        offset = np.concatenate([part * way for part in ways])
        start = np.tile(here, len(ways))
        found = left(start, points[start] + offset, offset)
        found = found.reshape(len(found), len(ways), len(row))
        found = np.take_along_axis(found, np.abs(found).argmax(axis=1)[:, None], axis=1)[:, 0]
        for whole, some in zip(total, found):
            np.add.at(whole, row, some)
        np.add.at(count, row, 1.0)
    return ids, total / count
