"""Meshes as seen by a cloud: the cells of the domain, their sides, and the normals of those on the boundary.

meshio knows no facets. VTK finds those of 53,000 tetrahedra in 0.07 s, here it takes 0.4 s, of which most checks the
cells: it knows solids only, takes curved facets for flat ones and refuses nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

# The facets of each kind of cell by its corners, turned so that their normals point outward from a cell of positive
# volume (right-hand rule).
FACETS: dict[str, list[tuple[int, ...]]] = {
    "line": [(0,), (1,)],
    "triangle": [(0, 1), (1, 2), (2, 0)],
    "quad": [(0, 1), (1, 2), (2, 3), (3, 0)],
    "tetra": [(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)],
    "hexahedron": [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)],
    "wedge": [(0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)],
    "pyramid": [(0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)],
}
# Nodes of first and of second order: corners alone, with the middles of edges, of faces, of the cell.
_NODES = {"line": (2, 3), "triangle": (3, 6), "quad": (4, 8, 9), "tetra": (4, 10), "hexahedron": (8, 20, 27),
          "wedge": (6, 15, 18), "pyramid": (5, 13, 14)}  # fmt: skip
_KINDS = {base + (str(n) if k else ""): (base, n) for base, counts in _NODES.items() for k, n in enumerate(counts)}
_DIMS = {"vertex": 0, "line": 1, "triangle": 2, "quad": 2, "tetra": 3, "hexahedron": 3, "wedge": 3, "pyramid": 3}
# Beyond 30 degrees there is a corner.
_SMOOTH = np.cos(np.radians(30.0))
# Cells to find out by where a kind's middle nodes stand.
_SAMPLE = 1000


class Block(NamedTuple):
    """Cells of one kind, as meshio has them."""

    type: str
    data: np.ndarray


class Mesh(NamedTuple):
    """What a mesh file holds, under meshio's names; meshio's own refuses some kinds of cells that it knows."""

    points: np.ndarray
    cells: list[Block]
    point_sets: dict[str, np.ndarray] = {}
    cell_sets: dict[str, list[np.ndarray]] = {}
    cell_data: dict[str, list[np.ndarray]] = {}
    field_data: dict[str, np.ndarray] = {}


class Cells(NamedTuple):
    """Cells of one kind: their nodes (M, n), corners first, and which of them lies amid which corners."""

    kind: str
    base: str
    nodes: np.ndarray
    middles: dict[tuple[int, ...], int]

    @property
    def corners(self) -> np.ndarray:
        """The corners (M, c)."""
        return self.nodes[:, : _NODES[self.base][0]]


class Sides(NamedTuple):
    """Facets of one shape: nodes (M, k), corners first; whether their normals point outward as their corners run
    (+1 or -1); how high their cell stands over them; and its nodes (M, n)."""

    nodes: np.ndarray
    corners: int
    sign: np.ndarray
    height: np.ndarray
    cell: np.ndarray

    @property
    def heads(self) -> np.ndarray:
        """The corners (M, c)."""
        return self.nodes[:, : self.corners]

    def of(self, mask: np.ndarray) -> Sides:
        """Some of them."""
        return Sides(self.nodes[mask], self.corners, self.sign[mask], self.height[mask], self.cell[mask])


def dimension(kind: str) -> int | None:
    """Of a kind of cell; None for one that is not understood."""
    return _DIMS.get(_KINDS.get(kind, (kind,))[0])


def corner_count(kind: str) -> int:
    """Corners of a kind of cell."""
    base = _KINDS.get(kind, (kind,))[0]
    return _NODES.get(base, (1,))[0]


def volume_cells(blocks: Any) -> tuple[int, list[tuple[str, np.ndarray]]]:
    """The dimension of a mesh and its cells of that dimension."""
    try:
        blocks = [(block.type, np.asarray(block.data)) for block in blocks if len(block.data)]
    except (AttributeError, TypeError, ValueError):  # ValueError: rows of several lengths
        raise ValueError("mesh: its cells are no meshio cell blocks; make it with meshio.Mesh(points, cells)") from None
    unknown = sorted({kind for kind, _ in blocks if dimension(kind) is None})
    if unknown:
        raise ValueError(
            f"mesh: cells of kind {unknown[0]!r} are not understood; save it with one of {', '.join(_KINDS)}"
        )
    dim = max((dimension(kind) or 0 for kind, _ in blocks), default=0)
    if dim == 0:
        raise ValueError("mesh: has no cells (lines, triangles, tetrahedra, ...); for bare points use js.Cloud")
    return dim, [(kind, block) for kind, block in blocks if dimension(kind) == dim]


def check_cells(count: int, blocks: Any) -> None:
    """Refuse cells whose nodes are not among the ``count`` points of the mesh, too many, or not different."""
    for kind, block in blocks:
        block = np.asarray(block)
        wanted = _KINDS.get(kind, (kind, 1))[1]
        if block.ndim != 2 or block.dtype.kind not in "iu" or block.shape[1] != wanted:
            raise ValueError(
                f"mesh: cells of kind {kind!r} have shape {block.shape} and type {block.dtype}; expected whole numbers "
                f"(M, {wanted}), their nodes"
            )
        if block.min() < 0 or block.max() >= count:
            raise ValueError(
                f"mesh: cells of kind {kind!r} name nodes from {block.min()} to {block.max()}, but there are only the "
                f"points 0 to {count - 1}; write the mesh again"
            )
        same = np.flatnonzero((np.diff(np.sort(block, axis=1), axis=1) == 0).any(axis=1))
        if len(same):
            raise ValueError(f"mesh: {kind!r} cell {same[0]} has a node twice, {block[same[0]].tolist()}; remove it")


def with_middles(points: np.ndarray, blocks: list[tuple[str, np.ndarray]]) -> list[Cells]:
    """The cells with what their nodes of second order lie amid of: formats number those in different ways, where they
    are does not lie."""
    out = []
    for kind, block in blocks:
        base, count = _KINDS[kind]
        corners = _NODES[base][0]
        places = _places(base)
        at, extra = points[block[:, :corners]], points[block[:, corners:]]
        centres = np.stack([at[:, list(place)].mean(axis=1) for place in places], axis=1) if count > corners else at
        some = slice(None, None, max(1, len(block) // _SAMPLE))
        size = np.linalg.norm(np.ptp(at, axis=1), axis=1)
        far = np.linalg.norm(extra[some, :, None] - centres[some, None], axis=3) / size[some, None, None]
        nearest = np.mean(far, axis=0).argmin(axis=1) if count > corners else np.zeros(0, int)
        off = np.linalg.norm(extra - centres[:, nearest], axis=2).max(axis=1, initial=0.0) > 0.5 * size
        if len(set(nearest)) < len(nearest) or off.any():
            raise ValueError(
                f"mesh: the middle nodes of {kind!r} cell {off.argmax()}, nodes {block[off.argmax()].tolist()}, are "
                "not near the middles of its edges and faces, numbered or placed wrong; write the mesh again"
            )
        out.append(Cells(kind, base, block, {places[k]: corners + j for j, k in enumerate(nearest)}))
    return out


def _places(base: str) -> list[tuple[int, ...]]:
    """The edges, the faces and the whole of a cell, by their corners ascending."""
    faces = [] if _DIMS[base] < 3 else [tuple(sorted(face)) for face in FACETS[base]]
    edges = {edge for facet in FACETS[base] for edge in _edges(facet)}
    return [*sorted(edges), *faces, tuple(range(_NODES[base][0]))]


def _edges(facet: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The edges of a facet, by their corners ascending, in its order."""
    pairs = list(zip(facet, facet[1:] + facet[:1]))[: 1 if len(facet) == 2 else None]
    return [tuple(sorted(pair)) for pair in pairs if len(facet) > 1]


