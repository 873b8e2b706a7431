"""Solve a boundary-value problem: the one verb of the package."""

from __future__ import annotations

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm import discretize as dz
from jsmitsm.clouds import Cloud
from jsmitsm.discretize import Discretization
from jsmitsm.kernels import Kernel
from jsmitsm.linsolve import SOLVERS
from jsmitsm.neighbours import Stencils
from jsmitsm.newton import newton
from jsmitsm.problem import Problem
from jsmitsm.progress import bar
from jsmitsm.solution import Recipe, Solution
from jsmitsm.system import Run
from jsmitsm.taylor import HIGHEST
from jsmitsm.tracers import is_traced

METHODS = ("I", "II", "III", "S", "SSPH")


@jax.tree_util.register_pytree_node_class
class Fit:
    """What it takes to fit the local polynomials of a solution again.

    taylor : (N, F, K) the expansions about which a nonlinear problem was last linearised, or None.
    """

    def __init__(self, problem, cloud, kernel, neighbours, taylor, recipe):
        self.problem, self.cloud, self.kernel = problem, cloud, kernel
        self.neighbours, self.taylor = neighbours, taylor
        self.recipe = recipe

    def discretization(self) -> Discretization:
        near = Stencils(self.neighbours, None)
        r = self.recipe
        return dz.discretize(self.problem, self.cloud, r.method, r.order, self.kernel, near, r.basis_terms)

    @bar("fitting")
    def coefficients(self, values: Any) -> Any:
        """Taylor coefficients (N, F, K) of every particle."""
        disc, taylor = self.discretization(), self.taylor
        held = dz.held_particles(disc)
        if taylor is not None and len(held):
            # Those of held particles are continued from others; fitted where that is linearised they are their own.
            alone = np.isin(disc.partner, held)[:, None, None]
            fitted = self._fitted(disc, held, taylor, values)
            taylor = (jnp if is_traced(fitted, taylor) else np).where(alone, fitted, taylor)
        return self._fitted(disc, np.flatnonzero(disc.partner == np.arange(len(self.cloud))), taylor, values)

    def _fitted(self, disc: Discretization, ids: np.ndarray, taylor: Any, values: Any) -> Any:
        """Taylor coefficients (N, F, K) of the particles ``ids`` alone, linearised at ``taylor``."""
        disc.classes = dz.sorted_classes(disc, ids, disc.stencils)
        nums = dz.numbers(disc, self.problem, taylor, everywhere=True)
        return dz.all_coefficients(disc, nums, values)

    def tree_flatten(self):
        return (self.problem, self.cloud, self.kernel, self.neighbours, self.taylor), self.recipe

    @classmethod
    def tree_unflatten(cls, recipe, leaves):
        return cls(*leaves, recipe)


@bar("solve")
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
    solver : "auto", "dense" (pure JAX), "sparse" (direct), "mixed" (direct, its factors in float32
        and the rest in float64: two thirds of the time and memory) or "iterative".
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
    check(problem, cloud, method, order, kernel, stencils, formulation, solver, u0, throw)
    disc = dz.discretize(problem, cloud, method, order, kernel, stencils, basis_terms, sources=False)
    problem = disc.problem
    run = Run(disc, problem, solver, throw, kernel is None and stencils is None, formulation)
    run.seconds["set-up"] = time.perf_counter() - start
    if not disc.classes:
        raise ValueError("problem: every particle's value is held; nothing is left to solve for")
    if disc.linear:
        nums = dz.numbers(disc, problem)
        values, good = run.step(nums)
        taylor, iterations = None, 1
    else:
        values, taylor, good, iterations = newton(run, u0)
    run.seconds["total"] = time.perf_counter() - start
    recipe = Recipe(method, order, basis_terms, run.formulation, problem.fields)
    fit = Fit(problem, cloud, disc.kernel, dz.table(disc), taylor, recipe)
    report = None if is_traced(values) else run
    return Solution(values, cloud, recipe, fit, good, iterations, run.stats(), report=report)


def discretized(
    problem: Problem, cloud: Cloud, method: str = "S", order: int = 4, kernel: Kernel | None = None,
    stencils: Stencils | None = None, basis_terms: int | None = None, formulation: str = "auto", solver: str = "auto",
) -> Discretization:  # fmt: skip
    """Checked arguments, discretised."""
    check(problem, cloud, method, order, kernel, stencils, formulation, solver)
    return dz.discretize(problem, cloud, method, order, kernel, stencils, basis_terms)


def check(
    problem, cloud, method, order, kernel, stencils, formulation="auto", solver="auto", u0=None, throw=True
) -> None:
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
    if formulation == "lsq" and method != "S":
        raise ValueError(f'formulation: "lsq" is a form of method S, not of {method!r}; use method="S" or "loo"')
    if stencils is not None and any(c.kind == "periodic" for cs in problem.bcs.values() for c in cs):
        raise ValueError("stencils: those of a cloud do not reach periodic images; leave stencils out")
    if not isinstance(throw, (bool, np.bool_)):
        raise ValueError(f"throw: expected True or False, got {throw!r}")
    _check_start(u0, (len(cloud), problem.fields))
    if isinstance(order, bool) or not isinstance(order, (int, np.integer)) or not 1 <= order <= HIGHEST:
        raise ValueError(
            f"order: expected a whole number from 1 to {HIGHEST}, the degree of the expansions, got {order!r}"
        )


def _check_start(u0: Any, shape: tuple[int, int]) -> None:
    """A start for Newton's method: nothing, a function, or finite values of the right shape."""
    if u0 is None or callable(u0) or is_traced(u0):
        return
    try:
        if np.iscomplexobj(u0):
            raise TypeError
        values = np.asarray(u0, float)
    except (TypeError, ValueError):
        raise ValueError(f"u0: expected a function of x or an array, got {u0!r}") from None
    if values.shape not in (shape, shape[:1]):
        raise ValueError(f"u0: expected a function, ({shape[0]},) or {shape}, got shape {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError("u0: NaN or infinite values; start from finite ones")
