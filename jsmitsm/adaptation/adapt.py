"""A tolerance in, an answer out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, TypedDict, Unpack

import numpy as np

from jsmitsm.adaptation.first_cloud import Make, first_cloud, refuse_no_maker
from jsmitsm.adaptation.measure import NORMS, Quantity
from jsmitsm.adaptation.orders import ORDERS
from jsmitsm.adaptation.rounds import Rounds
from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.unknowns.extras import refuse_extras
from jsmitsm.linear.linsolve import Solver
from jsmitsm.runtime import notebooks
from jsmitsm.runtime.arrays import ValueOrFunction
from jsmitsm.runtime.errors import did_you_mean, explaining, is_number, is_one_of, is_whole, refuse_word, short
from jsmitsm.runtime.progress import bar
from jsmitsm.solution.arguments import Depth, Formulation, Method
from jsmitsm.solution.solution import Solution


class AdaptOptions(TypedDict, total=False):
    """Options of ``js.solve`` for every solve of the search."""

    method: Method
    depth: Depth
    basis_terms: int | None
    formulation: Formulation
    solver: Solver
    u0: ValueOrFunction | None


OPTIONS = tuple(AdaptOptions.__annotations__)


@dataclass
class Adapted:
    """What ``js.adapt`` found.

    Attributes
    ----------
    solution, cloud : Solution, Cloud
        The last solution and its cloud.
    error : float
        Its estimated error in the measure of the tolerance, relative to the largest |u|, or to the quantity.
    reached : bool
        Whether that is within the tolerance, another order confirms it, and nothing speaks against the solution.
    tol : float
        What was asked for.
    history : dict
        Of every round, ready to plot: ``"particles"``, ``"order"``, ``"error"``, ``"seconds"``, ``"smallest"`` (the
        smallest spacing).
    quantity : float, optional
        The number that was asked for, None without one.
    flags : list of str
        What speaks against the solution, in sentences; ``diagnose`` tells what limited the search besides.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) + 1.0, ends)
    >>> found = js.adapt(
    ...     problem, lambda spacing: js.interval(0.0, 1.0, spacing=spacing), 1e-6
    ... )
    >>> found.reached, found.flags
    (True, [])
    """

    solution: Solution
    cloud: Cloud
    error: float
    reached: bool
    tol: float
    history: dict[str, np.ndarray]
    quantity: float | None = None
    flags: list[str] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)

    def diagnose(self) -> str:
        """In words: how it went, what limited it, and what the solution says of itself.

        Returns
        -------
        str
            Several lines; those that begin with FLAG speak against the solution.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) + 1.0, ends)
        >>> found = js.adapt(
        ...     problem, lambda spacing: js.interval(0.0, 1.0, spacing=spacing), 1e-6
        ... )
        >>> "FLAG" in found.diagnose()
        False
        """
        flags = [f"FLAG: {line}" for line in self.flags]
        return "\n".join([repr(self), *self.messages, *flags, self.solution.diagnose()])

    def __repr__(self) -> str:
        rounds = len(self.history["particles"])
        return (
            f"Adapted(error={self.error:.2g}, tol={self.tol:.2g}, reached={self.reached}, {len(self.cloud)} particles, "
            f"order={self.solution.order}, {rounds} round{'s' if rounds > 1 else ''})"
        )

    def _repr_html_(self) -> str:
        rows: list[tuple[str, Any]] = [("estimated error", f"{self.error:.2g}, {self.tol:.2g} asked for")]
        rows += [("reached", self.reached), ("particles", len(self.cloud)), ("rounds", len(self.history["particles"]))]
        rows += [] if self.quantity is None else [("quantity", f"{self.quantity:.8g}")]
        rows += [("flags", " ".join(self.flags) or "none"), ("besides", " ".join(self.messages) or "nothing")]
        return notebooks.shown("Adapted", rows) + self.solution._repr_html_()


@explaining
def adapt(
    problem: Problem,
    make: Make,
    tol: float,
    *,
    order: int | Literal["auto"] = "auto",
    start: float | Callable[[np.ndarray], Any] | None = None,
    quantity: Quantity | None = None,
    norm: Literal["max", "l2"] = "max",
    max_particles: int = 300_000,
    max_rounds: int = 20,
    progress: bool = True,
    **solve_options: Unpack[AdaptOptions],
) -> Adapted:
    """Solve ``problem`` to a tolerance, on clouds made where the error is.

    Solve, estimate, see which particles the error comes from, make a new cloud with the spacing that gives every
    particle the same share, and again, until the estimate is within the tolerance and a solve of another order agrees.
    Before the first solve source and coefficients are looked at between the particles, so that a peak that no particle
    meets is found; where the tolerance seems reached, the polynomials of neighbours must meet between them.

    Parameters
    ----------
    problem : Problem
        Its conditions and sources are functions of x, not arrays: the particles change.
    make : function
        Spacing -> ``js.Cloud``, where the spacing is a number or a function (M, D) -> (M,), as ``lambda spacing:
        js.from_polygon(vertices, spacing)``. Its group names must not depend on the spacing.
    tol : float
        Wanted error relative to the largest |u| (of all fields), or to the quantity.
    order : int or "auto"
        Of the expansions; "auto" lets the tolerance and the estimates decide.
    start : float or function, optional
        The first spacing, a number or a function; a moderate cloud if not given.
    quantity : function, optional
        A function of a ``js.Solution`` that returns one number; then the tolerance is on that number, and particles
        are put where they matter for it: its adjoint weighs them. It must be differentiable by JAX for that, as
        ``sol(points)``, ``sol.flux(group)``, ``sol.integral()`` and what jax.numpy makes of them are.
    norm : {"max", "l2"}
        "max", the largest error at the particles, or "l2", its root mean square over the domain.
    max_particles, max_rounds : int
        Where the search ends.
    progress : bool
        Show a bar, where tqdm is installed and stderr is a terminal.
    solve_options : optional
        ``depth``, ``formulation``, ``solver``, ``u0`` (a function) and others of ``js.solve``. A nonlinear problem
        starts from the solution of the round before.

    Returns
    -------
    Adapted
        ``solution``, ``cloud``, ``error``, ``reached``, ``history``. A solution with flags is never ``reached``.

    Raises
    ------
    ValueError
        For bad input, a ``make`` that returns no cloud or never uses its spacing, and whatever ``js.solve``
        refuses.
    SolveError
        Where no cloud could be solved on.

    Examples
    --------
    An L-shaped domain, whose corner is found by the estimate alone:

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> corner = [(0, 0), (1, 0), (1, 1), (-1, 1), (-1, -1), (0, -1)]
    >>> problem = js.Problem(
    ...     lambda u, x: js.laplacian(u)(x) + 1.0, {"boundary": js.dirichlet(0.0)}
    ... )
    >>> found = js.adapt(
    ...     problem, lambda spacing: js.from_polygon(corner, spacing), 5e-3
    ... )
    >>> found.reached, found.error < 5e-3
    (True, True)
    """
    options = _checked(problem, make, tol, order, start, quantity, norm, max_particles, max_rounds, solve_options)
    began = time.perf_counter()
    with bar("adapt", wanted=progress, parts=(("rounds", 1.0),)) as shown:
        cloud, spacing = first_cloud(make, start)
        search = Rounds(problem, make, float(tol), order, quantity, norm, max_particles, max_rounds, options, began)
        search.run(cloud, spacing, shown)
    return Adapted(
        search.solution, search.solution.cloud, search.error, search.reached, float(tol), search.history(),
        search.number, search.flags, search.messages,
    )  # fmt: skip


def _checked(problem, make, tol, order, start, quantity, norm, max_particles, max_rounds, options) -> dict[str, Any]:
    """Arguments judged before any work; the options of a solve."""
    if not isinstance(problem, Problem):
        raise ValueError(f"problem: expected a js.Problem, got {type(problem).__name__}")
    refuse_extras(problem)
    refuse_no_maker(make)
    if not is_number(tol) or not 0.0 < tol < 1.0:
        raise ValueError(f"tol: expected a relative error between 0 and 1, got {short(tol)}")
    if not is_one_of(order, ["auto"]) and not is_whole(order, 1):
        raise ValueError(f'order: expected "auto" or a whole number from 1 to {ORDERS[-1]}, got {short(order)}')
    if order != "auto" and order > ORDERS[-1]:
        raise ValueError(
            f"order: {order} leaves no higher one to estimate the error with; {ORDERS[-1]} is the highest here"
        )
    if start is not None and not callable(start):
        if not is_number(start) or start <= 0:
            raise ValueError(f"start: expected a positive spacing or a function (M, D) -> (M,), got {short(start)}")
    if quantity is not None and not callable(quantity):
        raise ValueError(f"quantity: expected a function of a Solution that returns a number, got {short(quantity)}")
    refuse_word("norm", norm, NORMS)
    for value, name in ((max_particles, "max_particles"), (max_rounds, "max_rounds")):
        if not is_whole(value, 1):
            raise ValueError(f"{name}: expected a whole number from 1, got {short(value)}")
    for name in options:
        if name in ("stencils", "kernel", "throw"):
            raise ValueError(
                f"{name}: belongs to one cloud, and js.adapt makes others; leave it out, or solve on found.cloud after"
                if name != "throw"
                else "throw: js.adapt refines where a solve fails, and raises what remains; leave it out"
            )
        if name not in OPTIONS:
            raise ValueError(
                f"{name}: no argument of js.adapt or js.solve; those of js.solve are {', '.join(OPTIONS)}"
                + did_you_mean(name, [*OPTIONS, "order", "start", "quantity", "norm", "max_particles", "max_rounds"])
            )
    u0 = options.get("u0")
    if u0 is not None and not callable(u0):
        raise ValueError("u0: expected a function of x: the particles change from round to round")
    return dict(options)
