"""The sides of a mesh that bound its domain, and what is refused: cells without volume, twisted, folded, overlapping or
with hanging nodes. Which way a cell's nodes run is a matter of the format, and harmless."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from jsmitsm.cloud.mesh_facets import FACETS, Cells, Sides, area, facet_nodes
from jsmitsm.runtime.errors import some

# Heights over a facet in units of the cell: below the first there is no volume, below the second a fold is the
# rounding of a file of a few digits, and moves no particle that matters.
_FLAT, _ROUNDED = 1e-10, 1e-6
# A node this near to a facet (in units of facet or cell) lies on it: the two sides of a seam that do not fit.
_ON = 1e-3
# Barycentric coordinates, to rounding.
_EDGE = 1e-8


Frames = tuple[np.ndarray, np.ndarray]  # the origins and inverse frames of simplices


class Boundary(NamedTuple):
    """The facets on the boundary, and by the number of a facet (in any order of its corners) how many cells have it."""

    outer: list[Sides]
    cells: np.ndarray
    place: np.ndarray  # by that number, the place among the outer facets, in the order of ``outer``
    asked: list[np.ndarray]  # the numbers of the facets asked for


def domain_sides(points: np.ndarray, cells: list[Cells], asked: list[np.ndarray]) -> Boundary:
    """The outer facets of a mesh of size one; ``asked``: corners (M, c) of further facets to be looked up."""
    sides = [side for block in cells for side in _sides(points, block)]
    heads = [_padded(np.sort(head, axis=1)) for head in [*(s.heads for s in sides), *asked]]
    cuts = np.cumsum([len(head) for head in heads])
    numbers = np.split(numbered(np.concatenate(heads)), cuts[:-1])
    own, wanted = np.concatenate(numbers[: len(sides)]), numbers[len(sides) :]
    total = max((int(n.max(initial=-1)) for n in numbers), default=-1) + 1
    count = np.bincount(own, minlength=total)
    outer = [s.of(count[n] == 1) for s, n in zip(sides, numbers)]
    if not any(len(s.nodes) for s in outer):
        raise ValueError(
            "mesh: no side of its cells is a boundary, as where every cell is given twice; remove the copies"
        )
    _check_neighbours(points, sides, numbers[: len(sides)], own, count)
    place = np.full(total, -1)
    place[own[count[own] == 1]] = np.arange((count == 1).sum())
    return Boundary(outer, count, place, wanted)


def _sides(points: np.ndarray, cells: Cells) -> Iterator[Sides]:
    """The facets of cells of one kind; refuse cells that have no inside."""
    dim, at = points.shape[1], points[cells.corners]
    centre, size = at.mean(axis=1), _size(at)
    vectors, parts, crossed = [], [], np.zeros(len(at), bool)
    for k, facet in enumerate(FACETS[cells.base]):
        corners = at[:, list(facet)]
        vectors.append(area(corners) * (2 * k - 1 if dim == 1 else 1))
        parts.append(np.sum((corners.mean(axis=1) - centre) * vectors[-1], axis=1) / dim)
        crossed |= dim == 3 and _crossed(corners)
    crossed |= cells.base == "quad" and _crossed(at)
    volume = np.sum(parts, axis=0)
    large = np.max([np.linalg.norm(v, axis=1) for v in vectors], axis=0)
    flat = dim * abs(volume) <= _FLAT * size * large
    if cells.base in ("hexahedron", "wedge", "pyramid"):
        crossed |= ~flat & (abs(volume) < 0.5 * np.sum(np.abs(parts), axis=0))
    for wrong, what, remedy in (
        (crossed, "whose sides cross", "its nodes are in no order that a cell has, write the mesh again"),
        (flat, "without volume", "remove such cells, or bring their nodes into order"),
    ):
        if wrong.any():
            raise ValueError(f"mesh: a cell {what} has the nodes {_cell(cells, wrong)}; {remedy}")
    for k, (facet, vector) in enumerate(zip(FACETS[cells.base], vectors)):
        sign = np.sign(volume) * (2 * k - 1 if dim == 1 else 1)
        height = dim * abs(volume) / np.maximum(np.linalg.norm(vector, axis=1), 1e-300)
        yield Sides(facet_nodes(cells, facet), len(facet), sign, height, cells.nodes)


def _size(at: np.ndarray) -> np.ndarray:
    """The diagonals of the boxes around corners (M, c, D); reduced one by one, which is many times faster."""
    low = high = at[:, 0]
    for k in range(1, at.shape[1]):
        low, high = np.minimum(low, at[:, k]), np.maximum(high, at[:, k])
    return np.linalg.norm(high - low, axis=1)


def _crossed(at: np.ndarray) -> Any:
    """Whether two sides of a quadrilateral (M, 4, D) cross each other; one corner may point inward."""
    if at.shape[1] != 4:
        return False
    at = np.pad(at, ((0, 0), (0, 0), (0, 3 - at.shape[2])))
    turns = np.cross(np.roll(at, -1, axis=1) - at, np.roll(at, 1, axis=1) - at)
    one, two = at[:, 2] - at[:, 0], at[:, 3] - at[:, 1]
    whole = np.cross(one, two)
    parallel = np.linalg.norm(whole, axis=1) <= 1e-12 * np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
    return parallel | ((np.sum(turns * whole[:, None], axis=2) < 0).sum(axis=1) > 1)


def _cell(cells: Cells, wrong: np.ndarray) -> str:
    """The first cell at fault, and how many there are."""
    which = np.flatnonzero(wrong)
    more = f" and {len(which) - 1} more" if len(which) > 1 else ""
    return f"{cells.nodes[which[0]].tolist()} ({cells.kind!r} cell {which[0]}{more})"


def _check_neighbours(
    points: np.ndarray, sides: list[Sides], numbers: list[np.ndarray], own: np.ndarray, count: np.ndarray
) -> None:
    """Refuse facets of more than two cells, and of two cells on the same side: one of them is inside out."""

    def nodes(number: int) -> list[int]:
        return next(s.heads[n == number][0].tolist() for s, n in zip(sides, numbers) if (n == number).any())

    crowded = np.flatnonzero(count > 2)
    if len(crowded):
        raise ValueError(
            f"mesh: the facet with the nodes {nodes(crowded[0])} belongs to {count[crowded[0]]} cells, which cannot be "
            "in one domain; cells are given twice or overlap, remove the copies"
        )
    turn = np.concatenate([s.sign * _run(s.heads) for s in sides])
    size = [_size(points[s.heads]) for s in sides]
    sure = np.concatenate([s.height > _ROUNDED * d for s, d in zip(sides, size)])
    both = np.bincount(own, weights=turn, minlength=len(count))
    folded = np.flatnonzero((abs(both) > 1) & (np.bincount(own, weights=sure, minlength=len(count)) > 1))
    if len(folded):
        raise ValueError(
            f"mesh: the two cells at the facet with the nodes {nodes(folded[0])} lie on the same side of it "
            f"({len(folded)} such facets): cells are inverted or overlap; untangle the mesh, or read its points again"
        )


def _run(heads: np.ndarray) -> np.ndarray:
    """+1 or -1: which way round the corners of facets (M, c) run; opposite for the two cells of a facet."""
    if heads.shape[1] == 1:
        return np.ones(len(heads))
    first = heads.argmin(axis=1)
    rows, width = np.arange(len(heads)), heads.shape[1]
    return np.where(
        heads[rows, (first + 1) % width] < heads[rows, (first - 1) % width] if width > 2 else first == 0, 1.0, -1.0
    )


def check_fit(points: np.ndarray, cells: list[Cells], outer: list[Sides]) -> None:
    """Refuse outer facets that lie on each other, cross, or reach into cells: hanging nodes, seams and overlaps."""
    _check_orders(cells)
    pieces = [part for side in outer for part in _simplices(side)]
    corners, own, sign, height = (np.concatenate(column) for column in zip(*pieces))
    plane = _frames(points, corners, sign)
    used = np.unique(np.concatenate([s.nodes.ravel() for s in outer]))
    _check_seams(points, outer, plane, corners, own, height, used)
    if points.shape[1] > 1:
        _check_crossings(points, plane, corners, own, outer)
    for block in cells:
        _check_inside(points, block, used)
    _check_pinches(points.shape[1], outer)


def _check_orders(cells: list[Cells]) -> None:
    """Refuse nodes that are a corner of one cell and the middle of another's side: they hang."""
    corners = np.unique(np.concatenate([block.corners.ravel() for block in cells]))
    for block in cells:
        middles = block.nodes[:, block.corners.shape[1] :]
        hanging = np.asarray(np.isin(middles, corners).any(axis=1))
        if hanging.any():
            raise ValueError(
                f"mesh: of the nodes {_cell(block, hanging)} a middle one is a corner of another cell: a hanging node; "
                "refine to a conforming mesh"
            )


