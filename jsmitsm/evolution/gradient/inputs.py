"""What a run may be differentiated by, and steps that are driven by it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np


@jax.tree_util.register_dataclass
@dataclass
class Push:
    """What -B N takes. source: the values of B; record: N; params; reference: see Semidiscrete, or None."""

    source: Any
    record: Any
    params: Any
    reference: Any


@jax.tree_util.register_dataclass
@dataclass
class Inputs:
    """What a run may be differentiated by.

    values: of the matrices of E and A; push: a Push, None for a linear problem; y (size,) and h; force, jump
    (K s + 1, size) and known (K s + 1, held): F, H and held values at the start and at all implicit stages; times
    (K s + 1,).
    """

    values: Any
    push: Any
    y: Any
    h: Any
    force: Any
    jump: Any
    known: Any
    times: Any


class Given:
    """Drives a stepper by inputs that are known; the times of steps are those of the inputs."""

    def __init__(self, at: Inputs, stages: int):
        self.at, self.stages = at, stages
        self._starts = {float(t): k for k, t in enumerate(np.asarray(at.times)[::stages])}

    def time(self, k: int) -> float:
        """When step k begins."""
        return float(self.at.times[k * self.stages])

    def start(self, t: float) -> tuple[Any, Any, Any]:
        n = self._starts[t] * self.stages
        return self.at.force[n], self.at.jump[n], self.at.known[n]

    def step(self, t: float, h: float) -> tuple[Any, Any, Any]:
        first = self._starts[t] * self.stages + 1
        some = slice(first, first + self.stages)
        return self.at.force[some], self.at.jump[some], self.at.known[some]
