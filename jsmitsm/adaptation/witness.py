"""What an estimate does not see where smoothness ends; whether it was right is told by the round after."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jsmitsm.adaptation.growth import Row
from jsmitsm.adaptation.marking import SLOW
from jsmitsm.adaptation.measure import Measured
from jsmitsm.cloud.cloud import INTERIOR
from jsmitsm.runtime.errors import SolveError
from jsmitsm.solution.solution import Solution

# Where smoothness ends solutions of two orders miss the same, and are nearer to each other than to what is true: the
# distance is taken for this part of the error.
_ALIKE = 0.5
# What is missed of a source between the particles is that as well, where contributions fall with less than this power:
# there no mean over a few points tells what its infinite values make.
_INFINITE = 1.0
# Two rounds know better where the estimate has fallen to this part: what the last one is off by then hardly counts.
_FALLEN = 1.0 / 3.0
# The gap of a point counts as one of its own where all between so many spacings from it are so many times smaller.
_RING, _ALONE = (2.5, 6.0), 4.0


class Earlier(NamedTuple):
    """The interior particles (M, D) of the round before, and the values (M, F) it found there."""

    points: np.ndarray
    values: np.ndarray


def remembered(sol: Solution) -> Earlier:
    """What the next round is compared with; on two sides of a slit it would be hard to tell which is meant."""
    inner = np.asarray(sol.cloud.groups[INTERIOR])
    return Earlier(np.asarray(sol.cloud.points)[inner], np.asarray(sol.u).reshape(len(sol.cloud), -1)[inner])


def doubted(found: Measured, rate: np.ndarray, unbounded: bool, times: Callable[[], float]) -> float:
    """The error where smoothness ends, of which the estimate sees a part.

    rate (N,): at which contributions fall. unbounded: whether the source may be infinite. times: how many times the
    estimate it is there.
    """
    assert found.local is not None
    infinite = unbounded & (rate < _INFINITE)
    seen = np.where(infinite, np.maximum(found.local, found.missed), found.local)[rate < SLOW].max(initial=0.0)
    return float(seen) * times() if seen else 0.0


def stands_out(points: np.ndarray, spacing: np.ndarray, apart: np.ndarray) -> float:
    """The largest of the gaps (N,) between neighbours if nothing around it is like it, else 0.

    Smoothness ends at a point then, a corner most often, before two rounds tell; a layer is like itself all along.
    """
    worst = int(apart.argmax())
    away = np.linalg.norm(points - points[worst], axis=1) / spacing[worst]
    around = (away > _RING[0]) & (away < _RING[1])
    return float(apart[worst]) if apart[worst] > _ALONE * apart[around].max(initial=0.0) else 0.0


def unseen(sol: Solution, rows: list[Row], earlier: Earlier | None) -> float:
    """How many times the estimate an error is where smoothness ends, from 1 to what is expected of strangers.

    The round before was off by what the two solutions differ by, about, and thought it was off by its estimate.
    """
    if earlier is None or not len(earlier.points) or rows[-1][1] != rows[-2][1]:
        return 1.0 / _ALIKE
    thought, left = rows[-2][2], rows[-1][2]
    if not (np.isfinite(thought) and left <= _FALLEN * thought):
        return 1.0 / _ALIKE
    try:
        now = np.asarray(sol(earlier.points, outside="extrapolate")).reshape(earlier.values.shape)
    except (ValueError, SolveError):
        return 1.0 / _ALIKE  # a source that is infinite on the boundary
    off = float(np.abs(now - earlier.values).max() / np.abs(np.asarray(sol.u)).max())
    return float(np.clip(off / (thought - left), 1.0, 1.0 / _ALIKE))
