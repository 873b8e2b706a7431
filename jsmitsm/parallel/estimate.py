"""The error estimate of js.Solution, by defect correction, on several processes."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.discretization.leave_one_out import matrix, right_side
from jsmitsm.discretization.resolution.digits import room
from jsmitsm.parallel.local import Local, Settings
from jsmitsm.parallel.solution import ParallelSolution
from jsmitsm.parallel.team import Team
from jsmitsm.solution.estimate import one_scale, strongest, trust_of
from jsmitsm.taylor.multi_indices import HIGHEST

_HALVINGS = 60


def error_estimate(sol: ParallelSolution) -> np.ndarray:
    """Estimated error |u - u_exact| at the own particles; see ``js.Solution.error_estimate``.

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
    order = sol._recipe.order + 2
    with us.phase():
        if sol._recipe.method != "S":
            raise ValueError("error_estimate: made for method S alone on several processes; use js.solve")
        if order > HIGHEST:
            raise ValueError(f"error_estimate: needs expansions of order {order}, and {HIGHEST} is the highest")
    with us.phase():
        disc = low.disc
        most = room(disc.rec, order, disc.traced, low.cloud, disc.problem.params, low.part)
    high = Local(us, low.problem, low.mine, Settings("S", order, min(disc.rec.depth, most), None, True, "loo"))
    high_nums, classes, rows = high.rows()
    values = np.zeros((len(high.halo), sol._recipe.fields))
    values[high.halo.ids] = sol._values[low.halo.ids]
    values = high.halo.spread(values)
    nums, low_classes, low_rows = low.rows()
    with us.phase():
        defect, theirs = _defects(high, high_nums, classes, rows, values)
        _, mine = _defects(low, nums, low_classes, low_rows, sol._values)
        disc, own = low.disc, low.halo.ids
        ratio = np.ones(disc.held.shape)
        there = np.ones(disc.held.shape)
        ratio[own], there[own] = mine[own], theirs[high.halo.ids]
        scale = one_scale(ratio, there, disc, low.halo.own, lambda x: _median(us, x))
        trusted = trust_of(high.disc, classes, rows)[high.halo.ids]
        weighed = scale[own] * trusted * defect[high.halo.ids]
    x = sol.system.solve(weighed[~disc.held[own]])
    out = np.zeros(weighed.shape)
    out[~disc.held[own]] = np.abs(x)
    return out[:, 0] if sol._recipe.fields == 1 else out


def _defects(local: Local, nums: Any, classes: Any, rows: Any, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The residual b - A u of every own row and the weight of the source in it, both (n, F); elsewhere 0 and 1."""
    disc = local.disc
    data, r, c = matrix(disc, classes, rows)
    u = values[~disc.held]
    free = np.where(~disc.held & local.halo.own[:, None])
    au = np.bincount(r, data * u[c], len(u))[disc.unknowns[free]]
    residual, weight = np.zeros(disc.held.shape), np.ones(disc.held.shape)
    residual[free] = right_side(disc, nums, classes, rows) - au
    first = np.array(disc.rec.equation_rows)
    for cls, row in zip(classes, rows):
        weight[cls.ids] = strongest(np.asarray(row.source)[:, :, first], np)
    return residual, weight


def _median(us: Team, values: np.ndarray) -> float:
    """The median of what all processes have, to rounding."""
    ends = us.gather((float(values.min(initial=np.inf)), float(values.max(initial=-np.inf)), len(values)))
    count = sum(n for *_, n in ends)
    if not count:
        return 1.0
    # The two in the middle, which are one where the count is odd.
    wanted = np.array([(count - 1) // 2 + 1, count // 2 + 1])
    low, high = (np.full(2, end) for end in (min(a for a, *_ in ends), max(b for _, b, _ in ends)))
    for _ in range(_HALVINGS):
        middle = (low + high) / 2.0
        below = us.total((values[:, None] <= middle).sum(axis=0)) >= wanted
        low, high = np.where(below, low, middle), np.where(below, middle, high)
    return float(high.mean())
