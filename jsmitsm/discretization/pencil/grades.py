"""Whether a pencil's rows are fit for time, and the repair of those that are not.

An evolution B v' = A v is stable where diag B has one sign, is not outweighed by the rest of its row, and the stencil
predicts well. These three were found to be what counts: of 35 pencils on random clouds 28 had growing modes without
repair, up to 8 with the Lebesgue constant alone, up to 2 with all three, and none where the few particles that stay bad
follow their neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.health import DEFECT, LEBESGUE, balanced, kind_of, wider
from jsmitsm.discretization.layout import Discretization, rounded_width
from jsmitsm.discretization.pencil.local import Part, part_of, widened
from jsmitsm.particle.moments import Row
from jsmitsm.runtime.collector import uncollected
from jsmitsm.runtime.errors import some

# The sources of all neighbours together may weigh so many times a particle's own, by the dimension.
DOMINANCE = {1: 5.0, 2: 5.0, 3: 8.0}
# What a diagonal entry of the wrong sign counts, and the grade above which a particle follows its neighbours.
WRONG, HOPELESS = 1000.0, 2.0
_TRIALS = (
    *((wider(f), f) for f in (1.25, 1.5, 1.85, 2.2)),
    *((balanced(f), f) for f in (1.0, 1.5, 2.2)),
)


@dataclass
class Fitness:
    """What was found and done; particle numbers."""

    worst: float = 0.0  # the largest grade of a particle with an equation; up to 1 is healthy
    lebesgue: float = 1.0
    dominance: float = 0.0
    repaired: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    weak: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    wrong: np.ndarray = field(default_factory=lambda: np.zeros(0, int))  # of the wrong sign
    following: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    undetermined: np.ndarray = field(default_factory=lambda: np.zeros(0, int))


class Grading:
    """The grades of rows against those of most particles.

    An equation goes with the field that it determines, in whatever order they are written.
    """

    def __init__(self, disc: Discretization, parts: list[Part], massed: np.ndarray):
        self.disc = disc
        blocks = np.concatenate([np.asarray(p.sources)[:, :, 0, :] for p in parts])
        inner = np.concatenate([disc.n_own[p.cls.ids] == 0 for p in parts])
        blocks = blocks[inner] if inner.any() else blocks
        size = np.linalg.norm(blocks, axis=(1, 2), keepdims=True)
        usual = np.median(blocks / np.where(size > 0, size, 1.0), axis=0)  # (F, E)
        if disc.part is not None:  # only signs and sizes beside one another count
            usual = disc.part.total(np.nan_to_num(usual) * len(blocks))
        self.of_field = _paired(np.abs(usual))
        self.usual, self.massed = usual[:, self.of_field], massed[self.of_field]
        self.sizes = _sizes(disc, parts)

    def __call__(self, part: Part) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Grades (n,), Lebesgue constants, dominance and whether the sign is wrong."""
        lebesgue = np.asarray(part.row.lebesgue).max(axis=1)
        determined = np.isfinite(lebesgue) & (np.asarray(part.row.defect) < DEFECT)
        n = len(lebesgue)
        if part.far is None or not self.massed.any():
            dominance, wrong = np.zeros(n), np.zeros(n, bool)
        else:
            dominance, wrong = self._of_sources(part)
        grade = np.maximum(lebesgue / LEBESGUE, dominance / DOMINANCE[self.disc.rec.dim]) + WRONG * wrong
        return np.where(determined, grade, np.inf), lebesgue, dominance, wrong

    def _of_sources(self, part: Part) -> tuple[np.ndarray, np.ndarray]:
        """How the neighbours' sources weigh against the particle's own, and whether those have the usual sign."""
        sources = np.nan_to_num(np.asarray(part.sources))[..., self.of_field]
        counts = self.massed & ~self.disc.held[part.cls.ids]  # (n, F)
        both = counts[:, :, None] & counts[:, None, :]
        unit = np.eye(len(self.massed))
        own, usual = (np.where(both, x, unit) for x in (sources[:, :, 0, :], self.usual))
        regular = _regular(own)
        dominance = np.full(len(own), np.inf)
        others = np.where(both[:, :, None, :], sources[:, :, 1:, :], 0.0)
        turned = np.einsum("nef,nfge->nge", np.linalg.inv(own[regular]), others[regular])
        dominance[regular] = np.abs(turned).sum(axis=1).max(axis=1, initial=0.0)
        comparable = regular & _regular(usual)
        wrong = ~regular
        ratio = np.linalg.eigvals(own[comparable] @ np.linalg.inv(usual[comparable]))
        wrong[comparable] = (ratio.real <= 0).any(axis=1)
        return dominance, wrong


