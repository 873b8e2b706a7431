"""Cubes of an octree around the boundary of a domain or all over it, and the curve along which they lie.

A domain is known here only through ``distance(x (M, D)) -> (d (M,), outward (M, D))``, a signed
distance that need be accurate only near the boundary. Everything runs on the host in numpy.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from jsmitsm.runtime.errors import TooFine

Spacing = Callable[[np.ndarray], np.ndarray]

# Base cells along the longest side: what decides how small a part of the domain is noticed at all.
BASE = {1: 256, 2: 48, 3: 20}
# Cells of an octree before it is taken for a mistake in the spacing.
_MOST = 30_000_000
# Per dimension the shifts and masks that put D - 1 zeros between the bits of a whole number.
_SPREAD: dict[int, tuple[tuple[int, int], ...]] = {
    1: (),
    2: (
        (16, 0x0000FFFF0000FFFF), (8, 0x00FF00FF00FF00FF), (4, 0x0F0F0F0F0F0F0F0F), (2, 0x3333333333333333),
        (1, 0x5555555555555555),
    ),
    3: (
        (32, 0x001F00000000FFFF), (16, 0x001F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ),
}  # fmt: skip


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


def base_cells(lo: np.ndarray, hi: np.ndarray, base: float = 0.0) -> tuple[np.ndarray, float, np.ndarray]:
    """Centres (M, D), width and counts (D,) of the cells from which an octree over a box is refined."""
    dim = len(lo)
    width = base or float((hi - lo).max()) / BASE[dim]
    counts = np.maximum(np.ceil((hi - lo) / width - 1e-9).astype(int), 1)
    start = (lo + hi) / 2 - counts * width / 2
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, dim)
    return start + (index + 0.5) * width, width, counts


def refine(
    region: Region, spacing: Spacing, lo: np.ndarray, hi: np.ndarray, fraction: float, inside: bool, base: float = 0.0,
    kept: np.ndarray | None = None,
) -> tuple[Cells, Cells]:  # fmt: skip
    """Split cubes until none is wider than ``fraction`` of the spacing.

    Returns the finished cells near the boundary (with ``inside`` also those in the domain) and the
    coarse ones left behind. ``base`` is the width to start from, chosen here where it is 0; ``kept`` (M,) a mask of the
    cells to start from.
    """
    dim = len(lo)
    centers, width, counts = base_cells(lo, hi, base)
    children = np.array(list(itertools.product((-0.25, 0.25), repeat=dim)))
    done: list[Cells] = []
    left: list[Cells] = []
    distance, outward = region.distance(centers)
    changes = _sign_changes(np.sign(distance).reshape(counts)).reshape(-1)
    if kept is not None:
        centers, distance, outward, changes = (x[kept] for x in (centers, distance, outward, changes))
    while len(centers):
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
        # Near the boundary a split cell leaves about 2^(D - 1) behind, inside 2^D. The foot of all that is beyond a
        # corner is the corner: where only this point is fine most of the cell is not, so no cell counts for too many.
        needed = float(np.minimum((width / (fraction * h[split])) ** (dim if inside else dim - 1), _MOST / 1000).sum())
        if needed > _MOST:
            raise TooFine(
                f"spacing: as small as {h[split].min():.3g} in a domain of size {(hi - lo).max():.3g} it takes about "
                f"{needed:.2g} cells, more than {_MOST:.0e}; enlarge it, or narrow the bounds if they are far too wide"
            )
        split = centers[split]
        centers = (split[:, None] + width * children).reshape(-1, dim)
        distance, outward = region.distance(centers)
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


def morton(points: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Place of each point along a space-filling curve: interleaved bits of its coordinates."""
    dim = points.shape[1]
    bits = {1: 52, 2: 30, 3: 20}[dim]
    scaled = np.clip((points - lo) / (hi - lo).max(), 0.0, 1.0) * (2**bits - 1)
    code = np.zeros(len(points), dtype=np.int64)
    for axis, q in enumerate(scaled.astype(np.int64).T):
        for shift, mask in _SPREAD[dim]:  # halves move apart, then quarters, and so on
            q = (q | q << shift) & mask
        code |= q << axis
    return code
