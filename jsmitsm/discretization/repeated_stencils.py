"""Repeated stencils: on a lattice most particles see the same neighbours, and one moment system serves them all."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jsmitsm.discretization.layout import Class

# Looking for repetitions costs more than it saves below so many particles, and where the moment systems are as small
# as this: neighbours times Taylor coefficients.
FEWEST, SMALLEST = 512, 1000
# A trial of so many particles says whether the rest is worth looking at, which is done for so many at a time.
_TRIAL, _AT_A_TIME = 32, 512
# Offsets are compared in this part of a spacing; what is found equal is then verified to rounding.
_UNIT = 1e-10
_ROUNDING = 8 * np.finfo(float).eps


class Repeats(NamedTuple):
    """particles[first] stand for all: particle i has the stencil of particles[first[of[i]]].

    neighbours (n, w): in an order that repeated stencils have in common.
    """

    first: np.ndarray
    of: np.ndarray
    neighbours: np.ndarray

    def few(self, cls: Class) -> Class:
        """The particles that stand for all of a class."""
        return replace(cls, ids=cls.ids[self.first], neighbours=self.neighbours[self.first])


def repeats(points: np.ndarray, ids: np.ndarray, neighbours: np.ndarray, own: np.ndarray) -> Repeats | None:
    """The distinct stencils of the particles ``ids``, or None where hardly any is repeated.

    points (M, D) with periodic images; neighbours (n, w), the particle first, -1 for none; own
    (n, ...): the coefficients of the particles' own conditions, which must repeat too.
    """
    n = len(ids)
    if n < FEWEST:
        return None
    trial = np.linspace(0, n - 1, _TRIAL).astype(int)
    sizes, shortest = _sizes(points, ids[trial], neighbours[trial])
    if len(sizes) > _TRIAL // 2:
        return None
    points = np.asfortranarray(points)  # each axis is looked up by itself
    coded = [_coded(points, ids[some], neighbours[some], own[some], shortest) for some in _parts(n)]
    neighbours, code = (np.concatenate(x) for x in zip(*coded))
    _, first, of = np.unique(code, return_index=True, return_inverse=True)
    if len(first) > n // 4:
        return None
    found = Repeats(first, of, neighbours)
    same = np.allclose(own, own[first][of], 1e-14, 1e-14)
    return found if same and all(_verified(points, ids, found, some) for some in _parts(n)) else None


def _parts(n: int) -> list[slice]:
    return [slice(k, k + _AT_A_TIME) for k in range(0, n, _AT_A_TIME)]


def _sizes(points: np.ndarray, ids: np.ndarray, neighbours: np.ndarray) -> tuple[np.ndarray, float]:
    """The different sizes of the stencils, in whatever order their neighbours are, and the shortest offset."""
    near = np.where(neighbours >= 0, neighbours, ids[:, None])
    offsets = np.abs(points[near] - points[ids][:, None])
    sizes, distance = np.sort(offsets.sum(axis=(1, 2))), offsets.max(axis=2)
    return sizes[np.diff(sizes, prepend=-1.0) > 1e-9 * sizes[-1]], float(distance[distance > 0].min(initial=1.0))


def _coded(
    points: np.ndarray, ids: np.ndarray, near: np.ndarray, own: np.ndarray, unit: float
) -> tuple[np.ndarray, ...]:
    """Each particle's neighbours in an order, and a number for the whole, both equal for equal stencils."""
    rng, there = np.random.default_rng(0), near >= 0
    code = np.zeros(near.shape, np.int64)
    with np.errstate(over="ignore"):
        # Products wrap around: a hash of the offset.
        for x in _offsets(points, ids, near):
            code += np.rint(x * (1.0 / (_UNIT * unit))).astype(np.int64) * rng.integers(1 << 62)
        code[~there] = np.iinfo(np.int64).max
        code[:, 0] = np.iinfo(np.int64).min
        order = np.argsort(code, axis=1)  # equal codes are those of empty places
        mixed = (code ^ (code >> 29)) * np.int64(0x3F58476D1CE4E5B9)
        total = (mixed ^ (mixed >> 32)).sum(axis=1)
        flat = np.rint(own.reshape(len(own), -1) * 1e12).astype(np.int64)
        total = total + (flat * rng.integers(1 << 62, size=flat.shape[1])).sum(axis=1)
    return np.take_along_axis(near, order, axis=1), total


def _offsets(points: np.ndarray, ids: np.ndarray, neighbours: np.ndarray) -> list[np.ndarray]:
    """The neighbours' offsets, (n, w) for each axis; 0 where there is none."""
    near = np.where(neighbours >= 0, neighbours, ids[:, None])
    return [x[near] - x[ids][:, None] for x in points.T]


def _verified(points: np.ndarray, ids: np.ndarray, found: Repeats, some: slice) -> bool:
    """Whether particles have the stencils of those that stand for them, to rounding."""
    near, others = found.neighbours[some], found.first[found.of[some]]
    stand = found.neighbours[others]
    if not np.array_equal(near >= 0, stand >= 0):
        return False
    pairs = zip(_offsets(points, ids[some], near), _offsets(points, ids[others], stand))
    return max(np.abs(x - y).max() for x, y in pairs) <= _ROUNDING * np.abs(points).max()
