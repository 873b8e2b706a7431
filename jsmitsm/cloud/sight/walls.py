"""Which neighbours a particle sees: those behind a boundary (across a gap, a slit, a notch) are none.

Where two parts of the boundary face each other within the reach of a stencil, the particles around are linked to their
nearest ones, links that leave the domain are cut, and a neighbour counts as one if the way to it along the links is not
much longer than the straight one. Round a blunt corner or a round hole it is not; across a gap there is none.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.cloud.neighbours import Stencils, nearest, within
from jsmitsm.cloud.sight.ways import Looked, Ways
from jsmitsm.runtime.errors import some

# A particle is in front of another at a smaller angle (its cosine) to the normal than this.
_FACING, _CUT = 0.5, 0.3
# Opposite normals, and how far in front of each other (in parts of their distance) particles with such normals are.
_OPPOSITE, _APART = -0.5, 0.003
# Of walls back to back the sign tells: across the narrowest slit they are in front of each other, in a thin part of the
# domain behind.
_BACK, _TOUCHING = -0.98, 1e-9
# Nearest particles that are linked, and boundary particles that may cut a link, by dimension.
_LINKS, _CUTTERS = {1: 4, 2: 12, 3: 30}, {1: 4, 2: 10, 3: 20}
# No link is longer than so many spacings.
_LONG = 2.3
# What a boundary particle covers of the boundary, in its distance from the next ones.
_COVER = {1: 1.0, 2: 0.6, 3: 0.75}
# Of a cloud of so many particles, or where they concern this part of it, all links are made at once.
_SMALL, _PART = 4000, 0.25
# A boundary particle has a side: the interior ones next to it lie in one direction (the mean's length).
_SIDED = 0.35
# An interior particle is behind a boundary particle if it has this part of all weights, of the inverse fourth powers.
_BEHIND = 0.02


class Walls:
    """The boundary as obstacles among the particles ``points`` (M, D).

    ids (W,): boundary particles; normals (W, D): outward, NaN where they are to be fitted. interior (M,): a mask;
    groups: the names of the boundary particles, for messages.
    """

    def __init__(
        self, points: np.ndarray, ids: np.ndarray, normals: np.ndarray, interior: np.ndarray,
        groups: dict[str, np.ndarray],
    ):  # fmt: skip
        self.points, self.ids, self.interior, self.groups = points, ids, interior, groups
        self.given = normals
        self.kept: dict[Any, np.ndarray] = {}  # what others found by looking
        self.ways: Ways | None = None
        self.looked = Looked(len(points))
        self.place = np.full(len(points), -1)
        self.place[ids] = np.arange(len(ids))

    def hidden(self, near: np.ndarray, rows: np.ndarray) -> np.ndarray | None:
        """Mask (n, w) of the neighbours ``near`` that the particles ``rows`` (n,) do not see; None if they see all."""
        if not len(self.ids):
            return None
        whole = len(rows) == len(self.points)
        if whole:
            self.check_outward(near)
        walls = self.ids if whole else np.unique(near[(near >= 0) & (self.place[near] >= 0)])
        if not len(walls):
            return None
        table = near[walls] if whole else self._nearest(walls, near.shape[1])
        facing = walls[self._faces(walls, table)]
        if not len(facing):
            return None
        mark = np.zeros(len(self.points) + 1, bool)
        mark[facing] = True
        mark[-1] = False
        suspects = np.flatnonzero(mark[near].any(axis=1))
        if not len(suspects):
            return None
        out = np.zeros(near.shape, bool)
        out[suspects] = self._behind(near[suspects], rows[suspects])
        if not np.isfinite(self.given).all():
            # Whom fitted normals cut off from everybody, they misjudge.
            out[((near >= 0) & ~out).sum(axis=1) <= self.points.shape[1] + 1] = False
        return out if out.any() else None

    def _nearest(self, ids: np.ndarray, count: int) -> np.ndarray:
        return _tree(self.points).query(self.points[ids], k=range(1, min(count, len(self.points)) + 1))[1]

    def _faces(self, walls: np.ndarray, table: np.ndarray) -> np.ndarray:
        """Which boundary particles have others straight in front of them."""
        normal = self._normals(walls)
        offset = self.points[np.maximum(table, 0)] - self.points[walls][:, None]
        length = np.sqrt((offset**2).sum(axis=2))
        height = np.einsum("bkd,bd->bk", offset, normal)
        return ((table >= 0) & (height > _FACING * length) & (length > 0)).any(axis=1)

    def _normals(self, walls: np.ndarray) -> np.ndarray:
        """Normals of some boundary particles: given ones, else those away from the interior; NaN where there is no
        such side."""
        normal = self.given[self.place[walls]]
        bare = np.flatnonzero(~np.isfinite(normal).all(axis=1))
        if len(bare):
            normal = normal.copy()
            normal[bare] = self._fitted(walls[bare])
        return normal

    def _fitted(self, walls: np.ndarray) -> np.ndarray:
        """Away from the interior particles next to them. Where those lie on both sides, another row of boundary
        particles on one side, nearer than they, shows a gap there; a single row has no side."""
        at, dim = self.points[walls], self.points.shape[1]
        first = self._away(walls, _SIDED)
        if not self.interior.any() or len(self.ids) < 2:
            return first
        distance = _tree(self.points[self.interior]).query(at)[0][:, None]
        count = min({1: 2, 2: 8, 3: 20}[dim], len(self.ids))
        away, next_ = _tree(self.points[self.ids]).query(at, k=range(2, count + 1))
        closer = np.where(away < 0.99 * distance, (away[:, :1] / away) ** 2, 0.0)
        across = -_mean_direction(at, self.points[self.ids][next_], closer, 0.1)
        first = np.where(np.isfinite(first), first, across)
        return first if dim == 1 else self._along(walls, first)

    def _away(self, walls: np.ndarray, least: float) -> np.ndarray:
        inner, at = self.points[self.interior], self.points[walls]
        if not len(inner):
            return np.full(at.shape, np.nan)
        distance, near = _tree(inner).query(at, k=range(1, min(at.shape[1] + 1, len(inner)) + 1))
        return _mean_direction(at, inner[near], (distance[:, :1] / distance) ** 4, least)

    def _along(self, walls: np.ndarray, first: np.ndarray) -> np.ndarray:
        """First guesses of normals made to stand upright on the line or plane of the boundary particles around."""
        dim = self.points.shape[1]
        count, most = {2: (2, 8), 3: (6, 20)}[dim]
        if len(self.ids) <= most:
            return first
        at = self.points[walls]
        distance, near = _tree(self.points[self.ids]).query(at, k=range(2, most + 2))
        offset = self.points[self.ids][near] - at[:, None]
        for steep in (0.55, 0.35, 0.2):  # what another wall shows of itself is left out better and better
            upright = np.abs(np.einsum("bkd,bd->bk", offset, np.nan_to_num(first))) > steep * distance
            chosen = np.argsort(np.where(upright, np.inf, distance), axis=1)[:, :count]
            around = np.take_along_axis(offset, chosen[..., None], axis=1)
            across = np.linalg.eigh(np.einsum("bki,bkj->bij", around, around))[1][:, :, 0]
            side = np.einsum("bi,bi->b", across, first)
            enough = (~upright).sum(axis=1) >= count
            good = (enough & (np.abs(side) > _FACING))[:, None]
            first = np.where(good, np.sign(side)[:, None] * across, first)
        return first

    def all_normals(self) -> np.ndarray:
        """Normals (M, D), NaN off the boundary."""
        out = np.full(self.points.shape, np.nan)
        out[self.ids] = self._normals(self.ids) if len(self.ids) else out[self.ids]
        return out

    def check_outward(self, table: np.ndarray) -> None:
        """Refuse normals that point to the interior particles, of most of a group or plainly: ValueError.

        table (M, w): the neighbours of all particles, hidden ones too.
        """
        for name, ids in self.groups.items():
            normal = self.given[self.place[ids]] if len(ids) else np.zeros((0, 1))
            ids, normal = (x[np.isfinite(normal).all(axis=1)] for x in (ids, normal))
            if not len(ids):
                continue
            near = table[ids]
            inner = (near >= 0) & self.interior[near]
            offset = self.points[np.maximum(near, 0)] - self.points[ids][:, None]
            length = np.linalg.norm(offset, axis=2)
            height = np.einsum("bkd,bd->bk", offset, normal) / np.where(length > 0, length, 1.0)
            closest = length.min(axis=1, where=inner, initial=np.inf)
            weight = np.where(inner, (closest[:, None] / np.where(inner, length, 1.0)) ** 4, 0.0)
            weight /= np.maximum(weight.sum(axis=1), 1e-300)[:, None]
            inward = (weight * height).sum(axis=1) > 0.3
            many = 2 * inward.sum() > len(ids)
            if not many:
                # One by one it is told where no interior particle lies behind, and no other wall stands before those in
                # front: across a slit or a gap lie particles of the other side.
                behind = (weight * np.maximum(-height, 0.0)).sum(axis=1) > _BEHIND
                wall = (near >= 0) & ~inner & (height > _CUT) & (length < closest[:, None])
                inward &= ~behind & ~wall.any(axis=1)
            if inward.any():
                those = "normals are outward, turn them round (cloud.replace(normals=-cloud.normals))"
                if not inward.all():
                    those = "normals are outward, turn those round (normals[ids] *= -1, cloud.replace(normals=normals))"
                raise ValueError(
                    f"normals: those of {int(inward.sum())} of {len(ids)} particles of the group {name!r} point into "
                    f"the domain, first at particle {int(ids[inward.argmax()])}"
                    + (f" of {some(ids[inward])}" if 1 < inward.sum() < len(ids) else "")
                    + f": interior particles lie before it; {those}"
                )

    # -- what is seen

    def _behind(self, near: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Mask (n, w) of the neighbours of some particles to which the way is long."""
        known, out = self.looked.known(near, rows), np.zeros(near.shape, bool)
        if known.any():
            out[known] = self.looked.answer(rows[known], near.shape[1])
        new = np.flatnonzero(~known)
        if len(new):
            out[new] = self._ways(near[new], rows[new]).long(near[new], rows[new])
            self.looked.add(near[new], rows[new], out[new])
        return out

    def _ways(self, near: np.ndarray, rows: np.ndarray) -> Ways:
        """The ways among some particles and their neighbours; where these are a large part of the cloud among all,
        once."""
        if self.ways is None:
            members = np.unique(np.concatenate([near[near >= 0], rows]))
            if len(members) < _PART * len(self.points) and len(self.points) > _SMALL:
                return self._linked(members)
            self.ways = self._linked(np.arange(len(self.points)))
        return self.ways

    def _linked(self, members: np.ndarray) -> Ways:
        """Particles linked to their nearest ones, without the links that leave the domain."""
        from scipy.sparse import coo_array

        number = np.full(len(self.points), -1)
        number[members] = np.arange(len(members))
        at = self.points[members]
        distance, linked = _tree(at).query(at, k=range(1, min(_LINKS[at.shape[1]] + 1, len(at)) + 1))
        spacing = distance[:, 1 : 1 + 2 * at.shape[1]].mean(axis=1)
        a, b = np.repeat(np.arange(len(at)), linked.shape[1] - 1), linked[:, 1:].ravel()
        a, b = np.divmod(np.unique(np.minimum(a, b) * len(at) + np.maximum(a, b)), len(at))
        length = np.sqrt(((at[a] - at[b]) ** 2).sum(axis=1))
        short = length <= _LONG * np.maximum(spacing[a], spacing[b])
        a, b, length = a[short], b[short], length[short]
        keep = ~self._cut(members[a], members[b])
        graph = coo_array((length[keep], (a[keep], b[keep])), shape=(len(at), len(at))).tocsr()
        return Ways(self.points, number, spacing, graph)

    def _cut(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Mask of the links between particles ``a`` and ``b`` that leave the domain."""
        owner, normal, cover = self._surfels(np.unique(np.concatenate([a, b])))
        out = np.zeros(len(a), bool)
        if not len(owner):
            return out
        count = min(_CUTTERS[self.points.shape[1]], len(owner))
        x, y = self.points[a], self.points[b]
        reach = np.sqrt(((x - y) ** 2).sum(axis=1)) / 2.0 + cover.max()
        away, near = _tree(self.points[owner]).query((x + y) / 2.0, k=range(1, count + 1))
        # The boundary is far from most.
        some = np.flatnonzero(away[:, 0] <= 1.01 * reach)
        out[some] = self._leaving(a[some], b[some], owner, normal, cover, near[some])
        return out

    def _leaving(
        self, a: np.ndarray, b: np.ndarray, owner: np.ndarray, normal: np.ndarray, cover: np.ndarray, near: np.ndarray
    ) -> np.ndarray:
        """Mask of the links that leave the domain between the pieces ``near`` (links, k) of its boundary."""
        x, y = self.points[a], self.points[b]
        length = np.sqrt(((x - y) ** 2).sum(axis=1))[:, None]
        at, n = self.points[owner][near], normal[near]
        one, two = (np.einsum("ekd,ekd->ek", z[:, None] - at, n) for z in (x, y))
        from_a, from_b = owner[near] == a[:, None], owner[near] == b[:, None]
        # From a boundary particle outward.
        cut = (from_a & (two > _CUT * length)) | (from_b & (one > _CUT * length))
        # Through the boundary next to one.
        share = one / np.where(one != two, one - two, 1.0)
        through = x[:, None] + share[..., None] * (y - x)[:, None]
        aside = np.linalg.norm(through - at, axis=2)
        small = 0.02 * length
        crossing = ((one < -small) & (two > small)) | ((two < -small) & (one > small))
        cut |= crossing & ~from_a & ~from_b & (aside <= cover[near])
        # Between particles of walls that face each other, however flat the link lies.
        for apart, turned in ((_APART, _OPPOSITE), (_TOUCHING, _BACK)):
            ahead_a, ahead_b = from_a & (two > apart * length), from_b & (one > apart * length)
            facing = np.flatnonzero(ahead_a.any(axis=1) & ahead_b.any(axis=1))
            opposite = np.einsum("ekd,eld->ekl", n[facing], n[facing]) < turned
            pair = ahead_a[facing][:, :, None] & ahead_b[facing][:, None, :]
            cut[facing] |= (pair & opposite).any(axis=2)
        return cut.any(axis=1)

    def _surfels(self, members: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The boundary particles among some as pieces of it: their numbers, normals, and what each covers (a radius).

        A particle at a convex corner has the normals of all sides that end in it.
        """
        walls = members[self.place[members] >= 0]
        normal = self._normals(walls)
        sided = np.isfinite(normal).all(axis=1)
        walls, normal = walls[sided], normal[sided]
        at, dim = self.points[walls], self.points.shape[1]
        count = min({1: 2, 2: 8, 3: 20}[dim], len(walls))
        if count < 2 or dim == 1:
            return walls, normal, np.ones(len(walls))
        distance, near = _tree(at).query(at, k=range(2, count + 1))
        offset = at[near] - at[:, None]
        height = np.einsum("bkd,bd->bk", offset, normal)
        alike = (np.einsum("bkd,bd->bk", normal[near], normal) > 0.3) & (np.abs(height) < 0.8 * distance)
        sorted_ = np.sort(np.where(alike, distance, np.inf), axis=1)
        along = sorted_[:, min({2: 1, 3: 3}[dim], sorted_.shape[1] - 1)]
        along = np.where(np.isfinite(along), along, np.where(np.isfinite(sorted_[:, 0]), sorted_[:, 0], distance[:, 0]))
        # Sides that end in a particle: it lies in the plane of one of theirs, and they behind its own.
        level = np.abs(np.einsum("bkd,bkd->bk", offset, normal[near])) / distance
        turn = np.einsum("bkd,bd->bk", normal[near], normal)  # the wall across a gap is no side of the corner
        away = np.einsum("bkd,bd->bk", normal[near], np.nan_to_num(self._away(walls, 0.0))) > 0.1
        ends = ((level < 0.02) | ((level < 0.1) & away)) & (height < 0.1 * distance) & (turn < 0.9) & (turn > -0.9)
        ends &= distance < 1.6 * along[:, None]
        b, k = np.nonzero(ends)
        lone = ends.sum(axis=1) < 2  # between two sides a corner's own normal is that of no wall
        owner, extra = np.concatenate([walls[lone], walls[b]]), np.concatenate([normal[lone], normal[near[b, k]]])
        return owner, extra, _COVER[dim] * np.concatenate([along[lone], along[b]])


def nearest_seen(points: np.ndarray, size: int, which: np.ndarray | None, walls: Walls | None) -> Stencils:
    """As ``nearest``, of the particles that each one sees."""
    found = nearest(points, size, which)
    rows = np.arange(len(points)) if which is None else which
    hidden = None if walls is None else walls.hidden(np.asarray(found.indices), rows)
    if hidden is None or walls is None:
        return found
    indices, radius = np.array(found.indices), np.array(found.radius)
    some = np.flatnonzero(hidden.any(axis=1))
    for factor in (4, 12):
        pool = np.asarray(nearest(points, min(len(points), factor * size), rows[some]).indices)
        unseen = walls.hidden(pool, rows[some])
        kept = _first(pool if unseen is None else np.where(unseen, -1, pool), size)
        indices = np.pad(indices, ((0, 0), (0, max(0, size - indices.shape[1]))), constant_values=-1)
        indices[some] = -1
        indices[some, : kept.shape[1]] = kept
        last = np.where(kept >= 0, np.linalg.norm(points[kept] - points[rows[some]][:, None], axis=2), 0.0)
        radius[some] = last.max(axis=1)
        some = some[(kept < 0).any(axis=1)]
        if not len(some) or pool.shape[1] >= len(points):
            break
    return Stencils(indices, radius)


def within_seen(points: np.ndarray, radius: Any, which: np.ndarray | None, walls: Walls | None) -> Stencils:
    """As ``within``, of the particles that each one sees."""
    return seen(within(points, radius, which), which, walls)


def seen(stencils: Stencils, which: np.ndarray | None, walls: Walls | None) -> Stencils:
    """Stencils without the neighbours that are hidden."""
    near = np.asarray(stencils.indices)
    hidden = None if walls is None else walls.hidden(near, np.arange(len(near)) if which is None else which)
    if hidden is None:
        return stencils
    return Stencils(_first(np.where(hidden, -1, near), near.shape[1]), stencils.radius)


def _first(near: np.ndarray, size: int) -> np.ndarray:
    """The first ``size`` neighbours of every row that are any, in their order."""
    order = np.argsort(near < 0, axis=1, kind="stable")[:, :size]
    return np.take_along_axis(near, order, axis=1)


def _mean_direction(at: np.ndarray, others: np.ndarray, weight: np.ndarray, least: float) -> np.ndarray:
    """Unit vectors (n, D) at points (n, D) away from weighted others (n, k, D); NaN where the mean is shorter than
    ``least``."""
    away = at[:, None] - others
    length = np.linalg.norm(away, axis=2, keepdims=True)
    away = away / np.where(length > 0, length, 1.0)
    mean = (away * weight[..., None]).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-300)[:, None]
    size = np.linalg.norm(mean, axis=1, keepdims=True)
    return np.where(size > least, mean / np.where(size > 0, size, 1.0), np.nan)


def _tree(points: np.ndarray) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(points)
