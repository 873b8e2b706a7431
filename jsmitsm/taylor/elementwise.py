"""Elementwise primitives on Taylor series, and their values on plain numpy arrays."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jsmitsm.runtime.jaxprs import DISCRETE
from jsmitsm.taylor.series import (
    Array,
    Ring,
    add,
    align,
    along_line,
    choose,
    circle,
    div,
    euler,
    integer_power,
    integrate,
    mul,
    on_host,
    power,
    riccati,
    truncate,
)

Rule = Callable[..., Any]


def _special(name: str) -> Callable[..., Any]:
    """A function of scipy.special, imported when first called."""

    def call(*args: Any) -> Any:
        import scipy.special

        return getattr(scipy.special, name)(*args)

    return call


def _divide(x: Any, y: Any) -> Any:
    if np.issubdtype(np.result_type(x, y), np.integer):
        return np.trunc(np.true_divide(x, y)).astype(np.result_type(x, y))
    return np.true_divide(x, y)


def _logical(boolean: Any, bitwise: Any) -> Callable[..., Any]:
    return lambda *args: (boolean if args[0].dtype == bool else bitwise)(*args)


HOST: dict[str, Callable[..., Any]] = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "div": _divide, "neg": np.negative,
    "rem": np.fmod, "max": np.maximum, "min": np.minimum, "abs": np.abs, "sign": np.sign, "floor": np.floor,
    "ceil": np.ceil, "is_finite": np.isfinite, "square": np.square, "sqrt": np.sqrt, "rsqrt": lambda x: 1 / np.sqrt(x),
    "cbrt": np.cbrt, "pow": np.power, "exp": np.exp, "exp2": np.exp2, "expm1": np.expm1, "log": np.log,
    "log1p": np.log1p, "sin": np.sin, "cos": np.cos, "tan": np.tan, "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh,
    "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "asinh": np.arcsinh, "acosh": np.arccosh,
    "atanh": np.arctanh, "atan2": np.arctan2, "logistic": _special("expit"), "erf": _special("erf"),
    "erfc": _special("erfc"), "erf_inv": _special("erfinv"), "lgamma": _special("gammaln"),
    "digamma": _special("digamma"), "polygamma": _special("polygamma"), "igamma": _special("gammainc"),
    "igammac": _special("gammaincc"), "zeta": _special("zeta"), "bessel_i0e": _special("i0e"),
    "bessel_i1e": _special("i1e"), "regularized_incomplete_beta": _special("betainc"),
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "eq_to": np.equal, "lt_to": np.less, "le_to": np.less_equal,
    "and": _logical(np.logical_and, np.bitwise_and), "or": _logical(np.logical_or, np.bitwise_or),
    "xor": _logical(np.logical_xor, np.bitwise_xor), "not": _logical(np.logical_not, np.bitwise_not),
    "shift_left": np.left_shift, "nextafter": np.nextafter,
}  # fmt: skip

ELEMENTWISE = frozenset(HOST) | frozenset(
    "round integer_pow clamp population_count clz shift_right_logical shift_right_arithmetic igamma_grad_a".split()
)


def plain_elementwise(eqn: Any, vals: list[Array]) -> Array:
    """The primitive on arrays independent of x (L = 1)."""
    name = eqn.primitive.name
    vals = align(*vals)
    if on_host(*vals):
        if name in HOST:
            out = HOST[name](*vals)
            dtype = eqn.outvars[0].aval.dtype
            return out if out.dtype == dtype else out.astype(dtype)
        if name == "integer_pow":
            return (
                vals[0] ** np.asarray(eqn.params["y"], vals[0].dtype)
                if eqn.params["y"] < 0
                else (vals[0] ** eqn.params["y"])
            )
        if name == "round":
            return np.round(vals[0]) if _to_even(eqn) else np.trunc(vals[0] + np.copysign(0.5, vals[0]))
    shape = np.broadcast_shapes(*(v.shape for v in vals))
    if on_host(*vals):
        # Concrete values stay concrete even while an outer transformation is being traced.
        with jax.ensure_compile_time_eval():
            out = eqn.primitive.bind(*(np.broadcast_to(v, shape) for v in vals), **eqn.params)
            return np.asarray(out)
    return eqn.primitive.bind(*(jax.numpy.broadcast_to(v, shape) for v in vals), **eqn.params)


def _to_even(eqn: Any) -> bool:
    return int(eqn.params["rounding_method"]) == 1


RULES: dict[str, Rule] = {}


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Register a rule (ring, eqn, *values) -> value."""

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, function))
        return function

    return register


