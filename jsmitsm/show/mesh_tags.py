"""Who owns which node of a mesh: its tags and sets as groups of the boundary and as groups of cells."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jsmitsm.cloud.mesh_facets import dimension
from jsmitsm.runtime.errors import some

_KEYS = ("gmsh:physical", "medit:ref", "cell_tags", "gambit:ref", "su2:tag", "avsucd:material")


class Tag(NamedTuple):
    """What a mesh calls by one name: cells of one dimension, (block, rows), or, of dimension -1, nodes."""

    name: str
    dim: int
    cells: list[tuple[int, np.ndarray]]
    nodes: np.ndarray


def all_tags(mesh: Any, key: str | None) -> list[Tag]:
    """Everything that has a name, in the order of the names in the file."""
    dims = [dimension(block.type) or 0 for block in mesh.cells]
    found: dict[tuple[str, int], list[tuple[int, np.ndarray]]] = {}
    if key is None:
        key = next((k for k in _KEYS if k in mesh.cell_data), None)
    elif key not in mesh.cell_data:
        raise ValueError(f"tags: {key!r} is none of the mesh's cell data {sorted(mesh.cell_data)}{_meant(key, mesh)}")
    names = {} if key == "gmsh:geometrical" else _names(mesh.field_data)  # those are of physical groups
    if key is not None:
        values = [_whole(key, v) for v in mesh.cell_data[key]]
        _check_lengths(f"cell data {key!r}", [len(v) for v in values], [len(block.data) for block in mesh.cells])
        if key == "gmsh:physical":  # the sign is a direction, and zero is none
            values = [abs(v) for v in values]
        every = {(d, n) for d, v in zip(dims, values) for n in np.unique(v).tolist() if n or key != "gmsh:physical"}
        place = {entry: k for k, entry in enumerate(names)}
        for dim, number in sorted(every, key=lambda e: (place.get(e, len(place)), e)):
            rows = [(k, np.flatnonzero(v == number)) for k, v in enumerate(values) if dims[k] == dim]
            found.setdefault((names.get((dim, number), str(number)), dim), []).extend(rows)
    for name, members in mesh.cell_sets.items():
        # Gmsh's bounding entities and the like are no groups of the user's; its names tell of cells with several tags.
        if name.startswith("gmsh:") or (key is not None and name not in names.values()):
            continue
        _check_lengths(f"set {name!r}", [1] * len(members), [1] * len(mesh.cells))
        for k, rows in enumerate(members):
            if rows is not None and len(rows):
                found.setdefault((name, dims[k]), []).append((k, _rows(name, rows, len(mesh.cells[k].data))))
    tags = [Tag(name, dim, cells, np.zeros(0, int)) for (name, dim), cells in found.items()]
    for name, nodes in mesh.point_sets.items():
        tags.append(Tag(name, -1, [], _rows(name, nodes, len(mesh.points))))
    return tags


def chosen(tags: list[Tag], names: Sequence[str] | None) -> list[Tag]:
    """The tags of these names, in their order."""
    if names is None:
        return tags
    known = {tag.name for tag in tags}
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(str(name), known, n=1, cutoff=0.5)
            raise ValueError(
                f"tags: {name!r} is none of the mesh's groups {sorted(known)}"
                + (f"; did you mean {near[0]!r}?" if near else "; name groups that it has")
            )
    return [tag for name in names for tag in tags if tag.name == name]


def shared_out(claims: dict[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Disjoint groups from sets of nodes that may overlap: a node is the first's that claims it, a set that holds
    another whole comes after it, and none goes away empty-handed."""
    masks = {}
    for name, nodes in claims.items():
        masks[name] = np.zeros(count, bool)
        masks[name][nodes] = True
    sizes = {name: mask.sum() for name, mask in masks.items()}
    holds = {a: sum(sizes[b] < sizes[a] and not (masks[b] & ~masks[a]).any() for b in masks) for a in masks}
    order = sorted(masks, key=lambda name: holds[name])
    owner = np.full(count, -1)
    for k, name in enumerate(order):
        owner[masks[name] & (owner < 0)] = k
    for k, name in enumerate(order):
        mine = np.flatnonzero(masks[name])
        if not (owner[mine] == k).any():
            had = np.bincount(owner[owner >= 0], minlength=len(order))[owner[mine]]
            if holds[name] or had.max() < 2:
                theirs = ", ".join(sorted({repr(order[j]) for j in owner[mine]}))
                raise ValueError(
                    f"mesh: the group {name!r} would have no node: all of its own, {some(mine)}, belong to {theirs}; "
                    "refine there, or choose groups, the first first, by tags=[...]"
                )
            owner[mine[had.argmax()]] = k
    return {name: np.flatnonzero(owner == order.index(name)) for name in masks}


def _names(field_data: Any) -> dict[tuple[int, int], str]:
    """Names by dimension and number, as Gmsh has them; other field data are none."""
    out = {}
    for name, entry in field_data.items():
        entry = np.asarray(entry)
        if entry.shape == (2,) and entry.dtype.kind in "iuf" and (entry == np.round(entry)).all():
            out[int(entry[1]), int(entry[0])] = name
    return out


def _whole(key: str, values: Any) -> np.ndarray:
    """Tags as integers."""
    values = np.asarray(values).ravel()
    if values.dtype.kind not in "iuf" or not (np.isfinite(values) & (values == np.round(values))).all():
        raise ValueError(f"tags: the cell data {key!r} are no whole numbers; number the sides 1, 2, ...")
    return values.astype(int)


def _check_lengths(what: str, came: list[int], wanted: list[int]) -> None:
    """Refuse data that do not go with the blocks of cells."""
    if came != wanted:
        raise ValueError(f"mesh: its {what} has blocks of lengths {came}, its cells of {wanted}; write the mesh again")


def _rows(name: str, rows: Any, count: int) -> np.ndarray:
    """The members of a set as indices, unique."""
    rows = np.asarray(rows).ravel()
    if len(rows) == 0:
        return np.zeros(0, int)
    if rows.dtype.kind not in "iu" or rows.min() < 0 or rows.max() >= count:
        raise ValueError(
            f"mesh: the set {name!r} has members {some(rows) if rows.dtype.kind in 'iu' else rows.dtype}; expected "
            f"whole numbers from 0 to {count - 1}"
        )
    return np.unique(rows)


def _meant(key: str, mesh: Any) -> str:
    """What a wrong name may have meant."""
    near = difflib.get_close_matches(key, list(mesh.cell_data), n=1, cutoff=0.5)
    sets = sorted({*mesh.cell_sets, *mesh.point_sets, *_names(mesh.field_data).values()})
    if near:
        return f"; did you mean {near[0]!r}?"
    return f"; its groups {sets} are found by themselves, or chosen by a list of names" if sets else ""
