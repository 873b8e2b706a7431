"""How many particles the next cloud may have, how many it should, and whether one more is worth it."""

from __future__ import annotations

from collections.abc import Sequence

# A cloud grows at most by the first factor, small ones up to so many by dimension.
_MOST, _SMALL = 5.0, {1: 400, 2: 1500, 3: 3000}
# Along lines, where a particle more gains least and the last round is all of the cost, by no more than this.
_LINED = 2.5
# One of more than so many grows at least by this factor: rounds that gain little are dear. (By as much as the last two
# rounds say it takes is worse: where smoothness ends it takes rounds to find out, and three times the particles.)
_LARGE, _LEAST = 4000, 1.75
# After so many rounds without a smaller error by this factor the search ends.
_STALLED, _BETTER = 3, 0.7

# Particles, order, error, seconds, smallest spacing of a round.
Row = tuple[int, int, float, float, float]


def most(count: int, dim: int, allowed: int, lined: bool) -> float:
    """How many particles may follow ``count``; lined: whether most of them are along lines."""
    return min(max((_LINED if lined else _MOST) * count, _SMALL[dim]), allowed)


def least(count: int, allowed: int) -> float:
    """How many particles should follow a large cloud of ``count``."""
    return min(_LEAST * count, allowed) if count > _LARGE else 0.0


def stalled(rows: Sequence[Row], dim: int) -> bool:
    """Whether the last rounds, which grew, gained nothing."""
    errors = [row[2] for row in rows]
    if len(errors) <= _STALLED or len({row[1] for row in rows[-_STALLED - 1 :]}) > 1:
        return False
    grown = rows[-1][0] > max(rows[-_STALLED][0], _SMALL[dim])
    return grown and min(errors[-_STALLED:]) > _BETTER * min(errors[:-_STALLED])
