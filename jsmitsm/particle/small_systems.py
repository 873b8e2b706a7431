"""Small dense systems in plain jnp: they batch, differentiate and never call LAPACK.

Batched LAPACK calls that run side by side in one program can deadlock on a small machine, and
do not run on every device; loops of rank-one updates do, and are faster at these sizes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.runtime import one_kernel


def safe_root(x: Any) -> Any:
    """The square root of x >= 0, with derivative zero at zero: a weight of zero stays one."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)


@jax.custom_jvp
def null_space(matrix: Any) -> tuple[Any, Any]:
    """Orthonormal basis Z of the null space of C (r, k), and the pseudo-inverse Q of C (full rank, else NaN).

    Householder reflections in plain jnp, so that it batches without LAPACK.
    """
    r, k = matrix.shape
    if r == 0:
        return jnp.eye(k, dtype=matrix.dtype), jnp.zeros((k, 0), matrix.dtype)

    def reflect(j, carry):
        x, q = carry
        column = jnp.where(jnp.arange(k) >= j, x[:, j], 0.0)
        length = jnp.sqrt(jnp.sum(column**2))
        v = column + jnp.where(jnp.arange(k) == j, jnp.where(column[j] >= 0, length, -length), 0.0)
        beta = jnp.sum(v**2)
        v = v * jnp.sqrt(2.0 / jnp.where(beta > 0, beta, 1.0))
        return x - jnp.outer(v, v @ x), q - jnp.outer(q @ v, v)

    x, q = jax.lax.fori_loop(0, r, reflect, (matrix.T, jnp.eye(k, dtype=matrix.dtype)))
    # Of a row that repeats others rounding is left: what it would say of the solution is not to be used.
    sound = jnp.all(jnp.abs(jnp.diagonal(x)) > 1e-13)
    return jnp.where(sound, q[:, r:], jnp.nan), q[:, :r] @ _inverse_lower(x[:r].T)


@null_space.defjvp
def _null_space_jvp(primals, tangents):
    # C Z = 0 gives dZ = -Q dC Z up to a rotation of Z, on which nothing that is used depends.
    (matrix,), (change,) = primals, tangents
    z, q = null_space(matrix)
    dz = -q @ (change @ z)
    dq = z @ ((change @ z).T @ (q.T @ q)) - q @ (change @ q)
    return (z, q), (dz, dq)


def orthonormalising(columns: Any) -> Any:
    """T (k, k) that makes ``columns @ T`` orthonormal, for columns (n, k) that span the space.

    Modified Gram-Schmidt in plain jnp. What rests on the space alone does not change with T, so it is a constant to
    derivatives.
    """
    n, k = columns.shape
    start = jnp.concatenate([jax.lax.stop_gradient(columns), jnp.eye(k, dtype=columns.dtype)])

    def step(j, work):
        one = jax.lax.dynamic_index_in_dim(work, j, 1, keepdims=False)
        one = one / jnp.sqrt(jnp.maximum(jnp.sum(one[:n] ** 2), jnp.finfo(one.dtype).tiny))
        along = jnp.where(jnp.arange(k) > j, one[:n] @ work[:n], 0.0)
        return jax.lax.dynamic_update_index_in_dim(work - jnp.outer(one, along), one, j, 1)

    return jax.lax.fori_loop(0, k, step, start)[n:]


def independent(matrix: Any, rank: int) -> Any:
    """Which ``rank`` rows of a matrix (r, k) span it, the largest first, as rows of the unit matrix (rank, r)."""
    rest = jax.lax.stop_gradient(matrix)
    chosen = []
    for _ in range(rank):
        k = jnp.argmax(jnp.sum(rest**2, axis=1))
        v = rest[k] / jnp.sqrt(jnp.maximum(jnp.sum(rest[k] ** 2), jnp.finfo(rest.dtype).tiny))
        rest = rest - jnp.outer(rest @ v, v)
        rest = jnp.where((jnp.arange(len(rest)) == k)[:, None], 0.0, rest)
        chosen.append(jnp.arange(len(rest)) == k)
    return jnp.stack(chosen).astype(matrix.dtype) if rank else jnp.zeros((0, len(matrix)), matrix.dtype)


