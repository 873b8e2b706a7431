"""What the local polynomials leave of equation and source between the particles, where nothing made it small."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.discretization.leave_one_out import right_side
from jsmitsm.discretization.rows import all_coefficients, all_rows
from jsmitsm.equation.problem import Problem
from jsmitsm.particle.polynomials import derivative_table
from jsmitsm.taylor.multi_indices import multi_indices


def between(disc: Discretization, nums: Numbers, problem: Problem, values: Any, rows: Any, factor: Any) -> np.ndarray:
    """What the residual between the particles makes of the solution, (N, F); nothing in the least-squares form.

    rows: the classes and their rows, factor: that of the global system. The least-squares form has no rows, and its
    estimate is another solution, which sees the same.
    """
    found = np.zeros(disc.held.size)
    if rows is None or (disc.linear and disc.traced.constant and disc.traced.source != "variable"):
        return found.reshape(disc.held.shape)
    missed = unresolved(disc, nums, problem, values)
    classes, made = rows
    if not disc.scheme.sourced or disc.scheme.method in ("I", "II"):
        # Rows of a problem without a source lack its weights; those of I and II hold the neighbours' sources.
        disc = replace(disc, scheme=replace(disc.scheme, sourced=True))
        disc.classes = [replace(cls, scheme=replace(cls.scheme, sourced=True)) for cls in classes]
        classes, made = all_rows(disc, missed)
    right = np.asarray(right_side(disc, missed, classes, made))
    solved = factor.solve(np.concatenate([right, np.zeros(factor.n - len(right))]))
    found[~disc.held.reshape(-1)] = np.abs(solved[: len(right)])
    return found.reshape(disc.held.shape)


def unresolved(disc: Discretization, nums: Numbers, problem: Problem, values: Any) -> Numbers:
    """The numbers of the same operator with, for its source, what the polynomials leave of the residual.

    The residual is looked at halfway to the nearest 2 D neighbours, and averaged: a source or a coefficient that the
    particles do not see, or whose Taylor series ends before it reaches the neighbours, shows there.
    """
    fitted = np.asarray(all_coefficients(disc, nums, values), float)
    points, place = np.asarray(disc.points, float), np.full(len(disc.cloud), -1)
    place[nums.ids] = np.arange(len(nums.ids))
    source = np.zeros((disc.rec.n_rows, len(nums.ids)))
    for cls in disc.classes:
        source[np.array(disc.rec.equation_rows)[:, None], place[cls.ids]] = _mean(disc, problem, cls, points, fitted)
    zero = np.zeros_like
    return replace(nums, source=source, held=zero(nums.held), given=zero(nums.given), gamma=zero(nums.gamma))


def unseen(disc: Discretization, nums: Numbers, problem: Problem, rows: Any) -> np.ndarray | None:
    """What the rows miss of the source (N, F), in the scale of u; None where there is no source, or a nonlinear one.

    The rows know a source by its Taylor series at the particles. What differs from them halfway to the neighbours,
    beside a kink, a jump or a point where it is infinite, is no less real, and rows of all orders miss it alike.
    """
    if not disc.linear or disc.traced.source != "variable" or not disc.scheme.sourced or np.shape(nums.source)[-1] < 2:
        return None
    points, place = np.asarray(disc.points, float), np.full(len(disc.cloud), -1)
    place[nums.ids] = np.arange(len(nums.ids))
    known, missed = np.asarray(nums.source), np.zeros((disc.rec.n_rows, len(nums.ids)))
    series = [[k for k, (e, _) in enumerate(disc.rec.row_index) if e == f] for f in range(len(disc.rec.orders))]
    for cls in rows[0]:
        at = place[cls.ids]

        def left(there: np.ndarray, offset: np.ndarray, at: np.ndarray = at) -> np.ndarray:
            away = -np.asarray(disc.traced.residuals(there, params=problem.params))
            for e, some in enumerate(series):
                powers = [np.prod(offset ** np.array(disc.rec.row_index[k][1]), axis=1) for k in some]
                away[e] -= np.einsum("kn,kn->n", known[some][:, at], np.stack(powers))
            return np.where(np.isfinite(away), away, 0.0)  # infinite on the boundary

        missed[np.array(disc.rec.equation_rows)[:, None], at] = _around(disc, cls, points, left)
    zero = np.zeros_like
    there = replace(nums, source=missed, held=zero(nums.held), given=zero(nums.given), gamma=zero(nums.gamma))
    found = np.zeros(disc.held.size)
    found[~disc.held.reshape(-1)] = np.asarray(right_side(disc, there, *rows))
    return found.reshape(disc.held.shape)


def _mean(disc: Discretization, problem: Problem, cls: Class, points: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """The mean residual (E, n) around every particle of a class, whose own share of it is zero."""
    left = lambda at, offset: _residual(disc, problem, at, offset, fitted[cls.ids])
    return _around(disc, cls, points, left)


def _around(disc: Discretization, cls: Class, points: np.ndarray, left: Callable[..., Any]) -> np.ndarray:
    """The mean (E, n) of something that vanishes at the particles of a class and is left(points, offsets) halfway."""
    near = np.asarray(cls.neighbours)[:, 1 : 1 + 2 * disc.rec.dim]
    total, count = np.zeros((len(disc.rec.orders), len(cls.ids))), np.ones(len(cls.ids))
    for k in range(near.shape[1]):
        there = near[:, k] >= 0
        offset = 0.5 * (points[np.where(there, near[:, k], cls.ids)] - points[cls.ids])
        total += np.where(there, left(points[cls.ids] + offset, offset), 0.0)
        count += there
    return total / count


def _residual(disc: Discretization, problem: Problem, at: np.ndarray, offset: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The residual (E, n) of polynomials u (n, F, K) at their centres plus ``offset``."""
    rec, traced = disc.rec, disc.traced
    powers = np.stack([np.prod(offset ** np.array(a), axis=1) for a in multi_indices(rec.dim, rec.reach)], axis=1)
    slots = []
    for f, b in traced.slots:
        lower, factor = derivative_table(rec.dim, rec.reach, b)
        slots.append(np.einsum("nk,nk->n", u[:, f], powers[:, lower] * factor))
    value = np.stack(slots)[:, None]
    if not traced.linear:
        return np.asarray(traced.coefficients(at, 0, params=problem.params, slots=value)[1])[:, 0]
    jac, source = traced.coefficients(at, 0, params=problem.params)
    found = np.einsum("esn,sn->en", np.broadcast_to(np.asarray(jac)[:, :, 0], (*jac.shape[:2], len(at))), value[:, 0])
    return found if source is None else found + np.asarray(source)[:, 0]
