"""Boundary conditions as numbers: held values, and linear functionals of local expansions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.cloud.corners import mean_normals, side_normals
from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.closing import recorded_residual, recorded_values
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.traced import Traced
from jsmitsm.runtime.errors import did_you_mean
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program, picked
from jsmitsm.taylor.multi_indices import Slot


@dataclass
class Group:
    """The conditions on one group: fields whose value is held, and everything else.

    ``numbers`` computes the functionals; for conditions that are nonlinear in u it takes the
    local derivatives of the current iterate.
    """

    name: str
    ids: np.ndarray
    held: dict[int, Callable[[], Any]] = field(default_factory=dict)
    parts: list[Part] = field(default_factory=list)

    @property
    def n_rows(self) -> int:
        return sum(part.n_rows for part in self.parts)

    @property
    def slots(self) -> tuple[Slot, ...]:
        return tuple(dict.fromkeys(slot for part in self.parts for slot in part.slots))

    @property
    def linear(self) -> bool:
        return all(part.linear for part in self.parts)


@dataclass
class Part:
    """One condition that is not a held value. ``numbers(derivatives)`` -> coef, value; the
    argument (S, n), derivatives of the iterate in the part's slots, is used if not linear."""

    slots: tuple[Slot, ...]
    n_rows: int
    linear: bool
    numbers: Callable[[Any], tuple[Any, Any]]


def group_conditions(
    problem: Problem, cloud: Cloud, order: int, orders: tuple[int, ...], whole: bool = True
) -> list[Group]:
    """Check the conditions against the cloud and lay them out, one entry per boundary group.

    orders: those of the operator's equations; whole: not a part of a cloud, which may lack sides.

    Raises ValueError for missing, unknown or impossible conditions.
    """
    highest = max(orders)
    names = [name for name in cloud.groups if name != INTERIOR]
    given = dict(problem.bcs)
    used = {name for cs in given.values() for c in cs if c.kind == "periodic" for name in c.groups}
    unknown = sorted(used - set(names))
    if unknown:
        raise ValueError(f"bcs: periodic names {unknown[0]!r}, which is no boundary group of the cloud; it has {names}"
                         + did_you_mean(unknown[0], names))  # fmt: skip
    missing = [n for n in names if n not in given and n not in used and len(cloud.groups[n])]
    if missing:
        stray = [n for n in given if n not in cloud.groups]
        raise ValueError(
            f"bcs: no condition for the boundary group(s) {missing}; the cloud has {names}"
            + (f", but not {stray}. " if stray else ". ") +
            "Give each a condition, js.free() where none belongs"
            + next(filter(None, (did_you_mean(n, missing) for n in stray)), "")
        )
    seconds = {c.groups[1] for cs in given.values() for c in cs if c.kind == "periodic"}
    for name in seconds & set(given):
        if any(c.kind != "periodic" for c in given[name]):
            raise ValueError(
                f"bcs[{name!r}]: its particles take the values of their periodic partners; remove its other conditions"
            )
    if whole and highest > 0 and not any(c.kind != "free" for cs in given.values() for c in cs):
        raise ValueError(f"bcs: no condition on any group ({names}), so the solution is not determined; give one")
    groups = []
    counts = {name: 0 for name in names if name not in used and len(cloud.groups[name])}
    for name, conditions in given.items():
        pinned = [c for c in conditions if c.kind == "fix"]
        if name not in cloud.groups and len(pinned) < len([c for c in conditions if c.kind != "periodic"]):
            raise ValueError(f"bcs: {name!r} is no group of the cloud; it has {names}{did_you_mean(name, names)}")
        if name == INTERIOR and len(pinned) < len(conditions):
            raise ValueError('bcs: "interior" takes no boundary condition; hold single particles with js.fix')
        groups += [_laid_out(problem, cloud, name, np.array(c.indices), [c], order, highest) for c in pinned]
        rest = [c for c in conditions if c.kind not in ("fix", "periodic", "free", "interface")]
        if rest:
            groups.append(_laid_out(problem, cloud, name, cloud.groups[name], rest, order, highest))
            counts[name] = len(groups[-1].held) + groups[-1].n_rows
    if whole:
        refuse_counts(problem, counts, sum(orders))
    groups = [g for g in groups if len(g.ids)]
    _refuse_held_twice(groups, problem.fields, len(cloud))
    return groups


