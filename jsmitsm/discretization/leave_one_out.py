"""The global system of the leave-one-out form: coordinates of its matrix, and its right-hand side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.discretization.local_data import right_sides
from jsmitsm.particle.moments import Row
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program


def predictions(disc: Discretization, classes: list[Class], rows: list[Row]) -> tuple[Any, np.ndarray, np.ndarray]:
    """The global matrix of some rows without its diagonal of ones, as coordinates; not for traced neighbours."""
    places = [_places(disc, cls) for cls in classes]
    if not places:
        return np.zeros(0), np.zeros(0, int), np.zeros(0, int)
    found = _entries([row.weights for row in rows], [p.kept for p in places], np.zeros(0))
    return found, np.concatenate([p.at for p in places]), np.concatenate([p.to for p in places])


def matrix(disc: Discretization, classes: list[Class], rows: list[Row]) -> tuple[Any, Any, Any]:
    """The global matrix as coordinates: own u_i - sum_g weights u_g over the unknowns."""
    if is_traced([cls.neighbours for cls in classes]):
        return joined([*(_traced_entries(disc, cls, row) for cls, row in zip(classes, rows, strict=True)), _ones(disc)])
    places = [_places(disc, cls) for cls in classes]
    ones, every, _ = _ones(disc)
    if not places:
        return ones, every, every
    found = _entries([row.weights for row in rows], [p.kept for p in places], ones)
    at, to = ([getattr(p, name) for p in places] for name in ("at", "to"))
    return found, np.concatenate([*at, every]), np.concatenate([*to, every])


def _ones(disc: Discretization) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The diagonal of ones."""
    n = int(disc.unknowns.max(initial=-1)) + 1 if disc.scheme.method != "SSPH" else 0
    return np.ones(n), np.arange(n), np.arange(n)


class _Places(NamedTuple):
    """Where the rows of a class stand in the global system."""

    unknown: np.ndarray  # what the numbers are of
    kept: np.ndarray  # the weights (flat) that stand in the matrix
    at: np.ndarray  # their rows
    to: np.ndarray  # and columns


# So many weights at the most are worth keeping their places.
_KEPT = 1 << 18


def _places(disc: Discretization, cls: Class) -> _Places:
    found = cls.kept.get("places")
    if found is not None and found.unknown is disc.unknowns:
        return found
    unknown, near = disc.unknowns, disc.images.owners(cls.neighbours)
    own = unknown[cls.ids]
    column = np.where((near >= 0)[..., None], unknown[near], -1)[:, None]  # (n, 1, w, F)
    shape = (*own.shape, *column.shape[2:])
    rows, columns = np.broadcast_to(own[:, :, None, None], shape), np.broadcast_to(column, shape)
    kept = np.flatnonzero((rows >= 0) & (columns >= 0))
    made = _Places(unknown, kept, rows.reshape(-1)[kept], columns.reshape(-1)[kept])
    if rows.size <= _KEPT:
        cls.kept["places"] = made
    return made


def _traced_entries(disc: Discretization, cls: Class, row: Row) -> tuple[Any, Any, Any]:
    """The entries of one class among neighbours that JAX traces, zero where there are none."""
    unknown, near = disc.unknowns, disc.images.owners(cls.neighbours)
    own = unknown[cls.ids]
    column = jnp.where((near >= 0)[..., None], jnp.asarray(unknown)[near], -1)
    shape = (*own.shape, *column.shape[1:])
    r, c = np.broadcast_to(own[:, :, None, None], shape), jnp.broadcast_to(column[:, None], shape)
    keep = (r >= 0) & (c >= 0)
    values, at, to = (jnp.where(keep, x, 0).ravel() for x in (-row.weights, r, c))
    return values, at, to


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
    parts, places = [], []
    for cls, row in zip(classes, rows, strict=True):
        source, given = right_sides(disc, nums, cls)
        near, own = disc.images.owners(cls.neighbours), disc.unknowns[cls.ids].reshape(-1)
        free = np.flatnonzero(own >= 0)
        parts.append((row, source if cls.scheme.sourced else None, given, near, free))
        places.append(own[free])
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
