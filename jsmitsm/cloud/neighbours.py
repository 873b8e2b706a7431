"""Neighbour search on the host: padded stencils of fixed width."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.particle.kernels import EDGE
from jsmitsm.runtime.arrays import Array, ArrayLike
from jsmitsm.runtime.errors import explaining, is_whole, numbers, short
from jsmitsm.runtime.interrupts import interruptible
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.threads import cores

# Neighbours at the same distance up to this enter together: rounding must not choose among them.
_TIE = 1e-7
# So many ties, or half of a stencil, are looked for at the most; further ones are found by a search within the radius.
_MOST_TIES = 4
# Particles that tell how many ties there are, and (four times as many) whether the cloud is evenly spaced.
_SAMPLE, EVEN_SAMPLE = 16, 64
# The nearest neighbour is farther than this part of the spacing around 90 % of the particles of an even cloud: 0.57 on
# a lattice jittered by 0.3 spacings, 0.67 and more on relaxed clouds, 0.36 on Halton's points, 0.18 on random ones.
_EVEN = 0.5
# Around a particle the radii of stencils of one size differ by less than this ratio, but for jumps in the spacing.
_JUMP = 2.2
# The first search of a process looks at all distances of so few particles: importing scipy.spatial takes a tenth of a
# second, several times as long. So many rows of distances stay in cache.
_ALL_PAIRS, _ROWS = 2048, 128
# Searches for fewer particles are done before a second core would have begun.
_MANY = 4000
# Particles whose neighbours are searched at a time.
_BLOCK = 1 << 14


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stencils:
    """Every particle's neighbours, padded to one width.

    Attributes
    ----------
    indices : array (N, w)
        (N, w) int32 array; the particle itself comes first, -1 fills the row.
    radius : array (N,), optional
        (N,) float array, the distance within which all particles are listed; None where nothing needs it.

    Examples
    --------
    >>> import jsmitsm as js
    >>> found = js.stencils(js.interval(0.0, 1.0, 5), size=3)
    >>> found.indices[0].tolist()
    [0, 1, 2]
    """

    indices: Array
    radius: Array | None

    @property
    def width(self) -> int:
        """The largest number of neighbours, the particle itself counted."""
        return self.indices.shape[1]

    def __len__(self) -> int:
        return self.indices.shape[0]

    def __repr__(self) -> str:
        return f"Stencils({len(self)} particles, at most {self.width} neighbours each, themselves counted)"


@explaining
@bar("neighbours")
def stencils(cloud: Cloud, *, size: int | None = None, radius: ArrayLike | None = None) -> Stencils:
    """Find every particle's neighbours, once, on the host.

    Parameters
    ----------
    cloud : Cloud
        In one of several regions neighbours are of the same region.
    size : int, optional
        The number of nearest particles, the particle itself counted. Particles as far as the last one enter as
        well, so that a lattice gets closed shells.
    radius : float or array_like (N,), optional
        All particles within this distance (a scalar or one per particle, length units), the edge included.

    Returns
    -------
    Stencils
        Every particle's neighbours.

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
        raise ValueError(f"stencils: give either size or radius, got size={short(size)} and radius={short(radius)}")
    if isinstance(cloud, RegionCloud):
        return _of_regions(cloud, size, radius)
    points = np.asarray(cloud.points)
    if size is None:
        return within(points, radius)
    if not is_whole(size, 2):
        raise ValueError(f"size: expected a whole number of at least 2 (the particle itself counts), got {short(size)}")
    return nearest(points, int(size))


def _of_regions(cloud: RegionCloud, size: int | None, radius: ArrayLike | None) -> Stencils:
    """Every particle's neighbours in its own region, numbered in the whole cloud."""
    found = []
    for name, ids in cloud.regions.items():
        own = None if radius is None else np.broadcast_to(np.asarray(radius), (len(cloud),))[ids]
        found.append((ids, stencils(cloud.region(name), size=size, radius=own)))
    near = np.full((len(cloud), max(one.width for _, one in found)), -1, np.int32)
    reach = np.zeros(len(cloud))
    for ids, one in found:
        index = np.asarray(one.indices)
        near[ids[:, None], np.arange(one.width)] = np.where(index >= 0, ids[index], -1)
        reach[ids] = one.radius
    return Stencils(near, reach)


