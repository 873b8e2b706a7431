"""The error estimate of js.Solution on several processes."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.discretization.leave_one_out import matrix
from jsmitsm.discretization.resolution.digits import room
from jsmitsm.parallel.local import Local, Settings
from jsmitsm.parallel.solution import ParallelSolution
from jsmitsm.parallel.solving import assembled
from jsmitsm.runtime.errors import explaining
from jsmitsm.solution.estimate import compared
from jsmitsm.taylor.multi_indices import HIGHEST


@explaining
def error_estimate(sol: ParallelSolution) -> np.ndarray:
    """Estimated error |u - u_exact| at the own particles; see ``js.Solution.error_estimate``.

    That towards one other order: no second one is asked.

    Parameters
    ----------
    sol : ParallelSolution
        Of method S.

    Returns
    -------
    array (n,) or (n, F)
        In units of u, for this process's particles.

    Raises
    ------
    ValueError
        For method III, and where order + 2 is beyond the highest.

    Examples
    --------
    ``largest = jp.norm(jp.error_estimate(sol))``
    """
    us, low = sol._team, sol._local
    order = sol._recipe.order + 2  # the highest that may be asked for
    with us.phase():
        if sol._recipe.method != "S":
            raise ValueError("error_estimate: made for method S alone on several processes; use js.solve")
        if order > HIGHEST:
            raise ValueError(f"error_estimate: needs expansions of order {order}, and {HIGHEST} is the highest")
    with us.phase():
        disc = low.disc
        room_at = lambda order: room(disc.rec, order, disc.traced, low.cloud, disc.problem.params, low.part)
        order = compared(disc.rec.order, disc.rec.depth, room_at(order), max(disc.rec.orders))
        most = room_at(order)
    high = Local(us, low.problem, low.mine, Settings("S", order, min(disc.rec.depth, most), None, True, "loo"))
    high_nums, classes, rows = high.rows()
    values = np.zeros((len(high.halo), sol._recipe.fields))
    values[high.halo.ids] = sol._values[low.halo.ids]
    values = high.halo.spread(values)
    system, right = assembled(us, high, high_nums, classes, rows, "auto")
    with us.phase():
        own = high.halo.ids
        free = ~high.disc.held[own]
        residual = _residual(high, right, classes, rows, values)[own]
    x = system.solve(residual[free])
    out = np.zeros(residual.shape)
    out[free] = np.abs(x)
    return out[:, 0] if sol._recipe.fields == 1 else out


def _residual(local: Local, right: np.ndarray, classes: Any, rows: Any, values: np.ndarray) -> np.ndarray:
    """The residual b - A u of every own row, (n, F); elsewhere 0."""
    disc = local.disc
    data, r, c = matrix(disc, classes, rows)
    u = values[~disc.held]
    free = np.where(~disc.held & local.halo.own[:, None])
    residual = np.zeros(disc.held.shape)
    residual[free] = right - np.bincount(r, data * u[c], len(u))[disc.unknowns[free]]
    return residual
