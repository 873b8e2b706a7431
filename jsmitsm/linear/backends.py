"""Solvers of one sparse matrix, each behind the same two lines: construct, `apply`.

`Backend(matrix)` factorises a scipy csc array, or sets up a preconditioner; it raises where it
cannot. `apply(b, transpose)` solves for (n, m) right-hand sides, as well as the method does by
itself; `sparse.Factor` scales, orders, corrects residuals and changes the backend where one fails.
`entries` is the number of stored entries, `iterations` counts steps, and `stalled` tells that they
led nowhere, which a small residual can hide where the matrix is singular.
"""

from __future__ import annotations

import importlib.util
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import copy
from functools import cache
from typing import Any

import numpy as np

from jsmitsm.runtime.collector import uncollected
from jsmitsm.runtime.progress import bar


@cache
def installed(package: str) -> bool:
    """Whether an optional package can be imported, without importing it."""
    return importlib.util.find_spec(package) is not None


class Lapack:
    """Dense LU."""

    iterations, stalled = 0, False

    def __init__(self, matrix: Any) -> None:
        from scipy.linalg.lapack import dgetrf

        self.entries = matrix.shape[0] ** 2
        self.lu, self.pivots, code = dgetrf(matrix.toarray(order="F"), overwrite_a=True)
        if code > 0:
            raise np.linalg.LinAlgError(f"zero pivot {code}")

    def apply(self, b: np.ndarray, transpose: bool) -> np.ndarray:
        """Solve, (n, m) to (n, m)."""
        from scipy.linalg.lapack import dgetrs

        return dgetrs(self.lu, self.pivots, b, trans=int(transpose))[0] if b.size else b


class SuperLU:
    """Sparse LU; `ordered`: the matrix stands in a good symmetric order already."""

    iterations, stalled = 0, False

    def __init__(self, matrix: Any, ordered: bool) -> None:
        self.lu = _in_order(matrix) if ordered else _splu(matrix)
        self.entries = self.lu.nnz

    def apply(self, b: np.ndarray, transpose: bool) -> np.ndarray:
        """Solve, (n, m) to (n, m)."""
        return self.lu.solve(b, "T" if transpose else "N")


def _in_order(matrix: Any) -> Any:
    """SuperLU's factors of a matrix in a good order: a low threshold keeps the pivots on the diagonal."""
    return _splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.01, options={"SymmetricMode": True})


def _splu(matrix: Any, **options: Any) -> Any:
    with uncollected():
        from scipy.sparse.linalg import splu

    return splu(matrix, **options)


@cache
def _pardiso() -> Any:
    """A solver without a matrix; finding MKL's library takes a fifth of a second."""
    from pypardiso import PyPardisoSolver

    return PyPardisoSolver()


class Pardiso:
    """Sparse LU by MKL's PARDISO (pypardiso), on all cores, in an order of its own."""

    iterations, stalled = 0, False

    def __init__(self, matrix: Any) -> None:
        from scipy import sparse

        self.solver = copy(_pardiso())
        self.solver.pt, self.solver.iparm = np.zeros_like(self.solver.pt), np.zeros_like(self.solver.iparm)
        self.matrix = sparse.csr_array(matrix)
        self.solver.factorize(self.matrix)
        self.entries = self.solver.get_iparm(18)
        if self.solver.get_iparm(14):
            raise np.linalg.LinAlgError(f"{self.solver.get_iparm(14)} pivots vanish")

    def apply(self, b: np.ndarray, transpose: bool) -> np.ndarray:
        """Solve, (n, m) to (n, m)."""
        # The transposed matrix shares its arrays with the one that was factorised, so that its factors serve.
        return self.solver.solve(self.matrix.T if transpose else self.matrix, b)

    def __del__(self) -> None:
        if hasattr(self, "matrix") and not sys.is_finalizing():
            self.solver.free_memory(everything=True)


class Krylov(ABC):
    """BiCGSTAB; a subclass gives the preconditioner and its transpose."""

    most = 100
    entries: int

    def __init__(self, matrix: Any) -> None:
        from scipy import sparse

        self.matrices = {False: sparse.csr_array(matrix), True: sparse.csr_array(matrix.T)}
        self.preconditioners: dict[bool, Callable[[np.ndarray], np.ndarray]] = {}
        self.iterations, self.stalled = 0, False

    @abstractmethod
    def preconditioner(self, transpose: bool) -> Callable[[np.ndarray], np.ndarray]:
        """Map that approximates the inverse, or its transpose."""

    def apply(self, b: np.ndarray, transpose: bool, tolerance: float = 1e-10) -> np.ndarray:
        """Solve, (n, m) to (n, m), column by column."""
        if transpose not in self.preconditioners:
            self.preconditioners[transpose] = self.preconditioner(transpose)
        matrix, guess = self.matrices[transpose], self.preconditioners[transpose]
        x = np.zeros_like(b)
        for k in range(b.shape[1]):
            column = np.ascontiguousarray(b[:, k])
            with bar("iterative solve") as shown:
                x[:, k], steps, gain = _bicgstab(matrix, column, guess, tolerance, self.most, shown)
            self.iterations += steps
            self.stalled |= gain > 1e-6
        return x


