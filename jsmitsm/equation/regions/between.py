"""The conditions on interfaces as numbers: linear functionals of the local expansions of both sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import INTERIOR
from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.conditions import component
from jsmitsm.equation.problem import Problem, of_parts
from jsmitsm.equation.regions.interface import INTERFACE
from jsmitsm.equation.regions.per_region import group_and_region, members
from jsmitsm.equation.traced import Traced
from jsmitsm.runtime.errors import did_you_mean
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program
from jsmitsm.taylor.multi_indices import Slot


@dataclass
class Between:
    """The conditions on one interface: slots of both sides (0 the first, 1 the second), and which rows speak of values
    alone. ``numbers(derivatives)`` -> coef (P, rows, S), value (P, rows); the argument (S, P), derivatives of the
    iterate in the slots, is used if not linear."""

    slots: tuple[tuple[int, Slot], ...]
    of_values: tuple[bool, ...]
    linear: bool
    numbers: Callable[[Any], tuple[Any, Any]]

    @property
    def n_rows(self) -> int:
        return len(self.of_values)


def region_of(problem: Problem, cloud: Any, name: str) -> Problem:
    """The problem of one region alone, whose interfaces are still without conditions.

    cloud: the RegionCloud. Arrays over groups and numbers of particles become those of the region.
    """
    ids = cloud.regions[name]
    place = np.full(len(cloud), -1)
    place[ids] = np.arange(len(ids))
    new = of_parts(problem.pde[name], {}, problem.fields, problem.params)
    for key, conditions in problem.bcs.items():
        group, whose = group_and_region(key, cloud)
        if whose not in (None, name):
            continue
        here = place[cloud.groups.get(group, np.zeros(0, int))] >= 0
        if group in cloud.interfaces:
            if here.any():
                new.bcs[group] = [Condition(INTERFACE)]
            continue
        made = [_here(c, place, here, problem.fields) for c in conditions]
        kept = [c for c in made if c is not None and (c.kind == "fix" or here.any())]
        if kept:
            new.bcs[group] = kept
    for group in cloud.groups:
        if group in cloud.interfaces and (place[cloud.groups[group]] >= 0).any():
            new.bcs.setdefault(group, [Condition(INTERFACE)])
    return new


def _here(c: Condition, place: np.ndarray, here: np.ndarray, fields: int) -> Condition | None:
    """A condition for those members of its group that are ``here``; None where there are none."""
    parts = dict(c.parts)
    if c.kind == "fix":
        there = place[np.array(c.indices)]
        here, parts["indices"] = there >= 0, tuple(int(i) for i in there[there >= 0])
        if not here.any():
            return None
    for k in c.numbers:
        shape = np.shape(parts[k])
        whole = fields > 1 and c.field is None and shape == (fields,)
        if shape and shape[0] == len(here) and not whole and not isinstance(parts[k], Traced):
            parts[k] = parts[k][np.flatnonzero(here)]
    return Condition(c.kind, c.field, **parts)


def check_regions(problem: Problem, cloud: Any) -> None:
    """ValueError unless there is an equation for each region and a condition for each interface of the cloud."""
    names, given = list(cloud.regions), list(problem.pde)
    for name in names:
        if name not in given:
            raise ValueError(f"pde: no equation for the region {name!r}; the cloud has {names}, the problem {given}")
    for name in given:
        if name not in names:
            raise ValueError(f"pde: {name!r} is no region of the cloud; it has {names}{did_you_mean(name, names)}")
    interfaces = list(cloud.interfaces)
    for key, conditions in problem.bcs.items():
        turned = "|".join(reversed(key.split("|")))
        meant = [c for c in conditions if c.kind == INTERFACE]
        if key not in interfaces:
            if turned in interfaces:
                raise ValueError(
                    f"bcs: the interface is called {turned!r}, not {key!r}: its names stand in the order of the "
                    f"regions, and its normal points from {turned.split('|')[0]!r} to {turned.split('|')[1]!r}"
                )
            if meant or "|" in key:
                raise ValueError(
                    f"bcs: {key!r} is no interface of the cloud; it has {interfaces or 'none'}"
                    f"{did_you_mean(key, interfaces)}"
                )
            if any(c.kind == "periodic" for c in conditions):
                raise ValueError(f"bcs[{key!r}]: js.periodic is not made for clouds of several regions yet")
            _check_group(problem, cloud, key, conditions)
            continue
        if len(conditions) != 1 or not meant:
            raise ValueError(f"bcs[{key!r}]: an interface takes one js.interface(...), got {conditions}")
        _check_sides(key, meant[0])
    missing = [name for name in interfaces if name not in problem.bcs]
    if missing:
        raise ValueError(
            f"bcs: no condition for the interface(s) {missing}; the cloud has {interfaces}. Give each js.interface("
            f'flux={{{missing[0].split("|")[0]!r}: f, {missing[0].split("|")[1]!r}: g}}), it is never guessed'
        )


def _check_group(problem: Problem, cloud: Any, key: str, conditions: list[Condition]) -> None:
    """Conditions on a boundary group, of one region or of all that it bounds."""
    group, region = group_and_region(key, cloud)
    known = [name for name in cloud.groups if name != INTERIOR and name not in cloud.interfaces]
    if group not in known and not all(c.kind == "fix" for c in conditions):
        raise ValueError(
            f"bcs: {group!r} is no boundary group of the cloud; it has {known}{did_you_mean(group, known)}"
        )
    if region is not None and group in problem.bcs:
        raise ValueError(f"bcs[{group!r}]: conditions for all regions and for {region!r}; give one of the two")
    if region is not None and not len(members(key, cloud)):
        raise ValueError(f"bcs[{group!r}]: a condition for the region {region!r}, which the group does not bound")


def _check_sides(key: str, c: Condition) -> None:
    sides = tuple(key.split("|"))
    if "sides" in c.parts and set(c.sides) != set(sides):
        raise ValueError(f"bcs[{key!r}]: flux for {list(c.sides)}, expected one for each of {list(sides)}")


def between(problem: Problem, name: str, points: Any, normals: Any) -> Between:
    """The conditions on the interface ``name`` at its pairs (P, D); those of a closed problem."""
    (c,), where = problem.bcs[name], f"bcs[{name!r}]"
    if "sides" not in c.parts:
        return _general(problem, c.residual, points, normals, where)
    first, second = (c.one, c.two) if c.sides[0] == name.split("|")[0] else (c.two, c.one)
    for side, flux in zip(name.split("|"), (first, second)):
        _check_flux(flux, problem.fields, f"{where}.flux[{side!r}]")
    zero, fields = (0,) * points.shape[1], problem.fields
    own = [(side, (f, zero)) for side in (0, 1) for f in range(fields)]
    more = [(side, slot) for side, flux in enumerate((first, second)) for slot in flux.slots]
    slots = tuple(dict.fromkeys(own + more))
    places = [np.array([slots.index((side, s)) for s in flux.slots], int) for side, flux in enumerate((first, second))]
    given = {k: c.parts.get(k) for k in ("jump", "source", "resistance")}

    def values(what: str) -> list[Any]:
        each = range(fields)
        return [component(problem, points, given[what], None, k, f"{where}.{what}")() for k in each]

    def numbers(derivatives: Any) -> tuple[Any, Any]:
        made = [
            _linearised(flux, points, normals, problem.params, None if flux.linear else derivatives[place], where)
            for flux, place in zip((first, second), places)
        ]
        if fields == 1:
            _check_signs(first, second, made, normals, name)
        resistance = given["resistance"]
        if resistance is not None:
            resistance = component(problem, points, resistance, 0, 0, f"{where}.resistance")()
            if not is_traced(resistance) and (np.asarray(resistance) < 0).any():
                raise ValueError(
                    f"{where}.resistance: {np.min(resistance):.6g} came, expected none below zero: the temperature "
                    "falls along the flow of heat, u_a - u_b = -resistance flux_a; state other laws as a residual"
                )
        return _rows(made, places, values("jump"), values("source"), resistance, len(slots))

    plain = given["resistance"] is None
    return Between(slots, (plain,) * fields + (False,) * fields, first.linear and second.linear, numbers)


def _check_flux(flux: Traced, fields: int, where: str) -> None:
    if flux.n_equations != fields:
        raise ValueError(f"{where}: returns {flux.n_equations} value(s) for {fields} field(s); a flux has one for each")
    if not flux.slots:
        raise ValueError(f"{where}: does not depend on u; return +k n . grad u (or +traction)")
    if max(sum(b) for _, b in flux.slots) > 1:
        raise ValueError(f"{where}: holds derivatives beyond the first, which fluxes of second-order equations lack")


def _check_signs(first: Traced, second: Traced, made: Any, normals: Any, name: str) -> None:
    """Both fluxes count along the same normal: ValueError where they grow with the slope in opposite senses."""
    if is_traced(made, normals):
        return
    along = []
    for flux, (jac, _) in zip((first, second), made):
        slots = [(k, b.index(1)) for k, (_, b) in enumerate(flux.slots) if sum(b) == 1]
        along.append(sum(np.asarray(jac)[0, k] * np.asarray(normals)[:, axis] for k, axis in slots))
    if np.ndim(along[0]) and np.ndim(along[1]) and (along[0] * along[1] < 0).all():
        raise ValueError(
            f"bcs[{name!r}].flux: of opposite signs on the two sides, but both are +k n . grad u with the same n, "
            f"which points from {name.split('|')[0]!r} to {name.split('|')[1]!r}; where a conductivity is meant to be "
            "negative, state it as a residual"
        )


def _linearised(flux: Traced, points: Any, normals: Any, params: Any, at: Any, where: str) -> tuple[Any, Any]:
    """The coefficients (E, S, n) of a function of the field and what it is at u = 0 (E, n), linearised at ``at``."""
    n = points.shape[0]
    jac, res = flux.coefficients(
        points, 0, extras=(normals,), params=params, slots=None if flux.linear else at[:, None, :]
    )
    made = _flattened(jac, res, None if flux.linear else at, n)
    if flux.linear and not is_traced(made) and not all(np.isfinite(x).all() for x in made):
        raise ValueError(f"{where}: NaN or infinite coefficients at a pair of this interface")
    return made


def _general(problem: Problem, residual: Traced, points: Any, normals: Any, where: str) -> Between:
    """A user's residual(a, b, x, n)."""
    fields = problem.fields
    slots = tuple((f // fields, (f % fields, b)) for f, b in residual.slots)
    for side in (0, 1):
        if not any(s == side for s, _ in slots):
            raise ValueError(f"{where}: the residual does not depend on {'ab'[side]}, the field of one side")
    if residual.n_equations != 2 * fields:
        raise ValueError(
            f"{where}: the residual returns {residual.n_equations} condition(s), but an interface of equations of "
            f"second order takes {2 * fields}, two for each field"
        )
    if max(sum(b) for _, (_, b) in slots) > 1:
        raise ValueError(f"{where}: the residual holds derivatives beyond the first")
    order = np.array([sum(b) for _, (_, b) in slots])
    of_values = tuple(bool(not np.any(row & (order > 0))) for row in residual.pattern)

    def numbers(derivatives: Any) -> tuple[Any, Any]:
        jac, res = _linearised(residual, points, normals, problem.params, derivatives, where)
        return _as_conditions(jac, res)

    return Between(slots, of_values, residual.linear, numbers)


@in_one_program
def _as_conditions(jac: Any, res: Any) -> tuple[Any, Any]:
    xp: Any = jnp if is_traced(jac, res) else np
    return xp.transpose(jac, (2, 0, 1)), -res.T


def _flattened(jac: Any, res: Any, at: Any, n: int) -> tuple[Any, Any]:
    xp: Any = jnp if is_traced(jac, res, at) else np
    jac = xp.broadcast_to(jac[:, :, 0], (*jac.shape[:2], n))
    res = xp.zeros((jac.shape[0], n)) if res is None else xp.broadcast_to(res[:, 0], (jac.shape[0], n))
    return jac, res if at is None else res - xp.einsum("esn,sn->en", jac, at)


def _rows(
    flux: list[tuple[Any, Any]], places: list[np.ndarray], jump: list[Any], source: list[Any], resistance: Any,
    n_slots: int,
) -> tuple[Any, Any]:
    """u_a - u_b + R q_a = jump and q_a - q_b = source, field by field: coef (n, 2 F, S), value (n, 2 F)."""
    return _stacked(flux, places, jump, source, resistance, np.zeros(n_slots))


@in_one_program
def _stacked(flux: Any, places: Any, jump: Any, source: Any, resistance: Any, none: Any) -> tuple[Any, Any]:
    xp: Any = jnp if is_traced(flux, jump, source, resistance) else np
    fields, n_slots = len(jump), len(none)
    spread = [
        xp.einsum("esn,st->net", jac, (place[:, None] == np.arange(n_slots)).astype(float))
        for (jac, _), place in zip(flux, places)
    ]
    n = spread[0].shape[0]
    difference = np.zeros((fields, n_slots))
    difference[np.arange(fields), np.arange(fields)] = 1.0
    difference[np.arange(fields), fields + np.arange(fields)] = -1.0
    value = xp.broadcast_to(xp.asarray(difference), (n, fields, n_slots))
    right = xp.stack(jump, axis=1)
    if resistance is not None:
        value = value + resistance[:, None, None] * spread[0]
        right = right - resistance[:, None] * flux[0][1].T
    step = xp.stack(source, axis=1) - flux[0][1].T + flux[1][1].T
    return xp.concatenate([value, spread[0] - spread[1]], axis=1), xp.concatenate([right, step], axis=1)
