"""How many particles the next cloud may have, how many it should, and whether one more is worth it."""

from __future__ import annotations

import math
from collections.abc import Sequence

# A cloud grows at most by the first factor, small ones up to so many by dimension.
_MOST, _SMALL = 5.0, {1: 400, 2: 1500, 3: 3000}
# One of more than so many particles grows at least by this factor: rounds that gain little are dear. This part of the
# tolerance is aimed at.
_LARGE, _LEAST, _AIM = 5000, 1.5, 0.7
# After so many rounds without a smaller error by this factor the search ends.
_STALLED, _BETTER = 3, 0.7

# Particles, order, error, seconds, smallest spacing of a round.
Row = tuple[int, int, float, float, float]


def most(count: int, dim: int, allowed: int) -> float:
    """How many particles may follow ``count``."""
    return min(max(_MOST * count, _SMALL[dim]), allowed)


def least(rows: Sequence[Row], error: float, tol: float, allowed: int) -> float:
    """How many particles should follow: as many as the last two rounds say the tolerance takes, of ``error`` now.

    Where smoothness ends along a line, say, all rounds fall alike, and slower than contributions tell.
    """
    count, order, now = rows[-1][:3]
    if count <= _LARGE:
        return 0.0
    factor = _LEAST
    if len(rows) > 1 and rows[-2][1] == order and rows[-2][0] < count and rows[-2][2] > now > 0.0:
        rate = math.log(rows[-2][2] / now) / math.log(count / rows[-2][0])
        wanted = math.log(max(error, now) / (_AIM * tol)) / rate
        factor = max(math.exp(min(wanted, math.log(_MOST))), _LEAST)
    return min(factor * count, allowed)


def stalled(rows: Sequence[Row], dim: int) -> bool:
    """Whether the last rounds, which grew, gained nothing."""
    errors = [row[2] for row in rows]
    if len(errors) <= _STALLED or len({row[1] for row in rows[-_STALLED - 1 :]}) > 1:
        return False
    grown = rows[-1][0] > max(rows[-_STALLED][0], _SMALL[dim])
    return grown and min(errors[-_STALLED:]) > _BETTER * min(errors[:-_STALLED])
