"""Errors of eigenvalues: by the pencil of order p + 2, by way of both vectors, and by what no order sees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jsmitsm.discretization.layout import Discretization
from jsmitsm.discretization.pencil.assemble import Pencil
from jsmitsm.discretization.regions.layout import Regions
from jsmitsm.discretization.resolution.residuals import residual
from jsmitsm.modes.ends import at_ends
from jsmitsm.modes.question import Question, assembled, reduced
from jsmitsm.modes.spectrum import Pairs
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.progress import PENCIL, bar
from jsmitsm.solution.look.between import same_everywhere
from jsmitsm.solution.look.gaps import gaps
from jsmitsm.solution.look.halfway import WAYS, around
from jsmitsm.solution.look.layers import across_layers
from jsmitsm.solution.solution import Solution
from jsmitsm.taylor.multi_indices import HIGHEST

# Rows of two orders differ in the weight of their source by less than this.
_OUTLIER = 4.0


def conditions(question: Question, found: Pairs) -> np.ndarray:
    """The condition numbers (k,) of the values: the sizes of both vectors where their product is one.

    Field by field, so that the units in which one is given do not count.
    """
    dual = question.inert.host_transposed @ found.left
    field = question.pencil.free % question.problem.fields
    each = [np.flatnonzero(field == k) for k in np.unique(field)]
    return sum(np.linalg.norm(found.right[at], axis=0) * np.linalg.norm(dual[at], axis=0) for at in each)


@bar("error estimate", parts=PENCIL)
def errors(question: Question, found: Pairs, mode: Callable[[int], Solution] | None = None) -> np.ndarray:
    """Estimated errors (k,) of the values; infinite where there is no other order to compare with.

    With the modes between the particles, what no order sees is in them (``unseen``).

    With A', C' of order p + 2, rows D scaled to those of A, and y^T C v = 1, to first order

        lambda' - lambda = y^T D (A' - lambda C') v;

    for a cluster the largest singular value of that matrix.
    """
    other = _other_order(question)
    if other is None:
        return np.full(len(found.values), np.inf)
    _, a, c = reduced(other, question.problem, question.weights)
    rest = a.host @ found.right - (c.host @ found.right) * found.values
    moved = found.left.T @ (_scale(question.pencil, other)[:, None] * rest)
    out = np.zeros(len(found.values))
    for cluster in np.unique(found.cluster):
        at = np.flatnonzero(found.cluster == cluster)
        out[at] = np.linalg.norm(moved[np.ix_(at, at)], 2)
    return out if mode is None else np.maximum(out, unseen(question, found, mode))


def unseen(question: Question, found: Pairs, mode: Callable[[int], Solution]) -> np.ndarray:
    """By how much values (k,) may be off for what rows of all orders miss alike, in one region.

    mode: those between the particles, which solve L u - lambda mass u = 0. Halfway to their neighbours polynomials miss
    it by r where a coefficient or the mass jumps, or a layer there hardly conducts, which moves the value by

        y^T B r / y^T C v,

    and where the mode is not smooth, at a corner or where conditions change, neighbours part by a gap there. The value
    is off by about its square (in parts of the largest |v|; measured on corners and changes of conditions, by 0.2 to 4
    times that), as energies are: what two orders tell falls with another power of the spacing. Where not all is held
    around, there is more (see ``ends``).
    """
    out, pencil = np.zeros(len(found.values)), question.pencil
    if isinstance(pencil.layout.disc, Regions):
        return out
    for k in np.flatnonzero(np.isreal(found.values)):
        sol, value = mode(int(k)), abs(found.values[k])
        disc, values = sol._fit.discretization(), np.asarray(sol.u).reshape(len(sol.cloud), -1)
        parted, largest = gaps(sol), float(np.abs(values).max(initial=0.0))
        if parted is not None and max(disc.rec.orders) == 2 and largest > 0:
            out[k] = value * (float(parted.max(initial=0.0)) / largest) ** 2
            out[k] = max(out[k], at_ends(question, found, int(k), sol))
        if not same_everywhere(disc):
            left = found.left[:, k]
            one = left @ (question.inert.host @ values.ravel()[pencil.free])
            for rest in _left_between(sol, disc):
                out[k] = max(out[k], np.abs(left @ (pencil.B.host @ rest)[pencil.free] / one))
    for cluster in np.unique(found.cluster):
        at = found.cluster == cluster
        out[at] = out[at].max()
    return out


def _left_between(sol: Solution, disc: Discretization) -> list[np.ndarray]:
    """What polynomials leave of the equation halfway to their neighbours, and what layers there that hardly conduct
    make them miss, at the particles (N F,)."""
    fitted = np.asarray(sol.coefficients, float).reshape(len(sol.cloud), disc.rec.fields, -1)
    fitted = np.concatenate([fitted, fitted[disc.images.owner]])
    left = lambda ids, there, offset: residual(disc, sol._fit.problem, there, offset, fitted[ids])
    found = [around(disc, disc.classes, left, WAYS[disc.rec.dim])]
    found.append(across_layers(disc, sol._fit.problem, lambda: fitted))
    rests = np.zeros((2, len(sol.cloud), disc.rec.fields))
    for rest, (ids, mean) in zip(rests, found):
        rest[ids] = mean.T
    return list(rests.reshape(2, -1))


def _other_order(question: Question) -> Pencil | None:
    """The pencil of two orders more, or less where the cloud or the method has no more."""
    cloud = question.pencil.layout.disc.cloud
    if question.other is not None:
        return question.other
    for order in (question.order + 2, question.order - 2):
        if order + question.depth > HIGHEST:
            continue
        try:
            question.other = assembled(
                question.problem, cloud, order=order, mass=tuple(question.massed), depth=question.depth
            )
            return question.other
        except (ValueError, SolveError):  # too few particles for the one, too low an order for the other
            continue
    return None


def _scale(mine: Pencil, other: Pencil) -> np.ndarray:
    """The ratios (n,) of the weights that a particle's own source has in the rows of both, over the free unknowns."""
    weights = []
    for pencil in (mine, other):
        b = pencil.B
        fields = pencil.layout.disc.rec.fields
        own = b.rows % fields == b.cols % fields
        weights.append(np.bincount(b.rows[own], np.asarray(b.values)[own], b.shape[0])[mine.free])
    here, there = weights
    known = (here != 0) & (there != 0)
    ratio = np.where(known, here / np.where(known, there, 1.0), 0.0)
    sound = ratio > 0
    typical = float(np.median(ratio[sound])) if sound.any() else 1.0
    out: Any = np.where(sound, np.clip(ratio, typical / _OUTLIER, typical * _OUTLIER), typical)
    return out
