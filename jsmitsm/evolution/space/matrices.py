"""Sparse matrices by their entries, whose values JAX may trace, and their resolvents."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.linear import linsolve
from jsmitsm.runtime.collector import uncollected
from jsmitsm.runtime.tracers import is_traced

# Entries that are taken together, few enough to stay in cache.
CHUNK = 1024


class Sparse:
    """A matrix by its entries; those at one place add up. values (nnz,) may be traced, rows and cols not."""

    def __init__(self, values: Any, rows: np.ndarray, cols: np.ndarray, shape: tuple[int, int]):
        self.values, self.rows, self.cols, self.shape = values, rows, cols, shape

    @cached_property
    def host(self) -> Any:
        """The matrix for scipy."""
        with uncollected():
            from scipy import sparse

        return sparse.csr_array((np.asarray(self.values), (self.rows, self.cols)), shape=self.shape)

    @cached_property
    def host_transposed(self) -> Any:
        return self.host.T.tocsr()

    def times(self, x: Any) -> Any:
        """The product with x (n,) or (n, m), by scipy or, where anything is traced, by JAX."""
        if not is_traced(self.values, x):
            return self.host @ np.asarray(x)
        if np.ndim(x) == 2:
            return _product(_Form(self.rows, self.cols, self.shape), self.values, x)
        return _times(self.values, self.rows, self.cols, jnp.asarray(x), self.shape[0])

    def with_values(self, values: Any) -> Sparse:
        return Sparse(values, self.rows, self.cols, self.shape)

    def part(self, rows: np.ndarray, cols: np.ndarray) -> Sparse:
        """The submatrix of these rows and columns, each given once."""
        place = [np.full(n, -1) for n in self.shape]
        place[0][rows], place[1][cols] = np.arange(len(rows)), np.arange(len(cols))
        keep = np.flatnonzero((place[0][self.rows] >= 0) & (place[1][self.cols] >= 0))
        at = place[0][self.rows[keep]], place[1][self.cols[keep]]
        return Sparse(self.values[keep], *at, (len(rows), len(cols)))


def _times(values: Any, rows: Any, cols: Any, x: Any, n: int) -> Any:
    wide = values.reshape(-1, *[1] * (x.ndim - 1))
    return jnp.zeros((n, *x.shape[1:]), jnp.result_type(values, x)).at[rows].add(wide * x[cols])


_times = jax.jit(_times, static_argnums=4)


@dataclass(eq=False)
class _Form:
    """A matrix without its values."""

    rows: np.ndarray
    cols: np.ndarray
    shape: tuple[int, int]


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _product(form: _Form, values: Any, x: Any) -> Any:
    """Many products: by scipy wherever only derivatives are traced, so that nothing of entries by columns is made."""
    if is_traced(values, x):
        return _times(values, form.rows, form.cols, jnp.asarray(x), form.shape[0])
    return jnp.asarray(Sparse(values, form.rows, form.cols, form.shape).host @ np.asarray(x))


def _product_forward(form: _Form, values: Any, x: Any) -> tuple[Any, Any]:
    return _product(form, values, x), (values, x)


def _product_backward(form: _Form, kept: Any, bar: Any) -> tuple[Any, Any]:
    values, x = kept
    if is_traced(kept, bar):
        _, back = jax.vjp(lambda v, y: _times(v, form.rows, form.cols, y, form.shape[0]), values, jnp.asarray(x))
        return back(bar)
    matrix, bar = Sparse(values, form.rows, form.cols, form.shape), np.asarray(bar)
    return jnp.asarray(sampled(matrix, bar, np.asarray(x))), jnp.asarray(matrix.host_transposed @ bar)


_product.defvjp(_product_forward, _product_backward)


def sampled(matrix: Sparse, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The entries of left right^T, (n, m) and (k, m), at the places of a matrix."""
    out = np.empty(len(matrix.rows))
    for k in range(0, len(out), CHUNK):
        some = slice(k, k + CHUNK)
        np.einsum("ej,ej->e", left[matrix.rows[some]], right[matrix.cols[some]], out=out[some])
    return out


def combined(parts: list[tuple[Any, Sparse]]) -> tuple[Any, np.ndarray, np.ndarray]:
    """Entries, rows and columns of a sum of factor * matrix."""
    xp = jnp if is_traced([(f, m.values) for f, m in parts]) else np
    values = xp.concatenate([f * xp.asarray(m.values) for f, m in parts])
    return values, np.concatenate([m.rows for _, m in parts]), np.concatenate([m.cols for _, m in parts])


class ComplexFactor:
    """The factors of P + i Q as those of the real matrix [P, -Q; Q, P]; the transpose is not conjugated."""

    def __init__(self, entries: tuple[Any, Any, Any], n: int, points: np.ndarray | None):
        values, rows, cols = entries
        real, imag = values.real, values.imag
        self._factor = linsolve.factor(
            np.concatenate([real, real, -imag, imag]), np.concatenate([rows, rows + n, rows, rows + n]),
            np.concatenate([cols, cols + n, cols + n, cols]), 2 * n,
            None if points is None else np.concatenate([points, points]), "sparse", False, 0,
        )  # fmt: skip
        self.n = n

    def solve(self, b: np.ndarray, transpose: bool = False) -> np.ndarray:
        # The real transpose is that of the conjugate.
        b = b.conj() if transpose else b
        x = self._factor.solve(np.concatenate([b.real, b.imag]), transpose)
        x = x[: self.n] + 1j * x[self.n :]
        return x.conj() if transpose else x


class RealFactor:
    """A factorisation that is kept among those of the package, solved with as it is."""

    def __init__(self, entries: tuple[Any, Any, Any], n: int, points: np.ndarray | None):
        self._factor = linsolve.factor(*entries, n, points, "sparse", False, 0)

    def solve(self, b: np.ndarray, transpose: bool = False) -> np.ndarray:
        return self._factor.solve(b, transpose)
