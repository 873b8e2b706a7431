"""Regions on a lattice: its cells belong to the regions whose predicates hold in their middles."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jsmitsm.cloud.cloud import INTERIOR
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.cloud.shapes import Predicate, grouped
from jsmitsm.runtime.errors import is_whole, short


class _Facet:
    """Facets between cells: their middles (M, D), unit normals (M, D), and corners (M, 2^(D-1)), numbers of nodes."""

    def __init__(self, middles: Any, normals: Any, corners: Any):
        self.middles, self.normals, self.corners = middles, normals, corners


def cut_lattice(
    shapes: Mapping[str, Any], box: tuple[np.ndarray, np.ndarray], shape: Sequence[int],
    groups: Mapping[str, Predicate] | None,
) -> RegionCloud:  # fmt: skip
    """Particles at the nodes of a lattice of ``shape`` on a box, copied where cells of several regions meet."""
    lo, hi = box
    dim, names = len(lo), list(shapes)
    if not isinstance(shape, (tuple, list)) or len(shape) != dim or not all(is_whole(n, 3, 10**6) for n in shape):
        raise ValueError(f"lattice: expected {dim} whole numbers from 3, particles along each axis, got {short(shape)}")
    ticks = [np.linspace(a, b, n) for a, b, n in zip(lo, hi, shape)]
    points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, dim)
    middles = np.stack(np.meshgrid(*(0.5 * (t[1:] + t[:-1]) for t in ticks), indexing="ij"), axis=-1)
    tags = _tags(shapes, middles.reshape(-1, dim)).reshape(middles.shape[:-1])
    facets = _facets(tags, ticks)
    # Every node's cells: the corners of a cell are its lowest one and those one step along.
    number = np.arange(len(points)).reshape(shape)
    belongs = np.zeros((len(names), len(points)), bool)
    for step in itertools.product((0, 1), repeat=dim):
        at = number[tuple(slice(s, n - 1 + s) for s, n in zip(step, shape))]
        for k in range(len(names)):
            belongs[k, at[tags == k]] = True
    copies, start = np.full(belongs.shape, -1), 0
    for k, some in enumerate(belongs):
        copies[k, some] = start + np.arange(some.sum())
        start += int(some.sum())
    return _cloud(names, points, copies, facets, groups)


def _tags(shapes: Mapping[str, Any], middles: np.ndarray) -> np.ndarray:
    """The number of the region (M,) of every cell, -1 outside."""
    tags = np.full(len(middles), -1)
    for k, (name, shape) in enumerate(shapes.items()):
        inside = _inside(name, shape, middles)
        twice = np.flatnonzero(inside & (tags >= 0))
        if len(twice):
            raise ValueError(
                f"shapes: {list(shapes)[tags[twice[0]]]!r} and {name!r} overlap at {middles[twice[0]]}; let one of the "
                "predicates exclude the other"
            )
        if not inside.any():
            raise ValueError(f"shapes[{name!r}]: holds the middle of no cell of the lattice; refine it")
        tags[inside] = k
    return tags


def _inside(name: str, shape: Any, middles: np.ndarray) -> np.ndarray:
    """Where a predicate of many points holds, or a signed distance of one point is negative."""
    wanted = "a predicate (M, D) -> (M,) of booleans, or a signed distance"
    if not callable(shape):
        raise ValueError(f"shapes[{name!r}]: with lattice= expected {wanted}, got {short(shape)}")
    try:
        found = np.asarray(shape(middles))
    except Exception:  # a signed distance may not take many points
        found = np.zeros(0)
    if found.dtype == bool and found.shape == (len(middles),):
        return found
    try:
        level = np.asarray(jax.vmap(shape)(middles))
    except Exception as error:
        raise ValueError(f"shapes[{name!r}]: with lattice= expected {wanted}; calling it failed: {error}") from error
    if level.shape != (len(middles),) or level.dtype.kind != "f":
        raise ValueError(f"shapes[{name!r}]: with lattice= expected {wanted}, it returns shape {found.shape}")
    return level < 0


def _facets(tags: np.ndarray, ticks: list[np.ndarray]) -> dict[tuple[int, int], _Facet]:
    """The facets between cells of two regions, normals from the first to the second; of a region and -1, outward."""
    dim, shape = tags.ndim, tuple(n + 1 for n in tags.shape)
    number = np.arange(int(np.prod(shape))).reshape(shape)
    wide = np.pad(tags, 1, constant_values=-1)
    centres = [0.5 * (t[1:] + t[:-1]) for t in ticks]
    found: dict[tuple[int, int], list[tuple[np.ndarray, ...]]] = {}
    for axis in range(dim):
        inner = [slice(1, -1)] * dim
        below, above = (wide[tuple(s if k != axis else cut for k, s in enumerate(inner))]
                        for cut in (slice(None, -1), slice(1, None)))  # fmt: skip
        middles = np.stack(np.meshgrid(*(ticks[k] if k == axis else centres[k] for k in range(dim)), indexing="ij"), -1)
        across = [n - (k != axis) for k, n in enumerate(shape)]
        corners = []
        for step in itertools.product(*((0,) if k == axis else (0, 1) for k in range(dim))):
            corners.append(number[tuple(slice(s, s + n) for s, n in zip(step, across))])
        ends = np.stack(corners, axis=-1)
        for first, second in {(int(a), int(b)) for a, b in zip(below.ravel(), above.ravel()) if a != b}:
            here = (below == first) & (above == second)
            turned = first < 0 or (second >= 0 and second < first)
            normal = np.zeros((int(here.sum()), dim))
            normal[:, axis] = -1.0 if turned else 1.0
            pair = (second, first) if turned else (first, second)
            found.setdefault(pair, []).append((middles[here], normal, ends[here]))
    return {pair: _Facet(*(np.concatenate(parts) for parts in zip(*some))) for pair, some in found.items()}


def _summed(facet: _Facet, count: int, some: np.ndarray | None = None) -> np.ndarray:
    """The sum of the facets' normals at every node, (count, D)."""
    out = np.zeros((count, facet.normals.shape[1]))
    for corner in facet.corners.T:
        chosen = slice(None) if some is None else some
        np.add.at(out, corner[chosen], facet.normals[chosen])
    return out


