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

    def project(self, x: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Newton steps of at most ``reach`` (M,) to the zero level; points (M, D), whether they arrived, normals."""
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
            going = (off > _ON * self.size) & (better | (before > _ARRIVED * self.size))
            live = live[going]
            if not len(live):
                break
            step = np.clip(distance[going], -reach[live], reach[live])
            at = at[going] - step[:, None] * outward[going]
        return found, best <= _ARRIVED * self.size, normal

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
            f"at {boundary.points[off[0]]}; the function must be continuous and cross zero with a slope"
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
    """Zeros on the segments from a to b (M, D), whose ends differ in sign: Illinois, bisection every third step.

    tolerance: in parts of a segment, of the place or, by the mean slope along it, of the value.
    """
    fa, fb = region.values(a), region.values(b)
    small = 0.1 * tolerance * np.abs(fb - fa)
    s, t = np.zeros(len(a)), np.ones(len(a))
    result, live = np.zeros(len(a)), np.arange(len(a))
    for step in range(90):
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.where(step % 3 == 2, (s + t) / 2, s - fa * (t - s) / (fb - fa))
        u = np.clip(np.where(np.isfinite(u), u, (s + t) / 2), s, t)
        result[live] = u
        f = region.values(a[live] + u[:, None] * (b - a)[live])
        left = (f < 0) == (fa < 0)  # the zero lies between u and t
        s, t = np.where(left, u, s), np.where(left, t, u)
        fa, fb = np.where(left, f, fa / 2), np.where(left, fb / 2, f)
        going = (t - s > tolerance) & (np.abs(f) > small[live])
        live, s, t, fa, fb = live[going], s[going], t[going], fa[going], fb[going]
        if not len(live):
            break
    return a + result[:, None] * (b - a)
