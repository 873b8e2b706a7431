"""What is left of a problem with point sources when their singular part is subtracted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud, sides
from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.conditions import component, condition_normals, each_its_own
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.regions.interface import INTERFACE
from jsmitsm.equation.regions.per_region import members
from jsmitsm.equation.tracing import trace
from jsmitsm.equation.unknowns.point_source import FARTHEST, Kelvin, Singular
from jsmitsm.runtime.errors import IN_FUNCTIONS, in_words, some
from jsmitsm.runtime.tracers import concrete
from jsmitsm.taylor.multi_indices import multi_indices

# A particle within this part of the spacing from a source is at it.
AT = 1e-9
# Coefficients of the second derivatives are equal up to this part of them.
ROUND_OFF = 1e-12


def regular_problem(problem: Problem, cloud: Cloud) -> tuple[Problem, Singular | Kelvin]:
    """The problem of the regular part w of u = w + singular part, and that part."""
    assert problem.extras is not None
    singular = _singular(problem, problem.pde, cloud, list(enumerate(problem.extras.sources)))
    parts = [(singular, np.arange(len(cloud)))]
    bcs = {
        name: [_regular(problem, condition, cloud, name, parts) for condition in conditions]
        for name, conditions in problem.bcs.items()
    }
    return Problem(problem.pde, bcs, problem.fields, problem.params), singular


def regular_in_regions(
    problem: Problem, cloud: RegionCloud, where: Sequence[str]
) -> tuple[Problem, dict[str, Singular | Kelvin]]:
    """The same in several regions: the singular part of each of those that have sources; where: that of each source."""
    assert problem.extras is not None
    found = {}
    for name in dict.fromkeys(where):
        mine = [(k, s) for k, (s, there) in enumerate(zip(problem.extras.sources, where)) if there == name]
        try:
            found[name] = _singular(problem, problem.pde[name], cloud.region(name), mine)
        except ValueError as error:
            raise ValueError(f"{error} (in the region {name!r})") from None
    parts = [(singular, cloud.regions[name]) for name, singular in found.items()]
    bcs = {}
    for name, conditions in problem.bcs.items():
        if name in cloud.interfaces:
            bcs[name] = [_between(problem, c, cloud, name, found) for c in conditions]
        else:
            bcs[name] = [_regular(problem, c, cloud, name, parts) for c in conditions]
    return Problem(dict(problem.pde), bcs, problem.fields, problem.params), found


def _singular(problem: Problem, pde: Any, cloud: Cloud, sources: list[tuple[int, Any]]) -> Singular | Kelvin:
    """The singular part of numbered sources under one equation."""
    for k, source in sources:
        if np.shape(source.place) != (cloud.dim,):
            raise ValueError(f"sources[{k}]: x0 has {len(source.place)} coordinate(s), the cloud {cloud.dim}")
        expected = () if problem.fields == 1 else (problem.fields,)
        if np.shape(source.strength) != expected:
            raise ValueError(
                f"sources[{k}]: a strength of shape {np.shape(source.strength)}, but {expected} is expected for "
                f"{problem.fields} field(s)"
            )
    places, strengths = (jnp.stack([jnp.asarray(s[k], float) for _, s in sources]) for k in (0, 1))
    singular: Singular | Kelvin
    if problem.fields == 1:
        a, c, sound = _operator(problem, pde, cloud)
        singular = Singular(places, strengths, a, c / a, sound)
    else:
        singular = Kelvin(places, strengths, *_elasticity(problem, pde, cloud))
    _check_distances(singular, cloud)
    return singular


def _coefficients(problem: Problem, pde: Any, cloud: Cloud) -> tuple[Any, Any]:
    """The record of a linear equation with constant coefficients, and these (E, S)."""
    try:
        record = trace(pde, cloud.dim, problem.fields, params=problem.params)
    except IN_FUNCTIONS as error:
        raise ValueError(f"pde: {in_words(error)}; it returns a number for each field") from error
    if not record.linear or not record.constant or record.n_equations != problem.fields:
        raise _unknown("an operator that is nonlinear or whose coefficients vary", cloud)
    return record, record.coefficients(cloud.points[:1], 0, params=problem.params)[0][:, :, 0, 0]


def _elasticity(problem: Problem, pde: Any, cloud: Cloud) -> tuple[Any, Any, Any]:
    """The constants of a laplacian(u) + b grad(div u) of D displacements; ValueError for any other operator."""
    dim, fields = cloud.dim, problem.fields
    if fields != dim or dim == 1:
        raise _unknown(f"{fields} fields in {dim}D", cloud)
    record, jac = _coefficients(problem, pde, cloud)
    place = {slot: s for s, slot in enumerate(record.slots)}

    def found(e: int, f: int, index: tuple[int, ...]) -> Any:
        s = place.get((f, index))
        return 0.0 if s is None or not record.pattern[e, s] else jac[e, s]

    twice = [tuple(2 * int(i == k) for i in range(dim)) for k in range(dim)]
    both = [[tuple(int(i in (e, f)) for i in range(dim)) for f in range(dim)] for e in range(dim)]
    a, b = found(0, 0, twice[1]), found(0, 1, both[0][1])
    terms = {(f, index) for f, index in record.slots} | {(f, i) for f in range(dim) for i in multi_indices(dim, 2)}
    off = []
    for e in range(dim):
        for f, index in terms:
            if e == f and index in twice:
                wanted = a + b if index == twice[e] else a
            else:
                wanted = b if e != f and index == both[e][f] else 0.0
            off.append(found(e, f, index) - wanted)
    sound = _true(jnp.max(jnp.abs(jnp.stack(off))) <= ROUND_OFF * jnp.maximum(jnp.abs(a), jnp.abs(b)))
    if sound is False:
        raise _unknown("a system of other terms than those of elasticity", cloud)
    if _true((a == 0.0) | (a + b == 0.0)) is True:
        raise _unknown("a system without a term of elasticity", cloud)
    return a, b, sound


def _true(value: Any) -> Any:
    """A truth value of JAX as one of Python where it is known."""
    known = concrete(jnp.asarray(value))
    return value if known is None else bool(known)


def _operator(problem: Problem, pde: Any, cloud: Cloud) -> tuple[Any, Any, Any]:
    """The constants of a laplacian(u) + c u; ValueError for any other operator."""
    record, jac = _coefficients(problem, pde, cloud)
    found = {b: jac[0, s] for s, (_, b) in enumerate(record.slots)}
    zero = (0,) * cloud.dim
    second = [tuple(2 * int(i == k) for i in range(cloud.dim)) for k in range(cloud.dim)]
    c, leading = found.pop(zero, 0.0), [found.pop(b, 0.0) for b in second]
    for v in map(concrete, found.values()):
        if v is None or float(v) != 0.0:
            raise _unknown("an operator with first, mixed or higher derivatives", cloud)
    sizes = jnp.stack([jnp.asarray(v, float) for v in leading])
    sound = _true((sizes[0] != 0.0) & (jnp.ptp(sizes) <= ROUND_OFF * jnp.abs(sizes[0])))
    if sound is False:
        raise _unknown("an operator that is not the same in all directions", cloud)
    return leading[0], c, sound


def _unknown(what: str, cloud: Cloud) -> ValueError:
    width = "three spacings" if concrete(cloud.points) is None else f"{3.0 * cloud.spacing:.3g}, three spacings"
    return ValueError(
        "sources: the singular part is known for one field under a laplacian(u) + c u, and for the displacements of "
        f"elasticity, a laplacian(u) + b grad(div u), with constants a, b and c; here is {what}. Put a Gaussian into "
        f"the pde, strength exp(-|x - x0|^2 / (2 w^2)) / (2 pi w^2)^({cloud.dim}/2) with w about {width}"
    )


def _check_distances(singular: Singular | Kelvin, cloud: Cloud) -> None:
    """No particle at a source, none so far away that the series of the singular part fails."""
    points, places, m = concrete(cloud.points), concrete(singular.places), concrete(jnp.asarray(singular.m))
    if points is None or places is None:
        return
    distance = np.linalg.norm(np.asarray(points)[:, None] - np.asarray(places), axis=2)
    near = np.flatnonzero(distance.min(axis=1) <= AT * cloud.spacing)
    if len(near) and cloud.dim > 1:
        raise ValueError(
            f"sources: x0 is the place of particle(s) {some(near)}, where u is infinite; move the source, or the "
            "cloud, by a part of the spacing"
        )
    reach = 0.0 if m is None else float(np.sqrt(abs(np.asarray(m))) * distance.max())
    if reach > FARTHEST:
        raise ValueError(
            f"sources: the domain is {reach:.3g} / root(|c / a|) wide as seen from x0, and the singular part is known "
            f"up to {FARTHEST:g}; put a Gaussian into the pde instead, strength exp(-|x - x0|^2 / (2 w^2)) / "
            f"(2 pi w^2)^({cloud.dim}/2) with w about {3.0 * cloud.spacing:.3g}, three spacings"
        )


class _Whole:
    """A regular part and a singular one as the field that a user's function takes."""

    def __init__(self, field: Any, rest: Callable[[Any], Any]):
        self.field, self.rest = field, rest

    def __call__(self, x: Any) -> Any:
        return self.field(x) + self.rest(x)

    def __getitem__(self, k: Any) -> _Whole:
        return _Whole(self.field[k], lambda x: self.rest(x)[k])

    def __len__(self) -> int:
        return len(self.field)


