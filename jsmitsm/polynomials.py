"""Local polynomials in the scaled offset s = (x - x_i) / l, and linear functionals of them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.recursion import Recursion
from jsmitsm.taylor import Slot, factorial, index_of, multi_indices


@lru_cache(maxsize=32)
def _monomial_steps(dim: int, order: int) -> list[tuple[int, int]]:
    """For each monomial but the first: the place of one a degree lower, and the axis to multiply it with."""
    place = index_of(dim, order)
    steps = []
    for a in multi_indices(dim, order)[1:]:
        axis = next(j for j in range(dim) if a[j])
        lower = tuple(v - (j == axis) for j, v in enumerate(a))
        steps.append((place[lower], axis))
    return steps


def monomials(offset: Any, order: int) -> Any:
    """All monomials s^a with |a| <= order: (ns, D) -> (ns, K)."""
    columns = [jnp.ones_like(offset[:, 0])]
    for lower, axis in _monomial_steps(offset.shape[1], order):
        columns.append(columns[lower] * offset[:, axis])
    return jnp.stack(columns, axis=1)


@lru_cache(maxsize=256)
def derivative_table(dim: int, order: int, b: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """d^b s^a = factor[a] s^(a-b): the place of a - b (0 where the factor is 0), and the factor."""
    place = index_of(dim, order)
    lower = [tuple(ai - bi for ai, bi in zip(a, b)) for a in place]
    ok = [min(c) >= 0 for c in lower]
    return (
        np.array([place[c] if good else 0 for c, good in zip(lower, ok)]),
        np.array([factorial(a) / factorial(c) if good else 0.0 for a, c, good in zip(place, lower, ok)]),
    )


def functionals(slots: Sequence[Slot], coef: Any, p: Any, rec: Recursion, length: Any) -> tuple[Any, Any]:
    """Rows (n, F K) of conditions sum_s coef[n, s] d^b u_f at a point with monomials p (K,).

    Each row is scaled to be free of units and of unit size at the leading term; the second
    result holds the factors (n,) of the right-hand side.
    """
    rows = jnp.zeros((coef.shape[0], rec.fields * rec.size), p.dtype)
    for s, (f, b) in enumerate(slots):
        lower, factor = derivative_table(rec.dim, rec.order, b)
        row = p[lower] * factor * length ** (-sum(b) - rec.weights[f])
        rows = rows.at[:, f * rec.size : (f + 1) * rec.size].add(coef[:, s, None] * row)
    sizes = jnp.stack([jnp.abs(coef[:, s]) * length ** (-sum(b) - rec.weights[f]) for s, (f, b) in enumerate(slots)])
    size = jnp.max(sizes, axis=0)
    scale = 1.0 / jnp.where(size > 0, size, 1.0)
    return rows * scale[:, None], scale


@lru_cache(maxsize=32)
def whitening(dim: int, order: int) -> np.ndarray:
    """A triangular T (K, K): the polynomials s^a T are orthonormal over the unit ball under the
    default weight, so that normal equations of the moment systems are safe."""
    nodes, weights = np.polynomial.legendre.leggauss(order + 12)
    grid = np.stack(np.meshgrid(*[nodes] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    mass = np.prod(np.stack(np.meshgrid(*[weights] * dim, indexing="ij"), axis=-1).reshape(-1, dim), axis=1)
    inside = (grid**2).sum(axis=1) <= 1
    grid, mass = grid[inside], mass[inside]
    root = np.sqrt(mass / mass.sum() * np.exp(-4 * (grid**2).sum(axis=1)))
    p = np.stack([np.prod(grid ** np.array(a), axis=1) for a in multi_indices(dim, order)], axis=1)
    r = np.linalg.qr(root[:, None] * p, mode="r")
    return np.linalg.inv(r * np.sign(np.diag(r))[:, None])
