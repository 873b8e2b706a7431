"""Reading jaxprs: what an operation calls, what the outputs need, the derivative of one operation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jax.interpreters import partial_eval

# What jaxprs are made of, for the whole package. JAX's public place for it, jax.extend.core, is these very objects, and
# loads Pallas with them: most of what importing this package would take.
try:
    from jax._src.core import ClosedJaxpr as ClosedJaxpr
    from jax._src.core import Jaxpr as Jaxpr
    from jax._src.core import Literal as Literal
    from jax._src.core import Primitive as Primitive
    from jax._src.core import jaxpr_as_fun as jaxpr_as_fun
except ImportError:
    from jax.extend.core import ClosedJaxpr as ClosedJaxpr
    from jax.extend.core import Jaxpr as Jaxpr
    from jax.extend.core import Literal as Literal
    from jax.extend.core import Primitive as Primitive
    from jax.extend.core import jaxpr_as_fun as jaxpr_as_fun

# Piecewise constant in their arguments: the degree 0 decides.
DISCRETE = frozenset(
    "sign floor ceil round is_finite eq ne lt le gt ge eq_to lt_to le_to and or xor not shift_left "
    "shift_right_logical shift_right_arithmetic population_count clz nextafter argmax argmin reduce_and reduce_or "
    "reduce_xor iota random_bits random_wrap random_unwrap threefry2x32 bitcast_convert_type".split()
)
# How much of a value is asked for: nothing, its degree 0, all of it.
NOTHING, CONSTANT_TERM, EVERYTHING = 0, 1, 2
CALLS = {"jit", "pjit", "closed_call", "core_call", "call", "remat", "checkpoint", "remat2", "custom_vjp_call",
         "custom_vjp_call_jaxpr", "custom_lin", "custom_vmap_call", "composite"}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Program:
    """A jaxpr whose constants are kept elsewhere. JAX's own tells constants from inputs by the values it holds."""

    constvars: tuple[Any, ...]
    invars: tuple[Any, ...]
    outvars: tuple[Any, ...]
    eqns: tuple[Any, ...]


def program(closed: ClosedJaxpr, last: int = 0) -> Program:
    """The program of a trace without its constants; its ``last`` inputs become constants too."""
    jaxpr = closed.jaxpr
    inputs = len(jaxpr.invars) - last
    constvars = (*jaxpr.constvars, *jaxpr.invars[inputs:])
    return Program(constvars, tuple(jaxpr.invars[:inputs]), tuple(jaxpr.outvars), tuple(jaxpr.eqns))


def comes_up(jaxpr: Any, kind: Any) -> bool:
    """Whether numbers of a kind, as ``np.complexfloating``, come up in a jaxpr or in what it calls."""
    some = [*jaxpr.constvars, *(v for eqn in jaxpr.eqns for v in eqn.outvars)]
    return any(jax.dtypes.issubdtype(getattr(v.aval, "dtype", float), kind) for v in some) or any(
        comes_up(inner, kind) for eqn in jaxpr.eqns for inner in inner_jaxprs(eqn)
    )


def called(eqn: Any) -> ClosedJaxpr | None:
    """The jaxpr of an operation that only calls one, else None."""
    if eqn.primitive.name not in CALLS:
        return None
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call"):
        if key in eqn.params:
            inner = eqn.params[key]
            return inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
    return None


