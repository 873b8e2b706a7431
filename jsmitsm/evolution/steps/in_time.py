"""The error in time of a run: what the scheme says of some of its steps, carried along by the equations."""

from __future__ import annotations

from collections.abc import Callable
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
    who know what makes them grow. sizes: of the fields (F,) of what is free. lasting: whether nothing is damped, as in
    waves; then errors add up by their sizes, for they turn with the solution.
    """

    def __init__(self, t0: float, t1: float, sizes: Callable[[np.ndarray], np.ndarray], lasting: bool) -> None:
        self.times: list[float] = []
        self.sizes: list[np.ndarray] = []
        self._sizes, self._lasting = sizes, lasting
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
        before, error = self._sum, np.abs(step.error) if self._lasting else step.error
        if before is not None and not self._lasting and getattr(stepper, "newton", None) is None:
            before = system.resolvent(stepper.smallest(h)).solve(system.mass(before))
        self._sum = weight * error + (0.0 if before is None else before)
        self.times.append(t)
        self.sizes.append(self._sizes(self._sum[: system.n]))

    def at(self, times: np.ndarray) -> np.ndarray:
        """The sizes of the errors of fields (S, F) at times (S,), within the first step already those of its end."""
        if not self.times:
            return np.zeros((len(times), 1))
        times = np.where(times > self._whole[0], np.maximum(times, self.times[0]), times)
        known = [min(self.times[0], self._whole[0]), *self.times]
        return np.stack([np.interp(times, known, [0.0, *one]) for one in zip(*self.sizes)], axis=-1)
