"""Periodic conditions: images of the particles beyond paired groups."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.equation.problem import Problem
from jsmitsm.runtime.tracers import is_traced

# A particle and the copy of another nearer than this part of the translation are the same.
_SAME = 1e-8


@dataclass(frozen=True)
class Images:
    """Copies of particles, appended after the N particles of the cloud.

    owner (M,): whose copy each one is; shift (M, D): where it stands relative to it; aside: the
    particles of second groups, on which images of the first ones fall.
    """

    n: int
    owner: np.ndarray
    shift: np.ndarray
    aside: np.ndarray

    def extend(self, points: Any) -> Any:
        """Points (N, D) with the images behind, (N + M, D)."""
        if not len(self.owner):
            return points
        xp = jnp if is_traced(points) else np
        return xp.concatenate([points, points[self.owner] + self.shift])

    def searched(self, points: np.ndarray) -> np.ndarray:
        """What a neighbour search looks at: second groups are moved out of everybody's reach."""
        found = np.array(self.extend(points))
        far = 1e3 * (np.ptp(found, axis=0).max() + 1.0)
        found[self.aside] += far * (1.0 + np.arange(len(self.aside)))[:, None]
        return found

    def extend_values(self, values: Any) -> Any:
        """Values (N, ...) with those of the images behind."""
        if not len(self.owner):
            return values
        return (jnp if is_traced(values) else np).concatenate([values, values[self.owner]])

    def owners(self, index: Any) -> Any:
        """Neighbour numbers with images replaced by their owners; -1 stays."""
        if not len(self.owner):
            return index
        return np.concatenate([np.arange(self.n), self.owner, [-1]])[index]


def periodic_images(problem: Problem, cloud: Cloud, given: np.ndarray) -> tuple[Images, np.ndarray]:
    """The images that the problem's periodic pairs call for, and every particle's partner.

    The particles of a pair's second group take the values of their partners in the first and
    carry no equation. given (N,): those whose values conditions hold, which lend and do not take.
    Raises ValueError where the groups are no translated copies.
    """
    n = len(cloud)
    partner = np.arange(n)
    pairs = dict.fromkeys(c.groups for cs in problem.bcs.values() for c in cs if c.kind == "periodic")
    none = Images(n, np.zeros(0, int), np.zeros((0, cloud.dim)), np.zeros(0, int))
    if not pairs:
        return none, partner
    if isinstance(cloud.points, jax.core.Tracer):
        raise ValueError("cloud: its points are traced by a JAX transform; periodic partners are found on the host")
    points = np.asarray(cloud.points)
    shifts = []
    for first, second in pairs:
        shift, match = _matched(points, cloud, first, second)
        shifts.append(shift)
        partner[cloud.groups[second]] = cloud.groups[first][match]
    partner = partner[partner]  # a corner may be an image of an image
    partner = _with_corners_met(partner, points, cloud, shifts, given)
    own = np.flatnonzero(partner == np.arange(n))
    owner, moved = [], []
    for steps in product((-1, 0, 1), repeat=len(shifts)):
        if any(steps):
            owner.append(own)
            moved.append(np.broadcast_to(np.array(steps) @ np.array(shifts), (len(own), cloud.dim)))
    return Images(n, np.concatenate(owner), np.concatenate(moved), np.flatnonzero(partner != np.arange(n))), partner


def _with_corners_met(
    partner: np.ndarray, points: np.ndarray, cloud: Cloud, shifts: list[np.ndarray], given: np.ndarray
) -> np.ndarray:
    """The partners, of particles too on which the copy of another falls though no pair names them.

    A corner belongs to one side, so that the pair of the other sides misses it. Left with an equation of its own it
    would state that of its copy once more: two rows of a collocation that are the same.
    """
    from scipy.spatial import cKDTree

    partner, own = partner.copy(), partner == np.arange(len(points))
    sides = [members for name, members in cloud.groups.items() if name != INTERIOR]
    ids = np.unique(np.concatenate(sides).astype(int))
    ids = ids[own[ids]]
    tree = cKDTree(points[ids])

    def lender(i: int) -> int:
        while partner[i] != i:
            i = partner[i]
        return i

    for shift in shifts:
        distance, near = tree.query(points[ids] + shift)
        for k in np.flatnonzero(distance <= _SAME * np.linalg.norm(shift)):
            one, other = lender(ids[k]), lender(ids[near[k]])
            if given[other]:
                one, other = other, one
            if not given[other]:
                partner[other] = one
    while (partner[partner] != partner)[ids].any():
        partner[ids] = partner[partner[ids]]
    return partner[partner]


