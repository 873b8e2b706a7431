"""What speaks against a solution of several processes: what ``jsmitsm.solution.flags`` tells one, asked together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from jsmitsm.discretization.held_particles import with_held_expansions
from jsmitsm.discretization.rows import all_coefficients, all_rows
from jsmitsm.parallel.local import Local
from jsmitsm.parallel.look.conditioning import condition
from jsmitsm.parallel.system import ROUND_OFF, System
from jsmitsm.runtime.errors import SolveError
from jsmitsm.solution.flags import flags
from jsmitsm.solution.look.reach import beyond_orders


class Factor:
    """The system of all processes, as the flags of one ask its factors."""

    def __init__(self, system: System):
        self.system, self.n = system, system.n

    def condition(self) -> float:
        return condition(self.system)

    def solve(self, b: np.ndarray) -> np.ndarray:
        """The own part of the answer, infinite where no solver finds one."""
        try:
            return self.system.answer(b, False, ROUND_OFF)[0]
        except SolveError:
            return np.full(self.n, np.inf)


class Look:
    """A finished solve as the flags look at it: rows of the own particles, numbers and values of those around too."""

    formulation, misfit, bordering = "loo", None, 0
    unsettled = ()  # here nobody is kept from moving

    def __init__(self, local: Local, system: System, taylor: Any):
        self.local, self.disc, self.problem = local, local.disc, local.disc.problem
        every = replace(self.disc, part=replace(local.part, own=np.ones(len(local.halo), bool)))
        self.nums = local.numbers(every, taylor)
        self.rows = all_rows(self.disc, self.nums)
        self.factor = Factor(system)
        self._fitted: np.ndarray | None = None
        self.misses: Any = None

    def fitted(self, nums: Any, values: Any) -> np.ndarray:
        """The polynomials (n, F, K) of the values at all particles that carry equations, each its owner's."""
        if self._fitted is None:
            self._fitted = self.local.halo.spread(np.asarray(all_coefficients(self.disc, nums, values), float))
        return self._fitted

    def expanded(self, nums: Any, values: Any) -> np.ndarray:
        """The same, and those of held particles."""
        return self.local.halo.spread(np.asarray(with_held_expansions(self.disc, self.fitted(nums, values))))


def unseen(local: Local, system: System, values: np.ndarray, taylor: Any, known: np.ndarray) -> np.ndarray:
    """What no order sees, at the own particles (n, F), beside the error that two orders tell of these."""
    with local.team.phase(local.halo.slab.number):
        look = Look(local, system, taylor)
    with local.team.phase():
        return beyond_orders(look, values, known)[local.halo.ids]


def told(
    local: Local, system: System, values: np.ndarray, taylor: Any, estimated: Callable[[], float]
) -> list[str]:  # fmt: skip
    """Sentences, the same on all processes; taylor: at which a nonlinear problem was linearised last."""
    with local.team.phase(local.halo.slab.number):
        look = Look(local, system, taylor)
    with local.team.phase():
        return flags(look, values, look.nums, estimated)[0]
