"""The recursion of one particle solved for its free coefficients: U = Q F + B c.

The fit knows the coefficients up to the order. The recursion goes on beyond it: with the constraints parted into
those that reach no further than the fit and the deeper ones,

    M_ll u_l = F_l,      M_hl u_l + M_hh u_h = F_h,

the tail u_h follows from u_l. It has more coefficients than equations; of all solutions the one of least Fischer
norm sum a! u_a^2 is taken, u_h = E (F_h - M_hl u_l) with E = D (M_hh D)^+ and D = diag(1 / sqrt(a!)), the
coefficients in units of the farthest neighbour's distance. That norm does not depend on the axes, and it keeps tails
small where convection is strong, where degree by degree or axis by axis they grow without bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jsmitsm.particle.polynomials import whitening
from jsmitsm.particle.recursion import FitAndTail, Recursion, constraints, fit_and_tail, row_lifts, substitution
from jsmitsm.particle.small_systems import (
    definite_inverse,
    gram_matrix,
    independent,
    null_space,
    orthonormalising,
    product,
)
from jsmitsm.taylor.multi_indices import Slot, factorial, multi_indices

# The ridge of a deep equation, as a part of its square.
RIDGE = 1e-6
# The deep part of an equation below this part of the whole says nothing of the tail.
FAINT = 1e-6

# A row of the recursion below this part of its equation's largest holds nothing but rounding.
SMALL = 1e-12


@dataclass(frozen=True)
class Scheme:
    """What is static about a class of particles: the method and the shapes of its systems.

    Attributes
    ----------
    free, dependent : positions of the paper's free and dependent coefficients (I, II, III).
    own : slots of the particle's own boundary conditions, and their number.
    data : slots of the conditions that neighbours contribute as data, and their number.
    sourced : whether the source's weights are wanted.
    flat : whether the homogeneous local solutions end with the fit: those of a constant operator whose terms are all
        of one order are sums of homogeneous polynomials.
    lost : rows of the recursion that add nothing to the others, where the equation degenerates.
    uneven : whether the particles' neighbours are too unevenly spread for the fit to be drawn to the near ones.
    carried : whether convection may outweigh diffusion between neighbours.
    """

    method: str
    rec: Recursion
    free: tuple[int, ...] = ()
    dependent: tuple[int, ...] = ()
    own: tuple[Slot, ...] = ()
    n_own: int = 0
    data: tuple[Slot, ...] = ()
    n_data: int = 0
    sourced: bool = True
    lost: int = 0
    flat: bool = False
    uneven: bool = False
    carried: bool = False

    def with_own(self, count: int, lost: int) -> Scheme:
        """The scheme of particles with so many conditions of their own and rows that add nothing.

        Without conditions it says nothing of what those of others are about: one program serves all regions.
        """
        return replace(self, n_own=count, lost=lost, own=self.own if count else ())

    @property
    def decay(self) -> float:
        """Without a kernel the weight is exp(-(decay r / r_max)^2). Deeper polynomials are true farther out, and
        measured best when the fit is drawn to the near ones."""
        return 2.5 if self.rec.depth and self.rec.order >= 3 and not self.uneven else 2.0

    @property
    def farthest(self) -> float:
        """The distance of the farthest neighbour in units of the length by which offsets are divided."""
        return self.decay / 2.0


class Elimination(NamedTuple):
    """U = Q F + B c: the local solutions, and the lengths by which the constraints were divided."""

    basis: Any  # (F K, free)
    particular: Any  # (F K, rows), or Deep
    lift: Any  # (rows,)
    rows: Any  # (F, F K): the equations themselves, needed by collocation
    units: Any  # (F,): of the fields, beside powers of the length


@lru_cache(maxsize=64)
def _whitening(rec: Recursion) -> np.ndarray:
    """The whitening applied to each field's block of the fit's columns."""
    blocks = [whitening(rec.dim, rec.order - (w if rec.depth else 0)) for w in rec.weights]
    out = np.zeros((sum(map(len, blocks)),) * 2)
    start = 0
    for block in blocks:
        out[start : start + len(block), start : start + len(block)] = block
        start += len(block)
    return out


@lru_cache(maxsize=64)
def _fischer(rec: Recursion, farthest: float) -> np.ndarray:
    """1 / sqrt(a!) of every coefficient (F K,) in units of the farthest neighbour's distance, here in scaled ones."""
    return np.tile([factorial(a) ** -0.5 * farthest ** -sum(a) for a in multi_indices(rec.dim, rec.reach)], rec.fields)


