"""Problems in time on several processes: the implicit steps of ``js.evolve`` on the pencil that they share."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.problem import Problem
from jsmitsm.evolution.arguments import check, saved_times
from jsmitsm.evolution.march import LARGE, NAMES, marched
from jsmitsm.parallel.distributed import ParallelCloud, bisected, slab_of
from jsmitsm.parallel.local import OfOwn, Settings
from jsmitsm.parallel.pencil.run import ParallelRun, TimedLocal
from jsmitsm.parallel.pencil.space import OwnSystem
from jsmitsm.parallel.solving import refuse_others, refuse_traced
from jsmitsm.parallel.team import collective, team
from jsmitsm.runtime.arrays import ValueOrFunction
from jsmitsm.runtime.errors import SolveError, did_you_mean, explained, is_one_of
from jsmitsm.runtime.progress import bar

# Schemes that are made for several processes.
SCHEMES = ("auto", "esdirk", "imex", "euler")


class ParallelEvolution(OfOwn):
    """A run of which every process has its own particles' part.

    Attributes
    ----------
    t : array (S,)
        The saved times.
    u : array (S, n) or (S, n, F)
        Values at this process's particles.
    rates : array (S, n) or (S, n, F), or None
        Their rates, of a problem of second order in time.
    points, numbers : array (n, D), (n,)
        Where these are, and their numbers in the whole cloud.
    flags : list of str
        What speaks against the run; the same on all processes.
    stats : dict
        Seconds, sizes, the solver of the last step.
    """

    def __init__(self, t: np.ndarray, u: np.ndarray, rates: Any, local: Any, flags: list[str], stats: dict[str, Any]):
        self.t, self.flags, self.stats = t, explained(flags), stats
        one = u.shape[-1] == 1
        self.u = u[..., 0] if one else u
        self.rates = rates if rates is None or not one else rates[..., 0]
        self._local = local

    def __repr__(self) -> str:
        return f"ParallelEvolution({len(self.t)} times, {self.u.shape[1]} of {self._local.mine.count} particles here)"


@collective
def evolve(
    problem: Problem, cloud: Cloud | ParallelCloud, u0: ValueOrFunction | tuple[ValueOrFunction, ValueOrFunction],
    t: tuple[float, float], *, steps: int | None = None, tol: float | None = None, order: int = 4, scheme: str = "auto",
    save: Any = None, damping: Any = "auto", depth: int | str = "auto", solver: str = "auto",
) -> ParallelEvolution:  # fmt: skip
    """Solve a problem in time by the steps of ``js.evolve``.

    Parameters
    ----------
    problem : Problem
        As for ``js.evolve``: of one field or several, linear or not, of first or second order in time. Incompressible
        flows, and what ``jp.solve`` refuses, are not made for several processes.
    cloud : Cloud or ParallelCloud
        As for ``jp.solve``.
    u0 : function, array_like or pair of them
        The values at the start: a function of x, a number, or (N,) or (N, F) of the whole cloud; of second order in
        time a pair, with the rates.
    t : pair of float
        The start and the end.
    steps : int, optional
        So many equal steps; or
    tol : float, optional
        As for ``js.evolve``.
    order, save, damping, depth : optional
        As for ``js.evolve``.
    scheme : {"auto", "esdirk", "imex", "euler"}
        As for ``js.evolve``; where that takes "radau" by itself this takes "esdirk".
    solver : {"auto", "hypre", "gamg", "mumps"}
        As for ``jp.solve``.

    Returns
    -------
    ParallelEvolution
        The states at the saved times.

    Raises
    ------
    ValueError
        For bad input, and what is not made for several processes, on all of them.
    SolveError
        Where the run cannot go on: a step whose system is not solved, a solution that blew up.

    Examples
    --------
    ``run = jp.evolve(heat, cloud, lambda x: 0.0 * x[0], (0.0, 1.0), steps=50, save=10)``
    """
    us, began = team(), time.perf_counter()
    with us.phase():
        if not is_one_of(scheme, SCHEMES):
            raise ValueError(f"scheme: {scheme!r} is none of {', '.join(map(repr, SCHEMES))}, which are made for "
                             f"several processes{did_you_mean(scheme, SCHEMES)}")  # fmt: skip
        refuse_others(problem, cloud, "S", "auto", solver)
        refuse_traced(u0, t)
        probe: Any = cloud.slab.cloud() if isinstance(cloud, ParallelCloud) else cloud
        check(problem, probe, t, steps, tol, order, scheme, True, False)
        t0, t1 = float(t[0]), float(t[1])
        parts = saved_times(save, t0, t1)
    slab = slab_of(us, cloud)
    settings = Settings("S", order, 0 if depth == "auto" else depth, None, True, "loo", True)
    local = TimedLocal(us, problem, bisected(us, slab), settings, t0)
    run = ParallelRun(local, u0, (t0, t1), began, scheme, damping, solver)
    made = time.perf_counter()
    count, wanted = None if steps is None else int(steps), None if tol is None else float(tol)
    with bar("steps in time", wanted=False) as shown:
        history, fault = marched(run, count, wanted, parts, shown)
    if fault:
        raise SolveError(f"the run stopped: {fault}")
    times = np.where(parts >= 1.0, t1, t0 + parts * (t1 - t0))
    states = history.at(times, history.states)
    rates = history.at(times, history.rates) if run.second else None
    later = history.part_in_time(history.in_time_at(times))
    if later is not None and later > LARGE:
        run.flags.append(f"The estimated error in time is {later:.0%} of the solution: take more steps, or a tol.")
    end, system = time.perf_counter(), run.semi.system
    assert isinstance(system, OwnSystem)
    stats = {
        "particles": local.mine.count, "own": len(local.halo.ids), "unknowns": local.size, "processes": us.size,
        "reach": local.halo.reach, "scheme": NAMES[run.name], "steps": run.counts["steps"],
        "rejected": run.counts["rejected"], "pencils": run.counts["pencils"],
        "iterations": run.newton.counts["iterations"] if run.newton else 0, "damping": run.damping,
        "error_in_time": later, "linear": system.info,
        "seconds": {"pencil": made - began, "steps": end - made, "total": end - began},
    }  # fmt: skip
    return ParallelEvolution(times, states, rates, local, run.flags, stats)
