"""What a problem says of itself before it is solved: where its source and coefficients need finer particles.

A cloud knows source and coefficients by their Taylor polynomials at the particles. Here they are looked at between, on
cubes that are halved until the polynomials about their centres tell what the corners see: a peak that no particle
meets, a front, coefficients that oscillate. Nothing is solved for it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.inside import inside_of
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.traced import Traced
from jsmitsm.equation.tracing import trace
from jsmitsm.particle.polynomials import monomials_on_host
from jsmitsm.taylor.multi_indices import count

# Points that are asked for source and coefficients besides the cubes' own, by dimension: what is narrower than their
# distance may be missed.
SAMPLES = {1: 200000, 2: 20000, 3: 30000}
# A cube looks so many of its widths away, as far as neighbours are that count.
_AWAY = 1.25
# Coefficients may differ from their Taylor polynomials by this part of the largest term of the operator.
COEFFICIENT = 0.3
# Waves of an operator such as laplacian(u) + k^2 u: (k h)^2 up to this is resolved, and a layer's (h / w)^2.
_WAVE = 1.5
# Of so many points it is asked whether they lie in the domain; of more, only whether in its box.
_ASKED = 60_000
# So many cubes are looked at together, and so often one is halved.
_CHUNK, _LEVELS = 8192, 14


class Look(NamedTuple):
    """How far source and coefficients are from their Taylor polynomials about n points.

    source (n,): of the source over the leading coefficient, that is of m-th derivatives of u. coefficient (n,): in
    parts of the operator's largest term. wave (n,): (k h)^2, or (h / w)^2 of a layer of the width w. size (n,): of the
    source around.
    """

    source: np.ndarray
    coefficient: np.ndarray
    wave: np.ndarray
    size: np.ndarray


class Data:
    """Source and coefficients of a problem, by themselves; at u = 0 where it is nonlinear."""

    def __init__(self, traced: Traced, params: Any, degree: int):
        self.traced, self.params, self.degree = traced, params, degree
        self.order = max(traced.order)

    @property
    def plain(self) -> bool:
        """Whether there is nothing to see: constant coefficients and a constant source."""
        return self.traced.linear and self.traced.constant and self.traced.source != "variable"

    def series(self, points: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
        """Taylor coefficients (E, S, T, n) of the operator and (E, T, n) of the source."""
        t = self.traced
        terms = count(t.dim, degree)
        slots = None if t.linear else np.zeros((len(t.slots), terms, len(points)))
        jac, source = t.coefficients(points, degree, params=self.params, slots=slots)
        jac = np.asarray(jac)
        if jac.shape[-1] == 1 and jac.shape[2] == 1:
            jac = np.concatenate([jac, np.zeros((*jac.shape[:2], terms - 1, 1))], axis=2)
        zero = np.zeros((t.n_equations, terms, len(points)))
        return np.broadcast_to(jac, (*jac.shape[:3], len(points))), zero if source is None else np.asarray(source)

    def look(self, points: np.ndarray, which: np.ndarray, offsets: np.ndarray, length: np.ndarray) -> Look:
        """At points (n, D) with the spacing length (n,): from point which (M,) to the offsets (M, D)."""
        order = np.argsort(which, kind="stable")
        ends = np.searchsorted(which[order], np.arange(0, len(points) + _CHUNK, _CHUNK))
        parts = []
        for k, (i, j) in enumerate(zip(ends[:-1], ends[1:])):
            some = slice(k * _CHUNK, (k + 1) * _CHUNK)
            pairs = order[i:j]
            parts.append(self._look(points[some], which[pairs] - k * _CHUNK, offsets[pairs], length[some]))
        return Look(*(np.concatenate(part) for part in zip(*parts)))

    def _look(self, points: np.ndarray, which: np.ndarray, offsets: np.ndarray, length: np.ndarray) -> Look:
        t = self.traced
        if not len(which):
            return Look(*np.zeros((4, len(points))))
        jac, source = self.series(points, self.degree)
        jac_there, source_there = self.series(points[which] + offsets, 0)
        powers = monomials_on_host(offsets.T, self.degree)
        order = np.array([[sum(b) for _, b in t.slots]] * t.n_equations)
        leading = np.abs(jac[:, :, 0]) * (order == np.array(t.order)[:, None])[..., None]
        leading = np.maximum(leading.max(axis=1), 1e-300)  # (E, n)
        with np.errstate(all="ignore"):
            missed = np.abs(np.einsum("etm,tm->em", source[..., which], powers) - source_there[:, 0])
            missed = _gathered(missed / leading[:, which], which, len(points))
            size = _gathered(np.abs(source_there[:, 0]) / leading[:, which], which, len(points))
            centre = (np.abs(source[:, 0]) / leading).max(axis=0)
            scale = length ** (np.array(t.order)[:, None] - order)[..., None]  # (E, S, n)
            away = np.abs(np.einsum("estm,tm->esm", jac[..., which], powers) - jac_there[:, :, 0]) * scale[..., which]
            terms = np.maximum((np.abs(jac[:, :, 0]) * scale).max(axis=1), 1e-300)
            coefficient = _gathered(away.max(axis=1) / terms[:, which], which, len(points))
            wave = np.maximum(self._waves(jac[:, :, 0]), self._turning(jac, length)) * length**2
        size = np.where(np.isfinite(centre), np.maximum(size, centre), size)
        return Look(missed, coefficient, wave, size)

    def _waves(self, jac: np.ndarray) -> np.ndarray:
        """k^2 (n,) of operators of second order with a term of the field that makes waves; else zero."""
        t = self.traced
        found = np.zeros(jac.shape[-1])
        if t.n_equations > 1 or t.order != (2,):
            return found
        zero = [s for s, (_, b) in enumerate(t.slots) if sum(b) == 0]
        pure = [s for s, (_, b) in enumerate(t.slots) if sum(b) == 2 and max(b) == 2]
        if not zero or not pure:
            return found
        second = jac[0, pure]
        one_sign = second.min(axis=0) * second.max(axis=0) > 0
        diffusion = np.where(one_sign, second[0], 1.0)
        return np.where(one_sign, np.maximum(jac[0, zero[0]] / diffusion, 0.0), 0.0)

    def _turning(self, jac: np.ndarray, length: np.ndarray) -> np.ndarray:
        """1 / w^2 (n,) of layers within a line: about a zero of b that rises, a u'' + b u' has them, w^2 = a / b'."""
        t = self.traced
        found = np.zeros(jac.shape[-1])
        if t.dim > 1 or t.n_equations > 1 or t.order != (2,) or (0, (1,)) not in t.slots:
            return found
        a, (b, slope) = jac[0, t.slots.index((0, (2,))), 0], jac[0, t.slots.index((0, (1,))), :2]
        rise = slope / np.where(a != 0, a, np.inf)
        return np.where(np.abs(b) <= np.abs(slope) * length, np.maximum(rise, 0.0), 0.0)


def _gathered(values: np.ndarray, which: np.ndarray, n: int) -> np.ndarray:
    """The largest (n,) of values (E, M) that are numbers: outside of the domain a source need not be defined."""
    out = np.zeros(n)
    np.maximum.at(out, which, np.where(np.isfinite(values), values, 0.0).max(axis=0))
    return out


def data_of(problem: Problem, dim: int, degree: int) -> Data | None:
    """The data of a problem; None where it has several equations for several regions."""
    pde = problem.pde
    if not callable(pde) and not isinstance(pde, Traced):
        return None
    return Data(pde if isinstance(pde, Traced) else trace(pde, dim, problem.fields, params=problem.params),
                problem.params, degree)  # fmt: skip


def unresolved(
    data: Data, cloud: Cloud, width: float, part: float, scale: float, most: int
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (n, D) and widths (n,) of cubes as wide as the particles there should be apart.

    width: of the first cubes. A cube is resolved where the source between is known to this ``part`` of the largest
    source met, or to what makes this part of the ``scale`` of u. most: cubes after which the look ends.
    """
    points = np.asarray(cloud.points)
    lo, hi = points.min(axis=0), points.max(axis=0)
    counts = np.maximum(np.ceil((hi - lo) / width - 1e-9).astype(int), 1)
    start = (lo + hi - counts * width) / 2
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, cloud.dim)
    fine = _samples(lo, hi, cloud.dim)
    domain = inside_of(cloud)
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    largest, total = 0.0, 0
    for level in range(_LEVELS):
        centres = start + (index + 0.5) * width
        inside = _in_domain(domain, centres, width)
        index, centres = index[inside], centres[inside]
        total += len(index)
        if not len(index) or total > most:
            break
        steps, every = _AWAY * width * _directions(cloud.dim), np.arange(len(index))
        which, offsets = np.repeat(every, len(steps)), np.tile(steps, (len(index), 1))
        if len(fine):
            own = _cell_of(fine, start, width, index)
            fine, own = fine[own >= 0], own[own >= 0]
            which, offsets = np.concatenate([which, own]), np.concatenate([offsets, fine - centres[own]])
        there = centres[which] + offsets
        seen = ((there >= lo) & (there <= hi)).all(axis=1)
        if domain is not None and seen.sum() < _ASKED:
            at = np.flatnonzero(seen)
            seen[at] = ~domain.outside(there[at])
        which, offsets = which[seen], offsets[seen]
        found = data.look(centres, which, offsets, np.full(len(index), width))
        largest = max(largest, float(found.size.max(initial=0.0)))
        allowed = max(part * largest, part * scale / width**data.order)
        split = (found.source > allowed) | (found.coefficient > COEFFICIENT) | (found.wave > _WAVE)
        if level:
            kept.append((centres, np.full(len(centres), width)))
        if not split.any():
            break
        children = np.stack(np.meshgrid(*[[0, 1]] * cloud.dim, indexing="ij"), axis=-1).reshape(-1, cloud.dim)
        index = (2 * index[split][:, None] + children).reshape(-1, cloud.dim)
        width /= 2
    if not kept:
        return np.zeros((0, cloud.dim)), np.zeros(0)
    return np.concatenate([c for c, _ in kept]), np.concatenate([w for _, w in kept])


