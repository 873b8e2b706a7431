"""Which order the rounds of a search have: by the tolerance, and lower where a solution is not smooth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from jsmitsm.adaptation.growth import Row
from jsmitsm.adaptation.marking import ROUGH

# Orders that may be used: two more are needed for the estimate, and two more for that of the check.
ORDERS = tuple(range(1, 13))
# With "auto": up to which tolerance an order serves, by dimension; while the error is rough, the first.
_LADDER = {
    1: ((1e-2, 4), (0.0, 8)),
    2: ((2e-3, 4), (1e-5, 6), (0.0, 8)),
    3: ((1e-3, 4), (0.0, 6)),
}
# A rough solution that a round leaves with this part of its error gets no better by particles.
_HOPE = 0.5


@dataclass
class Orders:
    """The choice of a search for a tolerance: the order ``asked`` for, or "auto"."""

    asked: int | str
    tol: float
    least: int = 1  # of the equation
    highest: int = ORDERS[-1]
    shallow: bool = False  # whether the recursion ends at the order
    lowered: tuple[int, float] | None = None  # order and error before the order was lowered
    hopeful: bool = False  # whether that was no remedy, and more particles are what is left

    def following(self, rows: Sequence[Row], dim: int, lined: bool) -> int:
        """The order of the round after these; lined: whether smoothness ends along lines with most particles."""
        if self.asked != "auto":
            return int(self.asked)
        ladder = _LADDER[dim]
        wanted = next(order for limit, order in ladder if self.tol >= limit)
        if not rows or rows[-1][2] > ROUGH or lined:
            wanted = min(wanted, ladder[0][1])
        last = rows[-1] if rows else (0, 0, 0.0, 0.0, 0.0)
        # Lower orders were no remedy, or the solution is rough no more.
        if self.lowered is not None and last[1] < self.lowered[0] and not _HOPE * ROUGH <= last[2] <= self.lowered[1]:
            self.highest, self.shallow, self.hopeful = self.lowered[0], False, True
        elif len(rows) > 1 and last[2] > max(ROUGH, _HOPE * rows[-2][2]) and not self.hopeful:
            # More particles do not help: Taylor series of something that is not smooth. First the depth is too much.
            self.lowered = last[1], last[2]
            self.highest = min(self.highest, max(last[1] - 2 * self.shallow, self.least))
            self.shallow = True
        return max(min(wanted, self.highest), self.least)
