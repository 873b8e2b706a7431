"""What is asked of an operator's modes: the problem, the mass, and the pencil over the free unknowns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.discretization.layout import Discretization, mean_spacing
from jsmitsm.discretization.pencil.assemble import Pencil, assemble_pencil
from jsmitsm.discretization.pencil.sparse import Sparse
from jsmitsm.discretization.regions.layout import Regions
from jsmitsm.discretization.regions.pencil import assemble_regions_pencil
from jsmitsm.discretization.resolution.poles import poles_of
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.traced import Traced
from jsmitsm.modes.mass import weighted
from jsmitsm.modes.spectrum import Pattern
from jsmitsm.runtime.tracers import concrete


@dataclass(eq=False)
class Question:
    """What modes are modes of.

    weights: the mass of every equation at every particle (N, F), or the record of an operator. stiff, inert: A and
    B mass over the free unknowns.
    """

    problem: Problem
    mass: Any
    near: float
    order: int
    depth: int
    pencil: Pencil
    weights: Any
    massed: np.ndarray
    stiff: Sparse
    inert: Sparse
    other: Pencil | None = None  # of another order, once an error was estimated

    def highest(self) -> float:
        """The value, about, of a wave of four particles: beyond it nothing is resolved."""
        out = np.inf
        for disc, ids in operators(self.pencil):
            number = 0.5 * np.pi / mean_spacing(disc)
            if len({disc.traced.order[e] for e in np.flatnonzero(self.massed)}) > 1:
                out = min(out, self._fastest(disc, ids, number))
                continue
            for e in np.flatnonzero(self.massed):
                m, size = _leading(disc.traced, int(e), disc)
                if isinstance(self.weights, Traced):
                    less, most = _leading(self.weights, int(e), disc)
                else:
                    less, most = 0, float(np.abs(self.weights[ids, e]).max())
                out = min(out, size * number ** (m - less) / most) if most else out
        return out

    def _fastest(self, disc: Discretization, ids: Any, number: float) -> float:
        """The largest value of a wave along an axis, of equations that only together have waves, as u_t = v has none.

        number: of the wave, 2 pi over its length.
        """
        from scipy.linalg import eigvals

        found = []
        for axis in range(disc.rec.dim):
            stiff = _symbol(disc.traced, disc, axis, number)
            if isinstance(self.weights, Traced):
                inert = _symbol(self.weights, disc, axis, number)
            else:
                inert = np.diag(np.median(self.weights[ids], axis=0) * self.massed).astype(complex)
            values = np.abs(eigvals(stiff, inert))
            found += [float(v) for v in values if np.isfinite(v)]
        return max(found, default=np.inf)

    def poles(self) -> list[str]:
        """Of coefficients that are infinite between the particles: no estimate knows that modes have cusps there."""
        return [line for disc, _ in operators(self.pencil) for line in poles_of(disc)]


def _leading(record: Traced, e: int, disc: Discretization) -> tuple[int, float]:
    """The order of an operator's equation, and the size of its highest derivatives' coefficients."""
    jac, _ = record.coefficients(disc.cloud.points, 0, params=disc.problem.params)
    lead = [s for s, (_, b) in enumerate(record.slots) if sum(b) == record.order[e]]
    return record.order[e], float(np.median(np.abs(np.asarray(jac)[e, lead, 0]).max(axis=0)))


def _symbol(record: Traced, disc: Discretization, axis: int, number: float) -> np.ndarray:
    """What an operator (F, F) makes of waves along an axis, at the median of its coefficients."""
    jac, _ = record.coefficients(disc.cloud.points, 0, params=disc.problem.params)
    typical = np.median(np.asarray(jac)[:, :, 0], axis=2)  # (E, S)
    out = np.zeros((len(typical), disc.rec.fields), complex)
    for s, (field, b) in enumerate(record.slots):
        if b[axis] == sum(b):
            out[:, field] += typical[:, s] * (1j * number) ** b[axis]
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


def reduced(pencil: Pencil, problem: Problem, weights: Any) -> tuple[Pattern, Sparse, Sparse]:
    """The pencil over the free unknowns alone: the places of its entries, A, and B mass."""
    disc = pencil.layout.disc
    a, c = pencil.A.part(pencil.free, pencil.free), weighted(problem, pencil, weights)
    points = concrete(disc.cloud.points)
    points = None if points is None else np.asarray(points)[pencil.free // disc.rec.fields]
    less = max(weights.order) if isinstance(weights, Traced) else 0
    pattern = Pattern(
        len(pencil.free), a.rows, a.cols, c.rows, c.cols, points, disc.rec.order, _offset(pencil, a, c, less),
        bool(disc.floating),
    )  # fmt: skip
    return pattern, a, c


def _offset(pencil: Pencil, a: Sparse, c: Sparse, less: int) -> float:
    """About a tenth of the lowest value: the largest one times the spacing over the size to the operator's order.

    less: by the order of the mass.
    """
    entries = [concrete(m.values) for m in (a, c)]
    if any(x is None for x in entries):
        return 0.1
    disc = pencil.layout.disc
    rows = [np.bincount(m.rows, np.abs(np.asarray(x)), m.shape[0]) for m, x in zip((a, c), entries)]
    ratio = rows[0][rows[1] > 0] / rows[1][rows[1] > 0]
    points = np.asarray(concrete(disc.cloud.points))
    part = mean_spacing(disc) / float(np.ptp(points, axis=0).max())
    return 0.1 * float(np.median(ratio)) * part ** (max(max(one.traced.order) for one, _ in operators(pencil)) - less)
