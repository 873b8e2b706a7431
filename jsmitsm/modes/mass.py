"""The mass of an eigenvalue problem, what lambda multiplies: numbers, a function of x, or an operator."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.discretization.pencil.assemble import Pencil
from jsmitsm.discretization.pencil.fits import local_fits
from jsmitsm.discretization.pencil.sparse import Sparse, product
from jsmitsm.discretization.regions.rows import spread_values
from jsmitsm.equation.field import RATE
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.traced import Traced
from jsmitsm.equation.tracing import trace
from jsmitsm.runtime.errors import IN_FUNCTIONS, in_words, short
from jsmitsm.runtime.tracers import concrete, is_traced


def masses(problem: Problem, cloud: Cloud, mass: Any) -> tuple[Any, np.ndarray]:
    """The mass of every equation at every particle (N, F), or its record, and which equations have any (F,)."""
    n, fields = len(cloud), problem.fields
    if mass is None:
        return np.ones((n, fields)), np.ones(fields, bool)
    if isinstance(mass, Mapping):
        return _masses_of_regions(problem, cloud, mass)
    if is_operator(problem, mass):
        record = _recorded(problem, cloud, mass)
        return record, np.asarray(record.pattern.any(axis=1))
    if callable(mass):
        values = _sampled(problem, cloud, mass)
    else:
        try:
            values = mass if is_traced(mass) else np.asarray(mass)
            if values.dtype.kind not in "iuf":
                raise TypeError
        except (TypeError, ValueError, AttributeError):
            raise ValueError(
                f"mass: expected a number, ({fields},) numbers or a function of x, got {short(mass)}"
            ) from None
        values = (jnp if is_traced(values) else np).broadcast_to(values, (n, *np.shape(values)))
    if np.shape(values) not in ((n,), (n, fields)):
        shape = np.shape(values)[1:]
        raise ValueError(
            f"mass: expected a scalar, or ({fields},) for the {fields} equation(s) of the problem, got shape {shape}"
        )
    xp = jnp if is_traced(values) else np
    values = xp.broadcast_to(values[:, None] if values.ndim == 1 else values, (n, fields)) * 1.0
    known = concrete(values)
    if known is None:
        return values, np.ones(fields, bool)
    if not np.isfinite(known).all():
        bad = int(np.flatnonzero(~np.isfinite(known).all(axis=1))[0])
        raise ValueError(f"mass: NaN or infinite at particle {bad}; give finite numbers")
    massed = (np.asarray(known) != 0).any(axis=0)
    if not massed.any():
        raise ValueError("mass: zero in every equation, so no number multiplies u; give one equation a mass")
    return values, massed


def _masses_of_regions(problem: Problem, cloud: Cloud, mass: Mapping[str, Any]) -> tuple[Any, np.ndarray]:
    """The same, region by region."""
    if any(is_operator(problem, one) for one in mass.values()):
        raise ValueError(f"mass: {_OF_ONE}")
    known = list(cloud.regions) if isinstance(cloud, RegionCloud) else []
    if not isinstance(cloud, RegionCloud) or set(mass) != set(known):
        raise ValueError(f"mass: given for the regions {list(mass)}; the cloud has {known or 'none'}")
    found = [masses(problem, cloud.region(name), mass[name]) for name in known]
    values = spread_values([v for v, _ in found], list(cloud.regions.values()), (len(cloud), problem.fields))
    return values, np.any([some for _, some in found], axis=0)


def _sampled(problem: Problem, cloud: Cloud, mass: Callable[..., Any]) -> Any:
    """A user's function at all particles: (N,) or (N, F)."""
    points = jnp.asarray(cloud.points)
    try:
        values = jax.vmap(lambda x: jnp.asarray(mass_at(problem, mass, x)))(points)
    except IN_FUNCTIONS as error:
        raise ValueError(f"mass: {in_words(error)}; it is a function of one point x (D,)") from error
    if values.dtype.kind not in "iuf":
        raise ValueError(f"mass: the function returns {values.dtype}, expected real numbers")
    return values if is_traced(values) else np.asarray(values)


def mass_times(problem: Problem, mass: Any, u: Any, x: Any) -> Any:
    """mass u at a point: scalar or (F,)."""
    if is_operator(problem, mass):
        return mass(u, x) if problem.params is None else mass(u, x, problem.params)
    return mass_at(problem, mass, x) * u(x)


