"""A record without the operations whose results are known beforehand.

Derivatives bring unit vectors along, one for each axis, and most of what is done with them is to multiply by one or by
zero, and to add the zeros up. That is done once here, and not at every evaluation of the record.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from jsmitsm.equation.dependence import Facts, facts_of, known, unknown
from jsmitsm.runtime.jaxprs import EVERYTHING, Literal, Program, levels, literal


def folded(written: Program) -> Program:
    """The program with known numbers in place of what gives them, and without what changes nothing.

    The arrays that it closes over are not looked at: they may be others in a record that JAX has carried along.
    """
    if not any(eqn.primitive.name == "iota" for eqn in written.eqns):  # of which unit vectors are made
        return written
    inputs = (*written.constvars, *written.invars)
    facts: dict[Any, Facts] = {v: unknown(v.aval.shape, v.aval.dtype) for v in inputs}
    instead: dict[Any, Any] = {}

    def read(v: Any) -> Facts:
        return known(literal(v)) if isinstance(v, Literal) else facts[v]

    eqns = []
    for eqn in written.eqns:
        eqn = eqn.replace(invars=[v if isinstance(v, Literal) else instead.get(v, v) for v in eqn.invars])
        given = [read(v) for v in eqn.invars]
        found = facts_of(eqn, given)
        facts.update(zip(eqn.outvars, found, strict=True))
        same = _unchanged(eqn, given)
        if same is not None:
            instead[eqn.outvars[0]] = same
        elif len(found) == 1 and not found[0].shape and found[0].known:
            instead[eqn.outvars[0]] = Literal(found[0].value[()], eqn.outvars[0].aval)
        else:
            eqns.append(eqn)
    results = [v if isinstance(v, Literal) else instead.get(v, v) for v in written.outvars]
    made = Program(written.constvars, written.invars, tuple(results), tuple(eqns))
    return replace(made, eqns=tuple(eqn for eqn, _ in levels(made, [EVERYTHING] * len(results))))


def _unchanged(eqn: Any, facts: list[Facts]) -> Any:
    """The operand that the operation gives back, if it does: times one, or plus zero."""
    name, out = eqn.primitive.name, eqn.outvars[0].aval
    neutral = {"mul": 1, "add": 0, "add_any": 0, "sub": 0}.get(name)
    if neutral is None:
        return None
    for k, other in ((1, 0), (0, 1)) if name != "sub" else ((1, 0),):
        v = eqn.invars[other]
        alike = v.aval.shape == out.shape and v.aval.dtype == out.dtype
        if alike and facts[k].known.all() and (facts[k].value == neutral).all():
            return v
    return None
