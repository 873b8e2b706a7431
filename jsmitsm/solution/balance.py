"""Do the data of a field that nothing fixes balance?"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Discretization
from jsmitsm.discretization.least_squares import misfit
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.look.sizes import scales
from jsmitsm.taylor.multi_indices import HIGHEST

# A solvable pure Neumann problem leaves a mean residual below this part of its data,
COMPATIBLE = 1e-6
# or one that falls to less than this part of itself from one order to two orders higher.
KEPT = 0.5
# In the least-squares form data that do not balance are spread evenly over all fits. A median misfit, added up across
# the domain, of less than this is what they leave that balance to half a percent; measured over all particles of large
# clouds, it is 0.024 to 0.034 times the part of them that does not, at any order.
EVEN = 1e-4
# Less than the first changes the solution by less than the discretisation does, and slopes taken at corners leave as
# much. Between the fields of a system, and where interfaces curve, both vary more with the order: less than the second
# is a doubt, not a refusal.
UNSURE, FALLEN = (1e-5, 1e-3), 0.1


def unbalanced(
    rest: float, imbalance_at: Callable[[int], float], order: int, fields: int, linear: bool,
    floating: tuple[int, ...], several: bool = False,
) -> tuple[str, bool]:  # fmt: skip
    """What speaks against data that leave the mean residual ``rest``, and whether that is certain; "" if nothing does.

    imbalance_at: the mean residual of the same problem at another order; floating: the fields that nothing fixes;
    several: regions.
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
    names = f"field{'s' * (len(floating) > 1)} {', '.join(map(str, floating))}"
    value = f"the value of {names}, which enters by its derivatives only" if fields > 1 else "the value"
    if fields == 1 and min(rest, other) < UNSURE[0]:
        return "", False
    small = (fields > 1 or several) and min(rest, other) < UNSURE[1]
    # What the discretisation leaves of a nonlinear system (a pressure at the corners of a lid) cannot be told apart.
    if small or (fields > 1 and not linear):
        return f"The data may not balance, and nothing fixes {value} {told}.", False
    return f"the conditions are incompatible: nothing fixes {value}, and the data do not balance {told}", True


def with_multiplier(data: Any, r: Any, c: Any, b: Any, ids: np.ndarray) -> tuple[Any, Any, Any, Any]:
    """The system (entries, rows, columns, right-hand side) with a row and a column more: the unknowns ``ids`` of a
    floating field have mean zero.

    Their entries have the size of the field's own, whose unit is squared in the least-squares form.
    """
    xp = jnp if is_traced(data, r, c, b) else np
    n = len(b)
    mine = xp.asarray(np.isin(np.arange(n), ids))[r] & (xp.asarray(r) == xp.asarray(c))
    size = xp.sqrt(xp.abs(xp.sum(xp.where(mine, data, 0.0))) / len(ids))
    line, entries = np.full(len(ids), n), xp.where(size > 0, size, 1.0) * np.ones(2 * len(ids))
    places = (np.concatenate if xp is np else xp.concatenate)
    return (
        xp.concatenate([data, entries]), places([r, ids, line]), places([c, line, ids]),
        xp.concatenate([b, np.zeros(1)]),
    )  # fmt: skip


def relative_misfit(disc: Discretization, nums: Numbers, values: Any, parts: list[Any] | None = None) -> Any:
    """By how much the particles' values miss their local fits, in parts of the range; parts: as of ``misfit``."""
    return misfit(disc, nums, values, parts) / scales(values[:, _leading(disc)]).max()


def _leading(disc: Discretization) -> np.ndarray:
    """The fields that count all derivatives of the equations, (F,) bool."""
    return np.array(disc.rec.weights) == 0


def spread(disc: Discretization, missed: Any) -> Any:
    """The median of relative misfits, added up across the domain; zero below ``EVEN``.

    Where all that is compared is held, values are met exactly, whatever the data.
    """
    free = np.flatnonzero(~disc.held[disc.active][:, _leading(disc)].all(axis=1))
    if not len(free):
        return 0.0
    xp = jnp if is_traced(missed) else np
    found = xp.median(missed[free]) * len(disc.cloud) ** (1.0 / disc.rec.dim)
    return xp.where(found > EVEN, found, 0.0)


def imbalance(turned: Callable[[Any], Any], x: Any, b: Any, n: int) -> Any:
    """The largest Lagrange multiplier relative to the data that it sums up.

    With y the last row of the inverse, the multiplier is y . b, whatever the units of the equations that y weighs:
    relative to |y| . |b| it is the same at every order, in a system of fields too. turned: solves with the transpose.
    """
    xp = jnp if is_traced(x, b) else np
    size = xp.abs(b) @ xp.abs(turned(np.eye(len(b), len(b) - n, -n)))
    return xp.max(xp.abs(x[n:]) / xp.where(size > 0, size, 1.0))
