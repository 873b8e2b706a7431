"""The order that a tolerance needs on a given cloud, found by the error estimate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jsmitsm.runtime.errors import SolveError, is_number, short
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.solution import Solution

# Even orders pay; above the last there is no higher one to estimate the error with.
ORDERS = (4, 6, 8, 10, 12)
# An order whose estimate is not below this part of the one before gains nothing; after so many such the search ends.
_GAIN, _IDLE = 0.7, 2


def check_tolerance(order: Any, tol: Any) -> None:
    """``tol`` and ``order="auto"`` come together."""
    if isinstance(order, str) and order == "auto":
        if not is_number(tol) or not 0.0 < tol < 1.0:
            raise ValueError(
                f'tol: order="auto" needs the wanted error, relative to the largest |u|, from 0 to 1, got {short(tol)}'
            )
    elif tol is not None:
        raise ValueError(f'tol: got {short(tol)} with order={short(order)}; a tolerance goes with order="auto"')


def of_tolerance(solved: Callable[[int], Solution], tol: float) -> Solution:
    """The solution of the lowest order whose estimated error is within ``tol`` of the largest \\|u\\|.

    solved: of an order, the solution. Where no order reaches the tolerance, the best one, with a flag that says so.
    """
    best: tuple[float, Solution] | None = None
    idle, refused = 0, None
    for order in ORDERS:
        try:
            sol = solved(order)
            if is_traced(sol.u):
                raise ValueError(
                    'order: "auto" compares estimates, which JAX traces here; choose the order before the transform'
                )
            error = _estimated(sol)
        except (ValueError, SolveError) as fault:
            if best is None and str(fault).startswith("order:") and order < ORDERS[-1]:
                continue  # below the order of the equation
            if best is None:
                raise
            refused = fault  # most often: too few particles for stencils of this order
            break
        if error <= tol:
            return sol
        idle = idle + 1 if best is not None and not error < _GAIN * best[0] else 0
        if best is None or error < best[0]:
            best = error, sol
        if idle == _IDLE:
            break
    assert best is not None
    error, sol = best
    why = f"; order {order} was refused: {refused}" if refused is not None else ""
    sol.stats["objections"] = [
        f"No order reaches the tolerance {tol:.1e} on this cloud: the best, {sol.order}, has an estimated error of "
        f"{error:.1e} of the largest value; take a finer cloud, or js.adapt{why}."
    ]
    return sol


def _estimated(sol: Solution) -> float:
    """The largest estimated error over the largest value; infinite where there is none."""
    error, values = np.asarray(sol.error_estimate()), np.asarray(sol.u)
    if not (bool(sol.converged) and np.isfinite(error).all() and np.isfinite(values).all()):
        return np.inf
    largest = float(np.abs(values).max(initial=0.0))
    return float(error.max(initial=0.0)) / (largest or 1.0)