def _samples(lo: np.ndarray, hi: np.ndarray, dim: int) -> np.ndarray:
    """Points (M, D) of an even lattice in the box, a little disordered."""
    extent = hi - lo
    step = (np.prod(extent) / SAMPLES[dim]) ** (1.0 / dim)
    counts = np.maximum((extent / step).astype(int), 1)
    lattice = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, dim)
    return lo + extent * (lattice + np.random.default_rng(0).uniform(0.1, 0.9, lattice.shape)) / counts


def _directions(dim: int) -> np.ndarray:
    """Offsets (k, D) along the axes, half as far too in 1D, and to the corners."""
    axes = np.concatenate([np.eye(dim), -np.eye(dim)])
    if dim == 1:
        return np.concatenate([axes, 0.5 * axes])
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    return np.concatenate([axes, corners / np.sqrt(dim)])


def _in_domain(domain: Any, centres: np.ndarray, width: float) -> np.ndarray:
    """Which cubes (n,) meet the domain."""
    if domain is None:
        return np.ones(len(centres), bool)
    near = domain.trees[0].query(centres)[0] < width
    rest = np.flatnonzero(~near)
    near[rest] = ~domain.outside(centres[rest]) if len(rest) else False
    return near


def _cell_of(x: np.ndarray, start: np.ndarray, width: float, index: np.ndarray) -> np.ndarray:
    """The place (M,) among the cubes ``index`` of the one that holds each point, -1 for none."""
    at = np.floor((x - start) / width).astype(np.int64)
    base = index.min(axis=0)
    shape = index.max(axis=0) - base + 1
    within = ((at >= base) & (at < base + shape)).all(axis=1)
    code = _code(np.where(within[:, None], at - base, 0), shape)
    known = _code(index - base, shape)
    order = np.argsort(known)
    place = np.minimum(np.searchsorted(known[order], code), len(order) - 1)
    found = order[place]
    return np.where(within & (known[found] == code), found, -1)


def _code(index: np.ndarray, shape: np.ndarray) -> np.ndarray:
    code = np.zeros(len(index), np.int64)
    for k, size in enumerate(shape):
        code = code * int(size) + index[:, k]
    return code
