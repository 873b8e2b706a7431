"""A problem with global unknowns or an integral term stated as a plain one: what is found rides in its params."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.problem import Problem, of_parts
from jsmitsm.equation.regions.per_region import PerRegion
from jsmitsm.equation.unknowns.integral import added


def stated(problem: Problem, unknowns: Any, points: Any = None) -> Problem:
    """The plain problem at given unknowns: its params are the problem's own, they, and what an integral term carries.

    points (N, D): the particles, over which the integral term sums; not given, it is left out.
    """
    assert problem.extras is not None
    kernels, named = {} if points is None else dict(problem.extras.kernels), bool(problem.extras.unknowns)
    if not named and not kernels:  # constraints alone: its functions are called as ever
        return Problem(problem.pde, problem.bcs, problem.fields, problem.params)
    given, fields = problem.params is not None, problem.fields
    pde: Any = problem.pde

    def made(one: Callable[..., Any], name: str | None) -> Callable[..., Any]:
        plain = _pde(one, given, named, "pde" if name is None else f"pde[{name!r}]")
        if name not in kernels:
            return plain

        def with_integral(u: Any, x: Any, parts: Any) -> Any:
            term = added(kernels[name], points, parts[2], fields)
            value = plain(u, x, parts)
            value = jnp.stack(list(value)) if isinstance(value, (list, tuple)) else value
            return value + term(x, *([parts[0]] if given else []))

        return with_integral

    pde = {n: made(one, n) for n, one in pde.items()} if isinstance(pde, PerRegion) else made(pde, None)
    bcs = {name: [_condition(c, given, named) for c in cs] for name, cs in problem.bcs.items()}
    carried = np.zeros((len(points) if kernels else 0, fields))
    return Problem(pde, bcs, fields, (problem.params, floats(unknowns), carried))


def _pde(pde: Callable[..., Any], given: bool, named: bool, name: str) -> Callable[..., Any]:
    """A user's equation as one of (u, x, parts). ValueError where it cannot be called so."""
    try:
        if named:
            inspect.signature(pde).bind(*[None] * (4 if given else 3))
    except TypeError as error:
        called = "pde(u, x, params, unknowns)" if given else "pde(u, x, unknowns)"
        raise ValueError(
            f"{name}: {error}; with unknowns it is called as {called}, all other functions alike"
        ) from None
    except ValueError:  # a callable without a signature
        pass
    return _function(pde, given, named)


def at(plain: Problem, unknowns: Any, carried: Any = None) -> Problem:
    """A problem of ``stated`` (recorded or not) with other unknowns, or other values carried by its integral term."""
    if not unknowns and carried is None:
        return plain
    params, _, before = plain.params
    return of_parts(
        plain.pde, plain.bcs, plain.fields, (params, floats(unknowns), before if carried is None else carried)
    )  # fmt: skip


def begun(problem: Problem, u0: Any) -> Any:
    """A user's start, a function of (x[, params]), an array or a dict of these, as one of the plain problem's."""
    if isinstance(u0, Mapping):
        return {name: begun(problem, one) for name, one in u0.items()}
    extras = problem.extras
    if not callable(u0) or extras is None or not (extras.unknowns or extras.kernels):
        return u0
    given = problem.params is not None
    return lambda x, parts: u0(x, *([parts[0]] if given else []))


def floats(unknowns: Any) -> dict[str, Any]:
    return {name: jnp.asarray(value, float) for name, value in unknowns.items()}


def _function(function: Callable[..., Any], given: bool, named: bool) -> Callable[..., Any]:
    """A user's function of (..., [params, ][unknowns]) as one of (..., parts)."""

    def called(*args: Any) -> Any:
        params, unknowns, _ = args[-1]
        return function(*args[:-1], *([params] if given else []), *([unknowns] if named else []))

    return called


def _condition(c: Condition, given: bool, named: bool) -> Condition:
    parts = {name: _function(v, given, named) if callable(v) else v for name, v in c.parts.items()}
    return Condition(c.kind, c.field, **parts)
