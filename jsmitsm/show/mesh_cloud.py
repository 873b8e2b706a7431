"""The cloud of a mesh: its nodes, the groups of its tags, the normals of its sides."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.cloud.mesh_checks import Boundary, check_fit, domain_sides, numbered
from jsmitsm.cloud.mesh_facets import (
    Sides,
    boundary_normals,
    check_cells,
    corner_count,
    dimension,
    side_normals,
    volume_cells,
    with_middles,
)
from jsmitsm.runtime.errors import refuse_masked, some
from jsmitsm.show.mesh_tags import Tag, all_tags, chosen, shared_out

# Out of the plane by less than this, in units of the mesh, a plane mesh was rounded by its file.
_PLANE = 1e-8


class _Named(NamedTuple):
    """One tag on the domain: nodes of its own on the boundary, its outer facets, all its nodes where it reaches
    inside."""

    border: np.ndarray
    facets: np.ndarray
    inside: np.ndarray | None


def cloud_of(mesh: Any, key: str | None, names: list[str] | None) -> Cloud:
    """The cloud of a ``meshio.Mesh``; see ``js.files.from_mesh``."""
    dim, blocks = volume_cells(mesh.cells)
    points = _checked_nodes(mesh.points, dim)
    check_cells(len(points), [(block.type, block.data) for block in mesh.cells if len(block.data)])
    used = np.unique(np.concatenate([block.ravel() for _, block in blocks]))
    _check_places(points, used)
    _check_plane(points[used], dim)
    _check_attached(mesh.cells, used, dim)
    # Products of coordinates must neither overflow nor vanish: the geometry is found in units of its size.
    unit = float(np.ptp(points[used, :dim], axis=0).max()) or 1.0
    scaled = (points[:, :dim] - points[used, :dim].min(axis=0)) / unit
    tags = chosen(all_tags(mesh, key), names)
    cells = with_middles(scaled, _once(mesh, blocks, dim))
    asked = [(k, *entry) for k, tag in enumerate(tags) if tag.dim == dim - 1 for entry in tag.cells]
    corners = [mesh.cells[b].data[rows][:, : corner_count(mesh.cells[b].type)] for _, b, rows in asked]
    found = domain_sides(scaled, cells, corners)
    check_fit(scaled, cells, found.outer)
    border = np.zeros(len(points), bool)
    border[np.concatenate([side.nodes.ravel() for side in found.outer])] = True
    numbers: dict[int, list[np.ndarray]] = {}
    for (k, _, _), number in zip(asked, found.asked):
        numbers.setdefault(k, []).append(number)
    live = np.zeros(len(points), bool)
    live[used] = True
    named = [_located(mesh, tag, dim, found, numbers.get(k, []), border, live, names is not None)
             for k, tag in enumerate(tags)]  # fmt: skip
    claims, facets = _claims(tags, named, live)
    cell_groups = _cell_groups(tags, named, dim)
    if key is not None and not claims and len(cell_groups) < 2:
        raise ValueError(
            f"tags: the cell data {key!r} name no side of the domain and tell no materials apart; tag its boundary "
            "facets, or leave tags out"
        )
    there = {tag.name for tag, n in zip(tags, named) if len(n.border) or (n.inside is not None and len(n.inside))}
    for name in names or ():
        if name not in there:
            raise ValueError(f"tags: the group {name!r} has no node in the domain; leave it out, or mesh it too")
    new = np.cumsum(live) - 1
    groups, normals = _owned(scaled, found.outer, border & live, claims, facets)
    return Cloud(
        np.ascontiguousarray(points[used, :dim]),
        {INTERIOR: new[np.flatnonzero(live & ~border)], **{name: new[nodes] for name, nodes in groups.items()}},
        normals[used],
        {name: new[nodes] for name, nodes in cell_groups.items()},
    )


def _once(mesh: Any, blocks: list[tuple[str, np.ndarray]], dim: int) -> list[tuple[str, np.ndarray]]:
    """The cells, each once: Gmsh 2 writes a cell of several physical groups once for each. Copies within one group
    stay, to be refused."""
    tags = [np.asarray(tag) for block, tag in zip(mesh.cells, mesh.cell_data.get("gmsh:physical", []))
            if len(block.data) and dimension(block.type) == dim]  # fmt: skip
    if not tags or len(np.unique(np.concatenate(tags))) == 1:
        return blocks
    out = []
    for kind in dict.fromkeys(kind for kind, _ in blocks):
        rows = np.concatenate([block for k, block in blocks if k == kind])
        tag = np.concatenate([t for t, (k, _) in zip(tags, blocks) if k == kind])
        number = numbered(np.sort(rows, axis=1))
        first = np.unique(number, return_index=True)[1][number]
        out.append((kind, rows[(first == np.arange(len(rows))) | (tag == tag[first])]))
    return out


def _owned(
    points: np.ndarray, outer: list[Sides], border: np.ndarray, claims: dict[str, np.ndarray], facets: dict[str, Any]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The boundary groups and the normals of all nodes."""
    normals = boundary_normals(points, outer)
    bare = np.flatnonzero(border & ~np.isfinite(normals[:, 0]))
    if len(bare):
        raise ValueError(
            f"mesh: its domain touches itself at the nodes {some(bare)}, where no direction is outward; take the parts "
            "apart or join them by cells"
        )
    groups = shared_out(claims, len(border))
    if INTERIOR in groups:
        raise ValueError(f"mesh: boundary facets are tagged {INTERIOR!r}, the name of what lies inside; rename")
    cuts = np.cumsum([len(side.nodes) for side in outer])[:-1]
    for name, nodes in groups.items():
        # At a corner between groups the normal is that of the own side: what is said of a side holds to its end.
        own = side_normals(points, [side.of(mask) for side, mask in zip(outer, np.split(facets[name], cuts))])[nodes]
        normals[nodes] = np.where(np.isfinite(own), own, normals[nodes])
    free = border.copy()
    free[[n for nodes in groups.values() for n in nodes]] = False
    if free.any():
        groups["boundary"] = np.union1d(groups.get("boundary", np.zeros(0, int)), np.flatnonzero(free))
    return groups, normals


