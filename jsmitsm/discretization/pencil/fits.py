"""Derivatives of a field from its values alone: polynomials fitted around every particle, through its own value."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.pencil.local import source_stencils
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


def local_fits(disc: Any, degree: int, alone: bool = False) -> LocalFits:
    """Polynomials of this degree around all particles; those of periodic partners are their lenders'.

    alone: without the particle's own value, which they predict.
    """
    points = np.asarray(disc.cloud.points)
    size = min(2 * count(disc.rec.dim, degree), len(points))
    ids = np.flatnonzero(disc.partner == np.arange(len(points)))
    near = source_stencils(disc, ids, size, degree)[np.searchsorted(ids, disc.partner)]
    owner = np.concatenate([np.arange(len(points)), disc.images.owner]).astype(int)
    return LocalFits(np.asarray(disc.points), near, disc.partner[owner], degree, alone)
