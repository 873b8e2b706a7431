"""Solve a problem with constraints: the bordered system, in Newton steps where something is not linear."""

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
from jsmitsm.runtime.jaxprs import used_inputs
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.runtime.whole_program import in_one_program
from jsmitsm.solution.fit import Fit, Recipe
from jsmitsm.solution.regions.fit import RegionsFit
from jsmitsm.solution.unknowns.bordered import Bordered, BorderedRegionsRun
from jsmitsm.solution.unknowns.joint_newton import joint_newton
from jsmitsm.solution.unknowns.lines import Lines
from jsmitsm.solution.unknowns.solution import ConstrainedRegionsSolution, ConstrainedSolution, WithUnknowns
from jsmitsm.taylor.multi_indices import HIGHEST

# Steps of Newton's method for constraints that are not linear.
STEPS = 20
# An unknown enters linearly if twice as much of it does twice as much, up to round-off.
LINEAR = 1e-9

# (order, unknowns, values of a nonlinear problem or None) -> the values at another order, which begins there.
Again = Callable[[int, dict[str, Any], Any], Any]


class Compared:
    """A fit whose error estimate is the distance to the solution of another order, unknowns and all; its integrals take
    another rule too, or what both orders' rules miss alike would go untold."""

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
    problem: Problem, run: Bordered, recipe: Recipe, again: Again, u0: Any = None
) -> WithUnknowns:
    """The solution of a problem with constraints, from the run of its plain problem.

    recipe: of the solution, once the run has assembled; again: the values at another order.
    """
    assert problem.extras is not None
    start = floats(problem.extras.unknowns)
    _check(problem, run)
    if run.term is not None:
        run.term.weigh(run.disc.cloud, recipe.order, recipe.otherwise)
        run.solver = "dense" if run.solver == "auto" else run.solver
    run.multipliers = not start and run.term is None
    answer = _response(run, start) if run.disc.linear else None
    recipe = replace(recipe, formulation=run.formulation)
    lines = Lines(problem, run, recipe)
    if answer is None:
        return _jointly(run, lines, start, recipe, again, u0)
    if not lines.constraints:
        x, good = _solved(run, answer)
        return _finished(run, start, with_held(run.disc, answer.nums, x), None, good, 1, recipe, again)
    unknowns, values, good, linearly, steps = _linearly(run, lines, answer, start)
    if start:
        known = concrete(linearly)
        if _bends(run, start) if known is None else not bool(known):
            run.go(start)
            return _jointly(run, lines, start, recipe, again, u0)
        good = good & linearly
    return _finished(run, unknowns, values, None, good, steps, recipe, again)


def _linearly(run: Bordered, lines: Lines, answer: Response, start: dict[str, Any]) -> tuple[Any, Any, Any, Any, int]:
    """Unknowns, values, whether the constraints are met, whether the unknowns entered linearly, and the steps.

    Equation and conditions are taken to be linear in both; where they are not it ends.
    """
    disc, names, count = run.disc, lines.names, len(lines.constraints)
    run.columns, run.names = run.constants() if run.multipliers else -answer.columns, names
    free = np.flatnonzero(~disc.held.reshape(-1))
    # Linear constraints do not care where they are linearised; others must not have a flat spot there.
    unknowns, values, good = start, with_held(disc, answer.nums, np.ones(len(free))), True
    linearly: Any = True
    for step in range(1, STEPS + 1):  # noqa: B007
        rest, by_value, by_unknown = lines.slopes(values, unknowns)
        away = jnp.stack([unknowns[n] - start[n] for n in names]) if names else jnp.zeros(0)
        # The constraints are written about u = the held values at the start, g = the start.
        moved = by_value @ (with_held(disc, answer.nums, np.zeros(len(free))) - values).reshape(-1) - by_unknown @ away
        corner = by_unknown + by_value @ answer.held.reshape(len(names), -1).T if names else None
        run.lines, run.right = _host(lines.of_free(by_value)), _host(-(rest + moved))
        run.corner = np.zeros((count,) * 2) if corner is None else _host(corner)
        x, well = _solved(run, answer)
        if names:
            unknowns = {n: start[n] + run.extra[k] for k, n in enumerate(names)}
            linearly = _entered_linearly(run, answer, start, unknowns)
        change = sum((answer.held[k] * (unknowns[n] - start[n]) for k, n in enumerate(names)), 0.0)
        values = with_held(disc, answer.nums, x) + change
        rest = lines.missed(values, unknowns)
        met = lines.met(rest, by_value, by_unknown, values, unknowns)
        good = good & well
        if concrete(met) is None or bool(concrete(met)) or not bool(concrete(jnp.isfinite(rest).all())):
            break
        if not bool(concrete(linearly)):
            break
    if not is_traced(values, unknowns, met):
        told = f"the constraints are not met after {step} step(s) of Newton's method; are they possible?"
        if linearly and not (bool(good) and bool(met)) and not run.failed and np.isfinite(values).all():
            run.fail(told)
    return unknowns, values, good & met, linearly, step


def _jointly(
    run: Bordered, lines: Lines, start: dict[str, Any], recipe: Recipe, again: Again, u0: Any
) -> WithUnknowns:
    """Where the problem is not linear in its values and unknowns."""
    if run.term is not None:
        raise ValueError(
            "integral: with an integral term unknowns enter as sources and as values of conditions, linearly; these "
            "multiply u or enter nonlinearly"
        )
    found, good, steps = joint_newton(run, lines, start, u0)
    unknowns = {n: found.unknowns[k] for k, n in enumerate(lines.names)}
    recipe = replace(recipe, formulation=run.formulation, depth=run.disc.rec.depth)
    return _finished(run, unknowns, found.values, found.taylor, good, steps, recipe, again)


