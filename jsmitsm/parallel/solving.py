"""Solve a problem with the processes that mpiexec started."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.discretization.leave_one_out import matrix, right_side, with_held
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.regions.per_region import PerRegion
from jsmitsm.equation.unknowns.extras import refuse_extras
from jsmitsm.parallel.distributed import ParallelCloud, bisected, slab_of
from jsmitsm.parallel.local import Local, Settings
from jsmitsm.parallel.solution import ParallelSolution
from jsmitsm.parallel.system import SOLVERS, System
from jsmitsm.parallel.team import Team, team
from jsmitsm.particle.kernels import Kernel
from jsmitsm.runtime.errors import did_you_mean, explaining
from jsmitsm.solution.arguments import Depth, check
from jsmitsm.solution.fit import Recipe


@explaining
def solve(
    problem: Problem, cloud: Cloud | ParallelCloud, *, method: str = "S", order: int = 4, depth: Depth = "auto",
    kernel: Kernel | None = None, formulation: str = "auto", solver: str = "auto",
) -> ParallelSolution:  # fmt: skip
    """Solve a linear ``problem`` on ``cloud``, whose particles the processes share.

    All processes call it together. The rows of the global system are those that ``js.solve`` makes, so that the
    solution agrees with that of one process to round-off times the condition of the system.

    Parameters
    ----------
    problem : Problem
        Linear, of one field or several. Not made for several processes: nonlinear problems, periodic pairs, several
        regions, constraints, unknowns, point sources, complex values, fields that only derivatives determine,
        degenerate equations. All are refused by name.
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

    Returns
    -------
    ParallelSolution
        Every process with the values of its own particles.

    Raises
    ------
    ValueError
        For bad input, and what is not made for several processes, on all of them.
    SolveError
        For systems that no solver brings to a backward error of 1e-12, on all of them.

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
        _check(problem, cloud, method, order, depth, kernel, formulation, solver)
        slab = slab_of(us, cloud)
    parted = bisected(us, slab)
    with us.phase():
        if not len(parted):
            raise ValueError(f"cloud: no particles for process {us.rank} of {us.size}; start fewer processes")
    repair = kernel is None
    local = Local(us, problem, parted, Settings(method, order, depth, kernel, repair, formulation))
    return solved(us, local, problem, slab, solver, began)


def solved(us: Team, local: Local, problem: Problem, slab: Any, solver: str, began: float) -> ParallelSolution:
    """Rows, global system, values."""
    with us.phase():
        if not local.disc.linear:
            raise ValueError("problem: nonlinear ones are not made for several processes; use js.solve")
    nums, classes, rows = local.rows()
    made = time.perf_counter()
    system, b = assembled(us, local, nums, classes, rows, solver)
    put = time.perf_counter()
    x = system.solve(b)
    done = time.perf_counter()
    values = spread(local, nums, x)
    seconds = {"local": made - began, "assembly": put - made, "solve": done - put}
    rec = local.disc.rec
    recipe = Recipe(
        local.disc.scheme.method, rec.order, None, "loo", rec.fields, rec.depth, tuple(rec.orders)
    )  # fmt: skip
    return ParallelSolution(us, local, recipe, values, nums, system, slab, seconds)


def assembled(us: Team, local: Local, nums: Any, classes: Any, rows: Any, solver: str) -> tuple[System, np.ndarray]:
    """The global system of the own rows, and the own part of its right-hand side."""
    with us.phase():
        own, number = numbered(us, local)
        data, r, c = matrix(local.disc, classes, rows)
        mine = own[r]
        b = right_side(local.disc, nums, classes, rows)
    rec = local.disc.rec
    elliptic = rec.fields == 1 and set(rec.orders) == {2}
    system = System(us, len(b), number[r[mine]], number[c[mine]], np.asarray(data)[mine], solver, elliptic)
    return system, np.asarray(b)


def numbered(us: Team, local: Local) -> tuple[np.ndarray, np.ndarray]:
    """Which of the local unknowns are the process's own, and the number of each among those of all processes."""
    unknown = local.disc.unknowns
    free = unknown >= 0
    own = free & local.halo.own[:, None]
    first = sum(us.gather(int(own.sum()))[: us.rank])
    number = np.full(unknown.shape, -1)
    number[own] = first + np.arange(own.sum())
    number = local.halo.spread(number)
    flat = np.zeros(int(free.sum()), bool), np.zeros(int(free.sum()), int)
    flat[0][unknown[free]], flat[1][unknown[free]] = own[free], number[free]
    return flat


def spread(local: Local, nums: Any, x: np.ndarray) -> np.ndarray:
    """The values (n, F) of all local particles from the own unknowns."""
    disc = local.disc
    whole = np.zeros(disc.held.shape)
    whole[~disc.held & local.halo.own[:, None]] = x
    whole = local.halo.spread(whole)
    return np.asarray(with_held(disc, nums, whole[~disc.held]))


def _check(problem: Any, cloud: Any, method: Any, order: Any, depth: Any, kernel: Any, form: Any, solver: Any) -> None:
    if not isinstance(problem, Problem):
        raise ValueError(f"problem: expected a js.Problem, got {type(problem).__name__}")
    if isinstance(problem.pde, PerRegion):
        raise ValueError("problem: several regions are not made for several processes; use js.solve")
    refuse_extras(problem)
    for value, known, name in ((method, ("S", "III"), "method"), (form, ("auto", "loo"), "formulation"),
                               (solver, SOLVERS, "solver")):  # fmt: skip
        if value not in known:
            raise ValueError(f"{name}: {value!r} is none of {', '.join(map(repr, known))}, which are made for several "
                             f"processes{did_you_mean(value, known)}")  # fmt: skip
    if getattr(cloud, "dim", 2) == 1:
        raise ValueError("cloud: one in 1D has no need of several processes; use js.solve")
    probe = cloud.slab.cloud() if isinstance(cloud, ParallelCloud) else cloud
    given = None if kernel is None or np.ndim(kernel.h) else kernel
    check(problem, probe, method, order, given, None, "auto", "auto", depth=depth)