def _bicgstab(
    a: Any, b: np.ndarray, guess: Callable[[np.ndarray], np.ndarray], tolerance: float, most: int, shown: Any
) -> tuple[np.ndarray, int, float]:
    """Best iterate of preconditioned BiCGSTAB, steps taken, and its residual relative to b.

    Source: H. van der Vorst, SIAM J. Sci. Stat. Comput. 13 (1992). Written out because scipy's
    calls threaded BLAS for every product of two vectors, which on a busy machine takes five times
    as long as all the rest; `einsum` does not.
    """

    def dot(u: np.ndarray, v: np.ndarray) -> float:
        return float(np.einsum("i,i->", u, v))

    x, r = np.zeros_like(b), b.copy()
    size = start = least = dot(b, b)
    best, goal = x, tolerance**2 * start
    shadow, p, v = r, np.zeros_like(b), np.zeros_like(b)
    rho = alpha = omega = 1.0
    step = 0
    while step < most and least > goal:
        rho, before = dot(shadow, r), rho
        if abs(rho) < 1e-10 * np.sqrt(dot(shadow, shadow) * size) or omega == 0.0:
            # Broken down, as it happens where b has one nonzero entry alone: start afresh from r.
            shadow, p, v = r, np.zeros_like(b), np.zeros_like(b)
            rho, before, alpha, omega = size, 1.0, 1.0, 1.0
        p = r + (rho / before) * (alpha / omega) * (p - omega * v)
        p_hat = guess(p)
        v = a @ p_hat
        along = dot(shadow, v)
        if along == 0.0:
            break
        alpha = rho / along
        s = r - alpha * v
        s_hat = guess(s)
        t = a @ s_hat
        tt = dot(t, t)
        omega = dot(t, s) / tt if tt else 0.0
        x = x + alpha * p_hat + omega * s_hat
        r = s - omega * t
        step += 1
        shown.update()
        size = dot(r, r)
        if not np.isfinite(size):
            break
        if size < least:
            best, least = x, size
    return best, step, float(np.sqrt(least / start)) if start else 0.0


class AMG(Krylov):
    """Ruge-Stueben multigrid as the preconditioner (pyamg sets it up)."""

    def __init__(self, matrix: Any) -> None:
        import pyamg
        from scipy import sparse

        super().__init__(matrix)
        if not matrix.diagonal().all():
            raise ValueError("zeros on the diagonal")
        hierarchy = pyamg.ruge_stuben_solver(sparse.csr_matrix(self.matrices[False]))
        *fine, coarsest = hierarchy.levels
        self.levels = [(level.A, level.P, level.R) for level in fine]
        self.coarse_inverse = np.linalg.pinv(coarsest.A.toarray())
        self.entries = sum(level.A.nnz for level in hierarchy.levels)

    def preconditioner(self, transpose: bool) -> Callable[[np.ndarray], np.ndarray]:
        """V-cycle, one Gauss-Seidel sweep down and one, backward, up.

        The cycle of the transposed matrices with the same transfers (R = P^T) is the transposed
        cycle: an adjoint solve takes as many iterations as its forward solve and no new set-up.
        """
        from pyamg.relaxation.relaxation import gauss_seidel

        levels, coarse = self.levels, self.coarse_inverse
        if transpose:
            levels = [(a.T.tocsr(), p, r) for a, p, r in levels]
            coarse = coarse.T

        def cycle(b: np.ndarray, depth: int = 0) -> np.ndarray:
            if depth == len(levels):
                return coarse @ b
            a, prolong, restrict = levels[depth]
            x = np.zeros_like(b)
            gauss_seidel(a, x, b, sweep="forward")
            x += prolong @ cycle(restrict @ (b - a @ x), depth + 1)
            gauss_seidel(a, x, b, sweep="backward")
            return x

        return cycle


class ILU(Krylov):
    """Incomplete LU as the preconditioner."""

    def __init__(self, matrix: Any) -> None:
        from scipy.sparse.linalg import spilu

        super().__init__(matrix)
        self.lu = spilu(matrix, drop_tol=1e-3, fill_factor=8, permc_spec="NATURAL")
        self.entries = self.lu.nnz

    def preconditioner(self, transpose: bool) -> Callable[[np.ndarray], np.ndarray]:
        """Triangular solves."""
        mode = "T" if transpose else "N"
        return lambda v: self.lu.solve(v, mode)


class Mixed(Krylov):
    """LU in float32 as the preconditioner, everything else in float64: two iterations unless the matrix is
    ill-conditioned, in two thirds of the memory of LU in float64 and of its time."""

    most = 10

    def __init__(self, matrix: Any) -> None:
        super().__init__(matrix)
        self.lu = _in_order(matrix.astype(np.float32))
        self.entries = self.lu.nnz

    def preconditioner(self, transpose: bool) -> Callable[[np.ndarray], np.ndarray]:
        """Triangular solves, of a right-hand side brought to the size of one: float32 ends at 1e38."""
        mode = "T" if transpose else "N"

        def guess(v: np.ndarray) -> np.ndarray:
            size = float(abs(v).max()) or 1.0
            return self.lu.solve((v / size).astype(np.float32), mode) * size

        return guess