def _sizes(disc: Discretization, parts: list[Part]) -> dict[Any, int]:
    """The largest stencils of every kind of class, and of its sources; in a part of a cloud those of the whole."""
    found: dict[Any, int] = {}
    for part in parts:
        kind = kind_of(part.cls.scheme, part.cls.wide)
        for name, near in (("near", part.cls.neighbours), ("far", part.far)):
            if near is not None:
                size = int((near >= 0).sum(axis=1).max())
                found[kind, name] = max(size, found.get((kind, name), 0))
    return found if disc.part is None else disc.part.largest(found)


def _paired(size: np.ndarray) -> np.ndarray:
    """The equation of each field by the sizes (F, E) of the sources in its row."""
    if len(size) == 1:
        return np.zeros(1, int)
    with uncollected():
        from scipy.optimize import linear_sum_assignment

    part = size / np.maximum(size.max(axis=0), 1e-300)
    return linear_sum_assignment(np.log(np.maximum(part, 1e-12)), maximize=True)[1]


def _regular(blocks: np.ndarray) -> np.ndarray:
    """Whether matrices (n, F, F) can be inverted, by their determinant in units of their rows."""
    size = np.linalg.norm(blocks, axis=2)
    unit = np.prod(np.where(size > 0, size, 1.0), axis=1)
    return (size > 0).all(axis=1) & (np.abs(np.linalg.det(blocks)) > 1e-10 * unit)


def graded(
    disc: Discretization, nums: Numbers, parts: list[Part], massed: np.ndarray, repair: bool, shared: Any
) -> tuple[list[Part], Fitness]:
    """The parts with the stencils of weak particles replaced by better ones, and what was found.

    massed (E,): the equations whose sources matter.
    """
    grading, fitness = Grading(disc, parts, massed), Fitness()
    out: list[Part] = []
    for part in parts:
        grade = grading(part)[0]
        poor = np.flatnonzero(grade > 1.0)
        if not repair or not len(poor):
            out.append(part)
            continue
        if len(poor) < len(grade):
            out.append(_taken(part, np.flatnonzero(grade <= 1.0)))
        out += _repaired(disc, nums, _taken(part, poor), grade[poor], grading, shared, fitness)
    for part in out:
        grade, lebesgue, dominance, wrong = grading(part)
        ids = part.cls.ids
        if part.far is None:
            fitness.following = np.append(fitness.following, ids)
        else:
            fitness.worst = max(fitness.worst, float(grade.max(initial=0.0)))
            fitness.weak = np.append(fitness.weak, ids[grade > 1.0])
            fitness.wrong = np.append(fitness.wrong, ids[wrong])
            fitness.dominance = max(fitness.dominance, float(dominance.max(initial=0.0)))
        fitness.lebesgue = max(fitness.lebesgue, float(lebesgue[np.isfinite(lebesgue)].max(initial=1.0)))
        fitness.undetermined = np.append(fitness.undetermined, ids[~np.isfinite(grade)])
    return out, fitness


