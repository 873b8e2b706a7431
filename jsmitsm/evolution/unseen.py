"""What the particles do not see of an evolution: of its start, and of what jumps between them, or across a seam.

No order tells, and of the start no later time: what was not sampled is not carried on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
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
from jsmitsm.evolution.steps import dense_output
from jsmitsm.particle.polynomials import monomials_on_host
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.taylor.multi_indices import factorial, index_of

# The degree of the polynomials that the start is compared with, and what differs by much, in parts of the largest
# value: four particles a wavelength leave a fortieth, a jump a half.
DEGREE, MUCH = 4, 0.1
# Halfway between two particles what jumps is off the mean of both by half of the jump; the largest anywhere counts.
LARGE = 0.2
# What differs by less than this part across a seam is round-off. So many states of a run are looked at there.
SAME, ENDS = 1e-9, 3


def unseen_start(u0: Any, values: Any, cloud: Cloud, semi: Semidiscrete) -> float:
    """The part of the start, a function of x with ``values`` (N, F) at the particles, that these do not see.

    The local polynomials of the values are compared with it halfway to the nearest neighbours. Those that differ by
    much are taken to be off by chance, each for the volume that it has: in a sum over the domain the squares add up.
    What jumps from one side of a periodic pair to the other is half of the jump off, all along the seam. Of arrays
    nothing else is known; zero in several regions, and where JAX traces.
    """
    u0 = u0[0] if semi.second and isinstance(u0, (tuple, list)) else u0
    if isinstance(cloud, RegionCloud) or len(cloud) < 3 or is_traced(values, cloud):
        return 0.0
    values, points = np.asarray(values), np.asarray(cloud.points)
    jumps = _start_at_seams(values, semi.disc)
    if not callable(u0):
        return jumps
    dim = cloud.dim
    near, count = _nearest(semi.disc)
    offset = 0.5 * (points[near] - points[:, None])
    half = (points[:, None] + offset).reshape(-1, dim)
    there = np.asarray(sampled(u0, half, values.shape[1])).reshape(*near.shape, -1)
    much = MUCH * np.abs(values).max(axis=0)
    if not (np.abs(there - 0.5 * (values[:, None] + values[near])) > much).any():
        return jumps
    powers = monomials_on_host(offset.reshape(-1, dim).T, DEGREE).T.reshape(*near.shape, -1)
    away = there - np.einsum("nkt,nft->nkf", powers, np.asarray(semi.state_fit(DEGREE).coefficients(values)))
    away = np.where(np.abs(away) > much, away, 0.0).sum(axis=1) / (1 + count)[:, None]
    volume = (2.0 * np.linalg.norm(offset, axis=2).sum(axis=1) / np.maximum(count, 1)) ** dim
    whole = np.abs(values).T @ volume
    part = np.sqrt(np.square(away * volume[:, None]).sum(axis=0)) / np.where(whole > 0, whole, np.inf)
    return max(float(part.max(initial=0.0)), jumps)


def _start_at_seams(values: np.ndarray, disc: Discretization) -> float:
    """The part of a start (N, F) that is lost at periodic pairs, whose second particles take the values of the first.

    Those were to have the mean of both, each for the volume that it has.
    """
    aside, owner = _beyond_seams(disc)
    gap = values[aside] - values[owner]
    gap = np.where(np.abs(gap) > MUCH * np.abs(values).max(axis=0), gap, 0.0)
    if not gap.any():
        return 0.0
    points, (near, count) = np.asarray(disc.cloud.points), _nearest(disc)
    away = np.linalg.norm(points[near] - points[:, None], axis=2).sum(axis=1)
    volume = (away / np.maximum(count, 1)) ** points.shape[1]
    sides = 1 + np.bincount(owner, minlength=len(points))[owner]
    lost = np.abs((gap * (volume[owner] / sides)[:, None]).sum(axis=0))
    own = disc.partner == np.arange(len(points))
    whole = np.abs(values[own]).T @ volume[own]
    return float((lost / np.where(whole > 0, whole, np.inf)).max())


def _beyond_seams(disc: Discretization) -> tuple[np.ndarray, np.ndarray]:
    """The particles of second groups of periodic pairs, and those whose values they take."""
    aside = np.flatnonzero(disc.partner != np.arange(len(disc.cloud)))
    return aside, disc.partner[aside]


def looker(semi: Semidiscrete, times: Iterable[float]) -> StateFit | None:
    """What gives states the derivatives that the equation has; None where nothing of it may jump, or have a kink."""
    if isinstance(semi.disc, Regions):
        return None
    return _fits(semi) if _kinked(semi) or differs_at_seams(semi, times) else None


def _fits(semi: Semidiscrete) -> StateFit:
    return semi.state_fit(max((sum(b) for _, b in semi.timed.space.slots), default=0) + DEGREE)


def _kinked(semi: Semidiscrete) -> bool:
    return any(record.kinked for record in (semi.timed.space, semi.timed.apart, *semi.timed.masses))


def differs_at_seams(semi: Semidiscrete, times: Iterable[float]) -> bool:
    """Whether the equation of any state is another on the other side of a periodic pair, at one of the times."""
    if isinstance(semi.disc, Regions):
        return False
    aside, owner = _beyond_seams(semi.disc)
    if not len(aside):
        return False
    points, record = np.asarray(semi.points), semi.timed.space
    slots = np.random.default_rng(0).normal(size=(len(record.slots), 1)) * np.ones(len(aside))
    for t in times:
        at = (np.asarray(t), semi.params)

        def known(x: np.ndarray, at: Any = at) -> np.ndarray:
            found = np.asarray(record.residuals(x, params=at, slots=slots if record.slots else None))
            masses = [np.asarray(semi.timed.mass(j, x, at)) for j in range(len(semi.timed.masses) + 1)]
            rows = [np.broadcast_to(found, (semi.fields, len(x))).T, *(m.reshape(len(x), -1) for m in masses)]
            return np.concatenate(rows, axis=1)

        one, other = known(points[owner]), known(points[aside])
        if (np.abs(other - one) > SAME * np.abs(one).max(axis=0, initial=1e-300)).any():
            return True
    return False


def made_at_seams(
    semi: Semidiscrete, history: tuple[np.ndarray, np.ndarray], rates: np.ndarray | None
) -> np.ndarray | None:  # fmt: skip
    """What an equation that is another beyond a seam makes of free values (n,) of a run; None where it is not.

    history: times and values of the steps; rates: theirs, of second order in time. Looked at in a few states, each as
    if it drove all of the run.
    """
    steps, values = history
    looks = np.linspace(steps[0], steps[-1], ENDS)
    if len(steps) < 2 or not differs_at_seams(semi, looks):
        return None
    span, fits, found = float(steps[-1] - steps[0]), _fits(semi), np.zeros(semi.system.n)
    for t in map(float, looks):
        state = [dense_output.derivative(steps, of, t, j) for of in (values, rates) if of is not None for j in (0, 1)]
        left = _left_at_seams(semi, *_residual(semi, fits, state[0], state[-2 if semi.second else -1 :], t))
        force = np.asarray(semi.system.force(semi.source.host @ left))
        made = np.asarray(semi.system.resolvent(span).solve(span * force))[: semi.system.n]
        found = np.maximum(found, np.abs(made))
    return found


def left_between(
    semi: Semidiscrete, fits: StateFit, u: np.ndarray, rates: Sequence[np.ndarray], t: float
) -> np.ndarray:  # fmt: skip
    """What the equation lacks at the particles for what jumps between them and their nearest neighbours, (N F,).

    fits: the ``looker``; u (N, F), rates: those of first (and second) order. The residual at a particle's own
    derivatives, halfway to a neighbour, against the mean of what it is at both ends: where that is much, the mean over
    its neighbours. What jumps across the seam of a periodic pair is off its mean by a half at the first one's side.
    """
    residual, own = _residual(semi, fits, u, rates, t)
    return _left_at_seams(semi, residual, own) + (_left_halfway(semi, residual, own) if _kinked(semi) else 0.0)


def _residual(
    semi: Semidiscrete, fits: StateFit, u: np.ndarray, rates: Sequence[np.ndarray], t: float
) -> tuple[Callable[..., np.ndarray], np.ndarray]:  # fmt: skip
    """The residual of the particles' own derivatives at other points, of all or some of them, and at their own."""
    points, at = np.asarray(semi.points), (np.asarray(t), semi.params)
    record, place = semi.timed.space, index_of(points.shape[1], fits.degree)
    terms = np.asarray(fits.coefficients(u))
    slots = np.stack([terms[:, k, place[b]] * factorial(b) for k, b in record.slots]) if record.slots else None

    def residual(x: np.ndarray, of: Any = slice(None)) -> np.ndarray:
        some = None if slots is None else slots[..., of]
        found = np.broadcast_to(record.residuals(x, params=at, slots=some), (semi.fields, len(x))).T
        for j, rate in enumerate((u, *rates)):  # u itself where the equation has it with a factor alone
            found = found + np.einsum("nef,nf->ne", semi.timed.mass(j, x, at), rate[of])
        return found

    return residual, residual(points)


def _left_at_seams(semi: Semidiscrete, residual: Callable[..., np.ndarray], own: np.ndarray) -> np.ndarray:
    """That at the first particles of periodic pairs, for what their second ones would have, (N F,)."""
    aside, owner = _beyond_seams(semi.disc)
    total = np.zeros(own.shape)
    if len(aside):
        away = residual(np.asarray(semi.points)[aside], owner) - own[owner]
        away[~np.isfinite(away)] = 0.0
        np.add.at(total, owner, away / (1 + np.bincount(owner, minlength=len(own))[owner])[:, None])
    return total.reshape(-1)


def _left_halfway(semi: Semidiscrete, residual: Callable[..., np.ndarray], own: np.ndarray) -> np.ndarray:
    """That of what jumps between neighbours, (N F,)."""
    points, (near, count) = np.asarray(semi.points), _nearest(semi.disc)
    total = np.zeros(own.shape)
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