def _regular(
    problem: Problem, c: Condition, cloud: Cloud, name: str, parts: list[tuple[Singular | Kelvin, np.ndarray]]
) -> Condition:
    """A condition on u as one on its regular part; parts: singular parts, and the particles where each counts."""
    if c.kind == "free":
        return c
    if c.kind not in ("condition", "dirichlet", "neumann", "robin", "fix"):
        raise ValueError(
            f"bcs[{name!r}]: js.{c.kind} does not go with point sources; put a Gaussian into the pde instead"
        )
    ids = np.asarray(c.indices) if c.kind == "fix" else members(name, cloud)
    if not len(ids):
        return c  # refused by name later
    touched = [(singular, np.isin(ids, those)) for singular, those in parts]
    touched = [(singular, here) for singular, here in touched if here.any()]
    if not touched:
        return c
    if c.kind == "condition":
        if not all(here.all() for _, here in touched):
            raise ValueError(
                f"bcs[{name!r}]: a js.condition on a group that lies in a region with a point source and in another; "
                "give each region a group of its own (groups=), or one each in a dict by region"
            )
        ((singular, _),) = touched
        return Condition("condition", residual=lambda u, x, *more: c.residual(_Whole(u, singular.at), x, *more))
    points, several = jnp.asarray(cloud.points)[ids], problem.fields > 1

    def sampled(what: str) -> Any:
        every = range(problem.fields) if several and c.field is None else (0,)
        made = [component(problem, points, c.parts[what], c.field, k, f"bcs[{name!r}].{what}")() for k in every]
        return jnp.stack(made, axis=1) if several and c.field is None else made[0]

    def of_singular(function: Callable[..., Any], *more: Any) -> Any:
        made = [jax.vmap(lambda *a, s=s: function(s, *a))(points, *more) for s, _ in touched]
        kept = [jnp.where(here.reshape(-1, *[1] * several), one, 0.0) for one, (_, here) in zip(made, touched)]
        found = jnp.sum(jnp.stack(kept), axis=0)
        return found if c.field is None or not several else found[:, c.field]

    there = of_singular(lambda singular, x: singular.at(x))
    if c.kind in ("dirichlet", "fix"):
        rest = {k: v for k, v in c.parts.items() if k != "value"}
        return Condition(c.kind, c.field, **rest, value=sampled("value") - there)
    if cloud.normals is None:
        return c  # refused by name later
    normals = jnp.asarray(condition_normals(cloud, ids, c, f"bcs[{name!r}]"))
    along = {} if each_its_own(c, len(ids)) else {"along": "sides"}  # as it was asked for
    slope = of_singular(lambda singular, x, n: jax.jvp(singular.at, (x,), (n,))[1], normals)
    if c.kind == "neumann":
        return Condition(c.kind, c.field, value=sampled("value") - slope, **along)
    a, b = sampled("a"), sampled("b")
    return Condition(c.kind, c.field, a=a, b=b, value=sampled("value") - a * there - b * slope, **along)


