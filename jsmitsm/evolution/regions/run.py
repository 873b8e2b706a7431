"""A run of a problem with several regions before its first step."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np

from jsmitsm.discretization.regions.pencil import assemble_regions_pencil
from jsmitsm.evolution.regions.semidiscrete import RegionsSemidiscrete
from jsmitsm.evolution.run import Run
from jsmitsm.evolution.space.convection import refuse_convection
from jsmitsm.runtime.tracers import computed


class RegionsRun(Run):
    """What ``Run`` is to one region; ``timed`` is a ``RegionsTimed``."""

    timed: Any
    cloud: Any

    def _damping(self, asked: Any) -> float:
        if not isinstance(asked, str) and asked:
            raise ValueError("damping: that of waves, which js.evolve does for one region alone; leave it out")
        return 0.0

    def pencil(self, t: Any, u: Any) -> RegionsSemidiscrete:
        began = time.perf_counter()
        massed = np.any([part.sourced for part in self.timed.parts.values()], axis=0)
        self.counts["pencils"] += 1
        with computed():
            semi = self._parts(t, self.order, massed, self.stencils)
        if not self.traced:
            self._refuse_convection()
        self.told = list(semi.pencil.health)
        self.counts["seconds in pencils"] = self.counts.get("seconds in pencils", 0.0) + time.perf_counter() - began
        return semi

    def beside(self, order: int, t: float, u: Any) -> RegionsSemidiscrete:
        return self._parts(np.asarray(t), order, None, None)

    def _parts(self, t: Any, order: int, massed: Any, stencils: Any) -> RegionsSemidiscrete:
        problem = self.timed.at(t, self.params)
        pencil = assemble_regions_pencil(
            problem, self.cloud, order=order, mass=massed, stencils=stencils, depth=self.depth
        )
        return RegionsSemidiscrete(self.timed, pencil, self.params)

    def _refuse_convection(self) -> None:
        for name, part in self.timed.parts.items():
            region = self.cloud.region(name)
            told: list[str] = []
            view: Any = SimpleNamespace(timed=part, second=False, points=region.points, fields=self.fields)
            try:
                refuse_convection(view, told)
            except ValueError as error:
                raise ValueError(f"{error} (in the region {name!r})") from None
            self.flags += [f"In the region {name!r}: {line[0].lower()}{line[1:]}" for line in told]
