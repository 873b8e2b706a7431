"""A problem with several regions prepared for many right-hand sides."""

from __future__ import annotations

import time
from copy import copy
from typing import Any

import numpy as np

from jsmitsm.discretization.leave_one_out import with_held
from jsmitsm.discretization.regions.layout import discretize_regions
from jsmitsm.discretization.regions.rows import RegionNumbers, region_numbers, whole_right_side, whole_table
from jsmitsm.equation.unknowns.extras import refuse_extras
from jsmitsm.runtime.errors import explaining
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.arguments import check, of_regions
from jsmitsm.solution.kept_matrix import KeptMatrix, refuse_nonlinear, refuse_other, same_matrix
from jsmitsm.solution.regions.run import RegionsRun
from jsmitsm.solution.regions.solution import RegionsSolution
from jsmitsm.solution.regions.solve import finished_regions, prepared_regions


class RegionsFactorization(KeptMatrix):
    """What ``js.Factorization`` is to one region: rows and factors kept while sources and conditions' values change.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> layers = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
    >>> k = {"a": 1.0, "b": 3.0}
    >>> flux = {name: lambda u, x, n, k=k[name]: k * n @ js.grad(u)(x) for name in k}
    >>> def heated(q):
    ...     pde = {
    ...         name: lambda u, x, k=k[name]: k * js.laplacian(u)(x) + q for name in k
    ...     }
    ...     return js.Problem(
    ...         pde, {"boundary": js.dirichlet(0.0), "a|b": js.interface(flux=flux)}
    ...     )
    >>> ready = js.factorize(heated(1.0), layers)
    >>> anew = js.solve(heated(8.0), layers)
    >>> bool(abs(ready.solve(heated(8.0)).u - anew.u).max() < 1e-12)
    True
    """

    def __init__(self, problem: Any, cloud: Any, **options: Any):
        self._options = options
        self._run = prepared_regions(problem, cloud, sources=True, **options)
        refuse_nonlinear(self._run.disc)
        self._nums = self._run.numbers()
        super().__init__(self._run.assembled(self._nums)[:3])

    @explaining
    @bar("solve")
    def solve(self, problem: Any) -> RegionsSolution:
        """The solution of a problem with the same operators; sources and values of conditions may differ.

        Parameters
        ----------
        problem : Problem
            What is solved.

        Returns
        -------
        RegionsSolution
            As ``js.solve`` gives it.

        Raises
        ------
        ValueError
            For another kind of operators or conditions.
        SolveError
            As ``js.solve`` does.
        """
        old = self._run.disc
        check(problem, old.cloud, "S", old.rec.order, None, None)
        of_regions(problem, old.cloud)
        refuse_extras(problem)
        disc = discretize_regions(problem, old.cloud, old.rec.order, old.rec.depth, whole_table(old), sources=True)
        if not np.array_equal(disc.held, old.held) or [p.disc.scheme for p in disc.parts] != [
            p.disc.scheme for p in old.parts
        ]:
            refuse_other()
        refuse_nonlinear(disc)
        disc.contrast, disc.squared = old.contrast, old.squared
        nums = region_numbers(disc)
        if not same_matrix(nums, self._nums):
            return RegionsFactorization(problem, old.cloud, **self._options).solve(problem)
        run = copy(self._run)  # the solution's own: what it says of itself must not change with the next
        run.disc, run.problem = disc, disc.problem
        run.messages, run.against, run.began = list(run.messages), list(run.against), time.perf_counter()
        return self._finish(run, nums)

    def _finish(self, run: RegionsRun, nums: RegionNumbers) -> RegionsSolution:
        right = whole_right_side(self._run.disc, nums, run.parts, run.bound)
        x, good = self._solved(run, right)
        values = with_held(run.disc, nums, x)  # type: ignore[arg-type]
        if not is_traced(values):
            run.nums, run.values = nums, np.asarray(values)
            good = bool(good) and bool(np.isfinite(run.values).all())
        return finished_regions(run, values, None, good, 1)

    def __repr__(self) -> str:
        disc = self._run.disc
        return f"Factorization({int((~disc.held).sum())} unknowns, regions={list(disc.cloud.regions)})"
