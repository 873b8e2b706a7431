"""Ways between particles along their links: a neighbour to which the way is long is behind something."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

# A way this many times as long as the straight one, and this many spacings more, leads round something.
_DETOUR, _SLACK = 2.0, 0.5
# Sources of one search for shortest ways.
_CHUNK = 64
# Particles whose neighbours' spacings are within this ratio search together. Much finer ones than all of these are no
# stations of their ways: around the tip of a crack there are thousands.
_BAND, _FINE = 4.0, 8.0
# Of more answers than this those before are forgotten.
_KEPT = 20_000_000


class Ways:
    """The ways among some of ``points`` (M, D).

    number (M,): of the particles in the graph, -1 for others; spacing: of the linked ones; graph: lengths of links.
    """

    def __init__(self, points: np.ndarray, number: np.ndarray, spacing: np.ndarray, graph: Any):
        self.points, self.number, self.spacing, self.graph = points, number, spacing, graph

    def long(self, near: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Mask (n, w) of the neighbours of the particles ``rows`` (n,) to which the way is long."""
        out, there = np.zeros(near.shape, bool), np.where(near >= 0, near, rows[:, None])
        straight = np.sqrt(((self.points[there] - self.points[rows][:, None]) ** 2).sum(axis=2))
        allowed = _DETOUR * straight + _SLACK * self.spacing[self.number[rows]][:, None]
        for some, stations in self._bands(there, rows):
            place = np.full(len(self.spacing), -1)
            place[stations] = np.arange(len(stations))
            graph = self.graph if len(stations) == len(self.spacing) else self.graph[stations][:, stations]
            some = some[np.argsort(allowed[some].max(axis=1))]  # a search goes as far as the farthest of its sources
            for k in range(0, len(some), _CHUNK):
                part = some[k : k + _CHUNK]
                out[part] = _longer(
                    graph, place[self.number[rows[part]]], place[self.number[there[part]]], allowed[part]
                )
        return out

    def _bands(self, there: np.ndarray, rows: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Rows (places) that search together, and the stations of their ways, by their numbers in the graph.

        Which these are hangs on a row alone, not on who else asks: processes ask for their own.
        """
        finest = np.maximum(self.spacing[self.number[there]].min(axis=1), 1e-300)
        band = np.floor(np.log(finest) / np.log(_BAND))
        for b in np.unique(band):
            yield np.flatnonzero(band == b), np.flatnonzero(self.spacing >= _BAND**b / _FINE)


def _longer(graph: Any, at: np.ndarray, to: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Whether ways from ``at`` (n,) to ``to`` (n, w) are longer than allowed (n, w)."""
    from scipy.sparse.csgraph import dijkstra

    ways = dijkstra(graph, directed=False, indices=at, limit=float(allowed.max()))
    return ~(ways[np.arange(len(at))[:, None], to] <= allowed)


class Looked:
    """What was found of particles' neighbours, for those who ask again: another order, or repairs."""

    def __init__(self, count: int):
        self.at = np.full(count, -1)
        self._forget()

    def _forget(self) -> None:
        self.at[:] = -1
        self.near, self.behind = np.zeros((0, 0), np.int32), np.zeros((0, 0), bool)

    def known(self, near: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Which of the particles ``rows`` (n,) were looked at with these neighbours (n, w), or these and farther
        ones."""
        width, at = near.shape[1], self.at[rows]
        if width > self.near.shape[1]:
            return np.zeros(len(rows), bool)
        return (at >= 0) & (self.near[at, :width] == near).all(axis=1)

    def answer(self, rows: np.ndarray, width: int) -> np.ndarray:
        return self.behind[self.at[rows], :width]

    def add(self, near: np.ndarray, rows: np.ndarray, behind: np.ndarray) -> None:
        """Remember it; of a particle that was looked at already what is new stands in place of the old."""
        if (len(self.near) + len(rows)) * max(near.shape[1], self.near.shape[1]) > _KEPT:
            self._forget()
        old, width = self.near.shape, max(near.shape[1], self.near.shape[1])
        new = np.unique(rows[self.at[rows] < 0])
        self.at[new] = old[0] + np.arange(len(new))
        more = ((0, len(new)), (0, width - old[1]))
        self.near = np.pad(self.near, more, constant_values=-2)  # never asked for
        self.behind = np.pad(self.behind, more)
        at = self.at[rows]
        self.near[at], self.behind[at] = -2, False
        self.near[at, : near.shape[1]], self.behind[at, : near.shape[1]] = near, behind
