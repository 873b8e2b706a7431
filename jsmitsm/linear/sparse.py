"""Factorisations of sparse matrices on the host, and solves with them.

Everything here is numpy and scipy on concrete arrays; `linsolve` makes it differentiable. A matrix
is first scaled by powers of two, so that neither the units of an equation nor those of an unknown
matter, and put in nested-dissection order. What a backend then returns is only a first guess: the
residual is corrected (iterative refinement), its size decides whether the backend is believed, and
if not the next one takes over and a message says so.
"""

from __future__ import annotations

import threading
import time
from functools import partial
from typing import Any

import numpy as np

from jsmitsm.linear.backends import SuperLU
from jsmitsm.linear.conditioning import inverse_norm, near_null_vector, to_one
from jsmitsm.linear.ordering import nested_dissection, spatial_order
from jsmitsm.linear.solver_choice import BACKENDS, DENSE_MAX, ITERATIVE, choose_backends
from jsmitsm.runtime.collector import uncollected
from jsmitsm.runtime.errors import SingularMatrix
from jsmitsm.runtime.interrupts import interruptible
from jsmitsm.runtime.progress import bar

BACKWARD_ERROR = 1e-9  # what is accepted of a direct solver
BACKWARD_ERROR_ITERATIVE = 1e-12  # of an iterative one, which reaches round-off unless it stalls
SINGULAR = 1e15  # condition number (scaled) above which no digit of a solution means anything
# Backends that live on what is left of a matrix's symmetry, and eliminate nothing.
MULTIGRID = ("amg", "device amg")
# Unknowns from which a factorisation may take seconds: a thread costs less than a millisecond.
LONG = 10_000
# Right-hand sides below this lose digits as they vanish; they are lifted by this power of two.
_HARDLY, _LIFT = 1e-250, 2.0**600
COUNTS = {"factorisations": 0}


