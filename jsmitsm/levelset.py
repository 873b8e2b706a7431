"""The zero level of a signed-distance-like function: evaluation in batches, projection, boundary particles."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm import packing
from jsmitsm.packing import Spacing

_BATCH = 2048  # every call is padded to this size: one compilation per function and dimension
_CORNER = np.cos(np.deg2rad(8.0))  # normals that differ by more, however close, make a corner
LEAST = 5.0  # spacings round a boundary component below which its shape is lost


class Boundary(NamedTuple):
    """Boundary particles (B, D) with unit outward normals (B, D)."""

    points: np.ndarray
    normals: np.ndarray


@functools.partial(jax.jit, static_argnums=0)
def _value_and_gradient(sdf: Callable, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(jax.value_and_grad(sdf))(x)


def _double_precision() -> Any:
    """Context in which JAX computes in float64: a boundary to 1e-10 is out of reach of float32."""
    enable = getattr(jax, "enable_x64", None)
    if enable is None:  # JAX before 0.8
        from jax.experimental import enable_x64 as enable
    return enable(True)


class SdfRegion:
    """The part of the box lo, hi where ``sdf`` is negative."""

    def __init__(self, sdf: Callable, lo: np.ndarray, hi: np.ndarray):
        self.lo, self.hi = lo, hi
        self.size = float((hi - lo).max())
        try:
            hash(sdf)
            self._sdf = sdf
        except TypeError:
            self._sdf = lambda x: sdf(x)
        self._check_shape()
        self._check_faces()

    def _check_shape(self) -> None:
        dim = len(self.lo)
        if not callable(self._sdf):
            raise ValueError(f"sdf: expected a function x (D,) -> scalar, got {self._sdf!r}")
        with _double_precision():
            try:
                out = jax.eval_shape(self._sdf, jax.ShapeDtypeStruct((dim,), jnp.float64))
            except jax.errors.JAXTypeError as error:
                raise ValueError(
                    "sdf: JAX could not trace it; write it for one point with jax.numpy, jnp.where in place of if "
                    f"({type(error).__name__}: {str(error).splitlines()[0]})"
                ) from error
        if getattr(out, "shape", None) != () or not jnp.issubdtype(out.dtype, jnp.floating):
            raise ValueError(
                f"sdf: returned {out} for one point x of shape ({dim},), expected a real scalar; "
                "it is mapped over points here, write it for a single one"
            )
        if out.dtype != jnp.float64:
            raise ValueError(f"sdf: computes in {out.dtype}, float64 was expected; drop casts and float32 constants in it")

    def _check_faces(self) -> None:
        """Raise where the domain reaches through the box."""
        dim = len(self.lo)
        ticks = [np.linspace(a, b, {1: 2, 2: 257, 3: 41}[dim]) for a, b in zip(self.lo, self.hi)]
        for axis in range(dim):
            for end in (self.lo, self.hi):
                sides = [np.array([end[i]]) if i == axis else t for i, t in enumerate(ticks)]
                x = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, dim)
                value = self.evaluate(x)[0]
                if value.min() < -1e-9 * self.size:
                    raise ValueError(
                        f"bounds: cut the domain, sdf = {value.min():.3g} at {x[value.argmin()]} on a face of the box "
                        f"from {self.lo} to {self.hi}; enlarge the bounds until sdf >= 0 on every face"
                    )

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (M,) and gradients (M, D); outside of the box everything is positive."""
        count = len(x)
        value, gradient = np.empty(count), np.empty(x.shape)
        with _double_precision():
            for i in range(0, count, _BATCH):
                part = x[i : i + _BATCH]
                padded = np.concatenate([part, np.broadcast_to(part[:1], (_BATCH - len(part), x.shape[1]))])
                v, g = _value_and_gradient(self._sdf, padded)
                value[i : i + _BATCH], gradient[i : i + _BATCH] = (np.asarray(a)[: len(part)] for a in (v, g))
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

    def project(self, x: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Newton steps of at most ``reach`` (M,) to the zero level; points (M, D) and whether they arrived."""
        x = x.copy()
        best, found = np.full(len(x), np.inf), x.copy()
        live = np.arange(len(x))
        for _ in range(40):
            distance, outward = self.distance(x[live])
            better = np.abs(distance) < best[live]
            at = live[better]
            best[at], found[at] = np.abs(distance[better]), x[at]
            step = np.clip(distance, -reach[live], reach[live])
            going = np.abs(distance) > 4e-16 * self.size
            live, step, outward = live[going], step[going], outward[going]
            if not len(live):
                break
            x[live] -= step[:, None] * outward
        return found, best <= 1e-13 * self.size

    def normals(self, x: np.ndarray) -> np.ndarray:
        """Unit gradients (M, D) at points of the zero level."""
        outward = self.distance(x)[1]
        lost = np.flatnonzero(~outward.any(axis=1))
        if len(lost):
            raise ValueError(
                f"sdf: its gradient vanishes or is not finite at the boundary point {x[lost[0]]}; the function must "
                "cross zero with a slope (not be a square or an absolute value)"
            )
        return outward


def boundary_of(region: SdfRegion, spacing: Spacing, seed: int) -> Boundary:
    """Boundary particles of the region, evenly spaced, with normals."""
    dim = len(region.lo)
    boundary = {1: _line, 2: _contour, 3: _surface}[dim](region, spacing, seed)
    value, gradient = region.evaluate(boundary.points)
    slope = np.maximum(np.nan_to_num(np.linalg.norm(gradient, axis=1)), 1.0)
    off = np.flatnonzero(np.abs(value) > 1e-11 * max(1.0, region.size) * slope)
    if len(off):
        raise ValueError(
            f"sdf: {len(off)} boundary points could not be brought to its zero level, e.g. sdf = {value[off[0]]:.3g} "
            f"at {boundary.points[off[0]]}; the function must be continuous and cross zero with a slope"
        )
    return boundary


def _cells(region: SdfRegion, spacing: Spacing, fraction: float) -> tuple[packing.Cells, packing.Cells]:
    """Octree cells near the zero level, and the coarse ones around; raises for an empty domain."""
    pad = 1.01 * region.size / packing._BASE[len(region.lo)]
    cells, coarse = packing.refine(region, spacing, region.lo - pad, region.hi + pad, fraction, False)
    if not ((cells.distance < 0).any() or (coarse.distance < 0).any()):
        raise ValueError(
            f"sdf: never negative in the bounds from {region.lo} to {region.hi} (looked at "
            f"{len(cells.distance) + len(coarse.distance)} points); negative means inside: check its sign and the bounds"
        )
    return cells, coarse


def _line(region: SdfRegion, spacing: Spacing, seed: int) -> Boundary:
    """Ends of the intervals in 1D."""
    cells, coarse = _cells(region, spacing, 0.5)
    x = np.concatenate([cells.centers, coarse.centers])
    x = x[np.argsort(x[:, 0])]
    negative = region.evaluate(x)[0] < 0
    change = np.flatnonzero(negative[1:] != negative[:-1])
    points = _root(region, x[change], x[change + 1], 1e-15)
    points, _ = region.project(points, np.full(len(points), 1e-6 * region.size))
    return Boundary(points, np.where(negative[change + 1], -1.0, 1.0)[:, None])


def _root(region: SdfRegion, a: np.ndarray, b: np.ndarray, tolerance: float) -> np.ndarray:
    """Zeros on the segments from a to b (M, D), whose ends differ in sign: Illinois, bisection every third step."""
    fa, fb = region.evaluate(a)[0], region.evaluate(b)[0]
    s, t = np.zeros(len(a)), np.ones(len(a))
    result, live = np.zeros(len(a)), np.arange(len(a))
    for step in range(90):
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.where(step % 3 == 2, (s + t) / 2, s - fa * (t - s) / (fb - fa))
        u = np.clip(np.where(np.isfinite(u), u, (s + t) / 2), s, t)
        result[live] = u
        f = region.evaluate(a[live] + u[:, None] * (b - a)[live])[0]
        left = (f < 0) == (fa < 0)  # the zero lies between u and t
        s, t = np.where(left, u, s), np.where(left, t, u)
        fa, fb = np.where(left, f, fa / 2), np.where(left, fb / 2, f)
        going = (t - s > tolerance) & (f != 0)
        live, s, t, fa, fb = live[going], s[going], t[going], fa[going], fb[going]
        if not len(live):
            break
    return a + result[:, None] * (b - a)


def _contour(region: SdfRegion, spacing: Spacing, seed: int) -> Boundary:
    """The zero level in 2D: closed polylines from marching triangles, cut at corners, divided evenly."""
    cells, coarse = _cells(region, spacing, 0.4)
    loops = _polylines(region, cells, coarse)
    if not loops:
        raise ValueError("spacing: too coarse for the shape, no boundary was found; reduce it below the shape's width")
    _check_seen(region, cells, np.concatenate(loops))
    points, normals = [], []
    for loop in loops:
        part = _divided_loop(region, loop, spacing)
        points.append(part.points)
        normals.append(part.normals)
    return Boundary(np.concatenate(points), np.concatenate(normals))


def _polylines(region: SdfRegion, cells: packing.Cells, coarse: packing.Cells) -> list[np.ndarray]:
    """Closed polylines (M, 2) of the zero level on a Delaunay triangulation of the cells' centres."""
    from scipy.spatial import Delaunay

    # A little disorder keeps the triangulation clear of cocircular points and of symmetric zeros.
    every = np.concatenate([cells.centers, coarse.centers])
    width = np.concatenate([cells.widths, coarse.widths])
    every = every + np.random.default_rng(0).uniform(-0.1, 0.1, every.shape) * width[:, None]
    negative = region.evaluate(every)[0] < 0
    triangles = Delaunay(every).simplices
    triangles = triangles[(negative[triangles].sum(axis=1) % 3) != 0]
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    crossed = negative[edges[..., 0]] != negative[edges[..., 1]]  # two edges of every such triangle
    ends, number = np.unique(edges[crossed], axis=0, return_inverse=True)
    links: list[list[int]] = [[] for _ in range(len(ends))]
    for i, j in number.reshape(-1, 2).tolist():
        links[i].append(j)
        links[j].append(i)
    points = _root(region, every[ends[:, 0]], every[ends[:, 1]], 1e-7)
    loops, seen = [], [False] * len(ends)
    for first in range(len(ends)):
        loop, at = [], first
        while not seen[at]:
            seen[at] = True
            loop.append(at)
            at = next((j for j in links[at] if not seen[j]), at)
        if len(loop) > 2:
            loops.append(_without_specks(points[loop]))
    return [loop for loop in loops if len(loop) > 2]


def _without_specks(loop: np.ndarray) -> np.ndarray:
    """Drop points of a closed polyline much closer to the one before than usual: their normals tell nothing."""
    length = np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1)
    return loop[length > 0.02 * np.median(length)]


