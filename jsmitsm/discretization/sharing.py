"""Classes of particles cut into pieces that the cores share."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.particle.recursion import fit_and_tail
from jsmitsm.runtime.progress import each, shown
from jsmitsm.runtime.size_classes import cloud_size, open_size
from jsmitsm.runtime.threads import cores, side_by_side
from jsmitsm.runtime.tracers import closes_over_traced, is_traced, recorded

# Particles that the cores share in pieces, between whose ends a progress bar moves. Every piece costs a millisecond, so
# it has some four of work: _WORK entries of matrices to be made, about.
PIECE, MOST_PIECES, _WORK = 16384, 32, 1_200_000
# What the systems of other methods take, measured by those of S.
_TIMES = {"I": 8, "II": 8, "III": 4}


def pieces(disc: Discretization, nums: Numbers, classes: list[Class], *more: Any) -> list[list[Class]]:
    """Every class in pieces of about one size (one program serves all), for the cores to share or a bar to move."""
    if not _to_share(disc, nums, classes, *more) or not (shown() or (cores() > 1 and jax.default_backend() == "cpu")):
        return [[cls] for cls in classes]
    total, worth = _total(classes), _worth(nums, classes)
    rounds = -(-min(-(-total // PIECE), MOST_PIECES) // cores())  # as many pieces for each core
    return [_cut(cls, max(-(-total // (rounds * cores())), worth)) for cls in classes]


def in_pieces(disc: Discretization, nums: Numbers, classes: list[Class], *more: Any) -> list[Class]:
    """The pieces of all classes."""
    return [piece for some in pieces(disc, nums, classes, *more) for piece in some]


def on_all_cores(
    what: str, one: Any, disc: Discretization, nums: Numbers, classes: list[Class], *more: Any
) -> list[Any]:
    """``one`` of all classes, or pieces of them, side by side where nothing is traced."""

    def program(cls: Class) -> Any:
        sizes = cloud_size(len(disc.points)), open_size(len(cls.ids)), cls.neighbours.shape[1]
        return one.__qualname__, cls.scheme, sizes, disc.kernel is None

    mapped = partial(side_by_side, program=program) if _to_share(disc, nums, classes, *more) else map
    return each(what, one, classes, mapped)


def joined(parts: list[Any]) -> Any:
    """Pytrees with the particle axis first, one after another."""
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _to_share(disc: Discretization, nums: Numbers, classes: list[Class], *more: Any) -> bool:
    """Whether the classes are worth several cores; not where JAX traces something, which this thread alone may do."""
    if _total(classes) < 2 * _worth(nums, classes) or recorded():
        return False
    if is_traced(disc.points, disc.kernel, vars(nums), [cls.neighbours for cls in classes], more):
        return False
    return disc.kernel is None or not closes_over_traced(disc.kernel.tree_flatten()[1])


def _total(classes: list[Class]) -> int:
    return sum(len(cls.ids) for cls in classes)


def _worth(nums: Numbers, classes: list[Class]) -> int:
    """The least number of particles worth a piece of their own."""
    return min(PIECE, _WORK // max((work(nums, cls) for cls in classes), default=1) + 1)


def work(nums: Numbers, cls: Class) -> int:
    """How much the system of one particle is to make, in numbers."""
    rec = cls.scheme.rec
    # Of a flat operator the tail is zero, and only the fit is looked at.
    columns = len(fit_and_tail(rec)[0]) if cls.scheme.flat else rec.size * rec.fields
    matrix = cls.neighbours.shape[1] * columns * _TIMES.get(cls.scheme.method, 1)
    return matrix + (columns**3 // 4 if nums.jac.shape[-1] > 1 else 0)


def _cut(cls: Class, size: int) -> list[Class]:
    """A class in equal pieces of about this size; one that is a piece already stays as it is."""
    n = len(cls.ids)
    step = -(-n // max(1, round(n / size)))
    cuts = [slice(start, start + step) for start in range(0, n, step)]
    return [replace(cls, ids=cls.ids[some], neighbours=cls.neighbours[some]) for some in cuts]
