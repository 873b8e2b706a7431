"""What is static about a problem with several regions: a discretisation of each, and the places where they meet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.cloud.regions.region_cloud import RegionCloud, sides
from jsmitsm.cloud.sight.walls import nearest_seen
from jsmitsm.discretization.layout import Discretization, discretize, sorted_classes
from jsmitsm.discretization.periodic import Images
from jsmitsm.discretization.supports import default_size
from jsmitsm.equation.closing import with_recorded
from jsmitsm.equation.conditions import Group
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.regions.between import Between, between, check_regions, region_of
from jsmitsm.equation.regions.per_region import PerRegion
from jsmitsm.particle.recursion import Recursion
from jsmitsm.runtime.tracers import is_traced


@dataclass
class Part:
    """One region: its discretisation, and the number in the whole cloud of each of its particles."""

    name: str
    disc: Discretization
    ids: np.ndarray


@dataclass
class Meeting:
    """Particles at one point, a copy in each of some regions.

    parts : the numbers of the regions, ascending; copies : the particle in each, numbered in the whole cloud; pairs :
    (interface, pair on it) of the conditions between them.
    """

    parts: tuple[int, ...]
    copies: tuple[int, ...]
    pairs: tuple[tuple[str, int], ...]


@dataclass
class Regions:
    """A problem with several regions on its cloud; what ``Discretization`` is to one.

    Values, held ones and unknowns are numbered as in the whole cloud.
    """

    problem: Problem  # closed
    cloud: RegionCloud
    parts: list[Part]
    interfaces: dict[str, Between]
    meetings: list[Meeting]
    near: np.ndarray  # (N, w) every particle's neighbours in its own region, numbered in the whole cloud
    held: np.ndarray  # (N, F)
    images: Images
    given_stencils: bool = False  # the user's: nothing outside them is looked at
    kernel: None = None
    part: None = None  # of a cloud that several processes share
    contrast: float = 1.0  # of the conductivities on both sides of an interface, the largest
    squared: bool = False  # whether a region takes the least-squares form

    @property
    def rec(self) -> Recursion:
        """The recursion of the first region: dimension, fields and degrees are those of all."""
        return self.parts[0].disc.rec

    @property
    def scheme(self) -> Any:
        return self.parts[0].disc.scheme

    @property
    def points(self) -> Any:
        return self.cloud.points

    @property
    def linear(self) -> bool:
        return all(p.disc.linear for p in self.parts) and all(b.linear for b in self.interfaces.values())

    @property
    def partner(self) -> np.ndarray:
        return np.arange(len(self.cloud))

    @property
    def floating(self) -> tuple[int, ...]:
        """Fields of which no equation and no condition knows the value; a jump knows but a difference."""
        held_by = set(range(self.rec.fields))
        for part in self.parts:
            held_by &= set(part.disc.floating)
        return tuple(f for f in sorted(held_by) if not self._known_between(f))

    def _known_between(self, f: int) -> bool:
        """Whether a condition on an interface speaks of values of field f on one side alone."""
        for b in self.interfaces.values():
            zero = [side for side, (k, a) in b.slots if k == f and sum(a) == 0]
            if len(zero) == 1:
                return True
        return False

    @cached_property
    def unknowns(self) -> np.ndarray:
        """The number of each unknown among all values, (N, F); -1 for held ones."""
        number = np.full(self.held.size, -1)
        free = ~self.held.reshape(-1)
        number[free] = np.arange(free.sum())
        return number.reshape(self.held.shape)

    @property
    def groups(self) -> list[Group]:
        """The conditions of all regions' boundaries."""
        return [replace(g, ids=p.ids[g.ids]) for p in self.parts for g in p.disc.groups]

    @property
    def stencils(self) -> Any:
        return _Table(self.near)


@dataclass
class _Table:
    indices: np.ndarray


def discretize_regions(
    problem: Problem, cloud: RegionCloud, order: int, depth: int | str, near: Any = None, sources: bool = True
) -> Regions:
    """Every region discretised, and who meets whom.

    near (N, w): the neighbours of an earlier solve, in the numbers of the whole cloud.
    """
    check_regions(problem, cloud)
    made: list[Part] = []
    for name, ids in cloud.regions.items():
        made.append(Part(name, _region(problem, cloud, name, order, depth, _local(near, ids), sources), ids))
    deepest = max(p.disc.rec.depth for p in made)
    made = [
        p if p.disc.rec.depth == deepest
        else Part(p.name, _region(problem, cloud, p.name, order, deepest, _local(near, p.ids), sources), p.ids)
        for p in made
    ]  # fmt: skip
    recorded = PerRegion({p.name: p.disc.traced for p in made})
    problem = with_recorded(problem, recorded, cloud.dim)
    held = np.zeros((len(cloud), problem.fields), bool)
    for p in made:
        held[p.ids] = p.disc.held
    interfaces = {
        name: between(problem, name, cloud.points[pairs[:, 0]], cloud.interface_normals[name])
        for name, pairs in cloud.interfaces.items()
    }
    meetings = _meetings(cloud, held)
    if near is None:
        _widened(made, meetings)
    none = Images(len(cloud), np.zeros(0, int), np.zeros((0, cloud.dim)), np.zeros(0, int))
    copies = np.array([i for m in meetings for i in m.copies], int)
    for p in made:
        bound = np.isin(p.ids[p.disc.active], copies)
        p.disc.classes = sorted_classes(p.disc, p.disc.active[~bound], p.disc.stencils)
    table = near if near is not None else _table(made, len(cloud))
    return Regions(problem, cloud, made, interfaces, meetings, table, held, none, near is not None)


