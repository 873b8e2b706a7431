"""Solve a problem with the processes that mpiexec started."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.regions.per_region import PerRegion
from jsmitsm.equation.unknowns.extras import refuse_extras
from jsmitsm.parallel.assembly import assembled, spread
from jsmitsm.parallel.distributed import ParallelCloud, bisected, slab_of
from jsmitsm.parallel.local import Local, Settings
from jsmitsm.parallel.newton import newton
from jsmitsm.parallel.solution import ParallelSolution
from jsmitsm.parallel.system import SOLVERS, ways
from jsmitsm.parallel.team import Team, collective, team
from jsmitsm.particle.kernels import Kernel
from jsmitsm.runtime.arrays import ValueOrFunction
from jsmitsm.runtime.errors import did_you_mean, is_one_of
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.arguments import Depth, check
from jsmitsm.solution.fit import Recipe


@collective
def solve(
    problem: Problem, cloud: Cloud | ParallelCloud, *, method: str = "S", order: int = 4, depth: Depth = "auto",
    kernel: Kernel | None = None, formulation: str = "auto", solver: str = "auto", u0: ValueOrFunction | None = None,
) -> ParallelSolution:  # fmt: skip
    """Solve ``problem`` on ``cloud``, whose particles the processes share.

    All processes call it together. The rows of the global system are those that ``js.solve`` makes, so that the
    solution agrees with that of one process to round-off times the condition of the system.

    Parameters
    ----------
    problem : Problem
        Of one field or several; a nonlinear one by Newton's damped steps. Not made for several processes: periodic
        pairs, several regions, constraints, unknowns, point sources, complex values, fields that only derivatives
        determine. All are refused by name.
    cloud : Cloud or ParallelCloud
        A Cloud that every process made alike, or what ``jp.read`` returned. In 2D or 3D.
    method : {"S", "III"}
        As in ``js.solve``.
    order, depth, kernel : optional
        As in ``js.solve``.
    formulation : {"auto", "loo"}
        "auto" refuses equations in which information travels, where ``js.solve`` takes least squares; in systems with
        a pressure it is "loo".
    solver : {"auto", "hypre", "gamg", "mumps"}
        "auto": for one field with an operator of second order algebraic multigrid, hypre's and then PETSc's, and what
        these do not solve directly; for all else directly.
    u0 : array_like or function, optional
        Start of Newton's method: a function of x, or the values (N,) or (N, F) of the whole cloud.

    Returns
    -------
    ParallelSolution
        Every process with the values of its own particles.

    Raises
    ------
    ValueError
        For bad input, and what is not made for several processes, on all of them.
    SolveError
        For systems that no solver brings to a backward error of 1e-12, and where Newton's damped steps do not
        converge, on all of them.

    Examples
    --------
    In ``script.py``, run as ``mpiexec -n 4 python script.py``::

        import jax
        jax.config.update("jax_enable_x64", True)
        import jsmitsm as js
        import jsmitsm.parallel as jp

        cloud = js.rectangle((0, 0), (1, 1), (201, 201), jitter=0.3)
        sides = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
        sol = jp.solve(js.Problem(lambda u, x: js.laplacian(u)(x) + 1.0, sides), cloud)
        largest = jp.norm(sol.u)
    """
    us = team()
    began = time.perf_counter()
    with us.phase():
        check_asked(problem, cloud, method, order, depth, kernel, formulation, solver)
        slab = slab_of(us, cloud)
    parted = bisected(us, slab)
    del slab
    with us.phase():
        if not len(parted):
            raise ValueError(f"cloud: no particles for process {us.rank} of {us.size}; start fewer processes")
    repair = kernel is None
    local = Local(us, problem, parted, Settings(method, order, depth, kernel, repair, formulation))
    return solved(us, local, solver, u0, began)


def solved(us: Team, local: Local, solver: str, u0: Any, began: float) -> ParallelSolution:
    """Rows, global system, values; of a nonlinear problem the last ones of Newton's method."""
    if not local.disc.linear:
        found = newton(us, local, solver, u0)
        seconds = {"local": found.seconds, "total": time.perf_counter() - began}
        sol = ParallelSolution(us, local, recipe(local), found.values, found.system, seconds)
        sol._linearised = found.taylor
        sol.iterations, sol.stats["changes"] = found.steps, found.changes
        return sol
    system, b = assembled(us, local, solver)
    put = time.perf_counter()
    values = spread(local, system.solve(b))
    local.refuse_contradictions(values)
    seconds = {"local": put - began, "solve": time.perf_counter() - put, "total": time.perf_counter() - began}
    return ParallelSolution(us, local, recipe(local), values, system, seconds)


def recipe(local: Local) -> Recipe:
    rec = local.disc.rec
    return Recipe(local.disc.scheme.method, rec.order, None, "loo", rec.fields, rec.depth, tuple(rec.orders))


def check_asked(
    problem: Any, cloud: Any, method: Any, order: Any, depth: Any, kernel: Any, form: Any, solver: Any
) -> None:
    """Refuse bad input, and in words what several processes do not make."""
    refuse_others(problem, cloud, method, form, solver)
    probe = cloud.slab.cloud() if isinstance(cloud, ParallelCloud) else cloud
    given = None if kernel is None or np.ndim(kernel.h) else kernel
    check(problem, probe, method, order, given, None, "auto", "auto", depth=depth)


def refuse_others(problem: Any, cloud: Any, method: Any, form: Any, solver: Any) -> None:
    """Refuse by name what several processes do not make."""
    if not isinstance(problem, Problem):
        raise ValueError(f"problem: expected a js.Problem, got {type(problem).__name__}")
    if isinstance(problem.pde, PerRegion):
        raise ValueError("problem: several regions are not made for several processes; use js.solve")
    refuse_extras(problem)
    refuse_traced(problem.params, getattr(cloud, "points", None))
    for value, known, name in ((method, ("S", "III"), "method"), (form, ("auto", "loo"), "formulation"),
                               (solver, SOLVERS, "solver")):  # fmt: skip
        if not is_one_of(value, known):
            raise ValueError(f"{name}: {value!r} is none of {', '.join(map(repr, known))}, which are made for several "
                             f"processes{did_you_mean(value, known)}")  # fmt: skip
    ways(solver, True)
    if getattr(cloud, "dim", 2) == 1:
        raise ValueError("cloud: one in 1D has no need of several processes; use js.solve")


def refuse_traced(*given: Any) -> None:
    """Refuse what a JAX transform traces: it sees one process alone."""
    if is_traced(given):
        raise ValueError(
            "problem: traced by a JAX transform, which cannot follow several processes; jp.value_and_grad has "
            "gradients of steady problems, js.evolve those in time"
        )
