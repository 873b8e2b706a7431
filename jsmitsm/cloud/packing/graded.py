"""Interior particles of a spacing that varies, in parts: what each part fills hangs on the place alone.

The cells from which an octree is refined are dealt out along a curve. Each part starts from the cells around its own
that reach it, over as many spacings as relaxation carries, and keeps what comes to lie in its own.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from jsmitsm.cloud.packing.lattice import disorder
from jsmitsm.cloud.packing.octree import Region, Spacing, base_cells, morton, refine
from jsmitsm.cloud.packing.relaxation import DENSITY, settled

# Spacings over which particles are carried along, in 24 steps of relaxation by less and less: from 24 spacings on parts
# were those of the whole to the last bit, at 16 to 1e-8.
CARRIED = 32.0
# Dithering counts in such parts of a particle, whole numbers: sums of them do not hang on what was added before.
_ONE = 1 << 32


class Blocks(NamedTuple):
    """The cubes of a regular grid over a domain.

    lo (D,): the grid's corner; width, counts (D,): of its cubes; spacing (M,): the largest in each, 0 outside of the
    domain; share (M,): the particles expected in each.
    """

    lo: np.ndarray
    width: float
    counts: np.ndarray
    spacing: np.ndarray
    share: np.ndarray

    def at(self, points: np.ndarray) -> np.ndarray:
        """The numbers (n,) of the cubes in which points lie."""
        index = np.floor((points - self.lo) / self.width).astype(int)
        return np.ravel_multi_index(tuple(np.clip(index, 0, self.counts - 1).T), tuple(self.counts))


def blocks(region: Region, spacing: Spacing, lo: np.ndarray, hi: np.ndarray) -> Blocks:
    """The cubes from which the octree of a domain is refined."""
    dim = len(lo)
    centers, width, counts = base_cells(lo, hi)
    inner = np.array(list(itertools.product((-0.25, 0.25), repeat=dim)))
    at = (centers[:, None] + width * inner).reshape(-1, dim)
    distance, outward = region.distance(at)
    near = distance < np.sqrt(dim) * width
    feet = np.where((distance > 0)[:, None], at - distance[:, None] * outward, at)
    h = np.zeros(len(at))
    h[near] = spacing(feet[near])
    inside = distance < 0
    share = np.zeros(len(at))
    share[inside] = DENSITY[dim] * (0.5 * width / h[inside]) ** dim
    of_block = lambda x: x.reshape(len(centers), -1)  # noqa: E731
    return Blocks(centers[0] - width / 2, width, counts, of_block(h).max(axis=1), of_block(share).sum(axis=1))


def owners(grid: Blocks, parts: int) -> np.ndarray:
    """The part (M,) that has each block: runs along a curve with as many particles each."""
    index = np.stack(np.unravel_index(np.arange(len(grid.share)), tuple(grid.counts)), axis=1).astype(float)
    order = np.argsort(morton(index, np.zeros(len(grid.counts)), grid.counts.astype(float)), kind="stable")
    upto = np.cumsum(grid.share[order])
    out = np.zeros(len(order), int)
    middle = (upto - 0.5 * grid.share[order]) / upto[-1]
    out[order] = np.minimum((parts * middle).astype(int), parts - 1)
    return out


def graded_part(
    region: Region, spacing: Spacing, lo: np.ndarray, hi: np.ndarray, boundary: np.ndarray, seed: int, grid: Blocks,
    mine: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Interior particles in the blocks of a mask (M,); parts with the same seed have the particles of the whole."""
    points = _scattered(region, spacing, lo, hi, seed, grid, _reached(grid, mine))

    def directions(around: np.ndarray, count: int) -> np.ndarray:
        bits = np.ascontiguousarray(around).view(np.int64)
        numbered = [np.concatenate([bits, np.full((len(bits), 1), k)], axis=1) for k in range(count)]
        return np.concatenate([disorder(x, seed)[:, :-1] for x in numbered])

    points = settled(region, points, boundary, spacing, directions)
    return points[mine[grid.at(points)]]


def _reached(grid: Blocks, mine: np.ndarray) -> np.ndarray:
    """The blocks (M,) from which particles carry to those of a part, by the shortest ways, in spacings."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    shape, dim = tuple(grid.counts), len(grid.counts)
    number, h = np.arange(len(mine)).reshape(shape), grid.spacing
    pairs = []
    for step in itertools.product((-1, 0, 1), repeat=dim):
        if step <= (0,) * dim:
            continue
        here = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(step, shape))
        there = tuple(slice(max(0, s), n + min(0, s)) for s, n in zip(step, shape))
        a, b = number[here].reshape(-1), number[there].reshape(-1)
        both = (h[a] > 0) & (h[b] > 0)
        a, b = a[both], b[both]
        pairs.append((a, b, grid.width * np.sqrt(np.square(step).sum()) / np.maximum(h[a], h[b])))
    a, b, cost = (np.concatenate(x) for x in zip(*pairs))
    graph = coo_array((cost, (a, b)), shape=(len(mine), len(mine))).tocsr()
    sources = np.flatnonzero(mine & (h > 0))
    if not len(sources):
        return mine
    away = dijkstra(graph, directed=False, indices=sources, min_only=True, limit=CARRIED)
    reached = np.isfinite(away) | mine
    # From a block's middle to its faces there is half of it, on both ends of the way.
    beside = reached.copy()
    beside[b[reached[a]]] = True
    beside[a[reached[b]]] = True
    return beside


def _scattered(
    region: Region, spacing: Spacing, lo: np.ndarray, hi: np.ndarray, seed: int, grid: Blocks, kept: np.ndarray
) -> np.ndarray:
    """A start of the right density in some blocks: cells of at most one particle each, dithered block by block."""
    dim = len(lo)
    cells, _ = refine(region, spacing, lo, hi, DENSITY[dim] ** (-1.0 / dim), True, kept=kept)
    block = grid.at(cells.centers)
    order = np.lexsort((morton(cells.centers, lo, hi), block))
    block, centers, width = block[order], np.ascontiguousarray(cells.centers[order]), cells.widths[order]
    weight = np.rint(_ONE * np.minimum(DENSITY[dim] * (width / cells.spacing[order]) ** dim, 1.0)).astype(np.int64)
    upto = np.cumsum(weight)
    first = np.flatnonzero(np.diff(block, prepend=-1))
    before = np.repeat(upto[first] - weight[first], np.diff(np.append(first, len(block))))
    phase = np.rint(0.5 * (1.0 + disorder(np.arange(len(kept))[:, None], seed)[:, 0]) * (_ONE - 1)).astype(np.int64)
    upto = upto - before + phase[block]
    chosen = (upto // _ONE) > ((upto - weight) // _ONE)
    points = centers + 0.45 * disorder(centers.view(np.int64), seed) * width[:, None]
    points = points[chosen]
    return points[region.distance(points)[0] < 0]
