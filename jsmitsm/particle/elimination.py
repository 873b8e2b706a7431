"""The recursion of one particle solved for its free coefficients: U = Q F + B c."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jsmitsm.particle.polynomials import whitening
from jsmitsm.particle.recursion import Recursion, constraints, substitution
from jsmitsm.particle.small_systems import null_space
from jsmitsm.taylor.multi_indices import Slot


@dataclass(frozen=True)
class Scheme:
    """What is static about a class of particles: the method and the shapes of its systems.

    Attributes
    ----------
    free, dependent : positions of the paper's free and dependent coefficients (I, II, III).
    own : slots of the particle's own boundary conditions, and their number.
    data : slots of the conditions that neighbours contribute as data, and their number.
    sourced : whether the source's weights are wanted.
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
        z, q = null_space(matrix @ white)
        return Elimination(white @ z, white @ q, lift, rows)
    order = np.concatenate([scheme.free, np.setdiff1d(_all_free(scheme), scheme.free)]).astype(int)
    z, q = substitution(matrix, order, np.array(scheme.dependent))
    return Elimination(z[:, : len(scheme.free)], q, lift, rows)


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
