"""What the particles do not see of an evolution: of its start, and of what jumps between them later.

No order tells, and of the start no later time: what was not sampled is not carried on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.cloud.sight.walls import nearest_seen
from jsmitsm.discretization.layout import Discretization
from jsmitsm.discretization.regions.layout import Regions
from jsmitsm.evolution.arguments import sampled
from jsmitsm.evolution.space.local_fits import StateFit
from jsmitsm.evolution.space.semidiscrete import Semidiscrete
from jsmitsm.particle.polynomials import monomials_on_host
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.taylor.multi_indices import factorial, index_of

# The degree of the polynomials that the start is compared with, and what differs by much, in parts of the largest
# value: four particles a wavelength leave a fortieth, a jump a half.
DEGREE, MUCH = 4, 0.1
# Halfway between two particles what jumps is off the mean of both by half of the jump; the largest anywhere counts.
LARGE = 0.2


def unseen_start(u0: Any, values: Any, cloud: Cloud, semi: Semidiscrete) -> float:
    """The part of the start, a function of x with ``values`` (N, F) at the particles, that these do not see.

    The local polynomials of the values are compared with it halfway to the nearest neighbours. Those that differ by
    much are taken to be off by chance, each for the volume that it has: in a sum over the domain the squares add up.
    Zero for arrays, in several regions, and where JAX traces.
    """
    u0 = u0[0] if semi.second and isinstance(u0, (tuple, list)) else u0
    if not callable(u0) or isinstance(cloud, RegionCloud) or len(cloud) < 3 or is_traced(values, cloud):
        return 0.0
    values, points = np.asarray(values), np.asarray(cloud.points)
    dim = cloud.dim
    near, count = _nearest(semi.disc)
    offset = 0.5 * (points[near] - points[:, None])
    half = (points[:, None] + offset).reshape(-1, dim)
    there = np.asarray(sampled(u0, half, values.shape[1])).reshape(*near.shape, -1)
    much = MUCH * np.abs(values).max(axis=0)
    if not (np.abs(there - 0.5 * (values[:, None] + values[near])) > much).any():
        return 0.0
    powers = monomials_on_host(offset.reshape(-1, dim).T, DEGREE).T.reshape(*near.shape, -1)
    away = there - np.einsum("nkt,nft->nkf", powers, np.asarray(semi.state_fit(DEGREE).coefficients(values)))
    away = np.where(np.abs(away) > much, away, 0.0).sum(axis=1) / (1 + count)[:, None]
    volume = (2.0 * np.linalg.norm(offset, axis=2).sum(axis=1) / np.maximum(count, 1)) ** dim
    whole = np.abs(values).T @ volume
    part = np.sqrt(np.square(away * volume[:, None]).sum(axis=0)) / np.where(whole > 0, whole, np.inf)
    return float(part.max(initial=0.0))


def looker(semi: Semidiscrete) -> StateFit | None:
    """What gives states the derivatives that the equation has; None where nothing of it may jump, or have a kink."""
    if isinstance(semi.disc, Regions):
        return None
    if not any(record.kinked for record in (semi.timed.space, semi.timed.apart, *semi.timed.masses)):
        return None
    return semi.state_fit(max((sum(b) for _, b in semi.timed.space.slots), default=0) + DEGREE)


def left_between(
    semi: Semidiscrete, fits: StateFit, u: np.ndarray, rates: Sequence[np.ndarray], t: float
) -> np.ndarray:  # fmt: skip
    """What the equation lacks at the particles for what jumps between them and their nearest neighbours, (N F,).

    fits: the ``looker``; u (N, F), rates: those of first (and second) order. The residual at a particle's own
    derivatives, halfway to a neighbour, against the mean of what it is at both ends: where that is much, the mean over
    its neighbours.
    """
    points, at = np.asarray(semi.points), (np.asarray(t), semi.params)
    record, place = semi.timed.space, index_of(points.shape[1], fits.degree)
    terms = np.asarray(fits.coefficients(u))
    slots = np.stack([terms[:, k, place[b]] * factorial(b) for k, b in record.slots]) if record.slots else None

    def residual(x: np.ndarray) -> np.ndarray:
        found = np.broadcast_to(record.residuals(x, params=at, slots=slots), (semi.fields, len(x))).T
        for j, rate in enumerate((u, *rates)):  # u itself where the equation has it with a factor alone
            found = found + np.einsum("nef,nf->ne", semi.timed.mass(j, x, at), rate)
        return found

    near, count = _nearest(semi.disc)
    own, total = residual(points), np.zeros((len(points), semi.fields))
    for other in near.T:
        there = residual(points[other])
        away = residual(0.5 * (points + points[other])) - 0.5 * (own + there)
        total += np.where(np.abs(away) > LARGE * np.abs(there - own).max(axis=0), away, 0.0)
    return (total / (1 + count)[:, None]).reshape(-1)


def _nearest(disc: Discretization) -> tuple[np.ndarray, np.ndarray]:
    """The nearest neighbours (N, k) that particles see, two along each axis, and how many (N,) there are.

    Across a gap there is none: halfway to it lies no part of the domain. For want of one a particle is its own.
    """
    points = np.asarray(disc.cloud.points, float)
    size = min(2 * points.shape[1] + 1, len(points))
    near = np.asarray(nearest_seen(points, size, None, disc.walls).indices)[:, 1:size]
    return np.where(near >= 0, near, np.arange(len(points))[:, None]), (near >= 0).sum(axis=1)
