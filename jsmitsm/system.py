"""One linear solve from rows to values: repair, global system, solve, and checks by name."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm import discretize as dz
from jsmitsm import health, linsolve
from jsmitsm.discretize import Class, Discretization, Numbers
from jsmitsm.errors import SolveError, some
from jsmitsm.flags import flags
from jsmitsm.moments import Row
from jsmitsm.problem import Problem
from jsmitsm.taylor import HIGHEST
from jsmitsm.tracers import is_traced

# A solvable pure Neumann problem leaves a mean residual below this part of its data,
COMPATIBLE = 1e-6
# or one that falls to less than this part of itself from one order to two orders higher.
KEPT = 0.5
# Between the fields of a system both vary more with the order: less than this is a doubt, not a refusal.
UNSURE, FALLEN = 1e-3, 0.1
# Entries of the matrix, and of it and all that it is made of, in those of the rows of method S: of methods I and II,
# whose rows reach the neighbours of neighbours, and of the least-squares form, where every row is a square block.
# Measured from the growth of the peak memory with 3,000 to 39,000 particles in 2D (orders 4, 6) and 6,000 in 3D: 3.2
# and 6.5; 0.65 to 0.95 and 0.4 to 0.6 of the square.
NESTED, SQUARED = (3.2, 6.5), (0.85, 0.6)


class Run:
    """One call of ``solve``: the discretisation, its options, and what happened."""

    def __init__(
        self, disc: Discretization, problem: Problem, solver: str, throw: bool, repair: bool, formulation: str
    ):
        self.disc, self.problem = disc, problem
        self.solver, self.throw, self.repair = solver, throw, repair
        self.formulation = formulation
        self.seconds: dict[str, float] = {"local": 0.0, "assembly": 0.0, "solve": 0.0}
        self.messages: list[str] = []
        self.against: list[str] = []  # those of the messages that speak against the solution
        self.failed = False
        self.linear: dict[str, Any] = {}
        self.changes: list[float] = []  # of Newton's steps, relative to the solution
        self.health: health.Health | None = None
        self.imbalance = np.inf  # of a floating field's data, once solved: the mean residual relative to them
        self._refuse_too_large()
        # What the last step leaves for the flags; nothing of it under a JAX transform.
        self.rows: tuple[list[Class], list[Row]] | None = None
        self.nums: Numbers | None = None
        self.values: np.ndarray | None = None

    def _refuse_too_large(self) -> None:
        """What will not fit in memory is refused before it is made."""
        disc = self.disc
        near, fields = disc.stencils.indices, disc.rec.fields
        if is_traced(near, disc.cloud.points):
            return
        n, width = int((~disc.held).sum()), fields * int(np.shape(near)[1])
        entries = made = float(n * width)
        if disc.scheme.method in ("I", "II"):
            entries, made = NESTED[0] * entries, NESTED[1] * made
        elif self.formulation == "lsq":
            entries, made = SQUARED[0] * width * entries, SQUARED[1] * width * made
        points = np.asarray(disc.cloud.points)
        linsolve.refuse_too_large(n, int(entries), points, self.solver, fields == 1, int(made))

    def local_rows(self, nums: Numbers) -> tuple[list[Class], list[Row]]:
        """The rows of all classes, weak stencils repaired the first time."""
        disc = self.disc
        classes, rows = dz.all_rows(disc, nums)
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
        if self.repair:
            self._tell_repairs()
        bad = self.health.undetermined
        if len(bad) and not np.isfinite(np.asarray(nums.jac)).all():
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
        return classes, rows

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
        self.messages, self.against, self.failed = [], [], False
        self.__dict__.pop("factor", None)
        self.__dict__.pop("misfit", None)

    def step(self, nums: Numbers, altered: Callable[..., Any] | None = None) -> tuple[Any, Any]:
        """Assemble and solve one linear system: values (N, F), and whether it went well.

        altered: a function of the system's entries, their rows and columns and the right-hand side that returns others.
        """
        data, r, c, b = self.assembled(nums)
        if altered is not None:
            data, r, c, b = altered(data, r, c, b)
        start = time.perf_counter()
        x, good = self.solved(data, r, c, b)
        values = dz.with_held(self.disc, nums, x)
        self.seconds["solve"] += time.perf_counter() - start
        if is_traced(values):
            return values, jnp.isfinite(values).all()
        self.nums, self.values = nums, values
        return values, bool(good and np.isfinite(values).all() and not self.failed)

    def assembled(self, nums: Numbers, parts: list[Any] | None = None) -> tuple[Any, Any, Any, Any]:
        """The global system: entries of the matrix, their rows and columns, and the right-hand side.

        parts: see :func:`jsmitsm.leastsquares.least_squares`.
        """
        clock, disc = time.perf_counter, self.disc
        start = clock()
        self._forget()
        if disc.cut_off:
            self.messages.append(
                f"The supports of at least {len(disc.cut_off)} particle(s), first {some(disc.cut_off)}, reach outside "
                "of the given stencils, which cut them off: build wider stencils, or take a smaller h or d."
            )
        if self.formulation == "auto":
            self.formulation = "lsq" if dz.prefers_least_squares(disc, nums) else "loo"
            self._refuse_too_large()
        if self.formulation == "lsq":
            made = dz.least_squares(disc, nums, parts)
            local = clock()
        else:
            self.rows = classes, rows = self.local_rows(nums)
            local = clock()
            made = *dz.matrix(disc, classes, rows), dz.right_side(disc, nums, classes, rows)
        self.seconds["local"] += local - start
        self.seconds["assembly"] += clock() - local
        return made

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
        if not is_traced(x):
            x = np.asarray(x)
            if disc.floating:
                system = linsolve.factor(data, r, c, len(b), points, self.solver, self._elliptic)
                self.imbalance = _imbalance(system, x, b, n)
                if balanced:
                    self._check_compatible(self.imbalance)
        return x[:n], True

    @property
    def _elliptic(self) -> bool:
        """Whether multigrid may be expected to work."""
        return self.disc.rec.fields == 1 and not self.disc.floating

    def _bordered(self, data: Any, r: Any, c: Any, b: Any) -> tuple[Any, Any, Any, Any, Any]:
        """The system and the places of its unknowns; a row and a column of ones more for every floating field."""
        disc, fields = self.disc, self.disc.rec.fields
        free = np.flatnonzero(~disc.held.reshape(-1))
        points = None if is_traced(disc.cloud.points) else np.asarray(disc.cloud.points)[free // fields]
        xp = jnp if is_traced(data, b) else np
        for k, f in enumerate(disc.floating):
            ids = np.flatnonzero(free % fields == f)
            line = np.full(len(ids), len(free) + k)
            data, b = xp.concatenate([data, np.ones(2 * len(ids))]), xp.concatenate([b, np.zeros(1)])
            r, c = np.concatenate([r, ids, line]), np.concatenate([c, line, ids])
            points = None if points is None else np.concatenate([points, np.full((1, points.shape[1]), np.nan)])
        return data, r, c, b, points

    def _check_compatible(self, rest: float) -> None:
        """A field without values: its data must balance, up to what the discretisation explains."""
        self.messages.append("The conditions fix the solution only up to a constant; its mean over the particles is 0.")
        if rest <= COMPATIBLE:
            return
        # The discretisation's share falls with the order, a real imbalance stays. The highest orders look down.
        up = self.disc.rec.order + 2 <= HIGHEST
        try:
            other = self._imbalance_at(self.disc.rec.order + (2 if up else -2))
        except ValueError:  # too few particles to tell
            other = rest
        lower, higher = (rest, other) if up else (other, rest)
        system = self.disc.rec.fields > 1
        if higher <= max(COMPATIBLE, (FALLEN if system else KEPT) * lower):
            return
        told = (
            f"(mean residual {rest:.1e} of the data, and {other:.1e} two orders {'higher' if up else 'lower'}); "
            "correct the source or the fluxes, hold a value (js.dirichlet, js.fix), or refine a cloud that is too "
            "coarse for its data"
        )
        if system and min(rest, other) < UNSURE:
            self.object(f"The data may not balance, and nothing fixes the value {told}.")
        else:
            self.fail(f"the conditions are incompatible: nothing fixes the value, and the data do not balance {told}")

    def _imbalance_at(self, order: int) -> float:
        """The mean residual, relative to the data, of the same problem with method S of another order."""
        cloud = self.disc.cloud
        disc = dz.discretize(self.problem, cloud, "S", order, None, None, None)
        other = Run(disc, self.problem, self.solver, False, True, "loo")
        nums = dz.numbers(disc, self.problem)
        classes, rows = other.local_rows(nums)
        other.solved(*dz.matrix(disc, classes, rows), dz.right_side(disc, nums, classes, rows), balanced=False)
        return other.imbalance

    @cached_property
    def factor(self) -> linsolve.Factor | None:
        """The factors of the last step's system, most often still kept; None before there was one."""
        if self.nums is None:
            return None
        if self.formulation == "lsq":
            data, r, c, _ = dz.least_squares(self.disc, self.nums)
        else:
            assert self.rows is not None
            data, r, c = dz.matrix(self.disc, *self.rows)
        return self.factor_of(data, r, c)

    def factor_of(self, data: Any, r: Any, c: Any) -> linsolve.Factor:
        """The factors of a global system."""
        data, r, c, b, points = self._bordered(data, r, c, np.zeros(int((~self.disc.held).sum())))
        return linsolve.factor(data, r, c, len(b), points, self.solver, self._elliptic)

    @cached_property
    def misfit(self) -> np.ndarray | None:
        """By how much each particle's value misses its local fit, in the least-squares form."""
        if self.formulation != "lsq" or self.nums is None:
            return None
        return dz.misfit(self.disc, self.nums, self.values)

    def condition_numbers(self) -> tuple[np.ndarray, float]:
        """Of the particles' moment matrices (N,), and of the global system."""
        if self.nums is None:
            raise ValueError("condition_numbers: the solve failed before it had a system; see diagnose()")
        assert self.factor is not None
        whole = self.factor.condition()
        return health.condition_numbers(self.disc, self.nums), float(whole)

    def flags(self, estimated: Callable[[], float]) -> list[str]:
        """What speaks against the solution, in sentences; see :mod:`jsmitsm.flags`."""
        if self.values is None or self.nums is None:
            return list(self.against)
        return flags(self, self.values, self.nums, estimated)[0] + self.against

    def stats(self) -> dict[str, Any]:
        """What a user may want to know about the solve."""
        disc = self.disc
        out: dict[str, Any] = {
            "seconds": dict(self.seconds),
            "particles": len(disc.cloud),
            "unknowns": int((~disc.held).sum()),
            "neighbours": max((c.neighbours.shape[1] for c in disc.classes), default=0),
            "linear": self.linear,
            "formulation": self.formulation,
            "skipped": skipped(disc, self.linear, self.values is None),
            "messages": list(self.messages),
        }
        if self.changes:
            out["changes"] = list(self.changes)
        if "residual" in self.linear:
            out["residual"] = self.linear["residual"]
        if self.health is not None:
            out["lebesgue_max"] = self.health.largest
            out["repaired"] = self.health.repaired
            out["weak"] = self.health.weak
        return out


