"""What gives the states of an evolution their local polynomials."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import nearest
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.discretization.pencil.fits import LocalFits
from jsmitsm.taylor.multi_indices import count


class StateFit:
    """Gives a Solution the local polynomials of one state of an evolution, from its values alone."""

    def __init__(self, cloud: Cloud, degree: int, make: Callable[[], LocalFits] | None = None):
        self.cloud, self.degree, self._make = cloud, degree, make
        self._fits: LocalFits | None = None

    def coefficients(self, values: Any) -> Any:
        """Taylor coefficients (N, F, K)."""
        if self._fits is None and self._make is not None:
            self._fits = self._make()
        if self._fits is None:
            points = np.asarray(self.cloud.points)
            near = nearest(points, min(2 * count(points.shape[1], self.degree), len(points))).indices
            self._fits = LocalFits(points, np.asarray(near), np.arange(len(points)), self.degree)
        return self._fits.coefficients(values)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_make": None, "_fits": None}

    def discretization(self) -> Any:
        """There is none: the estimate is the evolution's to make."""
        raise ValueError("error_estimate: a state alone has none; ask the evolution, run.error_estimate()")


class RegionsStateFit(StateFit):
    """The same where there are several regions: each has polynomials of its own."""

    def __init__(self, cloud: RegionCloud, degree: int, make: list[Callable[[], LocalFits] | None] | None = None):
        super().__init__(cloud, degree)
        makers = make or [None] * len(cloud.regions)
        self.parts = [StateFit(cloud.region(n), degree, m) for n, m in zip(cloud.regions, makers)]

    def coefficients(self, values: Any) -> Any:
        assert isinstance(self.cloud, RegionCloud)
        values = np.asarray(values)
        found = [part.coefficients(values[ids]) for part, ids in zip(self.parts, self.cloud.regions.values())]
        out = np.zeros((*values.shape, found[0].shape[-1]))
        for ids, own in zip(self.cloud.regions.values(), found):
            out[ids] = own
        return out


def state_fit(cloud: Cloud, degree: int) -> StateFit:
    """Of states on any cloud."""
    return RegionsStateFit(cloud, degree) if isinstance(cloud, RegionCloud) else StateFit(cloud, degree)
