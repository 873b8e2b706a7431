"""Points between the particles where a source or a potential is infinite, as 1 / r about a centre.

Beside such a point Taylor series end before they reach the neighbours, and the recursion makes of them the analytic
solution about it, which vanishes there where the true one has a cusp. A fit of the values takes the place of the
series. Where the coefficient of a derivative is infinite too, as 2 / r on an axis, all belong together, and an analytic
solution is the true one: there everything stays.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import kept
from jsmitsm.discretization.layout import Discretization
from jsmitsm.discretization.parts.whole import ALONE, Whole
from jsmitsm.discretization.resolution.kinks import fitted_series, offsets
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.traced import Traced
from jsmitsm.runtime.compiled import Same
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.runtime.whole_program import in_one_program
from jsmitsm.taylor.multi_indices import count, multi_indices

# v / |grad v| is the way to a pole of first order; to others it is another part of the way, of logarithms a small one.
PARTS, STEPS = np.array([1.0, 0.5, 2.0, 0.25, 0.12, 0.06]), 20
# A pole is found where this way is so small a part of the support, and of what it was: exponentials keep theirs. It is
# met by a particle that is as near to it.
FOUND, SHORTER = 1e-5, 1e-2
# After so many steps the way is a part of what it was that is far below this, or leads to no pole. Of 700 on their ways
# to poles, wherever they began, none had more left than a millionth.
SOON, STILL = 8, 0.5
# Who has gone so many times as far as the support reaches is on the way to none, or to one that does not count.
ASTRAY = 2.0
# A value nearer to a pole than this part of the spacing is taken so far away: about the mean over a particle's share of
# space, of 1 / r in 2D and 3D, of its root on a line.
NEAREST = {1: 0.12, 2: 0.3, 3: 0.4}
# What is left out beside a pole is this part of what the values around it differ from the fit, measured on sources and
# potentials like 1 / r at several places within the spacing: from half to five times the error.
LEFT_OUT = 0.5


class Poles(NamedTuple):
    """at (P, D): where the source of an ``equation`` (P,) or its coefficient of a ``slot`` (P,), -1 for the source, is
    infinite, beside the particles ids (P,); missed (P,): what the fits that took the place of the series leave out.
    """

    at: np.ndarray
    ids: np.ndarray
    equation: np.ndarray
    slot: np.ndarray
    missed: np.ndarray


def joined(known: Poles | None, found: Poles | None) -> Poles | None:
    """What is known of poles beside particles, and what was found beside others."""
    if known is None or found is None:
        return known or found
    new = ~np.isin(found.ids, known.ids)
    return Poles(*(np.concatenate([a, b[new]]) for a, b in zip(known, found)))


def said(found: Poles | None, told: Whole = ALONE) -> list[str]:
    """A sentence on poles, if there are any; ``told``: of the cloud that several processes share."""
    at = told.together(np.zeros((0, 0)) if found is None else found.at)
    what = "A coefficient" if told.total(0 if found is None else int((found.slot >= 0).sum())) else "The source"
    if not len(at):
        return []
    return [
        f"{what} is infinite at x = {at[0]}, between the particles, and the solution is not smooth there: refine "
        "towards that point, or solve for what is left once the singular part is taken out."
    ]


def poles_of(disc: Discretization) -> list[str]:
    """A sentence on the poles of a linear operator's coefficients, if there are any."""
    if not (disc.traced.unbounded[1] and disc.linear) or disc.traced.constant:
        return []
    jac, _ = disc.traced.coefficients(disc.cloud.points[disc.active], disc.rec.degree, params=disc.problem.params)
    _, _, found = without_poles(disc, disc.problem, disc.active, jac, np.zeros((disc.rec.n_rows, 1)))
    return said(found)


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
    if not any(disc.traced.unbounded):
        return jac, source, None
    numbers = [concrete(x) for x in jax.tree.leaves((jac, source, disc.points, disc.traced, problem.params))]
    if any(x is None for x in numbers):
        return jac, source, None
    found = _sought(disc, problem, ids, np.asarray(concrete(jac)), np.asarray(concrete(source)))
    if not found:
        return jac, source, None
    missed = []
    for function, (at, which) in found.items():
        valued = partial(function.at, disc.traced, problem.params)
        if function.slot is None:
            source, left = _replaced(disc, ids[which], at, which, source, function.place(disc), valued)
        else:
            jac, left = _replaced(disc, ids[which], at, which, jac, function.place(disc), valued)
        missed.append(left)
    at, which = (np.concatenate(x) for x in zip(*found.values()))
    names = [(f.equation, -1 if f.slot is None else f.slot) for f, (_, some) in found.items() for _ in some]
    equation, slot = np.array(names).T
    return jac, source, Poles(at, ids[which], equation, slot, LEFT_OUT * np.sqrt(np.concatenate(missed)))


