"""How large values and their errors are, field by field, and how smooth: over one process's particles, or all."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.parts.whole import ALONE, Whole
from jsmitsm.runtime.tracers import is_traced

# A field's range below this part of its values is round-off, and so is a field below this part of the largest.
FLAT, NOTHING = 1e-9, 1e-10


def share(error: np.ndarray, values: np.ndarray, nothing: float = NOTHING, told: Whole = ALONE) -> float:
    """Errors (N, F) over the values (N, F), of the worst field: each has a scale of its own.

    nothing : a field below this part of the largest is taken for zero.
    """
    size = told.most(np.abs(values).max(initial=0.0)) or 1.0  # no square overflows
    norms = lambda x: np.sqrt(told.total(np.square(x / size).sum(axis=0)))  # noqa: E731
    fields = norms(values)
    scale = np.maximum(fields, nothing * fields.max(initial=0.0))
    return float(np.max(norms(error) / np.where(scale > 0, scale, 1.0)))


def scales(values: Any, told: Whole = ALONE) -> Any:
    """The range of each field (F,), not below the round-off of the values: a constant has no range of its own."""
    xp = jnp if is_traced(values) else np
    size = told.most(xp.abs(values).max(axis=0, initial=0.0))
    span = told.most(values.max(axis=0)) + told.most((-values).max(axis=0))
    scale = xp.maximum(span, xp.maximum(FLAT * size, NOTHING * size.max(initial=0.0)))
    return xp.where(scale > 0, scale, 1.0)


def predicted(points: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Each particle's value from the linear function that fits its 2 D + 1 nearest neighbours best."""
    from scipy.spatial import cKDTree

    n, dim = points.shape
    k = min(2 * dim + 2, n)
    if k < dim + 3:
        return values
    near = cKDTree(points).query(points, k=k)[1][:, 1:]
    offset = points[near] - points[:, None]
    size = np.sqrt((offset**2).sum(axis=2)).max(axis=1)
    p = np.concatenate([np.ones((n, k - 1, 1)), offset / size[:, None, None]], axis=2)
    # A little ridge: neighbours on one line say nothing of the slope across it.
    gram = np.einsum("nki,nkj->nij", p, p) + 1e-6 * np.eye(dim + 1)
    return np.linalg.solve(gram, np.einsum("nki,nk->ni", p, values[near])[..., None])[:, 0, 0]
