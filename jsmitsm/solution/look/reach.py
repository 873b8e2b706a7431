"""Values that the local polynomials of their neighbours do not reach, and what this makes of a solution.

Beside a point where the solution is not smooth, as where a condition or its data change within a side, in a corner, at
a singular point of the equation, or in a layer within the spacing, polynomials of all orders end alike: the distance of
two orders' solutions tells nothing there. What each leaves of its neighbours' values does.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.discretization.parts.whole import whole
from jsmitsm.particle.moments import Row
from jsmitsm.particle.polynomials import monomials_on_host
from jsmitsm.solution.look.between import beyond_kinks, seam, solved_alone
from jsmitsm.solution.look.edges import singular
from jsmitsm.solution.look.halfway import nearest_of, pairs
from jsmitsm.solution.look.sizes import predicted, scales

# A polynomial does not reach its nearest neighbours where it misses one by this part of the largest change to any of
# them: 0.1 to 0.5 beside square roots and jumps of data. By order: up to 3, and above.
LOST = (0.1, 0.06)
# Above order 3 less may be lost too, beside r^(3/2) from this part on; but a curve that the particles hardly resolve
# has as much, whose error two orders do tell. So this counts up to so many times what they say.
FAINT, TRUSTED = 0.01, 4.0
# By far are those missed whose miss is this part of the change.
FAR = 0.2
# The error is so many times what misses, drawn at random, make of the solution. Measured on singular points and jumps
# wherever they lie in the spacing, orders 2 to 6, lines and squares: by 1.0 it would be 0.2 to 5 times the error.
TIMES = 1.4
# Beside a singular end of a boundary that is not all held less counts too, and the error, which reaches all of the
# domain, is so many times as large. Measured on changes of conditions within a side and on corners of elastic bodies:
# by 1.0 it would be 0.1 to 1.0 times the error, beside r^(3/2) 2 times.
ENDED, OPEN = 0.003, 2.0
# Values that differ there by this part of the range from the linear function through their neighbours are looked at.
ROUGH_END = 0.01
# Those who miss by this part of the largest miss are named.
NAMED = 0.2


def beyond_orders(run: Any, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """What no order sees makes of the solution of a run, (N, F): beyond kinks, jumps and seams, and out of reach.

    known: the error that two orders tell of the own particles.
    """
    kinks = beyond_kinks(run, values)
    found = np.maximum(unmet(run, values)[0], _faint(run, values, known))
    found = np.maximum(found, _at_ends(run, values))
    if run.nums is not None and run.factor is not None:
        found = np.maximum(found, seam(run, values))
    return found if kinks is None else np.maximum(found, kinks)


def _faint(run: Any, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """What is made of values that are hardly out of reach, no more of it than two orders make likely."""
    if run.disc.rec.order <= 3 or run.disc.scheme.method not in ("S", "III"):
        return np.zeros(run.disc.held.shape)
    made, told = _unmet(run, values, FAINT)[0], whole(run.disc)
    size = told.norm(told.own(made))
    return made if size == 0 else made * min(1.0, TRUSTED * told.norm(known) / size)


def _at_ends(run: Any, values: np.ndarray) -> np.ndarray:
    """What is made of values out of reach beside singular corners and changes of conditions, where orders are blind.

    A process that has but a part of the cloud does not see all of a boundary's ends.
    """
    alone = run.formulation != "lsq" and run.rows is not None and run.factor is not None and run.disc.part is None
    if not alone or run.disc.scheme.method not in ("S", "III"):
        return np.zeros(run.disc.held.shape)
    misses = _misses(run, values)
    beside = singular(run.disc, misses.most)
    return made_of(run, OPEN * TIMES * misses.of(ENDED) * beside)[0] if beside.any() else np.zeros(beside.shape)


def rough_ends(run: Any, values: np.ndarray) -> bool:
    """Whether the boundary may have a singular end: a look at the values alone, without polynomials."""
    if run.disc.part is not None:
        return False
    points = np.asarray(run.disc.cloud.points, float)
    away = np.stack([np.abs(v - predicted(points, v)) for v in values.T], axis=1) / scales(values)
    return bool((away * singular(run.disc, away) > ROUGH_END).any())


def unmet(run: Any, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What values out of reach make of the solution of a run, (N, F), and the particles whose polynomials these are.

    Nothing in the least-squares form, which has a misfit of its own, nor of method SSPH and of I and II, whose
    rows are other predictions than their polynomials: they are compared with method S.
    """
    if run.disc.scheme.method not in ("S", "III"):
        return np.zeros(run.disc.held.shape), np.zeros(0, int)
    return _unmet(run, values, LOST[run.disc.rec.order > 3])


