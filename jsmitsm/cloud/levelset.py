"""The zero level of a signed-distance-like function: projection, boundary particles, cells around."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jsmitsm.cloud import filling
from jsmitsm.cloud.packing import octree
from jsmitsm.cloud.packing.octree import Spacing
from jsmitsm.cloud.sdf.recorded import Recorded

LEAST = 5.0  # spacings round a boundary component below which its shape is lost
# Of the size of the domain: a point closer than the first lies on the zero level, one that comes no closer than the
# second does not.
_ON, _ARRIVED = 2e-15, 1e-13


class Boundary(NamedTuple):
    """Boundary particles (B, D) with unit outward normals (B, D)."""

    points: np.ndarray
    normals: np.ndarray


class SdfRegion:
    """The part of the box lo, hi where ``sdf`` is negative."""

    def __init__(self, sdf: Callable[..., Any], lo: np.ndarray, hi: np.ndarray):
        self.lo, self.hi = lo, hi
        self.size = float((hi - lo).max())
        self._recorded = Recorded(sdf, len(lo))
        self._check_faces()

    def _check_faces(self) -> None:
        """Raise where the domain reaches through the box."""
        dim = len(self.lo)
        ticks = [np.linspace(a, b, {1: 2, 2: 257, 3: 41}[dim]) for a, b in zip(self.lo, self.hi)]
        faces = []
        for axis in range(dim):
            for end in (self.lo, self.hi):
                sides = [np.array([end[i]]) if i == axis else t for i, t in enumerate(ticks)]
                faces.append(np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, dim))
        x = np.concatenate(faces)
        value = self.values(x)
        if value.min() < -1e-9 * self.size:
            raise ValueError(
                f"bounds: cut the domain, sdf = {value.min():.3g} at {x[value.argmin()]} on a face of the box "
                f"from {self.lo} to {self.hi}; enlarge the bounds until sdf >= 0 on every face"
            )

    def values(self, x: np.ndarray) -> np.ndarray:
        """Values (M,); outside of the box everything is positive."""
        return self.evaluate(x, False)[0]

    def evaluate(self, x: np.ndarray, gradients: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Values (M,) and, if asked for, gradients (M, D); outside of the box everything is positive."""
        value, gradient = self._recorded(x, gradients)
        if len(x) == 0 or (x.min(axis=0) >= self.lo).all() and (x.max(axis=0) <= self.hi).all():
            if np.isfinite(value).all():
                return value, gradient
        beyond = np.maximum(self.lo - x, x - self.hi)
        out = beyond.max(axis=1)
        bad = np.flatnonzero(~np.isfinite(value) & (out <= 0))
        if len(bad):
            raise ValueError(
                f"sdf: returned {value[bad[0]]} at {x[bad[0]]}, expected a finite number everywhere in the bounds; "
                "guard square roots, logarithms and divisions with jnp.where"
            )
        # Other parts of {sdf < 0} may lie beyond the box; the box cuts them off.
        cut = np.flatnonzero((out > 0) & ~(value > 0))
        value[cut] = out[cut]
        gradient[cut] = np.where(beyond[cut] == out[cut, None], np.sign(x[cut] - (self.lo + self.hi) / 2), 0.0)
        return value, gradient

    def distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First-order distance sdf / |grad sdf| (M,) and unit gradient (M, D)."""
        value, gradient = self.evaluate(x)
        slope = np.linalg.norm(gradient, axis=1)
        # Where the gradient vanishes or is NaN (a centre, a ridge) the value has to do.
        good = np.isfinite(slope) & (slope > 0)
        slope[~good] = 1.0
        gradient[~good] = 0.0
        return value / slope, gradient / slope[:, None]

    def project(
        self, x: np.ndarray, reach: np.ndarray, near: float = 0.0, roam: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Newton steps of at most ``reach`` (M,) to the zero level; points (M, D), whether they arrived, normals.

        near: a distance that is close enough; roam (M,): those that go farther from where they began are given up.
        """
        on, there = max(_ON * self.size, near), max(_ARRIVED * self.size, near)
        found, normal = x.copy(), np.zeros(x.shape)
        best = np.full(len(x), np.inf)
        live, at = np.arange(len(x)), x
        for _ in range(40):
            distance, outward = self.distance(at)
            off = np.abs(distance)
            before = best[live]
            better = off < before
            kept = live[better]
            best[kept], found[kept], normal[kept] = off[better], at[better], outward[better]
            # What no longer improves is as close as its round-off lets it.
            going = (off > on) & (better | (before > there))
            if roam is not None:
                going &= np.linalg.norm(at - x[live], axis=1) <= roam[live]
            live = live[going]
            if not len(live):
                break
            step = np.clip(distance[going], -reach[live], reach[live])
            at = at[going] - step[:, None] * outward[going]
        return found, best <= there, normal

    def normals(self, x: np.ndarray) -> np.ndarray:
        """Unit gradients (M, D) at points of the zero level."""
        return crossing_normals(x, self.distance(x)[1])


