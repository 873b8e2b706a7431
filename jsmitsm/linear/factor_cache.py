"""Factorisations kept for the next solve with the same matrix.

They are found again by the values of the matrix, compared exactly, so that the adjoint of a solve,
its tangent and a second right-hand side need not know of one another. The last ones are kept here; one that is kept
elsewhere, as by js.factorize, is found as well.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from jsmitsm.linear.sparse import COUNTS, Factor


@dataclass(frozen=True)
class Settings:
    """What a factorisation depends on besides the entries; hashable, a primitive's parameter."""

    n: int
    points: np.ndarray | None = field(repr=False)
    solver: str
    elliptic: bool
    refine: int

    def __hash__(self) -> int:
        return hash((self.n, self.solver, self.elliptic, self.refine))

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Settings)
            and hash(self) == hash(other)
            and (self.n, self.solver) == (other.n, other.solver)
            and (self.elliptic, self.refine) == (other.elliptic, other.refine)
            and _same(self.points, other.points)
        )


def _same(a: Any, b: Any) -> bool:
    """Whether two arrays hold the same values (NaN equals NaN)."""
    if a is b:
        return True
    if a is None or b is None or a.shape != b.shape:
        return False
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def _glance(array: Any) -> Any:
    """A few of an array's bytes: most arrays that differ, differ there."""
    return None if array is None else (array.shape, array[:: max(1, len(array) // 16)].tobytes())


@dataclass(eq=False)
class _Pattern:
    """The places of a matrix's entries; matrices that differ in their entries alone share one."""

    rows: np.ndarray
    cols: np.ndarray
    settings: Settings
    glance: int

    def fits(self, rows: np.ndarray, cols: np.ndarray, settings: Settings, glance: int) -> bool:
        return glance == self.glance and settings == self.settings and _same(rows, self.rows) and _same(cols, self.cols)


@dataclass(eq=False)
class _Matrix:
    """What a factorisation was made of."""

    data: np.ndarray
    glance: Any  # at the data
    pattern: _Pattern


_kept: list[Factor] = []  # the last one used stands last
_known: WeakKeyDictionary[Factor, _Matrix] = WeakKeyDictionary()  # those that somebody else keeps, too
_lock = threading.Lock()
CACHE_ENTRIES, CACHE_BYTES = 64, 2**30


def clear_cache() -> None:
    """Forget every factorisation that nobody else keeps, and so free its memory."""
    with _lock:
        _kept.clear()


def factorisations() -> int:
    """Number of factorisations made so far in this process."""
    return COUNTS["factorisations"]


def lookup(arrays: Sequence[Any], settings: Settings) -> tuple[Factor, bool]:
    """The factorisation of (data, rows, cols), and whether it was kept."""
    data, rows, cols = (np.asarray(a) for a in arrays)
    first = _glance(data)
    glance = hash((settings, _glance(settings.points), _glance(rows), _glance(cols)))
    pattern, order = None, None
    compared: dict[int, bool] = {}  # patterns by identity: comparing one takes milliseconds
    with _lock:
        for factor in dict.fromkeys([*reversed(_kept), *_known]):
            matrix = _known[factor]
            other = matrix.pattern
            if id(other) not in compared:
                compared[id(other)] = other.fits(rows, cols, settings, glance)
            if compared[id(other)]:
                if first == matrix.glance and _same(data, matrix.data):
                    _keep(factor)
                    return factor, True
                pattern, order = other, factor.order
    s = settings
    made = Factor(data, rows, cols, s.n, s.points, s.solver, s.elliptic, s.refine, order)
    with _lock:
        # Copies: the caller may change an array in place, even under a JAX array that shares it.
        pattern = pattern or _Pattern(rows.copy(), cols.copy(), settings, glance)
        _known[made] = _Matrix(data.copy(), first, pattern)
        _keep(made)
    return made, False


def _keep(factor: Factor) -> None:
    """Put a factorisation last, and forget the first ones where they are too many or too large."""
    if factor in _kept:
        _kept.remove(factor)
    _kept.append(factor)
    total = sum(other.nbytes for other in _kept)
    while len(_kept) > 1 and (len(_kept) > CACHE_ENTRIES or total > CACHE_BYTES):
        total -= _kept.pop(0).nbytes
