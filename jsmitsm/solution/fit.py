"""How a solution was made: enough to discretise its problem again, and to fit its local polynomials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.discretization.coefficients import numbers
from jsmitsm.discretization.held_particles import held_particles, without_astray
from jsmitsm.discretization.layout import Discretization, discretize, sorted_classes
from jsmitsm.discretization.rows import all_coefficients
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import is_traced


@dataclass(frozen=True)
class Recipe:
    """How a solution was made, static: enough to fit its local polynomials again."""

    method: str
    order: int
    basis_terms: int | None
    formulation: str
    fields: int
    depth: int = 0
    operator_orders: tuple[int, ...] = ()
    otherwise: bool = False  # whether integrals take the other rule, by which their error is told

    @property
    def reach(self) -> int:
        """The degree of the local polynomials."""
        return self.order + self.depth


@jax.tree_util.register_pytree_node_class
class Fit:
    """What it takes to fit the local polynomials of a solution again.

    taylor : (N, F, K) the expansions about which a nonlinear problem was last linearised, or None.
    """

    def __init__(self, problem, cloud, kernel, neighbours, taylor, recipe):
        self.problem, self.cloud, self.kernel = problem, cloud, kernel
        self.neighbours, self.taylor = neighbours, taylor
        self.recipe = recipe

    def discretization(self) -> Discretization:
        near = Stencils(self.neighbours, None)
        r = self.recipe
        return discretize(self.problem, self.cloud, r.method, r.order, self.kernel, near, r.basis_terms, depth=r.depth)

    @bar("fitting")
    def coefficients(self, values: Any, about: Any = None, known: Any = None) -> Any:
        """Taylor coefficients (N, F, K) of every particle.

        about: other values (N, F) whose polynomials are what held particles of a nonlinear problem are linearised at.
        known: those of the particles that carry equations, where they are at hand.
        """
        disc, taylor = self.discretization(), self.taylor
        held = held_particles(disc)
        if known is not None:
            found = without_astray(disc, self._fitted(disc, held, taylor, values), values) if len(held) else known
            return np.where(np.isin(disc.partner, held)[:, None, None], found, known)
        if taylor is not None and len(held):
            # Those of held particles are continued from others; fitted where that is linearised they are their own.
            fitted = self._fitted(disc, held, taylor, values if about is None else about)
            alone = np.isin(disc.partner, held)[:, None, None]
            taylor = (jnp if is_traced(fitted, taylor) else np).where(alone, fitted, taylor)
        found = self._fitted(disc, np.flatnonzero(disc.partner == np.arange(len(self.cloud))), taylor, values)
        return without_astray(disc, found, values)

    def _fitted(self, disc: Discretization, ids: np.ndarray, taylor: Any, values: Any) -> Any:
        """Taylor coefficients (N, F, K) of the particles ``ids`` alone, linearised at ``taylor``."""
        disc.classes = sorted_classes(disc, ids, disc.stencils)
        nums = numbers(disc, self.problem, taylor, everywhere=True)
        return all_coefficients(disc, nums, values)

    def tree_flatten(self):
        return (self.problem, self.cloud, self.kernel, self.neighbours, self.taylor), self.recipe

    @classmethod
    def tree_unflatten(cls, recipe, leaves):
        return cls(*leaves, recipe)
