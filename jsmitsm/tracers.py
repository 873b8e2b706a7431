"""Values that JAX only traces: whether there are any, and the numbers behind them."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np


def is_traced(*trees: Any) -> bool:
    """Whether any leaf is under a JAX transform."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def recorded() -> bool:
    """Whether every operation is recorded here, one on constants too, as under jit."""
    return is_traced(jax.device_put(np.zeros(())))  # which alone compiles nothing


def closes_over_traced(function: Any, depth: int = 4) -> bool:
    """Whether a function refers to traced values by its closure, or by those of functions in it."""
    for cell in getattr(function, "__closure__", None) or ():
        try:
            value = cell.cell_contents
        except ValueError:  # still empty
            continue
        if is_traced(value) or (depth and closes_over_traced(value, depth - 1)):
            return True
    return False


def concrete(x: Any) -> Any:
    """The numbers behind a value that only carries derivatives; None behind an abstract one."""
    while isinstance(x, jax.core.Tracer):
        x = getattr(x, "primal", None)
    return x