def _check_seen(region: SdfRegion, cells: packing.Cells, found: np.ndarray) -> None:
    """Raise if some part of the zero level is too small to show up in the polylines."""
    from scipy.spatial import cKDTree

    close = np.abs(cells.distance) < 1.5 * cells.widths
    x, width = cells.centers[close], cells.widths[close]
    x, arrived = region.project(x, width)
    gap = cKDTree(found).query(x)[0]
    missed = arrived & (gap > 3 * width) & (np.linalg.norm(x - cells.centers[close], axis=1) < 2 * width)
    x, width = x[missed], width[missed]
    outward = region.distance(x)[1]
    # Where two shapes of a union touch, zero is reached from inside on both sides: that is no boundary.
    shift = 1e-4 * width[:, None] * outward
    real = (region.evaluate(x + shift)[0] > 0) & (region.evaluate(x - shift)[0] < 0)
    if real.any():
        raise ValueError(
            f"spacing: too coarse for the shape, whose boundary near {x[real][0]} is smaller than half a spacing; "
            "reduce the spacing there (it may be a function of the position)"
        )


def _divided_loop(region: SdfRegion, loop: np.ndarray, spacing: Spacing) -> Boundary:
    """Evenly spaced particles on a closed polyline of the zero level, its corners among them."""
    total = packing.path_lengths(np.concatenate([loop, loop[:1]]), spacing)[-1]
    if total < LEAST:
        raise ValueError(
            f"spacing: too coarse for the shape, a closed boundary near {loop[0]} is only {total:.2g} spacings round, "
            f"at least {LEAST:g} are needed; reduce the spacing there (it may be a function of the position)"
        )
    after, corners = _corners(region, loop)
    if len(after):
        loop = np.roll(loop, -(after[0] + 1), axis=0)  # begins right behind the first corner
        after = after - after[0] - 1
        bounds = np.concatenate([after[1:], [len(loop) - 1]]) + 1
        starts = np.concatenate([[0], bounds[:-1]])
        parts = []
        for k, (i, j) in enumerate(zip(starts, bounds)):
            end = corners.points[(k + 1) % len(corners.points)]
            path = np.concatenate([corners.points[k][None], loop[i:j], end[None]])
            parts.append(packing.divide(path, spacing)[0][1:-1])
        smooth = np.concatenate(parts)
    else:
        smooth = packing.divide(np.concatenate([loop, loop[:1]]), spacing)[0][:-1]
    smooth = _on_level(region, smooth, spacing)
    return Boundary(
        np.concatenate([corners.points, smooth]), np.concatenate([corners.normals, region.normals(smooth)])
    )


