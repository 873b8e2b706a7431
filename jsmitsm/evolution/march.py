"""The steps of a run on the host, and what is said of them afterwards."""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import numpy as np

from jsmitsm.evolution.estimate import estimated, in_space
from jsmitsm.evolution.evolution import Evolution, Report
from jsmitsm.evolution.run import Run
from jsmitsm.evolution.sizes import Sizes, sizes
from jsmitsm.evolution.space.system import VANISHING
from jsmitsm.evolution.steps import dense_output
from jsmitsm.evolution.steps.control import FIRST, controlled
from jsmitsm.evolution.steps.in_time import InTime, looks
from jsmitsm.evolution.steps.stepping import Step, Stopped
from jsmitsm.evolution.unseen import made_at_seams
from jsmitsm.runtime.errors import SolveError
from jsmitsm.solution.fit import Recipe
from jsmitsm.taylor.multi_indices import HIGHEST

# Bytes of states that are kept for what lies between the saved ones.
HISTORY = 2**29
# Growth of the largest value that no problem means.
BLOWN = 1e30
# An estimated error, in time or in all, above this part of the solution is a flag.
LARGE = 0.02
# A start of less than this part of what data make in one of so many parts of a run, each as long as its first step, is
# one at rest. No step is longer then, or it would pass over what the data do between.
_REST, _PARTS = 1e-6, 2**FIRST
# Of the schemes, as ``stats`` tells them.
NAMES = {
    "esdirk": "KenCarp4", "imex": "KenCarp4, implicit and explicit", "radau": "Radau IIA 5", "euler": "backward Euler",
}  # fmt: skip


class History:
    """The states of a run: all of them, or where they would be too many those next to the saved times."""

    def __init__(self, run: Run, wanted: np.ndarray | None):
        self.run, self.wanted = run, wanted
        self.times: list[float] = []
        self.states: list[np.ndarray] = []
        self.rates: list[np.ndarray] = []
        self.sizes, self.first = Sizes(run), 0.0
        lasting = bool(run.second or run.damping)
        self.in_time = InTime(float(run.t[0]), float(run.t[1]), lambda part: sizes(run.semi, part), lasting)

    def add(self, t: float, step: Step, number: int | None = None) -> None:
        semi = self.run.semi
        part = step.y[: semi.system.n]
        self.sizes.add(step.y)
        if self.wanted is not None and number is not None and not self.wanted[number]:
            return
        self.times.append(t)
        self.states.append(semi.kept(part, step.known))
        if len(self.states) == 1:
            self.first = max(semi.system.largest(self.states[0]), 1.0)
        if semi.second:
            rates = semi.sample(np.asarray(float(t)))[3]
            self.rates.append(semi.kept(step.y[semi.system.n :], np.asarray(rates)))

    def in_time_at(self, times: np.ndarray) -> np.ndarray:
        """The estimated errors in time of the fields (S, F): of the steps, and of what lies between them."""
        if not self.in_time.times:  # of a scheme without an estimate
            return self.in_time.at(times)
        between = dense_output.doubts(np.array(self.times), self.states, times, self.run.semi.system.largest)
        return self.in_time.at(times) + between

    def part_in_time(self, later: np.ndarray) -> float | None:
        """Of these the worst, as a part of its field."""
        return float((later / self.sizes.scales()).max()) if self.in_time.times else None

    def at(self, times: np.ndarray, of: list[np.ndarray]) -> np.ndarray:
        index, weights = dense_output.weights(np.array(self.times), times)
        return np.stack([np.tensordot(w, np.stack([of[i] for i in k]), axes=1) for k, w in zip(index, weights)])


def march(run: Run, steps: int | None, tol: float | None, parts: np.ndarray, shown: Any) -> Evolution:
    """All steps, and the Evolution that they make."""
    began = time.perf_counter()
    history, fault = marched(run, steps, tol, parts, shown)
    if fault and run.throw:
        raise SolveError(f"the run stopped: {fault}; give throw=False for the last good state", [])
    return _finished(run, parts, history, fault, began)


def marched(run: Run, steps: int | None, tol: float | None, parts: np.ndarray, shown: Any) -> tuple[History, str]:
    """All steps, and what ended them early."""
    t0, t1 = (float(v) for v in run.t)
    wanted = None
    if steps is not None and 8 * (steps + 1) * len(run.cloud) * run.fields > HISTORY:
        wanted = np.zeros(steps + 1, bool)
        wanted[dense_output.weights(np.linspace(0.0, 1.0, steps + 1), parts)[0]] = True
    history = History(run, wanted)
    fault = ""
    try:
        y = started(run, (t1 - t0) / (steps or _PARTS))
        if steps is None:
            assert tol is not None
            _adaptive(run, y, t0, t1, tol, history, shown)
        else:
            _equal(run, y, np.linspace(t0, t1, steps + 1), history, shown)
    except Stopped as stopped:
        fault = str(stopped)
        if run.name == "imex" and not run.semi.linear and not run.second:
            fault += '; scheme="esdirk" solves for what is nonlinear, as stiff reactions need it'
    return history, fault