def facet_nodes(cells: Cells, facet: tuple[int, ...]) -> np.ndarray:
    """The nodes (M, k) of one facet of every cell: corners, middles of its edges, its own middle."""
    amid = [*_edges(facet), tuple(sorted(facet))] if len(facet) > 2 else _edges(facet)
    return cells.nodes[:, [*facet, *(cells.middles[place] for place in amid if place in cells.middles)]]


def area(at: np.ndarray) -> np.ndarray:
    """The area vectors (M, D) of facets by their corners (M, c, D): normal by the right-hand rule, as long as the
    facet is large."""
    if at.shape[2] == 1:
        return np.ones((len(at), 1))
    if at.shape[2] == 2:
        side = at[:, 1] - at[:, 0]
        return np.stack([side[:, 1], -side[:, 0]], axis=1)
    # The diagonals of a quadrilateral, two sides of a triangle.
    return 0.5 * np.cross(at[:, 2] - at[:, 0], at[:, -1] - at[:, 1])


def boundary_normals(points: np.ndarray, outer: list[Sides]) -> np.ndarray:
    """Unit outward normals (N, D) of the nodes on the facets ``outer``, averaged by angle; NaN elsewhere."""
    total = np.zeros(points.shape)
    for sides in outer:
        _add_normals(total, points, sides)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-9, total / np.where(length > 0, length, 1.0), np.nan)


