"""A run before its first step: the scheme, the damping, the pencil, the start."""

from __future__ import annotations

import time
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.discretization.coefficients import slot_series
from jsmitsm.discretization.layout import discretize
from jsmitsm.discretization.pencil.assemble import assemble_pencil
from jsmitsm.discretization.pencil.fits import local_fits
from jsmitsm.equation.field import RATE
from jsmitsm.evolution.space.convection import flag_divergence, flag_open, refuse_convection
from jsmitsm.evolution.space.semidiscrete import Driver, Semidiscrete
from jsmitsm.evolution.space.timed import Timed
from jsmitsm.evolution.steps.newton import Newton
from jsmitsm.evolution.steps.stepping import RadauStepper, Step, Stepper
from jsmitsm.evolution.steps.tableaux import EULER, KENCARP4, RADAU, Additive, Radau
from jsmitsm.runtime.errors import is_number, some
from jsmitsm.runtime.tracers import computed, is_traced

# A quasilinear problem is linearised anew where its coefficients have changed by this part of themselves.
DRIFT = 0.1


class Run:
    """A run of one problem on one cloud."""

    unseen = 0.0  # the part of the start that its particles do not see

    def __init__(self, timed: Timed, cloud: Cloud, start: tuple[Any, ...], t: Any, began: float, *, order: int,
                 scheme: str, damping: Any, stencils: Any, throw: bool, depth: int):  # fmt: skip
        self.timed, self.cloud, self.start, self.t, self.began = timed, cloud, start, t, began
        self.order, self.stencils, self.throw, self.depth = order, stencils, throw, depth
        self.params = timed.problem.params[1]
        self.traced = is_traced(self.params, start, t, cloud, timed.problem, timed.rest, timed.masses,
                                timed.apart)  # fmt: skip
        self.fields = timed.problem.fields
        self.second = bool(timed.masses[1].slots)
        self.flags: list[str] = []
        self.told: list[str] = []
        self.counts: dict[str, Any] = {"steps": 0, "rejected": 0, "pencils": 0}
        self.newton: Newton | None = None
        self._fits: dict[int, Any] = {}  # by order
        self.name = self._scheme(scheme)
        self.damping = self._damping(damping)
        self.semi = self.pencil(t[0] if is_traced(t[0]) else np.asarray(float(t[0])), start[0])

    # ------------------------------------------------------------------ what is chosen

    @property
    def algebraic(self) -> bool:
        """Whether a field has no rate."""
        moved = {k for m in self.timed.masses for k, _ in m.slots}
        return len({k % RATE for k in moved}) < self.fields

    def _scheme(self, asked: str) -> str:
        timed = self.timed
        if asked == "radau" and not timed.linear:
            raise ValueError(
                'scheme: "radau" serves linear problems, and this one is nonlinear, or its operator depends on t; use '
                '"imex" or "esdirk"'
            )
        if asked == "imex" and timed.quasilinear:
            raise ValueError(
                'scheme: "imex" takes what is nonlinear explicitly, and here the highest derivatives are nonlinear or '
                'their coefficients depend on t; use "esdirk"'
            )
        if asked == "imex" and self.algebraic and not timed.linear:
            raise ValueError(
                'scheme: "imex" takes what is nonlinear explicitly, which an equation without a rate cannot wait for; '
                'use "esdirk"'
            )
        if self.second and not timed.linear and asked in ("esdirk", "euler"):
            raise ValueError(
                f'scheme: {asked!r} solves linear problems of second order in time; use "imex", or write two fields of '
                "first order"
            )
        if self.second and timed.quasilinear:
            raise ValueError(
                "pde: of second order in time and with nonlinear (or time-dependent) highest derivatives, which "
                "js.evolve does not do; write two fields of first order"
            )
        if asked != "auto":
            return asked
        if timed.linear:
            return "radau" if self.order >= 6 or self.second or self.algebraic else "esdirk"
        # Second derivatives and higher ones that are nonlinear are too stiff to be taken explicitly.
        return "esdirk" if timed.quasilinear or self.algebraic or max(timed.rest.order) > 1 else "imex"

    def _damping(self, asked: Any) -> float:
        """The factor of the damping matrix."""
        operator, rates = self.timed.operator, self.timed.masses[0]
        own = [{k % RATE for (k, _), p in zip(rates.slots, row) if p} for row in rates.pattern]
        coupled = not self.second and self.fields > 1 and all(
            not any(p and k in own[e] and sum(b) == operator.order[e] for (k, b), p in zip(operator.slots, row))
            for e, row in enumerate(operator.pattern)
        )  # fmt: skip
        if isinstance(asked, str) and asked == "auto":
            if self.second:
                alpha = 0.1 if self.order >= 6 else 0.0
            else:
                alpha = 0.2 if coupled and max(operator.order) >= 2 and not self.algebraic else 0.0
        else:
            if not is_number(asked) or asked < 0:
                raise ValueError(f'damping: expected "auto" or a number from 0, got {asked!r}')
            alpha = float(asked)
        if not alpha or is_traced(self.cloud.points):
            return 0.0
        spacing = self.spacing
        return alpha / spacing if self.second else alpha / spacing**2

    @property
    def spacing(self) -> float:
        """The mean spacing of the whole cloud."""
        points = np.asarray(self.cloud.points)
        return float((np.prod(np.ptp(points, axis=0)) / len(points)) ** (1.0 / points.shape[1]))

    def pencil(self, t: Any, u: Any) -> Semidiscrete:
        """The semidiscrete equations, linearised at the values u (N, F) where the problem is quasilinear."""
        timed, began = self.timed, time.perf_counter()
        self.counts["pencils"] += 1
        semi = self._semidiscrete(t, u, self.order, self.damping, timed.sourced, self.stencils)
        pencil = semi.pencil
        if not self.traced:
            refuse_convection(semi, self.flags)
            if timed.flow is not None:
                flag_divergence(semi, self.start[0], self.flags)
                flag_open(semi, self.flags)
        self.told = list(pencil.health)
        self._flag_signs(pencil)
        if timed.flow is not None:
            self.told.append(f"Field {timed.flow.pressure}, a pressure, has the divergence of the other equations for "
                             "its own; what the start has of a divergence diffuses.")  # fmt: skip
        self.counts["seconds in pencils"] = self.counts.get("seconds in pencils", 0.0) + time.perf_counter() - began
        return semi

    def _flag_signs(self, pencil: Any) -> None:
        """A flag where particles without conditions have equations that would grow in time."""
        fitness, disc = pencil.layout.fitness, pencil.layout.disc
        wrong = np.zeros(0, int) if fitness is None else fitness.wrong
        self._flag_wrong(wrong[disc.n_own[wrong] == 0] if len(wrong) else wrong)

    def _flag_wrong(self, wrong: np.ndarray) -> None:
        if len(wrong):
            flag = (f"The source has the wrong sign in the rows of {len(wrong)} particle(s), first {some(wrong)}: the "
                    "evolution may be unstable.")  # fmt: skip
            self.flags += [] if flag in self.flags else [flag]

    def beside(self, order: int, t: float, u: Any) -> Semidiscrete:
        """The semidiscrete equations of another order, at a time and values (N, F)."""
        return self._semidiscrete(np.asarray(t), u, order, 0.0, None, None)

    def _semidiscrete(self, t: Any, u: Any, order: int, damping: float, massed: Any, stencils: Any) -> Semidiscrete:
        timed, problem = self.timed, self.timed.at(t, self.params)
        options: dict[str, Any] = {"order": order, "mass": massed, "stencils": stencils, "depth": self.depth}
        if not timed.quasilinear:
            with computed():
                return Semidiscrete(timed, assemble_pencil(problem, self.cloud, **options), self.params, damping)
        problem.pde = timed.space  # type: ignore[assignment]
        if order not in self._fits:
            disc = discretize(problem, self.cloud, "S", order, None, stencils, None, depth=self.depth)
            self._fits[order] = local_fits(disc, disc.rec.reach)
        taylor = self._fits[order].coefficients(u)  # of the values the problem is linearised at, (N, F, K)
        pencil = assemble_pencil(problem, self.cloud, taylor=taylor, **options)
        slots = slot_series(pencil.layout.disc.rec, timed.space.slots, taylor, 0)
        jac, _ = timed.space.coefficients(self.cloud.points, 0, params=problem.params, slots=slots)
        xp = jnp if is_traced(jac) else np
        reference = xp.broadcast_to(jac[:, :, 0], (self.fields, len(timed.space.slots), len(self.cloud)))
        return Semidiscrete(timed, pencil, self.params, damping, reference)

    def renew(self, y: Any, t: Any) -> None:
        """The pencil linearised at a later state."""
        t = t if is_traced(t) else np.asarray(float(t))
        self.semi = self.pencil(t, self.semi.lifted(y, t))

    def left(self, step: Step, t: float) -> bool:
        """Whether the pencil is to be made anew."""
        return drifted(self.semi, self.semi.placed(step.y[: self.semi.system.n], step.known), t)

    @property
    def scheme(self) -> Additive | Radau:
        """The coefficients of its scheme."""
        if self.name == "radau":
            return RADAU
        return EULER if self.name == "euler" else KENCARP4

    def stepper(self, semi: Semidiscrete) -> Any:
        """What makes its steps."""
        drive, scheme = Driver(semi, self.scheme.sampling(not semi.second)), self.scheme
        if isinstance(scheme, Radau):
            return RadauStepper(semi.system, drive)
        explicit = None if semi.linear else semi.explicit
        if self.name != "imex" and explicit is not None:
            self.newton = Newton(semi)
        return Stepper(semi.system, drive, scheme, explicit, None if self.name == "imex" else self.newton)


def drifted(semi: Semidiscrete, u: Any, t: float, some: Any = slice(None)) -> bool:
    """Whether the coefficients at the values u (N, F) have left those that the pencil was made with.

    some: the particles that are looked at.
    """
    record, reference = semi.timed.space, semi.reference[..., some]
    change = semi.steepness(u, t)[..., some]
    for e, m in enumerate(record.order):
        top = [s for s, (_, b) in enumerate(record.slots) if record.pattern[e, s] and sum(b) == m]
        size = np.sqrt((reference[e, top] ** 2).sum(axis=0))
        if (np.abs(change[e, top]).max(axis=0) > DRIFT * size).any():
            return True
    return False
