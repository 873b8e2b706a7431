"""Thin layers between particles that hardly conduct: with the coefficients all that the equation misses is small there.

A flux passes through such a layer, or is held up by it, and what counts is the integral of 1 / k across it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jsmitsm.discretization.layout import Discretization
from jsmitsm.equation.problem import Problem
from jsmitsm.solution.look.halfway import looked_at, pairs
from jsmitsm.taylor.multi_indices import factorial, index_of

# One looks at so many places on the way, by dimension: layers thinner than their distance may be overlooked.
PLACES = {1: 101, 2: 7, 3: 3}
# A layer yields to the same flux so many times as much as both of its ends do; less of it at the places looked at makes
# one look again.
YIELDS, SUSPECT = 2.0, 1.2
# Around the place that yields most one looks again, so many times, at so many places up to so many beside it.
_AGAIN, _FINER, _BESIDE = 5, 16, 2
# An entry of the inverse below this part of the largest is none.
_NOTHING = 1e-6
# It is a flux that passes where the first derivatives' coefficients are the slope of the leading ones to this part.
_FLUX = 0.5


def across_layers(
    disc: Discretization, problem: Problem, fitted: Callable[[], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The particles (n,) with equations, and what layers on the way to their neighbours make them miss, (E, n).

    fitted: makes the local polynomials (N, F, K), if there is need of them. Beyond a layer the solution is by e another
    than they say; the mean of P e / d^2 around is the source that moves it so, with P the leading coefficients on the
    way d: to one side from here, to the other from beyond. Of equations of second order, and on a line of the first.
    """
    rec, points = disc.rec, np.asarray(disc.points, float)
    ids, near = looked_at(disc, disc.classes)
    missed = np.zeros((len(rec.levels), len(ids)))
    known = max(rec.levels) == 2 or (max(rec.levels) == 1 and rec.dim == 1)
    if not known or len(rec.levels) != rec.fields or disc.traced.constant:
        return ids, missed
    ways = np.linspace(0.0, 1.0, PLACES[rec.dim] + 2)
    count = np.maximum((near >= 0).sum(axis=1), 1)
    for row, column in pairs(near, len(ways)):
        here = ids[row]
        u = None if disc.linear else fitted()[here]
        line = _Line(disc, problem, points[here], points[near[row, column]] - points[here], u)
        found = _moved(line, np.broadcast_to(ways, (len(row), len(ways))), here, fitted)
        for e, level in enumerate(rec.levels):
            np.add.at(missed[e], row, found[:, e] * level * rec.dim / count[row])
    return ids, missed


