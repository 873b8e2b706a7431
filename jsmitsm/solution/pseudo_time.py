"""Pseudo-transient continuation: from far away along the way on which time would lead, in steps that grow.

The leave-one-out equations are u_i - sum_g w_g u_g = b_i, the operator times the square of a length with the sign of
minus the Laplacian: A u = b. An implicit step of du/dt = b - A u changes the matrix by a multiple of its diagonal only,

    (A + s D) u_new = b + s D u,

with s the inverse of the step. As the residual falls so does s (switched evolution relaxation, Mulder and van Leer
1985; convergence: Kelley and Keyes 1998), and the steps become Newton's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.solution.newton_step import Iterate, Record, distance

# The first step moves no value by more than about this part of the solution; after one that did, or that moved none by
# more than SMALL of it, the next is shorter or longer by GROWTH than the residual says.
FIRST, SMALL, GROWTH = 0.5, 0.1, 2.0
# From steps this short Newton's method goes on; so many solves at most, and so many times a step is cut in a row.
NEAR, MOST, CUTS = 1e-3, 60, 4


class Pull:
    """Alters a linear system A u = b so that its solution stays near to the values ``here`` (N, F)."""

    def __init__(self, free: np.ndarray, fields: int, scales: np.ndarray):
        self.free, self.field, self.scales = free, free % fields, scales
        self.here: Any = None
        self.strength = self.residual = 0.0

    def __call__(self, data: Any, r: Any, c: Any, b: Any) -> tuple[Any, Any, Any, Any]:
        data, b = np.asarray(data), np.asarray(b)
        n, own = len(b), r == c
        diagonal = np.bincount(r[own], data[own], n)
        diagonal[diagonal == 0] = np.abs(diagonal).max() or 1.0
        u = self.here.reshape(-1)[self.free]
        left = np.abs(b - np.bincount(r, data * u[c], n)) / np.abs(diagonal)
        residual = float(np.max(left / self.scales[self.field]))
        if not self.strength:
            self.strength = residual / FIRST
        elif self.residual:
            self.strength *= residual / self.residual
        self.residual = residual
        pull, every = self.strength * diagonal, np.arange(n)
        return np.concatenate([data, pull]), np.concatenate([r, every]), np.concatenate([c, every]), b + pull * u


def relaxed(record: Record, here: Iterate, scales: np.ndarray) -> Iterate | None:
    """An iterate near a solution, or None where time does not lead to one.

    scales (F,): the size of each field.
    """
    disc = record.run.disc
    held = disc.held.reshape(-1)
    pull = Pull(np.flatnonzero(~held), disc.rec.fields, scales)
    cuts = 0
    for _ in range(MOST):
        pull.here = here.values
        new = record.tried(here, pull)
        if new is None or not np.isfinite(pull.residual):
            pull.strength, pull.residual, cuts = 10.0 * (pull.strength or 1.0), 0.0, cuts + 1
            if cuts > CUTS:
                return None
            continue
        moved = float(np.max(np.abs(new.values - here.values) / scales))
        record.went(distance(new, here), new.size)
        here, cuts = new, 0
        if moved < NEAR and pull.strength < NEAR:
            return here
        pull.strength *= 1.0 / GROWTH if moved < SMALL else GROWTH if moved > FIRST else 1.0
    return None
