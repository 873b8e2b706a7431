"""Evenly spaced particles inside of a domain: scattered by an octree, relaxed, holes filled.

A domain is known here only through ``distance(x (M, D)) -> (d (M,), outward (M, D))``, a signed
distance that need be accurate only near the boundary. Everything runs on the host in numpy.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from jsmitsm.runtime.errors import short

Spacing = Callable[[np.ndarray], np.ndarray]
SpacingLike = float | Callable[[np.ndarray], Any]

# Particles per spacing^D of the densest even arrangement: hexagons in 2D; in 3D a little below the
# 1.41 of a face-centred lattice, which relaxation from a random start does not find.
_DENSITY = {1: 1.0, 2: 2.0 / np.sqrt(3.0), 3: 1.25}
_NEIGHBOURS = {2: 8, 3: 14}
# Where the spacing varies, a force that scales with the mean of two spacings drives particles to the coarse side:
# there are more of them on the fine side. This weight of the neighbour's spacing stops the drift (found by trial).
_LEAN = {2: 0.6, 3: 0.75}
# Base cells along the longest side: what decides how small a part of the domain is noticed at all.
BASE = {1: 256, 2: 48, 3: 20}
# A new particle goes where an empty ball has more than this many spacings as radius; 0.58 is a gap between hexagons.
_HOLE = 0.85
_PROBES = 6
# Cells of an octree before it is taken for a mistake in the spacing.
_MOST = 30_000_000
# A lattice of one spacing, in spacings: its basis (in 3D a little wider, as the boundary's particles lie less densely),
# its disorder (a bare one is two to three times less accurate at order 6), how near to the boundary it is kept.
_BASIS = {
    2: np.array([(1.0, 0.0), (0.5, np.sqrt(0.75))]),
    3: 1.042 * np.sqrt(0.5) * np.array([(1.0, 1.0, 0.0), (1.0, 0.0, 1.0), (0.0, 1.0, 1.0)]),
}
_JITTER, _KEPT = 0.06, {2: 0.433, 3: 0.40}
# Particles so many spacings from the boundary are moved, those up to as many push them, in so many steps.
_MOVING, _HELD, _STEPS = 3.5, 5.7, 12
# No interior particle comes closer to the boundary than this many spacings.
CLEARANCE = 0.5


class Region(Protocol):
    """What the packing has to know about a domain."""

    def distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance (M,), negative inside, and the unit direction of its growth (M, D)."""
        ...


class Cells(NamedTuple):
    """Cubes of an octree: centres (M, D), widths (M,), and what the region says at the centres."""

    centers: np.ndarray
    widths: np.ndarray
    distance: np.ndarray
    outward: np.ndarray
    spacing: np.ndarray


def spacing_function(spacing: Any) -> Spacing:
    """A number or a user's function as a function (M, D) -> (M,) that checks what it returns."""
    if not callable(spacing):
        value = np.array(None) if isinstance(spacing, jax.core.Tracer) else np.asarray(spacing)
        if value.ndim or value.dtype.kind not in "fiu" or not np.isfinite(value) or value <= 0:
            raise ValueError(
                f"spacing: expected a positive finite number or a function (M, D) -> (M,), got {short(spacing)}"
            )
        return lambda x: np.full(len(x), float(value))

    def checked(x: np.ndarray) -> np.ndarray:
        given = spacing(x)
        try:
            h = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"spacing: the function returned {short(given)}, expected numbers (M,)") from None
        if h.shape != (len(x),):
            raise ValueError(
                f"spacing: the function returned shape {h.shape} for points of shape {x.shape}, "
                f"expected {(len(x),)}; compute it from x[:, 0], x[:, 1], ..."
            )
        bad = np.flatnonzero(~(np.isfinite(h) & (h > 0)))
        if len(bad):
            raise ValueError(
                f"spacing: the function returned {h[bad[0]]} at {x[bad[0]]}, expected positive finite lengths "
                "everywhere in the domain; bound it from below with np.maximum"
            )
        return h

    return checked


