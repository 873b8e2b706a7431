"""What a picture paints: triangles up to the true outline of a domain, or of a slice through it, and values on them."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.cloud.triangulation import cut, simplices

AXES = "xyz"
# Contours are refined by the local polynomials until they have this many triangles.
_FINE = 6000
# An outline is looked for on so many lines across a domain.
_LINES = 300


class Piece(NamedTuple):
    """One domain or slice, or one region of it."""

    places: np.ndarray  # (P, 2)
    triangles: np.ndarray  # (T, 3)
    values: np.ndarray  # (P,) or (P, F)
    outline: list[np.ndarray]  # loops (V, 2), holes the other way round; none where nothing but the particles is known


def pieces(cloud: Cloud, numbers: np.ndarray, anywhere: Callable | None, axis: int = -1, position: float = 0.0,
           outlined: bool = True) -> list[Piece]:  # fmt: skip
    """What is drawn of a 2D domain, or where a plane across ``axis`` cuts a 3D one: a piece for each region, so that
    jumps stay sharp.

    numbers (N,) or (N, F): values at the particles; anywhere: the same at any points, None where nobody knows; not
    outlined are slices that end where the facets between the particles do.
    """
    if not isinstance(cloud, RegionCloud):
        return [_piece(cloud, numbers, anywhere, axis, position, outlined)]
    out = []
    for name, ids in cloud.regions.items():
        part, own = cloud.region(name), None if anywhere is None else partial(anywhere, region=name)
        reach = np.asarray(part.points)[:, axis]
        if axis < 0 or reach.min() < position < reach.max():
            out.append(_piece(part, numbers[ids], own, axis, position, outlined))
    return out or [_piece(cloud.region(next(iter(cloud.regions))), numbers, anywhere, axis, position, outlined)]


def _piece(cloud: Cloud, numbers: np.ndarray, anywhere: Callable | None, axis: int, position: float, outlined: bool
           ) -> Piece:  # fmt: skip
    points = np.asarray(cloud.points, dtype=float)
    loops = outline(cloud, axis, position) if outlined else []
    kept = [k for k in range(cloud.dim) if k != axis]
    if anywhere is None:
        if axis < 0:
            return Piece(points, simplices(cloud), numbers, loops)
        cells, at, z = _cut(cloud, points, numbers, axis, position)
        return Piece(at[:, kept], cells, z, loops)
    if axis >= 0:
        places, cells = _sliced(cloud, points, axis, position, loops)
    elif loops:
        places, cells = _filled(cloud, points, loops)
    else:
        places, cells = points, simplices(cloud)
    given = len(points) if axis < 0 else 0
    places, cells = _refined(places, cells)
    there = places if axis < 0 else np.insert(places, axis, position, axis=1)
    # The particles keep the values that were solved for, held ones among them.
    fine = _believed(cloud, points, numbers, there[given:], np.asarray(anywhere(there[given:])))
    return Piece(places, cells, np.concatenate([numbers, fine]) if given else fine, loops)


def _believed(cloud: Cloud, points: np.ndarray, numbers: np.ndarray, places: np.ndarray, values: np.ndarray
              ) -> np.ndarray:  # fmt: skip
    """Values between the particles, near the boundary none beyond those at all particles: a peak may lie between two of
    them, but what a polynomial adds to values held on a boundary, round a corner most of all, is its own."""
    from scipy.spatial import cKDTree

    near = cKDTree(points).query(places, k=min(2 * cloud.dim, len(points)))[1]
    rim = np.zeros(len(points), bool)
    rim[cloud.boundary] = True
    within = np.clip(values, numbers.min(axis=0), numbers.max(axis=0))
    return np.where(rim[near].any(axis=1).reshape(-1, *(1,) * (values.ndim - 1)), within, values)


def _refined(places: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles cut into four at the middles of their sides until there are enough; the given places stay in front."""
    from matplotlib.tri import Triangulation, UniformTriRefiner

    times = max(0, math.ceil(math.log(_FINE / len(cells), 4)))
    coarse: Any = Triangulation(places[:, 0], places[:, 1], cells)
    finer: Any = UniformTriRefiner(coarse).refine_triangulation(subdiv=times)
    return np.stack([finer.x, finer.y], axis=1), finer.triangles


def _cut(cloud: Cloud, points: np.ndarray, numbers: np.ndarray, axis: int, position: float) -> tuple:
    """Triangles, places (P, 3) and values of a slice, by the tetrahedra between the particles."""
    cells, at, edges = cut(points, simplices(cloud), axis, position)
    if not len(cells):
        raise ValueError(
            f"at: the plane {AXES[axis]} = {position:g} does not meet the domain, "
            f"which reaches from {points[:, axis].min():g} to {points[:, axis].max():g}"
        )
    a, b = points[edges].transpose(1, 0, 2)
    share = (at[:, axis] - a[:, axis]) / (b[:, axis] - a[:, axis])
    share = share.reshape(-1, *(1,) * (numbers.ndim - 1))
    return cells, at, numbers[edges[:, 0]] * (1 - share) + numbers[edges[:, 1]] * share


