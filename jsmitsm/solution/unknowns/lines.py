"""Constraints as rows of the bordered system: by how much they are missed, and their slopes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.equation.problem import Problem
from jsmitsm.runtime.errors import IN_FUNCTIONS, in_words
from jsmitsm.solution.fit import Recipe
from jsmitsm.solution.unknowns.bordered import Bordered, BorderedRegionsRun
from jsmitsm.solution.unknowns.solution import Probe, RegionsProbe

# A constraint is met when it misses by this part of what it is made of; round-off of the fits leaves 1e-12.
MET = 1e-9


class Lines:
    """The C constraints of a problem with K unknowns."""

    def __init__(self, problem: Problem, run: Bordered, recipe: Recipe):
        assert problem.extras is not None
        self.problem, self.run, self.recipe = problem, run, recipe
        self.constraints, self.names = problem.extras.constraints, list(problem.extras.unknowns)
        self.kind: Any = RegionsProbe if isinstance(run, BorderedRegionsRun) else Probe

    def missed(self, values: Any, unknowns: dict[str, Any], taylor: Any = None) -> Any:
        """By how much the constraints (C,) are missed; taylor: about which a nonlinear problem is linearised."""
        fit = self.run.fit(unknowns, values, self.recipe, taylor)
        probe = self.kind(values, self.run.disc.cloud, self.recipe, fit, True, 1, {}, unknowns=unknowns)
        return jnp.stack([_value(c, probe, k) for k, c in enumerate(self.constraints)])

    def slopes(self, values: Any, unknowns: dict[str, Any], taylor: Any = None) -> tuple[Any, Any, Any]:
        """What is missed (C,), and its derivatives by the values (C, N F) and by the unknowns (C, K)."""
        missed: Callable[..., Any] = lambda v, g: self.missed(v, g, taylor)  # noqa: E731
        rest, pull = jax.vjp(missed, jnp.asarray(values, float), unknowns)
        slopes = [pull(row) for row in np.eye(len(self.constraints))]
        by_value = jnp.stack([v.reshape(-1) for v, _ in slopes])
        none = jnp.zeros((len(slopes), 0))
        by_unknown = jnp.stack([jnp.stack([g[n] for n in self.names]) for _, g in slopes]) if self.names else none
        return rest, by_value, by_unknown

    def met(self, rest: Any, by_value: Any, by_unknown: Any, values: Any, unknowns: dict[str, Any]) -> Any:
        """Whether what is missed is small beside what it is made of."""
        size = abs(by_value) @ abs(values).reshape(-1) + sum(
            (abs(by_unknown[:, k] * unknowns[n]) for k, n in enumerate(self.names)),
            abs(jnp.stack([jnp.asarray(c.value, float) for c in self.constraints])),
        )
        return jnp.all(abs(rest) <= MET * jnp.where(size > 0, size, 1.0))

    def of_free(self, by_value: Any) -> Any:
        """Slopes (C, n) by the free values, from those by all (C, N F): a periodic image adds to its partner's."""
        disc = self.run.disc
        number = disc.unknowns.reshape(-1)
        place = np.flatnonzero(number >= 0)
        count = int((~disc.held).sum())
        return jnp.zeros((len(by_value), count)).at[:, number[place]].add(by_value[:, place])


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
