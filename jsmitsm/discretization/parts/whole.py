"""A cloud of which several processes have a part each, and what is told of the whole of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Part:
    """A part of a cloud that several processes share: what is decided of the whole, and how they decide together.

    own (n,) bool: the particles whose rows are made here, the others are only looked at. even: whether the whole cloud
    is evenly spaced; spacing: the mean one of the whole. number (n,): of all particles here in the whole cloud of
    ``count``. every: of a step k every k-th particle of the whole; largest: of numbers by name the largest of all
    parts; total: the sum of an array over all parts; gather: what each part gives; all of them call these at once.
    typical: what is typical of the equation in the whole (see ``degenerate.Typical``), where that was asked for.
    """

    own: np.ndarray
    even: bool
    spacing: float
    number: np.ndarray
    count: int
    every: Callable[[int], np.ndarray]
    largest: Callable[[dict[Any, Any]], dict[Any, Any]]
    total: Callable[[Any], Any]
    gather: Callable[[Any], list[Any]]
    typical: Any = None


@dataclass(frozen=True)
class Whole:
    """What is told of all particles: by one process that has them, or by several, all of which ask at the same time."""

    part: Part | None = None

    def own(self, values: Any) -> Any:
        """Of values (n, ...) of all particles here those of the own ones."""
        return values if self.part is None else values[self.part.own]

    def every(self, points: np.ndarray, step: int) -> np.ndarray:
        """Of the particles ``points`` here every ``step``-th of the whole cloud, in its order."""
        return points[::step] if self.part is None else self.part.every(step)

    def owned(self, ids: np.ndarray, values: Any) -> Any:
        """Of values (..., n or 1) at the particles ``ids`` (n,) those of own ones."""
        if self.part is None or np.shape(values)[-1] != len(ids):
            return values
        return values[..., self.part.own[ids]]

    def most(self, value: Any) -> Any:
        """The largest of a number, or of every entry of an array."""
        if self.part is None:
            return value
        entries = np.asarray(value, float)
        found = self.part.largest(dict(enumerate(entries.reshape(-1).tolist())))
        out = np.array([found[k] for k in range(entries.size)]).reshape(entries.shape)
        return out if out.ndim else float(out)

    def total(self, value: Any) -> Any:
        """The sum of a number, or of every entry of an array."""
        return value if self.part is None else self.part.total(value)

    def norm(self, values: Any) -> float:
        """The root of the sum of the squares of own values."""
        return float(np.sqrt(self.total(float(np.sum(np.square(values))))))

    def quantile(self, values: np.ndarray, at: float) -> float:
        """What this part of the own values (n,) does not exceed, as numpy's."""
        if self.part is None:
            return float(np.median(values) if at == 0.5 else np.quantile(values, at))
        mine = np.sort(values)
        place = at * (self.total(len(mine)) - 1)
        ends = [self._smallest(mine, int(k)) for k in (np.floor(place), np.ceil(place))]
        return float(np.quantile(ends, place - np.floor(place))) if ends[0] < ends[1] else ends[0]

    def _smallest(self, mine: np.ndarray, k: int) -> float:
        """The k-th smallest number of all, from 0: halved between floats, which are ordered as whole numbers are."""
        low = _ordered(-self.most(float(-mine[0]) if len(mine) else -np.inf))
        high = _ordered(self.most(float(mine[-1]) if len(mine) else -np.inf))
        while low < high:
            middle = (low + high) // 2
            if self.total(int(np.searchsorted(mine, _number(middle), side="right"))) > k:
                high = middle
            else:
                low = middle + 1
        return _number(low)

    def named(self, ids: np.ndarray) -> np.ndarray:
        """The numbers in the whole cloud, ascending, of own particles ``ids`` of all parts."""
        if self.part is None:
            return np.sort(ids)
        ids = np.asarray(ids, int)
        return np.sort(self.together(self.part.number[ids[self.part.own[ids]]]))

    def together(self, values: np.ndarray) -> np.ndarray:
        """Arrays of all parts, one after the other; those without an entry may have any shape."""
        if self.part is None:
            return values
        found = self.part.gather(values)
        return np.concatenate([x for x in found if len(x)] or found[:1])


ALONE = Whole()


def whole(disc: Any) -> Whole:
    """Of the cloud of a discretisation."""
    return Whole(getattr(disc, "part", None))


def particles(disc: Any) -> int:
    """How many particles the whole cloud has."""
    part = getattr(disc, "part", None)
    return len(disc.cloud) if part is None else part.count


_SIGN = 1 << 63


def _ordered(x: float) -> int:
    bits = int(np.float64(x).view(np.uint64))
    return -(bits - _SIGN) if bits >= _SIGN else bits


def _number(k: int) -> float:
    return float(np.uint64(k if k >= 0 else _SIGN - k).view(np.float64))
