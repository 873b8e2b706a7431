"""The digits there are: whether JAX computes in float32, and how deep a recursion may go before round-off shows."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import numpy as np

from jsmitsm.cloud.cloud import Cloud, kept
from jsmitsm.discretization.parts.whole import Part, Whole
from jsmitsm.discretization.resolution.turning import USUAL, few, turning
from jsmitsm.equation.traced import Traced
from jsmitsm.particle.recursion import Recursion
from jsmitsm.runtime.tracers import concrete, is_traced

# The highest degree of local polynomials where information travels, and where convection outweighs diffusion between
# neighbours by the third number: measured, degree 12 leaves errors of 1e-5 there, and 1e-6 in their estimates. Beyond
# the fourth two degrees have all of the gain.
TRAVELLING, CARRIED, PECLET, STRONG = 10, 8, 5.0, 50.0
# Particles whose coefficients are looked at.
LOOKED_AT = 64
# Data that turn within a support by less than the first angle are mild (half of it where lower terms make waves), by
# more than the second they oscillate. Of a constant operator it is worth a look from the third order on, up to the
# fourth there is room for more.
MILD, OSCILLATING, WORTH, HIGH = 0.8, 3.2, 6, 10
SINGLE = (
    "JAX computes in float32 here, the solution has seven digits at most and fewer at higher orders; put "
    'jax.config.update("jax_enable_x64", True) at the beginning of the program, or where it is meant give particles in '
    "float32, js.Cloud(points.astype(np.float32), groups, normals)"
)


def warn_of_float32(cloud: Cloud) -> None:
    """Say that values look like float64 and are not, once a cloud; whoever gives float32 knows."""

    def warn() -> bool:
        warnings.warn(SINGLE, stacklevel=4)
        return True

    if cloud.points.dtype == np.float64 and not jax.config.read("jax_enable_x64"):
        kept(cloud, SINGLE, warn)


def suited_depth(
    method: str, rec: Recursion, flat: bool, sourced: bool, traced: Traced, cloud: Cloud, params: Any,
    held: list[np.ndarray], part: Part | None = None,
) -> int:  # fmt: skip
    """How many degrees the recursion should go beyond the fit.

    Measured: two degrees have all of the gain where the data are mild, four gain 2 to 10 times more where they turn
    within a support, and two more as much again where a constant operator or its source oscillates. I, II and III are
    the paper's. Where neither the operator nor a source has anything to say there, none.
    """
    if method != "S" or rec.order < 2 or (flat and not sourced):
        return 0
    if rec.order == 2 or (rec.dim == 3 and not flat):
        return 2
    if rec.dim == 1 or (traced.constant and rec.order < WORTH) or (sourced and traced.source == "zero"):
        return USUAL
    found = turning(rec, traced, cloud, params, held, part)
    if found is None:
        return USUAL
    # Where a few eliminations serve all, depth costs next to nothing.
    dear = not traced.constant or (flat and not few(traced, cloud, part))
    if dear and max(found.source, found.coefficients, 2.0 * found.reaction, 2.0 * found.carried) < MILD:
        return 2
    waves = max(found.source, found.reaction) if traced.constant and not found.carried else 0.0
    return 6 if rec.dim == 2 and rec.order <= HIGH and waves > OSCILLATING else USUAL


def room(rec: Recursion, order: int, traced: Traced, cloud: Cloud, params: Any, part: Part | None = None) -> int:
    """By how many degrees the recursion of a fit of this order may go deeper, at the most.

    An equation whose leading terms say little of an axis, or little at all within a support, bounds the deep
    coefficients weakly: what it says of the others is multiplied degree by degree.
    """
    if rec.fields > 1 or len(set(rec.orders)) > 1:
        return CARRIED + TRAVELLING
    if rec.orders[0] == 1 or lags(rec):
        return max(TRAVELLING - order, 0)
    peclet = _peclet(rec, traced, cloud, params, part)
    if peclet <= PECLET:
        return CARRIED + TRAVELLING
    return min(max(CARRIED - order, 0), 2 if peclet > STRONG else CARRIED)


def lags(rec: Recursion) -> bool:
    """Whether an axis enters by lower derivatives only, as time does in a heat equation."""
    along = np.array([b for _, b in rec.slots]).reshape(-1, rec.dim)
    highest = along.max(axis=0, initial=0)
    return bool(((highest > 0) & (highest < rec.orders[0]) & ~_mixed(rec, along)).any())


def _mixed(rec: Recursion, along: np.ndarray) -> np.ndarray:
    """Which axes (D,) take part in a leading term."""
    return (along[along.sum(axis=1) == rec.orders[0]] > 0).any(axis=0)


def _peclet(rec: Recursion, traced: Traced, cloud: Cloud, params: Any, part: Part | None) -> float:
    """Convection over diffusion between neighbours, the median over some particles; 0 where nothing is known of it."""
    drift = [s for s, (_, b) in enumerate(rec.slots) if sum(b) == 1]
    second = [s for s, (_, b) in enumerate(rec.slots) if sum(b) == 2]
    points = concrete(cloud.points)
    if rec.orders[0] != 2 or not (drift and second) or points is None or not traced.linear or is_traced(params):
        return 0.0
    points = np.asarray(points)
    n, spacing = len(points), float((np.prod(np.ptp(points, axis=0)) / len(points)) ** (1.0 / rec.dim))
    if part is not None:
        n, spacing = part.count, part.spacing
    sample = Whole(part).every(points, max(1, n // LOOKED_AT))
    jac = traced.leading(sample, params)
    if is_traced(jac):
        return 0.0
    jac = np.asarray(jac)[0]
    if not np.isfinite(jac).all():  # refused where the coefficients are used
        return 0.0
    speed, diffusion = np.linalg.norm(jac[drift], axis=0), np.abs(jac[second]).max(axis=0)
    return float(np.median(speed * spacing / np.where(diffusion > 0, diffusion, np.inf)))
