"""The global system: coordinates of its matrix, its right-hand side, and its two forms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm import assembly
from jsmitsm.layout import Class, Discretization, sorted_classes, table
from jsmitsm.moments import Row
from jsmitsm.neighbours import Stencils
from jsmitsm.numbers import Numbers
from jsmitsm.program import in_one_program
from jsmitsm.progress import each
from jsmitsm.recursion import Recursion
from jsmitsm.rows import operands, pieces, right_sides, shared_elimination
from jsmitsm.tracers import concrete, is_traced


def matrix(disc: Discretization, classes: list[Class], rows: list[Row]) -> tuple[Any, Any, Any]:
    """The global matrix as coordinates: own u_i - sum_g weights u_g over the unknowns."""
    unknown, fields = disc.unknowns, disc.rec.fields
    parts: list[Any] = []
    places: list[Any] = []
    for cls, row in zip(classes, rows):
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
        return _joined([*parts, (ones, every, every)])
    weights, at, to = zip(*parts)
    return _entries(weights, places, ones), np.concatenate([*at, every]), np.concatenate([*to, every])


@in_one_program
def _entries(weights: Sequence[Any], places: Sequence[np.ndarray], diagonal: np.ndarray) -> Any:
    """The entries of the matrix: the weights at their places, negative, and the diagonal of ones."""
    xp = jnp if is_traced(weights) else np
    return xp.concatenate([*(-xp.asarray(w).reshape(-1)[at] for w, at in zip(weights, places)), diagonal])


def _joined(parts: Sequence[tuple[Any, Any, Any]]) -> tuple[Any, Any, Any]:
    """Entries and their places, each in one array; places stay on the host where they can."""
    values, at, to = zip(*parts)
    join = jnp.concatenate if is_traced(values) else np.concatenate
    where = jnp.concatenate if is_traced(at, to) else np.concatenate
    return join(values), where(at), where(to)


def right_side(disc: Discretization, nums: Numbers, classes: list[Class], rows: list[Row]) -> Any:
    """The global right-hand side (n,): source, own conditions and held neighbours."""
    unknown = disc.unknowns
    parts, places = [], []
    for cls, row in zip(classes, rows):
        source, given = right_sides(disc, nums, cls)
        near = disc.images.owners(cls.neighbours)
        own = unknown[cls.ids]
        parts.append((row, source if cls.scheme.sourced else None, given, near, np.flatnonzero(own >= 0)))
        places.append(own[own >= 0])
    return _loads(parts, nums.held, nums.gamma, np.argsort(np.concatenate(places))) if parts else np.zeros(0)


@in_one_program
def _loads(parts: Sequence[Any], held: Any, gamma: Any, order: np.ndarray) -> Any:
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


def misfit(disc: Discretization, nums: Numbers, fits: list[Any], values: Any) -> np.ndarray:
    """By how much each particle's value misses its local fit, in the blocks of :func:`least_squares`."""
    found = []
    for near, own, load, extra in fits:
        data = np.concatenate([np.asarray(values)[np.maximum(near, 0)].reshape(len(near), -1), extra], axis=1)
        found.append(np.abs(np.einsum("nij,nj->ni", own, data) - load).max(axis=1))
    return np.concatenate(found)


def least_squares(disc: Discretization, nums: Numbers, fits: list[Any] | None = None) -> tuple[Any, Any, Any, Any]:
    """The normal equations of the least-squares form, as coordinates, and their right-hand side.

    A list ``fits`` is filled with what :func:`misfit` needs, where nothing is traced.

    Every particle contributes the misfit of its local fit, those with held values too: the
    projector of a fit is idempotent, so nothing is squared.
    """
    shared = shared_elimination(disc, nums)
    n = int(disc.unknowns.max(initial=-1)) + 1
    whole = sorted_classes(disc, nums.ids, Stencils(table(disc), None))
    classes = [piece for cls in whole for piece in pieces(disc, nums, cls)]
    parts, loads = zip(*each("local fits", lambda cls: _normal_part(disc, nums, cls, shared, fits), classes))
    b = _added_up(*zip(*loads), np.zeros(n))
    return *_joined(parts), b


def _normal_part(disc: Discretization, nums: Numbers, cls: Class, shared: Any, fits: list[Any] | None) -> tuple:
    """What one class adds to the normal equations: entries as coordinates, and places and values on the right."""
    given = operands(disc, nums, cls, shared)
    made = assembly.blocks(
        cls.scheme, disc.points, disc.kernel, cls.ids, cls.neighbours, given, right_sides(disc, nums, cls)
    )
    near = disc.images.owners(cls.neighbours)
    host: Any = jnp if is_traced(near) else np
    place = host.where((near >= 0)[..., None], host.asarray(disc.unknowns)[host.maximum(near, 0)], -1)
    place = place.reshape(len(cls.ids), -1)
    if fits is not None and not is_traced(near, made, nums.held, nums.gamma):
        own = slice(0, disc.rec.fields)
        matrix, load = np.asarray(made.matrix), np.asarray(made.load)
        extra = np.asarray(nums.gamma)[np.maximum(near, 0)].reshape(len(cls.ids), -1)
        fits.append((near, matrix[:, own].copy(), load[:, own].copy(), extra))
    right = _normal_load(made.matrix, made.load, near, place, nums.held, nums.gamma)
    m = place.shape[1]
    r = host.broadcast_to(place[:, :, None], (len(cls.ids), m, m))
    c = host.broadcast_to(place[:, None, :], (len(cls.ids), m, m))
    keep = (r >= 0) & (c >= 0)
    if is_traced(near):
        matrix = made.matrix[:, :m, :m]
        entries = (jnp.where(keep, matrix, 0.0), jnp.where(keep, r, 0), jnp.where(keep, c, 0))
        return tuple(x.reshape(-1) for x in entries), (place, right)
    at = np.nonzero(keep)
    return (_block_entries(made.matrix, at), r[at], c[at]), (place, right)