def _on_level(region: SdfRegion, x: np.ndarray, spacing: Spacing) -> np.ndarray:
    """Points near the zero level moved onto it; where Newton fails, by bisection along the gradient."""
    h = spacing(x)
    found, arrived = region.project(x, h / 4)
    arrived &= np.linalg.norm(found - x, axis=1) < h / 2
    lost = np.flatnonzero(~arrived)
    if len(lost):
        shift = 0.3 * h[lost, None] * region.distance(x[lost])[1]
        a, b = x[lost] - shift, x[lost] + shift
        bracket = (region.evaluate(a)[0] < 0) & (region.evaluate(b)[0] > 0)
        found[lost[bracket]] = _root(region, a[bracket], b[bracket], 1e-16)
    return found


def _corners(region: SdfRegion, loop: np.ndarray) -> tuple[np.ndarray, Boundary]:
    """Corners of a closed polyline: the points they come after, their places, bisectors as normals."""
    normal = region.distance(loop)[1]
    turning = np.einsum("md,md->m", normal, np.roll(normal, -1, axis=0)) < _CORNER
    after = np.flatnonzero(turning)
    a, b, na, nb = _jumps(region, loop[after], np.roll(loop, -1, axis=0)[after])
    sharp = np.einsum("md,md->m", na, nb) < _CORNER
    after, a, b, na, nb = (v[sharp] for v in (after, a, b, na, nb))
    # The corner is where the tangents on its two sides meet: exact, as the sides are ~1e-9 away.
    cross = na[:, 0] * nb[:, 1] - na[:, 1] * nb[:, 0]
    right = np.stack([np.einsum("md,md->m", na, a), np.einsum("md,md->m", nb, b)], axis=1)
    usable = np.abs(cross) > 0.02
    cross = np.where(usable, cross, 1.0)
    meet = np.stack(
        [right[:, 0] * nb[:, 1] - right[:, 1] * na[:, 1], right[:, 1] * na[:, 0] - right[:, 0] * nb[:, 0]], axis=1
    ) / cross[:, None]
    usable &= np.linalg.norm(meet - a, axis=1) < 100 * np.linalg.norm(b - a, axis=1) + 1e-12 * region.size
    points = np.where(usable[:, None], meet, a)
    bisector = na + nb
    length = np.linalg.norm(bisector, axis=1, keepdims=True)
    return after, Boundary(points, np.where(length > 1e-6, bisector / np.maximum(length, 1e-300), na))


