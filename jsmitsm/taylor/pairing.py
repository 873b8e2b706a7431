"""Sums over pairs of coefficients, out[r] = sum_m w[r, m] x[i[r, m]] y[j[r, m]], as one JAX primitive.

Products of series and both of their transposes have this form.  Left to itself, automatic
differentiation turns the gathers into scatters, which take several times as long to compile and run.
"""

from __future__ import annotations

from functools import cache, cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import ad, batching, mlir

from jsmitsm.runtime.jaxprs import Primitive
from jsmitsm.taylor.multi_indices import add, count, index_of, multi_indices

# Fewer pairs in a row than this are written out.
_WRITTEN_OUT = 3


class Pairs:
    """A fixed list of triples (r, i, j) with weights; compared by identity, so keep and share it."""

    def __init__(self, r: np.ndarray, i: np.ndarray, j: np.ndarray, w: np.ndarray, sizes: tuple[int, int, int]):
        self.r, self.i, self.j, self.w, self.sizes = r, i, j, w, sizes

    @cached_property
    def table(self) -> tuple[np.ndarray, ...]:
        """(i, j, w), each (rows, M), padded by weights of zero."""
        order = np.argsort(self.r, kind="stable")
        r = self.r[order]
        column = np.arange(len(r)) - np.searchsorted(r, r)
        shape = (self.sizes[0], int(column.max(initial=0)) + 1)
        out: tuple[np.ndarray, ...] = (np.zeros(shape, np.int32), np.zeros(shape, np.int32), np.zeros(shape))
        for table, values in zip(out, (self.i, self.j, self.w), strict=True):
            table[r, column] = values[order]
        return out

    @cached_property
    def by_first(self) -> Pairs:
        """x from (out, y): the transpose with respect to x."""
        n, a, b = self.sizes
        return Pairs(self.i, self.r, self.j, self.w, (a, n, b))

    @cached_property
    def by_second(self) -> Pairs:
        """y from (out, x)."""
        n, a, b = self.sizes
        return Pairs(self.j, self.r, self.i, self.w, (b, n, a))


@cache
def product(dim: int, left: int, right: int, low: int, high: int, first: int = 0, euler: bool = False) -> Pairs:
    """The coefficients of degree low..high of a product of series of degree ``left`` and ``right``.

    ``first``: only the left factor's terms of at least this degree; ``euler``: each times its degree.
    """
    start, place = count(dim, low - 1), index_of(dim, high)
    rows = []
    for i, a in enumerate(multi_indices(dim, left)):
        if sum(a) < first:
            continue
        for j, b in enumerate(multi_indices(dim, min(right, high - sum(a)))):
            r = place[add(a, b)] - start
            if r >= 0:
                rows.append((r, i, j, sum(a) if euler else 1))
    table = np.array(rows, int).reshape(-1, 4).T
    r, i, j, w = table[0], table[1], table[2], table[3].astype(float)
    return Pairs(r, i, j, w, (count(dim, high) - start, count(dim, left), count(dim, right)))


pairing_p = Primitive("pairing")


def pairing(x: Any, y: Any, pairs: Pairs) -> jax.Array:
    """The sum over the pairs; x (I, *rest) and y (J, *rest) to (rows, *rest), broadcasting ``rest``."""
    dtype = jnp.result_type(x, y)
    rest = np.broadcast_shapes(x.shape[1:], y.shape[1:])
    x, y = (jnp.broadcast_to(v, (v.shape[0], *rest)).astype(dtype) for v in (x, y))
    return pairing_p.bind(x, y, pairs=pairs)


def _sum(x: Any, y: Any, *, pairs: Pairs) -> jax.Array:
    i, j, w = pairs.table
    plain = bool((w == 1).all())

    def rows(v: Any, places: Any) -> Any:
        return v.at[places].get(mode="promise_in_bounds")

    def term(i: Any, j: Any, w: Any) -> Any:
        value = rows(x, i) * rows(y, j)
        return value if plain else value * w.reshape(-1, *(1,) * (x.ndim - 1)).astype(x.dtype)

    if i.shape[1] < _WRITTEN_OUT:
        return sum(term(i[:, m], j[:, m], w[:, m]) for m in range(i.shape[1]))
    # A loop over whole rows: contiguous reads, and a program that does not grow with the degree.
    tables = tuple(jnp.asarray(t.T) for t in (i, j, w))

    def add_one(total: Any, row: Any) -> tuple[Any, None]:
        return total + term(*row), None

    start = jnp.zeros((i.shape[0], *x.shape[1:]), x.dtype)
    return jax.lax.scan(add_one, start, tables)[0]


def _abstract(x: Any, y: Any, *, pairs: Pairs) -> Any:
    return jax.core.ShapedArray((pairs.sizes[0], *x.shape[1:]), x.dtype)


def _batch(args: Any, axes: Any, *, pairs: Pairs) -> tuple[Any, int]:
    """A mapped axis is one more axis of ``rest``."""
    size = next(a.shape[k] for a, k in zip(args, axes, strict=True) if k is not None)

    def move(a: Any, k: int | None) -> Any:
        if k is None:
            return jnp.broadcast_to(a[:, None], (a.shape[0], size, *a.shape[1:]))
        return jnp.moveaxis(a, k, 1)

    moved = map(move, args, axes)
    return pairing_p.bind(*moved, pairs=pairs), 1


pairing_p.def_impl(lambda x, y, *, pairs: jax.jit(_sum, static_argnames="pairs")(x, y, pairs=pairs))
pairing_p.def_abstract_eval(_abstract)
ad.defbilinear(
    pairing_p,
    lambda ct, x, y, *, pairs: pairing_p.bind(ct, y, pairs=pairs.by_first),
    lambda ct, x, y, *, pairs: pairing_p.bind(ct, x, pairs=pairs.by_second),
)
batching.primitive_batchers[pairing_p] = _batch
mlir.register_lowering(pairing_p, mlir.lower_fun(_sum, multiple_results=False))
