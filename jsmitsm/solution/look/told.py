"""Sentences of what no particle sees of a problem, and no estimate with them."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.discretization.parts.whole import whole
from jsmitsm.runtime.errors import some
from jsmitsm.solution.look.between import between, even, layers, seam, unseen_data
from jsmitsm.solution.look.reach import far_out, unmet
from jsmitsm.solution.look.sizes import share

# An estimated error below this part of the solution clears what only suspects the resolution ...
CLEARED = 0.02
# ... unless what is missed between the particles would make so much of the solution, or where the source says so too.
MISSED, AGREED = 1.0, 0.3
# ... or layers that hold up a flux there: integrals across them, which are as they are.
LAYERED = 0.02
# ... or boundary data so much: seven particles a wavelength leave an eighth of the data.
DATA = 0.3
# ... or values that no polynomial reaches by far: above 0.27 where estimates were blind, below 0.05 of solutions right
# to 1 %.
REACHED = 0.2


def unseen(
    run: Any, values: np.ndarray, found: dict[str, float], cleared: bool, narrow: bool
) -> list[str]:  # fmt: skip
    """What no particle sees, and with them no estimate: between them, and beyond a seam.

    cleared: by cheap tests, without an estimate; narrow: the source is not resolved, as they say.
    """
    disc, every = run.disc, whole(run.disc)
    part = lambda missed: share(every.own(missed), every.own(values), told=every)
    found["missed"] = missed = 0.0 if cleared and even(run) else part(between(run, values))
    found["layers"] = layered = part(layers(run, values))
    told = list[str]()
    # Constant coefficients degenerate nowhere, and layers that fall to nothing within the spacing may be right.
    if not (disc.linear and disc.traced.constant):
        told += out_of_reach(run, values, found, cleared)
    if missed > (AGREED if narrow else MISSED) or layered > LAYERED:
        told.append(
            f"Between the particles the equation is missed by as much as makes {max(missed, layered):.0%} of the "
            "solution: the source or a coefficient changes within the spacing, unseen by the particles; refine there, "
            "or smooth it."
        )
    return told + data(run, values, found)


def data(run: Any, values: np.ndarray, found: dict[str, float]) -> list[str]:
    """Of boundary data between the particles, and of the equation beyond a seam."""
    return _between(run, values, found) + _across(run, values, found)


def _across(run: Any, values: np.ndarray, found: dict[str, float]) -> list[str]:
    """Of an equation that a periodic pair does not repeat, which an estimate knows, but not by name."""
    every = whole(run.disc)
    found["seam"] = beyond = share(every.own(seam(run, values)), every.own(values), told=every)
    if beyond <= CLEARED:
        return []
    return [
        f"The equation is not the same on both sides of a periodic pair, which makes {beyond:.0%} of the solution: "
        "let the source and the coefficients repeat themselves, or refine there."
    ]


def _between(run: Any, values: np.ndarray, found: dict[str, float]) -> list[str]:
    """Of boundary data between the particles; where these seem not to see them, the polynomials are asked."""
    every = whole(run.disc)
    made = share(every.own(unseen_data(run)), every.own(values), told=every)
    if made > DATA:
        made = share(every.own(unseen_data(run, run.fitted(run.nums, values))), every.own(values), told=every)
    found["data"] = made
    if made <= DATA:
        return []
    return [
        f"Between the particles boundary data change by as much as makes {made:.0%} of the solution, unseen by them: "
        "refine the boundary, or smooth the data."
    ]


def out_of_reach(run: Any, values: np.ndarray, found: dict[str, float], alone: bool = True) -> list[str]:
    """Of values that the polynomials of their neighbours do not reach; alone: without an estimate."""
    every = whole(run.disc)
    made, at = (unmet if alone else far_out)(run, values)
    part, most = share(every.own(made), every.own(values), told=every), CLEARED if alone else REACHED
    found["unmet"], at = part, every.named(at)
    if part <= most and alone:
        return out_of_reach(run, values, found, False)
    if part <= most:
        return []
    return [
        f"The local polynomials of {len(at)} particle(s), first {some(at)}, do not reach their nearest neighbours, "
        f"which makes {part:.0%} of the solution, and no order sees it: beside a point where conditions or their data "
        "change, a corner or a singular point, or in a layer thinner than the spacing; refine there."
    ]
