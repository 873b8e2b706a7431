"""The global system bordered by global unknowns and constraints.

A problem that is linear in u and in its unknowns g has A u = b + B (g - g0), and linear constraints read
C u + D (g - g0) = d. Both are solved at once,

    [ A  -B ] [ u      ]   [ b ]
    [ C   D ] [ g - g0 ] = [ d ],

which is regular where A alone is not, as for slopes given all around. A field that the conditions leave free up to a
constant, and a constraint without an unknown, have for B a column of ones: the unknown is a multiplier then, zero for
data that balance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.layout import Discretization
from jsmitsm.discretization.periodic import with_corners
from jsmitsm.equation.conditions import group_conditions
from jsmitsm.equation.unknowns.stated import at
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.run import Run


class BorderedRun(Run):
    """A linear solve with rows and columns more: ``columns`` (n, K), ``lines`` (K, n), ``corner`` (K, K)."""

    def __init__(self, *args: Any):
        super().__init__(*args)
        self.columns: Any = np.zeros((int((~self.disc.held).sum()), 0))
        self.lines: Any = self.columns.T
        self.corner: Any = np.zeros((0, 0))
        self.right: Any = np.zeros(0)
        self.system: tuple[Any, Any, Any] = (np.zeros(0), np.zeros(0, int), np.zeros(0, int))  # entries and places
        self.parts: list[Any] = []  # of the least-squares form
        self.multipliers = False  # whether the columns are those of free constants

    @property
    def floating(self) -> tuple[int, ...]:
        return self.disc.floating if self.multipliers else ()

    @property
    def bordering(self) -> int:
        return len(self.corner)

    def moved(self, unknowns: dict[str, Any]) -> Discretization:
        """The discretisation of the problem with other unknowns."""
        problem, disc = at(self.problem, unknowns), self.disc
        groups = group_conditions(problem, with_corners(problem, disc.cloud), disc.rec.order, disc.traced.order)
        return replace(disc, problem=problem, groups=groups)

    def constants(self) -> np.ndarray:
        """Columns of ones (n, K) for the fields that are free up to a constant."""
        field = np.flatnonzero(~self.disc.held.reshape(-1)) % self.disc.rec.fields
        return (field[:, None] == np.array(self.disc.floating, int)).astype(float)

    def _bordered(self, data: Any, r: Any, c: Any, b: Any) -> tuple[Any, Any, Any, Any, Any]:
        disc, count = self.disc, self.bordering
        free = np.flatnonzero(~disc.held.reshape(-1))
        n, every = len(free), np.arange(len(free))
        points = None if is_traced(disc.cloud.points) else np.asarray(disc.cloud.points)[free // disc.rec.fields]
        xp: Any = jnp if is_traced(data, b, self.columns, self.lines, self.corner, self.right) else np
        added = np.arange(n, n + count)
        parts = (self.columns.T, self.lines, self.corner)
        data = xp.concatenate([data, *(xp.asarray(p).reshape(-1) for p in parts)])
        across, along = np.tile(every, count), np.repeat(added, n)
        r = np.concatenate([r, across, along, np.repeat(added, count)])
        c = np.concatenate([c, along, across, np.tile(added, count)])
        if points is not None:
            points = np.concatenate([points, np.full((count, points.shape[1]), np.nan)])
        return data, r, c, xp.concatenate([b, xp.asarray(self.right)]), points

    def fail(self, message: str, particles: Any = ()) -> None:
        if "is a condition missing" in message:
            message += " Or two constraints say the same, or one sees nothing of what is unknown"
        super().fail(message, particles)

    def check_balance(self, taylor: Any = None) -> None:
        super().check_balance(taylor)
        self.messages = [m for m in self.messages if "its mean over the particles is 0" not in m]
