"""The recursion of one particle solved for its free coefficients: U = Q F + B c."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jsmitsm.particle.polynomials import whitening
from jsmitsm.particle.recursion import Recursion, constraints, row_lifts, substitution
from jsmitsm.particle.small_systems import independent, null_space
from jsmitsm.taylor.multi_indices import Slot

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
    lost : rows of the recursion that add nothing to the others, where the equation degenerates.
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


class Elimination(NamedTuple):
    """U = Q F + B c: the local solutions, and the lengths by which the constraints were divided."""

    basis: Any  # (F K, free)
    particular: Any  # (F K, rows)
    lift: Any  # (rows,)
    rows: Any  # (F, F K): the equations themselves, needed by collocation


def _blocks(matrix: Any, fields: int) -> Any:
    """The whitening applied to each field's block of columns."""
    return matrix if fields == 1 else jnp.kron(jnp.eye(fields), matrix)


def eliminate(scheme: Scheme, jac: Any, length: Any) -> Elimination:
    """Solve the recursion of one particle for its free coefficients.

    jac (E, S, T). Method S and SSPH use polynomials that are orthonormal over the support.
    """
    rec = scheme.rec
    matrix, lift = constraints(rec, jac, length)
    rows = matrix[np.array(rec.equation_rows)]
    if scheme.method == "SSPH":
        white = _blocks(jnp.asarray(whitening(rec.dim, rec.order)), rec.fields)
        return Elimination(white, jnp.zeros((white.shape[0], matrix.shape[0])), lift, rows)
    if scheme.method == "S":
        white = _blocks(jnp.asarray(whitening(rec.dim, rec.order)), rec.fields)
        if scheme.lost:
            return _of_lower_rank(scheme, matrix, lift, length, white, rows)
        z, q = null_space(matrix @ white)
        return Elimination(white @ z, white @ q, lift, rows)
    order = np.concatenate([scheme.free, np.setdiff1d(_all_free(scheme), scheme.free)]).astype(int)
    z, q = substitution(matrix, order, np.array(scheme.dependent))
    return Elimination(z[:, : len(scheme.free)], q, lift, rows)


def _of_lower_rank(scheme: Scheme, matrix: Any, lift: Any, length: Any, white: Any, rows: Any) -> Elimination:
    """The elimination where some rows add nothing: by those that do, the largest first."""
    # Rows of unit length hide that rounding is all there is of one.
    rec = scheme.rec
    size = row_lifts(rec, length) / lift
    equation = np.array([e for e, _ in rec.row_index])
    largest = jnp.stack([jnp.max(jnp.where(equation == e, size, 0.0)) for e in range(len(rec.levels))])[equation]
    small = size < SMALL * largest
    damped = jnp.where(small, size / jnp.where(largest > 0, largest, 1.0), 1.0)
    wide = (damped[:, None] * matrix) @ white
    chosen = independent(wide, len(matrix) - scheme.lost)
    z, q = null_space(chosen @ wide)
    return Elimination(white @ z, white @ (q @ chosen), damped * lift, rows)


def eliminate_on_host(scheme: Scheme, jac: np.ndarray, length: float = 1.0) -> Elimination:
    """:func:`eliminate` in numpy, where one elimination serves many particles; kept for later."""
    bare = Scheme(scheme.method, scheme.rec, scheme.free, scheme.dependent)
    return _eliminated_once(bare, jac.tobytes(), jac.shape, jac.dtype.str, length)


@lru_cache(maxsize=256)
def _eliminated_once(
    scheme: Scheme, numbers: bytes, shape: tuple[int, ...], dtype: str, length: float
) -> Elimination:
    made = _eliminated(scheme, np.frombuffer(numbers, dtype).reshape(shape), length)
    for part in made:
        part.setflags(write=False)
    return made


def _eliminated(scheme: Scheme, jac: np.ndarray, length: float) -> Elimination:
    rec = scheme.rec
    matrix, lift = constraints(rec, jac, length, np)
    rows = matrix[np.array(rec.equation_rows)]
    white = np.kron(np.eye(rec.fields), whitening(rec.dim, rec.order))
    if scheme.method == "SSPH":
        return Elimination(white, np.zeros((white.shape[0], len(matrix))), lift, rows)
    if scheme.method == "S":
        return Elimination(*_refined(matrix, white), lift, rows)
    free, dependent = np.array(scheme.free), np.array(scheme.dependent, int)
    basis, particular = np.zeros((rec.size, len(free))), np.zeros((rec.size, len(matrix)))
    particular[dependent] = np.linalg.inv(matrix[:, dependent])
    basis[free, np.arange(len(free))] = 1.0
    basis[dependent] = -particular[dependent] @ matrix[:, free]
    return Elimination(basis, particular, lift, rows)


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


def _all_free(scheme: Scheme) -> np.ndarray:
    return np.setdiff1d(np.arange(scheme.rec.size), scheme.dependent)