def _finished(
    run: Bordered, unknowns: dict[str, Any], values: Any, taylor: Any, good: Any, steps: int, recipe: Recipe,
    again: Again,
) -> WithUnknowns:  # fmt: skip
    """Judge what came out, and hand it on."""
    cloud, traced = run.disc.cloud, is_traced(values, unknowns)
    plain = run.fit(unknowns, values, recipe, taylor)
    if not traced:
        values = np.asarray(values)
        run.go(unknowns, values)
        run.nums, run.values = run.numbers(taylor), values
        told = run.term and run.term.coarse()
        if told:
            run.object(told)
        good = bool(good) and not run.failed and bool(np.isfinite(values).all())
    run.seconds["total"] = time.perf_counter() - run.began
    several, stats = isinstance(run, BorderedRegionsRun), run.stats()
    kind: Any = ComparedRegionsFit if several else ComparedFit
    own = kind(*plain.tree_flatten()[0], recipe)
    near = None if taylor is None else values
    own.again = None if traced else lambda order: again(order, unknowns, near)
    return (ConstrainedRegionsSolution if several else ConstrainedSolution)(
        values, cloud, recipe, own, good, steps, stats, report=None if traced else run, unknowns=unknowns
    )


def _check(problem: Problem, run: Bordered) -> None:
    """As many constraints as unknowns."""
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


def _response(run: Bordered, start: dict[str, Any]) -> Response | None:
    """Assemble at the start, and once more for every unknown moved by one; None where one multiplies u."""
    names = list(start)
    parts: list[Any] = []
    nums = run.numbers()
    data, r, c, right = run.assembled(nums, parts)
    run.system, run.squares = (data, r, c), parts
    columns, held = [], []
    if names and any(concrete(x) is None for x in nums.of_matrix) and _multiplies(run, start):
        return None
    for name in names:
        disc = run.moved({**start, name: start[name] + 1.0})
        there = run.numbers_of(disc)
        if not _same(nums.of_matrix, there.of_matrix):
            return None
        columns.append(run.right_of(there) - right)
        held.append((there.held - nums.held)[run.disc.partner])
    xp: Any = jnp if is_traced(columns, held) else np
    empty = np.zeros((len(right), 0)), np.zeros((0, *np.shape(nums.held)))
    return Response(nums, right, *((xp.stack(columns, 1), xp.stack(held)) if names else empty))


def _multiplies(run: Bordered, start: dict[str, Any]) -> bool:
    """Whether the rows depend on an unknown, where no number tells."""

    def rows(unknowns: dict[str, Any]) -> list[Any]:
        return [x for x in run.numbers_of(run.moved(unknowns)).of_matrix if concrete(x) is None]

    return any(used_inputs(jax.make_jaxpr(rows)(start).jaxpr))


def _bends(run: Bordered, start: dict[str, Any]) -> bool:
    """Whether an unknown enters source or conditions other than linearly, where no number tells: the slope knows it."""

    def parts(unknowns: dict[str, Any]) -> tuple[Any, Any]:
        nums = run.numbers_of(run.moved(unknowns))
        return run.right_of(nums), nums.held

    def slope(unknowns: dict[str, Any]) -> Any:
        return jax.jvp(parts, (unknowns,), (dict.fromkeys(unknowns, jnp.ones(())),))[1]

    return any(used_inputs(jax.make_jaxpr(slope)({n: jnp.asarray(v, float) for n, v in start.items()}).jaxpr))


def _same(one: list[Any], two: list[Any]) -> bool:
    """Whether numbers are the same, as far as they are known."""
    pairs = [(concrete(a), concrete(b)) for a, b in zip(one, two, strict=True)]
    return all(a is None or b is None or np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)


def _entered_linearly(run: Bordered, answer: Response, start: Any, unknowns: Any) -> Any:
    """Whether the unknowns entered as they were taken to."""
    away = [unknowns[n] - start[n] for n in start]
    nums = run.numbers_of(run.moved(unknowns))
    found = (answer.right, answer.columns, run.right_of(nums)), (answer.nums.held, answer.held.T, nums.held)
    return jax.lax.stop_gradient(_straight(away, found))


@in_one_program
def _straight(away: list[Any], found: Any) -> Any:
    """Whether what was, with slopes times the way, is what is there."""
    xp: Any = jnp if is_traced(away, found) else np
    linearly: Any = True
    for parts in found:
        first, slopes, there = map(xp.asarray, parts)
        moved = (slopes @ xp.array(away, float)).T
        size = xp.stack([xp.abs(part).max(initial=0.0) for part in (first, moved, there)]).max()
        linearly &= ~(xp.abs(first + moved - there).max(initial=0.0) > LINEAR * size)  # NaN are told elsewhere
    return linearly


def _solved(run: Bordered, answer: Response) -> tuple[Any, Any]:
    began = time.perf_counter()
    x, good = run.solved(*run.system, answer.right)
    run.seconds["solve"] += time.perf_counter() - began
    if is_traced(x):
        return x, jnp.isfinite(x).all() & good
    return x, bool(good) and bool(np.isfinite(x).all())


def _host(x: Any) -> Any:
    return x if is_traced(x) else np.asarray(x)
