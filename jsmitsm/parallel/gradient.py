"""Derivatives of a number that hangs on the solution, by one adjoint solve: of parameters, and of the particles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.discretization.coefficients import numbers
from jsmitsm.discretization.layout import discretize, table
from jsmitsm.discretization.leave_one_out import matrix, right_side, with_held
from jsmitsm.discretization.rows import all_rows
from jsmitsm.equation.problem import Problem
from jsmitsm.parallel.distributed import ParallelCloud
from jsmitsm.parallel.local import Local
from jsmitsm.parallel.shares import local_kernel, local_problem
from jsmitsm.parallel.solving import solve
from jsmitsm.runtime.errors import explaining, is_one_of

WRT = ("params", "points")


@explaining
def value_and_grad(
    objective: Callable[..., Any], problem: Problem, cloud: Cloud | ParallelCloud, *, wrt: str = "params",
    **options: Any,
) -> tuple[float, Any]:  # fmt: skip
    """A number that hangs on the solution, and its gradient by ``problem.params`` or by the particles.

    Exact derivatives of the discrete solution at fixed neighbours, as those that JAX takes of ``js.solve``. They cost
    one more solve, with the transpose, and one more pass over the rows.

    Parameters
    ----------
    objective : function
        ``objective(u, x)``, or ``objective(u, x, params)`` where the problem has params: of the values (n,) or (n, F)
        and the places (n, D) of this process's particles its part of the number. The parts add up.
    problem : Problem
        Linear.
    cloud : Cloud or ParallelCloud
        As for ``jp.solve``.
    wrt : {"params", "points"}
        What is differentiated by.
    **options
        Those of ``jp.solve``.

    Returns
    -------
    tuple of (float, pytree or array (n, D))
        The sum over all processes, and the gradient: by params the whole one on every process, by points that of this
        process's own particles.

    Raises
    ------
    ValueError
        As ``jp.solve``; and for ``wrt="params"`` of a problem without any.
    SolveError
        As ``jp.solve``.

    Examples
    --------
    ``value, slope = jp.value_and_grad(lambda u, x, k: (u**2).sum(), problem, cloud, order=4)``
    """
    if not is_one_of(wrt, WRT) or (wrt == "params" and getattr(problem, "params", None) is None):
        raise ValueError(f"wrt: {wrt!r} is none of {', '.join(map(repr, WRT))}, or the problem has no params")
    sol = solve(problem, cloud, **options)
    us, local = sol._team, sol._local
    halo, disc = local.halo, local.disc
    given = () if problem.params is None else (problem.params,)
    with us.phase():
        if not disc.linear:
            raise ValueError(
                "problem: gradients of nonlinear problems are not made for several processes; use js.solve"
            )
        x = sol._values[~disc.held]
        part = lambda u: jnp.asarray(objective(u, jnp.asarray(sol.points), *given))  # noqa: E731
        value, slope = jax.value_and_grad(part)(jnp.asarray(sol.u))
        free = ~disc.held[halo.ids]
        slope = np.asarray(slope).reshape(free.shape)[free]
    weights = sol.system.solve(slope, transpose=True)
    with us.phase():
        points = jnp.asarray(local.cloud.points)
        lagrangian = _lagrangian(objective, problem, local, x, weights, local.owned)
        which = 0 if wrt == "params" else 1
        found = jax.tree.map(np.asarray, jax.grad(lagrangian, argnums=which)(problem.params, points))
    total = float(us.total(float(value)))
    if wrt == "points":
        return total, halo.returned(found)[halo.ids]
    return total, jax.tree.map(us.total, found)


def _lagrangian(objective: Any, problem: Problem, local: Local, x: Any, weights: Any, own: np.ndarray) -> Any:
    """The own part of the objective and of weights . (b - A x), at fixed unknowns x, by params and points."""
    halo, settings, near = local.halo, local.settings, Stencils(table(local.disc), None)

    def lagrangian(params: Any, points: Any) -> Any:
        changed = problem if problem.params is None else problem.replace(params=params)
        kernel = settings.kernel and local_kernel(settings.kernel, halo.slab)
        disc = discretize(
            local_problem(changed, halo.slab), local.cloud.replace(points=points), settings.method, settings.order,
            kernel, near, None, sources=False, depth=local.disc.rec.depth, part=local.part,
        )  # fmt: skip
        nums = numbers(disc, disc.problem)
        classes, rows = all_rows(disc, nums)
        data, r, c = matrix(disc, classes, rows)
        b = right_side(disc, nums, classes, rows)
        mine, row = np.asarray(own)[r], np.full(len(own), -1)
        row[own] = np.arange(int(own.sum()))
        away = jnp.dot(weights, b) - jnp.sum(weights[row[r[mine]]] * jnp.asarray(data)[mine] * x[c[mine]])
        values = jnp.asarray(with_held(disc, nums, x))[halo.ids]
        values = values[:, 0] if problem.fields == 1 else values
        given = () if problem.params is None else (params,)
        return objective(values, points[halo.ids], *given) + away

    return lagrangian
