"""A cloud of several regions from a mesh whose cells are tagged: nodes of several tags are copied, once for each."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import INTERIOR
from jsmitsm.cloud.mesh_facets import FACETS, Block, Mesh, corner_count, dimension, volume_cells
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.show.mesh_cloud import cloud_of
from jsmitsm.show.mesh_tags import all_tags, chosen

# Facets by the number of their corners.
_KINDS = {1: "vertex", 2: "line", 3: "triangle", 4: "quad"}


def regions_of(mesh: Any, key: str | None, names: list[str] | None) -> RegionCloud:
    """The regions ``names`` of a mesh, or all tags of its cells; see ``js.files.from_mesh``."""
    dim, _ = volume_cells(mesh.cells)
    tags = [tag for tag in chosen(all_tags(mesh, key), names) if tag.dim == dim]
    if not tags:
        raise ValueError("regions: no cells of the domain are tagged; tag them by material, or leave regions out")
    cells = {tag.name: _cells(mesh, tag.cells) for tag in tags}
    _check_parted(mesh, dim, {tag.name: tag.cells for tag in tags})
    whole, used = cloud_of(mesh, key, None), _used([b for blocks in cells.values() for b in blocks])
    points, nodes = np.asarray(mesh.points, float)[:, :dim], {n: _used(blocks) for n, blocks in cells.items()}
    first = dict(zip(nodes, np.cumsum([0, *map(len, nodes.values())])))
    number = {n: dict(zip(ids.tolist(), range(first[n], first[n] + len(ids)))) for n, ids in nodes.items()}
    assert whole.normals is not None
    outer = {int(used[i]): (g, whole.normals[i]) for g, ids in whole.groups.items() if g != INTERIOR for i in ids}
    total = sum(map(len, nodes.values()))
    group: Any = np.full(total, INTERIOR, object)
    normals = np.full((total, dim), np.nan)
    for places in number.values():
        for node, i in places.items():
            if node in outer:
                group[i], normals[i] = outer[node]
    pairs, pair_normals = {}, {}
    for (a, b), (at, n) in _interfaces(mesh, cells).items():
        name = f"{a}|{b}"
        pairs[name] = np.array([[number[a][k], number[b][k]] for k in at.tolist()])
        pair_normals[name] = n
        for column in pairs[name].T:
            free = np.asarray(group[column] == INTERIOR)
            group[column[free]], normals[column[free]] = name, n[free]
    order = [INTERIOR, *(g for g in whole.groups if g != INTERIOR), *pairs]
    index = {name: np.flatnonzero(group == name) for name in order}
    members = {n: np.arange(first[n], first[n] + len(ids)) for n, ids in nodes.items()}
    made = np.concatenate([points[ids] for ids in nodes.values()])
    kept = {g: ids for g, ids in index.items() if g == INTERIOR or len(ids)}
    return RegionCloud(made, kept, normals, members, pairs, pair_normals)


def _cells(mesh: Any, entries: list[tuple[int, np.ndarray]]) -> list[Block]:
    return [Block(mesh.cells[k].type, np.asarray(mesh.cells[k].data)[rows]) for k, rows in entries if len(rows)]


def _used(blocks: list[Block]) -> np.ndarray:
    return np.unique(np.concatenate([b.data.ravel() for b in blocks]))


def _check_parted(mesh: Any, dim: int, tags: dict[str, list[tuple[int, np.ndarray]]]) -> None:
    """Every cell of the domain in one region."""
    count = [np.zeros(len(b.data), int) for b in mesh.cells]
    for name, entries in tags.items():
        if "|" in name:
            raise ValueError(f'regions: the tag {name!r} holds a "|", which stands between the names of an interface')
        for k, rows in entries:
            count[k][rows] += 1
    for b, c in zip(mesh.cells, count):
        if dimension(b.type) == dim and (c != 1).any():
            k = int(np.flatnonzero(c != 1)[0])
            what = "no region" if c[k] == 0 else "several regions"
            raise ValueError(
                f"regions: {b.type!r} cell {k} belongs to {what} of {list(tags)}; every cell belongs to one, name all "
                "of them"
            )


def _interfaces(mesh: Any, cells: dict[str, list[Block]]) -> dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]:
    """For each two regions that share facets the nodes on them and the unit normals there, from the first outward."""
    facets = {name: _facets(blocks) for name, blocks in cells.items()}
    names, out = list(cells), {}
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            shared = [facets[a][key] for key in facets[a].keys() & facets[b].keys()]
            if not shared:
                continue
            sizes = sorted({len(f) for f in shared})
            added = [Block(_KINDS[n], np.array([f for f in shared if len(f) == n])) for n in sizes]
            sets = {"between": [np.zeros(0, int)] * len(cells[a]) + [np.arange(len(block.data)) for block in added]}
            part = cloud_of(Mesh(mesh.points, [*cells[a], *added], cell_sets=sets), None, None)
            own = part.groups["between"]
            assert part.normals is not None
            out[a, b] = _used(cells[a])[own], np.asarray(part.normals)[own]
    return out


def _facets(blocks: list[Block]) -> dict[tuple[int, ...], np.ndarray]:
    """The facets of cells by their sorted corners."""
    out = {}
    for block in blocks:
        base = next(kind for kind in FACETS if block.type.startswith(kind))
        corners = block.data[:, : corner_count(block.type)]
        for facet in FACETS[base]:
            for row in corners[:, list(facet)]:
                out[tuple(sorted(row.tolist()))] = row
    return out