def _between(
    problem: Problem, c: Condition, cloud: RegionCloud, name: str, found: dict[str, Singular | Kelvin]
) -> Condition:
    """The conditions on an interface on u as those on its regular part."""
    singular = [found.get(side) for side in sides(name)]
    if c.kind != INTERFACE or singular == [None, None]:
        return c

    def whole(u: Any, part: Any) -> Any:
        return u if part is None else _Whole(u, part.at)

    parts = dict(c.parts)
    if "residual" in parts:
        one, two = singular
        return Condition(
            c.kind, residual=lambda a, b, x, *more: c.residual(whole(a, one), whole(b, two), x, *more)
        )  # fmt: skip

    def flux(given: Any, part: Any) -> Any:
        return lambda u, x, *more: given(whole(u, part), x, *more)

    for which, side in zip(("one", "two"), c.sides):
        parts[which] = flux(parts[which], found.get(side))
    points = jnp.asarray(cloud.points)[cloud.interfaces[name][:, 0]]
    every = range(problem.fields)
    jump = [component(problem, points, parts["jump"], None, k, f"bcs[{name!r}].jump")() for k in every]
    steps = [0.0 if part is None else jax.vmap(part.at)(points) for part in singular]
    parts["jump"] = (jump[0] if len(jump) == 1 else jnp.stack(jump, axis=1)) - steps[0] + steps[1]
    return Condition(c.kind, **parts)
