"""The pencil of a problem that several processes share, A u = B f + Bg g: rows of own particles, as on one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jsmitsm.discretization.pencil.assemble import Layout, Pencil, laid_out, pencil_of
from jsmitsm.discretization.pencil.local import source_stencils
from jsmitsm.discretization.pencil.sparse import Sparse
from jsmitsm.parallel.local import Local
from jsmitsm.parallel.system import Block, distributed
from jsmitsm.taylor.multi_indices import count


def pencil_of_part(
    local: Local, massed: np.ndarray, start: Callable[[], Any] | None = None, degrees: Sequence[int] = ()
) -> Pencil:  # fmt: skip
    """The pencil whose rows of own particles are those of one process; the halo is widened where they need it.

    massed (F,): the equations with a source that matters. start: expansions (n, F, K) on the present halo, at which it
    is linearised. degrees: of polynomials that are to be fitted at the particles whose sources take part. Rows of
    borrowed particles mean nothing.
    """
    while True:
        taylor = None if start is None else start()
        with local.team.phase(local.halo.slab.number):
            nums = local.numbers(local.disc, taylor)
            local.refuse_degenerate(nums.degenerate)
            layout, parts = laid_out(local.disc, nums, massed)
            pencil = pencil_of(layout, parts, nums)
        if not local.widen(local.team.most(max(_misses(local, layout), fits_miss(local, _sources(layout), degrees)))):
            return pencil


def fits_miss(local: Local, ids: np.ndarray, degrees: Sequence[int]) -> float:
    """By how much the halo falls short of polynomials of these degrees that are fitted at local particles."""
    if not len(degrees):
        return -1.0
    points = local.halo.slab.points
    size = min(2 * count(local.mine.dim, max(degrees)), len(points))
    near = source_stencils(local.disc, ids, size, max(degrees))
    return local.halo.short_by(_radius(points, ids, near), ids)


def _sources(layout: Layout) -> np.ndarray:
    """The particles whose sources take part in the rows of own ones."""
    found = [far[far >= 0] for _, far in layout.classes if far is not None]
    return np.unique(np.concatenate([np.zeros(0, int), *found]).astype(int))


def _radius(points: np.ndarray, ids: np.ndarray, near: np.ndarray) -> np.ndarray:
    away = np.linalg.norm(points[np.maximum(near, 0)] - points[ids][:, None], axis=2)
    return np.where(near >= 0, away, 0.0).max(axis=1, initial=0.0)


def _misses(local: Local, layout: Layout) -> float:
    """By how much the halo falls short of the sources' stencils, and of what was looked at to repair weak rows."""
    points, worst, widest = local.halo.slab.points, -1.0, 1
    for cls, far in layout.classes:
        for near in (cls.neighbours, far):
            if near is None or not len(near):
                continue
            widest = max(widest, int((near >= 0).sum(axis=1).max()))
            worst = max(worst, local.halo.short_by(_radius(points, cls.ids, near), cls.ids))
    found = layout.fitness
    if found is not None:
        ids = np.unique(np.concatenate([found.repaired, found.weak, found.following])).astype(int)
        worst = max(worst, local.pool_misses(ids, widest)) if len(ids) else worst
    return worst


def own_rows(local: Local, matrix: Sparse) -> Any:
    """The own rows of a matrix over the local free values, as a matrix of PETSc's over those of all processes."""
    from scipy import sparse

    keep = np.flatnonzero(local.owned[matrix.rows])
    at = local.place[matrix.rows[keep]] - local.first, local.place[matrix.cols[keep]]
    block = sparse.csr_array((np.asarray(matrix.values)[keep], at), shape=(local.count, local.size))
    block.sum_duplicates()
    return distributed(local.team, local.count, [Block(np.arange(local.count), block)])
