"""What local polynomials leave of the equation away from their particles."""

from __future__ import annotations

import numpy as np

from jsmitsm.discretization.layout import Discretization
from jsmitsm.equation.problem import Problem
from jsmitsm.particle.polynomials import derivative_table, monomials_on_host

# Places looked at on the way to a neighbour, in parts of it; the polynomial of the nearer particle is asked.
WAY = np.arange(0.0, 1.01, 0.04)
# On it the equation is followed if it is missed by less than the first, in parts of its largest term, while no leading
# coefficient changes by more than the second of itself from one place to the next.
MISSED, STEP = 0.05, 0.5


def residual(disc: Discretization, problem: Problem, at: np.ndarray, offset: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The residual (E, n) of polynomials u (n, F, K) at their centres plus ``offset``, which is ``at``."""
    return evaluated(disc, problem, at, offset, u)[0]


def evaluated(disc: Discretization, problem: Problem, at: np.ndarray, offset: np.ndarray, u: np.ndarray) -> tuple:
    """The same, the operator's coefficients (E, S, n) there, and what they are multiplied with (S, n)."""
    rec, traced = disc.rec, disc.traced
    powers = monomials_on_host(offset.T, rec.reach)
    slots = []
    for f, b in traced.slots:
        lower, factor = derivative_table(rec.dim, rec.reach, b)
        slots.append(np.einsum("nk,kn->n", u[:, f], powers[lower] * factor[:, None]))
    value = np.stack(slots)
    jac, source = traced.coefficients(at, 0, params=problem.params, slots=None if traced.linear else value[:, None])
    jac = np.broadcast_to(np.asarray(jac)[:, :, 0], (*np.shape(jac)[:2], len(at)))
    if not traced.linear:
        return np.asarray(source)[:, 0], jac, value
    found = np.einsum("esn,sn->en", jac, value)
    return found if source is None else found + np.asarray(source)[:, 0], jac, value


def followed(
    disc: Discretization, problem: Problem, fitted: np.ndarray, ids: np.ndarray, near: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    """Whether the solution follows the equation all the way from particles to neighbours, (n,).

    fitted (N, F, K): the polynomials; offset (n, D): from the particles ``ids`` to ``near``.
    Where it does, a coefficient may be as steep as it likes: the source is too, and makes up for it.
    """
    rec, points = disc.rec, np.asarray(disc.points, float)
    leading = [s for s, (f, b) in enumerate(rec.slots) if sum(b) + rec.weights[f] == max(rec.levels)]
    good, before = np.ones(len(ids), bool), None
    for t in WAY:
        of, away = (ids, t * offset) if t <= 0.5 else (near, (t - 1.0) * offset)
        missed, jac, value = evaluated(disc, problem, points[ids] + t * offset, away, fitted[of])
        largest = np.abs(jac * value).max(axis=1)
        good &= (np.abs(missed) <= MISSED * largest).all(axis=0)
        now = jac[:, leading]
        if before is not None:
            good &= (np.abs(now - before) <= STEP * np.maximum(np.abs(now), np.abs(before))).all(axis=(0, 1))
        before = now
    return good
