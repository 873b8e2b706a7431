"""SU2 meshes, with the names of their markers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jsmitsm.cloud.mesh_facets import Block, Mesh

# By VTK's number of the kind: its name and how many nodes it has.
_KINDS = {3: ("line", 2), 5: ("triangle", 3), 9: ("quad", 4), 10: ("tetra", 4), 12: ("hexahedron", 8),
          13: ("wedge", 6), 14: ("pyramid", 5)}  # fmt: skip


def read_su2(path: str) -> Mesh:
    """The mesh of one zone; its markers are cell sets."""
    with open(path, encoding="utf-8", errors="replace") as file:
        lines = iter([text for line in file if (text := line.split("%")[0].strip())])
    dim, points, marker, wanted = 0, None, None, None
    blocks: list[Block] = []
    sets: dict[str, list[int]] = {}
    for line in lines:
        key, sign, value = (part.strip() for part in line.partition("="))
        key = key.upper()
        if not sign or not key.isidentifier():
            raise ValueError(f"the line {line[:60]!r} is none of SU2; expected NAME= value")
        if key == "NDIME":
            dim = int(value)
        elif key in ("NZONE", "NPERIODIC") and int(value) > 1:
            raise ValueError(f"{key}= {value}: one zone is read; write the zones into files of their own")
        elif key == "NPOIN":
            points = _points(lines, int(value.split()[0]), dim)
        elif key == "NMARK":
            wanted = int(value)
        elif key == "MARKER_TAG":
            marker = value
        elif key in ("NELEM", "MARKER_ELEMS"):
            for kind, cells in _cells(lines, int(value), key):
                if key == "MARKER_ELEMS":
                    if marker is None:
                        raise ValueError("MARKER_ELEMS without a MARKER_TAG before it")
                    sets.setdefault(marker, []).append(len(blocks))
                blocks.append(Block(kind, cells))
    if points is None or not blocks:
        raise ValueError("there are no points (NPOIN) or no cells (NELEM)")
    if wanted is not None and wanted != len(sets):
        raise ValueError(f"NMARK= {wanted}, but there are {len(sets)} markers {list(sets)}")
    members = {name: [np.arange(len(cells)) if k in own else np.zeros(0, int) for k, (_, cells) in enumerate(blocks)]
               for name, own in sets.items()}  # fmt: skip
    return Mesh(points, blocks, cell_sets=members)


def _points(lines: Iterator[str], count: int, dim: int) -> np.ndarray:
    """The coordinates (count, dim), between spaces or tabs; an index may follow them."""
    if dim not in (2, 3):
        raise ValueError(f"NDIME= {dim} before the points; expected 2 or 3")
    rows = [_next(lines, "point").split() for _ in range(count)]
    bad = next((row for row in rows if not dim <= len(row) <= dim + 2), None)
    if bad is not None:
        raise ValueError(f"the point {' '.join(bad)[:60]!r} has {len(bad)} numbers; expected {dim}, perhaps an index")
    return np.array([row[:dim] for row in rows], float).reshape(count, dim)


def _cells(lines: Iterator[str], count: int, key: str) -> list[tuple[str, np.ndarray]]:
    """Blocks of cells, by kind; an index may follow the nodes."""
    rows: dict[str, list[list[int]]] = {}
    for _ in range(count):
        numbers = [int(word) for word in _next(lines, "cell").split()]
        if numbers[0] == 1 and key == "MARKER_ELEMS":  # a vertex: the sender and receiver of partitions
            raise ValueError("a marker of single points, as of a mesh in parts; write the whole mesh")
        name, nodes = _KINDS.get(numbers[0], ("", 0))
        if not nodes or not nodes < len(numbers) <= nodes + 2:
            raise ValueError(f"the cell {numbers} is none of SU2; expected a kind of {sorted(_KINDS)} and its nodes")
        rows.setdefault(name, []).append(numbers[1 : nodes + 1])
    return [(name, np.array(cells)) for name, cells in rows.items()]


def _next(lines: Iterator[str], what: str) -> str:
    line = next(lines, None)
    if line is None or "=" in line:
        raise ValueError(f"expected a {what}, got {'the end of the file' if line is None else repr(line[:60])}")
    return line
