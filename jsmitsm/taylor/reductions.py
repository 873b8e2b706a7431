"""Primitives that sum, compare or multiply along axes, on Taylor series (L, *shape, B)."""

from __future__ import annotations

import string
from typing import Any

import numpy as np

from jsmitsm.taylor.elementwise import rule
from jsmitsm.taylor.series import Array, Ring, align, mul, on_host, unify, xp_of


def _axes(eqn: Any) -> tuple[int, ...]:
    return tuple(k + 1 for k in eqn.params["axes"])


@rule("reduce_sum")
def _reduce_sum(ring: Ring, eqn: Any, x: Array) -> Array:
    axes = _axes(eqn)
    return x.sum(axes, dtype=x.dtype) if axes else x


@rule("reduce_and", "reduce_or")
def _reduce_logical(ring: Ring, eqn: Any, x: Array) -> Array:
    return x.all(_axes(eqn)) if eqn.primitive.name == "reduce_and" else x.any(_axes(eqn))


def _flattened(x: Array, axes: tuple[int, ...]) -> Array:
    """The given axes as one, in place 1."""
    xp = xp_of(x)
    x = xp.moveaxis(x, axes, range(1, len(axes) + 1))
    return x.reshape(x.shape[0], -1, *x.shape[len(axes) + 1 :])


@rule("reduce_max", "reduce_min")
def _reduce_extreme(ring: Ring, eqn: Any, x: Array) -> Array:
    x = _flattened(x, _axes(eqn))
    xp = xp_of(x)
    best = (xp.argmax if eqn.primitive.name == "reduce_max" else xp.argmin)(x[:1], axis=1)
    return xp.take_along_axis(x, best[:, None], axis=1)[:, 0]


@rule("argmax", "argmin")
def _arg_extreme(ring: Ring, eqn: Any, x: Array) -> Array:
    x = _flattened(x[:1], _axes(eqn))
    xp = xp_of(x)
    return getattr(xp, eqn.primitive.name)(x, axis=1).astype(eqn.params["index_dtype"])


@rule("reduce_prod")
def _reduce_prod(ring: Ring, eqn: Any, x: Array) -> Array:
    x = _flattened(x, _axes(eqn))
    if x.shape[0] == 1:
        return x.prod(1)
    out = x[:, 0]
    for k in range(1, x.shape[1]):
        out = mul(ring, out, x[:, k])
    return out


@rule("cumsum")
def _cumsum(ring: Ring, eqn: Any, x: Array) -> Array:
    xp, axis = xp_of(x), eqn.params["axis"] + 1
    if eqn.params["reverse"]:
        return xp.flip(xp.flip(x, axis).cumsum(axis), axis)
    return x.cumsum(axis)


@rule("cumprod")
def _cumprod(ring: Ring, eqn: Any, x: Array) -> Array:
    xp, axis = xp_of(x), eqn.params["axis"] + 1
    x = xp.moveaxis(x, axis, 1)
    order = range(x.shape[1])
    parts: dict[int, Array] = {}
    last = None
    for k in reversed(order) if eqn.params["reverse"] else order:
        last = x[:, k] if last is None else mul(ring, last, x[:, k])
        parts[k] = last
    return xp.moveaxis(xp.stack(unify(*(parts[k] for k in order)), 1), 1, axis)


@rule("sort")
def _sort(ring: Ring, eqn: Any, *vals: Array) -> list[Array]:
    if eqn.params["num_keys"] != 1:
        raise ValueError("sorting by several keys is not supported in a pde; sort by one key")
    axis = eqn.params["dimension"] + 1
    vals = tuple(vals)
    batch = max(v.shape[-1] for v in vals)
    order = xp_of(vals[0]).argsort(vals[0][:1], axis=axis, stable=True)
    out = []
    for v in vals:
        xp = xp_of(v, order)
        v = xp.broadcast_to(v, (*v.shape[:-1], batch))
        out.append(xp.take_along_axis(v, xp.broadcast_to(order, (1, *v.shape[1:])), axis=axis))
    return out


@rule("dot_general")
def _dot_general(ring: Ring, eqn: Any, x: Array, y: Array) -> Array:
    (lc, rc), (lb, rb) = eqn.params["dimension_numbers"]
    letters = iter(string.ascii_lowercase)
    left = {int(k): next(letters) for k in range(x.ndim - 2)}
    right = {int(k): next(letters) for k in range(y.ndim - 2)}
    for i, j in zip((*lc, *lb), (*rc, *rb), strict=True):
        right[int(j)] = left[int(i)]
    batch = [left[int(k)] for k in lb]
    summed = [left[int(k)] for k in lc]
    free = [left[k] for k in left if left[k] not in batch + summed]
    free += [right[k] for k in right if right[k] not in batch + summed]
    out = "".join(batch + free)
    names = ["".join(left.values()), "".join(right.values())]
    if x.shape[0] > 1 and y.shape[0] > 1:
        return _series_dot(ring, x, y, names, out, summed)
    # One factor is independent of x: an ordinary product, one more axis for the coefficients.
    operands, batched = [x, y], False
    for k, v in enumerate(operands):
        if v.shape[0] > 1:
            names[k] = "L" + names[k]
        else:
            v = v[0]
        if v.shape[-1] > 1:
            names[k] += "Z"
            batched = True
        else:
            v = v[..., 0]
        operands[k] = v
    series = max(x.shape[0], y.shape[0]) > 1
    target = ("L" if series else "") + out + ("Z" if batched else "")
    value = xp_of(x, y).einsum(f"{names[0]},{names[1]}->{target}", *operands, optimize=x.size > 64 or y.size > 64)
    value = np.asarray(value) if on_host(x, y) else value
    value = value if series else value[None]
    return value if batched else value[..., None]


def _series_dot(ring: Ring, x: Array, y: Array, names: list[str], out: str, summed: list[str]) -> Array:
    """Both factors series: multiply out elementwise, then sum."""
    axes = out + "".join(summed)
    spread = []
    for v, name in zip((x, y), names, strict=True):
        order = sorted(range(len(name)), key=lambda k: axes.index(name[k]))
        v = v.transpose(0, *(k + 1 for k in order), v.ndim - 1)
        sizes = dict(zip((name[k] for k in order), v.shape[1:-1], strict=True))
        spread.append(v.reshape(v.shape[0], *(sizes.get(a, 1) for a in axes), v.shape[-1]))
    product = mul(ring, *align(*spread))
    return product.sum(tuple(range(1 + len(out), 1 + len(axes)))) if summed else product
