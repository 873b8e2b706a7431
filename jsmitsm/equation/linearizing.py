"""A residual as a jaxpr of the point, of one scalar per derivative, and its coefficients by AD."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.equation.elements import Elements
from jsmitsm.equation.field import Field, LocalField, field_p, frozen_p
from jsmitsm.equation.marks import DIFFERENTIATED
from jsmitsm.equation.unknowns.parts import parts
from jsmitsm.runtime.jaxprs import (
    EVERYTHING,
    Literal,
    bind,
    called,
    comes_up,
    inner_jaxprs,
    levels,
    literal,
    program,
    scan_sizes,
)
from jsmitsm.runtime.snapshot import snapshot
from jsmitsm.runtime.tracers import owned
from jsmitsm.taylor.elementwise import ELEMENTWISE
from jsmitsm.taylor.multi_indices import Slot

# What a value of the traced residual is to the point: the point itself, dependent on it, or not.
POINT, DEPENDENT, FREE = 2, 1, 0
# These forward a value when shape and dtype stay: the point stays the point.
_FORWARDING = frozenset(
    "copy copy_p reshape broadcast_in_dim convert_element_type squeeze transpose stop_gradient optimization_barrier "
    "name reduce_precision".split()
)
# Linear in all their operands together: the tangents go through the operation itself.
_LINEAR = frozenset(
    "neg sub add add_any reshape broadcast_in_dim squeeze expand_dims transpose slice rev reduce_sum concatenate stack "
    "tile pad convert_element_type copy copy_p cumsum".split()
)


def slots_of(jaxpr: Any) -> set[Slot]:
    """The derivatives of the fields a jaxpr asks for."""
    out: set[Slot] = set()
    for eqn in jaxpr.eqns:
        if eqn.primitive is field_p:
            out.add((eqn.params["field"], eqn.params["index"]))
        for inner in inner_jaxprs(eqn):
            out |= slots_of(inner)
    return out


def is_mark(eqn: Any) -> bool:
    """Whether an operation only names what an operator differentiates."""
    return eqn.primitive.name == "name" and eqn.params["name"].startswith(DIFFERENTIATED)


def check_points(jaxpr: Any, kinds: Sequence[int]) -> list[int]:
    """Raise where a field is taken away from x, or a factor treated as constant is none."""
    env: dict[Any, int] = dict.fromkeys(jaxpr.constvars, FREE)
    env.update(zip(jaxpr.invars, kinds, strict=True))

    def read(v: Any) -> int:
        return FREE if isinstance(v, Literal) else env[v]

    for eqn in jaxpr.eqns:
        kinds = [read(v) for v in eqn.invars]
        name = eqn.primitive.name
        if eqn.primitive is field_p and kinds != [POINT]:
            raise ValueError(
                "the field u, or a derivative of it, was evaluated at a point other than x; a pde sees the field only "
                "at its own point: write u(x) and js.grad(u)(x) with the x the function receives, and compose "
                "operators as js.divergence(lambda y: a(y) * js.grad(u)(y))(x)"
            )
        if eqn.primitive is frozen_p and kinds != [FREE]:
            raise ValueError(
                "a derivative of (factor * field) was taken with a factor that depends on x, which would be treated "
                "as constant; write the product as a function: js.divergence(lambda y: a(y) * js.grad(u)(y))(x)"
            )
        out = [DEPENDENT if eqn.primitive is field_p or any(kinds) else FREE] * len(eqn.outvars)
        inner = called(eqn)
        if inner is not None:
            out = check_points(inner.jaxpr, kinds[len(kinds) - len(inner.jaxpr.invars) :])
        elif name == "custom_jvp_call":
            out = check_points(eqn.params["call_jaxpr"].jaxpr, kinds)
        elif name in _FORWARDING and kinds[0] == POINT:
            same = eqn.outvars[0].aval.shape == eqn.invars[0].aval.shape
            out = [POINT if same and eqn.outvars[0].aval.dtype == eqn.invars[0].aval.dtype else DEPENDENT]
            if name == "transpose" and eqn.params["permutation"] != (0,):
                out = [DEPENDENT]
        elif any(slots_of(j) for j in inner_jaxprs(eqn)):
            _check_control(eqn, kinds)
            out = [DEPENDENT] * len(eqn.outvars)
        env.update(zip(eqn.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _check_control(eqn: Any, kinds: list[int]) -> None:
    """A loop or a branch that asks for the field: what its state depends on is not followed."""
    p, name = eqn.params, eqn.primitive.name

    def loose(some: list[int]) -> list[int]:
        return [min(k, DEPENDENT) for k in some]

    if name == "scan":
        n, _ = scan_sizes(p)
        check_points(p["jaxpr"].jaxpr, kinds[:n] + loose(kinds[n:]))
    elif name == "while":
        n, m = p["cond_nconsts"], p["body_nconsts"]
        check_points(p["cond_jaxpr"].jaxpr, kinds[:n] + loose(kinds[n + m :]))
        check_points(p["body_jaxpr"].jaxpr, kinds[n : n + m] + loose(kinds[n + m :]))
    elif name == "cond":
        for branch in p["branches"]:
            check_points(branch.jaxpr, kinds[1:])
    else:
        raise ValueError(
            f"the field u was used inside the primitive '{name}', which cannot be opened; evaluate u(x) outside of it"
        )


def open_fields(jaxpr: Any, consts: Sequence[Any], args: Sequence[Any], slots: dict[Slot, Any]) -> list[Any]:
    """Perform a jaxpr with its calls opened and the fields' derivatives taken from ``slots``.

    Equal operations are performed once: nested derivatives repeat the same values many times.
    """

    def walk(jaxpr: Any, consts: Sequence[Any], args: Sequence[Any], perform: Elements) -> list[Any]:
        env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))

        def read(v: Any) -> Any:
            return literal(v) if isinstance(v, Literal) else env[v]

        for eqn, _ in levels(jaxpr, [EVERYTHING] * len(jaxpr.outvars)):
            vals = [read(v) for v in eqn.invars]
            inner = called(eqn)
            if eqn.primitive is field_p:
                out = [slots[eqn.params["field"], eqn.params["index"]]]
            elif eqn.primitive is frozen_p or is_mark(eqn):
                out = vals
            elif inner is not None:
                out = walk(inner.jaxpr, inner.consts, vals[len(vals) - len(inner.jaxpr.invars) :], perform)
            elif any(slots_of(j) for j in inner_jaxprs(eqn)):
                out = control(eqn, [perform.whole(v) for v in vals], performed)
            else:
                out = perform(eqn, vals)
            env.update(zip(eqn.outvars, out, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def performed(jaxpr: Any, consts: Sequence[Any], args: Sequence[Any]) -> list[Any]:
        perform = Elements()
        return [perform.whole(v) for v in walk(jaxpr, consts, args, perform)]

    return performed(jaxpr, consts, args)


def control(eqn: Any, vals: list[Any], walk: Callable[..., list[Any]]) -> list[Any]:
    """A loop or branch whose body asks for the fields: they reach it by closure.

    walk: performs a jaxpr, given with its constants and arguments.
    """
    p, name = eqn.params, eqn.primitive.name
    if name == "custom_jvp_call":
        return walk(p["call_jaxpr"].jaxpr, p["call_jaxpr"].consts, vals)
    if name == "cond":
        branches = [lambda operands, b=b: walk(b.jaxpr, b.consts, operands) for b in p["branches"]]
        return jax.lax.switch(vals[0], branches, vals[1:])
    if name == "scan":
        n, m = scan_sizes(p)
        body = p["jaxpr"]

        def step(carry: Any, row: Any) -> tuple[Any, Any]:
            out = walk(body.jaxpr, body.consts, [*vals[:n], *carry, *row])
            return out[:m], out[m:]

        carry, ys = jax.lax.scan(step, vals[n : n + m], vals[n + m :], p["length"], p["reverse"])
        return [*carry, *ys]
    n, m = p["cond_nconsts"], p["body_nconsts"]
    test, body = p["cond_jaxpr"], p["body_jaxpr"]
    return list(jax.lax.while_loop(
        lambda state: walk(test.jaxpr, test.consts, [*vals[:n], *state])[0],
        lambda state: walk(body.jaxpr, body.consts, [*vals[n:n + m], *state]),
        vals[n + m:],
    ))  # fmt: skip


def tangents_of(
    jaxpr: Any, consts: Sequence[Any], args: Sequence[Any], seeds: dict[int, Any]
) -> tuple[list[Any], list[dict[int, Any]]]:
    """Results of a flat jaxpr and their derivatives with respect to some scalar inputs.

    ``seeds``: input position -> tangent.  The derivatives are dictionaries by input position: an
    input that does not reach a result is absent, and costs nothing.
    """
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))
    slopes: dict[Any, dict[int, Any]] = {jaxpr.invars[k]: {k: one} for k, one in seeds.items()}

    def read(v: Any) -> Any:
        return literal(v) if isinstance(v, Literal) else env[v]

    for eqn, _ in levels(jaxpr, [EVERYTHING] * len(jaxpr.outvars)):
        vals = [read(v) for v in eqn.invars]
        out = bind(eqn, *vals)
        env.update(zip(eqn.outvars, out, strict=True))
        moving = [{} if isinstance(v, Literal) else slopes.get(v, {}) for v in eqn.invars]
        if not any(moving):
            continue
        result: list[dict[int, Any]] = [{} for _ in out]
        factors: dict[int, Any] = {}
        for seed in sorted(set().union(*moving)):
            slope = _slope(eqn, vals, out, [m.get(seed) for m in moving], factors)
            for target, t in zip(result, slope, strict=True):
                if t is not None:
                    target[seed] = t
        slopes.update(zip(eqn.outvars, result, strict=True))
    return [read(v) for v in jaxpr.outvars], [
        {} if isinstance(v, Literal) else slopes.get(v, {}) for v in jaxpr.outvars
    ]


def _slope(eqn: Any, vals: list[Any], out: list[Any], slopes: list[Any], factors: dict[int, Any]) -> list[Any]:
    """The tangents of one operation; None stands for zero.

    ``factors`` keeps an elementwise operation's partial derivatives for the next seed.
    """
    name = eqn.primitive.name
    exact = [not np.issubdtype(v.aval.dtype, np.inexact) for v in eqn.outvars]
    if all(exact) or name == "stop_gradient":
        return [None] * len(out)
    if name in _LINEAR and all(np.issubdtype(v.aval.dtype, np.inexact) for v in eqn.invars):
        if name in ("add", "add_any", "sub"):
            x, y = slopes
            if y is None:
                if np.shape(x) == out[0].shape:
                    return [x]
            elif x is None:
                if np.shape(y) == out[0].shape:
                    return [y if name != "sub" else jax.lax.neg(_array(y))]
            elif np.shape(x) == np.shape(y):
                return bind(eqn, x, y)
        else:
            full = [np.zeros(np.shape(v), v.dtype) if t is None else t for v, t in zip(vals, slopes, strict=True)]
            return bind(eqn, *full)
    if name == "mul":
        (x, y), (dx, dy) = vals, slopes
        parts = [_times(eqn, t, v, out) for t, v in ((dx, y), (dy, x)) if t is not None]
        return [functools.reduce(jax.lax.add, map(_array, parts))]
    if name == "div" and slopes[1] is None and np.shape(slopes[0]) == np.shape(vals[1]) == out[0].shape:
        return [jax.lax.div(_array(slopes[0]), _array(vals[1]))]
    active = [k for k, t in enumerate(slopes) if t is not None]
    if name in ELEMENTWISE and all(np.shape(vals[k]) == out[0].shape for k in active):
        parts = []
        for k in active:
            if k not in factors:
                (factors[k],) = _jvp(eqn, vals, [k], [np.ones(np.shape(vals[k]), vals[k].dtype)])
            parts.append(jax.lax.mul(_array(slopes[k]), _array(factors[k])))
        return [functools.reduce(jax.lax.add, map(_array, parts))]
    new = _jvp(eqn, vals, active, [slopes[k] for k in active])
    return [None if skip else t for t, skip in zip(new, exact, strict=True)]


def _jvp(eqn: Any, vals: list[Any], active: list[int], slopes: list[Any]) -> list[Any]:
    """The operation's own derivative rule, along the operands ``active``."""

    def some(*chosen: Any) -> list[Any]:
        full = list(vals)
        for k, v in zip(active, chosen, strict=True):
            full[k] = v
        return bind(eqn, *full)

    return jax.jvp(some, tuple(_array(vals[k]) for k in active), tuple(map(_array, slopes)))[1]


