"""The error estimate of js.Solution on several processes."""

from __future__ import annotations

import numpy as np

from jsmitsm.discretization.resolution.digits import room
from jsmitsm.parallel.assembly import assembled
from jsmitsm.parallel.local import Local, Settings
from jsmitsm.parallel.pencil.modes import ParallelModes, errors
from jsmitsm.parallel.solution import ParallelSolution
from jsmitsm.runtime.errors import explaining
from jsmitsm.solution.estimate import compared
from jsmitsm.taylor.multi_indices import HIGHEST


@explaining
def error_estimate(sol: ParallelSolution | ParallelModes) -> np.ndarray:
    """Estimated error |u - u_exact| at the own particles, or of eigenvalues; see ``js.Solution.error_estimate``.

    That towards one other order: no second one is asked.

    Parameters
    ----------
    sol : ParallelSolution or ParallelModes
        Of method S; or what ``jp.eigen`` found, whose values are found once more by order p + 2.

    Returns
    -------
    array (n,) or (n, F), or (k,)
        In units of u, for this process's particles; of eigenvalues the same on all, for those of a cluster that of the
        cluster, and infinite where there is no other order.

    Raises
    ------
    ValueError
        For method III, and where order + 2 is beyond the highest.

    Examples
    --------
    ``largest = jp.norm(jp.error_estimate(sol))``
    """
    if isinstance(sol, ParallelModes):
        return errors(sol)
    us, low = sol._team, sol._local
    order = sol._recipe.order + 2  # the highest that may be asked for
    with us.phase():
        if sol._recipe.method != "S":
            raise ValueError("error_estimate: made for method S alone on several processes; use js.solve")
        if not low.disc.linear:
            raise ValueError("error_estimate: made for linear problems alone on several processes; use js.solve")
        if order > HIGHEST:
            raise ValueError(f"error_estimate: needs expansions of order {order}, and {HIGHEST} is the highest")
    with us.phase():
        disc = low.disc
        room_at = lambda order: room(disc.rec, order, disc.traced, low.cloud, disc.problem.params, low.part)
        order = compared(disc.rec.order, disc.rec.depth, room_at(order), max(disc.rec.orders))
        most = room_at(order)
    high = Local(us, low.problem, low.mine, Settings("S", order, min(disc.rec.depth, most), None, True, "loo"))
    system, right = assembled(us, high, "auto")
    values = sol._values[low.halo.ids]
    free = ~high.disc.held[high.halo.ids]
    x = system.solve(right - system.times(values[free]))
    out = np.zeros(values.shape)
    out[free] = np.abs(x)
    return out[:, 0] if sol._recipe.fields == 1 else out