def _simplices(side: Sides) -> list[tuple[np.ndarray, ...]]:
    """Facets as points, segments and triangles: corners (M, D), the nodes of their cells (M, 27), sign and height."""
    cell = np.pad(side.cell, ((0, 0), (0, 27 - side.cell.shape[1])), constant_values=-1)
    cuts = [[0, 1, 2], [0, 2, 3]] if side.corners == 4 else [list(range(side.corners))]
    return [(side.heads[:, cut], cell, side.sign, side.height) for cut in cuts]


def _frames(points: np.ndarray, corners: np.ndarray, sign: np.ndarray) -> Frames:
    """Origin and inverse frame of every simplex: its edges and the outward unit normal."""
    at = points[corners]
    normal = area(at) * sign[:, None]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    frame = np.stack([*(at[:, k] - at[:, 0] for k in range(1, at.shape[1])), normal], axis=2)
    frame[abs(np.linalg.det(frame)) < 1e-150] = np.inf  # half of a dart: nothing lies on it
    with np.errstate(invalid="ignore"):
        inverse = np.full_like(frame, np.nan)
        good = np.isfinite(frame).all(axis=(1, 2))
        inverse[good] = np.linalg.inv(frame[good])
    return at[:, 0], inverse


def _local(plane: Frames, which: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The smallest barycentric coordinate of points in simplices, and the height over them."""
    local = np.einsum("mij,mj->mi", plane[1][which], x - plane[0][which])
    inside = np.column_stack([local[:, :-1], 1.0 - local[:, :-1].sum(axis=1)])
    return inside.min(axis=1), local[:, -1]


def _near(centres: np.ndarray, radii: np.ndarray, points: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs (ball, point) of points in balls, some at a time."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    balls = np.flatnonzero(tree.query(centres)[0] <= radii)
    for start in range(0, len(balls), 20_000):
        some_balls = balls[start : start + 20_000]
        found = tree.query_ball_point(centres[some_balls], radii[some_balls])
        yield np.repeat(some_balls, [len(f) for f in found]), np.concatenate([*found, []]).astype(int)


def _check_seams(
    points: np.ndarray, outer: list[Sides], plane: Frames, corners: np.ndarray, own: np.ndarray, height: np.ndarray,
    used: np.ndarray,
) -> None:  # fmt: skip
    """Refuse nodes and facets on facets of cells that they do not belong to."""
    at = points[corners]
    centres = at.mean(axis=1)
    radii = np.linalg.norm(at - centres[:, None], axis=2).max(axis=1) * (1.0 + 2.0 * _ON) + 1e-12
    size = _size(at) if points.shape[1] > 1 else height
    inward, outward = _ON * np.minimum(size, height), _ON * size
    heads = np.concatenate([_padded(s.heads) for s in outer])
    tests = np.concatenate([points[used], *(points[s.heads].mean(axis=1) for s in outer)])
    # A facet's middle stands for the facet: it belongs to the cell that has all its corners.
    needs = np.concatenate([_padded(used[:, None]), heads])
    for ball, test in _near(centres, radii, tests):
        inside, high = _local(plane, ball, tests[test])
        on = (inside > -_EDGE) & (high > -inward[ball]) & (high < outward[ball])
        ball, test = ball[on], test[on]
        on = ~_has(own[ball], needs[test])
        if on.any():
            ball, test = ball[on], test[on]
            hung = np.unique(used[test[test < len(used)]])
            who = f"the nodes {some(hung)} lie" if len(hung) else "facets lie"
            raise ValueError(
                f"mesh: {who} on sides of cells that they do not belong to, as the facet at the nodes "
                f"{corners[ball[0]].tolist()}: hanging nodes, or parts whose nodes were not merged; refine to a "
                "conforming mesh, merge the nodes (in Gmsh: Coherence), or take parts apart"
            )


def _has(own: np.ndarray, needs: np.ndarray) -> np.ndarray:
    """Whether all of the nodes (M, 4), -1 for none, are among others (M, n)."""
    return ((own[:, :, None] == needs[:, None]).any(axis=1) | (needs < 0)).all(axis=1)


def _check_crossings(
    points: np.ndarray, plane: Frames, corners: np.ndarray, own: np.ndarray, outer: list[Sides]
) -> None:
    """Refuse edges of outer facets that pierce other outer facets: parts overlap."""
    edges = np.unique(np.concatenate(list(_outer_edges(outer))), axis=0)
    at, ends = points[corners], points[edges]
    centres, middles = at.mean(axis=1), ends.mean(axis=1)
    radii = np.linalg.norm(at - centres[:, None], axis=2).max(axis=1)
    half = 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    # Of an edge and a facet that meet the larger has the middle of the smaller in twice its ball.
    pairs = [*_near(centres, 2.0 * radii, middles), *((f, e) for e, f in _near(middles, 2.0 * half, centres))]
    for facet, edge in pairs:
        low, high = (_local(plane, facet, ends[edge, k])[1] for k in (0, 1))
        across = low * high < 0
        facet, edge, low, high = facet[across], edge[across], low[across], high[across]
        met = ends[edge, 0] + (ends[edge, 1] - ends[edge, 0]) * (low / (low - high))[:, None]
        pierced = _local(plane, facet, met)[0] > _EDGE
        facet, edge = facet[pierced], edge[pierced]
        alien = np.flatnonzero(~(own[facet][:, :, None] == edges[edge][:, None]).any(axis=(1, 2)))
        if len(alien):
            raise ValueError(
                f"mesh: the edge between the nodes {edges[edge[alien[0]]].tolist()} crosses the facet at the nodes "
                f"{corners[facet[alien[0]]].tolist()}: parts of the mesh overlap; take them apart"
            )


def _outer_edges(outer: list[Sides]) -> Iterator[np.ndarray]:
    for side in outer:
        for k in range(side.corners if side.corners > 2 else side.corners - 1):
            yield np.sort(side.heads[:, [k, (k + 1) % side.corners]], axis=1)


def _check_inside(points: np.ndarray, cells: Cells, used: np.ndarray) -> None:
    """Refuse boundary nodes within a cell: parts overlap."""
    at = points[cells.corners]
    centres = at.mean(axis=1)
    radii = np.linalg.norm(at - centres[:, None], axis=2).max(axis=1)
    for cell, test in _near(centres, radii, points[used]):
        alien = (cells.nodes[cell] != used[test][:, None]).all(axis=1)
        cell, test = cell[alien], test[alien]
        deep = np.ones(len(cell), bool)
        for k, facet in enumerate(FACETS[cells.base]):
            corners = at[cell][:, list(facet)]
            normal = area(corners) * (2 * k - 1 if points.shape[1] == 1 else 1)
            middle = corners.mean(axis=1)
            # Which way the nodes run is the format's: inside is where the cell's centre is.
            inner = np.sum((centres[cell] - middle) * normal, axis=1)
            deep &= np.sum((points[used[test]] - middle) * normal, axis=1) * np.sign(inner) > _ROUNDED * abs(inner)
        if deep.any():
            k = int(deep.argmax())
            raise ValueError(
                f"mesh: the node {used[test[k]]} lies in {cells.kind!r} cell {cell[k]} (nodes "
                f"{cells.nodes[cell[k]].tolist()}), of which it is no node: cells overlap; take them apart"
            )


def _check_pinches(dim: int, outer: list[Sides]) -> None:
    """Refuse a boundary that touches itself, at a node in 2D, along an edge in 3D: there is no outward there."""
    if dim == 1:
        return
    meets = np.concatenate(list(_outer_edges(outer)) if dim == 3 else [s.heads[:, [k]] for s in outer for k in (0, 1)])
    where, count = np.unique(meets, axis=0, return_counts=True)
    if (count > 2).any():
        raise ValueError(
            f"mesh: its domain touches itself at the nodes {where[count > 2][0].tolist()}, where {count.max()} sides "
            "meet and none is outward; take the parts apart or join them by cells"
        )


def numbered(rows: np.ndarray) -> np.ndarray:
    """Numbers (M,) that are equal where rows are."""
    order = np.lexsort(rows.T)
    new = np.ones(len(rows), int)
    new[1:] = (np.diff(rows[order], axis=0) != 0).any(axis=1)
    numbers = np.empty(len(rows), int)
    numbers[order] = np.cumsum(new) - 1
    return numbers


def _padded(rows: np.ndarray) -> np.ndarray:
    """Rows of four, so that triangles and quadrilaterals compare."""
    return np.pad(rows, ((0, 0), (0, 4 - rows.shape[1])), constant_values=-1)