def _filled(cloud: Cloud, points: np.ndarray, loops: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Triangles between the particles and places on the outline, which the sides of the triangles follow."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    gap = tree.query(points, k=2)[0][:, 1]
    rim = np.concatenate([_divided(loop, tree, gap) for loop in loops])
    away, near = tree.query(rim)
    return _inside(cloud, np.concatenate([points, rim[away > 0.1 * gap[near]]]))


def _sliced(cloud: Cloud, points: np.ndarray, axis: int, position: float, loops: list[np.ndarray]
            ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Triangles of a slice and their places (P, 2)."""
    kept = [k for k in range(3) if k != axis]
    if not loops:
        cells, at, _ = _cut(cloud, points, points[:, 0], axis, position)
        return at[:, kept], cells
    rim = np.concatenate([loop[: -1 if len(loop) > 1 and (loop[0] == loop[-1]).all() else None] for loop in loops])
    lo, hi = rim.min(axis=0), rim.max(axis=0)
    step = (hi - lo).max() / 40
    grid = np.stack(np.meshgrid(*(np.arange(a + step / 2, b, step) for a, b in zip(lo, hi))), axis=-1).reshape(-1, 2)
    inside = cloud._shape.distance(np.insert(grid, axis, position, axis=1))[0] < -0.3 * step
    return _inside(cloud, np.concatenate([grid[inside], rim]), axis, position)


def _inside(cloud: Cloud, places: np.ndarray, axis: int = -1, position: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Places (P, 2) and those triangles between them that lie in the domain."""
    from scipy.spatial import Delaunay

    cells = Delaunay(places).simplices
    middle = places[cells].mean(axis=1)
    middle = middle if axis < 0 else np.insert(middle, axis, position, axis=1)
    sides = places[cells[:, 1:]] - places[cells[:, :1]]
    solid = np.abs(np.linalg.det(sides)) > 1e-9 * (sides**2).sum(axis=(1, 2))
    return places, cells[solid & (cloud._shape.distance(middle)[0] < 0)]


def _divided(loop: np.ndarray, tree: Any, gap: np.ndarray) -> np.ndarray:
    """Places on a loop about half as far apart as the particles beside it; its corners among them if it has few."""
    ahead = np.roll(loop, -1, axis=0)
    length = np.linalg.norm(ahead - loop, axis=1)
    wanted = 0.5 * gap[tree.query(loop)[1]]
    along = np.cumsum(length / wanted)
    if (length < wanted).all():  # the samples of a curve: some of them will do
        return loop[np.unique(np.searchsorted(along, np.arange(int(along[-1]) + 1)), return_index=False) % len(loop)]
    counts = np.maximum(1, np.ceil(length / wanted).astype(int))
    return np.concatenate([a + np.arange(n)[:, None] / n * (b - a) for a, b, n in zip(loop, ahead, counts)])


def outline(cloud: Cloud, axis: int = -1, position: float = 0.0) -> list[np.ndarray]:
    """Loops (V, 2) round a 2D domain or a slice of a 3D one; none if its maker left no shape.

    >>> import jsmitsm as js
    >>> [len(loop) for loop in outline(js.from_polygon([(0, 0), (1, 0), (1, 1), (0, 1)], 0.2))]
    [4]
    """
    shape = cloud._shape
    if shape is None or cloud.dim == 1:
        return []
    if hasattr(shape, "loops"):
        return shape.loops
    from contourpy import contour_generator

    kept = [k for k in range(cloud.dim) if k != axis]
    lo, hi = np.asarray(shape.lo)[kept], np.asarray(shape.hi)[kept]
    margin = 1e-3 * (hi - lo).max()  # a domain may touch its box
    step = (hi - lo).max() / _LINES
    x, y = (np.arange(a - margin, b + margin + step, step) for a, b in zip(lo, hi))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    there = grid if axis < 0 else np.insert(grid, axis, position, axis=1)
    level = shape.distance(there)[0].reshape(len(y), len(x))
    loops: Any = contour_generator(x, y, level).lines(0.0)
    return [loop[:-1] for loop in loops if len(loop) > 4]


def clipped(ax: Any, artist: Any, loops: list[np.ndarray]) -> None:
    """What is drawn ends where the domain does."""
    if not loops:
        return
    from matplotlib.path import Path

    closed = [Path(np.concatenate([loop, loop[:1]]), closed=True) for loop in loops]
    artist.set_clip_path(Path.make_compound_path(*closed), ax.transData)
