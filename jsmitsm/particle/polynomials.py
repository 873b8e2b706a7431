"""Local polynomials in the scaled offset s = (x - x_i) / l, and linear functionals of them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.particle.recursion import Recursion
from jsmitsm.particle.small_systems import outer_products, product
from jsmitsm.taylor.multi_indices import Slot, factorial, index_of, multi_indices

# Up to so many monomials their combinations are made at once.
FEW = 15


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def monomials(offset: Any, order: int) -> Any:
    """All monomials s^a with |a| <= order: (ns, D) -> (ns, K), without a loop over them.

    Each power is a product of s, s^2, s^4, ... or 1, as the bits of its exponent tell.
    """
    exponents = np.array(multi_indices(offset.shape[1], order))
    out = jnp.ones((), offset.dtype)
    for s, exponent in zip(offset.T, exponents.T, strict=True):
        for bit in range(order.bit_length()):
            out = out * jnp.where((exponent >> bit) % 2 == 1, s[:, None], 1.0)
            s = s * s
    # The barrier keeps the compiler from making them again for every use.
    return jax.lax.optimization_barrier(out)


@monomials.defjvp
def _monomials_jvp(order, primals, tangents):
    # Differentiated column by column, which needs no more products than there are columns.
    _, slope = jax.jvp(lambda x: jnp.concatenate(_columns(x, order)).T, primals, tangents)
    return monomials(*primals, order), slope


def _columns(offset: Any, order: int) -> list[Any]:
    """The monomials one by one, (1, ns) each: one product makes each from another."""
    dim = offset.shape[1]
    axes = jax.lax.split(offset.T, [1] * dim)
    columns = [jax.lax.full_like(axes[0], 1.0)]
    for lower, axis in _steps(dim, order):
        columns.append(columns[lower] * axes[axis])
    return columns


@lru_cache(maxsize=64)
def _steps(dim: int, order: int) -> tuple[tuple[int, int], ...]:
    """Of every monomial but the first: the one before it, and the axis by which that is multiplied."""
    place = index_of(dim, order)
    axes = [next(k for k, n in enumerate(a) if n) for a in multi_indices(dim, order)[1:]]
    lower = [tuple(n - (k == axis) for k, n in enumerate(a)) for a, axis in zip(multi_indices(dim, order)[1:], axes)]
    return tuple((place[a], axis) for a, axis in zip(lower, axes))


def monomials_on_host(offset: np.ndarray, order: int) -> np.ndarray:
    """All monomials s^a with |a| <= order, in numpy: (D, M) to (K, M)."""
    steps = _steps(len(offset), order)
    out = np.ones((len(steps) + 1, offset.shape[1]))
    for k, (lower, axis) in enumerate(steps):
        np.multiply(out[lower], offset[axis], out=out[k + 1])
    return out


class Combinations(NamedTuple):
    """What stands for ``monomials(offset, order)``, of at most FEW monomials, in products with matrices."""

    offset: Any  # (ns, D)
    order: int

    def __matmul__(self, matrix: Any) -> Any:
        """(ns, K) @ (K, m) or (K,)."""
        if matrix.ndim == 1:
            return (self @ matrix[:, None])[:, 0]
        return _combined(self.offset, self.order, matrix)


class Separated(NamedTuple):
    """What stands for ``monomials(offset, order)`` on a line or in the plane, where sums over places are asked for."""

    offset: Any  # (ns, D)
    order: int

    def __matmul__(self, matrix: Any) -> Any:
        """(ns, K) @ (K, m) or (K,)."""
        return monomials(self.offset, self.order) @ matrix

    def summed(self, weights: Any) -> Any:
        """The transposed (K, ns) @ (ns, m): powers of x times powers of y, summed before they are multiplied out."""
        exponents = np.array(multi_indices(self.offset.shape[1], self.order)).T
        x, *y = (_powers(s, self.order) for s in self.offset.T)
        if not y:
            return product(x, weights)
        sums = [product(x * w, y[0].T)[tuple(exponents)] for w in weights.T]
        return jnp.stack(sums, axis=1)


def _powers(x: Any, order: int) -> Any:
    """1, x, x^2, ... (order + 1, n)."""
    rows = [jnp.ones_like(x)]
    for _ in range(order):
        rows.append(rows[-1] * x)
    return jnp.stack(rows)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _combined(offset: Any, order: int, matrix: Any) -> Any:
    # Each monomial times its row of the matrix, summed in one loop, and the monomials never stored: half the time.
    return outer_products(_columns(offset, order), jax.lax.split(matrix, [1] * len(matrix)))


@_combined.defjvp
def _combined_jvp(order, primals, tangents):
    (offset, matrix), (change, other) = primals, tangents
    p, slope = jax.jvp(lambda x: monomials(x, order), (offset,), (change,))
    return _combined(offset, order, matrix), slope @ matrix + p @ other


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


def functionals(
    slots: Sequence[Slot], coef: Any, p: Any, rec: Recursion, length: Any, units: Any
) -> tuple[Any, Any]:
    """Rows (n, F K) of conditions sum_s coef[n, s] d^b u_f at a point with monomials p (K,).

    units (F,): of the fields. Each row is scaled to be free of units and of unit size at the leading term; the second
    result holds the factors (n,) of the right-hand side.
    """
    rows = jnp.zeros((coef.shape[0], rec.fields * rec.size), p.dtype)
    for s, (f, b) in enumerate(slots):
        lower, factor = derivative_table(rec.dim, rec.reach, b)
        row = p[lower] * factor * units[f] * length ** (-sum(b) - rec.weights[f])
        rows = rows.at[:, f * rec.size : (f + 1) * rec.size].add(coef[:, s, None] * row)
    sizes = [
        jnp.abs(coef[:, s]) * units[f] * length ** (-sum(b) - rec.weights[f]) for s, (f, b) in enumerate(slots)
    ]
    size = jnp.max(jnp.stack(sizes), axis=0)
    scale = 1.0 / jnp.where(size > 0, size, 1.0)
    return rows * scale[:, None], scale


@lru_cache(maxsize=32)
def whitening(dim: int, order: int, pinned: bool = False) -> np.ndarray:
    """A triangular T (K, K): the polynomials s^a T are orthonormal over the unit ball under the
    default weight, so that normal equations of the moment systems are safe. Pinned: without the constant."""
    nodes, weights = np.polynomial.legendre.leggauss(order + 12)
    grid = np.stack(np.meshgrid(*[nodes] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    mass = np.prod(np.stack(np.meshgrid(*[weights] * dim, indexing="ij"), axis=-1).reshape(-1, dim), axis=1)
    inside = (grid**2).sum(axis=1) <= 1
    grid, mass = grid[inside], mass[inside]
    root = np.sqrt(mass / mass.sum() * np.exp(-4 * (grid**2).sum(axis=1)))
    p = np.stack([np.prod(grid ** np.array(a), axis=1) for a in multi_indices(dim, order)[int(pinned) :]], axis=1)
    r = np.linalg.qr(root[:, None] * p, mode="r")
    return np.linalg.inv(r * np.sign(np.diag(r))[:, None])