def refine(
    region: Region, spacing: Spacing, lo: np.ndarray, hi: np.ndarray, fraction: float, inside: bool, base: float = 0.0
) -> tuple[Cells, Cells]:
    """Split cubes until none is wider than ``fraction`` of the spacing.

    Returns the finished cells near the boundary (with ``inside`` also those in the domain) and the
    coarse ones left behind. ``base`` is the width to start from, chosen here where it is 0.
    """
    dim = len(lo)
    width = base or float((hi - lo).max()) / BASE[dim]
    counts = np.maximum(np.ceil((hi - lo) / width - 1e-9).astype(int), 1)
    start = (lo + hi) / 2 - counts * width / 2
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, dim)
    centers = start + (index + 0.5) * width
    children = np.array(list(itertools.product((-0.25, 0.25), repeat=dim)))
    done: list[Cells] = []
    left: list[Cells] = []
    changes = _sign_changes(np.sign(region.distance(centers)[0]).reshape(counts)).reshape(-1)
    while len(centers):
        distance, outward = region.distance(centers)
        # Twice the half diagonal: a signed distance function may be wrong by that factor.
        near = ~(np.abs(distance) > np.sqrt(dim) * width) | changes
        wanted = near | (distance < 0) if inside else near
        # Outside of the domain a user's spacing need not be defined: ask at the foot point.
        feet = np.where((distance > 0)[:, None] & near[:, None], centers - distance[:, None] * outward, centers)
        h = np.full(len(centers), np.inf)
        h[wanted] = spacing(feet[wanted])
        cells = Cells(centers, np.full(len(centers), width), distance, outward, h)
        left.append(_take(cells, ~wanted))
        done.append(_take(cells, wanted & (width <= fraction * h * (1 + 1e-9))))
        split = wanted & (width > fraction * h * (1 + 1e-9))
        # Near the boundary a split cell leaves about 2^(D - 1) behind, inside 2^D.
        needed = float(((width / (fraction * h[split])) ** (dim if inside else dim - 1)).sum())
        if needed > _MOST:
            raise ValueError(
                f"spacing: as small as {h[split].min():.3g} in a domain of size {(hi - lo).max():.3g} it takes about "
                f"{needed:.2g} cells, more than {_MOST:.0e}; enlarge it, or narrow the bounds if they are far too wide"
            )
        split = centers[split]
        centers = (split[:, None] + width * children).reshape(-1, dim)
        changes = np.zeros(len(centers), bool)
        width /= 2
    return join(done), join(left)


def _sign_changes(sign: np.ndarray) -> np.ndarray:
    """Cells of a grid next to one of the other sign."""
    changes = np.zeros(sign.shape, bool)
    for axis in range(sign.ndim):
        s, c = np.moveaxis(sign, axis, 0), np.moveaxis(changes, axis, 0)
        other = s[1:] != s[:-1]
        c[1:] |= other
        c[:-1] |= other
    return changes


def _take(cells: Cells, mask: np.ndarray) -> Cells:
    return Cells(*(field[mask] for field in cells))


def join(parts: list[Cells]) -> Cells:
    return Cells(*(np.concatenate(fields) for fields in zip(*parts)))


def fill(
    region: Region, spacing: Spacing, lo: np.ndarray, hi: np.ndarray, boundary: np.ndarray, seed: int, uniform: bool
) -> np.ndarray:
    """Interior particles (M, D) for a given boundary (B, D), evenly spaced, along a Morton curve."""
    if len(lo) == 1:
        return _fill_line(region, spacing, np.sort(boundary[:, 0]))
    rng = np.random.default_rng(seed)
    if uniform:
        points = _lattice(region, float(spacing(lo[None])[0]), lo, hi, boundary, rng)
        return points[np.argsort(morton(points, lo, hi), kind="stable")]
    points = _scatter(region, spacing, lo, hi, rng)
    points = points[_clear(region, points, boundary, spacing(points), 0.9 * CLEARANCE)]
    if not len(points):
        return points
    points = relax(region, points, boundary, len(boundary), spacing, 20)
    points = _repair(region, points, boundary, spacing, rng)
    points = relax(region, points, boundary, len(boundary), spacing, 10)
    points = points[_clear(region, points, boundary, spacing(points), 0.8 * CLEARANCE)]
    return points[np.argsort(morton(points, lo, hi), kind="stable")]