def _sought(
    disc: Discretization, problem: Problem, ids: np.ndarray, jac: np.ndarray, source: np.ndarray
) -> dict[_Function, tuple[np.ndarray, np.ndarray]]:
    """Sources and potentials that are infinite beside particles: where, (P, D), and which of the ids, (P,)."""
    traced, params = jax.tree.map(concrete, (disc.traced, problem.params))
    reach = _reach(disc, ids)
    points = np.asarray(concrete(disc.cloud.points), float)
    passing = is_traced(jax.tree.leaves((disc.traced, problem.params)))  # by JAX: nothing of it stays
    asked = "poles", Same(disc.traced), tuple(np.asarray(x).tobytes() for x in jax.tree.leaves(params))
    found, together = {}, np.zeros(len(ids), bool)
    for function in _varying(disc, jac, source):
        series = (source if function.slot is None else jac)[function.place(disc)]
        which = _ending(series, disc.rec.degrees[function.equation], disc.rec.dim, reach)
        if not len(which):
            continue
        # Another order's series end at other particles, but the ways from them are the same.
        ways = _Ways(points) if passing else kept(disc.cloud, (*asked, function), partial(_Ways, points))
        at, arrived = ways.met(partial(function.at, traced, params), ids[which], reach[which])
        at, which = at[arrived], which[arrived]
        if function.slot is not None and any(disc.rec.slots[function.slot][1]):
            together[which] = True
        elif len(which):
            found[function] = at, which
    for function, (at, which) in list(found.items()):
        good = _between(disc, ids[which], at, function.slot is not None) & ~together[which]
        found[function] = at[good], which[good]
    return {function: where for function, where in found.items() if len(where[1])}


def _varying(disc: Discretization, jac: np.ndarray, source: np.ndarray) -> list[_Function]:
    """The coefficients and the sources that are not the same everywhere."""
    slots = [(e, s) for e, row in enumerate(disc.rec.pattern) for s, there in enumerate(row) if there]
    out = [_Function(*slot) for slot in slots] if jac.shape[-1] > 1 else []
    sources = source.shape[-1] > 1 and not disc.traced.kinked_source  # whose series are judged by their values
    return out + [_Function(e, None) for e in range(len(disc.rec.degrees)) if sources]


def _reach(disc: Discretization, ids: np.ndarray) -> np.ndarray:
    """How far the supports of the particles reach, (n,); 0: a particle has none."""
    points, out = np.asarray(concrete(disc.points), float), np.zeros(len(disc.cloud))
    for cls in disc.classes:
        for near in np.asarray(cls.neighbours).T:  # one after the other: all at once are as large as the rows
            away = points[np.where(near >= 0, near, cls.ids)] - points[cls.ids]
            out[cls.ids] = np.maximum(out[cls.ids], np.linalg.norm(away, axis=1))
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