def eliminate(scheme: Scheme, jac: Any, length: Any) -> Elimination:
    """Solve the recursion of one particle for its free coefficients.

    jac (E, S, T). Method S and SSPH use polynomials that are orthonormal over the support.
    """
    rec = scheme.rec
    matrix, lift, units = constraints(rec, jac, length)
    rows = matrix[np.array(rec.equation_rows)]
    white = jnp.asarray(_whitening(rec))
    if scheme.method == "SSPH":
        return Elimination(white, jnp.zeros((white.shape[0], matrix.shape[0])), lift, rows, units)
    low, _, first, _ = fit_and_tail(rec)
    fitted = matrix if not rec.depth else matrix[first][:, low]
    if scheme.method == "S":
        if scheme.lost:
            z, q, lift = _of_lower_rank(scheme, fitted, lift, length, white)
        else:
            z, q = null_space(fitted @ white)
        z, q = white @ z, white @ q
    else:
        order = np.concatenate([scheme.free, np.setdiff1d(_all_free(scheme), scheme.free)]).astype(int)
        z, q = substitution(fitted, order, np.array(scheme.dependent))
        z = z[:, : len(scheme.free)]
    if rec.depth:
        z, q = _deepened(scheme, matrix, z, q)
    return Elimination(z, q, lift, rows, units)


@dataclass(frozen=True)
class Deep:
    """The particular solutions (F K, rows) of a recursion deeper than the fit, in parts: most of them are asked for
    their products with a vector or two alone, and a matrix of them all takes as long to make as everything else.

    Whoever asks for a tail has it by the same matrix E: what E itself lacks is then no error of a polynomial that the
    fit knows, however strong convection is. By factors of it, each product rounded apart, half of the digits are lost.
    """

    fitted: Any  # (low columns, low rows): Q of the fit
    across: Any  # (deep rows, low columns): M_hl
    extension: Any  # (high columns, deep rows): E, with a ridge
    place: FitAndTail  # of columns and rows among all
    shape: tuple[int, int]

    def extended(self, missing: Any) -> Any:
        """The tail (high columns, m) that follows from what the deep equations miss (deep rows, m)."""
        return product(self.extension, missing)

    def __matmul__(self, sides: Any) -> Any:
        """(rows,) or (rows, m) to (F K,) or (F K, m)."""
        if sides.ndim == 1:
            return (self @ sides[:, None])[:, 0]
        low = product(self.fitted, _rows_of(sides, self.place.first))
        high = self.extended(_rows_of(sides, self.place.deeper) - product(self.across, low))
        return _joined(low, high, self.place.low, self.place.high, self.shape[0])

    def transposed(self, wanted: Any) -> Any:
        """(F K, m) to (rows, m)."""
        deeper = product(self.extension.T, _rows_of(wanted, self.place.high))
        low = _rows_of(wanted, self.place.low) - product(self.across.T, deeper)
        return _joined(product(self.fitted.T, low), deeper, self.place.first, self.place.deeper, self.shape[1])


def transposed(particular: Any, wanted: Any) -> Any:
    """particular^T wanted, for a matrix of particular solutions or the parts of one: (rows, m)."""
    return particular.transposed(wanted) if isinstance(particular, Deep) else particular.T @ wanted


def as_matrix(particular: Any) -> Any:
    """Particular solutions (F K, rows) in one piece, for an elimination that many particles share."""
    return particular @ jnp.eye(particular.shape[1]) if isinstance(particular, Deep) else particular


def _deepened(scheme: Scheme, matrix: Any, basis: Any, particular: Any) -> tuple[Any, Deep]:
    """Local solutions (F K, free) of all degrees, from those of the fit's, and the particular ones."""
    place = fit_and_tail(scheme.rec)
    rows = _rows_of(matrix, place.deeper)
    across, deep = (_rows_of(rows.T, at).T for at in (place.low, place.high))
    size = jnp.asarray(_fischer(scheme.rec, scheme.farthest)[place.high])
    deep = deep * size
    unit = _row_lengths(deep, jnp)
    spread = (deep / unit[:, None]).T
    # The ridge bounds the condition of the Gram matrix: its inverse needs no refinement.
    inverse = definite_inverse(gram_matrix(spread) + _ridge(scheme) * np.eye(len(place.deeper)))
    extension = size[:, None] * product(spread, inverse) / unit
    made = Deep(particular, across, extension, place, (matrix.shape[1], matrix.shape[0]))
    tail = made.extended(-product(across, basis))
    whole = _joined(basis, tail, place.low, place.high, matrix.shape[1])
    if scheme.carried:
        whole = whole @ orthonormalising(_heights(scheme)[:, None] * whole)
    return whole, made


