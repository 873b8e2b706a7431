"""Meshes as seen by a cloud: the cells of the domain, its boundary facets, their normals and names."""

from __future__ import annotations

from typing import Any

import numpy as np

# The facets of each kind of cell, by the cell's nodes: corners first, nodes of second order after them.
_FACETS: dict[str, list[tuple[int, ...]]] = {
    "line": [(0,), (1,)],
    "line3": [(0,), (1,)],
    "triangle": [(0, 1), (1, 2), (2, 0)],
    "triangle6": [(0, 1, 3), (1, 2, 4), (2, 0, 5)],
    "quad": [(0, 1), (1, 2), (2, 3), (3, 0)],
    "quad8": [(0, 1, 4), (1, 2, 5), (2, 3, 6), (3, 0, 7)],
    "quad9": [(0, 1, 4), (1, 2, 5), (2, 3, 6), (3, 0, 7)],
    "tetra": [(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)],
    "tetra10": [(1, 2, 3, 5, 9, 8), (0, 3, 2, 7, 9, 6), (0, 1, 3, 4, 8, 7), (0, 2, 1, 6, 5, 4)],
    "hexahedron": [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)],
    "wedge": [(0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)],
    "pyramid": [(0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)],
}  # fmt: skip
_DIMS = {"vertex": 0} | {
    kind: 1 if kind.startswith("line") else 2 if kind.startswith(("tri", "quad")) else 3 for kind in _FACETS
}
# Beyond 30 degrees there is a corner.
_SMOOTH = np.cos(np.radians(30.0))
_CORNERS = {"line": 2, "triangle": 3, "quad": 4, "tetra": 4, "hexahedron": 8, "wedge": 6, "pyramid": 5}
_TAGS = ("gmsh:physical", "medit:ref", "cell_tags", "gambit:ref", "su2:tag", "avsucd:material")


def volume_cells(blocks: Any) -> tuple[int, list[tuple[str, np.ndarray]]]:
    """The dimension of a mesh and its cells of that dimension."""
    try:
        blocks = [(block.type, np.asarray(block.data)) for block in blocks if len(block.data)]
    except (AttributeError, TypeError):
        raise ValueError("mesh: its cells are no meshio cell blocks; make it with meshio.Mesh(points, cells)") from None
    unknown = sorted({kind for kind, _ in blocks} - set(_DIMS))
    if unknown:
        raise ValueError(
            f"mesh: cells of kind {unknown[0]!r} are not understood; save it with one of {', '.join(_FACETS)}"
        )
    dim = max((_DIMS[kind] for kind, _ in blocks), default=0)
    if dim == 0:
        raise ValueError("mesh: has no cells (lines, triangles, tetrahedra, ...); for bare points use js.Cloud")
    return dim, [(kind, block) for kind, block in blocks if _DIMS[kind] == dim]


def check_cells(count: int, cells: list[tuple[str, np.ndarray]]) -> None:
    """Refuse cells whose nodes are not among the ``count`` points of the mesh, or not different."""
    for kind, block in cells:
        if block.ndim != 2 or block.dtype.kind not in "iu":
            raise ValueError(
                f"mesh: cells of kind {kind!r} have shape {block.shape}; expected whole numbers (M, nodes)"
            )
        if block.min() < 0 or block.max() >= count:
            raise ValueError(
                f"mesh: cells of kind {kind!r} name nodes from {block.min()} to {block.max()}, but there are only the "
                f"points 0 to {count - 1}; write the mesh again"
            )
        same = np.flatnonzero((np.diff(np.sort(block, axis=1), axis=1) == 0).any(axis=1))
        if len(same):
            raise ValueError(f"mesh: {kind!r} cell {same[0]} has a node twice, {block[same[0]].tolist()}; remove it")


