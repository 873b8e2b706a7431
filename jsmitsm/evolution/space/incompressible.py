"""Incompressible flow: the pressure's own equation instead of the constraint on the velocities.

An equation div u = 0 determines no rate and no pressure at a moment: a constraint of index 2. The pencil of such a
system has as many modes as velocities, half of which leave the constraint; what they do is decided by errors of the
discretization, and from order 5 on some of them grow. So the divergence of the momentum equations takes its place,

    u_t + N(u) + grad p = nu lap u    gives    div(N(u) + grad p) = 0,    with div u = 0 on the boundary,

without the viscous terms: what is left of a divergence then diffuses, (div u)_t = nu lap(div u), and dies out (Johnston
and Liu, J. Comput. Phys. 199, 2004; Shirokoff and Rosales, J. Comput. Phys. 230, 2011). On a plane along which the flow
slips div u = 0 would say of its tangential velocity what the momentum equations say already; there those across it
give the pressure's slope, for u_n = 0, its rate, its convection and its friction are zero.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.bcs import Condition, condition, fix
from jsmitsm.equation.closing import closed
from jsmitsm.equation.field import RATE, total, unit
from jsmitsm.equation.operators import divergence, dt, grad, partial
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.traced import Traced
from jsmitsm.equation.tracing import trace
from jsmitsm.runtime.tracers import any_number, is_traced
from jsmitsm.taylor.multi_indices import add

# Particles at which numbers of the equations are compared.
_LOOKS = 32


@dataclass(frozen=True)
class Flow:
    """What is what: the pressure's field and the constraint's equation, and by axis the velocity's field and equation.

    floating: whether the pressure is determined up to a constant only. open: groups that neither hold the velocity nor
    let it slip nor say anything of the pressure.
    """

    pressure: int
    constraint: int
    velocity: tuple[int, ...]
    momentum: tuple[int, ...]
    floating: bool = False
    open: tuple[str, ...] = ()


def flow_of(stated: Problem, whole: Traced, cloud: Cloud) -> Flow | None:
    """The flow that a residual in time describes, or None; ValueError where its viscosity is no number."""
    row = [[s for s, p in zip(whole.slots, held) if p] for held in whole.pattern]
    moved = {k % RATE for k, _ in whole.slots if k >= RATE}
    still = sorted(set(range(stated.fields)) - moved)
    bare = [e for e, slots in enumerate(row) if all(k < RATE for k, _ in slots)]
    if len(still) != 1 or len(bare) != 1:
        return None
    pressure, constraint, dim = still[0], bare[0], cloud.dim
    parts = {b: k for k, b in row[constraint] if sum(b) == 1}
    if len(row[constraint]) != dim or len(parts) != dim or len({*parts.values(), pressure}) != dim + 1:
        return None
    velocity = tuple(parts[unit(dim, i)] for i in range(dim))
    momentum = tuple(
        next((e for e, slots in enumerate(row) if [s[0] for s in slots if s[0] >= RATE] == [k + RATE]), -1)
        for k in velocity
    )
    if -1 in momentum:
        return None
    _check_viscosity(stated, whole, cloud, velocity, momentum, constraint)
    return Flow(pressure, constraint, velocity, momentum)


def _numbers(stated: Problem, whole: Traced, cloud: Cloud) -> np.ndarray:
    """The coefficients (E, S, M) of a residual's slots at some particles, of two states at two times."""
    n = min(len(cloud), _LOOKS)
    points = np.asarray(any_number(cloud.points))[:: max(1, len(cloud) // n)][:n]
    rng, found = np.random.default_rng(0), []
    for _ in range(2):
        params = (np.asarray(rng.normal()), jax.tree.map(any_number, stated.params[1]))
        slots = rng.normal(size=(len(whole.slots), 1, len(points)))
        jac, _ = whole.coefficients(points, 0, params=params, slots=slots)
        found.append(np.broadcast_to(np.asarray(jac)[:, :, 0], (*whole.pattern.shape, len(points))))
    return np.concatenate(found, axis=2)


def _check_viscosity(
    stated: Problem, whole: Traced, cloud: Cloud, velocity: tuple[int, ...], momentum: tuple[int, ...], constraint: int
) -> None:
    """ValueError unless the divergence of the viscous terms is a number times the Laplacian of div u."""
    dim, numbers = cloud.dim, _numbers(stated, whole, cloud)
    place = {slot: s for s, slot in enumerate(whole.slots)}
    viscous = [s for s, (_, b) in enumerate(whole.slots) if sum(b) > 1]
    rated = [place[k + RATE, (0,) * dim] for k in velocity]
    use = np.zeros(whole.pattern.shape, bool)
    use[constraint] = True
    use[np.ix_(momentum, viscous)] = True
    use[momentum, rated] = True
    spread = np.ptp(numbers, axis=2)[use].max(initial=0.0)
    numbers = numbers.mean(axis=2)
    weights = np.array([numbers[constraint, place[k, unit(dim, i)]] for i, k in enumerate(velocity)])
    density = numbers[momentum, rated]
    sums: Any = defaultdict(float)
    for j, e in enumerate(momentum):
        for s in viscous:
            k, b = whole.slots[s]
            sums[k, add(b, unit(dim, j))] += numbers[e, s]
    wanted = [(k, add(unit(dim, i), tuple(2 * v for v in unit(dim, m)))) for i, k in enumerate(velocity)
              for m in range(dim)]  # fmt: skip
    nu = np.mean([-sums[one] for one in wanted])
    odd = max((abs(v) for one, v in sums.items() if one not in wanted), default=0.0)
    off = max(abs(sums[one] + nu) for one in wanted)
    uneven = max(np.ptp(v) / np.abs(v).max() for v in (weights, density))
    if spread > 1e-10 * np.abs(numbers[use]).max() or uneven > 1e-10:
        why = "a coefficient of the constraint, of a rate or of the viscosity varies"
    elif not nu * density[0] > 0 or max(odd, off) > 1e-10 * abs(nu):
        why = "their viscous terms are not those of one positive viscosity, nu lap u"
    else:
        return
    raise ValueError(
        f"pde: fields {list(velocity)} are the velocities of an incompressible flow, but {why}, which js.evolve does "
        "not do; in 2D solve for a stream function and the vorticity, or solve for the steady flow by js.solve"
    )


def with_pressure_equation(stated: Problem, whole: Traced, flow: Flow, cloud: Cloud) -> tuple[Problem, Flow]:
    """The problem with an equation for the pressure, and conditions for it."""
    recorded, dim = closed(stated, whole), cloud.dim
    fixed, floats = _of_pressure(recorded, whole, flow)

    def continuity(u: Any, x: Any, n: Any, p: Any) -> Any:
        return total(partial(u[k], unit(dim, i))(x) for i, k in enumerate(flow.velocity))

    def across(u: Any, x: Any, n: Any, p: Any) -> Any:
        """The momentum equations along n where the velocities are zero."""

        def still(slot: Any) -> Any:
            k, b = slot
            return jnp.zeros(()) if k >= RATE or k in flow.velocity else partial(u[k], b)(x)

        rows = whole.written(x, still, p)
        return total(n[i] * rows[e] for i, e in enumerate(flow.momentum))

    bcs, loose = dict(stated.bcs), []
    for name, conditions in stated.bcs.items():
        if name not in cloud.groups or conditions[0].kind in ("periodic", "fix", "interface"):
            continue
        # Of the flow's conditions, one more than it has velocities, div u = 0 is the last.
        slips = name not in fixed and _slips(conditions, flow, cloud, name)
        count = sum(_rows(c, flow, stated.fields) for c in recorded.bcs[name])
        if count < dim:
            raise ValueError(
                f"bcs[{name!r}]: {count} condition(s) on the flow, fields {[*flow.velocity, flow.pressure]}, which "
                f"takes {dim} beside div u = 0: give all velocities, or the pressure and the velocities along the side"
            )
        if count == dim:
            last = condition(across if slips else continuity)
            bcs[name] = [*conditions, _outlet(conditions, flow, cloud, name) if name in fixed else last]
        if name not in fixed:
            held = {k for c in conditions if c.kind == "dirichlet" for k in _fields(c, stated.fields)}
            loose += [] if slips or held >= set(flow.velocity) else [name]
    if floats:
        inner = np.asarray(cloud.groups["interior"])
        points = np.asarray(any_number(cloud.points))
        nearest = inner[np.argmin(np.linalg.norm(points[inner] - points.mean(axis=0), axis=1))]
        name = "the pressure's constant"
        bcs[name] = [fix([int(nearest)], 0.0, flow.pressure)]
    made = Problem(_pde(whole, flow, dim, False), bcs, stated.fields, stated.params)
    _check_convection(made, flow, cloud)
    made.pde = _pde(whole, flow, dim, True)
    return made, replace(flow, floating=floats, open=tuple(loose))


def _fields(c: Condition, fields: int) -> tuple[int, ...]:
    return tuple(range(fields)) if c.field is None else (c.field,)


def _rows(c: Condition, flow: Flow, fields: int) -> int:
    """How many numbers a recorded condition gives of the flow alone at a particle."""
    own = {*flow.velocity, flow.pressure}
    if c.kind == "free":
        return 0
    if c.kind != "condition":
        return len(own.intersection(_fields(c, fields)))
    inside = np.array([k in own for k, _ in c.residual.slots], bool)
    held = c.residual.pattern
    return int((held[:, inside].any(axis=1) & ~held[:, ~inside].any(axis=1)).sum())


def _outlet(conditions: Sequence[Condition], flow: Flow, cloud: Cloud, name: str) -> Condition:
    """div u = 0 where the pressure is given, and besides it the velocities along a plane across an axis.

    Their slopes are those of their values; modes in the corners grow where they are the solution's own (in 3D), beside
    slopes that are given, or where the velocity through the plane is held. ValueError where this does not serve.
    """
    dim, held = cloud.dim, {c.field: c.parts["value"] for c in conditions if c.kind == "dirichlet"}
    left = [i for i, k in enumerate(flow.velocity) if k not in held]
    axis = None if cloud.normals is None else _across(cloud, name)
    arrays = any(np.ndim(v) for v in held.values() if not callable(v))
    if axis is None or left != [axis] or (arrays and dim > 2):
        named = {c.field for c in conditions}
        bare = next((flow.velocity[i] for i in left if flow.velocity[i] not in named), flow.velocity[left[0]])
        raise ValueError(
            f"bcs[{name!r}]: beside the pressure it gives something else than the velocities along a plane across an "
            f"axis, by numbers or functions, and div u = 0 does not serve as its last condition; give one more, as the "
            f"slope js.neumann(0.0, field={bare})"
        )

    def along(u: Any, k: int, i: int, x: Any, p: Any) -> Any:
        value: Any = held.get(k, 0.0)
        if callable(value):
            return jax.jacfwd(lambda y: jnp.asarray(value(y, p), float).reshape(()))(x)[i]
        return partial(u[k], unit(dim, i))(x) if i == axis or np.ndim(value) else jnp.zeros(())

    return condition(lambda u, x, n, p: total(along(u, k, i, x, p) for i, k in enumerate(flow.velocity)))


def _across(cloud: Cloud, name: str) -> int | None:
    """The axis that a group is a plane across, if it is one."""
    normals = np.abs(np.asarray(any_number(cloud.normals))[np.asarray(cloud.groups[name])])
    axis = int(np.argmax(normals[0]))
    return axis if np.allclose(normals, np.eye(cloud.dim)[axis]) else None


def _slips(conditions: Sequence[Condition], flow: Flow, cloud: Cloud, name: str) -> bool:
    """Whether a group is a plane across an axis, with a zero velocity through it and no friction along it."""
    axis = None if cloud.normals is None else _across(cloud, name)
    if axis is None:
        return False
    found = {c.field: (c.kind, c.parts.get("value")) for c in conditions}
    return all(
        found.get(k, ("", None))[0] == ("dirichlet" if i == axis else "neumann") and _zero(found[k][1])
        for i, k in enumerate(flow.velocity)
    )


def _zero(value: Any) -> bool:
    return not callable(value) and not is_traced(value) and not np.any(np.asarray(value))


def _check_convection(made: Problem, flow: Flow, cloud: Cloud) -> None:
    """ValueError unless second derivatives of the velocities enter the pressure's equation by grad(div u) alone."""
    whole, dim = trace(made.pde, cloud.dim, made.fields, params=made.params), cloud.dim  # type: ignore[arg-type]
    numbers = dict(zip(whole.slots, _numbers(made, whole, cloud)[flow.constraint]))
    second: dict[Any, Any] = {s: v for s, v in numbers.items() if s[0] in flow.velocity and sum(s[1]) > 1}
    size = max((np.abs(v).max() for v in second.values()), default=0.0)
    for axis in range(dim):
        along = [second.pop((k, add(unit(dim, i), unit(dim, axis))), 0.0) for i, k in enumerate(flow.velocity)]
        second["differences", axis] = np.ptp(np.broadcast_arrays(*along), axis=0)
    if max(np.abs(v).max() for v in second.values()) > 1e-10 * size:
        raise ValueError(
            "pde: the divergence of the flow's convection holds second derivatives of the velocity besides those of "
            "div u, as in the rotational form; write it as js.grad(v)(x) @ v(x), v = u[:2]"
        )


def _of_pressure(problem: Problem, whole: Traced, flow: Flow) -> tuple[set[str], bool]:
    """The groups with a condition of the pressure alone, and whether nothing determines its constant."""
    q, zero = flow.pressure, (0,) * whole.dim
    fixed, floats = set(), (q, zero) not in whole.slots
    for name, conditions in problem.bcs.items():
        for c in conditions:
            if c.kind == "condition":
                floats &= (q, zero) not in c.residual.slots
            elif c.kind != "periodic" and c.field in (q, None):
                fixed.add(name)
                floats &= c.kind == "neumann"
    return fixed, floats


def _pde(whole: Traced, flow: Flow, dim: int, divergence_free: bool) -> Any:
    """The residual (u, x, params) with the pressure's equation in the place of the constraint.

    divergence_free: without what grad(div u) = 0 takes out of it, the second derivatives of the velocities.
    """

    def value(u: Any, slot: Any, x: Any) -> Any:
        k, b = slot
        return dt(u[k % RATE], k // RATE)(x) if k >= RATE else partial(u[k], b)(x)

    def pde(u: Any, x: Any, p: Any) -> Any:
        def inviscid(y: Any) -> Any:
            def part(slot: Any) -> Any:
                k, b = slot
                if k >= RATE or (k in flow.velocity and sum(b) > 1):
                    return jnp.zeros(())
                if not (divergence_free and k in flow.velocity):
                    return value(u, slot, y)
                return value(u, slot, x) if sum(b) else partial(u[k], b)(x) + grad(u[k])(x) @ (y - x)

            found = whole.written(y, part, p)
            return jnp.stack([found[e] for e in flow.momentum])

        rows = whole.written(x, lambda slot: value(u, slot, x), p)
        own = divergence(inviscid)(x)
        return jnp.stack([own if e == flow.constraint else rows[e] for e in range(whole.n_equations)])

    return pde
