"""In which region a point lies, as far as the particles tell."""

from __future__ import annotations

import numpy as np

from jsmitsm.cloud.regions.region_cloud import RegionCloud, sides
from jsmitsm.runtime.tracers import concrete

# The chord between places of a smooth curve makes one angle with the normals of both; at a corner they differ by more.
_TURN = np.radians(15.0)
# An interface nearer than so many times the nearest particle decides.
_NEAR = 2.0


def located(cloud: RegionCloud, points: np.ndarray) -> np.ndarray:
    """The number of the region (M,) in which each point lies.

    Near an interface the nearest pair decides and the next one: on which side of the curve through both, of their
    normals, the point lies; in space the sign of (x - x_i) . n. Where several interfaces meet it is the region in which
    the point lies deepest.
    """
    from scipy.spatial import cKDTree

    found = cloud.__dict__.get("_sides")
    if found is None:
        found = _Sides(cloud)
        cloud.__dict__["_sides"] = found
    distance, nearest = cKDTree(found.points).query(points)
    out = found.owner[nearest]
    if not len(found.at):
        return out
    tree = cKDTree(found.at)
    count = min(4, len(found.at))
    away, near = (x.reshape(len(points), -1) for x in tree.query(points, k=count))
    close = np.flatnonzero((away[:, 0] <= _NEAR * distance) | (found.paired[nearest]))
    for k in close:
        out[k] = found.side(points[k], near[k])
    return out


class _Sides:
    """The interfaces of a cloud, place by place."""

    def __init__(self, cloud: RegionCloud):
        self.points = np.asarray(concrete(cloud.points), float)
        self.owner = np.full(len(cloud), -1)
        for k, ids in enumerate(cloud.regions.values()):
            self.owner[ids] = k
        self.paired = np.zeros(len(cloud), bool)
        names = list(cloud.regions)
        place: dict[bytes, int] = {}
        at: list[np.ndarray] = []
        self.pairs: list[dict[tuple[int, int], np.ndarray]] = []  # of each place the normals by the regions they part
        for name, ids in cloud.interfaces.items():
            first, second = (names.index(side) for side in sides(name))
            normals = np.asarray(concrete(cloud.interface_normals[name]), float)
            self.paired[ids.reshape(-1)] = True
            for i, n in zip(ids[:, 0], normals):
                key = self.points[i].tobytes()
                if key not in place:
                    place[key] = len(at)
                    at.append(self.points[i])
                    self.pairs.append({})
                self.pairs[place[key]][first, second] = n
        self.at = np.array(at).reshape(-1, self.points.shape[1])

    def side(self, x: np.ndarray, near: np.ndarray) -> int:
        """The region of x, of whose nearest places on interfaces ``near`` is a list."""
        k = near[0]
        if len(self.pairs[k]) == 1:
            ((first, second),) = self.pairs[k]
            return second if self._height(x, k, near[1:], (first, second)) > 0 else first
        depth: dict[int, float] = {}
        for (first, second), n in self.pairs[k].items():
            height = float((x - self.at[k]) @ n)
            depth[first] = min(depth.get(first, np.inf), -height)
            depth[second] = min(depth.get(second, np.inf), height)
        return max(depth, key=lambda region: depth[region])

    def _height(self, x: np.ndarray, k: int, others: np.ndarray, pair: tuple[int, int]) -> float:
        """How far x is beyond the interface of a pair: over its tangents and its chord to the next place, of which
        a curve is halfway between; at a corner over the chord."""
        own = self.pairs[k][pair]
        height = float((x - self.at[k]) @ own)
        other = next((j for j in others if pair in self.pairs[j]), None)
        if other is None or len(x) != 2:
            return height
        way, next_ = self.at[other] - self.at[k], self.pairs[other][pair]
        across = np.array([way[1], -way[0]]) / np.linalg.norm(way)
        across = across if across @ (own + next_) > 0 else -across
        chord = float((x - self.at[k]) @ across)
        if abs(np.arccos(np.clip(across @ own, -1, 1)) - np.arccos(np.clip(across @ next_, -1, 1))) > _TURN:
            return chord
        part = float(np.clip((x - self.at[k]) @ way / (way @ way), 0.0, 1.0))
        tangents = (1.0 - part) * height + part * float((x - self.at[other]) @ next_)
        return 0.5 * (tangents + chord)