def _cloud(
    names: list[str], points: np.ndarray, copies: np.ndarray, facets: dict[tuple[int, int], _Facet], groups: Any
) -> RegionCloud:
    """The cloud of the copies (regions, nodes) of the nodes."""
    total, dim = int(copies.max()) + 1, points.shape[1]
    group: Any = np.full(total, INTERIOR, object)
    normals, labelled = np.full((total, dim), np.nan), _labelled(points, facets, groups)
    for (k, other), facet in facets.items():
        if other >= 0:
            continue
        nodes = np.unique(facet.corners)
        label, side = labelled(points[nodes]), labelled(facet.middles)
        whole = _summed(facet, len(points))[nodes]
        for name in dict.fromkeys(label):
            # At a corner between groups the normal is that of the own side.
            mine = np.asarray(label == name)
            own = _summed(facet, len(points), np.flatnonzero(side == name))[nodes[mine]]
            way = np.where(np.linalg.norm(own, axis=1, keepdims=True) > 0, own, whole[mine])
            at = copies[k, nodes[mine]]
            group[at], normals[at] = name, _unit(way, points[nodes[mine]])
    pairs, pair_normals = {}, {}
    for (i, j), facet in sorted(facets.items()):
        if j < 0:
            continue
        name, nodes = f"{names[i]}|{names[j]}", np.unique(facet.corners)
        if groups is not None and name in groups:
            raise ValueError(f"groups: the name {name!r} is taken by an interface; choose another")
        pairs[name] = np.stack([copies[i, nodes], copies[j, nodes]], axis=1)
        pair_normals[name] = _unit(_summed(facet, len(points))[nodes], points[nodes])
        for column in pairs[name].T:
            free = np.asarray(group[column] == INTERIOR)
            group[column[free]], normals[column[free]] = name, pair_normals[name][free]
    order = [INTERIOR, *(["boundary"] if groups is None else groups), *pairs]
    index = {name: np.flatnonzero(group == name) for name in order}
    where = np.concatenate([np.flatnonzero(own >= 0) for own in copies])
    members = {name: own[own >= 0] for name, own in zip(names, copies)}
    kept = {name: ids for name, ids in index.items() if name == INTERIOR or len(ids)}
    return RegionCloud(points[where], kept, normals, members, pairs, pair_normals)


def _labelled(points: np.ndarray, facets: dict[tuple[int, int], _Facet], groups: Any) -> Callable[..., np.ndarray]:
    """The function that gives points of the boundary their groups; what is wrong with these is said of the nodes."""
    if groups is None:
        return lambda at: np.full(len(at), "boundary", object)
    outer = [facet.corners.ravel() for (_, other), facet in facets.items() if other < 0]
    grouped(points[np.unique(np.concatenate(outer))], groups)

    def label(at: np.ndarray) -> np.ndarray:
        out = np.full(len(at), "", object)
        for name, predicate in groups.items():
            out[np.asarray(out == "") & np.asarray(predicate(at), bool)] = name
        return out

    return label


def _unit(way: np.ndarray, at: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(way, axis=1, keepdims=True)
    bad = np.flatnonzero(size[:, 0] == 0)
    if len(bad):
        raise ValueError(
            f"shapes: two regions touch in a point alone, {at[bad[0]]}, where no way leads from one to the other; "
            "let the predicates part them along whole sides of cells"
        )
    return way / size
