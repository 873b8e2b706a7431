"""Newton's method: it arrives from far, ends quadratically, and its end carries derivatives.

The local fits solve the linearised recursion, so that a step from expansions U leads to values and expansions V with
R(U) + R'(U) (V - U) = 0, for both together. What it lacks of a quadratic rate is the misfit of the fits times the
curvature of the equation, as in Gauss's and Newton's method for least squares: a step turns the local solutions among
which the next fit is sought. It falls with the misfit (a driven cavity at order 6: 0.2 on 17 x 17 particles, 0.02 on
27 x 27), and steps that end linearly are mixed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.coefficients import slot_series
from jsmitsm.discretization.layout import refuse_jumps
from jsmitsm.equation.branches import FIELD
from jsmitsm.runtime.errors import SolveError, some
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.solution.nonlinear.damped import DONE, GOOD, MOST, Found, damped
from jsmitsm.solution.nonlinear.start import harmonic, start
from jsmitsm.solution.nonlinear.steps import Falling, Iterate, Record, advance, raising, relaxed
from jsmitsm.solution.run import Run

# Under jit, where no condition is known, steps below STALLED that do not fall are taken to be round-off.
STALLED = 1e-7
# Where only the first full step tells how large the solution is, it may be this much larger than that.
WARY = 0.01
NOTHING = "the equation says nothing"
SHALLOW = "With a recursion deeper than the order Newton's steps do not settle; this is without depth."
# So many full steps in the end, until one is this short.
WANDERING, NEAR = 30, 1e-3


def newton(run: Run, u0: Any) -> tuple[Any, Any, Any, Any]:
    """Values (N, F), expansions (N, F, K), whether it converged, and the number of steps.

    The iteration is not differentiated. At its end some steps are repeated with derivatives:
    near the solution a step contracts errors of the expansions, and those of their derivatives
    alike, so that this is the implicit derivative and not that of the history.
    """
    (values, taylor, _), good, steps, rate = sought(run, u0)
    if rate is not None:
        for _ in range(repeats(rate)):
            values, taylor, _ = advance(run, taylor)
    return values, taylor, good, steps


def sought(run: Run, u0: Any) -> tuple[Iterate, Any, Any, float | None]:
    """Where the iteration ends, whether it converged, the number of steps, and by how much one of them contracts where
    something is traced, else None."""
    here, one = _first(run, Iterate(*start(run.disc, run.problem, u0)), u0 is None)
    if any(concrete(x) is None for x in one):
        at, good, steps = compiled(lambda old: advance(run, old.taylor), here, relative_change)
        rate = 0.1
    else:
        with bar("Newton steps") as shown:
            record = Record(run, shown)
            found = _searched(record, here.numbers(), one.numbers())
        at, good, steps, rate = found.at, found.good, record.steps, record.rate
        run.changes = record.changes
    refuse_jumps_at(run, at.values, at.taylor)
    return at, good, steps, rate if is_traced(one) else None


def refuse_jumps_at(run: Run, values: Any, taylor: Any) -> None:
    """Refuse jumps that the operator differentiates where they depend on u, as it has come out."""
    for disc, _, ids in run.operators():
        found = disc.traced.branches
        if found is None or not found.depends & FIELD:
            continue
        slots, place = slot_series(disc.rec, found.slots, taylor[ids], 0)[:, 0], (0,) * disc.rec.dim
        given = [values[ids, f] if b == place else slots[k] for k, (f, b) in enumerate(found.slots)]
        refuse_jumps(disc, disc.problem, (jnp if is_traced(given) else np).stack(given))


def repeats(rate: float) -> int:
    """Steps after which the derivative's error, contracted by ``rate`` each, is below 1e-9."""
    return int(np.clip(math.ceil(math.log(1e-9) / math.log(min(max(rate, 1e-12), 0.5))), 2, 20))


