"""The equations of the free values of several regions."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.coefficients import conditions_of
from jsmitsm.discretization.pencil.fits import local_fits
from jsmitsm.discretization.regions.rows import spread
from jsmitsm.equation.regions.between import between
from jsmitsm.evolution.regions.timed import RegionsTimed
from jsmitsm.evolution.space.local_fits import RegionsStateFit, StateFit
from jsmitsm.evolution.space.semidiscrete import Semidiscrete
from jsmitsm.runtime.tracers import is_traced


class RegionsSemidiscrete(Semidiscrete):
    """What ``Semidiscrete`` is to one region; all that is linear of it, for ``disc`` is a ``Regions``."""

    timed: RegionsTimed  # type: ignore[assignment]
    disc: Any

    @property
    def linear(self) -> bool:
        return True

    def sample(self, t: Any) -> tuple[Any, ...]:
        disc, timed = self.disc, self.timed
        held, conditions, source = [], [], []
        for part in disc.parts:
            own = timed.parts[part.name]
            values, given, gamma = conditions_of(part.disc, own.at(t, self.params))
            held.append(values)
            conditions += [given.reshape(-1), gamma.reshape(-1)]
            source.append(_source(own, part.disc.cloud.points, t, self.params, self.fields))
        problem = timed.at(t, self.params)
        for name, pairs in disc.cloud.interfaces.items():
            found = between(problem, name, disc.cloud.points[pairs[:, 0]], disc.cloud.interface_normals[name])
            conditions.append(found.numbers(None)[1].reshape(-1))
        xp: Any = jnp if is_traced(held, conditions, source) else np
        whole = (self.n, self.fields)
        every = spread(disc, held, whole).reshape(-1)[self.held]
        return every, xp.concatenate(conditions), spread(disc, source, whole).reshape(-1)

    def state_fit(self, degree: int) -> StateFit:
        parts = self.disc.parts

        def one(k: int) -> Any:
            return lambda: local_fits(parts[k].disc, degree)

        return RegionsStateFit(self.disc.cloud, degree, [one(k) for k in range(len(parts))])


def _source(timed: Any, points: Any, t: Any, params: Any, fields: int) -> Any:
    """What drives one region (N, F)."""
    if timed.rest.source == "zero":
        return np.zeros((len(points), fields))
    found = timed.rest.residuals(points, params=(t, params), slots=None)
    return (jnp if is_traced(found) else np).broadcast_to(found, (fields, len(points))).T
