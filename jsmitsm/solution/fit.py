"""How a solution was made: enough to discretise its problem again, and to fit its local polynomials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.discretization.coefficients import numbers
from jsmitsm.discretization.layout import Discretization, discretize, sorted_classes
from jsmitsm.discretization.rows import all_coefficients
from jsmitsm.runtime.progress import bar


@dataclass(frozen=True)
class Recipe:
    """How a solution was made, static: enough to fit its local polynomials again."""

    method: str
    order: int
    basis_terms: int | None
    formulation: str
    fields: int
    depth: int = 0

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
    def coefficients(self, values: Any) -> Any:
        """Taylor coefficients (N, F, K) of every particle."""
        disc = self.discretization()
        disc.classes = sorted_classes(
            disc, np.flatnonzero(disc.partner == np.arange(len(self.cloud))), disc.stencils
        )
        nums = numbers(disc, self.problem, self.taylor, everywhere=True)
        return all_coefficients(disc, nums, values)

    def tree_flatten(self):
        return (self.problem, self.cloud, self.kernel, self.neighbours, self.taylor), self.recipe

    @classmethod
    def tree_unflatten(cls, recipe, leaves):
        return cls(*leaves, recipe)
