"""Between the steps: interpolation by the polynomial through the nearest of them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

# Steps that a polynomial goes through; its error is of their number's power of the step.
NEAREST = 6
# Each term of a polynomial is taken to be so large a part of the one before at the most.
SLOWEST = 0.8


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


def doubts(
    nodes: np.ndarray, values: list[np.ndarray], times: np.ndarray, largest: Callable[[np.ndarray], float]
) -> np.ndarray:
    """The sizes (S, F) of errors of the values (K) of (N, F) between the nodes, at times (S,), by field.

    By Newton's terms of the polynomial, those of the nearest nodes first. The last one is what there is to add where
    they get small soon. What is over within a step, as most of a start that contradicts the conditions is, makes terms
    that go like powers of their number, with a sum many times the last one: it shows by what the polynomial changes
    where the last node before the time is left out, which is the bound, as is all that the values change.
    """
    out = np.zeros((len(times), values[0].shape[-1]))
    for s, (index, w) in enumerate(zip(*weights(nodes, times))):
        if np.count_nonzero(w) == 1:
            continue
        index = index[np.argsort(abs(nodes[index] - times[s]))]
        x, table = nodes[index], np.stack([values[i] for i in index])
        spread, terms, product = np.abs(table - table[0]).max(axis=0), [], 1.0
        for j in range(1, len(x)):
            table[j:] = (table[j:] - table[j - 1 : -1]) / (x[j:] - x[:-j])[:, None, None]
            product *= times[s] - x[j - 1]
            terms.append(product * table[j])
        sizes = np.array([[largest(v[:, f]) for v in (*terms, spread)] for f in range(out.shape[1])])
        without = (times[s] - x[-1]) / (times[s] - x[x < times[s]].max())
        out[s] = [min(_rest(v[:-1]), max(abs(without), 1.0) * v[-2], v[-2] + v[-1]) for v in sizes]
    return out


def _rest(terms: np.ndarray) -> float:
    """The size of what comes after terms of these sizes, by how fast the last of them got small."""
    last, first = float(terms[-1]), float(terms[min(1, len(terms) - 1)])
    if not terms.all():
        return last
    ratios = [(last / first) ** (1.0 / (len(terms) - 2)), *terms[-2:] / terms[-3:-1]] if len(terms) > 2 else [SLOWEST]
    return last / (1.0 - min(max(ratios), SLOWEST)) ** 3


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
