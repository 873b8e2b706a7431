"""By how much the local polynomials of neighbours part halfway between them."""

from __future__ import annotations

import numpy as np

from jsmitsm.particle.polynomials import monomials_on_host
from jsmitsm.runtime.errors import SolveError
from jsmitsm.solution.solution import Solution
from jsmitsm.taylor.multi_indices import multi_indices


def gaps(sol: Solution) -> np.ndarray | None:
    """By how much the polynomials of neighbours differ halfway between them (N,); None where they cannot be had.

    What happens within a spacing, unseen by the particles, parts them: a layer at a wall, for instance. Across the seam
    of a periodic pair the neighbours are images; particles that take their values from partners part as these do.
    """
    try:
        found = np.asarray(sol.coefficients, float)
    except (ValueError, SolveError):
        return None  # a source that is infinite on the boundary
    found = found.reshape(*found.shape[:2], -1)
    points, dim = np.asarray(sol.cloud.points), sol.cloud.dim
    near = sol.neighbours[:, 1 : 2 * dim + 1]  # those across a slit are none
    owner = partner = np.arange(len(points))
    there = points
    if (near >= len(points)).any():
        disc = sol._fit.discretization()
        there, partner = np.asarray(disc.images.extend(points)), disc.partner
        owner = np.concatenate([owner, disc.images.owner])
        # Stencils of particles that have a partner are no neighbourhoods: nobody is to reach them.
        near = np.where((partner == np.arange(len(points)))[:, None], near, -1)
    near = np.where((near >= 0) & (near < len(there)), near, np.arange(len(points))[:, None])
    odd = np.array([(-1.0) ** sum(a) for a in multi_indices(dim, sol.order + sol.depth)])
    worst = np.zeros(len(points))
    for k in range(near.shape[1]):
        powers = monomials_on_host(0.5 * (there[near[:, k]] - points).T, sol.order + sol.depth).T
        apart = np.einsum("nk,nkf->nf", powers, found) - np.einsum("nk,nkf->nf", odd * powers, found[owner[near[:, k]]])
        worst = np.maximum(worst, np.abs(apart).max(axis=1))
    worst = worst[partner]
    return worst if np.isfinite(worst).all() else None
