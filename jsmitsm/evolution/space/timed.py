"""A problem in time as the package knows problems: t is one more parameter, rates are slots of the record.

The residual R(u, x, t) is recorded once and seen in parts:

    M2 u_tt + M1 u_t + L u + C u + N(u, x, t) = 0

L and C hold the slots whose coefficients depend neither on u nor on t, N all the rest, the source too. C are the values
of u beside their derivatives: like the rates a source of the recursion, known at the particles. In it, their weight
against that of the derivatives would grow with the stencil's square, and turn the sign of rows that look one way.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.closing import closed
from jsmitsm.equation.field import RATE
from jsmitsm.equation.problem import Problem, of_parts
from jsmitsm.equation.traced import Traced
from jsmitsm.equation.tracing import moving, restricted, trace
from jsmitsm.evolution.space.incompressible import Flow, flow_of, with_pressure_equation
from jsmitsm.runtime.collector import uncollected
from jsmitsm.runtime.errors import IN_FUNCTIONS, of_the_pde
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.taylor.multi_indices import Slot

# The time is the first leaf of the parameters.
TIME = 0
# What functions call the time and the normal.
TIMES, NORMAL = ("t", "time"), ("n", "normal")


@dataclass
class Timed:
    """The parts of a problem in time; every record takes the parameters (t, params).

    problem : closed, its pde the record of L. rest: N. masses: coefficients of the first and the second rate. apart: C.
    steady : whether neither N at u = 0 nor a condition depends on t.
    quasilinear : whether N holds derivatives of the order of an equation. space: the whole residual without rates.
    flow: of an incompressible flow, whose constraint has become an equation for the pressure.
    """

    problem: Problem
    space: Traced
    rest: Traced
    masses: tuple[Traced, ...]
    apart: Traced
    steady: bool
    quasilinear: bool
    flow: Flow | None = None

    @property
    def operator(self) -> Traced:
        """The record of L."""
        assert isinstance(self.problem.pde, Traced)
        return self.problem.pde

    @property
    def order(self) -> int:
        """That of the highest derivatives in space."""
        return max(self.space.order)

    @property
    def linear(self) -> bool:
        return not self.rest.slots

    @property
    def values(self) -> bool:
        """Whether C is anything."""
        return bool(self.apart.slots)

    @property
    def sourced(self) -> np.ndarray:
        """The equations (E,) whose sources matter."""
        found = np.zeros(self.problem.fields, bool)
        for record in (*self.masses, self.apart, self.rest):
            found |= record.pattern.any(axis=1) if record.slots else record.source != "zero"
        return found

    def at(self, t: Any, params: Any = None) -> Problem:
        """The closed problem at a moment; params: others than its own."""
        return at_moment(self.problem, t, params)

    def mass(self, order: int, points: Any, params: Any) -> Any:
        """Coefficients (N, E, F) of the rates of this order; of order 0 those of C."""
        record = self.masses[order - 1] if order else self.apart
        n, fields = len(points), self.problem.fields
        columns: list[Any] = [np.zeros((n, fields))] * fields
        if record.slots:
            jac, _ = record.coefficients(points, 0, params=params)
            xp = jnp if is_traced(jac) else np
            for s, (k, _) in enumerate(record.slots):
                columns[k % RATE] = xp.broadcast_to(jac[:, s, 0], (fields, n)).T
        return (jnp if is_traced(columns) else np).stack(columns, axis=2)


def at_moment(problem: Problem, t: Any, params: Any) -> Problem:
    """A closed problem of the parameters (t, params) at a moment; params: None for its own."""
    return of_parts(problem.pde, problem.bcs, problem.fields, (t, problem.params[1] if params is None else params))


def timed(problem: Problem, cloud: Cloud) -> Timed:
    """Record a problem in time; ValueError where it is none."""
    with_params = problem.params is not None
    pde = in_time(problem.pde, with_params, (("u, x, t", 3),), "pde", "js.Problem")
    bcs = {
        name: [condition_in_time(c, with_params, f"bcs[{name!r}]") for c in conditions]
        for name, conditions in problem.bcs.items()
    }
    stated = Problem(pde, bcs, problem.fields, (np.asarray(0.0), problem.params))
    whole = _recorded(stated, cloud.dim)
    flow = flow_of(stated, whole, cloud)
    if flow is not None:
        stated, flow = with_pressure_equation(stated, whole, flow, cloud)
        whole = _recorded(stated, cloud.dim)
    changing, source_moves = moving(whole, TIME)
    rates = [[s for s in whole.slots if s[0] // RATE == j] for j in (1, 2)]
    _check_rates(rates, changing)
    _check_constraints(whole, problem.fields)
    apart = _apart(whole, changing)
    space = [s for s in whole.slots if s[0] < RATE and s not in apart]
    linear = [s for s in space if s not in changing]
    operator, rest, still, *masses, values = restricted(
        whole, (linear, True), ([s for s in space if s in changing], False), (space, False),
        *((slots, True) for slots in (*rates, apart)),
    )  # fmt: skip
    orders = [max((sum(b) for (_, b), p in zip(whole.slots, row) if p), default=-1) for row in whole.pattern]
    problem_in_time = closed(stated, whole)
    problem_in_time.pde = operator  # type: ignore[assignment]
    condition_moves = check_conditions(problem_in_time)
    return Timed(
        problem_in_time, still, rest, tuple(masses), values,
        not source_moves and not condition_moves,
        any(m > max(o, 0) for m, o in zip(orders, operator.order)),
        flow,
    )  # fmt: skip


def _apart(whole: Traced, changing: set[Slot]) -> list[Slot]:
    """The slots of C: values in equations of second order and more, where these determine a field each without them."""
    kind = np.array([(k // RATE, k % RATE, sum(b)) for k, b in whole.slots])
    order = np.where(whole.pattern & (kind[:, 0] == 0), kind[:, 2], -1).max(axis=1, initial=-1)
    leads = whole.pattern & (kind[:, 0] == 0) & ((kind[:, 2] == order[:, None]) | (order < 2)[:, None])
    determined = np.stack([leads[:, kind[:, 1] == k].any(axis=1) for k in range(whole.fields)], axis=1)
    if (_partners(determined) < 0).any():
        return []
    beside = ~(whole.pattern & (order < 2)[:, None]).any(axis=0)
    return [s for s, one, m in zip(whole.slots, beside, kind) if one and not m[0] and not m[2] and s not in changing]


def _partners(stands: np.ndarray) -> np.ndarray:
    """The row of each column, none of them twice; -1 where there is none."""
    with uncollected():
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import maximum_bipartite_matching

    return maximum_bipartite_matching(csr_array(stands), perm_type="row")


def _recorded(stated: Problem, dim: int) -> Traced:
    """The record of the whole residual."""
    try:
        whole = trace(stated.pde, dim, stated.fields, params=stated.params)  # type: ignore[arg-type]
    except IN_FUNCTIONS as error:
        raise ValueError(of_the_pde(error)) from error
    if whole.n_equations != stated.fields:
        raise ValueError(
            f"pde: returns {whole.n_equations} residual(s) for fields={stated.fields}; a system of F fields needs F"
        )
    slope = next((k for k, b in whole.slots if k >= RATE and any(b)), None)
    if slope is not None:
        of = f" of field {slope % RATE}" if stated.fields > 1 else ""
        raise ValueError(
            f"pde: it holds a derivative in space of a rate{of}; write a derivative of a rate as an unknown of its "
            "own: a second field v, js.dt(u)(x) - v(x) = 0 its equation, and v in the place of js.dt(u) (docs: time)"
        )
    return whole


def _check_rates(rates: list[list[Slot]], changing: set[Slot]) -> None:
    if not rates[0] and not rates[1]:
        raise ValueError("pde: no rate in it; write js.dt(u)(x) where u changes in time, or use js.solve")
    for slot in [*rates[0], *rates[1]]:
        if slot in changing:
            raise ValueError(
                f"pde: the coefficient of the rate of field {slot[0] % RATE} depends on u or on t; divide the equation "
                "by it, so that js.dt(u)(x) stands alone or with a factor that depends on x"
            )


def _check_constraints(whole: Traced, fields: int) -> None:
    """ValueError unless the equations without a rate determine the fields without one."""
    field, kind = (np.array([s[0] % RATE for s in whole.slots]), np.array([s[0] // RATE for s in whole.slots]))
    still = np.setdiff1d(np.arange(fields), field[kind > 0])
    if not len(still):
        return
    without = np.flatnonzero(~whole.pattern[:, kind > 0].any(axis=1))
    stands = np.array([whole.pattern[:, (kind == 0) & (field == k)].any(axis=1) for k in still], bool)[:, without]
    found = _partners(stands.T)
    if (found < 0).any():
        names = ", ".join(str(k) for k in still[found < 0])
        raise ValueError(
            f"pde: field {names} has no rate, and no equation without a rate determines it: a constraint of index 2, "
            "of which js.evolve knows div u = 0 of incompressible flow alone; differentiate the constraint until it "
            "holds the field"
        )


def check_conditions(problem: Problem) -> bool:
    """Whether a condition's value depends on t; ValueError where its form does, or where it is nonlinear."""
    found = False
    for name, conditions in problem.bcs.items():
        for c in conditions:
            for part, value in c.parts.items():
                if not isinstance(value, Traced):
                    continue
                slots, rest = moving(value, TIME)
                if slots:
                    raise ValueError(
                        f"bcs[{name!r}]: the condition is nonlinear in u, or a coefficient of u in it depends on t; "
                        "js.evolve takes conditions that are linear, with values that may depend on t: write the "
                        "nonlinear part as the flux of a field of its own, or linearise it"
                    )
                if rest and part in ("a", "b"):
                    raise ValueError(f"bcs[{name!r}].{part}: it depends on t; only the value of a condition may")
                found = found or rest
    return found


