"""The global system bordered by global unknowns and constraints.

A problem that is linear in u and in its unknowns g has A u = b + B (g - g0), and linear constraints read
C u + D (g - g0) = d. Both are solved at once,

    [ A  -B ] [ u      ]   [ b ]
    [ C   D ] [ g - g0 ] = [ d ],

which is regular where A alone is not, as for slopes given all around. A field that the conditions leave free up to a
constant, and a constraint without an unknown, have for B a column of ones: the unknown is a multiplier then, zero for
data that balance.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.discretization.coefficients import Numbers, numbers
from jsmitsm.discretization.layout import Discretization, discretize, table
from jsmitsm.discretization.least_squares import least_squares_right_side
from jsmitsm.discretization.leave_one_out import right_side
from jsmitsm.discretization.periodic import with_corners
from jsmitsm.discretization.regions.layout import Regions, discretize_regions
from jsmitsm.discretization.regions.rows import RegionNumbers, region_numbers, whole_right_side, whole_table
from jsmitsm.equation.conditions import group_conditions
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.unknowns.stated import at
from jsmitsm.particle.recursion import Recursion
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.fit import Fit, Recipe
from jsmitsm.solution.regions.fit import RegionsFit
from jsmitsm.solution.regions.run import RegionsRun
from jsmitsm.solution.run import Run
from jsmitsm.solution.unknowns.integral import IntegralTerm


class Bordered(Run, ABC):
    """A linear solve with rows and columns more: ``columns`` (n, K), ``lines`` (K, n), ``corner`` (K, K)."""

    def __init__(self, *args: Any):
        super().__init__(*args)
        self.columns: Any = np.zeros((int((~self.disc.held).sum()), 0))
        self.lines: Any = self.columns.T
        self.corner: Any = np.zeros((0, 0))
        self.right: Any = np.zeros(0)
        self.system: tuple[Any, Any, Any] = (np.zeros(0), np.zeros(0, int), np.zeros(0, int))  # entries and places
        self.squares: list[Any] = []  # parts of the least-squares form
        self.names: list[str] = []  # of the unknowns that the columns are of
        self.multipliers = False  # whether the columns are those of free constants
        # The integral term of the problem, and the problem with it; ``problem`` is without.
        self.term: IntegralTerm | None = None
        self.whole: Problem | None = None

    @property
    def floating(self) -> tuple[int, ...]:
        return self.disc.floating if self.multipliers else ()

    def assembled(self, nums: Any, parts: Any = None) -> tuple[Any, Any, Any, Any]:
        data, r, c, b = super().assembled(nums, parts)
        if self.term is None:
            return data, r, c, b
        if self.least_squares:
            raise ValueError(
                "integral: the equation takes the least-squares form, for which integral terms are not made; say "
                'formulation="loo" where information does not travel'
            )
        self.term.assemble(self._right_of, lambda make: self.sources_alone(nums, make), self.disc.unknowns)
        return *self._with_term(data, r, c), b + self.term.shift_of(nums.held)

    def _with_term(self, data: Any, r: Any, c: Any) -> tuple[Any, Any, Any]:
        """The entries of the matrix and those of the integral term."""
        if self.term is None:
            return data, r, c
        block, n = self.term.block, len(self.term.block)
        xp: Any = jnp if is_traced(data, block) else np
        rows, columns = np.divmod(np.arange(n * n), max(n, 1))
        return xp.concatenate([data, block.reshape(-1)]), np.concatenate([r, rows]), np.concatenate([c, columns])

    def factor_of(self, data: Any, r: Any, c: Any) -> Any:
        return super().factor_of(*self._with_term(data, r, c))

    def right_of(self, nums: Any) -> Any:
        """The right-hand side (n,) that belongs to the rows of the last step."""
        right = self._right_of(nums)
        return right if self.term is None else right + self.term.shift_of(nums.held)

    @abstractmethod
    def sources_alone(self, nums: Any, make: Callable[[str | None, Any, Recursion], Any]) -> Any:
        """The numbers of the same operators without values of any kind, with other sources: see ``IntegralTerm``."""

    def at(self, unknowns: dict[str, Any], values: Any) -> Problem:
        """The problem with other unknowns; with an integral term that of these values (N, F)."""
        if self.term is None or values is None:
            return at(self.problem, unknowns)
        assert self.whole is not None
        return at(self.whole, unknowns, self.term.carried(values))

    @property
    def bordering(self) -> int:
        return len(self.corner)

    @abstractmethod
    def moved(self, unknowns: dict[str, Any], values: Any = None) -> Any:
        """The discretisation of the problem with other unknowns, and with values (N, F) of its integral term."""

    @abstractmethod
    def numbers_of(self, disc: Any) -> Any:
        """The numbers of one of these."""

    @abstractmethod
    def _right_of(self, nums: Any) -> Any:
        """The right-hand side (n,) without what an integral term adds."""

    @abstractmethod
    def fit(self, unknowns: dict[str, Any], values: Any, recipe: Recipe, taylor: Any = None) -> Any:
        """What fits the local polynomials of values that belong to these unknowns."""

    @abstractmethod
    def plain(self) -> Run:
        """A run of the problem for its unknowns as they are, without constraints."""

    def go(self, unknowns: dict[str, Any], values: Any = None) -> None:
        """Become the run of the problem with other unknowns."""
        self.disc = self.moved(unknowns, values)
        self.problem = self.disc.problem

    def constants(self) -> np.ndarray:
        """Columns of ones (n, K) for the fields that are free up to a constant."""
        field = np.flatnonzero(~self.disc.held.reshape(-1)) % self.disc.rec.fields
        return (field[:, None] == np.array(self.disc.floating, int)).astype(float)

    def _bordered(self, data: Any, r: Any, c: Any, b: Any) -> tuple[Any, Any, Any, Any, Any]:
        disc, count = self.disc, self.bordering
        free = np.flatnonzero(~disc.held.reshape(-1))
        n, every = len(free), np.arange(len(free))
        points = None if is_traced(disc.cloud.points) else np.asarray(disc.cloud.points)[free // disc.rec.fields]
        xp: Any = jnp if is_traced(data, b, self.columns, self.lines, self.corner, self.right) else np
        added = np.arange(n, n + count)
        parts = (self.columns.T, self.lines, self.corner)
        data = xp.concatenate([data, *(xp.asarray(p).reshape(-1) for p in parts)])
        across, along = np.tile(every, count), np.repeat(added, n)
        r = np.concatenate([r, across, along, np.repeat(added, count)])
        c = np.concatenate([c, along, across, np.tile(added, count)])
        if points is not None:
            points = np.concatenate([points, np.full((count, points.shape[1]), np.nan)])
        return data, r, c, xp.concatenate([b, xp.asarray(self.right)]), points

    def fail(self, message: str, particles: Any = ()) -> None:
        if "is a condition missing" in message:
            message += " Or two constraints say the same, or one sees nothing of what is unknown"
            if unseen := self.unseen():
                message += f"; neither equations nor constraints know of {unseen}"
        super().fail(message, particles)

    def unseen(self) -> list[str]:
        """The unknowns on which nothing depends."""
        if is_traced(self.columns, self.corner) or len(self.names) != np.shape(self.columns)[1]:
            return []
        seen = np.abs(self.columns).max(axis=0, initial=0.0) + np.abs(self.corner).max(axis=0, initial=0.0)
        return [name for name, some in zip(self.names, seen) if some == 0]

    def check_balance(self, taylor: Any = None) -> None:
        super().check_balance(taylor)
        self.messages = [m for m in self.messages if "its mean over the particles is 0" not in m]


class BorderedRun(Bordered):
    """In one region."""

    def moved(self, unknowns: dict[str, Any], values: Any = None) -> Discretization:
        problem, disc = self.at(unknowns, values), self.disc
        if self.term is not None and values is not None:
            near, rec = Stencils(table(disc), None), disc.rec
            return discretize(problem, disc.cloud, disc.scheme.method, rec.order, None, near, None, depth=rec.depth)
        groups = group_conditions(problem, with_corners(problem, disc.cloud), disc.rec.order, disc.traced.order)
        return replace(disc, problem=problem, groups=groups)

    def numbers_of(self, disc: Discretization) -> Numbers:
        return numbers(disc, disc.problem)

    def _right_of(self, nums: Numbers) -> Any:
        if self.formulation == "lsq":
            return least_squares_right_side(self.disc, nums, self.squares)
        assert self.rows is not None
        return right_side(self.disc, nums, *self.rows)

    def sources_alone(self, nums: Numbers, make: Any) -> Numbers:
        return _alone(nums, make(None, self.disc.cloud.points[nums.ids], self.disc.rec))

    def fit(self, unknowns: dict[str, Any], values: Any, recipe: Recipe, taylor: Any = None) -> Fit:
        disc = self.disc
        return Fit(self.at(unknowns, values), disc.cloud, disc.kernel, table(disc), taylor, recipe)

    def plain(self) -> Run:
        return Run(self.disc, self.problem, self.solver, True, self.repair, self.formulation)


class BorderedRegionsRun(Bordered, RegionsRun):
    """In several regions."""

    def moved(self, unknowns: dict[str, Any], values: Any = None) -> Regions:
        disc = self.disc
        problem, near, sources = self.at(unknowns, values), whole_table(disc), self.term is not None
        return discretize_regions(problem, disc.cloud, disc.rec.order, disc.rec.depth, near, sources=sources)

    def numbers_of(self, disc: Regions) -> RegionNumbers:
        return region_numbers(disc)

    def _right_of(self, nums: RegionNumbers) -> Any:
        return whole_right_side(self.disc, nums, self.parts, self.bound)

    def sources_alone(self, nums: RegionNumbers, make: Any) -> RegionNumbers:
        parts = [
            _alone(own, make(p.name, p.disc.cloud.points[own.ids], p.disc.rec))
            for p, own in zip(self.disc.parts, nums.parts)
        ]
        between = {name: (coef, np.zeros(np.shape(value))) for name, (coef, value) in nums.between.items()}
        return RegionNumbers(parts, between, np.zeros(np.shape(nums.held)))

    def fit(self, unknowns: dict[str, Any], values: Any, recipe: Recipe, taylor: Any = None) -> RegionsFit:
        return RegionsFit(self.at(unknowns, values), self.disc.cloud, whole_table(self.disc), taylor, recipe)

    def plain(self) -> Run:
        return RegionsRun(self.disc, self.solver, True, self.repair, self.form)


def _alone(nums: Numbers, source: Any) -> Numbers:
    given, held, gamma = (np.zeros(np.shape(x)) for x in (nums.given, nums.held, nums.gamma))
    return replace(nums, source=source, given=given, held=held, gamma=gamma)
