"""The rounds of a search: solve, estimate, mark, make a new cloud."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np

from jsmitsm.adaptation import growth
from jsmitsm.adaptation.data import Data, data_of
from jsmitsm.adaptation.first_cloud import Make, farther_than_asked, looked_at, made
from jsmitsm.adaptation.free_ends import off_at_free_ends
from jsmitsm.adaptation.layers import LOST, along_outflow
from jsmitsm.adaptation.marking import FAR, ROUGH, SLOW, Marks, marks, next_spacing
from jsmitsm.adaptation.measure import Measured, Quantity, measured, size, spent
from jsmitsm.adaptation.orders import Orders
from jsmitsm.adaptation.spacing_field import SpacingField
from jsmitsm.adaptation.witness import Earlier, doubted, remembered, stands_out, unseen
from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.problem import Problem
from jsmitsm.runtime.errors import SolveError, TooCoarse, TooFine
from jsmitsm.solution.look.edges import edges
from jsmitsm.solution.look.gaps import gaps
from jsmitsm.solution.solution import Solution
from jsmitsm.solution.solve import solve

# Where smoothness ends along lines with so large a part of the particles, a higher order makes them dearer, no fewer.
_LINES = 0.3
# Polynomials of neighbours may differ between them by so many tolerances: they are off by so much more than the values.
_GAP = 10.0
# Where the values may be off by more than they are thought to be, they are off by so many times as much, no more: a
# corner of hardly more than 180 degrees, at which no estimate sees anything, against a layer at a wall.
_PARTLY = 2.0
# Near the end of a search one aims at this part of the tolerance, if there are such points.
_AIMED = 0.6
# Where lines hold most particles every part of the error is dear: one aims at so many times as much as usually.
_DEAR = 2.0
# A number that is there at once is asked for again at this spacing. Two may differ by so many times what was thought.
_CONFIRMED, _AGREE = 0.75, 2.0
# Where they part, at a corner most often, that falls with this power of the spacing; by so many times what they may,
# that is known to be the point, and worth more than a round.
_PARTED, _TORN = 0.5, 30.0
# While only that is wanting, the error at the particles may go back to so many of the usual aims.
_EASED = 1.5
# A cloud of this part of the particles that are allowed is the last.
_FULL = 0.8
# So many solves in a row may fail, each followed by one on a finer cloud.
_REFUSED = 4
# So many attempts are made at a cloud that grows as it should: around a refined point the gradation decides.
_PUSHED = 3
# The degree of the polynomials that source and coefficients are compared with.
_DEGREE = 4
# A round before with less than this part of the last one's error is what is handed out.
_BACK = 0.1
# Makers leave particles so many times the spacing apart that they were asked for, and no more.
_ASKED = 3.0
# From this part of the distance to it on, the error of the solve that checks explains the distance.
_OTHERS = 0.5


class Ended(NamedTuple):
    """What a round leaves to be handed out, should none do better."""

    error: float
    solution: Solution
    number: float | None


class Rounds:
    """A search in progress, and its result."""

    def __init__(
        self, problem: Problem, make: Make, tol: float, order: Any, quantity: Quantity | None, norm: str,
        max_particles: int, max_rounds: int, options: dict[str, Any], began: float,
    ):  # fmt: skip
        self.problem, self.make, self.tol, self.quantity, self.norm = problem, make, tol, quantity, norm
        self.max_particles, self.max_rounds, self.options = max_particles, max_rounds, options
        self.orders = Orders(order, tol)
        self.clock = began
        self.solution: Solution = None  # type: ignore[assignment]
        self.spacing: SpacingField = None  # type: ignore[assignment]
        self.error, self.reached = np.inf, False
        self.checked = self.checked_before = np.inf  # the error without what two rounds' numbers differ by
        self.undoubted = np.inf  # the error without the doubt where smoothness ends, which marking has as well
        self.number: float | None = None
        self.number_before: float | None = None
        self.flags: list[str] = []
        self.messages: list[str] = []
        self.rows: list[growth.Row] = []
        self.data: Data | None = None
        self.before: Marks | None = None
        self.earlier: Earlier | None = None
        self.best: tuple[int, float, SpacingField] | None = None  # order, error and spacing of the best round so far
        self.apart: np.ndarray | None = None  # gaps between neighbours, where they are what is wrong
        self.least_error: Ended | None = None
        self.lined = False  # whether smoothness ends along lines that hold most particles, whatever the order

    def history(self) -> dict[str, np.ndarray]:
        names = ("particles", "order", "error", "seconds", "smallest")
        return {name: np.array(column) for name, column in zip(names, zip(*self.rows))}

    # ------------------------------------------------------------------ the loop

    def run(self, cloud: Cloud, spacing: SpacingField, shown: Any) -> None:
        self._search(cloud, spacing, shown)
        best = self.least_error
        if not self.reached and best is not None and best.error < _BACK * self.error and not best.solution.flags:
            self.messages.append(f"The last round was worse, {self.error:.1e}: this is the best one.")
            self.error, self.solution, self.number = best
            self.flags = []
        if self.quantity is not None and self.number_before is None and not self.reached:
            # A number of one cloud is no nearer to the truth than its solution, as far as anybody knows.
            sol, h = self.solution, self.spacing(np.asarray(self.solution.cloud.points))
            self.error = max(self.error, measured(sol, h, self._operator_order(sol), "max", None).error)

    def _search(self, cloud: Cloud, spacing: SpacingField, shown: Any) -> None:
        self.data = data_of(self.problem, cloud.dim, _DEGREE)
        if self.data is not None:
            self.orders.least = max(self.data.traced.order)
            spacing, cloud = looked_at(self.data, self._cloud, cloud, spacing, self.max_particles // 4)
        refused = 0
        for number in range(self.max_rounds):
            try:
                sol, found = self._solved(cloud, spacing)
            except (ValueError, SolveError) as error:
                refused += 1
                if refused > _REFUSED or not _refinable(error) or number == self.max_rounds - 1:
                    if self.solution is None:
                        raise
                    self.messages.append(f"Limited by a solve that failed: {error}")
                    return
                spacing = spacing.scaled(0.7)
                cloud = self._cloud(spacing)
                continue
            refused = 0
            self._refuse_no_number()
            shown.reach(spent(self.history(), self.tol))
            shown.note(f"round {number + 1}, {len(cloud)} particles, error {found.error:.1e} of {self.tol:g}")
            done = self._done(sol, found, cloud, spacing)
            if self.least_error is None or self.error < self.least_error.error:
                self.least_error = Ended(self.error, sol, found.number)
            self._clocked()
            if done:
                shown.reach(1.0)
                return
            if number == self.max_rounds - 1:
                self._limit(f"the {self.max_rounds} rounds that were allowed (max_rounds)")
                return
            if growth.stalled(self.rows, cloud.dim):
                self._limit("what the cloud or round-off allow: the last rounds gained nothing")
                return
            following = self._next(found, cloud, spacing)
            if following is None:
                return
            spacing, cloud = following

    def _limit(self, what: str) -> None:
        self.messages.append(f"Not reached: the error is estimated at {self.error:.1e}; limited by {what}.")
        coarser = farther_than_asked(self.solution.cloud, self.spacing)
        if coarser > _ASKED:
            self.messages.append(
                f"The cloud's maker leaves particles up to {coarser:.0f} times as far apart as it was asked to; it "
                "must keep to its spacing everywhere."
            )
        if self.solution is not None and not self.flags:
            self.flags = self.solution.flags

    def _solved(self, cloud: Cloud, spacing: SpacingField) -> tuple[Solution, Measured]:
        order = self.orders.following(self.rows, cloud.dim, self.lined)
        sol = self._solve(cloud, order)
        h = spacing(np.asarray(cloud.points))
        found = measured(sol, h, self._operator_order(sol), self.norm, self.quantity)
        now = time.perf_counter()
        self.rows.append((len(cloud), order, found.error, now - self.clock, float(h.min())))
        self.clock = now
        self.earlier = None if self.solution is None else remembered(self.solution)
        self.spacing, self.solution = spacing, sol
        self.checked_before, self.checked = self.checked, found.error
        self.error = self.undoubted = found.error
        self.number_before, self.number = self.number, found.number
        return sol, found

    def _refuse_no_number(self) -> None:
        known = [number for number in (self.number, self.number_before) if number is not None]
        if len(known) == 2 and np.isnan(known).all():
            raise ValueError("quantity: returns NaN on two clouds; is a point outside of the domain?")

    def _clocked(self) -> None:
        """What was spent since the last row belongs to its round: the check by another order."""
        now = time.perf_counter()
        *row, seconds, smallest = self.rows[-1]
        self.rows[-1] = (*row, seconds + now - self.clock, smallest)  # type: ignore[assignment]
        self.clock = now

    def _solve(self, cloud: Cloud, order: int, start: Any = None) -> Solution:
        depth = 0 if self.orders.shallow else "auto"
        options = {"order": order, "throw": True, "depth": depth, **self.options}
        if start is None and self.solution is not None and self.solution.iterations != 1 and self.solution.converged:
            start = np.asarray(self.solution(np.asarray(cloud.points), outside="extrapolate"))
        if start is None:
            return solve(self.problem, cloud, **options)
        try:
            return solve(self.problem, cloud, **{**options, "u0": start})
        except SolveError:  # the solution before may be farther from this one than what it began with itself
            return solve(self.problem, cloud, **options)

    def _operator_order(self, sol: Solution) -> int:
        return max(sol.operator_orders, default=2)  # several regions do not tell

    # ------------------------------------------------------------------ clouds

    def _cloud(self, spacing: SpacingField) -> Cloud:
        return made(self.make, spacing)

    # ------------------------------------------------------------------ ends

    def _done(self, sol: Solution, found: Measured, cloud: Cloud, spacing: SpacingField) -> bool:
        """Whether the tolerance is reached, all doubts heard."""
        if not found.error <= self.tol:
            return False
        self._checked(sol, found, cloud, spacing)
        self.flags = sol.flags
        rate = self._marks(found, cloud, spacing).rate
        self.apart, apart = None, None
        if self.quantity is None and self.norm == "max" and sol.defects:
            apart = self._parts(sol, rate)
        if apart is not None and found.scale > 0:
            between = apart / found.scale / _GAP
            if between.max() > self.tol:
                self.apart = apart
            else:  # where smoothness ends the values are off by as much, elsewhere by some of it
                some = min(_PARTLY * self.error, float(between.max()))
                if self.before is None:
                    some = max(some, stands_out(np.asarray(cloud.points), spacing(np.asarray(cloud.points)), between))
                self.error = max(self.error, float(between[rate < SLOW].max(initial=some)))
        self.checked = self.error
        self.undoubted = max(self.error, self._disagreed())
        self.error = max(self.undoubted, self._doubted(found, rate))
        if self.apart is not None:
            self.error = max(self.error, float(self.apart.max()) / found.scale / _GAP)
        self.reached = self.error <= self.tol and not self.flags and not self._unconfirmed
        return self.reached

    @property
    def _unconfirmed(self) -> bool:
        """Whether a number is that of a single cloud: no estimate knows what makes it of the values."""
        return self.quantity is not None and self.number_before is None and self.max_rounds > 1

    def _parts(self, sol: Solution, rate: np.ndarray) -> np.ndarray | None:
        """What parts neighbours between them, or may part them from what is true, (N,)."""
        before, values = self.before, np.asarray(sol.u).reshape(len(sol.cloud), -1)
        slow, points = (None, None) if before is None else (rate < SLOW, before.points)
        off = off_at_free_ends(self.problem, sol.cloud, values, slow, points)
        apart = gaps(sol)
        return np.maximum(_GAP * off, 0.0 if apart is None else apart) if off.any() else apart

    def _doubted(self, found: Measured, rate: np.ndarray) -> float:
        """The error where smoothness ends, of which the estimate sees a part."""
        if found.local is None or self.before is None:
            return 0.0
        unbounded = self.data is not None and self.data.traced.unbounded[0]
        return doubted(found, rate, unbounded, lambda: unseen(self.solution, self.rows, self.earlier))

    def _disagreed(self) -> float:
        """By how much the number changed unforeseen: what makes it of the values, a quadrature say, errs too."""
        if self.number is None or self.number_before is None:
            return 0.0
        change = abs(self.number - self.number_before) / (abs(self.number) or 1.0)
        return change - _AGREE * self.checked_before

    def _checked(self, sol: Solution, found: Measured, cloud: Cloud, spacing: SpacingField) -> None:
        """Where the solution of another order is farther away than the tolerance, that is the error.

        Unless it is the error of the other, which where a solution is barely resolved may be the larger one. The
        estimate of a linear problem has met the other already.
        """
        if found.apart <= self.tol:
            return
        try:
            other = self._solve(cloud, sol.order + 2, None if sol.iterations == 1 else np.asarray(sol.u))
        except (ValueError, SolveError) as error:
            self.messages.append(f"No solve of another order could check the error: {error}")
            return
        h = spacing(np.asarray(cloud.points))
        if self.quantity is None:
            values = np.asarray(sol.u).reshape(len(cloud), -1)
            away = np.asarray(other.u).reshape(len(cloud), -1) - values
            apart = size(away, values, h, self.norm, cloud.dim)
        else:
            number, again = self.number or 0.0, float(np.asarray(self.quantity(other)).sum())
            apart = abs(again - number) / (abs(number) or 1.0)
        # A number is made of more than values, slopes of polynomials for instance, of which the other order knows more.
        if apart > (max(self.error, self.tol) if self.quantity is None else self.error):
            own = measured(other, h, self._operator_order(other), self.norm, self.quantity).error
            if not (np.isfinite(own) and own > _OTHERS * apart):
                self.error = apart

    # ------------------------------------------------------------------ the next cloud

    def _next(self, found: Measured, cloud: Cloud, spacing: SpacingField) -> tuple[SpacingField, Cloud] | None:
        points, h = np.asarray(cloud.points), spacing(np.asarray(cloud.points))
        power, error = self._power(cloud), self.undoubted if np.isfinite(self.undoubted) else 1e3
        apart, self.apart = self.apart, None
        least = growth.least(len(cloud), int(self.max_particles / 1.1))
        here = self._marks(found, cloud, spacing)
        self.before = here if np.isfinite(found.error) else None
        self.lined |= here.along.mean() > _LINES
        if len(cloud) >= _FULL * self.max_particles:
            self._limit(f"the {self.max_particles} particles that were allowed (max_particles)")
            return None
        most = growth.most(len(cloud), cloud.dim, self.max_particles, self.lined)
        wanted = _EASED * self.tol if apart is not None else self.tol if self.error > self.tol else 0.5 * error
        if self.lined:
            wanted *= _DEAR * min(1.0, self.undoubted / self.error)
        elif here.singular.any() and error <= _AIMED * FAR * self.tol:  # the estimate will be doubted there, soon
            wanted *= _AIMED
        made_h, _ = next_spacing(here, power, error, wanted, most, found.gathered, found.missed)
        if apart is not None:
            parted = marks(points, h, apart, power, None, expected=_PARTED)
            torn = apart > _TORN * _GAP * self.tol * found.scale
            parted = parted._replace(located=parted.singular & torn)
            finer, _ = next_spacing(parted, power, float(apart.max()) / found.scale / _GAP, self.tol, most)
            made_h = np.where(finer < h, np.minimum(made_h, finer), made_h)
        field = SpacingField(points, made_h, spacing.largest)
        better = self._better(spacing)
        if better is not None:
            field = better.joined(points, made_h)
        if error > LOST:
            field = along_outflow(self.data, self._cloud, field, self.max_particles // 4)
        if self.error <= self.tol and self._unconfirmed:
            field = spacing.scaled(_CONFIRMED)
        for attempt in range(8):
            try:
                following = self._cloud(field)
            except TooFine:
                coarser = np.maximum(field.spacing, 4.0 * field.spacing.min())
                field = SpacingField(field.points, coarser, field.largest)
                continue
            except TooCoarse:
                field = field.scaled(0.7)
                continue
            if len(following) > self.max_particles:
                field = field.scaled((1.1 * len(following) / self.max_particles) ** (1.0 / cloud.dim))
            elif attempt < _PUSHED and apart is None and len(following) < least:
                field = field.scaled((len(following) / (1.1 * least)) ** (1.0 / cloud.dim))
            else:
                break
        else:
            self._limit("the cloud's maker, which refused finer ones")
            return None
        if len(following) == len(cloud) and np.array_equal(following.points, points):
            self._limit("the cloud's maker, which made the same particles again for another spacing")
            return None
        return field, following

    def _power(self, cloud: Cloud) -> float:
        """The power of the spacing by which contributions to the error of a smooth solution fall."""
        return self.solution.order + 1.0 + min(0, cloud.dim - self._operator_order(self.solution))

    def _marks(self, found: Measured, cloud: Cloud, spacing: SpacingField) -> Marks:
        # Contributions at another order are others, in a constant at least: they tell no rate.
        comparable = len(self.rows) > 1 and self.rows[-1][1] == self.rows[-2][1] and np.isfinite(found.error)
        points, before = np.asarray(cloud.points), self.before if comparable else None
        known = self.solution.poles
        return marks(points, spacing(points), found.contribution, self._power(cloud), before, edges(cloud), poles=known)

    def _better(self, spacing: SpacingField) -> SpacingField | None:
        """The spacing of a round before that did better than the last one, over which no other may grow then."""
        order, error = self.rows[-1][1:3]
        if self.best is not None and self.best[0] == order and error > self.best[1]:
            return self.best[2]
        self.best = (order, error, spacing) if error < ROUGH else None
        return None


def _refinable(error: Exception) -> bool:
    """Whether more particles may mend what a solve refused."""
    return isinstance(error, SolveError) or str(error).startswith(("cloud:", "stencils:"))