def _located(
    mesh: Any, tag: Tag, dim: int, found: Boundary, numbers: list[np.ndarray], border: np.ndarray, live: np.ndarray,
    asked: bool,
) -> _Named:  # fmt: skip
    """Where a tag lies: its part of the boundary, and all of it where it reaches inside."""
    total = sum(len(side.nodes) for side in found.outer)
    mask = np.zeros(total, bool)
    if tag.dim == -1:
        nodes = tag.nodes[live[tag.nodes]]
        members = np.zeros(len(live), bool)
        members[nodes] = True
        if len(nodes):
            mask = np.concatenate([members[side.nodes].all(axis=1) for side in found.outer])
        inner = not border[nodes].all()
        return _Named(nodes[border[nodes]] if asked or not inner else nodes[:0], mask, nodes if inner else None)
    cells = [mesh.cells[b].data[rows] for b, rows in tag.cells]
    nodes = np.unique(np.concatenate([c.ravel() for c in cells]))
    if tag.dim != dim - 1:
        return _Named(nodes[:0], mask, nodes[live[nodes]])
    for cell, number in zip(cells, numbers):
        stray = np.flatnonzero((found.cells[number] == 0) & border[cell].all(axis=1))
        if len(stray):
            raise ValueError(
                f"mesh: {len(stray)} facets of the group {tag.name!r} lie on the boundary but are no side of any cell, "
                f"as that with the nodes {cell[stray[0]].tolist()}; mesh the sides and the domain together"
            )
    number = np.concatenate(numbers)
    mask[found.place[number[found.cells[number] == 1]]] = True
    cuts = np.cumsum([len(side.nodes) for side in found.outer])[:-1]
    own = [side.nodes[m].ravel() for side, m in zip(found.outer, np.split(mask, cuts))]
    inner = (found.cells[number] != 1).any()
    return _Named(np.unique(np.concatenate(own)), mask, nodes[live[nodes]] if inner else None)


