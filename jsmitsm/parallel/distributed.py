"""A cloud in slabs, a piece a process; and recursive bisection, which makes compact parts of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.parallel.team import Team

# Halvings of an interval until a cut stands between two numbers.
_HALVINGS = 60


@dataclass(frozen=True)
class Slab:
    """The particles that one process holds of a cloud of ``count``.

    number (n,): in the whole cloud; points (n, D); normals (n, D), NaN in the interior, or (n, 0) for none;
    group (n,): the number of the name in ``names``; place (n,): among the particles of that group, in the order of the
    whole cloud.
    """

    names: tuple[str, ...]
    count: int
    number: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    group: np.ndarray
    place: np.ndarray
    with_normals: bool
    sizes: tuple[int, ...] = ()  # of the groups of the whole cloud

    def __len__(self) -> int:
        return len(self.number)

    @property
    def dim(self) -> int:
        return self.points.shape[1]

    def columns(self, at: Any) -> np.ndarray:
        """Some particles as rows of numbers, to be sent."""
        whole = np.stack([self.number, self.group, self.place], axis=1)[at]
        return np.concatenate([whole.astype(float), self.points[at], self.normals[at]], axis=1)

    def of_rows(self, rows: np.ndarray) -> Slab:
        """The slab of such rows, by number."""
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        number, group, place = (rows[:, k].astype(int) for k in range(3))
        # Copies: views would keep the rows.
        points, normals = rows[:, 3 : 3 + self.dim].copy(), rows[:, 3 + self.dim :].copy()
        return Slab(self.names, self.count, number, points, normals, group, place, self.with_normals, self.sizes)

    def cloud(self) -> Cloud:
        """These particles as a cloud of their own, with all groups, empty ones too."""
        groups = {name: np.flatnonzero(self.group == k) for k, name in enumerate(self.names)}
        return Cloud(self.points, groups, self.normals if self.with_normals else None)


class ParallelCloud:
    """A cloud of which every process holds a slab: what ``jp.read`` returns and ``jp.solve`` takes.

    ``len(cloud)`` counts the particles of all processes; ``points``, ``numbers`` are this process's own.
    """

    def __init__(self, slab: Slab):
        self.slab = slab

    def __len__(self) -> int:
        return self.slab.count

    @property
    def dim(self) -> int:
        """Number of space dimensions D."""
        return self.slab.dim

    @property
    def points(self) -> np.ndarray:
        """This process's particles (n, D)."""
        return self.slab.points

    @property
    def numbers(self) -> np.ndarray:
        """Their numbers (n,) in the whole cloud."""
        return self.slab.number

    def __repr__(self) -> str:
        return f"ParallelCloud({len(self.slab)} of {self.slab.count} particles in {self.dim}D here)"


def own_slab(us: Team, count: int, rank: int | None = None) -> slice:
    """The particles of this process, or of another one, before they are dealt anew."""
    if count < us.size:
        raise ValueError(f"cloud: {count} particles for {us.size} processes; start fewer")
    rank = us.rank if rank is None else rank
    return slice(rank * count // us.size, (rank + 1) * count // us.size)


def placed(us: Team, slab: Slab) -> Slab:
    """With the place of every particle in its group."""
    counts = np.stack(us.gather(np.bincount(slab.group, minlength=len(slab.names))))
    before = counts[: us.rank].sum(axis=0)
    place = np.zeros(len(slab), int)
    for k in range(len(slab.names)):
        at = np.flatnonzero(slab.group == k)
        place[at] = before[k] + np.arange(len(at))
    sizes = tuple(map(int, counts.sum(axis=0)))
    return replace(slab, place=place, sizes=sizes)


def slab_of(us: Team, cloud: Any, rank: int | None = None) -> Slab:
    """This process's slab of a cloud that every process has, or of one in slabs; or that of another process."""
    if isinstance(cloud, ParallelCloud):
        return cloud.slab
    if not isinstance(cloud, Cloud):
        raise ValueError(f"cloud: expected a js.Cloud or what jp.read returns, got {type(cloud).__name__}")
    if isinstance(cloud, RegionCloud):
        raise ValueError("cloud: several regions are not made for several processes; use js.solve")
    some = own_slab(us, len(cloud), rank)
    group, place = np.zeros(len(cloud), int), np.zeros(len(cloud), int)
    for k, ids in enumerate(cloud.groups.values()):
        group[ids], place[ids] = k, np.arange(len(ids))
    points = np.asarray(cloud.points, float)
    normals = np.zeros((len(cloud), 0)) if cloud.normals is None else np.asarray(cloud.normals, float)
    number, sizes = np.arange(some.start, some.stop), tuple(map(len, cloud.groups.values()))
    return Slab(tuple(cloud.groups), len(cloud), number, points[some], normals[some], group[some], place[some],
                cloud.normals is not None, sizes)  # fmt: skip


def bisected(us: Team, slab: Slab) -> Slab:
    """The particles dealt anew, so that every process has those of a compact part, as many as the others."""
    owner = np.zeros(len(slab), int)
    boxes = [(0, us.size)]
    while any(high - low > 1 for low, high in boxes):
        owner, boxes = _halved(us, slab.points, owner, boxes)
    parcels = [slab.columns(owner == rank) for rank in range(us.size)]
    return slab.of_rows(np.concatenate(us.trade(parcels)))


def _halved(us: Team, points: np.ndarray, owner: np.ndarray, boxes: list[tuple[int, int]]) -> Any:
    """Every box of several processes cut across its longest side; owner (n,): the first process of a particle's box."""
    split = [(low, high) for low, high in boxes if high - low > 1]
    inside = [np.flatnonzero(owner == low) for low, _ in split]
    ends = [[(x.min(axis=0), x.max(axis=0)) if len(x) else None for x in (points[ids] for ids in inside)]]
    low_end, high_end, axis = [], [], []
    every = us.gather(ends[0])
    for k in range(len(split)):
        known = [mine[k] for mine in every if mine[k] is not None]
        low, high = np.min([x for x, _ in known], axis=0), np.max([x for _, x in known], axis=0)
        axis.append(int(np.argmax(high - low)))
        low_end.append(low[axis[-1]])
        high_end.append(high[axis[-1]])
    values = [points[ids, a] for ids, a in zip(inside, axis)]
    share = np.array([((low + high) // 2 - low) / (high - low) for low, high in split])
    wanted = share * us.total(np.array([len(ids) for ids in inside]))
    a, b = np.array(low_end, float), np.array(high_end, float)
    for _ in range(_HALVINGS):
        middle = (a + b) / 2.0
        below = us.total(np.array([(x < m).sum() for x, m in zip(values, middle)])) < wanted
        a, b = np.where(below, middle, a), np.where(below, b, middle)
    owner, new = owner.copy(), [box for box in boxes if box[1] - box[0] == 1]
    for (low, high), ids, x, cut in zip(split, inside, values, (a + b) / 2.0):
        middle = (low + high) // 2
        owner[ids[x >= cut]] = middle
        new += [(low, middle), (middle, high)]
    return owner, new
