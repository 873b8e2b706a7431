"""The way back through a step of an additive scheme, and such steps inside of a program.

With S = E + g h A, P_j = F_j - A Y_j and Q_j = -B N(Y_j, t_j) (see stepping for the stages) the cotangents run
backwards through the stages i = s .. 1, Y_s being the next state:

    Y_i* += -A^T P_i* + Q'(Y_i)^T Q_i*,   F_i* += P_i*,   l = S^-T Y_i*
    y* += E^T l,   H* += l,   H_i* -= l,   F_i* += g h l,   P_j* += h a_ij l,   Q_j* += h e_ij l  (j < i)
    h* += l . (sum_{j<i} a_ij P_j + e_ij Q_j + g (F_i - A Y_i))
    E* += l (y - Y_i)^T,   A* -= (g h l + P_i*) Y_i^T

and at the start of the step y* += -A^T P_0* + Q'(y)^T Q_0*, F_0* += P_0*, A* -= P_0* y^T. Where stages are solved by
Newton's method Q_i counts to P_i: then S = E + g h (A + B N'(Y_i)), and N takes the cotangent g h l + P_i* of Q_i.
Elsewhere the end E Y = E Y_s + h sum_j c_j Q_j comes first:

    l = E^-T Y*,   Y_s* += Y*,   Q_j* += h c_j l,   h* += l . sum_j c_j Q_j,   E* += l (Y_s - Y)^T
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.evolution.gradient.bars import Bars
from jsmitsm.evolution.gradient.inputs import Inputs
from jsmitsm.evolution.space.semidiscrete import Semidiscrete
from jsmitsm.evolution.steps.newton import Newton
from jsmitsm.evolution.steps.tableaux import Additive


def back(
    scheme: Additive, bars: Bars, newton: Newton | None, k: int, y: np.ndarray, stages: list[np.ndarray],
    y_bar: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """From the cotangent of a step's end to that of its start."""
    at, system, pull, ys = bars.at, bars.system, bars.pull, [y, *stages]
    h, g, s = float(at.h), scheme.gamma, scheme.stages - 1
    first = k * s
    explicit = pull if newton is None else None
    q_bar = np.zeros((s + 1, system.size))
    if explicit is not None:
        *ys, end = ys
        last = system.settled(h).solve_transposed(y_bar)
        q_bar = np.multiply.outer(h * scheme.closing, last)
        bars.mass(last[None], (ys[-1] - end)[None])
        explicit.collect(q_bar[s], ys[s], first + s)
        y_bar = y_bar + explicit.state(q_bar[s], ys[s], first + s)
    low, p_bar = np.empty((s, system.size)), np.zeros((s + 1, system.size))
    stage_bar = y_bar
    for i in range(s, 0, -1):
        if newton is None or pull is None:
            low[i - 1] = system.resolvent(h * g).solve_transposed(stage_bar)
        else:
            number = first + i
            low[i - 1] = newton.transposed(stage_bar, ys[i], at.times[number], h * g, at.known[number], pull, number)
            pull.collect((g * h) * low[i - 1] + p_bar[i], ys[i], number)
        # On to stage i - 1: what asked for its slope.
        p_bar[i - 1] = (h * scheme.implicit[i:, i - 1]) @ low[i - 1 :]
        p_bar[i - 1, bars.still] = 0.0
        stage_bar = -system.stiff_transposed(p_bar[i - 1])
        if pull is not None:
            asked = p_bar[i - 1]
            if explicit is not None:
                asked = (h * scheme.explicit[i:, i - 1]) @ low[i - 1 :] + q_bar[i - 1]
            stage_bar += pull.state(asked, ys[i - 1], first + i - 1)
            if newton is None or i == 1:
                pull.collect(asked, ys[i - 1], first + i - 1)
    if bars.timed:
        rates, pushes = _rates(scheme, bars, newton is not None, ys, first)
        bars.h += sum(float(v @ rate) for v, rate in zip(low, rates))
        bars.h += 0.0 if explicit is None else sum(float(last @ q) * c for c, q in zip(scheme.closing, pushes))
    total, states = low.sum(axis=0), np.array(ys)
    bars.jump[first] += total
    bars.jump[first + 1 : first + s + 1] -= low
    bars.mass(low, y - states[1:])
    p_bar[1:] += (g * h) * low
    bars.force[first : first + s + 1] += p_bar
    bars.stiff(-p_bar, states)
    return system.mass_transposed(total) + stage_bar


def _rates(scheme: Additive, bars: Bars, newton: bool, ys: list[np.ndarray], first: int) -> tuple[Any, Any]:
    """For every implicit stage what its right-hand side and matrix take of h, and all that is added explicitly."""
    at, s = bars.at, scheme.stages - 1
    p = [at.force[first + j] - bars.system.stiff(y) for j, y in enumerate(ys)]
    q = [np.zeros_like(v) for v in p]
    if bars.pull is not None:
        q = [bars.semi.explicit(y, at.times[first + j], at.known[first + j]) for j, y in enumerate(ys)]
        if newton:
            p, q = [a + b for a, b in zip(p, q)], [np.zeros_like(v) for v in q]
    slopes = np.array(p)
    slopes[:, bars.still] = 0.0
    out = []
    for i in range(1, s + 1):
        before = sum(scheme.implicit[i, j] * slopes[j] + scheme.explicit[i, j] * q[j] for j in range(i))
        out.append(before + scheme.gamma * p[i])
    return out, q


def scanned(scheme: Additive, semi: Semidiscrete, steps: int, given: Inputs) -> Any:
    """The same as ``Stepper`` inside of a program: a scan over the steps, every solve JAX's to differentiate."""
    now = semi.stated(given.values, given.push)
    system, still, s, g = now.system, semi.system.undriven(), scheme.stages - 1, scheme.gamma
    resolvent, settled = system.resolvent(given.h * g), system.settled(given.h)

    def step(y: Any, window: Any) -> tuple[Any, Any]:
        whole = given.force, given.jump, given.known, given.times
        force, jump, known, times = (jnp.asarray(v)[window] for v in whole)
        base, ps, qs, last = system.mass(y) + jump[0], [], [], y
        for i in range(1, s + 1):
            ps.append(jnp.where(still, 0.0, force[i - 1] - system.stiff(last)))
            qs.append(now.explicit(last, times[i - 1], known[i - 1]))
            r = base - jump[i] + (given.h * g) * force[i]
            r = r + sum(given.h * scheme.implicit[i, j] * ps[j] for j in range(i) if scheme.implicit[i, j])
            r = r + sum(given.h * scheme.explicit[i, j] * qs[j] for j in range(i) if scheme.explicit[i, j])
            last = resolvent.solve(r)
        qs.append(now.explicit(last, times[s], known[s]))
        last = last + settled.solve(given.h * sum(c * q for c, q in zip(scheme.closing, qs)))
        return last, last

    y = jnp.asarray(given.y, float)
    windows = np.arange(steps)[:, None] * s + np.arange(s + 1)
    return jnp.concatenate([y[None], jax.lax.scan(step, y, windows)[1]])
