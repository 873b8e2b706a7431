"""In which region a point lies, as far as the particles tell."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.cloud.regions.region_cloud import RegionCloud, sides
from jsmitsm.runtime.tracers import concrete

# A pair whose normal differs by more than this angle (its cosine) from the next one's stands at a corner.
_CORNER = np.cos(np.radians(20.0))
# An interface nearer than so many times the nearest particle decides.
_NEAR = 2.0


def located(cloud: RegionCloud, points: np.ndarray) -> np.ndarray:
    """The number of the region (M,) in which each point lies.

    Near an interface its nearest pair decides: the sign of (x - x_i) . n. At a corner, whose normal is that of neither
    side, the next pair does; where several interfaces meet, the region in which the point lies deepest.
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
        at, pairs = [], []
        for name, ids in cloud.interfaces.items():
            first, second = (names.index(side) for side in sides(name))
            normals = np.asarray(concrete(cloud.interface_normals[name]), float)
            self.paired[ids.reshape(-1)] = True
            for (i, _), n in zip(ids, normals):
                key = self.points[i].tobytes()
                if key not in place:
                    place[key] = len(at)
                    at.append(self.points[i])
                    pairs.append([])
                pairs[place[key]].append((first, second, n))
        self.at, self.pairs = np.array(at).reshape(-1, self.points.shape[1]), pairs
        self.corner = np.zeros(len(at), bool)
        if len(at) > 2 and self.at.shape[1] > 1:
            self._find_corners()

    def _find_corners(self) -> None:
        """Single pairs whose normal is far from that of the next ones of the same interface."""
        from scipy.spatial import cKDTree

        near = cKDTree(self.at).query(self.at, k=min(3, len(self.at)))[1][:, 1:]
        for k, others in enumerate(near):
            if len(self.pairs[k]) == 1:
                first, second, n = self.pairs[k][0]
                alike = [m @ n for o in others for a, b, m in self.pairs[o] if (a, b) == (first, second)]
                self.corner[k] = bool(alike) and min(alike) < _CORNER

    def side(self, x: np.ndarray, near: np.ndarray) -> int:
        """The region of x, of whose nearest places on interfaces ``near`` is a list."""
        plain = [k for k in near if not self.corner[k]]
        k = near[0] if not self.corner[near[0]] or not plain else plain[0]
        depth: dict[int, float] = {}
        for first, second, n in self.pairs[k]:
            height = float((x - self.at[k]) @ n)
            depth[first] = min(depth.get(first, np.inf), -height)
            depth[second] = min(depth.get(second, np.inf), height)
        return max(depth, key=lambda region: depth[region])