def outer_facets(points: np.ndarray, cells: list[tuple[str, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The facets that belong to one cell only, by their nodes (M, k), with the centres of their cells (M, D)."""
    dim = points.shape[1]
    facets, centres = [], []
    for kind, block in cells:
        corners = block[:, : _CORNERS[kind.rstrip("0123456789")]]
        for facet in _FACETS[kind]:
            facets += [block[:, list(facet)]]
            centres += [points[corners].mean(axis=1)]
    heads = [_padded(np.sort(f[:, : _head(f.shape[1], dim)], axis=1)) for f in facets]
    _, first, count = np.unique(np.concatenate(heads), axis=0, return_index=True, return_counts=True)
    outer = np.zeros(sum(map(len, heads)), bool)
    outer[first[count == 1]] = True
    if not outer.any():
        raise ValueError(
            "mesh: no side of its cells is a boundary, as where every cell is given twice; remove the copies"
        )
    masks = np.split(outer, np.cumsum([len(h) for h in heads])[:-1])
    return [(nodes[mask], centre[mask]) for nodes, centre, mask in zip(facets, centres, masks)]


def boundary_normals(points: np.ndarray, outer: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Unit outward normals (N, D) of the nodes on the facets ``outer``, averaged by angle; NaN elsewhere."""
    total = np.zeros(points.shape)
    for nodes, centre in outer:
        _add_normals(total, points, nodes, centre)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1.0), np.nan)


def side_normals(points: np.ndarray, outer: list[tuple[np.ndarray, np.ndarray]], members: np.ndarray) -> np.ndarray:
    """Unit outward normals (N, D) of one side of the boundary, from the facets all of whose nodes are ``members`` (N,).

    In 2D an end of a curved side has one chord only; its normal is the next one's, mirrored in the chord's: exact on
    a circle.
    """
    outer = among(outer, members)
    normals = boundary_normals(points, outer)
    if points.shape[1] != 2 or not any(nodes.shape[1] == 2 for nodes, _ in outer):
        return normals
    chords = np.concatenate([nodes[:, k] for nodes, _ in outer for k in ([0, 1], [1, 0]) if nodes.shape[1] == 2])
    single = np.bincount(chords[:, 0], minlength=len(points))[chords[:, 0]] == 1
    end, near = chords[single].T
    cosine = np.sum(normals[end] * normals[near], axis=1, keepdims=True)
    mirrored = 2.0 * cosine * normals[end] - normals[near]
    normals[end] = np.where(cosine > _SMOOTH, mirrored, normals[end])
    return normals


def among(outer: list[tuple[np.ndarray, np.ndarray]], members: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The facets all of whose nodes are ``members``, a mask (N,)."""
    return [(nodes[keep], centre[keep]) for nodes, centre in outer for keep in [members[nodes].all(axis=1)]]


def _add_normals(total: np.ndarray, points: np.ndarray, facets: np.ndarray, centres: np.ndarray) -> None:
    """Add every facet's unit normal at its nodes, weighted by the facet's angle there."""
    dim = points.shape[1]
    head = facets[:, : _head(facets.shape[1], dim)]
    at = points[head]
    if dim == 1:
        normal = np.ones((len(facets), 1))
    elif dim == 2:
        side = at[:, 1] - at[:, 0]
        normal = np.stack([side[:, 1], -side[:, 0]], axis=1)
    else:
        # The diagonals of a quadrilateral, two sides of a triangle.
        normal = np.cross(at[:, 2] - at[:, 0], at[:, -1] - at[:, 1])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1.0)
    outward = np.sum(normal * (at.mean(axis=1) - centres), axis=1, keepdims=True)
    flat = np.flatnonzero(np.abs(outward[:, 0]) < 1e-14)  # the mesh has size one
    if len(flat):
        raise ValueError(f"mesh: a cell without volume has the nodes {facets[flat[0]].tolist()}; remove such cells")
    normal = normal * np.sign(outward)
    for k in range(facets.shape[1]):
        angle = np.ones(len(facets))
        if dim == 3 and k < head.shape[1]:
            one, two = (at[:, (k + s) % head.shape[1]] - at[:, k] for s in (1, -1))
            cosine = np.sum(one * two, axis=1) / (np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1))
            angle = np.arccos(np.clip(cosine, -1, 1))
        np.add.at(total, facets[:, k], normal * angle[:, None])


def _head(nodes: int, dim: int) -> int:
    """Corners among the nodes of a facet; those of second order come after them."""
    return {1: 1, 2: 2, 3: 3 if nodes == 6 else nodes}[dim]


def _padded(rows: np.ndarray) -> np.ndarray:
    """Rows of four, so that triangles and quadrilaterals compare."""
    return np.concatenate([rows, np.full((len(rows), 4 - rows.shape[1]), -1)], axis=1)


def named_facets(mesh: Any, dim: int, tags: str | None) -> dict[str, np.ndarray]:
    """Nodes by the name of the facets or point sets they belong to, in the order of the names in the file."""
    named: dict[str, list[np.ndarray]] = {}
    facets = [k for k, block in enumerate(mesh.cells) if _DIMS.get(block.type) == dim - 1]
    keys = [tags] if tags is not None else [key for key in _TAGS if key in mesh.cell_data]
    if tags is not None and tags not in mesh.cell_data:
        raise ValueError(f"tags: {tags!r} is none of the mesh's cell data {sorted(mesh.cell_data)}")
    for key in keys[:1]:
        names = {int(entry[0]): name for name, entry in mesh.field_data.items() if int(entry[1]) == dim - 1}
        numbers = {k: _whole(key, mesh.cell_data[key][k]) for k in facets}
        present = sorted(set().union(*map(set, numbers.values())) if numbers else (), key=_order_of(names))
        for number in present:
            nodes = [mesh.cells[k].data[numbers[k] == number].ravel() for k in facets]
            named.setdefault(names.get(int(number), str(number)), []).extend(nodes)
    for name, members in ({} if keys else mesh.cell_sets).items():
        # Gmsh's bounding entities and the like are no groups of the user's.
        if not name.startswith("gmsh:"):
            nodes = [mesh.cells[k].data[np.asarray(members[k], int)].ravel() for k in facets if members[k] is not None]
            named.setdefault(name, []).extend(nodes)
    for name, members in mesh.point_sets.items():
        named.setdefault(name, []).append(np.asarray(members, int).ravel())
    return {name: np.concatenate(nodes) for name, nodes in named.items() if nodes}


def _whole(key: str, values: Any) -> np.ndarray:
    """Tags as integers."""
    values = np.asarray(values).ravel()
    if values.dtype.kind not in "iuf" or not (np.isfinite(values) & (values == np.round(values))).all():
        raise ValueError(f"tags: the cell data {key!r} are no whole numbers; number the sides 1, 2, ...")
    return values.astype(int)


def _order_of(names: dict[int, str]) -> Any:
    """Named tags in the order of their names in the file, then the others by number."""
    place = {number: k for k, number in enumerate(names)}
    return lambda number: (place.get(int(number), len(place)), int(number))
