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


def concrete(x: Any) -> Any:
    """The numbers behind a value that only carries derivatives; None behind an abstract one."""
    while isinstance(x, jax.core.Tracer):
        x = getattr(x, "primal", None)
    return x
