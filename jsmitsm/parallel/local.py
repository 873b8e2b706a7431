"""The part of a problem that one process discretises: its own particles in their halo, which is widened as needed.

The rows are those that one process alone would make. What they need of the whole cloud (is it even, how many
neighbours have most, how large are stencils that a repair widens) the processes decide together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import EVEN_SAMPLE, Stencils, is_even, kept_distances, nearest
from jsmitsm.discretization import health
from jsmitsm.discretization.coefficients import Numbers, numbers, slot_series
from jsmitsm.discretization.degenerate import Degenerate, contradiction, typical
from jsmitsm.discretization.held_particles import with_held_expansions
from jsmitsm.discretization.layout import Class, Discretization, discretize, sorted_classes
from jsmitsm.discretization.operator_kind import information_travels
from jsmitsm.discretization.parts.stencils import InClasses
from jsmitsm.discretization.parts.whole import Part, Whole
from jsmitsm.discretization.rows import all_coefficients, all_rows
from jsmitsm.equation.conditions import refuse_counts
from jsmitsm.equation.problem import Problem
from jsmitsm.parallel.distributed import Slab
from jsmitsm.parallel.halo import Halo, boxes_of
from jsmitsm.parallel.shares import local_kernel, local_problem
from jsmitsm.parallel.team import Team, give_back
from jsmitsm.particle.kernels import Kernel
from jsmitsm.particle.moments import Row
from jsmitsm.runtime.errors import SolveError
from jsmitsm.solution.run import Run

# The first halo reaches so many times the radius of this many nearest particles for every free coefficient of the fit.
# What repairs look at is ten stencils at the most.
FIRST, POOL = 1.6, 10
# A halo that falls short is widened to this more than what was missed.
MORE = 1.05
# Particles whose rows are made at a time: enough to fill a program, few enough not to be seen beside the matrix.
AT_ONCE = 4096

# What is made of the rows of some particles: (discretisation of these alone, numbers, classes, rows) -> anything.
Use = Callable[[Discretization, Numbers, list[Class], list[Row]], Any]


@dataclass
class Settings:
    """How a problem is discretised."""

    method: str
    order: int
    depth: Any
    kernel: Kernel | None
    repair: bool
    formulation: str
    sources: bool = False  # whether the weights of a source are wanted that is zero


class Local:
    """One process's share: a halo, the discretisation on it, and the rows of the own particles."""

    def __init__(self, team: Team, problem: Problem, mine: Slab, settings: Settings):
        self.team, self.problem, self.settings, self.mine = team, problem, settings, mine
        self.degenerate: list[Degenerate] = []  # what was found of the equation at own particles, piece by piece
        self.boxes = boxes_of(team, mine)
        self._settle(team.most(first_reach(mine, settings.order)))

    def _settle(self, reach: float) -> None:
        """Discretise on a halo of this reach, or of a larger one where the stencils need it."""
        self.halo = Halo(self.team, self.mine, self.boxes, reach)
        while (missing := self._made()) > 0.0:
            self.halo = Halo(self.team, self.mine, self.boxes, MORE * (self.halo.reach + missing))

    # -- what is static

    def _made(self) -> float:
        """Discretise on the present halo; by how much that falls short for some process."""
        halo, s = self.halo, self.settings
        with self.team.phase(halo.slab.number):
            even = self._even()
            self.part = Part(halo.own, even, self._spacing(), halo.slab.number, self.mine.count, self._every,
                             self.team.largest, self.team.total, self.team.gather)  # fmt: skip
            cloud = halo.slab.cloud()
            kernel = s.kernel and local_kernel(s.kernel, halo.slab)
            local = self._localised(halo.slab, cloud)
            self.cloud = cloud
            self.disc = discretize(
                local, cloud, s.method, s.order, kernel, None, None, sources=s.sources, depth=s.depth,
                part=self.part,
            )
        missing = self.team.most(self._stencils_miss())
        if missing > 0.0 and self._grows():
            return missing
        with self.team.phase(halo.slab.number):
            self._check_together()
            self.run = Run(self.disc, self.disc.problem, "auto", True, s.repair, "loo")
        self._number()
        give_back()
        return 0.0

    def _localised(self, slab: Slab, cloud: Cloud) -> Problem:
        """The problem on the local particles."""
        return local_problem(self.problem, slab)

    def widen(self, missing: float) -> bool:
        """Begin anew on a halo that reaches farther by what is missing; False where that is not needed."""
        if missing <= 0.0 or not self._grows():
            return False
        self._settle(MORE * (self.halo.reach + missing))
        return True

    def _grows(self) -> bool:
        return self.team.total(int(len(self.halo) < self.mine.count)) > 0

    def _even(self) -> bool:
        """Whether the whole cloud is even, by the same sample as one process takes."""
        slab, count = self.halo.slab, self.mine.count
        sample = np.linspace(0, count - 1, min(count, EVEN_SAMPLE)).astype(int)
        at = self.halo.ids[np.isin(slab.number[self.halo.ids], sample)]
        kept = kept_distances(slab.points, slab.points[at]) if len(at) else np.zeros(0)
        return is_even(np.concatenate(self.team.gather(kept)))

    def _every(self, step: int) -> np.ndarray:
        """Every ``step``-th particle of the whole cloud, in its order."""
        some = self.mine.number % step == 0
        found = self.team.gather((self.mine.number[some], self.mine.points[some]))
        number, points = (np.concatenate(parts) for parts in zip(*found))
        return points[np.argsort(number)]

    def _spacing(self) -> float:
        low, high = np.min([a for a, _ in self.boxes], axis=0), np.max([b for _, b in self.boxes], axis=0)
        return float((np.prod(high - low) / self.mine.count) ** (1.0 / self.mine.dim))

    def _stencils_miss(self) -> float:
        """By how much the halo falls short of the stencils of own particles, and of those that tell jumps from them."""
        near, radius = np.asarray(self.disc.stencils.indices), self.disc.stencils.radius
        seen = np.zeros(len(near) + 1, bool)  # -1 stands for none
        seen[near[self.halo.ids]] = True
        ids = np.flatnonzero(seen[:-1])
        if radius is None:
            return -1.0
        return self.halo.short_by(np.broadcast_to(np.asarray(radius), len(near))[ids], ids)

    def _check_together(self) -> None:
        """What the conditions are as a whole: their counts, the same slots everywhere, and no field left floating."""
        disc, team = self.disc, self.team
        mine = {g.name: len(g.held) + g.n_rows for g in disc.groups}
        free = {n: 0 for n, ids in disc.cloud.groups.items() if n != "interior" and len(ids) and n not in mine}
        counts: dict[str, int] = {}
        fixed = {n for n, cs in self.problem.bcs.items() if all(c.kind == "fix" for c in cs)}
        for found in team.gather({**free, **mine}):
            counts.update({n: max(k, counts.get(n, 0)) for n, k in found.items() if n not in fixed})
        refuse_counts(self.problem, counts, sum(disc.rec.orders))
        floating = set.intersection(*map(set, team.gather(disc.floating)))
        if floating:
            raise ValueError(
                f"problem: nothing fixes the value of field(s) {sorted(floating)}, and solutions up to a constant are "
                "not made for several processes; hold one value (js.fix), or use js.solve"
            )
        if len(set(team.gather((disc.scheme.free, disc.scheme.dependent)))) > 1:
            raise ValueError(
                "method: III eliminates other coefficients in other parts of this cloud, where the equation's leading "
                'coefficients differ; use method="S"'
            )

    @property
    def whole(self) -> Whole:
        """What is told of all particles."""
        return Whole(self.part)

    # -- unknowns

    def _number(self) -> None:
        """Which of the local unknowns are the process's own, and the number of each among those of all processes."""
        unknown = self.disc.unknowns
        free = unknown >= 0
        own = free & self.halo.own[:, None]
        self.count = int(own.sum())
        counts = self.team.gather(self.count)
        self.first, self.size = sum(counts[: self.team.rank]), sum(counts)
        number = np.full(unknown.shape, -1)
        number[own] = self.first + np.arange(self.count)
        number = self.halo.spread(number)
        self.owned, self.place = np.zeros(int(free.sum()), bool), np.zeros(int(free.sum()), int)
        self.owned[unknown[free]], self.place[unknown[free]] = own[free], number[free]

    # -- rows

    def numbers(self, disc: Discretization, taylor: Any = None) -> Numbers:
        nums = numbers(disc, disc.problem, taylor)
        if nums.degenerate is not None and len(nums.degenerate.empty):
            raise ValueError(
                f"pde: it says nothing at {len(nums.degenerate.empty)} particle(s), where all its coefficients vanish; "
                "hold their values (js.fix), leave them out of the cloud, or use js.solve"
            )
        return nums

    def refuse_degenerate(self, found: Degenerate | None = None) -> None:
        if self.team.total(int(bool(self.degenerate or found))):
            raise ValueError(
                "pde: its highest derivatives lose their weight at some particles, and for several processes such "
                "equations are made by jp.solve alone; use one process"
            )

    def refuse_contradictions(self, values: np.ndarray) -> None:
        """Raise where a degenerate equation and a condition say different things of a solution (n, F)."""
        size = self.team.most(float(np.abs(values).max(initial=0.0)))
        with self.team.phase(self.halo.slab.number):
            bad = [i for found in self.degenerate for i in found.contradicted(size)]
            if bad:
                raise SolveError(contradiction(bad), bad)

    def _decide(self, taylor: Any) -> None:
        """What is typical of the equation in the whole cloud; and whether the least-squares form is needed."""
        disc, ids = self.disc, self.disc.active

        def jac(which: Any, degree: int) -> np.ndarray:
            at = ids[which]
            slots = None if taylor is None else slot_series(disc.rec, disc.traced.slots, taylor[at], degree)
            points = np.asarray(disc.cloud.points)[at]
            return np.asarray(disc.traced.coefficients(points, degree, params=disc.problem.params, slots=slots)[0])

        every = jac(slice(None), 0)
        if self.run.health is None and self.settings.formulation == "auto":
            self._refuse_least_squares(every)
        varies = self.settings.method == "S" and not disc.traced.constant
        if varies and all(self.team.gather(np.isfinite(every).all())):
            usual = typical(disc, every, lambda some: jac(some, min(2, disc.rec.degree)), self.whole)
            self.part = self.disc.part = replace(self.part, typical=usual)

    def made(self, use: Use, start: Callable[[], Any] | None = None) -> list[Any]:
        """``use`` of the rows of some own particles after others; on a wider halo where a repair looked beyond it.

        start: expansions (n, F, K) on the present halo, about which a nonlinear problem is linearised.
        """
        while True:
            first = self.run.health is None
            taylor = None if start is None else start()
            with self.team.phase(self.halo.slab.number):
                self._decide(taylor)
                self.degenerate = []
                found = [use(*piece) for piece in self._pieces(taylor)]
            missing = self.team.most(self._repairs_miss()) if first and self.settings.repair else 0.0
            if not self.widen(missing):
                return found

    def only(self, classes: list[Class], widest: dict[Any, int] | None = None) -> Discretization:
        """The discretisation of the particles of some classes alone; widest: of every kind, in the whole cloud."""
        own = np.zeros(len(self.halo), bool)
        own[np.concatenate([np.zeros(0, int), *(cls.ids for cls in classes)])] = True
        largest = lambda mine: {name: (widest or {})[name] for name in mine}  # noqa: E731
        return replace(self.disc, classes=classes, part=replace(self.part, own=own, largest=largest))

    def _pieces(self, taylor: Any) -> Iterator[tuple[Discretization, Numbers, list[Class], list[Row]]]:
        """The own particles in pieces, the first time those with weak stencils repaired and last."""
        run = self.run
        repair = self.settings.repair and run.health is None and self.disc.scheme.method in ("S", "III")
        poor, every = list[Class](), list[Class]()
        known = [] if run.health is None else [run.health.repaired]
        told: list[health.Health] = []
        for some in _gathered(self.disc.classes):
            disc = self.only(some)
            nums = self.numbers(disc, taylor)
            if nums.degenerate is not None:
                self.degenerate.append(nums.degenerate)
            classes, rows = all_rows(disc, nums)
            if repair:
                classes, rows, weak = health.parted(classes, rows)
                poor += weak
                if not classes:
                    continue
                disc = self.only(classes)
            told.append(self._judged(health.examine(classes, rows), nums, rows))
            every += classes
            yield disc, nums, classes, rows
            for cls in classes:  # what was kept for a next time is as large as the rows
                cls.kept.clear()
            del nums, classes, rows
            give_back()
        # Only now: where an equation degenerates the classes are others than before.
        widest = self.team.largest(_widest(every + poor)) if repair else {}
        if poor:
            disc = self.only(poor, widest)
            nums = self.numbers(disc, taylor)
            classes, rows, found = health.repaired(disc, nums, *all_rows(disc, nums))
            told.append(self._judged(found, nums, rows))
            known.append(found.repaired)
            every += classes
            yield self.only(classes), nums, classes, rows
        self.disc.classes, self.disc.stencils = every, InClasses(self.disc.stencils, every)
        run.health = health.Health(
            max((one.largest for one in told), default=1.0),
            np.concatenate([np.zeros(0, int), *(one.weak for one in told)]),
            np.concatenate([np.zeros(0, int), *known]),
        )

    def _judged(self, found: health.Health, nums: Numbers, rows: list[Row]) -> health.Health:
        """What was found of a piece, unless its rows are not determined."""
        self.run.health, before = found, self.run.health
        self.run.judge(nums, rows)
        self.run.health = before
        return found

    def _refuse_least_squares(self, jac: np.ndarray) -> None:
        if any(self.team.gather(information_travels(self.disc, jac))):
            raise ValueError(
                "formulation: in this equation information travels (first order, or convection above diffusion), and "
                'the least-squares form, which is right there, is not made for several processes; say formulation="loo"'
                " where diffusion does resolve it, or use js.solve"
            )

    def _repairs_miss(self) -> float:
        """By how much the halo falls short of what the repair of weak stencils looks at."""
        health = self.run.health
        ids = np.unique(np.concatenate([health.repaired, health.weak])).astype(int) if health else np.zeros(0, int)
        if not len(ids):
            return -1.0
        return self.pool_misses(ids, max(int((c.neighbours >= 0).sum(axis=1).max()) for c in self.disc.classes))

    def pool_misses(self, ids: np.ndarray, widest: int) -> float:
        """By how much the halo falls short of what a repair of stencils of this size looks at."""
        count = POOL * widest
        points = self.halo.slab.points
        if len(points) < min(count, self.mine.count):
            return self.halo.reach
        radius = nearest(points, min(count, len(points)), ids).radius
        return self.halo.short_by(np.asarray(radius), ids)

    # -- local polynomials

    def coefficients(self, values: np.ndarray, taylor: Any = None) -> np.ndarray:
        """Taylor coefficients (n, F, K) of all local particles, the borrowed ones' from their owners."""
        with self.team.phase(self.halo.slab.number):
            near = Stencils(self.disc.stencils.indices, None)
            disc = replace(self.disc, classes=sorted_classes(self.disc, self.halo.ids, near), stencils=near)
            nums = numbers(disc, disc.problem, taylor, everywhere=True)
            found = np.asarray(all_coefficients(disc, nums, values))
        return self.halo.spread(found)

    def expanded(self, values: np.ndarray, taylor: Any) -> np.ndarray:
        """The expansions (n, F, K) that the rows linearised at ``taylor`` give to values (n, F), held ones' too."""
        with self.team.phase(self.halo.slab.number):
            found = np.asarray(all_coefficients(self.disc, self.numbers(self.disc, taylor), values))
        found = self.halo.spread(found)
        with self.team.phase(self.halo.slab.number):
            found = np.asarray(with_held_expansions(self.disc, found))
        return self.halo.spread(found)


