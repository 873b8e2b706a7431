"""The rows and the Taylor coefficients of all particles, class by class."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.discretization.local_data import around, operands, own_conditions, right_sides, sent, shared_elimination
from jsmitsm.discretization.repeated_stencils import SMALLEST, Repeats, repeats
from jsmitsm.discretization.sharing import in_pieces, joined, on_all_cores, pieces, work
from jsmitsm.discretization.two_stage import two_stage_rows
from jsmitsm.particle import batches
from jsmitsm.particle.moments import Row
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program


def all_rows(disc: Discretization, nums: Numbers) -> tuple[list[Class], list[Row]]:
    """The rows of all particles: of every class in its pieces, with the neighbours that the rows reach."""
    shared = shared_elimination(disc, nums)
    if disc.scheme.method in ("I", "II"):
        return two_stage_rows(disc, nums, shared)
    found = [_repeats(disc, nums, cls) for cls in disc.classes]
    distinct = [cls if same is None else same.few(cls) for cls, same in zip(disc.classes, found)]
    cut = pieces(disc, nums, distinct)
    made = iter(_piece_rows(disc, nums, [piece for some in cut for piece in some], shared))
    classes, rows = [], []
    for cls, same, some in zip(disc.classes, found, cut):
        parts = list(islice(made, len(some)))
        if same is None:
            classes += some
            rows += parts
        else:
            disc.repeated += len(cls.ids) - len(same.first)
            classes.append(replace(cls, neighbours=same.neighbours))
            rows.append(jax.tree.map(lambda x, of=same.of: x[of], joined(parts)))
    return classes, rows


def _repeats(disc: Discretization, nums: Numbers, cls: Class) -> Repeats | None:
    """Repeated stencils of a constant operator, which are set up once."""
    if work(nums, cls) < SMALLEST or nums.jac.shape[-1] > 1 or cls.scheme.n_data:
        return None
    one_size = disc.kernel is None or (not is_traced(disc.kernel) and np.ndim(disc.kernel.h) == 0)
    own = own_conditions(nums, cls)
    if not one_size or is_traced(cls.neighbours, disc.points, own):
        return None
    return repeats(np.asarray(disc.points), cls.ids, cls.neighbours, np.asarray(own))


def class_rows(disc: Discretization, nums: Numbers, cls: Class, shared: Any) -> Row:
    """The rows of one class of particles."""
    return joined(_piece_rows(disc, nums, in_pieces(disc, nums, [cls]), shared))


def _piece_rows(disc: Discretization, nums: Numbers, cut: list[Class], shared: Any) -> list[Row]:
    """The rows of pieces of classes."""
    there = around(disc, nums)

    def one(cls: Class) -> Row:
        given = operands(disc, nums, cls, shared, there.data)
        return batches.rows(cls.scheme, there.points, there.kernel, cls.ids, cls.neighbours, given)

    return on_all_cores("local fits", one, disc, nums, cut)


def class_moment_matrices(disc: Discretization, nums: Numbers, cls: Class, shared: Any) -> Any:
    """The moment matrices (n, rows, free) of one class of particles."""
    there = around(disc, nums)
    given = operands(disc, nums, cls, shared, there.data)
    return batches.moment_matrices(cls.scheme, there.points, there.kernel, cls.ids, cls.neighbours, given)


def all_coefficients(disc: Discretization, nums: Numbers, values: Any) -> Any:
    """Taylor coefficients (N, F, K) of the particles of all classes, from all values u (N, F); zeros elsewhere."""
    shared, there = shared_elimination(disc, nums), around(disc, nums)
    known = disc.images.extend_values(values), disc.images.extend_values(nums.gamma)
    known = sent(batches.in_cloud_size(known, len(disc.points)))

    def one(cls: Class) -> Any:
        given = operands(disc, nums, cls, shared, there.data)
        sides = right_sides(disc, nums, cls)
        return batches.coefficients(
            cls.scheme, there.points, there.kernel, cls.ids, cls.neighbours, given, sides, known
        )

    cut = in_pieces(disc, nums, disc.classes, values)
    parts = on_all_cores("Taylor coefficients", one, disc, nums, cut, values)
    shape = (len(disc.cloud), disc.rec.fields, disc.rec.size)
    return _scattered(parts, np.concatenate([c.ids for c in cut]), disc.partner, shape)


@partial(in_one_program, static=("shape",))
def _scattered(parts: list[Any], ids: np.ndarray, partner: np.ndarray, shape: tuple[int, ...]) -> Any:
    """The coefficients of all classes at their particles, and every particle's taken from its partner."""
    if is_traced(parts):
        return jnp.zeros(shape).at[ids].set(jnp.concatenate(parts))[partner]
    out = np.zeros(shape)
    out[ids] = np.concatenate([np.asarray(p) for p in parts])
    return out[partner]