def _array(value: Any) -> Any:
    return value if isinstance(value, jax.Array | np.ndarray) else np.asarray(value)


def _times(eqn: Any, slope: Any, value: Any, out: list[Any]) -> Any:
    """A product, without the multiplication by a seed of one."""
    if np.shape(value) == out[0].shape and isinstance(slope, np.ndarray) and slope.ndim == 0 and slope == 1:
        return value
    return bind(eqn, slope, value)[0]


class Record(NamedTuple):
    """A residual as a jaxpr.

    Inputs: the point, the slots, the extras, the leaves of the parameters, the constants.  Outputs:
    the residual (E,), then the coefficients (E,) named by ``outputs`` (None: zero).
    """

    jaxpr: Any
    consts: tuple[Any, ...]
    slots: tuple[Slot, ...]
    outputs: tuple[int | None, ...]
    n_equations: int
    written: Any  # the residual as it was written, with its fields and calls: inputs but for the slots


def record(
    residual: Callable[..., Any], field: Field | LocalField, extras: Sequence[tuple[int, ...]], params: Any
) -> Record:
    """Trace a residual once, and its derivatives with respect to every slot."""
    dtype = jnp.result_type(float)
    point = jax.ShapeDtypeStruct((field.dim,), dtype)
    others = [jax.ShapeDtypeStruct(tuple(shape), dtype) for shape in extras]
    def written(x: Any, e: Any, p: Any) -> jax.Array:
        return _values(residual(field, x, *e, *(() if params is None else (p,))), dtype)

    first, _ = snapshot(written, point, others, params)
    if comes_up(first.jaxpr, np.complexfloating):  # within, they are followed as pairs of real numbers
        first, _ = snapshot(lambda *a: parts(written, *a)[0], point, others, params)
    flat = program(first)
    check_points(flat, [POINT] + [FREE] * (len(flat.invars) - 1))
    needed = [eqn for eqn, _ in levels(flat, [EVERYTHING])]
    slots = set()
    for eqn in needed:
        if eqn.primitive is field_p:
            slots.add((eqn.params["field"], eqn.params["index"]))
        for inner in inner_jaxprs(eqn):
            slots |= slots_of(inner)
    ordered = tuple(sorted(slots, key=_grade))
    scalars = [jax.ShapeDtypeStruct((), dtype)] * len(ordered)
    rest, consts = [_shaped(v) for v in flat.invars[1:]], [_shaped(v) for v in flat.constvars]
    second = jax.make_jaxpr(lambda x, s, r, c: open_fields(flat, c, [x, *r], dict(zip(ordered, s, strict=True))))(
        point, scalars, rest, consts
    )
    outputs: list[int | None] = []

    def derivatives(*args: Any) -> list[Any]:
        seeds = {1 + k: np.ones((), dtype) for k in range(len(ordered))}
        (value,), (slopes,) = tangents_of(second.jaxpr, second.consts, args, seeds)
        found: list[Any] = []
        for k in range(len(ordered)):
            slope = slopes.get(1 + k)
            outputs.append(None if slope is None else 1 + len(found))
            if slope is not None:
                found.append(slope)
        return [value, *found]

    third = jax.make_jaxpr(derivatives)(*map(_shaped, second.jaxpr.invars))
    # The constants of the first trace are the last inputs of the third; make them constants again.
    made = program(third, last=len(flat.constvars))
    kept = tuple(map(owned, (*third.consts, *first.consts)))  # the user may change the arrays in place
    return Record(made, kept, ordered, tuple(outputs), flat.outvars[0].aval.shape[0], flat)


