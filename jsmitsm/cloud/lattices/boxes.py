"""Lattices of particles in rectangles and boxes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import FAR, INTERIOR, Cloud
from jsmitsm.runtime.errors import explaining, is_number, is_whole, numbers, short

_SIDES = (("left", 0, 0), ("right", 0, 1), ("bottom", 1, 0), ("top", 1, 1), ("front", 2, 0), ("back", 2, 1))


@explaining
def rectangle(
    lo: Sequence[float], hi: Sequence[float], shape: Sequence[int], jitter: float = 0.0, seed: int = 0
) -> Cloud:
    """A lattice of particles on a rectangle; groups interior, left, right, bottom, top.

    A corner belongs to the first group that claims it, in that order.

    Parameters
    ----------
    lo, hi : sequence of float (2,)
        The lower left and the upper right corner.
    shape : sequence of int (2,)
        Particles along x and y.
    jitter : float
        Interior particles move by up to that fraction of the spacing along each axis.
    seed : int
        Makes the jitter reproducible.

    Returns
    -------
    Cloud
        In 2D.

    Raises
    ------
    ValueError
        For an empty rectangle, fewer than two particles along an axis, or a jitter of half a spacing or more.

    Examples
    --------
    >>> import jsmitsm as js
    >>> len(js.rectangle((0, 0), (4, 9), (5, 10)))
    50
    """
    return lattice(lo, hi, shape, jitter, seed, dim=2)


@explaining
def box(lo: Sequence[float], hi: Sequence[float], shape: Sequence[int], jitter: float = 0.0, seed: int = 0) -> Cloud:
    """A lattice of particles on a box; groups as in ``js.rectangle``, then front (low z) and back (high z).

    Parameters
    ----------
    lo, hi : sequence of float (3,)
        Two opposite corners.
    shape : sequence of int (3,)
        Particles along x, y and z.
    jitter : float
        Interior particles move by up to that fraction of the spacing along each axis.
    seed : int
        Makes the jitter reproducible.

    Returns
    -------
    Cloud
        In 3D.

    Raises
    ------
    ValueError
        As ``js.rectangle``.

    Examples
    --------
    >>> import jsmitsm as js
    >>> sorted(js.box((0, 0, 0), (1, 1, 1), (3, 3, 3)).groups)
    ['back', 'bottom', 'front', 'interior', 'left', 'right', 'top']
    """
    return lattice(lo, hi, shape, jitter, seed, dim=3)


def lattice(lo, hi, shape, jitter, seed, dim=1, names=("lo", "hi", "shape")) -> Cloud:
    """A lattice cloud of any dimension; ``names``: of the arguments in what is raised."""
    lo, hi = (_checked_corner(v, name, dim) for v, name in zip((lo, hi), names))
    if not (hi > lo).all():
        raise ValueError(f"{names[1]}: {hi.tolist()} must be greater than {names[0]} = {lo.tolist()} along every axis")
    counts = np.atleast_1d(np.asarray(shape))
    if counts.shape != (dim,) or counts.dtype.kind not in "iu" or (counts < 2).any():
        raise ValueError(f"{names[2]}: expected {dim} whole number(s) of at least 2, got {shape!r}")
    if not is_number(jitter) or not 0.0 <= jitter < 0.5:
        raise ValueError(f"jitter: expected 0 <= jitter < 0.5 spacings (beyond, particles may meet), got {jitter!r}")
    if not is_whole(seed, 0):
        raise ValueError(f"seed: expected a whole number from 0, the start of the random numbers, got {seed!r}")
    axes = [np.linspace(a, b, n) for a, b, n in zip(lo, hi, counts)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
    place = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, dim)
    free = np.ones(len(points), bool)
    normals = np.full(points.shape, np.nan)
    sides: dict[str, np.ndarray] = {}
    for name, axis, end in _SIDES[: 2 * dim]:
        claimed = free & (place[:, axis] == (counts[axis] - 1 if end else 0))
        sides[name] = np.flatnonzero(claimed)
        normals[claimed] = 0.0
        normals[claimed, axis] = 1.0 if end else -1.0
        free &= ~claimed
    inside = np.flatnonzero(free)
    if jitter:
        spacing = (hi - lo) / (counts - 1)
        points[inside] += jitter * spacing * np.random.default_rng(seed).uniform(-1, 1, (len(inside), dim))
    return Cloud(points, {INTERIOR: inside, **sides}, normals)


def _checked_corner(value: Any, name: str, dim: int) -> np.ndarray:
    try:
        corner = np.atleast_1d(numbers(name, value))
    except ValueError:
        raise ValueError(f"{name}: expected {dim} finite number(s), got {short(value)}") from None
    if np.abs(corner).max(initial=0.0) > FAR and np.isfinite(corner).all():
        raise ValueError(
            f"{name}: {short(value)} is of a size whose powers leave the range of floats; use another unit of length"
        )
    if corner.shape != (dim,) or not np.isfinite(corner).all():
        raise ValueError(f"{name}: expected {dim} finite number(s), got {short(value)}")
    return corner
