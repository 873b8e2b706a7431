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
from jsmitsm.discretization.rows import all_coefficients, all_rows
from jsmitsm.equation.problem import Problem
from jsmitsm.parallel.assembly import assembled
from jsmitsm.parallel.distributed import ParallelCloud
from jsmitsm.parallel.local import Local
from jsmitsm.parallel.shares import local_kernel, local_problem
from jsmitsm.parallel.solving import solve
from jsmitsm.parallel.team import Team, collective
from jsmitsm.runtime.errors import SolveError, is_one_of

WRT = ("params", "points")
# The adjoint of Newton's steps is repeated until it changes by so little, and at most so often.
SETTLED, MOST = 1e-11, 40


@collective
def value_and_grad(
    objective: Callable[..., Any], problem: Problem, cloud: Cloud | ParallelCloud, *, wrt: str = "params",
    **options: Any,
) -> tuple[float, Any]:  # fmt: skip
    """A number that hangs on the solution, and its gradient by ``problem.params`` or by the particles.

    Exact derivatives of the discrete solution at fixed neighbours, as those that JAX takes of ``js.solve``. They cost
    one more solve, with the transpose, and one more pass over the rows; of a nonlinear problem some more such solves,
    and the expansions at which it is linearised follow the solution.

    Parameters
    ----------
    objective : function
        ``objective(u, x)``, or ``objective(u, x, params)`` where the problem has params: of the values (n,) or (n, F)
        and the places (n, D) of this process's particles its part of the number. The parts add up.
    problem : Problem
        As for ``jp.solve``.
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
        As ``jp.solve``; and where a step of Newton's method at the solution does not contract.

    Examples
    --------
    ``value, slope = jp.value_and_grad(lambda u, x, k: (u**2).sum(), problem, cloud, order=4)``
    """
    if not is_one_of(wrt, WRT) or (wrt == "params" and getattr(problem, "params", None) is None):
        raise ValueError(f"wrt: {wrt!r} is none of {', '.join(map(repr, WRT))}, or the problem has no params")
    sol = solve(problem, cloud, **options)
    us, local, taylor = sol._team, sol._local, sol._linearised
    local.refuse_degenerate()
    halo = local.halo
    # Newton's last step was linearised at the iterate before.
    system = sol.system if taylor is None else assembled(us, local, options.get("solver", "auto"), lambda: taylor)[0]
    with us.phase():
        given = problem.params if wrt == "params" else jnp.asarray(local.cloud.points)
        (value, away, fitted), back = jax.vjp(_step(objective, problem, local, wrt), given, taylor, sol._values)
        more = () if problem.params is None else (problem.params,)
        slope = jax.grad(lambda u: jnp.asarray(objective(u, jnp.asarray(sol.points), *more)))(jnp.asarray(sol.u))
        slope, free = np.asarray(slope).reshape(len(halo.ids), -1), ~local.disc.held[halo.ids]
    asks, silent, nowhere = jnp.ones_like(value), jnp.zeros_like(value), jnp.zeros_like(away)

    def of_others(which: int, *asked: Any) -> Any:
        """What the own results, asked so much, pull at the own particles' expansions (1) or values (2)."""
        with us.phase():
            found = np.asarray(back(asked)[which])
        return halo.returned(found)[halo.ids]

    def adjoint(pulled: Any) -> Any:
        """The adjoint of the own unknowns, at which the objective looks, and what is fitted to them, by ``pulled``."""
        looked = slope if pulled is None else slope + of_others(2, silent, nowhere, pulled)
        return jnp.asarray(system.solve(looked[free], transpose=True))

    pulled = None
    if taylor is not None:
        once_more = lambda pulled: jnp.asarray(of_others(1, silent, adjoint(pulled), pulled))  # noqa: E731
        pulled = _settled(us, once_more, jnp.zeros_like(fitted))
    weights = adjoint(pulled)
    with us.phase():
        found = jax.tree.map(np.asarray, back((asks, weights, pulled))[0])
    total = float(us.total(float(value)))
    if wrt == "points":
        return total, halo.returned(found)[halo.ids]
    return total, jax.tree.map(us.total, found)


def _settled(us: Team, once_more: Callable[[Any], Any], pulled: Any) -> Any:
    """What the solution pulls at the expansions: the fixed point of Newton's steps backwards, which contract alike."""
    for _ in range(MOST):
        new = once_more(pulled)
        length, size = (us.most(float(jnp.abs(x).max(initial=0.0))) for x in (new - pulled, new))
        pulled = new
        if length <= SETTLED * size:
            return pulled
    raise SolveError(
        f"Newton's steps backwards still change the gradient by {length / size:.1e} of its size after {MOST} of them: "
        "the cloud does not resolve the solution, take a finer one or another order"
    )


def _step(objective: Any, problem: Problem, local: Local, wrt: str) -> Callable[..., Any]:
    """One step from expansions (n, F, K) and values (n, F) of local particles, what it is differentiated by first.

    It gives the own part of the objective, what the own equations linearised at the expansions leave of the values,
    b - A x, and the own expansions that belong to these; for linear problems no expansions.
    """
    halo, settings, own = local.halo, local.settings, local.owned
    near, place = Stencils(table(local.disc), None), np.full(len(own), -1)
    place[own] = np.arange(int(own.sum()))

    def step(given: Any, taylor: Any, values: Any) -> tuple[Any, Any, Any]:
        params, points = (given, local.cloud.points) if wrt == "params" else (problem.params, given)
        changed = problem if problem.params is None else problem.replace(params=params)
        kernel = settings.kernel and local_kernel(settings.kernel, halo.slab)
        disc = discretize(
            local_problem(changed, halo.slab), local.cloud.replace(points=points), settings.method, settings.order,
            kernel, near, None, sources=False, depth=local.disc.rec.depth, part=local.part,
        )  # fmt: skip
        nums = numbers(disc, disc.problem, taylor)
        classes, rows = all_rows(disc, nums)
        data, r, c = matrix(disc, classes, rows)
        b, x = right_side(disc, nums, classes, rows), values[~local.disc.held]
        mine = own[r]
        away = b.at[place[r[mine]]].add(-jnp.asarray(data)[mine] * x[c[mine]])
        everywhere = jnp.asarray(with_held(disc, nums, x))
        found = everywhere[halo.ids, 0] if problem.fields == 1 else everywhere[halo.ids]
        told = objective(found, points[halo.ids], *(() if problem.params is None else (params,)))
        fitted = None if taylor is None else all_coefficients(disc, nums, everywhere)[halo.ids]
        return jnp.asarray(told), away, fitted

    return step
