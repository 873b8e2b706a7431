"""Where the equation degenerates: particles at which its highest derivatives have no weight.

On the axis of r u'' + 2 u' = f the equation itself says u' = 0, and a condition that says so too adds nothing; at a
zero of the leading coefficient a row of the recursion is empty, or repeats the others. Neither may be eliminated: what
rounding leaves of such a row would be solved for. The rank is decided here, on the host and at the few particles in
question, so that what is compiled knows how many rows of each count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from jsmitsm.discretization.layout import Discretization, mean_spacing, split
from jsmitsm.discretization.parts.whole import ALONE, Whole
from jsmitsm.equation.problem import Problem
from jsmitsm.particle.recursion import Recursion, constraints, fit_and_tail, row_lifts
from jsmitsm.runtime.errors import some
from jsmitsm.runtime.tracers import any_number, concrete
from jsmitsm.taylor.multi_indices import factorial, index_of

# Leading coefficients below this part of all others, over a support, and of most of the cloud's, may lose a row of the
# recursion or imply a condition; where so many do, only those below the smaller part are looked at.
LEADING, MOST, TINY, MANY = 1e-2, 0.2, 1e-6, 500
# A row below this part of the equation's largest is empty.
EMPTY = 1e-12
# What is left of a row of unit length after those before it. Less adds nothing but rounding, which grows with every
# row that is taken for another; a condition is left out only where the equation says the same.
DEPENDENT, IMPLIED = 1e-2, 1e-4
# What an equation and a condition say of one particle may differ by this part of the solution.
CONTRADICTION = 1e-6


@dataclass
class Degenerate:
    """What was found at the degenerate particles.

    implied : particles of which a condition was left out, since the equation says the same.
    empty : particles where, and around which, an equation says nothing.
    conflicts : (particle, by how much two statements of it differ, in units of u, and which part of u that may be).
    """

    implied: np.ndarray
    empty: np.ndarray
    conflicts: list[tuple[int, float, float]]

    def contradicted(self, size: float) -> list[int]:
        """The particles of which the equation and a condition say different things; size: of the solution."""
        if not np.isfinite(size):
            return []
        return [i for i, off, slack in self.conflicts if off > (CONTRADICTION + 10.0 * slack) * size]


def contradiction(particles: Any) -> str:
    """What a solve says of such particles."""
    return (
        f"the equation at {len(particles)} particle(s), first {some(particles)}, where its leading coefficient "
        "vanishes, says something of u by itself, and the condition or the source there contradicts it; correct them, "
        "or give js.free() where the equation needs no condition"
    )


@dataclass
class _Found:
    """One particle: rows of the recursion that add nothing, conditions that do, and what they contradict."""

    lost: int
    kept: list[int]
    nothing: bool
    conflict: float
    slack: float


@dataclass(frozen=True)
class Typical:
    """What is typical of the whole cloud.

    lead : of each equation the leading coefficient that most particles exceed.
    size : of each equation the size of its own row.
    below : the part of what is typical below which particles are looked at.
    """

    lead: list[float]
    size: np.ndarray
    below: float


def typical(disc: Discretization, jac: np.ndarray, further: Callable[[np.ndarray], np.ndarray], told: Whole) -> Typical:
    """What several processes decide together.

    jac (E, S, 1, n): of degree 0, of all own particles; further: makes it of degree 2 for a mask (n,) of them.
    """
    lead = _leads(disc, jac, told)
    near = np.any([(_lead(disc.rec, jac, e) <= LEADING * most) | (most == 0) for e, most in enumerate(lead)], axis=0)
    count = int((_nearness(disc, further(near), lead) <= LEADING).sum()) if near.any() else 0
    size = _scales(disc.rec, jac, 2.0 * mean_spacing(disc), told)
    return Typical(lead, size, LEADING if told.total(count) <= MANY else TINY)


def _powers(rec: Recursion, e: int) -> list[int]:
    return [rec.levels[e] - sum(b) - rec.weights[f] for f, b in rec.slots]


def _lead(rec: Recursion, jac: np.ndarray, e: int) -> np.ndarray:
    """The largest leading coefficient of an equation, (n,)."""
    return np.max([np.abs(jac[e, s, 0]) for s, p in enumerate(_powers(rec, e)) if p == 0], axis=0)


def _leads(disc: Discretization, jac: np.ndarray, told: Whole) -> list[float]:
    return [float(told.quantile(_lead(disc.rec, jac, e), MOST)) for e in range(len(jac))]


def _nearness(disc: Discretization, jac: np.ndarray, usual: list[float]) -> np.ndarray:
    """How near to zero (n,) the leading coefficients are, beside all others and what is usual."""
    rec, length = disc.rec, 2.0 * mean_spacing(disc)
    degree = [sum(t) for t in index_of(rec.dim, rec.degree)]
    least = np.full(jac.shape[-1], np.inf)
    near = [t for t, d in enumerate(degree[: jac.shape[2]]) if d <= 2]
    for e, most in enumerate(usual):
        lead = _lead(rec, jac, e)
        every = np.max([np.abs(jac[e, s, t]) * length ** (p + degree[t]) for s, p in enumerate(_powers(rec, e))
                        for t in near], axis=0)  # fmt: skip
        every = np.minimum(every, most) if most > 0 else every
        least = np.minimum(least, np.where(every > 0, lead / np.where(every > 0, every, 1.0), 0.0))
    return least


def candidates(disc: Discretization, jac: np.ndarray, told: Whole = ALONE) -> tuple[np.ndarray, np.ndarray]:
    """Those of the particles (n,) of jac (E, S, T, n) whose leading coefficients are near zero, and how near.

    told: what tells of the jac of all processes, where these ask together.
    """
    least = _nearness(disc, jac, _leads(disc, jac, told))
    few = np.flatnonzero(least <= LEADING)
    few = few if told.total(len(few)) <= MANY else np.flatnonzero(least <= TINY)
    return few, least[few]


def settled(disc: Discretization, problem: Problem, nums: Any) -> Any:
    """The numbers without conditions that the equation implies; ``disc`` learns how many rows count where."""
    disc.lost, disc.dropped, old = None, None, (disc.lost, disc.dropped)
    own, points, near = (concrete(x) for x in (nums.own, disc.points, disc.stencils.indices))
    seen = own is not None and points is not None and near is not None
    if seen and disc.scheme.method == "S" and np.shape(nums.jac)[-1] > 1:
        jac = concrete(nums.jac)
        jac = _in_general(disc, problem, nums.ids) if jac is None else np.asarray(jac)
        # What is not finite is told where the rows are made.
        if np.isfinite(jac).all():
            nums = _examined(disc, nums, jac, np.asarray(own), np.asarray(points))
    if not all(map(_same, old, (disc.lost, disc.dropped))):
        disc.classes = [part for cls in disc.classes for part in split(disc, cls)]
    return nums


def _same(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    return a is b if a is None or b is None else np.array_equal(a, b)


def _in_general(disc: Discretization, problem: Problem, ids: np.ndarray) -> np.ndarray:
    """The operator's coefficients where JAX only traces them: with any numbers for what is traced.

    Which rows are empty, or repeat others, hangs on where x makes the coefficients vanish, but for special numbers.
    """
    traced, points = disc.traced, np.asarray(concrete(disc.cloud.points))[ids]
    params = jax.tree.map(any_number, problem.params)
    slots, terms = None, len(index_of(disc.rec.dim, disc.rec.degree))
    if not traced.linear:
        slots = np.random.default_rng(0).uniform(0.5, 1.5, (len(traced.slots), terms, len(points)))
    return np.asarray(traced.with_any_numbers().coefficients(points, disc.rec.degree, params=params, slots=slots)[0])


def _examined(disc: Discretization, nums: Any, jac: np.ndarray, own: np.ndarray, points: np.ndarray) -> Any:
    if disc.part is None or disc.part.typical is None:
        at, least = candidates(disc, jac)
        scale = _scales(disc.rec, jac, 2.0 * mean_spacing(disc)) if len(at) else np.zeros(0)
    else:  # these are some of many particles, of which the processes decided together
        usual = disc.part.typical
        least, scale = _nearness(disc, jac, usual.lead), usual.size
        at = np.flatnonzero(least <= usual.below)
        least = least[at]
    if not len(at):
        return nums
    n = len(disc.cloud)
    known = concrete(nums.jac) is not None
    source, given = (concrete(x) if known else None for x in (nums.source, nums.given))
    near, ids = np.asarray(concrete(disc.stencils.indices)), nums.ids
    found: dict[int, _Found] = {}
    for k in at:
        i = int(ids[k])
        around = near[i][near[i] >= 0]
        length = float(np.linalg.norm(points[around] - points[i], axis=1).max()) or 1.0
        place = np.searchsorted(nums.own_ids, i)
        count = int(disc.n_own[i])
        right = None if source is None else np.asarray(source)[:, min(k, np.shape(source)[1] - 1)]
        values = None if given is None or not count else np.asarray(given)[place, :count]
        rows = own[place, :count] if count else np.zeros((0, len(disc.scheme.own)))
        found[i] = _particle(disc, jac[..., k], rows, length, right, values, scale)
    lost, dropped = np.zeros(n, int), np.zeros(n, int)
    nothing = np.zeros(len(disc.points), bool)
    for i, one in found.items():
        lost[i], dropped[i], nothing[i] = one.lost, int(disc.n_own[i]) - len(one.kept), one.nothing
    if not lost.any() and not dropped.any():
        return nums
    disc.lost, disc.dropped = lost, dropped
    share = np.where(near >= 0, nothing[disc.images.owners(near)], False).sum(axis=1) / (near >= 0).sum(axis=1)
    # Of a part the neighbours may be others' to look at.
    empty = np.flatnonzero(nothing[:n] & ((share > 0.5) | (disc.part is not None)))
    # A little beside an axis, at a distance that no cloud resolves, data are those of the axis.
    beside = dict(zip(ids[at].tolist(), least.tolist()))
    conflicts = [(i, one.conflict, max(one.slack, beside[i])) for i, one in found.items() if one.conflict > 0]
    told = Degenerate(np.flatnonzero(dropped), empty, conflicts)
    return replace(nums, degenerate=told, **_first_kept(nums, {i: one.kept for i, one in found.items()}))


def _scales(rec: Recursion, jac: np.ndarray, length: float, told: Whole = ALONE) -> np.ndarray:
    """The usual size of each equation's own row."""
    out = []
    for e in range(len(rec.levels)):
        sizes = [np.abs(jac[e, s, 0]) * length**p for s, p in enumerate(_powers(rec, e))]
        out.append(float(told.quantile(np.max(sizes, axis=0), 0.5)))
    return np.array(out)