def refuse_counts(problem: Problem, counts: dict[str, int], total: int) -> None:
    """More or fewer conditions on the sides (counts by name) than an operator of order ``total`` takes."""
    _refuse_too_many(counts, total, problem.fields)
    if problem.fields == 1 and not any(c.kind == "fix" for cs in problem.bcs.values() for c in cs):
        _refuse_too_few(counts, total)


def _refuse_too_many(counts: dict[str, int], total: int, fields: int) -> None:
    """More conditions on a side than the operator takes.

    An operator of order m takes m of them along a line through the domain, on both of its ends
    together: all of them may stand on one side (a start in time) only where another side has fewer.
    """
    most = max(total, fields)
    for name, count in counts.items():
        if count > most:
            raise ValueError(
                f"bcs[{name!r}]: {count} conditions on one side, but an operator of order {total} takes at most "
                f"{most}; remove some"
            )
        if fields == 1 and 2 * count > total and 2 * min(counts.values()) >= total and total % 2 == 0:
            raise ValueError(
                f"bcs[{name!r}]: {count} conditions, and at least {total // 2} on every other side, but an operator of "
                f"order {total} takes {total // 2} on each; remove some, or let another side have js.free()"
            )


def _refuse_too_few(counts: dict[str, int], total: int) -> None:
    """Fewer conditions than an operator of even order m takes, m / 2 on every side: many functions meet them.

    Where one side is free or has more than its half, as at a start in time, others may have less.
    """
    half = total // 2
    if not counts or total % 2 or min(counts.values()) == 0 or max(counts.values()) > half:
        return
    name = min(counts, key=lambda n: counts[n])
    if counts[name] < half:
        raise ValueError(
            f"bcs[{name!r}]: {counts[name]} condition(s), but an operator of order {total} takes {half} on every side; "
            "give a list of them, as [js.dirichlet(0.0), js.neumann(0.0)], or let another side have js.free()"
        )


def _refuse_held_twice(groups: list[Group], fields: int, n: int) -> None:
    """A value held by two conditions (a group's and a fixed particle's)."""
    owner = np.full((n, fields), "", object)
    for group in groups:
        for k in group.held:
            twice = group.ids[owner[group.ids, k] != ""]
            if len(twice):
                raise ValueError(
                    f"bcs[{group.name!r}]: the value of particle {int(twice[0])} is held by "
                    f"bcs[{owner[twice[0], k]!r}] already; remove it from one of the two"
                )
            owner[group.ids, k] = group.name


def _laid_out(problem, cloud, name, ids, conditions: list[Condition], order: int, highest: int) -> Group:
    """The held fields and the functionals of one group."""
    if len(ids) and (ids.min() < 0 or ids.max() >= len(cloud)):
        raise ValueError(f"bcs[{name!r}]: particle {int(ids.max())} does not exist; the cloud has {len(cloud)}")
    group = Group(name, ids)
    points = picked(cloud.points, ids)
    for c in conditions:
        where = f"bcs[{name!r}]"
        if c.kind in ("dirichlet", "fix"):
            fields = range(problem.fields) if c.field is None else (c.field,)
            for k in fields:
                if k in group.held:
                    raise ValueError(f"{where}: the value of field {k} is given twice; remove one of the conditions")
                group.held[k] = component(problem, points, c.value, c.field, k, f"{where}.value")
        else:
            normals = condition_normals(cloud, ids, c, where)
            for part in _parts(problem, points, normals, c, where):
                limit = min(order, max(highest - 1, 1))
                top = max((sum(b) for _, b in part.slots), default=0)
                if top > limit:
                    raise ValueError(
                        f"{where}: the condition has derivatives of order {top}, but an operator of order {highest} "
                        f"and a Taylor expansion of order {order} allow at most {limit}; lower the condition's order"
                    )
                group.parts.append(part)
    _held_by_residual(group, problem)
    return group