def _imbalance(system: linsolve.Factor, x: np.ndarray, b: np.ndarray, n: int) -> float:
    """The largest Lagrange multiplier relative to the data that it sums up.

    With y the last row of the inverse, the multiplier is y . b, whatever the units of the equations that y weighs:
    relative to |y| . |b| it is the same at every order, in a system of fields too.
    """
    weights = np.abs(system.solve(np.eye(len(b), len(b) - n, -n), transpose=True))
    size = np.abs(b) @ weights
    return float(np.max(np.abs(x[n:]) / np.where(size > 0, size, 1.0)))


def skipped(disc: Discretization, linear: dict[str, Any], traced: bool) -> list[str]:
    """What the scene made unnecessary; ``linear``: what the linear solve tells of itself."""
    method = disc.scheme.method
    out = []
    if disc.given_stencils:
        out.append("neighbour search")
    if method in ("S", "SSPH", "I"):
        out.append("kernel derivatives")
    if disc.traced.constant and disc.rec.scale_free:
        out.append("recursion per particle")
    elif disc.lengths:
        out.append(f"recursion per particle, but for {disc.lengths} lengths")
    if disc.repeated:
        out.append(f"moment systems of {disc.repeated} particles with repeated stencils")
    if disc.traced.source == "zero":
        out.append("particular part")
    if disc.held.all(axis=1).any():
        out.append(f"{int(disc.held.all(axis=1).sum())} particles with held values")
    if linear.get("cached"):
        out.append("factorisation, that of the same matrix was kept")
    elif linear.get("order_kept"):
        out.append("elimination order, that of the same pattern was kept")
    if not traced:
        out.append("bookkeeping for gradients")
    return [*out, "Taylor coefficients until asked for", "error estimate until asked for"]
