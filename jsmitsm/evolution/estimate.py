"""The error of an evolution: what a pencil of two orders more makes of the same rates, and where errors of steps go."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from jsmitsm.evolution.run import Run, drifted
from jsmitsm.evolution.sizes import scales
from jsmitsm.evolution.space.semidiscrete import Semidiscrete
from jsmitsm.evolution.space.system import System
from jsmitsm.evolution.steps import dense_output
from jsmitsm.evolution.steps.in_time import PARTS as ALL_PARTS
from jsmitsm.evolution.steps.newton import Newton
from jsmitsm.evolution.steps.stepping import RadauStepper, Stepper
from jsmitsm.evolution.steps.tableaux import KENCARP4, RADAU
from jsmitsm.evolution.unseen import left_between, looker
from jsmitsm.runtime.progress import PENCIL, bar
from jsmitsm.solution.estimate import lower
from jsmitsm.taylor.multi_indices import HIGHEST

# So many times are looked at. From one to the next the error goes in so many parts, in each of which the misfit is
# looked at so many times at most.
LOOKS, MOST = 10, 4
PARTS = ALL_PARTS // LOOKS


@bar("error estimate", parts=(*PENCIL, ("times", 4.0)))
def in_space(
    run: Run, history: tuple[np.ndarray, np.ndarray], rates: np.ndarray | None, lumps: list[tuple[float, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (K + 1,), and estimated errors w - u (K + 1, N, F) at them: A' w = B' f + Bg' g, f = -(M u' + N).

    Dashes are of order p + 2. What the rates leave over drives the error, from zero at the start. history: times and
    values of the steps; rates: theirs, of second order in time. Zero where nothing is known: at the highest orders.
    The third is where the errors of steps, lumps (size,) at times, have gone on the way, where that is known. Where
    order p + 2 makes more of the error than there is of the solution, it is p + 1 or a lower order, if that does not:
    on some clouds the higher pencil has a growing mode, of which the run knows nothing.
    """
    semi, (steps, values) = run.semi, history
    if len(steps) < 2 or run.order + 2 > HIGHEST:
        return steps[[0, -1]], *np.zeros((2, 2, semi.n, semi.fields))
    grid = np.linspace(steps[0], steps[-1], min(LOOKS, len(steps) - 1) + 1)
    scale = scales(semi, np.abs(values).max(axis=(0, 1)))
    errors, carried = _towards(run, run.order + 2, steps, values, rates, grid, lumps)
    if not _within(errors, carried, scale):
        below = lower(run.order, semi.timed.order)
        for order in (run.order + 1, *([below] if below < run.order else [])):
            other = _towards(run, order, steps, values, rates, grid, lumps)
            if _within(*other, scale):
                errors, carried = other
                break
    for each in (errors, carried):
        each.reshape(len(grid), -1)[:, semi.held] = 0.0
    return grid, errors, carried


def _within(errors: np.ndarray, carried: np.ndarray, scale: np.ndarray) -> bool:
    """Whether errors (K + 1, N, F) are smaller than the solution."""
    return bool((np.maximum(np.abs(errors), np.abs(carried)).max(axis=(0, 1)) <= scale).all())


