"""Points along a segment, close enough together to follow a spacing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

# Points to begin with, and the largest distance of two, in the spacings at both.
_FIRST, _CLOSE = 17, 0.5
# Halvings, and points after which the rest is left as it is: more would not fit a cloud.
_ROUNDS, _MOST = 60, 4_000_000


def followed(a: np.ndarray, b: np.ndarray, spacing: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Points (M, D) from a to b: a piece longer than half the spacing at one of its ends is halved, again and again."""
    at = np.linspace(0.0, 1.0, _FIRST)
    length = float(np.linalg.norm(b - a))
    h = spacing(a + at[:, None] * (b - a))
    for _ in range(_ROUNDS):
        wide = np.flatnonzero(length * np.diff(at) > _CLOSE * np.minimum(h[1:], h[:-1]))
        if not len(wide) or len(at) > _MOST:
            break
        middle = 0.5 * (at[wide] + at[wide + 1])
        wide = wide[(middle > at[wide]) & (middle < at[wide + 1])]
        middle = 0.5 * (at[wide] + at[wide + 1])
        if not len(wide):
            break
        h = np.insert(h, wide + 1, spacing(a + middle[:, None] * (b - a)))
        at = np.insert(at, wide + 1, middle)
    path = a + at[:, None] * (b - a)
    path[-1] = b
    return path
