"""Implicit stages of nonlinear problems by Newton's method, its matrix kept as long as it serves."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.discretization.pencil.sparse import Sparse
from jsmitsm.evolution.space.semidiscrete import Semidiscrete
from jsmitsm.evolution.steps.stepping import Stopped
from jsmitsm.runtime.errors import SolveError

# Corrections at the most; a correction must shrink to this part of the last, or the matrix is made anew.
MOST, SLOW = 12, 0.1
# Relative change of the state at which a stage counts as solved, and of an error that is estimated.
SOLVED, ESTIMATED = 1e-11, 1e-3


class Newton:
    """Solves E y + g (A y + B N(y)) = r for a stage."""

    def __init__(self, semi: Semidiscrete):
        self.semi = semi
        self._factor: Any = None
        self._g = 0.0
        self.counts = {"iterations": 0, "factorisations": 0}

    def __call__(self, r: np.ndarray, guess: np.ndarray, t: float, g: float, known: np.ndarray) -> np.ndarray:
        semi, y, largest = self.semi, guess, self.semi.system.largest
        before, fresh = np.inf, False
        for _ in range(MOST):
            with np.errstate(all="ignore"):
                misfit = semi.system.mass(y) + g * (semi.system.stiff(y) - semi.explicit(y, t, known)) - r
            if not np.isfinite(largest(misfit)):
                break
            if self._factor is None or g != self._g:
                self._prepare(semi.placed(y, known), t, g)
                fresh = True
            change = self._factor.solve(misfit)
            y = y - change
            self.counts["iterations"] += 1
            size = largest(change) / max(largest(y), 1e-300)
            if size <= SOLVED or (size <= 1e-8 and size >= 0.5 * before):  # round-off is reached
                return y
            if size > SLOW * before and not fresh:
                self._factor = None
            before, fresh = size, False
        self._factor = None
        raise Stopped(
            f"a stage's equations at t = {t:.6g} were not solved by {MOST} steps of Newton's method: take more steps, "
            "or a tol instead of steps"
        )

    def transposed(
        self, b: np.ndarray, y: np.ndarray, t: float, g: float, known: np.ndarray, pull: Any, number: int
    ) -> np.ndarray:
        """Solves with the transposed matrix of the stage that has the solution y, by an older one where it serves.

        pull: has the transpose of -B N' at this stage.
        """
        system, x, r, before = self.semi.system, np.zeros_like(b), b, np.inf
        fresh = self._factor is None or g != self._g
        if fresh:
            self._prepare(self.semi.placed(y, known), t, g)
        for _ in range(2 * MOST):
            change = self._factor.solve(r, True)
            x = x + change
            size = float(np.abs(change).max(initial=0.0)) / max(float(np.abs(x).max(initial=0.0)), 1e-300)
            if size <= 1e-2 * SOLVED or (size <= SOLVED and size >= 0.5 * before):
                return x
            if size > SLOW * before and not fresh:
                self._prepare(self.semi.placed(y, known), t, g)
                fresh = True
            before = size
            r = b - system.mass_transposed(x) - g * (system.stiff_transposed(x) - pull.state(x, y, number))
        raise Stopped(f"the transposed equations of a stage at t = {t:.6g} were not solved; take more steps")

    def around(self, r: np.ndarray, u: np.ndarray, t: float, g: float) -> np.ndarray:
        """Solves E y + g (A y + B N'(u) y) = r (n, m) for errors y of values u (N, F), as well as these are known."""
        system, size = self.semi.system, lambda x: np.abs(x).max(axis=0, initial=0.0)
        slope = self.semi.linearised(self.semi.steepness(u, t))
        fresh = self._factor is None or g != self._g
        if fresh:
            self._prepare(u, t, g)
        x, before = self._factor.solve(r), np.inf
        while not fresh:
            change = self._factor.solve(r - system.mass(x) - g * (system.stiff(x) + slope @ x))
            x = x + change
            now = float((size(change) / np.maximum(size(x), 1e-300)).max())
            if now <= ESTIMATED:
                break
            if not now <= 0.5 * before:
                self._prepare(u, t, g)
                return self._factor.solve(r)
            before = now
        return x

    def _prepare(self, u: np.ndarray, t: float, g: float) -> None:
        semi = self.semi
        system = semi.system
        extra = (g * semi.linearised(semi.steepness(u, t))).tocoo()
        more = Sparse(extra.data, extra.coords[0], extra.coords[1], extra.shape)
        try:
            parts = [(1.0, system.masses[0]), (g, system.stiffness), (1.0, more)]
            _, self._factor = system.inverse(parts, g, kept=False)
        except SolveError as fault:
            raise Stopped(f"the stage's system at t = {t:.6g} cannot be solved: {fault}") from fault
        self._g = g
        self.counts["factorisations"] += 1