def started(run: Run, h: float) -> np.ndarray:
    """The state at the start: the impulse of a start that contradicts the conditions, and equations without rates."""
    semi, t0 = run.semi, float(run.t[0])
    y, asked, jumps = semi.begun(run.start, t0)
    force, held = _now(semi, t0, y)
    jump = asked - held
    small = VANISHING * h
    if run.algebraic:  # a vanishing step of backward Euler takes the impulse, another settles what holds always
        resolvent, mass = semi.system.resolvent(small), semi.system.mass
        y = resolvent.solve(mass(y) + jump + small * force)
        force, later = _now(semi, t0 + small, y)
        return resolvent.solve(mass(y) + held - later + small * force)
    if not semi.second and jumps:
        if semi.system.largest(semi.system.undriven()):
            return semi.system.resolvent(small).solve(semi.system.mass(y) + jump + small * force)
        return y + semi.system.resolvent(0.0).solve(jump)
    return y


def _now(semi: Any, t: float, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    samples = semi.samples(np.array([t]))
    force, held = semi.forces(*samples)
    explicit = 0.0 if semi.linear else semi.explicit(y, t, samples[0][:, 0])
    return force[0] + explicit, held[0]


def _equal(run: Run, y: np.ndarray, times: np.ndarray, history: History, shown: Any) -> None:
    """Equal steps."""
    h = float(times[-1] - times[0]) / (len(times) - 1)
    stepper = run.stepper(run.semi)
    stepper.drive.plan(times[:-1], h)
    step = stepper.first(y, float(times[0]))
    history.add(float(times[0]), step, 0)
    wanted = looks(len(times) - 1)
    for k in range(len(times) - 1):
        if run.timed.quasilinear and run.left(step, float(times[k])):
            run.renew(step.y, float(times[k]))
            stepper = run.stepper(run.semi)
            step = stepper.first(step.y, float(times[k]))
        history.sizes.stepped(stepper.smallest(h))
        step = _one(run, stepper, step, float(times[k]), h, k in wanted)
        _refuse_growth(history, run.semi.system.largest(step.y[: run.semi.system.n]), float(times[k + 1]))
        history.add(float(times[k + 1]), step, k + 1)
        if k in wanted:
            history.in_time.add(stepper, step, float(times[k + 1]), h, wanted[k])
        run.counts["steps"] += 1
        shown.update()


def _one(run: Run, stepper: Any, step: Step, t: float, h: float, look: bool) -> Step:
    try:
        return stepper.advance(step, t, h, look)
    except SolveError as fault:
        raise Stopped(f"the stage's system at t = {t:.6g} cannot be solved: {fault}") from fault


def _refuse_growth(history: History, size: float, t: float) -> None:
    if size > BLOWN * history.first:
        raise Stopped(
            f"the solution blew up: it is {size:.1e} at t = {t:.6g}; take more steps, or, where the equation "
            "itself grows so fast, an earlier end"
        )


def _adaptive(run: Run, y: np.ndarray, t0: float, t1: float, tol: float, history: History, shown: Any) -> None:
    if run.name == "euler":
        raise ValueError('tol: backward Euler has no estimate of its error; use steps, or scheme="esdirk"')
    done = 0

    def tell(part: float) -> None:
        nonlocal done
        new = int(1000 * part)
        shown.update(new - done)
        done = new

    stepper: Any = _Renewing(run)

    def added(t: float, step: Step) -> None:
        if history.times:
            history.in_time.add(stepper.inner, step, t, stepper.h)
        history.add(t, step)

    driven, coupled = _foreseen(run, stepper.inner, y, t0, t1)
    n, made = run.semi.system.n, np.maximum(driven, coupled)
    known = sizes(run.semi, y[:n])
    least = np.where(known < _REST * made, made, 0.0)

    def size(error: np.ndarray) -> float:
        """That of the worst field. What others make of one may be all of it, so that the step itself counts."""
        history.sizes.stepped(stepper.inner.smallest(stepper.h))
        more = least if run.fields == 1 else np.maximum(least, sizes(run.semi, stepper.y[:n]))
        return float((sizes(run.semi, error[:n]) / history.sizes.scales(more, tol)).max())

    resting = known < _REST * driven
    # Data that do not change may be passed over once a field moves.
    rests = (resting | (known == 0)).all() if run.semi.timed.steady else True
    counts = controlled(stepper, y, t0, t1, tol, added, tell, size, FIRST if resting.any() and rests else 0)
    run.counts.update(counts)


def _foreseen(run: Run, stepper: Any, y: np.ndarray, t0: float, t1: float) -> tuple[np.ndarray, np.ndarray]:
    """How large data make each field (F,) of a solution that starts at rest, and how large other fields make it.

    The values given, and what forces do in one of the parts. What begins slowly, as a smooth pulse does, would have to
    be right to so many digits of nearly nothing.
    """
    semi, system = run.semi, run.semi.system
    h, size = stepper.smallest((t1 - t0) / _PARTS), np.zeros(run.fields)
    held = semi.held % run.fields
    for t in np.linspace(t0, t1, 1 if semi.timed.steady else _PARTS + 1):
        force, _, known = stepper.drive.start(float(t))
        moved = system.resolvent(h).solve(h * np.asarray(force))[: system.n]
        given = [system.largest(np.asarray(known)[held == k]) for k in range(run.fields)]
        size = np.maximum(size, np.maximum(sizes(semi, moved), given))
    coupled = np.zeros(run.fields)
    if run.fields > 1:
        first = _now(semi, t0, y)[0]
        coupled = sizes(semi, system.resolvent(h).solve(system.mass(y) + h * first)[: system.n])
    return np.where(np.isfinite(size), size, 0.0), np.where(np.isfinite(coupled), coupled, 0.0)


class _Renewing:
    """Steps of a run whose pencil may have to be made anew on the way."""

    def __init__(self, run: Run):
        self.run, self.inner = run, run.stepper(run.semi)
        self.order, self.h, self.y = self.inner.order, 0.0, np.zeros(0)

    def first(self, y: np.ndarray, t: float) -> Step:
        return self.inner.first(y, t)

    def advance(self, last: Step, t: float, h: float, estimate: bool) -> Step:
        run = self.run
        if run.timed.quasilinear and run.left(last, t):
            run.renew(last.y, t)
            self.inner = run.stepper(run.semi)
            last = self.inner.first(last.y, t)
        self.h = h
        now = self.inner.advance(last, t, h, estimate)
        self.y = now.y
        return now


def _finished(run: Run, parts: np.ndarray, history: History, fault: str, began: float) -> Evolution:
    t0, t1 = (float(v) for v in run.t)
    times = np.where(parts >= 1.0, t1, t0 + parts * (t1 - t0))
    flags, told = run.flags, run.told
    if fault:
        last = history.times[-1] if history.times else t0
        times = np.append(times[times < last - 1e-12 * (t1 - t0)], last)
        flags.insert(0, f"FAILED: {fault}.")
    if not history.times:
        states = np.asarray(run.start[0])[None]
        rates = np.asarray(run.start[1])[None] if run.second else None
        history.times, history.states = [t0], list(states)
        times = np.array([t0])
    elif len(history.times) == 1:
        states, rates = np.stack(history.states), np.stack(history.rates) if run.second else None
    else:
        states = history.at(times, history.states)
        rates = history.at(times, history.rates) if run.second else None
    later = history.in_time_at(times)
    in_time = history.part_in_time(later)
    if in_time is not None and in_time > LARGE:
        flags.append(f"The estimated error in time is {in_time:.0%} of the solution: take more steps, or a tol.")
    if run.unseen > LARGE:
        flags.append(
            f"The start changes within the spacing, unseen by the particles, by as much as makes {run.unseen:.0%} of "
            "it: refine there, or smooth it."
        )
    stats = _statistics(run, began, in_time)
    degree = min(run.order + 2, HIGHEST)
    recipe = Recipe("S", run.order, None, "loo", run.fields, degree - run.order)
    fit = run.semi.state_fit(degree)
    kept = np.array(history.times), np.stack(history.states)
    moved = np.stack(history.rates) if history.rates else None

    beyond = made_at_seams(run.semi, kept, moved)
    made = 0.0 if beyond is None else float((sizes(run.semi, beyond) / history.sizes.scales()).max())
    if made > LARGE:
        flags.append(
            f"The equation is not the same on both sides of a periodic pair, which makes {made:.0%} of the solution: "
            "let the source and the coefficients repeat themselves, or refine there."
        )
    lumps = list(history.in_time.parts.values())
    known = cache(lambda: in_space(run, kept, moved, lumps))

    def estimate() -> np.ndarray:
        sampled = run.unseen * np.abs(states).max(axis=1)
        sampled[0] = 0.0  # at the particles the start is right
        scale = history.sizes.scales()
        found = estimated(run, np.asarray(times), *known(), later + sampled, scale)
        part = float((found.max(axis=(0, 1), initial=0.0) / scale).max())
        if part > LARGE and not (in_time is not None and in_time > LARGE):
            flags.append(f"The estimated error is {part:.0%} of the solution: refine the cloud, or raise the order.")
        return found

    report = Report(flags, told, estimate, lambda: known()[1][-1])
    return Evolution(times, states, rates, run.cloud, recipe, not fault, stats, kept, report, fit)


def _statistics(run: Run, began: float, in_time: float | None) -> dict[str, Any]:
    end = time.perf_counter()
    counts = run.counts
    made = run.semi.system.factorisations + (run.newton.counts["factorisations"] if run.newton else 0)
    skipped = []
    if run.semi.timed.steady:
        skipped.append("data that do not change in time were looked at once")
    return {
        "scheme": NAMES[run.name],
        "steps": counts["steps"],
        "rejected": counts["rejected"],
        "factorisations": made,
        "pencils": counts["pencils"],
        "iterations": run.newton.counts["iterations"] if run.newton else 0,
        "unknowns": run.semi.system.size,
        "particles": len(run.cloud),
        "damping": run.damping,
        "depth": run.depth,
        "error_in_time": in_time,
        "skipped": skipped,
        "seconds": {"pencil": counts["seconds in pencils"], "steps": end - began, "total": end - run.began},
        "messages": list(run.told),
    }
