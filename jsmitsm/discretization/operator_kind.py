"""What kind of equation it is: whether information travels in it, how convective it is, how long its waves are."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Discretization, mean_spacing
from jsmitsm.discretization.parts.whole import particles, whole
from jsmitsm.particle.recursion import Recursion
from jsmitsm.runtime.tracers import concrete, is_traced


def prefers_least_squares(disc: Discretization, nums: Numbers) -> bool:
    """Whether the local fits should agree in the mean, and not every value be what its neighbours predict.

    Where information travels, and in saddle-point systems: there what keeps a flow free of divergence is that the
    fits agree. Measured on Stokes' flow, orders 4 and 6, random and even particles: velocities 10 to 80 times as
    accurate, pressures 10 to 20; of Navier's and Stokes' equations 3 % where predicted values are 40 % off.
    """
    return disc.scheme.method == "S" and (saddle(disc.rec) or information_travels(disc, nums.jac))


def saddle(rec: Recursion) -> bool:
    """Whether a field, such as a pressure, enters by fewer derivatives than every equation has that knows it."""
    return any(rec.weights)


def information_travels(disc: Discretization, coefficients: Any, most: float = 2.0) -> bool:
    """Whether information travels: operators of first order, hyperbolic and parabolic ones of second,
    and those whose convection outweighs diffusion between neighbours (cell Peclet number above ``most``).

    There a value predicted by neighbours on all sides is the wrong global form. coefficients: as ``Numbers.jac``.
    """
    rec, jac = disc.rec, concrete(coefficients)
    jac = None if jac is None else np.asarray(jac)  # where it only carries derivatives, no operation is recorded
    orders = set(rec.orders)
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
    values = _diffusivities(rec, jac)
    diffusion = np.abs(values).max(axis=1)
    if whole(disc).total(int((values[:, 0] * values[:, -1] < -1e-10 * diffusion**2).any())):
        return True
    drift = [s for s, (_, b) in enumerate(rec.slots) if sum(b) == 1]
    if not drift or concrete(disc.cloud.points) is None:
        return False
    speed = np.linalg.norm(jac[0, drift, 0], axis=0)
    convective = speed * mean_spacing(disc) / np.where(diffusion > 0, diffusion, np.inf)
    return whole(disc).quantile(convective, 0.5) > most


def _diffusivities(rec: Recursion, jac: np.ndarray) -> np.ndarray:
    """The eigenvalues (n, D), ascending, of the second derivatives' coefficients."""
    symbol = np.zeros((jac.shape[-1], rec.dim, rec.dim))
    for s, (_, b) in enumerate(rec.slots):
        if sum(b) == 2:
            i, j = [axis for axis in range(rec.dim) for _ in range(b[axis])]
            symbol[:, i, j] += jac[0, s, 0] / 2
            symbol[:, j, i] += jac[0, s, 0] / 2
    return np.linalg.eigvalsh(symbol)


def turned(disc: Discretization, nums: Numbers) -> np.ndarray:
    """The particles, the fewer, at which the highest derivatives have the other sign than at the rest.

    In between they have no weight, and what holds of the solution on one side need not on the other.
    """
    rec, told = disc.rec, whole(disc)
    jac, ids = (told.owned(nums.ids, np.asarray(x)) for x in (nums.jac, nums.ids))
    if rec.fields > 1 or np.shape(nums.jac)[-1] == 1 or rec.dim > 1 and set(rec.orders) != {2}:
        return np.zeros(0, int)
    if rec.dim == 1:
        values = jac[0, [s for s, (_, b) in enumerate(rec.slots) if sum(b) == max(rec.orders)], 0].T
    else:
        values = _diffusivities(rec, jac)
    above, below = ids[(values > 0).all(axis=1)], ids[(values < 0).all(axis=1)]
    return min(above, below, key=lambda some: told.total(len(some)))


def inward_growth(disc: Discretization, nums: Numbers) -> tuple[np.ndarray, np.ndarray]:
    """Held particles of a first-order equation, and from each the exponent of growth to the next particle inside.

    Along its characteristics u grows or falls as exp(-c s), c the coefficient of u over the speed. Where values are
    given at the end to which things flow, what falls along the flow grows inwards.
    """
    rec = disc.rec
    along, zero = _first(rec), next((s for s, (_, b) in enumerate(rec.slots) if sum(b) == 0), None)
    held = np.flatnonzero(disc.held.all(axis=1) & ~np.isin(np.arange(len(disc.cloud)), nums.ids))
    if rec.fields > 1 or set(rec.orders) != {1} or zero is None or not len(held) or not len(nums.ids):
        return held[:0], np.zeros(0)
    points = np.asarray(disc.cloud.points, float)
    from scipy.spatial import cKDTree

    inside = cKDTree(points[nums.ids]).query(points[held])[1]
    jac = np.broadcast_to(np.asarray(nums.jac)[0, :, 0], (len(rec.slots), len(nums.ids)))[:, inside]
    flow = np.stack([np.zeros(len(held)) if slot is None else jac[slot] for slot in along], axis=1)
    speed, way = np.linalg.norm(flow, axis=1), points[nums.ids[inside]] - points[held]
    rate = -np.sign(np.einsum("nd,nd->n", flow, way)) * jac[zero] / np.where(speed > 0, speed, np.inf)
    return held, rate * np.linalg.norm(way, axis=1)


def _first(rec: Recursion) -> list[int | None]:
    """The places of the first derivatives along every axis among the coefficients."""
    places = {b.index(1): s for s, (_, b) in enumerate(rec.slots) if sum(b) == 1}
    return [places.get(axis) for axis in range(rec.dim)]


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
    orders = set(rec.orders)
    if rec.fields > 1 or orders != {2} or not drift or not second or is_traced(nums.jac, disc.cloud.points):
        return 0.0
    jac = whole(disc).owned(nums.ids, np.asarray(nums.jac)[0, :, 0])
    speed, diffusion = np.linalg.norm(jac[drift], axis=0), np.abs(jac[second]).max(axis=0)
    return whole(disc).quantile(speed * mean_spacing(disc) / np.where(diffusion > 0, diffusion, np.inf), 0.5)


def usual_condition(disc: Discretization) -> float:
    """Of the order of the condition of a regular system: n^(m/D) for an operator of order m, times the contrast of
    conductivities where there are several regions; squared where one of these takes the least-squares form."""
    usual = float(particles(disc) ** (max(disc.rec.orders) / disc.rec.dim)) * getattr(disc, "contrast", 1.0)
    return usual**2 if getattr(disc, "squared", False) else usual


def wave_number(disc: Discretization, nums: Numbers) -> float:
    """k of an operator such as laplacian(u) + k^2 u, the median over the particles; 0 where it has no waves."""
    rec = disc.rec
    zero = [s for s, (_, b) in enumerate(rec.slots) if sum(b) == 0]
    pure = [s for s, (_, b) in enumerate(rec.slots) if sum(b) == 2 and max(b) == 2]
    orders = set(rec.orders)
    if rec.fields > 1 or orders != {2} or not zero or not pure or is_traced(nums.jac, disc.cloud.points):
        return 0.0
    jac = whole(disc).owned(nums.ids, np.asarray(nums.jac)[0, :, 0])
    second = jac[pure]
    # A wave equation in space and time has second derivatives of both signs: another matter.
    if whole(disc).total(int((second.min(axis=0) * second.max(axis=0) <= 0).any())):
        return 0.0
    square = jac[zero[0]] / second[np.argmax(np.abs(second), axis=0), np.arange(second.shape[1])]
    square = whole(disc).quantile(square, 0.5)
    return float(np.sqrt(max(square, 0.0)))