def _towards(
    run: Run, order: int, steps: Any, values: Any, rates: Any, grid: np.ndarray, lumps: list[tuple[float, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """The errors in space and in time (K + 1, N, F) by the equations of an order."""
    # Pairs of fields that drive one another are the ones that are damped.
    if run.semi.second or run.damping:
        integrated = _travelled if run.semi.second else _summed
        errors = integrated(run.semi, run.beside(order, float(steps[0]), values[0]), steps, values, rates, grid)
        return errors, np.zeros_like(errors)
    return _integrated(run, order, steps, values, rates, grid, lumps)


def estimated(
    run: Run, times: np.ndarray, grid: np.ndarray, errors: np.ndarray, carried: np.ndarray, in_time: np.ndarray,
    scale: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """The sizes of errors (S, N, F) at the times: of those in space at a grid, and of what steps add.

    carried: that, at the grid, where it is known where it has gone; in_time (S, F): how much of it is known to be
    there, of fields of a scale (F,). Where the sum of steps' errors does not know how fields drive one another, all are
    taken to be off by the same part of themselves.
    """
    if run.semi.second or run.damping or not run.semi.linear:
        in_time = (in_time / scale).max(axis=1, keepdims=True) * scale
    index = np.clip(np.searchsorted(grid, times), 1, len(grid) - 1)
    part = ((times - grid[index - 1]) / np.maximum(grid[index] - grid[index - 1], 1e-300))[:, None, None]
    space, steps = ((1.0 - part) * e[index - 1] + part * e[index] for e in (np.abs(errors), np.abs(carried)))
    out = space + np.maximum(steps, in_time[:, None, :])
    out.reshape(len(times), -1)[1:, run.semi.held] = 0.0
    return out


def _integrated(
    run: Run, order: int, steps: Any, values: Any, rates: Any, grid: np.ndarray, lumps: list[tuple[float, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (K + 1, N, F) in space and in time at equidistant times: E e' + A e + B N'(u) e = misfit, from e = 0.

    Those in time are driven by the errors of the steps, lumps (size,) where they were made. By the diagonally implicit
    method of two stages and second order, which damps what is stiff and lets grow what does (Alexander, SIAM J. Numer.
    Anal. 14, 1977). The misfit is its mean over a step: much of it may be over soon.
    """
    h, gamma, semi = float(grid[1] - grid[0]) / PARTS, 1.0 - math.sqrt(0.5), run.semi
    state = lambda t: dense_output.derivative(steps, values, float(t), 0)  # noqa: E731
    high, fits = run.beside(order, float(grid[0]), state(grid[0])), looker(semi, grid)
    solve, misfit = _following(semi, high, steps, values, rates, gamma * h)
    y, before = np.zeros((high.system.size, 2)), misfit(grid[0])
    nothing, out = np.zeros(len(high.held)), [np.zeros((semi.n, semi.fields, 2))]
    with bar("times", PARTS * (len(grid) - 1)) as shown:
        for begin in grid[:-1]:
            if run.timed.quasilinear and drifted(high, state(begin), float(begin)):
                high = run.beside(order, float(begin), state(begin))
                solve, misfit = _following(semi, high, steps, values, rates, gamma * h)
                before = misfit(begin)
            system, middle, left = high.system, float(begin) + 0.5 * PARTS * h, np.zeros(high.source.shape[0])
            if fits is not None:  # rows of all orders miss what jumps between the particles
                u, rate = (dense_output.derivative(steps, values, middle, j) for j in range(2))
                left = high.source.host @ left_between(semi, fits, u, [rate], middle)
            for t in begin + h * np.arange(PARTS):
                mean, before = _mean(misfit, before, steps, float(t), h)
                made = sum((e for at, e in lumps if t < at - 1e-9 * h <= t + h), np.zeros(system.size))
                force = gamma * np.stack([h * (mean - left), system.mass(made)], axis=-1)
                first = system.mass(y)
                second = system.mass(solve(first + force, t + gamma * h)) - first
                y = solve(first + (1.0 - gamma) / gamma * second + force, t + h)
                shown.update(1)
            out.append(np.stack([high.placed(column, nothing) for column in y.T], axis=-1))
    space, time = np.moveaxis(np.stack(out), -1, 0)
    return space, time


def _following(
    semi: Semidiscrete, high: Semidiscrete, steps: Any, values: Any, rates: Any, g: float
) -> tuple[Callable[..., np.ndarray], Callable[[float], np.ndarray]]:
    """What solves (E + g (A + B N'(u))) y = r (n, m) at a time, for errors go on as small changes of the run do; and
    what its states leave over."""
    misfit = lambda t: _misfit(semi, high, steps, values, rates, float(t))  # noqa: E731
    if semi.linear:
        solve = high.system.resolvent(g).solve
        return lambda r, t: solve(r), misfit
    newton = Newton(high)
    return lambda r, t: newton.around(r, dense_output.derivative(steps, values, float(t), 0), float(t), g), misfit


def _mean(
    misfit: Callable[[float], np.ndarray], before: np.ndarray, steps: np.ndarray, t: float, h: float
) -> tuple[np.ndarray, np.ndarray]:
    """The mean of the misfit between t, where it is known, and t + h, and what it is there.

    It is looked at where the run took its steps, at some of them if these are many.
    """
    inside = steps[(steps > t + 1e-9 * h) & (steps < t + (1.0 - 1e-9) * h)]
    times = np.concatenate([[t], inside[:: -(-len(inside) // MOST) or 1], [t + h]])
    found = np.stack([before, *map(misfit, times[1:])])
    return 0.5 * np.diff(times) @ (found[1:] + found[:-1]) / h, found[-1]


def _travelled(
    semi: Semidiscrete, high: Semidiscrete, steps: Any, values: Any, rates: Any, grid: np.ndarray
) -> np.ndarray:
    """The same of second order in time, by the scheme of the run in as many steps.

    Nothing dies out, and what is left over travels with the error that it makes, which grows all the way as long as
    both are in phase: a method of low order would lose that long before the run does.
    """
    many = -(-(len(steps) - 1) // (len(grid) - 1))
    h = float(grid[1] - grid[0]) / many
    scheme = RADAU if semi.linear else KENCARP4
    left = _LeftOver(high.system, _missed(semi, high, steps, values, rates, grid), scheme.nodes)

    def driven(y: np.ndarray, t: float, known: Any) -> np.ndarray:
        slope = high.linearised(high.steepness(dense_output.derivative(steps, values, t, 0), t))
        return -high.system.force(slope @ y[: high.system.n])

    stepper: Any = RadauStepper(high.system, left) if semi.linear else Stepper(high.system, left, KENCARP4, driven)
    nothing = np.zeros(len(high.held))
    now, out = stepper.first(np.zeros(high.system.size), float(grid[0])), [np.zeros((semi.n, semi.fields))]
    with bar("times", many * (len(grid) - 1)) as shown:
        for begin in grid[:-1]:
            for t in begin + h * np.arange(many):
                now = stepper.advance(now, float(t), h)
                shown.update(1)
            out.append(high.placed(now.y[: high.system.n], nothing))
    return np.stack(out)


class _LeftOver:
    """Drives a system by a misfit (n,) of the time, at the stages of a scheme; the held particles stay at zero."""

    def __init__(self, system: System, misfit: Callable[[float], np.ndarray], nodes: np.ndarray):
        self.system, self.misfit, self.nodes = system, misfit, nodes[nodes > 0]

    def start(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.system.force(self.misfit(t)), np.zeros(self.system.size), np.zeros(0)

    def step(self, t: float, h: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        forces = np.stack([self.system.force(self.misfit(t + float(c) * h)) for c in self.nodes])
        return forces, np.zeros_like(forces), np.zeros((len(forces), 0))


def _summed(
    semi: Semidiscrete, high: Semidiscrete, steps: Any, values: Any, rates: Any, grid: np.ndarray
) -> np.ndarray:
    """The same where nothing dies out, as in Schroedinger's equation: the sizes of (E + h A)^-1 misfit, added up.

    There the misfit turns with the solution, and backward Euler over long steps would damp what adds up; over h, a
    step of the run, it takes out what turns too fast to add up.
    """
    solve, sizes = high.system.resolvent(float(np.diff(steps).mean())).solve, []
    missed = _missed(semi, high, steps, values, rates, grid)
    for t in grid:
        found = high.placed(solve(missed(float(t))), np.zeros(len(high.held)))
        sizes.append(np.broadcast_to(np.linalg.norm(found, axis=1, keepdims=True), found.shape))
    between = (grid[1] - grid[0]) * (np.array(sizes[1:]) + np.array(sizes[:-1])) / 2
    return np.concatenate([np.zeros_like(between[:1]), np.cumsum(between, axis=0)])


def _missed(
    semi: Semidiscrete, high: Semidiscrete, steps: Any, values: Any, rates: Any, grid: np.ndarray
) -> Callable[[float], np.ndarray]:
    """What states leave over at a time, without what jumps between the particles, which rows of all orders miss."""
    fits = looker(semi, grid)

    def missed(t: float) -> np.ndarray:
        found = _misfit(semi, high, steps, values, rates, t)
        if fits is None:
            return found
        u, first = (dense_output.derivative(steps, values, t, j) for j in range(2))
        moved = [first] if rates is None else [dense_output.derivative(steps, rates, t, j) for j in range(2)]
        return found - high.source.host @ left_between(semi, fits, u, moved, t)

    return missed


def _misfit(semi: Semidiscrete, high: Semidiscrete, steps: Any, values: Any, rates: Any, t: float) -> np.ndarray:
    """What the state at t leaves over in the equations of the higher order."""
    at = np.asarray(t)
    held, conditions, source, *_ = (np.asarray(v) for v in high.sample(at))
    u = dense_output.derivative(steps, values, t, 0)
    if not semi.linear:
        source = source + np.asarray(high.nonlinear(high.slot_values(u), at, high.params))
    for j in range(1, 3 if semi.second else 2):
        rate = dense_output.derivative(steps, values if rates is None else rates, t, j - (rates is not None))
        mass = semi.timed.mass(j, np.asarray(semi.points), (at, semi.params))
        source = source + np.einsum("nef,nf->ne", mass, rate).reshape(-1)
    flat = u.reshape(-1)
    return (
        high.given.host @ conditions - high.source.host @ source
        - high.system.stiffness.host @ flat[high.free] - high.stiff_held.host @ held
    )  # fmt: skip