def _gathered(classes: list[Class]) -> list[list[Class]]:
    """The classes cut, and small ones put together, so that each piece has about AT_ONCE particles."""
    pieces: list[list[Class]] = []
    left = 0
    for cls in classes:
        parts = max(1, round(len(cls.ids) / AT_ONCE))
        for ids, near in zip(np.array_split(cls.ids, parts), np.array_split(cls.neighbours, parts)):
            if len(ids) > left:
                pieces.append([])
                left = AT_ONCE
            pieces[-1].append(replace(cls, ids=ids.copy(), neighbours=near.copy()) if parts > 1 else cls)
            left -= len(ids)
    return pieces


def _widest(classes: list[Class]) -> dict[Any, int]:
    """The largest stencil of every kind of class."""
    out: dict[Any, int] = {}
    for cls in classes:
        kind = health.kind_of(cls.scheme, cls.wide)
        out[kind] = max(int((cls.neighbours >= 0).sum(axis=1).max()), out.get(kind, 0))
    return out


def first_reach(mine: Slab, order: int) -> float:
    """The reach of a first halo: that of a stencil, and of those next to it."""
    size = {2: (order + 1) * 4, 3: (order + 1) ** 2 * 3}[mine.dim]
    points = mine.points
    sample = points[np.linspace(0, len(points) - 1, min(len(points), 400)).astype(int)]
    from scipy.spatial import cKDTree

    return FIRST * float(cKDTree(points).query(sample, k=[min(size, len(points))])[0].max())


class OfOwn:
    """What every process has its own particles' part of."""

    _local: Local

    @property
    def points(self) -> np.ndarray:
        """The own particles (n, D)."""
        return self._local.mine.points

    @property
    def numbers(self) -> np.ndarray:
        """The numbers (n,) of the own particles in the whole cloud."""
        return self._local.mine.number
