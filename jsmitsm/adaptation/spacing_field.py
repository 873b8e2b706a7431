"""A spacing known at points and wanted everywhere."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

# By how much a spacing may grow over a length: particles graded more steeply have weak stencils.
GROWTH = 0.25
# Points that are asked for the smallest spacing around: more would be smoother, and slower.
_ASKED = 4
_LINKED = {1: 4, 2: 8, 3: 14}


class SpacingField:
    """The largest spacing that nowhere exceeds those given at points by more than the growth over the distance.

    A function (M, D) -> (M,), as ``make`` takes it.
    """

    def __init__(self, points: np.ndarray, spacing: np.ndarray, largest: float):
        self.points, self.largest = np.asarray(points, float), float(largest)
        self.spacing = self._graded(np.minimum(spacing, largest))

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    def _graded(self, spacing: np.ndarray) -> np.ndarray:
        """The given spacings held to the growth from point to neighbouring point."""
        count = min(_LINKED[self.points.shape[1]] + 1, len(self.points))
        away, near = self._tree.query(self.points, k=range(1, count + 1))
        step, at = GROWTH * away.ravel(), near.ravel()
        from_ = np.repeat(np.arange(len(near)), count)
        for _ in range(200):
            before = spacing
            spacing = np.minimum(spacing, (spacing[near] + GROWTH * away).min(axis=1))
            np.minimum.at(spacing, at, spacing[from_] + step)  # being a neighbour is not mutual
            if (spacing > 0.99 * before).all():
                break
        return spacing

    def __call__(self, x: np.ndarray) -> np.ndarray:
        x = np.asarray(x, float)
        count = min(_ASKED, len(self.points))
        away, near = self._tree.query(x, k=range(1, count + 1))
        return np.minimum(self.largest, (self.spacing[near] + GROWTH * away).min(axis=1))

    @property
    def largest_used(self) -> float:
        """The largest of the spacings at the points."""
        return float(self.spacing.max())

    def scaled(self, factor: float) -> SpacingField:
        """The same everywhere so many times as large."""
        return SpacingField(self.points, factor * self.spacing, factor * self.largest)

    def joined(self, points: np.ndarray, spacing: np.ndarray) -> SpacingField:
        """With further points, between all of which the smaller spacing counts."""
        if not len(points):
            return self
        own = np.minimum(spacing, self(points))
        return SpacingField(
            np.concatenate([self.points, points]), np.concatenate([self.spacing, own]), self.largest
        )
