"""What the particles of several regions do not see of their problem, and what it would make of the solution."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.regions.layout import Part
from jsmitsm.discretization.regions.rows import RegionNumbers, in_squares, spread, whole_coefficients, whole_right_side
from jsmitsm.discretization.rows import all_rows
from jsmitsm.solution.look.between import (
    data_between,
    has_kinks,
    held_up,
    measured,
    out_of_series,
    same_everywhere,
    solved_alone,
    sourced,
    unresolved,
    with_source,
)
from jsmitsm.solution.look.reach import LOST, TIMES, Misses, made_of
from jsmitsm.solution.look.sizes import share
from jsmitsm.solution.look.told import CLEARED, DATA, LAYERED, MISSED


def unseen(run: Any, values: np.ndarray) -> list[str]:
    """A sentence for what lies between the particles of the regions, and for each that orders do not see."""
    expanded = np.asarray(whole_coefficients(run.disc, run.nums, values), float)

    def left(part: Part, own: Numbers) -> Numbers | None:
        disc = part.disc
        return None if same_everywhere(disc) else unresolved(disc, own, disc.problem, expanded[part.ids])

    def beyond(part: Part, own: Numbers) -> Numbers | None:
        disc = part.disc
        return out_of_series(disc, own, disc.problem, expanded[part.ids]) if has_kinks(disc, own) else None

    def layers(part: Part, own: Numbers) -> Numbers | None:
        disc = part.disc
        return None if disc.traced.constant else held_up(disc, own, disc.problem, lambda: expanded[part.ids])

    told, between = [], share(_made(run, left), values)
    layered = share(measured(values, _made(run, layers)), values)
    if between > MISSED or layered > LAYERED:
        told.append(
            f"Between the particles the equations are missed by as much as makes {max(between, layered):.0%} of the "
            "solution: a source or a coefficient changes within the spacing, unseen by the particles; refine there, or "
            "smooth it."
        )
    if (kinks := share(_made(run, beyond), values)) > CLEARED:
        told.append(
            f"Beyond kinks or jumps of a source or a coefficient, where their series end, the equations are missed by "
            f"as much as makes {kinks:.0%} of the solution: make both sides regions of their own, or refine there."
        )
    if (data := share(_made(run, _data), values)) > DATA:
        told.append(
            f"Between the particles boundary data change by as much as makes {data:.0%} of the solution, unseen by "
            "them: refine the boundary, or smooth the data."
        )
    return told


def out_of_reach(run: Any, values: np.ndarray) -> np.ndarray:
    """What values that the polynomials of their own region do not reach make of the solution, (N, F)."""
    disc, defects = run.disc, np.zeros(run.disc.held.shape)
    if run.nums is None or run.factor is None:
        return defects
    expanded = np.asarray(whole_coefficients(disc, run.nums, values), float)
    for part, rows in zip(disc.parts, run.parts):
        if part.name not in run.squared:
            misses = Misses(part.disc, rows, values[part.ids], expanded[part.ids])
            defects[part.ids] = misses.of(LOST[disc.rec.order > 3])
    return made_of(run, TIMES * defects)[0]


def _data(part: Part, own: Numbers) -> Numbers | None:
    return data_between(part.disc, own, part.disc.problem)


def _with_sources(part: Part, own: Numbers, made: Any) -> Any:
    """The rows of a region with the weights of a source, which those of an equation without one lack."""
    classes, rows = made
    if part.disc.scheme.sourced or in_squares(rows):
        return made
    return all_rows(sourced(part.disc, classes), own)


def _made(run: Any, look: Callable[[Part, Numbers], Numbers | None]) -> np.ndarray:
    """What the numbers that ``look`` finds in every region, None for nothing, make of the solution, (N, F)."""
    disc, nums = run.disc, run.nums
    found = [look(part, own) for part, own in zip(disc.parts, nums.parts)]
    if all(own is None for own in found) or run.factor is None:
        return np.zeros(disc.held.shape)
    alone = [with_source(own, np.zeros_like(own.source)) if new is None else new for own, new in zip(nums.parts, found)]
    between = {name: (coef, np.zeros_like(value)) for name, (coef, value) in nums.between.items()}
    held = spread(disc, [own.held for own in alone], disc.held.shape)
    rows = [_with_sources(part, own, made) for part, own, made in zip(disc.parts, nums.parts, run.parts)]
    right = whole_right_side(disc, RegionNumbers(alone, between, held), rows, run.bound)
    return solved_alone(run, np.asarray(right)) if right.any() else np.zeros(disc.held.shape)
