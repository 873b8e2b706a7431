"""The parts of time of an evolution that makes its clouds: march, estimate, mark, and again on another cloud."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from jsmitsm.adaptation.first_cloud import FIRST, cloud_of
from jsmitsm.adaptation.marking import GENTLY, marks, next_spacing
from jsmitsm.adaptation.spacing_field import SpacingField
from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.problem import Problem
from jsmitsm.evolution.adaptive.adapted import AdaptedEvolution
from jsmitsm.evolution.adaptive.begun import seen, spacing_of
from jsmitsm.evolution.adaptive.missing import Missing
from jsmitsm.evolution.adaptive.readapt import Readapt
from jsmitsm.evolution.arguments import sampled, starting_values
from jsmitsm.evolution.evolution import Evolution
from jsmitsm.evolution.march import march
from jsmitsm.evolution.run import Run
from jsmitsm.evolution.space.timed import Timed, timed
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.progress import bar
from jsmitsm.taylor.multi_indices import HIGHEST

# A part is repeated so many times at most. Its cloud is made anew after it too where this part of the particles do.
_AGAIN, _FEWER = 4, 0.8
# Steps become shorter where their error is more than this part of what a part may make, at most by so much at once.
_IN_TIME, _SHORTER = 0.5, 4.0
# Where the equations refuse a cloud the coarsest spacing becomes this part of what it was.
_FINER = 0.7
# A part's end is looked at, and so many moments before it: what moves is seen on its way.
_LOOKS = 4


class Marcher:
    """An evolution on clouds that follow it, in progress."""

    def __init__(
        self, problem: Problem, cloud: Cloud, u0: Any, t: tuple[float, float], steps: int | None, tol: float | None,
        plan: Readapt, options: dict[str, Any],
    ):  # fmt: skip
        self.problem, self.u0, self.t, self.tol, self.plan, self.options = problem, u0, t, tol, plan, options
        self.steps = None if steps is None else -(-steps // plan.times)
        self.groups = set(cloud.groups)
        self.cloud, self.spacing = cloud, spacing_of(cloud)
        self.coarsest, self.scale, self.error = self.spacing.largest, 0.0, 0.0
        self.parts: list[Evolution] = []
        self.rows: list[tuple[float, ...]] = []
        self.messages: list[str] = []
        self.missing = Missing(np.asarray(cloud.points), np.zeros((len(cloud), problem.fields)))
        self.passed: np.ndarray | float = 0.0  # what reading the start off another cloud may have changed

    def run(self, shown: Any) -> None:
        """All parts, one after the other."""
        if callable(self.u0):
            self.cloud, self.spacing = seen(
                self.cloud, self.spacing, self._everywhere, min(self.options["order"] + 2, HIGHEST), self.plan.tol,
                self._made_cloud, self.plan.max_particles,
            )  # fmt: skip
        ends = np.linspace(*self.t, self.plan.times + 1)
        for begin, end in zip(ends[:-1], ends[1:]):
            self._part(float(begin), float(end))
            shown.update()
            if not self.parts[-1].converged:
                break
        if self.error > self.plan.tol:
            self.messages.append(
                f"Not reached: the error is estimated at {self.error:.1e} of the largest value, {self.plan.tol:g} was "
                "asked for. What parts of the time make may grow on the way: ask for less; or allow more particles, or "
                "a higher order."
            )

    # ------------------------------------------------------------------ one part

    def _part(self, begin: float, end: float) -> None:
        """A part of the time, on as many clouds and with as many steps as it takes."""
        began = time.perf_counter()
        wanted = self.plan.tol * (end - begin) / (self.t[1] - self.t[0])
        for attempt in range(_AGAIN + 1):
            made = self._run(begin, end)
            try:
                evolution = self._marched(made)
            except SolveError:
                if attempt == _AGAIN or self._given():
                    raise
                self._refine_all()
                continue
            found = np.asarray(evolution.error_estimate()).reshape(len(evolution.t), len(self.cloud), -1)
            scale = max(self.scale, float(np.abs(np.asarray(evolution.u)).max(initial=0.0))) or 1.0
            local = found.max(axis=(0, 2)) / scale
            good = float(local.max(initial=0.0)) <= wanted
            if good or not evolution.converged or attempt == _AGAIN or self._given():
                break
            in_time = evolution.stats["error_in_time"] or 0.0
            if in_time > _IN_TIME * wanted:
                self._shorten(in_time / wanted)
            elif not self._follow(np.maximum(local - in_time, 0.0), wanted, False):
                break
        self.scale = scale
        self.missing = self.missing.after(made, evolution, self.passed, self._marched, scale)
        self.error = self.missing.largest / scale
        self.parts.append(evolution)
        smallest = float(self.spacing(np.asarray(evolution.cloud.points)).min())
        seconds = time.perf_counter() - began
        self.rows.append((end, len(evolution.cloud), self.error, smallest, attempt + 1, seconds))
        if good:
            self._follow(local, wanted, True)

    def _run(self, begin: float, end: float) -> Run:
        """The equations on the cloud, or on one that is less coarse where these refuse or doubt it: convection may."""
        while True:
            begun, start = time.perf_counter(), self._start(begin)
            last = self._given() or len(self.cloud) > self.plan.max_particles * _FINER**self.cloud.dim
            try:
                made = Run(timed(self.problem, self.cloud), self.cloud, start, (begin, end), begun, **self.options)
                if last or not made.flags:
                    return made
            except ValueError:
                if last:
                    raise
            self._refine_all()

    def _marched(self, made: Run) -> Evolution:
        with bar("steps", self.steps or 1000) as shown:
            return march(made, self.steps, self.tol, np.linspace(0.0, 1.0, _LOOKS + 1), shown)

    def _shorten(self, times: float) -> None:
        """Shorter steps for an error in time so many times what it may be, of schemes of order four about."""
        more = float(np.clip((times / _IN_TIME) ** 0.25, 1.2, _SHORTER))
        if self.steps is not None:
            self.steps = int(np.ceil(more * self.steps))
        else:
            assert self.tol is not None
            self.tol = max(self.tol / more**4, 1e-13)

    # ------------------------------------------------------------------ what a part begins with

    def _given(self) -> bool:
        """Whether the cloud cannot be another one: the start is known at its particles only."""
        return not self.parts and not callable(self.u0) and np.ndim(self.u0) > 0

    def _everywhere(self, points: np.ndarray) -> np.ndarray:
        """The start (M, F), a function, at many points (M, D)."""
        return np.asarray(sampled(self.u0, points, self.problem.fields))

    def _start(self, begin: float) -> tuple[Any, ...]:
        """Values (N, F) that the part begins with."""
        self.passed = 0.0
        if not self.parts:
            return starting_values(self.u0, self.cloud, self.problem.fields, False)
        before = self.parts[-1]
        last = np.asarray(before._u)[-1]
        if before.cloud is self.cloud:
            return (last,)
        points, state = np.asarray(self.cloud.points), before._solution(last, begin)
        read: Callable[[bool], np.ndarray] = lambda blend: np.asarray(  # noqa: E731
            state(points, blend=blend, outside="extrapolate")
        ).reshape(len(points), -1)
        values = read(True)
        self.passed = read(False) - values  # neighbours know it as well as they agree
        return (values,)

    # ------------------------------------------------------------------ clouds

    def _follow(self, local: np.ndarray, wanted: float, only_fewer: bool) -> bool:
        """Another cloud for an error ``local`` (N,) at the particles; False where it stays.

        only_fewer: only one of clearly fewer particles, but of enough for an estimate.
        """
        points, power = np.asarray(self.cloud.points), float(self.options["order"])
        found, most = marks(points, self.spacing(points), local, power, None), self.plan.max_particles
        largest = lambda some: float(some.max())  # noqa: E731
        h, count = next_spacing(found, power, largest(local), wanted, most, largest, coarser=GENTLY)
        if only_fewer and not FIRST[self.cloud.dim] < count < _FEWER * len(points):
            return False
        field = SpacingField(points, h, self.coarsest)
        following = self._made_cloud(field)
        if len(following) > most or (only_fewer and not len(following) < _FEWER * len(points)):
            return False
        self.cloud, self.spacing = following, field
        return True

    def _refine_all(self) -> None:
        """A cloud on which nothing is as coarse as on the last."""
        self.coarsest = _FINER * float(self.spacing(np.asarray(self.cloud.points)).max())
        field = SpacingField(self.spacing.points, self.spacing.spacing, self.coarsest)
        self.cloud, self.spacing = self._made_cloud(field), field

    def _made_cloud(self, spacing: SpacingField) -> Cloud:
        cloud = cloud_of(self.plan.make, spacing)
        if set(cloud.groups) != self.groups:
            raise ValueError(
                f"make: its cloud has the groups {sorted(cloud.groups)}, that of the start {sorted(self.groups)}; give "
                "js.evolve a cloud of the same maker"
            )
        return cloud


def refuse_what_does_not_damp(made: Timed) -> None:
    """ValueError for problems whose clouds cannot be made by an estimate."""
    if made.masses[1].slots or made.flow is not None:
        what = "of second order in time" if made.masses[1].slots else "incompressible flows"
        raise ValueError(
            f"readapt: {what}, on clouds that change, would keep what every change leaves behind, of which no estimate "
            "knows; leave readapt out"
        )


def followed(
    problem: Problem, cloud: Cloud, u0: Any, t: tuple[float, float], steps: int | None, tol: float | None,
    saved: np.ndarray, plan: Readapt, options: dict[str, Any],
) -> AdaptedEvolution:  # fmt: skip
    """The evolution on clouds that follow it; saved: times as parts of the whole."""
    marcher = Marcher(problem, cloud, u0, t, steps, tol, plan, options)
    with bar("parts", plan.times) as shown:
        marcher.run(shown)
    names = ("t", "particles", "error", "smallest", "attempts", "seconds")
    history = {name: np.array(column) for name, column in zip(names, zip(*marcher.rows))}
    times = t[0] + saved * (t[1] - t[0])
    last = float(marcher.parts[-1].t[-1])
    times = times if marcher.parts[-1].converged else np.append(times[times < last], last)
    return AdaptedEvolution(times, marcher.parts, marcher.error, plan.tol, history, marcher.messages)
