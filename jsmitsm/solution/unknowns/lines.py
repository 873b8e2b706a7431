"""Constraints as rows of the bordered system: by how much they are missed, and their slopes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.equation.problem import Problem
from jsmitsm.runtime.errors import IN_FUNCTIONS, in_words
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.runtime.whole_program import in_one_program
from jsmitsm.solution.fit import Recipe
from jsmitsm.solution.unknowns.bordered import Bordered, BorderedRegionsRun
from jsmitsm.solution.unknowns.solution import Probe, RegionsProbe

# A constraint is met when it misses by this part of what it is made of; round-off of the fits leaves 1e-12.
MET = 1e-9
# Part of an unknown by which it is moved for a difference where the problem is not linear.
MOVED = 1e-5


class Lines:
    """The C constraints of a problem with K unknowns."""

    def __init__(self, problem: Problem, run: Bordered, recipe: Recipe):
        assert problem.extras is not None
        self.problem, self.run, self.recipe = problem, run, recipe
        self.constraints, self.names = problem.extras.constraints, list(problem.extras.unknowns)
        self.kind: Any = RegionsProbe if isinstance(run, BorderedRegionsRun) else Probe

    def missed(self, values: Any, unknowns: dict[str, Any], taylor: Any = None) -> Any:
        """By how much the constraints (C,) are missed; taylor: about which a nonlinear problem is linearised."""
        return self._missed(self.run.fit(unknowns, values, self.recipe, taylor), values, unknowns)[0]

    def _missed(self, fit: Any, values: Any, unknowns: dict[str, Any], fitted: Any = None) -> tuple[Any, Any]:
        """With the local polynomials (N, F, K), None where nothing asks for them."""
        cloud = self.run.disc.cloud
        probe = self.kind(values, cloud, self.recipe, fit, True, 1, {}, fitted=fitted, unknowns=unknowns)
        return jnp.stack([_value(c, probe, k) for k, c in enumerate(self.constraints)]), probe._fitted

    def slopes(self, values: Any, unknowns: dict[str, Any], taylor: Any = None) -> tuple[Any, Any, Any]:
        """What is missed (C,), and its derivatives by the values (C, N F) and by the unknowns (C, K).

        With the polynomials P(v, g) between, c(v, P, g) has the slopes c_v + c_P P_v and c_g + c_P P_g. P_v takes what
        held particles of a nonlinear problem are linearised at for given, and P_g are differences. So nothing that the
        equation is made of is differentiated, and the polynomials are linear in g where the problem is.
        """
        values = jnp.asarray(values, float)
        made: Callable[..., Any] = lambda v, g: self.run.fit(g, v, self.recipe, taylor)  # noqa: E731
        fit = made(values, unknowns)
        rest, fitted = self._missed(fit, values, unknowns)
        missed: Callable[..., Any] = lambda v, g, *p: self._missed(fit, v, g, *p)[0]  # noqa: E731
        _, pull = jax.vjp(missed, values, unknowns, *([] if fitted is None else [fitted]))
        by_v, by_g, *by_p = zip(*(pull(row) for row in np.eye(len(rest))))
        by_value, by_unknown = jnp.stack(by_v), [jnp.stack([g[n] for g in by_g]) for n in self.names]
        if by_p:
            _, pull = jax.vjp(lambda v: made(v, unknowns).coefficients(v, about=values), values)
            by_value += jnp.stack([pull(p)[0] for p in by_p[0]])
            for k, (name, move) in enumerate(zip(self.names, self.moves(unknowns, linear=taylor is None))):
                there = made(values, {**unknowns, name: unknowns[name] + move}).coefficients(values)
                grown = (there - fitted) / move
                by_unknown[k] += jnp.stack([jnp.vdot(p, grown) for p in by_p[0]])
        none = jnp.zeros((len(rest), 0))
        return rest, by_value.reshape(len(rest), -1), jnp.stack(by_unknown, axis=1) if by_unknown else none

    def moves(self, unknowns: dict[str, Any], linear: bool) -> list[Any]:
        """By how much each unknown is moved for a difference: as much as it is or was, or one; a small part of it where
        something is not linear. Numbers where they are known."""
        assert self.problem.extras is not None
        begin = self.problem.extras.unknowns
        return [_size(unknowns[n], begin[n]) * (1.0 if linear else MOVED) for n in self.names]

    def met(self, rest: Any, by_value: Any, by_unknown: Any, values: Any, unknowns: dict[str, Any]) -> Any:
        """Whether what is missed is small beside what it is made of."""
        wanted = [c.value for c in self.constraints]
        return _met(rest, by_value, by_unknown, values, [unknowns[n] for n in self.names], wanted)

    def of_free(self, by_value: Any) -> Any:
        """Slopes (C, n) by the free values, from those by all (C, N F): a periodic image adds to its partner's."""
        disc = self.run.disc
        number = disc.unknowns.reshape(-1)
        place = np.flatnonzero(number >= 0)
        return _added(by_value, place, number[place], int((~disc.held).sum()))


@in_one_program
def _met(rest: Any, by_value: Any, by_unknown: Any, values: Any, unknowns: list[Any], wanted: list[Any]) -> Any:
    xp: Any = jnp if is_traced(rest, by_value, by_unknown, values, unknowns, wanted) else np
    moved = xp.abs(by_unknown) @ xp.abs(xp.array(unknowns, float))
    size = xp.abs(by_value) @ xp.abs(values).reshape(-1) + moved + xp.abs(xp.array(wanted, float))
    return xp.all(xp.abs(rest) <= MET * xp.where(size > 0, size, 1.0))


@partial(in_one_program, static=("count",))
def _added(by_value: Any, place: Any, number: Any, count: int) -> Any:
    """Columns ``place`` of slopes (C, N F), each added to the column ``number`` of (C, count)."""
    if is_traced(by_value):
        return jnp.zeros((len(by_value), count)).at[:, number].add(by_value[:, place])
    out = np.zeros((count, len(by_value)))
    np.add.at(out, number, np.asarray(by_value)[:, place].T)
    return out.T


def number(x: Any) -> Any:
    """The numbers behind x, or where there are none x without derivatives."""
    known = concrete(x)
    return jax.lax.stop_gradient(x) if known is None else np.asarray(known)


def _size(now: Any, begin: Any) -> Any:
    now, begin = number(now), number(begin)
    xp: Any = jnp if is_traced(now, begin) else np
    return xp.maximum(abs(now), xp.where(begin != 0, abs(begin), 1.0))


def _value(c: Any, probe: Any, k: int) -> Any:
    try:
        found = jnp.asarray(c.functional(probe))
    except IN_FUNCTIONS as error:
        raise ValueError(
            f"constraints[{k}]: calling functional(sol) failed: {in_words(error)}; write it with jax.numpy, of what "
            "sol offers: u, values and derivatives at points, integral, flux, unknowns"
        ) from error
    if found.shape or jnp.iscomplexobj(found):
        raise ValueError(f"constraints[{k}]: functional(sol) must return a real scalar, got shape {found.shape}")
    return found - c.value
