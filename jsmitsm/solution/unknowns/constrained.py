"""Solve a linear problem with constraints: the bordered system, in Newton steps where a constraint is not linear."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.leave_one_out import with_held
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.unknowns.stated import floats
from jsmitsm.runtime.errors import IN_FUNCTIONS, in_words
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.solution.fit import Fit, Recipe
from jsmitsm.solution.regions.fit import RegionsFit
from jsmitsm.solution.unknowns.bordered import Bordered, BorderedRegionsRun
from jsmitsm.solution.unknowns.solution import (
    ConstrainedRegionsSolution,
    ConstrainedSolution,
    Probe,
    RegionsProbe,
    WithUnknowns,
)
from jsmitsm.taylor.multi_indices import HIGHEST

# A constraint is met when it misses by this part of what it is made of; round-off of the fits leaves 1e-12.
MET, STEPS = 1e-9, 20
# An unknown enters linearly if twice as much of it does twice as much, up to round-off.
LINEAR = 1e-9


class Compared:
    """A fit whose error estimate is the distance to the solution of another order, unknowns and all."""

    recipe: Recipe
    again: Callable[[int], Any] | None = None  # the values at another order

    @bar("error estimate")
    def error_estimate(self, values: Any) -> Any:
        if self.again is None:
            raise ValueError(
                "error_estimate: this solution went through a JAX transform, which kept nothing to compare it with; "
                "ask the one that js.solve returned"
            )
        order = self.recipe.order
        error = abs(self.again(order + 2 if order + 2 <= HIGHEST else order - 2) - values)
        return error[:, 0] if self.recipe.fields == 1 else error


@jax.tree_util.register_pytree_node_class
class ComparedFit(Compared, Fit):
    """In one region."""


@jax.tree_util.register_pytree_node_class
class ComparedRegionsFit(Compared, RegionsFit):
    """In several regions."""


@dataclass
class Response:
    """How the system answers to the unknowns: numbers at the start, change of right-hand side and held values."""

    nums: Any
    right: Any  # (n,)
    columns: Any  # (n, K)
    held: Any  # (K, N, F)


def solve_constrained(
    problem: Problem, run: Bordered, recipe: Recipe, again: Callable[[int], Any]
) -> WithUnknowns:
    """The solution of a problem with constraints, from the run of its plain problem.

    recipe: of the solution, once the run has assembled; again: the values at another order.
    """
    assert problem.extras is not None
    constraints, start = problem.extras.constraints, floats(problem.extras.unknowns)
    _check(problem, run)
    disc, names, several = run.disc, list(start), isinstance(run, BorderedRegionsRun)
    if run.term is not None:
        run.term.weigh(disc.cloud, recipe.order)
        run.solver = "dense" if run.solver == "auto" else run.solver
    run.multipliers = not names and run.term is None
    answer = _response(run, start)
    recipe = replace(recipe, formulation=run.formulation)
    if not constraints:
        x, good = _solved(run, answer)
        return _finished(run, answer, start, start, with_held(disc, answer.nums, x), good, 1, recipe, again)

    def missed(values: Any, unknowns: Any) -> Any:
        """By how much the constraints (K,) are missed."""
        made: Any = RegionsProbe if several else Probe
        probe = made(values, disc.cloud, recipe, run.fit(unknowns, values, recipe), True, 1, {}, unknowns=unknowns)
        return jnp.stack([_value(c, probe, k) for k, c in enumerate(constraints)])

    run.columns = run.constants() if run.multipliers else -answer.columns
    free = np.flatnonzero(~disc.held.reshape(-1))
    # Linear constraints do not care where they are linearised; others must not have a flat spot there.
    unknowns, values, good = start, with_held(disc, answer.nums, np.ones(len(free))), True
    for step in range(1, STEPS + 1):  # noqa: B007
        rest, pull = jax.vjp(missed, jnp.asarray(values, float), unknowns)
        slopes = [pull(row) for row in np.eye(len(constraints))]
        by_value = jnp.stack([v.reshape(-1) for v, _ in slopes])  # (K, N F)
        by_unknown = jnp.stack([jnp.stack([g[n] for n in names]) for _, g in slopes]) if names else jnp.zeros((1, 0))
        lines = _of_free(disc, by_value)
        away = jnp.stack([unknowns[n] - start[n] for n in names]) if names else jnp.zeros(0)
        # The constraints are written about u = the held values at the start, g = the start.
        moved = by_value @ (with_held(disc, answer.nums, np.zeros(len(free))) - values).reshape(-1) - by_unknown @ away
        corner = by_unknown + by_value @ answer.held.reshape(len(names), -1).T if names else None
        run.lines, run.right = _host(lines), _host(-(rest + moved))
        run.corner = np.zeros((len(constraints),) * 2) if corner is None else _host(corner)
        x, well = _solved(run, answer)
        if names:
            unknowns = {n: start[n] + run.extra[k] for k, n in enumerate(names)}
        change = sum((answer.held[k] * (unknowns[n] - start[n]) for k, n in enumerate(names)), 0.0)
        values = with_held(disc, answer.nums, x) + change
        rest = missed(values, unknowns)
        size = abs(by_value) @ abs(values).reshape(-1) + sum(
            (abs(by_unknown[:, k] * unknowns[n]) for k, n in enumerate(names)),
            abs(jnp.stack([jnp.asarray(c.value, float) for c in constraints])),
        )
        met = jnp.all(abs(rest) <= MET * jnp.where(size > 0, size, 1.0))
        good = good & well
        if concrete(met) is None or bool(concrete(met)) or not bool(concrete(jnp.isfinite(rest).all())):
            break
    return _finished(run, answer, start, unknowns, values, good & met, step, recipe, again)


def _finished(run, answer, start, unknowns, values, good, steps, recipe, again) -> WithUnknowns:
    """Judge what came out, and hand it on."""
    disc, names = run.disc, list(start)
    traced, plain = is_traced(values, unknowns), run.fit(unknowns, values, recipe)
    if not traced:
        values = np.asarray(values)
        if names:
            _refuse_nonlinear(run, answer, start, unknowns)
        run.disc = run.moved(unknowns, values)
        run.problem = run.disc.problem
        run.nums, run.values = run.numbers(), values
        told = run.term and run.term.coarse()
        if told:
            run.object(told)
        if not bool(good) and not run.failed and np.isfinite(values).all():
            run.fail(f"the constraints are not met after {steps} step(s) of Newton's method; are they possible?")
        good = bool(good) and not run.failed and bool(np.isfinite(values).all())
    run.seconds["total"] = time.perf_counter() - run.began
    several, stats = isinstance(run, BorderedRegionsRun), run.stats()
    kind: Any = ComparedRegionsFit if several else ComparedFit
    own = kind(*plain.tree_flatten()[0], recipe)
    own.again = None if traced else again
    return (ConstrainedRegionsSolution if several else ConstrainedSolution)(
        values, disc.cloud, recipe, own, good, steps, stats, report=None if traced else run, unknowns=unknowns
    )


def _check(problem: Problem, run: Bordered) -> None:
    """As many constraints as unknowns, of a problem that is linear in u."""
    assert problem.extras is not None
    constraints, unknowns = problem.extras.constraints, problem.extras.unknowns
    floating = run.disc.floating
    if not run.disc.linear and problem.extras.kernels:
        raise ValueError(
            "integral: the problem is nonlinear in u, and integral terms are made for linear ones; linearise it, and "
            "repeat the solve with what it gave (a Picard iteration)"
        )
    if problem.extras.kernels and run.disc.scheme.method != "S":
        raise ValueError(f'method: {run.disc.scheme.method} is not made for integral terms; use "S"')
    if not run.disc.linear:
        raise ValueError(
            "constraints: the problem is nonlinear in u, and constraints are made for linear ones; solve it for given "
            "unknowns and find them outside, e.g. with scipy.optimize.root on the functional"
        )
    if run.disc.scheme.method in ("I", "II"):
        raise ValueError(f'method: {run.disc.scheme.method} is not made for constraints; use "S", "III" or "SSPH"')
    wanted = len(unknowns) or (0 if problem.extras.kernels else len(floating))
    if len(constraints) != wanted:
        named = f" ({', '.join(unknowns)})" if unknowns else ""
        constant = f"; nothing else fixes the constant of {len(floating)} field(s), which take one each"
        raise ValueError(
            f"constraints: got {len(constraints)} for {len(unknowns)} unknown(s){named}; give one for each unknown"
            + ("" if unknowns else constant if floating else ', e.g. unknowns={"q": 0.0}, and let the pde use it')
        )


def _response(run: Bordered, start: dict[str, Any]) -> Response:
    """Assemble at the start, and once more for every unknown moved by one."""
    names = list(start)
    parts: list[Any] = []
    nums = run.numbers()
    data, r, c, right = run.assembled(nums, parts)
    run.system, run.squares = (data, r, c), parts
    columns, held = [], []
    for name in names:
        disc = run.moved({**start, name: start[name] + 1.0})
        there = run.numbers_of(disc)
        _refuse_in_operator(nums.of_matrix, there.of_matrix, name)
        columns.append(run.right_of(there) - right)
        held.append((there.held - nums.held)[run.disc.partner])
    xp: Any = jnp if is_traced(columns, held) else np
    empty = np.zeros((len(right), 0)), np.zeros((0, *np.shape(nums.held)))
    return Response(nums, right, *((xp.stack(columns, 1), xp.stack(held)) if names else empty))


def _refuse_in_operator(one: list[Any], two: list[Any], name: str) -> None:
    for a, b in zip(one, two, strict=True):
        a, b = concrete(a), concrete(b)
        if a is not None and b is not None and not np.array_equal(np.asarray(a), np.asarray(b)):
            raise ValueError(
                f"unknowns: {name!r} multiplies u or a derivative of it; unknowns enter as sources and as values of "
                "conditions. For an eigenvalue take js.eigen, or a field of its own with zero slope"
            )


def _refuse_nonlinear(run: Bordered, answer: Response, start: Any, unknowns: Any) -> None:
    """The unknowns must have entered as they were taken to."""
    away = np.array([float(unknowns[n] - start[n]) for n in start])
    nums = run.numbers_of(run.moved(unknowns))
    found = (answer.right, answer.columns @ away, run.right_of(nums)), (
        answer.nums.held, np.tensordot(away, answer.held, axes=1), nums.held
    )  # fmt: skip
    for first, moved, there in found:
        size = max(np.abs(part).max(initial=0.0) for part in (first, moved, there))
        if np.isfinite(there).all() and np.abs(first + moved - there).max(initial=0.0) > LINEAR * size:
            raise ValueError(
                f"unknowns: {', '.join(map(repr, start))} enter the equation or the conditions nonlinearly; only "
                "linear terms are made for it: take the term itself for the unknown, as q for exp(a)"
            )


def _solved(run: Bordered, answer: Response) -> tuple[Any, Any]:
    began = time.perf_counter()
    x, good = run.solved(*run.system, answer.right)
    run.seconds["solve"] += time.perf_counter() - began
    if is_traced(x):
        return x, jnp.isfinite(x).all() & good
    return x, bool(good) and bool(np.isfinite(x).all())


def _value(c: Any, probe: Any, k: int) -> Any:
    try:
        found = jnp.asarray(c.functional(probe))
    except IN_FUNCTIONS as error:
        raise ValueError(
            f"constraints[{k}]: calling functional(sol) failed: {in_words(error)}; write it with jax.numpy, of what "
            "sol offers: u, values and derivatives at points, integral, flux, unknowns"
        ) from error
    if found.shape or jnp.iscomplexobj(found):
        raise ValueError(f"constraints[{k}]: functional(sol) must return a real scalar, got shape {found.shape}")
    return found - c.value


def _of_free(disc: Any, by_value: Any) -> Any:
    """Slopes (K, n) by the unknowns, from those by all values (K, N F): a periodic image adds to its partner's."""
    number = disc.unknowns.reshape(-1)
    place = np.flatnonzero(number >= 0)
    count = int((~disc.held).sum())
    return jnp.zeros((len(by_value), count)).at[:, number[place]].add(by_value[:, place])


def _host(x: Any) -> Any:
    return x if is_traced(x) else np.asarray(x)
