"""A problem with global unknowns stated as a plain one: the unknowns ride in its params."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.problem import Problem, of_parts
from jsmitsm.equation.regions.per_region import PerRegion


def stated(problem: Problem, unknowns: Any) -> Problem:
    """The plain problem at given unknowns: its params are the pair of the problem's own and of them."""
    assert problem.extras is not None
    if not problem.extras.unknowns:  # constraints alone: its functions are called as ever
        return Problem(problem.pde, problem.bcs, problem.fields, problem.params)
    given = problem.params is not None
    pde: Any = problem.pde
    if isinstance(pde, PerRegion):
        pde = {name: _pde(one, given, f"pde[{name!r}]") for name, one in pde.items()}
    else:
        pde = _pde(pde, given, "pde")
    bcs = {name: [_condition(c, given) for c in cs] for name, cs in problem.bcs.items()}
    return Problem(pde, bcs, problem.fields, (problem.params, floats(unknowns)))


def _pde(pde: Callable[..., Any], given: bool, name: str) -> Callable[..., Any]:
    """A user's equation as one of (u, x, pair). ValueError where it cannot be called so."""
    try:
        inspect.signature(pde).bind(*[None] * (4 if given else 3))
    except TypeError as error:
        called = "pde(u, x, params, unknowns)" if given else "pde(u, x, unknowns)"
        raise ValueError(f"{name}: {error}; with unknowns it is called as {called}, all other functions alike") from None
    except ValueError:  # a callable without a signature
        pass
    return _function(pde, given)


def at(plain: Problem, unknowns: Any) -> Problem:
    """A problem of ``stated`` (recorded or not) with other unknowns."""
    if not unknowns:
        return plain
    return of_parts(plain.pde, plain.bcs, plain.fields, (plain.params[0], floats(unknowns)))


def floats(unknowns: Any) -> dict[str, Any]:
    return {name: jnp.asarray(value, float) for name, value in unknowns.items()}


def _function(function: Callable[..., Any], given: bool) -> Callable[..., Any]:
    """A user's function of (..., params, unknowns), or (..., unknowns) without params, as one of (..., pair)."""
    if given:
        return lambda *args: function(*args[:-1], *args[-1])
    return lambda *args: function(*args[:-1], args[-1][1])


def _condition(c: Condition, given: bool) -> Condition:
    parts = {name: _function(v, given) if callable(v) else v for name, v in c.parts.items()}
    return Condition(c.kind, c.field, **parts)