def _region(
    problem: Problem, cloud: RegionCloud, name: str, order: int, depth: int | str, near: Any, sources: bool
) -> Discretization:
    """The discretisation of one region; whatever is wrong with it is said to be this region's."""
    own = region_of(problem, cloud, name)
    try:
        disc = discretize(
            own, cloud.region(name), "S", order, None, near, None, sources=sources, depth=depth, region=True
        )
    except ValueError as error:
        text = str(error)
        if text.startswith("cloud:") and "too few" in text:
            raise ValueError(
                f"cloud: the region {name!r} is too small: {text[7:]}; reduce the spacing there, or lower the order"
            ) from None
        raise ValueError(f"{text} (in the region {name!r})") from error
    highest = max(disc.traced.order)
    if highest != 2 and len(cloud.interfaces):
        raise ValueError(
            f"pde[{name!r}]: of order {highest}; interfaces bind values and fluxes of equations of second order, "
            + ("write it as a system of them" if highest > 2 else "give it a diffusion that the spacing resolves")
        )
    lower = [f for f, less in enumerate(disc.rec.weights) if less]
    if lower and len(cloud.interfaces):
        raise ValueError(
            f"pde[{name!r}]: field {lower[0]}, as a pressure, enters by fewer derivatives than the equations that know "
            "it, and interfaces bind a value and a flux of every field; such systems are made for one region"
        )
    if disc.scheme.n_data:
        raise ValueError(
            f"bcs: a side of the region {name!r} has more conditions than the equation has fields, which is not made "
            "for clouds of several regions; give it one for each field"
        )
    return disc


def _local(near: Any, ids: np.ndarray) -> Any:
    """Neighbours in the numbers of one region, as stencils; None where none are given."""
    if near is None:
        return None
    place = np.full(int(ids.max()) + 2, -1, np.int32)
    place[ids] = np.arange(len(ids))
    return Stencils(place[near[ids]], None)


def _table(parts: list[Part], n: int) -> np.ndarray:
    """All stencils in one padded array (N, w)."""
    width = max(np.shape(p.disc.stencils.indices)[1] for p in parts)
    out = np.full((n, width), -1, np.int32)
    for p in parts:
        near = np.asarray(p.disc.stencils.indices)
        out[p.ids[:, None], np.arange(near.shape[1])] = np.where(near >= 0, p.ids[near], -1)
    return out


def _widened(parts: list[Part], meetings: list[Meeting]) -> None:
    """Copies take the stencil of an uneven cloud on each side: at high orders the smaller one is too weak there."""
    for k, p in enumerate(parts):
        rank = {int(i): j for j, i in enumerate(p.ids)}
        own = np.array([rank[c] for m in meetings for q, c in zip(m.parts, m.copies) if q == k], int)
        if not len(own) or is_traced(p.disc.stencils.indices) or p.disc.cloud.dim == 1:
            continue
        own = np.unique(own)
        size = min(default_size(p.disc.scheme), len(p.ids))
        found = nearest_seen(np.asarray(p.disc.cloud.points), size, own, p.disc.walls)
        near = np.asarray(p.disc.stencils.indices)
        width = max(near.shape[1], found.indices.shape[1])
        both = np.full((len(near), width), -1, near.dtype)
        both[:, : near.shape[1]] = near
        both[own] = -1
        both[own, : found.indices.shape[1]] = found.indices
        p.disc.stencils = replace(p.disc.stencils, indices=both, radius=None)


def _meetings(cloud: RegionCloud, held: np.ndarray) -> list[Meeting]:
    """Copies that belong together; those whose values are held by an outer condition need no equation."""
    parent = np.arange(len(cloud))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = int(parent[i])
        return i

    links: list[tuple[int, str, int]] = []
    for name, pairs in cloud.interfaces.items():
        for k, (i, j) in enumerate(pairs):
            links.append((int(i), name, k))
            parent[root(int(j))] = root(int(i))
    found: dict[int, list[tuple[str, int]]] = {}
    for i, name, k in links:
        found.setdefault(root(i), []).append((name, k))
    names, out = list(cloud.regions), []
    for conditions in found.values():
        part_of = {}
        for name, k in conditions:
            for side, i in zip(sides(name), cloud.interfaces[name][k]):
                part_of[names.index(side)] = int(i)
        parts = tuple(sorted(part_of))
        copies = tuple(part_of[p] for p in parts)
        if held[list(copies)].all():
            continue
        out.append(Meeting(parts, copies, tuple(conditions)))
    return out
