"""Runs whose values JAX traces: all that drives them first, then the steps as one operation."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.evolution.evolution import Evolution
from jsmitsm.evolution.gradient.adjoint import Plan, states
from jsmitsm.evolution.gradient.backward import backward
from jsmitsm.evolution.gradient.inputs import Inputs, Push
from jsmitsm.evolution.run import Run, drifted
from jsmitsm.evolution.space.semidiscrete import Semidiscrete, centred
from jsmitsm.evolution.space.system import VANISHING
from jsmitsm.evolution.steps import dense_output
from jsmitsm.evolution.steps.tableaux import Additive, Radau
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.runtime.whole_program import in_one_program
from jsmitsm.solution.fit import Recipe
from jsmitsm.taylor.multi_indices import HIGHEST


def differentiable(run: Run, steps: int, parts: np.ndarray) -> Evolution:
    """The Evolution of a run with traced values, in equal steps.

    Where the pencil of a quasilinear problem is made anew on the way, the operation ends and another one begins.
    """
    scheme = run.scheme
    t0, t1 = (jnp.asarray(v, float) for v in run.t)
    h = (t1 - t0) / steps
    m = len(scheme.sampling(not run.second).nodes) - 1
    known, done, y, fresh = [], 0, None, True
    found: list[Any] = []
    while done < steps:
        semi = run.semi
        samples, given = _inputs(run, semi, scheme, t0, h, done, steps - done, y)
        renewed = drifted if semi.reference is not None else None
        if y is None and renewed and _leaves(semi, given, t0):  # a start that contradicts the conditions
            y = given.y
            run.renew(y, t0)
            continue
        newton = not semi.linear and run.name != "imex"
        plan = Plan(semi, scheme, newton, steps - done, is_traced(run.t), run.throw, renewed, fresh)
        out = states(plan, backward(given))
        made = len(out) - 1
        found.append(out if not found else out[1:])
        known.append([v if done + made == steps else v[:, : made * m] for v in (samples[0], *samples[3:4])])
        done, y, fresh = done + made, out[-1], True
        if done < steps:
            run.renew(y, t0 + h * done)
    held = [v[0] if len(v) == 1 else jnp.concatenate(v, axis=1) for v in zip(*known)]
    u, rates = _saved(run.semi, parts, steps, m, jnp.concatenate(found), held)
    recipe = Recipe("S", run.order, None, "loo", run.fields, min(2, HIGHEST - run.order))
    finite = jnp.isfinite(u).all()
    good = finite if is_traced(finite) else bool(finite)
    stats = {"scheme": "Radau IIA 5" if isinstance(scheme, Radau) else scheme.name, "steps": steps}
    return Evolution(t0 + (t1 - t0) * parts, u, rates, run.cloud, recipe, good, stats)


def _leaves(semi: Semidiscrete, given: Inputs, t0: Any) -> bool:
    """Whether the coefficients are others once the conditions are met."""
    if any(concrete(v) is None for v in jax.tree.leaves((given, t0))):
        return False
    host, t = jax.tree.map(concrete, (given, t0))
    semi = semi.stated(host.values, host.push)
    return drifted(semi, semi.placed(np.asarray(host.y)[: semi.system.n], np.asarray(host.known[0])), float(t))


def _entered(semi: Semidiscrete, *others: Any) -> tuple[Any, ...]:
    """The equations and what else enters the run, refused in words where derivatives are asked for forward."""
    parts = [semi.source, semi.given, semi.stiff_held, *semi.masses_held]
    own = semi.system.values, [m.values for m in parts]
    (values, of_parts), others = backward((own, others))
    if is_traced(own):
        semi = semi.stated(values, None)
        made = [m.with_values(v) for m, v in zip(parts, of_parts)]
        semi.source, semi.given, semi.stiff_held, semi.masses_held = *made[:3], made[3:]
    return semi, *others


def _inputs(
    run: Run, semi: Semidiscrete, scheme: Additive | Radau, t0: Any, h: Any, done: int, steps: int, y: Any
) -> tuple[list[Any], Inputs]:
    """Samples at the nodes of so many steps, and all that drives them; y: None at the start."""
    sampling = scheme.sampling(not semi.second)
    m, s = len(sampling.nodes) - 1, len(sampling.stages)
    places = np.append((np.arange(steps)[:, None] + sampling.nodes[:-1]).reshape(-1), steps) + done
    times = t0 + h * places
    semi, samples, start, h = _entered(semi, semi.samples(times), run.start, h)
    windows = np.arange(steps)[:, None] * m + np.arange(m + 1)
    numbers = np.append(0, windows[:, sampling.stages].reshape(-1))
    of_stages = [v if m == s else v[:, numbers] for v in samples]  # as large as the forces: no copy where all are asked
    mixed = [_mixed(v, windows, sampling.blend) for v in samples[:2]]
    force, jump = semi.forces(*mixed, *of_stages[2:])
    push = None if semi.linear else Push(semi.source.values, semi.rest, semi.params, semi.reference)
    if y is None:
        y = _started(run, semi, start, samples, force[0], jump[0], h, semi.system.undriven())
    values = tuple(jnp.asarray(v) for v in semi.system.values)
    return samples, Inputs(values, push, y, h, force, jump, of_stages[0].T, times if m == s else times[numbers])


@in_one_program
def _mixed(values: Any, windows: np.ndarray, blend: np.ndarray) -> Any:
    """Boundary data at the start and at all stages from those (n, samples) at the nodes; see Sampling."""
    stages = len(windows) * len(blend)  # said, for there may be no values
    return jnp.concatenate([values[:, :1], (values[:, windows] @ blend.T).reshape(len(values), stages)], axis=1)


def _saved(semi: Semidiscrete, parts: np.ndarray, steps: int, m: int, found: Any, held: list[Any]) -> list[Any]:
    """Values (S, N, F) at the saved times, and rates of a problem of second order (or None); held: (held, samples)."""
    index, weights = dense_output.weights(np.linspace(0.0, 1.0, steps + 1), parts)
    at = np.round(index * m).astype(int)  # samples at the ends of steps
    size, out = semi.system.n, []
    places: Any = semi.free, semi.held, semi.disc.partner
    static: Any = {"fields": semi.fields, "floating": semi.floating}
    for part, given in zip((slice(None, size), slice(size, None)), held):
        out.append(_interpolated(found[:, part], given, weights, index, at, *places, **static))
    return out if semi.second else [*out, None]


@partial(in_one_program, static=("fields", "floating"))
def _interpolated(found: Any, held_values: Any, weights: Any, index: Any, at: Any, free: Any, held: Any, partner: Any,
                  fields: int, floating: int | None) -> Any:  # fmt: skip
    """All values from the free ones (K + 1, n) and the held ones (held, samples) of the steps around saved times."""
    mine = jnp.einsum("sk,skn->sn", weights, jnp.asarray(found)[index])
    given = jnp.einsum("sk,skn->sn", weights, jnp.asarray(held_values).T[at])
    flat = jnp.zeros((len(index), len(partner) * fields)).at[:, free].set(mine).at[:, held].set(given)
    return centred(flat.reshape(len(index), -1, fields)[:, partner], floating)


def _started(
    run: Run, semi: Semidiscrete, start: tuple[Any, ...], samples: list[Any], force: Any, jump: Any, h: Any,
    still: np.ndarray,
) -> Any:  # fmt: skip
    """The state at the start with its impulse, see march.started."""
    flat = [jnp.asarray(v).reshape(-1) for v in start]
    y = jnp.concatenate([v[semi.free] for v in flat])
    if semi.second or not len(semi.held):
        return y
    at = flat[0][semi.held], samples[0][:, 0]
    if not is_traced(at) and not run.algebraic:
        gap = np.abs(np.asarray(at[0]) - np.asarray(at[1])).max(initial=0.0)
        if gap <= 1e-13 * np.abs(np.asarray(flat[0])).max(initial=0.0):
            return y
    moved = semi.masses_held[-1].times(flat[-1][semi.held]) - jump
    small = VANISHING * h
    if run.algebraic:
        resolvent, t = semi.system.resolvent(small), run.t[0] + small
        later = semi.samples(jnp.reshape(t, 1))
        forces, jumps = semi.forces(*later)
        for jumped, f, at, known in ((moved, force, run.t[0], samples[0]), (jump - jumps[0], forces[0], t, later[0])):
            f = f if semi.linear else f + semi.explicit(y, at, known[:, 0])
            y = resolvent.solve(semi.system.mass(y) + jumped + small * f)
        return y
    if still.any():
        return semi.system.resolvent(small).solve(semi.system.mass(y) + moved + small * force)
    return y + semi.system.resolvent(jnp.asarray(0.0)).solve(moved)