def _rows_of(matrix: Any, at: np.ndarray) -> Any:
    """The rows ``at`` of a matrix; those that follow one another by a slice, which is many times faster."""
    if len(at) and at[-1] - at[0] == len(at) - 1:
        return matrix[int(at[0]) : int(at[-1]) + 1]
    return matrix[at]


def _joined(upper: Any, lower: Any, first: np.ndarray, second: np.ndarray, count: int) -> Any:
    """The rows of two matrices brought to where they belong among ``count``; what is in neither is zero."""
    both = jnp.concatenate([upper, lower, jnp.zeros((count - len(upper) - len(lower), upper.shape[1]), upper.dtype)])
    at = np.concatenate([first, second])
    behind = np.argsort(np.concatenate([at, np.setdiff1d(np.arange(count), at)]))
    return both if (np.diff(behind) == 1).all() else both[behind]


def _row_lengths(matrix: Any, xp: Any) -> Any:
    """The lengths of the deep parts of rows of unit length; where they are only rounding, none of it counts."""
    return xp.sqrt(xp.maximum(xp.sum(matrix**2, axis=1), FAINT**2))


def _heights(scheme: Scheme) -> np.ndarray:
    """How high every monomial (F K,) is at the farthest neighbour.

    Where convection is strong, all local solutions but those that it carries have tails that grow as the Peclet number
    to the power of the depth, and a basis that mixes them leaves nothing of the others in the normal equations of the
    fit. One that is orthonormal by these heights does: Peclet numbers of 1e4 do no harm then.
    """
    rec = scheme.rec
    return np.tile([scheme.farthest ** sum(a) for a in multi_indices(rec.dim, rec.reach)], rec.fields)


def _ridge(scheme: Scheme) -> float:
    """By how much every deep equation may be missed, as a part of its square; not at all where the tail is determined.

    Where convection outweighs diffusion within a support, the deep equations speak of the fit's own coefficients, and
    the tail that would meet them exactly grows as the Peclet number to the power of the depth. The ridge bounds it:
    measured at cell Peclet numbers from 5 to 1000, and without effect on elliptic operators.
    """
    return 0.0 if scheme.flat else RIDGE


def _of_lower_rank(scheme: Scheme, fitted: Any, lift: Any, length: Any, white: Any) -> tuple[Any, Any, Any]:
    """Null space, pseudo-inverse and factors where some rows add nothing: by those that do, the largest first."""
    # Rows of unit length hide that rounding is all there is of one.
    rec = scheme.rec
    first = fit_and_tail(rec)[2]
    size = row_lifts(rec, length) / lift
    equation = np.array([e for e, _ in rec.row_index])
    largest = jnp.stack([jnp.max(jnp.where(equation == e, size, 0.0)) for e in range(len(rec.levels))])[equation]
    small = size < SMALL * largest
    damped = jnp.where(small, size / jnp.where(largest > 0, largest, 1.0), 1.0)
    wide = (damped[first][:, None] * fitted) @ white
    chosen = independent(wide, len(first) - scheme.lost)
    z, q = null_space(chosen @ wide)
    return z, q @ chosen, damped * lift


def unconstrained(scheme: Scheme) -> tuple[Scheme, Elimination]:
    """The scheme of a plain polynomial fit of the same order, and what stands for the recursion that it has not."""
    rec = replace(scheme.rec, degrees=(-1,) * len(scheme.rec.degrees), depth=0)
    white = _whitening(rec)
    nothing = np.zeros((len(white), 0)), np.zeros(0), np.zeros((rec.fields, len(white)))
    made = Elimination(white, *nothing, np.ones(rec.fields))
    return replace(scheme, rec=rec, sourced=False, flat=False, lost=0), made


def eliminate_on_host(scheme: Scheme, jac: np.ndarray, length: float = 1.0) -> Elimination:
    """``eliminate`` in numpy, where one elimination serves many particles; kept for later."""
    bare = Scheme(scheme.method, scheme.rec, scheme.free, scheme.dependent, flat=scheme.flat, uneven=scheme.uneven,
                  carried=scheme.carried)  # fmt: skip
    return _eliminated_once(bare, jac.tobytes(), jac.shape, jac.dtype.str, length)


@lru_cache(maxsize=256)
def _eliminated_once(scheme: Scheme, numbers: bytes, shape: tuple[int, ...], dtype: str, length: float) -> Elimination:
    made = _eliminated(scheme, np.frombuffer(numbers, dtype).reshape(shape), length)
    for part in made:
        part.setflags(write=False)
    return made


