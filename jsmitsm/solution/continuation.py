"""Continuation: a hard nonlinear problem approached through easier ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Unpack

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.problem import Problem
from jsmitsm.particle.kernels import Kernel
from jsmitsm.runtime.arrays import Array, ValueOrFunction
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.progress import bar
from jsmitsm.solution.arguments import SolveOptions
from jsmitsm.solution.solution import Solution
from jsmitsm.solution.solve import solve


class StageOptions(SolveOptions, total=False):
    """Options of :func:`jsmitsm.solve` for every stage."""

    kernel: Kernel | None


# A stage is halved this often before continuation gives up.
_HALVINGS = 6


def continuation(
    problem: Callable[[float], Problem],
    cloud: Cloud,
    parameters: Sequence[float] | Array,
    *,
    u0: ValueOrFunction | None = None,
    **options: Unpack[StageOptions],
) -> list[Solution]:
    """Solve ``problem(parameter)`` for a sequence of parameters, each from the solution before.

    Parameters
    ----------
    problem : function of one number that returns the problem to solve.
    parameters : the stages, in the order in which to go; two or more.
    u0 : start of the first stage, as in :func:`jsmitsm.solve`; ``options`` are passed to it.

    Returns
    -------
    list of Solution : one for each of ``parameters``. Where Newton's method fails, the way to the
        next parameter is halved.

    Raises
    ------
    SolveError
        With the last parameter reached if halving does not help, as at a turning point, beyond
        which there is no solution.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> bratu = lambda c: js.Problem(lambda u, x: js.laplacian(u)(x) + c * jnp.exp(u(x)), ends)
    >>> sols = js.continuation(bratu, js.interval(0.0, 1.0, 21), [1.0, 2.0, 3.0])
    >>> [round(float(sol.u[10]), 4) for sol in sols]
    [0.1405, 0.329, 0.6401]
    """
    values = np.asarray(parameters, float)
    if values.ndim != 1 or len(values) < 2 or not np.isfinite(values).all():
        raise ValueError(f"parameters: expected two or more finite numbers in a row, got {parameters!r}")
    if not callable(problem):
        raise ValueError(
            f"problem: expected a function of the parameter that returns a js.Problem, got {type(problem).__name__}"
        )
    options["throw"] = True
    with bar("continuation", len(values)) as shown:
        sols = [solve(problem(float(values[0])), cloud, u0=u0, **options)]
        shown.update()
        for before, after in zip(values[:-1], values[1:]):
            sols.append(_onward(problem, cloud, float(before), float(after), sols[-1], options))
            shown.update()
    return sols


def _onward(problem: Any, cloud: Cloud, at: float, end: float, sol: Solution, options: Any) -> Solution:
    """From the solution at one parameter to that at the next, in steps that adapt."""
    step, smallest = end - at, abs(end - at) * 0.5**_HALVINGS
    while at != end:
        to = end if abs(end - at) <= abs(step) else at + step
        try:
            sol = solve(problem(to), cloud, u0=sol.u, **options)
        except SolveError as error:
            step /= 2.0
            if abs(step) < smallest:
                raise SolveError(
                    f"continuation stopped at the parameter {at:.6g} on the way to {end:.6g}: {error.args[0]}",
                    error.particles,
                ) from error
        else:
            at = to
    return sol
