"""The least-squares form of the global system: the misfits of all local fits, as a quadratic form of the values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Class, Discretization, sorted_classes, table
from jsmitsm.discretization.leave_one_out import joined
from jsmitsm.discretization.local_data import Around, around, operands, right_sides, shared_elimination
from jsmitsm.discretization.sharing import in_pieces, on_all_cores
from jsmitsm.particle import batches
from jsmitsm.particle.moments import Block
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program


def least_squares(
    disc: Discretization, nums: Numbers, parts: list[tuple[Class, Block]] | None = None
) -> tuple[Any, Any, Any, Any]:
    """The normal equations of the least-squares form, as coordinates, and their right-hand side.

    Every particle contributes the misfit of its local fit, those with held values too: the
    projector of a fit is idempotent, so nothing is squared. A list ``parts`` is filled with what
    ``least_squares_right_side`` needs.
    """
    shared, there = shared_elimination(disc, nums), around(disc, nums)

    def one(cls: Class) -> tuple[Any, Any, Any]:
        block = _class_blocks(disc, nums, cls, shared, there)
        kept = None if parts is None else (cls, block)
        return normal_entries(disc, cls, block), normal_load(disc, nums, cls, block), kept

    entries, loads, kept = zip(*on_all_cores("local fits", one, disc, nums, _fitted(disc, nums)))
    if parts is not None:
        parts += kept
    return *joined(entries), added_up(*zip(*loads), np.zeros(_unknown_count(disc)))


def least_squares_right_side(disc: Discretization, nums: Numbers, parts: list[tuple[Class, Block]]) -> Any:
    """The right-hand side (n,) alone, for another source and other values in the conditions."""
    loads = [normal_load(disc, nums, cls, block) for cls, block in parts]
    return added_up(*zip(*loads), np.zeros(_unknown_count(disc)))


def misfit(disc: Discretization, nums: Numbers, values: Any, parts: list[tuple[Class, Block]] | None = None) -> Any:
    """By how much each particle's value (N, F) misses its local fit, in the least-squares form.

    A field that counts fewer derivatives than the others has another unit, and is left out. parts: as ``least_squares``
    has filled them, else made again.
    """
    own = np.flatnonzero(np.array(disc.rec.weights) == 0)
    if parts is None:
        parts = fitted_blocks(disc, nums)
    found = [_missed(disc, nums, cls, block, values)[:, own] for cls, block in parts]
    ids, xp = np.concatenate([cls.ids for cls, _ in parts]), jnp if is_traced(found) else np
    return xp.max(xp.abs(xp.concatenate(found)), axis=1)[np.argsort(ids)]


def fitted_blocks(disc: Discretization, nums: Numbers) -> list[tuple[Class, Block]]:
    """The misfits of all local fits, class by class."""
    shared, there = shared_elimination(disc, nums), around(disc, nums)
    one = lambda cls: (cls, _class_blocks(disc, nums, cls, shared, there))  # noqa: E731
    return on_all_cores("local fits", one, disc, nums, _fitted(disc, nums))


def _missed(disc: Discretization, nums: Numbers, cls: Class, block: Block, values: Any) -> Any:
    """What the fits of a class leave of their data (n, m)."""
    near = np.maximum(disc.images.owners(cls.neighbours), 0)
    xp = jnp if is_traced(block, values, nums.gamma) else np
    data = xp.concatenate([xp.asarray(x)[near].reshape(len(near), -1) for x in (values, nums.gamma)], axis=1)
    fitted = xp.einsum("nij,nj->ni", xp.asarray(block.matrix), data)
    return fitted - xp.einsum("nir,nr->ni", xp.asarray(block.right), xp.asarray(_right_values(disc, nums, cls)))


def _unknown_count(disc: Discretization) -> int:
    return int(disc.unknowns.max(initial=-1)) + 1


def _fitted(disc: Discretization, nums: Numbers) -> list[Class]:
    """All particles, those with held values too, in pieces."""
    whole = sorted_classes(disc, nums.ids, Stencils(table(disc), None))
    return in_pieces(disc, nums, whole)


def _class_blocks(disc: Discretization, nums: Numbers, cls: Class, shared: Any, there: Around) -> Block:
    given = operands(disc, nums, cls, shared, there.data)
    return batches.blocks(cls.scheme, there.points, there.kernel, cls.ids, cls.neighbours, given)


def _right_values(disc: Discretization, nums: Numbers, cls: Class) -> Any:
    """What the blocks' ``right`` is multiplied with, (n, rows + n_own)."""
    source, given = right_sides(disc, nums, cls)
    xp = jnp if is_traced(source, given) else np
    return xp.concatenate([source, given], axis=1) if cls.scheme.sourced else given