def _fill_line(region: Region, spacing: Spacing, ends: np.ndarray) -> np.ndarray:
    """Interior particles of the intervals between successive ends that lie in the domain."""
    parts = [np.zeros((0, 1))]
    for a, b in zip(ends[:-1], ends[1:]):
        if region.distance(np.array([[(a + b) / 2]]))[0][0] < 0:
            parts.append(divide(np.linspace(a, b, 2001)[:, None], spacing)[0][1:-1])
    return np.concatenate(parts)


def divide(path: np.ndarray, spacing: Spacing) -> tuple[np.ndarray, np.ndarray]:
    """Points (n + 1, D) along a path (M, D), ends kept, a constant number of local spacings apart.

    Also the piece of the path each lies on: k between path[k] and path[k + 1].
    """
    lengths = path_lengths(path, spacing)
    at = np.linspace(0.0, lengths[-1], max(1, int(np.rint(lengths[-1]))) + 1)
    points = np.stack([np.interp(at, lengths, x) for x in path.T], axis=1)
    points[0], points[-1] = path[0], path[-1]
    return points, np.clip(np.searchsorted(lengths, at, side="right") - 1, 0, len(path) - 2)


def path_lengths(path: np.ndarray, spacing: Spacing) -> np.ndarray:
    """Lengths (M,) along a path (M, D) from its start, in local spacings."""
    rate = 1.0 / spacing(path)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1) * (rate[1:] + rate[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])