def _repaired(
    disc: Discretization, nums: Numbers, part: Part, grade: np.ndarray, grading: Grading, shared: Any, fitness: Fitness
) -> list[Part]:
    """Weak particles of one class with better stencils; those that no stencil mends follow their neighbours."""
    points = disc.images.searched(np.asarray(disc.cloud.points))
    assert part.far is not None
    size, far_size = (grading.sizes[kind_of(part.cls.scheme, part.cls.wide), name] for name in ("near", "far"))
    most = min(len(points), round(2.2 * size)), min(len(points), round(2.2 * far_size))
    near, far = (widened(x, rounded_width(m, 16)) for x, m in zip((part.cls.neighbours, part.far), most))
    far = part.far if far_size == 1 else far
    ids, best, changed = part.cls.ids, grade.copy(), np.zeros(len(grade), bool)
    for attempt, factor in _TRIALS:
        left = np.flatnonzero(best > 1.0)
        if not len(left):
            break
        # One shape for all attempts: compiling costs far more than computing a few rows twice.
        at = np.sort(np.resize(left, len(ids)))
        tried = widened(attempt(points, ids[at], size, disc.walls)[:, : most[0]], near.shape[1])
        wide = far[at]
        if far_size > 1:
            wide = widened(wider(factor)(points, ids[at], far_size, disc.walls)[:, : most[1]], far.shape[1])
        trial = part_of(disc, nums, replace(part.cls, ids=ids[at], neighbours=tried), wide, shared)
        found = grading(trial)[0]
        gain = np.flatnonzero(found < best[at])
        into = at[gain]
        near[into], far[into], best[into], changed[into] = tried[gain], wide[gain], found[gain], True
    # Where a condition makes a particle one-sided, dominance is lost by nature; and with the equation of a system it
    # would lose what the condition says of other fields.
    follows = best > (WRONG if part.cls.scheme.n_own else HOPELESS)
    follows &= not (part.cls.scheme.n_own and disc.rec.fields > 1)
    fitness.repaired = np.append(fitness.repaired, ids[changed & ~follows])
    out = []
    kept, lost = np.flatnonzero(~follows), np.flatnonzero(follows)
    if len(kept):
        cls = replace(part.cls, ids=ids[kept], neighbours=near[kept])
        out.append(part_of(disc, nums, cls, far[kept], shared))
    if len(lost):
        count = min(len(points), 2 * disc.rec.size + 1)
        around = wider(1.0)(points, ids[lost], count, disc.walls)
        out.append(part_of(disc, nums, replace(part.cls, ids=ids[lost], neighbours=around), None, shared))
    return out


def _taken(part: Part, at: np.ndarray) -> Part:
    """The particles ``at`` of a part."""
    cls = replace(part.cls, ids=part.cls.ids[at], neighbours=part.cls.neighbours[at])
    row = Row(*(np.asarray(x)[at] for x in part.row))
    far = None if part.far is None else part.far[at]
    return Part(cls, far, row, None if part.sources is None else np.asarray(part.sources)[at])


def told(fitness: Fitness) -> list[str]:
    """In words: what the repair did, and what stays."""
    out = []
    if len(fitness.repaired):
        out.append(f"{len(fitness.repaired)} stencil(s) were widened or balanced, first {some(fitness.repaired)}.")
    if len(fitness.following):
        out.append(
            f"{len(fitness.following)} particle(s), first {some(fitness.following)}, follow their neighbours: no "
            "stencil of theirs gives an equation that is stable in time."
        )
    if len(fitness.weak):
        out.append(
            f"{len(fitness.weak)} particle(s) stay weak (grade {fitness.worst:.3g}, up to 1 is healthy), first "
            f"{some(fitness.weak)}."
        )
    if len(fitness.wrong):
        out.append(f"The source has the wrong sign in the rows of {len(fitness.wrong)} particle(s), first "
                   f"{some(fitness.wrong)}: an evolution would not be stable.")  # fmt: skip
    return out

