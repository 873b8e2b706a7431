"""Runs whose values JAX traces: all that drives them first, then the steps as one operation."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.evolution.evolution import Evolution
from jsmitsm.evolution.gradient.adjoint import Inputs, Plan, states
from jsmitsm.evolution.gradient.pushing import Pushing
from jsmitsm.evolution.run import Run
from jsmitsm.evolution.steps import dense_output
from jsmitsm.evolution.steps.tableaux import EULER, KENCARP4
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.fit import Recipe
from jsmitsm.taylor.multi_indices import HIGHEST


def differentiable(run: Run, steps: int, parts: np.ndarray) -> Evolution:
    """The Evolution of a run with traced values, in equal steps."""
    semi = run.semi
    scheme = EULER if run.name == "euler" else KENCARP4
    sampling = scheme.sampling(not semi.second)
    t0, t1 = (jnp.asarray(v, float) for v in run.t)
    h = (t1 - t0) / steps
    m, s = len(sampling.nodes) - 1, len(sampling.stages)
    places = np.append((np.arange(steps)[:, None] + sampling.nodes[:-1]).reshape(-1), steps)
    times = t0 + h * places
    samples = semi.samples(times)
    windows = np.arange(steps)[:, None] * m + np.arange(m + 1)
    # Steps stand before nodes, and both last.
    cut = [v[:, windows] for v in samples]
    blended = [v.reshape(v.shape[0], steps * s) for v in semi.blended(sampling, cut)]
    force, jump = semi.forces(*[jnp.concatenate([v[:, :1], b], axis=1) for v, b in zip(samples, blended)])
    numbers = np.append(0, (windows[:, sampling.stages]).reshape(-1))
    pushing = None if semi.linear else Pushing(semi)
    still = np.asarray(semi.system.undriven())
    y = _started(run, samples, force[0], jump[0], h, still)
    push = None if pushing is None else pushing.given()
    values = tuple(jnp.asarray(v) for v in semi.system.values)
    found = states(
        Plan(semi.system, scheme, pushing, still, steps),
        Inputs(values, push, y, h, force, jump, samples[0].T[numbers], times[numbers]),
    )
    index, weights = dense_output.weights(np.linspace(0.0, 1.0, steps + 1), parts)
    held = np.round(index * m).astype(int)  # samples at the ends of steps
    size = semi.system.n

    def saved(values: Any) -> Any:
        return jnp.einsum("sk,sk...->s...", weights, values[index])

    def whole(part: Any, held_values: Any) -> Any:
        return jnp.stack([semi.placed(jnp.asarray(p), jnp.asarray(q)) for p, q in zip(saved(part), held_values)])

    def of_held(rows: Any) -> Any:
        return jnp.einsum("sk,sk...->s...", weights, jnp.asarray(rows).T[held])

    u = whole(found[:, :size], of_held(samples[0]))
    rates = whole(found[:, size:], of_held(samples[3])) if semi.second else None
    recipe = Recipe("S", run.order, None, "loo", run.fields, min(2, HIGHEST - run.order))
    finite = jnp.isfinite(u).all()
    good = finite if is_traced(finite) else bool(finite)
    return Evolution(t0 + (t1 - t0) * parts, u, rates, run.cloud, recipe, good, {"scheme": scheme.name, "steps": steps})


def _started(run: Run, samples: list[Any], force: Any, jump: Any, h: Any, still: np.ndarray) -> Any:
    """The state at the start with its impulse, see march.started."""
    semi = run.semi
    flat = [jnp.asarray(v).reshape(-1) for v in run.start]
    y = jnp.concatenate([v[semi.free] for v in flat])
    if semi.second or not len(semi.held):
        return y
    at = flat[0][semi.held], samples[0][:, 0]
    if not is_traced(at) and not run.algebraic:
        gap = np.abs(np.asarray(at[0]) - np.asarray(at[1])).max(initial=0.0)
        if gap <= 1e-13 * np.abs(np.asarray(flat[0])).max(initial=0.0):
            return y
    moved = semi.masses_held[-1].times(flat[-1][semi.held]) - jump
    if run.algebraic or still.any():
        small = 1e-7 * h
        return semi.system.resolvent(small).solve(semi.system.mass(y) + moved + small * force)
    return y + semi.system.resolvent(jnp.asarray(0.0)).solve(moved)
