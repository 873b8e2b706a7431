"""A problem closed: the user's functions recorded and the arrays copied, so that nothing can change it any more."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp

from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.field import RATE
from jsmitsm.equation.problem import Problem, of_parts
from jsmitsm.equation.traced import Traced
from jsmitsm.equation.tracing import trace
from jsmitsm.runtime.errors import IN_FUNCTIONS, in_words
from jsmitsm.runtime.tracers import owned


def closed(problem: Problem, traced: Traced) -> Problem:
    """The problem as it is now: its functions recorded (``traced`` is its pde's record), its arrays copied.

    What is made of it later, derivatives and estimates, is that of this problem, whatever the user's closures,
    parameters and arrays have become.
    """
    if problem.pde is traced:
        return problem
    return with_recorded(problem, traced, traced.dim)


def with_recorded(problem: Problem, pde: Any, dim: int) -> Problem:
    """The problem with the record ``pde`` (of every region, where there are several) and its conditions recorded."""
    bcs = {
        name: [_closed_condition(problem, c, dim, f"bcs[{name!r}]") for c in conditions]
        for name, conditions in problem.bcs.items()
    }
    return of_parts(pde, bcs, problem.fields, jax.tree.map(owned, problem.params))


def _closed_condition(problem: Problem, c: Condition, dim: int, where: str) -> Condition:
    components = problem.fields if c.field is None else 1

    def one(name: str, part: Any) -> Any:
        if not callable(part):
            return owned(part)
        if c.kind == "condition" or name in ("one", "two"):
            return recorded_residual(part, dim, problem, where)
        if name == "residual":
            return recorded_between(part, dim, problem, where)
        count = 1 if name == "resistance" else components
        return recorded_values(part, dim, problem.params, count, f"{where}.{name}")

    return Condition(c.kind, c.field, **{name: one(name, part) for name, part in c.parts.items()})


def recorded_values(function: Callable[..., Any], dim: int, params: Any, components: int, where: str) -> Traced:
    arguments = "x" if params is None else "x, params"
    with _named(where, f"a function of {arguments} that returns {_wanted(components)}"):
        # Without the condition's name: a function on several sides is recorded once.
        return trace(lambda u, x, *p: _shaped(function(x, *p), components), dim, components, params=params)


def recorded_residual(residual: Callable[..., Any], dim: int, problem: Problem, where: str) -> Traced:
    arguments = "u, x, n" if problem.params is None else "u, x, n, params"
    with _named(where, f"residual({arguments}) returning a scalar or a vector"):
        return _without_rates(trace(residual, dim, problem.fields, extras=((dim,),), params=problem.params), where)


def recorded_between(residual: Callable[..., Any], dim: int, problem: Problem, where: str) -> Traced:
    """The record of residual(a, b, x, n): of a field with the components of both sides, those of a first."""
    fields = problem.fields

    def both(u: Any, x: Any, n: Any, *params: Any) -> Any:
        a, b = (u[0], u[1]) if fields == 1 else (u[:fields], u[fields:])
        return residual(a, b, x, n, *params)

    arguments = "a, b, x, n" if problem.params is None else "a, b, x, n, params"
    with _named(where, f"residual({arguments}) returning a scalar or a vector"):
        return _without_rates(trace(both, dim, 2 * fields, extras=((dim,),), params=problem.params), where)


def _without_rates(record: Traced, where: str) -> Traced:
    """The record of a condition; ValueError where it asks for a rate, of which rows of conditions know nothing."""
    if any(k >= RATE for k, _ in record.slots):
        raise ValueError(
            f"{where}: js.dt(u) in a condition, which takes no rates: a steady problem has none, and in js.evolve, "
            "where the pde says what the rate is, give that a field v of its own, v(x) - js.laplacian(u)(x) = 0 for "
            "the heat equation, and write v(x) in the condition; waves leave through a layer, with s(x) * js.dt(u)(x) "
            "in the pde (docs: time)"
        )
    return record


@contextmanager
def _named(where: str, expected: str) -> Iterator[None]:
    """Say which of the user's functions failed, and what was expected of it."""
    try:
        yield
    except _NoValue as error:
        raise ValueError(f"{where}: {error}") from None
    except IN_FUNCTIONS as error:
        if str(error).startswith(where):
            raise
        raise ValueError(f"{where}: expected {expected}; calling it failed: {in_words(error)}") from error


class _NoValue(ValueError):
    """A function returned what is no value of a condition."""


def _shaped(result: Any, components: int) -> Any:
    if jnp.iscomplexobj(result):
        raise _NoValue(
            "expected real numbers, got complex ones; take jnp.real of them or js.Problem(..., dtype=complex)"
        )
    result = jnp.asarray(result, float)
    if result.size == components and result.ndim <= 1:
        return result.reshape((components,) if components > 1 else ())
    if result.ndim == 0:
        return jnp.full((components,), result)
    raise _NoValue(
        f"expected a function of one point x (D,) returning {_wanted(components)}, got shape {result.shape}"
    )


def _wanted(components: int) -> str:
    return "a scalar" if components == 1 else f"({components},), one number per field, or a scalar for all"
