"""The error of an evolution in space: what a pencil of two orders more makes of the same rates."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.evolution.run import Run
from jsmitsm.evolution.space.semidiscrete import Semidiscrete
from jsmitsm.evolution.steps import dense_output
from jsmitsm.runtime.progress import bar
from jsmitsm.taylor.multi_indices import HIGHEST


@bar("error estimate")
def estimated(run: Run, times: np.ndarray, history: tuple[np.ndarray, np.ndarray], in_time: float | None) -> np.ndarray:
    """Estimated errors (S, N, F): |w - u| of A' w = B' f + Bg' g, f = -(M u' + N), and what the steps add.

    Dashes are of order p + 2; w - u is taken through the resolvent of the whole time, so that operators with
    constants in their null space have one too.
    """
    semi, (steps, values) = run.semi, history
    out = np.zeros((len(times), semi.n, semi.fields))
    if len(steps) > 1 and not run.timed.quasilinear and run.order + 2 <= HIGHEST:
        high = run.finer()
        span = float(steps[-1] - steps[0])
        for k, t in enumerate(times):
            out[k] = _one(semi, high, steps, values, float(t), span)
    if in_time is not None:
        out += in_time * np.abs(values).max()
    out.reshape(len(times), -1)[1:, semi.held] = 0.0
    return out


def _one(semi: Semidiscrete, high: Semidiscrete, steps: Any, values: Any, t: float, span: float) -> np.ndarray:
    """The error (N, F) at one time."""
    at = np.asarray(t)
    held, conditions, source, *_ = (np.asarray(v) for v in high.sample(at))
    u = dense_output.derivative(steps, values, t, 0)
    if not semi.linear:
        source = np.asarray(semi.nonlinear(semi.slot_values(u), at, semi.params))
    for j in range(1, 3 if semi.second else 2):
        rate = dense_output.derivative(steps, values, t, j)
        mass = semi.timed.mass(j, np.asarray(semi.points), (at, semi.params))
        source = source + np.einsum("nef,nf->ne", mass, rate).reshape(-1)
    flat = u.reshape(-1)
    misfit = (
        high.given.host @ conditions - high.source.host @ source
        - high.system.stiffness.host @ flat[high.free] - high.stiff_held.host @ held
    )  # fmt: skip
    h = span if not semi.second else span
    r = high.system.force(misfit)
    error = high.system.resolvent(h).solve(h * r)[: high.system.n]
    return np.abs(high.placed(error, np.zeros(len(high.held))))
