"""The global system under PETSc: rows of every process in one matrix, solved by multigrid or directly, and checked.

A solver's answer is a first guess: its residual is corrected until it no longer falls, and what is left of it decides.
The transpose is assembled: BoomerAMG's own transposed solve is wrong without a word.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jsmitsm.parallel.team import Team, engine, give_back
from jsmitsm.runtime.errors import SolveError

# Solvers by name. Hypre is tuned for second-order operators on scattered particles, see docs/parallel.md.
SOLVERS = ("auto", "hypre", "gamg", "mumps")
_HYPRE = {
    "coarsen_type": "HMIS", "interp_type": "ext+i", "P_max": 4, "strong_threshold": 0.25,
    "relax_type_all": "SOR/Jacobi",
}  # fmt: skip
# Weights below this part of their particle's own do not hold particles together on coarser levels: iterations grow by
# one or less for ten times the particles, and by three where all weights do.
_GAMG_THRESHOLD = 0.01
# A first solve reduces the residual to this part; each correction does so again.
REDUCED, MOST_STEPS, CORRECTIONS = 1e-10, 200, 5
# A normwise backward error above this is no solution. Below the second nothing is left to correct.
BACKWARD_ERROR, ROUND_OFF = 1e-12, 2e-16


def ways(solver: str, elliptic: bool) -> tuple[str, ...]:
    """The solvers that are tried in turn, of those that this PETSc was built with; GAMG is its own."""
    has = engine("petsc4py.PETSc").Sys.hasExternalPackage
    wanted = (solver,) if solver != "auto" else ("hypre", "gamg", "mumps") if elliptic else ("mumps",)
    found = tuple(way for way in wanted if way == "gamg" or has(way))
    if not found:
        raise ValueError(f"solver: {solver!r} needs {wanted[0]}, which this PETSc has not; see docs/parallel.md")
    return found


class Block(NamedTuple):
    """Some own rows: their numbers (m,) among the own, and their entries (m, size), columns numbered over all."""

    rows: np.ndarray
    entries: Any


def distributed(team: Team, n: int, blocks: list[Block]) -> Any:
    """The matrix of PETSc's that has the blocks' rows, n of them here; each block is let go once it stands there."""
    petsc = engine("petsc4py.PETSc")
    counts = team.gather(n)
    first, size = sum(counts[: team.rank]), sum(counts)
    index = petsc.IntType
    if size > np.iinfo(index).max:
        raise SolveError(f"{size} unknowns need a PETSc with 64-bit indices (libpetsc64-real-dev)")
    here, away = np.zeros(n, index), np.zeros(n, index)
    for rows, entries in blocks:
        near = (entries.indices >= first) & (entries.indices < first + n)
        upto = np.concatenate([[0], np.cumsum(near)])[entries.indptr]
        here[rows] += np.diff(upto).astype(index)
        away[rows] += (np.diff(entries.indptr) - np.diff(upto)).astype(index)
    matrix = petsc.Mat().create(comm=team.comm)
    matrix.setSizes(((n, size), (n, size)))
    matrix.setType("aij")
    matrix.setPreallocationNNZ((here, away))
    while blocks:
        rows, entries = blocks.pop()
        places = (entries.indptr.astype(index), entries.indices.astype(index), entries.data)
        matrix.setValuesIJV(*places, addv=True, rowmap=(first + rows).astype(index))
        del rows, entries, places
        give_back()
    matrix.assemble()
    return matrix


def product(matrix: Any, x: np.ndarray) -> np.ndarray:
    """The own part (n,) of A x, from that of x."""
    vector, out = matrix.createVecRight(), matrix.createVecLeft()
    vector.setArray(x)
    matrix.mult(vector, out)
    return out.getArray().copy()


def _add_turned_places(petsc: Any, matrix: Any) -> None:
    """Zeros where the transpose has entries: GAMG adds the two, in place where these are the same."""
    turned = matrix.transpose(petsc.Mat())
    turned.zeroEntries()
    matrix.axpy(1.0, turned, structure=petsc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    turned.destroy()
    matrix.setOption(petsc.Mat.Option.STRUCTURALLY_SYMMETRIC, True)
    give_back()


class System:
    """The rows of all processes, unknowns numbered over all.

    info: the solver, the iterations of the last solve (to its first guess, and in all), and its backward error.
    """

    def __init__(self, team: Team, matrix: Any, solver: str, elliptic: bool):
        self.team, self.elliptic = team, elliptic
        self.petsc = engine("petsc4py.PETSc")
        self.n, self.size = matrix.getLocalSize()[0], matrix.getSize()[0]
        self.matrix = matrix
        self.turned: Any = None
        self.ways = ways(solver, elliptic)
        self._solvers: dict[tuple[str, bool], Any] = {}
        self.info: dict[str, Any] = {"unknowns": self.size, "tried": []}

    def solve(self, b: np.ndarray, transpose: bool = False) -> np.ndarray:
        """The own part (n,) of the solution of A x = b, or of A^T x = b."""
        x, found = self.answer(b, transpose, ROUND_OFF)
        self.info.update(found | {"tried": self.info["tried"] + found.get("tried", [])})
        return x

    def answer(
        self, b: np.ndarray, transpose: bool, enough: float, within: float = BACKWARD_ERROR
    ) -> tuple[np.ndarray, dict[str, Any]]:  # fmt: skip
        """The same, and what was done: corrected until a backward error is enough, accepted within another."""
        matrix, tried = self.matrix, []
        if transpose:
            self.turned = matrix = self.turned or self.matrix.transpose(self.petsc.Mat())
        if not self.team.most(float(np.abs(b).max(initial=0.0))):
            return np.zeros(self.n), {}
        for way in self.ways:
            x, error, steps = self._refined(way, matrix, b, transpose, enough)
            first = steps[0] if steps else 0
            tried.append((way, first, error))
            if error <= within:
                return x, {"solver": way, "iterations": first, "in_all": sum(steps), "residual": error, "tried": tried}
        raise SolveError(
            f"{' and '.join(self.ways)} left a backward error of {error:.1e} of the global system, which is singular "
            "or beyond this solver; is a condition missing, or the operator at a resonance? Try solver=\"mumps\""
        )

    def times(self, x: np.ndarray) -> np.ndarray:
        """The own part (n,) of A x."""
        return product(self.matrix, x)

    def _refined(
        self, way: str, matrix: Any, b: np.ndarray, transpose: bool, enough: float
    ) -> tuple[np.ndarray, float, list[int]]:  # fmt: skip
        """The solution of one solver, its backward error, and the iterations of the first solve and each correction."""
        right, x, step, residual = (matrix.createVecLeft() for _ in range(4))
        right.setArray(b)
        largest = right.norm(self.petsc.NormType.NORM_INFINITY)
        size = matrix.norm(self.petsc.NormType.NORM_INFINITY)
        right.copy(residual)
        best, kept = np.inf, np.zeros(self.n)
        steps: list[int] = []
        try:
            solver = self._solver(way, matrix, transpose)
            for _ in range(CORRECTIONS):
                solver.solve(residual, step)
                steps.append(int(solver.getIterationNumber()))
                x.axpy(1.0, step)
                matrix.mult(x, residual)
                residual.aypx(-1.0, right)
                grown = x.norm(self.petsc.NormType.NORM_INFINITY)
                error = residual.norm(self.petsc.NormType.NORM_INFINITY) / (size * grown + largest)
                if not np.isfinite(error) or error >= 0.5 * best:
                    if error < best:
                        best, kept = error, x.getArray().copy()
                    break
                best, kept = error, x.getArray().copy()
                if best <= enough:
                    break
        except self.petsc.Error:
            pass
        return kept, float(best), steps

    def _solver(self, way: str, matrix: Any, transpose: bool) -> Any:
        """A solver of PETSc's, kept for the next right-hand side."""
        found = self._solvers.get((way, transpose))
        if found is None:
            prefix, options = f"jsmitsm_{way}_", self.petsc.Options()
            found = self.petsc.KSP().create(self.team.comm)
            found.setOptionsPrefix(prefix)
            if way == "gamg":
                _add_turned_places(self.petsc, matrix)
            found.setOperators(matrix)
            found.setTolerances(rtol=REDUCED, atol=0.0, max_it=MOST_STEPS)
            if way == "mumps":
                found.setType("preonly")
                found.getPC().setType("lu")
                found.getPC().setFactorSolverType("mumps")
            else:
                found.setType("bcgs")
                found.getPC().setType(way)
            if way == "hypre":
                found.getPC().setHYPREType("boomeramg")
                for name, value in _HYPRE.items():
                    options[f"{prefix}pc_hypre_boomeramg_{name}"] = value
            if way == "gamg":
                options[f"{prefix}pc_gamg_threshold"] = _GAMG_THRESHOLD
                # The square of the weights would be three times as large as these.
                options[f"{prefix}pc_gamg_aggressive_square_graph"] = False
            found.setFromOptions()
            found.setErrorIfNotConverged(False)
            self._solvers[way, transpose] = found
        return found
