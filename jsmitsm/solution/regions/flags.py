"""What speaks against a solution in several regions beyond what each region tells: its interfaces."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.discretization.regions.layout import Meeting, Regions
from jsmitsm.runtime.errors import some
from jsmitsm.solution.flags import scales

# Rows of copies that amplify their neighbours' errors by more than this are a flag: their values are lost.
WEAK = 10.0
# Around a point where regions meet, values that grow as a lower power of the distance than this are singular there, if
# what they grow by in the nearest ring makes this part of the range. Smooth ones grow with power one at the least.
POWER, PART = 0.75, 0.02
# ... unless linear functions around it leave less than this of the change: unlike directions in two rings are no power.
LINEAR = 0.1
# The rings, in distances of the nearest neighbour.
_RINGS = (1.6, 3.2)


def weak_copies(bound: list[Any]) -> list[str]:
    """bound: the joints with their classes and rows."""
    worst, bad = 0.0, [np.zeros(0, int)]
    for _, classes, rows in bound:
        for cls, row in zip(classes, rows):
            size = np.asarray(row.lebesgue).max(axis=1)
            worst = max(worst, float(size.max(initial=0.0)))
            bad.append(cls.ids[size > WEAK])
    at = np.concatenate(bad)
    if not len(at):
        return []
    return [
        f"{len(at)} particle(s) on interfaces, first {some(at)}, amplify their neighbours' errors up to {worst:.1e} "
        "times: the regions are too coarse or too thin there; refine near the interface."
    ]


def singular(regions: Regions, values: np.ndarray) -> list[str]:
    """Points where three regions or more meet, or an interface has a corner, around which the solution is singular."""
    if regions.rec.dim == 1:
        return []
    points, scale = np.asarray(regions.points, float), scales(values)
    found = []
    for m in _corners(regions, points):
        power, part = _growth(regions, m, points, values / scale)
        if power < POWER and part > PART:
            found.append((part, power, m.copies[0]))
    if not found:
        return []
    _, power, i = max(found)
    return [
        f"Around {len(found)} point(s) where regions meet, as particle {i} at {points[i]}, the solution changes as the "
        f"distance to the power {power:.2f}: it is singular there, and the order of the method is lost; refine towards "
        "that point (spacing may be a function of the position)."
    ]


def _corners(regions: Regions, points: np.ndarray) -> list[Meeting]:
    """Meetings of three regions or more, and single pairs whose normal is not that of the next ones."""
    out = [m for m in regions.meetings if len(m.parts) > 2]
    for name, pairs in regions.cloud.interfaces.items():
        normals = np.asarray(regions.cloud.interface_normals[name], float)
        if len(pairs) < 4:
            continue
        from scipy.spatial import cKDTree

        at = points[pairs[:, 0]]
        away, near = cKDTree(at).query(at, k=3)
        turn = np.einsum("pkd,pd->pk", normals[near[:, 1:]], normals).min(axis=1)
        # A curve turns by a part of a radian between particles, a corner by more on both sides.
        sharp = np.flatnonzero(turn < np.cos(np.radians(20.0)))
        single = {m.pairs[0]: m for m in regions.meetings if len(m.pairs) == 1}
        out += [single[name, int(k)] for k in sharp if (name, int(k)) in single]
    return out


def _growth(regions: Regions, m: Meeting, points: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """The power of the distance with which the values change around a point, and by how much in the nearest ring."""
    distances, changes, curved = [], [], []
    for i in m.copies:
        near = regions.near[i][regions.near[i] >= 0]
        near = near[near != i]
        way, rise = points[near] - points[i], values[near] - values[i]
        distances.append(np.linalg.norm(way, axis=1))
        close = distances[-1] <= _RINGS[1] * distances[-1].min()
        slope = np.linalg.lstsq(way[close], rise[close], rcond=1e-9)[0]
        changes.append(np.abs(rise).max(axis=1))
        curved.append(np.abs(rise - way @ slope).max(axis=1))
    r, change = np.concatenate(distances), np.concatenate(changes)
    first = r <= _RINGS[0] * r.min()
    second = (r <= _RINGS[1] * r.min()) & ~first
    if first.sum() < 3 or second.sum() < 3:
        return np.inf, 0.0
    size = [float(np.sqrt((change[ring] ** 2).mean())) for ring in (first, second)]
    rest = float(np.sqrt((np.concatenate(curved)[first] ** 2).mean()))
    if not size[0] or not size[1] or rest <= LINEAR * size[0]:
        return np.inf, 0.0
    power = np.log(size[1] / size[0]) / np.log(r[second].mean() / r[first].mean())
    return float(power), size[0]
