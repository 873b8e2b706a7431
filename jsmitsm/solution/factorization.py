"""A problem prepared for many right-hand sides: what a new source or new boundary values leave valid is kept."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.discretization.coefficients import Numbers, numbers
from jsmitsm.discretization.layout import Discretization, discretize, table
from jsmitsm.discretization.least_squares import least_squares_right_side
from jsmitsm.discretization.leave_one_out import right_side, with_held
from jsmitsm.equation.problem import Problem
from jsmitsm.linear.linsolve import Solver
from jsmitsm.particle.kernels import Kernel
from jsmitsm.runtime.errors import explaining
from jsmitsm.runtime.progress import SOLVE, bar
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.arguments import Depth, Formulation, Method, check, discretized, of_regions
from jsmitsm.solution.fit import Fit, Recipe
from jsmitsm.solution.kept_matrix import KeptMatrix, refuse_nonlinear, refuse_other, same_matrix
from jsmitsm.solution.regions.factorization import RegionsFactorization
from jsmitsm.solution.run import Run
from jsmitsm.solution.solution import Solution


class Factorization(KeptMatrix):
    """A problem ready to be solved again; made by ``js.factorize``.

    It keeps the neighbours, the rows and the factors as long as only the source and the values in the
    conditions changed, and makes anew what else did.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> js.factorize(
    ...     js.Problem(lambda u, x: js.laplacian(u)(x) + 1.0, ends),
    ...     js.interval(0.0, 1.0, 11),
    ... )
    Factorization(9 unknowns, method='S')
    """

    def __init__(self, disc: Discretization, problem: Problem, solver: str, repair: bool, formulation: str):
        self._disc, self._options = disc, (solver, repair, formulation)
        problem = disc.problem
        self._run = Run(disc, problem, solver, True, repair, formulation)
        self._nums = numbers(disc, problem)
        self._parts: list[Any] = []  # of the least-squares form
        *matrix, self._right = self._run.assembled(self._nums, self._parts)
        super().__init__(tuple(matrix))

    @explaining
    @bar("solve")
    def solve(self, problem: Problem) -> Solution:
        """The solution of a problem with the same operator; source and boundary values may differ.

        Parameters
        ----------
        problem : Problem
            What is solved.

        Returns
        -------
        Solution
            As ``js.solve`` gives it.

        Raises
        ------
        ValueError
            For another kind of operator or conditions.
        SolveError
            As ``js.solve`` does.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> heated = lambda q: js.Problem(lambda u, x: js.laplacian(u)(x) + q, ends)
        >>> ready = js.factorize(heated(1.0), js.interval(0.0, 1.0, 11))
        >>> round(float(ready.solve(heated(8.0)).u[5]), 10)
        1.0
        """
        old = self._disc
        method, order, kernel = old.scheme.method, old.rec.order, old.kernel
        check(problem, old.cloud, method, order, kernel, None)
        disc = discretize(
            problem, old.cloud, method, order, kernel, Stencils(table(old), None), old.basis_terms,
            depth=old.rec.depth,
        )
        alike = replace(disc.scheme, carried=old.scheme.carried)  # convection may be stronger now
        if alike != old.scheme or not np.array_equal(disc.held, old.held):
            refuse_other()
        refuse_nonlinear(disc)
        problem = disc.problem
        nums = numbers(disc, problem)
        if not same_matrix(nums, self._nums) or disc.scheme.method in ("I", "II"):
            made = Factorization(disc, problem, *self._options)
            return made._finish(problem, made._nums, made._right)
        return self._finish(problem, nums, self._right_side(nums))

    def _right_side(self, nums: Numbers) -> Any:
        if self._run.formulation == "lsq":
            return least_squares_right_side(self._disc, nums, self._parts)
        assert self._run.rows is not None
        return right_side(self._disc, nums, *self._run.rows)

    def _finish(self, problem: Problem, nums: Numbers, right: Any) -> Solution:
        disc = self._disc
        run = copy(self._run)  # the solution's own: what it says of itself must not change with the next
        run.problem, run.messages, run.against = problem, list(run.messages), list(run.against)
        x, good = self._solved(run, right)
        values = with_held(disc, nums, x)
        traced = is_traced(values)
        if not traced:
            run.keep(nums, np.asarray(values))
            good = good and not run.failed
        rec = disc.rec
        recipe = Recipe(
            disc.scheme.method, rec.order, disc.basis_terms, run.formulation, problem.fields, rec.depth,
            tuple(rec.orders),
        )  # fmt: skip
        fit = Fit(problem, disc.cloud, disc.kernel, table(disc), None, recipe)
        fine = jnp.isfinite(values).all() if traced else good
        return Solution(values, disc.cloud, recipe, fit, fine, 1, run.stats(), report=None if traced else run)

    def __repr__(self) -> str:
        return f"Factorization({int((~self._disc.held).sum())} unknowns, method={self._disc.scheme.method!r})"


@explaining
@bar("factorize", parts=SOLVE)
def factorize(
    problem: Problem, cloud: Cloud, *, method: Method = "S", order: int = 4, kernel: Kernel | None = None,
    stencils: Stencils | None = None, basis_terms: int | None = None, formulation: Formulation = "auto",
    solver: Solver = "auto", depth: Depth = "auto",
) -> Factorization | RegionsFactorization:  # fmt: skip
    """Prepare a linear problem for many right-hand sides.

    What a change of the source or of the values in the conditions leaves valid is kept: neighbours, moment
    systems, ordering and factors.

    Parameters
    ----------
    problem : Problem
        A linear one.
    cloud : Cloud
        Where it is solved.
    method, order, kernel, stencils, basis_terms, formulation, solver, depth : optional
        As for ``js.solve``.

    Returns
    -------
    Factorization
        Its ``solve(problem)`` gives a solution.

    Raises
    ------
    ValueError
        For a nonlinear problem: its matrix changes in every step.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> cloud = js.interval(0.0, 1.0, 11)
    >>> def heated(q):
    ...     ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    ...     return js.Problem(lambda u, x: js.laplacian(u)(x) + q, ends)
    >>> ready = js.factorize(heated(1.0), cloud)
    >>> round(float(ready.solve(heated(8.0)).u[5]), 10)
    1.0
    """
    if of_regions(problem, cloud):
        return RegionsFactorization(
            problem, cloud, method=method, order=order, kernel=kernel, stencils=stencils, basis_terms=basis_terms,
            formulation=formulation, solver=solver, depth=depth,
        )  # fmt: skip
    disc = discretized(problem, cloud, method, order, kernel, stencils, basis_terms, formulation, solver, depth)
    refuse_nonlinear(disc)
    return Factorization(disc, problem, solver, kernel is None and stencils is None, formulation)
