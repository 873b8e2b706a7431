"""A whole run as one operation with one derivative: steps forward on the host, transposed solves back with its factors.

For a step from y (see stepping for the stages), with S = E + g h A, P_j = F_j - A Y_j and Q_j = -B N(Y_j, t_j), the
cotangents run backwards through the stages i = s .. 1, Y_s being the next state:

    Y_i* += -A^T P_i* + Q'(Y_i)^T Q_i*,   F_i* += P_i*,   l = S^-T Y_i*
    y* += E^T l,   H* += l,   H_i* -= l,   F_i* += g h l,   P_j* += h a_ij l,   Q_j* += h e_ij l  (j < i)
    h* += l . (sum_{j<i} a_ij P_j + e_ij Q_j + g (F_i - A Y_i))
    E* += l (y - Y_i)^T,   A* -= (g h l + P_i*) Y_i^T

and at the start of the step y* += -A^T P_0* + Q'(y)^T Q_0*, F_0* += P_0*, A* -= P_0* y^T.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.evolution.gradient.pushing import Pushing
from jsmitsm.evolution.space.matrices import sampled
from jsmitsm.evolution.space.system import System
from jsmitsm.evolution.steps.tableaux import Additive
from jsmitsm.runtime.tracers import is_traced

# Bytes of stages that are kept for the way back; beyond that they are made again step by step.
TAPE = 2**30
# Products of cotangents and states that are taken together.
MANY = 100


@dataclass(eq=False)
class Plan:
    """What of a run is static: matrices without their values, the scheme, the nonlinear part's form."""

    system: System
    scheme: Additive
    pushing: Pushing | None
    still: np.ndarray
    steps: int


@jax.tree_util.register_dataclass
@dataclass
class Inputs:
    """What a run may be differentiated by.

    values: of the matrices of E and A; push: what N takes (see pushing); y (size,) and h; force, jump (K s + 1, size)
    and known (K s + 1, held): F, H and held values at the start and at all implicit stages; times (K s + 1,).
    """

    values: Any
    push: Any
    y: Any
    h: Any
    force: Any
    jump: Any
    known: Any
    times: Any


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def states(plan: Plan, given: Inputs) -> Any:
    """All states (K + 1, size)."""
    return _forward(plan, given)[0]


def _forward(plan: Plan, given: Inputs) -> tuple[Any, Any]:
    """The states, and on the host the stages behind them."""
    if is_traced(given):
        return _scanned(plan, given), None
    host = jax.tree.map(np.asarray, given)
    system = plan.system.with_values(host.values)
    s = plan.scheme.stages - 1
    keep = 8 * 3 * plan.steps * s * system.size < TAPE
    out, tape, y = [host.y], [], host.y
    for k in range(plan.steps):
        stages = _stages(plan, system, host, k, y)
        y = stages[0][-1]
        tape.append(stages if keep else None)
        out.append(y)
    return jnp.asarray(np.stack(out)), (system, tape)


def _stages(plan: Plan, system: System, at: Inputs, k: int, y: Any) -> tuple[list[Any], list[Any], list[Any]]:
    """Y_0 .. Y_s, P_0 .. P_(s-1), Q_0 .. Q_(s-1) of step k; numpy or JAX."""
    scheme, h = plan.scheme, at.h
    s, g = scheme.stages - 1, scheme.gamma
    resolvent = system.resolvent(_number(h * g))
    first = k * s
    base = system.mass(y) + at.jump[first]
    ys, ps, qs = [y], [], []
    for i in range(1, s + 1):
        p = at.force[first + i - 1] - system.stiff(ys[-1])
        ps.append((jnp if is_traced(p) else np).where(plan.still, 0.0, p))
        if plan.pushing is not None:
            number = first + i - 1
            qs.append(plan.pushing.value(at.push, ys[-1], at.known[number], at.times[number]))
        r = base - at.jump[first + i] + (h * g) * at.force[first + i]
        r = r + sum(h * float(scheme.implicit[i, j]) * ps[j] for j in range(i) if scheme.implicit[i, j])
        if plan.pushing is not None:
            r = r + sum(h * float(scheme.explicit[i, j]) * qs[j] for j in range(i) if scheme.explicit[i, j])
        ys.append(resolvent.solve(r))
    return ys, ps, qs


def _number(h: Any) -> Any:
    return h if is_traced(h) else float(h)


def _scanned(plan: Plan, given: Inputs) -> Any:
    """The same as one loop in JAX, for jit and vmap; every solve is an operation of its own."""
    system = plan.system.with_values(given.values)
    s = plan.scheme.stages - 1
    windows = np.arange(plan.steps)[:, None] * s + np.arange(s + 1)

    def step(y: Any, window: Any) -> tuple[Any, Any]:
        names = ("force", "jump", "known", "times")
        cut = {name: jnp.asarray(getattr(given, name))[window] for name in names}
        now = Inputs(given.values, given.push, y, given.h, **cut)
        y = _stages(plan, system, now, 0, y)[0][-1]
        return y, y

    y = jnp.asarray(given.y, float)
    return jnp.concatenate([y[None], jax.lax.scan(step, y, windows)[1]])


