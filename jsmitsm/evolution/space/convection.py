"""What is said of a flow before its first step: convection that no pencil stands, a start that is no flow."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.cloud.neighbours import nearest
from jsmitsm.discretization.parts.whole import Part
from jsmitsm.discretization.pencil.fits import local_fits
from jsmitsm.equation.field import RATE, unit
from jsmitsm.equation.traced import Traced
from jsmitsm.evolution.space.semidiscrete import Semidiscrete
from jsmitsm.evolution.space.timed import Timed
from jsmitsm.runtime.collector import uncollected

# Cell Peclet numbers |v| h / eps: up to the first the recursion is stable, beyond the second nothing is.
MODERATE, MOST = 2.0, 5.0
# A divergence at the start that no fit makes, in units of the largest slope.
DIVERGENT = 0.1


def refuse_convection(semi: Semidiscrete, flags: list[str], part: Part | None = None) -> None:
    """ValueError where convection outweighs diffusion between neighbours; a flag where it comes near.

    part: of a cloud that several processes share, which find the same.
    """
    operator, problem = semi.timed.operator, semi.timed.problem
    whole = semi.timed.space
    _refuse_waves(whole, _rated(semi.timed))
    for e, row in enumerate(whole.pattern):
        rates = any(p for m in semi.timed.masses for p in (m.pattern[e] if m.slots else ()))
        first = [s for s, (_, b) in enumerate(whole.slots) if row[s] and sum(b) == 1]
        if rates and first and whole.order[e] == 1 and not _coupled(whole, e):
            raise ValueError(
                f"pde: equation {e} transports without any diffusion, and this method is unstable for pure advection; "
                "add a diffusion of about |v| spacing / 2, or use another method"
            )
    if semi.second or not len(operator.slots) or max(operator.order) != 2:
        return
    points = np.asarray(semi.points)
    spacing = part.spacing if part else float((np.prod(np.ptp(points, axis=0)) / len(points)) ** (1 / points.shape[1]))
    jac, _ = operator.coefficients(points, 0, params=problem.params)
    worst = 0.0
    for e in range(semi.fields):
        if operator.order[e] != 2:
            continue
        speed, diffusion = (
            np.sqrt(sum(
                np.broadcast_to(jac[e, s, 0], len(points)) ** 2
                for s, (_, b) in enumerate(operator.slots) if operator.pattern[e, s] and sum(b) == m
            ) + np.zeros(len(points)))
            for m in (1, 2)
        )  # fmt: skip
        diffusion = diffusion / np.sqrt(points.shape[1])
        with np.errstate(divide="ignore", invalid="ignore"):
            cell = np.where(speed > 0, speed * spacing / diffusion, 0.0)
        if (cell > MODERATE).any():
            rate = np.abs(semi.timed.mass(1, points, problem.params)[:, e]).sum(axis=1)
            cell = np.where(_vanish(points, rate, diffusion), 0.0, cell)
        worst = max(worst, float(np.nanmax(cell)))
    worst = part.largest({"": worst})[""] if part else worst  # type: ignore[dict-item,assignment]
    if worst > MOST:
        raise ValueError(
            f"pde: between neighbouring particles convection is {worst:.3g} times the diffusion (|v| h / eps, the cell "
            f"Peclet number), and beyond {MOST:g} the evolution is unstable: refine the cloud to a spacing of "
            f"{spacing * MODERATE / worst:.2g}, or add diffusion"
        )
    if worst > MODERATE:
        flags.append(
            f"Between neighbouring particles convection is {worst:.3g} times the diffusion; up to {MODERATE:g} is "
            "known to be stable: a finer cloud is safer."
        )


def flag_divergence(semi: Semidiscrete, start: Any, flags: list[str]) -> None:
    """A flag where the velocities at the start (N, F) of an incompressible flow are none."""
    flow, dim = semi.timed.flow, semi.disc.rec.dim
    assert flow is not None
    fits = local_fits(semi.disc, semi.disc.rec.order)
    along = [fits.derivative(unit(dim, i)).host for i in range(dim)]
    slopes = np.array([[d @ start[:, k] for d in along] for k in flow.velocity])
    size, left = float(np.abs(slopes).max()), float(np.abs(np.trace(slopes)).max())
    if left > DIVERGENT * size:
        flags.append(
            f"The start is not free of divergence: div u is up to {left / size:.0%} of the largest slope; it diffuses "
            "as the velocities do, and the pressure answers to it."
        )


def flag_open(semi: Semidiscrete, flags: list[str]) -> None:
    """A flag where the pressure has no condition that is known to serve."""
    flow = semi.timed.flow
    assert flow is not None
    if flow.open:
        names = ", ".join(map(repr, flow.open))
        flags.append(
            f"On {names} neither all velocities are given nor anything of the pressure, field {flow.pressure}, and "
            "errors may be some percent there: give the pressure, as at an outlet, or its slope along the normal, as "
            "the momentum equations have it."
        )


def _vanish(points: np.ndarray, rate: np.ndarray, diffusion: np.ndarray) -> np.ndarray:
    """Where (N,) both are less than half of what they are beside: within a spacing of an axis, or of another zero.

    There the equation is a condition in itself, and its convection moves nothing.
    """
    near = np.asarray(nearest(points, min(2 * points.shape[1] + 1, len(points))).indices)
    return np.all([2.0 * some < some[near].max(axis=1) for some in (rate, diffusion)], axis=0)


def _rated(timed: Timed) -> np.ndarray:
    """Which equation holds a rate of which field, (E, F)."""
    found = np.zeros((timed.problem.fields, timed.problem.fields), bool)
    for m in timed.masses:
        for s, (k, _) in enumerate(m.slots):
            found[:, k % RATE] |= m.pattern[:, s]
    return found


def _refuse_waves(whole: Traced, rated: np.ndarray) -> None:
    """ValueError where equations of first order drive one another round, as first-order forms of waves do.

    What damps is an equation of higher order, or one without a rate, that has a part in what goes round.
    """
    with uncollected():
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import connected_components

    held = np.zeros((2, *rated.shape), bool)  # of which fields an equation holds anything, and first derivatives
    for s, (k, b) in enumerate(whole.slots):
        held[0, :, k] |= whole.pattern[:, s]
        held[1, :, k] |= whole.pattern[:, s] & (sum(b) == 1)
    # From an equation to those that move its fields; fields without a rate are found by the equations without one.
    moved = rated | (~rated.any(axis=0) & ~rated.any(axis=1, keepdims=True) & held[0])
    drives, slopes = (h.astype(int) @ moved.T.astype(int) > 0 for h in held)
    round_ = connected_components(csr_array(drives), connection="strong")[1]
    damps = (np.array(whole.order) > 1) | ~rated.any(axis=1)
    damped = np.isin(round_, round_[damps])
    bare = slopes & ~(damped[:, None] | damped) & ~np.eye(len(slopes), dtype=bool)
    rings = connected_components(csr_array(bare), connection="strong")[1]
    for one in range(rings.max() + 1):
        ring = np.flatnonzero(rings == one)
        if len(ring) > 1:
            raise ValueError(
                f"pde: equations {ring.tolist()} are of first order and drive one another, a wave that nothing damps, "
                "and this method is unstable for it; write it as one equation of second order in time, "
                "js.dt(u, 2)(x) - c**2 * js.laplacian(u)(x), or add a diffusion of about c spacing / 2 to each"
            )


def _coupled(whole: Any, e: int) -> bool:
    """Whether an equation of first order drives its field by another's, as first-order forms of waves do."""
    return any(k != e and sum(b) == 1 and p for (k, b), p in zip(whole.slots, whole.pattern[e]))