def _held_by_residual(group: Group, problem: Problem) -> None:
    """Turn functionals that only fix one field's value (u(x) - g(x)) into held values."""
    for part in list(group.parts):
        if part.n_rows == 1 and part.linear and len(part.slots) == 1 and sum(part.slots[0][1]) == 0:
            k = part.slots[0][0]
            if k in group.held:
                raise ValueError(f"bcs[{group.name!r}]: the value of field {k} is given twice; remove one of them")

            def value(part=part):
                coef, value = part.numbers(None)
                return value[:, 0] / coef[:, 0, 0]

            group.held[k] = value
            group.parts.remove(part)


def each_its_own(c: Condition, n: int) -> bool:
    """Whether a condition has numbers for every one of its n particles."""
    return any(np.ndim(c.parts[k]) > 0 and np.shape(c.parts[k])[0] == n for k in c.numbers)


def condition_normals(cloud: Cloud, ids: np.ndarray, c: Condition, where: str) -> Any:
    """The normals (n, D) that a condition is asked for with: at corners within a group a side's.

    Slopes given by numbers or functions of x are the same on all sides, and hold for their mean; those given particle
    by particle are for the cloud's own normals, unless they are said to be ``along`` the sides'.
    """
    if cloud.normals is None:
        raise ValueError(f"{where}: the condition uses the normal, but the cloud has none; give Cloud(..., normals=)")
    if c.kind == "condition":
        normals = side_normals(cloud)
    else:
        normals = mean_normals(cloud) if "along" in c.parts or not each_its_own(c, len(ids)) else cloud.normals
    normals = picked(normals, ids)
    if not is_traced(normals) and np.isnan(np.asarray(normals)).any():
        raise ValueError(f"{where}: NaN normals in this group; give every boundary particle a unit outward normal")
    return normals


def component(problem: Problem, points: Any, value: Any, named: int | None, k: int, where: str) -> Callable[[], Any]:
    """The value of field k over a group, (n,), computed when asked for."""
    n, several = points.shape[0], problem.fields > 1 and named is None

    def compute():
        if callable(value) or isinstance(value, Traced):
            sampled = sample(value, points, problem.params, problem.fields if several else 1, where)
            return sampled[k if several else 0]
        xp = jnp if is_traced(value) or isinstance(value, jax.Array) else np
        array = xp.asarray(value, float)
        if several and array.shape in ((problem.fields,), (n, problem.fields)):
            array = array[..., k]
        if array.shape not in ((), (n,)):
            shapes = f"a scalar, ({problem.fields},) or ({n}, {problem.fields})" if several else f"a scalar or ({n},)"
            raise ValueError(f"{where}: expected {shapes} for this group of {n} particles, got shape {array.shape}")
        return xp.broadcast_to(array, (n,))

    return compute


def sample(function: Callable[..., Any] | Traced, points: Any, params: Any, components: int, where: str) -> Any:
    """A user's function of x, or its record, at all points: (components, n)."""
    if not isinstance(function, Traced):
        function = recorded_values(function, points.shape[1], params, components, where)
    _, values = function.coefficients(points, 0, params=params)
    n = points.shape[0]
    if values is None:
        return np.zeros((components, n))
    values = (jnp if is_traced(values) else np).broadcast_to(values[:, 0], (components, n))
    if not is_traced(values) and not np.isfinite(values).all():
        bad = int(np.flatnonzero(~np.isfinite(np.asarray(values)).all(axis=0))[0])
        raise ValueError(f"{where}: the function returns NaN or infinity, first at x = {np.asarray(points)[bad]}")
    return values


