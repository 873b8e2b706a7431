"""Condition numbers and near null vectors of matrices that are only known by solves with them.

``apply(b, transpose)`` solves A x = b, or A^T x = b, for columns b (n, m).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def inverse_norm(apply: Callable[..., Any], n: int) -> float:
    """The 1-norm of A^-1: a lower bound that is rarely off by more than 3, for a handful of solves.

    Source: W. Hager, Condition estimates, SIAM J. Sci. Stat. Comput. 5 (1984), with the alternating
    vector of N. Higham, ACM Trans. Math. Softw. 14 (1988).

    Example:
      >>> inverse_norm(lambda b, transpose: b / 4.0, 3)
      0.25
    """
    x = np.full((n, 1), 1.0 / n)
    best = 0.0
    for _ in range(5):
        y = apply(x, False)
        size = float(abs(y).sum())
        if not np.isfinite(size):
            return float("inf")
        if size <= best:
            break
        best = size
        z = apply(np.where(y < 0, -1.0, 1.0), True)
        j = int(abs(z).argmax())
        if abs(z[j, 0]) <= abs(z[:, 0] @ x[:, 0]):
            break
        x = np.zeros((n, 1))
        x[j] = 1.0
    ramp = np.arange(n) / max(n - 1, 1)
    alternating = (np.where(np.arange(n) % 2, -1.0, 1.0) * (1.0 + ramp))[:, None]
    return max(best, 2.0 * float(abs(apply(alternating, False)).sum()) / (3.0 * n))


def near_null_vector(apply: Callable[..., Any], n: int) -> np.ndarray:
    """Unit vector (n,) that A maps nearest to zero: three powers of (A^T A)^-1."""
    v = np.random.default_rng(1).standard_normal((n, 1))
    for _ in range(3):
        w = apply(v / np.linalg.norm(v), True)
        v = apply(w / np.linalg.norm(w), False)
    return v[:, 0] / np.linalg.norm(v)
