"""What is left of a problem with point sources when their singular part is subtracted."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.tracing import trace
from jsmitsm.equation.unknowns.point_source import FARTHEST, Singular
from jsmitsm.runtime.errors import IN_FUNCTIONS, in_words, some
from jsmitsm.runtime.tracers import concrete

# A particle within this part of the spacing from a source is at it.
AT = 1e-9
# Coefficients of the second derivatives are equal up to this part of them.
ROUND_OFF = 1e-12


def regular_problem(problem: Problem, cloud: Cloud) -> tuple[Problem, Singular]:
    """The problem of the regular part w of u = w + singular part, and that part."""
    assert problem.extras is not None
    sources = problem.extras.sources
    for k, source in enumerate(sources):
        if np.shape(source.place) != (cloud.dim,):
            raise ValueError(f"sources[{k}]: x0 has {len(source.place)} coordinate(s), the cloud {cloud.dim}")
    a, c = _operator(problem, cloud)
    places, strengths = ([jnp.asarray(s[k], float) for s in sources] for k in (0, 1))
    singular = Singular(jnp.stack(places), jnp.stack(strengths), a, c / a)
    _check_distances(singular, cloud)
    bcs = {
        name: [_regular(problem, condition, cloud, name, singular) for condition in conditions]
        for name, conditions in problem.bcs.items()
    }
    return Problem(problem.pde, bcs, 1, problem.params), singular


def _operator(problem: Problem, cloud: Cloud) -> tuple[Any, Any]:
    """The constants of a laplacian(u) + c u; ValueError for any other operator."""
    if problem.fields > 1:
        raise _unknown(f"{problem.fields} fields", cloud)
    try:
        record = trace(problem.pde, cloud.dim, 1, params=problem.params)
    except IN_FUNCTIONS as error:
        raise ValueError(f"pde: {in_words(error)}; it returns a number") from error
    if not record.linear or not record.constant or record.n_equations != 1:
        raise _unknown("an operator that is nonlinear or whose coefficients vary", cloud)
    jac, _ = record.coefficients(cloud.points[:1], 0, params=problem.params)
    found = {b: jac[0, s, 0, 0] for s, (_, b) in enumerate(record.slots)}
    zero = (0,) * cloud.dim
    second = [tuple(2 * int(i == k) for i in range(cloud.dim)) for k in range(cloud.dim)]
    c, leading = found.pop(zero, 0.0), [found.pop(b, 0.0) for b in second]
    known, rest = [concrete(v) for v in leading], [concrete(v) for v in found.values()]
    for v in rest:
        if v is None or float(v) != 0.0:
            raise _unknown("an operator with first, mixed or higher derivatives", cloud)
    sizes = None if any(v is None for v in known) else np.asarray(known, float)
    if sizes is not None and (sizes[0] == 0.0 or np.ptp(sizes) > ROUND_OFF * abs(sizes[0])):
        raise _unknown("an operator that is not the same in all directions", cloud)
    return leading[0], c


def _unknown(what: str, cloud: Cloud) -> ValueError:
    width = "three spacings" if concrete(cloud.points) is None else f"{3.0 * cloud.spacing:.3g}, three spacings"
    return ValueError(
        "sources: the singular part is known for one field under a laplacian(u) + c u with constants a and c; here is "
        f"{what}. Put a Gaussian into the pde, strength exp(-|x - x0|^2 / (2 w^2)) / (2 pi w^2)^({cloud.dim}/2) "
        f"with w about {width}"
    )


def _check_distances(singular: Singular, cloud: Cloud) -> None:
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


def _regular(problem: Problem, c: Condition, cloud: Cloud, name: str, singular: Singular) -> Condition:
    """A condition on u as one on its regular part."""
    if c.kind == "free":
        return c
    if c.kind == "condition":
        whole = lambda u: lambda y: u(y) + singular.at(y)  # noqa: E731
        return Condition("condition", residual=lambda u, x, *more: c.residual(whole(u), x, *more))
    if c.kind not in ("dirichlet", "neumann", "robin", "fix"):
        raise ValueError(
            f"bcs[{name!r}]: js.{c.kind} does not go with point sources; put a Gaussian into the pde instead"
        )
    ids = np.asarray(c.indices) if c.kind == "fix" else np.asarray(cloud.groups.get(name, ()), int)
    if not len(ids):
        return c  # refused by name later
    points = jnp.asarray(cloud.points)[ids]

    def sampled(value: Any) -> Any:
        if callable(value):
            more = () if problem.params is None else (problem.params,)
            return jax.vmap(lambda x: jnp.asarray(value(x, *more), float).reshape(()))(points)
        return value

    there = jax.vmap(singular.at)(points)
    if c.kind in ("dirichlet", "fix"):
        rest = {k: v for k, v in c.parts.items() if k != "value"}
        return Condition(c.kind, c.field, **rest, value=sampled(c.value) - there)
    if cloud.normals is None:
        return c  # refused by name later
    slope = jnp.sum(jax.vmap(jax.grad(singular.at))(points) * jnp.asarray(cloud.normals)[ids], axis=1)
    if c.kind == "neumann":
        return Condition(c.kind, c.field, value=sampled(c.value) - slope)
    a, b = sampled(c.a), sampled(c.b)
    return Condition(c.kind, c.field, a=a, b=b, value=sampled(c.value) - a * there - b * slope)