def _parts(problem: Problem, points: Any, normals: Any, c: Condition, where: str) -> list[Part]:
    """Neumann, Robin and general conditions as functionals."""
    dim = points.shape[1]
    if c.kind == "condition":
        return [_general(problem, points, normals, c, where)]
    fields = range(problem.fields) if c.field is None else (c.field,)
    unit = [tuple(int(i == axis) for i in range(dim)) for axis in range(dim)]
    zero = (0,) * dim
    parts = []
    for k in fields:
        get = lambda name, k=k: component(problem, points, c.parts[name], c.field, k, f"{where}.{name}")()  # noqa: E731
        if c.kind == "neumann":

            def numbers(_, get=get):
                return normals[:, None, :], _as_column(get("value"))

            slots: tuple[Slot, ...] = tuple((k, b) for b in unit)
        else:

            def numbers(_, get=get):
                return _robin_rows(get("a"), get("b"), normals), _as_column(get("value"))

            slots = ((k, zero), *((k, b) for b in unit))
        parts.append(Part(slots, 1, True, numbers))
    return parts


@in_one_program
def _robin_rows(a: Any, b: Any, normals: Any) -> Any:
    """The coefficients (n, 1, 1 + D) of a u + b n . grad u."""
    xp = jnp if is_traced(a, b, normals) or isinstance(a, jax.Array) else np
    return xp.concatenate([a[:, None], b[:, None] * normals], axis=1)[:, None, :]


@in_one_program
def _as_column(values: Any) -> Any:
    return values[:, None]


def _general(problem: Problem, points: Any, normals: Any, c: Condition, where: str) -> Part:
    """A user's residual(u, x, n): its derivatives with respect to the slots by AD."""
    dim, n = points.shape[1], points.shape[0]
    traced = c.residual if isinstance(c.residual, Traced) else recorded_residual(c.residual, dim, problem, where)
    if not traced.slots:
        raise ValueError(f"{where}: the residual does not depend on u; a condition must involve the solution")

    def numbers(derivatives):
        slots = None if traced.linear else derivatives[:, None, :]
        jac, res = traced.coefficients(points, 0, extras=(normals,), params=problem.params, slots=slots)
        xp = jnp if is_traced(jac, res) else np
        jac = xp.broadcast_to(jac[:, :, 0], (*jac.shape[:2], n))
        value = xp.zeros((jac.shape[0], n)) if res is None else -xp.broadcast_to(res[:, 0], (jac.shape[0], n))
        if traced.linear and xp is np and not (np.isfinite(jac).all() and np.isfinite(value).all()):
            raise ValueError(f"{where}: the residual has NaN or infinite coefficients at a particle of this group")
        if not traced.linear:
            value = value + xp.einsum("esn,sn->en", jac, derivatives)
        return xp.transpose(jac, (2, 0, 1)), value.T

    return Part(traced.slots, traced.n_equations, traced.linear, numbers)


def merged(group: Group, slots: tuple[Slot, ...], derivatives: Any = None) -> tuple[Any, Any]:
    """All functionals of a group over common ``slots``: coef (n, rows, S), value (n, rows).

    derivatives (S, n): those of the iterate in ``slots``, for nonlinear conditions.
    """
    coefs, values, places = [], [], []
    for part in group.parts:
        place = np.array([slots.index(s) for s in part.slots])
        coef, value = part.numbers(None if derivatives is None else derivatives[place])
        coefs.append(coef)
        values.append(value)
        places.append(place)
    return _spread(coefs, values, places, len(slots))


@partial(in_one_program, static=("n_slots",))
def _spread(coefs: list[Any], values: list[Any], places: list[np.ndarray], n_slots: int) -> tuple[Any, Any]:
    """Functionals one below the other, each coefficient at the place of its slot."""
    spread = [coef @ (place[:, None] == np.arange(n_slots)).astype(coef.dtype) for coef, place in zip(coefs, places)]
    xp = jnp if is_traced(coefs, values) or any(isinstance(v, jax.Array) for v in coefs + values) else np
    return xp.concatenate(spread, axis=1), xp.concatenate(values, axis=1)


def check_collocated(groups: list[Group], fields: int) -> None:
    """A particle of SSPH states its equations or its conditions, as many of either as there are fields."""
    for group in groups:
        count = len(group.held) + group.n_rows
        if count not in (0, fields) and len(group.held) < fields:
            raise ValueError(
                f"bcs[{group.name!r}]: {count} condition(s) for {fields} field(s), but method SSPH puts a condition in "
                f'the place of every equation there and takes {fields}, or none (js.free()); use method="S"'
            )
