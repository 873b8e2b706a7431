"""Heat and its kin on several processes: the implicit steps of ``js.evolve`` on the pencil that they share."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.problem import Problem
from jsmitsm.evolution.arguments import check, saved_times, starting_values
from jsmitsm.evolution.space.convection import refuse_convection
from jsmitsm.evolution.space.semidiscrete import Driver, Semidiscrete
from jsmitsm.evolution.space.timed import Timed, timed
from jsmitsm.evolution.steps import dense_output
from jsmitsm.evolution.steps.stepping import Stepper
from jsmitsm.evolution.steps.tableaux import EULER, KENCARP4
from jsmitsm.parallel.distributed import ParallelCloud, Slab, bisected, slab_of
from jsmitsm.parallel.local import Local, OfOwn, Settings
from jsmitsm.parallel.pencil.assemble import own_rows, pencil_of_part
from jsmitsm.parallel.shares import local_problem
from jsmitsm.parallel.solving import refuse_others
from jsmitsm.parallel.system import System, product
from jsmitsm.parallel.team import Team, team
from jsmitsm.runtime.arrays import ValueOrFunction
from jsmitsm.runtime.errors import did_you_mean, explaining

# Schemes that are made for several processes.
SCHEMES = {"auto": KENCARP4, "esdirk": KENCARP4, "euler": EULER}
# A start may differ from what is held by this part of its size; the step, in those of the run, of an impulse.
ROUND_OFF, SMALL = 1e-13, 1e-7


class ParallelEvolution(OfOwn):
    """A run of which every process has its own particles' part.

    Attributes
    ----------
    t : array (S,)
        The saved times.
    u : array (S, n)
        Values at this process's particles.
    points, numbers : array (n, D), (n,)
        Where these are, and their numbers in the whole cloud.
    flags : list of str
        What speaks against the run; the same on all processes.
    stats : dict
        Seconds, sizes, the solver of the last step.
    """

    def __init__(self, t: np.ndarray, u: np.ndarray, local: Local, flags: list[str], stats: dict[str, Any]):
        self.t, self.u, self.flags, self.stats = t, u, flags, stats
        self._local = local

    def __repr__(self) -> str:
        return f"ParallelEvolution({len(self.t)} times, {self.u.shape[1]} of {self._local.mine.count} particles here)"


class _TimedLocal(Local):
    """A part of a problem in time, at the moment t0: what is discretised is its operator in space."""

    def __init__(self, us: Team, problem: Problem, mine: Slab, settings: Settings, t0: float):
        self.t0 = t0
        super().__init__(us, problem, mine, settings)

    def _localised(self, slab: Slab, cloud: Cloud) -> Problem:
        self.timed = timed(local_problem(self.problem, slab), cloud)
        _refuse(self.timed)
        return self.timed.at(np.asarray(self.t0))


@explaining
def evolve(
    problem: Problem, cloud: Cloud | ParallelCloud, u0: ValueOrFunction, t: tuple[float, float], *, steps: int,
    order: int = 4, scheme: str = "auto", save: Any = None, depth: int | str = "auto", solver: str = "auto",
) -> ParallelEvolution:  # fmt: skip
    """Solve a linear problem of one field, of first order in time, by the steps of ``js.evolve``.

    Parameters
    ----------
    problem : Problem
        As for ``js.evolve``: of one field, linear. Nonlinear ones, systems, second order in time, and what ``jp.solve``
        refuses are not made for several processes.
    cloud : Cloud or ParallelCloud
        As for ``jp.solve``.
    u0 : function or array_like
        The values at the start: a function of x, a number, or (N,) of the whole cloud.
    t : pair of float
        The start and the end.
    steps : int
        So many equal steps.
    order, save, depth : optional
        As for ``js.evolve``.
    scheme : {"auto", "esdirk", "euler"}
        "auto" is "esdirk", at order 6 and above too, where ``js.evolve`` takes "radau".
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
        For a step whose system is not solved.

    Examples
    --------
    ``run = jp.evolve(heat, cloud, lambda x: 0.0 * x[0], (0.0, 1.0), steps=50, save=10)``
    """
    us, began = team(), time.perf_counter()
    with us.phase():
        if scheme not in SCHEMES:
            raise ValueError(f"scheme: {scheme!r} is none of {', '.join(map(repr, SCHEMES))}, which are made for "
                             f"several processes{did_you_mean(scheme, tuple(SCHEMES))}")  # fmt: skip
        refuse_others(problem, cloud, "S", "auto", solver)
        probe: Any = cloud.slab.cloud() if isinstance(cloud, ParallelCloud) else cloud
        check(problem, probe, t, steps, None, order, scheme, True, False)
        t0, t1 = float(t[0]), float(t[1])
        parts = saved_times(save, t0, t1)
    slab = slab_of(us, cloud)
    settings = Settings("S", order, 0 if depth == "auto" else depth, None, True, "loo", True)
    local = _TimedLocal(us, problem, bisected(us, slab), settings, t0)
    massed = np.ones(1, bool)
    pencil = pencil_of_part(local, massed)
    with us.phase():
        semi = Semidiscrete(local.timed, pencil, local.timed.problem.params[1])
        flags: list[str] = []
        refuse_convection(semi, flags)
        start = _start(local, u0)
    run = _Run(us, local, semi, solver, SCHEMES[scheme])
    made = time.perf_counter()
    u = run.states(start, np.linspace(t0, t1, steps + 1), parts)
    end = time.perf_counter()
    stats = {
        "particles": local.mine.count, "own": len(local.halo.ids), "unknowns": local.size, "processes": us.size,
        "reach": local.halo.reach, "scheme": "backward Euler" if scheme == "euler" else "KenCarp4", "steps": steps,
        "linear": run.system.info, "seconds": {"pencil": made - began, "steps": end - made, "total": end - began},
    }  # fmt: skip
    told = sorted({flag for some in us.gather(flags) for flag in some})
    return ParallelEvolution(np.where(parts >= 1.0, t1, t0 + parts * (t1 - t0)), u, local, told, stats)


def _refuse(made: Timed) -> None:
    """What of time is not made for several processes, by name."""
    what = ""
    if made.flow is not None or made.problem.fields > 1:
        what = "systems in time"
    elif made.masses[1].slots:
        what = "problems of second order in time"
    elif not made.linear or made.quasilinear:
        what = "nonlinear problems in time, and operators that depend on t,"
    if what:
        raise ValueError(f"problem: {what} are not made for several processes; use js.evolve")


def _start(local: Local, u0: Any) -> np.ndarray:
    """The values (n,) of all local particles at the start."""
    slab = local.halo.slab
    if not callable(u0) and np.ndim(u0):
        if np.shape(u0) != (slab.count,):
            raise ValueError(f"u0: shape {np.shape(u0)}, expected a function of x, a number or ({slab.count},)")
        u0 = np.asarray(u0)[slab.number]
    return np.asarray(starting_values(u0, local.cloud, 1, False)[0])[:, 0]


class _Run:
    """One run: what drives its steps, cut to the own free values."""

    def __init__(self, us: Team, local: Local, semi: Semidiscrete, solver: str, scheme: Any):
        self.us, self.local, self.semi = us, local, semi
        self.rows = np.flatnonzero(local.halo.own[semi.free])  # those of the own among all local free values
        self.system = _System(us, local, semi, solver)
        self.drive = Driver(semi, scheme.sampling(True))
        self.stepper = Stepper(self.system, self, scheme)  # type: ignore[arg-type]

    def start(self, t: float) -> tuple[Any, Any, Any]:
        force, held, known = self.drive.start(t)
        return force[self.rows], held[self.rows], known

    def step(self, t: float, h: float) -> tuple[Any, Any, Any]:
        force, held, known = self.drive.step(t, h)
        return force[:, self.rows], held[:, self.rows], known

    def states(self, start: np.ndarray, times: np.ndarray, parts: np.ndarray) -> np.ndarray:
        """The values (S, n) of the own particles at parts of the whole time."""
        h = float(times[-1] - times[0]) / (len(times) - 1)
        index, weights = dense_output.weights(np.linspace(0.0, 1.0, len(times)), parts)
        kept: dict[int, np.ndarray] = {}
        y = self._begun(start, float(times[0]), h)
        with self.us.phase():
            self.drive.plan(times[:-1], h)
        step = self.stepper.first(y, float(times[0]))
        for k in range(len(times)):
            if k:
                step = self.stepper.advance(step, float(times[k - 1]), h)
            if (index == k).any():
                kept[k] = self._placed(step)
        return np.stack([
            sum(a * kept[i] for a, i in zip(some, at)) for some, at in zip(weights, index)  # type: ignore[misc]
        ])  # fmt: skip

    def _placed(self, step: Any) -> np.ndarray:
        """The values (n,) of the own particles in a state."""
        whole = np.zeros(len(self.local.halo))
        whole[self.semi.held] = step.known
        whole[self.semi.free[self.rows]] = step.y
        return whole[self.local.halo.ids]

    def _begun(self, start: np.ndarray, t0: float, h: float) -> np.ndarray:
        """The state at the start: the impulse of one that contradicts the conditions; see ``march.started``."""
        us, semi, system = self.us, self.semi, self.system
        with us.phase():
            y = start[semi.free[self.rows]]
            force, held, known = self.start(t0)
            jump = (semi.masses_held[-1].host @ start[semi.held])[self.rows] - held
            gap = float(np.abs(start[semi.held] - np.asarray(known)).max(initial=0.0))
        scale = us.most(float(np.abs(start).max(initial=0.0)))
        entries = us.total(int(semi.masses_held[-1].values.size))
        if us.most(gap) <= ROUND_OFF * scale or not entries:
            return y
        if us.total(int(system.undriven().any())):
            return system.resolvent(SMALL * h).solve(system.mass(y) + jump + SMALL * h * force)
        return y + system.resolvent(0.0).solve(jump)


class _System:
    """E y' + A y = F(t) of the free values of all processes; see ``jsmitsm.evolution.space.system``."""

    def __init__(self, us: Team, local: Local, semi: Semidiscrete, solver: str):
        self.us, self.solver = us, solver
        self.stiffness, self.masses = (own_rows(local, m) for m in (semi.system.stiffness, semi.system.masses[0]))
        self._still = np.diff(self.masses.getValuesCSR()[0]) == 0
        self._resolvents: dict[float, System] = {}

    @property
    def info(self) -> dict[str, Any]:
        """Of the last resolvent."""
        return next(reversed(self._resolvents.values())).info if self._resolvents else {}

    def mass(self, y: np.ndarray) -> np.ndarray:
        return product(self.masses, y)

    def stiff(self, y: np.ndarray) -> np.ndarray:
        return product(self.stiffness, y)

    def undriven(self) -> np.ndarray:
        return self._still

    def resolvent(self, h: float) -> System:
        """The inverse of E + h A, its hierarchy or factors kept."""
        if h not in self._resolvents:
            whole = self.masses.copy()
            whole.axpy(h, self.stiffness)
            self._resolvents[h] = System(self.us, whole, self.solver, True)
        return self._resolvents[h]
