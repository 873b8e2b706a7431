"""Where Newton's method starts: values, and polynomials fitted to them over the stencils."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.coefficients import held_values
from jsmitsm.discretization.layout import Discretization
from jsmitsm.equation.conditions import sample
from jsmitsm.equation.problem import Problem
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.taylor.multi_indices import multi_indices

# Scattered neighbours determine so many polynomials each; on a line every one of them determines one.
_EACH = 0.7
# Relative to the moment matrix: what its neighbours do not determine of a polynomial stays zero.
_RIDGE = 1e-10
# Particles that are fitted together.
_PIECE = 4096


def start(disc: Discretization, problem: Problem, u0: Any) -> tuple[Any, Any]:
    """Values (N, F) and expansions (N, F, K) of ``u0``; flat ones where it is None."""
    n, fields = disc.held.shape
    if u0 is None:
        values = np.zeros((n, fields))
    elif isinstance(u0, Mapping):
        points, ids = disc.cloud.points, disc.cloud.regions  # type: ignore[attr-defined]
        parts = [_values(u0[name], points[ids[name]], problem, f"u0[{name!r}]") for name in ids]
        xp: Any = jnp if is_traced(parts) else np
        values = xp.concatenate(parts)[np.argsort(np.concatenate(list(ids.values())))]
    else:
        values = _values(u0, disc.cloud.points, problem, "u0")
    values = jax.lax.stop_gradient(values)
    if concrete(values) is None or is_traced(disc.stencils.indices):
        return values, jnp.zeros((n, fields, disc.rec.size)).at[:, :, 0].set(values)
    given = np.asarray(concrete(values))
    return given, fitted(disc, given)


def _values(given: Any, points: Any, problem: Problem, where: str) -> Any:
    """A function, an array or a number as values (n, F)."""
    shape = len(points), problem.fields
    if callable(given):
        return sample(given, jax.lax.stop_gradient(points), problem.params, problem.fields, where).T
    if np.ndim(given) == 0:
        return jnp.full(shape, given, float) if is_traced(given) else np.full(shape, float(given))
    return (given if is_traced(given) else np.asarray(given, float)).reshape(shape)


def harmonic(disc: Discretization) -> tuple[np.ndarray, np.ndarray] | None:
    """What ``start`` gives for values that spread from the held ones into the cloud; None where that is flat.

    Every value is the mean of its neighbours', which for linear data on a lattice is the linear function, on an
    interface of those on both sides.
    """
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    near = disc.stencils.indices
    if is_traced(near, disc.points):
        return None
    held = concrete(held_values(disc))
    if held is None:
        return None
    held = np.asarray(held)
    points, near, n = np.asarray(disc.points), np.asarray(near), len(held)
    away = np.where(near >= 0, np.linalg.norm(points[np.maximum(near, 0)] - points[:n, None], axis=2), np.inf)
    nearest = np.argsort(away, axis=1, kind="stable")[:, : 1 + 2 * disc.rec.dim]
    near = disc.images.owners(np.take_along_axis(near, nearest, axis=1))
    at, others = np.repeat(np.arange(n), near.shape[1]), near.reshape(-1)
    keep = (others >= 0) & (others != at)
    at, others = at[keep], others[keep]
    for pairs in getattr(disc.cloud, "interfaces", {}).values():
        at, others = np.concatenate([at, *pairs.T]), np.concatenate([others, *pairs.T[::-1]])
    mean = sparse.csr_array((np.ones(len(at)), (at, others)), shape=(n, n))
    laplace = (sparse.diags_array(mean.sum(axis=1)) - mean).tocsr()
    values = held.copy()
    for k in range(disc.rec.fields):
        known, free = np.flatnonzero(disc.held[:, k]), np.flatnonzero(~disc.held[:, k])
        if len(free) and len(known) and np.ptp(held[known, k]) > 0:
            values[free, k] = spsolve(laplace[free][:, free].tocsc(), -laplace[free][:, known] @ held[known, k])
        elif len(known):
            values[:, k] = held[known[0], k]
    return (values, fitted(disc, values)) if np.isfinite(values).all() and values.any() else None


def fitted(disc: Discretization, values: np.ndarray) -> np.ndarray:
    """Expansions (N, F, K) whose value is the particle's own, by least squares over its neighbours'.

    To the order of the method where the stencils determine as much, else to the highest degree that they do.
    """
    rec, points = disc.rec, concrete(disc.points)
    taylor = np.zeros((*values.shape, rec.size))
    taylor[:, :, 0] = values
    if points is None or not np.ptp(values, axis=0).any():
        return taylor
    near = np.asarray(disc.stencils.indices)
    owners = disc.images.owners(near)
    degree = _degree(rec.dim, rec.order, int(np.median((near >= 0).sum(axis=1))) - 1)
    for some in np.split(np.arange(len(near)), range(_PIECE, len(near), _PIECE)):
        change = np.where((owners[some] >= 0)[..., None], values[np.maximum(owners[some], 0)] - values[some, None], 0.0)
        made = _slopes(np.asarray(points), some, near[some], change, rec.dim, degree)
        taylor[some, :, 1 : 1 + made.shape[2]] = made
    return taylor


def lengths(disc: Discretization) -> np.ndarray:
    """The distance (N,) of every particle's farthest neighbour."""
    points, near = np.asarray(concrete(disc.points)), np.asarray(disc.stencils.indices)
    offset = np.where((near >= 0)[..., None], points[np.maximum(near, 0)] - points[: len(near), None], 0.0)
    return np.sqrt((offset**2).sum(axis=2).max(axis=1))


def _degree(dim: int, order: int, count: int) -> int:
    """The degree of polynomials that ``count`` neighbours determine beside the particle's own value."""
    enough = count if dim == 1 else _EACH * count
    return max(d for d in range(1, order + 1) if d == 1 or len(multi_indices(dim, d)) - 1 <= enough)


def _slopes(
    points: np.ndarray, ids: np.ndarray, near: np.ndarray, change: np.ndarray, dim: int, degree: int
) -> np.ndarray:
    """Taylor coefficients (n, F, K - 1) without the value from the neighbours' differences (n, w, F)."""
    some = np.array(multi_indices(dim, degree)[1:])
    valid = near >= 0
    offset = np.where(valid[..., None], points[np.maximum(near, 0)] - points[ids, None], 0.0)
    square = (offset**2).sum(axis=2)
    length = np.sqrt(square.max(axis=1))
    weight = np.where(valid, np.exp(-2.0 * square / length[:, None] ** 2), 0.0)
    p = np.prod((offset / length[:, None, None])[:, :, None, :] ** some, axis=3)  # (n, w, K - 1)
    moments = np.einsum("nwa,nw,nwb->nab", p, weight, p)
    ridge = _RIDGE * np.trace(moments, axis1=1, axis2=2)
    moments += ridge[:, None, None] * np.eye(len(some))
    found = np.linalg.solve(moments, np.einsum("nwa,nw,nwf->naf", p, weight, change))
    return np.swapaxes(found * length[:, None, None] ** -some.sum(axis=1)[:, None].astype(float), 1, 2)
