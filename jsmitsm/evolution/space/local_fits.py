"""Derivatives of a field from its values alone: polynomials fitted around every particle, through its own value."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import nearest
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.discretization.pencil.sparse import Sparse
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.taylor.multi_indices import MultiIndex, count, factorial, index_of, multi_indices

# Particles fitted at a time.
_CHUNK = 2000


class LocalFits:
    """Polynomials of one degree about every particle, by weighted least squares on the values of its neighbours.

    points (N', D) with periodic images behind the particles; near (N, w), the particle itself first, -1 for none;
    owners: whose value each of the points has. weights (N, K, w): Taylor coefficients from the neighbours' values.
    alone: without the particle's own value, which they predict then.
    """

    def __init__(self, points: np.ndarray, near: np.ndarray, owners: np.ndarray, degree: int, alone: bool = False):
        self.degree, self.dim, self.alone = degree, points.shape[1], alone
        self.near = owners[np.maximum(near, 0)]
        parts = [self._fitted(points, near[k : k + _CHUNK]) for k in range(0, len(near), _CHUNK)]
        self.weights = np.concatenate(parts)

    def _fitted(self, points: np.ndarray, near: np.ndarray) -> np.ndarray:
        there = near >= 0
        offset = points[np.maximum(near, 0)] - points[near[:, 0]][:, None]
        far = np.sqrt((offset**2).sum(axis=2)) * there
        h = far.max(axis=1)
        s = offset / h[:, None, None]
        root = np.sqrt(np.exp(-((2.0 * far / h[:, None]) ** 2))) * there
        root[:, 0] = 0.0
        basis = multi_indices(self.dim, self.degree)
        powers = np.stack([np.prod(s**np.array(a), axis=2) for a in basis], axis=2)
        scale = h[:, None, None] ** np.array([sum(a) for a in basis])[:, None]
        if self.alone:
            return np.linalg.pinv(root[:, :, None] * powers, rcond=1e-12) * root[:, None, :] / scale
        powers = powers[:, :, 1:]
        fit = np.linalg.pinv(root[:, :, None] * powers, rcond=1e-12) * root[:, None, :]
        fit[:, :, 0] = -fit.sum(axis=2)  # through its own value
        whole = np.zeros((len(near), len(basis), near.shape[1]))
        whole[:, 0, 0] = 1.0
        whole[:, 1:] = fit / scale[:, 1:]
        return whole

    def derivative(self, index: MultiIndex) -> Sparse:
        """The matrix (N, N) of one derivative."""
        n, w = self.near.shape
        values = self.weights[:, index_of(self.dim, self.degree)[index]] * factorial(index)
        rows = np.repeat(np.arange(n), w)
        return Sparse(values.ravel(), rows, self.near.ravel(), (n, n))

    def coefficients(self, values: Any) -> Any:
        """Taylor coefficients (N, F, K) of fields (N, F)."""
        xp = jnp if is_traced(values) else np
        return xp.einsum("nkw,nwf->nfk", self.weights, xp.asarray(values)[self.near])


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
