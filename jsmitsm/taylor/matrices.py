"""Small dense linear algebra on Taylor series: the factorisations run in series arithmetic itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.taylor.elementwise import rule
from jsmitsm.taylor.series import Array, Ring, add, div, mul, power, unify, xp_of

# The matrix axes are -3 and -2, the particles' axis is -1.


def _join(parts: list[Array], axis: int) -> Array:
    parts = unify(*parts)
    return xp_of(*parts).concatenate(parts, axis=axis)


def _sub(x: Array, y: Array) -> Array:
    return add(x, -y)


def factor_lu(ring: Ring, a: Array) -> tuple[Array, Array, Array]:
    """LU with partial pivoting by the constant terms: (lu, pivots, permutation)."""
    n = a.shape[-2]
    xp = xp_of(a)
    batch = a.shape[1:-3]
    column = np.arange(n).reshape(n, 1)
    permutation = xp.broadcast_to(column, (*batch, n, a.shape[-1]))
    pivots = []
    for k in range(n):
        best = xp.argmax(xp.abs(a[0, ..., k:, k, :]), axis=-2) + k  # (*batch, B)
        pivots.append(best)
        best = best[..., None, :]
        swap = xp.where(column == k, best, xp.where(column == best, k, column))
        permutation = xp.take_along_axis(permutation, swap, axis=-2)
        rows = xp.broadcast_to(swap[None, ..., None, :], (1, *a.shape[1:]))
        a = xp.take_along_axis(a, rows, axis=-3)
        if k + 1 < n:
            factor = div(ring, a[..., k + 1 :, k : k + 1, :], a[..., k : k + 1, k : k + 1, :])
            rest = _sub(a[..., k + 1 :, k + 1 :, :], mul(ring, factor, a[..., k : k + 1, k + 1 :, :]))
            lower = _join([a[..., k + 1 :, :k, :], factor, rest], -2)
            a = _join([a[..., : k + 1, :, :], lower], -3)
    return a, xp.stack(pivots, -2), permutation


@rule("lu")
def _lu(ring: Ring, eqn: Any, a: Array) -> list[Array]:
    if a.shape[-3] != a.shape[-2]:
        raise ValueError(f"an LU factorisation in a pde must be of a square matrix, got shape {a.shape[1:-1]}")
    lu, pivots, permutation = factor_lu(ring, a)
    return [lu, pivots[None].astype(np.int32), permutation[None].astype(np.int32)]


@rule("lu_pivots_to_permutation")
def _permutation(ring: Ring, eqn: Any, pivots: Array) -> Array:
    xp = xp_of(pivots)
    n = eqn.params["permutation_size"]
    column = np.arange(n).reshape(n, 1)
    out = xp.broadcast_to(column, (*pivots.shape[1:-2], n, pivots.shape[-1]))
    for k in range(pivots.shape[-2]):
        best = pivots[0, ..., k : k + 1, :]
        out = xp.take_along_axis(out, xp.where(column == k, best, xp.where(column == best, k, column)), axis=-2)
    return out[None].astype(np.int32)


@rule("cholesky")
def _cholesky(ring: Ring, eqn: Any, a: Array) -> Array:
    n = a.shape[-2]
    columns: list[Array] = []
    for j in range(n):
        v = a[..., j:, j, :]
        for c in columns:
            v = _sub(v, mul(ring, c[..., j:, :], c[..., j : j + 1, :]))
        pivot = v[..., :1, :]
        start = xp_of(v).sqrt(pivot[:1])
        half = np.full((1,) * v.ndim, 0.5, v.dtype)
        root = start if pivot.shape[0] == 1 else power(ring, pivot, half, start)
        column = div(ring, v, root)
        zero = np.zeros((1, *column.shape[1:-2], j, column.shape[-1]), column.dtype)
        columns.append(_join([zero, column], -2) if j else column)
    columns = unify(*columns)
    return xp_of(*columns).stack(columns, -2)


@rule("triangular_solve")
def _triangular_solve(ring: Ring, eqn: Any, a: Array, b: Array) -> Array:
    p = eqn.params
    transposed, lower = p["transpose_a"], p["lower"]
    if not p["left_side"]:  # X A = B is A^T X^T = B^T
        b, transposed = b.swapaxes(-3, -2), not transposed
    if transposed:
        a, lower = a.swapaxes(-3, -2), not lower
    n = a.shape[-2]
    rows: dict[int, Array] = {}
    for i in range(n) if lower else reversed(range(n)):
        r = b[..., i, :, :]
        for j, x in rows.items():
            r = _sub(r, mul(ring, a[..., i, j, None, :], x))
        rows[i] = r if p["unit_diagonal"] else div(ring, r, a[..., i, i, None, :])
    parts = unify(*(rows[i] for i in range(n)))
    out = xp_of(*parts).stack(parts, -3)
    return out if p["left_side"] else out.swapaxes(-3, -2)
