"""Probes around a particle, which tell what meets there."""

from __future__ import annotations

import numpy as np

# So many of them.
_PROBES = 24


def share_a_side(one: np.ndarray, two: np.ndarray, member: np.ndarray, at: np.ndarray, dim: int) -> np.ndarray:
    """Mask of the particles ``at`` at which two shapes share a piece of boundary, not only that point.

    Of the probes in a ring those of each shape follow one another; shapes that share a side have neighbouring ones.
    """
    if dim != 2:
        return np.ones(len(at), bool)
    a, b = one[:, at], two[:, at]
    touch = (a & np.roll(b, 1, axis=0)) | (b & np.roll(a, 1, axis=0)) | (a & b)
    return np.asarray(touch.any(axis=0))


def directions(dim: int) -> np.ndarray:
    """Unit vectors to all sides."""
    if dim == 1:
        return np.array([[-1.0], [1.0]])
    if dim == 2:
        # Off the axes, along which boundaries often run.
        angle = 2.0 * np.pi * (np.arange(_PROBES) + 0.37) / _PROBES
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    k = np.arange(_PROBES) + 0.5
    z, angle = 1.0 - 2.0 * k / _PROBES, np.pi * (1.0 + 5.0**0.5) * k
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
