"""Held values that contradict the equation: what it says by itself where its highest derivatives have no weight."""

from __future__ import annotations

import numpy as np

from jsmitsm.discretization.coefficients import Numbers, slot_series
from jsmitsm.discretization.degenerate import candidates
from jsmitsm.discretization.held_particles import held_particles, with_held_expansions
from jsmitsm.discretization.layout import Discretization, mean_spacing
from jsmitsm.discretization.rows import all_coefficients
from jsmitsm.equation.problem import Problem

ROUNDING = 1e-9


def contradictions(disc: Discretization, nums: Numbers, problem: Problem, values: np.ndarray) -> np.ndarray:
    """By how much held values (N, F) miss the equation where it degenerates, in parts of its largest terms: (N,).

    No equation is solved at a held particle. On a boundary where the highest derivatives have a weight they make up for
    any value; where they have none the rest of the equation fixes it: -2 u = 0 at the left end of x^2 u'' = 2 u. The
    derivatives in the rest are those of the polynomials around.
    """
    off = np.zeros(len(disc.cloud))
    ids = held_particles(disc)
    if not len(ids) or not disc.linear:
        return off
    jac, source = disc.traced.coefficients(np.asarray(disc.cloud.points)[ids], 0, params=problem.params)
    jac = np.asarray(jac)
    few = candidates(disc, np.broadcast_to(jac, (*jac.shape[:3], len(ids))))[0]
    if not len(few):
        return off
    every = with_held_expansions(disc, np.asarray(all_coefficients(disc, nums, values)))
    every = np.array(every)
    every[ids, :, 0] = values[ids]
    terms = lambda at, j: j * slot_series(disc.rec, disc.traced.slots, every[at], 0)[None, :, 0]
    here = terms(ids[few], np.broadcast_to(jac, (*jac.shape[:3], len(ids)))[:, :, 0, few])
    rest = here.sum(axis=1) + (0.0 if source is None else np.asarray(source)[:, 0, few])
    largest = np.abs(terms(nums.ids, np.asarray(nums.jac)[:, :, 0])).max(axis=(1, 2))
    # Differences of neighbours are known to their rounding.
    length = mean_spacing(disc) or 1.0
    rounding = ROUNDING * np.array([np.abs(values[:, f]).max() / length ** sum(b) for f, b in disc.traced.slots])
    rounded = (np.abs(np.asarray(nums.jac)[:, :, 0]) * rounding[:, None]).max(axis=(1, 2))
    largest = np.maximum(np.maximum(largest, np.abs(here).max(axis=(1, 2))), rounded)
    off[ids[few]] = (np.abs(rest) / np.where(largest > 0, largest, 1.0)[:, None]).max(axis=0)
    return off
