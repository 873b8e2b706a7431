"""Repeated stencils: on a lattice most particles see the same neighbours, and one moment system serves them all."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Looking for repetitions costs more than it saves below so many particles.
FEWEST = 512
# A trial of this many particles says whether the rest is worth looking at.
_TRIAL = 64
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


def repeats(points: np.ndarray, ids: np.ndarray, neighbours: np.ndarray, own: np.ndarray) -> Repeats | None:
    """The distinct stencils of the particles ``ids``, or None where hardly any is repeated.

    points (M, D) with periodic images; neighbours (n, w), the particle first, -1 for none; own
    (n, ...): the coefficients of the particles' own conditions, which must repeat too.
    """
    n = len(ids)
    if n < FEWEST:
        return None
    trial = np.linspace(0, n - 1, _TRIAL).astype(int)
    if len(np.unique(_codes(points, ids[trial], neighbours[trial], own[trial])[1])) > _TRIAL // 2:
        return None
    order, code = _codes(points, ids, neighbours, own)
    _, first, of = np.unique(code, return_index=True, return_inverse=True)
    if len(first) > n // 4:
        return None
    neighbours = np.take_along_axis(neighbours, order, axis=1)
    away = max(np.abs(x - x[first][of]).max() for x in _offsets(points, ids, neighbours))
    same = np.array_equal(neighbours >= 0, (neighbours >= 0)[first][of])
    if away > _ROUNDING * np.abs(points).max() or not same or not np.allclose(own, own[first][of], 1e-14, 1e-14):
        return None
    return Repeats(first, of, neighbours)


def _offsets(points: np.ndarray, ids: np.ndarray, neighbours: np.ndarray) -> list[np.ndarray]:
    """The neighbours' offsets, (n, w) for each axis; 0 where there is none."""
    near = np.where(neighbours >= 0, neighbours, ids[:, None])
    return [x[near] - x[ids][:, None] for x in np.ascontiguousarray(points.T)]


def _codes(points: np.ndarray, ids: np.ndarray, neighbours: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, ...]:
    """An order of each particle's neighbours, and a number for the whole, equal for equal stencils."""
    offsets = _offsets(points, ids, neighbours)
    distance = np.maximum.reduce([np.abs(x) for x in offsets])
    unit = _UNIT * distance[distance > 0].min()
    factors = np.random.default_rng(0).integers(1 << 62, size=(points.shape[1],))
    with np.errstate(over="ignore"):
        # Products wrap around: a hash of the offset.
        code = np.sum([np.rint(x * (1.0 / unit)).astype(np.int64) * f for x, f in zip(offsets, factors)], axis=0)
        code = np.where(neighbours >= 0, code, np.iinfo(np.int64).max)
        code[:, 0] = np.iinfo(np.int64).min
        order = np.argsort(code, axis=1)  # equal codes are those of empty places
        mixed = (code ^ (code >> 29)) * np.int64(0x3F58476D1CE4E5B9)
        total = (mixed ^ (mixed >> 32)).sum(axis=1)
        flat = np.rint(own.reshape(len(own), -1) * 1e12).astype(np.int64)
        total = total + (flat * np.random.default_rng(1).integers(1 << 62, size=flat.shape[1])).sum(axis=1)
    return order, total
