"""Solve a boundary-value problem: the one verb of the package."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.discretization.coefficients import numbers
from jsmitsm.discretization.layout import discretize, table
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.unknowns.regular import regular_in_regions, regular_problem
from jsmitsm.equation.unknowns.stated import begun, stated
from jsmitsm.equation.unknowns.two_fields import two_fields, two_parts
from jsmitsm.linear.linsolve import Solver
from jsmitsm.particle.kernels import Kernel
from jsmitsm.runtime.arrays import ValueOrFunction
from jsmitsm.runtime.errors import explaining
from jsmitsm.runtime.progress import SOLVE, bar
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.arguments import Depth, Formulation, Method, check, of_regions
from jsmitsm.solution.fit import Fit, Recipe
from jsmitsm.solution.nonlinear.newton import newton
from jsmitsm.solution.order_choice import check_tolerance, of_tolerance
from jsmitsm.solution.regions.solve import prepared_regions, regions_recipe, solve_regions
from jsmitsm.solution.run import Run
from jsmitsm.solution.solution import Solution
from jsmitsm.solution.unknowns.bordered import BorderedRegionsRun, BorderedRun
from jsmitsm.solution.unknowns.complex_solution import complex_solution
from jsmitsm.solution.unknowns.constrained import solve_constrained
from jsmitsm.solution.unknowns.integral import IntegralTerm
from jsmitsm.solution.unknowns.point_solution import (
    PointSolution,
    RegionsPointSolution,
    check_inside,
    regions_of_sources,
)


@explaining
@bar("solve", parts=SOLVE)
def solve(
    problem: Problem,
    cloud: Cloud,
    *,
    method: Method = "S",
    order: int | Literal["auto"] = 4,
    tol: float | None = None,
    depth: Depth = "auto",
    kernel: Kernel | None = None,
    stencils: Stencils | None = None,
    basis_terms: int | None = None,
    formulation: Formulation = "auto",
    solver: Solver = "auto",
    u0: ValueOrFunction | Mapping[str, ValueOrFunction] | None = None,
    throw: bool = True,
) -> Solution:
    """Solve ``problem`` on ``cloud``.

    Parameters
    ----------
    problem : Problem
        What is solved.
    cloud : Cloud
        The particles it is solved on.
    method : {"S", "I", "II", "III", "SSPH"}
        "I", "II", "III" (SMITSM, Karamanli 2015), "SSPH", or "S", the recursion with symmetric moment rows.
    order : int or "auto"
        Total degree of the fit. "auto": the lowest even one from 4 whose estimated error is within ``tol``; where
        none is, the best one, with a flag that says so.
    tol : float, optional
        With ``order="auto"``, the wanted error relative to the largest |u|. The cloud stays as it is:
        ``js.adapt`` makes one that the tolerance needs.
    depth : int or "auto"
        Degrees by which the recursion goes beyond the order: the local polynomials have degree order + depth, with
        no more free coefficients. 0 is the paper's. "auto" is, for method S, 4 in 1D and 2D (2 at order 2), in 3D
        2, or 4 where the operator is constant and of one order; for I, II and III 0. SSPH has no recursion to go
        deeper with. The data have a word in it where the problem is linear: in 2D it is 2 where coefficients and
        source hardly turn within a support, and 6 from order 6 on where a constant operator or its source oscillates.
    kernel : Kernel, optional
        Weights and supports; chosen from the cloud, the order and the method if not given.
    stencils : Stencils, optional
        From ``js.stencils``; needed where JAX traces ``h``, ``d`` or the points.
    basis_terms : int, optional
        Keep only the first so many free coefficients (I, II, III).
    formulation : {"auto", "loo", "lsq"}
        "loo" (each value is predicted by its neighbours), "lsq" (least squares over all local fits) or "auto": "lsq"
        where information travels, and in systems with a pressure; else "loo". With several regions, region by region.
    solver : {"auto", "dense", "sparse", "mixed", "iterative"}
        "auto", "dense" (pure JAX), "sparse" (direct), "mixed" (direct, its factors in float32 and the rest in
        float64: two thirds of the time and memory) or "iterative".
    u0 : array_like, float or function, optional
        Start of Newton's method for a nonlinear problem: (N,), (N, F), a number or a function of x; with several
        regions also a dict of them by region.
    throw : bool
        Raise ``js.SolveError`` where the solve fails; otherwise, and always under jit, ``converged`` is
        False.

    Returns
    -------
    Solution
        Values, derivatives, integrals, error estimate.

    Raises
    ------
    ValueError
        For bad input, with the argument, what came, what was expected and what to do.
    SolveError
        For a singular or non-finite system, with the particles at fault.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> cloud = js.interval(0.0, 2.0, 20)
    >>> problem = js.Problem(
    ...     pde=lambda u, x: js.laplacian(u)(x) - x[0] ** 3,
    ...     bcs={"left": js.dirichlet(1.0), "right": js.dirichlet(6.6)},
    ... )
    >>> sol = js.solve(problem, cloud, order=5)
    >>> x = cloud.points[:, 0]
    >>> bool(abs(sol.u - (x**5 / 20 + 2 * x + 1)).max() < 1e-12)
    True
    """
    check_tolerance(order, tol)

    def solved(order: Any) -> Solution:
        if getattr(problem, "extras", None) is not None:
            return with_extras(
                problem, cloud, method=method, order=order, kernel=kernel, stencils=stencils, basis_terms=basis_terms,
                formulation=formulation, solver=solver, u0=u0, throw=throw, depth=depth,
            )  # fmt: skip
        if of_regions(problem, cloud):
            return solve_regions(
                problem, cloud, method=method, order=order, kernel=kernel, stencils=stencils, basis_terms=basis_terms,
                formulation=formulation, solver=solver, u0=u0, throw=throw, depth=depth,
            )  # fmt: skip
        run = prepared(
            problem, cloud, method=method, order=order, kernel=kernel, stencils=stencils, basis_terms=basis_terms,
            formulation=formulation, solver=solver, u0=u0, throw=throw, depth=depth,
        )  # fmt: skip
        if run.disc.linear:
            values, good = run.step(numbers(run.disc, problem))
            return finished(run, values, None, good, 1)
        return finished(run, *newton(run, u0))

    return of_tolerance(solved, tol) if order == "auto" and tol is not None else solved(order)


def prepared(
    problem: Problem, cloud: Cloud, *, method: str = "S", order: int = 4, kernel: Kernel | None = None,
    stencils: Stencils | None = None, basis_terms: int | None = None, formulation: str = "auto", solver: str = "auto",
    u0: Any = None, throw: bool = True, depth: Depth = "auto", kind: type[Run] = Run, sources: bool = False,
) -> Run:  # fmt: skip
    """Checked arguments of ``js.solve``, discretised; kind: of run that is made of them, sources: see discretize."""
    start = time.perf_counter()
    check(problem, cloud, method, order, kernel, stencils, formulation, solver, u0, throw, depth)
    disc = discretize(problem, cloud, method, order, kernel, stencils, basis_terms, sources=sources, depth=depth)
    problem = disc.problem
    run = kind(disc, problem, solver, throw, kernel is None and stencils is None, formulation)
    run.began, run.seconds["set-up"] = start, time.perf_counter() - start
    if not disc.classes:
        raise ValueError("problem: every particle's value is held; nothing is left to solve for")
    return run


def finished(run: Run, values: Any, taylor: Any, good: Any, iterations: Any) -> Solution:
    """The solution of a run that ended with these values and expansions (None: a linear problem)."""
    disc, recipe = run.disc, recipe_of(run)
    run.seconds["total"] = time.perf_counter() - run.began
    fit = Fit(run.problem, disc.cloud, disc.kernel, table(disc), taylor, recipe)
    report = None if is_traced(values) else run
    return Solution(values, disc.cloud, recipe, fit, good, iterations, run.stats(), report=report)


def recipe_of(run: Run) -> Recipe:
    rec = run.disc.rec
    return Recipe(
        run.disc.scheme.method, rec.order, run.disc.basis_terms, run.formulation, rec.fields, rec.depth,
        tuple(rec.orders),
    )  # fmt: skip


def with_extras(problem: Problem, cloud: Cloud, *, order: Any, otherwise: bool = False, **options: Any) -> Solution:
    """The solution of a problem with constraints, complex values or point sources; options as those of ``js.solve``.

    otherwise: whether integrals take the rule by which the error of the usual one is told.
    """
    assert problem.extras is not None
    several = of_regions(problem, cloud)
    if problem.extras.complex_values:
        if options["method"] not in ("S", "SSPH"):
            raise ValueError(f'method: {options["method"]} treats one real field; use "S" for dtype=complex')
        options["u0"] = two_parts(options["u0"], problem.fields)
        return complex_solution(solve(two_fields(problem), cloud, order=order, **options))
    if problem.extras.sources:
        if several:
            assert isinstance(cloud, RegionCloud)
            where = regions_of_sources(problem.extras.sources, cloud)
            made, parts = regular_in_regions(problem, cloud, where)
            return RegionsPointSolution.of(solve(made, cloud, order=order, **options), parts)  # type: ignore[arg-type]
        check_inside(problem.extras.sources, cloud)
        regular, singular = regular_problem(problem, cloud)
        return PointSolution.of(solve(regular, cloud, order=order, **options), singular)
    term = IntegralTerm(problem, cloud) if problem.extras.kernels else None
    plain = stated(problem, problem.extras.unknowns)
    run: Any
    if several:
        run = prepared_regions(plain, cloud, order=order, kind=BorderedRegionsRun, sources=term is not None, **options)
    else:
        run = prepared(plain, cloud, order=order, kind=BorderedRun, sources=term is not None, **options)
    if term is not None:
        run.term, run.whole = term, stated(problem, problem.extras.unknowns, term.points)

    def again(order: int, unknowns: Any, u0: Any) -> Any:
        other = {"method": "S", "depth": run.disc.rec.depth, "solver": options["solver"], "u0": u0}
        near = problem if u0 is None else problem.replace(unknowns=unknowns)
        return with_extras(near, cloud, order=order, otherwise=True, **other)._values

    recipe = replace(regions_recipe(run) if several else recipe_of(run), otherwise=otherwise)
    return solve_constrained(problem, run, recipe, again, begun(problem, options["u0"]))