class Factor:
    """A matrix ready to be solved with, as often as wanted, transposed or not.

    Args:
      data, rows, cols: (nnz,) arrays, entries and their positions; entries at one place add up.
      n: number of unknowns.
      points: (n, D) coordinates of the unknowns or None; NaN where an unknown has none. They serve
        the order of elimination alone.
      solver: "dense", "sparse" (direct), "iterative", or "auto", which decides by size.
      elliptic: whether multigrid can be expected to work, for "auto".
      refine: steps of iterative refinement done in any case; more follow where they are needed.
      order: `order` of a factor with the same positions, to save finding it again.

    Attributes:
      info: dict of what was done: "backend", "unknowns", "entries", "factor_entries",
        "seconds" ("ordering", "factorisation", "solve": the last one), "iterations" and "residual"
        of the last solve (the normwise backward error), "order_kept" (whether `order` was given),
        "messages" (fallbacks, in words).

    Raises:
      SingularMatrix: entries that are not finite, empty rows or columns, a singular matrix.
      SolveError: factors that would not fit in memory, before any of it is taken.

    Example:
      >>> import numpy as np
      >>> f = Factor(np.array([2.0, 1.0, 4.0]), np.array([0, 0, 1]), np.array([0, 1, 1]), 2)
      >>> f.solve(np.array([4.0, 8.0])).tolist()
      [1.0, 2.0]
      >>> f.solve(np.array([4.0, 8.0]), transpose=True).tolist()
      [2.0, 1.5]
    """

    def __init__(
        self,
        data: Any,
        rows: Any,
        cols: Any,
        n: int,
        points: np.ndarray | None = None,
        solver: str = "auto",
        elliptic: bool = True,
        refine: int = 1,
        order: np.ndarray | None = None,
    ) -> None:
        with uncollected():
            from scipy import sparse

        data = np.asarray(data, dtype=float)
        rows, cols = np.asarray(rows), np.asarray(cols)
        self.n, self.refine = n, refine
        self._lu: Any = None
        self._trusted = {False: False, True: False}
        self._lock = threading.RLock()  # a backend may change during a solve
        self.messages: list[str] = []
        self.info: dict[str, Any] = {
            "unknowns": n,
            "entries": len(data),
            "seconds": {"ordering": 0.0, "factorisation": 0.0, "solve": 0.0},
            "iterations": 0,
            "residual": 0.0,
            "order_kept": order is not None,
            "messages": self.messages,
        }
        self._backends = choose_backends(n, len(data), points, solver, elliptic)
        rows_only = self._backends[0] in (*MULTIGRID, "ilu")
        self.row_scale, self.col_scale = _scales(data, rows, cols, n, columns=not rows_only)
        scaled = data * self.row_scale[rows] * self.col_scale[cols]
        started = time.perf_counter()
        self.order, self._points = order, points
        if order is None and points is not None and n > DENSE_MAX and self._backends[0] != "pardiso":
            multigrid = self._backends[0] in MULTIGRID
            self.order = spatial_order(points) if multigrid else nested_dissection(rows, cols, np.asarray(points))
        if self.order is not None:
            place = np.empty(n, np.int32)
            place[self.order] = np.arange(n, dtype=np.int32)
            rows, cols = place[rows], place[cols]
        self.info["seconds"]["ordering"] = time.perf_counter() - started
        self.matrix = sparse.csc_array((scaled, (rows, cols)), shape=(n, n))
        if n:  # nothing is to be solved where every value is known
            size = abs(self.matrix.data)
            by_row = np.bincount(self.matrix.indices, size, n)
            by_column = np.add.reduceat(size, self.matrix.indptr[:-1])  # no column is empty
            self._norms = {False: float(by_row.max()), True: float(by_column.max())}
            self._factorise()

    @property
    def nbytes(self) -> int:
        """Bytes held, roughly."""
        return 60 * self.matrix.nnz + 14 * int(self.info.get("factor_entries", 0))

    def solve(self, b: Any, transpose: bool = False) -> np.ndarray:
        """Solution of A x = b, or of A^T x = b: (n,) or (n, m), like `b`.

        A column of `b` that is not finite gives a column of NaN. Raises SingularMatrix when no
        backend reaches an acceptable residual.
        """
        started = time.perf_counter()
        b = np.asarray(b, dtype=float)
        if not b.size:
            return b.copy()
        wide = b.reshape(self.n, -1)
        finite = np.isfinite(wide).all(axis=0)
        wide = wide if finite.all() else np.where(finite, wide, 0.0)
        before, after = self.row_scale, self.col_scale
        if transpose:
            before, after = after, before
        # Of what is hardly a number any more no residual is small: it is solved for as a multiple of itself.
        lift = np.where(np.abs(wide).max(axis=0, initial=0.0) < _HARDLY, _LIFT, 1.0)
        rhs = before[:, None] * (lift * wide)
        with self._lock:
            x = self._solve_scaled(rhs, transpose)
        x *= after[:, None] / lift
        x[:, ~finite] = np.nan
        self.info["seconds"]["solve"] = time.perf_counter() - started
        return x.reshape(b.shape)

    def plain(self, b: np.ndarray, transpose: bool = False) -> np.ndarray:
        """``solve`` for one of many finite right-hand sides (n,) or (n, m): residuals are looked at of the first alone.

        A direct solver that has solved one backward stably solves all; iterative ones are looked at every time.
        """
        if not self._trusted[transpose] or self._backends[0] in ITERATIVE:
            x = self.solve(b, transpose)
            self._trusted[transpose] = bool(b.any())
            return x
        before, after = (self.col_scale, self.row_scale) if transpose else (self.row_scale, self.col_scale)
        right = before[:, None] * b.reshape(self.n, -1)
        x = self._lu.apply(right if self.order is None else right[self.order], transpose)
        return (after[:, None] * self._in_callers_order(x)).reshape(b.shape)

    def condition(self) -> float:
        """Condition number in the 1-norm, of the matrix with rows and columns scaled to about one.

        The scaling takes out the units of equations and unknowns, so the number says how many digits
        are lost in a solve, whatever they are.

        Example:
          >>> index = np.arange(2)
          >>> Factor(np.array([1.0, 2.0**-20]), index, index, 2).condition()
          1.0
        """
        if not self.n:
            return 1.0
        krylov = self._backends[0] in ITERATIVE  # two digits of the number are enough
        apply = partial(self._lu.apply, tolerance=1e-6) if krylov else self._lu.apply
        return self._norms[True] * inverse_norm(apply, self.n)

    def near_null_vector(self) -> np.ndarray:
        """Unit vector (n,) the scaled matrix maps nearest to zero.

        Its largest entries name the unknowns a (nearly) singular matrix leaves undetermined.

        Example:
          >>> f = Factor(np.array([1, 1, 1, 1, 1.001]), [0, 1, 1, 2, 2], [0, 1, 2, 1, 2], 3)
          >>> np.round(abs(f.near_null_vector()), 3).tolist()
          [0.0, 0.707, 0.707]
        """
        return self._in_callers_order(near_null_vector(self._lu.apply, self.n))

    def _in_callers_order(self, x: np.ndarray) -> np.ndarray:
        """Rows in the order of elimination put back at their places."""
        if self.order is None:
            return x
        out = np.empty_like(x)
        out[self.order] = x
        return out

    def _solve_scaled(self, b: np.ndarray, transpose: bool) -> np.ndarray:
        """Solve with the scaled matrix; change the backend, and with it the order, where one fails."""
        while True:
            self._lu.iterations, self._lu.stalled = 0, False
            x, error = self._refined(b if self.order is None else b[self.order], transpose)
            self.info.update(residual=error, iterations=self._lu.iterations)
            backend, stalled = self._backends[0], self._lu.stalled
            strict = backend in ITERATIVE and self.refine
            small = error <= (BACKWARD_ERROR_ITERATIVE if strict else BACKWARD_ERROR)
            if small and not stalled:
                return self._in_callers_order(x)
            told = f"{'stalled at' if stalled else 'left'} a residual of {error:.1e}"
            if self._give_way(told):
                continue
            if small:
                self.messages.append(f"{backend} {told}; a direct solver needs too much memory")
                return self._in_callers_order(x)
            raise SingularMatrix(
                f"the linear system cannot be solved: {backend} {told} after refinement",
                _largest(self.near_null_vector()),
            )

    def _give_way(self, told: str) -> bool:
        """Go on to the next backend, if there is one."""
        if len(self._backends) == 1:
            return False
        backend = self._backends.pop(0)
        self.messages.append(f"{backend} {told}; {self._backends[0]} took over")
        if backend in MULTIGRID and self.order is not None and self._points is not None:
            self._dissect()
        self._factorise()
        return True

    def _dissect(self) -> None:
        """Put the matrix in the order in which it may be eliminated."""
        assert self.order is not None
        entries = self.matrix.tocoo()
        order = nested_dissection(entries.coords[0], entries.coords[1], np.asarray(self._points)[self.order])
        self.order, self.matrix = self.order[order], self.matrix[order][:, order]

    def _refined(self, b: np.ndarray, transpose: bool) -> tuple[np.ndarray, float]:
        """Solution with its residual corrected until that no longer helps, and backward error."""
        a = self.matrix.T if transpose else self.matrix
        x = self._lu.apply(b, transpose)
        residual = b - a @ x
        error = self._backward_error(residual, x, b, transpose)
        krylov = self._backends[0] in ITERATIVE
        # An iterative method, which a single run leaves at 1e-10, is taken down to round-off; a
        # direct one starts from there.
        goal, most = (5e-16, self.refine + 5) if krylov else (1e-14, self.refine + 2)
        for step in range(most if self.refine else 0):
            if (error <= goal and (krylov or step >= self.refine)) or not np.isfinite(error):
                break
            better = x + self._lu.apply(residual, transpose)
            residual_new = b - a @ better
            error_new = self._backward_error(residual_new, better, b, transpose)
            if not error_new <= error:
                break
            stalled = error_new > 0.5 * error and step >= self.refine - 1
            x, residual, error = better, residual_new, error_new
            if stalled:
                break
        return x, error if np.isfinite(error) else np.inf

    def _backward_error(self, residual: np.ndarray, x: np.ndarray, b: np.ndarray, transpose: bool) -> float:
        """Largest over the columns of |r| / (|A| |x| + |b|), maximum norms."""
        if not residual.size:
            return 0.0
        size = self._norms[transpose] * abs(x).max(axis=0) + abs(b).max(axis=0)
        return float((abs(residual).max(axis=0) / np.where(size == 0.0, 1.0, size)).max())

    def _factorise(self) -> None:
        """Make the first of the remaining backends; step on where it refuses."""
        started = time.perf_counter()
        backend = self._backends[0]
        COUNTS["factorisations"] += 1
        try:
            with bar(f"{backend} on {self.n} unknowns"):
                make = partial(BACKENDS[backend], self.matrix)
                self._lu = interruptible(make) if self.n > LONG else make()
        except (RuntimeError, ValueError, np.linalg.LinAlgError) as error:
            if self._give_way(f"failed ({error})"):
                return
            raise SingularMatrix(f"the matrix is singular ({backend}: {error})", self._dependent_unknowns()) from error
        self.info.update(backend=backend, factor_entries=self._lu.entries)
        self.info["seconds"]["factorisation"] += time.perf_counter() - started
        self._refuse_singular()

    def _refuse_singular(self) -> None:
        """Raise where one random right-hand side, or else the condition number, betrays it."""
        probe = np.random.default_rng(0).standard_normal((self.n, 1))
        krylov = self._backends[0] in ITERATIVE
        x = self._lu.apply(probe, False, tolerance=1e-6) if krylov else self._lu.apply(probe, False)
        growth = abs(x).max() * self._norms[False] / abs(probe).max()
        small = growth < 1e-3 * SINGULAR / np.sqrt(self.n)
        if krylov:
            if self._lu.stalled or not small:  # only a direct solver can tell why
                self._give_way("stalled" if self._lu.stalled else "met a nearly singular matrix")
            return
        if small:
            return
        condition = self.condition() if np.isfinite(growth) else np.inf
        if condition < SINGULAR or (np.isinf(condition) and self._give_way("broke down")):
            return
        raise SingularMatrix(
            f"the matrix is singular to working precision (condition {condition:.1e})",
            _largest(self.near_null_vector()),
        )

    def _dependent_unknowns(self) -> list[int]:
        """Unknowns at fault where a factorisation met a zero pivot."""
        from scipy import sparse
        from scipy.sparse.csgraph import maximum_bipartite_matching

        pattern = sparse.csr_matrix(self.matrix)
        pattern.eliminate_zeros()
        unmatched = np.flatnonzero(maximum_bipartite_matching(pattern, perm_type="column") < 0)
        if len(unmatched):
            return (unmatched if self.order is None else self.order[unmatched]).tolist()
        try:  # shifted a little, the matrix has a factor and its null vector still dominates
            shifted = self.matrix + 1e-11 * sparse.eye_array(self.n, format="csc")
            backend = SuperLU(sparse.csc_array(shifted), ordered=False)
        except RuntimeError:
            return []
        return _largest(self._in_callers_order(near_null_vector(backend.apply, self.n)))


