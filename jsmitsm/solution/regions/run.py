"""One linear solve of a problem with several regions."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import copy
from typing import Any

import numpy as np

from jsmitsm.discretization import health
from jsmitsm.discretization.health import Health
from jsmitsm.discretization.layout import Class
from jsmitsm.discretization.leave_one_out import matrix
from jsmitsm.discretization.operator_kind import information_travels
from jsmitsm.discretization.regions.layout import Regions, discretize_regions
from jsmitsm.discretization.regions.rows import (
    RegionNumbers,
    contrast,
    in_whole,
    joint_rows,
    joints,
    region_numbers,
    whole_coefficients,
    whole_right_side,
    with_held,
)
from jsmitsm.discretization.rows import all_rows
from jsmitsm.particle.moments import Row
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution import flags
from jsmitsm.solution.regions.flags import singular, weak_copies
from jsmitsm.solution.run import Run


class RegionsRun(Run):
    """What ``Run`` is to a problem of one region; ``disc`` is a ``Regions``."""

    disc: Any
    nums: Any

    def __init__(self, disc: Regions, solver: str, throw: bool, repair: bool):
        super().__init__(disc, disc.problem, solver, throw, repair, "loo")  # type: ignore[arg-type]
        self.parts: list[tuple[list[Class], list[Row]]] = []  # rows of every region, in its own numbers
        self.bound: list[Any] = []  # those of the copies

    def numbers(self, taylor: Any = None) -> RegionNumbers:
        return region_numbers(self.disc, taylor)

    def expanded(self, nums: RegionNumbers, values: Any) -> Any:
        return with_held(self.disc, whole_coefficients(self.disc, nums, values))

    def operators(self) -> list[Any]:
        parts = [None] * len(self.disc.parts) if self.nums is None else self.nums.parts
        return [(p.disc, own, p.ids) for p, own in zip(self.disc.parts, parts)]

    def local_rows(self, nums: RegionNumbers) -> tuple[list[Class], list[Row]]:  # type: ignore[override]
        """The rows of all regions and of the copies, numbered in the whole cloud."""
        first = self.health is None
        self.parts, self.bound = [], []
        found: list[Health] = []
        classes: list[Class] = []
        rows: list[Row] = []
        for part, own in zip(self.disc.parts, nums.parts):
            made, some = all_rows(part.disc, own)
            if not is_traced(some):
                if self.repair and first:
                    made, some, looked = health.repaired(part.disc, own, made, some)
                    part.disc.classes = made
                else:
                    looked = health.examine(made, some)
                found.append(_numbered(looked, part.ids))
            self.parts.append((made, some))
            classes += [in_whole(part, cls) for cls in made]
            rows += some
        for meeting in joints(self.disc, nums):
            whose, equations = joint_rows(self.disc, nums, meeting)
            self.bound.append((meeting, whose, equations))
            classes += whose
            rows += equations
        if is_traced(rows):
            return classes, rows
        before = self.health
        found += [health.examine(cls, row) for _, cls, row in self.bound]
        self.health = _together(found)
        if before is not None:
            self.health.repaired = before.repaired
        self.judge(nums, rows)
        return classes, rows

    def _finite(self, nums: RegionNumbers) -> bool:
        return all(np.isfinite(np.asarray(own.jac)).all() for own in nums.parts)

    def assembled(self, nums: RegionNumbers, parts: Any = None) -> tuple[Any, Any, Any, Any]:  # type: ignore[override]
        clock, start = time.perf_counter, time.perf_counter()
        self._forget()
        for part, own in zip(self.disc.parts, nums.parts):
            if own.degenerate is not None and len(own.degenerate.empty):
                self._fail_empty(part.ids[own.degenerate.empty])
            if information_travels(part.disc, own.jac):
                self.object(
                    f"Information travels in the equation of the region {part.name!r}, or is carried faster than it "
                    "spreads between neighbours; the form that suits it is not made for clouds of several regions: "
                    "refine there."
                )
        if not is_traced(nums.between):
            self.disc.contrast = contrast(self.disc, nums)
        self.rows = classes, rows = self.local_rows(nums)
        local = clock()
        made = *matrix(self.disc, classes, rows), whole_right_side(self.disc, nums, self.parts, self.bound)
        self.seconds["local"] += local - start
        self.seconds["assembly"] += clock() - local
        return made

    def right_side(self, nums: RegionNumbers) -> Any:
        """The right-hand side alone, by the rows of the last step."""
        return whole_right_side(self.disc, nums, self.parts, self.bound)

    def _check_degenerate(self, nums: RegionNumbers, values: np.ndarray) -> None:  # type: ignore[override]
        for part, own in zip(self.disc.parts, nums.parts):
            there = copy(self)
            there.disc = part.disc
            Run._check_degenerate(there, own, values[part.ids])

    def _imbalance_at(self, taylor: Any, order: int) -> float:
        disc = discretize_regions(self.problem, self.disc.cloud, order, self.disc.rec.depth)
        other = RegionsRun(disc, self.solver, False, True)
        if taylor is not None:
            more = max(0, disc.rec.size - taylor.shape[2])
            taylor = np.pad(taylor, ((0, 0), (0, 0), (0, more)))[:, :, : disc.rec.size]
        nums = other.numbers(taylor)
        other.solved(*other.assembled(nums), balanced=False)
        return other.imbalance

    @property
    def misfit(self) -> None:  # type: ignore[override]
        return None

    def condition_numbers(self) -> tuple[np.ndarray, float]:
        """Of the particles' moment matrices (N,), NaN on interfaces, and of the global system."""
        if self.nums is None or self.factor is None:
            raise ValueError("condition_numbers: the solve failed before it had a system; see diagnose()")
        out = np.full(len(self.disc.cloud), np.nan)
        for part, own in zip(self.disc.parts, self.nums.parts):
            out[part.ids] = health.condition_numbers(part.disc, own)
        return out, float(self.factor.condition())

    def flags(self, estimated: Callable[[], float]) -> list[str]:
        """What speaks against the solution: the tests of each region, and those of the whole system."""
        if self.values is None or self.nums is None:
            return list(self.against)
        values = np.asarray(self.values, float)
        if not np.isfinite(values).all():
            return ["The values are not finite.", *self.against]
        certain: list[str] = []
        found: dict[str, float] = {}
        for test in flags.OF_THE_WHOLE:
            test(self, values, self.nums, certain, found)
        doubts: list[str] = []
        told: list[str]
        for part, own, rows in zip(self.disc.parts, self.nums.parts, self.parts):
            told = []
            view = copy(self)
            view.disc, view.rows, view.nums = part.disc, rows, own
            for test in flags.OF_A_REGION:
                test(view, values[part.ids], own, told, {})
            doubts += [f"In the region {part.name!r}: {line[0].lower()}{line[1:]}" for line in told]
        told = [*weak_copies(self.bound), *singular(self.disc, values)]
        cleared = len(values) <= flags.MANY and estimated() <= flags.CLEARED
        return [*certain, *([] if cleared else doubts), *told, *self.against]

    def stats(self) -> dict[str, Any]:
        """What a user may want to know about the solve."""
        disc = self.disc
        out: dict[str, Any] = {
            "seconds": dict(self.seconds), "depth": disc.rec.depth, "particles": len(disc.cloud),
            "unknowns": int((~disc.held).sum()), "neighbours": int(disc.near.shape[1]), "linear": self.linear,
            "formulation": self.formulation, "skipped": [], "messages": list(self.messages),
            "regions": {p.name: len(p.ids) for p in disc.parts}, "copies": sum(len(m.copies) for m in disc.meetings),
        }  # fmt: skip
        if self.changes:
            out["changes"] = list(self.changes)
        if "residual" in self.linear:
            out["residual"] = self.linear["residual"]
        if self.health is not None:
            out |= {
                "lebesgue_max": self.health.largest, "repaired": self.health.repaired, "weak": self.health.weak,
                "lebesgue_interfaces": max((h for h in (float(np.max(r.lebesgue)) for *_, rs in self.bound for r in rs
                                                        if not is_traced(r.lebesgue))), default=1.0),
            }  # fmt: skip
        return out


def _numbered(found: Health, ids: np.ndarray) -> Health:
    """The health of a region in the numbers of the whole cloud."""
    return Health(found.largest, *(ids[x.astype(int)] for x in (found.weak, found.repaired, found.undetermined)))


def _together(found: list[Health]) -> Health:
    joined = [np.concatenate([getattr(h, name) for h in found]) for name in ("weak", "repaired", "undetermined")]
    return Health(max(h.largest for h in found), *(x.astype(int) for x in joined))
