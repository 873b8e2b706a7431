"""One step of Newton's method on the recursion: linearise at the expansions, solve, fit them again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from jsmitsm.discretization.coefficients import numbers
from jsmitsm.discretization.layout import Discretization
from jsmitsm.discretization.rows import all_coefficients
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.tracers import concrete
from jsmitsm.solution.run import Run
from jsmitsm.solution.start import lengths
from jsmitsm.taylor.multi_indices import multi_indices

# Frozen together are the particles that move by this part of the most, and at most so many.
MOVES, FEW = 0.3, 0.03


class Iterate(NamedTuple):
    """Values (N, F) and expansions (N, F, K)."""

    values: Any
    taylor: Any

    def toward(self, target: Iterate, part: float) -> Iterate:
        """A part of the way; what is linear and holds of both ends holds of it too."""
        return Iterate(*(x + part * (y - x) for x, y in zip(self, target)))

    def numbers(self) -> Iterate:
        """Without derivatives."""
        return Iterate(*(np.asarray(concrete(x)) for x in self))

    @property
    def size(self) -> float:
        return float(np.abs(self.values).max(initial=0.0)) or 1.0


def distance(new: Iterate, old: Iterate) -> float:
    return float(np.abs(new.values - old.values).max())


def mixed(history: list[tuple[Iterate, Iterate]]) -> Iterate:
    """Anderson's mixing of iterates and what they led to, the last one last: their combination of the shortest step."""
    steps = np.stack([(new.values - old.values).ravel() for old, new in history])
    shares = np.linalg.lstsq((steps[:-1] - steps[-1]).T, -steps[-1], rcond=1e-10)[0]
    shares = np.append(shares, 1.0 - shares.sum())
    return Iterate(*(sum(a * x for a, x in zip(shares, part)) for part in zip(*(new for _, new in history))))


class Frozen:
    """Particles about whose expansions the equation stays linearised, because they do not settle.

    Where the cloud does not resolve the solution several polynomials may fit the equation and the neighbours equally
    well, a crest that leans this way or that, and the steps wander between them while the values hardly change.
    """

    def __init__(self, disc: Discretization):
        self.disc = disc
        self.particles = np.zeros(0, int)
        self.taylor: Any = None

    def kept(self, here: Iterate) -> Iterate:
        if not len(self.particles):
            return here
        taylor = here.taylor.copy()
        taylor[self.particles] = self.taylor[self.particles]
        return here._replace(taylor=taylor)

    def more(self, here: Iterate, target: Iterate) -> bool:
        """Freeze those whose expansions move most, few in number; False where too many do."""
        degrees = np.array([sum(a) for a in multi_indices(self.disc.rec.dim, self.disc.rec.order)])
        moved = np.abs(target.taylor - here.taylor) * np.asarray(lengths(self.disc))[:, None, None] ** degrees
        moved = moved.max(axis=(1, 2))
        moved[self.particles] = 0.0
        most = np.flatnonzero(moved >= MOVES * moved.max())
        if len(self.particles) + len(most) > max(1, FEW * len(moved)):
            return False
        self.taylor = self.kept(here).taylor
        self.particles = np.append(self.particles, most)
        return True


def advance(run: Run, taylor: Any, altered: Callable[..., Any] | None = None) -> Iterate:
    """One full step from the expansions; ``altered`` may change the linear system (see :meth:`Run.step`)."""
    nums = numbers(run.disc, run.problem, taylor)
    values, _ = run.step(nums, altered)
    return Iterate(values, all_coefficients(run.disc, nums, values))


@dataclass
class Record:
    """What a search for a solution has done."""

    run: Run
    shown: Any
    solves: int = 1
    steps: int = 1
    rate: float = 0.1  # of the last two full steps
    changes: list[float] = field(default_factory=list)

    def tried(self, here: Iterate, altered: Callable[..., Any] | None = None) -> Iterate | None:
        """The step from ``here``, or None where the linearised problem is singular or leads to no numbers."""
        self.solves += 1
        try:
            with raising(self.run):
                made = advance(self.run, here.taylor, altered).numbers()
        except SolveError:
            return None
        return made if np.isfinite(made.values).all() and np.isfinite(made.taylor).all() else None

    def went(self, change: float, size: float) -> None:
        """A step was taken, and the next one would be ``change`` long."""
        self.steps += 1
        self.changes.append(change / size)
        self.shown.note(f"change {change / size:.1e}")
        self.shown.update()


class raising:  # noqa: N801
    """Inside, a failed linear solve raises, whatever the caller of ``solve`` asked for."""

    def __init__(self, run: Run):
        self.run, self.before = run, run.throw

    def __enter__(self) -> None:
        self.run.throw = True

    def __exit__(self, *_: Any) -> None:
        self.run.throw = self.before