def _shaped(v: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype)


def _grade(slot: Slot) -> tuple[Any, ...]:
    """Graded order, inside a degree descending in the first axis; fields last."""
    k, index = slot
    return sum(index), tuple(-i for i in index), k


def _values(out: Any, dtype: Any) -> jax.Array:
    """The residual as a vector (E,)."""
    if isinstance(out, Field | LocalField):
        raise ValueError("the residual is a field, not its value: evaluate it at the point, as in js.laplacian(u)(x)")
    if out is None:
        raise ValueError("the residual function returned None; it must return a scalar or a vector")
    if isinstance(out, list | tuple):
        if any(isinstance(v, Field | LocalField) for v in out):
            raise ValueError("the residual holds a field, not its value: evaluate it at the point, as in u(x)")
        if any(np.ndim(v) != 0 for v in out):
            raise ValueError(f"the residual's entries must be scalars, got shapes {[np.shape(v) for v in out]}")
        out = jnp.stack([jnp.asarray(v, dtype) for v in out]) if out else jnp.zeros(0, dtype)
    out = jnp.asarray(out)
    if out.ndim > 1 or out.size == 0:
        raise ValueError(
            f"the residual must be a scalar or a vector with one entry per equation, got shape {out.shape}; "
            "did an operator or x keep an axis? (js.grad(u)(x) is a vector, js.laplacian(u)(x) a scalar)"
        )
    if not np.issubdtype(out.dtype, np.floating) and not np.issubdtype(out.dtype, np.integer):
        raise ValueError(f"the residual must be real, got dtype {out.dtype}; take js.Problem(..., dtype=complex)")
    return out.astype(dtype).reshape(-1)