def nearest(points: np.ndarray, size: int, which: np.ndarray | None = None) -> Stencils:
    """The ``size`` nearest particles and their ties, of all particles or of those in ``which``."""
    n = len(points)
    if n < size:
        raise ValueError(
            f"size: {size} neighbours asked for, but the cloud has only {n} particles; lower the order or add particles"
        )
    centres = points if which is None else points[which]
    tree = _searcher(points)
    _once.clear()
    # Block by block, in the order of the tree's leaves: of what a search finds little is kept.
    order = tree.indices if which is None and n > _BLOCK else np.arange(len(centres))
    radius, found = np.empty(len(centres)), []
    for some in np.split(order, range(_BLOCK, len(order), _BLOCK)):
        distance, near = _with_ties(tree, centres[some], size)
        radius[some] = distance[:, size - 1] * (1 + _TIE)
        inside = distance <= radius[some, None]
        if inside[:, -1].any() and distance.shape[1] < n:  # more ties than were looked for
            radius = _radius(tree, centres, size)
            return _ragged(points, centres, radius, which)
        width = int(inside.sum(axis=1).max())
        found.append((some, np.where(inside[:, :width], near[:, :width], -1).astype(np.int32)))
    index = found[0][1] if len(found) == 1 else np.full((len(centres), max(x.shape[1] for _, x in found)), -1, np.int32)
    if len(found) > 1:
        for some, part in found:
            index[some, : part.shape[1]] = part
    return Stencils(_self_first(index, which), radius)


def _radius(tree: Any, centres: np.ndarray, size: int) -> np.ndarray:
    """The distance (n,) within which every centre has ``size`` particles, with their ties."""
    blocks = np.split(centres, range(_BLOCK, len(centres), _BLOCK))
    return np.concatenate([_query(tree, some, size)[0][:, size - 1] for some in blocks]) * (1 + _TIE)


def replaced(stencils: Stencils, ids: np.ndarray, others: Stencils) -> Stencils:
    """The stencils with those of the particles ``ids`` taken from ``others``, one for each of them."""
    width = max(stencils.width, others.width)
    indices, radius = np.full((len(stencils), width), -1, np.int32), np.array(stencils.radius)
    indices[:, : stencils.width] = stencils.indices
    indices[ids] = np.pad(others.indices, ((0, 0), (0, width - others.width)), constant_values=-1)
    radius[ids] = others.radius
    return Stencils(indices, radius)


