"""Steps of Newton's method on the recursion, and implicit steps in pseudo-time, which become Newton's.

A step linearises at the expansions, solves, and fits them again. Pseudo-transient continuation goes from far away along
the way on which time would lead. The leave-one-out equations are u_i - sum_g w_g u_g = b_i, the operator times the
square of a length with the sign of minus the Laplacian: A u = b. An implicit step of du/dt = b - A u changes the matrix
by a multiple of its diagonal D only,

    (A + s D) u_new = b + s D u,

with s the inverse of the step. As the residual falls so does s (switched evolution relaxation, Mulder and van Leer
1985; convergence: Kelley and Keyes 1998).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from jsmitsm.discretization.layout import Discretization, discretize
from jsmitsm.discretization.regions.layout import Regions, discretize_regions
from jsmitsm.linear.linsolve import times
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.tracers import concrete
from jsmitsm.solution.nonlinear.start import lengths
from jsmitsm.solution.run import Run
from jsmitsm.taylor.multi_indices import multi_indices

# The first step moves no value by more than about this part of the solution; after one that did, or that moved none by
# more than SMALL of it, the next is shorter or longer by GROWTH than the residual says.
FIRST, SMALL, GROWTH = 0.5, 0.1, 2.0
# From steps this short Newton's method goes on; so many solves at most, and so many times a step is cut in a row.
NEAR, LONGEST, CUTS = 1e-3, 60, 4
# A search of which so many steps in a row come no nearer than this part of the least so far leads nowhere.
PATIENCE, NEARER = 10, 0.9

# Round-off times this and the condition of the matrix may keep the steps from falling, up to a part ROUND_OFF of the
# solution.
ROUNDING, ROUND_OFF = 10 * np.finfo(float).eps, 1e-6
# Frozen together are the particles that move by this part of the most, and at most so many.
MOVES, FEW = 0.3, 0.03


class Iterate(NamedTuple):
    """Values (N, F), expansions (N, F, K), and the global unknowns (G,) of a problem that has some."""

    values: Any
    taylor: Any
    unknowns: Any = np.zeros(0)

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


def shortest(
    history: list[tuple[Iterate, Iterate]],
    part: Callable[[Any], Any] = lambda values: values,
    triangle: Callable[[np.ndarray], np.ndarray] = lambda columns: columns,
) -> Iterate:
    """Anderson's mixing of iterates and what they led to, the last one last: their combination of the shortest step.

    part: of values, what counts here; triangle: of columns, whatever has the same least squares.
    """
    steps = np.stack([part(new.values - old.values).ravel() for old, new in history])
    columns = triangle(np.concatenate([steps[:-1] - steps[-1], -steps[-1:]]).T)
    shares = np.linalg.lstsq(columns[:, :-1], columns[:, -1], rcond=1e-10)[0]
    shares = np.append(shares, 1.0 - shares.sum())
    return Iterate(*(sum(a * x for a, x in zip(shares, each)) for each in zip(*(new for _, new in history))))


class Falling:
    """Whether what a search makes small still falls."""

    def __init__(self) -> None:
        self.least, self.waited = np.inf, 0

    def still(self, left: float) -> bool:
        """Told after each step; False after ``PATIENCE`` of them that came no nearer."""
        nearer = left < NEARER * self.least
        self.least, self.waited = (left, 0) if nearer else (self.least, self.waited + 1)
        return self.waited < PATIENCE


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
        degrees = np.array([sum(a) for a in multi_indices(self.disc.rec.dim, self.disc.rec.reach)])
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
    """One full step from the expansions; ``altered`` may change the linear system (see ``Run.step``)."""
    nums = run.numbers(taylor)
    values, _ = run.step(nums, altered)
    return Iterate(values, run.expanded(nums, values))


def shallow(run: Any) -> Any:
    """A run of the same problem whose recursion ends with the fit, which raises where it fails."""
    disc, other = run.disc, copy(run)
    given = disc.stencils if disc.given_stencils else None
    if isinstance(disc, Regions):
        near = given and given.indices
        other.disc = discretize_regions(run.problem, disc.cloud, disc.rec.order, 0, near, sources=False)
    else:
        other.disc = discretize(
            run.problem, disc.cloud, disc.scheme.method, disc.rec.order, disc.kernel, given, disc.basis_terms,
            sources=False, depth=0,
        )  # fmt: skip
    other.throw, other.health, other.linear, other.changes = True, None, {}, []
    other.messages, other.against, other.seconds = [], [], dict.fromkeys(run.seconds, 0.0)
    return other


@dataclass
class Record:
    """A search for a solution on one process, and what it has done; see ``damped.Search``."""

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

    def size(self, here: Iterate) -> float:
        return here.size

    def distance(self, new: Iterate, old: Iterate) -> float:
        return distance(new, old)

    def mixed(self, history: list[tuple[Iterate, Iterate]]) -> Iterate:
        return shortest(history)

    def rounded(self, length: float, after: float, size: float) -> bool:
        """Whether a step no longer falls because round-off, amplified by the matrix, is as large."""
        factor = self.run.factor
        if length > ROUND_OFF * size or after > 100.0 * length or factor is None:
            return False
        return bool(length <= ROUNDING * factor.condition() * size)

    def shallow(self) -> Record:
        """One of the same problem where the recursion ends with the fit."""
        return Record(shallow(self.run), self.shown)

    def become(self, other: Any) -> None:
        """Go on as another record."""
        self.run.become(other.run)
        self.rate = other.rate

    def frozen(self) -> Frozen:
        return Frozen(self.run.disc)

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


class Pull:
    """Alters a linear system A u = b so that its solution stays near to the values ``here`` (N, F)."""

    def __init__(self, free: np.ndarray, fields: int, scales: np.ndarray):
        self.free, self.field, self.scales = free, free % fields, scales
        self.here: Any = None
        self.strength = self.residual = 0.0

    def __call__(self, data: Any, r: Any, c: Any, b: Any) -> tuple[Any, Any, Any, Any]:
        data, b = np.asarray(concrete(data)), np.asarray(concrete(b))  # the search is not differentiated
        n, own = len(b), r == c
        diagonal = np.bincount(r[own], data[own], n)
        diagonal[diagonal == 0] = np.abs(diagonal).max() or 1.0
        u = self.here.reshape(-1)[self.free]
        left = np.abs(b - times(data, r, c, u)) / np.abs(diagonal)
        residual = float(np.max(left / self.scales[self.field]))
        if not self.strength:
            self.strength = residual / FIRST
        elif self.residual:
            self.strength *= residual / self.residual
        self.residual = residual
        pull, every = self.strength * diagonal, np.arange(n)
        return np.concatenate([data, pull]), np.concatenate([r, every]), np.concatenate([c, every]), b + pull * u


def relaxed(record: Record, here: Iterate, scales: np.ndarray) -> Iterate | None:
    """An iterate near a solution, or None where time does not lead to one.

    scales (F,): the size of each field.
    """
    disc = record.run.disc
    held = disc.held.reshape(-1)
    pull, falling = Pull(np.flatnonzero(~held), disc.rec.fields, scales), Falling()
    cuts = 0
    for _ in range(LONGEST):
        pull.here = here.values
        new = record.tried(here, pull)
        if new is None or not np.isfinite(pull.residual):
            pull.strength, pull.residual, cuts = 10.0 * (pull.strength or 1.0), 0.0, cuts + 1
            if cuts > CUTS:
                return None
            continue
        moved = float(np.max(np.abs(new.values - here.values) / scales))
        record.went(distance(new, here), new.size)
        here, cuts = new, 0
        if moved < NEAR and pull.strength < NEAR:
            return here
        if not falling.still(pull.residual):
            return None
        pull.strength *= 1.0 / GROWTH if moved < SMALL else GROWTH if moved > FIRST else 1.0
    return None
