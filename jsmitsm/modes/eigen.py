"""Eigenvalues of an operator on a cloud: the verb."""

from __future__ import annotations

import time
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.discretization.layout import Discretization
from jsmitsm.discretization.pencil.assemble import Pencil
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.unknowns.extras import refuse_extras
from jsmitsm.modes.estimate import errors
from jsmitsm.modes.mass import masses
from jsmitsm.modes.modes import Modes
from jsmitsm.modes.question import Question, assembled, operators, reduced
from jsmitsm.modes.spectrum import in_real_numbers, modes, normalised, pairs
from jsmitsm.runtime.arrays import ValueOrFunction
from jsmitsm.runtime.errors import SolveError, explaining, is_one_of, is_whole, short
from jsmitsm.runtime.progress import PENCIL, bar
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.solution.arguments import Depth, check, of_regions

# A condition's value or a source up to this part of what it stands beside is rounding.
_NOTHING = 1e-12
# The parts of a double value may stand apart by more than their error's estimate, which is of the first order, says.
PARTED = 4.0


@explaining
@bar("eigen", parts=(*PENCIL, ("unknowns", 1.0), ("error estimate", 4.0)))
def eigen(
    problem: Problem,
    cloud: Cloud,
    count: int,
    *,
    near: float = 0.0,
    mass: ValueOrFunction | None = None,
    method: str = "S",
    order: int = 6,
    depth: Depth = "auto",
    stencils: Stencils | None = None,
    throw: bool = True,
) -> Modes:
    """Eigenvalues and modes: numbers lambda and functions u with L u = lambda mass u, and homogeneous conditions.

    L is the residual as it is written: with ``-js.laplacian(u)(x)`` the values are positive. The source's Taylor
    coefficients are fitted to its values, which makes of the rows of method S a pencil A u = lambda B mass u of their
    full order; kin: compact (Mehrstellen) schemes.

    Parameters
    ----------
    cloud : Cloud
        The particles it is solved on.
    problem : Problem
        Linear, without a source, its conditions homogeneous: of zero value. Of any order and number of fields, in
        1D, 2D and 3D; periodic pairs too.
    count : int
        How many values. A multiple one is returned whole, so there may be more; not under ``jax.jit``, where the
        number must be known.
    near : float
        A real number; the values nearest to it are found.
    mass : float, array or function, optional
        A number, an array (F,), or a function of x (and of the problem's params, where it takes two arguments),
        scalar or (F,), with several regions also a dict of these by region; 1 if not given. Equation k has the mass
        times field k on its right-hand side; zero for an equation without it. Or an operator like the pde, a function
        of (u, x) (and params), of a lower order than the pde: ``lambda u, x: -js.laplacian(u)(x)`` for buckling.
    method : {"S"}
        "S", the only one whose rows know their source.
    order : int
        The degree of the expansions. Errors of values fall as the spacing to the power of the order, or faster.
    depth : int or "auto"
        Degrees beyond the order of the recursion and of the fit of the source. "auto" is 2 in 1D and 2D, where it
        gains a factor of 30 to 400, about as much as two orders more do; 0 in 3D and on clouds
        of too few particles for it.
    stencils : Stencils, optional
        From ``js.stencils``; needed where JAX traces the points.
    throw : bool
        Raise where the values are not found; otherwise ``converged`` is False.

    Returns
    -------
    Modes
        ``.values`` (k,), ``.u`` (N, k) or (N, k, F), ``modes(j, points)``, ``.error_estimate()`` (k,), ``.flags``.
        Values and modes are differentiable with respect to params, points and whatever the pde closes over; values of
        a cluster with the derivative of their mean, modes of simple values only.

    Raises
    ------
    ValueError
        For bad input, with the argument, what came, what was expected and what to do.
    SolveError
        Where the values are not found.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> string = js.Problem(lambda u, x: -js.laplacian(u)(x), ends)
    >>> modes = js.eigen(string, js.interval(0.0, 1.0, 41), 3)
    >>> [round(float(value) ** 0.5 / 3.14159265, 4) for value in modes.values]
    [1.0, 2.0, 3.0]
    """
    start = time.perf_counter()
    check(problem, cloud, "S", order, None, stencils, throw=throw, depth=depth)
    check_question(problem, count, near, method)
    weights, massed = masses(problem, cloud, mass)
    of_regions(problem, cloud)
    pencil = assembled(problem, cloud, order=order, mass=tuple(massed), stencils=stencils, depth=depth)
    disc = pencil.layout.disc
    refuse_data(disc, pencil)
    refuse_mass(pencil, massed)
    fields = problem.fields
    local = time.perf_counter()
    pattern, stiff, inert = reduced(pencil, problem, weights)
    a, c = stiff.values, inert.values
    with_mass = int(massed[pencil.free % fields].sum())
    if count > with_mass:
        raise ValueError(
            f"count: {count} values asked for, but only {with_mass} of the {len(cloud)} particles' values have an "
            "equation with a mass; ask for fewer (a tenth of them is resolved well), or refine the cloud"
        )
    question = Question(
        problem, mass, float(near), order, pencil.layout.disc.rec.depth, pencil, weights, massed, stiff, inert
    )
    size = float(len(cloud))
    known_a, known_c = (concrete(x) for x in (a, c))
    if known_a is None or known_c is None:
        values, right, *_ = modes(pattern, a, c, float(near), int(count), size)
        return _finished(question, values, right, jnp.isfinite(values).all(), None, {})
    try:
        found = pairs(pattern, np.asarray(known_a), np.asarray(known_c), float(near), int(count), True)
    except SolveError:
        if throw:
            raise
        nothing = np.full((len(pencil.free), count), np.nan)
        return _finished(question, nothing[0], nothing, False, None, {})
    if is_traced(a, c):
        values, right, *_ = modes(pattern, a, c, float(near), len(found.values), size)
        return _finished(question, values, right, True, None, {})
    small = np.abs(found.values.imag) <= 1e-12 * np.abs(found.values)
    if not small.all():
        # Parts of a double value may come as a complex pair, whose imaginary part is an error.
        error = np.maximum(PARTED * errors(question, found), 1e-10 * np.abs(found.values))
        small = np.abs(found.values.imag) <= error
    found = normalised(in_real_numbers(found, small), size)
    ended = time.perf_counter()
    stats = {
        "particles": len(cloud), "unknowns": pattern.n, "depth": question.depth,
        "neighbours": max(cls.neighbours.shape[1] for cls, _ in pencil.layout.classes),
        "seconds": {"local": local - start, "modes": ended - local, "total": ended - start},
    }  # fmt: skip
    return _finished(question, found.values, found.right, True, found, stats)


