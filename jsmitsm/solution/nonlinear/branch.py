"""A branch of solutions followed by its arc length, through turning points (Keller 1977).

At fixed expansions a Newton step at the parameter c leads to values u(c), and one at a parameter near by tells how they
change with it, t = du/dc: the tangent from one more solve. A step of the branch is a step of Newton's method in (u, c),

    u_new = u(c) + d t,   c_new = c + d,

with d such that the point lies at the wanted distance along the tangent of the point before. The expansions are
combined as the values are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.problem import Problem
from jsmitsm.runtime.errors import SolveError
from jsmitsm.solution.nonlinear.steps import Iterate, advance, distance
from jsmitsm.solution.run import Run
from jsmitsm.solution.solution import Solution
from jsmitsm.solution.solve import finished, prepared, solve

# The change of the parameter by which the tangent is measured, relative to the distance of the first two.
NUDGE = 1e-6
# Newton's steps at a point, and the change of the last one. Up to QUICK of them, and a turn of the tangent by less than
# the first angle (its cosine), the next step is longer; a turn by more than the second is too much.
MOST, CLOSE, QUICK = 8, 1e-8, 4
STRAIGHT, BENT, GROWTH = 0.97, 0.8, 1.6
# The first step, in distances of the first two parameters; and the shortest.
FIRST, SHORTEST = 0.5, 1e-5


class Branch(list[Solution]):
    """Solutions at the parameters that were asked for, as far as the branch reached them.

    Attributes
    ----------
    parameters : those reached, one for each solution.
    branch : list of (parameter, Solution), every step of the way from the first on.
    folds : the parameters at which the branch turns back.
    """

    def __init__(self, first: float, sol: Solution):
        super().__init__([sol])
        self.parameters = [first]
        self.branch = [(first, sol)]
        self.folds: list[float] = []

    def __repr__(self) -> str:
        folds = f", folds at {', '.join(f'{c:.6g}' for c in self.folds)}" if self.folds else ""
        return f"Branch(solutions at {self.parameters}, {len(self.branch)} steps{folds})"


@dataclass
class Point:
    """A point of the branch and its unit tangent: of values and expansions, and of the parameter."""

    at: Iterate
    parameter: float
    along: Iterate
    rate: float
    sol: Solution


class Follower:
    """Takes steps along the branch of ``problem(parameter)``."""

    def __init__(self, problem: Callable[[float], Problem], cloud: Cloud, unit: float, options: dict[str, Any]):
        self.problem, self.cloud, self.unit, self.options = problem, cloud, unit, options
        self.size = 0.0  # of the values, so that the first tangent counts them as much as the parameter
        self.first: Run | None = None

    def run(self, parameter: float) -> Run:
        """The discretisation at a parameter, with the stencils of the first one."""
        run = prepared(self.problem(parameter), self.cloud, **self.options)
        if self.first is None:
            self.first = run
        elif run.repair:
            run.disc.classes, run.health = self.first.disc.classes, self.first.health
            run.formulation = self.first.formulation
        return run

    def product(self, x: Any, y: Any, a: float, b: float) -> float:
        return float(np.mean(x * y)) / self.size**2 + a * b / self.unit**2

    def steps(self, at: Iterate, parameter: float) -> tuple[Run, Iterate, Iterate]:
        """A Newton step from ``at``, and the derivative of where it leads by the parameter."""
        run, nudge = self.run(parameter), NUDGE * self.unit
        made = advance(run, at.taylor).numbers()
        other = advance(self.run(parameter + nudge), at.taylor).numbers()
        return run, made, Iterate(*((y - x) / nudge for x, y in zip(made, other)))

    def point(self, at: Iterate, parameter: float, before: Point | None) -> Point:
        """The point with its tangent, which leads on as that of the point before does."""
        run, _, slope = self.steps(at, parameter)
        if before is None:
            self.size = float(np.sqrt(np.mean(slope.values**2))) * abs(self.unit) or at.size
        length = math.sqrt(self.product(slope.values, slope.values, 1.0, 1.0))
        if before is None:
            length = math.copysign(length, self.unit)
        elif self.product(slope.values, before.along.values, 1.0, before.rate) < 0:
            length = -length
        sol = finished(run, at.values, at.taylor, True, 1)
        return Point(at, parameter, Iterate(*(x / length for x in slope)), 1.0 / length, sol)

    def onward(self, base: Point, far: float) -> tuple[Point, int] | None:
        """The point at the distance ``far`` along the tangent of ``base`` and the steps it took; None: not found."""
        at = Iterate(*(x + far * t for x, t in zip(base.at, base.along)))
        parameter = base.parameter + far * base.rate
        for count in range(1, MOST + 1):
            try:
                _, made, slope = self.steps(at, parameter)
            except SolveError:
                return None
            left = far - self.product(
                made.values - base.at.values, base.along.values, parameter - base.parameter, base.rate
            )
            change = left / self.product(slope.values, base.along.values, 1.0, base.rate)
            new = Iterate(*(x + change * t for x, t in zip(made, slope)))
            if not np.isfinite(new.values).all():
                return None
            moved = distance(new, at)
            at, parameter = new, parameter + change
            if moved <= CLOSE * at.size:
                return self.point(at, parameter, base), count
        return None

    def cosine(self, one: Point, other: Point) -> float:
        return self.product(one.along.values, other.along.values, one.rate, other.rate)


def follow(
    problem: Callable[[float], Problem], cloud: Cloud, parameters: Any, u0: Any, steps: int, options: dict[str, Any],
    shown: Any,
) -> Branch:  # fmt: skip
    """The branch through the solution at the first parameter towards the second, all passed in order."""
    first, wanted = float(parameters[0]), [float(c) for c in parameters[1:]]
    sol = solve(problem(first), cloud, u0=u0, **options)
    found, follower = Branch(first, sol), Follower(problem, cloud, wanted[0] - first, options)
    taylor = sol._fit.taylor if sol._fit.taylor is not None else sol._taylor
    here = follower.point(Iterate(sol._values, taylor).numbers(), first, None)
    far, count = FIRST * math.sqrt(2.0), 0
    while wanted and count < steps:
        made = follower.onward(here, far)
        if made is None or follower.cosine(here, made[0]) < BENT:
            far /= 2.0
            if far < SHORTEST:
                raise SolveError(
                    f"continuation: the branch stopped at the parameter {here.parameter:.6g} after {count} steps: "
                    "Newton's method does not arrive from there, however short the step; is it its end, or a point "
                    "where several branches meet?",
                    [],
                )
            continue
        there, needed = made
        bend = _Bend(here.parameter, there.parameter, here.rate, there.rate / follower.cosine(here, there), far)
        found.folds += bend.turns()
        found.branch.append((there.parameter, there.sol))
        passed = 0.0
        while wanted and (at := bend.where(wanted[0], passed)) is not None:
            passed, c = at, wanted.pop(0)
            between = here.at.toward(there.at, passed / far)
            found.append(solve(problem(c), cloud, u0=between.values, **options))
            found.parameters.append(c)
            shown.update()
        if needed <= QUICK and follower.cosine(here, there) > STRAIGHT:
            far *= GROWTH
        here, count = there, count + 1
        shown.note(f"parameter {here.parameter:.5g}")
    return found


class _Bend:
    """The parameter along one step of the length ``far``: the cubic that has its values and slopes at both ends."""

    def __init__(self, start: float, end: float, rate: float, rate_end: float, far: float):
        rise = (end - start) / far
        self.cubic = np.poly1d(
            [(rate + rate_end - 2 * rise) / far**2, (3 * rise - 2 * rate - rate_end) / far, rate, start]
        )
        self.far = far

    def _roots(self, polynomial: np.poly1d, after: float) -> list[float]:
        roots = np.roots(polynomial)
        real = np.sort(roots.real[np.abs(roots.imag) <= 1e-12 * self.far])
        return [float(s) for s in real if after < s <= self.far]

    def where(self, parameter: float, after: float) -> float | None:
        """The first place after another one where the parameter has a value."""
        found = self._roots(self.cubic - parameter, after + 1e-9 * self.far)
        return found[0] if found else None

    def turns(self) -> list[float]:
        """The parameters at which it turns back."""
        return [float(self.cubic(s)) for s in self._roots(self.cubic.deriv(), 0.0)]
