"""What leads from a solution of several processes to that of another order."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.discretization.health import LEBESGUE
from jsmitsm.discretization.resolution.digits import lags, room
from jsmitsm.parallel.assembly import assembled
from jsmitsm.parallel.local import Local, Settings
from jsmitsm.runtime.errors import SolveError
from jsmitsm.solution.estimate import DOUBT, HIGH, TRUSTED, comparable, compared, lower
from jsmitsm.solution.look.sizes import share
from jsmitsm.taylor.multi_indices import HIGHEST, count


def corrected(low: Local, values: np.ndarray, taylor: Any) -> tuple[np.ndarray, Any]:
    """Estimated errors (n, F), their sign kept, of the own values, and units of the fields to compare them in.

    values (n, F), taylor (n, F, K): of all local particles, the latter where the problem is nonlinear.
    """
    us, order, rec = low.team, low.settings.order, low.disc.rec
    with us.phase():
        if order + 2 > HIGHEST:  # the highest that may be asked for
            raise ValueError(f"error_estimate: needs expansions of order {order + 2}, and {HIGHEST} is the highest")
        other = compared(rec.order, rec.depth, room(rec, order + 2), max(rec.orders), lags(rec))
    error, trust, units = _towards(low, values, taylor, other)
    below = lower(order, max(rec.orders))
    if not (other > order >= HIGH and trust < TRUSTED and below < order):
        return error, units
    # As ``jsmitsm.solution.estimate`` doubts rows of a higher order that amplify what they miss.
    try:
        beside, _, _ = _towards(low, values, taylor, below)
    except SolveError:
        return error, units
    own = values[low.halo.ids]
    far, near = (share(e, own, told=low.whole) for e in (error, beside))
    return (beside * (far / near) ** DOUBT if 0.0 < near < far else error), units


def _towards(low: Local, values: np.ndarray, taylor: Any, order: int) -> tuple[np.ndarray, float, Any]:
    """What leads from the own values to the solution by method S of another order, how far its rows are trusted, and
    the units of the fields."""
    us = low.team
    with us.phase():
        depth = min(low.disc.rec.depth, room(low.disc.rec, order))
    high = Local(us, low.problem, low.mine, Settings("S", order, depth, None, True, "loo"))

    def start() -> np.ndarray:
        """The own expansions, as long as those of the other order, on its halo."""
        size = count(low.mine.dim, high.disc.rec.reach)
        mine = np.asarray(taylor)[low.halo.ids][:, :, :size]
        out = np.zeros((len(high.halo), mine.shape[1], size))
        out[high.halo.ids, :, : mine.shape[2]] = mine
        return high.halo.spread(out)

    system, right = assembled(us, high, "auto", None if taylor is None else start)
    own = values[low.halo.ids]
    free = ~high.disc.held[high.halo.ids]
    x = system.solve(right - system.times(own[free]))
    out = np.zeros(own.shape)
    out[free] = x
    health = high.run.health
    assert health is not None
    return out, LEBESGUE / max(us.most(health.largest), LEBESGUE), _units(high, None if taylor is None else start())


def _units(high: Local, taylor: Any) -> Any:
    """As ``jsmitsm.solution.estimate.comparable``, the middle of what every process finds."""
    if not (any(high.disc.rec.weights) or high.disc.rec.sizes):
        return 1.0
    mine = comparable(high.disc, high.numbers(high.disc, taylor))
    return np.median(high.team.gather(mine), axis=0)