def mass_at(problem: Problem, mass: Any, x: Any) -> Any:
    """The mass at a point: scalar or (F,)."""
    if mass is None or not callable(mass):
        return 1.0 if mass is None else jnp.asarray(mass)
    return mass(x, problem.params) if problem.params is not None and len(_names(mass)) == 2 else mass(x)


# ------------------------------------------------------------------------------------- operators

_OF_ONE = "an operator (u, x) is a mass on clouds of one region alone; give numbers or functions of x"


def is_operator(problem: Problem, mass: Any) -> bool:
    """Whether a mass is a function of (u, x), and params where the problem has them: of (u, x) alone by its names."""
    names = _names(mass)
    return len(names) == 3 or len(names) == 2 and (problem.params is None or names[1] == "x")


def _names(mass: Any) -> tuple[str, ...]:
    """The names of a function's arguments, without those that keep numbers in defaults."""
    code = getattr(mass, "__code__", None)
    return () if code is None else code.co_varnames[: code.co_argcount - len(mass.__defaults__ or ())]


def _recorded(problem: Problem, cloud: Cloud, mass: Callable[..., Any]) -> Traced:
    """The record of an operator."""
    if isinstance(cloud, RegionCloud):
        raise ValueError(f"mass: {_OF_ONE}")
    given = mass if problem.params is None or len(_names(mass)) == 3 else lambda u, x, _: mass(u, x)
    try:
        record = trace(given, cloud.dim, problem.fields, params=problem.params)
    except IN_FUNCTIONS as error:
        raise ValueError(f"mass: {in_words(error)}; an operator is a function (u, x) like the pde") from error
    if record.n_equations != problem.fields:
        raise ValueError(f"mass: the operator returns {record.n_equations} value(s) for {problem.fields} equation(s)")
    if not record.linear or record.source != "zero" or not record.slots:
        raise ValueError("mass: an operator is linear in u and has no part without u; this one is not so")
    if any(k >= RATE for k, _ in record.slots):
        raise ValueError("mass: js.dt(u) is a rate in time, and an eigenproblem has no rates; write u(x) in its place")
    return record


def weighted(problem: Problem, pencil: Pencil, weights: Any) -> Sparse:
    """B mass over the free unknowns, the mass given by numbers (N, F) or by the record of an operator."""
    b = pencil.B
    if isinstance(weights, Traced):
        whole = product(b, _matrix(problem, pencil, weights))
    else:
        whole = b.with_values(b.values * weights.reshape(-1)[b.cols])
    return whole.part(pencil.free, pencil.free)


def _matrix(problem: Problem, pencil: Pencil, record: Traced) -> Sparse:
    """An operator (N F, N F) on a pencil's particles; its derivatives are those of polynomials fitted to u."""
    disc = pencil.layout.disc
    if concrete(disc.cloud.points) is None:
        raise ValueError("mass: the derivatives of an operator are fitted to fixed points, and JAX traces these; give "
                         "numbers or a function of x")  # fmt: skip
    if max(record.order) >= max(disc.traced.order):
        raise ValueError(
            f"mass: an operator of order {max(record.order)}, but the pde is of order {max(disc.traced.order)}, and "
            "its mass is of a lower one; exchange them, 1 / lambda are the values then"
        )
    fits = local_fits(disc, disc.rec.order + max(max(record.order) - 1, 0))
    jac, _ = record.coefficients(disc.cloud.points, 0, params=problem.params)
    xp, fields, places = jnp if is_traced(jac) else np, disc.rec.fields, np.arange(len(disc.cloud))
    jac = xp.broadcast_to(jac[:, :, 0], (fields, len(record.slots), len(places)))
    entries: list[Any] = []
    for e, s in zip(*np.nonzero(record.pattern)):
        k, b = record.slots[s]
        d = fits.derivative(b)
        entries.append((jac[e, s][d.rows] * d.values, d.rows * fields + e, d.cols * fields + k))
    values, rows, cols = zip(*entries)
    shape = len(places) * fields, len(places) * fields
    return Sparse(xp.concatenate(values), np.concatenate(rows), np.concatenate(cols), shape)
