"""What every element of a traced residual depends on, read off the jaxpr and never sampled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jsmitsm.runtime.jaxprs import DISCRETE, Literal, called, literal, scan_sizes
from jsmitsm.taylor.elementwise import ELEMENTWISE, RULES
from jsmitsm.taylor.movement import MOVEMENT
from jsmitsm.taylor.series import Ring

# What an element may depend on.  JUMPS: on the unknown field through something that has no useful
# derivative (a comparison, a sign, floor), so that the residual is not linear in it.
POINT, EXTRAS, FIELD, JUMPS = 1, 2, 4, 8
# A loop with more steps than this is taken as one operation.
UNROLL = 64
_PLAIN = Ring(1, 0)


class Facts(NamedTuple):
    """Per element: its value where that is known, whether it is, and what it depends on."""

    value: np.ndarray
    known: np.ndarray
    depends: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        return self.depends.shape


def known(value: Any) -> Facts:
    value = np.asarray(value)
    return Facts(value, np.ones(value.shape, bool), np.zeros(value.shape, np.uint8))


def unknown(shape: tuple[int, ...], dtype: Any, depends: int | np.ndarray = 0) -> Facts:
    dependence = np.broadcast_to(np.asarray(depends, np.uint8), shape)
    return Facts(np.zeros(shape, dtype), np.zeros(shape, bool), dependence)


def _host(eqn: Any, values: Sequence[np.ndarray]) -> list[np.ndarray] | None:
    """The operation itself on known values, where a rule can do it with numpy."""
    name = eqn.primitive.name
    arrays = [v.reshape(1, *v.shape, 1) for v in values]
    if name not in RULES:
        return None
    with np.errstate(all="ignore"):
        out = RULES[name](_PLAIN, eqn, *arrays)
    outs = out if eqn.primitive.multiple_results else [out]
    return [np.broadcast_to(o[0, ..., 0], v.aval.shape) for o, v in zip(outs, eqn.outvars, strict=True)]


def interpret(jaxpr: Any, consts: Sequence[Facts], args: Sequence[Facts]) -> list[Facts]:
    """Facts about the outputs of a jaxpr from facts about its inputs."""
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))

    def read(v: Any) -> Facts:
        return known(literal(v)) if isinstance(v, Literal) else env[v]

    for eqn in jaxpr.eqns:
        env.update(zip(eqn.outvars, facts_of(eqn, [read(v) for v in eqn.invars]), strict=True))
    return [read(v) for v in jaxpr.outvars]


def facts_of(eqn: Any, facts: list[Facts]) -> list[Facts]:
    """Facts about the results of one operation."""
    name = eqn.primitive.name
    inner = called(eqn)
    if inner is not None:
        args = facts[len(facts) - len(inner.jaxpr.invars) :]
        return interpret(inner.jaxpr, [constant(c) for c in inner.consts], args)
    if all(f.known.all() for f in facts):
        out = _host(eqn, [f.value for f in facts])
        if out is not None:
            return [known(o) for o in out]
    if name in SPECIAL:
        result = SPECIAL[name](eqn, facts)
        if result is not None:
            return result
    if name in MOVEMENT:
        moved = _move(eqn, facts)
        if moved is not None:
            return moved
    if name in ELEMENTWISE or name in ("convert_element_type", "stop_gradient"):
        return [_elementwise(eqn, facts)]
    return _coarse(eqn, facts)


def constant(value: Any) -> Facts:
    """Facts about a closed-over array: its numbers, unless it is traced."""
    if isinstance(value, jax.core.Tracer):
        return unknown(value.shape, value.dtype)
    return known(value)


def _jumps(depends: np.ndarray) -> np.ndarray:
    """The same dependence, through something discontinuous."""
    return np.where(depends & FIELD, depends | JUMPS, depends)


def _is_jump(eqn: Any) -> bool:
    name = eqn.primitive.name
    exact = not np.issubdtype(eqn.outvars[0].aval.dtype, np.inexact)
    return name in DISCRETE or name in ("stop_gradient", "custom_jvp_call") or exact


def _elementwise(eqn: Any, facts: list[Facts]) -> Facts:
    aval = eqn.outvars[0].aval
    depends = np.zeros(aval.shape, np.uint8)
    for f in facts:
        depends = depends | f.depends
    if _is_jump(eqn):
        depends = _jumps(depends)
    every = np.ones(aval.shape, bool)
    for f in facts:
        every = every & f.known
    value = np.zeros(aval.shape, aval.dtype)
    if every.any():
        out = _host(eqn, [f.value for f in facts])
        if out is None:
            every = np.zeros(aval.shape, bool)
        else:
            value = np.where(every, out[0], value)
    return Facts(value, every, np.where(every, 0, depends))


def _coarse(eqn: Any, facts: list[Facts]) -> list[Facts]:
    """Every output element depends on every input element."""
    bits = 0
    for f in facts:
        bits |= int(np.bitwise_or.reduce(f.depends, axis=None)) if f.depends.size else 0
    smooth = eqn.primitive.name in SMOOTH
    if bits & FIELD and not smooth:
        bits |= JUMPS
    return [unknown(v.aval.shape, v.aval.dtype, bits) for v in eqn.outvars]


# Many-element primitives that are differentiable wherever they are defined.
SMOOTH = frozenset(
    "cholesky lu triangular_solve custom_linear_solve cumsum cumprod cumlogsumexp reduce_prod "
    "conv_general_dilated fft scatter scatter-add linear_solve reduce_sum dot_general".split()
)


def _move(eqn: Any, facts: list[Facts]) -> list[Facts] | None:
    """Follow elements through an operation that only moves them, by moving their numbers."""
    name = eqn.primitive.name
    data = 1 if name in ("gather", "dynamic_slice") else 2 if name == "dynamic_update_slice" else len(facts)
    if not all(f.known.all() for f in facts[data:]):
        return None
    if name == "dynamic_slice":
        _refuse_outside(eqn, facts)
    numbers, start = [], 0
    for f in facts[:data]:
        size = int(np.prod(f.shape))
        numbers.append(np.arange(start, start + size).reshape(f.shape))
        start += size
    places = _host(eqn, [*numbers, *(f.value for f in facts[data:])])
    if places is None:
        return None

    def pool(parts: list[np.ndarray]) -> np.ndarray:
        return np.concatenate([p.ravel() for p in parts])

    values = pool([f.value for f in facts[:data]])
    certain, depends = pool([f.known for f in facts[:data]]), pool([f.depends for f in facts[:data]])
    out = []
    for p in places:
        inside = p >= 0  # a gather out of bounds gives a negative number: known, but not a number
        p = np.where(inside, p, 0)
        out.append(Facts(values[p], certain[p] & inside, np.where(inside, depends[p], 0).astype(np.uint8)))
    return out


def _refuse_outside(eqn: Any, facts: list[Facts]) -> None:
    """An index beyond an array, as x[1] in 1D: JAX would silently take the last element."""
    for axis, (length, size, first) in enumerate(zip(facts[0].shape, eqn.params["slice_sizes"], facts[1:])):
        start = int(first.value)
        if not 0 <= start <= length - size:
            raise ValueError(
                f"index {start} is out of bounds for axis {axis} of an array with {length} element(s); "
                "does the function use a coordinate that the cloud's dimension does not have?"
            )


def _mul(eqn: Any, facts: list[Facts]) -> list[Facts]:
    """Zero times anything is zero."""
    x, y = facts
    zero = (x.known & (x.value == 0)) | (y.known & (y.value == 0))
    both = x.known & y.known
    with np.errstate(all="ignore"):
        value = np.where(both & ~zero, x.value * y.value, 0).astype(eqn.outvars[0].aval.dtype)
    depends = np.where(zero | both, 0, x.depends | y.depends).astype(np.uint8)
    return [Facts(value, zero | both, depends)]


def _div(eqn: Any, facts: list[Facts]) -> list[Facts] | None:
    x, y = facts
    out = _elementwise(eqn, facts)
    zero = x.known & (x.value == 0) & ~out.known
    return [Facts(np.where(zero, 0, out.value), out.known | zero, np.where(zero, 0, out.depends))]


def _select_n(eqn: Any, facts: list[Facts]) -> list[Facts] | None:
    which, *cases = facts
    shape = cases[0].shape
    chosen = np.broadcast_to(which.value, shape).astype(int)
    decided = np.broadcast_to(which.known, shape)
    values = np.stack([c.value for c in cases])
    certain = np.stack([c.known for c in cases])
    depends = np.stack([c.depends for c in cases])

    def pick(stack: np.ndarray) -> np.ndarray:
        return np.take_along_axis(stack, chosen[None], 0)[0]

    same = certain.all(0) & (values == values[:1]).all(0)
    either = np.bitwise_or.reduce(depends, 0) | _jumps(np.broadcast_to(which.depends, shape))
    picked = np.where(decided, pick(certain), same)
    value = np.where(decided, pick(values), values[0])
    return [Facts(value, picked, np.where(picked, 0, np.where(decided, pick(depends), either)).astype(np.uint8))]


def _reduce_sum(eqn: Any, facts: list[Facts]) -> list[Facts]:
    (x,) = facts
    axes = tuple(eqn.params["axes"])
    sure = np.asarray(x.known.all(axes))
    value = np.where(sure, np.where(x.known, x.value, 0).sum(axes), 0).astype(eqn.outvars[0].aval.dtype)
    return [Facts(value, sure, np.where(sure, 0, np.bitwise_or.reduce(x.depends, axis=axes)).astype(np.uint8))]


def _dot_general(eqn: Any, facts: list[Facts]) -> list[Facts] | None:
    """A sum of products, of which those with a known zero vanish."""
    x, y = facts
    dtype = eqn.outvars[0].aval.dtype

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        arrays = (a.astype(float)[None, ..., None], b.astype(float)[None, ..., None])
        return RULES["dot_general"](_PLAIN, eqn, *arrays)[0, ..., 0]

    live_x, live_y = ~(x.known & (x.value == 0)), ~(y.known & (y.value == 0))
    depends = np.zeros(eqn.outvars[0].aval.shape, np.uint8)
    for bit in (POINT, EXTRAS, FIELD, JUMPS):
        touched = product(live_x & (x.depends & bit > 0), live_y) + product(live_x, live_y & (y.depends & bit > 0))
        depends = depends | np.where(touched > 0, bit, 0).astype(np.uint8)
    doubtful = product(live_x & ~x.known, live_y) + product(live_x, live_y & ~y.known)
    sure = doubtful == 0
    value = np.zeros(sure.shape, dtype)
    if sure.any():
        with np.errstate(all="ignore"):
            total = product(np.where(x.known, x.value, 0), np.where(y.known, y.value, 0))
        value = np.where(sure, total, 0).astype(dtype)
    return [Facts(value, sure, np.where(sure, 0, depends).astype(np.uint8))]


def _scan(eqn: Any, facts: list[Facts]) -> list[Facts] | None:
    p = eqn.params
    if p["length"] > UNROLL:
        return None
    n, m = scan_sizes(p)
    fixed, carry, rows = facts[:n], facts[n : n + m], facts[n + m :]
    consts = [constant(c) for c in p["jaxpr"].consts]
    order = range(p["length"])
    outs: dict[int, list[Facts]] = {}
    for k in reversed(order) if p["reverse"] else order:
        row = [Facts(*(part[k] for part in f)) for f in rows]
        new = interpret(p["jaxpr"].jaxpr, consts, [*fixed, *carry, *row])
        carry = new[:m]
        outs[k] = new[m:]
    if not outs:
        return None
    stacked = [Facts(*(np.stack(parts) for parts in zip(*(outs[k][i] for k in order)))) for i in range(len(outs[0]))]
    return [*carry, *stacked]


def _cond(eqn: Any, facts: list[Facts]) -> list[Facts]:
    index, *args = facts
    branches = eqn.params["branches"]
    if index.known.all():
        chosen = [branches[int(np.clip(index.value, 0, len(branches) - 1))]]
    else:
        chosen = list(branches)
    outs = [interpret(b.jaxpr, [constant(c) for c in b.consts], args) for b in chosen]
    result = []
    for parts in zip(*outs):
        values = np.stack([f.value for f in parts])
        same = np.stack([f.known for f in parts]).all(0) & (values == values[:1]).all(0)
        depends = np.bitwise_or.reduce(np.stack([f.depends for f in parts]), 0) | _jumps(index.depends)
        result.append(Facts(values[0], same, np.where(same, 0, depends).astype(np.uint8)))
    return result


SPECIAL: dict[str, Callable[[Any, list[Facts]], list[Facts] | None]] = {
    "mul": _mul, "div": _div, "select_n": _select_n, "reduce_sum": _reduce_sum, "dot_general": _dot_general,
    "scan": _scan, "cond": _cond,
}  # fmt: skip
