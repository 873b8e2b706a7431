"""Whether the cloud resolves the operator's coefficients: what neighbours know of each other's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Discretization
from jsmitsm.discretization.parts.whole import whole
from jsmitsm.discretization.resolution.residuals import followed
from jsmitsm.equation.problem import Problem
from jsmitsm.particle.polynomials import monomials_on_host

# A coefficient that changes between neighbours by this part of the larger value jumps.
JUMP = 0.5
# So many particles at a time.
CHUNK = 8192


def steepness(
    disc: Discretization, nums: Numbers, problem: Problem, fitted: Callable[[], np.ndarray], most: float
) -> np.ndarray:  # fmt: skip
    """By how much the coefficients at the nearest neighbours differ from the particles' Taylor polynomials, (N,).

    Each counts as it enters the recursion, scaled by the distance, in parts of the largest. Of degree 0 the
    polynomials are constants. No more than ``most`` where the solution, whose polynomials (N, F, K) ``fitted`` makes,
    follows the equation to the neighbour.
    """
    rec, jac = disc.rec, np.asarray(nums.jac, float)
    power = np.array([[rec.levels[e] - sum(b) - rec.weights[f] for f, b in rec.slots] for e in range(len(rec.levels))])
    worst, steep = np.zeros(len(disc.cloud)), []
    for ids, here, there, offset in _pairs(disc, nums):
        length = np.linalg.norm(offset, axis=1) ** power[..., None]
        t = monomials_on_host(offset.T, rec.degree)
        away = np.abs(np.einsum("estn,tn->esn", jac[..., here], t) - jac[:, :, 0, there]) * length
        size = (np.maximum(np.abs(jac[:, :, 0, there]), np.abs(jac[:, :, 0, here])) * length).max(axis=1)
        part = (away.max(axis=1) / np.where(size > 0, size, 1.0)).max(axis=0)
        bad = np.flatnonzero(part > most)
        if len(bad):
            steep.append((ids[bad], part[bad], nums.ids[there[bad]], offset[bad]))
            part[bad] = most
        worst[ids] = np.maximum(worst[ids], part)
    if whole(disc).most(len(steep)):
        u = fitted()
        for ids, part, near, offset in steep:
            part = np.where(followed(disc, problem, u, ids, near, offset), most, part)
            worst[ids] = np.maximum(worst[ids], part)
    return worst


def unseen(disc: Discretization, nums: Numbers, problem: Problem, fitted: Callable[[], np.ndarray]) -> np.ndarray:
    """Which particles (N,) have a neighbour to which a leading coefficient jumps while both their slopes deny it.

    The recursion knows a coefficient by its derivatives at the particles: of such a jump it knows nothing, nor do the
    rows of a higher order, and the solution is that of another problem; unless it follows the equation all the way.
    """
    rec, jac = disc.rec, np.asarray(nums.jac, float)
    found = np.zeros(len(disc.cloud), bool)
    leading = [s for s, (f, b) in enumerate(rec.slots) if sum(b) + rec.weights[f] == max(rec.levels)]
    pairs = []
    for ids, here, there, offset in _pairs(disc, nums):
        a, b = jac[:, leading, 0][..., here], jac[:, leading, 0][..., there]
        largest = np.maximum(np.abs(a), np.abs(b)).max(axis=1, keepdims=True)
        jumps = (np.abs(a - b) > JUMP * largest) & (largest > 0)
        if jumps.any():
            pairs.append((ids, here, there, offset, jumps))
    if not whole(disc).most(len(pairs)):
        return found
    if rec.degree == 0:
        if not disc.linear:
            return found
        jac = np.asarray(disc.traced.coefficients(np.asarray(disc.cloud.points)[nums.ids], 1, params=problem.params)[0])
    slopes, lost = jac[:, leading, 1 : 1 + rec.dim], []
    for ids, here, there, offset, jumps in pairs:
        change = jac[:, leading, 0][..., there] - jac[:, leading, 0][..., here]
        told = 0.5 * np.einsum("esdn,nd->esn", slopes[..., here] + slopes[..., there], offset)
        bad = np.flatnonzero((jumps & ((change - told) * np.sign(change) > 0.6 * np.abs(change))).any(axis=(0, 1)))
        if len(bad):
            lost.append((ids[bad], nums.ids[there[bad]], offset[bad]))
    if whole(disc).most(len(lost)):
        u = fitted()
        for ids, near, offset in lost:
            found[ids[~followed(disc, problem, u, ids, near, offset)]] = True
    return found


def _pairs(disc: Discretization, nums: Numbers) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Particles with equations and their nearest neighbours that have one: numbers, places in ``nums``, offsets."""
    points, place = np.asarray(disc.points, float), np.full(len(disc.cloud), -1)
    place[nums.ids] = np.arange(len(nums.ids))
    for cls in disc.classes:
        near = np.asarray(cls.neighbours)[:, : 1 + 2 * disc.rec.dim]
        owners = np.asarray(disc.images.owners(near))
        for start, k in product(range(0, len(near), CHUNK), range(1, near.shape[1])):
            some = slice(start, start + CHUNK)
            both = (near[some, k] >= 0) & (place[np.maximum(owners[some, k], 0)] >= 0)
            ids = cls.ids[some][both]
            yield ids, place[ids], place[owners[some, k][both]], points[near[some, k][both]] - points[ids]
