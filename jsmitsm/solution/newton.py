"""Newton's method on the recursion: linearise at the local expansions, solve, fit them again."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.coefficients import numbers, slot_series
from jsmitsm.discretization.held_particles import with_held_expansions
from jsmitsm.discretization.layout import refuse_jumps
from jsmitsm.discretization.rows import all_coefficients
from jsmitsm.equation.branches import FIELD
from jsmitsm.equation.conditions import sample
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.solution.run import Run
from jsmitsm.taylor.multi_indices import multi_indices

MOST = 50
TOLERANCE = 1e-10
# A step that must be cut below this does not lead on.
SHORTEST = 1.0 / 64.0


def newton(run: Run, u0: Any) -> tuple[Any, Any, Any, Any]:
    """Values (N, F), expansions (N, F, K), whether it converged, and the number of steps.

    The iteration is not differentiated. At its end some steps are repeated with derivatives:
    near the solution a step contracts errors of the expansions, and those of their derivatives
    alike, so that this is the implicit derivative and not that of the history.
    """
    values, taylor = _start(run, u0)
    one = _advance(run, taylor)
    if any(concrete(x) is None for x in one):
        values, taylor, good, steps = _compiled(run, values, taylor)
        rate = 0.1
    else:
        with bar("Newton steps") as shown:
            values, taylor, good, steps, rate = _iterate(run, values, taylor, one, shown)
    _refuse_jumps(run, values, taylor)
    if is_traced(one):
        for _ in range(_repeats(rate)):
            values, taylor = _advance(run, taylor)
    return values, taylor, good, steps


def _refuse_jumps(run: Run, values: Any, taylor: Any) -> None:
    """Refuse jumps that the operator differentiates where they depend on u, as it has come out."""
    disc, found = run.disc, run.disc.traced.branches
    if found is None or not found.depends & FIELD:
        return
    slots, place = slot_series(disc.rec, found.slots, taylor, 0)[:, 0], (0,) * disc.rec.dim
    given = [values[:, f] if b == place else slots[k] for k, (f, b) in enumerate(found.slots)]
    refuse_jumps(disc, run.problem, (jnp if is_traced(given) else np).stack(given))


def _repeats(rate: float) -> int:
    """Steps after which the derivative's error, contracted by ``rate`` each, is below 1e-9."""
    return int(np.clip(math.ceil(math.log(1e-9) / math.log(min(max(rate, 1e-12), 0.5))), 2, 20))


def _advance(run: Run, taylor: Any) -> tuple[Any, Any]:
    """One full Newton step from the expansions."""
    nums = numbers(run.disc, run.problem, taylor)
    values, _ = run.step(nums)
    return values, with_held_expansions(run.disc, all_coefficients(run.disc, nums, values))


def _iterate(
    run: Run, values: Any, taylor: Any, one: tuple[Any, Any], shown: Any
) -> tuple[Any, Any, bool, int, float]:
    """Damped Newton's method; the length of the next step must not grow (natural monotonicity)."""
    target = tuple(np.asarray(concrete(x)) for x in one)
    values = np.asarray(concrete(values))
    # Lengths are absolute: measured against values that grow, a step that leads away looks shorter.
    length, steps, rate = _distance(target[0], values), 1, 0.1
    while length > TOLERANCE * _size(target[0]) and steps < MOST:
        part = 1.0
        while True:
            values_new = values + part * (target[0] - values)
            taylor_new = taylor + part * (target[1] - taylor)
            next_target = _tried(run, taylor_new)
            next_length = np.inf if next_target is None else _distance(next_target[0], values_new)
            small = TOLERANCE * _size(values_new)
            if next_length <= max((1.0 - part / 4.0) * length, small) or part <= SHORTEST:
                break
            part /= 2.0
        if next_target is None or not np.isfinite(next_length):
            break
        rate = next_length / length if part == 1.0 else rate
        values, taylor, target, length = values_new, taylor_new, next_target, next_length
        steps += 1
        shown.note(f"change {length:.1e}")
        shown.update()
    relative = length / _size(target[0])
    good = bool(relative <= 1e-8)
    if not good:
        _refuse_jumps(run, target[0], target[1])
        run.fail(
            f"Newton's method did not converge: after {steps} steps the next one would still change u by "
            f"{relative:.1e} of its size; start nearer (u0), approach the parameters in stages (js.continuation), or "
            "refine the cloud"
        )
    return target[0], target[1], good, steps, rate


