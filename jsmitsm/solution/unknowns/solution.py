"""The solution of a problem with constraints."""

from __future__ import annotations

from typing import Any

import jax

from jsmitsm.solution.regions.solution import RegionsSolution
from jsmitsm.solution.solution import Solution


class WithUnknowns(Solution):
    """A solution, and the global unknowns that were found with it."""

    def __init__(self, *args: Any, unknowns: dict[str, Any], **more: Any):
        super().__init__(*args, **more)
        self._unknowns = unknowns

    @property
    def unknowns(self) -> dict[str, Any]:
        return dict(self._unknowns)

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, unknowns: {', '.join(self._unknowns) or 'none'})"

    def tree_flatten(self):
        leaves, recipe = super().tree_flatten()
        return (leaves, self._unknowns), recipe

    @classmethod
    def tree_unflatten(cls, recipe, leaves):
        plain, unknowns = leaves
        new = super().tree_unflatten(recipe, plain)
        new._unknowns = unknowns
        return new


@jax.tree_util.register_pytree_node_class
class ConstrainedSolution(WithUnknowns):
    """In one region."""


@jax.tree_util.register_pytree_node_class
class ConstrainedRegionsSolution(WithUnknowns, RegionsSolution):
    """In several regions."""


class Probing(Solution):
    """A solution on its way through a functional: its polynomials are fitted once, traced or not."""

    @property
    def _taylor(self) -> Any:
        if self._fitted is None:
            self._fitted = self._fit.coefficients(self._values)
        return self._fitted


class Probe(Probing, ConstrainedSolution):
    """In one region."""


class RegionsProbe(Probing, ConstrainedRegionsSolution):
    """In several regions."""
