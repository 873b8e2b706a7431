"""A run on several processes before its first step: as ``jsmitsm.evolution.run``, its pencil that of a part."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.discretization.coefficients import slot_series
from jsmitsm.discretization.pencil.fits import local_fits
from jsmitsm.equation.problem import Problem
from jsmitsm.evolution.arguments import starting_values
from jsmitsm.evolution.run import Run, drifted
from jsmitsm.evolution.space.convection import refuse_convection
from jsmitsm.evolution.space.timed import Timed, timed
from jsmitsm.evolution.steps.stepping import Step
from jsmitsm.parallel.distributed import Slab
from jsmitsm.parallel.local import Local, Settings
from jsmitsm.parallel.pencil.assemble import fits_miss, pencil_of_part
from jsmitsm.parallel.pencil.space import OwnSemidiscrete
from jsmitsm.parallel.shares import local_problem
from jsmitsm.parallel.solving import refuse_traced
from jsmitsm.parallel.team import Team


class TimedLocal(Local):
    """A part of a problem in time, at a moment: what is discretised is its operator in space."""

    timed: Timed

    def __init__(self, us: Team, problem: Problem, mine: Slab, settings: Settings, t: float):
        self.t = np.asarray(t)
        super().__init__(us, problem, mine, settings)

    def _localised(self, slab: Slab, cloud: Cloud) -> Problem:
        self.timed = timed(local_problem(self.problem, slab), cloud)
        if self.timed.flow is not None:
            raise ValueError("problem: incompressible flows in time are not made for several processes; use js.evolve")
        return self.at(self.t)

    def at(self, t: Any) -> Problem:
        """What is discretised, at a moment: where the highest derivatives are nonlinear the whole residual."""
        problem = self.timed.at(t)
        if self.timed.quasilinear:
            problem.pde = self.timed.space  # type: ignore[assignment]
        return problem

    def move(self, t: Any) -> None:
        """The same part at another moment."""
        self.t = np.asarray(t)
        self.disc = replace(self.disc, problem=self.at(self.t))


class ParallelRun(Run):
    """A run of which every process has a part; all decide the same."""

    def __init__(self, local: TimedLocal, u0: Any, t: tuple[float, float], began: float, scheme: str, damping: Any,
                 solver: str):  # fmt: skip
        self.local, self.u0, self.solver = local, u0, solver
        order, depth = local.settings.order, local.settings.depth
        super().__init__(local.timed, local.cloud, self._start(), t, began, order=order, scheme=scheme, damping=damping,
                         stencils=None, throw=True, depth=depth)  # fmt: skip

    def _start(self) -> tuple[Any, ...]:
        """Values (n, F) of all local particles at the start, and rates."""
        local = self.local
        fields, slab = local.problem.fields, local.halo.slab
        second = bool(local.timed.masses[1].slots)

        def cut(given: Any) -> Any:
            whole = not callable(given) and np.ndim(given) and (fields == 1 or np.shape(given) != (fields,))
            if whole and np.shape(given)[:1] != (slab.count,):
                raise ValueError(f"u0: shape {np.shape(given)}, expected a function of x, a number or ({slab.count}, "
                                 "...)")  # fmt: skip
            return np.asarray(given)[slab.number] if whole else given

        with local.team.phase():
            pair = second and isinstance(self.u0, (tuple, list)) and len(self.u0) == 2
            u0 = tuple(map(cut, self.u0)) if pair else self.u0 if second else cut(self.u0)
            values = starting_values(u0, local.cloud, fields, second)
            refuse_traced(values)
            return tuple(map(np.asarray, values))

    def _scheme(self, asked: str) -> str:
        found = super()._scheme(asked)
        return "esdirk" if found == "radau" else found

    @property
    def spacing(self) -> float:
        return self.local.part.spacing

    def pencil(self, t: Any, u: Any) -> OwnSemidiscrete:
        local, began = self.local, time.perf_counter()
        self.counts["pencils"] += 1
        own, reference, taylor = u[local.halo.ids], None, None
        local.move(t)
        if local.timed.quasilinear:
            taylor = lambda: self._expanded(own)  # noqa: E731
        pencil = pencil_of_part(local, local.timed.sourced, taylor, self._degrees())
        self.timed, self.cloud = local.timed, local.cloud
        self.params = local.timed.problem.params[1]
        if not self.counts["steps"]:
            self.start = self._start()
        with local.team.phase(local.halo.slab.number):
            if taylor is not None:
                reference = self._reference(local.disc.problem, taylor())
            semi = OwnSemidiscrete(local, self.timed, pencil, self.params, self.damping, reference, self.solver)
            refuse_convection(semi, self.flags, local.part)
            self._flag_signs(pencil)
        self.counts["seconds in pencils"] = self.counts.get("seconds in pencils", 0.0) + time.perf_counter() - began
        return semi

    def _degrees(self) -> list[int]:
        """Of the polynomials that what is nonlinear and what damps ask for."""
        rest = self.timed.space if self.timed.quasilinear else self.timed.rest
        highest = max((sum(b) for _, b in rest.slots), default=0)
        nonlinear = [self.local.disc.rec.order + highest - 1] if highest else []
        return nonlinear + ([max(self.local.disc.rec.order - 2, 1)] if self.damping else [])

    def _expanded(self, own: np.ndarray) -> np.ndarray:
        """Local polynomials (n, F, K) of own values (n, F), those of borrowed particles from their owners."""
        local = self.local
        while True:
            degree, halo = local.disc.rec.reach, local.halo
            if not local.widen(local.team.most(fits_miss(local, halo.ids, [degree]))):
                break
        values = np.zeros((len(halo), own.shape[1]))
        values[halo.ids] = own
        values = halo.spread(values)
        with local.team.phase():
            found = np.asarray(local_fits(local.disc, degree).coefficients(values))
        return halo.spread(found)

    def _reference(self, problem: Problem, taylor: np.ndarray) -> np.ndarray:
        """The coefficients (E, S, n) that the pencil is made with."""
        space, local = self.timed.space, self.local
        slots = slot_series(local.disc.rec, space.slots, taylor, 0)
        jac, _ = space.coefficients(local.cloud.points, 0, params=problem.params, slots=slots)
        return np.broadcast_to(np.asarray(jac)[:, :, 0], (self.fields, len(space.slots), len(local.halo)))

    def _flag_wrong(self, wrong: np.ndarray) -> None:
        number = self.local.halo.slab.number[np.asarray(wrong, int)]
        super()._flag_wrong(np.sort(np.concatenate(self.local.team.gather(number))))

    def left(self, step: Step, t: float) -> bool:
        u = self.semi.placed(step.y[: self.semi.system.n], step.known)
        mine = drifted(self.semi, u, t, self.local.halo.ids)
        return self.local.team.total(int(mine)) > 0
