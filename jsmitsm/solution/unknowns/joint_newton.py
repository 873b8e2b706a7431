"""Newton's method for values and unknowns together, where the problem is linear in neither.

A step linearises equation, conditions and constraints at values v, expansions and unknowns g. With the linear system
A u = b of the recursion there, and G = d(A v - b)/dg by differences, it solves

    [ A  G ] [ u       ]   [ b                ]
    [ C  D ] [ g' - g  ] = [ C v - c(v, g)    ],

C and D the slopes of the constraints c = 0. What G lacks of the derivative slows the steps down a little and moves no
solution. So an unknown may be a coefficient, an eigenvalue among them, and a branch is followed past its fold.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.leave_one_out import with_held
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.solution.nonlinear.damped import damped
from jsmitsm.solution.nonlinear.newton import from_nearer, judged, newton, repeats, wandering
from jsmitsm.solution.nonlinear.start import start
from jsmitsm.solution.nonlinear.steps import Iterate, Record, distance, raising
from jsmitsm.solution.unknowns.bordered import Bordered
from jsmitsm.solution.unknowns.lines import Lines

# Part of an unknown, or of one where it is nothing, by which it is moved for a difference.
MOVED = 1e-5


class Stepping:
    """Takes the steps of a run."""

    def __init__(self, run: Bordered, lines: Lines, begin: np.ndarray):
        self.run, self.lines, self.begin = run, lines, begin
        run.multipliers = not lines.names
        self._slopes: Any = None  # of the last step's equations and constraints

    def named(self, unknowns: Any) -> dict[str, Any]:
        return {name: jnp.asarray(unknowns[k]) for k, name in enumerate(self.lines.names)}

    def step(self, here: Iterate) -> Iterate:
        """One full step."""
        grown, moved = self._by_unknowns(here)
        rest, *by = self.lines.slopes(here.values, self.named(here.unknowns), here.taylor)
        self._slopes = grown, moved, *(np.asarray(concrete(v)) for v in by)
        return self._solved(here, rest)

    def again(self, here: Iterate) -> Iterate:
        """One with the slopes of the step before, which are numbers: it may be differentiated."""
        return self._solved(here, self.lines.missed(here.values, self.named(here.unknowns), here.taylor))

    def _solved(self, here: Iterate, rest: Any) -> Iterate:
        run, lines = self.run, self.lines
        grown, moved, by_value, by_unknown = self._slopes
        nums, (data, r, c, b) = self._system(here.unknowns, here.taylor)
        base = with_held(run.disc, nums, np.zeros(len(b)))
        run.columns, run.lines = grown, np.asarray(lines.of_free(by_value))
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

    def _by_unknowns(self, here: Iterate) -> tuple[np.ndarray, np.ndarray]:
        """How residuals of the equations (n, G) and held values (G, N F) change with the unknowns; numbers."""
        run = self.run
        if run.multipliers:
            return run.constants(), np.zeros((0, run.disc.held.size))
        free = np.flatnonzero(~run.disc.held.reshape(-1))
        u = np.asarray(concrete(here.values)).reshape(-1)[free]

        def looked(unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            nums, (data, r, c, b) = self._system(unknowns, here.taylor)
            held = np.asarray(concrete(with_held(run.disc, nums, np.zeros(len(free))))).reshape(-1)
            return np.bincount(r, np.asarray(concrete(data)) * u[c], len(free)) - np.asarray(concrete(b)), held

        now = np.asarray(concrete(here.unknowns))
        sizes = MOVED * np.maximum(np.abs(now), np.where(self.begin != 0, np.abs(self.begin), 1.0))
        first = looked(now)
        changes = [[(b - a) / d for a, b in zip(first, looked(now + d * e))] for d, e in zip(sizes, np.eye(len(now)))]
        return np.stack([c for c, _ in changes], axis=1), np.stack([h for _, h in changes])


class JointRecord(Record):
    """A search for values and unknowns."""

    stepping: Stepping
    weights: Any = 0.0  # what a change of each unknown counts beside one of the values

    def tried(self, here: Any, altered: Any = None) -> Any:
        self.solves += 1
        try:
            return _stepped(self.stepping, here)
        except ValueError:  # far away the user's functions may be out of their range
            return None

    def distance(self, new: Any, old: Any) -> float:
        return max(distance(new, old), float(np.max(self.weights * np.abs(new.unknowns - old.unknowns), initial=0.0)))


def joint_newton(run: Bordered, lines: Lines, unknowns: dict[str, Any], u0: Any) -> tuple[Iterate, bool, int]:
    """Values, expansions and unknowns, whether they were found, and the number of steps.

    It begins at u0, or at the solution for the unknowns as they are given.
    """
    begin = np.array([float(_known(unknowns[n])) for n in lines.names])
    stepping = Stepping(run, lines, begin)
    here = Iterate(*_first(run, u0), begin)
    _known(here.values)
    with bar("Newton steps") as shown:
        record = JointRecord(run, shown)
        record.stepping = stepping
        here = here.numbers()
        target = _stepped(stepping, here)
        if target is None:
            run.fail(
                "values and unknowns: equations and constraints linearised at the start determine no step; start "
                "nearer to the solution (u0, and the unknowns' own numbers), where no constraint is flat"
            )
            nothing = Iterate(*(np.full(np.shape(x), np.nan) for x in here))
            return nothing, False, 1
        record.weights = target.size / np.maximum(np.maximum(np.abs(target.unknowns), np.abs(begin)), 1e-300)
        found = damped(record, here, target)
        if not found.good:
            found = from_nearer(record, found, wandering(record, here, target))
    run.changes = record.changes
    # At the last iterate once more, with derivatives where something is differentiated.
    last: Any = stepping.step(found.at)
    if is_traced(last):
        for _ in range(repeats(record.rate)):
            last = stepping.again(last)
    else:
        found = judged(run, found._replace(at=last))
    if not found.good and not run.failed:
        run.fail(
            "Newton's method for values and unknowns did not converge: the next step would still change them by "
            f"{found.change:.1e} of their size; start nearer (u0, and the unknowns' own numbers), or refine the cloud"
        )
    return last, found.good and not run.failed, record.steps


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
    if u0 is None:
        try:
            values, taylor, _, _ = newton(run.plain(), None)
            return values, taylor
        except SolveError:
            pass
    return start(run.disc, run.problem, u0)


def _known(x: Any) -> Any:
    found = concrete(x)
    if found is None:
        raise ValueError(
            "constraints: jax.jit and jax.vmap cannot wait for Newton's method for values and unknowns, which looks at "
            "numbers; call js.solve, or jax.grad of it, without them"
        )
    return found
