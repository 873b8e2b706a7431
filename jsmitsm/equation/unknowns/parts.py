"""Complex functions in two real parts: their operations, recorded by JAX, done on pairs of real arrays."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.runtime.jaxprs import Literal, bind, called, comes_up


class Pair(NamedTuple):
    """re + i im; None for a part that is zero, so that nothing comes to depend on what it is multiplied with."""

    re: Any
    im: Any


def parts(function: Callable[..., Any], *args: Any) -> tuple[jax.Array, jax.Array]:
    """Real and imaginary part of function(*args), for real arguments; a sequence of results is stacked."""
    made = jax.make_jaxpr(lambda *a: _stacked(function(*a)))(*args)
    (out,) = _evaluate(made.jaxpr, made.consts, jax.tree.leaves(args))
    shape = made.out_avals[0].shape
    pair = out if isinstance(out, Pair) else Pair(out, None)
    re, im = (jnp.zeros(shape) if p is None else jnp.asarray(p, float) for p in pair)
    return re, im


def _stacked(out: Any) -> Any:
    return jnp.stack([jnp.asarray(v) for v in out]) if isinstance(out, (list, tuple)) else jnp.asarray(out)


def _evaluate(jaxpr: Any, consts: Any, args: Any) -> list[Any]:
    known: dict[Any, Any] = {}

    def read(v: Any) -> Any:
        return _given(v.val) if isinstance(v, Literal) else known[v]

    known.update(zip(jaxpr.constvars, map(_given, consts), strict=True))
    known.update(zip(jaxpr.invars, args, strict=True))
    for eqn in jaxpr.eqns:
        vals = [read(v) for v in eqn.invars]
        # The scopes say what an operator differentiates and which jumps are meant.
        scope = str(eqn.source_info.name_stack)
        with jax.named_scope(scope) if scope else nullcontext():
            out = _done(eqn, vals)
        known.update(zip(eqn.outvars, out if eqn.primitive.multiple_results else [out], strict=True))
    return [read(v) for v in jaxpr.outvars]


def _given(value: Any) -> Any:
    """A constant, split where it is complex."""
    if not jnp.iscomplexobj(value):
        return value
    if isinstance(value, jax.core.Tracer):
        return Pair(jnp.real(value), jnp.imag(value))
    value = np.asarray(value)
    return Pair(*(p if np.any(p) else None for p in (value.real, value.imag)))


def _done(eqn: Any, vals: list[Any]) -> Any:
    """One operation, or the operations of a function within."""
    name = eqn.primitive.name
    inner = called(eqn)
    holds = any(isinstance(v, Pair) for v in vals)
    makes = any(jnp.issubdtype(v.aval.dtype, jnp.complexfloating) for v in eqn.outvars)
    if inner is not None and (holds or makes or comes_up(inner.jaxpr, np.complexfloating)):
        return _evaluate(inner.jaxpr, inner.consts, vals[len(vals) - len(inner.jaxpr.invars) :])
    if not holds and not makes:
        out = bind(eqn, *vals)
        return out if eqn.primitive.multiple_results else out[0]
    if name in RULES:
        out, shape = RULES[name](eqn, *(_pair(v) for v in vals)), eqn.outvars[0].aval.shape
        if not isinstance(out, Pair):
            return out
        return Pair(*(p if p is None or jnp.shape(p) == shape else _filled(p, shape) for p in out))
    if name in BOTH:
        return _both(eqn, vals)
    raise ValueError(
        f"the operation {name} of JAX on complex numbers is not made for; write it with +, *, /, powers, exp, log, "
        "sqrt, sin, cos, sinh, cosh, real, imag, conj and abs, or by real and imaginary parts"
    )


def _pair(value: Any) -> Pair:
    return value if isinstance(value, Pair) else Pair(value, None)


# Operations that do the same to both parts; operands that are no complex numbers (indices, choices) stay.
BOTH = frozenset(
    "broadcast_in_dim reshape squeeze slice dynamic_slice transpose concatenate reduce_sum cumsum rev copy copy_p "
    "gather select_n pad expand_dims stack unstack split neg name frozen stop_gradient".split()
)


def _both(eqn: Any, vals: list[Any]) -> Any:
    def one(k: int) -> list[Any]:
        if all(v[k] is None for v in vals if isinstance(v, Pair)):
            return [None] * len(eqn.outvars)
        return bind(eqn, *(_operand(v, w, k) for v, w in zip(vals, eqn.invars, strict=True)))

    out = [Pair(re, im) for re, im in zip(one(0), one(1), strict=True)]
    return out if eqn.primitive.multiple_results else out[0]


def _operand(value: Any, var: Any, k: int) -> Any:
    """Part k of an operand: of a real one among complex ones the first is itself, indices and choices are both."""
    if isinstance(value, Pair):
        return _filled(value[k], var.aval.shape)
    if jnp.issubdtype(var.aval.dtype, jnp.complexfloating):
        return _filled(value if k == 0 else None, var.aval.shape)
    return value


def _filled(part: Any, shape: Any) -> Any:
    return jnp.zeros(shape) if part is None else jnp.broadcast_to(jnp.asarray(part, float), shape)


def _plus(a: Any, b: Any) -> Any:
    return a if b is None else b if a is None else a + b


def _minus(a: Any, b: Any) -> Any:
    return a if b is None else -b if a is None else a - b


def _times(a: Any, b: Any) -> Any:
    return None if a is None or b is None else a * b


def _mul(_: Any, a: Pair, b: Pair) -> Pair:
    return Pair(
        _minus(_times(a.re, b.re), _times(a.im, b.im)), _plus(_times(a.re, b.im), _times(a.im, b.re))
    )


def _div(eqn: Any, a: Pair, b: Pair) -> Pair:
    if b.im is None:
        return Pair(*(None if p is None else p / b.re for p in a))
    size = _plus(_times(b.re, b.re), _times(b.im, b.im))
    over = _mul(eqn, a, Pair(b.re, -b.im))
    return Pair(*(None if p is None else p / size for p in over))


def _power(eqn: Any, a: Pair) -> Pair:
    count = eqn.params.get("y", 2)
    out = Pair(1.0, None)
    for _ in range(abs(count)):
        out = _mul(eqn, out, a)
    return out if count >= 0 else _div(eqn, Pair(1.0, None), out)


def _exp(eqn: Any, a: Pair) -> Pair:
    size = 1.0 if a.re is None else jnp.exp(a.re)
    return Pair(size, None) if a.im is None else Pair(size * jnp.cos(a.im), size * jnp.sin(a.im))


def _both_known(a: Pair) -> tuple[Any, Any]:
    return (0.0 if a.re is None else a.re), (0.0 if a.im is None else a.im)


def _log(_: Any, a: Pair) -> Pair:
    x, y = _both_known(a)
    return Pair(0.5 * jnp.log(x * x + y * y), jnp.arctan2(jnp.asarray(y, float), x))


def _sqrt(_: Any, a: Pair) -> Pair:
    x, y = _both_known(a)
    size, angle = (x * x + y * y) ** 0.25, 0.5 * jnp.arctan2(jnp.asarray(y, float), x)
    return Pair(size * jnp.cos(angle), size * jnp.sin(angle))


def _abs(_: Any, a: Pair) -> Any:
    x, y = _both_known(a)
    return jnp.sqrt(x * x + y * y)


def _round(first: Any, second: Any, cross: Any, third: Any, sign: float) -> Callable[..., Pair]:
    """f(x + i y) = first(x) second(y) + i sign cross(x) third(y)."""

    def rule(_: Any, a: Pair) -> Pair:
        x, y = _both_known(a)
        return Pair(first(x) * second(y), sign * cross(x) * third(y))

    return rule


def _dot(eqn: Any, a: Pair, b: Pair) -> Pair:
    params = {**eqn.params, "preferred_element_type": None}

    def dot(x: Any, y: Any) -> Any:
        if x is None or y is None:
            return None
        return eqn.primitive.bind(jnp.asarray(x, float), jnp.asarray(y, float), **params)

    return Pair(_minus(dot(a.re, b.re), dot(a.im, b.im)), _plus(dot(a.re, b.im), dot(a.im, b.re)))


def _converted(eqn: Any, a: Pair) -> Any:
    if jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.complexfloating):
        return Pair(*(None if p is None else jnp.asarray(p, float) for p in a))
    return _part(0)(eqn, a)


def _part(k: int) -> Callable[..., Any]:
    return lambda eqn, a: _filled(a[k], eqn.outvars[0].aval.shape)


RULES: dict[str, Callable[..., Any]] = {
    "add": lambda _, a, b: Pair(_plus(a.re, b.re), _plus(a.im, b.im)),
    "add_any": lambda _, a, b: Pair(_plus(a.re, b.re), _plus(a.im, b.im)),
    "sub": lambda _, a, b: Pair(_minus(a.re, b.re), _minus(a.im, b.im)),
    "mul": _mul,
    "div": _div,
    "integer_pow": _power,
    "square": _power,
    "exp": _exp,
    "log": _log,
    "sqrt": _sqrt,
    "abs": _abs,
    "sin": _round(jnp.sin, jnp.cosh, jnp.cos, jnp.sinh, 1.0),
    "cos": _round(jnp.cos, jnp.cosh, jnp.sin, jnp.sinh, -1.0),
    "sinh": _round(jnp.sinh, jnp.cos, jnp.cosh, jnp.sin, 1.0),
    "cosh": _round(jnp.cosh, jnp.cos, jnp.sinh, jnp.sin, 1.0),
    "conj": lambda _, a: Pair(a.re, None if a.im is None else -a.im),
    "real": _part(0),
    "imag": _part(1),
    "complex": lambda _, a, b: Pair(a.re, b.re),
    "dot_general": _dot,
    "convert_element_type": _converted,
}
