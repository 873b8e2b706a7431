"""The global system from the rows of own particles, piece by piece: no process holds more than its share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jsmitsm.discretization.coefficients import Numbers, held_values
from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.discretization.leave_one_out import predictions, right_side
from jsmitsm.parallel.local import Local
from jsmitsm.parallel.system import Block, System, distributed
from jsmitsm.parallel.team import Team, give_back
from jsmitsm.particle.moments import Row

# What rows were made of: the discretisation of some particles, its numbers, classes and rows.
Piece = tuple[Discretization, Numbers, list[Class], list[Row]]


def assembled(
    us: Team, local: Local, solver: str, start: Callable[[], Any] | None = None, kept: list[Piece] | None = None
) -> tuple[System, np.ndarray]:  # fmt: skip
    """The global system of the own rows, and the own part (n,) of its right-hand side.

    start: expansions to linearise at, see ``Local.made``. kept: gets what the rows were made of.
    """

    def block(*piece: Any) -> tuple[Block, np.ndarray, Any]:
        return *_block(local, *piece), piece if kept is not None else None

    found = local.made(block, start)
    right = np.zeros(local.count)
    for (rows, _), values, piece in found:
        right[rows] = values
        if kept is not None:
            kept.append(piece)
    blocks = [some for some, _, _ in found]
    found.clear()
    rec = local.disc.rec
    elliptic = rec.fields == 1 and set(rec.orders) == {2}
    matrix = distributed(us, local.count, blocks)
    give_back()
    return System(us, matrix, solver, elliptic), right


def _block(
    local: Local, disc: Discretization, nums: Numbers, classes: list[Class], rows: list[Row]
) -> tuple[Block, np.ndarray]:  # fmt: skip
    """The own rows of some particles, u_i - sum_g w_g u_g, and their right-hand side."""
    from scipy import sparse

    unknowns = disc.unknowns[np.concatenate([cls.ids for cls in classes])].reshape(-1)
    unknowns = np.sort(unknowns[unknowns >= 0])
    data, r, c = predictions(disc, classes, rows)
    every = np.arange(len(unknowns))
    places = np.concatenate([np.searchsorted(unknowns, r), every]), local.place[np.concatenate([c, unknowns])]
    entries = sparse.csr_array(
        (np.concatenate([np.asarray(data), np.ones(len(every))]), places), shape=(len(unknowns), local.size)
    )
    entries.sum_duplicates()
    return Block(local.place[unknowns] - local.first, entries), np.asarray(right_side(disc, nums, classes, rows))


def spread(local: Local, x: np.ndarray) -> np.ndarray:
    """The values (n, F) of all local particles from the own unknowns."""
    disc = local.disc
    whole = np.zeros(disc.held.shape)
    whole[~disc.held & local.halo.own[:, None]] = x
    whole = local.halo.spread(whole)
    return np.where(disc.held, np.asarray(held_values(disc)), whole)
