"""What is missing of the values so far, carried from part to part: errors die out, or grow, as the equation has it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from jsmitsm.evolution.evolution import Evolution
from jsmitsm.evolution.run import Run
from jsmitsm.runtime.errors import SolveError

# An error on one cloud is that of so many nearest particles on another.
_NEAREST = 3


class Missing(NamedTuple):
    """points (M, D), and there u_exact - u in space (M, F); in_time: of the error in time the size alone."""

    points: np.ndarray
    values: np.ndarray
    in_time: float = 0.0

    @property
    def largest(self) -> float:
        """The error at most; infinite where nothing is known."""
        size = float(np.abs(self.values).max(initial=0.0)) + self.in_time
        return size if np.isfinite(size) else np.inf

    def after(
        self, run: Run, evolution: Evolution, passed: np.ndarray | float, marched: Callable[[Run], Evolution],
        scale: float,
    ) -> Missing:  # fmt: skip
        """The same after a part: what was, as the equation takes it along, and what the part makes itself.

        passed (N, F): what reading the start off another cloud may have changed. marched: runs the part again. scale:
        what errors in time are relative to.
        """
        assert evolution._report is not None
        there = np.asarray(evolution.cloud.points)
        off = _between(self.points, self.values, there) + passed
        largest, in_time = float(np.abs(off).max(initial=0.0)), self.in_time
        carried = np.zeros(off.shape)
        if largest > 0:
            carried = _carried(run, evolution, off, marched)
            in_time *= float(np.abs(carried).max()) / largest
        in_time += (evolution.stats["error_in_time"] or 0.0) * scale
        return Missing(there, carried + evolution._report.in_space(), in_time)


def _carried(run: Run, evolution: Evolution, off: np.ndarray, marched: Callable[[Run], Evolution]) -> np.ndarray:
    """What was missing (N, F) at the begin of a part, at its end: the same steps from a start without the error."""
    nothing = np.full(off.shape, np.inf)
    if not np.isfinite(off).all():
        return nothing
    start = run.start
    run.start = (start[0] + off,)
    try:
        other = marched(run)
    except SolveError:
        return nothing
    finally:
        run.start = start
    return np.asarray(other._u)[-1] - np.asarray(evolution._u)[-1] if other.converged else nothing


def _between(points: np.ndarray, values: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Values (N, F) at points, at others (M, D): the mean of the nearest, the nearer the more."""
    away, near = cKDTree(points).query(there, k=range(1, min(_NEAREST, len(points)) + 1))
    weight = 1.0 / np.maximum(away, 1e-12 * away.max(axis=1, keepdims=True) + 1e-150) ** 2
    return np.einsum("mk,mkf->mf", weight / weight.sum(axis=1, keepdims=True), values[near])
