"""Jumps that an operator differentiates, and whose part in the derivative is lost.

Differentiated by JAX, a branch gives the derivative of the piece taken: d/dx where(x < a, k1, k2) is zero, without the
delta at a. A problem that differentiates such a jump inside of its cloud (a conductivity of two materials in a
divergence) has lost what holds there, the balance of fluxes, at any resolution. A jump that no operator differentiates,
of a source or of a reaction, costs accuracy and nothing else.

What is differentiated carries a name in the recorded operations (``operators``); here it is found, with the outcomes of
the comparisons, roundings and look-ups behind it. ``jumps`` evaluates both on the cloud.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.equation.field import field_p, frozen_p
from jsmitsm.equation.linearizing import control, inner_jaxprs, is_mark, open_fields, slots_of
from jsmitsm.equation.marks import ALONG, DIFFERENTIATED, MEANT
from jsmitsm.runtime.jaxprs import Literal, bind, called, literal, program, scan_sizes
from jsmitsm.runtime.tracers import concrete
from jsmitsm.taylor.multi_indices import Slot

# What the outcome of a branch depends on: the point, the field, a parameter, a value that is only traced.
POINT, FIELD, PARAMETER, TRACED = 1, 2, 4, 8
# Floats that are constant but for jumps; operations on floats that jump where these tell.
_STEPS = frozenset("sign floor ceil round".split())
_JUMPS = {
    "rem": lambda x, y: jnp.trunc(x / y),
    "atan2": lambda y, x: jnp.where(x < 0, jnp.sign(y), 0.0),
}
# Loops of up to so many steps are opened.
_UNROLL = 64


class _Value(NamedTuple):
    """A recorded value: what it depends on, and which branches reach it without being meant."""

    value: Any
    depends: int = 0
    reached: frozenset[int] = frozenset()


class Outcome(NamedTuple):
    """The outcome of one operation that branches, None where it cannot be seen; what it depends on; where it stands."""

    value: Any
    depends: int
    place: str


class Differentiated(NamedTuple):
    """A value that is differentiated along an axis (None: by the user's own derivative, along any)."""

    value: Any
    axis: int | None
    reached: frozenset[int]


@dataclass(frozen=True, eq=False)
class Branches:
    """The branches that a residual differentiates.

    The jaxpr takes the point, the slots, the parameters' leaves and the constants; it gives the differentiated values
    and then the outcomes that can be seen.
    """

    jaxpr: Any
    consts: tuple[Any, ...]
    slots: tuple[Slot, ...]
    values: tuple[Differentiated, ...]
    outcomes: tuple[Outcome, ...]

    @property
    def depends(self) -> int:
        """What any outcome depends on."""
        return _either(o.depends for o in self.outcomes)


def _either(some: Iterable[int]) -> int:
    return reduce(operator.or_, some, 0)


def branching(jaxpr: Any) -> bool:
    """Whether any operation inside has outcomes rather than values."""
    return any(decides(eqn) or any(map(branching, inner_jaxprs(eqn))) for eqn in jaxpr.eqns)


def decides(eqn: Any) -> bool:
    """Whether a number that varies becomes an outcome."""
    name = eqn.primitive.name
    if not (name in _STEPS or name in _JUMPS or any(v.aval.dtype.kind in "biu" for v in eqn.outvars)):
        return False
    return any(v.aval.dtype.kind not in "biu" for v in eqn.invars)


def branches(written: Any, consts: Sequence[Any], n_extras: int) -> Branches | None:
    """The branches that a residual as it was written differentiates; None where there are none."""
    if not branching(written):
        return None
    slots = tuple(sorted(slots_of(written)))  # those too of which only derivatives are used
    dtype = written.invars[0].aval.dtype
    shaped = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in (*written.invars, *written.constvars)]
    scalars = [jax.ShapeDtypeStruct((), dtype)] * len(slots)
    n = len(written.invars)
    found: list[_Reader] = []

    def look(x: Any, s: Any, rest: Any, c: Any) -> Any:
        reader = _Reader(dict(zip(slots, s, strict=True)))
        args = [_Value(x, POINT), *(_Value(v, POINT if k < n_extras else PARAMETER) for k, v in enumerate(rest))]
        fixed = [_Value(v, TRACED if concrete(k) is None else 0) for v, k in zip(c, consts, strict=True)]
        reader.walk(written, fixed, args, _Scope())
        reader.forget_others()
        found[:] = [reader]
        return [v.value for v in reader.values], [o.value for o in reader.outcomes if o.value is not None]

    closed = jax.make_jaxpr(look)(shaped[0], scalars, shaped[1:n], shaped[n:])
    (reader,) = found
    if not reader.values:
        return None
    # Nothing traced is kept: of the outcomes their shapes.
    values = tuple(v._replace(value=None) for v in reader.values)
    outcomes = tuple(o._replace(value=None if o.value is None else tuple(o.value.shape)) for o in reader.outcomes)
    return Branches(program(closed, last=len(written.constvars)), tuple(closed.consts), slots, values, outcomes)


