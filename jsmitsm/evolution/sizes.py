"""How large the fields of a run are, each by itself: a pressure, and a velocity beside it."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.evolution.space.semidiscrete import Semidiscrete
from jsmitsm.solution.look.sizes import NOTHING

# Of the error of a step, this part of what the rows of the equations add up is round-off.
_ROUND_OFF = 1e-14
# Entries of a system's matrix have noise where fields do not meet: a field below this part of others is that, and so
# is an error of a step below the second one.
_NOISE, _NOISY = 1e-15, 1e-19
# A pressure has the size of this part of the velocities' square at least: at rest, or in shear, it may vanish.
_DYNAMIC = 0.1


def sizes(semi: Semidiscrete, part: Any) -> np.ndarray:
    """The largest size of each field (F,) among free values (n,), NaN where one is none."""
    fields = semi.free_fields
    return np.array([semi.system.largest(part[fields == k]) for k in range(semi.fields)])


def scales(semi: Semidiscrete, largest: np.ndarray, added: np.ndarray | None = None, tol: float = 1.0) -> np.ndarray:
    """What errors of fields (F,) are relative to, their largest sizes but for round-off; 1 for one that is nothing.

    added: what rows ``added_up`` in them, of which a field that is zero takes its round-off. tol: of what is looked at,
    an error of a step may be that small. Velocities of a flow are one vector, whose axes are anyone's choice.
    """
    found, flow = np.array(largest, float), semi.timed.flow
    if flow is not None:
        velocity = list(flow.velocity)
        found[velocity] = found[velocity].max()
        at = np.asarray(semi.points)[:1]
        density = np.abs(semi.timed.mass(1, at, (np.asarray(0.0), semi.params))[0][list(flow.momentum), velocity]).max()
        found[flow.pressure] = max(found[flow.pressure], _DYNAMIC * float(density) * found[velocity[0]] ** 2)
    if added is not None:
        found = np.maximum(found, max(NOTHING, _ROUND_OFF / tol) * added)
    found = np.maximum(found, max(_NOISE, _NOISY / tol) * found.max())
    return np.where(found > 0, found, 1.0)


class Sizes:
    """The largest values of a run's fields so far, and what errors of theirs are relative to."""

    def __init__(self, run: Any):
        self.run, self.largest = run, np.zeros(run.fields)
        self._y: Any = None
        self._h = 0.0
        self._added: tuple[float, np.ndarray, np.ndarray] = (0.0, self.largest, self.largest)

    def add(self, y: np.ndarray) -> None:
        """A state of the run."""
        semi = self.run.semi
        self.largest, self._y = np.maximum(self.largest, sizes(semi, y[: semi.system.n])), y

    def stepped(self, h: float) -> None:
        """The step that is taken, as of backward Euler, whose factor is there."""
        self._h = h

    def scales(self, more: Any = 0.0, tol: float = 1.0) -> np.ndarray:
        """What errors of each field (F,) are relative to; more: sizes that are known beside those so far."""
        semi, largest = self.run.semi, np.maximum(self.largest, more)
        if len(largest) == 1 or self._h == 0.0 or self._y is None:
            return scales(semi, largest)
        h, known, added = self._added
        if h != self._h or (largest > 2.0 * known).any():
            added = added_up(semi, self._y, self._h)
            self._added = self._h, largest, added
        return scales(semi, largest, added, tol)


def added_up(semi: Semidiscrete, y: np.ndarray, h: float) -> np.ndarray:
    """What the terms in the rows of E + h A make of each field (F,) where signs are at random, as those of round-off.

    It comes from the largest fields to all that hang on them, in their units: a pressure takes that of velocities.
    """
    system, chance = semi.system, np.random.default_rng(0)
    signs = lambda: chance.choice([-1.0, 1.0], len(y))  # noqa: E731
    mixed = signs() * np.abs(y)
    rows = system.mass(mixed) + h * system.stiff(mixed)
    found = sizes(semi, system.resolvent(h).solve(signs() * np.abs(rows))[: system.n])
    return np.where(np.isfinite(found), found, 0.0)
