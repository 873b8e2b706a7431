"""Multi-indices and the tables of truncated Taylor arithmetic."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np

from jsmitsm.runtime.errors import is_whole, short

MultiIndex = tuple[int, ...]
Slot = tuple[int, MultiIndex]
"""A derivative of a field: the field and the multi-index."""

# No expansion has a higher order.
HIGHEST = 14


def multi_indices(dim: int, degree: int) -> tuple[MultiIndex, ...]:
    """All multi-indices up to a total degree, graded.

    Inside a degree they descend in the first axis, so every lower degree is a prefix.

    Parameters
    ----------
    dim : int
        Number of axes D.
    degree : int
        The largest total degree; a negative one gives none.

    Returns
    -------
    tuple of tuple of int
        (D,) each, in the order of ``Solution.coefficients``.

    Raises
    ------
    ValueError
        If ``dim`` or ``degree`` is no whole number, or there are more than ten million.

    Examples
    --------
    >>> multi_indices(2, 2)
    ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    """
    for name, value in (("dim", dim), ("degree", degree)):
        if not is_whole(value):
            raise ValueError(f"{name}: expected a whole number, got {short(value)} (docs: choosing)")
    if not 1 <= dim <= 99:
        raise ValueError(f"dim: expected a number of axes, 1 to 99, got {short(dim)} (docs: choosing)")
    if degree > 10_000_000 or degree > 0 and math.comb(int(dim + degree), int(dim)) > 10_000_000:
        raise ValueError("degree: there are more than ten million multi-indices; lower it (docs: choosing)")
    return _up_to(int(dim), int(degree))


@cache
def _up_to(dim: int, degree: int) -> tuple[MultiIndex, ...]:
    return tuple(a for d in range(degree + 1) for a in _of_degree(dim, d))


def _of_degree(dim: int, degree: int) -> Iterator[MultiIndex]:
    """The multi-indices of exactly this degree."""
    if dim == 1:
        yield (degree,)
        return
    for first in range(degree, -1, -1):
        for rest in _of_degree(dim - 1, degree - first):
            yield (first, *rest)


@cache
def index_of(dim: int, degree: int) -> dict[MultiIndex, int]:
    """Position of every multi-index in ``multi_indices(dim, degree)``.

    >>> index_of(2, 2)[(1, 1)]
    4
    """
    return {a: i for i, a in enumerate(multi_indices(dim, degree))}


def factorial(a: MultiIndex) -> int:
    """a! = a_1! a_2! ...

    >>> factorial((3, 2))
    12
    """
    return math.prod(math.factorial(k) for k in a)


@cache
def powers(dim: int, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Every multi-index a (T, D) and |a|! / a! (T,): (s_1 + s_2 + ...)^k is the sum of these over all |a| = k.

    >>> powers(2, 2)[1].tolist()
    [1.0, 1.0, 1.0, 1.0, 2.0, 1.0]
    """
    every = multi_indices(dim, degree)
    return np.array(every), np.array([math.factorial(sum(a)) / factorial(a) for a in every])


@cache
def count(dim: int, degree: int) -> int:
    """How many multi-indices have total degree at most ``degree``."""
    return math.comb(degree + dim, dim) if degree >= 0 else 0


@cache
def degree_of_count(dim: int, terms: int) -> int:
    """The degree whose graded prefix has this many terms."""
    degree = 0
    while count(dim, degree) < terms:
        degree += 1
    if count(dim, degree) != terms:
        raise ValueError(f"{terms} is not a number of Taylor coefficients in {dim} dimensions")
    return degree


@cache
def degrees(dim: int, degree: int) -> np.ndarray:
    """|a| of every multi-index, (T,)."""
    return np.array([sum(a) for a in multi_indices(dim, degree)])


def _positions(places: list[int]) -> Any:
    """A slice where the positions are consecutive (a view is cheaper than a copy)."""
    if places == list(range(places[0], places[0] + len(places))):
        return slice(places[0], places[0] + len(places))
    return np.array(places)


@cache
def product_rows(dim: int, left: int, right: int, degree: int) -> tuple[tuple[int, Any], ...]:
    """For each index a of the left factor: how many terms of the right one count, and where.

    The right factor's terms that keep a + b within ``degree`` are a prefix, so a product is
    ``out[places] += x[a] * y[:n]``.
    """
    place = index_of(dim, degree)
    rows = []
    for a in multi_indices(dim, left):
        some = multi_indices(dim, min(right, degree - sum(a)))
        rows.append((len(some), _positions([place[add(a, b)] for b in some]) if some else None))
    return tuple(rows)


@cache
def product_runs(dim: int, left: int, right: int, degree: int) -> tuple[tuple[tuple[int, int, int], ...], ...]:
    """The same places as runs (place of the first, first and end among the right factor's terms) without a gap."""
    runs = []
    for n, places in product_rows(dim, left, right, degree):
        at = np.arange(places.start, places.stop) if isinstance(places, slice) else np.array(places if n else [], int)
        ends = [0, *(np.flatnonzero(np.diff(at) != 1) + 1).tolist(), len(at)]
        runs.append(tuple((int(at[low]), low, high) for low, high in zip(ends, ends[1:]) if high > low))
    return tuple(runs)


@cache
def block_rows(dim: int, left: int, right: int) -> tuple[Any, ...]:
    """For each index a of degree ``left``: places of a + b in degree left + right, all |b| = right."""
    place = {c: i for i, c in enumerate(_of_degree(dim, left + right))}
    return tuple(_positions([place[add(a, b)] for b in _of_degree(dim, right)]) for a in _of_degree(dim, left))


def add(a: MultiIndex, b: MultiIndex) -> MultiIndex:
    """The sum of two multi-indices."""
    return tuple(m + n for m, n in zip(a, b, strict=True))