def _jumps(region: SdfRegion, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, ...]:
    """Close in on the greatest turn of the normal between points a and b (M, D) of the zero level.

    Returns the two sides and their normals; where the boundary is smooth these end up nearly parallel.
    """
    reach = np.linalg.norm(b - a, axis=1)
    a, b = region.project(a, reach)[0], region.project(b, reach)[0]
    na, nb = region.distance(a)[1], region.distance(b)[1]
    live = np.arange(len(a))
    rng = np.random.default_rng(0)
    for _ in range(60):
        gap = np.linalg.norm(b[live] - a[live], axis=1)
        turn = np.einsum("md,md->m", na[live], nb[live])
        going = (gap > 1e-9 * region.size) & (turn < _CORNER)
        live, gap = live[going], gap[going]
        if not len(live):
            break
        # Not the exact middle, which may well be a corner of a symmetric shape.
        middle = a[live] + rng.uniform(0.4, 0.6, (len(live), 1)) * (b - a)[live]
        on, arrived = region.project(middle, gap)
        astray = ~arrived | (np.linalg.norm(on - middle, axis=1) > 2 * gap)
        on[astray] = middle[astray]
        n = region.distance(on)[1]
        first = np.einsum("md,md->m", na[live], n) < np.einsum("md,md->m", nb[live], n)
        b[live[first]], nb[live[first]] = on[first], n[first]
        a[live[~first]], na[live[~first]] = on[~first], n[~first]
    return a, b, na, nb


