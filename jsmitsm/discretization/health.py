"""Local health: the Lebesgue constant of every particle, and the repair of weak stencils.

L_i = sum_g |w_g| bounds how much a particle's equation amplifies errors of its neighbours. A
plain nearest-neighbour stencil is bad where the density jumps: all neighbours lie on one side.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jsmitsm.cloud.sight.walls import Walls, nearest_seen
from jsmitsm.discretization.coefficients import Numbers, judge_again
from jsmitsm.discretization.layout import Class, Discretization, rounded_width
from jsmitsm.discretization.local_data import shared_elimination
from jsmitsm.discretization.rows import class_moment_matrices, class_rows
from jsmitsm.particle.moments import Row

# Up to this a stencil is healthy.
LEBESGUE = 1.5
# A particle with conditions of its own (a Neumann side) is one-sided by nature: short of a healthy
# stencil a wider one costs it more accuracy than it gains, unless the old one is as bad as this.
HOPELESS = 10.0
# Beyond this a stencil that could not be repaired has a weight that falls less.
POOR = 3.0
# A stencil is better by more than rounding: the same neighbours in another order are no repair.
GAIN = 1e-6
# A moment system that misses what is asked of it by more than this does not determine it.
DEFECT = 1e-6


@dataclass
class Health:
    """What was found and done; particle numbers."""

    largest: float = 1.0
    weak: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    repaired: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    undetermined: np.ndarray = field(default_factory=lambda: np.zeros(0, int))


def examine(classes: list[Class], rows: list[Row]) -> Health:
    """Largest Lebesgue constant, weak particles, and those whose system is not determined."""
    health = Health()
    for cls, row in zip(classes, rows, strict=True):
        lebesgue, defect = _worst(row)
        bad = ~np.isfinite(lebesgue) | ~(defect < _most(row))
        health.undetermined = np.append(health.undetermined, cls.ids[bad])
        health.weak = np.append(health.weak, cls.ids[lebesgue > LEBESGUE])
        health.largest = max(health.largest, float(np.max(lebesgue[~bad], initial=1.0)))
    return health


def _most(row: Row) -> float:
    """The largest defect that round-off explains: in float32 a moment system keeps three digits."""
    return max(DEFECT, 1e4 * float(np.finfo(np.asarray(row.weights).dtype).eps))


def _worst(row: Row) -> tuple[np.ndarray, np.ndarray]:
    """The largest Lebesgue constant over a particle's equations, and its defect."""
    return np.asarray(row.lebesgue).max(axis=1), np.asarray(row.defect)


def parted(classes: list[Class], rows: list[Row]) -> tuple[list[Class], list[Row], list[Class]]:
    """The healthy particles of some classes with their rows, and the classes of the weak ones."""
    well, good, poor = [], [], []
    for cls, row in zip(classes, rows, strict=True):
        weak = _score(row) > LEBESGUE
        if weak.any():
            poor.append(_some(cls, weak))
        if not weak.all():
            well.append(_some(cls, ~weak) if weak.any() else cls)
            good.append(_take(row, ~weak) if weak.any() else row)
    return well, good, poor


def repaired(
    disc: Discretization, nums: Numbers, classes: list[Class], rows: list[Row]
) -> tuple[list[Class], list[Row], Health]:
    """Give weak particles wider stencils, then balanced ones; keep the healthiest found.

    Tried in turn until L <= 1.5: 1.5 and 2.2 times the neighbours, then stencils with some neighbours from every
    direction. Those that stay poor are tried again with a weight that falls less. Particles with conditions of their
    own take no half measures.
    """
    new_classes, new_rows, touched = [], [], [np.zeros(0, int)]
    # The pieces of a class are repaired together.
    pieces: dict[Any, list[tuple[Class, Row, np.ndarray]]] = {}
    for cls, row in zip(classes, rows, strict=True):
        weak = _score(row) > LEBESGUE
        pieces.setdefault((cls.scheme, cls.wide), []).append((cls, row, np.flatnonzero(weak)))
        if not weak.any():
            new_classes.append(cls)
            new_rows.append(row)
        elif not weak.all():
            new_classes.append(_some(cls, ~weak))
            new_rows.append(_take(row, ~weak))
    sizes = _sizes(disc, pieces)
    for key, found in pieces.items():
        poor = [(_some(cls, at), _take(row, at)) for cls, row, at in found if len(at)]
        if poor:
            for cls, row, changed in _parted(disc, nums, *_repaired(disc, nums, poor, sizes[key]), sizes[key]):
                new_classes.append(cls)
                new_rows.append(row)
                touched.append(changed)
    changed = np.concatenate(touched)
    wider = [_some(cls, at) for cls in new_classes if (at := np.isin(cls.ids, changed)).any()]
    judge_again(replace(disc, classes=wider), nums)
    return new_classes, new_rows, replace(examine(new_classes, new_rows), repaired=changed)


