"""Damped steps of Newton's method, mixed where they converge slowly: what decides about them, on any processes."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from jsmitsm.solution.nonlinear.steps import Iterate

# Steps of one search. A step shorter than DONE of the solution is the last; shorter than GOOD it counts as converged.
MOST, DONE, GOOD = 50, 1e-10, 1e-8
# A damped step that must be cut below SHORTEST does not lead on, nor does a search of which so many steps were refused.
SHORTEST, REFUSED = 1.0 / 16.0, 12
# Steps of less than CLOSE of the solution that fall to no less than SLOW of the one before converge linearly, and are
# mixed with up to DEPTH that came before.
SLOW, CLOSE, DEPTH = 0.05, 2e-2, 4


class Search(Protocol):
    """Who takes the steps. Sizes and distances are those of the whole solution, wherever its parts are."""

    rate: float  # of the last two full steps
    changes: list[float]

    def tried(self, here: Iterate) -> Iterate | None:
        """The step from ``here``; None where there is none, or it leads to no numbers."""

    def size(self, here: Iterate) -> float: ...

    def distance(self, new: Iterate, old: Iterate) -> float: ...

    def mixed(self, history: list[tuple[Iterate, Iterate]]) -> Iterate:
        """The combination of iterates and what they led to that has the shortest step."""

    def rounded(self, length: float, after: float, size: float) -> bool:
        """Whether a step no longer falls because of round-off."""

    def frozen(self) -> Any:
        """Who keeps particles from moving that do not settle, see ``jsmitsm.solution.nonlinear.steps.Frozen``."""

    def went(self, change: float, size: float) -> None:
        """A step was taken, and the next one would be ``change`` long."""


class Found(NamedTuple):
    """Where a search ended: what its last step led to, how long that was, whether it converged, and who was frozen."""

    at: Iterate
    change: float
    good: bool
    frozen: np.ndarray


def damped(search: Search, here: Iterate, target: Iterate) -> Found:
    """Damped Newton's method; the length of the next step must not grow (natural monotonicity)."""
    # Lengths are absolute: measured against values that grow, a step that leads away looks shorter.
    length, size, part, refused = search.distance(target, here), search.size(target), 1.0, 0
    search.changes.append(length / size)
    history, frozen = [(here, target)], search.frozen()

    def found(good: bool = False) -> Found:
        change = length / size
        return Found(target, change, good or change <= GOOD, frozen.particles)

    for _ in range(MOST):
        if length <= DONE * size:
            break
        while True:
            new = frozen.kept(here.toward(target, part) if len(history) < 2 else search.mixed(history))
            after = search.tried(new)
            next_length = np.inf if after is None else search.distance(after, new)
            if after is not None and next_length <= max((1.0 - part / 4.0) * length, DONE * search.size(new)):
                break
            if part == 1.0 and search.rounded(length, next_length, size):
                return found(True)
            if len(history) > 1:
                history = history[-1:]
            elif part == 1.0 and length <= GOOD * size:
                return found()
            elif after is not None and length < CLOSE * size and frozen.more(here, target):
                continue
            elif part <= SHORTEST or refused == REFUSED:
                return found()
            else:
                part, refused = part / 2.0, refused + 1
        # What a full step leaves of a difference; a mixed one is shorter than that tells.
        rate = search.distance(after, target) / max(search.distance(new, here), np.finfo(float).tiny)
        search.rate = rate if part == 1.0 else search.rate
        size = search.size(after)
        slow = part == 1.0 and rate > SLOW and next_length < CLOSE * size
        history = [*(history[-DEPTH:] if slow else []), (new, after)]
        here, target, length, part = new, after, next_length, min(1.0, 2.0 * part)
        search.went(length, size)
    return found()
