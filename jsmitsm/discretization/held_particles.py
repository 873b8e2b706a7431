"""Expansions of held particles: they carry no equation, yet a nonlinear problem is linearised there too."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.layout import Discretization
from jsmitsm.particle.polynomials import derivative_table, monomials_on_host
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program
from jsmitsm.taylor.multi_indices import index_of, multi_indices

# A polynomial that misses the nearest values by so many times what these differ knows nothing of them.
_ASTRAY = 3.0
# Singular values below this part of the largest say nothing.
_RANK = 1e-6


def held_particles(disc: Discretization) -> np.ndarray:
    """The particles all of whose values are held, but for those that take them from a periodic partner."""
    return np.flatnonzero(disc.held.all(axis=1) & (disc.partner == np.arange(len(disc.cloud))))


def without_astray(disc: Discretization, taylor: Any, values: Any) -> Any:
    """Expansions (N, F, K) of the values (N, F), with quadratic fits for those of held particles that miss what they
    were made of.

    The particles in a tip thinner than the spacing all but stand on a line. What their polynomials do across it is
    round-off, and nothing asks for it but who looks there.
    """
    ids = held_particles(disc)
    if is_traced(taylor, values, disc.points) or not len(ids):
        return taylor
    points, known = np.asarray(disc.points, float), np.asarray(disc.images.extend_values(values), float)
    near = np.asarray(disc.stencils.indices)[ids]
    near = np.where(near >= 0, near, ids[:, None])
    nearest = near[:, 1 : 1 + 2 * disc.rec.dim]
    offset = points[nearest] - points[ids][:, None]
    powers = monomials_on_host(offset.reshape(-1, disc.rec.dim).T, disc.rec.reach).T.reshape(*nearest.shape, -1)
    off = np.einsum("nkt,nft->nkf", powers, np.asarray(taylor)[ids]) - known[nearest]
    change = known[nearest] - known[ids][:, None]
    away = nearest != ids[:, None]
    astray = (np.abs(off * away[..., None]).max(axis=1) > _ASTRAY * np.abs(change).max(axis=1)).any(axis=1)
    out = np.array(taylor) if astray.any() else taylor
    degree = min(2, disc.rec.reach)
    for i, around in zip(ids[astray], near[astray]):
        scale = np.abs(points[around] - points[i]).max()
        way = (points[around] - points[i]) / scale
        terms = monomials_on_host(way.T, degree).T
        found = np.linalg.lstsq(terms[:, 1:], known[around] - known[i], rcond=_RANK)[0]
        degrees = np.array([sum(a) for a in multi_indices(disc.rec.dim, degree)])[1:]
        out[i] = 0.0
        out[i, :, 0], out[i, :, 1 : len(terms[0])] = known[i], (found / scale ** degrees[:, None]).T
    return out


def with_held_expansions(disc: Discretization, taylor: Any) -> Any:
    """Expansions (N, F, K) with those of the held particles continued from their nearest neighbours that have one.

    They have the accuracy of the expansions that they continue, so that what is linearised at them differs from what
    is linearised at the solution by their error squared. A particle without such a neighbour keeps what it has.
    """
    ids = held_particles(disc)
    if not len(ids):
        return taylor
    near = disc.stencils.indices[ids]
    given = ~disc.held.all(axis=1)
    return _continued(taylor, disc.points, ids, near, disc.images.owners(near), given, disc.partner, disc.rec.reach)


@partial(in_one_program, static=("order",))
def _continued(
    taylor: Any, points: Any, ids: np.ndarray, near: Any, owners: Any, given: np.ndarray, partner: np.ndarray,
    order: int,
) -> Any:  # fmt: skip
    traced = is_traced(taylor, points, near)
    xp: Any = jnp if traced else np
    owners = xp.asarray(partner)[xp.maximum(owners, 0)]
    offset = xp.asarray(points)[ids][:, None] - xp.asarray(points)[xp.maximum(near, 0)]
    square = xp.sum(jax.lax.stop_gradient(offset) ** 2 if traced else offset**2, axis=2)
    square = xp.where((near >= 0) & xp.asarray(given)[owners], square, xp.inf)
    nearest = xp.argmin(square, axis=1)[:, None]
    found = xp.isfinite(xp.take_along_axis(square, nearest, axis=1))[:, :, None]
    source = xp.asarray(taylor)[xp.take_along_axis(owners, nearest, axis=1)[:, 0]]
    moved = _recentred(source, xp.take_along_axis(offset, nearest[..., None], axis=1)[:, 0], order)
    moved = xp.where(found, moved, xp.asarray(taylor)[ids])
    if traced:
        return jnp.asarray(taylor).at[ids].set(moved)[partner]
    out = np.array(taylor)
    out[ids] = moved
    return out[partner]


def _recentred(taylor: Any, offset: Any, order: int) -> Any:
    """The same polynomials (n, F, K) about points ``offset`` (n, D) away."""
    xp: Any = jnp if is_traced(taylor, offset) else np
    dim, powers, out = offset.shape[1], _powers(offset, order), []
    for b in multi_indices(dim, order):
        lower, factor = derivative_table(dim, order, b)
        scale = 1.0 / math.prod(map(math.factorial, b))
        out.append(xp.einsum("nfk,nk->nf", taylor, powers[:, lower] * (factor * scale)))
    return xp.stack(out, axis=2)


def _powers(offset: Any, order: int) -> Any:
    """All monomials (n, K) of offsets (n, D)."""
    place = index_of(offset.shape[1], order)
    columns = [1.0 + 0.0 * offset[:, 0]]
    for a in list(place)[1:]:
        axis = next(k for k, n in enumerate(a) if n)
        columns.append(columns[place[tuple(n - (k == axis) for k, n in enumerate(a))]] * offset[:, axis])
    return (jnp if is_traced(offset) else np).stack(columns, axis=1)