def _inverse_lower(lower: Any) -> Any:
    """The inverse of a lower triangular matrix by forward substitution; zero pivots give zero rows."""
    n = lower.shape[0]

    def step(i, inverse):
        at = jnp.arange(n) == i
        row = jnp.where(jnp.arange(n) < i, lower[i], 0.0)
        pivot = lower[i, i]
        safe = jnp.where(jnp.abs(pivot) > 1e-13, pivot, jnp.inf)
        return jnp.where(at[:, None], (at - row @ inverse) / safe, inverse)

    return jax.lax.fori_loop(0, n, step, jnp.zeros_like(lower))


@jax.custom_jvp
def general_inverse(matrix: Any) -> Any:
    """The inverse of a small square matrix: Gauss-Jordan with row pivoting in plain jnp."""
    n = matrix.shape[0]
    if not n:
        return matrix
    work = jnp.concatenate([matrix, jnp.eye(n, dtype=matrix.dtype)], axis=1)

    def step(k, work):
        pivot = jnp.argmax(jnp.where(jnp.arange(n) >= k, jnp.abs(work[:, k]), -1.0))
        here, there = jnp.arange(n) == k, jnp.arange(n) == pivot
        row, other = work[pivot], work[k]
        work = jnp.where(there[:, None], other, work)
        row = row / row[k]
        column = jnp.where(here, 0.0, work[:, k])
        return jnp.where(here[:, None], row, work - jnp.outer(column, row))

    return jax.lax.fori_loop(0, n, step, work)[:, n:]


@general_inverse.defjvp
def _general_inverse_jvp(primals, tangents):
    inverse = general_inverse(primals[0])
    return inverse, -inverse @ (tangents[0] @ inverse)


class GramInverse(NamedTuple):
    """(A^T A)^-1 = scale matrix scale, from columns of unit length."""

    matrix: Any  # (k, k)
    scale: Any  # (k,)

    def __matmul__(self, t: Any) -> Any:
        scale = self.scale if t.ndim == 1 else self.scale[:, None]
        return scale * (self.matrix @ (scale * t))


# So many outer products are summed in one loop. Up to so many rows a Gram matrix inside of one kernel is faster as a
# sum of them than as a product; elsewhere it is no faster, and takes a quarter longer to compile.
_TOGETHER, _MOST_ROWS = 18, 64


def outer_products(left: Sequence[Any], right: Sequence[Any]) -> Any:
    """sum_g left[g]^T right[g] of rows (1, k) and (1, m), without a loop over g: (k, m).

    Where left and right are matrices this small, cut into rows, it takes half the time of their product.
    """
    across = (((0,), (0,)), ((), ()))
    terms = [jax.lax.dot_general(a, b, across) for a, b in zip(left, right, strict=True)]
    some = [reduce(jax.lax.add, terms[k : k + _TOGETHER]) for k in range(0, len(terms), _TOGETHER)]
    # The barrier keeps the compiler from one loop over everything, which would not stay in registers.
    return reduce(jax.lax.add, map(jax.lax.optimization_barrier, some))


def product(a: Any, b: Any) -> Any:
    """a @ b of small matrices (n, k) and (k, m)."""
    if not one_kernel.inside():
        return a @ b
    ones = [1] * len(b)
    return outer_products(jax.lax.split(a.T, ones), jax.lax.split(b, ones))


@jax.custom_jvp
def gram_matrix(a: Any) -> Any:
    """A^T A for a tall A (n, k)."""
    if not one_kernel.inside() or len(a) > _MOST_ROWS:
        return a.T @ a
    rows = jax.lax.split(a, [1] * len(a))
    return outer_products(rows, rows)


@gram_matrix.defjvp
def _gram_matrix_jvp(primals, tangents):
    (a,), (da,) = primals, tangents
    half = da.T @ a
    return gram_matrix(a), half + half.T


def gram_inverse(a: Any, tolerance: float | None = None) -> GramInverse:
    """(A^T A)^-1 for a tall A (n, k) by symmetric sweeps; with a tolerance, columns that depend
    on others up to it are left out (zero rows and columns)."""
    if not a.shape[1]:  # conditions may leave nothing free
        return GramInverse(jnp.zeros((0, 0), a.dtype), jnp.zeros(0, a.dtype))
    gram = gram_matrix(a)
    square = jnp.diagonal(gram)
    scale = 1.0 / jnp.sqrt(jnp.where(square > 0, square, 1.0))
    gram = gram * scale[:, None] * scale
    return GramInverse(definite_inverse(gram) if tolerance is None else _pivoted_inverse(gram, tolerance), scale)


