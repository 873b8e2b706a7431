"""The particles around a process's own: who has them, and how their numbers come."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.parallel.distributed import Slab
from jsmitsm.parallel.team import Team


class Halo:
    """A process's own particles with all others within ``reach`` of their box, in the order of the whole cloud.

    own (n,): a mask; ids: the own ones. lent[r]: local numbers of own particles that process r looks at; borrowed[r]:
    local numbers of those of process r, in the same order.
    """

    def __init__(self, team: Team, mine: Slab, boxes: list[tuple[np.ndarray, np.ndarray]], reach: float):
        self.team, self.boxes, self.reach = team, boxes, reach
        near = [
            np.flatnonzero(from_box(mine.points, *box) <= reach) if rank != team.rank else np.zeros(0, int)
            for rank, box in enumerate(boxes)
        ]
        rows = team.trade([mine.columns(at) for at in near])
        self.slab = mine.of_rows(np.concatenate([mine.columns(slice(None)), *rows]))
        self.ids: np.ndarray = np.searchsorted(self.slab.number, mine.number)
        self.own = np.zeros(len(self.slab), bool)
        self.own[self.ids] = True
        self.lent = [self.ids[at] for at in near]
        self.borrowed = [np.searchsorted(self.slab.number, some[:, 0].astype(int)) for some in rows]

    def __len__(self) -> int:
        return len(self.slab)

    def spread(self, values: np.ndarray) -> np.ndarray:
        """The array (n, ...) with the values of borrowed particles as their owners have them."""
        out = np.array(values)
        for at, came in zip(self.borrowed, self.team.trade([values[at] for at in self.lent])):
            out[at] = came
        return out

    def returned(self, values: np.ndarray) -> np.ndarray:
        """The transpose of ``spread``: what stands at borrowed particles is added at their owners', and zero here."""
        out = np.array(values)
        came = self.team.trade([values[at] for at in self.borrowed])
        for at in self.borrowed:
            out[at] = 0.0
        for at, more in zip(self.lent, came):
            np.add.at(out, at, more)
        return out

    def short_by(self, radius: Any, ids: np.ndarray) -> float:
        """How much farther the halo had to reach for balls of this radius about local particles; at most 0: enough."""
        low, high = self.boxes[self.team.rank]
        needed = from_box(self.slab.points[ids], low, high) + radius
        return float(np.max(needed, initial=0.0)) - self.reach


def from_box(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Distances (n,) from a box, 0 inside."""
    return np.sqrt((np.maximum(np.maximum(low - points, points - high), 0.0) ** 2).sum(axis=1))


def boxes_of(team: Team, mine: Slab) -> list[tuple[np.ndarray, np.ndarray]]:
    """The boxes of all processes' own particles."""
    return team.gather((mine.points.min(axis=0), mine.points.max(axis=0)))
