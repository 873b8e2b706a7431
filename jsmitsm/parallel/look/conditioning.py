"""The condition number of the global system, from a few solves with it, as that of one process."""

from __future__ import annotations

import numpy as np

from jsmitsm.linear.conditioning import inverse_norm, to_one
from jsmitsm.parallel.system import System
from jsmitsm.parallel.team import Team
from jsmitsm.runtime.errors import SolveError

# Two digits of the number are enough.
ENOUGH, WITHIN = 1e-6, 1e-3


class Entries:
    """The own entries of a vector over all processes; see ``jsmitsm.linear.conditioning.inverse_norm``."""

    def __init__(self, team: Team, here: int):
        self.team, self.here = team, here
        counts = team.gather(here)
        self.starts = np.concatenate([[0], np.cumsum(counts)])
        self.first = int(self.starts[team.rank])

    def total(self, value: float) -> float:
        return float(self.team.total(value))

    def largest(self, size: np.ndarray) -> tuple[float, int]:
        """The largest entry and its number among all, the first of equal ones."""
        at = int(np.argmax(size)) if len(size) else 0
        found = self.team.gather((float(size[at]) if len(size) else -np.inf, -(self.first + at)))
        value, place = max(found)
        return value, -place

    def collected(self, places: np.ndarray, values: np.ndarray, ufunc: np.ufunc) -> np.ndarray:
        """What all processes give to own entries, put together by ``ufunc``: places (m,) are numbers among all."""
        parcels = []
        for low, high in zip(self.starts[:-1], self.starts[1:]):
            some = (places >= low) & (places < high)
            mine = np.zeros(high - low)
            ufunc.at(mine, places[some] - low, values[some])
            at = np.flatnonzero(mine)
            parcels.append((at, mine[at]))
        out = np.zeros(self.here)
        for at, came in self.team.trade(parcels):
            ufunc.at(out, at, came)
        return out


def condition(system: System) -> float:
    """In the 1-norm, of the matrix with rows and columns brought to about one; infinite where no solver gets on.

    Units of equations and unknowns do not count.
    """
    every = Entries(system.team, system.n)
    starts, columns, data = system.matrix.getValuesCSR()
    size, columns = np.abs(data), np.asarray(columns)
    rows = np.repeat(np.arange(system.n), np.diff(starts))
    by_row = np.zeros(system.n)
    np.maximum.at(by_row, rows, size)
    before = to_one(by_row)
    size *= before[rows]
    after = to_one(every.collected(columns, size, np.maximum))
    sums = after * every.collected(columns, size, np.add)
    del size, columns, rows

    def apply(b: np.ndarray, transpose: bool) -> np.ndarray:
        left, right = (after, before) if transpose else (before, after)
        x, _ = system.answer(left * b[:, 0], transpose, ENOUGH, WITHIN)
        return (right * x)[:, None]

    try:
        found = inverse_norm(apply, system.size, every)
    except SolveError:
        return float("inf")
    return system.team.most(float(sums.max(initial=0.0))) * found
