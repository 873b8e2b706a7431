"""Sparse matrices by their entries, whose values JAX may trace."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.runtime.collector import uncollected
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import picked

# Numbers that are taken together, few enough to stay in cache.
CHUNK = 2**17


@partial(jax.tree_util.register_dataclass, data_fields=["values", "rows", "cols"], meta_fields=["shape"])
@dataclass(eq=False)
class Sparse:
    """A matrix by its entries (nnz,) and their places; entries at one place add up. The values may be traced."""

    values: Any
    rows: np.ndarray
    cols: np.ndarray
    shape: tuple[int, int]

    @cached_property
    def host(self) -> Any:
        """The matrix for scipy, by rows."""
        with uncollected():
            from scipy import sparse

        return sparse.csr_array((np.asarray(self.values), (self.rows, self.cols)), shape=self.shape)

    @cached_property
    def host_transposed(self) -> Any:
        """Its transpose for scipy, by rows."""
        return self.host.T.tocsr()

    @cached_property
    def by_width(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rows (n,) that have w entries each, and which these are (n, w), for every w."""
        order = np.argsort(self.rows, kind="stable")
        counts = np.bincount(self.rows, minlength=self.shape[0])
        first = np.cumsum(counts) - counts
        alike = [(np.flatnonzero(counts == w), w) for w in np.unique(counts[counts > 0])]
        return [(some, order[first[some][:, None] + np.arange(w)]) for some, w in alike]

    def times(self, x: Any) -> Any:
        """The product with x (n,) or (n, m), by scipy or, where anything is traced, by JAX."""
        if not is_traced(self.values, x):
            return self.host @ np.asarray(x)
        if np.ndim(x) == 2:
            return _product(_Form(self.rows, self.cols, self.shape), self.values, x)
        return _times(self.values, self.rows, self.cols, jnp.asarray(x), self.shape[0])

    def with_values(self, values: Any) -> Sparse:
        """Others at the same places."""
        return Sparse(values, self.rows, self.cols, self.shape)

    def part(self, rows: np.ndarray, cols: np.ndarray) -> Sparse:
        """The submatrix of these rows and columns, each given once."""
        place = [np.full(n, -1) for n in self.shape]
        place[0][rows], place[1][cols] = np.arange(len(rows)), np.arange(len(cols))
        keep = np.flatnonzero((place[0][self.rows] >= 0) & (place[1][self.cols] >= 0))
        at = place[0][self.rows[keep]], place[1][self.cols[keep]]
        values = picked(self.values, keep) if is_traced(self.values) else self.values[keep]
        return Sparse(values, *at, (len(rows), len(cols)))


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
    return jax.device_put(Sparse(values, form.rows, form.cols, form.shape).host @ np.asarray(x))


def _product_forward(form: _Form, values: Any, x: Any) -> tuple[Any, Any]:
    return _product.fun(form, values, x), (values, x)  # itself, for second derivatives


def _product_backward(form: _Form, kept: Any, bar: Any) -> tuple[Any, Any]:
    values, x = kept
    if is_traced(kept, bar):
        _, back = jax.vjp(lambda v, y: _times(v, form.rows, form.cols, y, form.shape[0]), values, jnp.asarray(x))
        return back(bar)
    matrix, bar = Sparse(values, form.rows, form.cols, form.shape), np.asarray(bar)
    return jax.device_put((sampled(matrix, bar, np.asarray(x)), matrix.host_transposed @ bar))


_product.defvjp(_product_forward, _product_backward)


def sampled(matrix: Sparse, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The entries of left right^T, (n, m) and (k, m), at the places of a matrix."""
    out = np.empty(len(matrix.rows))
    for rows, entries in matrix.by_width:
        size = max(1, CHUNK // (entries.shape[1] * left.shape[1]))
        for k in range(0, len(rows), size):
            some = entries[k : k + size]
            out[some] = (right[matrix.cols[some]] @ left[rows[k : k + size], :, None])[..., 0]
    return out


def combined(parts: list[tuple[Any, Sparse]]) -> tuple[Any, np.ndarray, np.ndarray]:
    """Entries, rows and columns of a sum of factor * matrix."""
    xp = jnp if is_traced([(f, m.values) for f, m in parts]) else np
    values = xp.concatenate([f * xp.asarray(m.values) for f, m in parts])
    return values, np.concatenate([m.rows for _, m in parts]), np.concatenate([m.cols for _, m in parts])


def product(first: Sparse, second: Sparse) -> Sparse:
    """The product of two matrices; where JAX traces values, by all pairs of entries that meet."""
    shape = first.shape[0], second.shape[1]
    if not is_traced(first.values, second.values):
        whole = (first.host @ second.host).tocoo()
        rows, cols = (c.astype(int) for c in whole.coords)
        return Sparse(whole.data, rows, cols, shape)
    order = np.argsort(second.rows, kind="stable")
    counts = np.bincount(second.rows, minlength=second.shape[0])
    width, begin = counts[first.cols], (np.cumsum(counts) - counts)[first.cols]
    one = np.repeat(np.arange(len(first.cols)), width)
    two = order[np.arange(len(one)) - np.repeat(np.cumsum(width) - width, width) + begin[one]]
    at, place = np.unique(first.rows[one] * shape[1] + second.cols[two], return_inverse=True)
    values = jnp.zeros(len(at)).at[place].add(jnp.asarray(first.values)[one] * jnp.asarray(second.values)[two])
    return Sparse(values, at // shape[1], at % shape[1], shape)
