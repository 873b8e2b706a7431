"""Polygons with holes: their checks, boundary particles and signed distance, all on the host.

shapely, an optional extra, is asked for nothing here: its search of nearest edges took 2.7 times as long (2000 edges,
100,000 points) and tells no direction, and it names a place where a polygon crosses itself, not the edges.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from jsmitsm.cloud import filling, levelset
from jsmitsm.cloud.lattices.path import followed
from jsmitsm.cloud.packing import relaxation
from jsmitsm.cloud.packing.octree import Spacing
from jsmitsm.runtime.errors import TooCoarse, listed, numbers

_SHARP = np.deg2rad(20.0)  # a vertex that turns by more is a corner of the shape, not a sample of a curve


def checked_holes(holes: Any) -> list[Any]:
    if isinstance(holes, (str, Mapping)):
        raise ValueError(f"holes: expected a sequence of polygons (V, 2), got {holes!r}")
    holes = listed("holes", holes, "a sequence of polygons (V, 2)")
    if any(np.ndim(hole) == 1 for hole in holes):
        raise ValueError("holes: expected a sequence of polygons (V, 2), got one polygon; pass holes=[vertices]")
    return holes


def checked_loop(name: str, vertices: Any) -> np.ndarray:
    """Vertices (V, 2) of a polygon, counter-clockwise, not closed."""
    try:
        loop = numbers(name, vertices)
    except (TypeError, ValueError, OverflowError):
        loop = np.zeros(0)
    if loop.ndim != 2 or loop.shape[1] != 2:
        raise ValueError(f"{name}: expected an array of shape (V, 2), got {np.shape(loop)}")
    if not np.isfinite(loop).all():
        raise ValueError(f"{name}: not finite at vertex {np.flatnonzero(~np.isfinite(loop).all(axis=1))[0]}")
    if len(loop) > 1 and (loop[0] == loop[-1]).all():
        loop = loop[:-1]  # many programs repeat the first vertex to close the polygon
    if len(loop) < 3:
        raise ValueError(f"{name}: {len(loop)} different vertices, at least 3 are needed for a polygon")
    same = np.flatnonzero((loop == np.roll(loop, -1, axis=0)).all(axis=1))
    if len(same):
        raise ValueError(f"{name}: vertex {same[0]} at {loop[same[0]]} is repeated by the next; drop one")
    return loop if _area(loop) > 0 else loop[::-1]


def _area(loop: np.ndarray) -> float:
    """Signed area by the shoelace formula, about the first vertex to keep digits."""
    x, y = (loop - loop[0]).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2


def check_crossings(loops: list[np.ndarray], names: list[str]) -> None:
    """Raise if edges meet anywhere but at the vertex they share."""
    a = np.concatenate(loops)
    b = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    owner = np.repeat(np.arange(len(loops)), [len(loop) for loop in loops])
    number = np.split(np.arange(len(a)), np.cumsum([len(loop) for loop in loops])[:-1])
    after = np.concatenate([np.roll(own, -1) for own in number])

    def side(p, q, r):  # which side of pq is r on; zero within round-off
        u, v = q - p, r - p
        turn = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
        noise = 1e-12 * np.linalg.norm(u, axis=-1) * np.maximum(np.linalg.norm(v, axis=-1), np.linalg.norm(u, axis=-1))
        return np.where(np.abs(turn) <= noise, 0.0, np.sign(turn))

    bad: list[tuple[int, int]] = []
    for i, j in _close_edges(np.minimum(a, b), np.maximum(a, b)):
        p, q, c, d = a[i], b[i], a[j], b[j]
        here, there = side(p, q, c), side(p, q, d)
        meet = (here * there <= 0) & (side(c, d, p) * side(c, d, q) <= 0)
        # Neighbours meet at their vertex; they overlap only where one folds back onto the other.
        folded = (here == 0) & (there == 0) & (((d - c) * (q - p)).sum(axis=1) < 0)
        wrong = meet & ((after[i] != j) & (after[j] != i) | folded)
        bad += zip(i[wrong], j[wrong])
    if bad:
        first, k = min(bad)
        one, two = names[owner[first]], names[owner[k]]
        what = f"{one}: crosses or touches itself" if one == two else f"{two}: crosses or touches {one}"
        raise ValueError(
            f"{what}, the edge from {a[first]} to {b[first]} meets the one from {a[k]} to {b[k]}; "
            "reorder or move the vertices (polygons that meet must be joined into one)"
        )


def _close_edges(low: np.ndarray, high: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs i < j of edges whose boxes (E, 2) meet, some at a time: a sweep along the first axis."""
    order = np.argsort(low[:, 0])
    place = np.arange(len(order))
    count = np.searchsorted(low[order, 0], high[order, 0], side="right") - place - 1
    for some in np.array_split(place, 1 + count.sum() // 1_000_000):
        one = np.repeat(some, count[some])
        two = one + 1 + np.arange(len(one)) - np.repeat(np.cumsum(count[some]) - count[some], count[some])
        i, j = order[one], order[two]
        meet = (low[j, 1] <= high[i, 1]) & (low[i, 1] <= high[j, 1])
        yield np.minimum(i, j)[meet], np.maximum(i, j)[meet]


def check_nesting(loops: list[np.ndarray], names: list[str]) -> None:
    """Raise unless every hole is inside of the outer polygon and of no other hole."""
    for k in range(1, len(loops)):
        if not _inside(loops[k][:1], loops[:1])[0]:
            raise ValueError(
                f"{names[k]}: lies outside of the polygon (its vertex {loops[k][0]}); holes must be inside of it"
            )
        for other in range(1, len(loops)):
            if other != k and _inside(loops[k][:1], [loops[other]])[0]:
                raise ValueError(f"{names[k]}: lies inside of {names[other]}; a hole in a hole cuts nothing, drop it")


def _inside(x: np.ndarray, loops: list[np.ndarray]) -> np.ndarray:
    """Even-odd rule for points (M, 2), in horizontal bands so that each point meets few edges."""
    a = np.concatenate(loops)
    b = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    low, high = np.minimum(a[:, 1], b[:, 1]), np.maximum(a[:, 1], b[:, 1])
    bands = int(np.clip(len(a) // 8, 1, 512))
    cuts = np.linspace(low.min(), high.max(), bands + 1)
    band = np.clip(np.searchsorted(cuts, x[:, 1], side="right") - 1, 0, bands - 1)
    order = np.argsort(band, kind="stable")
    ends = np.searchsorted(band[order], np.arange(bands + 1))
    result = np.zeros(len(x), bool)
    for k in range(bands):
        rows = order[ends[k] : ends[k + 1]]
        edges = np.flatnonzero((low <= cuts[k + 1]) & (high >= cuts[k]) & (high > low))
        for some in np.array_split(edges, 1 + len(edges) * len(rows) // 2_000_000) if len(rows) else ():
            (ax, ay), (bx, by) = a[some].T, b[some].T
            px, py = x[rows, :1], x[rows, 1:]
            across = ((ay > py) != (by > py)) & (px < ax + (py - ay) * ((bx - ax) / (by - ay)))
            result[rows] ^= across.sum(axis=1) % 2 == 1
    return result


def _turns(loop: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The outward normals of the edges behind and before each vertex of a loop, and the angle between them."""
    edge = np.roll(loop, -1, axis=0) - loop
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    before = np.roll(normal, 1, axis=0)
    across = np.abs(before[:, 0] * normal[:, 1] - before[:, 1] * normal[:, 0])
    return normal, before, np.arctan2(across, (before * normal).sum(axis=1))


def sharp_vertices(loop: np.ndarray) -> np.ndarray:
    """Those vertices (C, 2) of a loop that are corners of the shape."""
    return loop[_turns(loop)[2] > _SHARP]


def with_vertices(loop: np.ndarray, forced: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A loop with the points ``forced`` (C, 2) that lie on its edges as vertices, and which vertices these are."""
    size = np.ptp(loop, axis=0).max()
    start, step = loop, np.roll(loop, -1, axis=0) - loop
    square = (step * step).sum(axis=1)
    along = ((forced[:, None] - start) * step).sum(axis=2) / square
    away = np.linalg.norm(start + np.clip(along, 0.0, 1.0)[..., None] * step - forced[:, None], axis=2)
    point, edge = np.nonzero(away <= 1e-9 * size)
    position = edge + np.clip(along[point, edge], 0.0, 1.0)
    gap = np.abs(forced[point][:, None] - loop[None]).max(axis=2).min(axis=1, initial=np.inf)
    new = gap > 1e-9 * size
    forced_at = np.unique(np.abs(forced[point][~new][:, None] - loop[None]).max(axis=2).argmin(axis=1))
    order = np.argsort(np.concatenate([np.arange(len(loop)), position[new]]), kind="stable")
    points = np.concatenate([loop, forced[point][new]])[order]
    mask = np.concatenate([np.isin(np.arange(len(loop)), forced_at), np.ones(int(new.sum()), bool)])[order]
    return points, mask


def edge_particles(
    loop: np.ndarray, forced: np.ndarray | None = None, *, spacing: Spacing, name: str
) -> levelset.Boundary:
    """Particles (B, 2) on the edges of a polygon and at its corners, outward normals right of the way.

    forced (V,) bool: vertices that are particles in any case.
    """
    ahead = np.roll(loop, -1, axis=0)
    normal, before, turn = _turns(loop)
    paths = [followed(a, b, spacing) for a, b in zip(loop, ahead)]
    lengths = np.array([filling.path_lengths(path, spacing)[-1] for path in paths])
    if lengths.sum() < levelset.LEAST:
        raise TooCoarse(
            f"spacing: too coarse for the shape, the outline of {name} is only "
            f"{lengths.sum():.2g} times as long as the spacing, at least {levelset.LEAST:g} are needed"
        )
    sharp = turn > _SHARP
    if forced is not None:
        sharp = sharp | forced
    tight = np.flatnonzero(sharp & np.roll(sharp, -1) & (lengths < 0.1))
    if len(tight):
        raise TooCoarse(
            f"spacing: too coarse for the shape, the edge of {name} from {loop[tight[0]]} to {ahead[tight[0]]} is only "
            f"{lengths[tight[0]]:.2g} spacings long; reduce the spacing there or simplify the polygon"
        )
    kept = sharp | (np.minimum(lengths, np.roll(lengths, 1)) > 0.75)
    points, normals = [], []
    first = int(np.argmax(kept))  # the first vertex if none is kept
    stops = np.flatnonzero(np.roll(kept, -first))
    stops = np.append(stops if len(stops) else [0], len(loop))
    for i, j in zip(stops[:-1], stops[1:]):
        numbers = (first + np.arange(i, j)) % len(loop)
        path = np.concatenate([paths[k][:-1] for k in numbers] + [ahead[numbers[-1]][None]])
        piece = np.concatenate([np.full(len(paths[k]) - 1, k) for k in numbers])
        at, where = filling.divide(path, spacing)
        points.append(at[:-1])
        normals.append(normal[piece[where[:-1]]])
        bisector = before[numbers[0]] + normal[numbers[0]]
        normals[-1][0] = bisector / np.linalg.norm(bisector)
    at, outward = np.concatenate(points), np.concatenate(normals)
    firsts = np.cumsum([0] + [len(part) for part in points[:-1]])  # the vertices that are kept
    order = np.concatenate([firsts, np.setdiff1d(np.arange(len(at)), firsts)])
    order = order[relaxation.uncrowded(at[order], outward[order], spacing(at[order]), len(firsts))]
    return levelset.Boundary(at[np.sort(order)], outward[np.sort(order)])


class PolygonRegion:
    """Signed distance of a polygon with holes, by the nearest of many short pieces of its edges."""

    piecewise = True

    def __init__(self, loops: list[np.ndarray], spacing: Spacing):
        from scipy.spatial import cKDTree

        self.loops = loops
        chains = [
            filling.divide(followed(a, b, spacing), spacing)[0]
            for loop in loops
            for a, b in zip(loop, np.roll(loop, -1, axis=0))
        ]
        self._start = np.concatenate([chain[:-1] for chain in chains])
        self._step = np.concatenate([np.diff(chain, axis=0) for chain in chains])
        self._tree = cKDTree(self._start + self._step / 2)

    def distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance (M,), negative inside, and the unit direction of its growth (M, 2)."""
        if not len(x):
            return np.zeros(0), np.zeros((0, 2))
        near = self._tree.query(x, k=min(6, len(self._start)))[1]
        offset, step = x[:, None] - self._start[near], self._step[near]
        along = np.clip((offset * step).sum(axis=2) / (step * step).sum(axis=2), 0.0, 1.0)
        away = offset - along[..., None] * step
        square = (away * away).sum(axis=2)
        best = square.argmin(axis=1)
        row = np.arange(len(x))
        size = np.sqrt(square[row, best])
        sign = np.where(_inside(x, self.loops), -1.0, 1.0)
        return sign * size, away[row, best] * (sign / np.maximum(size, 1e-300))[:, None]
