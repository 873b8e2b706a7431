"""Choose a kernel's parameters by gradient descent, without knowing the exact solution.

The objective "estimate" is the distance to one reference solution of higher order, computed once,
held by a bound on the Lebesgue constant: without it the descent finds kernels that are accurate
only for the very numbers they were tuned to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias, Unpack

import jax
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.discretization.supports import default_kernel
from jsmitsm.equation.problem import Problem
from jsmitsm.particle.kernels import Kernel
from jsmitsm.runtime import notebooks
from jsmitsm.runtime.arrays import ArrayLike, ValueOrFunction
from jsmitsm.runtime.errors import SolveError, did_you_mean, explaining, is_one_of, is_whole, listed, short
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.arguments import SolveOptions, check, discretized
from jsmitsm.solution.solution import Solution
from jsmitsm.solution.solve import solve
from jsmitsm.tuning.descent import Descent
from jsmitsm.tuning.objective import Objective
from jsmitsm.tuning.parameter_maps import ParameterMap


class TuneOptions(SolveOptions, total=False):
    """Options of ``js.solve`` for every solve of the search."""

    u0: ValueOrFunction | None


OPTIONS = tuple(TuneOptions.__annotations__)
Parameter: TypeAlias = Literal["h", "d", "params"]


@dataclass
class TuneResult:
    """What ``js.tune`` found.

    Attributes
    ----------
    kernel : Kernel
        The best kernel met, never worse than the one it started from.
    solution : Solution
        The solution with it.
    history : dict
        Per evaluated step, ready to plot: ``"objective"`` (for "estimate" the relative distance to the reference
        solution), ``"lebesgue"`` (the largest Lebesgue constant), and each tuned parameter under its name, (steps,)
        or (steps, N); ``"params"`` has the form of the kernel's own, every leaf with a leading axis of steps.
    messages : list of str
        In words, where tuning had to step back, widen a support or stop, and what it did not take.
    solves : int
        Number of solves, those of the reference and of the returned solution included.
    step : int
        Where in the history the returned kernel stands; smaller objectives there are of kernels that were not taken.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) + x[0], ends)
    >>> start = js.SuperGaussian(h=0.125, d=4.0)
    >>> found = js.tune(problem, js.interval(0.0, 1.0, 17), start, order=3, steps=2)
    >>> isinstance(found, js.TuneResult), sorted(found.history)
    (True, ['d', 'h', 'lebesgue', 'objective'])
    """

    kernel: Kernel
    solution: Solution
    history: dict[str, Any]
    messages: list[str] = field(default_factory=list)
    solves: int = 0
    step: int = 0

    def __repr__(self) -> str:
        seen = self.history["objective"]
        return f"TuneResult({self.kernel!r}, objective {seen[0]:.3g} -> {seen[self.step]:.3g}, {self.solves} solves)"

    def _repr_html_(self) -> str:
        seen = np.asarray(self.history["objective"], float)
        rows: list[tuple[str, Any]] = [("kernel", repr(self.kernel)), ("steps, solves", f"{len(seen)}, {self.solves}")]
        rows += [("objective", f"{seen[0]:.3g} to {seen[self.step]:.3g}")]
        rows += [("messages", " ".join(self.messages) or "none")]
        return notebooks.shown("TuneResult", rows) + self.solution._repr_html_()


@explaining
def tune(
    problem: Problem,
    cloud: Cloud,
    kernel: Kernel | None = None,
    *,
    objective: Literal["estimate"] | Callable[[Solution], Any] = "estimate",
    parameters: Parameter | Sequence[Parameter] = ("h", "d"),
    optimizer: Any = None,
    steps: int = 50,
    progress: bool = True,
    groups: ArrayLike | None = None,
    **solve_options: Unpack[TuneOptions],
) -> TuneResult:
    """Tune the parameters of a kernel by gradient descent.

    Positive parameters are changed on their logarithms, so they stay positive; the support is kept
    wide enough that every particle has the neighbours its fit needs. Where a solve fails or an
    objective is not finite, the search returns to the best kernel found and halves its step.

    Parameters
    ----------
    problem : Problem
        What is solved.
    cloud : Cloud
        The particles it is solved on.
    kernel : Kernel, optional
        Where to start. ``h`` scalar, or (N,) to tune one smoothing length per particle. If not given, what
        ``js.solve`` takes, its smoothing lengths by one factor unless ``groups`` says otherwise. Stencils that it
        balances between directions are no kernel's support: where they stay ahead of the best, a message says so.
    objective : "estimate" or function
        "estimate", the distance to a reference solution of higher order that is computed once; or a function of a
        ``js.Solution`` that returns a scalar to be made small. Both are held by a bound on the Lebesgue
        constant: 1.5, or that of h = spacing, d = 4.
    parameters : str or sequence of str
        Some of "h", "d" and, for a kernel that has them, "params". Every floating-point leaf of ``params`` is
        tuned, its sign kept where it starts positive.
    optimizer : optax transformation, optional
        Any optax transformation; Adam with a decaying step if not given.
    steps : int
        At most so many steps; fewer where nothing is gained any more.
    progress : bool
        Show a bar, where tqdm is installed and stderr is a terminal.
    groups : array_like (N,), optional
        (N,) whole numbers; particles with the same one share a factor on ``h``, so that a graded ``h`` keeps its
        grading.
    solve_options : optional
        ``method``, ``order`` and the others of ``js.solve``.

    Returns
    -------
    TuneResult
        The best kernel, its solution and the history.

    Raises
    ------
    ValueError
        For bad input, such as a parameter that the kernel lacks.
    SolveError
        If the problem cannot be solved with the starting kernel, nor with wider ones.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp
    >>> import jsmitsm as js
    >>> cloud = js.interval(0.0, 1.0, 17)
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> problem = js.Problem(
    ...     lambda u, x: js.laplacian(u)(x) + jnp.sin(jnp.pi * x[0]), ends
    ... )
    >>> start = js.SuperGaussian(h=2 * cloud.spacing, d=4.0)
    >>> found = js.tune(problem, cloud, start, order=3, steps=10)
    >>> bool(found.history["objective"].min() < found.history["objective"][0] / 2)
    True
    """
    options: dict[str, Any] = {"method": "S", "order": 4, **solve_options}
    _check_input(problem, cloud, kernel, objective, optimizer, steps, options)
    plain = None
    if kernel is None:
        kernel, plain = _chosen(problem, cloud, options)
        groups = np.zeros(len(cloud), int) if groups is None and "h" in parameters else groups
    names = _checked_names(kernel, parameters)
    kernel = kernel.recorded()
    space = ParameterMap(kernel, names, _checked_groups(groups, cloud, names))
    with bar("tune", steps, progress) as shown:
        scored = Objective(problem, cloud, kernel, objective, options)
        search = Descent(space, scored, optimizer, steps)
        search.run(shown)
        best = search.best
        if plain is not None:
            search.tell_nearer(scored.measured(plain))
        if not scored.linear:
            options["u0"] = best.score.values
        solution = solve(problem, cloud, kernel=best.kernel, **options)
    solves = scored.solves + 1 + (plain is not None)
    return TuneResult(best.kernel.as_written(), solution, search.history(), search.messages, solves, search.place)


# ------------------------------------------------------------------ input


def _chosen(problem: Problem, cloud: Cloud, options: dict[str, Any]) -> tuple[Kernel, Solution | None]:
    """The kernel that ``js.solve`` takes where none is given, and its solution where there is one.

    It fits the stencils that were repaired too: narrower ones begin with the weak rows that a solve has mended.
    """
    disc = discretized(
        problem, cloud, options["method"], options["order"], None, options.get("stencils"),
        depth=options.get("depth", "auto"),
    )  # fmt: skip
    near, plain = disc.stencils.indices, None
    try:
        plain = solve(problem, cloud, **options)
        near = plain._fit.neighbours
    except SolveError:
        pass
    return default_kernel(disc.points, np.arange(len(cloud)), near, disc.scheme.decay), plain


def _checked_names(kernel: Kernel, parameters: Any) -> tuple[str, ...]:
    known = ["h", "d"] + (["params"] if jax.tree.leaves(kernel.params) else [])
    some = [parameters] if isinstance(parameters, str) else parameters
    names = tuple(listed("parameters", some, f"some of {', '.join(map(repr, known))}"))
    for name in names:
        if not is_one_of(name, known):
            raise ValueError(
                f"parameters: {short(name)} is no parameter of {type(kernel).__name__}; it has "
                f"{', '.join(map(repr, known))}" + did_you_mean(name, known)
            )
    if not names or len(set(names)) < len(names):
        raise ValueError(f"parameters: expected some of {', '.join(map(repr, known))}, each once, got {parameters!r}")
    return names


def _check_input(problem, cloud, kernel, objective, optimizer, steps, options) -> None:
    for name in options:
        if name not in OPTIONS:
            raise ValueError(f"{name}: no argument of js.tune or js.solve; those of js.solve are {', '.join(OPTIONS)}"
                             + did_you_mean(name, [*OPTIONS, "objective", "optimizer", "steps"]))  # fmt: skip
    o = {"formulation": "auto", "solver": "auto", "stencils": None, **options}
    check(problem, cloud, o["method"], o["order"], kernel, o["stencils"], o["formulation"], o["solver"],
          u0=o.get("u0"), throw=o.get("throw", True), depth=o.get("depth", "auto"))
    if is_traced(kernel, cloud, problem.params):
        raise ValueError("kernel, cloud, problem: traced by a JAX transform; js.tune runs on the host, call it outside")
    if not is_one_of(objective, ["estimate"]) and not callable(objective):
        raise ValueError(f'objective: expected "estimate" or a function of a Solution, got {short(objective)}'
                         + did_you_mean(objective, ["estimate"]))  # fmt: skip
    if optimizer is not None and not (hasattr(optimizer, "init") and hasattr(optimizer, "update")):
        raise ValueError(f"optimizer: expected an optax transformation such as optax.adam(0.1), got {optimizer!r}")
    if not is_whole(steps, 0):
        raise ValueError(f"steps: expected a whole number, 0 or more, got {steps!r}")


def _checked_groups(groups: Any, cloud: Cloud, names: tuple[str, ...]) -> np.ndarray | None:
    if groups is None:
        return None
    array = np.asarray(groups)
    if array.shape != (len(cloud),) or array.dtype.kind not in "iu":
        raise ValueError(
            f"groups: expected ({len(cloud)},) whole numbers, one per particle, got {array.dtype} {array.shape}"
        )
    if "h" not in names:
        raise ValueError(f'groups: particles share a factor on h, but parameters={names!r} does not tune "h"')
    return array
