"""Do the data of a field that nothing fixes balance?"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jsmitsm.linear import linsolve
from jsmitsm.taylor.multi_indices import HIGHEST

# A solvable pure Neumann problem leaves a mean residual below this part of its data,
COMPATIBLE = 1e-6
# or one that falls to less than this part of itself from one order to two orders higher.
KEPT = 0.5
# Between the fields of a system both vary more with the order: less than this is a doubt, not a refusal.
UNSURE, FALLEN = 1e-3, 0.1


def unbalanced(
    rest: float, imbalance_at: Callable[[int], float], order: int, fields: int, linear: bool
) -> tuple[str, bool]:
    """What speaks against data that leave the mean residual ``rest``, and whether that is certain; "" if nothing does.

    imbalance_at: the mean residual of the same problem at another order.
    """
    if rest <= COMPATIBLE:
        return "", False
    # The discretisation's share falls with the order, a real imbalance stays. The highest orders look down.
    up = order + 2 <= HIGHEST
    try:
        other = imbalance_at(order + (2 if up else -2))
    except ValueError:  # too few particles to tell
        other = rest
    lower, higher = (rest, other) if up else (other, rest)
    if higher <= max(COMPATIBLE, (FALLEN if fields > 1 else KEPT) * lower):
        return "", False
    told = (
        f"(mean residual {rest:.1e} of the data, and {other:.1e} two orders {'higher' if up else 'lower'}); "
        "correct the source or the fluxes, hold a value (js.dirichlet, js.fix), or refine a cloud that is too "
        "coarse for its data"
    )
    # What the discretisation leaves of a nonlinear system (a pressure at the corners of a lid) cannot be told apart.
    if fields > 1 and (min(rest, other) < UNSURE or not linear):
        return f"The data may not balance, and nothing fixes the value {told}.", False
    return f"the conditions are incompatible: nothing fixes the value, and the data do not balance {told}", True


def imbalance(system: linsolve.Factor, x: np.ndarray, b: np.ndarray, n: int) -> float:
    """The largest Lagrange multiplier relative to the data that it sums up.

    With y the last row of the inverse, the multiplier is y . b, whatever the units of the equations that y weighs:
    relative to |y| . |b| it is the same at every order, in a system of fields too.
    """
    weights = np.abs(system.solve(np.eye(len(b), len(b) - n, -n), transpose=True))
    size = np.abs(b) @ weights
    return float(np.max(np.abs(x[n:]) / np.where(size > 0, size, 1.0)))
