"""The first modes of an operator on several processes, by SLEPc."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.discretization.pencil.assemble import default_depth
from jsmitsm.equation.problem import Problem
from jsmitsm.modes.eigen import check_question, refuse_data, refuse_mass
from jsmitsm.modes.mass import is_operator, masses, weighted
from jsmitsm.parallel.distributed import ParallelCloud, bisected, slab_of
from jsmitsm.parallel.local import Local, OfOwn, Settings
from jsmitsm.parallel.pencil.assemble import own_rows, pencil_of_part
from jsmitsm.parallel.solving import check_asked
from jsmitsm.parallel.system import product
from jsmitsm.parallel.team import Team, collective, engine, team
from jsmitsm.runtime.arrays import ValueOrFunction
from jsmitsm.runtime.errors import SolveError
from jsmitsm.solution.arguments import Depth

# Values sought beyond those asked for, the residual that ends the search, and its longest.
MORE, SETTLED, MOST = 6, 1e-13, 500
# Values of another order that are asked for besides, since some may have changed places.
BESIDE = 2


class ParallelModes(OfOwn):
    """Modes of which every process has its own particles' part.

    Attributes
    ----------
    values : array (k,)
        Eigenvalues by their distance from what was asked for; real but for imaginary parts that no error explains.
    u : array (n, k) or (n, k, F)
        The modes at this process's particles; the mean of their square over the whole cloud is 1.
    points, numbers : array (n, D), (n,)
        Where these are, and their numbers in the whole cloud.
    residuals : array (k,)
        The largest entry of A u - lambda B mass u, relative to that of A u.
    stats : dict
        Seconds, sizes.
    """

    def __init__(self, values: np.ndarray, u: np.ndarray, residuals: np.ndarray, local: Local, stats: dict[str, Any],
                 again: Callable[[int, int], np.ndarray]):  # fmt: skip
        self.values, self.residuals, self.stats = values, residuals, stats
        self._u, self._local, self._again = u, local, again

    @property
    def u(self) -> np.ndarray:
        """The modes (n, k) or (n, k, F) at the own particles."""
        return self._u[..., 0] if self._u.shape[-1] == 1 else self._u

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        return f"ParallelModes({len(self)} of {self._local.mine.count} particles, {len(self._u)} of them here)"


@collective
def eigen(
    problem: Problem, cloud: Cloud | ParallelCloud, count: int, *, near: float = 0.0,
    mass: ValueOrFunction | None = None, order: int = 6, depth: Depth = "auto",
) -> ParallelModes:  # fmt: skip
    """Eigenvalues and modes, as ``js.eigen`` finds them, from the same pencil. Needs slepc4py.

    Parameters
    ----------
    problem : Problem
        As for ``js.eigen``; what ``jp.solve`` refuses is refused here too, and so fields that nothing fixes.
    cloud : Cloud or ParallelCloud
        As for ``jp.solve``.
    count : int
        How many values; a multiple one is returned whole.
    near, mass, order, depth : optional
        As for ``js.eigen``.

    Returns
    -------
    ParallelModes
        Values, and the modes at every process's particles; ``jp.error_estimate`` takes them. Derivatives and values
        between the particles are those of ``js.eigen`` alone.

    Raises
    ------
    ValueError
        As ``js.eigen``, on all processes.
    SolveError
        Where the values are not found.

    Examples
    --------
    ``modes = jp.eigen(drum, cloud, 6)``
    """
    us, began = team(), time.perf_counter()
    with us.phase():
        check_asked(problem, cloud, "S", order, depth, None, "auto", "auto")
        check_question(problem, count, near, "S")
        if callable(mass) and is_operator(problem, mass):
            raise ValueError("mass: an operator, a function of (u, x), is not made for several processes; use js.eigen")
        engine("slepc4py.SLEPc")
    slab = slab_of(us, cloud)
    settings = Settings("S", order, default_depth(depth, slab.dim), None, True, "loo", True)
    local = Local(us, problem, bisected(us, slab), settings)
    with us.phase():
        if not local.disc.linear:
            raise ValueError("problem: its pde or a condition is nonlinear in u, but modes are of a linear operator")
        _, massed = masses(problem, local.cloud, mass)
    massed = us.total(massed.astype(int)) > 0
    pencil = pencil_of_part(local, massed)
    with us.phase():
        refuse_data(local.disc, pencil)
        refuse_mass(pencil, massed)
        weights, _ = masses(problem, local.cloud, mass)
        stiff, inert = pencil.A.part(pencil.free, pencil.free), weighted(problem, pencil, weights)
    a, c = own_rows(local, stiff), own_rows(local, inert)
    made = time.perf_counter()
    values, vectors, residuals = _found(us, a, c, count, float(near), _together(order))
    u = np.zeros((*local.disc.held[local.halo.ids].shape, len(values)), vectors.dtype)
    u[~local.disc.held[local.halo.ids]] = _normalised(us, vectors, slab.count, local.first)
    end = time.perf_counter()
    stats = {
        "particles": local.mine.count, "own": len(local.halo.ids), "unknowns": local.size, "reach": local.halo.reach,
        "processes": us.size, "depth": local.disc.rec.depth,
        "seconds": {"local": made - began, "modes": end - made, "total": end - began},
    }  # fmt: skip

    def again(order: int, count: int) -> np.ndarray:
        """So many values by another order."""
        return eigen(problem, ParallelCloud(slab), count, near=near, mass=mass, order=order, depth=depth).values

    return ParallelModes(values, np.swapaxes(u, 1, 2), residuals, local, stats, again)


def errors(modes: ParallelModes) -> np.ndarray:
    """Estimated errors (k,) of the values: how far those of order p + 2, or of p - 2, are away; see error_estimate."""
    order, values = modes._local.settings.order, modes.values
    for other in (order + 2, order - 2):
        try:
            found = modes._again(other, min(len(values) + BESIDE, modes.stats["unknowns"]))
        except (ValueError, SolveError):  # too high or too low an order, too few particles
            continue
        away = np.abs(values[:, None] - found).min(axis=1)
        near = np.abs(values[:, None] - values) <= _together(order) * np.abs(values)[:, None]
        return np.where(near, away, 0.0).max(axis=1)
    return np.full(len(values), np.inf)


def _together(order: int) -> float:
    """Values whose relative distance is below this may be one, parted by the discretisation."""
    return float(10.0 ** -(order / 2 + 1))


def _found(
    us: Team, a: Any, c: Any, count: int, near: float, together: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Values, own parts (n, k) of vectors, and residuals, by Krylov-Schur on (A - near C)^-1 C.

    together: values whose relative distance is below this may be one, parted by the discretisation.
    """
    slepc, petsc = engine("slepc4py.SLEPc"), engine("petsc4py.PETSc")
    most = a.getSize()[0]
    if count > most:
        raise ValueError(f"count: {count} values asked for, and there are {most} unknowns")
    solver = slepc.EPS().create(us.comm)
    solver.setOperators(a, c)
    solver.setProblemType(slepc.EPS.ProblemType.GNHEP)
    solver.setDimensions(min(count + MORE, most))
    solver.setTarget(near)
    solver.setWhichEigenpairs(slepc.EPS.Which.TARGET_MAGNITUDE)
    solver.setTolerances(SETTLED, MOST)
    transform = solver.getST()
    transform.setType("sinvert")
    inner = transform.getKSP()
    inner.setType("preonly")
    inner.getPC().setType("lu")
    inner.getPC().setFactorSolverType("mumps")
    try:
        solver.solve()
        known = int(solver.getConverged())
    except petsc.Error as error:
        raise SolveError(f"the operator is singular at {near}, or beyond the solver ({error}); move near") from None
    if known < count:
        raise SolveError(f"{known} of {count} values near {near} were found; ask for fewer, or move near")
    real, imaginary = a.createVecLeft(), a.createVecLeft()
    values, vectors = np.zeros(known, complex), np.zeros((a.getLocalSize()[0], known), complex)
    for k in range(known):
        values[k] = solver.getEigenpair(k, real, imaginary)
        vectors[:, k] = real.getArray() + 1j * imaginary.getArray()
    order = np.lexsort((-values.imag, np.round(np.abs(values - near) / np.abs(values - near).max(), 13)))
    values, vectors = values[order], vectors[:, order]
    size = np.maximum(np.abs(values), np.abs(values - near))
    apart = np.abs(np.diff(values)) > together * np.maximum(size[1:], 1e-3 * size.max())
    cluster = np.concatenate([[0], np.cumsum(apart)])
    kept = int((cluster <= cluster[count - 1]).sum())
    values, vectors = values[:kept], vectors[:, :kept]
    residuals = np.array([_residual(us, a, c, value, v) for value, v in zip(values, vectors.T)])
    if (np.abs(values.imag) <= together * np.abs(values)).all():
        # The parts of a double value may come as a pair; the vector of a real one may carry any complex factor.
        second = values.imag < 0
        vectors = np.where(second, vectors.imag, vectors.real)
        values = values.real
    return values, vectors, residuals


def _residual(us: Team, a: Any, c: Any, value: complex, v: np.ndarray) -> float:
    left = product(a, v.real.copy()) + 1j * product(a, v.imag.copy())
    right = product(c, v.real.copy()) + 1j * product(c, v.imag.copy())
    size = us.most(float(np.abs(left).max(initial=0.0))) or 1.0
    return us.most(float(np.abs(left - value * right).max(initial=0.0))) / size


def _normalised(us: Team, vectors: np.ndarray, count: int, first: int) -> np.ndarray:
    """Vectors whose square has the mean 1 over all particles, their largest entry positive."""
    norm = np.sqrt(us.total((np.abs(vectors) ** 2).sum(axis=0)) / count)
    largest = np.max(us.gather(np.abs(vectors).max(axis=0, initial=0.0)), axis=0)
    # Of entries that are equal but for rounding the first, and of these that of the first process.
    entries = []
    for v, most in zip(vectors.T, largest):
        at = np.flatnonzero(np.abs(v) > (1.0 - 1e-6) * most)
        entries.append((first + at[0], v[at[0]]) if len(at) else (np.inf, 0.0))
    tops = [min(some)[1] for some in zip(*us.gather(entries))]
    return vectors / (norm * np.array([top / abs(top) for top in tops]))