def _places(disc: Discretization, cls: Class) -> tuple[Any, Any]:
    """The neighbours of a class (n, w), images by their owners, and the numbers of their unknowns (n, w F) or -1."""
    near = disc.images.owners(cls.neighbours)
    xp: Any = jnp if is_traced(near) else np
    place = xp.where((near >= 0)[..., None], xp.asarray(disc.unknowns)[xp.maximum(near, 0)], -1)
    return near, place.reshape(len(cls.ids), -1)


def normal_entries(disc: Discretization, cls: Class, block: Block) -> tuple[Any, Any, Any]:
    """What one class adds to the matrix of the normal equations, as coordinates."""
    near, place = _places(disc, cls)
    host: Any = jnp if is_traced(near) else np
    n, m = place.shape
    r = host.broadcast_to(place[:, :, None], (n, m, m))
    c = host.broadcast_to(place[:, None, :], (n, m, m))
    keep = (r >= 0) & (c >= 0)
    if is_traced(near):
        matrix = block.matrix[:, :m, :m]
        entries = (jnp.where(keep, matrix, 0.0), jnp.where(keep, r, 0), jnp.where(keep, c, 0))
        return entries[0].reshape(-1), entries[1].reshape(-1), entries[2].reshape(-1)
    at = np.nonzero(keep)
    return _block_entries(block.matrix, at), r[at], c[at]


def normal_load(disc: Discretization, nums: Numbers, cls: Class, block: Block) -> tuple[Any, Any]:
    """What one class adds to their right-hand side: places and values."""
    near, place = _places(disc, cls)
    return place, _loads_left(block, _right_values(disc, nums, cls), near, place, nums.held, nums.gamma)


@in_one_program
def _loads_left(block: Block, given: Any, near: Any, place: Any, held: Any, gamma: Any) -> Any:
    """The blocks' loads (n, m) less what the known values take of them."""
    xp = jnp if is_traced(block, given, near, held, gamma) else np
    index, n = xp.maximum(near, 0), near.shape[0]
    known = xp.where((near >= 0)[..., None], xp.asarray(held)[index], 0.0).reshape(n, -1)
    known = xp.where(place >= 0, 0.0, known)
    data = xp.concatenate([known, xp.asarray(gamma)[index].reshape(n, -1)], axis=1)
    load = xp.einsum("nir,nr->ni", xp.asarray(block.right), xp.asarray(given))
    return (load - xp.einsum("nij,nj->ni", xp.asarray(block.matrix), data))[:, : place.shape[1]]


@in_one_program
def _block_entries(matrix: Any, at: tuple[np.ndarray, ...]) -> Any:
    return (matrix if is_traced(matrix) else np.asarray(matrix))[at]


@in_one_program
def added_up(places: Sequence[Any], loads: Sequence[Any], start: np.ndarray) -> Any:
    """The right-hand side of the normal equations: the loads of all blocks at their places."""
    if is_traced(places, loads):
        b: Any = jnp.asarray(start)
        for place, right in zip(places, loads):
            b = b.at[jnp.maximum(place, 0)].add(jnp.where(place >= 0, right, 0.0))
        return b
    b = start.copy()
    for place, right in zip(places, loads):
        np.add.at(b, place[place >= 0], right[place >= 0])
    return b
