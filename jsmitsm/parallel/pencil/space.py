"""The semidiscrete equations of a process's own free values, E y' + A y = F(t) - B N(y, t), as on one process.

What is nonlinear, and what damps, is made of all local values: a halo's are its owners', and reaches as far as needed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.discretization.pencil.assemble import Pencil
from jsmitsm.evolution.space.semidiscrete import ROUND_OFF, Semidiscrete
from jsmitsm.evolution.space.system import System
from jsmitsm.evolution.space.timed import Timed
from jsmitsm.parallel.local import Local
from jsmitsm.parallel.pencil.assemble import own_rows
from jsmitsm.parallel.system import System as Distributed
from jsmitsm.parallel.system import product


class Rows:
    """Own rows of a matrix over the free values of all processes."""

    def __init__(self, local: Local, matrix: Any):
        self.matrix, self.shape = own_rows(local, matrix), (local.count, local.size)

    def times(self, x: np.ndarray) -> np.ndarray:
        return product(self.matrix, x)


class OwnSystem(System):
    """The own rows of E and A; see ``jsmitsm.evolution.space.system``."""

    def __init__(self, local: Local, whole: System, solver: str):
        rows: Any = [Rows(local, m) for m in (whole.stiffness, *whole.masses)]
        super().__init__(rows[0], tuple(rows[1:]))
        self.local, self.solver = local, solver
        self.info: dict[str, Any] = {}

    def largest(self, x: Any) -> float:
        return float(np.max(self.local.team.gather(super().largest(x))))

    def undriven(self) -> np.ndarray:
        still = np.diff(self.masses[-1].matrix.getValuesCSR()[0]) == 0  # type: ignore[attr-defined]
        return np.concatenate([np.zeros(self.n, bool), still]) if self.second else still

    def inverse(self, parts: list[tuple[Any, Any]], h: Any, kept: bool = True) -> tuple[Any, Any]:
        """No entries, and what solves with the sum of factor * matrix; its hierarchy or factors are kept with it."""
        made: Any = None
        for factor, m in parts:
            some = m.matrix if isinstance(m, Rows) else own_rows(self.local, m)
            if made is None:
                made = some.copy()
                made.scale(factor)
            else:
                made.axpy(factor, some)
        rec = self.local.disc.rec
        found = Distributed(self.local.team, made, self.solver, rec.fields == 1 and set(rec.orders) == {2})
        self.info = found.info
        return None, found


class OwnSemidiscrete(Semidiscrete):
    """``Semidiscrete`` of a process: it holds all local values, states are the own free ones."""

    def __init__(self, local: Local, timed: Timed, pencil: Pencil, params: Any, damping: float, reference: Any,
                 solver: str):  # fmt: skip
        super().__init__(timed, pencil, params, damping, reference)
        self.local = local
        rows = np.flatnonzero(local.halo.own[self.free // self.fields])
        self.own = self.free[rows]
        self.rows = np.concatenate([rows, len(self.free) + rows]) if self.second else rows
        self.apart = all(local.team.gather(self.apart))
        self.system: Any = OwnSystem(local, self.system, solver)

    @property
    def free_fields(self) -> np.ndarray:
        return self.own % self.fields

    def forces(self, held: Any, conditions: Any, source: Any, *rates: Any) -> tuple[Any, Any]:
        force, moved = super().forces(held, conditions, source, *rates)
        return force[:, self.rows], moved[:, self.rows]

    def explicit(self, y: Any, t: Any, known: Any) -> Any:
        return super().explicit(y, t, known)[self.rows]

    def placed(self, part: Any, held: Any) -> Any:
        """All local values (n, F) from the own free ones and those that are held."""
        return self.local.halo.spread(self._placed(part, held))

    def kept(self, part: Any, held: Any) -> Any:
        """The own values (n, F)."""
        return self._placed(part, held)[self.local.halo.ids]

    def _placed(self, part: Any, held: Any) -> np.ndarray:
        flat = np.zeros(self.n * self.fields)
        flat[self.held], flat[self.own] = held, part
        return flat.reshape(self.n, self.fields)

    def begun(self, start: tuple[Any, ...], t: float) -> tuple[Any, Any, bool]:
        flat, team = [np.asarray(v).reshape(-1) for v in start], self.local.team
        gap = np.abs(flat[0][self.held] - np.asarray(self.sample(np.asarray(t))[0])).max(initial=0.0)
        scale = team.most(max(float(np.abs(v).max(initial=0.0)) for v in flat))
        entries = team.total(int(self.masses_held[-1].values.size))
        asked = self.system.force(self.masses_held[-1].host @ flat[-1][self.held])
        jumps = team.most(float(gap)) > ROUND_OFF * scale and entries > 0
        return np.concatenate([v[self.own] for v in flat]), asked[self.rows], jumps
