"""Solve a boundary-value problem: the one verb of the package."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm import discretize as dz
from jsmitsm import linsolve
from jsmitsm.boundary import is_traced
from jsmitsm.clouds import Cloud
from jsmitsm.discretize import Discretization, Numbers
from jsmitsm.errors import SolveError
from jsmitsm.kernels import Kernel
from jsmitsm.neighbours import Stencils
from jsmitsm.problem import Problem
from jsmitsm.solution import Recipe, Solution

METHODS = ("I", "II", "III", "S", "SSPH")
SOLVERS = ("auto", "dense", "sparse", "iterative")


@jax.tree_util.register_pytree_node_class
class Fit:
    """What it takes to fit the local polynomials of a solution again."""

    def __init__(self, problem, cloud, kernel, neighbours, taylor, recipe, ids):
        self.problem, self.cloud, self.kernel = problem, cloud, kernel
        self.neighbours, self.taylor = neighbours, taylor
        self.recipe, self.ids = recipe, ids

    def coefficients(self, values: Any) -> Any:
        """Taylor coefficients (N, F, K) of every particle."""
        disc = dz.discretize(
            self.problem, self.cloud, self.recipe.method, self.recipe.order, self.kernel,
            Stencils(self.neighbours, None), self.recipe.basis_terms,
        )  # fmt: skip
        disc.classes = dz.sorted_classes(disc, np.arange(len(self.cloud)), Stencils(self.neighbours, None))
        nums = dz.numbers(disc, self.problem, self.taylor, everywhere=True)
        return fit_all(disc, nums, values)

    def tree_flatten(self):
        return (self.problem, self.cloud, self.kernel, self.neighbours, self.taylor), (self.recipe, self.ids)

    @classmethod
    def tree_unflatten(cls, aux, leaves):
        return cls(*leaves, *aux)


def fit_all(disc: Discretization, nums: Numbers, values: Any) -> Any:
    """Taylor coefficients (N, F, K) of the particles of all classes."""
    shared = dz.shared_elimination(disc, nums)
    parts = [dz.class_coefficients(disc, nums, c, shared, values) for c in disc.classes]
    ids = np.concatenate([c.ids for c in disc.classes])
    xp = jnp if is_traced(parts) else np
    out = xp.concatenate([xp.asarray(p) for p in parts])[np.argsort(ids)]
    if len(ids) == len(disc.cloud):
        return out
    place = np.searchsorted(np.sort(ids), np.arange(len(disc.cloud)))
    return out[np.minimum(place, len(ids) - 1)]


def solve(
    problem: Problem,
    cloud: Cloud,
    *,
    method: str = "S",
    order: int = 4,
    kernel: Kernel | None = None,
    stencils: Stencils | None = None,
    basis_terms: int | None = None,
    formulation: str = "auto",
    solver: str = "auto",
    u0: Any = None,
    throw: bool = True,
) -> Solution:
    """Solve ``problem`` on ``cloud``.

    Parameters
    ----------
    method : "I", "II", "III" (SMITSM, Karamanli 2015), "SSPH", or "S", the recursion with
        symmetric moment rows.
    order : total degree of the local Taylor expansions.
    kernel : weights and supports; chosen from the cloud, the order and the method if not given.
    stencils : from :func:`jsmitsm.stencils`; needed where JAX traces ``h``, ``d`` or the points.
    basis_terms : keep only the first so many free coefficients (I, II, III).
    formulation : "loo" (each value is predicted by its neighbours), "lsq" (least squares over
        all local fits) or "auto".
    solver : "auto", "dense" (pure JAX), "sparse" (direct) or "iterative".
    u0 : start of Newton's method for a nonlinear problem: (N,), (N, F) or a function of x.
    throw : raise :class:`jsmitsm.SolveError` where the solve fails; otherwise, and always under
        jit, ``converged`` is False.

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
    >>> bool(abs(sol.u - (cloud.points[:, 0] ** 5 / 20 + 2 * cloud.points[:, 0] + 1)).max() < 1e-12)
    True
    """
    start = time.perf_counter()
    _check(problem, cloud, method, order, kernel, stencils, formulation, solver)
    disc = dz.discretize(problem, cloud, method, order, kernel, stencils, basis_terms)
    recipe = Recipe(method, order, basis_terms, formulation, problem.fields)
    stats: dict[str, Any] = {"seconds": {"set-up": time.perf_counter() - start}, "messages": [], "skipped": []}
    if disc.traced.linear and all(g.linear for g in disc.groups):
        nums = dz.numbers(disc, problem)
        values, good = _linear_step(disc, nums, solver, stats, throw)
        taylor, iterations = None, 1
    else:
        raise NotImplementedError
    neighbours = _all_neighbours(disc, cloud)
    fit = Fit(problem, cloud, kernel, neighbours, taylor, recipe, None)
    stats["seconds"]["total"] = time.perf_counter() - start
    return Solution(values, cloud, recipe, fit, good, iterations, stats)


def _all_neighbours(disc, cloud):
    return disc.stencils.indices


def _linear_step(disc: Discretization, nums: Numbers, solver: str, stats: dict, throw: bool) -> tuple[Any, Any]:
    """Assemble and solve one linear system: values (N, F) and whether it went well."""
    clock = time.perf_counter
    t0 = clock()
    classes, rows = dz.all_rows(disc, nums)
    t1 = clock()
    data, r, c = dz.matrix(disc, classes, rows)
    b = dz.right_side(disc, nums, classes, rows)
    t2 = clock()
    info: dict[str, Any] = {}
    x = linsolve.solve(data, r, c, b, n=b.shape[0], solver=solver, info=info)
    stats["seconds"].update({"local": t1 - t0, "assembly": t2 - t1, "solve": clock() - t2})
    stats["linear"] = info
    values = dz.with_held(disc, nums, x)
    good = jnp.isfinite(values).all() if is_traced(values) else bool(np.isfinite(values).all())
    return values, good


def _check(problem, cloud, method, order, kernel, stencils, formulation, solver) -> None:
    """Arguments of :func:`solve` that can be judged before any work."""
    for value, kind, name in ((problem, Problem, "problem"), (cloud, Cloud, "cloud")):
        if not isinstance(value, kind):
            raise ValueError(f"{name}: expected a js.{kind.__name__}, got {type(value).__name__}")
    if kernel is not None and not isinstance(kernel, Kernel):
        raise ValueError(
            f"kernel: expected a kernel such as js.SuperGaussian(h, d), got {kernel!r}; wrap your own with js.Kernel"
        )
    if stencils is not None and not isinstance(stencils, Stencils):
        raise ValueError(f"stencils: expected js.stencils(cloud, size=...), got {type(stencils).__name__}")
    for value, known, name in (
        (method, METHODS, "method"), (formulation, ("auto", "loo", "lsq"), "formulation"), (solver, SOLVERS, "solver")
    ):  # fmt: skip
        if value not in known:
            raise ValueError(f"{name}: {value!r} is none of {', '.join(map(repr, known))}")
    if isinstance(order, bool) or not isinstance(order, (int, np.integer)) or not 1 <= order <= 12:
        raise ValueError(f"order: expected a whole number from 1 to 12, the degree of the expansions, got {order!r}")
