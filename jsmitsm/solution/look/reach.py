"""Values that the local polynomials of their neighbours do not reach, and what this makes of a solution.

Beside a point where the solution is not smooth, as where a condition or its data change within a side, in a corner, at
a singular point of the equation, or in a layer within the spacing, polynomials of all orders end alike: the distance of
two orders' solutions tells nothing there. What each leaves of its neighbours' values does.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.discretization.parts.whole import whole
from jsmitsm.particle.moments import Row
from jsmitsm.particle.polynomials import monomials_on_host
from jsmitsm.solution.look.between import beyond_kinks, nearest_of, solved_alone

Fits = Callable[[], np.ndarray]
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
# Those who miss by this part of the largest miss are named.
NAMED = 0.2


def beyond_orders(run: Any, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """What no order sees makes of the solution of a run, (N, F): beyond kinks and jumps, and out of reach.

    known: the error that two orders tell of the own particles.
    """
    fitted, kinks = fits(run, values), beyond_kinks(run, values)
    found = np.maximum(unmet(run, values, fitted)[0], _faint(run, values, known, fitted))
    return found if kinks is None else np.maximum(found, kinks)


def fits(run: Any, values: np.ndarray) -> Fits:
    """The local polynomials (N, F, K) of the values, made when they are asked for, and once."""
    return cache(lambda: run.fitted(run.nums, values))


def _faint(run: Any, values: np.ndarray, known: np.ndarray, fitted: Fits) -> np.ndarray:
    """What is made of values that are hardly out of reach, no more of it than two orders make likely."""
    if run.disc.rec.order <= 3 or run.disc.scheme.method not in ("S", "III"):
        return np.zeros(run.disc.held.shape)
    made, told = _unmet(run, values, FAINT, fitted)[0], whole(run.disc)
    size = told.norm(told.own(made))
    return made if size == 0 else made * min(1.0, TRUSTED * told.norm(known) / size)


def unmet(run: Any, values: np.ndarray, fitted: Fits) -> tuple[np.ndarray, np.ndarray]:
    """What values out of reach make of the solution of a run, (N, F), and the particles whose polynomials these are.

    Nothing in the least-squares form, which has a misfit of its own, nor of method SSPH and of I and II, whose
    rows are other predictions than their polynomials: they are compared with method S.
    """
    if run.disc.scheme.method not in ("S", "III"):
        return np.zeros(run.disc.held.shape), np.zeros(0, int)
    return _unmet(run, values, LOST[run.disc.rec.order > 3], fitted)


def far_out(run: Any, values: np.ndarray, fitted: Fits) -> tuple[np.ndarray, np.ndarray]:
    """The same of values that are missed by far, each by as much as the nearest are: of any method.

    Where held values have no part in the solution its weights are nothing, and so is what they miss.
    """
    return _unmet(run, values, FAR, fitted, plain=True)


def _unmet(
    run: Any, values: np.ndarray, lost: float, fitted: Fits, plain: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    if run.formulation == "lsq" or run.rows is None or run.factor is None:
        return np.zeros(run.disc.held.shape), np.zeros(0, int)
    defects = missed(run.disc, run.rows, values, fitted(), lost, plain)
    return made_of(run, defects if plain else TIMES * defects)


def made_of(run: Any, defects: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What defects (N, F) make of the solution of a run, (N, F), and the particles that have the largest."""
    disc, told = run.disc, whole(run.disc)
    free = ~disc.held if disc.part is None else ~disc.held & disc.part.own[:, None]
    most = told.most((defects * free).max(axis=0, initial=0.0))
    if not np.any(most):
        return np.zeros(disc.held.shape), np.zeros(0, int)
    return solved_alone(run, defects[free]), np.flatnonzero((free & (defects > NAMED * most)).any(axis=1))


def missed(
    disc: Discretization, rows: tuple[list[Class], list[Row]], values: np.ndarray, fitted: np.ndarray, lost: float,
    plain: bool = False,
) -> np.ndarray:  # fmt: skip
    """What predictions (N, F) of polynomials that do not reach their nearest neighbours miss, zero elsewhere.

    A prediction is a weighted sum of the neighbours' values, and what the polynomial leaves of them no more than noise
    to it. plain: the mean that is left of the nearest in its place. values (N, F), fitted (N, F, K): the polynomials.
    """
    points, out = np.asarray(disc.points, float), np.zeros(disc.held.shape)
    at = lambda other: values[np.asarray(disc.images.owners(other))]

    def left(ids: np.ndarray, other: np.ndarray) -> np.ndarray:
        """What polynomials at particles (n,) leave of the values of others (n,), (n, F)."""
        terms = monomials_on_host((points[other] - points[ids]).T, disc.rec.reach)[: fitted.shape[2]]
        away = np.abs(np.einsum("nfk,kn->nf", fitted[ids], terms) - at(other))
        return np.where((other != ids)[:, None], away, 0.0)

    for cls, row in zip(*rows):
        nearest = nearest_of(disc, cls, 2 * disc.rec.dim)
        nearest = np.where(nearest >= 0, nearest, cls.ids[:, None])
        off = np.stack([left(cls.ids, other) for other in nearest.T])
        change = np.stack([np.abs(at(other) - values[cls.ids]) for other in nearest.T]).max(axis=0)
        bad = np.flatnonzero((off.max(axis=0) > lost * change).any(axis=1))
        if not len(bad):
            continue
        total = off[:, bad].mean(axis=0)
        if not plain:
            near = np.where(np.asarray(cls.neighbours) >= 0, cls.neighbours, cls.ids[:, None])[bad]
            weights = np.abs(np.asarray(row.weights)[bad])
            parts = [np.einsum("nfg,ng->nf", weights[:, :, k], left(cls.ids[bad], other))
                     for k, other in enumerate(near.T)]  # fmt: skip
            total = np.linalg.norm(parts, axis=0)
        out[cls.ids[bad]] = np.where((off.max(axis=0) > lost * change)[bad], total, 0.0)
    return out