def _finished(question: Question, values: Any, right: Any, good: Any, found: Any, stats: dict[str, Any]) -> Modes:
    """The modes on all particles: zero where values are held, a partner's value where it lends it."""
    pencil = question.pencil
    disc = pencil.layout.disc
    xp = jnp if is_traced(right) else np
    shape = (*disc.held.shape, right.shape[1])
    if is_traced(right):
        whole: Any = jnp.zeros((disc.held.size, right.shape[1])).at[pencil.free].set(right)
    else:
        right = np.asarray(right)
        whole = np.zeros((disc.held.size, right.shape[1]), right.dtype)
        whole[pencil.free] = right
    u = xp.swapaxes(whole.reshape(shape)[disc.partner], 1, 2)  # (N, k, F)
    return Modes(values, u, disc.cloud, good, stats, question, found)


def check_question(problem: Problem, count: Any, near: Any, method: Any) -> None:
    """Arguments that can be judged before any work."""
    refuse_extras(problem)
    if not is_one_of(method, ["S"]):
        raise ValueError(
            f"method: {short(method)} has no pencil: only the rows of method \"S\" know their source; leave it out"
        )
    if not is_whole(count, 1):
        raise ValueError(f"count: expected a whole number of values from 1, got {short(count)}")
    if is_traced(near):
        raise ValueError("near: it is traced by a JAX transform, but says which values are sought; give a number")
    if isinstance(near, (bool, str, np.timedelta64)) or np.ndim(near) or np.iscomplexobj(near) or not _finite(near):
        raise ValueError(f"near: expected a finite real number, got {short(near)}")


def _finite(value: Any) -> bool:
    try:
        return bool(np.isfinite(float(value)))
    except (TypeError, ValueError, OverflowError):
        return False


def refuse_data(disc: Discretization, pencil: Pencil) -> None:
    """Values of conditions and sources, which an eigenvalue problem has none of."""
    for one, _ in operators(pencil):
        source = one.traced.coefficients(one.cloud.points, 0, params=one.problem.params)[1]
        if source is not None and not is_traced(source) and np.abs(source).max(initial=0.0) > 0.0:
            raise ValueError(
                "pde: it has a source, a part without u, but modes are of L u = lambda mass u; leave that part out"
            )
    held, given = (concrete(x) for x in (pencil.held_values, pencil.conditions))
    for values in (held, given):
        if values is not None and np.abs(np.asarray(values)).max(initial=0.0) > _NOTHING:
            raise ValueError(
                f"bcs: {_culprit(disc)} a value other than zero, but the conditions of modes are homogeneous; set "
                "the values to 0.0"
            )


def refuse_mass(pencil: Pencil, massed: np.ndarray) -> None:
    """A mass at a field that its equation lacks, and of which none has a derivative: nothing makes it a function."""
    for one, _ in operators(pencil):
        traced = one.traced
        for k in np.flatnonzero(massed):
            mine = [s for s, (field, _) in enumerate(traced.slots) if field == k]
            derived = any(sum(traced.slots[s][1]) for s in mine)
            if not derived and not any(traced.pattern[k][s] for s in mine):
                raise ValueError(
                    f"mass: equation {k} has one, which multiplies u[{k}], but neither has that equation u[{k}] in it, "
                    f"nor any one a derivative of it; write the operator that u[{k}] stands for as the mass, as in "
                    "mass=lambda u, x: -js.laplacian(u)(x)"
                )


def _culprit(disc: Discretization) -> str:
    """The group whose condition has a value."""
    for group in disc.groups:
        held = [np.asarray(concrete(value())) for value in group.held.values()]
        parts = [np.asarray(concrete(part.numbers(None)[1])) for part in group.parts if part.linear]
        if any(np.abs(x).max(initial=0.0) > _NOTHING for x in (*held, *parts)):
            return f"the condition of {group.name!r} has"
    return "a condition has"
