"""Which spacing comes next: every particle's contribution to the error made the same, and the sum what is wanted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jsmitsm.adaptation.spacing_field import GROWTH

# The error aimed at, in parts of the tolerance: what is predicted is not always met.
SAFETY = 0.4
# A spacing changes by at most these factors in a round: refined where the solution is smooth, where it is known not to
# be, and coarsened: freely where the error says nothing yet, later gently, and not at all within some factor of what is
# wanted, or rounds would undo each other.
FINER, SINGULAR, COARSER, GENTLY, FAR = 0.3, 0.05, 3.0, 1.4, 3.0
# Where refining helped with less than this part of the expected power, the solution is not smooth.
_ROUGH = 0.6
_SLOWEST = 0.35
# Rates are read where the spacing changed by this factor, and smoothed over so many particles.
_CHANGED, _AROUND = 1.3, 6
# Contributions are taken from the largest of so many nearest particles; a singular point is the worst of so many. It
# may be one of its so many neighbours without an equation of its own, as at the corner of a domain.
_NEAR, _WORST, _HELD = 8, 12, 4
# The error is at least the largest contribution, and random signs of many add up to this part of their root sum square.
_SPREAD = 0.2
# While the error is larger than this the solution is not resolved, and an estimate of it means little.
ROUGH = 0.3


class Marks(NamedTuple):
    """What a round leaves for the next: where (N, D), the spacing, contributions, the rates at which they fall, and
    whether it is a point that smoothness ends at, all (N,)."""

    points: np.ndarray
    spacing: np.ndarray
    contribution: np.ndarray
    rate: np.ndarray
    singular: np.ndarray


def marks(
    points: np.ndarray, spacing: np.ndarray, contribution: np.ndarray, power: float, before: Marks | None,
    expected: float | None = None,
) -> Marks:  # fmt: skip
    """Contributions smoothed, and the rates at which they fall with the spacing.

    power: that of a smooth solution. before: those of the round before, None where it had another order or was
    not trustworthy; then all fall at the rate ``expected``, that of a smooth solution if None.
    """
    from scipy.spatial import cKDTree

    near = cKDTree(points).query(points, k=range(1, min(_WORST, len(points)) + 1))[1]
    largest = contribution[near[:, :_NEAR]].max(axis=1)
    rate = np.full(len(points), power if expected is None else expected)
    if before is not None:
        old = cKDTree(before.points).query(points)[1]
        rate = before.rate[old] + power - before.rate.max(initial=power)
        change = np.log(spacing / before.spacing[old])
        with np.errstate(all="ignore"):
            seen = np.log(largest / before.contribution[old]) / change
        known = (np.abs(change) > np.log(_CHANGED)) & np.isfinite(seen)
        rate = np.where(known, seen, rate)
        rate = np.median(rate[near[:, :_AROUND]], axis=1)
    worst = (contribution > 0) & (contribution >= contribution[near].max(axis=1)) & (rate < _ROUGH * power)
    singular = worst.copy()
    around = near[worst, :_HELD]
    singular[around[contribution[around] == 0]] = True
    return Marks(points, spacing, largest, np.clip(rate, _SLOWEST, power), singular)


def next_spacing(found: Marks, power: float, error: float, wanted: float, most: float) -> tuple[np.ndarray, float]:
    """Spacings (N,) at the particles for an error ``wanted`` where it is ``error`` now, and how many that makes.

    most: particles that may be, about; where more were needed, the contributions are equal and larger.
    """
    eta = np.maximum(found.contribution, 1e-300)
    aim = SAFETY * wanted / max(error, 1e-300) * _total(eta.max(), np.sqrt(len(eta)) * np.sqrt(np.mean(eta**2)))
    dim = found.points.shape[1]
    lowest = np.where(found.singular, SINGULAR, FINER)
    rate = np.where(found.singular, found.rate, np.maximum(found.rate, _ROUGH * power))
    goal, count = aim, float(len(eta))
    coarser = COARSER if error > ROUGH else GENTLY if error > FAR * wanted else 1.0
    for _ in range(200):
        factor = np.clip((goal / eta) ** (1.0 / rate), lowest, coarser)
        count = float(_children(factor, dim).sum())
        if count > most:
            goal *= 1.2
        elif _total(goal, goal * np.sqrt(count)) > 1.05 * aim and count < 0.8 * most:
            goal *= 0.9
        else:
            break
    return factor * found.spacing, count


def _total(largest: float, root: float) -> float:
    """The error that contributions make, up to a factor: the largest of them, and the root of the sum of squares."""
    return float(max(largest, _SPREAD * root))


def _children(factor: np.ndarray, dim: int) -> np.ndarray:
    """How many particles come of each: as many as fit, or as a point-like refinement needs in its cone."""
    cone = {1: 2.0 / GROWTH, 2: 45.0, 3: 800.0}[dim]
    return np.minimum(factor ** -float(dim), 1.0 + np.where(factor < FINER, FINER**-dim + cone * np.log(FINER / factor),
                                                            np.inf))  # fmt: skip