def crossing_normals(x: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """The unit gradients (M, D) at points of the zero level (M, D), once there are some."""
    lost = np.flatnonzero(~outward.any(axis=1))
    if len(lost):
        raise ValueError(
            f"sdf: its gradient vanishes or is not finite at the boundary point {x[lost[0]]}; the function must "
            "cross zero with a slope (not be a square or an absolute value)"
        )
    return outward


def checked(region: SdfRegion, boundary: Boundary) -> Boundary:
    """The same boundary, once all of it is seen to lie on the zero level."""
    value, gradient = region.evaluate(boundary.points)
    slope = np.maximum(np.nan_to_num(np.linalg.norm(gradient, axis=1)), 1.0)
    off = np.flatnonzero(np.abs(value) > 1e-11 * max(1.0, region.size) * slope)
    if len(off):
        raise ValueError(
            f"sdf: {len(off)} boundary points could not be brought to its zero level, e.g. sdf = {value[off[0]]:.3g} "
            f"at {boundary.points[off[0]]}; the function must be continuous and cross zero with a slope, and its parts "
            "must not touch in a point: move them apart by a spacing, or let them cross"
        )
    return boundary


def cells_near(
    region: SdfRegion, spacing: Spacing, fraction: float
) -> tuple[octree.Cells, octree.Cells]:
    """Octree cells near the zero level, and the coarse ones around; raises for an empty domain."""
    base = region.size / octree.BASE[len(region.lo)]
    pad = 1.01 * base
    # Off the middle: the centres of symmetric shapes, and lines on which the function touches zero, are not met.
    shift = 0.1 * base * np.array([0.63, -0.41, 0.29])[: len(region.lo)]
    if isinstance(spacing, filling.Constant):  # cells as wide as wanted at the end, not up to half as wide
        wanted = fraction * spacing.value
        base = min(base, wanted * 2.0 ** max(0.0, np.floor(np.log2(base / wanted))))
    cells, coarse = octree.refine(
        region, spacing, region.lo - pad + shift, region.hi + pad + shift, fraction, False, base
    )
    if not ((cells.distance < 0).any() or (coarse.distance < 0).any()):
        raise ValueError(
            f"sdf: never negative in the bounds from {region.lo} to {region.hi} (looked at "
            f"{len(cells.distance) + len(coarse.distance)} points); negative is inside: check its sign and the bounds"
        )
    return cells, coarse


def root(region: SdfRegion, a: np.ndarray, b: np.ndarray, tolerance: float) -> np.ndarray:
    """Zeros on the segments from a to b (M, D), whose ends differ in sign: inverse quadratic interpolation where it is
    safe, else bisection (Chandrupatla, Adv. Eng. Softw. 28, 1997).

    tolerance: in parts of a segment, of the place or, by the mean slope along it, of the value.
    """
    f0, f1 = region.values(a), region.values(b)
    s0, s1 = np.zeros(len(a)), np.ones(len(a))
    small = 0.1 * tolerance * np.abs(f1 - f0)
    result, live = np.where(np.abs(f0) < np.abs(f1), 0.0, 1.0), np.arange(len(a))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.clip(f1 / (f1 - f0), 0.05, 0.95)
        for _ in range(90):
            s = s1 + np.where(np.isfinite(t), t, 0.5) * (s0 - s1)
            f = region.values(a[live] + s[:, None] * (b - a)[live])
            same = (f < 0) == (f1 < 0)
            # The zero lies between s1, the newest, and s0; s2 is the one before.
            s2, f2 = np.where(same, s1, s0), np.where(same, f1, f0)
            s0, f0 = np.where(same, s0, s1), np.where(same, f0, f1)
            s1, f1 = s, f
            best = np.abs(f0) < np.abs(f1)
            result[live] = np.where(best, s0, s1)
            least = np.where(best, np.abs(f0), np.abs(f1))
            going = (np.abs(s1 - s0) > tolerance) & (least > small[live])
            live, s0, s1, s2, f0, f1, f2 = (v[going] for v in (live, s0, s1, s2, f0, f1, f2))
            if not len(live):
                break
            place, value = (s1 - s0) / (s2 - s0), (f1 - f0) / (f2 - f0)
            safe = (value**2 < place) & ((1.0 - value) ** 2 < 1.0 - place)
            t = f1 / (f0 - f1) * f2 / (f0 - f2) + (s2 - s1) / (s0 - s1) * f1 / (f2 - f1) * f0 / (f2 - f0)
            edge = 0.5 * tolerance / np.abs(s0 - s1)
            t = np.clip(np.where(safe, t, 0.5), edge, 1.0 - edge)
    return a + result[:, None] * (b - a)
