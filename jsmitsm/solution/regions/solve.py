"""Solve a problem with several regions."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from jsmitsm.discretization.regions.layout import discretize_regions
from jsmitsm.discretization.regions.rows import whole_table
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.arguments import check
from jsmitsm.solution.fit import Recipe
from jsmitsm.solution.nonlinear.newton import newton
from jsmitsm.solution.regions.fit import RegionsFit
from jsmitsm.solution.regions.run import RegionsRun
from jsmitsm.solution.regions.solution import RegionsSolution


def prepared_regions(
    problem: Any, cloud: Any, *, method: str = "S", order: int = 4, kernel: Any = None, stencils: Any = None,
    basis_terms: Any = None, formulation: str = "auto", solver: str = "auto", u0: Any = None, throw: bool = True,
    depth: Any = 0, kind: type[RegionsRun] = RegionsRun, sources: bool = False,
) -> RegionsRun:  # fmt: skip
    """Checked arguments of a solve, discretised; kind: of run that is made of them."""
    start = time.perf_counter()
    check(problem, cloud, method, order, kernel, stencils, formulation, solver, u0, throw, depth)
    if method != "S":
        raise ValueError(f'method: {method} is not made for clouds of several regions; use "S"')
    for name, value in (("kernel", kernel), ("basis_terms", basis_terms)):
        if value is not None:
            raise ValueError(f"{name}: not made for clouds of several regions; leave it out")
    near = None if stencils is None else np.asarray(stencils.indices)
    if near is not None and len(near) != len(cloud):
        raise ValueError(f"stencils: built for {len(near)} particles, the cloud has {len(cloud)}; build them again")
    if near is None and is_traced(cloud.points):
        raise ValueError(
            "stencils: the points are traced by a JAX transform, and neighbours are found on the host; build "
            "stencils = js.stencils(cloud, size=...) before the transform and pass stencils=stencils to solve"
        )
    disc = discretize_regions(problem, cloud, order, depth, near, sources=sources)
    run = kind(disc, solver, throw, near is None, formulation)
    run.began, run.seconds["set-up"] = start, time.perf_counter() - start
    if disc.held.all():
        raise ValueError("problem: every particle's value is held; nothing is left to solve for")
    return run


def solve_regions(problem: Any, cloud: Any, *, u0: Any = None, **options: Any) -> RegionsSolution:
    """The solution of a problem with several regions; options as those of ``js.solve``."""
    run = prepared_regions(problem, cloud, u0=u0, **options)
    if run.disc.linear:
        values, good = run.step(run.numbers())
        return finished_regions(run, values, None, good, 1)
    return finished_regions(run, *newton(run, u0))


def finished_regions(run: RegionsRun, values: Any, taylor: Any, good: Any, iterations: Any) -> RegionsSolution:
    """The solution of a run that ended with these values and expansions (None: a linear problem)."""
    disc = run.disc
    run.seconds["total"] = time.perf_counter() - run.began
    recipe = regions_recipe(run)
    fit = RegionsFit(disc.problem, disc.cloud, whole_table(disc), taylor, recipe)
    report = None if is_traced(values) else run
    return RegionsSolution(values, disc.cloud, recipe, fit, good, iterations, run.stats(), report=report)


def regions_recipe(run: RegionsRun) -> Recipe:
    rec = run.disc.rec
    return Recipe("S", rec.order, None, run.form, rec.fields, rec.depth, tuple(rec.orders))