def smooth(*names: str) -> Callable[[Rule], Rule]:
    """Register a rule (ring, start, *values) -> value for arguments of which one depends on x at least.

    ``start`` is the primitive's value at degree 0.
    """

    def register(function: Rule) -> Rule:
        def apply(ring: Ring, eqn: Any, *vals: Array) -> Array:
            start = plain_elementwise(eqn, [v[:1] for v in vals])
            if all([v.shape[0] == 1 for v in vals]):
                return start
            straight = None
            if len(vals) == 1:
                straight = along_line(ring, vals[0], lambda line, x: function(line, start, x))
            return function(ring, start, *vals) if straight is None else straight

        RULES.update(dict.fromkeys(names, apply))
        return function

    return register


def _chain(ring: Ring, start: Array, x: Array, slope: Callable[[Ring, Array], Array]) -> Array:
    """g(x) from g(x0) and g', by E(g) = g'(x) E(x): g' is needed one degree less."""
    lower = Ring(ring.dim, ring.degree - 1)
    return integrate(ring, start, mul(ring, euler(ring, x), slope(lower, truncate(lower, x))))


def _scalar(x: Array, value: float) -> np.ndarray:
    return np.full((1,) * x.ndim, value, x.dtype)


def _power(ring: Ring, x: Array, exponent: float) -> Array:
    """x**exponent of a series."""
    r = _scalar(x, exponent)
    return x**r if x.shape[0] == 1 else power(ring, x, r, x[:1] ** r)


@rule("add", "add_any")
def _add(ring: Ring, eqn: Any, x: Array, y: Array) -> Array:
    return add(x, y)


@rule("sub")
def _sub(ring: Ring, eqn: Any, x: Array, y: Array) -> Array:
    x, y = align(x, y)
    n = min(len(x), len(y))
    if len(x) == len(y) or not on_host(x, y) or x.shape[1:] != y.shape[1:] or x.dtype != y.dtype:
        return x - y if len(x) == len(y) else add(x, -y)
    out = x.copy() if n < len(x) else -y
    np.subtract(x[:n], y[:n], out=out[:n])
    return out


@rule("neg")
def _neg(ring: Ring, eqn: Any, x: Array) -> Array:
    return -x


@rule("mul")
def _mul(ring: Ring, eqn: Any, x: Array, y: Array) -> Array:
    return mul(ring, x, y)


@smooth("square")
def _square(ring: Ring, start: Array, x: Array) -> Array:
    return mul(ring, x, x)


@smooth("div")
def _div(ring: Ring, start: Array, x: Array, y: Array) -> Array:
    return div(ring, x, y)


@rule("integer_pow")
def _integer_pow(ring: Ring, eqn: Any, x: Array) -> Array:
    return integer_power(ring, x, eqn.params["y"]) if x.shape[0] > 1 else plain_elementwise(eqn, [x])


@rule("convert_element_type")
def _convert(ring: Ring, eqn: Any, x: Array) -> Array:
    dtype = np.dtype(eqn.params["new_dtype"])
    if x.dtype == dtype:
        return x
    return x.astype(dtype) if np.issubdtype(dtype, np.inexact) else x[:1].astype(dtype)


@rule("copy", "copy_p", "stop_gradient", "reduce_precision", "optimization_barrier", "name", "device_put")
def _identity(ring: Ring, eqn: Any, *vals: Array) -> Any:
    # Expansion in x is no differentiation of the user's: stop_gradient does not stop it.
    return list(vals) if eqn.primitive.multiple_results else vals[0]


@smooth("exp")
def _exp(ring: Ring, start: Array, x: Array) -> Array:
    return riccati(ring, x, start, 0, 1, 0)


@smooth("exp2")
def _exp2(ring: Ring, start: Array, x: Array) -> Array:
    return riccati(ring, x, start, 0, math.log(2), 0)


@smooth("expm1")
def _expm1(ring: Ring, start: Array, x: Array) -> Array:
    return riccati(ring, x, start, 1, 1, 0)


@smooth("tan")
def _tan(ring: Ring, start: Array, x: Array) -> Array:
    return riccati(ring, x, start, 1, 0, 1)


@smooth("tanh")
def _tanh(ring: Ring, start: Array, x: Array) -> Array:
    return riccati(ring, x, start, 1, 0, -1)


@smooth("logistic")
def _logistic(ring: Ring, start: Array, x: Array) -> Array:
    return riccati(ring, x, start, 0, 1, -1)


def _circular(name: str, partner: Callable[[Array], Array], which: int, sign: float) -> None:
    @smooth(name)
    def apply(ring: Ring, start: Array, x: Array) -> Array:
        pair = [start, start]
        pair[1 - which] = partner(x[:1])
        return circle(ring, x, pair[0], pair[1], sign)[which]


def _of(name: str) -> Callable[[Array], Array]:
    return lambda x: getattr(np if on_host(x) else jax.numpy, name)(x)


_circular("sin", _of("cos"), 0, -1.0)
_circular("cos", _of("sin"), 1, -1.0)
_circular("sinh", _of("cosh"), 0, 1.0)
_circular("cosh", _of("sinh"), 1, 1.0)


