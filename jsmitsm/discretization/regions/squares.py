"""Regions in the least-squares form: where information travels the values of a region are those that its fits agree on.

The copies on interfaces keep the equations of their joint fits, so that jumps are met exactly; to the quadratic form of
the region they are what held values are on an outer boundary.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.discretization.least_squares import fitted_blocks, normal_entries, normal_load
from jsmitsm.discretization.leave_one_out import joined
from jsmitsm.discretization.regions.layout import Part, Regions
from jsmitsm.particle.moments import Block
from jsmitsm.runtime.tracers import is_traced


def squared_blocks(part: Part, nums: Numbers) -> tuple[list[Class], list[Block]]:
    """The misfits of all fits of a region."""
    found = fitted_blocks(part.disc, nums)
    return [cls for cls, _ in found], [block for _, block in found]


def squared_rows(regions: Regions, part: Part) -> np.ndarray:
    """The numbers of the unknowns whose equations are those of the region's least-squares form: all but the copies'."""
    copies = [i for m in regions.meetings for i in m.copies]
    at = regions.unknowns[np.setdiff1d(part.ids, copies)].reshape(-1)
    return at[at >= 0]


def squared_entries(regions: Regions, part: Part, made: tuple[list[Class], list[Block]]) -> tuple[Any, Any, Any]:
    """Their entries of the global matrix, as coordinates."""
    disc = _in_whole(regions, part)
    entries = joined([normal_entries(disc, cls, block) for cls, block in zip(*made, strict=True)])
    return of_rows(entries, _among(regions, part))


def squared_loads(
    regions: Regions, part: Part, nums: Numbers, made: tuple[list[Class], list[Block]]
) -> tuple[list[Any], list[Any]]:
    """What they add to the right-hand side: places, -1 for none, and values."""
    disc, mine = _in_whole(regions, part), _among(regions, part)
    places, loads = zip(*(normal_load(disc, nums, cls, block) for cls, block in zip(*made, strict=True)))
    xp: Any = jnp if is_traced(places) else np
    return [xp.where((p >= 0) & xp.asarray(mine)[xp.maximum(p, 0)], p, -1) for p in places], list(loads)


def of_rows(entries: tuple[Any, Any, Any], mine: np.ndarray) -> tuple[Any, Any, Any]:
    """Those entries (values, rows, columns) that stand in the rows ``mine`` (n,) bool."""
    values, at, to = entries
    if is_traced(at):
        return jnp.where(jnp.asarray(mine)[at], values, 0.0), at, to
    keep = np.flatnonzero(mine[at])
    return values[keep], at[keep], to[keep]


def _among(regions: Regions, part: Part) -> np.ndarray:
    mine = np.zeros(int(regions.unknowns.max(initial=-1)) + 1, bool)
    mine[squared_rows(regions, part)] = True
    return mine


def _in_whole(regions: Regions, part: Part) -> Discretization:
    """A region's discretisation whose unknowns have the numbers of the whole."""
    return replace(part.disc, unknowns=regions.unknowns[part.ids])