class _Scope(NamedTuple):
    """The names around an operation, and where the user's code called it."""

    names: str = ""
    place: str = ""


class _Reader:
    """Performs a residual as it was written, noting what branches and what is differentiated."""

    def __init__(self, slots: dict[Slot, Any]):
        self.slots = slots
        self.values: list[Differentiated] = []
        self.outcomes: list[Outcome] = []
        self.kinks: list[set[int]] = []  # operands and results of max, min and abs, whose own derivatives compare them
        self.taken: set[int] = set()  # outcomes that chose already: what they choose next is a derivative of it
        self.alive: list[_Value] = []  # what the numbers in these two stand for

    def forget_others(self) -> None:
        """Leave out the outcomes that reach nothing which is differentiated."""
        kept = sorted(frozenset().union(*(v.reached for v in self.values)))
        self.outcomes = [self.outcomes[k] for k in kept]
        self.values = [v._replace(reached=frozenset(map(kept.index, v.reached))) for v in self.values]

    def walk(self, jaxpr: Any, consts: Sequence[_Value], args: Sequence[_Value], scope: _Scope) -> list[_Value]:
        env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))

        def read(v: Any) -> _Value:
            return _Value(literal(v)) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            # What is compiled remembers where it was called first: the call from outside tells.
            inside = _Scope(f"{scope.names}/{eqn.source_info.name_stack}", scope.place or _place(eqn))
            made = self.step(eqn, [read(v) for v in eqn.invars], inside)
            env.update(zip(eqn.outvars, made, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def step(self, eqn: Any, operands: list[_Value], scope: _Scope) -> list[_Value]:
        inner, name = called(eqn), eqn.primitive.name
        meant = MEANT in scope.names
        if eqn.primitive is field_p:
            return [_Value(self.slots[eqn.params["field"], eqn.params["index"]], POINT | FIELD)]
        if eqn.primitive is frozen_p:
            return operands
        if is_mark(eqn):
            if operands[0].reached and not meant:
                axis = int(eqn.params["name"].removeprefix(DIFFERENTIATED))
                self.values.append(Differentiated(operands[0].value, axis, operands[0].reached))
            return operands
        if inner is None and name == "custom_jvp_call":
            inner = eqn.params["call_jaxpr"]
        if inner is not None:
            consts = [_Value(c) for c in inner.consts]
            return self.walk(inner.jaxpr, consts, operands[len(operands) - len(inner.jaxpr.invars) :], scope)
        if name == "scan" and eqn.params["length"] <= _UNROLL:
            return self.scan(eqn, operands, scope)
        vals = [v.value for v in operands]
        if any(slots_of(j) for j in inner_jaxprs(eqn)):
            out = control(eqn, vals, lambda j, c, a: open_fields(j, c, a, self.slots))
        else:
            out = bind(eqn, *vals)
        depends = _either(v.depends for v in operands)
        reached = frozenset().union(*(v.reached for v in operands))
        if meant:
            return [_Value(v, depends) for v in out]
        results = []
        for v, var in zip(out, eqn.outvars, strict=True):
            results.append(_Value(v, depends, reached | self.noted(eqn, v, var, operands, depends, scope)))
        self.alive += results
        if name in ("max", "min", "abs", "clamp"):
            self.kinks.append({id(v) for v in (*operands, *results)})
        self.by_user(eqn, operands, results, scope)
        return results

    def noted(
        self, eqn: Any, value: Any, var: Any, operands: list[_Value], depends: int, scope: _Scope
    ) -> frozenset[int]:
        """A new outcome, of what varies over the cloud."""
        if not depends & (POINT | FIELD):
            return frozenset()
        hidden = any(map(branching, inner_jaxprs(eqn)))
        name = eqn.primitive.name
        step = not np.issubdtype(var.aval.dtype, np.inexact) or name in _STEPS or name in _JUMPS
        if name in _JUMPS:
            value = _JUMPS[name](*(v.value for v in operands))
        if not hidden and not (step and decides(eqn)):
            return frozenset()
        self.outcomes.append(Outcome(None if hidden else value, depends, f"{_WORDS.get(name, _ANY)}{scope.place}"))
        return frozenset([len(self.outcomes) - 1])

    def scan(self, eqn: Any, operands: list[_Value], scope: _Scope) -> list[_Value]:
        p = eqn.params
        (n, m), body = scan_sizes(p), p["jaxpr"]
        fixed, carry, rows = operands[:n], operands[n : n + m], operands[n + m :]
        consts = [_Value(c) for c in body.consts]
        steps: dict[int, list[_Value]] = {}
        order = range(p["length"])
        for k in reversed(order) if p["reverse"] else order:
            row = [r._replace(value=r.value[k]) for r in rows]
            new = self.walk(body.jaxpr, consts, [*fixed, *carry, *row], scope)
            carry, steps[k] = new[:m], new[m:]
        stacked = []
        for i in range(len(eqn.outvars) - m):
            parts = [steps[k][i] for k in order]
            depends = _either(v.depends for v in parts)
            reached = frozenset().union(*(v.reached for v in parts))
            stacked.append(_Value(jnp.stack([v.value for v in parts]), depends, reached))
        return [*carry, *stacked]

    def by_user(self, eqn: Any, operands: list[_Value], results: list[_Value], scope: _Scope) -> None:
        """What an outcome decides inside of the user's own jax.grad, jax.jacfwd or such is taken as differentiated.

        The result that is differentiated has no name there: the choice itself is judged, and the choices that
        derivatives of max, min, abs and of earlier choices make are left out.
        """
        if scope.names.count("jvp(") <= scope.names.count(ALONG) or "transpose(" in scope.names:
            return
        name, varying = eqn.primitive.name, [v for v in operands if v.depends & (POINT | FIELD)]
        if not np.issubdtype(eqn.outvars[0].aval.dtype, np.inexact):
            # A comparison of the operands of a max belongs to its derivative.
            for kink in self.kinks:
                if varying and all(id(v) in kink for v in varying):
                    kink.update(id(v) for v in results)
            return
        exact = [not np.issubdtype(v.aval.dtype, np.inexact) for v in eqn.invars]
        deciding = [v for v, e in zip(operands, exact) if e and v.reached] or (varying if name in _STEPS else [])
        if not deciding or id(deciding[0]) in self.taken or any(id(deciding[0]) in kink for kink in self.kinks):
            return
        self.taken.add(id(deciding[0]))
        self.values += [Differentiated(v.value, None, v.reached) for v in results if v.reached]


_INNER = tuple(str(Path(module.__file__ or "").parent) for module in (jax,)) + (str(Path(__file__).parent.parent),)


_WORDS = {"sign": "a sign", **dict.fromkeys(("floor", "round", "ceil", "rem"), "a rounding"), "atan2": "an angle"}
_ANY = "a comparison or a look-up"


def _place(eqn: Any) -> str:
    """Where in the user's code an operation stands."""
    for frame in getattr(getattr(eqn.source_info, "traceback", None), "frames", ()):
        if not frame.file_name.startswith(_INNER) and "<frozen" not in frame.file_name:
            line = getattr(frame, "line_num", None) or getattr(frame, "start_line", "?")
            return f" in {Path(frame.file_name).name}, line {line} ({frame.function_name.split('.')[-1]}),"
    return ""