def _reciprocal(ring: Ring, x: Array) -> Array:
    return div(ring, _scalar(x, 1.0), x)


def _one_plus(x: Array, sign: float = 1.0) -> Array:
    return add(_scalar(x, 1.0), x if sign > 0 else -x)


def _gauss(ring: Ring, x: Array, factor: float) -> Array:
    v = -mul(ring, x, x)
    start = (np if on_host(v) else jax.numpy).exp(v[:1])
    return factor * (start if v.shape[0] == 1 else riccati(ring, v, start, 0, 1, 0))


# Functions whose derivative is elementary: dg/dx as a series from x as a series.
_SLOPES: dict[str, Callable[[Ring, Array], Array]] = {
    "log": _reciprocal,
    "log1p": lambda r, x: _reciprocal(r, _one_plus(x)),
    "atan": lambda r, x: _reciprocal(r, _one_plus(mul(r, x, x))),
    "atanh": lambda r, x: _reciprocal(r, _one_plus(mul(r, x, x), -1.0)),
    "asin": lambda r, x: _power(r, _one_plus(mul(r, x, x), -1.0), -0.5),
    "acos": lambda r, x: -_power(r, _one_plus(mul(r, x, x), -1.0), -0.5),
    "asinh": lambda r, x: _power(r, _one_plus(mul(r, x, x)), -0.5),
    "acosh": lambda r, x: _power(r, add(mul(r, x, x), _scalar(x, -1.0)), -0.5),
    "erf": lambda r, x: _gauss(r, x, 2 / math.sqrt(math.pi)),
    "erfc": lambda r, x: _gauss(r, x, -2 / math.sqrt(math.pi)),
}


def _by_slope(name: str, slope: Callable[[Ring, Array], Array]) -> None:
    smooth(name)(lambda ring, start, x: _chain(ring, start, x, slope))


for _name, _slope in _SLOPES.items():
    _by_slope(_name, _slope)


@smooth("sqrt")
def _sqrt(ring: Ring, start: Array, x: Array) -> Array:
    return power(ring, x, _scalar(x, 0.5), start)


@smooth("rsqrt")
def _rsqrt(ring: Ring, start: Array, x: Array) -> Array:
    return power(ring, x, _scalar(x, -0.5), start)


@smooth("cbrt")
def _cbrt(ring: Ring, start: Array, x: Array) -> Array:
    return power(ring, x, _scalar(x, 1 / 3), start)


@smooth("pow")
def _pow(ring: Ring, start: Array, x: Array, y: Array) -> Array:
    if y.shape[0] == 1:
        if isinstance(y, np.ndarray) and y.size == 1 and float(y.flat[0]).is_integer() and 0 <= y.flat[0] <= 64:
            # A whole power is smooth where x vanishes, unlike the recursion.
            return integer_power(ring, x, int(y.flat[0]))
        return power(ring, x, y.astype(x.dtype), start)
    log = (np if on_host(x) else jax.numpy).log(x[:1])
    if x.shape[0] > 1:
        log = _chain(ring, log, x, _reciprocal)
    return riccati(ring, mul(ring, y, log), start, 0, 1, 0)


@smooth("atan2")
def _atan2(ring: Ring, start: Array, y: Array, x: Array) -> Array:
    y, x = align(y, x)
    turn = add(mul(ring, x, euler(ring, y)), -mul(ring, y, euler(ring, x)))
    return integrate(ring, start, div(ring, turn, add(mul(ring, x, x), mul(ring, y, y))))


@smooth("abs")
def _abs(ring: Ring, start: Array, x: Array) -> Array:
    return choose(x[:1] < 0, -x, x)


@smooth("max")
def _max(ring: Ring, start: Array, x: Array, y: Array) -> Array:
    return choose(operator.ge(*align(x[:1], y[:1])), x, y)


@smooth("min")
def _min(ring: Ring, start: Array, x: Array, y: Array) -> Array:
    return choose(operator.le(*align(x[:1], y[:1])), x, y)


@smooth("rem")
def _rem(ring: Ring, start: Array, x: Array, y: Array) -> Array:
    xp = np if on_host(x, y) else jax.numpy
    x, y = align(x, y)
    return add(x, -y * xp.trunc(x[:1] / y[:1]))


@rule("clamp")
def _clamp(ring: Ring, eqn: Any, low: Array, x: Array, high: Array) -> Array:
    low, x, high = align(low, x, high)
    out = choose(x[:1] < low[:1], low, x)
    return choose(align(out[:1])[0] > high[:1], high, out)


def _discrete(ring: Ring, eqn: Any, *vals: Array) -> Array:
    return plain_elementwise(eqn, [v[:1] for v in vals])


for _name in sorted(DISCRETE & ELEMENTWISE):
    RULES[_name] = _discrete
