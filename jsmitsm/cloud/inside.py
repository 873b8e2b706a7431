"""Which points lie in the domain of a cloud, told by its particles alone: whatever made the cloud, it works."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.runtime.tracers import concrete, is_traced

# In local spacings: a point so near to a boundary particle is inside, one farther than the second number is outside
# where the boundary particles around it say so.
_NEAR, _FAR = 0.5, 0.95
# Beyond so many spacings from a boundary particle that is the nearest of all particles nothing is inside.
_BEYOND = 2.5
# Boundary particles asked, those that are at most so much farther than the nearest, in spacings.
_ASKED, _MARGIN = {1: 2, 2: 6, 3: 12}, 0.5
# A point at a smaller angle (its cosine) to the normal than this stands in front of a boundary particle.
_FRONT = 0.35
# Where no boundary closes the cloud: particles all of which lie in one direction (the length of the mean direction).
_ONE_SIDED = 0.65
# A table of nearest particles: so many in a square at the most, asked for so many points at a time, and made once more
# points than so many times the particles were asked for.
_IN_SQUARE, _AT_ONCE, _OFTEN = 16, 4096, 3


class Nearest(NamedTuple):
    """The distance (M,) of points from their nearest particles, and the numbers (M,) of these."""

    distance: np.ndarray
    number: np.ndarray


class Table:
    """For every square of a grid over the particles those (n, w) that are the nearest to one of its points.

    In 2D a look there takes a quarter of the time of a search in a tree. Making it takes some three searches for as
    many points as there are particles.
    """

    def __init__(
        self, points: np.ndarray, tree: Any, low: np.ndarray, edge: float, shape: np.ndarray, rows: np.ndarray
    ):
        self.tree, self.low, self.edge, self.shape, self.rows = tree, low, edge, shape, rows
        self.x, self.y = (np.ascontiguousarray(x)[rows] for x in points.T)

    @classmethod
    def of(cls, points: np.ndarray, tree: Any) -> Table | None:
        """None in other dimensions, and where some squares would hold too many: in graded clouds."""
        low, size = points.min(axis=0), np.ptp(points, axis=0)
        if points.shape[1] != 2 or len(points) <= _IN_SQUARE or not (size > 0).all():
            return None
        edge = float(np.sqrt(size.prod() / len(points)))
        shape = np.floor(size / edge).astype(int) + 1
        if shape.prod() > 4 * len(points):
            return None
        squares = np.stack(np.divmod(np.arange(shape.prod()), shape[1]), axis=1)
        distance, rows = tree.query(low + (squares + 0.5) * edge, k=_IN_SQUARE + 1)
        needed = distance <= distance[:, :1] + np.sqrt(2.0) * edge * (1 + 1e-9)  # twice half a diagonal
        width = int(needed.sum(axis=1).max())
        if width > _IN_SQUARE:
            return None
        return cls(points, tree, low, edge, shape, np.where(needed, rows, rows[:, :1])[:, :width])

    def nearest(self, points: np.ndarray) -> Nearest:
        """The nearest particles of points (M, 2), some at a time, so that all stays in cache."""
        parts = [self._some(points[k : k + _AT_ONCE]) for k in range(0, max(len(points), 1), _AT_ONCE)]
        return parts[0] if len(parts) == 1 else Nearest(*map(np.concatenate, zip(*parts)))

    def _some(self, points: np.ndarray) -> Nearest:
        place = np.floor((points - self.low) / self.edge)
        if not ((place >= 0) & (place < self.shape)).all():
            return Nearest(*self.tree.query(points))
        square = (place[:, 0] * self.shape[1] + place[:, 1]).astype(int)
        away = (self.x[square] - points[:, :1]) ** 2 + (self.y[square] - points[:, 1:]) ** 2
        which = away.argmin(axis=1)
        return Nearest(np.sqrt(away[np.arange(len(which)), which]), self.rows[square, which])


class Inside:
    """The domain of a cloud, as its particles show it.

    A point whose nearest particle is an interior one is inside; so is one close to a boundary particle. Else the
    normals of the boundary particles around it decide, the cloud's and ones that point away from the interior
    particles behind them: a corner of a lattice has the normal of one of its sides only.
    """

    def __init__(self, points: np.ndarray, interior: np.ndarray, boundary: np.ndarray, normals: np.ndarray | None):
        self.points, self.interior, self.boundary = points, interior, boundary
        self.dim, self._given, self._asked = points.shape[1], normals, 0

    @cached_property
    def trees(self) -> tuple[Any, Any, Any]:
        """Search trees of all particles, of the interior ones and of those of the boundary (None where empty)."""
        from scipy.spatial import cKDTree

        made = (cKDTree(self.points[ids]) if len(ids) else None for ids in (self.interior, self.boundary))
        return cKDTree(self.points), *made

    @cached_property
    def spacing(self) -> np.ndarray:
        """The distance (N,) of every particle from its neighbours: of boundary particles from those on the boundary."""
        every, _, rim = self.trees
        count = min(2 * self.dim, len(self.points) - 1)
        out = every.query(self.points, k=count + 1)[0][:, 1:].mean(axis=1) if count else np.full(1, np.inf)
        along = min(2 * (self.dim - 1), len(self.boundary) - 1)
        if along > 0:
            there = rim.query(self.points[self.boundary], k=along + 1)[0][:, 1:].mean(axis=1)
            # Alone on its part of the boundary, a particle would be far from the next.
            out[self.boundary] = np.minimum(there, 2.0 * out[self.boundary])
        elif self.dim == 1 and count:
            out[self.boundary] = every.query(self.points[self.boundary], k=2)[0][:, 1]
        return out

    @cached_property
    def place(self) -> np.ndarray:
        """The number (N,) of every particle among those of the boundary, -1 in the interior."""
        out = np.full(len(self.points), -1)
        out[self.boundary] = np.arange(len(self.boundary))
        return out

    @cached_property
    def from_rim(self) -> np.ndarray:
        """The distance (N,) of every particle from the nearest one of the boundary."""
        return self.trees[2].query(self.points)[0] if len(self.boundary) else np.full(len(self.points), np.inf)

    @cached_property
    def depth(self) -> np.ndarray:
        """The distance (B,) of every boundary particle from the nearest interior one."""
        if not len(self.interior):
            return np.zeros(max(1, len(self.boundary)))
        return self.trees[1].query(self.points[self.boundary])[0] if len(self.boundary) else np.zeros(1)

    @cached_property
    def behind(self) -> np.ndarray:
        """Directions (B, D) of the boundary particles away from the interior ones behind them."""
        rim = self.points[self.boundary]
        if not len(self.interior):
            return np.zeros(rim.shape)
        count = min(self.dim + 1, len(self.interior))
        distance, near = self.trees[1].query(rim, k=range(1, count + 1))
        weight = 1.0 / distance**2
        mean = (self.points[self.interior][near] * weight[..., None]).sum(axis=1) / weight.sum(axis=1)[:, None]
        away = rim - mean
        length = np.linalg.norm(away, axis=1, keepdims=True)
        return away / np.where(length > 0, length, 1.0)

    @cached_property
    def normals(self) -> np.ndarray:
        """Outward normals (B, D) of the boundary particles: the cloud's where it has them, else fitted ones, those of
        the line or plane through a particle and its neighbours on the boundary."""
        fitted, count = self.behind, {1: 0, 2: 3, 3: 7}[self.dim]
        given = np.full(fitted.shape, np.nan) if self._given is None else self._given[self.boundary]
        bare = np.flatnonzero(~np.isfinite(given).all(axis=1))
        if not count or len(self.boundary) < count or not len(bare):
            return np.where(np.isfinite(given), given, fitted)
        rim = self.points[self.boundary]
        around = rim[self.trees[2].query(rim[bare], k=count)[1]]
        around = around - around.mean(axis=1, keepdims=True)
        across = np.linalg.eigh(np.einsum("bki,bkj->bij", around, around))[1][:, :, 0]
        side = np.einsum("bi,bi->b", across, fitted[bare])
        given = given.copy()
        given[bare] = np.where(np.abs(side) > _FRONT, np.sign(side), 0.0)[:, None] * across
        return np.where((given != 0).any(axis=1, keepdims=True) & np.isfinite(given), given, fitted)

    @cached_property
    def facing(self) -> bool:
        """Whether boundary particles have others straight before them: parts of the domain come close to each other."""
        count = min(4 * self.dim + 1, len(self.points))
        rim = self.points[self.boundary]
        if not len(rim) or count < 2:
            return False
        distance, near = self.trees[0].query(rim, k=count)
        height = np.einsum("bkd,bd->bk", self.points[near] - rim[:, None], self.normals)
        return bool((height[:, 1:] > 0.5 * distance[:, 1:]).any())

    def nearest(self, points: np.ndarray, count: int) -> tuple[np.ndarray, Nearest]:
        """The nearest particles (M, count) of points (M, D), those across a gap last; and the nearest of all."""
        more = min(count + 4 * self.dim, len(self.points)) if self.facing else count
        if more == 1:
            first = self.first(points)
            return first.number[:, None], first
        distance, near = self.trees[0].query(points, k=range(1, more + 1))
        first = Nearest(distance[:, 0], near[:, 0])
        if more == count:
            return near, first
        place = self.place[near]
        offset = points[:, None] - self.points[near]
        height = np.where(place >= 0, np.einsum("mkd,mkd->mk", offset, self.normals[place]), 0.0)
        across = height > np.maximum(0.02 * self.spacing[near], 0.1 * distance)
        # A point outside is before all boundary particles around; the nearest serves it.
        others = ~across & (distance <= _FAR * self.spacing[near])
        moved = across[:, 0] & others.any(axis=1)
        order = np.argsort(across & moved[:, None], axis=1, kind="stable")[:, :count]
        return np.take_along_axis(near, order, axis=1), first

    def first(self, points: np.ndarray) -> Nearest:
        """The nearest particles of points (M, D): from a table, once so many were asked for that it pays."""
        self._asked += len(points)
        if self._asked > _OFTEN * len(self.points) and self._table is not None:
            return self._table.nearest(points)
        return Nearest(*self.trees[0].query(points))

    @cached_property
    def _table(self) -> Table | None:
        return Table.of(self.points, self.trees[0])

    def outside(self, points: Any, first: Nearest | None = None) -> Any:
        """Mask (M,) of the points (M, D) outside; first: their nearest particles, where they are known."""
        host = concrete(points)
        if host is None:
            return self._outside(points, jnp, None)
        return self._outside(np.asarray(host, float), np, first)

    def _outside(self, points: Any, xp: Any, first: Nearest | None) -> Any:
        distance, nearest = first or (x[:, 0] for x in self._query(0, points, 1))
        place, spacing = xp.asarray(self.place)[nearest], xp.asarray(self.spacing)[nearest]
        rim = place >= 0
        out = rim & (distance > _BEYOND * xp.maximum(spacing, xp.asarray(self.depth)[place]))
        lone = ~rim & (distance > spacing)
        out = _where(lone, out, points, self._beyond_open_side)
        if not len(self.boundary):
            return out
        doubtful = ~out & (distance > _NEAR * xp.where(rim, 1.0, 0.5) * spacing)
        if xp is np:
            doubtful[doubtful] = ~self._behind_rim(points[doubtful], distance[doubtful], nearest[doubtful])
        return _where(doubtful, out, points, self._in_front, distance, rim)

    def _behind_rim(self, points: np.ndarray, distance: np.ndarray, nearest: np.ndarray) -> np.ndarray:
        """Which points (M, D) are certainly inside: far from the boundary, or behind its nearest particle.

        What ``_in_front`` would find as well, at a small part of the cost. distance, nearest (M,): of all particles.
        """
        place = self.place[nearest].copy()
        inner = place < 0
        reach = _MARGIN * self.spacing[self.boundary].max(initial=0.0)
        sure = inner & (self.from_rim[nearest] > 2.0 * distance + reach)
        left = np.flatnonzero(inner & ~sure)
        if len(left):
            place[left] = self.trees[2].query(points[left])[1]
        left = np.flatnonzero(~sure)
        rim = self.boundary[place[left]]
        height = np.einsum("md,md->m", points[left] - self.points[rim], self.normals[place[left]])
        sure[left] = (height <= _NEAR * self.spacing[rim]) & (
            inner[left] | (distance[left] <= _FAR * self.spacing[rim])
        )
        return sure

    def _query(self, which: int, points: Any, count: int) -> tuple[Any, Any]:
        """Distances and numbers (M, count) of the nearest of all, the interior, or the boundary particles."""
        if not is_traced(points):
            return self.trees[which].query(points, k=range(1, count + 1))
        there = (self.points, self.points[self.interior], self.points[self.boundary])[which]
        square = jnp.sum((points[:, None] - there[None]) ** 2, axis=2)
        found, index = jax.lax.top_k(-square, count)
        return jnp.sqrt(-found), index

    def _beyond_open_side(self, points: Any) -> Any:
        """Whether all particles around lie in one direction, and none near."""
        xp: Any = jnp if is_traced(points) else np
        distance, near = self._query(0, points, min(8 * self.dim, len(self.points)))
        away = (xp.asarray(self.points)[near] - points[:, None]) / xp.where(distance > 0, distance, 1.0)[..., None]
        one_sided = xp.sqrt((away.mean(axis=1) ** 2).sum(axis=1)) > _ONE_SIDED
        return one_sided & (distance[:, 0] > xp.asarray(self.spacing)[near].mean(axis=1))

    def _in_front(self, points: Any, nearest: Any, rim: Any) -> Any:
        """Whether points (M, D) lie before the boundary; ``nearest`` (M,): their distance from the nearest particle of
        all, ``rim`` (M,): whether that is one of the boundary."""
        xp: Any = jnp if is_traced(points) else np
        away, near = self._query(2, points, min(_ASKED[self.dim], len(self.boundary)))
        distance, spacing = away[:, 0], xp.asarray(self.spacing)[xp.asarray(self.boundary)[near[:, 0]]]
        asked = away <= (distance + _MARGIN * spacing)[:, None]
        offset = points[:, None] - xp.asarray(self.points)[xp.asarray(self.boundary)[near]]
        height = xp.sum(offset * xp.asarray(self.normals)[near], axis=2)
        lifted = xp.sum(offset * xp.asarray(self.behind)[near], axis=2)
        close = xp.where(asked, height, np.inf).min(axis=1) > _NEAR * spacing
        first = xp.maximum(height, lifted)[:, 0] > _FRONT * away[:, 0]
        some = (asked & (height > _FRONT * away)).any(axis=1)
        if len(self.interior):
            some &= self._query(1, points, 1)[0][:, 0] > distance + 0.45 * spacing
        # Before an interior particle, which is nearer, only those are outside whom the boundary around disowns.
        before = close & (distance <= nearest + _MARGIN * spacing)
        return xp.where(rim, xp.where(distance <= _FAR * spacing, close, first | some), before)


def _where(mask: Any, out: Any, points: Any, judge: Any, *more: Any) -> Any:
    """``out`` with what ``judge`` says of the points of the mask; of all of them where they are traced."""
    if is_traced(points):
        return jnp.where(mask, judge(points, *more), out)
    at = np.flatnonzero(mask)
    if len(at):
        out[at] = judge(points[at], *(x[at] for x in more))
    return out


def inside_of(cloud: Cloud) -> Inside | None:
    """What tells inside from outside, kept with the cloud; None where its points are traced by jit or vmap."""
    found = cloud.__dict__.get("_inside")
    if found is None:
        points, normals = concrete(cloud.points), concrete(cloud.normals)
        if points is None:
            return None
        normals = None if normals is None else np.asarray(normals, float)
        found = Inside(np.asarray(points, float), cloud.groups[INTERIOR], cloud.boundary, normals)
        if not is_traced(cloud.points, cloud.normals):
            cloud.__dict__["_inside"] = found
    return found
