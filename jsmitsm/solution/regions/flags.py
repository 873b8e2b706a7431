"""What speaks against a solution in several regions beyond what each region tells: its interfaces."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.discretization.regions.layout import Meeting, Regions
from jsmitsm.runtime.errors import some
from jsmitsm.solution.look.sizes import scales
from jsmitsm.taylor.multi_indices import count, multi_indices

# Rows of copies that amplify their neighbours' errors by more than this are a flag: their values are lost.
WEAK = 10.0
# Around a point where regions meet, values that grow as a lower power of the distance than this are singular there, if
# what they grow by in the nearest ring makes this part of the range. Smooth ones grow with power one at the least.
POWER, PART = 0.75, 0.02
# ... unless quadratic polynomials leave less than this of the change in the nearest ring: unlike ways are no power.
# Measured with jittered particles: r^0.39 leaves 0.17 to 0.3 of it, r^0.67 0.1 to 0.2, exp(r / 3) up to 0.07.
SMOOTH = 0.08
# The next pairs on an interface that are looked at for corners, in each dimension.
_BESIDE = {2: 2, 3: 6}
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
    for m in _corners(regions):
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


def _corners(regions: Regions) -> list[Meeting]:
    """Meetings of three regions or more, and single pairs at corners of their interface."""
    single = {m.pairs[0]: m for m in regions.meetings if len(m.pairs) == 1}
    several = [m for m in regions.meetings if len(m.parts) > 2]
    return several + [single[c] for c in corners(regions.cloud) if c in single]


def corners(cloud: RegionCloud) -> list[tuple[str, int]]:
    """The pairs of each interface that lie at or beside a corner of it; curves have none, however coarse."""
    from scipy.spatial import cKDTree

    points = np.asarray(cloud.points, float)
    out: list[tuple[str, int]] = []
    for name, pairs in cloud.interfaces.items():
        at, normals = points[pairs[:, 0]], np.asarray(cloud.interface_normals[name], float)
        beside = _BESIDE[at.shape[1]]
        if len(pairs) <= beside:
            continue
        near = cKDTree(at).query(at, k=beside + 1)[1][:, 1:]
        way, own, other = at[near] - at[:, None], normals[:, None], normals[near]
        turned = (own * other).sum(axis=2) < np.cos(np.radians(20.0))
        # The chord of an arc meets both normals at one angle, the side of a corner that of the side at a right one.
        rise, fall = (way * own).sum(axis=2), (way * other).sum(axis=2)
        bent = np.abs(rise + fall) > 0.5 * (np.abs(rise) + np.abs(fall))
        out += [(name, int(k)) for k in np.flatnonzero((turned & bent).any(axis=1))]
    return out


def _growth(regions: Regions, m: Meeting, points: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """The power of the distance with which the values change around a point, and by how much in the nearest ring."""
    distances, changes, rests = [], [], []
    for i in m.copies:
        near = regions.near[i][regions.near[i] >= 0]
        near = near[near != i]
        way, rise = points[near] - points[i], values[near] - values[i]
        distances.append(np.linalg.norm(way, axis=1))
        changes.append(np.abs(rise).max(axis=1))
        rests.append(np.abs(unlike_polynomials(way, rise)).max(axis=1))
    r, change = np.concatenate(distances), np.concatenate(changes)
    first = r <= _RINGS[0] * r.min()
    second = (r <= _RINGS[1] * r.min()) & ~first
    if first.sum() < 3 or second.sum() < 3:
        return np.inf, 0.0
    size = [float(np.sqrt((change[ring] ** 2).mean())) for ring in (first, second)]
    rest = float(np.sqrt((np.concatenate(rests)[first] ** 2).mean()))
    if not size[0] or not size[1] or rest <= SMOOTH * size[0]:
        return np.inf, 0.0
    power = np.log(size[1] / size[0]) / np.log(r[second].mean() / r[first].mean())
    return float(power), size[0]


def unlike_polynomials(way: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """What is left of the differences ``rise`` (n, F) to a particle's values by quadratic polynomials of the offsets
    ``way`` (n, D), linear ones where neighbours are few; the nearest count most."""
    n, dim = way.shape
    degree = 2 if n > count(dim, 2) else 1
    some = np.array(multi_indices(dim, degree))
    r = np.linalg.norm(way, axis=1)
    powers = np.prod((way / r.max())[:, None, :] ** some, axis=2)
    weight = np.exp(-((r / r.max()) ** 2))[:, None]
    # The particle itself is data too: its difference is zero there, at the offset zero.
    fitted = np.concatenate([weight * powers, np.eye(1, len(some))])
    data = np.concatenate([weight * rise, np.zeros((1, rise.shape[1]))])
    return rise - powers @ np.linalg.lstsq(fitted, data, rcond=1e-9)[0]
