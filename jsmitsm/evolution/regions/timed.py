"""A problem with several regions in time: the parts of each, and conditions between them that know the time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.discretization.regions.rows import spread_values
from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.closing import with_recorded
from jsmitsm.equation.problem import Problem, of_parts
from jsmitsm.equation.regions.between import check_regions, region_of
from jsmitsm.equation.regions.interface import INTERFACE
from jsmitsm.equation.regions.per_region import PerRegion
from jsmitsm.evolution.space.timed import Timed, at_moment, check_conditions, condition_in_time, in_time, timed

_VALUES = ("jump", "source", "resistance")


@dataclass
class RegionsTimed:
    """What ``Timed`` is to a problem of one region.

    problem : closed, its equations the records of L of each region, its params (t, params). parts: those of each.
    """

    problem: Problem
    parts: dict[str, Timed]
    ids: dict[str, np.ndarray]
    steady: bool
    quasilinear: bool = False
    linear: bool = True
    flow: None = None

    @property
    def masses(self) -> tuple[Any, ...]:
        """The records of the rates, by order; all regions have rates of the same fields."""
        return next(iter(self.parts.values())).masses

    @property
    def rest(self) -> tuple[Any, ...]:
        return tuple(part.rest for part in self.parts.values())

    @property
    def apart(self) -> tuple[Any, ...]:
        return tuple(part.apart for part in self.parts.values())

    @property
    def values(self) -> bool:
        """Whether there are values of u apart from the operator in any region."""
        return any(part.values for part in self.parts.values())

    @property
    def order(self) -> int:
        """That of the highest derivatives in space."""
        return max(part.order for part in self.parts.values())

    def at(self, t: Any, params: Any = None) -> Problem:
        """The closed problem at a moment; params: others than its own."""
        return at_moment(self.problem, t, params)

    def mass(self, order: int, points: Any, params: Any) -> Any:
        """Coefficients (N, E, F) of the rates of this order; of order 0 those of values."""
        found = [part.mass(order, points[self.ids[name]], params) for name, part in self.parts.items()]
        fields = self.problem.fields
        return spread_values(found, list(self.ids.values()), (len(points), fields, fields))


def regions_timed(problem: Problem, cloud: RegionCloud) -> RegionsTimed:
    """Record a problem with several regions in time; ValueError where it is none, or one that is not made."""
    check_regions(problem, cloud)
    parts = {}
    for name in cloud.regions:
        try:
            parts[name] = timed(region_of(problem, cloud, name), cloud.region(name))
        except ValueError as error:
            raise ValueError(f"{error} (in the region {name!r})") from error
        _check_part(name, parts[name])
    first, *others = parts.values()
    if any(_moved(part) != _moved(first) for part in others):
        raise ValueError("pde: a field has a rate in one region and none in another, which js.evolve does not do")
    with_params = problem.params is not None
    bcs = {
        name: [_condition(c, with_params, f"bcs[{name!r}]") for c in conditions]
        for name, conditions in problem.bcs.items()
    }
    operators = PerRegion({name: part.operator for name, part in parts.items()})
    whole = of_parts(operators, bcs, problem.fields, (np.asarray(0.0), problem.params))
    closed = with_recorded(whole, operators, cloud.dim)
    moves = check_conditions(closed)
    steady = not moves and all(part.steady for part in parts.values())
    return RegionsTimed(closed, parts, dict(cloud.regions), steady)


def _check_part(name: str, part: Timed) -> None:
    if part.masses[1].slots:
        raise ValueError(
            f"pde[{name!r}]: of second order in time, which js.evolve does for one region alone; several take "
            "js.dt(u)(x), the first rate"
        )
    if not part.linear:
        raise ValueError(
            f"pde[{name!r}]: nonlinear in u, or with coefficients that depend on t, which js.evolve does for one "
            "region alone; linearise it, or step by backward Euler and js.solve, with (u - old) / dt for the rate"
        )


def _moved(part: Timed) -> set[Any]:
    return set(part.masses[0].slots)


def _condition(c: Condition, with_params: bool, where: str) -> Condition:
    """A condition, or one on an interface, as one of the parameters (t, params)."""
    if c.kind != INTERFACE:
        return condition_in_time(c, with_params, where)
    forms = {
        **dict.fromkeys(_VALUES, (("x, t", 2), ("x", 1))), "residual": (("a, b, x, n, t", 5), ("a, b, x, n", 4)),
        **dict.fromkeys(("one", "two"), (("u, x, n, t", 4), ("u, x, n", 3))),
    }  # fmt: skip

    def one(name: str, part: Any) -> Any:
        return in_time(part, with_params, forms[name], f"{where}.{name}", c.kind) if callable(part) else part

    return Condition(c.kind, c.field, **{name: one(name, part) for name, part in c.parts.items()})
