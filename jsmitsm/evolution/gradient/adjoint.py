"""A whole run as one operation with one derivative: steps forward on the host, transposed solves back with its factors.

What a step is, and how cotangents run through it backwards, stands in ``additive`` and ``radau``. Here the steps follow
each other. States at the ends of steps are kept for the way back, and the stages between them as long as they fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from jsmitsm.evolution.gradient import additive, radau
from jsmitsm.evolution.gradient.backward import once
from jsmitsm.evolution.gradient.bars import Bars
from jsmitsm.evolution.gradient.inputs import Given, Inputs
from jsmitsm.evolution.space.semidiscrete import Semidiscrete
from jsmitsm.evolution.steps.newton import Newton
from jsmitsm.evolution.steps.stepping import RadauStepper, Stepper, Stopped
from jsmitsm.evolution.steps.tableaux import Additive, Radau
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.tracers import is_traced

# Bytes of stages that are kept for the way back; beyond that they are made again step by step.
TAPE = 2**30
# Whether a pencil is to be made anew for a state: (semi, all values, time).
Drifted = Callable[[Semidiscrete, Any, float], bool]


@dataclass(eq=False)
class Plan:
    """What of a run is static: the equations without their numbers, the scheme, how many steps.

    newton: whether stages are solved by Newton's method. drifted: after which state to stop, so that the pencil is
    made anew; fresh: whether it has just been. timed: whether the times are differentiated.
    """

    semi: Semidiscrete
    scheme: Additive | Radau
    newton: bool
    steps: int
    timed: bool
    throw: bool
    drifted: Drifted | None = None
    fresh: bool = True

    def stepper(self, semi: Semidiscrete, at: Inputs) -> Any:
        drive = Given(at, len(self.scheme.nodes) - (not isinstance(self.scheme, Radau)))
        if isinstance(self.scheme, Radau):
            return RadauStepper(semi.system, drive)
        explicit = None if at.push is None else semi.explicit
        return Stepper(semi.system, drive, self.scheme, explicit, Newton(semi) if self.newton else None)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def states(plan: Plan, given: Inputs) -> Any:
    """All states (K + 1, size), fewer where the run stopped for a new pencil."""
    return _forward(plan, given)[0]


def _forward(plan: Plan, given: Inputs) -> tuple[Any, Any]:
    """The states, and on the host what they were made with and the stages behind them."""
    if is_traced(given):
        return _recorded(plan, given), None
    host = jax.tree.map(np.asarray, given)
    semi = plan.semi.stated(host.values, host.push)
    keep = 8 * plan.steps * (len(plan.scheme.nodes)) * semi.system.size < TAPE
    stepper = plan.stepper(semi, host)
    step, h = stepper.first(host.y, float(host.times[0])), float(host.h)
    out, tape = [host.y], []
    for k in range(plan.steps):
        t = stepper.drive.time(k)
        if plan.drifted is not None and (k or not plan.fresh):
            if plan.drifted(semi, semi.placed(step.y[: semi.system.n], step.known), t):
                break
        try:
            step = stepper.advance(step, t, h)
        except (Stopped, SolveError) as fault:
            if plan.throw:
                raise SolveError(f"the run stopped: {fault}", []) from fault
            out += [np.full_like(host.y, np.nan)] * (plan.steps - k)
            break
        out.append(step.y)
        tape.append(step.stages if keep else None)
    return jax.device_put(np.stack(out)), (semi, tape)


def _recorded(plan: Plan, given: Inputs) -> Any:
    """Inside of a program: linear runs as one call of the host, others step by step in JAX."""
    if plan.newton:
        raise ValueError(
            "scheme: Newton's method for the stages of a run is done by the host, which neither jax.jit nor jax.vmap "
            "nor a derivative of a gradient can wait for; call jax.grad without them, or use "
            'scheme="imex" where only lower derivatives are nonlinear'
        )
    if given.push is not None and isinstance(plan.scheme, Additive):
        return additive.scanned(plan.scheme, plan.semi, plan.steps, given)
    still = Plan(plan.semi, plan.scheme, False, plan.steps, plan.timed, False)
    shape = jax.ShapeDtypeStruct((plan.steps + 1, plan.semi.system.size), float)
    return _called(lambda now: np.asarray(_forward(still, now)[0]), shape, given)


def _called(function: Any, shape: Any, *given: Any) -> Any:
    def on_host(*given: Any) -> Any:
        return function(*jax.tree.map(np.asarray, given))

    return jax.pure_callback(on_host, shape, *once(given), vmap_method="sequential")


def _forward_rule(plan: Plan, given: Inputs) -> tuple[Any, Any]:
    if not is_traced(given):
        out, tape = _forward(plan, given)
        return out, _Tape(plan, given, out, *tape)
    if given.push is not None and not plan.newton:
        return jax.vjp(lambda g: _recorded(plan, g), given)
    return _recorded(plan, given), given


@jax.tree_util.register_pytree_node_class
class _Tape:
    """What the way back needs; no array of it is ever traced."""

    def __init__(self, *parts: Any):
        self.parts = parts

    def tree_flatten(self) -> tuple[Any, Any]:
        return (), self.parts

    @classmethod
    def tree_unflatten(cls, parts: Any, _: Any) -> _Tape:
        return cls(*parts)


def _backward_rule(plan: Plan, kept: Any, out_bar: Any) -> tuple[Any]:
    if isinstance(kept, _Tape):
        if not is_traced(out_bar):
            return (_backward(kept, np.asarray(out_bar)),)
        # Several cotangents at once, as in jax.jacrev: one after the other.
        return (_called(lambda bar: _backward(kept, bar), _shapes(kept.parts[1]), out_bar),)
    if not isinstance(kept, Inputs):
        return kept(out_bar)

    def again(given: Inputs, bar: np.ndarray) -> Inputs:
        out, tape = _forward(Plan(plan.semi, plan.scheme, False, plan.steps, plan.timed, False), given)
        return _backward(_Tape(plan, given, out, *tape), bar)

    return (_called(again, _shapes(kept), kept, out_bar),)


def _shapes(given: Inputs) -> Any:
    return jax.tree.map(lambda v: jax.ShapeDtypeStruct(np.shape(v), v.dtype), given)


def _backward(kept: _Tape, out_bar: np.ndarray) -> Inputs:
    """The cotangents of all inputs."""
    plan, given, out, semi, tape = kept.parts
    at: Inputs = jax.tree.map(np.asarray, given)
    bars = Bars(semi, at, plan.timed)
    back = (radau if isinstance(plan.scheme, Radau) else additive).back
    newton = Newton(semi) if plan.newton else None
    y_bar = np.array(out_bar[-1])
    for k in range(len(tape) - 1, -1, -1):
        y, stages = np.asarray(out[k]), tape[k]
        if stages is None:
            stages = _again(plan, semi, at, k, y)
        y_bar = out_bar[k] + back(plan.scheme, bars, newton, k, y, stages, y_bar)
    return bars.finished(y_bar)


def _again(plan: Plan, semi: Semidiscrete, at: Inputs, k: int, y: np.ndarray) -> list[np.ndarray]:
    """The stages of one step, from its start."""
    stepper = plan.stepper(semi, at)
    t = stepper.drive.time(k)
    return stepper.advance(stepper.first(y, t), t, float(at.h)).stages


states.defvjp(_forward_rule, _backward_rule)