def scan_sizes(params: Any) -> tuple[int, int]:
    """How many inputs of a ``scan`` are constants of its body, and how many are carried on; the others are rows."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    constants, carried, _ = params["ft_in"].unpack()  # JAX 0.11 keeps the three as trees
    return len(constants), len(carried)


def literal(v: Any) -> np.ndarray:
    """The value of a literal, with its dtype."""
    return np.asarray(v.val, v.aval.dtype)


def bind(eqn: Any, *args: Any) -> list[Any]:
    """Perform the operation on JAX values."""
    params = eqn.primitive.get_bind_params(eqn.params)
    if isinstance(params, tuple):  # JAX before 0.10: functions come first
        args, params = (*params[0], *args), params[1]
    out = eqn.primitive.bind(*args, **params)
    return list(out) if eqn.primitive.multiple_results else [out]


def inner_jaxprs(eqn: Any) -> list[Jaxpr]:
    """Every jaxpr among the parameters of an operation."""
    found: list[Jaxpr] = []

    def look(value: Any) -> None:
        if isinstance(value, ClosedJaxpr):
            found.append(value.jaxpr)
        elif isinstance(value, Jaxpr):
            found.append(value)
        elif isinstance(value, tuple | list):
            for v in value:
                look(v)

    for value in eqn.params.values():
        look(value)
    return found


def used_inputs(jaxpr: Jaxpr) -> list[bool]:
    """Of every input whether an output depends on it."""
    return list(partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[1])


def levels(jaxpr: Any, wanted: Sequence[int]) -> tuple[tuple[Any, int], ...]:
    """The operations the wanted outputs need, in order, and how much of each."""
    return _levels(jaxpr, tuple(wanted))


@lru_cache(maxsize=1024)
def _levels(jaxpr: Any, wanted: tuple[int, ...]) -> tuple[tuple[Any, int], ...]:
    need: dict[Any, int] = {}

    def ask(v: Any, level: int) -> None:
        if not isinstance(v, Literal) and need.get(v, 0) < level:
            need[v] = level

    for v, level in zip(jaxpr.outvars, wanted, strict=True):
        ask(v, level)
    kept = []
    for eqn in reversed(jaxpr.eqns):
        level = max((need.get(v, NOTHING) for v in eqn.outvars), default=NOTHING)
        if level == NOTHING:
            continue
        kept.append((eqn, level))
        name = eqn.primitive.name
        for k, v in enumerate(eqn.invars):
            ask(v, _operand_level(eqn, name, k, level))
    return tuple(kept[::-1])


def _operand_level(eqn: Any, name: str, k: int, level: int) -> int:
    """How much of operand k is needed."""
    if name in DISCRETE or (name in ("select_n", "cond") and k == 0):
        return CONSTANT_TERM
    if name in ("gather", "dynamic_slice", "scatter", "scatter-add") and k == 1:
        return CONSTANT_TERM
    if name == "custom_linear_solve":
        lengths = eqn.params["const_lengths"]
        first = lengths.matvec + lengths.vecmat
        inside = first <= k < first + lengths.solve or k >= sum(lengths)
        return level if inside else NOTHING
    return level


def unsupported(name: str, why: str = "") -> ValueError:
    return ValueError(
        f"the primitive '{name}' has no Taylor expansion here{why}: it was met in a pde, a boundary condition or a "
        "kernel profile, applied to something that depends on x; rewrite it with elementary jax.numpy functions, or "
        "give the quantity as values on the particles"
    )


def derivative(eqn: Any, active: tuple[int, ...]) -> tuple[Any, Sequence[Any]]:
    """The jaxpr (operands, tangents of the active ones) -> tangents of the inexact results."""
    avals = tuple((v.aval.shape, v.aval.dtype) for v in eqn.invars)
    try:
        params = tuple(sorted(eqn.params.items()))
        hash(params)
    except TypeError:
        return _trace_derivative(eqn, active)
    return _cached_derivative(_Keyed((eqn.primitive, params, avals), eqn), active)


class _Keyed:
    """An operation that compares by what it computes."""

    def __init__(self, key: Any, eqn: Any):
        self.key, self.eqn = key, eqn

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Keyed) and self.key == other.key


@lru_cache(maxsize=512)
def _cached_derivative(keyed: _Keyed, active: tuple[int, ...]) -> tuple[Any, Sequence[Any]]:
    return _trace_derivative(keyed.eqn, active)


def _trace_derivative(eqn: Any, active: tuple[int, ...]) -> tuple[Any, Sequence[Any]]:
    exact = [not np.issubdtype(v.aval.dtype, np.inexact) for v in eqn.outvars]
    operands = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]

    def tangents(args: Any, slopes: Any) -> list[Any]:
        def some(*chosen: Any) -> list[Any]:
            full = list(args)
            for k, v in zip(active, chosen, strict=True):
                full[k] = v
            return bind(eqn, *full)

        _, out = jax.jvp(some, [args[k] for k in active], slopes)
        return [t for t, skip in zip(out, exact, strict=True) if not skip]

    try:
        closed = jax.make_jaxpr(tangents)(operands, [operands[k] for k in active])
    except (NotImplementedError, TypeError, ValueError) as error:
        raise unsupported(eqn.primitive.name, f" ({error})" if "JVP" in str(error) else "") from error
    # Calls are opened, so that the parts free of tangents can be told from the others.
    closed = jax.make_jaxpr(lambda *a: inlined(closed.jaxpr, closed.consts, a))(*closed.in_avals)
    return closed.jaxpr, closed.consts


def inlined(jaxpr: Any, consts: Sequence[Any], args: Sequence[Any]) -> list[Any]:
    """Perform a jaxpr on JAX values with its calls opened."""
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))

    def read(v: Any) -> Any:
        return v.val if isinstance(v, Literal) else env[v]

    for eqn in jaxpr.eqns:
        vals = [read(v) for v in eqn.invars]
        inner = called(eqn)
        if inner is None:
            out = bind(eqn, *vals)
        else:
            out = inlined(inner.jaxpr, inner.consts, vals[len(vals) - len(inner.jaxpr.invars) :])
        env.update(zip(eqn.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]