class _Ways:
    """Where |v| leads to from particles, found for those that are asked for, and once."""

    def __init__(self, points: np.ndarray):
        self.start = points
        # Where, (N, D), how far it was and is to there, (N,): replaced together, for solves run in threads too.
        self.ends = points, np.zeros(len(points)), np.full(len(points), np.nan)

    def met(self, valued: Callable[..., Any], ids: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where it leads to from the particles ids (m,), (m, D), and whether it is infinite there, (m,).

        Poles outside of the support are none. valued: makes the function's Taylor coefficients at points.
        """
        new = np.isnan(self.ends[2][ids])
        if new.any():
            at, first, left = (x.copy() for x in self.ends)
            found = _approached(valued, self.start[ids[new]], ASTRAY * reach[new])
            at[ids[new]], first[ids[new]], left[ids[new]] = found
            self.ends = at, first, left
        at, first, left = (x[ids] for x in self.ends)
        shorter = (left < FOUND * reach) & (left < SHORTER * first)
        return at, shorter & (np.linalg.norm(at - self.start[ids], axis=1) < reach)


def _approached(
    valued: Callable[..., Any], points: np.ndarray, far: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Where |v| leads to from points (m, D) by Newton's method for 1 / v = 0, and how far it was and is to there.

    Who has gone as far (m,) goes no farther.
    """

    def looked(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """|v| (...,) and the way to a pole of first order (..., D), none where v is infinite; -1 where it is no number:
        a root beyond its end, say, to which nobody goes."""
        with np.errstate(all="ignore"):
            value, *slope = np.asarray(valued(x.reshape(-1, x.shape[-1]), 1), float)
            way = value * np.array(slope) / np.square(slope).sum(axis=0)
        size = np.where(np.isnan(value), -1.0, np.abs(value))
        return size.reshape(x.shape[:-1]), np.where(np.isfinite(value), way, 0.0).T.reshape(x.shape)

    at, moving = points.copy(), np.arange(len(points))
    size, way = looked(at)
    first = np.linalg.norm(way, axis=1)
    for step in range(STEPS):
        if step == SOON:
            moving = moving[~(np.linalg.norm(way[moving], axis=1) > STILL * first[moving])]
        if not len(moving):
            break
        tried = at[moving] + PARTS[:, None, None] * np.where(np.isfinite(way[moving]), way[moving], 0.0)
        sizes, ways = looked(tried)
        best = sizes.argmax(axis=0), np.arange(len(moving))
        better = sizes[best] > size[moving]
        best, moving = (best[0][better], best[1][better]), moving[better]  # who gets no nearer never will
        size[moving], at[moving], way[moving] = sizes[best], tried[best], ways[best]
        moving = moving[np.linalg.norm(at[moving] - points[moving], axis=1) < far[moving]]
    left = np.linalg.norm(way, axis=1)
    return at, first, np.where(np.isnan(left), np.inf, left)


def _between(disc: Discretization, ids: np.ndarray, at: np.ndarray, inside: bool) -> np.ndarray:
    """Whether no particle meets the poles ``at`` (P, D) beside particles (P,); ``inside``: and the cloud goes on behind
    them."""
    points, good = np.asarray(concrete(disc.points), float), np.zeros(len(ids), bool)
    for cls in disc.classes:
        here = np.flatnonzero(np.isin(ids, cls.ids))
        near = np.asarray(cls.neighbours)[np.searchsorted(cls.ids, ids[here])]
        away = points[np.where(near >= 0, near, ids[here][:, None])] - at[here][:, None]
        length = np.linalg.norm(away, axis=2)
        behind = np.einsum("nwd,nd->nw", away, away[:, 0]) < 0  # the particle itself is the first
        good[here] = (length.min(axis=1) > FOUND * length.max(axis=1)) & (behind.any(axis=1) | (not inside))
    return good


def _replaced(
    disc: Discretization, ids: np.ndarray, at: np.ndarray, which: np.ndarray, whole: Any, place: Any,
    valued: Callable[..., Any],
) -> tuple[Any, np.ndarray]:  # fmt: skip
    """``whole`` (..., n) with fits in the columns ``which`` of the series at ``place``, and their mean square misfits.

    ids, at: the particles (P,), and the poles (P, D) beside them; valued: makes the function's values at points.
    """
    missed = np.zeros(len(which))
    for cls in disc.classes:
        here = np.flatnonzero(np.isin(ids, cls.ids))
        if not len(here):
            continue
        near = np.asarray(cls.neighbours)[np.searchsorted(cls.ids, ids[here])]
        away, there = _around(disc.points, ids[here], near, at[here])
        values = valued(there, 0)[0]
        whole, left = _with_fits(whole, place, which[here], away, near >= 0, values)
        missed[here] = concrete(left)
    return whole, missed


@in_one_program
def _with_fits(whole: Any, place: Any, columns: np.ndarray, away: Any, valid: Any, values: Any) -> tuple[Any, Any]:
    """``whole`` with quadratic fits to the values (n w,) around in some columns, and their mean square misfits (n,)."""
    xp: Any = jnp if is_traced(whole, away, values) else np
    *first, terms = place
    values = xp.asarray(values).reshape(valid.shape)
    valid = valid & xp.isfinite(values)  # a source may be infinite at a particle that is held as well
    new, missed = fitted_series(away, valid, xp.where(valid, values, 0.0), len(terms), xp)
    index = (*first, terms[:, None], columns)
    if xp is jnp:
        return jnp.asarray(whole).at[index].set(new), missed
    whole = np.array(whole)
    whole[index] = new
    return whole, missed


@in_one_program
def _around(points: Any, ids: np.ndarray, near: np.ndarray, at: np.ndarray) -> tuple[Any, Any]:
    """The ways (n, w, D) from particles to their neighbours, and where these are, kept off the poles (n, D)."""
    xp: Any = jnp if is_traced(points) else np
    points = xp.asarray(points)
    away = offsets(points, ids, near, xp)
    size = lambda x: xp.sqrt(xp.maximum(xp.sum(x**2, axis=2), 1e-300))
    dim = at.shape[1]
    spacing = xp.sort(xp.where(near >= 0, size(away), np.inf), axis=1)[:, 1 : 1 + 2 * dim].mean(axis=1)
    from_pole = points[ids][:, None] + away - at[:, None]
    farther = xp.maximum(1.0, NEAREST[dim] * spacing[:, None] / size(from_pole))
    return away, (at[:, None] + from_pole * farther[..., None]).reshape(-1, dim)