def _first(run: Run, here: Iterate, free: bool) -> tuple[Iterate, Iterate]:
    """The start and the first full step; ``free``: another start may be taken where the equation is singular there."""
    formulation = run.formulation
    try:
        with raising(run):
            one = advance(run, here.taylor)
            _refuse_degenerate(run)
            return here, one
    except SolveError as error:
        other = harmonic(run.disc) if free else None
        if other is not None:
            run.formulation = formulation
            return _first(run, Iterate(*other), False)
        text = error.args[0]
        if "singular" in text or NOTHING in text:
            text = (
                f"the equation linearised at the start of Newton's method ({'u = 0' if free else 'u0'}) is singular "
                f"({text.split(';')[0]}); give another start, u0=..., at which the derivative of the pde by u does not "
                "degenerate (not flat where the slope is a factor), or a condition that is missing"
            )
        run.fail(text, error.particles)
    return here, Iterate(*(np.full(np.shape(x), np.nan) for x in here))


def _refuse_degenerate(run: Run) -> None:
    """An equation of which nothing is left at a particle leaves its fit free there, and the system regular."""
    for _, nums, ids in run.operators():
        if nums is None or is_traced(nums.jac):
            return
        left = np.abs(np.asarray(nums.jac)[:, :, 0]).max(axis=1).min(axis=0)
        if (left == 0).any():
            at = ids[np.broadcast_to(nums.ids, np.broadcast_shapes(nums.ids.shape, left.shape))[left == 0]]
            run.fail(f"{NOTHING} at {len(at)} particle(s), first {some(at)}", at)


def _searched(record: Record, begin: Iterate, first: Iterate) -> Found:
    """Damped steps; where they lead nowhere, those without depth, in pseudo-time, and in the end full ones."""
    if not np.isfinite(first.values).all():
        return Found(first, np.inf, False, np.zeros(0, int))
    best = damped(record, begin, first)
    ways = ["damped steps"]
    if record.run.disc.rec.depth and not best.good:
        ways.append("steps without depth")
        best = without_depth(record, begin, _from_start) or best
        if not record.run.disc.rec.depth:
            return best
    for name, search in (("pseudo-time steps", _in_pseudo_time), ("full steps", wandering)):
        if best.good:
            break
        ways.append(name)
        best = from_nearer(record, best, search(record, begin, first))
    if not best.good:
        refuse_jumps_at(record.run, best.at.values, best.at.taylor)
        record.run.fail(
            f"Newton's method did not converge: {', '.join(ways)} were tried, {record.solves} linear solves, and the "
            f"next one would still change u by {best.change:.1e} of its size; start nearer (u0), approach the "
            "parameters in stages (js.continuation), or refine the cloud"
        )
    return judged(record.run, released(record, best))


def released(record: Record, found: Found) -> Found:
    """Particles that were kept from moving settle once all others have, most often: from where the search ended, or
    from expansions that its values alone tell. Fewer of them are kept then, or all is as it was."""
    while found.good and len(found.frozen):
        known = list(record.changes), record.rate
        afresh = Iterate(*start(record.run.disc, record.run.problem, found.at.values)).numbers()
        again = next((more for begin in (found.at, afresh) if (more := _with_fewer(record, begin, found))), None)
        if again is None:
            record.tried(found.at)  # what the run knows is of its last step
            record.changes[:], record.rate = known
            break
        found = again
    return found


def _with_fewer(record: Record, begin: Iterate, found: Found) -> Found | None:
    """Where damped steps from ``begin`` end, if fewer particles are kept from moving there."""
    step = record.tried(begin)
    again = None if step is None else damped(record, begin, step)
    return again if again is not None and again.good and len(again.frozen) < len(found.frozen) else None


def from_nearer(record: Record, best: Found, near: Iterate | None) -> Found:
    """The best so far, or what damped steps find from another start."""
    step = None if near is None else record.tried(near)
    if near is None or step is None:
        return best
    return min(best, damped(record, near, step), key=lambda found: (not found.good, found.change))


