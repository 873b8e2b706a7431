"""Newton's method on several processes: the damped steps of one, with an exchange of expansions after each.

Steps and decisions are those of ``jsmitsm.solution.nonlinear``, of which this has the first of its ways: damped steps,
mixed where they converge slowly. What leads on from where these end is left to one process.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jsmitsm.parallel.assembly import assembled, spread
from jsmitsm.parallel.local import Local
from jsmitsm.parallel.system import System
from jsmitsm.parallel.team import Team
from jsmitsm.runtime.errors import SolveError
from jsmitsm.solution.nonlinear import newton as alone
from jsmitsm.solution.nonlinear.start import start
from jsmitsm.solution.nonlinear.steps import Iterate


@dataclass
class Found:
    """Where Newton's method ended, and how: values (n, F) and expansions (n, F, K) on the halo."""

    values: np.ndarray
    taylor: np.ndarray
    system: System
    steps: int = 1
    changes: list[float] = field(default_factory=list)
    seconds: float = 0.0


def newton(us: Team, local: Local, solver: str, u0: Any) -> Found:
    """The solution of a nonlinear problem."""
    began = time.perf_counter()
    search = _Search(us, local, solver)
    here, target = search.first(u0)
    found = search.damped(here, target)
    with us.phase(local.halo.slab.number):
        alone.refuse_jumps_at(local.run, found.values, found.taylor)
    found.seconds = time.perf_counter() - began
    return found


class _Search:
    """Steps of one search; all processes take the same."""

    def __init__(self, us: Team, local: Local, solver: str):
        self.us, self.local, self.solver = us, local, solver
        self.system: Any = None

    def first(self, u0: Any) -> tuple[Iterate, Iterate]:
        """The start and the first full step from it."""
        try:
            one = self._step(lambda: self._start(u0).taylor)
        except SolveError as error:
            raise SolveError(
                f"the equation linearised at the start of Newton's method ({'u = 0' if u0 is None else 'u0'}) cannot "
                f"be solved ({error.args[0].split(';')[0]}); give another start, u0=...",
                error.particles,
            ) from error
        return self._start(u0), one

    def _start(self, u0: Any) -> Iterate:
        """Values and expansions of u0 on the present halo; those of borrowed particles from their owners."""
        local = self.local
        slab = local.halo.slab
        with self.us.phase():
            if u0 is not None and not callable(u0):
                shape = (slab.count, local.disc.rec.fields)
                if np.shape(u0) not in (shape, shape[:1]):
                    raise ValueError(f"u0: shape {np.shape(u0)}, expected a function of x or {shape}")
                u0 = np.asarray(u0, float).reshape(shape)[slab.number]
            found = Iterate(*map(np.asarray, start(local.disc, local.disc.problem, u0)))
        return Iterate(*(local.halo.spread(x) for x in found))

    def _step(self, at: Any) -> Iterate:
        """One full step from the expansions that ``at`` returns."""
        local = self.local
        self.system, b = assembled(self.us, local, self.solver, at)
        values = spread(local, self.system.solve(b))
        return Iterate(values, local.expanded(values, at()))

    def _tried(self, here: Iterate) -> Iterate | None:
        """The step from ``here``; None where the linearised problem is singular or leads to no numbers."""
        try:
            made = self._step(lambda: here.taylor)
        except SolveError:
            return None
        bad = not all(np.isfinite(x).all() for x in made)
        return None if self.us.total(int(bad)) else made

    def _size(self, here: Iterate) -> float:
        return self.us.most(float(np.abs(here.values).max(initial=0.0))) or 1.0

    def _distance(self, new: Iterate, old: Iterate) -> float:
        return self.us.most(float(np.abs(new.values - old.values).max(initial=0.0)))

    def damped(self, here: Iterate, target: Iterate) -> Found:
        """Damped Newton's method; the length of the next step must not grow (natural monotonicity)."""
        us = self.us
        length, size, part, refused, steps = self._distance(target, here), self._size(target), 1.0, 0, 1
        changes, history = [length / size], [(here, target)]

        def found(good: bool = False) -> Found:
            if not good and length > alone.GOOD * size:
                raise SolveError(
                    f"Newton's method did not converge: after {steps} damped step(s) the next one would still change "
                    f"u by {length / size:.1e} of its size; start nearer (u0), or use js.solve, which tries more ways"
                )
            return Found(*target, self.system, steps, changes)

        for _ in range(alone.MOST):
            if length <= alone.DONE * size:
                break
            while True:
                new = here.toward(target, part) if len(history) < 2 else self._mixed(history)
                after = self._tried(new)
                next_length = np.inf if after is None else self._distance(after, new)
                if after is not None and next_length <= max((1.0 - part / 4.0) * length, alone.DONE * self._size(new)):
                    break
                if part == 1.0 and length <= alone.STALLED * size and next_length <= 100.0 * length:
                    return found(True)
                if len(history) > 1:
                    history = history[-1:]
                elif part <= alone.SHORTEST or refused == alone.REFUSED:
                    return found()
                else:
                    part, refused = part / 2.0, refused + 1
            slow = part == 1.0 and next_length > alone.SLOW * length and next_length < alone.CLOSE * self._size(after)
            history = [*(history[-alone.DEPTH :] if slow else []), (new, after)]
            here, target, length, part = new, after, next_length, min(1.0, 2.0 * part)
            size, steps = self._size(target), steps + 1
            changes.append(length / size)
        us.gather(None)
        return found()

    def _mixed(self, history: list[tuple[Iterate, Iterate]]) -> Iterate:
        """Anderson's mixing, see ``jsmitsm.solution.nonlinear.steps.mixed``: least squares by every part's triangle."""
        own = self.local.halo.ids
        steps = np.stack([(new.values - old.values)[own].ravel() for old, new in history])
        columns = np.concatenate([steps[:-1] - steps[-1], -steps[-1:]]).T
        triangle = np.concatenate(self.us.gather(np.linalg.qr(columns, mode="r")))
        shares = np.linalg.lstsq(triangle[:, :-1], triangle[:, -1], rcond=1e-10)[0]
        shares = np.append(shares, 1.0 - shares.sum())
        return Iterate(*(sum(a * x for a, x in zip(shares, part)) for part in zip(*(new for _, new in history))))
