"""The differential transform of a PDE: its Taylor coefficients as linear constraints.

For a linear operator ``sum_b a_b(x) d^b u = f(x)`` every Taylor coefficient of the residual
about a particle vanishes up to degree p - m (Karamanli 2015, eqs. 32, 37, 40):

    sum_b sum_{t<=c} A_b(t) (c-t+b)!/(c-t)! U(c-t+b) = F(c),      |c| <= p - m

with A_b, F the coefficients of a_b and f and U(a) = d^a u / a!. In coordinates scaled by a
length l, the unknowns are l^|a| U(a), and the row c carries the factor l^(m+|c|), so that all
entries are free of units. The solutions of these constraints are

    U = Q F + Z c

with Z a basis of the homogeneous local solutions and c the free coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.particle.small_systems import general_inverse
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program
from jsmitsm.taylor.multi_indices import Slot, factorial, index_of, multi_indices


@dataclass(frozen=True)
class Recursion:
    """The static structure of the constraints; built once per problem and order.

    Attributes
    ----------
    order, depth : the fit has the free coefficients of degree ``order``; the recursion goes ``depth`` degrees deeper.
    levels : per equation, the power of length that makes its leading terms free of units.
    weights : per field, the power of length that balances it against the others
        (a pressure counts one derivative less than a velocity).
    sizes : per field, the unit in which it is taken, where fields differ in size by much; empty where they do not.
    degrees : per equation, the highest degree of residual coefficients that is set to zero.
    """

    dim: int
    order: int
    fields: int
    slots: tuple[Slot, ...]
    levels: tuple[int, ...]
    weights: tuple[int, ...]
    degrees: tuple[int, ...]
    pattern: tuple[tuple[bool, ...], ...]
    depth: int = 0
    sizes: tuple[float, ...] = ()

    @property
    def reach(self) -> int:
        """The degree of the local polynomials: that of the fit and what the recursion adds."""
        return self.order + self.depth

    @property
    def orders(self) -> tuple[int, ...]:
        """The order of each equation."""
        return tuple(self.reach - q for q in self.degrees)

    @property
    def size(self) -> int:
        """Taylor coefficients of one field, K."""
        return len(multi_indices(self.dim, self.reach))

    @property
    def degree(self) -> int:
        """The highest degree to which Taylor coefficients of the operator are needed."""
        return max(self.degrees)

    @property
    def n_rows(self) -> int:
        return len(_rows(self))

    @property
    def row_index(self) -> list[tuple[int, tuple[int, ...]]]:
        """The equation and the multi-index of the residual's coefficient behind each row."""
        return _rows(self)

    @property
    def scale_free(self) -> bool:
        """Whether constant coefficients give the same constraints at every length scale."""
        return all(
            self.levels[e] == sum(b) + self.weights[f]
            for e in range(len(self.levels))
            for s, (f, b) in enumerate(self.slots)
            if self.pattern[e][s]
        )

    @property
    def equation_rows(self) -> tuple[int, ...]:
        """The row of each equation's residual itself (c = 0)."""
        return tuple(k for k, (_, c) in enumerate(_rows(self)) if sum(c) == 0)


def recursion(
    dim: int, order: int, fields: int, slots: Sequence[Slot], pattern: np.ndarray, orders: Sequence[int], depth: int = 0
) -> Recursion:
    """Lay out the constraints of a traced operator for fits of degree ``order`` and ``depth`` more."""
    weights = [0] * fields
    for f in range(fields):
        gaps = [
            orders[e] - max(sum(b) for s, (g, b) in enumerate(slots) if g == f and pattern[e, s])
            for e in range(len(orders))
            if any(g == f and pattern[e, s] for s, (g, _) in enumerate(slots))
        ]
        weights[f] = min(gaps, default=0)
    levels = [max(sum(b) + weights[f] for s, (f, b) in enumerate(slots) if pattern[e, s]) for e in range(len(orders))]
    return Recursion(
        dim, order, fields, tuple(slots), tuple(levels), tuple(weights),
        tuple(order + depth - m for m in orders), tuple(tuple(bool(v) for v in row) for row in pattern), depth,
    )  # fmt: skip