def side_normals(points: np.ndarray, sides: list[Sides]) -> np.ndarray:
    """Unit outward normals (N, D) of one side of the boundary, from its own facets.

    In 2D an end of a curved side of chords has one of them only; its normal is the next one's, mirrored in the chord's:
    exact on a circle.
    """
    normals = boundary_normals(points, sides)
    chords = [s.nodes[:, k] for s in sides for k in ([0, 1], [1, 0]) if s.nodes.shape[1] == 2]
    if points.shape[1] != 2 or not chords:
        return normals
    pairs = np.concatenate(chords)
    single = np.bincount(pairs[:, 0], minlength=len(points))[pairs[:, 0]] == 1
    end, near = pairs[single].T
    cosine = np.sum(normals[end] * normals[near], axis=1, keepdims=True)
    mirrored = 2.0 * cosine * normals[end] - normals[near]
    normals[end] = np.where(cosine > _SMOOTH, mirrored, normals[end])
    return normals


def _add_normals(total: np.ndarray, points: np.ndarray, sides: Sides) -> None:
    """Add every facet's unit normals at its nodes, weighted by the facet's angle there."""
    dim, head = points.shape[1], points[sides.heads]
    flat = area(head)
    normal = np.repeat(flat[:, None], sides.nodes.shape[1], axis=1)
    if dim > 1:
        tangents = [np.einsum("kj,mjd->mkd", d, points[sides.nodes[:, : d.shape[1]]]) for d in
                    _derivatives(sides.corners, sides.nodes.shape[1])]  # fmt: skip
        turned = np.stack([tangents[0][..., 1], -tangents[0][..., 0]], -1) if dim == 2 else np.cross(*tangents)
        # A middle node at a quarter of its side leaves no tangent at the corner, one out of place a false one.
        right = np.sum(turned * flat[:, None], axis=2, keepdims=True) > 1e-9 * np.sum(flat**2, axis=1)[:, None, None]
        normal = np.where(right, turned, normal)
    normal = normal / np.linalg.norm(normal, axis=2, keepdims=True) * sides.sign[:, None, None]
    for k in range(sides.nodes.shape[1]):
        angle = np.ones(len(head))
        if dim == 3 and k < sides.corners:
            one, two = (head[:, (k + s) % sides.corners] - head[:, k] for s in (1, -1))
            cosine = np.sum(one * two, axis=1) / (np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1))
            angle = np.arccos(np.clip(cosine, -1, 1))
        np.add.at(total, sides.nodes[:, k], normal[:, k] * angle[:, None])


# A facet of second order is the image of the reference facet under polynomials: by its corners, the nodes of the
# reference facet and the exponents, of which the first k belong to the first k nodes.
_REFERENCE: dict[int, tuple[list[tuple[float, ...]], list[tuple[int, ...]]]] = {
    2: ([(-1,), (1,), (0,)], [(0,), (1,), (2,)]),
    3: ([(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)],
        [(0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2)]),
    4: ([(-1, -1), (1, -1), (1, 1), (-1, 1), (0, -1), (1, 0), (0, 1), (-1, 0), (0, 0)],
        [(0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 1), (1, 2), (2, 2)]),
}  # fmt: skip


def _derivatives(corners: int, nodes: int) -> list[np.ndarray]:
    """The tangents at the nodes of a facet as sums over its nodes: a matrix (nodes, terms) per reference axis."""
    where, exponents = _REFERENCE[corners]
    at, powers = np.array(where[:nodes]), np.array(exponents[:nodes])
    values = np.prod(at[: len(powers), None] ** powers, axis=2)
    out = []
    for axis in range(at.shape[1]):
        lower = np.maximum(powers - np.eye(at.shape[1], dtype=int)[axis], 0)
        out.append(powers[:, axis] * np.prod(at[:, None] ** lower, axis=2) @ np.linalg.inv(values))
    return out