def _sizes(disc: Discretization, pieces: dict[Any, list[tuple[Class, Row, np.ndarray]]]) -> dict[Any, int]:
    """The largest stencil of every kind of class that has weak ones; in a part of a cloud those of the whole."""
    mine = {
        key: max(int((cls.neighbours >= 0).sum(axis=1).max()) for cls, *_ in found)
        for key, found in pieces.items()
        if disc.part is not None or any(len(at) for *_, at in found)
    }
    if disc.part is None:
        return mine
    names = {key: kind_of(*key) for key in mine}
    largest = disc.part.largest({names[key]: size for key, size in mine.items()})
    return {key: largest[name] for key, name in names.items()}


def kind_of(scheme: Any, wide: bool) -> tuple[int, int, bool]:
    """What tells the kinds of classes apart whose largest stencils a repair goes by."""
    return scheme.n_own, scheme.lost, wide


def _parted(
    disc: Discretization, nums: Numbers, cls: Class, row: Row, changed: np.ndarray, size: int
) -> list[tuple[Class, Row, np.ndarray]]:
    """Repaired particles, and apart from them those that stay poor, with a weight that falls less."""
    even, weak = replace(cls.scheme, uneven=True), _score(row) > POOR
    if cls.scheme.n_own or even.decay == cls.scheme.decay or not weak.any():
        return [(cls, row, changed)]
    poor = replace(_some(cls, weak), scheme=even)
    start = class_rows(disc, nums, poor, shared_elimination(disc, nums))
    soft = _repaired(disc, nums, [(poor, start)], size)
    rest = _some(cls, ~weak)
    sound = [(rest, _take(row, ~weak), np.intersect1d(changed, rest.ids))] if len(rest.ids) else []
    return [*sound, (soft[0], soft[1], np.union1d(soft[2], np.intersect1d(changed, poor.ids)))]


def _repaired(
    disc: Discretization, nums: Numbers, poor: list[tuple[Class, Row]], size: int
) -> tuple[Class, Row, np.ndarray]:
    """Weak particles of one class, whose stencils have up to ``size`` neighbours, with better ones; those changed."""
    shared = shared_elimination(disc, nums)
    points = disc.images.searched(np.asarray(disc.cloud.points))
    classes, rows = zip(*poor)
    scheme, ids = classes[0].scheme, np.concatenate([cls.ids for cls in classes])
    near = np.concatenate([cls.neighbours for cls in classes])
    best = _Best(Row(*map(np.concatenate, zip(*rows))), near, bool(scheme.n_own))
    width = min(len(points), round(2.2 * size))
    kept = {} if disc.walls is None else disc.walls.kept
    around = _Pool(points, 10 * size, disc.walls)
    for number, attempt in enumerate((wider(1.5), wider(2.2), *(balanced(x, around) for x in (1.0, 1.5, 2.2)))):
        left = np.flatnonzero(best.lebesgue > LEBESGUE)
        if not len(left):
            break
        question = number, size, ids[left].tobytes()
        if question not in kept:
            if len(kept) >= _KEPT:
                kept.clear()
            kept[question] = attempt(points, ids[left], size, disc.walls)[:, :width]
        tried = kept[question]
        # And few shapes for all clouds.
        trial = Class(ids[left], _widened(tried, rounded_width(width, 16), 1, -1), scheme)
        best.update(left, trial.neighbours, class_rows(disc, nums, trial, shared))
    return Class(ids, best.neighbours, scheme, classes[0].wide), best.row, ids[best.changed]


# So many attempts are kept with the walls of a cloud, for the next solve on it, of another order too.
_KEPT = 32

# Moment matrices are looked at so many at a time, as many as one small program serves.
_PIECE = 128


def condition_numbers(disc: Discretization, nums: Numbers) -> np.ndarray:
    """The condition number (N,) of every particle's moment matrix; NaN where all values are held.

    That of the matrix with its rows and columns brought to unit length: units and the scaling of
    single coefficients do not count. It says how many digits a row may lose, and does not predict
    how well its stencil predicts the particle: the Lebesgue constant does.
    """
    shared = shared_elimination(disc, nums)
    out = np.full(len(disc.cloud), np.nan)
    for cls in disc.classes:
        for k in range(0, len(cls.ids), _PIECE):
            piece = Class(cls.ids[k : k + _PIECE], cls.neighbours[k : k + _PIECE], cls.scheme)
            out[piece.ids] = _conditions(np.asarray(class_moment_matrices(disc, nums, piece, shared), float))
    return out


