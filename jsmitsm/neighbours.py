"""Neighbour search on the host: padded stencils of fixed width."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jsmitsm.clouds import Cloud
from jsmitsm.kernels import EDGE

# Neighbours at the same distance up to this enter together: rounding must not choose among them.
_TIE = 1e-7


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stencils:
    """Every particle's neighbours, padded to one width.

    Attributes
    ----------
    indices : (N, w) int32 array; the particle itself comes first, -1 fills the row.
    radius : (N,) float array, the distance within which all particles are listed.
    """

    indices: Any
    radius: Any

    @property
    def width(self) -> int:
        return self.indices.shape[1]

    def __len__(self) -> int:
        return self.indices.shape[0]

    def __repr__(self) -> str:
        return f"Stencils({len(self)} particles, at most {self.width} neighbours each, themselves counted)"


def stencils(cloud: Cloud, *, size: int | None = None, radius: Any = None) -> Stencils:
    """Find every particle's neighbours, once, on the host.

    Parameters
    ----------
    size : the number of nearest particles, the particle itself counted. Particles as far as the
        last one enter as well, so that a lattice gets closed shells.
    radius : all particles within this distance (a scalar or one per particle, length units),
        the edge included.

    Raises
    ------
    ValueError
        If not exactly one of the two is given, or the cloud has fewer particles than ``size``.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.stencils(js.rectangle((0, 0), (1, 1), (9, 9)), size=9)
    Stencils(81 particles, at most 11 neighbours each, themselves counted)
    """
    if not isinstance(cloud, Cloud):
        raise ValueError(
            f"cloud: expected a js.Cloud, got {type(cloud).__name__}; build one with js.Cloud(points, groups)"
        )
    if isinstance(cloud.points, jax.core.Tracer):
        raise ValueError(
            "cloud: its points are traced by a JAX transform, and neighbours are found on the host; "
            "build stencils = js.stencils(cloud, size=...) before the transform and pass them in"
        )
    if (size is None) == (radius is None):
        raise ValueError(f"stencils: give either size or radius, got size={size!r} and radius={radius!r}")
    points = np.asarray(cloud.points)
    if size is None:
        return within(points, radius)
    if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or size < 2:
        raise ValueError(f"size: expected a whole number of at least 2 (the particle itself counts), got {size!r}")
    return nearest(points, int(size))


def nearest(points: np.ndarray, size: int, which: np.ndarray | None = None) -> Stencils:
    """The ``size`` nearest particles and their ties, of all particles or of those in ``which``."""
    n = len(points)
    if n < size:
        raise ValueError(
            f"size: {size} neighbours asked for, but the cloud has only {n} particles; lower the order or add particles"
        )
    centres = points if which is None else points[which]
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    extra = min(n, size + max(4, size // 2))
    distance, index = tree.query(centres, k=extra)
    radius = distance[:, size - 1] * (1 + _TIE)
    inside = distance <= radius[:, None]
    if inside[:, -1].any() and extra < n:  # more ties than were looked for
        return _ragged(tree, centres, radius, which)
    width = int(inside.sum(axis=1).max())
    index = np.where(inside, index, -1)[:, :width].astype(np.int32)
    return Stencils(_self_first(index, which), radius)


def in_line(points: np.ndarray, size: int, which: np.ndarray | None = None) -> Stencils:
    """In 1D: as many neighbours on either side, ``size`` in all with the particle itself.

    The nearest ones would leave a cluster of particles without a link to the others.
    """
    n = len(points)
    x = points[:, 0]
    order = np.argsort(x, kind="stable")
    rank = np.empty(n, int)
    rank[order] = np.arange(n)
    own = np.arange(n) if which is None else which
    first = np.clip(rank[own] - size // 2, 0, n - size)
    index = order[first[:, None] + np.arange(size)].astype(np.int32)
    return Stencils(_self_first(index, which), np.abs(x[index] - x[own][:, None]).max(axis=1))


def within(points: np.ndarray, radius: Any, which: np.ndarray | None = None) -> Stencils:
    """All particles within ``radius``, of all particles or of those in ``which``."""
    centres = points if which is None else points[which]
    try:
        radius = np.asarray(radius, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"radius: expected a positive scalar or ({len(centres)},) array, got {radius!r}") from None
    if radius.shape not in ((), (len(centres),)) or not (np.isfinite(radius) & (radius > 0)).all():
        raise ValueError(f"radius: expected a positive scalar or ({len(centres)},) array, got shape {radius.shape}")
    from scipy.spatial import cKDTree

    return _ragged(cKDTree(points), centres, np.broadcast_to(radius * EDGE, (len(centres),)), which)


def _ragged(tree, centres: np.ndarray, radius: np.ndarray, which: np.ndarray | None) -> Stencils:
    """Neighbours within a radius, padded to the largest number of them."""
    lists = tree.query_ball_point(centres, radius)
    counts = np.array([len(row) for row in lists])
    index = np.full((len(centres), counts.max()), -1, np.int32)
    index[np.arange(counts.max()) < counts[:, None]] = np.concatenate([np.sort(row) for row in lists])
    return Stencils(_self_first(index, which), radius)


def _self_first(index: np.ndarray, which: np.ndarray | None) -> np.ndarray:
    """Move the particle itself to the front of its row."""
    own = np.arange(len(index)) if which is None else which
    place = np.argmax(index == own[:, None], axis=1)
    rows = np.arange(len(index))
    index[rows, place] = index[:, 0]
    index[:, 0] = own
    return index