@lru_cache(maxsize=64)
def _rows(rec: Recursion) -> list[tuple[int, tuple[int, ...]]]:
    """The constraint rows (equation, multi-index c)."""
    return [(e, c) for e, q in enumerate(rec.degrees) for c in multi_indices(rec.dim, q)]


class FitAndTail(NamedTuple):
    """Columns and rows of the constraints that belong to the fit, and those that are deeper."""

    low: np.ndarray
    high: np.ndarray
    first: np.ndarray
    deeper: np.ndarray


@lru_cache(maxsize=64)
def fit_and_tail(rec: Recursion) -> FitAndTail:
    """Which columns (low, high) and which rows (first, deeper) the fit knows, and which it does not.

    A field counts with its weight, so that no row of the fit reaches a column beyond it. Without depth every
    coefficient up to the order takes part, as in the paper.
    """
    degrees = np.array([sum(a) for a in multi_indices(rec.dim, rec.reach)])
    weighted = np.concatenate([degrees + (w if rec.depth else 0) for w in rec.weights])
    behind = np.array([sum(c) + rec.orders[e] for e, c in _rows(rec)])
    masks = weighted <= rec.order, (weighted > rec.order) & (weighted <= rec.reach), behind <= rec.order
    # JAX takes no whole numbers of 64 bits where float64 is off.
    low, high, first, deeper = (np.flatnonzero(m).astype(np.int32) for m in (*masks, behind > rec.order))
    return FitAndTail(low, high, first, deeper)


@lru_cache(maxsize=64)
def _entries(rec: Recursion, terms: int) -> dict[str, np.ndarray]:
    """Every term of the constraints: its place in C, its coefficient and its factor; ``terms`` is 1 or all."""
    place, taylor = index_of(rec.dim, rec.reach), list(multi_indices(rec.dim, rec.degree))[:terms]
    found = []
    for row, (e, c) in enumerate(_rows(rec)):
        for s, (f, b) in enumerate(rec.slots):
            if not rec.pattern[e][s]:
                continue
            for t_index, t in enumerate(taylor):
                rest = tuple(ci - ti for ci, ti in zip(c, t))
                if min(rest) < 0:
                    continue
                a = tuple(r + bi for r, bi in zip(rest, b))
                found.append((row, f * rec.size + place[a], e, s, t_index, factorial(a) / factorial(rest)))
    names = ("row", "col", "equation", "slot", "taylor", "factor")
    return {name: np.array(values) for name, values in zip(names, zip(*found))}


@lru_cache(maxsize=64)
def _powers(rec: Recursion, terms: int) -> np.ndarray:
    """The power of length that frees each Taylor coefficient of the operator of units, (E, S, terms)."""
    levels = np.array(rec.levels)[:, None, None]
    derivatives = np.array([sum(b) + rec.weights[f] for f, b in rec.slots])[None, :, None]
    own = np.array([sum(t) for t in multi_indices(rec.dim, rec.degree)][:terms])
    return np.where(np.array(rec.pattern)[..., None], levels - derivatives + own, 0)


def _scattered(rec: Recursion, scaled: Any, xp: Any) -> Any:
    """The constraint matrix (rows, F K) from the operator's coefficients (E, S, T)."""
    row, col, e, s, t, factor = _entries(rec, scaled.shape[-1]).values()
    values, shape = scaled[e, s, t] * factor, (rec.n_rows, rec.fields * rec.size)
    if xp is not np:
        return jnp.zeros(shape, values.dtype).at[row, col].add(values)
    matrix = np.zeros(shape)
    np.add.at(matrix, (row, col), values)
    return matrix


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _gathered(rec: Recursion, scaled: Any) -> Any:
    """The same, number by number of the matrix: a third of the time that XLA takes to scatter."""
    layers, place = _layers(rec, scaled.shape[-1])
    flat = jax.lax.optimization_barrier(jnp.append(scaled.reshape(-1), 0.0))
    found = sum(jnp.take(flat, at, mode="clip") * factor for at, factor in layers)
    found = jax.lax.optimization_barrier(jnp.append(found, 0.0))
    return jnp.take(found, place, mode="clip").reshape(rec.n_rows, rec.fields * rec.size)


