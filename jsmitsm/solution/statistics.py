"""What a user may want to know about a solve: seconds, sizes, what was skipped or repaired."""

from __future__ import annotations

from typing import Any

from jsmitsm.discretization.layout import Discretization


def skipped(disc: Discretization, linear: dict[str, Any], traced: bool) -> list[str]:
    """What the scene made unnecessary; ``linear``: what the linear solve tells of itself."""
    method = disc.scheme.method
    out = []
    if disc.given_stencils:
        out.append("neighbour search")
    if method in ("S", "SSPH", "I"):
        out.append("kernel derivatives")
    if disc.traced.constant and disc.rec.scale_free:
        out.append("recursion per particle")
    elif disc.lengths:
        out.append(f"recursion per particle, but for {disc.lengths} lengths")
    if disc.repeated:
        out.append(f"moment systems of {disc.repeated} particles with repeated stencils")
    if disc.traced.source == "zero":
        out.append("particular part")
    if disc.held.all(axis=1).any():
        out.append(f"{int(disc.held.all(axis=1).sum())} particles with held values")
    if linear.get("cached"):
        out.append("factorisation, that of the same matrix was kept")
    elif linear.get("order_kept"):
        out.append("elimination order, that of the same pattern was kept")
    if not traced:
        out.append("bookkeeping for gradients")
    return [*out, "Taylor coefficients until asked for", "error estimate until asked for"]


def of_run(run: Any) -> dict[str, Any]:
    """Everything that a finished run tells of itself."""
    disc = run.disc
    out: dict[str, Any] = {
        "seconds": dict(run.seconds),
        "depth": disc.rec.depth,
        "particles": len(disc.cloud),
        "unknowns": int((~disc.held).sum()),
        "neighbours": max((c.neighbours.shape[1] for c in disc.classes), default=0),
        "linear": run.linear,
        "formulation": run.formulation,
        "skipped": skipped(disc, run.linear, run.values is None),
        "messages": list(run.messages),
    }
    if run.changes:
        out["changes"] = list(run.changes)
    if "residual" in run.linear:
        out["residual"] = run.linear["residual"]
    if run.health is not None:
        out.update(lebesgue_max=run.health.largest, repaired=run.health.repaired, weak=run.health.weak)
    return out
