"""One linear solve from rows to values: repair, global system, solve, and checks by name."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization import health
from jsmitsm.discretization.coefficients import Numbers, numbers
from jsmitsm.discretization.degenerate import contradiction
from jsmitsm.discretization.held_particles import with_held_expansions
from jsmitsm.discretization.layout import Class, Discretization, discretize
from jsmitsm.discretization.least_squares import least_squares
from jsmitsm.discretization.leave_one_out import matrix, right_side, with_held
from jsmitsm.discretization.operator_kind import prefers_least_squares, usual_condition
from jsmitsm.discretization.rows import all_coefficients, all_rows
from jsmitsm.equation.problem import Problem
from jsmitsm.linear import linsolve
from jsmitsm.particle.moments import Row
from jsmitsm.runtime.errors import SolveError, some
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.solution.balance import imbalance, relative_misfit, spread, unbalanced, with_multiplier
from jsmitsm.solution.flags import flags
from jsmitsm.solution.memory import refuse_too_large
from jsmitsm.solution.statistics import of_run

KEPT = 20_000_000  # polynomials of no more numbers stay for the next who asks
# Under a JAX transform a system is taken for singular whose solution outgrows its right-hand side by so many times the
# usual condition, and data for unbalanced that leave this part of them: there no other order is compared.
GROWN, BALANCED = 1e4, 1e-2
# ... or, in the least-squares form, leave so much of the range in all fits, see ``jsmitsm.solution.balance.EVEN``.
SPREAD = 1e-3


class Run:
    """One call of ``solve``: the discretisation, its options, and what happened."""

    def __init__(
        self, disc: Discretization, problem: Problem, solver: str, throw: bool, repair: bool, formulation: str
    ):
        self.disc, self.problem = disc, problem
        self.solver, self.throw, self.repair = solver, throw, repair
        self.formulation = formulation
        self.began = time.perf_counter()
        self.seconds: dict[str, float] = {"local": 0.0, "assembly": 0.0, "solve": 0.0}
        self.messages: list[str] = []
        self.against: list[str] = []  # those of the messages that speak against the solution
        self.unsettled = np.zeros(0, int)  # particles whose expansions Newton's method kept from moving
        self.failed = False
        self.linear: dict[str, Any] = {}
        self.changes: list[float] = []  # of Newton's steps, relative to the solution
        self.health: health.Health | None = None
        self.imbalance = np.inf  # of a floating field's data, once solved: the mean residual relative to them
        refuse_too_large(self.disc, self.formulation, self.solver)
        # What the last step leaves for the flags; nothing of it under a JAX transform.
        self.rows: tuple[list[Class], list[Row]] | None = None
        self.nums: Numbers | None = None
        self.values: np.ndarray | None = None
        self._polynomials: Any = None  # numbers, values, and the polynomials fitted to them
        self.misses: Any = None  # what these leave of their neighbours, see ``look.reach``
        self.extra: Any = None  # of the last step's unknowns those that are no values of particles

    def numbers(self, taylor: Any = None) -> Any:
        """The numbers of the problem, linearised at the expansions ``taylor`` (N, F, K) where it is nonlinear."""
        return numbers(self.disc, self.problem, taylor)

    def expanded(self, nums: Any, values: Any) -> Any:
        """The expansions (N, F, K) that belong to values (N, F), those of held particles too."""
        return with_held_expansions(self.disc, all_coefficients(self.disc, nums, values))

    def fitted(self, nums: Any, values: Any) -> np.ndarray:
        """The polynomials (N, F, K) of a solution (N, F) at the particles that carry equations, fitted once."""
        known = self._polynomials
        if known is None or known[0] is not nums or not np.array_equal(known[1], values):
            known = nums, values, np.asarray(all_coefficients(self.disc, nums, values), float)
            self._polynomials = known if known[2].size <= KEPT else None
        return known[2]

    def operators(self) -> list[tuple[Discretization, Any, np.ndarray]]:
        """The discretisation of each equation, its numbers, and the particles (of all) where it holds."""
        return [(self.disc, self.nums, np.arange(len(self.disc.cloud)))]

    def local_rows(self, nums: Numbers) -> tuple[list[Class], list[Row]]:
        """The rows of all classes, weak stencils repaired the first time."""
        disc = self.disc
        classes, rows = all_rows(disc, nums)
        if is_traced(rows):
            return classes, rows
        if self.repair and self.health is None and disc.scheme.method in ("S", "III"):
            classes, rows, self.health = health.repaired(disc, nums, classes, rows)
            disc.classes = classes
        else:
            before = self.health
            self.health = health.examine(classes, rows)
            if before is not None:  # Newton's later steps keep the stencils of the first
                self.health.repaired = before.repaired
        self.judge(nums, rows)
        return classes, rows

    def judge(self, nums: Any, rows: list[Row]) -> None:
        """Tell of repairs and weak stencils; fail where rows are not determined."""
        if self.repair:
            self._tell_repairs()
        assert self.health is not None
        bad = self.health.undetermined
        if len(bad) and not all(np.isfinite(np.asarray(own.jac)).all() for own in getattr(nums, "parts", [nums])):
            self.fail(
                f"the equation or its derivative by u is not finite at {len(bad)} particle(s), first {some(bad)}: "
                "start nearer to the solution (u0), inside the range for which the pde is defined",
                bad,
            )
        elif len(bad):
            single = any(np.asarray(row.weights).dtype == np.float32 for row in rows)
            self.fail(
                f"the moment systems of {len(bad)} particle(s) do not determine the solution, first {some(bad)}: too "
                "few neighbours, or neighbours in a special position; "
                + ('enable float64 with jax.config.update("jax_enable_x64", True), ' if single else "")
                + "widen the support (h, d or stencils), lower the order, or move the particles",
                bad,
            )

    def _tell_repairs(self) -> None:
        found = self.health
        if found is not None and len(found.repaired):
            self.messages.append(
                f"{len(found.repaired)} weak stencil(s) were widened or balanced, first {some(found.repaired)}."
            )
        if found is not None and len(found.weak):
            self.messages.append(
                f"{len(found.weak)} particle(s) stay weak (Lebesgue constant above {health.LEBESGUE}, at most "
                f"{found.largest:.3g}), first {some(found.weak)}: the cloud is too coarse or one-sided there."
            )

    def fail(self, message: str, particles: Any = ()) -> None:
        """Raise, or note the failure where the caller asked for that."""
        if self.throw:
            raise SolveError(message, [int(i) for i in np.asarray(particles)[:100]])
        self.failed = True
        self.object(f"FAILED: {message}.")

    def object(self, message: str) -> None:
        """Note what speaks against the solution."""
        self.messages.append(message)
        self.against.append(message)

    def _forget(self) -> None:
        """What an earlier step said speaks of other rows."""
        self.messages, self.against, self.failed, self.unsettled = [], [], False, np.zeros(0, int)
        self.__dict__.pop("factor", None)
        self.__dict__.pop("misfit", None)

    def step(self, nums: Any, altered: Callable[..., Any] | None = None) -> tuple[Any, Any]:
        """Assemble and solve one linear system: values (N, F), and whether it went well.

        altered: a function of the system's entries, their rows and columns and the right-hand side that returns others.
        """
        # What the least-squares form leaves of data that may not balance is looked at below.
        parts: list[Any] | None = [] if self.floating and self.disc.linear and is_traced(vars(nums)) else None
        data, r, c, b = self.assembled(nums, parts)
        if altered is not None:
            data, r, c, b = altered(data, r, c, b)
        start = time.perf_counter()
        x, good = self.solved(data, r, c, b, balanced=self.disc.linear)
        values = with_held(self.disc, nums, x)
        self.seconds["solve"] += time.perf_counter() - start
        if is_traced(values):
            known = concrete(values)
            finite = jnp.isfinite(values) if known is None else np.isfinite(np.asarray(known))
            if parts:
                good &= spread(self.disc, relative_misfit(self.disc, nums, values, parts)) <= SPREAD
            return values, finite.all() & good
        self.keep(nums, values)
        self._check_degenerate(nums, values)
        return values, bool(good and np.isfinite(values).all() and not self.failed)

    def _check_degenerate(self, nums: Numbers, values: np.ndarray) -> None:
        """Where the equation degenerates: conditions that contradict it, and a word on those that repeat it."""
        found = nums.degenerate
        if found is None:
            return
        if len(found.implied):
            self.messages.append(
                f"At {len(found.implied)} particle(s), first {some(found.implied)}, the equation itself says what a "
                "condition does, as on an axis: the condition was left out."
            )
        bad = found.contradicted(float(np.abs(values).max(initial=0.0)))
        if len(bad):
            self.fail(contradiction(bad), bad)

    def assembled(self, nums: Numbers, parts: list[Any] | None = None) -> tuple[Any, Any, Any, Any]:
        """The global system: entries of the matrix, their rows and columns, and the right-hand side.

        parts: see ``jsmitsm.discretization.least_squares.least_squares``.
        """
        clock, disc = time.perf_counter, self.disc
        start = clock()
        self._forget()
        if nums.degenerate is not None and len(nums.degenerate.empty):
            self._fail_empty(nums.degenerate.empty)
        if disc.cut_off:
            self.messages.append(
                f"The supports of at least {len(disc.cut_off)} particle(s), first {some(disc.cut_off)}, reach outside "
                "of the given stencils, which cut them off: build wider stencils, or take a smaller h or d."
            )
        if self.formulation == "auto":
            self.formulation = "lsq" if prefers_least_squares(disc, nums) else "loo"
            refuse_too_large(self.disc, self.formulation, self.solver)
        if self.formulation == "lsq":
            made = least_squares(disc, nums, parts)
            local = clock()
        else:
            self.rows = classes, rows = self.local_rows(nums)
            local = clock()
            made = *matrix(disc, classes, rows), right_side(disc, nums, classes, rows)
        self.seconds["local"] += local - start
        self.seconds["assembly"] += clock() - local
        return made

    def _fail_empty(self, at: np.ndarray) -> None:
        self.fail(
            f"the equation says nothing at {len(at)} particle(s), first {some(at)}: all its coefficients vanish "
            "there and around; hold their values (js.fix), or leave that part out of the cloud",
            at,
        )

    def solved(self, data: Any, r: Any, c: Any, b: Any, balanced: bool = True) -> tuple[Any, bool]:
        """Solve the global system; floating fields get a zero mean by a Lagrange multiplier.

        balanced: the right-hand side is that of a problem, which must balance where a field floats.
        """
        disc = self.disc
        free = np.flatnonzero(~disc.held.reshape(-1))
        n, fields = len(free), disc.rec.fields
        data, r, c, b, points = self._bordered(data, r, c, b)
        try:
            x: Any = linsolve.solve(
                data, r, c, b, n=len(b), points=points, solver=self.solver, elliptic=self._elliptic, info=self.linear
            )
        except linsolve.SingularMatrix as error:
            at = np.array([u for u in error.unknowns if u < n], int)
            particles = free[at] // fields
            self.fail(
                f"{error.args[0].rstrip('.')}: particles {some(particles)}; is a condition missing, a part of the "
                "cloud not connected, or the operator at a resonance?",
                particles,
            )
            return np.full(n, np.nan), False
        values, self.extra = (x[:n], x[n:]) if len(b) > n else (x, np.zeros(0))
        if is_traced(x):
            return values, self._solvable(data, r, c, b, x, points) if balanced else True
        if self.floating and self.formulation != "lsq":
            system = linsolve.factor(data, r, c, len(b), points, self.solver, self._elliptic)
            self.imbalance = imbalance(lambda e: system.solve(e, transpose=True), x, b, n)
            if balanced:
                self.check_balance()
        return values, True

    def keep(self, nums: Numbers, values: np.ndarray) -> None:
        """Keep what a solve leaves for the flags, and judge data whose misfit tells whether they balance."""
        self.nums, self.values = nums, values
        if self.formulation == "lsq" and self.floating and self.disc.linear:
            self.check_balance()

    def _solvable(self, data: Any, r: Any, c: Any, b: Any, x: Any, points: Any) -> Any:
        """Under a JAX transform, where nothing raises: whether the system is regular, and floating data balance."""
        n = int((~self.disc.held).sum())
        known, xp = (concrete(b), concrete(x)), cast(Any, np)
        if any(v is None for v in known):  # else nothing but a derivative is traced, and this has none
            known, xp = (b, x), jnp
        largest, size = (xp.max(xp.abs(xp.asarray(v)), initial=0.0) for v in known)
        good = size <= GROWN * usual_condition(self.disc) * xp.where(largest > 0, largest, 1.0)
        if self.floating:
            data, b, x = jax.lax.stop_gradient((data, b, x))
            turned = lambda e: jnp.stack([
                linsolve.solve(data, c, r, column, n=len(b), points=points, solver=self.solver, elliptic=False)
                for column in e.T
            ], axis=1)  # fmt: skip
            good &= imbalance(turned, x, b, n) <= BALANCED
        return good

    @property
    def floating(self) -> tuple[int, ...]:
        """The fields that get a multiplier, because nothing fixes their constant."""
        return self.disc.floating

    @property
    def least_squares(self) -> bool:
        """Whether equations of the global system come from the least-squares form."""
        return self.formulation == "lsq"

    @property
    def bordering(self) -> int:
        """How many rows and columns the global system has besides those of the particles' values."""
        return len(self.floating)

    @property
    def _elliptic(self) -> bool:
        """Whether multigrid may be expected to work."""
        return self.disc.rec.fields == 1 and not self.bordering

    def _bordered(self, data: Any, r: Any, c: Any, b: Any) -> tuple[Any, Any, Any, Any, Any]:
        """The system and the places of its unknowns; a row and a column more for every floating field."""
        disc = self.disc
        free = np.flatnonzero(~disc.held.reshape(-1))
        points = None if is_traced(disc.cloud.points) else np.asarray(disc.cloud.points)[free // disc.rec.fields]
        for f in disc.floating:
            data, r, c, b = with_multiplier(data, r, c, b, np.flatnonzero(free % disc.rec.fields == f))
            points = None if points is None else np.concatenate([points, np.full((1, points.shape[1]), np.nan)])
        return data, r, c, b, points

    def become(self, other: Run) -> None:
        """Go on as another run of the same problem; what was asked for, and when, stays."""
        mine = {name: getattr(self, name) for name in ("throw", "began")}
        seconds = {name: spent + other.seconds.get(name, 0.0) for name, spent in self.seconds.items()}
        self.__dict__ = {**vars(other), **mine, "seconds": seconds}

    def check_balance(self, taylor: Any = None) -> None:
        """A field without values: its data must balance, up to what the discretisation explains.

        taylor (N, F, K): the expansions about which a nonlinear problem is linearised.
        """
        self.messages.append("The conditions fix the solution only up to a constant; its mean over the particles is 0.")
        told, certain = unbalanced(
            self._rest(), partial(self._imbalance_at, taylor), self.disc.rec.order, self.disc.rec.fields,
            self.disc.linear, self.disc.floating, len(self.operators()) > 1,
        )  # fmt: skip
        if certain:
            self.fail(told)
        elif told:
            self.object(told)

    def _rest(self) -> float:
        """What the data leave where they do not balance, see ``jsmitsm.solution.balance``.

        Of nonlinear ones in the least-squares form only the error estimate tells, which is asked there anyway.
        """
        if self.formulation != "lsq":
            return self.imbalance
        return float(spread(self.disc, self.misfit)) if self.disc.linear else 0.0

    def _imbalance_at(self, taylor: Any, order: int) -> float:
        """The same of the same problem with method S of another order."""
        disc = discretize(self.problem, self.disc.cloud, "S", order, None, None, None, depth=self.disc.rec.depth)
        form = "lsq" if self.formulation == "lsq" else "loo"
        other = Run(disc, self.problem, self.solver, False, form == "loo", form)
        if taylor is not None:
            more = max(0, disc.rec.size - taylor.shape[2])
            taylor = np.pad(taylor, ((0, 0), (0, 0), (0, more)))[:, :, : disc.rec.size]
        nums = numbers(disc, self.problem, taylor)
        x, _ = other.solved(*other.assembled(nums), balanced=False)
        other.nums, other.values = nums, with_held(disc, nums, x)
        return other._rest()

    @cached_property
    def factor(self) -> linsolve.Factor | None:
        """The factors of the last step's system, most often still kept; None before there was one."""
        if self.nums is None:
            return None
        if self.formulation == "lsq":
            data, r, c, _ = least_squares(self.disc, self.nums)
        else:
            assert self.rows is not None
            data, r, c = matrix(self.disc, *self.rows)
        return self.factor_of(data, r, c)

    def factor_of(self, data: Any, r: Any, c: Any) -> linsolve.Factor:
        """The factors of a global system."""
        data, r, c, b, points = self._bordered(data, r, c, np.zeros(int((~self.disc.held).sum())))
        return linsolve.factor(data, r, c, len(b), points, self.solver, self._elliptic)

    @cached_property
    def misfit(self) -> np.ndarray | None:
        """By how much each particle's value misses its local fit, in parts of the range; of the least-squares form."""
        if self.formulation != "lsq" or self.nums is None or self.values is None:
            return None
        return relative_misfit(self.disc, self.nums, self.values)

    def condition_numbers(self) -> tuple[np.ndarray, float]:
        """Of the particles' moment matrices (N,), and of the global system."""
        if self.nums is None:
            raise ValueError("condition_numbers: the solve failed before it had a system; see diagnose()")
        assert self.factor is not None
        whole = self.factor.condition()
        return health.condition_numbers(self.disc, self.nums), float(whole)

    def flags(self, estimated: Callable[[], float], known: bool = False) -> list[str]:
        """What speaks against the solution, in sentences; see ``jsmitsm.solution.flags``."""
        if self.values is None or self.nums is None:
            return list(self.against)
        return flags(self, self.values, self.nums, estimated, known)[0] + self.against

    def stats(self) -> dict[str, Any]:
        """What a user may want to know about the solve."""
        return of_run(self)
