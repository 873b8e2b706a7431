"""The shapes of regions: what is asked of each of them, whatever it was given by."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np

from jsmitsm.cloud import contour, levelset, polygons, surface
from jsmitsm.cloud.packing.octree import Spacing
from jsmitsm.runtime.errors import numbers, short


class Shape(Protocol):
    """One region."""

    lo: np.ndarray
    hi: np.ndarray
    curved: bool  # its surface is relaxed: another region's particles cannot be added to it

    def distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance (M,), negative inside, and the unit direction of its growth (M, D)."""
        ...

    def corners(self, spacing: Spacing) -> np.ndarray:
        """Where the boundary is not smooth, (C, D)."""
        ...

    def boundary(self, spacing: Spacing, seed: int, forced: np.ndarray) -> levelset.Boundary:
        """Boundary particles, the points ``forced`` (C, D) that lie on it among them."""
        ...


class Interval:
    """A layer of a wall."""

    curved = False

    def __init__(self, a: float, b: float):
        self.lo, self.hi = np.array([a]), np.array([b])
        self.ends = np.array([[a], [b]])

    def distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        to = np.stack([self.lo[0] - x[:, 0], x[:, 0] - self.hi[0]])
        return to.max(axis=0), np.where(to[0] > to[1], -1.0, 1.0)[:, None]

    def corners(self, spacing: Spacing) -> np.ndarray:
        return self.ends

    def boundary(self, spacing: Spacing, seed: int, forced: np.ndarray) -> levelset.Boundary:
        return levelset.Boundary(self.ends.copy(), np.array([[-1.0], [1.0]]))


class Level:
    """The part of a box where a signed distance is negative."""

    def __init__(self, name: str, sdf: Any, lo: np.ndarray, hi: np.ndarray):
        self._name, self.lo, self.hi, self.curved = name, lo, hi, len(lo) == 3
        self._region = levelset.SdfRegion(sdf, lo, hi)
        self.distance = self._region.distance

    def corners(self, spacing: Spacing) -> np.ndarray:
        dim = len(self.lo)
        if dim != 2:
            return np.zeros((0, dim))
        with self._named():
            return contour.corners(self._region, spacing)

    def boundary(self, spacing: Spacing, seed: int, forced: np.ndarray) -> levelset.Boundary:
        with self._named():
            return levelset.checked(self._region, self._made(spacing, seed, forced))

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Errors tell which shape they speak of."""
        try:
            yield
        except ValueError as fault:
            raise ValueError(f"{self._name}: {fault}") from fault

    def _made(self, spacing: Spacing, seed: int, forced: np.ndarray) -> levelset.Boundary:
        dim = len(self.lo)
        if dim == 1:
            return contour.line(self._region, spacing)
        if dim == 2:
            return contour.contour(self._region, spacing, forced)
        return surface.surface(self._region, spacing, seed)


class Polygons:
    """Polygons with holes, apart from one another."""

    curved, piecewise = False, True

    def __init__(self, name: str, loops: list[np.ndarray], spacing: Spacing):
        self._name, self.loops = name, loops
        points = np.concatenate(loops)
        self.lo, self.hi = points.min(axis=0), points.max(axis=0)
        self.distance = polygons.PolygonRegion(loops, spacing).distance

    def corners(self, spacing: Spacing) -> np.ndarray:
        return np.concatenate([polygons.sharp_vertices(loop) for loop in self.loops])

    def boundary(self, spacing: Spacing, seed: int, forced: np.ndarray) -> levelset.Boundary:
        parts = [
            polygons.edge_particles(*polygons.with_vertices(loop, forced), spacing=spacing, name=self._name)
            for loop in self.loops
        ]
        return levelset.Boundary(*(np.concatenate(arrays) for arrays in zip(*parts)))


def shape_of(name: str, given: Any, bounds: Any, spacing: Spacing) -> Shape:
    """A user's shape: a signed distance, the ends of a layer, a polygon or a shapely geometry."""
    where = f"shapes[{name!r}]"
    if callable(given):
        if bounds is None:
            raise ValueError(f"bounds: needed for the signed distance {where}; give a box (lo, hi) that contains it")
        return Level(where, given, *bounds)
    if hasattr(given, "geom_type"):
        return Polygons(where, _shapely_loops(where, given), spacing)
    try:
        array = numbers(where, given)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros((0, 0, 0))
    if array.shape == (2,) and np.isfinite(array).all() and array[0] < array[1]:
        return Interval(float(array[0]), float(array[1]))
    if array.ndim == 2 and array.shape[1] == 2:
        return Polygons(where, _checked_loops(where, given, ()), spacing)
    raise ValueError(
        f"{where}: expected a signed distance (a function of x), a polygon (V, 2), a shapely geometry, or the ends "
        f"(a, b) of a layer with a < b, got {short(given)}"
    )


def _shapely_loops(where: str, geometry: Any) -> list[np.ndarray]:
    parts = list(getattr(geometry, "geoms", [geometry]))
    if not parts or any(part.geom_type != "Polygon" or part.is_empty for part in parts):
        raise ValueError(f"{where}: expected a shapely Polygon or MultiPolygon that is not empty, got {geometry!r:.80}")
    loops = []
    for part in parts:
        holes = [np.asarray(ring.coords)[:, :2] for ring in part.interiors]
        loops += _checked_loops(where, np.asarray(part.exterior.coords)[:, :2], holes)
    return loops


def _checked_loops(where: str, outer: Any, holes: Sequence[Any]) -> list[np.ndarray]:
    loops = [polygons.checked_loop(where, outer)]
    loops += [polygons.checked_loop(f"{where}, hole {k}", hole)[::-1] for k, hole in enumerate(holes)]
    names = [where, *(f"{where}, hole {k}" for k in range(len(holes)))]
    polygons.check_crossings(loops, names)
    polygons.check_nesting(loops, names)
    return loops
