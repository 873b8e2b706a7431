"""The global system of the leave-one-out form: coordinates of its matrix, and its right-hand side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.discretization.local_data import right_sides
from jsmitsm.particle.moments import Row
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program


def matrix(disc: Discretization, classes: list[Class], rows: list[Row]) -> tuple[Any, Any, Any]:
    """The global matrix as coordinates: own u_i - sum_g weights u_g over the unknowns."""
    unknown, fields = disc.unknowns, disc.rec.fields
    parts: list[Any] = []
    places: list[Any] = []
    for cls, row in zip(classes, rows, strict=True):
        near = disc.images.owners(cls.neighbours)
        xp: Any = jnp if is_traced(near) else np
        number = xp.asarray(unknown)
        own = unknown[cls.ids]
        col = xp.where((near >= 0)[..., None], number[near], -1)  # (n, w, F)
        shape = (len(cls.ids), fields, near.shape[1], fields)
        r = np.broadcast_to(own[:, :, None, None], shape)
        c = xp.broadcast_to(col[:, None], shape)
        keep = (r >= 0) & (c >= 0)
        if is_traced(near):
            parts.append(
                (
                    jnp.where(keep, -row.weights, 0.0).ravel(),
                    jnp.where(keep, r, 0).ravel(),
                    jnp.where(keep, c, 0).ravel(),
                )
            )
        else:
            places.append(np.flatnonzero(keep))
            parts.append((row.weights, *(x.reshape(-1)[places[-1]] for x in (r, c))))
    n = int(unknown.max(initial=-1)) + 1 if disc.scheme.method != "SSPH" else 0
    ones, every = np.ones(n), np.arange(n)
    if not places:
        return joined([*parts, (ones, every, every)])
    weights, at, to = zip(*parts)
    return _entries(weights, places, ones), np.concatenate([*at, every]), np.concatenate([*to, every])


@in_one_program
def _entries(weights: Sequence[Any], places: Sequence[np.ndarray], diagonal: np.ndarray) -> Any:
    """The entries of the matrix: the weights at their places, negative, and the diagonal of ones."""
    xp = jnp if is_traced(weights) else np
    return xp.concatenate([*(-xp.asarray(w).reshape(-1)[at] for w, at in zip(weights, places)), diagonal])


def joined(parts: Sequence[tuple[Any, Any, Any]]) -> tuple[Any, Any, Any]:
    """Entries and their places, each in one array; places stay on the host where they can."""
    values, at, to = zip(*parts)
    join = jnp.concatenate if is_traced(values) else np.concatenate
    where = jnp.concatenate if is_traced(at, to) else np.concatenate
    return join(values), where(at), where(to)


def right_side(disc: Discretization, nums: Numbers, classes: list[Class], rows: list[Row]) -> Any:
    """The global right-hand side (n,): source, own conditions and held neighbours."""
    unknown = disc.unknowns
    parts, places = [], []
    for cls, row in zip(classes, rows, strict=True):
        source, given = right_sides(disc, nums, cls)
        near = disc.images.owners(cls.neighbours)
        own = unknown[cls.ids]
        parts.append((row, source if cls.scheme.sourced else None, given, near, np.flatnonzero(own >= 0)))
        places.append(own[own >= 0])
    return loads(parts, nums.held, nums.gamma, np.argsort(np.concatenate(places))) if parts else np.zeros(0)


@in_one_program
def loads(parts: Sequence[Any], held: Any, gamma: Any, order: np.ndarray) -> Any:
    """The right-hand side from every class's row, source, own conditions, neighbours and places."""
    xp = jnp if is_traced(parts, held, gamma) else np
    found = []
    for row, source, given, near, free in parts:
        w, v, v_own, data = (xp.asarray(x) for x in (row.weights, row.source, row.condition, row.data))
        index = xp.maximum(near, 0)
        total = xp.einsum("nfk,nk->nf", v_own, given) + row.constant
        if source is not None:
            total = total + xp.einsum("nfr,nr->nf", v, source)
        total = total + xp.einsum("nfgh,ngh->nf", w, xp.asarray(held)[index])
        if gamma.shape[1]:
            total = total + xp.einsum("nfgd,ngd->nf", data, xp.asarray(gamma)[index])
        found.append(total.reshape(-1)[free])
    return xp.concatenate(found)[order]


def with_held(disc: Discretization, nums: Numbers, x: Any) -> Any:
    """All values (N, F) from the unknowns x (n,)."""
    return _inserted(nums.held, np.flatnonzero(~disc.held.reshape(-1)), x, disc.partner)


@in_one_program
def _inserted(held: Any, place: np.ndarray, x: Any, partner: np.ndarray) -> Any:
    """The unknowns x put at their places among all values, and every value taken from its partner."""
    values: Any
    if is_traced(held, x):
        values = jnp.asarray(held).reshape(-1).at[place].set(x)
    else:
        values = np.array(held).reshape(-1)
        values[place] = x
    return values.reshape(held.shape)[partner]
