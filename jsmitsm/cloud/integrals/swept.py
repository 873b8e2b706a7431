"""Ways from Gauss points of facets to the boundary, and what a layer along them sweeps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Swept(NamedTuple):
    """Ways from Gauss points of facets to the boundary, along the particles' normals, interpolated."""

    base: np.ndarray  # (M, Q, D) on the facets
    way: np.ndarray  # (M, Q, D)
    reach: np.ndarray  # (M, Q), how many ways it is to the boundary
    weights: np.ndarray  # (Q,), or (M, Q)
    sides: np.ndarray  # (M, D - 1, D) of the facets
    turns: np.ndarray  # (M, D - 1, D), by which the ways change along them
    handed: np.ndarray  # (M, 1), the sign that makes volumes on the outward side of a facet positive
    outward: np.ndarray  # (M, Q, D) unit normals where the ways end

    def at(self, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Where (M, Q, D) a share of the ways is gone, and the volume (M, Q) that a unit of them sweeps there."""
        along = self.sides[:, None] + (share * self.reach)[..., None, None] * self.turns[:, None]
        volume = np.linalg.det(np.concatenate([along, self.way[:, :, None]], axis=2)) * self.handed
        return self.base + (share * self.reach)[..., None] * self.way, volume * self.weights


def simplex_rule(dim: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points as barycentric coordinates (Q, dim + 1) in a simplex, collapsed from a cube, and weights."""
    x, w = np.polynomial.legendre.leggauss(count + (dim > 1))
    x, w = (x + 1.0) / 2.0, w / 2.0
    grid = np.stack([v.ravel() for v in np.meshgrid(*[x] * dim, indexing="ij")], axis=1)
    weight = np.prod(np.stack([v.ravel() for v in np.meshgrid(*[w] * dim, indexing="ij")], axis=1), axis=1)
    left, at = np.ones(len(grid)), []
    for k in range(dim):
        at.append(left * grid[:, k])
        weight = weight * left if k else weight
        left = left * (1.0 - grid[:, k])
    return np.stack([*at, left], axis=1), weight