def _particle(
    disc: Discretization, jac: np.ndarray, own: np.ndarray, length: float, source: Any, given: Any, scale: np.ndarray
) -> _Found:
    """The rank of one particle's rows, and which of its conditions add to it."""
    rec = disc.rec
    # Of a recursion that goes deeper than the fit, the rows of the fit count.
    low, _, first, _ = fit_and_tail(rec)
    matrix, lift, units = constraints(rec, jac, length, np)
    matrix, lift, lifts = matrix[np.ix_(first, low)], lift[first], row_lifts(rec, length, np)[first]
    equation = np.array([e for e, _ in rec.row_index])[first]
    size = np.where(np.any(matrix != 0, axis=1), lifts / lift, 0.0)
    largest = np.array([max(size[equation == e].max(), scale[e]) for e in range(len(rec.levels))])[equation]
    largest = np.where(largest > 0, largest, 1.0)
    full = size > EMPTY * largest
    matrix, lift = np.where(full[:, None], matrix, 0.0), np.where(full, lift, lifts / largest)
    right = np.zeros(len(lift)) if source is None else lift * source[first]
    chosen, span, slack = _independent(matrix)
    conditions, scales = _functionals(disc, own, length, units)
    values = np.zeros(len(own)) if given is None else scales * given
    kept = []
    for k, row in enumerate(conditions):
        rest = row - span.T @ (span @ row)
        left = float(np.linalg.norm(rest))
        if left > IMPLIED:
            kept.append(k)
            span = np.concatenate([span, rest[None] / left])
        else:
            slack = max(slack, left)
    said = np.concatenate([matrix[chosen], conditions[kept]])
    solution = np.linalg.lstsq(said, np.concatenate([right[chosen], values[kept]]), rcond=None)[0]
    conflict = 0.0
    if source is not None:
        conflict = float(np.abs(matrix @ solution - right).max(initial=0.0))
    if source is not None and given is not None:
        conflict = max(conflict, float(np.abs(conditions @ solution - values).max(initial=0.0)))
    nothing = any(not full[equation == e].any() for e in range(len(rec.levels)))
    return _Found(len(lift) - len(chosen), kept, nothing, conflict, slack)