class _Line:
    """The equation on the ways (n, D) from particles (n, D), the derivatives of the solution as these know them."""

    def __init__(
        self, disc: Discretization, problem: Problem, start: np.ndarray, way: np.ndarray, u: np.ndarray | None
    ):
        self.disc, self.problem, self.start, self.way, rec = disc, problem, start, way, disc.rec
        self.length = np.linalg.norm(way, axis=1)
        self.unit = way / self.length[:, None]
        self.value, self.below = np.zeros((len(disc.traced.slots), len(way))), np.zeros((len(way), rec.fields))
        if u is not None:
            self.value, self.below = self._known(u)

    def _known(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The derivatives (S, n) that the equation has, and what the leading ones (n, F) are one of: slopes, and the
        value of a pressure."""
        rec = self.disc.rec
        index = index_of(rec.dim, rec.reach)
        value = np.stack([u[:, f, index[b]] * factorial(b) for f, b in self.disc.traced.slots])
        first = [index[tuple(int(k == axis) for k in range(rec.dim))] for axis in range(rec.dim)]
        slope = np.einsum("nfd,nd->nf", u[:, :, first], self.unit)
        own = np.array(rec.weights)
        return value, np.where(own == 0, slope, np.where(own == 1, u[:, :, 0], 0.0))

    def some(self, rows: np.ndarray, u: np.ndarray) -> _Line:
        """Some of them, with the polynomials (n, F, K) of their particles."""
        return _Line(self.disc, self.problem, self.start[rows], self.way[rows], u)

    def at(self, ways: np.ndarray) -> tuple[np.ndarray, ...]:
        """At parts (n, W) of the ways the coefficients (n, W, E, F) of the leading derivatives along them, the sum of
        their sizes, those of the next derivatives, and the rest (n, W, E) of the equation."""
        rec, traced, (n, w) = self.disc.rec, self.disc.traced, ways.shape
        there = (self.start[:, None] + ways[..., None] * self.way[:, None]).reshape(n * w, -1)
        value = np.repeat(self.value, w, axis=1)
        jac, rest = traced.coefficients(
            there, 0, params=self.problem.params, slots=None if traced.linear else value[:, None]
        )
        jac = np.broadcast_to(np.asarray(jac)[:, :, 0], (*np.shape(jac)[:2], n * w))
        rest = np.zeros((len(jac), n * w)) if rest is None else np.array(rest)[:, 0] * np.ones(n * w)
        lead, size, after = np.zeros((3, n, w, len(rec.levels), rec.fields))
        for s, (f, b) in enumerate(traced.slots):
            along = np.prod(self.unit ** np.array(b), axis=1)[:, None]
            for e, level in enumerate(rec.levels):
                degree, coefficient = sum(b) + rec.weights[f], jac[e, s]
                if degree == level:
                    lead[:, :, e, f] += coefficient.reshape(n, w) * along
                    size[:, :, e, f] += np.abs(coefficient.reshape(n, w) * along)
                elif degree == level - 1 and any(b):
                    after[:, :, e, f] += coefficient.reshape(n, w) * along
                if (degree == level) != traced.linear:
                    rest[e] += (1.0 if traced.linear else -1.0) * coefficient * value[s]
        return lead, size, after, np.moveaxis(rest.reshape(-1, n, w), 0, 2)


def _moved(line: _Line, ways: np.ndarray, ids: np.ndarray, fitted: Callable[[], np.ndarray]) -> np.ndarray:
    """P e / d^level (n, E) by layers on the ways from particles (n,), looked at in parts ``ways`` (n, W) of them."""
    rec, out = line.disc.rec, np.zeros((len(ways), len(line.disc.rec.levels)))
    known = line.at(ways)
    layered = np.flatnonzero(_yields(*known[:2]).max(axis=1) > SUSPECT)
    if not len(layered):
        return out
    line, ways = line.some(layered, fitted()[ids[layered]]), ways[layered]
    known = line.at(ways)
    for _ in range(_AGAIN):
        worst = _yields(*known[:2]).argmax(axis=1)[:, None]
        beside = np.clip(np.concatenate([worst - _BESIDE, worst + _BESIDE], axis=1), 0, ways.shape[1] - 1)
        low, high = np.split(np.take_along_axis(ways, beside, axis=1), 2, axis=1)
        finer = low + (high - low) * np.linspace(0.0, 1.0, _FINER + 2)[1:-1]
        every = np.concatenate([ways, finer], axis=1)
        order = np.argsort(every, axis=1, kind="stable")
        ways = _sorted(every, order)
        known = tuple(_sorted(np.concatenate(both, axis=1), order) for both in zip(known, line.at(finer)))
    lead, _, after, rest = known
    inverse, length = _inverse(lead), line.length[:, None]
    flux = np.einsum("nef,nf->ne", lead[:, 0], line.below)
    slope = _beyond_ends(np.einsum("nwfe,ne->nwf", inverse, flux))
    bend = _beyond_ends(np.einsum("nwfe,nwe->nwf", inverse, -rest))
    if max(rec.levels) == 2:
        bend *= ((1.0 - ways) * length)[..., None]
    passes = _is_flux(line, ways, lead, after)
    excess = np.where(passes[:, None, None], slope, bend)
    e = (0.5 * (excess[:, 1:] + excess[:, :-1]) * np.diff(ways, axis=1)[..., None]).sum(axis=1) * length
    thick = _yields(*known[:2]).max(axis=1) <= YIELDS
    e = np.where((np.array(rec.weights) == 0) & ~thick[:, None], np.where(np.isfinite(e), e, 0.0), 0.0)
    out[layered] = np.einsum("nef,nf->ne", lead[:, 0], e) / length ** np.array(rec.levels)
    return out


def _sorted(x: np.ndarray, order: np.ndarray) -> np.ndarray:
    """What is known (n, W, ...) of places in another order (n, W)."""
    return np.take_along_axis(x, order.reshape(*order.shape, *(1,) * (x.ndim - 2)), axis=1)


def _inverse(lead: np.ndarray) -> np.ndarray:
    """The inverses of coefficients (n, W, E, F), infinite where there are none."""
    none = np.linalg.det(lead) == 0
    found = np.linalg.inv(np.where(none[..., None, None], np.eye(lead.shape[-1]), lead))
    return np.where(none[..., None, None], np.inf, found)


def _yields(lead: np.ndarray, size: np.ndarray) -> np.ndarray:
    """How many times as much places (n, W) yield as both ends do; zero where these have no inverse.

    Where coefficients are not smaller, terms of unlike signs cancel, as on the ways of waves and along streamlines.
    """
    smaller = (size * SUSPECT < np.minimum(size[:, :1], size[:, -1:])).any(axis=(2, 3))
    out, some = np.zeros(smaller.shape), np.flatnonzero(smaller.any(axis=1))
    inverse = np.abs(_inverse(lead[some]))
    ends = np.maximum(inverse[:, 0], inverse[:, -1])
    most = ends.max(axis=(1, 2), keepdims=True)
    sound = np.isfinite(most) & (most > 0)
    ends = np.where(sound, np.maximum(ends, _NOTHING * np.where(sound, most, 1.0)), np.inf)[:, None]
    out[some] = (np.minimum(inverse, np.finfo(float).max) / ends).max(axis=(2, 3))
    return np.where(smaller, out, 0.0)


def _beyond_ends(values: np.ndarray) -> np.ndarray:
    """By how much values (n, W, F) are larger than on both ends."""
    ends = np.maximum(np.abs(values[:, :1]), np.abs(values[:, -1:]))
    return np.sign(values) * np.maximum(np.abs(values) - ends, 0.0)


def _is_flux(line: _Line, ways: np.ndarray, lead: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Whether the equation on a way is of a divergence, (k u')', not k u''; a system's of unlike orders may be one."""
    second = np.array(line.disc.rec.levels) == 2
    if not second.any():
        return np.zeros(len(ways), bool)
    change = np.diff(lead, axis=1)[:, :, second]
    step = (np.diff(ways, axis=1) * line.length[:, None])[..., None, None]
    told = 0.5 * (after[:, 1:] + after[:, :-1])[:, :, second] * step
    size: Any = np.sqrt(np.square(change).sum(axis=(2, 3)))
    alike = (change * told).sum(axis=(2, 3)) / np.where(size > 0, size, 1.0)
    return alike.sum(axis=1) >= _FLUX * size.sum(axis=1)
