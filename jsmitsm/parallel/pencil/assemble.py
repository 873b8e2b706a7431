"""The pencil of a problem that several processes share, A u = B f + Bg g: rows of own particles, as on one."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.discretization.pencil.assemble import Layout, Pencil, laid_out, pencil_of
from jsmitsm.discretization.pencil.sparse import Sparse
from jsmitsm.parallel.local import Local
from jsmitsm.parallel.system import Block, distributed


def pencil_of_part(local: Local, massed: np.ndarray) -> Pencil:
    """The pencil whose rows of own particles are those of one process; the halo is widened where they need it.

    massed (F,): the equations with a source that matters. Rows of borrowed particles mean nothing.
    """
    while True:
        with local.team.phase(local.halo.slab.number):
            nums = local.numbers(local.disc)
            layout, parts = laid_out(local.disc, nums, massed)
            pencil = pencil_of(layout, parts, nums)
        if not local.widen(local.team.most(_misses(local, layout))):
            return pencil


def _misses(local: Local, layout: Layout) -> float:
    """By how much the halo falls short of the sources' stencils, and of what was looked at to repair weak rows."""
    points, worst, widest = local.halo.slab.points, -1.0, 1
    for cls, far in layout.classes:
        for near in (cls.neighbours, far):
            if near is None or not len(near):
                continue
            widest = max(widest, int((near >= 0).sum(axis=1).max()))
            away = np.linalg.norm(points[np.maximum(near, 0)] - points[cls.ids][:, None], axis=2)
            worst = max(worst, local.halo.short_by(np.where(near >= 0, away, 0.0).max(axis=1), cls.ids))
    found = layout.fitness
    if found is not None:
        ids = np.unique(np.concatenate([found.repaired, found.weak, found.following])).astype(int)
        worst = max(worst, local.pool_misses(ids, widest)) if len(ids) else worst
    return worst


def own_rows(local: Local, pencil: Pencil, matrix: Sparse, columns: Any = None) -> Any:
    """Rows of own free values against all free values, as a matrix of PETSc's; columns (N F,): factors of columns."""
    from scipy import sparse

    fields = local.disc.rec.fields
    number = np.full(local.disc.held.size, -1)
    number[pencil.free] = local.place[local.disc.unknowns.reshape(-1)[pencil.free]]
    keep = np.flatnonzero(
        local.halo.own[matrix.rows // fields] & (number[matrix.rows] >= 0) & (number[matrix.cols] >= 0)
    )
    values = np.asarray(matrix.values)[keep]
    if columns is not None:
        values = values * columns[matrix.cols[keep]]
    at = number[matrix.rows[keep]] - local.first, number[matrix.cols[keep]]
    block = sparse.csr_array((values, at), shape=(local.count, local.size))
    block.sum_duplicates()
    return distributed(local.team, local.count, [Block(np.arange(local.count), block)])