@_gathered.defjvp
def _gathered_jvp(rec: Recursion, primals: Any, tangents: Any) -> tuple[Any, Any]:
    # A scatter is what transposes to a gather.
    return _gathered(rec, *primals), _scattered(rec, tangents[0], jnp)


@lru_cache(maxsize=64)
def _layers(rec: Recursion, terms: int) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """Tables of terms and factors, whose sum is what C holds, and where each number of C (rows F K,) is in it.

    One more than the last stands for zero.
    """
    row, col, e, s, t, factor = _entries(rec, terms).values()
    positions, at = np.unique(row * rec.fields * rec.size + col, return_inverse=True)
    order = np.argsort(at, kind="stable")
    nth = np.arange(len(at)) - np.searchsorted(at[order], at[order])
    shape = (int(nth.max(initial=0)) + 1, len(positions))
    none = len(rec.levels) * len(rec.slots) * terms
    places, factors = np.full(shape, none, np.int32), np.zeros(shape)
    places[nth, at[order]] = ((e * len(rec.slots) + s) * terms + t)[order]
    factors[nth, at[order]] = factor[order]
    place = np.full(rec.n_rows * rec.fields * rec.size, len(positions), np.int32)
    place[positions] = np.arange(len(positions))
    return list(zip(places, factors)), place


def row_lifts(rec: Recursion, length: Any, xp: Any = jnp) -> Any:
    """The powers of length that make each constraint free of units: (rows,).

    Integer powers are products: many times cheaper than a general power.
    """
    levels, place = np.unique([rec.levels[e] + sum(c) for e, c in _rows(rec)], return_inverse=True)
    if not len(levels):
        return xp.zeros(0)
    return xp.stack([length ** int(k) for k in levels])[place]


def constraints(rec: Recursion, jac: Any, length: Any, xp: Any = jnp) -> tuple[Any, Any, Any]:
    """The constraint matrix of one particle, the factors of its right-hand side and the units of its fields.

    jac (E, S, T): Taylor coefficients of the operator's coefficients (T = 1 if constant);
    length: scalar scale. Returns C (rows, F K) with rows of unit length, the factors (rows,)
    that turn the Taylor coefficients of the source into the right-hand side, and the fields' units (F,).
    """
    powers = _powers(rec, jac.shape[-1])
    scaled = jac * (length ** xp.arange(int(powers.max()) + 1))[powers]
    matrix = _scattered(rec, scaled, np) if xp is np else _gathered(rec, scaled)
    units = field_units(rec, matrix, xp)
    if rec.sizes or any(rec.weights):
        matrix = matrix * xp.repeat(units, rec.size)
    square = xp.sum(matrix**2, axis=1)
    norm = xp.sqrt(xp.where(square > 0, square, 1.0))  # an empty row has a derivative too
    return matrix / norm[:, None], row_lifts(rec, length, xp) / norm, units


def field_units(rec: Recursion, matrix: Any, xp: Any = jnp) -> Any:
    """The units (F,) in which fields that count fewer derivatives weigh as much as the others in the equations.

    A pressure is in units of viscosity over length, or of momentum where that is more: a power of length alone
    leaves it so much too light, or too heavy, as the viscosity differs from one, and its modes between the particles
    are held by nothing. Fields of weight zero are taken in their sizes, where these differ by much.
    """
    sizes = xp.asarray(rec.sizes or (1.0,) * rec.fields)
    if not any(rec.weights):
        return sizes
    equations = np.array(rec.equation_rows)
    squares = xp.sum(matrix[equations].reshape(len(equations), rec.fields, rec.size) ** 2, axis=2)  # (E, F)
    if rec.sizes:
        squares = squares * sizes**2
    heavy = np.array(rec.weights) == 0
    others = xp.sum(xp.where(heavy, squares, 0.0), axis=1)
    shared = (squares > 0) & (others > 0)[:, None]
    own, rest = xp.sum(xp.where(shared, squares, 0.0), axis=0), xp.sum(xp.where(shared, others[:, None], 0.0), axis=0)
    known = (own > 0) & ~heavy
    units = xp.where(known, xp.sqrt(xp.where(known, rest, 1.0) / xp.where(known, own, 1.0)), 1.0)
    return units * sizes if rec.sizes else units


