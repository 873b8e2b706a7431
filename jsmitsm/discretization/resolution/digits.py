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

# The highest degree of local polynomials where information travels: measured, degree 12 leaves errors of 1e-5 there,
# and 1e-6 in their estimates. Elsewhere there is no bound that is ever met.
TRAVELLING, FREE = 10, 18
# Convection over diffusion between neighbours from which on a basis of local solutions is made orthonormal.
CARRIED = 1.0
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
    waves = max(found.source, found.reaction, found.carried) if traced.constant else 0.0
    return 6 if rec.dim == 2 and rec.order <= HIGH and waves > OSCILLATING else USUAL


def room(rec: Recursion, order: int) -> int:
    """By how many degrees the recursion of a fit of this order may go deeper, at the most.

    An equation whose leading terms say little of an axis bounds the deep coefficients weakly: what it says of the
    others is multiplied degree by degree.
    """
    if rec.fields > 1 or len(set(rec.orders)) > 1:
        return FREE
    return max(TRAVELLING - order, 0) if rec.orders[0] == 1 or lags(rec) else FREE


def lags(rec: Recursion) -> bool:
    """Whether an axis enters by lower derivatives only, as time does in a heat equation."""
    along = np.array([b for _, b in rec.slots]).reshape(-1, rec.dim)
    highest = along.max(axis=0, initial=0)
    return bool(((highest > 0) & (highest < rec.orders[0]) & ~_mixed(rec, along)).any())


def _mixed(rec: Recursion, along: np.ndarray) -> np.ndarray:
    """Which axes (D,) take part in a leading term."""
    return (along[along.sum(axis=1) == rec.orders[0]] > 0).any(axis=0)


def carries(rec: Recursion, traced: Traced, cloud: Cloud, params: Any, part: Part | None = None) -> bool:
    """Whether convection may outweigh diffusion between neighbours, in some equation for some field.

    So where nothing can be known of it beforehand: where the coefficients hang on the solution, or are traced.
    """
    pairs = [
        (e, drift, second)
        for e in np.flatnonzero(np.array(rec.orders) == 2)
        for k in range(rec.fields)
        if (drift := _slots(rec, traced, int(e), k, 1)) and (second := _slots(rec, traced, int(e), k, 2))
    ]
    points = concrete(cloud.points)
    unknown = points is None or any(concrete(x) is None for x in jax.tree.leaves((traced, params)))
    if not pairs or unknown or not traced.linear:
        return bool(pairs)
    if is_traced(traced, params):  # what only carries derivatives changes nothing
        traced, params = jax.tree.map(concrete, (traced, params))
    points = np.asarray(points)
    n, spacing = len(points), float((np.prod(np.ptp(points, axis=0)) / len(points)) ** (1.0 / rec.dim))
    if part is not None:
        n, spacing = part.count, part.spacing
    jac = traced.leading(Whole(part).every(points, max(1, n // LOOKED_AT)), params)
    jac = np.nan_to_num(np.asarray(jac))  # what is not finite is refused where it is used
    for e, drift, second in pairs:
        speed, diffusion = np.linalg.norm(jac[e, drift], axis=0), np.abs(jac[e, second]).max(axis=0)
        if np.median(speed * spacing - CARRIED * diffusion) > 0.0:
            return True
    return False


def _slots(rec: Recursion, traced: Traced, equation: int, field: int, degree: int) -> list[int]:
    """The derivatives of a degree of a field that an equation holds."""
    return [
        s for s, (k, b) in enumerate(rec.slots) if k == field and sum(b) == degree and traced.pattern[equation, s]
    ]
