"""Clouds on an interval."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.cloud.filling import SpacingLike, divide, spacing_function
from jsmitsm.cloud.lattices.boxes import lattice
from jsmitsm.cloud.lattices.path import followed
from jsmitsm.runtime.errors import TooCoarse, explaining, short


@explaining
def interval(a: float, b: float, n: int | None = None, *, spacing: SpacingLike | None = None) -> Cloud:
    """Particles on [a, b], ascending, both ends among them; groups interior, left, right.

    Parameters
    ----------
    a, b : float
        The ends, length units.
    n : int, optional
        So many, equally spaced.
    spacing : float or function, optional
        Instead of ``n``, the distance between neighbours in length units, a number or a function (M, 1) -> (M,) of
        numpy arrays. It is met up to a common factor near 1: the ends are particles.

    Returns
    -------
    Cloud
        In 1D.

    Raises
    ------
    ValueError
        Unless b > a, for an ``n`` below 2, a ``spacing`` too coarse for a particle between the ends, or both of
        them.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.interval(0.0, 1.0, 5).spacing
    0.25
    >>> graded = js.interval(0.0, 1.0, spacing=lambda x: 0.001 + 0.2 * x[:, 0])
    >>> len(graded), bool(graded.spacing < 0.002)
    (28, True)
    """
    if spacing is None:
        return lattice((a,), (b,), (n,), 0.0, 0, names=("a", "b", "n"))
    if n is not None:
        raise ValueError(f"n, spacing: got both, n={short(n)} and a spacing; give one of them")
    lattice((a,), (b,), (2,), 0.0, 0, names=("a", "b", "n"))  # judges the ends
    rule = spacing_function(spacing)
    ends: Any = np.array([[a], [b]], float)
    points = divide(followed(ends[0], ends[1], rule), rule)[0]
    if len(points) < 3:
        raise TooCoarse(
            f"spacing: too coarse for the shape, it leaves no particle between {a} and {b}; reduce it to half of "
            f"{b - a:.3g} at the most"
        )
    normals = np.full(points.shape, np.nan)
    normals[0], normals[-1] = -1.0, 1.0
    last = len(points) - 1
    return Cloud(points, {INTERIOR: np.arange(1, last), "left": [0], "right": [last]}, normals)
