"""Which spacing comes next: every particle's contribution to the error made the same, and the sum what is wanted."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from jsmitsm.adaptation.spacing_field import GROWTH

# The error aimed at, in parts of the tolerance: what is predicted is not always met.
SAFETY = 0.4
# A spacing changes by at most these factors in a round: refined where the solution is smooth, where it is known not to
# be, and where that was found at the same point before; and coarsened: freely where the error says nothing yet, later
# gently, and not at all within some factor of what is wanted, or rounds would undo each other.
FINER, SINGULAR, LOCATED, COARSER, GENTLY, FAR = 0.3, 0.05, 1e-3, 3.0, 1.4, 10.0
# Contributions below this part of what they may be are no matter.
_NOTHING = 1e-4
# Contributions of a smooth solution fall with at least this part of the expected power, whatever two rounds saw; where
# they fall with less than SLOW smoothness ends.
_ROUGH, SLOW, _SLOWEST = 0.6, 2.0, 0.35
# Rates are read where the spacing changed by this factor, and smoothed over so many particles.
_CHANGED, _AROUND = 1.3, 6
# A contribution of so many times the median stands out, and is expected to fall with this power.
_STARK, _SUSPECTED = 300.0, 1.0
# Where the spacing changed by this factor, only particles within so many spacings of an old one are compared with it.
_FRESH, _BESIDE = 0.15, 3.0
# Contributions are taken from the largest of so many nearest particles. A singular point is one of so many that are
# nearest to a particle, the worst of them.
_NEAR, _WORST = 8, 12
# Rows reach so many spacings far, about, and the error that a singular point makes.
_REACH, _AFFECTED = 4.0, 25.0
# A point may keep all of the error, which is estimated there at this part of what it is: its decades of spacing are as
# dear as all other particles together.
_POINT = 0.5
# Of a line of them there are at least so many within so many spacings.
_ALONG, _FEW = 12.0, 5
# From one of many there are others as bad (in parts of it) at distances between these, in its spacings; around a lone
# one there are none.
_AS_BAD, _FROM, _TO = 0.1, 6.0, 15.0
# Fewer than so many are no line, and so many particles of one are looked at together.
_MANY, _LINED = 8, 48
# Within so many spacings a singular point is the one of the round before.
_SAME = 1.0
# The error is at least the largest contribution, and random signs of many add up to this part of their root sum
# square, where nothing better is known.
_SPREAD = 0.2
# While the error is larger than this the solution is not resolved, and an estimate of it means little.
ROUGH = 0.3

Gathered = Callable[[np.ndarray], float]


class Marks(NamedTuple):
    """What a round leaves for the next: where (N, D), the spacing, contributions, the rates at which they fall, and
    whether smoothness ends there, and that at a point which is known to be this one, or along a line, all (N,)."""

    points: np.ndarray
    spacing: np.ndarray
    contribution: np.ndarray
    rate: np.ndarray
    singular: np.ndarray
    located: np.ndarray
    along: np.ndarray


def marks(
    points: np.ndarray, spacing: np.ndarray, contribution: np.ndarray, power: float, before: Marks | None,
    edge: np.ndarray | None = None, expected: float | None = None, poles: np.ndarray | None = None,
) -> Marks:  # fmt: skip
    """Contributions smoothed, and the rates at which they fall with the spacing.

    power: that of a smooth solution. before: those of the round before, None where it had another order or was not
    trustworthy; then all fall at the rate ``expected``, that of a smooth solution if None. edge (N,): where smoothness
    ends, rather than beside. poles (P, D): where it is known to end, between the particles.
    """
    tree = cKDTree(points)
    away, near = tree.query(points, k=range(1, min(_WORST, len(points)) + 1))
    largest = contribution[near[:, :_NEAR]].max(axis=1)
    rate = np.full(len(points), power if expected is None else expected)
    if before is not None:
        apart, old = cKDTree(before.points).query(points)
        change = np.log(spacing / before.spacing[old])
        with np.errstate(all="ignore"):
            seen = np.log(largest / before.contribution[old]) / change
        known = (np.abs(change) > np.log(_CHANGED)) & np.isfinite(seen)
        rate = np.where(known, seen, before.rate[old])
        # Around a point that was refined by far nothing is like the point itself.
        fresh = (change < np.log(_FRESH)) & (apart > _BESIDE * spacing)
        around = np.where(fresh, np.nan, rate)[near[:, :_AROUND]]
        around[:, 0] = rate
        rate = np.where(fresh, power, np.nanmedian(around, axis=1))
    worst = (contribution > 0) & (contribution >= contribution[near].max(axis=1)) & (rate < min(SLOW, _ROUGH * power))
    at = _middle(contribution[near], away / spacing[:, None], near, edge)[worst]
    at, along = _where_known(points, spacing, at, before), np.zeros(len(points), bool)
    np.minimum.at(rate, at, rate[worst])
    if before is not None:
        at, along = _on_lines(points, spacing, largest, rate < min(SLOW, _ROUGH * power), np.unique(at), before)
    if before is None and edge is not None:
        # No rates yet: what stands out at an edge is taken for its end of smoothness, and one round more tells.
        stark = contribution >= _STARK * max(float(np.median(contribution)), 1e-300)
        at = _middle(contribution[near], away / spacing[:, None], near, edge)[stark]
        at = at[edge[at]]
        rate[at] = _SUSPECTED
    sure = np.zeros(0, int)
    if poles is not None and len(poles):
        sure = _lone(points, spacing, np.unique(tree.query(poles)[1]))
    rate[sure] = np.minimum(rate[sure], _SUSPECTED)
    singular, located = _singular(points, spacing, np.unique(at), before, sure)
    _evened(points, along, largest, rate)
    return Marks(points, spacing, largest, np.clip(rate, _SLOWEST, power), singular | along, located, along)


def _middle(contribution: np.ndarray, away: np.ndarray, near: np.ndarray, edge: np.ndarray | None) -> np.ndarray:
    """For every particle the one of its neighbours (N, k) that contributions (N, k) are the largest around.

    away (N, k): in spacings. Particles without an equation contribute nothing, and may be it. edge (N,): those that are
    it before others.
    """
    weight = np.exp(-(away**2)) * (contribution > 0)
    around = ((weight * contribution).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-300))[near]
    if edge is not None:
        around = np.where(edge[near] | ~edge[near].any(axis=1, keepdims=True), around, -1.0)
    return np.take_along_axis(near, around.argmax(axis=1)[:, None], axis=1)[:, 0]


def _where_known(points: np.ndarray, spacing: np.ndarray, at: np.ndarray, before: Marks | None) -> np.ndarray:
    """The particles ``at``, beside a point found twice that point: what is rough around it is its fault."""
    if before is None or not before.located.any() or not len(at):
        return at
    known = before.points[before.located]
    away, which = cKDTree(known).query(points[at])
    off, there = cKDTree(points).query(known)
    beside = (away <= _AFFECTED * spacing[at]) & (off <= _SAME * spacing[there])[which]
    return np.where(beside, there[which], at)


def _on_lines(
    points: np.ndarray, spacing: np.ndarray, contribution: np.ndarray, slow: np.ndarray, at: np.ndarray, before: Marks
) -> tuple[np.ndarray, np.ndarray]:
    """Those of the particles ``at`` that are points where smoothness ends, and the particles (N,) along lines of such.

    slow (N,): those whose contributions fall slowly. What was found at the same point twice is one.
    """
    along = np.zeros(len(points), bool)
    if not len(at):
        return at, along
    some = slow & (contribution >= _AS_BAD * contribution[at].max())
    others = cKDTree(points[some])
    count = lambda far: others.query_ball_point(points[at], far * spacing[at], return_length=True)  # noqa: E731
    lines = count(_TO) - count(_FROM) >= _FEW
    lines |= before.along[cKDTree(before.points).query(points[at])[1]]
    if before.located.any():
        lines &= cKDTree(before.points[before.located]).query(points[at])[0] > _SAME * spacing[at]
    if lines.sum() < _MANY:
        return at, along
    alone = np.zeros(len(points), bool)
    alone[at[~lines]] = True
    along = some & ~alone & ~_reached(points, spacing, alone, _AFFECTED)
    return at[~lines], along


def _evened(points: np.ndarray, along: np.ndarray, contribution: np.ndarray, rate: np.ndarray) -> None:
    """Contributions and rates along lines made alike: they differ by chance, from one particle to the next."""
    at = points[along]
    if len(at):
        near = cKDTree(at).query(at, k=range(1, min(_LINED, len(at)) + 1))[1]
        contribution[along] = contribution[along][near].max(axis=1)
        rate[along] = np.median(rate[along][near], axis=1)


def _singular(
    points: np.ndarray, spacing: np.ndarray, at: np.ndarray, before: Marks | None, sure: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where smoothness ends (N,), of the particles ``at`` or ``sure``ly, and where that is surely so, or was found at
    the same point twice (N,)."""
    singular, located = np.zeros((2, len(points)), bool)
    singular[at] = True
    known = None if before is None else before.points[before.singular & ~before.along]
    if known is not None and len(known) and len(at):
        located[at] = cKDTree(known).query(points[at])[0] <= _SAME * spacing[at]
    singular[sure] = located[sure] = True
    singular &= located | ~_reached(points, spacing, located, _AFFECTED)
    return singular, located


