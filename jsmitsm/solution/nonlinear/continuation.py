"""Continuation: a hard nonlinear problem approached through easier ones."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, Literal, Unpack, overload

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.problem import Problem
from jsmitsm.particle.kernels import Kernel
from jsmitsm.runtime.arrays import Array, ValueOrFunction
from jsmitsm.runtime.errors import SolveError, explaining, is_whole, numbers, refuse_no_switch
from jsmitsm.runtime.progress import bar
from jsmitsm.solution.arguments import SolveOptions
from jsmitsm.solution.nonlinear.branch import Branch, follow
from jsmitsm.solution.solution import Solution
from jsmitsm.solution.solve import solve


class StageOptions(SolveOptions, total=False):
    """Options of ``js.solve`` for every stage."""

    kernel: Kernel | None


# A stage is halved this often before continuation gives up.
_HALVINGS = 6


@overload
def continuation(
    problem: Callable[[float], Problem], cloud: Cloud, parameters: Sequence[float] | Array, *,
    u0: ValueOrFunction | None = None, arclength: Literal[False] = False, steps: int = 100,
    **options: Unpack[StageOptions],
) -> list[Solution]: ...  # fmt: skip


@overload
def continuation(
    problem: Callable[[float], Problem], cloud: Cloud, parameters: Sequence[float] | Array, *,
    u0: ValueOrFunction | None = None, arclength: Literal[True], steps: int = 100, **options: Unpack[StageOptions],
) -> Branch: ...  # fmt: skip


@explaining
def continuation(
    problem: Callable[[float], Problem],
    cloud: Cloud,
    parameters: Sequence[float] | Array,
    *,
    u0: ValueOrFunction | None = None,
    arclength: bool = False,
    steps: int = 100,
    **options: Unpack[StageOptions],
) -> list[Solution]:
    """Solve ``problem(parameter)`` for a sequence of parameters, each from the solution before.

    Parameters
    ----------
    problem : callable
        A function of one number that returns the problem to solve.
    cloud : Cloud
        The particles it is solved on.
    parameters : sequence of float
        The stages, in the order in which to go; two or more.
    u0 : array_like or function, optional
        Start of the first stage, as in ``js.solve``.
    arclength : bool
        Follow the branch of solutions by its arc length (Keller 1977), which passes turning points. The second
        parameter says in which direction to set out, and each is that at which the branch passes it after the one
        before: [1.0, 2.0, 2.0] are the solutions at 2 before the turning point and behind it.
    steps : int
        With ``arclength``, the most steps along the branch; it ends there, or where the last parameter was passed.
    **options : optional
        Passed to ``js.solve``.

    Returns
    -------
    list of Solution
        One for each of ``parameters``. Where Newton's method fails, the way to the
        next parameter is halved. With ``arclength`` a list with attributes, of the solutions at those
        of the parameters that were reached: ``parameters`` (these), ``branch``, a list of (parameter,
        Solution) of all steps, and ``folds``, the parameters at which the branch turns back.

    Raises
    ------
    ValueError
        For bad parameters, with what came and what was expected.
    SolveError
        With the last parameter reached if halving does not help, as at a turning point, beyond
        which there is no solution; with ``arclength``, where the branch ends.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> bratu = lambda c: js.Problem(
    ...     lambda u, x: js.laplacian(u)(x) + c * jnp.exp(u(x)), ends
    ... )
    >>> sols = js.continuation(bratu, js.interval(0.0, 1.0, 21), [1.0, 2.0, 3.0])
    >>> [round(float(sol.u[10]), 4) for sol in sols]
    [0.1405, 0.329, 0.6401]
    >>> around = js.continuation(
    ...     bratu, js.interval(0.0, 1.0, 21), [1.0, 2.0, 2.0], arclength=True
    ... )
    >>> [round(float(sol.u[10]), 2) for sol in around], round(around.folds[0], 3)
    ([0.14, 0.33, 2.9], 3.514)
    """
    values = numbers("parameters", parameters)
    if values.ndim != 1 or len(values) < 2 or not np.isfinite(values).all():
        raise ValueError(f"parameters: expected two or more finite numbers in a row, got {parameters!r}")
    if not callable(problem):
        raise ValueError(
            f"problem: expected a function of the parameter that returns a js.Problem, got {type(problem).__name__}"
        )
    try:
        inspect.signature(problem).bind(0.0)
    except TypeError as fault:
        raise ValueError(
            f"problem: expected a function of the parameter alone, and it cannot be called so: {fault}"
        ) from None
    except ValueError:  # one of C's, which has no signature
        pass
    refuse_no_switch("arclength", arclength)
    options["throw"] = True
    if arclength:
        if values[0] == values[1]:
            raise ValueError(
                f"parameters: the first two say in which direction to follow the branch, and both are {values[0]:.6g}"
            )
        if not is_whole(steps, 1):
            raise ValueError(f"steps: expected a whole number from 1, the most steps along the branch, got {steps!r}")
        with bar("continuation", len(values)) as shown:
            return follow(problem, cloud, values, u0, int(steps), dict(options), shown)
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
                    f"continuation stopped at the parameter {at:.6g} on the way to {end:.6g} (arclength=True "
                    f"passes turning points): {error.args[0]}",
                    error.particles,
                ) from error
        else:
            at = to
    return sol