def _tried(run: Run, taylor: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """A step, or None where the linearised problem is singular."""
    try:
        values, taylor = (np.asarray(concrete(x)) for x in _advance(run, taylor))
    except SolveError:
        return None
    return (values, taylor) if np.isfinite(values).all() else None


def _distance(new: np.ndarray, old: np.ndarray) -> float:
    return float(np.abs(new - old).max())


def _size(values: np.ndarray) -> float:
    return float(np.abs(values).max(initial=0.0)) or 1.0


def _compiled(run: Run, values: Any, taylor: Any) -> tuple[Any, Any, Any, Any]:
    """Undamped Newton's method where no number can be looked at (under jit)."""

    def length(new, old):
        return jnp.max(jnp.abs(new - old)) / jnp.maximum(jnp.max(jnp.abs(new)), 1e-300)

    def more(carry):
        *_, change, steps = carry
        return (change > TOLERANCE) & (steps < MOST)

    def step(carry):
        values, taylor, _, steps = carry
        new, taylor = jax.lax.stop_gradient(_advance(run, taylor))
        return new, taylor, length(new, values), steps + 1

    start = (jnp.asarray(values, float), jnp.asarray(taylor, float), jnp.inf, 0)
    values, taylor, change, steps = jax.lax.while_loop(more, step, start)
    return values, taylor, change <= 1e-8, steps


def _start(run: Run, u0: Any) -> tuple[Any, Any]:
    """Values (N, F) and expansions (N, F, K) to start from."""
    disc = run.disc
    n, fields = disc.held.shape
    if u0 is None:
        values = np.zeros((n, fields))
    elif callable(u0):
        points = jax.lax.stop_gradient(disc.cloud.points)
        values = sample(u0, points, run.problem.params, fields, "u0").T
    else:
        values = (u0 if is_traced(u0) else np.asarray(u0, float)).reshape(n, fields)
    values = jax.lax.stop_gradient(values)
    if concrete(values) is None or is_traced(disc.stencils.indices):
        return values, jnp.zeros((n, fields, disc.rec.size)).at[:, :, 0].set(values)
    given = np.asarray(concrete(values))
    taylor = np.zeros((n, fields, disc.rec.size))
    taylor[:, :, 0] = given
    points = concrete(disc.points)
    if u0 is not None and points is not None:
        near = np.asarray(disc.stencils.indices)
        owners = disc.images.owners(near)
        _add_slopes(taylor, np.asarray(points), near, owners, disc.rec.dim, disc.rec.order)
    return given, taylor


def _add_slopes(
    taylor: np.ndarray, points: np.ndarray, near: np.ndarray, owners: np.ndarray, dim: int, order: int
) -> None:
    """First and second Taylor coefficients of the start, by least squares over the neighbours."""
    some = [a for a in multi_indices(dim, min(order, 2)) if sum(a)]
    offset = np.where((near >= 0)[..., None], points[np.maximum(near, 0)] - points[: len(near), None], 0.0)
    length = np.sqrt((offset**2).sum(axis=2).max(axis=1))
    scaled = offset / length[:, None, None]
    p = np.stack([np.prod(scaled ** np.array(a), axis=2) for a in some], axis=2)
    change = np.where((near >= 0)[..., None], taylor[np.maximum(owners, 0), :, 0] - taylor[:, None, :, 0], 0.0)
    fitted = np.linalg.pinv(p, rcond=1e-6) @ change  # (N, some, F)
    powers = length[:, None] ** -np.array([float(sum(a)) for a in some])
    taylor[:, :, 1 : 1 + len(some)] = np.swapaxes(fitted * powers[:, :, None], 1, 2)