def _eliminated(scheme: Scheme, jac: np.ndarray, length: float) -> Elimination:
    rec = scheme.rec
    matrix, lift, units = constraints(rec, jac, length, np)
    rows = matrix[np.array(rec.equation_rows)]
    white = _whitening(rec)
    if scheme.method == "SSPH":
        return Elimination(white, np.zeros((white.shape[0], len(matrix))), lift, rows, units)
    low, _, first, _ = fit_and_tail(rec)
    fitted = matrix[np.ix_(first, low)] if rec.depth else matrix
    if scheme.method == "S":
        basis, particular = _refined(fitted, white)
    else:
        free, dependent = np.array(scheme.free), np.array(scheme.dependent, int)
        basis, particular = np.zeros((fitted.shape[1], len(free))), np.zeros(fitted.T.shape)
        particular[dependent] = np.linalg.inv(fitted[:, dependent])
        basis[free, np.arange(len(free))] = 1.0
        basis[dependent] = -particular[dependent] @ fitted[:, free]
    if rec.depth:
        basis, particular = _deepened_on_host(scheme, matrix, basis, particular)
    return Elimination(basis, particular, lift, rows, units)


def _deepened_on_host(
    scheme: Scheme, matrix: np.ndarray, basis: np.ndarray, particular: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    rec = scheme.rec
    low, high, first, deeper = fit_and_tail(rec)
    size = _fischer(rec, scheme.farthest)[high]
    deep = matrix[np.ix_(deeper, high)] * size
    unit = _row_lengths(deep, np)
    spread = np.concatenate([deep / unit[:, None], np.sqrt(_ridge(scheme)) * np.eye(len(deeper))], axis=1)
    inverse = _inverted(spread)
    extension, across = size[:, None] * inverse[: len(high)] / unit, matrix[np.ix_(deeper, low)]
    whole, source = np.zeros((matrix.shape[1], basis.shape[1])), np.zeros(matrix.T.shape)
    whole[low], source[np.ix_(low, first)] = basis, particular
    whole[high], source[np.ix_(high, first)] = -extension @ (across @ basis), -extension @ (across @ particular)
    source[np.ix_(high, deeper)] = extension
    if scheme.carried:
        heights = _heights(scheme)[:, None]
        whole = np.linalg.qr(heights * whole)[0] / heights
    return whole, source


def _refined(matrix: np.ndarray, white: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Null space and pseudo-inverse of the constraints, rounded once.

    All particles share their error: unlike that of one particle it does not average out in the
    global system, which amplifies it as the inverse square of the spacing.
    """
    k = len(matrix)
    q, r = np.linalg.qr((matrix @ white).T, mode="complete")
    wide = white.astype(np.longdouble)
    whitened = matrix.astype(np.longdouble) @ wide
    inverse = q[:, :k] @ np.linalg.inv(r[:k]).T
    null = q[:, k:] - inverse @ (whitened @ q[:, k:])
    inverse = inverse + inverse @ (np.eye(k) - whitened @ inverse)
    return (wide @ null).astype(float), (wide @ inverse).astype(float)


def _inverted(matrix: np.ndarray) -> np.ndarray:
    """The pseudo-inverse of a wide matrix, rounded once as above; tails of systems in 3D have a thousand columns, for
    which products in extended precision would take minutes."""
    q, r = np.linalg.qr(matrix.T)
    inverse = q @ np.linalg.inv(r).T
    # Numbers of so few bits have products whose sums are exact.
    bits = (53 - int(np.ceil(np.log2(matrix.shape[1] + 1)))) // 2
    a, b = _slices(matrix, 1, bits), _slices(inverse, 0, bits)
    missed = np.eye(len(matrix)) - a[0] @ b[0]
    missed = missed - (a[0] @ b[1] + a[1] @ b[0]) - (a[0] @ b[2] + a[1] @ b[1] + a[2] @ b[0])
    return inverse + inverse @ missed


def _slices(matrix: np.ndarray, axis: int, bits: int) -> list[np.ndarray]:
    """Three matrices of numbers of so many bits, counted from the largest along an axis, that add up to the matrix."""
    unit = np.exp2(np.ceil(np.log2(np.maximum(np.abs(matrix).max(axis=axis, keepdims=True), np.finfo(float).tiny))))
    slices = []
    for _ in range(3):
        unit = unit * 0.5**bits
        slices.append(np.rint(matrix / unit) * unit)
        matrix = matrix - slices[-1]
    return slices


def _all_free(scheme: Scheme) -> np.ndarray:
    return np.setdiff1d(np.arange(len(fit_and_tail(scheme.rec)[0])), scheme.dependent)
