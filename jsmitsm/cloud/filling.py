"""Evenly spaced particles inside of a domain: a lattice, or scattered by an octree; relaxed, holes filled.

A domain is known here only through ``distance(x (M, D)) -> (d (M,), outward (M, D))``, a signed
distance that need be accurate only near the boundary. Everything runs on the host in numpy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jsmitsm.cloud.packing.lattice import lattice
from jsmitsm.cloud.packing.octree import Region, Spacing, morton, refine
from jsmitsm.cloud.packing.relaxation import DENSITY, settled
from jsmitsm.runtime.errors import IN_FUNCTIONS, numbers, short

SpacingLike = float | Callable[[np.ndarray], Any]


class Constant:
    """The same spacing everywhere."""

    def __init__(self, value: float):
        self.value = value

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return np.full(len(x), self.value)


def spacing_function(spacing: Any) -> Spacing:
    """A number or a user's function as a function (M, D) -> (M,) that checks what it returns."""
    if not callable(spacing):
        value = np.array(None) if isinstance(spacing, jax.core.Tracer) else np.asarray(spacing)
        if value.ndim or value.dtype.kind not in "fiu" or not np.isfinite(value) or value <= 0:
            raise ValueError(
                f"spacing: expected a positive finite number or a function (M, D) -> (M,), got {short(spacing)}"
            )
        return Constant(float(value))

    def checked(x: np.ndarray) -> np.ndarray:
        try:
            given = spacing(x)
        except IN_FUNCTIONS as error:
            raise ValueError(
                f"spacing: the function fails for points of shape {x.shape} ({type(error).__name__}: {error}); "
                "expected one of points (M, D) that returns lengths (M,)"
            ) from error
        try:
            h = numbers("spacing", given)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"spacing: the function returned {short(given)}, expected numbers (M,)") from None
        if h.shape != (len(x),):
            raise ValueError(
                f"spacing: the function returned shape {h.shape} for points of shape {x.shape}, "
                f"expected {(len(x),)}; compute it from x[:, 0], x[:, 1], ..."
            )
        bad = np.flatnonzero(~(np.isfinite(h) & (h > 0)))
        if len(bad):
            raise ValueError(
                f"spacing: the function returned {h[bad[0]]} at {x[bad[0]]}, expected positive finite lengths "
                "everywhere in the domain; bound it from below with np.maximum"
            )
        return h

    return checked


def fill(
    region: Region, spacing: Spacing, lo: np.ndarray, hi: np.ndarray, boundary: np.ndarray, seed: int, uniform: bool
) -> np.ndarray:
    """Interior particles (M, D) for a given boundary (B, D), evenly spaced, along a Morton curve."""
    if len(lo) == 1:
        return _fill_line(region, spacing, np.sort(boundary[:, 0]))
    rng = np.random.default_rng(seed)
    if uniform:
        points = lattice(region, float(spacing(lo[None])[0]), lo, hi, boundary, rng)
        return points[np.argsort(morton(points, lo, hi), kind="stable")]
    points = _scatter(region, spacing, lo, hi, rng)
    directions = lambda around, count: rng.normal(size=(count * len(around), len(lo)))  # noqa: E731
    points = settled(region, points, boundary, spacing, directions)
    return points[np.argsort(morton(points, lo, hi), kind="stable")]


def _fill_line(region: Region, spacing: Spacing, ends: np.ndarray) -> np.ndarray:
    """Interior particles of the intervals between successive ends that lie in the domain."""
    parts = [np.zeros((0, 1))]
    for a, b in zip(ends[:-1], ends[1:]):
        if region.distance(np.array([[(a + b) / 2]]))[0][0] < 0:
            parts.append(divide(np.linspace(a, b, 2001)[:, None], spacing)[0][1:-1])
    return np.concatenate(parts)


def divide(path: np.ndarray, spacing: Spacing) -> tuple[np.ndarray, np.ndarray]:
    """Points (n + 1, D) along a path (M, D), ends kept, a constant number of local spacings apart.

    Also the piece of the path each lies on: k between path[k] and path[k + 1].
    """
    lengths = path_lengths(path, spacing)
    at = np.linspace(0.0, lengths[-1], max(1, int(np.rint(lengths[-1]))) + 1)
    points = np.stack([np.interp(at, lengths, x) for x in path.T], axis=1)
    points[0], points[-1] = path[0], path[-1]
    return points, np.clip(np.searchsorted(lengths, at, side="right") - 1, 0, len(path) - 2)


def path_lengths(path: np.ndarray, spacing: Spacing) -> np.ndarray:
    """Lengths (M,) along a path (M, D) from its start, in local spacings."""
    rate = 1.0 / spacing(path)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1) * (rate[1:] + rate[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])


def _scatter(
    region: Region, spacing: Spacing, lo: np.ndarray, hi: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """A start of the right density: octree cells of at most one particle each, dithered along a Morton curve."""
    dim = len(lo)
    fraction = DENSITY[dim] ** (-1.0 / dim)
    shift = rng.uniform(0.0, 0.5, dim) * float((hi - lo).max()) / 100
    cells, _ = refine(region, spacing, lo - shift, hi + shift, fraction, True)
    order = np.argsort(morton(cells.centers, lo, hi), kind="stable")
    width = cells.widths[order]
    expected = np.cumsum(DENSITY[dim] * (width / cells.spacing[order]) ** dim) * (1 - 1e-9)
    chosen = np.diff(np.floor(expected + rng.uniform()), prepend=0.0) > 0
    jitter = rng.uniform(-0.45, 0.45, (len(expected), dim)) * width[:, None]
    points = (cells.centers[order] + jitter)[chosen]
    return points[region.distance(points)[0] < 0]