@in_one_program
def _normal_load(matrix: Any, load: Any, near: Any, place: Any, held: Any, gamma: Any) -> Any:
    """What is left of a block's right-hand side (n, m) once the known values are taken to it."""
    xp = jnp if is_traced(matrix, load, near, held, gamma) else np
    index, n = xp.maximum(near, 0), near.shape[0]
    known = xp.where((near >= 0)[..., None], xp.asarray(held)[index], 0.0).reshape(n, -1)
    known = xp.where(place >= 0, 0.0, known)
    data = xp.concatenate([known, xp.asarray(gamma)[index].reshape(n, -1)], axis=1)
    return (xp.asarray(load) - xp.einsum("nij,nj->ni", xp.asarray(matrix), data))[:, : place.shape[1]]


@in_one_program
def _block_entries(matrix: Any, at: tuple[np.ndarray, ...]) -> Any:
    return (matrix if is_traced(matrix) else np.asarray(matrix))[at]


@in_one_program
def _added_up(places: Sequence[Any], loads: Sequence[Any], start: np.ndarray) -> Any:
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


def prefers_least_squares(disc: Discretization, nums: Numbers) -> bool:
    """Whether information travels: operators of first order, hyperbolic and parabolic ones of second,
    and those whose convection outweighs diffusion between neighbours (cell Peclet number above 2).

    There a value predicted by neighbours on all sides is the wrong global form.
    """
    rec, jac = disc.rec, concrete(nums.jac)
    jac = None if jac is None else np.asarray(jac)  # where it only carries derivatives, no operation is recorded
    orders = {rec.order - q for q in rec.degrees}
    if disc.scheme.method != "S" or rec.fields > 1:
        return False
    if orders == {1}:
        return True
    if orders != {2}:
        return False
    if _timelike(rec):
        return True
    if jac is None:
        return False
    symbol = np.zeros((jac.shape[-1], rec.dim, rec.dim))
    for s, (_, b) in enumerate(rec.slots):
        if sum(b) == 2:
            i, j = [axis for axis in range(rec.dim) for _ in range(b[axis])]
            symbol[:, i, j] += jac[0, s, 0] / 2
            symbol[:, j, i] += jac[0, s, 0] / 2
    values = np.linalg.eigvalsh(symbol)
    diffusion = np.abs(values).max(axis=1)
    if (values[:, 0] * values[:, -1] < -1e-10 * diffusion**2).any():
        return True
    drift = [s for s, (_, b) in enumerate(rec.slots) if sum(b) == 1]
    if not drift or concrete(disc.cloud.points) is None:
        return False
    speed = np.linalg.norm(jac[0, drift, 0], axis=0)
    return bool(np.median(speed * mean_spacing(disc) / diffusion) > 2.0)


def _timelike(rec: Recursion) -> bool:
    """Whether an axis enters by a first derivative only, as time does in a heat equation."""
    second = {axis for _, b in rec.slots if sum(b) == 2 for axis in range(rec.dim) if b[axis]}
    first = {b.index(1) for _, b in rec.slots if sum(b) == 1}
    return bool(first - second)


def cell_peclet(disc: Discretization, nums: Numbers) -> float:
    """Convection over diffusion between neighbours, the median over the particles; 0 where it has no meaning."""
    rec = disc.rec
    drift = [s for s, (_, b) in enumerate(rec.slots) if sum(b) == 1]
    second = [s for s, (_, b) in enumerate(rec.slots) if sum(b) == 2]
    orders = {rec.order - q for q in rec.degrees}
    if rec.fields > 1 or orders != {2} or not drift or not second or is_traced(nums.jac, disc.cloud.points):
        return 0.0
    jac = np.asarray(nums.jac)[0, :, 0]
    speed, diffusion = np.linalg.norm(jac[drift], axis=0), np.abs(jac[second]).max(axis=0)
    return float(np.median(speed * mean_spacing(disc) / np.where(diffusion > 0, diffusion, np.inf)))


def mean_spacing(disc: Discretization) -> float:
    """The edge of the cube that each particle has for itself."""
    points = np.asarray(concrete(disc.cloud.points))
    return float((np.prod(np.ptp(points, axis=0)) / len(points)) ** (1.0 / disc.rec.dim))


def wave_number(disc: Discretization, nums: Numbers) -> float:
    """k of an operator such as laplacian(u) + k^2 u, the median over the particles; 0 where it has no waves."""
    rec = disc.rec
    zero = [s for s, (_, b) in enumerate(rec.slots) if sum(b) == 0]
    pure = [s for s, (_, b) in enumerate(rec.slots) if sum(b) == 2 and max(b) == 2]
    orders = {rec.order - q for q in rec.degrees}
    if rec.fields > 1 or orders != {2} or not zero or not pure or is_traced(nums.jac, disc.cloud.points):
        return 0.0
    jac = np.asarray(nums.jac)[0, :, 0]
    second = jac[pure]
    # A wave equation in space and time has second derivatives of both signs: another matter.
    if (second.min(axis=0) * second.max(axis=0) <= 0).any():
        return 0.0
    square = np.median(jac[zero[0]] / second[np.argmax(np.abs(second), axis=0), np.arange(second.shape[1])])
    return float(np.sqrt(max(square, 0.0)))


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
