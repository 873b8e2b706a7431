"""Newton's method for values and unknowns together, where the problem is linear in neither.

A step linearises equation, conditions and constraints at values v, expansions and unknowns g. With the linear system
A u = b of the recursion there, and G = d(A v - b)/dg by differences, it solves

    [ A  G ] [ u       ]   [ b                ]
    [ C  D ] [ g' - g  ] = [ C v - c(v, g)    ],

C and D the slopes of the constraints c = 0. What G lacks of the derivative slows the steps down a little and moves no
solution. So an unknown may be a coefficient, an eigenvalue among them, and a branch is followed past its fold.

Under jit, where no number is known, the steps are full ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.leave_one_out import with_held
from jsmitsm.linear.linsolve import times
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.solution.nonlinear.damped import Found, damped
from jsmitsm.solution.nonlinear.newton import (
    SHALLOW,
    compiled,
    from_nearer,
    judged,
    relative_change,
    repeats,
    sought,
    wandering,
    without_depth,
)
from jsmitsm.solution.nonlinear.start import start
from jsmitsm.solution.nonlinear.steps import Iterate, Record, distance, raising, shallow
from jsmitsm.solution.unknowns.bordered import Bordered
from jsmitsm.solution.unknowns.lines import Lines, number


class Stepping:
    """Takes the steps of a run."""

    def __init__(self, run: Bordered, lines: Lines, begin: Any):
        self.run, self.lines, self.begin = run, lines, begin
        run.multipliers = not lines.names
        self._slopes: Any = None  # of the last step's equations and constraints

    def named(self, unknowns: Any) -> dict[str, Any]:
        return {name: jnp.asarray(unknowns[k]) for k, name in enumerate(self.lines.names)}

    def step(self, here: Iterate) -> Iterate:
        """One full step."""
        return self._solved(here, *self.sloped(here))

    def again(self, here: Iterate) -> Iterate:
        """One with the slopes of the step before, which are numbers: it may be differentiated."""
        rest = self.lines.missed(here.values, self.named(here.unknowns), here.taylor)
        return self._solved(here, rest, self._system(here.unknowns, here.taylor))

    def sloped(self, here: Iterate) -> tuple[Any, Any]:
        """Slopes at ``here``, for the next steps; by how much the constraints are missed, and the linear system."""
        rest, *by = self.lines.slopes(here.values, self.named(here.unknowns), here.taylor)
        system, *grown = self._by_unknowns(here)
        self._slopes = *grown, *(number(v) for v in by)
        return rest, system

    def _solved(self, here: Iterate, rest: Any, system: Any) -> Iterate:
        run, lines = self.run, self.lines
        grown, moved, by_value, by_unknown = self._slopes
        nums, (data, r, c, b) = system
        base = with_held(run.disc, nums, np.zeros(len(b)))
        run.columns, run.lines = grown, number(lines.of_free(by_value))
        run.corner = np.zeros((len(rest),) * 2) if run.multipliers else by_unknown + by_value @ moved.T
        run.right = -(rest + by_value @ (base - here.values).reshape(-1))
        run.right = run.right if is_traced(run.right) else np.asarray(run.right)
        x, _ = run.solved(data, r, c, b, balanced=False)
        found = here.unknowns if run.multipliers else here.unknowns + run.extra
        run.go(self.named(found))
        nums = run.numbers(here.taylor)
        values = with_held(run.disc, nums, x)
        if not is_traced(values):
            run.keep(nums, values)
        return Iterate(values, run.expanded(nums, values), found)

    def _system(self, unknowns: Any, taylor: Any) -> tuple[Any, Any]:
        self.run.go(self.named(unknowns))
        nums = self.run.numbers(taylor)
        return nums, self.run.assembled(nums)

    def _by_unknowns(self, here: Iterate) -> tuple[Any, Any, Any]:
        """The linear system at ``here``, and how residuals of the equations (n, G) and held values (G, N F) change with
        the unknowns; numbers."""
        run = self.run
        if run.multipliers:
            return self._system(here.unknowns, here.taylor), run.constants(), np.zeros((0, run.disc.held.size))
        free = np.flatnonzero(~run.disc.held.reshape(-1))
        u, now = number(here.values).reshape(-1)[free], number(here.unknowns)

        def looked(system: Any) -> tuple[Any, Any]:
            nums, (data, r, c, b) = system
            held = number(with_held(run.disc, nums, np.zeros(len(free)))).reshape(-1)
            return times(number(data), r, c, u) - number(b), held

        xp: Any = jnp if is_traced(u, now) else np
        sizes = self.lines.moves(self.named(now), linear=False)
        beside = [looked(self._system(now + d * e, here.taylor)) for d, e in zip(sizes, np.eye(len(now)))]
        system = self._system(here.unknowns, here.taylor)  # the last, which the run keeps
        changes = [[(b - a) / d for a, b in zip(looked(system), there)] for d, there in zip(sizes, beside)]
        return system, xp.stack([c for c, _ in changes], axis=1), xp.stack([h for _, h in changes])

    def shallow(self) -> Stepping:
        """The same without depth."""
        run, lines = shallow(self.run), self.lines
        assert lines.problem.extras is not None
        return Stepping(run, Lines(lines.problem, run, replace(lines.recipe, depth=0)), self.begin)


class JointRecord(Record):
    """A search for values and unknowns; weights: what a change of each unknown counts beside one of the values."""

    def __init__(self, stepping: Stepping, shown: Any, weights: Any):
        super().__init__(stepping.run, shown)
        self.stepping, self.weights = stepping, weights

    def shallow(self) -> JointRecord:
        return JointRecord(self.stepping.shallow(), self.shown, self.weights)

    def become(self, other: Any) -> None:
        super().become(other)
        self.stepping.lines.recipe = other.stepping.lines.recipe

    def tried(self, here: Any, altered: Any = None) -> Any:
        self.solves += 1
        try:
            return _stepped(self.stepping, here)
        except ValueError:  # far away the user's functions may be out of their range
            return None

    def distance(self, new: Any, old: Any) -> float:
        return max(distance(new, old), float(np.max(self.weights * np.abs(new.unknowns - old.unknowns), initial=0.0)))


def joint_newton(run: Bordered, lines: Lines, unknowns: dict[str, Any], u0: Any) -> tuple[Iterate, Any, Any]:
    """Values, expansions and unknowns, whether they were found, and the number of steps.

    It begins at u0, or at the solution for the unknowns as they are given.
    """
    begin = jnp.stack([jnp.asarray(unknowns[n], float) for n in lines.names]) if lines.names else np.zeros(0)
    stepping = Stepping(run, lines, number(begin))
    here = Iterate(*_first(run, u0), stepping.begin)
    missed = lines.missed(here.values, stepping.named(here.unknowns), here.taylor)
    if any(concrete(x) is None for x in (*here, missed)):
        return _compiled(stepping, here)
    here, depth = here.numbers(), run.disc.rec.depth
    with bar("Newton steps") as shown:
        target = _stepped(stepping, here)
        if target is None:
            run.fail(
                "values and unknowns: equations and constraints linearised at the start determine no step; start "
                "nearer to the solution (u0, and the unknowns' own numbers), where no constraint is flat"
            )
            nothing = Iterate(*(np.full(np.shape(x), np.nan) for x in here))
            return nothing, False, 1
        sizes = np.maximum(np.abs(target.unknowns), np.abs(stepping.begin))
        record = JointRecord(stepping, shown, target.size / np.maximum(sizes, 1e-300))
        found = _searched(record, here, target)
    run.changes = record.changes
    # At the last iterate once more, with derivatives where something is differentiated.
    last: Any = stepping.step(found.at)
    if is_traced(last):
        for _ in range(repeats(record.rate)):
            last = stepping.again(last)
    else:
        found = judged(run, found._replace(at=last))
    if run.disc.rec.depth < depth:
        run.messages.append(SHALLOW)
    if not found.good and not run.failed:
        run.fail(
            "Newton's method for values and unknowns did not converge: the next step would still change them by "
            f"{found.change:.1e} of their size; start nearer (u0, and the unknowns' own numbers), or refine the cloud"
        )
    return last, found.good and not run.failed, record.steps


def _searched(record: JointRecord, here: Iterate, target: Iterate) -> Found:
    """Damped steps; where they lead nowhere, those without depth, and full ones."""
    found = damped(record, here, target)
    if not found.good and record.run.disc.rec.depth:
        found = without_depth(record, here, _from_start) or found
    if not found.good:
        found = from_nearer(record, found, wandering(record, here, target))
    return found


def _from_start(record: JointRecord, here: Iterate) -> Found:
    target = _stepped(record.stepping, here)
    return Found(here, np.inf, False, np.zeros(0, int)) if target is None else _searched(record, here, target)


def _compiled(stepping: Stepping, here: Iterate) -> tuple[Iterate, Any, Any]:
    """Full steps where numbers are not known, the last ones with derivatives."""
    run = stepping.run

    def change(new: Iterate, old: Iterate) -> Any:
        sizes = jnp.maximum(jnp.maximum(jnp.abs(new.unknowns), jnp.abs(stepping.begin)), 1e-300)
        moved = jnp.max(jnp.abs(new.unknowns - old.unknowns) / sizes, initial=0.0)
        return jnp.maximum(relative_change(new, old), moved)

    found, good, steps = compiled(stepping.step, here, change)
    stepping.sloped(found)
    last, _ = jax.lax.scan(lambda at, _: (stepping.again(at), None), found, length=repeats(0.1))
    run.go(stepping.named(last.unknowns))
    return last, good & jnp.isfinite(last.values).all(), steps


def _stepped(stepping: Stepping, here: Iterate) -> Iterate | None:
    """One step, None where none is determined."""
    try:
        with raising(stepping.run):
            made = stepping.step(here).numbers()
    except SolveError:
        return None
    return made if all(np.isfinite(x).all() for x in made) else None


def _first(run: Bordered, u0: Any) -> tuple[Any, Any]:
    """Where it begins: at u0, at the solution for the given unknowns, or at zero where there is none."""
    here = start(run.disc, run.problem, u0)
    if u0 is not None:
        return here
    try:
        (values, taylor, _), good, *_ = sought(run.plain(), None)
    except SolveError:
        return here
    less = run.disc.rec.size - taylor.shape[2]  # where the search ended without depth
    if less:
        taylor = np.pad(taylor, ((0, 0), (0, 0), (0, less)))
    if is_traced(good):
        good = good & jnp.isfinite(values).all() & jnp.isfinite(taylor).all()
        return jnp.where(good, values, here[0]), jnp.where(good, taylor, here[1])
    return values, taylor