def _claims(tags: list[Tag], named: list[_Named], live: np.ndarray) -> tuple[dict[str, Any], dict[str, Any]]:
    """What every name claims of the boundary: nodes, and which outer facets. A set of all nodes is no side beside
    others."""
    claims: dict[str, np.ndarray] = {}
    facets: dict[str, np.ndarray] = {}
    sides = [k for k, n in enumerate(named) if len(n.border)]
    whole = [k for k in sides if tags[k].dim == -1 and len(named[k].border) == live.sum()]
    for k in sides if len(whole) == len(sides) else [k for k in sides if k not in whole]:
        name = tags[k].name
        claims[name] = np.union1d(claims.get(name, np.zeros(0, int)), named[k].border)
        facets[name] = facets.get(name, False) | named[k].facets
    return claims, facets


def _cell_groups(tags: list[Tag], named: list[_Named], dim: int) -> dict[str, np.ndarray]:
    """The nodes of every tag that is no side: materials by name, and others, told apart where names are equal."""
    groups: dict[str, np.ndarray] = {}
    for tag, found in sorted(zip(tags, named), key=lambda pair: pair[0].dim != dim):
        if found.inside is not None:
            name = tag.name
            if name in groups:
                name = f"{name} ({('nodes', 'points', 'lines', 'faces')[tag.dim + 1]})"
            groups[name] = np.unique(found.inside)
    return groups


def _checked_nodes(points: Any, dim: int) -> np.ndarray:
    """The nodes of a mesh (N, D), real and finite, in at least as many axes as its cells have."""
    refuse_masked(points, "mesh: its points")
    array = np.asarray(points)
    if array.dtype.kind not in "iuf" or array.ndim != 2 or array.shape[1] < dim:
        raise ValueError(
            f"mesh: its points have shape {array.shape} and type {array.dtype}; expected real numbers (N, D), D at "
            f"least {dim} for its cells"
        )
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if len(bad):
        raise ValueError(f"mesh: NaN or infinite coordinates at the points {bad[:5].tolist()}; remove or mend them")
    return array.astype(np.float64)


def _check_places(points: np.ndarray, used: np.ndarray) -> None:
    """Refuse nodes at one place: cells that seem to touch there do not."""
    order = used[np.lexsort(points[used].T)]
    same = np.flatnonzero((np.diff(points[order], axis=0) == 0).all(axis=1))
    if len(same):
        raise ValueError(
            f"mesh: {len(same)} of its nodes stand where others do, as {order[same[0] : same[0] + 2].tolist()}; merge "
            "them (in Gmsh: Coherence), or give more digits"
        )


def _check_plane(points: np.ndarray, dim: int) -> None:
    """Refuse a mesh of lines or faces that is not in the first axes."""
    spread = np.ptp(points, axis=0)
    if points.shape[1] > dim and spread[dim:].max() > _PLANE * spread.max():
        flat = [k for k in range(points.shape[1]) if spread[k] > _PLANE * spread.max()]
        way = f"; it lies in the axes {flat}: pass points[:, {flat}]" if len(flat) == dim else ""
        raise ValueError(
            f"mesh: its cells are {dim}-dimensional but its points are not in the first {dim} axes; "
            f"a surface in space is no domain, mesh the volume{way}"
        )


def _check_attached(blocks: Any, used: np.ndarray, dim: int) -> None:
    """Refuse parts of a lower dimension beside the domain: they would be lost."""
    for block in blocks:
        if len(block.data) and 0 < (dimension(block.type) or 0) < dim:
            loose = np.flatnonzero(~np.isin(block.data, used).all(axis=1))
            if len(loose):
                raise ValueError(
                    f"mesh: {len(loose)} of its {block.type!r} cells have nodes that no {dim}-dimensional cell has, as "
                    f"{np.asarray(block.data)[loose[0]].tolist()}: parts of two dimensions are no domain; mesh them in "
                    "one dimension or remove them"
                )