def condition_in_time(c: Condition, with_params: bool, where: str) -> Condition:
    forms = (("u, x, n, t", 4), ("u, x, n", 3), ("u, x, t", 3)) if c.kind == "condition" else (("x, t", 2), ("x", 1))

    def one(name: str, part: Any) -> Any:
        return in_time(part, with_params, forms, f"{where}.{name}", c.kind) if callable(part) else part

    return Condition(c.kind, c.field, **{name: one(name, part) for name, part in c.parts.items()})


def in_time(function: Callable[..., Any], with_params: bool, forms: Any, where: str, kind: str) -> Callable[..., Any]:
    """A user's function of t as one of the parameters (t, params)."""
    # Functions that leave out the params are known by the names of their arguments.
    fitting = [(names, tail) for tail in sorted({with_params, False}, reverse=True) for names, count in forms
               if _takes(function, count + tail, names, tail < with_params)]  # fmt: skip
    if not fitting:
        raise ValueError(
            f"{where}: js.evolve calls it as f({forms[0][0]}{', params' if with_params else ''}), with the time t"
            + (", and params last" if with_params else "") + "; it takes other arguments"
        )  # fmt: skip
    names, with_params = fitting[0]

    def last(p: Any) -> tuple[Any, ...]:
        return ((p[0],) if names.endswith("t") else ()) + ((p[1],) if with_params else ())

    if names == "u, x, n" and kind == "condition":
        return lambda u, x, n, p: function(u, x, n, *last(p))
    if names == "u, x, t" and kind == "condition":
        return lambda u, x, n, p: function(u, x, *last(p))
    if names.startswith("a, b"):
        return lambda a, b, x, n, p: function(a, b, x, n, *last(p))
    if names.startswith("u, x, n"):
        return lambda u, x, n, p: function(u, x, n, *last(p))
    if names == "u, x, t":
        return lambda u, x, p: function(u, x, *last(p))
    return lambda x, p: function(x, *last(p))


def _takes(function: Callable[..., Any], count: int, names: str, named: bool) -> bool:
    """Whether a function takes so many arguments, those of these names.

    Numbers kept in defaults, as in lambda x, c=c: c * x[0], do not take the place of the time nor of the normal. An
    argument called t is the time and one called n the normal, and so no other. Else it is the place that counts, as in
    js.solve: the third argument of a condition is the normal, whatever its name. named: time and normal are called so.
    """
    try:
        signature = inspect.signature(function)
        signature.bind(*[None] * count)
    except TypeError:
        return False
    except ValueError:  # a callable without a signature
        return not named
    meant = names.split(", ")
    for k, one in enumerate(list(signature.parameters.values())[:count]):
        role, kept = meant[k] if k < len(meant) else "", one.default is not inspect.Parameter.empty
        if one.name in TIMES and not kept and role != "t":
            return False
        if one.name in NORMAL and role not in ("n", ""):
            return False
        if role == "t" and one.name not in TIMES and (named or kept):
            return False
        if names == "u, x, n" and role == "n" and one.name not in NORMAL and (named or kept):
            return False
    return True
