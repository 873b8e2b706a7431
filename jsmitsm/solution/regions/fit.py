"""What a solution in several regions can be asked later: its local polynomials and its error."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.health import LEBESGUE
from jsmitsm.discretization.held_particles import held_particles
from jsmitsm.discretization.layout import sorted_classes
from jsmitsm.discretization.leave_one_out import with_held
from jsmitsm.discretization.regions.layout import Regions, discretize_regions
from jsmitsm.discretization.regions.rows import joint_rows, joints, region_numbers, whole_coefficients
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.solution.estimate import HIGH, TRUSTED, between_orders, lower
from jsmitsm.solution.fit import Recipe
from jsmitsm.solution.regions.reach import left_by_copies, slowness
from jsmitsm.solution.regions.run import RegionsRun
from jsmitsm.taylor.multi_indices import HIGHEST, multi_indices


@jax.tree_util.register_pytree_node_class
class RegionsFit:
    """What it takes to fit the local polynomials of a solution again; see ``jsmitsm.solution.fit.Fit``."""

    def __init__(self, problem: Any, cloud: Any, neighbours: Any, taylor: Any, recipe: Recipe):
        self.problem, self.cloud = problem, cloud
        self.neighbours, self.taylor, self.recipe = neighbours, taylor, recipe

    def discretization(self) -> Regions:
        r = self.recipe
        return discretize_regions(self.problem, self.cloud, r.order, r.depth, np.asarray(self.neighbours))

    @bar("fitting")
    def coefficients(self, values: Any, about: Any = None) -> Any:
        """Taylor coefficients (N, F, K) of every particle, of those with held values too.

        about: other values (N, F) whose polynomials are what held particles of a nonlinear problem are linearised at.
        """
        regions, taylor = self.discretization(), self.taylor
        bound = {i for m in regions.meetings for i in m.copies}
        if taylor is not None and regions.held.all(axis=1).any():
            # Those of held particles are continued from others; fitted where that is linearised they are their own.
            fitted = self._fitted(regions, bound, taylor, values if about is None else about)
            held = np.zeros(len(self.cloud), bool)
            for p in regions.parts:
                held[p.ids[held_particles(p.disc)]] = True
            taylor = (jnp if is_traced(fitted, taylor) else np).where(held[:, None, None], fitted, taylor)
        return self._fitted(regions, bound, taylor, values)

    def _fitted(self, regions: Regions, bound: set[int], taylor: Any, values: Any) -> Any:
        for p in regions.parts:
            alone = np.array([k for k, i in enumerate(p.ids) if int(i) not in bound], int)
            p.disc.classes = sorted_classes(p.disc, alone, p.disc.stencils)
        nums = region_numbers(regions, taylor, everywhere=True)
        return whole_coefficients(regions, nums, values)

    @bar("error estimate")
    def error_estimate(self, values: Any) -> Any:
        """The distance (N,) or (N, F) to the solution of order p + 2, or towards a lower one (see ``_doubted`` of the
        estimate in one region) where rows of that order are weak or a region is too small for them."""
        order, below = self.recipe.order, lower(self.recipe.order, max(self.recipe.operator_orders))
        if order + 2 > HIGHEST:
            raise ValueError(
                f"error_estimate: needs expansions of order p + 2 = {order + 2}, and {HIGHEST} is the highest; solve "
                f"at order {HIGHEST - 2} or below, or compare with the solution on a finer cloud"
            )
        if concrete(self.cloud.points) is None or is_traced(self.cloud.points):
            raise ValueError(
                "error_estimate: the points are traced by a JAX transform, and the wider stencils it needs are found "
                "on the host; ask for it outside the transform"
            )
        left: Callable[[], np.ndarray] | None = None
        try:
            error, weakest, left = self._towards(order + 2, values)
        except (SolveError, ValueError):
            if below == order:
                raise
            error, weakest = self._towards(below, values)[0], 0.0
        if order >= HIGH and below < order and LEBESGUE < TRUSTED * weakest and not is_traced(error):
            error = between_orders(error, self._towards(below, values)[0], values)
        elif left is not None and not is_traced(error):
            error = error * slowness(self._left(values), left())
        return abs(error[:, 0] if self.recipe.fields == 1 else error)

    def _left(self, values: Any) -> np.ndarray:
        """What the copies' fits of the solution's own order leave of their neighbours' values."""
        regions = self.discretization()
        nums = region_numbers(regions, self.taylor)
        bound = [(made, *joint_rows(regions, nums, made)) for made in joints(regions, nums)]
        return left_by_copies(regions, nums, bound, np.asarray(values))

    def _towards(self, order: int, values: Any) -> tuple[Any, float, Callable[[], np.ndarray]]:
        """What leads to the solution of another order, (N, F), by how much its rows amplify errors at the most, and
        what its copies' fits leave of their neighbours' values."""
        regions = discretize_regions(self.problem, self.cloud, order, self.recipe.depth)
        run, taylor = RegionsRun(regions, "auto", True, True, self.recipe.formulation), self.taylor
        if taylor is not None:
            size = len(multi_indices(regions.rec.dim, regions.rec.reach))
            more = ((0, 0), (0, 0), (0, max(0, size - taylor.shape[2])))
            taylor = (jnp if is_traced(taylor) else np).pad(taylor, more)[:, :, :size]
        nums = run.numbers(taylor)
        found = with_held(regions, nums, run.solved(*run.assembled(nums), balanced=False)[0])  # type: ignore[arg-type]
        left = lambda: left_by_copies(regions, nums, run.bound, np.asarray(found))
        return found - values, 1.0 if run.health is None else run.health.largest, left

    def tree_flatten(self):
        return (self.problem, self.cloud, self.neighbours, self.taylor), self.recipe

    @classmethod
    def tree_unflatten(cls, recipe, leaves):
        return cls(*leaves, recipe)


@jax.tree_util.register_pytree_node_class
class RegionPart:
    """The fit of one region of a solution: that of the whole, of which it takes its particles."""

    def __init__(self, whole: Any, values: Any, ids: tuple[int, ...]):
        self.whole, self.values, self.ids = whole, values, ids

    def coefficients(self, _: Any) -> Any:
        return self.whole.coefficients(self.values)[np.array(self.ids)]

    def error_estimate(self, _: Any) -> Any:
        return self.whole.error_estimate(self.values)[np.array(self.ids)]

    def tree_flatten(self):
        return (self.whole, self.values), self.ids

    @classmethod
    def tree_unflatten(cls, ids, leaves):
        return cls(*leaves, ids)
