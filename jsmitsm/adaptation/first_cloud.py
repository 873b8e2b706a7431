"""The first cloud: how large the domain is, learnt from the questions its maker asks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from jsmitsm.adaptation.data import Data, unresolved
from jsmitsm.adaptation.layers import layers
from jsmitsm.adaptation.spacing_field import SpacingField
from jsmitsm.cloud.cloud import Cloud
from jsmitsm.discretization.coefficients import expect_estimate
from jsmitsm.runtime.errors import TooCoarse, TooFine

# Particles of the first cloud, by dimension: enough for the estimate of a low order, and not more.
FIRST = {1: 25, 2: 200, 3: 700}
# The guess may be off by this factor before it is corrected.
_OFF = 2.0
# A spacing too coarse for the shape is reduced by this factor, so many times.
_FINER, _TRIES = 0.6, 40
# Of the extent of what the maker asked about.
_COARSE = 0.2
# The look at source and coefficients, in parts of the largest |u|.
_PART = 0.05

Make = Callable[[Any], Cloud]


def refuse_no_maker(make: Any) -> None:
    """ValueError for what is no function from a spacing to a cloud."""
    if not callable(make):
        raise ValueError(
            f"make: expected a function spacing -> js.Cloud, got {type(make).__name__}; write for instance "
            "lambda spacing: js.from_polygon(vertices, spacing)"
        )


def cloud_of(make: Make, spacing: Any) -> Cloud:
    """A cloud from the user's maker; ValueError where it is none."""
    cloud = make(spacing)
    if not isinstance(cloud, Cloud):
        raise ValueError(
            f"make: returned {type(cloud).__name__}, expected a js.Cloud; it is called with a spacing, a number or a "
            "function (M, D) -> (M,), as in lambda spacing: js.from_polygon(vertices, spacing)"
        )
    return cloud


def made(make: Make, spacing: Any) -> Cloud:
    """A cloud from the user's maker, on which errors will be estimated."""
    cloud = cloud_of(make, spacing)
    expect_estimate(cloud)
    return cloud


def farther_than_asked(cloud: Cloud, spacing: SpacingField) -> float:
    """How many times the spacing particles are apart at most: makers may not know how to be finer, or not want to."""
    points = np.asarray(cloud.points)
    return float((cKDTree(points).query(points, k=[2])[0][:, 0] / spacing(points)).max())


def first_cloud(make: Make, start: Any) -> tuple[Cloud, SpacingField]:
    """The cloud to begin with, and its spacing.

    start: a spacing, a number or a function; None: one of a moderate number of particles.
    """
    if start is not None:
        cloud = made(make, start)
        points = np.asarray(cloud.points)
        given = np.asarray(start(points), float) if callable(start) else np.full(len(points), float(start))
        return cloud, SpacingField(points, given, _extent(points))
    size, cloud = _coarsest(make)
    wanted = FIRST[cloud.dim]
    if not wanted / _OFF <= len(cloud) <= wanted * _OFF:
        better = size * (len(cloud) / wanted) ** (1.0 / cloud.dim)
        size, cloud = _finer(make, better)
    points = np.asarray(cloud.points)
    return cloud, SpacingField(points, np.full(len(points), size), _extent(points))


def looked_at(
    data: Data, make: Make, cloud: Cloud, spacing: SpacingField, most: int
) -> tuple[SpacingField, Cloud]:
    """A first cloud of at most so many particles that sees source, coefficients, and the layers the operator makes."""
    part, coarse = _PART, 1.0
    at, thin = layers(data, cloud, spacing(np.asarray(cloud.points)))
    for _ in range(20):
        finer = spacing
        if not data.plain:
            points, width = unresolved(data, cloud, spacing.largest_used, part, 1.0, most)
            finer = finer.joined(points, 1.5 * coarse * width)
        finer = finer.joined(at, coarse * thin)
        if finer is spacing:
            break
        try:
            found = make(finer)
        except TooFine:
            coarse *= 4.0
            continue
        if len(found) <= most:
            return finer, found
        part, coarse = 4.0 * part, 2.0 * coarse
    return spacing, cloud


def _extent(points: np.ndarray) -> float:
    return float(np.ptp(points, axis=0).max())


def _coarsest(make: Make) -> tuple[float, Cloud]:
    """A spacing of the size of the domain's parts, and its cloud."""
    seen: list[np.ndarray] = []

    def listening(x: np.ndarray) -> np.ndarray:
        x = np.atleast_2d(np.asarray(x, float))
        seen.append(np.stack([x.min(axis=0), x.max(axis=0)]))
        return np.full(len(x), _COARSE * max(_spread(seen), 1e-300))

    refused: ValueError | None = None
    try:
        made(make, listening)
    except ValueError as error:
        refused = error  # most often: too coarse for the shape, which was not known yet
    size = _spread(seen)
    if not size > 0:
        raise refused or ValueError(
            "make: it never asked for the spacing at two points; pass its argument on to the maker of the cloud, as in "
            "lambda spacing: js.from_polygon(vertices, spacing), or say how to begin with start=..."
        )
    return _finer(make, _COARSE * size)


def _spread(seen: list[np.ndarray]) -> float:
    """The extent of all boxes (2, D) that were seen."""
    if not seen:
        return 0.0
    every = np.concatenate(seen)
    return float(np.ptp(every, axis=0).max())


def _finer(make: Make, size: float) -> tuple[float, Cloud]:
    """The cloud of this spacing, or of the first finer one that is not too coarse for the shape."""
    for attempt in range(_TRIES):
        try:
            return size, made(make, size)
        except TooCoarse:
            if attempt == _TRIES - 1:
                raise
            size *= _FINER
    raise AssertionError
