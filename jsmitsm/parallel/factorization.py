"""A problem that several processes prepared for many right-hand sides."""

from __future__ import annotations

import time
from copy import copy
from dataclasses import replace

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.discretization.layout import Discretization, discretize, table
from jsmitsm.discretization.leave_one_out import right_side
from jsmitsm.equation.problem import Problem
from jsmitsm.parallel.assembly import Piece, assembled, spread
from jsmitsm.parallel.distributed import ParallelCloud, bisected, slab_of
from jsmitsm.parallel.local import Local, Settings
from jsmitsm.parallel.shares import local_kernel, local_problem
from jsmitsm.parallel.solution import ParallelSolution
from jsmitsm.parallel.solving import check_asked, recipe
from jsmitsm.parallel.team import collective, team
from jsmitsm.particle.kernels import Kernel
from jsmitsm.solution.arguments import Depth
from jsmitsm.solution.kept_matrix import refuse_nonlinear, refuse_other, same_matrix


class ParallelFactorization:
    """A problem ready to be solved again; made by ``jp.factorize``.

    It keeps the halo, the neighbours, the rows and the solver with its hierarchy, as long as only the source and the
    values in the conditions change, and makes anew what else does.
    """

    def __init__(self, local: Local, solver: str):
        self._local, self._solver = local, solver
        self._pieces: list[Piece] = []
        self.system, _ = assembled(local.team, local, solver, kept=self._pieces)
        local.refuse_degenerate()

    @collective
    def solve(self, problem: Problem) -> ParallelSolution:
        """The solution of a problem with the same operator; source and values of conditions may differ.

        Parameters
        ----------
        problem : Problem
            What is solved.

        Returns
        -------
        ParallelSolution
            As ``jp.solve`` gives it.

        Raises
        ------
        ValueError
            For another kind of operator or conditions.
        SolveError
            As ``jp.solve`` does.

        Examples
        --------
        ``warmer = ready.solve(problem.replace(params=2.0))``
        """
        began, old, us = time.perf_counter(), self._local, self._local.team
        slab, settings = old.halo.slab, old.settings
        with us.phase(slab.number):
            kernel = settings.kernel and local_kernel(settings.kernel, slab)
            disc = discretize(
                local_problem(problem, slab), old.cloud, settings.method, settings.order, kernel,
                Stencils(table(old.disc), None), None, depth=old.disc.rec.depth, part=old.part,
            )  # fmt: skip
            if disc.scheme != old.disc.scheme or not np.array_equal(disc.held, old.disc.held):
                refuse_other()
            refuse_nonlinear(disc, "jp.solve")
        local = copy(old)
        local.problem, local.disc = problem, replace(disc, classes=old.disc.classes)
        with us.phase(slab.number):
            right = np.zeros(local.count)
            same = True
            for some, known, classes, rows in self._pieces:
                nums = local.numbers(replace(local.disc, classes=classes, part=some.part))
                same = same and same_matrix(nums, known)
                if same:
                    right[_places(local, some)] = np.asarray(right_side(some, nums, classes, rows))
        if not all(us.gather(same)):
            made = Local(us, problem, old.mine, settings)
            return ParallelFactorization(made, self._solver).solve(problem)
        x = self.system.solve(right)
        seconds = {"total": time.perf_counter() - began}
        return ParallelSolution(us, local, recipe(local), spread(local, x), self.system, seconds)

    def __repr__(self) -> str:
        return f"ParallelFactorization({self.system.size} unknowns, {self._local.count} of them here)"


def _places(local: Local, some: Discretization) -> np.ndarray:
    """Where the rows of some particles stand among the own."""
    unknowns = some.unknowns[some.active].reshape(-1)
    return local.place[unknowns[unknowns >= 0]] - local.first


@collective
def factorize(
    problem: Problem, cloud: Cloud | ParallelCloud, *, method: str = "S", order: int = 4, depth: Depth = "auto",
    kernel: Kernel | None = None, formulation: str = "auto", solver: str = "auto",
) -> ParallelFactorization:  # fmt: skip
    """Prepare a linear problem for many right-hand sides, as ``js.factorize`` does.

    Parameters
    ----------
    problem : Problem
        A linear one.
    cloud : Cloud or ParallelCloud
        Where it is solved.
    method, order, depth, kernel, formulation, solver : optional
        As for ``jp.solve``.

    Returns
    -------
    ParallelFactorization
        Its ``solve(problem)`` gives a solution.

    Raises
    ------
    ValueError
        For a nonlinear problem, whose matrix changes in every step, and as ``jp.solve``.

    Examples
    --------
    ``ready = jp.factorize(problem, cloud)``, then ``ready.solve(problem.replace(params=2.0))``.
    """
    us = team()
    with us.phase():
        check_asked(problem, cloud, method, order, depth, kernel, formulation, solver)
    mine, repair = bisected(us, slab_of(us, cloud)), kernel is None
    local = Local(us, problem, mine, Settings(method, order, depth, kernel, repair, formulation, True))
    with us.phase():
        if not local.disc.linear:
            raise ValueError("problem: it is nonlinear, so its matrix changes in every step; use jp.solve")
    return ParallelFactorization(local, solver)