def source_rows(rec: Recursion, residual: Any) -> Any:
    """Pick the right-hand side's Taylor coefficients (rows, N) from a residual (E, T, N) at u = 0."""
    taylor = index_of(rec.dim, rec.degree)
    e = np.array([e for e, _ in _rows(rec)])
    t = np.array([taylor[c] for _, c in _rows(rec)])
    # Under a transform it may be an array of JAX that is not traced: each operation on it is compiled by itself.
    return _negative(residual if is_traced(residual) else np.asarray(residual), e, t)


@in_one_program
def _negative(residual: Any, e: np.ndarray, t: np.ndarray) -> Any:
    return -residual[e, t]


# ---------------------------------------------------------------- elimination


def free_indices(rec: Recursion, jac0: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The paper's choice of free and dependent Taylor coefficients (positions in 0..K-1).

    The equation is solved for the pure highest derivative along one axis, the one with the
    largest coefficient (the last of equals: y for Laplace), so the coefficients whose degree
    along that axis reaches the operator's order depend on the others.

    jac0 (S, N): the operator's coefficients at the particles; None where they are traced, then
    the last axis that has such a derivative is taken.
    """
    m = rec.orders[0]
    sizes = []
    for axis in range(rec.dim):
        pure = tuple(m if k == axis else 0 for k in range(rec.dim))
        here = [s for s, (_, b) in enumerate(rec.slots) if b == pure and rec.pattern[0][s]]
        sizes.append(0.0 if not here else 1.0 if jac0 is None else np.abs(jac0[here[0]]).min())
    if m > 0 and max(sizes) <= 1e-8 * (1.0 if jac0 is None else np.abs(jac0).max()):
        raise ValueError(
            "method: I, II and III solve the equation for a pure highest derivative along an axis, and every such "
            'derivative is missing or its coefficient vanishes at a particle; use method="S", which needs none'
        )
    axis = rec.dim - 1 - int(np.argmax(np.array(sizes[::-1]) >= 0.999 * max(sizes)))
    along = np.array([a[axis] for a in multi_indices(rec.dim, rec.order)])
    return np.flatnonzero(along < m), np.flatnonzero(along >= m)


@partial(jax.jit, static_argnums=(1, 2))
def _substitute(matrix: Any, free: tuple[int, ...], dependent: tuple[int, ...]) -> tuple[Any, Any]:
    k = matrix.shape[1]
    inverse = general_inverse(matrix[:, np.array(dependent)])
    z = jnp.zeros((k, len(free)), matrix.dtype).at[np.array(free), np.arange(len(free))].set(1.0)
    z = z.at[np.array(dependent)].set(-inverse @ matrix[:, np.array(free)])
    return z, jnp.zeros((k, matrix.shape[0]), matrix.dtype).at[np.array(dependent)].set(inverse)


def substitution(matrix: Any, free: np.ndarray, dependent: np.ndarray) -> tuple[Any, Any]:
    """Z and Q with the free coefficients themselves as coordinates (the paper's eqs. 38, 41)."""
    if len(dependent) == 0:
        return jnp.eye(matrix.shape[1], dtype=matrix.dtype), jnp.zeros((matrix.shape[1], 0), matrix.dtype)
    return _substitute(matrix, tuple(int(i) for i in free), tuple(int(i) for i in dependent))