def judged(run: Run, found: Found) -> Found:
    """Data of a field that floats must balance at a solution; particles that do not settle are left to the flags."""
    if found.good and run.floating:
        run.check_balance(found.at.taylor)
        found = found._replace(good=not run.failed)
    run.unsettled = found.frozen
    return found


def without_depth(record: Record, begin: Iterate, search: Callable[[Any, Iterate], Found]) -> Found | None:
    """From the solution where the recursion ends with the fit, for far from it deep expansions mislead.

    Where they mislead next to it too, as at the corner of a moving lid, it is the solution, and the run without depth.
    None where there is no solution either. search: the way to one from a start.
    """
    other, size = record.shallow(), record.run.disc.rec.size
    low = other.run.disc.rec.size
    try:
        found = search(other, begin._replace(taylor=begin.taylor[:, :, :low]))
    except SolveError:
        return None
    finally:
        record.steps, record.solves = record.steps + other.steps, record.solves + other.solves
    if not found.good:
        return None
    record.changes += other.changes
    near = found.at._replace(taylor=np.pad(found.at.taylor, ((0, 0), (0, 0), (0, size - low))))
    step = record.tried(near)
    deep = None if step is None else damped(record, near, step)
    if deep is not None and deep.good:
        return deep
    record.become(other)
    record.run.messages.append(SHALLOW)
    return found


def _from_start(record: Record, begin: Iterate) -> Found:
    return _searched(record, begin, advance(record.run, begin.taylor).numbers())


def _in_pseudo_time(record: Record, begin: Iterate, first: Iterate) -> Iterate | None:
    """Time begins at the start; how large each field is, it and the held values tell, or else the first full step."""
    held = np.where(record.run.disc.held, first.values, 0.0)
    known = np.maximum(np.abs(begin.values), np.abs(held)).max(axis=0)
    scales = np.where(known > 0, known, np.abs(first.values).max(axis=0))
    scales = np.where(scales > 0, scales, 1.0)
    near = relaxed(record, begin, scales)
    return near if near is not None or known.all() else relaxed(record, begin, WARY * scales)


def wandering(record: Record, begin: Iterate, first: Iterate) -> Iterate | None:
    """Full steps, whatever their length: near singular matrices they are long and lead far, and come back."""
    here, target, falling = begin, first, Falling()
    for _ in range(WANDERING):
        after = record.tried(target)
        if after is None:
            return None
        here, target = target, after
        length = record.distance(target, here)
        record.went(length, target.size)
        if length <= NEAR * target.size:
            return target
        if not falling.still(length / target.size):
            return None
    return None


def compiled(
    step: Callable[[Iterate], Iterate], here: Iterate, change: Callable[[Iterate, Iterate], Any]
) -> tuple[Iterate, Any, Any]:
    """Undamped Newton's method where no number can be looked at (under jit): where it ends, whether well, the steps.

    change: of a new iterate and the old one, relative to the solution.
    """

    def more(carry):
        _, last, before, steps = carry
        return (last > DONE) & (steps < MOST) & ~_stalled(last, before)

    def stepped(carry):
        old, before, _, steps = carry
        new = jax.lax.stop_gradient(step(old))
        return new, change(new, old), before, steps + 1

    begin = Iterate(*(jnp.asarray(x, float) for x in here)), jnp.inf, jnp.inf, 0
    found, last, before, steps = jax.lax.while_loop(more, stepped, begin)
    return found, (last <= GOOD) | _stalled(last, before), steps


def relative_change(new: Iterate, old: Iterate) -> Any:
    return jnp.max(jnp.abs(new.values - old.values)) / jnp.maximum(jnp.max(jnp.abs(new.values)), 1e-300)


def _stalled(change: Any, before: Any) -> Any:
    """Round-off: short steps that no longer fall."""
    return (change <= STALLED) & (change >= before)
