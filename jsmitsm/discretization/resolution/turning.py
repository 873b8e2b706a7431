"""How fast source and coefficients turn within a stencil, as waves do: what tells how deep a recursion pays."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import reaches
from jsmitsm.discretization.parts.whole import Part, Whole
from jsmitsm.discretization.supports import default_size
from jsmitsm.equation.traced import Traced
from jsmitsm.particle.elimination import Scheme
from jsmitsm.particle.recursion import Recursion
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.taylor.multi_indices import count, factorial, multi_indices

# Particles that are looked at, and the degree of their series: fourth derivatives tell waves from slopes.
LOOKED_AT, DEGREE = 128, 4
# Up to so many particles of a constant operator their series are taken, of the depth that most problems have.
FEW, USUAL = 1000, 4
# Of so many their distances are found. In corners supports are twice as large as elsewhere; by more than the second
# number they differ where the cloud is graded, and the large ones decide.
MOST, EVEN = 16384, 3.0


class Turning(NamedTuple):
    """Angles by which waves turn within a support that grow from degree to degree as these do.

    source : the source; coefficients : those of the operator, in parts of its leading ones; reaction, carried : the
    waves (or layers) that terms without a derivative, or with fewer than the leading ones, make of constants.
    """

    source: float
    coefficients: float
    reaction: float
    carried: float


def turning(
    rec: Recursion, traced: Traced, cloud: Cloud, params: Any, held: list[np.ndarray], part: Part | None = None
) -> Turning | None:
    """The angles within a support of usual size.

    None where nothing can be known of them beforehand, or where supports are of very different sizes. held: the
    particles whose values are given, group by group.
    """
    points = concrete(cloud.points)
    if rec.fields > 1 or points is None or not traced.linear or traced.kinked_source:
        return None
    if any(concrete(x) is None for x in jax.tree.leaves((traced, params))):
        return None
    if is_traced(traced, params):  # what only carries derivatives changes nothing
        traced, params = jax.tree.map(concrete, (traced, params))
    points = np.asarray(points)
    sample, radius = _sample(points, default_size(Scheme("S", rec), True), part)
    if radius is None:
        return None
    degree = DEGREE
    if few(traced, cloud, part):  # the very series that are used afterwards, and remembered until then
        sample, degree = _free(points, held, part), rec.degree + USUAL
    jac, residual = traced.coefficients(sample, degree, params=params)
    source = np.zeros(2) if residual is None else _sizes(rec.dim, np.asarray(residual)[0], radius)
    lower = np.array([rec.orders[0] - sum(b) for _, b in rec.slots])
    start, end = np.array([_sizes(rec.dim, np.asarray(c), radius) for c in jac[0]]).T * radius**lower
    lead = start[lower == 0].max(initial=0.0)
    if not (lead > 0 and np.isfinite([*source, *start, *end]).all()):
        return None
    waves = (start / lead) ** (1.0 / np.maximum(lower, 1))
    plain = lower == rec.orders[0]
    return Turning(
        _angle(*source), _angle(lead, end.max()), waves[plain].max(initial=0.0),
        waves[~plain & (lower > 0)].max(initial=0.0),
    )  # fmt: skip


def few(traced: Traced, cloud: Cloud, part: Part | None) -> bool:
    """Whether one evaluation of a source more takes longer than some degrees less would save."""
    return traced.constant and (len(cloud) if part is None else part.count) <= FEW


def _sample(points: np.ndarray, size: int, part: Part | None) -> tuple[np.ndarray, float | None]:
    """Some particles, and the radius of the supports of this size; None where they differ."""
    n = len(points) if part is None else part.count
    every = lambda step: Whole(part).every(points, step)
    sample, step = every(-(-n // LOOKED_AT)), -(-n // MOST)
    radius = reaches(every(step), sample[::2], size) / step ** (1.0 / points.shape[1])
    middle = float(np.median(radius))
    return sample, middle if radius.max() < EVEN * middle else None


def _free(points: np.ndarray, held: list[np.ndarray], part: Part | None) -> np.ndarray:
    """All particles of the whole cloud whose values are not given."""
    free = np.ones(len(points), bool)
    for ids in held:
        free[ids] = False
    return points[free] if part is None else np.concatenate(part.gather(points[free & part.own]))


def _sizes(dim: int, series: np.ndarray, radius: float) -> tuple[float, float]:
    """Root mean squares, within the radius, of the values and of the terms of the highest degree: series (T, n)."""
    start = float(np.sqrt(np.mean(series[0] ** 2)))
    if len(series) == 1:
        return start, 0.0
    first, shares = _highest(dim)
    return start, float(np.sqrt(shares @ np.mean(series[first : first + len(shares)] ** 2, axis=1))) * radius**DEGREE


@lru_cache
def _highest(dim: int) -> tuple[int, np.ndarray]:
    """Where the terms of the degree begin, and the part a! / n! that each has in the size of them all."""
    indices = [a for a in multi_indices(dim, DEGREE) if sum(a) == DEGREE]
    return count(dim, DEGREE - 1), np.array([factorial(a) / math.factorial(DEGREE) for a in indices])


def _angle(start: float, end: float) -> float:
    """Of sin(k x), whose terms are (k r)^n / n!, it is k r."""
    return (math.factorial(DEGREE) * end / start) ** (1.0 / DEGREE) if start > 0 else 0.0
