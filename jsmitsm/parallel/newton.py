"""Newton's method on several processes: the damped steps of one, with an exchange of expansions after each.

The decisions are those of ``jsmitsm.solution.nonlinear.damped``; what leads on from where these steps end, and freezing
what does not settle, is left to one process.
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
from jsmitsm.solution.nonlinear.damped import damped
from jsmitsm.solution.nonlinear.newton import STALLED, refuse_jumps_at
from jsmitsm.solution.nonlinear.start import start
from jsmitsm.solution.nonlinear.steps import Iterate, shortest


@dataclass
class Found:
    """Where Newton's method ended, and how: values (n, F) and expansions (n, F, K) on the halo."""

    values: np.ndarray
    taylor: np.ndarray
    system: System
    steps: int
    changes: list[float]
    seconds: float


def newton(us: Team, local: Local, solver: str, u0: Any) -> Found:
    """The solution of a nonlinear problem."""
    began = time.perf_counter()
    search = _Search(us, local, solver)
    found = damped(search, *search.first(u0))
    if not found.good:
        raise SolveError(
            f"Newton's method did not converge: after {search.steps} damped step(s) the next one would still change "
            f"u by {found.change:.1e} of its size; start nearer (u0), or use js.solve, which tries more ways"
        )
    with us.phase(local.halo.slab.number):
        refuse_jumps_at(local.run, found.at.values, found.at.taylor)
    values, taylor, _ = found.at
    return Found(values, taylor, search.system, search.steps, search.changes, time.perf_counter() - began)


class _Free:
    """Nobody is frozen."""

    particles = np.zeros(0, int)

    def kept(self, here: Iterate) -> Iterate:
        return here

    def more(self, here: Iterate, target: Iterate) -> bool:
        return False


@dataclass
class _Search:
    """Steps of one search; all processes take the same. See ``damped.Search``."""

    us: Team
    local: Local
    solver: str
    system: Any = None
    steps: int = 1
    rate: float = 0.1
    changes: list[float] = field(default_factory=list)

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
        return Iterate(local.halo.spread(found.values), local.halo.spread(found.taylor))

    def _step(self, at: Any) -> Iterate:
        """One full step from the expansions that ``at`` returns."""
        local = self.local
        self.system, b = assembled(self.us, local, self.solver, at)
        values = spread(local, self.system.solve(b))
        local.refuse_contradictions(values)
        return Iterate(values, local.expanded(values, at()))

    def tried(self, here: Iterate) -> Iterate | None:
        """The step from ``here``; None where the linearised problem is singular or leads to no numbers."""
        try:
            made = self._step(lambda: here.taylor)
        except SolveError:
            return None
        bad = not all(np.isfinite(x).all() for x in made)
        return None if self.us.total(int(bad)) else made

    def size(self, here: Iterate) -> float:
        return self.us.most(float(np.abs(here.values).max(initial=0.0))) or 1.0

    def distance(self, new: Iterate, old: Iterate) -> float:
        return self.us.most(float(np.abs(new.values - old.values).max(initial=0.0)))

    def rounded(self, length: float, after: float, size: float) -> bool:
        """As under jit, where the condition of the matrix is not known either."""
        return length <= STALLED * size and after <= 100.0 * length

    def frozen(self) -> _Free:
        return _Free()

    def went(self, change: float, size: float) -> None:
        self.steps += 1
        self.changes.append(change / size)

    def mixed(self, history: list[tuple[Iterate, Iterate]]) -> Iterate:
        """Least squares by every part's triangle."""
        own = self.local.halo.ids
        return shortest(history, lambda x: x[own], lambda a: np.concatenate(self.us.gather(np.linalg.qr(a, mode="r"))))
