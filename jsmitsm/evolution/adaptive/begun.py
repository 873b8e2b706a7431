"""A first cloud that sees the start, and the spacing of a cloud that somebody else made."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from jsmitsm.adaptation.marking import marks, next_spacing
from jsmitsm.adaptation.spacing_field import SpacingField
from jsmitsm.cloud.cloud import Cloud
from jsmitsm.evolution.space.local_fits import state_fit
from jsmitsm.particle.polynomials import monomials_on_host

# The start may be missed between the particles by this part of the tolerance; so many clouds are tried.
PART, _TRIES = 0.1, 12


def spacing_of(cloud: Cloud) -> SpacingField:
    """The spacing of a cloud, the mean distance of the nearest particles around each."""
    points = np.asarray(cloud.points)
    count = min(2 * cloud.dim, len(points) - 1)
    h = cKDTree(points).query(points, k=count + 1)[0][:, 1:].mean(axis=1)
    return SpacingField(points, h, float(np.ptp(points, axis=0).max()))


def missed(cloud: Cloud, values: np.ndarray, start: Callable[[np.ndarray], np.ndarray], degree: int) -> np.ndarray:
    """By how much the local polynomials of the values (N, F) miss ``start``, (M, D) -> (M, F), halfway to the
    neighbours, (N,)."""
    points = np.asarray(cloud.points)
    found = np.asarray(state_fit(cloud, degree).coefficients(values))
    near = cKDTree(points).query(points, k=min(2 * cloud.dim + 1, len(points)))[1][:, 1:]
    worst = np.zeros(len(points))
    for other in near.T:
        offset = 0.5 * (points[other] - points)
        there = np.einsum("nfk,nk->nf", found, monomials_on_host(offset.T, degree).T)
        away = np.abs(start(points + offset) - there).max(axis=1)
        worst = np.maximum(worst, np.where(np.isfinite(away), away, 0.0))  # beside a hole a start need not be defined
    return worst


def seen(
    cloud: Cloud, spacing: SpacingField, start: Callable[[np.ndarray], np.ndarray], degree: int, tol: float,
    made: Callable[[SpacingField], Cloud], most: int,
) -> tuple[Cloud, SpacingField]:  # fmt: skip
    """The cloud, or a finer one where it does not see the start to a part of the tolerance."""
    for _ in range(_TRIES):
        points = np.asarray(cloud.points)
        values = start(points)
        away = missed(cloud, values, start, degree) / (np.abs(values).max(initial=0.0) or 1.0)
        if not away.max(initial=0.0) > PART * tol or len(cloud) >= most:
            break
        found = marks(points, spacing(points), away, degree + 1.0, None)
        h, _ = next_spacing(found, degree + 1.0, float(away.max()), PART * tol, most, lambda some: float(some.max()))
        spacing = SpacingField(points, np.minimum(h, spacing(points)), spacing.largest)
        cloud = made(spacing)
    return cloud, spacing
