"""Steps chosen by their estimated error, from a ladder of sizes, so that few factors serve a whole run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jsmitsm.evolution.steps.stepping import Step, Stopped
from jsmitsm.runtime.errors import SolveError

# The first and the smallest step are so many halvings of the whole.
FIRST, DEEPEST = 6, 40
_SAFETY = 0.8


def controlled(
    stepper: Any, y: np.ndarray, t0: float, t1: float, tol: float, keep: Callable[[float, Step], None],
    tell: Callable[[float], None], size: Callable[[np.ndarray], float], coarsest: int = 0,
) -> dict[str, int]:  # fmt: skip
    """Steps of (t1 - t0) / 2^k, k changing where the estimate asks for it; a step begins at a multiple of its size.

    size: the norm of an error relative to the solution, that of the worst field. coarsest: the least k. Raises Stopped
    where the smallest step does not do.
    """
    whole = t1 - t0
    step = stepper.first(y, t0)
    keep(t0, step)
    level, place = FIRST, 0  # the time is t0 + place whole / 2^level
    counts = {"steps": 0, "rejected": 0}
    power = 1.0 / (4 if stepper.order < 5 else 6)  # of KenCarp4 and of Radau
    while place < 2**level:
        t, h = t0 + whole * place / 2**level, whole / 2**level
        try:
            now = stepper.advance(step, t, h, True)
            error = size(now.error) / tol if now.error is not None else 0.0
        except (Stopped, SolveError) as fault:
            now, error, why = None, np.inf, str(fault)
        else:
            why = f"its estimated error is {error:.1e} of what is asked for"
        if not np.isfinite(error) or error > 1.0:
            counts["rejected"] += 1
            down = 1 if not np.isfinite(error) else max(1, int(np.ceil(np.log2(error**power / _SAFETY))))
            level, place = level + down, place * 2**down
            if level > DEEPEST:
                raise Stopped(f"no step is small enough at t = {t:.6g}: {why}")
            continue
        assert now is not None
        counts["steps"] += 1
        place += 1
        step = now
        # The end, to the last digit.
        keep(t1 if place == 2**level else t0 + whole * place / 2**level, step)
        tell(place / 2**level)
        while level > coarsest and place % 2 == 0 and (2.0 ** (1.0 / power)) * error < _SAFETY**4 and place < 2**level:
            level, place = level - 1, place // 2
            error *= 2.0 ** (1.0 / power)
    return counts