def _forward_rule(plan: Plan, given: Inputs) -> tuple[Any, Any]:
    if is_traced(given):
        out, back = jax.vjp(partial(_scanned, plan), given)
        return out, back
    out, tape = _forward(plan, given)
    return out, _Tape(plan, given, out, *tape)


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
    if not isinstance(kept, _Tape):
        return kept(out_bar)
    if is_traced(out_bar):  # several cotangents at once, as in jax.jacrev: one after the other
        return (_mapped(kept, out_bar),)
    return (_backward(kept, np.asarray(out_bar)),)


def _mapped(kept: _Tape, out_bar: Any) -> Any:
    given = kept.parts[1]
    shapes = jax.tree.map(lambda v: jax.ShapeDtypeStruct(np.shape(v), np.asarray(v).dtype), given)
    return jax.pure_callback(
        lambda bar: jax.tree.map(np.asarray, _backward(kept, np.asarray(bar))), shapes, out_bar,
        vmap_method="sequential",
    )  # fmt: skip


def _backward(kept: _Tape, out_bar: np.ndarray) -> Inputs:
    """The cotangents of all inputs."""
    plan, given, out, system, tape = kept.parts
    at = jax.tree.map(np.asarray, given)
    scheme, h = plan.scheme, float(at.h)
    s, g = scheme.stages - 1, scheme.gamma
    resolvent = system.resolvent(h * g)
    force, jump = np.zeros(at.force.shape), np.zeros(at.jump.shape)
    pull = None if plan.pushing is None else plan.pushing.pull(at)
    gather = _Gather(system)
    h_bar, y_bar = 0.0, np.array(out_bar[-1])
    for k in range(plan.steps - 1, -1, -1):
        ys, ps, qs = tape[k] if tape[k] is not None else _stages(plan, system, at, k, np.asarray(out[k]))
        first = k * s
        p_bar, q_bar = (np.zeros((s, system.size)) for _ in range(2))
        start_bar, stage_bar, slope = np.array(out_bar[k]), y_bar, np.zeros(system.size)
        for i in range(s, 0, -1):
            low = resolvent.solve_transposed(stage_bar)
            start_bar += system.mass_transposed(low)
            jump[first] += low
            jump[first + i] -= low
            force[first + i] += (g * h) * low
            drift = g * (at.force[first + i] - system.stiff(ys[i]))
            for j in range(i):
                a, e = scheme.implicit[i, j], scheme.explicit[i, j]
                if a:
                    p_bar[j] += (h * a) * low
                    drift = drift + a * ps[j]
                if pull is not None and e:
                    q_bar[j] += (h * e) * low
                    drift = drift + e * qs[j]
            h_bar += float(low @ drift)
            gather.mass(low, ys[0] - ys[i])
            gather.stiff((-g * h) * low - slope, ys[i])
            # On to stage i - 1: what asked for its slope.
            slope = np.where(plan.still, 0.0, p_bar[i - 1])
            number = first + i - 1
            force[number] += slope
            stage_bar = -system.stiff_transposed(slope)
            if pull is not None:
                stage_bar = stage_bar + pull(q_bar[i - 1], ys[i - 1], number)
        gather.stiff(-slope, ys[0])
        y_bar = start_bar + stage_bar
    push_bar, known_bar, times_bar = (
        (jax.tree.map(np.zeros_like, at.push), np.zeros(at.known.shape), np.zeros(at.times.shape))
        if pull is None else pull.finished()
    )  # fmt: skip
    return Inputs(gather.values(), push_bar, y_bar, np.asarray(h_bar), force, jump, known_bar, times_bar)


class _Gather:
    """Collects the cotangents of the matrices at their entries, many products at a time."""

    def __init__(self, system: System):
        self.system, self.lower = system, slice(system.n if system.second else 0, None)
        self.bars = [np.zeros(np.shape(v)) for v in system.values]
        self._mass: list[tuple[np.ndarray, np.ndarray]] = []
        self._stiff: list[tuple[np.ndarray, np.ndarray]] = []

    def mass(self, left: np.ndarray, right: np.ndarray) -> None:
        """E* += left right^T; the upper half of E, where there is one, is not differentiated."""
        self._mass.append((left[self.lower], right[self.lower]))
        if len(self._mass) == MANY:
            self._flush()

    def stiff(self, left: np.ndarray, right: np.ndarray) -> None:
        """A* += left right^T."""
        self._stiff.append((left[self.lower], right))

    def _flush(self) -> None:
        system, n = self.system, self.system.n
        if self._mass:
            self.bars[-1] += sampled(system.masses[-1], *_columns(self._mass))
        if self._stiff:
            left, right = _columns(self._stiff)
            self.bars[0] += sampled(system.stiffness, left, right[:n])
            if system.second:  # A = [0, -1; A, M1]
                self.bars[1] += sampled(system.masses[0], left, right[n:])
        self._mass, self._stiff = [], []

    def values(self) -> tuple[np.ndarray, ...]:
        self._flush()
        return tuple(self.bars)


def _columns(pairs: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, ...]:
    return tuple(np.ascontiguousarray(np.stack(v).T) for v in zip(*pairs))


states.defvjp(_forward_rule, _backward_rule)
