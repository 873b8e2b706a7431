"""One linear solve of a problem with several regions."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np

from jsmitsm.discretization import health
from jsmitsm.discretization.health import Health
from jsmitsm.discretization.layout import Class
from jsmitsm.discretization.leave_one_out import joined, matrix
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
from jsmitsm.discretization.regions.squares import of_rows, squared_blocks, squared_entries, squared_rows
from jsmitsm.discretization.rows import all_rows
from jsmitsm.discretization.supports import scheme_size
from jsmitsm.linear.linsolve import Factor
from jsmitsm.particle.moments import Row
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution import flags
from jsmitsm.solution.balance import relative_misfit
from jsmitsm.solution.regions.between import unseen
from jsmitsm.solution.regions.flags import singular, weak_copies
from jsmitsm.solution.run import Run

# A region takes least squares where convection is so many times diffusion between neighbours, more than where it is
# alone: what its copies predict is never least squares. Measured in a channel beside a conducting wall, order 4: at 4
# and 10 predicted values are 2 to 15 times as accurate; from 20 to 200 they are 4 to 100 times less accurate, but with
# slip up to 9 times more.
CARRIED = 20.0
# A region of fewer particles than this many times the free coefficients has hardly a neighbour that tells it anything.
SMALL = 1.5


class RegionsRun(Run):
    """What ``Run`` is to a problem of one region; ``disc`` is a ``Regions``."""

    disc: Any
    nums: Any

    def __init__(self, disc: Regions, solver: str, throw: bool, repair: bool, form: str = "auto"):
        super().__init__(disc, disc.problem, solver, throw, repair, "loo")  # type: ignore[arg-type]
        # Rows of every region, in its own numbers; blocks of those that take the least-squares form.
        self.parts: list[tuple[list[Class], list[Any]]] = []
        self.bound: list[Any] = []  # those of the copies
        # The form that was asked for, and the regions that take least squares; once they do they stay with it.
        self._missed: np.ndarray | None = None
        self.form, self.squared = form, set(p.name for p in disc.parts if form == "lsq")

    def fail(self, message: str, particles: Any = ()) -> None:
        if "is a condition missing" in message:
            count = {p.name: (len(p.ids), scheme_size(p.disc.scheme)) for p in self.disc.parts}
            for name, (n, free) in count.items():
                if n < SMALL * free:
                    message += (
                        f" Or the region {name!r} is too small for this order: {n} particles for {free} free "
                        "coefficients; reduce the spacing there, or lower the order"
                    )
        super().fail(message, particles)

    def numbers(self, taylor: Any = None) -> RegionNumbers:
        return region_numbers(self.disc, taylor)

    def expanded(self, nums: Any, values: Any) -> Any:
        if not isinstance(self.disc, Regions):  # the one region that ``flags`` looks at
            return super().expanded(nums, values)
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
            if part.name in self.squared:
                self.parts.append(squared_blocks(part, own))
                continue
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

    def assembled(self, nums: RegionNumbers, parts: Any = None) -> tuple[Any, Any, Any, Any]:  # type: ignore[override]
        clock, start = time.perf_counter, time.perf_counter()
        self._forget()
        for part, own in zip(self.disc.parts, nums.parts):
            if own.degenerate is not None and len(own.degenerate.empty):
                self._fail_empty(part.ids[own.degenerate.empty])
            if self.form == "auto" and information_travels(part.disc, own.jac, CARRIED):
                self.squared.add(part.name)
        self.disc.squared = bool(self.squared)
        if not is_traced(nums.between):
            self.disc.contrast = contrast(self.disc, nums)
        self.rows = classes, rows = self.local_rows(nums)
        local = clock()
        made = *self._entries(classes, rows), whole_right_side(self.disc, nums, self.parts, self.bound)
        self.seconds["local"] += local - start
        self.seconds["assembly"] += clock() - local
        return made

    def _entries(self, classes: list[Class], rows: list[Row]) -> tuple[Any, Any, Any]:
        """The global matrix as coordinates."""
        disc, entries = self.disc, matrix(self.disc, classes, rows)
        parts = [(p, made) for p, made in zip(disc.parts, self.parts) if p.name in self.squared]
        if not parts:
            return entries
        predicted = np.ones(int(disc.unknowns.max(initial=-1)) + 1, bool)
        predicted[np.concatenate([squared_rows(disc, p) for p, _ in parts])] = False
        return joined([of_rows(entries, predicted), *(squared_entries(disc, p, made) for p, made in parts)])

    @cached_property
    def factor(self) -> Factor | None:
        return None if self.rows is None else self.factor_of(*self._entries(*self.rows))

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
        other = RegionsRun(disc, self.solver, False, True, self.form)
        if taylor is not None:
            more = max(0, disc.rec.size - taylor.shape[2])
            taylor = np.pad(taylor, ((0, 0), (0, 0), (0, more)))[:, :, : disc.rec.size]
        nums = other.numbers(taylor)
        other.solved(*other.assembled(nums), balanced=False)
        return other.imbalance

    @property
    def misfit(self) -> np.ndarray | None:  # type: ignore[override]
        """Of the whole none; of the one region that ``flags`` looks at, where it takes the least-squares form."""
        return self._missed

    def condition_numbers(self) -> tuple[np.ndarray, float]:
        """Of the particles' moment matrices (N,), NaN on interfaces, and of the global system."""
        if self.nums is None or self.factor is None:
            raise ValueError("condition_numbers: the solve failed before it had a system; see diagnose()")
        out = np.full(len(self.disc.cloud), np.nan)
        for part, own in zip(self.disc.parts, self.nums.parts):
            out[part.ids] = health.condition_numbers(part.disc, own)
        return out, float(self.factor.condition())

    def flags(self, estimated: Callable[[], float], known: bool = False) -> list[str]:
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
        flags.unsettled(self, values, self.nums, doubts, found)
        bounds = [(0.0, flags.CLEARED)]
        for part, own, rows in zip(self.disc.parts, self.nums.parts, self.parts):
            sure, told, found = list[str](), list[str](), {}
            view = copy(self)
            view.disc, view.rows, view.nums = part.disc, rows, own
            if part.name in self.squared:
                view._missed = relative_misfit(part.disc, own, values[part.ids], list(zip(*rows)))
            for tests, lines in zip(flags.OF_A_REGION, (sure, told)):
                for test in tests:
                    test(view, values[part.ids], own, lines, found)
            sure, told = ([f"In the region {part.name!r}: {a[0].lower()}{a[1:]}" for a in lines]
                          for lines in (sure, told))  # fmt: skip
            certain += sure
            (certain if flags.hopeless(found) else doubts).extend(told)
            bounds.append(flags.clearing(found, self.disc.rec.order))
        told = [*weak_copies(self.bound), *singular(self.disc, values)]
        asked = known or len(values) <= flags.MANY
        share = estimated() if asked else np.inf
        if self.squared and not np.isfinite(share) and asked:
            doubts.append(
                f"The region(s) {sorted(self.squared)} take the least-squares form, whose error no other order can "
                "tell here: compare with a finer cloud."
            )
        cleared = max(least for least, _ in bounds) <= share <= min(most for _, most in bounds)
        if cleared and not certain:
            told += unseen(self, values)
        return [*certain, *([] if cleared else doubts), *told, *self.against]

    @property
    def least_squares(self) -> bool:
        return bool(self.squared)

    def _forms(self) -> Any:
        """The form of the global system; where regions differ, that of each."""
        forms = {p.name: "lsq" if p.name in self.squared else "loo" for p in self.disc.parts}
        return forms if len(set(forms.values())) > 1 else next(iter(forms.values()))

    def stats(self) -> dict[str, Any]:
        """What a user may want to know about the solve."""
        disc = self.disc
        out: dict[str, Any] = {
            "seconds": dict(self.seconds), "depth": disc.rec.depth, "particles": len(disc.cloud),
            "unknowns": int((~disc.held).sum()), "neighbours": int(disc.near.shape[1]), "linear": self.linear,
            "formulation": self._forms(), "skipped": [], "messages": list(self.messages),
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