def _scatter(
    region: Region, spacing: Spacing, lo: np.ndarray, hi: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """A start of the right density: octree cells of at most one particle each, dithered along a Morton curve."""
    dim = len(lo)
    fraction = _DENSITY[dim] ** (-1.0 / dim)
    shift = rng.uniform(0.0, 0.5, dim) * float((hi - lo).max()) / 100
    cells, _ = refine(region, spacing, lo - shift, hi + shift, fraction, True)
    order = np.argsort(morton(cells.centers, lo, hi), kind="stable")
    cells = _take(cells, order)
    expected = np.cumsum(_DENSITY[dim] * (cells.widths / cells.spacing) ** dim) * (1 - 1e-9)
    chosen = np.diff(np.floor(expected + rng.uniform()), prepend=0.0) > 0
    jitter = rng.uniform(-0.45, 0.45, (len(expected), dim)) * cells.widths[:, None]
    points = (cells.centers + jitter)[chosen]
    return points[region.distance(points)[0] < 0]


def _lattice(
    region: Region, h: float, lo: np.ndarray, hi: np.ndarray, boundary: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Interior particles for a spacing h that is the same everywhere: the densest lattice, turned and moved at random
    and a little disordered, relaxed where the boundary cuts it off."""
    from scipy.spatial import cKDTree

    points = _densest(h, lo, hi, rng)
    points = points[_clear(region, points, boundary, np.full(len(points), h), _KEPT[len(lo)])]
    if not len(points):
        return points
    away = cKDTree(boundary).query(points, distance_upper_bound=_HELD * h)[0]
    moving, held = np.flatnonzero(away < _MOVING * h), np.flatnonzero((away >= _MOVING * h) & (away < _HELD * h))
    fixed = np.concatenate([boundary, points[held]])
    moved = relax(region, points[moving], fixed, len(boundary), lambda x: np.full(len(x), h), _STEPS)
    points[moving] = moved
    clear = np.ones(len(points), bool)
    clear[moving] = _clear(region, moved, boundary, np.full(len(moved), h), 0.8 * CLEARANCE)
    return points[clear]


def _densest(h: float, lo: np.ndarray, hi: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The points (M, D) of a lattice of hexagons, in 3D of close-packed balls, that lie in a box."""
    dim = len(lo)
    basis = h * _BASIS[dim] @ _rotation(dim, rng).T
    inverse = np.linalg.inv(basis)
    corners = np.array(list(itertools.product(*zip(lo, hi)))) - lo
    reach = corners @ inverse
    ticks = [np.arange(np.floor(a) - 1, np.ceil(b) + 2) for a, b in zip(reach.min(axis=0), reach.max(axis=0))]
    ticks = [t + u for t, u in zip(ticks, rng.uniform(size=dim))]
    # Axis by axis: rows of the lattice that miss the box are never made.
    points = lo + (ticks[0][:, None] * basis[0])
    for k in range(1, dim):
        points = (points[:, None] + ticks[k][:, None] * basis[k]).reshape(-1, dim)
    points = points[((points >= lo) & (points <= hi)).all(axis=1)]
    return points + _JITTER * h * rng.uniform(-1, 1, points.shape)


def _rotation(dim: int, rng: np.random.Generator) -> np.ndarray:
    """A random rotation (D, D)."""
    q, r = np.linalg.qr(rng.normal(size=(dim, dim)))
    return q * np.sign(np.diag(r))


def morton(points: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Place of each point along a space-filling curve: interleaved bits of its coordinates."""
    dim = points.shape[1]
    bits = 60 // dim
    scaled = np.clip((points - lo) / (hi - lo).max(), 0.0, 1.0) * (2**bits - 1)
    code = np.zeros(len(points), dtype=np.int64)
    for axis, q in enumerate(scaled.astype(np.int64).T):
        for bit in range(bits):
            code |= ((q >> bit) & 1) << (dim * bit + axis)
    return code


def relax(
    region: Region, points: np.ndarray, fixed: np.ndarray, walls: int, spacing: Spacing, steps: int
) -> np.ndarray:
    """Let the particles repel each other and fixed ones, the first ``walls`` of which lie on the boundary."""
    from scipy.spatial import cKDTree

    points, count = points.copy(), len(points)
    k = min(_NEIGHBOURS[points.shape[1]] + 1, count + len(fixed))
    given = spacing(fixed)
    for step in range(steps):
        every = np.concatenate([points, fixed])
        if step % 6 == 0:  # particles move by a few hundredths of a spacing, neighbours outlast some steps
            h = np.concatenate([spacing(points), given])
            found = cKDTree(every, balanced_tree=False, compact_nodes=False).query(points, k=k)[1][:, 1:]
            scale = scaling(h[:count], h[found], points.shape[1])
            reach = (scale * np.linalg.norm(points[:, None] - every[found], axis=2)) < 2.0
            near = np.flatnonzero(((found >= count) & (found < count + walls) & reach).any(axis=1))
        points += h[:count, None] * repulsion(points, every, found, scale)
        if len(near) and step % 2:
            distance, outward = region.distance(points[near])
            push = np.clip(distance + CLEARANCE * h[near], 0.0, 0.3 * h[near])
            points[near] -= push[:, None] * outward
    return points


def scaling(h: np.ndarray, other: np.ndarray, dim: int) -> np.ndarray:
    """One over the spacing (M, k) that counts between particles with h (M,) and their neighbours with other (M, k)."""
    return 1.0 / ((1.0 - _LEAN[dim]) * h[:, None] + _LEAN[dim] * other)


def repulsion(points: np.ndarray, every: np.ndarray, found: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """One step (M, D) in spacings: forces q^-4 of the scaled distance q, cut off at 1.7 by the second shell."""
    # Axis by axis: contiguous (M, k) arrays are several times faster here than (M, k, D) ones.
    away = [x[:, None] - y[found] for x, y in zip(points.T, np.ascontiguousarray(every.T))]
    square = sum(a * a for a in away)
    q = np.maximum(square * scale * scale, 0.1)
    force = np.maximum(1.0 / (q * q) - 1.7**-4, 0.0) / np.sqrt(np.maximum(square, 1e-300))
    move = 0.05 * np.stack([(force * a).sum(axis=1) for a in away], axis=1)
    size = np.linalg.norm(move, axis=1)
    return move * np.minimum(1.0, 0.15 / np.maximum(size, 1e-300))[:, None]


def _clear(region: Region, points: np.ndarray, boundary: np.ndarray, h: np.ndarray, clearance: float) -> np.ndarray:
    """Mask of the points inside and away from the boundary by ``clearance`` spacings."""
    from scipy.spatial import cKDTree

    distance = region.distance(points)[0]
    clear = distance < -clearance * h
    # A first-order distance may be far too small where the function is steep; nobody near, nothing to keep clear of.
    doubtful = np.flatnonzero((distance < 0) & ~clear)
    clear[doubtful] = cKDTree(boundary).query(points[doubtful])[0] > 1.5 * h[doubtful]
    return clear


def _repair(
    region: Region, points: np.ndarray, boundary: np.ndarray, spacing: Spacing, rng: np.random.Generator
) -> np.ndarray:
    """Drop particles that are crowded, put new ones into holes."""
    from scipy.spatial import cKDTree

    h = spacing(points)
    gap, other = cKDTree(np.concatenate([points, boundary])).query(points, k=2)
    crowded = gap[:, 1] < 0.6 * h
    # Of a crowded pair of interior particles only one goes.
    crowded &= ~((other[:, 1] > np.arange(len(points))) & (other[:, 1] < len(points)))
    points, h = points[~crowded], h[~crowded]
    every = np.concatenate([points, boundary])
    tree = cKDTree(every)
    # A hole is seen from the particles around it: step off in some directions, then away from whatever is nearest.
    count = len(points)
    direction = rng.normal(size=(_PROBES * count, points.shape[1]))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    h = np.tile(h, _PROBES)
    probes = np.tile(points, (_PROBES, 1)) + 0.8 * h[:, None] * direction
    for step in range(6):
        gap, nearest = tree.query(probes)
        far = gap > (0.65 if step < 3 else 0.75) * h
        probes, h, gap, nearest = probes[far], h[far], gap[far], nearest[far]
        if step < 5:
            probes = probes + (0.2 * h / gap)[:, None] * (probes - every[nearest])
    probes = probes[region.distance(probes)[0] < 0]  # elsewhere a user's spacing need not be defined
    h = spacing(probes)
    gap = tree.query(probes)[0]
    hole = np.flatnonzero(gap > _HOLE * h)
    hole = hole[_clear(region, probes[hole], boundary, h[hole], CLEARANCE)]
    return np.concatenate([points, probes[hole[thin(probes[hole], _HOLE * h[hole], -gap[hole] / h[hole])]]])


def near_pairs(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances and indices (M, k) of as many neighbours as :func:`thin` can need, itself first."""
    from scipy.spatial import cKDTree

    return cKDTree(points).query(points, k=range(1, min(48, len(points)) + 1))


def thin(
    points: np.ndarray, radii: np.ndarray, priority: np.ndarray, pairs: tuple[np.ndarray, np.ndarray] | None = None
) -> np.ndarray:
    """Indices of a maximal subset with no two points closer than their radii; low priority values first."""
    if len(points) < 2:
        return np.arange(len(points))
    order = np.argsort(priority, kind="stable")
    rank = np.empty(len(points), int)
    rank[order] = np.arange(len(points))
    gap, other = near_pairs(points) if pairs is None else pairs
    close = gap < np.minimum(radii[:, None], radii[other])
    close[:, 0] = False
    a, b = np.nonzero(close)[0], other[close]
    a, b = np.concatenate([a, b]), np.concatenate([b, a])  # a list cut off at k need not be symmetric
    state = np.zeros(len(points), int)  # 0 undecided, 1 taken, -1 dropped
    while (state == 0).any():
        live = (state[a] == 0) & (state[b] == 0)
        a, b = a[live], b[live]
        beaten = np.zeros(len(points), bool)
        beaten[a[rank[b] < rank[a]]] = True
        winners = (state == 0) & ~beaten
        state[winners] = 1
        losers = b[winners[a]]
        state[losers] = -1
    return np.flatnonzero(state == 1)


def uncrowded(points: np.ndarray, h: np.ndarray, corners: int) -> np.ndarray:
    """Indices without the boundary points closer than half a spacing to others across a sharp tip.

    The first ``corners`` points always stay.
    """
    order = np.concatenate([np.zeros(corners), np.ones(len(points) - corners)])
    return np.union1d(thin(points, 0.5 * h, order), np.arange(corners))
