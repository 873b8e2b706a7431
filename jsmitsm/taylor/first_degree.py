"""Values and gradients of a recorded function at many points, in numpy, with the least between two operations.

What ``jets`` does at any degree is done here at the first, for the operations that signed distances are made of: of a
few hundred points the interpreter's own steps take as long as the arithmetic, and clouds ask a hundred times.
A value is a pair: an array (*shape, M), and its slopes (D, *shape, M) or None where it does not depend on the point;
M is 1 where all points share it.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from functools import lru_cache, partial, reduce
from typing import Any

import numpy as np

from jsmitsm.runtime.jaxprs import CONSTANT_TERM, DISCRETE, EVERYTHING, Literal, called, levels, literal
from jsmitsm.taylor.elementwise import HOST

Pair = tuple[np.ndarray, Any]
Rule = Callable[..., Pair]


class FirstDegree:
    """A jaxpr of one argument (D,) and one result () as a list of steps on numbered pairs."""

    def __init__(self, jaxpr: Any):
        self._start: list[Pair | None] = []
        self._steps: list[tuple[Rule, tuple[int, ...], int]] = []
        places = {v: self._new() for v in (*jaxpr.constvars, *jaxpr.invars)}
        self._consts, self._points = len(jaxpr.constvars), len(jaxpr.constvars)
        active = dict.fromkeys(jaxpr.constvars, False) | dict.fromkeys(jaxpr.invars, True)
        self._add(jaxpr, places, active)
        self._result = self._place(jaxpr.outvars[0], places)

    def __call__(self, consts: Sequence[Any], x: np.ndarray, gradients: bool) -> tuple[np.ndarray, np.ndarray]:
        """Values (M,) and, if asked for, gradients (M, D) at points (M, D); else zeros."""
        m, dim = x.shape
        env = list(self._start)
        for k, c in enumerate(consts):
            env[k] = np.asarray(c)[..., None], None
        slope = np.broadcast_to(np.eye(dim)[..., None], (dim, dim, m)) if gradients else None
        env[self._points] = np.ascontiguousarray(x.T), slope
        with np.errstate(all="ignore"):
            for rule, operands, out in self._steps:
                env[out] = rule(*[env[k] for k in operands])
        found = env[self._result]
        assert found is not None
        value, slope = found
        if value.shape[-1] != m:
            value = np.repeat(value, m)
        return value, np.zeros((m, dim)) if slope is None else slope.T

    def _new(self, value: Pair | None = None) -> int:
        self._start.append(value)
        return len(self._start) - 1

    def _place(self, v: Any, places: dict[Any, int]) -> int:
        if isinstance(v, Literal):
            return self._new((literal(v)[..., None], None))
        return places[v]

    def _add(self, jaxpr: Any, places: dict[Any, int], active: dict[Any, bool]) -> None:
        """The steps of a jaxpr whose inputs have their places; ``active``: what depends on the point."""
        for eqn, level in levels(jaxpr, [EVERYTHING] * len(jaxpr.outvars)):
            operands = [self._place(v, places) for v in eqn.invars]
            moving = [not isinstance(v, Literal) and active[v] for v in eqn.invars]
            inner = called(eqn)
            if inner is not None:
                body = inner.jaxpr
                first = len(operands) - len(body.invars)
                there = dict(zip(body.invars, operands[first:], strict=True))
                there |= {v: self._new((np.asarray(c)[..., None], None)) for v, c in zip(body.constvars, inner.consts)}
                below = dict(zip(body.invars, moving[first:], strict=True)) | dict.fromkeys(body.constvars, False)
                self._add(body, there, below)
                for v, w in zip(eqn.outvars, body.outvars, strict=True):
                    places[v], active[v] = self._place(w, there), not isinstance(w, Literal) and below[w]
                continue
            if len(eqn.outvars) != 1:  # a loop
                raise Unknown
            (out,) = eqn.outvars
            still = level == CONSTANT_TERM or eqn.primitive.name in DISCRETE
            rule = _rule(eqn, moving)
            places[out], active[out] = self._new(), any(moving) and not still
            self._steps.append((partial(_without_slopes, rule) if still else rule, tuple(operands), places[out]))


class Unknown(Exception):
    """An operation that stands not here."""


@lru_cache(maxsize=256)
def first_degree(jaxpr: Any) -> FirstDegree | None:
    """The steps of a jaxpr; None where one of its operations is left to ``jets``."""
    try:
        return FirstDegree(jaxpr)
    except Unknown:
        return None


def _rule(eqn: Any, moving: list[bool]) -> Rule:
    name, p = eqn.primitive.name, eqn.params
    if any(v.aval.dtype not in (np.float64, np.bool_) for v in (*eqn.invars, *eqn.outvars)):
        raise Unknown
    if name in _ELEMENTWISE:
        shape = eqn.outvars[0].aval.shape
        numbers = [flag and len(v.aval.shape) < len(shape) for v, flag in zip(eqn.invars, moving)]
        return partial(_lifted, _ELEMENTWISE[name], numbers, shape) if any(numbers) else _ELEMENTWISE[name]
    if name in DISCRETE and name in HOST:
        return partial(_plain, HOST[name])
    if name in _MADE:
        return _MADE[name](eqn, p)
    if name == "pow" and not moving[1]:
        return _pow
    raise Unknown


def _without_slopes(rule: Rule, *operands: Pair) -> Pair:
    return rule(*((v, None) for v, _ in operands))


def _plain(function: Callable[..., Any], *operands: Pair) -> Pair:
    return function(*(v for v, _ in operands)), None


def _lifted(rule: Rule, numbers: list[bool], shape: tuple[int, ...], *operands: Pair) -> Pair:
    """The rule on arrays (*shape, M), of which some operands are numbers (M,)."""
    between = (1,) * len(shape)
    wide = lambda v, lead: np.broadcast_to(v.reshape(*lead, *between, -1), (*lead, *shape, v.shape[-1]))  # noqa: E731
    return rule(*(
        _each(a, lambda v: wide(v, ()), lambda t: wide(t, t.shape[:1])) if flag else a
        for a, flag in zip(operands, numbers, strict=True)
    ))  # fmt: skip


# ------------------------------------------------------------------ elementwise


def _sum(x: Any, y: Any) -> Any:
    return y if x is None else x if y is None else x + y


def _times(slope: Any, factor: Any) -> Any:
    return None if slope is None else slope * factor


def _add(a: Pair, b: Pair) -> Pair:
    return a[0] + b[0], _sum(a[1], b[1])


def _sub(a: Pair, b: Pair) -> Pair:
    return a[0] - b[0], a[1] if b[1] is None else -b[1] if a[1] is None else a[1] - b[1]


def _mul(a: Pair, b: Pair) -> Pair:
    return a[0] * b[0], _sum(_times(a[1], b[0]), _times(b[1], a[0]))


def _div(a: Pair, b: Pair) -> Pair:
    w = a[0] / b[0]
    top = a[1] if b[1] is None else _sum(a[1], -w * b[1])
    return w, None if top is None else top / b[0]


def _neg(a: Pair) -> Pair:
    return -a[0], None if a[1] is None else -a[1]


def _where(which: np.ndarray, a: Pair, b: Pair) -> Pair:
    if a[1] is None and b[1] is None:
        return np.where(which, a[0], b[0]), None
    return np.where(which, a[0], b[0]), np.where(which, 0.0 if a[1] is None else a[1], 0.0 if b[1] is None else b[1])


def _select(which: Pair, no: Pair, yes: Pair) -> Pair:
    return _where(which[0], yes, no)


def _chained(value: Callable[..., Any], slope: Callable[..., Any]) -> Rule:
    """A function of one number from its value(x) and slope(x, value)."""

    def rule(a: Pair) -> Pair:
        x, tx = a
        v = value(x)
        return v, None if tx is None else tx * slope(x, v)

    return rule


def _pow(a: Pair, b: Pair) -> Pair:
    v = a[0] ** b[0]
    return v, None if a[1] is None else a[1] * (b[0] * a[0] ** (b[0] - 1.0))


def _atan2(a: Pair, b: Pair) -> Pair:
    (y, ty), (x, tx) = a, b
    turn = _sum(_times(ty, x), None if tx is None else -tx * y)
    return np.arctan2(y, x), None if turn is None else turn / (x * x + y * y)


def _same(a: Pair) -> Pair:
    return a


_ELEMENTWISE: dict[str, Rule] = {
    "add": _add, "add_any": _add, "sub": _sub, "mul": _mul, "div": _div, "neg": _neg, "select_n": _select,
    "max": lambda a, b: _where(a[0] >= b[0], a, b), "min": lambda a, b: _where(a[0] <= b[0], a, b),
    "abs": lambda a: _where(a[0] < 0, _neg(a), a), "atan2": _atan2,
    "square": _chained(lambda x: x * x, lambda x, v: 2.0 * x),
    "sqrt": _chained(np.sqrt, lambda x, v: 0.5 * v / x), "exp": _chained(np.exp, lambda x, v: v),
    "log": _chained(np.log, lambda x, v: 1.0 / x), "sin": _chained(np.sin, lambda x, v: np.cos(x)),
    "cos": _chained(np.cos, lambda x, v: -np.sin(x)), "tanh": _chained(np.tanh, lambda x, v: 1.0 - v * v),
    "atan": _chained(np.arctan, lambda x, v: 1.0 / (1.0 + x * x)),
    "copy": _same, "stop_gradient": _same,
}  # fmt: skip


# ------------------------------------------------------------------ made for one operation


def _whole_power(eqn: Any, p: Any) -> Rule:
    n = p["y"]
    return _chained(lambda x: x**n, (lambda x, v: 2.0 * x) if n == 2 else lambda x, v: n * x ** (n - 1))


def _converted(eqn: Any, p: Any) -> Rule:
    dtype = eqn.outvars[0].aval.dtype
    if eqn.invars[0].aval.dtype == dtype:
        return _same
    if dtype == np.bool_:
        raise Unknown
    return lambda a: (a[0].astype(dtype), None)


def _each(a: Pair, of_value: Callable[[Any], Any], of_slope: Callable[[Any], Any]) -> Pair:
    return of_value(a[0]), None if a[1] is None else of_slope(a[1])


def _sliced(eqn: Any, p: Any) -> Rule:
    strides = p["strides"] or (1,) * len(p["start_indices"])
    cuts = tuple(map(slice, p["start_indices"], p["limit_indices"], strides))
    return lambda a: _each(a, operator.itemgetter(cuts), operator.itemgetter((slice(None), *cuts)))


def _reshaped(eqn: Any, p: Any) -> Rule:
    shape = tuple(eqn.outvars[0].aval.shape)
    return lambda a: _each(
        a, lambda v: v.reshape(*shape, v.shape[-1]), lambda t: t.reshape(t.shape[0], *shape, t.shape[-1])
    )


def _spread(eqn: Any, p: Any) -> Rule:
    shape, axes = tuple(p["shape"]), p["broadcast_dimensions"]
    between = [1] * len(shape)
    for size, axis in zip(eqn.invars[0].aval.shape, axes, strict=True):
        between[axis] = size
    wide = lambda v, lead: np.broadcast_to(  # noqa: E731
        v.reshape(*lead, *between, v.shape[-1]), (*lead, *shape, v.shape[-1])
    )
    return lambda a: _each(a, lambda v: wide(v, ()), lambda t: wide(t, t.shape[:1]))


def _joined(join: Callable[..., Any], axis: int, *parts: Pair) -> Pair:
    m = max(v.shape[-1] for v, _ in parts)
    values = [np.broadcast_to(v, (*v.shape[:-1], m)) for v, _ in parts]
    dim = next((len(t) for _, t in parts if t is not None), None)
    if dim is None:
        return join(values, axis=axis), None
    slopes = [np.zeros((dim, *v.shape)) if t is None else t for v, (_, t) in zip(values, parts)]
    return join(values, axis=axis), join(slopes, axis=axis + 1)


def _summed(eqn: Any, p: Any) -> Rule:
    axes = tuple(p["axes"])
    after = tuple(k + 1 for k in axes)
    return lambda a: _each(a, lambda v: v.sum(axis=axes), lambda t: t.sum(axis=after))


def _extreme(better: Callable[[Any, Any], Any], eqn: Any, p: Any) -> Rule:
    if len(p["axes"]) != 1:
        raise Unknown
    (axis,) = p["axes"]
    before = (slice(None),) * axis

    def rule(a: Pair) -> Pair:
        parts = [
            _each(a, operator.itemgetter((*before, k)), operator.itemgetter((slice(None), *before, k)))
            for k in range(a[0].shape[axis])
        ]
        return reduce(lambda x, y: _where(better(x[0], y[0]), x, y), parts)

    return rule


def _decided(function: Any, eqn: Any, p: Any) -> Rule:
    axes = tuple(p["axes"])
    return lambda a: (function.reduce(a[0], axis=axes), None)


def _contracted(eqn: Any, p: Any) -> Rule:
    """A sum over one axis of products of vectors and matrices."""
    (left, right), batch = p["dimension_numbers"]
    ranks = [len(v.aval.shape) for v in eqn.invars]
    if len(left) != 1 or len(right) != 1 or any(batch) or ranks == [2, 2]:
        raise Unknown

    def last(a: Pair, axis: int, rank: int, other: int) -> Pair:
        """The summed axis last but one, and room before it for the free axis of the other factor."""
        value, slope = a
        value = np.moveaxis(value, axis, rank - 1)
        slope = None if slope is None else np.moveaxis(slope, axis + 1, rank)
        if other > rank:
            value, slope = value[None], None if slope is None else slope[:, None]
        return value, slope

    def rule(a: Pair, b: Pair) -> Pair:
        product = _mul(last(a, left[0], ranks[0], ranks[1]), last(b, right[0], ranks[1], ranks[0]))
        return _each(product, lambda v: v.sum(axis=-2), lambda t: t.sum(axis=-2))

    return rule


_MADE: dict[str, Callable[[Any, Any], Rule]] = {
    "integer_pow": _whole_power, "convert_element_type": _converted, "slice": _sliced,
    "reshape": _reshaped, "squeeze": _reshaped, "expand_dims": _reshaped, "broadcast_in_dim": _spread,
    "stack": lambda eqn, p: partial(_joined, np.stack, p["axis"]),
    "concatenate": lambda eqn, p: partial(_joined, np.concatenate, p["dimension"]),
    "reduce_sum": _summed, "reduce_max": partial(_extreme, operator.ge), "reduce_min": partial(_extreme, operator.le),
    "reduce_or": partial(_decided, np.logical_or), "reduce_and": partial(_decided, np.logical_and),
    "dot_general": _contracted,
}  # fmt: skip