def far_out(run: Any, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same of values that are missed by far, each by as much as the nearest are: of any method.

    Where held values have no part in the solution its weights are nothing, and so is what they miss.
    """
    return _unmet(run, values, FAR, plain=True)


def _unmet(run: Any, values: np.ndarray, lost: float, plain: bool = False) -> tuple[np.ndarray, np.ndarray]:
    if run.formulation == "lsq" or run.rows is None or run.factor is None:
        return np.zeros(run.disc.held.shape), np.zeros(0, int)
    defects = _misses(run, values).of(lost, plain)
    return made_of(run, defects if plain else TIMES * defects)


def _misses(run: Any, values: np.ndarray) -> Misses:
    """What the polynomials of the values leave of their neighbours, kept with the run for the next who asks."""
    fitted, known = run.fitted(run.nums, values), run.misses
    if known is None or known.fitted is not fitted:
        run.misses = known = Misses(run.disc, run.rows, values, fitted)
    return known


def made_of(run: Any, defects: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What defects (N, F) make of the solution of a run, (N, F), and the particles that have the largest."""
    disc, told = run.disc, whole(run.disc)
    free = ~disc.held if disc.part is None else ~disc.held & disc.part.own[:, None]
    most = told.most((defects * free).max(axis=0, initial=0.0))
    if not np.any(most):
        return np.zeros(disc.held.shape), np.zeros(0, int)
    return solved_alone(run, defects[free]), np.flatnonzero((free & (defects > NAMED * most)).any(axis=1))


class Misses:
    """What the local polynomials (N, F, K) leave of their neighbours' values (N, F).

    Looked at once, for all who ask; predictions are looked at when they are asked for.
    """

    def __init__(
        self, disc: Discretization, rows: tuple[list[Class], list[Row]], values: np.ndarray, fitted: np.ndarray
    ):
        self.disc, self.values, self.fitted = disc, values, fitted
        self.points = np.asarray(disc.points, float)
        self.parts = [_OfClass(self, cls, row) for cls, row in zip(*rows)]

    @property
    def most(self) -> np.ndarray:
        """The largest of what is left of the nearest neighbours (N, F)."""
        out = np.zeros(self.disc.held.shape)
        for part in self.parts:
            out[part.ids] = part.most
        return out

    def at(self, other: np.ndarray) -> np.ndarray:
        """The values (n, F) of particles, images among them."""
        return self.values[np.asarray(self.disc.images.owners(other))]

    def left(self, ids: np.ndarray, other: np.ndarray) -> np.ndarray:
        """What polynomials at particles (n,) leave of the values of others (n,), (n, F)."""
        terms = monomials_on_host((self.points[other] - self.points[ids]).T, self.disc.rec.reach)
        away = np.abs(np.einsum("nfk,kn->nf", self.fitted[ids], terms[: self.fitted.shape[2]]) - self.at(other))
        return np.where((other != ids)[:, None], away, 0.0)

    def of(self, lost: float, plain: bool = False) -> np.ndarray:
        """What predictions (N, F) of polynomials that do not reach their nearest neighbours miss, zero elsewhere.

        A prediction is a weighted sum of the neighbours' values, and what the polynomial leaves of them no more than
        noise to it. plain: the mean that is left of the nearest in its place.
        """
        out = np.zeros(self.disc.held.shape)
        for part in self.parts:
            out[part.ids] = part.of(lost, plain)
        return out


class _OfClass:
    """The same of the particles of a class."""

    def __init__(self, whole: Misses, cls: Class, row: Row):
        self.whole, self.cls, self.row, self.ids = whole, cls, row, cls.ids
        nearest = nearest_of(whole.disc, cls, 2 * whole.disc.rec.dim)
        nearest = np.where(nearest >= 0, nearest, cls.ids[:, None])
        off = np.stack([whole.left(cls.ids, other) for other in nearest.T])
        self.most, self.mean = off.max(axis=0), off.mean(axis=0)
        self.change = np.stack([np.abs(whole.at(other) - whole.values[cls.ids]) for other in nearest.T]).max(axis=0)
        self.predicted = np.full(self.mean.shape, np.nan)

    def of(self, lost: float, plain: bool) -> np.ndarray:
        bad = self.most > lost * self.change
        if plain:
            return np.where(bad, self.mean, 0.0)
        new = np.flatnonzero(bad.any(axis=1) & np.isnan(self.predicted).any(axis=1))
        if len(new):
            self.predicted[new] = self._predictions(new)
        return np.where(bad, self.predicted, 0.0)

    def _predictions(self, some: np.ndarray) -> np.ndarray:
        """What the predictions of some of them miss, (m, F)."""
        ids, near = self.ids[some], np.asarray(self.cls.neighbours)[some]
        weights, square = np.asarray(self.row.weights)[some], np.zeros((len(some), self.whole.values.shape[1]))
        for row, column in pairs(near):
            left = self.whole.left(ids[row], near[row, column])
            np.add.at(square, row, np.einsum("nfg,ng->nf", np.abs(weights[row, :, column]), left) ** 2)
        return np.sqrt(square)
