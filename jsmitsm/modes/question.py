"""What is asked of an operator's modes: the problem, the mass, and the pencil over the free unknowns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.discretization.layout import Discretization, mean_spacing
from jsmitsm.discretization.pencil.assemble import Pencil, assemble_pencil
from jsmitsm.discretization.regions.layout import Regions
from jsmitsm.discretization.regions.pencil import assemble_regions_pencil
from jsmitsm.discretization.regions.rows import spread_values
from jsmitsm.equation.problem import Problem
from jsmitsm.modes.spectrum import Pattern
from jsmitsm.runtime.errors import IN_FUNCTIONS, in_words, short
from jsmitsm.runtime.tracers import concrete, is_traced


@dataclass(eq=False)
class Question:
    """What modes are modes of. weights (N, F): the mass of every equation at every particle."""

    problem: Problem
    mass: Any
    near: float
    order: int
    depth: int
    pencil: Pencil
    weights: Any
    massed: np.ndarray
    other: Pencil | None = None  # of another order, once an error was estimated

    def highest(self) -> float:
        """The value, about, of a wave of four particles: beyond it nothing is resolved."""
        out = np.inf
        for disc, ids in operators(self.pencil):
            jac, _ = disc.traced.coefficients(disc.cloud.points, 0, params=disc.problem.params)
            number = 0.5 * np.pi / mean_spacing(disc)
            for e in np.flatnonzero(self.massed):
                m = disc.traced.order[e]
                lead = [s for s, (_, b) in enumerate(disc.rec.slots) if sum(b) == m]
                size = float(np.median(np.abs(np.asarray(jac)[e, lead, 0]).max(axis=0)))
                most = float(np.abs(self.weights[ids, e]).max())
                out = min(out, size * number**m / most) if most else out
        return out


def operators(pencil: Pencil) -> list[tuple[Discretization, Any]]:
    """The discretisation of every region, and its particles; of a problem with one region that of all."""
    disc: Any = pencil.layout.disc
    return [(p.disc, p.ids) for p in disc.parts] if isinstance(disc, Regions) else [(disc, slice(None))]


def assembled(problem: Problem, cloud: Cloud, **options: Any) -> Pencil:
    """The pencil of a problem with one region or several."""
    if isinstance(cloud, RegionCloud):
        return assemble_regions_pencil(problem, cloud, **options)
    return assemble_pencil(problem, cloud, **options)


def reduced(pencil: Pencil, weights: Any) -> tuple[Pattern, Any, Any]:
    """The pencil over the free unknowns alone: the places of its entries, those of A, and those of B mass."""
    disc = pencil.layout.disc
    number = np.full(disc.held.size, -1)
    number[pencil.free] = np.arange(len(pencil.free))
    places: list[np.ndarray] = []
    entries: list[Any] = []
    for matrix, columns in ((pencil.A, None), (pencil.B, weights.reshape(-1))):
        keep = np.flatnonzero((number[matrix.rows] >= 0) & (number[matrix.cols] >= 0))
        values = matrix.values[keep] if columns is None else matrix.values[keep] * columns[matrix.cols[keep]]
        places += [number[matrix.rows[keep]], number[matrix.cols[keep]]]
        entries.append(values)
    points = concrete(disc.cloud.points)
    points = None if points is None else np.asarray(points)[pencil.free // disc.rec.fields]
    a, c = entries
    rows_a, cols_a, rows_c, cols_c = places
    offset = _offset(pencil, (concrete(a), rows_a), (concrete(c), rows_c))
    pattern = Pattern(
        len(pencil.free), rows_a, cols_a, rows_c, cols_c, points, disc.rec.order, offset, bool(disc.floating)
    )
    return pattern, a, c


def _offset(pencil: Pencil, *matrices: tuple[Any, np.ndarray]) -> float:
    """About a tenth of the lowest value: the largest one times the spacing over the size to the operator's order."""
    if any(entries is None for entries, _ in matrices):
        return 0.1
    disc, n = pencil.layout.disc, pencil.A.shape[0]
    rows = [np.bincount(r, np.abs(np.asarray(x)), n) for x, r in matrices]
    ratio = rows[0][rows[1] > 0] / rows[1][rows[1] > 0]
    points = np.asarray(concrete(disc.cloud.points))
    part = mean_spacing(disc) / float(np.ptp(points, axis=0).max())
    return 0.1 * float(np.median(ratio)) * part ** max(max(one.traced.order) for one, _ in operators(pencil))


def masses(problem: Problem, cloud: Cloud, mass: Any) -> tuple[Any, np.ndarray]:
    """The mass of every equation at every particle (N, F), and which equations have any (F,)."""
    n, fields = len(cloud), problem.fields
    if mass is None:
        return np.ones((n, fields)), np.ones(fields, bool)
    if isinstance(mass, Mapping):
        return _masses_of_regions(problem, cloud, mass)
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


def mass_at(problem: Problem, mass: Any, x: Any) -> Any:
    """The mass at a point: scalar or (F,)."""
    if mass is None or not callable(mass):
        return 1.0 if mass is None else jnp.asarray(mass)
    return mass(x, problem.params) if problem.params is not None and _takes_params(mass) else mass(x)


def _takes_params(mass: Callable[..., Any]) -> bool:
    code = getattr(mass, "__code__", None)
    return code is not None and code.co_argcount - len(mass.__defaults__ or ()) == 2