def _scales(
    data: np.ndarray, rows: np.ndarray, cols: np.ndarray, n: int, columns: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Powers of two that bring the largest entry of every row, then column, to about one.

    Lines without a diagonal entry, as those of multipliers, come last: a row of them says nothing of the units that
    its unknowns have in the others.
    """
    size = abs(data)
    if not np.isfinite(size).all():
        bad = np.unique(rows[~np.isfinite(size)])
        raise SingularMatrix("the matrix has entries that are not finite", bad)
    at = rows == cols
    diagonal = np.bincount(rows[at], data[at], n)
    lined = diagonal == 0
    # Equal signs on the diagonal: what the smoothers of multigrid expect.
    sign = np.where(diagonal < 0, -1.0, 1.0)
    scales, lines = (np.ones(n), np.ones(n)), (rows, cols)
    faults = "equations without any coefficient", "unknowns that no equation contains"
    inner = ~(lined[rows] | lined[cols]) if lined.any() else slice(None)
    for some, entries in ((~lined, inner), (lined, slice(None))):
        for k in (0, 1) if some.any() else ():
            largest = np.zeros(n)
            np.maximum.at(largest, lines[k][entries], (size * scales[1 - k][lines[1 - k]])[entries])
            if not largest[some].all():
                raise SingularMatrix(faults[k], np.flatnonzero(some & (largest == 0)))
            if columns or k == 0:
                scales[k][some] = to_one(largest[some])
    return sign * scales[0], scales[1]


def _largest(vector: np.ndarray) -> list[int]:
    """The places of the largest entries, the largest first; none where one is not finite."""
    size = abs(vector)
    if not np.isfinite(size).all() or not size.any():
        return []
    worst = np.argsort(-size, kind="stable")
    return worst[size[worst] >= 0.1 * size.max()].tolist()
