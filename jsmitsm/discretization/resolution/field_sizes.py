"""How much the fields of a system differ in size: a potential in volts beside a concentration in particles per cubic
metre.

The fit of a particle mixes all fields, as they stand: of what it cannot meet, each has a part that rests on its unit.
Where one is larger than another by some digits, the smaller takes its errors, and is lost beside what rounding leaves
of the larger. So each field is taken in a unit of about its own size. Measured: right to a factor of 4 it costs
nothing, of 64 two digits. The unit is a power of 4, so that other numbers of the same problem seldom ask for other
programs, and there is none where fields are within ten times one another.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.discretization.parts.whole import Part, Whole
from jsmitsm.equation.conditions import Group
from jsmitsm.equation.traced import Traced
from jsmitsm.particle.recursion import Recursion
from jsmitsm.runtime.tracers import concrete, is_traced

# Fields within this ratio of one another keep their units; where the problem is nonlinear, of which the boundary values
# tell less, within the second.
ALIKE, ALIKE_THERE = 10.0, 1e3
# Units are powers of two to this.
STEP = 2
# A field that is held keeps the size of these values, unless others make it larger than them by this.
FAR = 8.0
# Particles whose coefficients are looked at.
LOOKED_AT = 32


def field_sizes(
    rec: Recursion, traced: Traced, cloud: Cloud, params: Any, groups: list[Group], part: Part | None = None
) -> tuple[float, ...]:
    """A unit for every field; empty where they may keep their own, and where nothing can be known beforehand.

    A field is as large as its boundary values, or, in a linear problem, as what the sources and the other fields make
    of it across the domain, where that is much more.
    """
    if rec.fields == 1:
        return ()
    points = concrete(cloud.points)
    if points is None or any(concrete(x) is None for x in jax.tree.leaves((traced, params))):
        return ()
    if is_traced(traced, params):  # what only carries derivatives changes nothing
        traced, params = jax.tree.map(concrete, (traced, params))
    whole, points = Whole(part), np.asarray(points)
    low, high = -whole.most(-points.min(axis=0)), whole.most(points.max(axis=0))
    halfway = 0.5 * float((high - low).max())
    given = _given(rec, groups, halfway)
    if whole.most(float(given is None)):
        return ()
    held, joined = map(whole.most, given or ())
    sizes, vectors = held, _vectors(rec, joined > 0)
    if traced.linear:
        count = len(points) if part is None else part.count
        some = whole.every(points, max(1, count // LOOKED_AT))
        sizes = _made(rec, *_terms(rec, traced, some, params, halfway), held, vectors)
    sizes = np.where(vectors, sizes, 0.0).max(axis=1)
    sizes = np.where((sizes > 0) & np.isfinite(sizes) & (np.array(rec.weights) == 0), sizes, np.nan)
    alike = ALIKE if traced.linear else ALIKE_THERE
    if not np.isfinite(sizes).any() or np.nanmax(sizes) <= alike * np.nanmin(sizes):
        return ()
    # The largest keeps its unit, and so does one of which nothing is known.
    steps = np.round(np.log2(np.nan_to_num(sizes / np.nanmax(sizes), nan=1.0)) / STEP)
    return tuple(float(x) for x in np.exp2(STEP * steps)) if steps.any() else ()


def _vectors(rec: Recursion, joined: np.ndarray) -> np.ndarray:
    """Which fields (F, F) are parts of one vector: those of which one condition speaks, and the velocities of a flow,
    of which the equation of a lower order does."""
    full, out = np.array(rec.weights) == 0, joined | np.eye(rec.fields, dtype=bool)
    for e, order in enumerate(rec.orders if any(rec.weights) else ()):
        if order < max(rec.orders):
            of = np.array([f for s, (f, _) in enumerate(rec.slots) if rec.pattern[e][s] and full[f]], int)
            out[np.ix_(of, of)] = True
    return np.linalg.matrix_power(out.astype(float), rec.fields) > 0


def _given(rec: Recursion, groups: list[Group], length: float) -> tuple[np.ndarray, np.ndarray] | None:
    """The largest size (F,) that conditions give to each field, and which fields (F, F) one condition speaks of.

    None where a condition's numbers are not known before the solve.
    """
    sizes, joined = np.zeros(rec.fields), np.zeros((rec.fields,) * 2, bool)
    for group in groups:
        for k, values in group.held.items():
            if (given := concrete(values())) is None:
                return None
            sizes[k] = max(sizes[k], _magnitudes(given).max(initial=0.0))
        for part in group.parts:
            numbers = [concrete(x) for x in part.numbers(None)] if part.linear else [None]
            if any(x is None for x in numbers):
                return None
            coef, value = map(_magnitudes, numbers)
            terms = (coef * [length ** -sum(b) for _, b in part.slots]).sum(axis=-1)
            size = np.median(value / np.where(terms > 0, terms, np.inf), axis=0).max(initial=0.0)
            fields = sorted({f for f, _ in part.slots})
            joined[np.ix_(fields, fields)] = True
            sizes[fields] = np.maximum(sizes[fields], size)
    return sizes, joined


def _magnitudes(values: Any) -> np.ndarray:
    """Absolute values; nothing where one is not finite, which is refused where it is used."""
    size = np.abs(np.asarray(values))
    return np.where(np.isfinite(size), size, 0.0)


def _terms(
    rec: Recursion, traced: Traced, points: np.ndarray, params: Any, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """What a field of size one, that changes within a length, adds to each equation (E, F), and the size of each
    source (E,): medians."""
    jac = np.median(_magnitudes(traced.leading(points, params)), axis=-1)
    out = np.zeros((len(rec.levels), rec.fields))
    for s, (f, b) in enumerate(rec.slots):
        out[:, f] += jac[:, s] * length ** -float(sum(b))
    return out, np.median(_magnitudes(traced.residuals(points, params=params)), axis=-1)


def _made(rec: Recursion, terms: np.ndarray, source: np.ndarray, held: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """The sizes (F,) of fields, from what their equations make of the sources, of the values held and of one another.

    Fields that drive one another without end, as the two parts of a wave do, are made no larger by that.
    """
    from scipy.optimize import linear_sum_assignment

    free = np.flatnonzero(np.array(rec.weights) == 0)
    row = terms[:, free].max(axis=1, initial=0.0)
    part = terms[:, free] / np.where(row > 0, row, 1.0)[:, None]
    leads = np.zeros(terms.shape)
    for s, (f, b) in enumerate(rec.slots):
        leads[[rec.pattern[e][s] and sum(b) == m for e, m in enumerate(rec.orders)], f] = 1.0
    # An equation is about a field that leads it; that of a flow's divergence, of lower order, is about the pressure.
    worth = np.log(np.maximum(part, 1e-300)) + 1e3 * leads[:, free] + 1e4 * np.array(rec.orders)[:, None]
    equations, fields = linear_sum_assignment(worth, maximize=True)
    fields = free[fields]
    own = terms[equations, fields]
    own = np.where(own > 0, own, np.inf)
    sizes = held.copy()
    sizes[fields] = np.maximum(sizes[fields], source[equations] / own)
    gain = np.zeros((rec.fields,) * 2)
    gain[fields] = terms[equations] / own[:, None]
    gain[:, np.array(rec.weights) != 0] = 0.0
    gain[vectors] = np.maximum(gain[vectors], 1.0)
    np.fill_diagonal(gain, 0.0)
    gain /= max(1.0, float(np.abs(np.linalg.eigvals(gain)).max(initial=0.0)))
    if not sizes.any():
        sizes[fields[0]] = 1.0
    for _ in range(rec.fields):
        sizes = np.maximum(sizes, (gain * sizes).max(axis=1))
    return np.where((held > 0) & (sizes < FAR * held), held, sizes)