@jax.custom_jvp
def definite_inverse(gram: Any) -> Any:
    """The inverse of a symmetric positive definite matrix (k, k)."""
    return _inverse_of_one(gram)


@definite_inverse.defjvp
def _inverse_jvp(primals, tangents):
    inverse = definite_inverse(primals[0])
    return inverse, -inverse @ (tangents[0] @ inverse)


@jax.custom_batching.custom_vmap
def _inverse_of_one(gram: Any) -> Any:
    return _sweeps(gram[..., None])[..., 0]


@_inverse_of_one.def_vmap
def _inverse_of_many(size: int, batched: Any, gram: Any) -> tuple[Any, bool]:
    # The matrices side by side in the last axis: every sweep is then a loop over neighbouring numbers.
    return jnp.moveaxis(_sweeps(jnp.moveaxis(gram, 0, -1)), -1, 0), True


def _sweeps(g: Any) -> Any:
    """The inverses of matrices (k, k, batch) by symmetric sweeps, one rank-one update each.

    With v = g[j] - e_j a sweep is g - v v^T / g[j, j], but for 2 on the diagonal, which is taken off at the end.
    """
    k = g.shape[0]
    unit = np.eye(k, dtype=g.dtype)[:, :, None]

    def factors(g, j):
        # An unsigned number needs no look whether it is negative.
        row, one = (jax.lax.dynamic_index_in_dim(x, j, 0, keepdims=False) for x in (g, unit))
        v = jax.lax.sub(row, jax.lax.broadcast_in_dim(one, row.shape, (0, 1)))
        return v, v / jax.lax.dynamic_index_in_dim(row, j, 0)

    def sweep(j, carry):
        g, v, u = carry
        # The barrier keeps the update in place: without it the compiler joins it with the next row and copies g.
        g = jax.lax.optimization_barrier(g - v[:, None] * u[None])
        return g, *factors(g, jax.lax.min(j + np.uint32(1), np.uint32(k - 1)))

    g, *_ = jax.lax.fori_loop(np.uint32(0), np.uint32(k), sweep, (g, *factors(g, np.uint32(0))))
    return 2.0 * unit - g


def _pivoted_inverse(gram: Any, tolerance: float) -> Any:
    """The same by one's own choice of pivots, without the columns that have none above the tolerance."""
    k = gram.shape[0]

    def step(_, carry):
        g, done = carry
        rest = jnp.where(done, -1.0, jnp.diagonal(g))
        j = jnp.argmax(rest)
        keep = rest[j] > tolerance
        at = jnp.arange(k) == j
        v = g[j] - at
        swept = g - jnp.outer(v, v / jnp.where(keep, rest[j], 1.0)) - 2.0 * jnp.outer(at, at)
        return jnp.where(keep, swept, g), done.at[j].set(done[j] | keep)

    g, done = jax.lax.fori_loop(0, k, step, (gram, jnp.zeros(k, bool)))
    return jnp.where(done[:, None] & done[None, :], -g, 0.0)


def min_norm(a: Any, t: Any, tolerance: float | None = None) -> Any:
    """The smallest w (n, m) with A^T w = t, for A (n, k) and t (k, m); refined once."""
    return _min_norm(tolerance, a, t)[0]


def solve_gram(a: Any, inverse: GramInverse, t: Any) -> Any:
    """y (k, m) with A^T A y = t, refined once."""
    y = inverse @ t
    return y + inverse @ (t - a.T @ (a @ y))


def _min_norm_impl(tolerance, a, t):
    inverse = gram_inverse(a, tolerance)
    y = solve_gram(a, inverse, t)
    return a @ y, y


_min_norm = jax.custom_jvp(_min_norm_impl, nondiff_argnums=(0,))


@_min_norm.defjvp
def _min_norm_jvp(tolerance, primals, tangents):
    # w = A y and A^T w = t, so dw = dA y + A dy with A^T A dy = dt - dA^T w - A^T dA y.
    (a, t), (da, dt) = primals, tangents
    w, y = _min_norm(tolerance, a, t)
    day = da @ y
    dy = solve_gram(a, gram_inverse(a, tolerance), dt - da.T @ w - a.T @ day)
    return (w, y), (day + a @ dy, dy)