def _with_ties(tree: Any, centres: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances and numbers of the ``size`` nearest particles and of the next ones, up to all ties: (n, m)."""
    most = min(tree.n, size + max(_MOST_TIES, size // 2))
    sample, _ = _query(tree, _sampled(centres, _SAMPLE), most)
    ties = (sample[:, size:] <= sample[:, size - 1 : size] * (1 + _TIE)).sum(axis=1).max(initial=0)
    count = min(most, size + 1 + int(ties))
    distance, index = _query(tree, centres, count)
    left = np.flatnonzero(distance[:, -1] <= distance[:, size - 1] * (1 + _TIE))
    if len(left) and count < most:
        wider = ((0, 0), (0, most - count))
        distance, index = np.pad(distance, wider, constant_values=np.inf), np.pad(index, wider)
        distance[left], index[left] = _query(tree, centres[left], most)
    return distance, index


def _sampled(points: np.ndarray, count: int) -> np.ndarray:
    return points[np.linspace(0, len(points) - 1, min(len(points), count)).astype(int)]


def evenly_spaced(points: np.ndarray) -> bool:
    """Whether the particles keep their distance from one another, as those of lattices and relaxed clouds do.

    Judged by the distance of the nearest neighbour, in a sample, relative to the spacing around it.
    """
    return is_even(kept_distances(points, _sampled(points, EVEN_SAMPLE)))


def kept_distances(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """The distance of each centre's nearest particle (itself not counted) relative to the spacing around it."""
    count = min(3 ** points.shape[1], len(points) - 1)
    distance, _ = _query(_searcher(points), centres, count + 1)
    volume = {1: 2.0, 2: np.pi, 3: 4.0 * np.pi / 3.0}[points.shape[1]]
    spacing = distance[:, -1] * (volume / (count + 1)) ** (1.0 / points.shape[1])
    return distance[:, 1] / np.where(spacing > 0, spacing, 1.0)


def reaches(points: np.ndarray, centres: np.ndarray, size: int) -> np.ndarray:
    """The distance within which every centre (n, D) has ``size`` of the points, or all of fewer."""
    return _query(_searcher(points), centres, min(size, len(points)))[0][:, -1]


def is_even(kept: np.ndarray) -> bool:
    """Whether such distances of a sample are those of an even cloud."""
    return bool(np.sort(kept)[len(kept) // 10] > _EVEN)


def jumps(radius: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """The particles around which the spacing changes abruptly: radius (N,) and neighbours (N, w), -1 for none.

    The radius of as many neighbours doubles from inside to a corner; more is a jump.
    """
    least, most, own = radius.copy(), radius.copy(), neighbours[:, 0]
    for column in neighbours.T:
        there = radius[np.where(column >= 0, column, own)]
        np.minimum(least, there, out=least)
        np.maximum(most, there, out=most)
    return np.flatnonzero((least < radius / _JUMP) | (most > radius * _JUMP))


_once = {"all pairs"}  # emptied by the first search


def _searcher(points: np.ndarray) -> Any:
    """What finds the nearest of the points: scipy's tree, but the first time, for few, what needs no import."""
    if _once and len(points) <= _ALL_PAIRS and "scipy.spatial" not in sys.modules:
        return _AllPairs(points)
    return _tree(points)


class _AllPairs:
    """Answers as the tree does, to the last bit, but for the order of neighbours that are equally far."""

    def __init__(self, points: np.ndarray) -> None:
        self.points, self.n = points, len(points)

    def query(self, centres: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Distances and numbers of the k nearest particles, (n, k)."""
        parts = [self._nearest(centres[at : at + _ROWS], k) for at in range(0, len(centres), _ROWS)]
        distances, numbers = zip(*parts)
        return np.concatenate(distances), np.concatenate(numbers)

    def _nearest(self, centres: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        square = sum((x[:, None] - y) ** 2 for x, y in zip(centres.T, self.points.T))
        index = np.argpartition(square, k - 1, axis=1)[:, :k]
        square = np.take_along_axis(square, index, axis=1)
        order = np.argsort(square, axis=1)
        return np.sqrt(np.take_along_axis(square, order, axis=1)), np.take_along_axis(index, order, axis=1)


def _tree(points: np.ndarray) -> Any:
    from scipy.spatial import cKDTree

    # Cells halved at their middle instead of at the median: built in half the time, searched as fast.
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _query(tree: Any, centres: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances and numbers of the ``count`` nearest particles of every centre, (n, count)."""
    n = len(centres)
    if n < _MANY:
        return tree.query(centres, k=count)
    # Beside the main thread: an interrupt must not take away the arrays that the workers of the search write into.
    search = lambda places: interruptible(lambda: tree.query(places, k=count, workers=cores()))
    if n != tree.n:
        return search(centres)
    # In the order of the tree's leaves: the search finds in the cache what it found for the centre before.
    order = tree.indices
    found = search(centres[order])
    distance, index = np.empty_like(found[0]), np.empty_like(found[1])
    distance[order], index[order] = found
    return distance, index


def in_line(
    points: np.ndarray, size: int, which: np.ndarray | None = None, normals: np.ndarray | None = None
) -> Stencils:
    """In 1D: as many neighbours on either side, ``size`` in all with the particle itself.

    The nearest ones would leave a cluster of particles without a link to the others. Where outward ``normals`` face
    one another the domain has a gap, over which nobody reaches: -1 stands for what is missing on the own side.
    """
    n = len(points)
    x = points[:, 0]
    order = np.argsort(x, kind="stable")
    rank = np.empty(n, int)
    rank[order] = np.arange(n)
    own = rank[np.arange(n) if which is None else which]
    outward = np.zeros(n) if normals is None else np.nan_to_num(normals[order, 0])
    cuts = np.flatnonzero((outward[:-1] > 0) & (outward[1:] < 0)) + 1
    starts = np.concatenate([[0], cuts, [n]])
    part = np.searchsorted(starts, own, side="right")
    low, high = starts[part - 1], starts[part]
    first = np.clip(own - size // 2, low, np.maximum(low, high - size))
    place = first[:, None] + np.arange(size)
    there = place < high[:, None]
    index = np.where(there, order[np.minimum(place, n - 1)], -1).astype(np.int32)
    distance = np.where(there, np.abs(x[index] - x[order[own]][:, None]), 0.0)
    return Stencils(_self_first(index, which), distance.max(axis=1))


def within(points: np.ndarray, radius: Any, which: np.ndarray | None = None) -> Stencils:
    """All particles within ``radius``, of all particles or of those in ``which``."""
    centres = points if which is None else points[which]
    try:
        radius = numbers("radius", radius)
    except (TypeError, ValueError, OverflowError):
        came = short(radius)
        raise ValueError(f"radius: expected a positive scalar or ({len(centres)},) array, got {came}") from None
    if radius.shape not in ((), (len(centres),)) or not (np.isfinite(radius) & (radius > 0)).all():
        came = f"shape {radius.shape}" if radius.ndim else f"{radius}"
        raise ValueError(f"radius: expected positive numbers, a scalar or ({len(centres)},), got {came}")
    return _ragged(points, centres, np.broadcast_to(radius * EDGE, (len(centres),)), which)


def _ragged(points: np.ndarray, centres: np.ndarray, radius: np.ndarray, which: np.ndarray | None) -> Stencils:
    """Neighbours within a radius, padded to the largest number of them."""
    lists = _tree(points).query_ball_point(centres, radius)
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
