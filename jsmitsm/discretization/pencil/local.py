"""The rows of classes of particles with the source as values, and those of particles that follow their neighbours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jsmitsm.cloud.neighbours import in_line
from jsmitsm.cloud.sight.walls import nearest_seen
from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Class, Discretization, rounded_width
from jsmitsm.discretization.local_data import around, own_conditions
from jsmitsm.discretization.pencil.determined import undetermined
from jsmitsm.discretization.rows import class_rows
from jsmitsm.discretization.sharing import in_pieces, joined, on_all_cores
from jsmitsm.particle import batches
from jsmitsm.particle.batches import Operands
from jsmitsm.particle.elimination import Elimination, unconstrained
from jsmitsm.particle.moments import Row
from jsmitsm.particle.recursion import Recursion
from jsmitsm.runtime.errors import SolveError, some
from jsmitsm.taylor.multi_indices import multi_indices

# A fit of the source's Taylor coefficients takes so many values for each of them.
_RATIO = 2
# Neighbours that do not determine it are taken so many times as many, until they do.
_WIDER = (1.25, 1.5, 1.85, 2.2, 3.0, 4.0, 6.0, 8.0)


@dataclass
class Part:
    """The rows of a class of particles.

    far (n, v): the neighbours whose sources take part; row: their equations; sources (n, F, v, E): the weights of
    those sources. Without far the particles follow their neighbours and have no equation: u_i - sum w u_g = 0.
    """

    cls: Class
    far: np.ndarray | None
    row: Row
    sources: Any


def source_stencil_size(rec: Recursion, size: int) -> int:
    """How many neighbours, the particle itself counted, the sources' fits take beside stencils of ``size``."""
    return max(size, _RATIO * len(multi_indices(rec.dim, rec.degree))) if rec.degree > 0 else 1


def source_stencils(
    disc: Discretization, ids: np.ndarray, size: int, degree: int, strict: bool = False
) -> np.ndarray:  # fmt: skip
    """The nearest particles that each of ``ids`` sees, itself first: (n, size or more).

    More of them where the nearest do not determine polynomials of this degree, as beside the walls of a lattice.
    strict: raise SolveError where none do.
    """
    points = disc.images.searched(np.asarray(disc.cloud.points))
    near = _nearest(disc, points, ids, min(size, len(points)))
    short = undetermined(points, near, degree)
    for factor in _WIDER:
        if not len(short):
            break
        wide = _nearest(disc, points, ids[short], min(round(factor * size), len(points)))
        lacking = np.isin(np.arange(len(short)), undetermined(points, wide, degree))
        if not lacking.all():
            near = widened(near, wide.shape[1])
            near[short[~lacking]] = widened(wide[~lacking], near.shape[1])
        short = short[lacking]
    if strict and len(short):
        bad = np.sort(ids[short])
        raise SolveError(
            f"the sources around {len(bad)} particle(s), first {some(bad)}, do not determine polynomials of degree "
            f"{degree}: the cloud has too few particles in a row there; refine it, or lower the order or the depth",
            [int(i) for i in bad[:100]],
        )
    return near


def _nearest(disc: Discretization, points: np.ndarray, ids: np.ndarray, size: int) -> np.ndarray:
    if size == 1:
        return ids[:, None].astype(np.int32)
    if disc.rec.dim == 1:
        normals = None if len(disc.images.owner) or disc.walls is None else disc.walls.all_normals()
        found = in_line(points, size, ids, normals).indices
    else:
        found = nearest_seen(points, size, ids, disc.walls).indices
    return widened(np.asarray(found), rounded_width(found.shape[1]))


def widened(near: np.ndarray, width: int) -> np.ndarray:
    """Neighbours (n, w) in a table of this width."""
    return np.pad(near, ((0, 0), (0, max(0, width - near.shape[1]))), constant_values=-1)


def part_of(disc: Discretization, nums: Numbers, cls: Class, far: np.ndarray | None, shared: Any) -> Part:
    """The rows of one class, in pieces that the cores share."""
    if far is None:
        scheme, plain = unconstrained(cls.scheme)
        cls = replace(cls, scheme=scheme)
        return Part(cls, None, _followers(disc, nums, cls, plain), None)
    row = class_rows(disc, nums, cls, shared)
    there = around(disc, nums)
    bare = replace(disc.scheme, n_own=0, n_data=0, own=(), data=(), lost=0)
    start, cut, sensitivity = 0, [], {}
    for piece in in_pieces(disc, nums, [cls], row):
        part = slice(start, start + len(piece.ids))
        cut.append(Class(piece.ids, far[part], bare))
        sensitivity[id(cut[-1])] = row.source[part]
        start = part.stop

    def one(piece: Class) -> Any:
        n = len(piece.ids)
        given = Operands(np.zeros((1, 1, 1, 1)), np.zeros((n, 0, 0)), np.zeros((len(disc.points), 0, 0)), None)
        each = (sensitivity[id(piece)],)
        return batches.sources(piece.scheme, there.points, None, piece.ids, piece.neighbours, given, each)

    return Part(cls, far, row, joined(on_all_cores("source fits", one, disc, nums, cut, row)))


def _followers(disc: Discretization, nums: Numbers, cls: Class, plain: Elimination) -> Row:
    """Rows that say a particle's value by a polynomial through its neighbours' alone, and its own conditions."""
    there = around(disc, nums)
    given = Operands(np.zeros((1, 1, 1, 1)), own_conditions(nums, cls), there.data, plain)
    return batches.rows(cls.scheme, there.points, None, cls.ids, cls.neighbours, given)
