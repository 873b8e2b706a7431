"""Solvers of one sparse matrix, each behind the same two lines: construct, `apply`.

`Backend(matrix)` factorises a scipy csc array, or sets up a preconditioner; it raises where it
cannot. `apply(b, transpose)` solves for (n, m) right-hand sides, as well as the method does by
itself; `sparse.Factor` scales, orders, corrects residuals and changes the backend where one fails.
`entries` is the number of stored entries, `iterations` those of the last solve.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np

ITERATIVE = ("amg", "ilu")


def installed(package: str) -> bool:
    """Whether an optional package can be imported, without importing it."""
    return importlib.util.find_spec(package) is not None


class Lapack:
    """Dense LU."""

    iterations = 0

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

    iterations = 0

    def __init__(self, matrix: Any, ordered: bool) -> None:
        from scipy.sparse.linalg import splu

        if ordered:  # a low threshold keeps the pivots on the diagonal and so keeps the order
            self.lu = splu(
                matrix,
                permc_spec="NATURAL",
                diag_pivot_thresh=0.01,
                options={"SymmetricMode": True},
            )
        else:
            self.lu = splu(matrix)
        self.entries = self.lu.nnz

    def apply(self, b: np.ndarray, transpose: bool) -> np.ndarray:
        """Solve, (n, m) to (n, m)."""
        return self.lu.solve(b, "T" if transpose else "N")


class Krylov:
    """BiCGSTAB; a subclass gives the preconditioner M and its transpose."""

    tolerance, most = 1e-10, 100  # refinement does the rest: round-off stalls a single run
    entries: int

    def __init__(self, matrix: Any) -> None:
        from scipy import sparse

        self.matrices = {False: sparse.csr_array(matrix), True: sparse.csr_array(matrix.T)}
        self.preconditioners: dict[bool, Any] = {}
        self.iterations = 0

    def preconditioner(self, transpose: bool) -> Any:
        """Linear operator that approximates the inverse, or its transpose."""
        raise NotImplementedError

    def apply(self, b: np.ndarray, transpose: bool) -> np.ndarray:
        """Solve, (n, m) to (n, m), column by column."""
        from scipy.sparse.linalg import bicgstab

        if transpose not in self.preconditioners:
            self.preconditioners[transpose] = self.preconditioner(transpose)
        x = np.zeros_like(b)

        def count(_: np.ndarray) -> None:
            self.iterations += 1

        for k in range(b.shape[1]):
            if b[:, k].any():
                x[:, k] = bicgstab(
                    self.matrices[transpose],
                    b[:, k],
                    rtol=self.tolerance,
                    maxiter=self.most,
                    M=self.preconditioners[transpose],
                    callback=count,
                )[0]
        return x


class AMG(Krylov):
    """Ruge-Stueben multigrid as the preconditioner (pyamg)."""

    def __init__(self, matrix: Any) -> None:
        import pyamg
        from scipy import sparse

        super().__init__(matrix)
        if not matrix.diagonal().all():
            raise ValueError("zeros on the diagonal")
        self.hierarchy = pyamg.ruge_stuben_solver(sparse.csr_matrix(self.matrices[False]))
        self.entries = sum(level.A.nnz for level in self.hierarchy.levels)

    def preconditioner(self, transpose: bool) -> Any:
        """V-cycle; transposed, every level's matrix is and the transfers stay (R = P^T)."""
        from pyamg.multilevel import MultilevelSolver
        from pyamg.relaxation.smoothing import change_smoothers

        if not transpose:
            return self.hierarchy.aspreconditioner("V")
        levels = []
        for level in self.hierarchy.levels:
            turned = MultilevelSolver.Level()
            turned.A = level.A.T.tocsr()
            if hasattr(level, "P"):
                turned.P, turned.R = level.P, level.R
            levels.append(turned)
        mirrored = MultilevelSolver(levels, coarse_solver="pinv")
        sweep = ("gauss_seidel", {"sweep": "symmetric"})
        change_smoothers(mirrored, sweep, sweep)
        return mirrored.aspreconditioner("V")


class ILU(Krylov):
    """Incomplete LU as the preconditioner."""

    def __init__(self, matrix: Any) -> None:
        from scipy.sparse.linalg import spilu

        super().__init__(matrix)
        self.lu = spilu(matrix, drop_tol=1e-3, fill_factor=8, permc_spec="NATURAL")
        self.entries = self.lu.nnz

    def preconditioner(self, transpose: bool) -> Any:
        """Triangular solves."""
        from scipy.sparse.linalg import LinearOperator

        mode = "T" if transpose else "N"
        shape = self.matrices[False].shape
        return LinearOperator(shape, matvec=lambda v: self.lu.solve(v, mode), dtype=float)


class Pardiso:
    """MKL's sparse LU (pypardiso)."""

    iterations = 0

    def __init__(self, matrix: Any) -> None:
        import pypardiso
        from scipy import sparse

        self.matrix = sparse.csr_matrix(matrix)
        self.solver = pypardiso.PyPardisoSolver(size_limit_storage=0)
        self.solver.factorize(self.matrix)
        self.entries = int(self.solver.get_iparm(18))

    def apply(self, b: np.ndarray, transpose: bool) -> np.ndarray:
        """Solve, (n, m) to (n, m)."""
        self.solver.set_iparm(12, 2 if transpose else 0)
        return self.solver.solve(self.matrix, b)


BACKENDS: dict[str, Callable[[Any], Any]] = {
    "lapack": Lapack,
    "nested dissection": lambda matrix: SuperLU(matrix, ordered=True),
    "colamd": lambda matrix: SuperLU(matrix, ordered=False),
    "amg": AMG,
    "ilu": ILU,
    "pardiso": Pardiso,
}
