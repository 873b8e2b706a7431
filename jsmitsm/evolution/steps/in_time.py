"""The error in time of a run: what the embedded scheme says of some of its steps, carried along by the equations."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.evolution.steps.stepping import Step

# Steps of a run with equal ones whose error is estimated, besides the first ones.
LOOKS = 8
# Errors are kept for so many parts of a run.
PARTS = 40


def looks(steps: int) -> dict[int, float]:
    """Which steps to look at, the first ones more closely, and how many each of them stands for."""
    early = [2**k for k in range(3)]
    at = sorted({round(k) for k in np.linspace(0, steps - 1, LOOKS)} | {k for k in early if k < steps})
    edges = [-0.5, *((a + b) / 2 for a, b in zip(at, at[1:])), steps - 0.5]
    return {k: right - left for k, left, right in zip(at, edges, edges[1:])}


class InTime:
    """Adds up errors of steps; what damps the solution damps them, by one step of backward Euler for each look.

    parts: those of each of PARTS parts of a run by themselves, when they were last added to and their sum, for those
    who know what makes them grow.
    """

    def __init__(self, t0: float, t1: float) -> None:
        self.times: list[float] = []
        self.sizes: list[float] = []
        self.parts: dict[int, tuple[float, np.ndarray]] = {}
        self._whole = t0, t1
        self._sum: Any = None

    def add(self, stepper: Any, step: Step, t: float, h: float, weight: float = 1.0) -> None:
        """The error of the step that ended at t."""
        if step.error is None:
            return
        system = stepper.system
        t0, t1 = self._whole
        part = int(PARTS * (t - t0) / (t1 - t0) - 1e-9)
        self.parts[part] = t, self.parts.get(part, (t, 0.0))[1] + weight * step.error
        before = self._sum
        if before is not None and not system.second and getattr(stepper, "newton", None) is None:
            before = system.resolvent(stepper.smallest(h)).solve(system.mass(before))
        self._sum = weight * step.error + (0.0 if before is None else before)
        self.times.append(t)
        self.sizes.append(system.largest(self._sum[: system.n]))

    def at(self, times: np.ndarray) -> np.ndarray:
        """The size of the error at some times."""
        if not self.times:
            return np.zeros(len(times))
        return np.interp(times, [min(self.times[0], float(times[0])), *self.times], [0.0, *self.sizes])
