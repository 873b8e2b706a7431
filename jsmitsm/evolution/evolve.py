"""Evolve a problem in time: the verb."""

from __future__ import annotations

import time
from typing import Any, Literal, TypeAlias, overload

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.equation.problem import Problem
from jsmitsm.evolution.adaptive.adapted import AdaptedEvolution
from jsmitsm.evolution.adaptive.parts import followed, refuse_what_does_not_damp
from jsmitsm.evolution.adaptive.readapt import Readapt
from jsmitsm.evolution.arguments import Scheme, check, saved_times, starting_values
from jsmitsm.evolution.evolution import Evolution
from jsmitsm.evolution.gradient.differentiable import differentiable
from jsmitsm.evolution.march import march
from jsmitsm.evolution.regions.run import RegionsRun
from jsmitsm.evolution.regions.timed import regions_timed
from jsmitsm.evolution.run import Run
from jsmitsm.evolution.space.timed import timed
from jsmitsm.evolution.unseen import unseen_start
from jsmitsm.runtime.arrays import ValueOrFunction
from jsmitsm.runtime.errors import explaining, short
from jsmitsm.runtime.progress import PENCIL, bar
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.arguments import Depth, of_regions

Start: TypeAlias = ValueOrFunction | tuple[ValueOrFunction, ValueOrFunction]


