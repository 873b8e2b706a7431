"""Held values that contradict the equation: what it says by itself where its highest derivatives have no weight."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jsmitsm.discretization.coefficients import Numbers, slot_series
from jsmitsm.discretization.degenerate import candidates
from jsmitsm.discretization.held_particles import held_particles
from jsmitsm.discretization.layout import Discretization, mean_spacing
from jsmitsm.discretization.parts.whole import whole
from jsmitsm.equation.problem import Problem

ROUNDING = 1e-9


def contradictions(
    disc: Discretization, nums: Numbers, problem: Problem, values: np.ndarray, expanded: Callable[[], np.ndarray]
) -> np.ndarray:  # fmt: skip
    """By how much held values (N, F) miss the equation where it degenerates, in parts of its largest terms: (N,).

    No equation is solved at a held particle. On a boundary where the highest derivatives have a weight they make up for
    any value; where they have none the rest of the equation fixes it: -2 u = 0 at the left end of x^2 u'' = 2 u. The
    derivatives in the rest are those of the polynomials around. expanded: makes the expansions of all particles.
    """
    off, told = np.zeros(len(disc.cloud)), whole(disc)
    ids = held_particles(disc)
    ids = ids if disc.part is None else ids[disc.part.own[ids]]
    if not told.most(len(ids)) or not disc.linear:
        return off
    jac, source = disc.traced.coefficients(np.asarray(disc.cloud.points)[ids], 0, params=problem.params)
    jac = np.asarray(jac)
    few = candidates(disc, np.broadcast_to(jac, (*jac.shape[:3], len(ids))), told)[0]
    if not told.most(len(few)):
        return off
    every = np.array(expanded())
    every[ids, :, 0] = values[ids]
    terms = lambda at, j: j * slot_series(disc.rec, disc.traced.slots, every[at], 0)[None, :, 0]
    here = terms(ids[few], np.broadcast_to(jac, (*jac.shape[:3], len(ids)))[:, :, 0, few])
    rest = here.sum(axis=1) + (0.0 if source is None else np.asarray(source)[:, 0, few])
    at, of = (told.owned(nums.ids, x) for x in (nums.ids, np.asarray(nums.jac)[:, :, 0]))
    largest = told.most(np.abs(terms(at, of)).max(axis=(1, 2), initial=0.0))
    # Differences of neighbours are known to their rounding.
    length = mean_spacing(disc) or 1.0
    size = told.most(np.abs(told.own(values)).max(axis=0, initial=0.0))
    rounding = ROUNDING * np.array([size[f] / length ** sum(b) for f, b in disc.traced.slots])
    rounded = told.most((np.abs(of) * rounding[:, None]).max(axis=(1, 2), initial=0.0))
    largest = np.maximum(np.maximum(largest, told.most(np.abs(here).max(axis=(1, 2), initial=0.0))), rounded)
    off[ids[few]] = (np.abs(rest) / np.where(largest > 0, largest, 1.0)[:, None]).max(axis=0)
    return off