def _reached(points: np.ndarray, spacing: np.ndarray, some: np.ndarray, reach: float) -> np.ndarray:
    """The other particles (N,) that are within so many spacings of some of them (N,)."""
    if not some.any():
        return np.zeros(len(points), bool)
    away, near = cKDTree(points[some]).query(points)
    return ~some & (away < reach * spacing[some][near])


def _lone(points: np.ndarray, spacing: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Those of the particles ``at`` that are no part of a line of them."""
    if not len(at):
        return at
    tree = cKDTree(points[at])
    return at[tree.query_ball_point(tree.data, _ALONG * spacing[at], return_length=True) < _FEW]


def next_spacing(
    found: Marks, power: float, error: float, wanted: float, most: float, gathered: Gathered | None = None,
    missed: np.ndarray | float = 0.0, coarser: float | None = None,
) -> tuple[np.ndarray, float]:
    """Spacings (N,) at the particles for an error ``wanted`` where it is ``error`` now, and how many that makes.

    most: particles that may be, about; where more were needed, the contributions are equal and larger. gathered: the
    error that contributions (N,) make together; a guess where None. missed (N,): the part of the error that falls with
    the spacing at a point where smoothness is known to end, whatever else contributes. coarser: by how much a spacing
    may grow at most; the error and the contributions decide where None.
    """
    eta = np.maximum(found.contribution, 1e-300)
    dim = found.points.shape[1]
    volume = found.spacing**dim
    together = gathered or (lambda some: _SPREAD * float(np.sqrt(np.sum(some**2))))
    at_one, now = together(np.ones(len(eta))), together(eta)
    aim = SAFETY * wanted / max(error, 1e-300) * max(float(eta.max()), now)
    rate = np.where(found.singular, found.rate, np.maximum(found.rate, _ROUGH * power))
    lowest = np.where(found.located, LOCATED, np.where(found.singular, SINGULAR, FINER))
    alone = found.located.copy()
    alone[_lone(found.points, found.spacing, np.flatnonzero(found.singular))] = True
    shaded = _reached(found.points, found.spacing, alone, _REACH)
    own = np.where(found.located, SAFETY * wanted / np.maximum(missed, 1e-300), np.inf)
    goal, count = aim, float(len(eta))
    nothing = COARSER if coarser is None else coarser
    if coarser is None:
        coarser = COARSER if error > ROUGH else GENTLY if error > FAR * wanted else 1.0
    for _ in range(200):
        highest = np.where(eta < _NOTHING * goal, nothing, coarser)
        less = np.minimum(np.where(alone, max(goal, _POINT * aim), goal) / eta, own)
        factor = np.clip(less ** (1.0 / np.where(less < 1, rate, power)), lowest, highest)
        if factor[alone].min(initial=1.0) < FINER:
            factor = np.where(shaded, np.maximum(factor, 1.0), factor)  # the gradation refines these
        count = float(_children(factor, dim).sum())
        more = np.sqrt(np.sum(volume * np.minimum(factor, 1.0) ** -dim) / np.sum(volume))
        if count > most:
            goal *= 1.2
        elif goal * max(1.0, at_one * more) > 1.05 * aim and count < 0.8 * most:
            goal *= 0.9
        else:
            break
    return factor * found.spacing, count


def _children(factor: np.ndarray, dim: int) -> np.ndarray:
    """How many particles come of each: as many as fit, or as a point-like refinement needs in its cone."""
    cone = {1: 2.0 / GROWTH, 2: 90.0, 3: 800.0}[dim]
    return np.minimum(factor ** -float(dim), 1.0 + np.where(factor < FINER, FINER**-dim + cone * np.log(FINER / factor),
                                                            np.inf))  # fmt: skip
