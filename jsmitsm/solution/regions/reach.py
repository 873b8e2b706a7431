"""What the polynomials of copies leave of their neighbours' values, and what it tells of the error of two orders.

Where an interface is strongly curved for its particles, as around a thin ring, stencils of every order reach as far as
the solution's series do: an order more gains little there, and two solutions that are off by much the same are near
each other. What the copies' fits leave of their neighbours' values falls from order to order as the errors do.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.discretization.regions.layout import Regions
from jsmitsm.discretization.regions.rows import Joints, RegionNumbers, expanded_copies
from jsmitsm.particle.polynomials import monomials_on_host

# The next order is off by as large a part of the error as its copies' fits leave, or up to so many times that. Measured
# on rings, coats and layers one to six spacings thin: by 0.6 to 1.9 times.
MORE = 1.5
# The distance of two orders is no less than this part of the error of the lower.
NEAREST = 0.25


def left_by_copies(regions: Regions, nums: RegionNumbers, bound: list[Any], values: np.ndarray) -> np.ndarray:
    """What the predictions of all copies miss, were it noise to them, (F,). bound: joints, their classes and rows."""
    parts = [np.zeros((1, regions.rec.fields))]
    for made, classes, rows in bound:
        expanded = np.stack([np.asarray(x) for x in expanded_copies(regions, nums, made, values)], axis=1)
        off = _left(regions, made, classes[0].neighbours, expanded, values)
        # Of every side's equations (n, F, w, F) the root of a sum of squares: errors of neighbours add up by chance.
        parts += [np.linalg.norm(np.asarray(row.weights) * off[:, None], axis=(2, 3)) for row in rows]
    return np.linalg.norm(np.concatenate(parts), axis=0)


def _left(regions: Regions, made: Joints, near: np.ndarray, expanded: np.ndarray, values: np.ndarray) -> np.ndarray:
    """What is left of the neighbours' values (n, w, F) by the polynomials (n, M, F, K) of the copies on their sides."""
    points, rec = np.asarray(regions.points, float), regions.rec
    each = np.arange(len(near))
    side_of = np.zeros(len(points), int)
    for side, k in enumerate(made.parts):
        side_of[regions.parts[k].ids] = side
    out = np.zeros((*near.shape, rec.fields))
    for column, there in enumerate(near.T):
        side = side_of[there]  # where there is no neighbour, any
        offset = points[there] - points[made.ids[each, side]]
        terms = monomials_on_host(offset.T, rec.reach)[: expanded.shape[3]]
        away = np.einsum("nfk,kn->nf", expanded[each, side], terms) - values[there]
        out[:, column] = np.where((there >= 0)[:, None], away, 0.0)
    return out


def slowness(left: np.ndarray, next_left: np.ndarray) -> np.ndarray:
    """How many times the distance of two orders the error of the lower one is, (F,), by what the copies of both leave.

    With e' = r e the errors are (1 - r) e apart, where r is between what is left in parts of what was, and ``MORE``
    times as much.
    """
    least = np.divide(next_left, left, out=np.zeros_like(left), where=left > 0)
    return 1.0 / np.clip(np.maximum(1.0 - MORE * least, least - 1.0), NEAREST, 1.0)