def _independent(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Rows (numbers) that span all, the largest first, an orthonormal basis of it, and what it misses of the rest."""
    rest, chosen, span = matrix.copy(), [], np.zeros((0, matrix.shape[1]))
    for _ in range(len(matrix)):
        norms = np.linalg.norm(rest, axis=1)
        k = int(np.argmax(norms))
        if norms[k] <= DEPENDENT:
            break
        v = rest[k] / norms[k]
        v = v - span.T @ (span @ v)
        v = v / np.linalg.norm(v)
        chosen.append(k)
        span = np.concatenate([span, v[None]])
        rest = rest - np.outer(rest @ v, v)
        rest[k] = 0.0
    return np.array(chosen, int), span, float(np.linalg.norm(rest, axis=1).max(initial=0.0))


def _functionals(
    disc: Discretization, own: np.ndarray, length: float, units: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Conditions (n, S) as rows over the scaled coefficients, of unit length, and the factors of their values."""
    rec, place = disc.rec, index_of(disc.rec.dim, disc.rec.reach)
    rows = np.zeros((len(own), rec.fields * rec.size))
    for s, (f, b) in enumerate(disc.scheme.own):
        rows[:, f * rec.size + place[b]] += own[:, s] * factorial(b) * units[f] * length ** -(sum(b) + rec.weights[f])
    norm = np.linalg.norm(rows, axis=1)
    norm = np.where(norm > 0, norm, 1.0)
    return (rows / norm[:, None])[:, fit_and_tail(rec)[0]], 1.0 / norm


def _first_kept(nums: Any, kept: dict[int, list[int]]) -> dict[str, Any]:
    """The conditions of every particle with those that are kept first."""
    order = np.broadcast_to(np.arange(np.shape(nums.own)[1]), np.shape(nums.own)[:2]).copy()
    for i, first in kept.items():
        at = np.searchsorted(nums.own_ids, i)
        if at < len(nums.own_ids) and nums.own_ids[at] == i:
            order[at] = [*first, *(k for k in range(order.shape[1]) if k not in first)]
    row = np.arange(len(order))[:, None]
    return {"own": nums.own[row, order], "given": nums.given[row, order]}
