"""Points between the particles where a source or a potential is infinite, as 1 / r about a centre.

Beside such a point Taylor series end before they reach the neighbours, and the recursion makes of them the analytic
solution about it, which vanishes there where the true one has a cusp. A fit of the values takes the place of the
series. Where the coefficient of a derivative is infinite too, as 2 / r on an axis, all belong together, and an analytic
solution is the true one: there everything stays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.layout import Discretization
from jsmitsm.discretization.resolution.kinks import fitted_series, offsets, owners
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.traced import Traced
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.taylor.multi_indices import count, multi_indices

# v / |grad v| is the way to a pole of first order; to others it is another part of the way.
PARTS, STEPS = np.array([1.0, 0.5, 2.0]), 12
# A pole is found where this way is so small a part of the support, and met by a particle that is as near to it.
FOUND = 1e-6


class Poles(NamedTuple):
    """at (P, D): where something is infinite, beside the particles ids (P,), whose series were replaced."""

    at: np.ndarray
    ids: np.ndarray


class _Function(NamedTuple):
    """The coefficient of a slot in an equation, or its source (slot None)."""

    equation: int
    slot: int | None

    def place(self, disc: Discretization) -> tuple[Any, ...]:
        """Where its Taylor coefficients stand, in those of the operator or of all sources."""
        if self.slot is not None:
            return self.equation, self.slot, np.arange(count(disc.rec.dim, disc.rec.degree))
        return (np.array([k for k, (e, _) in enumerate(disc.rec.row_index) if e == self.equation]),)

    def at(self, traced: Traced, params: Any, points: Any, degree: int) -> Any:
        """Its Taylor coefficients (T, m) at points (m, D)."""
        jac, residual = traced.coefficients(points, degree, params=params)
        return -residual[self.equation] if self.slot is None else jac[self.equation, self.slot]


def without_poles(
    disc: Discretization, problem: Problem, ids: np.ndarray, jac: Any, source: Any
) -> tuple[Any, Any, Poles | None]:
    """The numbers of a linear problem, with fits for the series that end at poles, and where these are.

    jac (E, S, T, n), source (rows, n): of the particles ``ids``. Poles are sought where numbers are known.
    """
    if not disc.traced.unbounded:
        return jac, source, None
    numbers = [concrete(x) for x in jax.tree.leaves((jac, source, disc.points, disc.traced, problem.params))]
    if any(x is None for x in numbers):
        return jac, source, None
    found = _sought(disc, problem, ids, np.asarray(concrete(jac)), np.asarray(concrete(source)))
    for function, (_, which) in found.items():
        there = function.at(disc.traced, problem.params, disc.cloud.points, 0)[0]
        if function.slot is None:
            source = _replaced(disc, ids, which, source, function.place(disc), there)
        else:
            jac = _replaced(disc, ids, which, jac, function.place(disc), there)
    if not found:
        return jac, source, None
    at, which = (np.concatenate(x) for x in zip(*found.values()))
    return jac, source, Poles(at, ids[which])


def _sought(
    disc: Discretization, problem: Problem, ids: np.ndarray, jac: np.ndarray, source: np.ndarray
) -> dict[_Function, tuple[np.ndarray, np.ndarray]]:
    """Sources and potentials that are infinite beside particles: where, (P, D), and which of the ids, (P,)."""
    traced, params = jax.tree.map(concrete, (disc.traced, problem.params))
    reach = _reach(disc, ids)
    points = np.asarray(concrete(disc.cloud.points), float)[ids]
    found, together = {}, np.zeros(len(ids), bool)
    for function in _varying(disc, jac, source):
        series = (source if function.slot is None else jac)[function.place(disc)]
        which = _ending(series, disc.rec.degrees[function.equation], disc.rec.dim, reach)
        if not len(which):
            continue
        at, arrived = _approached(function, traced, params, points[which], reach[which])
        at, which = at[arrived], which[arrived]
        if function.slot is not None and sum(disc.rec.slots[function.slot][1]):
            together[which] = True
        elif len(which):
            found[function] = at, which
    between = {f: _between(disc, ids, at, which, f.slot is not None) & ~together[which]
               for f, (at, which) in found.items()}  # fmt: skip
    return {f: (at[between[f]], which[between[f]]) for f, (at, which) in found.items() if between[f].any()}


def _varying(disc: Discretization, jac: np.ndarray, source: np.ndarray) -> list[_Function]:
    """The coefficients and the sources that are not the same everywhere."""
    slots = [(e, s) for e, row in enumerate(disc.rec.pattern) for s, there in enumerate(row) if there]
    out = [_Function(*slot) for slot in slots] if jac.shape[-1] > 1 else []
    return out + ([_Function(e, None) for e in range(len(disc.rec.degrees))] if source.shape[-1] > 1 else [])


def _reach(disc: Discretization, ids: np.ndarray) -> np.ndarray:
    """How far the supports of the particles reach, (n,); 0: a particle has none."""
    points, out = np.asarray(concrete(disc.points), float), np.zeros(len(disc.cloud))
    for cls in disc.classes:
        away = offsets(points, cls.ids, np.asarray(cls.neighbours), np)
        out[cls.ids] = np.sqrt(np.square(away).sum(axis=2).max(axis=1))
    return out[ids]


def _ending(series: np.ndarray, degree: int, dim: int, reach: np.ndarray) -> np.ndarray:
    """The particles whose series (T, n) may end within their supports: the last terms there exceed the value."""
    if degree < 1:
        return np.zeros(0, int)
    degrees = np.array([sum(c) for c in multi_indices(dim, degree)])
    series = series[: len(degrees)]
    last = np.flatnonzero(degrees > max(degree - 2, 0))
    terms = np.abs(series[last]) * reach ** degrees[last][:, None]
    return np.flatnonzero((terms.sum(axis=0) > np.abs(series[0])) & (reach > 0))


def _approached(
    function: _Function, traced: Traced, params: Any, points: np.ndarray, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where |v| leads to from points (m, D), Newton's method for 1 / v = 0, and whether it is infinite there, within
    the support."""

    def looked(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """|v| (m,) and the way to a pole of first order (m, D), none where v is infinite."""
        with np.errstate(all="ignore"):
            value, *slope = np.asarray(function.at(traced, params, x, 1), float)
            way = value * np.array(slope) / np.square(slope).sum(axis=0)
        infinite = ~np.isfinite(value)
        return np.where(infinite, np.inf, np.abs(value)), np.where(infinite, 0.0, way).T

    at = points
    size, way = looked(at)
    for _ in range(STEPS):
        tried = at + PARTS[:, None, None] * np.where(np.isfinite(way), way, 0.0)
        there = [looked(x) for x in tried]
        best = np.argmax([s for s, _ in there], axis=0)
        pick = best, np.arange(len(at))
        better = np.array([s for s, _ in there])[pick] > size
        at = np.where(better[:, None], tried[pick], at)
        size = np.where(better, np.array([s for s, _ in there])[pick], size)
        way = np.where(better[:, None], np.array([w for _, w in there])[pick], way)
    left = np.linalg.norm(way, axis=1)
    return at, (left < FOUND * reach) & (np.linalg.norm(at - points, axis=1) < reach)


def _between(disc: Discretization, ids: np.ndarray, at: np.ndarray, which: np.ndarray, inside: bool) -> np.ndarray:
    """Whether no particle meets the poles ``at`` (P, D); ``inside``: and the cloud goes on behind them."""
    points, good = np.asarray(concrete(disc.points), float), np.zeros(len(which), bool)
    for cls in disc.classes:
        here = np.flatnonzero(np.isin(ids[which], cls.ids))
        near = np.asarray(cls.neighbours)[np.searchsorted(cls.ids, ids[which[here]])]
        away = points[np.where(near >= 0, near, ids[which[here]][:, None])] - at[here][:, None]
        length = np.linalg.norm(away, axis=2)
        behind = np.einsum("nwd,nd->nw", away, away[:, 0]) < 0  # the particle itself is the first
        good[here] = (length.min(axis=1) > FOUND * length.max(axis=1)) & (behind.any(axis=1) | (not inside))
    return good


def _replaced(disc: Discretization, ids: np.ndarray, which: np.ndarray, whole: Any, place: Any, there: Any) -> Any:
    """``whole`` (..., n) with fits to the values ``there`` (N,) for the series at ``place`` of some of the particles."""
    xp: Any = jnp if is_traced(whole, there, disc.points) else np
    whole, there, points = xp.array(whole), xp.asarray(there), xp.asarray(disc.points)
    *first, terms = place
    for cls in disc.classes:
        here = which[np.isin(ids[which], cls.ids)]
        if not len(here):
            continue
        own = np.searchsorted(cls.ids, ids[here])
        near = np.asarray(cls.neighbours)[own]
        values = there[owners(disc, cls)[own]]
        valid = (near >= 0) & xp.isfinite(values)
        away = offsets(points, ids[here], near, xp)
        new, _ = fitted_series(away, valid, xp.where(valid, values, 0.0), len(terms), xp)
        index = (*first, terms[:, None], here)
        if xp is np:
            whole[index] = new
        else:
            whole = whole.at[index].set(new)
    return whole
