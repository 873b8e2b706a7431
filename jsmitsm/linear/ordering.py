"""Elimination orders for sparse factorisations, found from the particles' coordinates.

A direct solver fills in far less when the unknowns are eliminated region by region, the
*separators* between the regions last: nested dissection. The regions come from cutting the cloud
in two halves across an axis, again and again; a separator is every unknown of the upper half which
the matrix couples with the lower half. The axis is that of the longest extent, unless a cut across
another has far fewer unknowns beside it: across a cloud graded towards a wall, not along the wall.
"""

from __future__ import annotations

import numpy as np

LEAF = 30  # unknowns of a region that is not cut further; 15 to 60 give the same fill-in
# A cut has beside it what is no further than so many times as the couplings reach in the mean; 1 to 3 give the same.
_BESIDE = 2.0
# One coupling of so many is looked at.
_SOME = 4
# Another axis is taken where it has less than this part of what the longest has beside the cut.
_FEWER = 0.8


def nested_dissection(rows: np.ndarray, cols: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Nested-dissection order of the unknowns of a sparse matrix.

    Args:
      rows, cols: (nnz,) integer arrays, the positions of the entries; the graph of the matrix is
        taken without directions, and entries on the diagonal or named twice do no harm.
      points: (n, D) float array, a coordinate for every unknown, in any unit of length. Unknowns
        without one (a row with NaN: a Lagrange multiplier) are ordered last.

    Returns:
      (n,) integer array `order`: unknown `order[k]` is eliminated in step `k`.

    Source: A. George, Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10
    (1973); the cuts by coordinates are those of Heath and Raghavan, SIAM J. Matrix Anal. 16 (1995).

    Example:
      >>> import numpy as np
      >>> x = np.arange(5.0)[:, None]
      >>> nested_dissection(np.arange(4), np.arange(1, 5), x[::-1])
      array([4, 3, 2, 1, 0])
    """
    points = np.asarray(points, dtype=float)
    n = len(points)
    placed = np.isfinite(points).all(axis=1)
    if not placed.all():
        inner = np.flatnonzero(placed)
        number = np.full(n, -1)
        number[inner] = np.arange(len(inner))
        r, c = number[rows], number[cols]
        kept = (r >= 0) & (c >= 0)
        order = nested_dissection(r[kept], c[kept], points[inner])
        return np.concatenate([inner[order], np.flatnonzero(~placed)])
    if points.shape[1] == 1 or n <= LEAF:  # a chain fills in least from end to end
        return np.argsort(points[:, 0], kind="stable")
    code, depth, along = _halve(points, _reach(rows, cols, points))
    level = _separator_levels(rows, cols, code, depth)
    # Every region ends with its separator, after the two halves: sort by the end of the region,
    # smaller regions first where several end at the same place.
    shift = depth - level
    end = ((code >> shift) + 1) << shift
    key = end * (depth + 1) + shift
    return along[np.argsort(key[along], kind="stable")]


def spatial_order(points: np.ndarray) -> np.ndarray:
    """The unknowns region by region, neighbours near one another: for what sweeps over a matrix and eliminates nothing.

    ``points`` and what comes back as for ``nested_dissection``, which takes eight times as long.

    Example:
      >>> spatial_order(np.array([[2.0], [0.0], [1.0]]))
      array([1, 2, 0])
    """
    points = np.asarray(points, dtype=float)
    placed = np.isfinite(points).all(axis=1)
    inner = np.flatnonzero(placed)
    here = points[inner]
    flat = points.shape[1] == 1 or len(inner) <= LEAF
    order = np.argsort(here[:, 0], kind="stable") if flat else _halve(here)[2]
    return np.concatenate([inner[order], np.flatnonzero(~placed)])


def _reach(rows: np.ndarray, cols: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How far the couplings of every unknown reach along every axis in the mean of some of them, (n, D)."""
    rows, cols, n = rows[::_SOME], cols[::_SOME], len(points)
    count = np.maximum(np.bincount(rows, minlength=n), 1)
    return np.stack([np.bincount(rows, np.abs(x[rows] - x[cols]), n) / count for x in points.T], axis=1)


def _halve(points: np.ndarray, reach: np.ndarray | None = None) -> tuple[np.ndarray, int, np.ndarray]:
    """Binary code of every point's region, digits of the code, and the points in spatial order.

    reach (n, D): how far couplings reach; where None, every cut is across the longest extent.
    """
    n, dim = points.shape
    depth = int(np.ceil(np.log2(n / LEAF)))
    code = np.zeros(n, np.int64)
    # One order per axis, kept sorted inside every region, so that no level has to sort again.
    orders = [np.argsort(points[:, d], kind="stable") for d in range(dim)]
    start = np.array([0, n])
    for _ in range(depth):
        size = np.diff(start)
        first, last = start[:-1], start[1:] - 1
        extent = np.stack([points[o[last], d] - points[o[first], d] for d, o in enumerate(orders)])
        axis = extent.argmax(axis=0)
        region = np.repeat(np.arange(len(size)), size)
        offset = first[region]
        half = size // 2
        if reach is not None:
            beside = np.stack([_beside(points[o, d], reach[o, d], first, half, region) for d, o in enumerate(orders)])
            fewest, here = beside.argmin(axis=0), np.arange(len(size))
            axis = np.where(beside[fewest, here] < _FEWER * beside[axis, here], fewest, axis)
        in_upper = np.arange(n) - offset >= half[region]
        upper = np.empty(n, bool)
        for d, o in enumerate(orders):
            here = (axis == d)[region]
            upper[o[here]] = in_upper[here]
        code = 2 * code + upper
        for d, o in enumerate(orders):
            up = upper[o]
            before = np.cumsum(up) - up
            before -= before[first][region]
            place = np.where(up, offset + half[region] + before, np.arange(n) - before)
            orders[d] = np.empty_like(o)
            orders[d][place] = o
        start = np.concatenate([[0], np.cumsum(np.stack([half, size - half], 1).ravel())])
    return code, depth, orders[0]


def _beside(x: np.ndarray, reach: np.ndarray, first: np.ndarray, half: np.ndarray, region: np.ndarray) -> np.ndarray:
    """How many unknowns are beside a cut of every region in half; x, reach (n,): sorted in those from ``first``."""
    above = x - x[first + half][region]
    return np.add.reduceat((above >= 0) & (above < _BESIDE * reach), first, dtype=np.int64)


def _separator_levels(rows: np.ndarray, cols: np.ndarray, code: np.ndarray, depth: int) -> np.ndarray:
    """Level (0: the first cut) of the separator every unknown belongs to; `depth` for none."""
    a, b = code[rows], code[cols]
    differ = a ^ b
    cut = np.flatnonzero(differ)
    # The highest digit in which two regions differ tells the one cut that parts them.
    at = (depth - np.frexp(differ[cut].astype(float))[1]).astype(np.uint8)
    by_level = np.argsort(at, kind="stable")
    cut = cut[by_level]
    flip = a[cut] < b[cut]
    upper = np.where(flip, cols[cut], rows[cut])
    lower = np.where(flip, rows[cut], cols[cut])
    ends = np.concatenate([[0], np.cumsum(np.bincount(at, minlength=depth))])
    level = np.full(len(code), depth, np.int64)
    for k in range(depth):
        up, low = upper[ends[k] : ends[k + 1]], lower[ends[k] : ends[k + 1]]
        # A coupling through an unknown that already stands in a larger separator needs no cut.
        free = (level[up] == depth) & (level[low] == depth)
        level[up[free]] = k
    return level