def with_corners(problem: Problem, cloud: Cloud) -> Cloud:
    """The cloud as the other conditions see it: corners of the first group of a pair belong to the side they meet.

    A strip that repeats itself has no corners; what a lattice gives to its left side lies on the bottom too, and
    without the bottom's condition its equation would be one-sided and lose digits. Only flat sides are recognised,
    and those whose values are no array over the group.
    """
    pairs = dict.fromkeys(c.groups for cs in problem.bcs.values() for c in cs if c.kind == "periodic")
    periodic = {name for pair in pairs for name in pair}
    sides = [name for name in problem.bcs if name in cloud.groups and name not in periodic and _anywhere(
        problem.bcs[name], len(cloud.groups[name]))]  # fmt: skip
    if not pairs or not sides or not periodic <= set(cloud.groups) or is_traced(cloud.points, cloud.normals):
        return cloud
    if cloud.normals is None:
        return cloud
    fixed = [c.indices for cs in problem.bcs.values() for c in cs if c.kind == "fix"]
    ids = np.unique(np.concatenate([cloud.groups[first] for first, _ in pairs]))
    ids = np.setdiff1d(ids, np.concatenate([[], *fixed]).astype(int))
    groups, normals = dict(cloud.groups), np.array(cloud.normals)
    for name in sides:
        found, normal = _on_side(np.asarray(cloud.points), np.asarray(cloud.normals), ids, cloud.groups[name])
        groups = {other: np.setdiff1d(members, found) for other, members in groups.items()}
        groups[name] = np.concatenate([cloud.groups[name], found])
        normals[found], ids = normal, np.setdiff1d(ids, found)
    return Cloud(cloud.points, groups, normals)


def _anywhere(conditions: list[Any], n: int) -> bool:
    """Whether conditions can be asked for at any particle: no part of them is an array over the n of their group."""
    return not any(np.ndim(c.parts[k]) and np.shape(c.parts[k])[0] == n for c in conditions for k in c.numbers)


def _on_side(
    points: np.ndarray, normals: np.ndarray, ids: np.ndarray, side: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Those of the particles ``ids`` that lie in the plane of the ``side`` near them, and its normals there."""
    from scipy.spatial import cKDTree

    distance, near = cKDTree(points).query(points[ids], k=min(4 ** points.shape[1], len(points)))
    belongs = np.isin(near, side)
    nearest = near[np.arange(len(ids)), belongs.argmax(axis=1)]
    height = np.einsum("nkd,nd->nk", points[near] - points[ids][:, None], normals[nearest])
    flat = np.abs(np.where(near == nearest[:, None], height, 0.0)).max(axis=1)
    on = belongs.any(axis=1) & (np.maximum(flat, height.max(axis=1)) <= 1e-6 * distance[:, -1])
    return ids[on], normals[nearest[on]]


def _matched(points: np.ndarray, cloud: Cloud, first: str, second: str) -> tuple[np.ndarray, np.ndarray]:
    """The translation from one group to the other, and each second particle's partner."""
    from scipy.spatial import cKDTree

    for name in (first, second):
        if name not in cloud.groups:
            raise ValueError(f"periodic: {name!r} is no group of the cloud; it has {list(cloud.groups)}")
    a, b = points[cloud.groups[first]], points[cloud.groups[second]]
    shift = b.mean(axis=0) - a.mean(axis=0) if len(a) == len(b) else b[0] - a[0]
    size = np.linalg.norm(shift)
    distance, match = cKDTree(a + shift).query(b)
    if len(a) != len(b) or distance.max() > _SAME * size or len(np.unique(match)) != len(b):
        raise ValueError(
            f"periodic: the groups {first!r} ({len(a)} particles) and {second!r} ({len(b)}) are no translation "
            "of each other (congruent, one for one); give both the same number of particles, one for one"
        )
    return shift, match
