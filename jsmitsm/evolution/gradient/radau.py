"""The way back through a step of Radau IIA, of a linear problem.

With M the inverse of the scheme's matrix a step solves

    (M / h) (E (Y - y) + H_i - H) + A Y = F_i,    y' = Y_s

for its stages. With l (s, size) the solution of (M^T / h) E^T l + A^T l = (0, 0, y'*), by the same eigenvectors as
forward, and k = M^T l / h the cotangents are

    y* = sum_j E^T k_j,   H* += sum_j k_j,   H_j* -= k_j,   F_i* += l_i
    E* -= sum_j k_j (Y_j - y)^T,   A* -= sum_i l_i Y_i^T,   h* += sum_i l_i . (F_i - A Y_i) / h
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.evolution.gradient.bars import Bars
from jsmitsm.evolution.steps.tableaux import Radau


def back(
    scheme: Radau, bars: Bars, newton: Any, k: int, y: np.ndarray, stages: list[np.ndarray], y_bar: np.ndarray
) -> np.ndarray:
    """From the cotangent of a step's end to that of its start."""
    at, system, s = bars.at, bars.system, len(scheme.nodes)
    h, first = float(at.h), k * s
    real, pair = float(scheme.values[0].real), complex(scheme.values[1])
    w0 = (h / real) * system.resolvent(h / real).solve_transposed(scheme.vectors[-1, 0].real * y_bar)
    w1 = (h / pair) * system.resolvent(h / pair).solve_transposed(scheme.vectors[-1, 1] * y_bar)
    low = np.multiply.outer(scheme.back[0].real, w0) + 2.0 * np.multiply.outer(scheme.back[1], w1).real
    jumps = np.tensordot(np.linalg.inv(scheme.matrix).T / h, low, axes=1)
    total = jumps.sum(axis=0)
    bars.jump[first] += total
    states = np.array(stages)
    bars.force[first + 1 : first + s + 1] += low
    bars.jump[first + 1 : first + s + 1] -= jumps
    bars.mass(-jumps, states - y)
    bars.stiff(-low, states)
    if bars.timed:
        bars.h += sum(float(low[i] @ (at.force[first + 1 + i] - system.stiff(stages[i]))) for i in range(s)) / h
    return system.mass_transposed(total)
