"""Condition numbers and near null vectors of matrices that are only known by solves with them.

``apply(b, transpose)`` solves A x = b, or A^T x = b, for columns b (n, m).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


class Entries:
    """Which entries of a vector (n,) stand here, where several processes have a part each: all of them."""

    def __init__(self, n: int):
        self.first, self.here = 0, n

    def total(self, value: float) -> float:
        """The sum over all processes."""
        return value

    def largest(self, size: np.ndarray) -> tuple[float, int]:
        """The largest entry and its number among all."""
        at = int(size.argmax())
        return float(size[at]), at


def inverse_norm(apply: Callable[..., Any], n: int, entries: Any = None) -> float:
    """The 1-norm of A^-1: a lower bound that is rarely off by more than 3, for a handful of solves.

    entries: as ``Entries``, where ``apply`` takes and gives a part of the vectors.

    Source: W. Hager, Condition estimates, SIAM J. Sci. Stat. Comput. 5 (1984), with the alternating
    vector of N. Higham, ACM Trans. Math. Softw. 14 (1988).

    Example:
      >>> inverse_norm(lambda b, transpose: b / 4.0, 3)
      0.25
    """
    mine = Entries(n) if entries is None else entries
    number = mine.first + np.arange(mine.here)
    x = np.full((mine.here, 1), 1.0 / n)
    best = 0.0
    for _ in range(5):
        y = apply(x, False)
        size = mine.total(float(abs(y).sum()))
        if not np.isfinite(size):
            return float("inf")
        if size <= best:
            break
        best = size
        z = apply(np.where(y < 0, -1.0, 1.0), True)
        largest, j = mine.largest(abs(z[:, 0]))
        if largest <= abs(mine.total(float(z[:, 0] @ x[:, 0]))):
            break
        x = np.where(number == j, 1.0, 0.0)[:, None]
    alternating = (np.where(number % 2, -1.0, 1.0) * (1.0 + number / max(n - 1, 1)))[:, None]
    return max(best, 2.0 * mine.total(float(abs(apply(alternating, False)).sum())) / (3.0 * n))


def to_one(largest: np.ndarray) -> np.ndarray:
    """Powers of two that bring these numbers to about one; one for zeros."""
    return np.exp2(-np.round(np.log2(np.where(largest > 0, largest, 1.0))))


def near_null_vector(apply: Callable[..., Any], n: int) -> np.ndarray:
    """Unit vector (n,) that A maps nearest to zero: three powers of (A^T A)^-1."""
    v = np.random.default_rng(1).standard_normal((n, 1))
    for _ in range(3):
        w = apply(v / np.linalg.norm(v), True)
        v = apply(w / np.linalg.norm(w), False)
    return v[:, 0] / np.linalg.norm(v)