@overload
def evolve(
    problem: Problem, cloud: Cloud, u0: Start, t: tuple[float, float], *, steps: int | None = None,
    tol: float | None = None, order: int = 4, scheme: Scheme = "auto", save: int | Any = None,
    damping: float | Literal["auto"] = "auto", stencils: Stencils | None = None, depth: Depth = "auto",
    throw: bool = True, progress: bool = True, readapt: None = None,
) -> Evolution: ...  # fmt: skip
@overload
def evolve(
    problem: Problem, cloud: Cloud, u0: Start, t: tuple[float, float], *, steps: int | None = None,
    tol: float | None = None, order: int = 4, scheme: Scheme = "auto", save: int | Any = None,
    damping: float | Literal["auto"] = "auto", stencils: Stencils | None = None, depth: Depth = "auto",
    throw: bool = True, progress: bool = True, readapt: Readapt,
) -> AdaptedEvolution: ...  # fmt: skip
@explaining
def evolve(
    problem: Problem,
    cloud: Cloud,
    u0: Start,
    t: tuple[float, float],
    *,
    steps: int | None = None,
    tol: float | None = None,
    order: int = 4,
    scheme: Scheme = "auto",
    save: int | Any = None,
    damping: float | Literal["auto"] = "auto",
    stencils: Stencils | None = None,
    depth: Depth = "auto",
    throw: bool = True,
    progress: bool = True,
    readapt: Readapt | None = None,
) -> Evolution | AdaptedEvolution:
    """Evolve ``problem`` on ``cloud`` from ``u0`` over the times ``t``.

    The functions of the problem take the time: ``pde(u, x, t)``, in which ``js.dt(u)(x)`` and ``js.dt(u, 2)(x)`` are
    the rates of u; values of conditions ``(x, t)``; residuals of conditions ``(u, x, n, t)``, or as ``js.solve`` takes
    them ``(u, x, n)``, whatever the normal is called, or ``(u, x, t)``, the third called t or time; each with
    ``params`` last where the problem has them. Rates enter linearly, with factors that may depend on x. An equation
    without a rate holds at every moment. Where it is div v = 0, of the velocities v of an incompressible flow, the
    pressure gets the divergence of the momentum equations for its own, and mean zero.

    Parameters
    ----------
    problem : Problem
        Its functions take the time.
    cloud : Cloud
        The particles it is solved on.
    u0 : function, array_like or pair of them
        The start, a function of x, a number or an array (N,) or (N, F), with several regions also a dict of functions
        or numbers by region; for second order in time a pair of them, u and its rate. Where it differs from the
        conditions the run begins with the impulse that this is.
    t : pair of float
        (t0, t1), the start and the end.
    steps : int, optional
        So many equal steps; or
    tol : float, optional
        Steps whose estimated error stays below it, that of each field relative to its own largest value so far.
    order : int
        Of the discretization in space, the degree of the fits.
    scheme : {"auto", "esdirk", "radau", "imex", "euler"}
        "esdirk" (KenCarp4, order 4), "radau" (Radau IIA, order 5, for linear problems), "imex" (KenCarp4 with its
        explicit half for what is nonlinear), "euler" (backward), or "auto": radau for linear problems of order 6
        and more, of second order in time, and with equations without a rate, esdirk for other linear ones; imex for
        semilinear ones, where only lower derivatives are nonlinear, and esdirk with Newton's method for the rest.
    save : int or array_like, optional
        So many equal intervals, or an array of times; the start and the end alone if not given.
    damping : float or "auto"
        For waves, a small multiple of what only the cloud sees: alpha / spacing times the rate minus its prediction
        by the neighbours. "auto" is 0.1 at order 6 and above, 0 below; for pairs of fields that drive one another
        by second derivatives, as in Schroedinger's equation, 0.2.
    stencils : Stencils, optional
        The user's, from ``js.stencils``, which are not repaired; needed where JAX traces the points.
    depth : int or "auto"
        Degrees by which the recursion exceeds the order; "auto" is 0, since more gains nothing here.
    throw : bool
        Raise ``js.SolveError`` where the run cannot go on; otherwise return the last good state, with ``converged``
        False.
    progress : bool
        A bar with the time and an estimate of the rest.
    readapt : Readapt, optional
        Make the cloud anew on the way, where the error is: ``js.Readapt(make, tol)``. ``cloud`` is what it begins with,
        made finer where the function u0 asks for it; ``steps`` are spread over the parts, rounded up.

    Returns
    -------
    Evolution
        The states at the saved times, and at any other by ``.at(t)``; with ``readapt`` an ``AdaptedEvolution``, whose
        states lie on several clouds.

    Raises
    ------
    ValueError
        For bad input, and for problems that this cannot do: pure advection, conditions nonlinear in u; with several
        regions, nonlinear equations and second order in time; with ``readapt`` second order in time, incompressible
        flows, several regions, a user's stencils, and whatever is traced by JAX.
    SolveError
        For a run that blew up, a stage that did not converge, steps that became too small.

    Notes
    -----
    The source is a field given at the particles: space is one pencil A u = B f, made once, and a step size is one
    factorisation. Differentiable by ``jax.grad`` with respect to params, u0, t and what the functions close over;
    under ``jax.jit`` and ``jax.vmap`` with ``steps`` only.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> cloud = js.interval(0.0, 1.0, 31)
    >>> problem = js.Problem(
    ...     lambda u, x, t, k: js.dt(u)(x) - k * js.laplacian(u)(x),
    ...     {"left": js.dirichlet(0.0), "right": js.neumann(0.0)},
    ...     params=0.5,
    ... )
    >>> run = js.evolve(
    ...     problem,
    ...     cloud,
    ...     lambda x: jnp.sin(jnp.pi * x[0] / 2),
    ...     t=(0.0, 1.0),
    ...     steps=20,
    ...     order=6,
    ...     save=4,
    ... )
    >>> run.u.shape, run.t.tolist(), run.flags
    ((5, 31), [0.0, 0.25, 0.5, 0.75, 1.0], [])
    >>> bool(abs(run.u[-1, -1] - jnp.exp(-jnp.pi**2 / 8)) < 1e-8)
    True
    """
    began = time.perf_counter()
    check(problem, cloud, t, steps, tol, order, scheme, throw, progress)
    several = of_regions(problem, cloud)
    made: Any = regions_timed(problem, cloud) if several else timed(problem, cloud)  # type: ignore[arg-type]
    second = bool(made.masses[1].slots)
    start = starting_values(u0, cloud, problem.fields, second)
    if readapt is not None:
        _refuse_readapt(readapt, several, stencils, made, is_traced(problem, cloud, start, t))
    options: dict[str, Any] = {
        "order": int(order), "scheme": scheme, "damping": damping, "stencils": stencils, "throw": throw,
        "depth": 0 if depth == "auto" else depth,
    }  # fmt: skip
    if is_traced(t):
        if not (save is None or isinstance(save, int)):
            raise ValueError("save: where t is traced by JAX, give a number of intervals instead of times")
        parts = saved_times(save, 0.0, 1.0)
    else:
        parts = saved_times(save, float(t[0]), float(t[1]))
    if readapt is not None:
        span = float(t[0]), float(t[1])
        with bar("evolve", wanted=progress, parts=(("parts", 1.0),)):
            return followed(problem, cloud, u0, span, steps, tol, parts, readapt, options)
    # Measured with 1,000 and 8,000 particles: a step takes about as long as one of the fits; with tol some forty do.
    with bar("evolve", wanted=progress, parts=(*PENCIL, ("steps", float(40 if steps is None else steps)))):
        run = (RegionsRun if several else Run)(made, cloud, start, t, began, **options)
        run.unseen = unseen_start(u0, start[0], cloud, run.semi)  # type: ignore[arg-type]
        if run.traced:
            if steps is None:
                raise ValueError(
                    "tol: under a JAX transform the steps must be known; give steps=, as many as a run with tol took"
                )
            return differentiable(run, int(steps), parts)
        with bar("steps", int(steps) if steps is not None else 1000) as shown:
            return march(run, None if steps is None else int(steps), None if tol is None else float(tol), parts, shown)


def _refuse_readapt(readapt: Any, several: bool, stencils: Any, made: Any, traced: bool) -> None:
    if not isinstance(readapt, Readapt):
        raise ValueError(f"readapt: expected js.Readapt(make, tol), got {short(readapt)}")
    if several:
        raise ValueError("readapt: clouds of several regions are not made anew on the way; leave it out")
    if stencils is not None:
        raise ValueError("stencils: belong to one cloud, and readapt makes others; leave one of them out")
    if traced or is_traced(made.problem, made.rest, made.masses, made.apart):  # functions may close over what is traced
        raise ValueError(
            "readapt: no cloud can be made from traced values; differentiate js.evolve on one cloud, without readapt"
        )
    refuse_what_does_not_damp(made)
