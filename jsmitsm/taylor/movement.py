"""Primitives that move or select array elements, on Taylor series (L, *shape, B)."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.taylor.elementwise import rule
from jsmitsm.taylor.series import Array, Ring, choose, on_host, pad_to, take, unify, xp_of


def _shape(eqn: Any) -> tuple[int, ...]:
    return tuple(eqn.outvars[0].aval.shape)


@rule("reshape", "squeeze", "expand_dims")
def _reshape(ring: Ring, eqn: Any, x: Array) -> Array:
    return x.reshape(x.shape[0], *_shape(eqn), x.shape[-1])


@rule("broadcast_in_dim")
def _broadcast_in_dim(ring: Ring, eqn: Any, x: Array) -> Array:
    shape, axes = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    spread = [1] * len(shape)
    for size, axis in zip(x.shape[1:-1], axes, strict=True):
        spread[axis] = size
    x = x.reshape(x.shape[0], *spread, x.shape[-1])
    return xp_of(x).broadcast_to(x, (x.shape[0], *shape, x.shape[-1]))


@rule("tile")
def _tile(ring: Ring, eqn: Any, x: Array) -> Array:
    return xp_of(x).tile(x, (1, *eqn.params["reps"], 1))


@rule("transpose")
def _transpose(ring: Ring, eqn: Any, x: Array) -> Array:
    axes = [k + 1 for k in eqn.params["permutation"]]
    return x.transpose(0, *axes, x.ndim - 1)


@rule("rev")
def _rev(ring: Ring, eqn: Any, x: Array) -> Array:
    return xp_of(x).flip(x, [k + 1 for k in eqn.params["dimensions"]])


@rule("slice")
def _slice(ring: Ring, eqn: Any, x: Array) -> Array:
    p = eqn.params
    strides = p["strides"] or (1,) * len(p["start_indices"])
    cuts = map(slice, p["start_indices"], p["limit_indices"], strides)
    return x[(slice(None), *cuts)]


@rule("split")
def _split(ring: Ring, eqn: Any, x: Array) -> list[Array]:
    edges = np.cumsum(eqn.params["sizes"])[:-1].tolist()
    return list(xp_of(x).split(x, edges, axis=eqn.params["axis"] + 1))


@rule("concatenate")
def _concatenate(ring: Ring, eqn: Any, *vals: Array) -> Array:
    vals = tuple(unify(*vals))
    return xp_of(*vals).concatenate(vals, axis=eqn.params["dimension"] + 1)


@rule("stack")
def _stack(ring: Ring, eqn: Any, *vals: Array) -> Array:
    vals = tuple(unify(*vals))
    return xp_of(*vals).stack(vals, axis=eqn.params["axis"] + 1)


@rule("unstack")
def _unstack(ring: Ring, eqn: Any, x: Array) -> list[Array]:
    axis = eqn.params["axis"] + 1
    return [x[(slice(None),) * axis + (k,)] for k in range(x.shape[axis])]


@rule("iota")
def _iota(ring: Ring, eqn: Any) -> Array:
    shape, axis = eqn.params["shape"], eqn.params["dimension"]
    line = np.arange(shape[axis], dtype=eqn.params["dtype"])
    line = line.reshape([-1 if k == axis else 1 for k in range(len(shape))])
    return np.broadcast_to(line, shape)[None, ..., None]


def _pool(*vals: Array) -> tuple[Array, list[int]]:
    """Several arrays as one flat one, and where each begins."""
    flat = unify(*(v.reshape(v.shape[0], -1, v.shape[-1]) for v in vals))
    starts = np.cumsum([0] + [f.shape[1] for f in flat])
    return xp_of(*flat).concatenate(flat, axis=1), starts.tolist()


@rule("pad")
def _pad(ring: Ring, eqn: Any, x: Array, value: Array) -> Array:
    shape, source, target = _shape(eqn), [slice(None)], [slice(None)]
    for size, whole, (low, _, inner) in zip(x.shape[1:-1], shape, eqn.params["padding_config"], strict=True):
        step = inner + 1
        first, end = max(0, -(low // step)), min(size, -(-(whole - low) // step))  # those that come to lie within
        source.append(slice(first, max(first, end)))
        target.append(slice(low + first * step, max(low + end * step - inner, low + first * step), step))
    batch = max(x.shape[-1], value.shape[-1])
    terms = max(x.shape[0], value.shape[0])
    value = value.reshape(value.shape[0], *(1,) * len(shape), value.shape[-1])
    if on_host(x, value):
        out = np.zeros((terms, *shape, batch), x.dtype)
        out[: len(value)] = value
        out[tuple(target)] = pad_to(x, terms)[tuple(source)]
        return out
    every = jnp.broadcast_to(pad_to(value, terms), (terms, *shape, batch))
    return jnp.asarray(every).at[tuple(target)].set(pad_to(x, terms)[tuple(source)])


def _strides(shape: tuple[int, ...]) -> list[int]:
    return [math.prod(shape[k + 1 :]) for k in range(len(shape))]


def _along(values: Array, axis: int, rank: int) -> Array:
    """(n,) or (n, B) numbers as an array varying along one of ``rank`` axes, particles last."""
    values = values[:, None] if values.ndim == 1 else values
    return values.reshape(*(values.shape[0] if k == axis else 1 for k in range(rank)), values.shape[-1])


@rule("dynamic_slice")
def _dynamic_slice(ring: Ring, eqn: Any, x: Array, *starts: Array) -> Array:
    shape, sizes = x.shape[1:-1], eqn.params["slice_sizes"]
    places: Any = np.zeros((*sizes, 1), int)
    for axis, (start, size, stride) in enumerate(zip(starts, sizes, _strides(shape), strict=True)):
        first = xp_of(start).clip(start[0], 0, shape[axis] - size)  # (B,)
        places = places + _along((first[None] + np.arange(size)[:, None]) * stride, axis, len(sizes))
    return take(x, places)


@rule("dynamic_update_slice")
def _dynamic_update_slice(ring: Ring, eqn: Any, x: Array, update: Array, *starts: Array) -> Array:
    shape, sizes = x.shape[1:-1], update.shape[1:-1]
    pool, (_, offset, _) = _pool(x, update)
    inside: Any = np.ones((1,) * len(shape) + (1,), bool)
    places: Any = offset
    for axis, (start, stride) in enumerate(zip(starts, _strides(sizes), strict=True)):
        first = xp_of(start).clip(start[0], 0, shape[axis] - sizes[axis])
        at = np.arange(shape[axis])[:, None] - first[None]
        inside = inside & _along((at >= 0) & (at < sizes[axis]), axis, len(shape))
        places = places + _along(at * stride, axis, len(shape))
    own = np.arange(offset).reshape(*shape, 1)
    return take(pool, xp_of(*(inside,) if on_host(inside) else (inside, places)).where(inside, places, own))


def _gather_places(
    shape: tuple[int, ...],
    out_rank: int,
    indices: Array,
    offset_dims: Any,
    collapsed: Any,
    index_map: Any,
    batching: Any,
    index_batching: Any,
    sizes: Any,
    clip: bool,
) -> tuple[Array, Array]:
    """Flat source places (*out, B) of a gather, and which of them lie inside the operand."""
    indices = indices[0]  # (*batch, K, B)
    batch_axes = [k for k in range(out_rank) if k not in offset_dims]
    windows = [k for k in range(len(shape)) if k not in collapsed and k not in batching]

    def spread(values: Array) -> Array:
        """(*batch, B) over the batch axes of the output."""
        full = [1] * out_rank
        for axis, size in zip(batch_axes, values.shape[:-1], strict=True):
            full[axis] = size
        return values.reshape(*full, values.shape[-1])

    places: Any = 0
    valid: Any = np.ones((1,) * (out_rank + 1), bool)
    for d, stride in enumerate(_strides(shape)):
        at: Any = np.zeros((1,) * (out_rank + 1), int)
        if d in index_map:
            first = indices[..., index_map.index(d), :]
            bound = shape[d] - sizes[d]
            inside = (first >= 0) & (first <= bound)
            valid = valid & spread(inside)
            at = at + spread(xp_of(first).clip(first, 0, bound))
        if d in batching:
            axis = index_batching[batching.index(d)]
            line = np.arange(shape[d]).reshape([-1 if k == axis else 1 for k in range(indices.ndim - 2)] + [1])
            at = at + spread(np.broadcast_to(line, (*indices.shape[:-2], 1)))
        if d in windows:
            at = at + _along(np.arange(sizes[d]), offset_dims[windows.index(d)], out_rank)
        places = places + at * stride
    return places, (np.ones_like(valid) if clip and on_host(valid) else valid | clip)


@rule("gather")
def _gather(ring: Ring, eqn: Any, x: Array, indices: Array) -> Array:
    p, shape = eqn.params, _shape(eqn)
    dims = p["dimension_numbers"]
    mode = str(p["mode"])
    places, valid = _gather_places(
        x.shape[1:-1], len(shape), indices,
        tuple(map(int, dims.offset_dims)), tuple(map(int, dims.collapsed_slice_dims)),
        tuple(map(int, dims.start_index_map)), tuple(map(int, dims.operand_batching_dims)),
        tuple(map(int, dims.start_indices_batching_dims)), p["slice_sizes"], "FILL" not in mode,
    )  # fmt: skip
    places = xp_of(places).broadcast_to(places, (*shape, places.shape[-1]))
    out = take(x, places)
    if on_host(valid) and valid.all():
        return out
    filler = p["fill_value"]
    if filler is None:
        filler = np.nan if np.issubdtype(x.dtype, np.inexact) else np.iinfo(x.dtype).min
    return choose(valid[None], out, np.full((1,) * out.ndim, filler, x.dtype))


@rule("scatter", "scatter-add", "scatter_add")
def _scatter(ring: Ring, eqn: Any, x: Array, indices: Array, updates: Array) -> Array:
    p = eqn.params
    dims = p["dimension_numbers"]
    if not (on_host(indices) and indices.shape[-1] == 1):
        raise ValueError(
            "an indexed update (x.at[i].set or .add) whose index depends on the point or on a traced value is not "
            "supported in a pde; write it with jnp.where"
        )
    inserted, batching = tuple(map(int, dims.inserted_window_dims)), tuple(map(int, dims.operand_batching_dims))
    shape, out = x.shape[1:-1], updates.shape[1:-1]
    windows = iter([out[k] for k in dims.update_window_dims])
    sizes = [1 if k in inserted or k in batching else next(windows) for k in range(len(shape))]
    places, valid = _gather_places(
        shape, len(out), indices, tuple(map(int, dims.update_window_dims)), inserted,
        tuple(map(int, dims.scatter_dims_to_operand_dims)), batching,
        tuple(map(int, dims.scatter_indices_batching_dims)), sizes, "CLIP" in str(p["mode"]),
    )  # fmt: skip
    keep = np.broadcast_to(valid, (*out, 1)).ravel()
    places = np.broadcast_to(places, (*out, 1)).ravel()[keep]
    flat, new = unify(x.reshape(x.shape[0], -1, x.shape[-1]), updates.reshape(updates.shape[0], -1, updates.shape[-1]))
    new = new[:, keep]
    if on_host(flat, new):
        flat = flat.copy()
        if eqn.primitive.name == "scatter":
            flat[:, places] = new
        else:
            for k, place in enumerate(places):
                flat[:, place] += new[:, k]
    else:
        at = jnp.asarray(flat).at[:, places]
        flat = at.set(new) if eqn.primitive.name == "scatter" else at.add(new)
    return flat.reshape(flat.shape[0], *shape, flat.shape[-1])


@rule("select_n")
def _select_n(ring: Ring, eqn: Any, which: Array, *cases: Array) -> Array:
    which = which[:1]
    if on_host(which) and which.size == 1:
        return cases[int(which.flat[0])]
    if which.dtype == bool:
        return choose(which, cases[1], cases[0])
    out = cases[0]
    for k, case in enumerate(cases[1:], 1):
        out = choose(which == k, case, out)
    return out


MOVEMENT = frozenset(
    "reshape squeeze expand_dims broadcast_in_dim tile transpose rev slice split concatenate stack unstack pad "
    "dynamic_slice dynamic_update_slice gather copy copy_p reduce_precision optimization_barrier name".split()
)
