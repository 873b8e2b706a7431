"""Between the steps: interpolation by the polynomial through the nearest of them."""

from __future__ import annotations

import math

import numpy as np

# Steps that a polynomial goes through; its error is of their number's power of the step.
NEAREST = 6


def weights(nodes: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each of ``times`` (m,) the numbers (m, k) of the steps used, and their Lagrange weights (m, k)."""
    k = min(NEAREST, len(nodes))
    right = np.clip(np.searchsorted(nodes, times), 1, len(nodes) - 1)
    first = np.clip(right - k // 2, 0, len(nodes) - k)
    index = first[:, None] + np.arange(k)
    at = nodes[index]
    scale = at[:, -1:] - at[:, :1]
    at, x = at / scale, times[:, None] / scale
    out = np.ones(index.shape)
    for j in range(k):
        for i in range(k):
            if i != j:
                out[:, j] *= (x[:, 0] - at[:, i]) / (at[:, j] - at[:, i])
    near = np.argmin(abs(at - x), axis=1)
    hit = abs(at[np.arange(len(x)), near] - x[:, 0]) <= 1e-13
    out[hit] = np.arange(k) == near[hit, None]
    return index, out


def derivative(nodes: np.ndarray, values: np.ndarray, time: float, order: int) -> np.ndarray:
    """The derivative of this order of the polynomial through the nearest steps: values (K, ...) to (...)."""
    (index,), _ = weights(nodes, np.array([time]))
    scale = float(nodes[index[-1]] - nodes[index[0]])
    s = (nodes[index] - time) / scale
    # Coefficients of the polynomial about the time itself.
    taylor = np.tensordot(np.linalg.inv(s[:, None] ** np.arange(len(s))), values[index], axes=1)
    if order >= len(s):
        return np.zeros(values.shape[1:])
    return taylor[order] * math.factorial(order) / scale**order