def _surface(region: SdfRegion, spacing: Spacing, seed: int) -> Boundary:
    """The zero level in 3D: foot points of small cells, thinned, relaxed on the surface, holes filled."""
    cells, _ = _cells(region, spacing, 0.5)
    close = np.abs(cells.distance) < 0.6 * cells.widths  # about one foot per cell that the surface cuts
    feet, arrived = region.project(cells.centers[close], cells.widths[close])
    arrived &= np.linalg.norm(feet - cells.centers[close], axis=1) < 2 * cells.widths[close]
    feet, area = feet[arrived], cells.widths[close][arrived] ** 2 / 1.2  # volume of the layer over its thickness
    crossing = _crossing(region, feet)
    feet, area = feet[crossing], area[crossing]
    if not len(feet):
        raise ValueError("spacing: too coarse for the shape, no boundary was found; reduce it below the shape's width")
    h = spacing(feet)
    points = _sparse(feet, h, float((area / h**2).sum()), seed)
    _check_components(feet, h, points)
    points = _relax_surface(region, points, spacing, 30)
    points = _refill(points, feet, h)
    points = _relax_surface(region, points, spacing, 15)
    points = points[packing.thin(points, 0.5 * spacing(points), np.arange(len(points)))]
    return Boundary(points, _surface_normals(region, points, spacing(points)))


def _sparse(feet: np.ndarray, h: np.ndarray, area: float, seed: int) -> np.ndarray:
    """A random even choice of feet, as many as hexagons of one spacing cover ``area`` (in squared spacings)."""
    priority = np.random.default_rng(seed).permutation(len(feet))
    radius, wanted = 0.78, 2.0 / np.sqrt(3.0) * area
    for _ in range(4):
        chosen = packing.thin(feet, radius * h, priority)
        if abs(len(chosen) - wanted) < 0.02 * wanted:
            break
        radius *= np.clip(np.sqrt(len(chosen) / wanted), 0.7, 1.2)
    return feet[chosen]


def _crossing(region: SdfRegion, x: np.ndarray) -> np.ndarray:
    """Mask of the points where the function changes sign, not merely touches zero."""
    shift = 1e-7 * region.size * region.distance(x)[1]
    return (region.evaluate(x + shift)[0] > 0) & (region.evaluate(x - shift)[0] < 0)


def _check_components(feet: np.ndarray, h: np.ndarray, points: np.ndarray) -> None:
    """Raise if a connected part of the surface got too few particles to tell its shape."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    gap, other = cKDTree(feet).query(feet, k=min(16, len(feet)))
    row, column = np.nonzero(gap < 1.5 * h[:, None])
    graph = coo_matrix((np.ones(len(row)), (row, other[row, column])), shape=(len(feet), len(feet)))
    label = connected_components(graph, directed=False)[1]
    count = np.bincount(label[cKDTree(feet).query(points)[1]], minlength=label.max() + 1)
    if count.min() < 10:
        raise ValueError(
            f"spacing: too coarse for the shape, only {count.min()} particles fit on the closed boundary near "
            f"{feet[label == count.argmin()][0]}, at least 10 are needed; reduce the spacing there"
        )


def _relax_surface(region: SdfRegion, points: np.ndarray, spacing: Spacing, steps: int) -> np.ndarray:
    """Let particles repel each other along the surface; those that lose it stay where they were."""
    from scipy.spatial import cKDTree

    for step in range(steps):
        h, normal = spacing(points), region.distance(points)[1]
        if step % 3 == 0:
            k = min(11, len(points))
            found = cKDTree(points).query(points, k=k)[1][:, 1:]
        scale = 2.0 / (h[:, None] + h[found])
        move = h[:, None] * packing.repulsion(points, points, found, scale)
        move -= np.einsum("md,md->m", move, normal)[:, None] * normal
        new, arrived = region.project(points + move, 0.3 * h)
        arrived &= np.linalg.norm(new - points, axis=1) < 0.5 * h
        points = np.where(arrived[:, None], new, points)
    return points


def _refill(points: np.ndarray, feet: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Put particles on feet (M, 3) of spacing h (M,) that lie in holes."""
    from scipy.spatial import cKDTree

    gap = cKDTree(points).query(feet)[0] / h
    hole = np.flatnonzero(gap > 0.85)
    return np.concatenate([points, feet[hole[packing.thin(feet[hole], 0.85 * h[hole], -gap[hole])]]])


def _surface_normals(region: SdfRegion, points: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Unit gradients; on an edge or a corner, the normalised mean of those on its sides."""
    normal = region.normals(points)
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(normal, across)
    total = np.zeros_like(normal)
    small = 1e-6 * h[:, None]
    for u, v in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        total += region.distance(points + small * (u * across + v * other - normal))[1]
    mean = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    edge = np.einsum("md,md->m", mean, normal) < 1 - 1e-6
    edge |= np.linalg.norm(total, axis=1) < 4 * (1 - 1e-6)
    return np.where(edge[:, None], mean, normal)