def _conditions(matrices: np.ndarray) -> np.ndarray:
    """Condition numbers (n,) of matrices (n, rows, columns), scaled; infinite where one is not finite."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    scaled = np.where(finite[:, None, None], matrices, 0.0)
    axes = (2, 1) if matrices.shape[1] == matrices.shape[2] else (1,)  # rows of a fit carry the weights
    for axis in axes:
        size = np.linalg.norm(scaled, axis=axis, keepdims=True)
        scaled = scaled / np.where(size > 0, size, 1.0)
    values = np.linalg.svd(scaled, compute_uv=False)
    if not values.shape[1]:  # nothing is left to fit
        return np.ones(len(matrices))
    smallest = values[:, -1]
    return np.where(finite & (smallest > 0), values[:, 0] / np.where(smallest > 0, smallest, 1.0), np.inf)


def _score(row: Row) -> np.ndarray:
    lebesgue, defect = _worst(row)
    return np.where(np.isfinite(lebesgue) & (defect < _most(row)), lebesgue, np.inf)


class _Best:
    """The healthiest row found so far of every weak particle."""

    def __init__(self, row: Row, neighbours: np.ndarray, one_sided: bool):
        self.row, self.neighbours, self.one_sided = row, neighbours, one_sided
        self.lebesgue = _score(row)
        self.changed = np.zeros(len(neighbours), bool)

    def update(self, at: np.ndarray, neighbours: np.ndarray, row: Row) -> None:
        """Take over the rows of ``at`` that came out healthier."""
        score = _score(row)
        gain = score < (1.0 - GAIN) * self.lebesgue[at]
        if self.one_sided:
            gain &= (score <= LEBESGUE) | (self.lebesgue[at] > HOPELESS)
        better = np.flatnonzero(gain)
        width = max(self.neighbours.shape[1], neighbours.shape[1])
        self.neighbours = _widened(self.neighbours, width, 1, -1)
        here, trial = _wide_row(self.row, width), _wide_row(_take(row, better), width)
        into = at[better]
        self.neighbours[into] = _widened(neighbours, width, 1, -1)[better]
        self.row = Row(*(_inserted(x, into, y) for x, y in zip(here, trial)))
        self.lebesgue[into] = score[better]
        self.changed[into] = True


def _inserted(x: np.ndarray, at: np.ndarray, y: np.ndarray) -> np.ndarray:
    x = np.array(x)
    x[at] = y
    return x


def _some(cls: Class, at: np.ndarray) -> Class:
    return replace(cls, ids=cls.ids[at], neighbours=cls.neighbours[at])


def _take(row: Row, at: np.ndarray) -> Row:
    return Row(*(np.asarray(x)[at] for x in row))


def _wide_row(row: Row, width: int) -> Row:
    return row._replace(weights=_widened(row.weights, width, 2, 0.0), data=_widened(row.data, width, 2, 0.0))


def _widened(x: np.ndarray, width: int, axis: int, fill: Any) -> np.ndarray:
    pad = [(0, 0)] * x.ndim
    pad[axis] = (0, width - x.shape[axis])
    return np.pad(x, pad, constant_values=fill)


def wider(factor: float):
    """The nearest neighbours, ``factor`` times as many."""

    def attempt(points: np.ndarray, ids: np.ndarray, size: int, walls: Walls | None) -> np.ndarray:
        return np.asarray(nearest_seen(points, min(len(points), round(factor * size)), ids, walls).indices)

    return attempt


class _Pool:
    """The nearest ``count`` neighbours of particles, searched once for those first asked for and fewer of them."""

    def __init__(self, points: np.ndarray, count: int, walls: Walls | None):
        self.points, self.count, self.walls = points, min(len(points), count), walls
        self.row: dict[int, int] = {}
        self.near = np.zeros((0, 0), int)

    def of(self, ids: np.ndarray) -> np.ndarray:
        if not all(i in self.row for i in ids.tolist()):
            self.near = np.asarray(nearest_seen(self.points, self.count, ids, self.walls).indices)
            self.row = {i: k for k, i in enumerate(ids.tolist())}
        return self.near[[self.row[i] for i in ids.tolist()]]


def balanced(factor: float, around: _Pool | None = None):
    """At least a sixteenth of the neighbours from each of eight directions (two in 1D); around: who is near."""

    def attempt(points: np.ndarray, ids: np.ndarray, size: int, walls: Walls | None) -> np.ndarray:
        total = min(len(points), round(factor * size))
        pool = (around or _Pool(points, 10 * size, walls)).of(ids)
        offset = points[np.maximum(pool, 0)] - points[ids][:, None]
        away = np.where(pool >= 0, np.linalg.norm(offset, axis=2), np.inf)
        order = np.argsort(away, axis=1, kind="stable")
        pool, away = np.take_along_axis(pool, order, 1), np.take_along_axis(away, order, 1)
        sector = _sector(np.take_along_axis(offset, order[..., None], 1))
        quota = np.zeros(pool.shape, bool)
        share = max(1, -(-size // (16 if points.shape[1] > 1 else 4)))
        for s in range(int(sector.max()) + 1):
            here = (sector == s) & (pool >= 0)
            quota |= here & (np.cumsum(here, axis=1) <= share)
        quota[:, 0] = True  # the particle itself
        first = np.argsort(np.where(quota, -1.0, 1.0) * 1.0, axis=1, kind="stable")[:, :total]
        return np.take_along_axis(pool, first, 1)

    return attempt


def _sector(offset: np.ndarray) -> np.ndarray:
    """Eight directions around a particle: octants in 3D, half quadrants in 2D, sides in 1D."""
    dim = offset.shape[2]
    if dim == 2:
        return np.floor((np.arctan2(offset[..., 1], offset[..., 0]) + np.pi) / (np.pi / 4)).astype(int) % 8
    return ((offset > 0) * (1 << np.arange(dim))).sum(axis=2)
