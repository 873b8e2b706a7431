"""Error estimate by defect correction, and reuse of what a new right-hand side leaves valid."""

from __future__ import annotations

from copy import copy
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm import discretize as dz
from jsmitsm.clouds import Cloud
from jsmitsm.discretize import Discretization, Numbers
from jsmitsm.kernels import Kernel
from jsmitsm.neighbours import Stencils
from jsmitsm.problem import Problem
from jsmitsm.progress import bar
from jsmitsm.solution import Recipe, Solution
from jsmitsm.solve import Fit, check, discretized
from jsmitsm.system import Run
from jsmitsm.taylor import HIGHEST, multi_indices
from jsmitsm.tracers import concrete, is_traced


@bar("error estimate")
def error_estimate(solution: Solution) -> Any:
    """Estimated error |u - u_exact| of every particle, (N,) or (N, F).

    The defect of the solution in rows of order p + 2, taken through the inverse of its own
    matrix: e = A_p^-1 D (b_{p+2} - A_{p+2} u_p). D brings the rows of the two orders to one scale,
    that of the source in them. A least-squares solution is compared with that of order p + 2: its
    rows have no common scale. Held values have no error; where p + 2 is no better than p (no
    smoothness, or round-off) the estimate says little.
    """
    fit: Fit = solution._fit
    if fit is None:
        raise ValueError("error_estimate: this solution was pickled without its problem; ask before pickling")
    low = fit.discretization()
    if fit.recipe.formulation == "lsq":
        return _against_higher(fit, low, solution._values)
    run = Run(low, fit.problem, "auto", True, False, "loo")
    nums = dz.numbers(low, fit.problem, fit.taylor)
    classes, rows = dz.all_rows(low, nums)
    high, high_nums = _higher(fit, low)
    high_rows = Run(high, fit.problem, "auto", True, True, "loo").local_rows(high_nums)
    defect = _per_value(high, *high_rows, high_nums, solution._values)
    own = _per_value(low, classes, rows, nums, solution._values)
    free = np.flatnonzero(~low.held.reshape(-1))
    ratio = own[1].reshape(-1)[free] / defect[1].reshape(-1)[free]
    xp = jnp if is_traced(ratio) else np
    ratio = xp.where(xp.isfinite(ratio) & (ratio != 0), ratio, 1.0)
    data, r, c = dz.matrix(low, classes, rows)
    x, _ = run.solved(data, r, c, ratio * defect[0].reshape(-1)[free], balanced=False)
    zero = np.zeros(low.held.size)
    error: Any = jnp.asarray(zero).at[free].set(x) if is_traced(x) else _put(zero, free, x)
    error = abs(error).reshape(low.held.shape)
    return error[:, 0] if low.rec.fields == 1 else error


def _against_higher(fit: Fit, low: Discretization, values: Any) -> Any:
    """The distance to the least-squares solution of order p + 2, (N,) or (N, F)."""
    high, nums = _higher(fit, low)
    reference, _ = Run(high, fit.problem, "auto", True, False, "lsq").step(nums)
    error = abs(reference - values)
    return error[:, 0] if low.rec.fields == 1 else error


def _put(array: np.ndarray, at: np.ndarray, value: Any) -> np.ndarray:
    array[at] = value
    return array


def _higher(fit: Fit, low: Discretization) -> tuple[Discretization, Numbers]:
    """The same problem with method S of order p + 2 on its own stencils."""
    order = fit.recipe.order + 2
    if order > HIGHEST:
        raise ValueError(
            f"error_estimate: needs expansions of order p + 2 = {order}, and {HIGHEST} is the highest; solve at order "
            f"{HIGHEST - 2} or below, or compare with the solution on a finer cloud"
        )
    host = concrete(fit.cloud.points)
    if host is None:
        raise ValueError(
            "error_estimate: the points are traced by a JAX transform, and the wider stencils it needs are found on "
            "the host; ask for it outside the transform"
        )
    high = discretized(fit.problem, Cloud(np.asarray(host), low.cloud.groups, low.cloud.normals), "S", order)
    high.cloud = fit.cloud
    taylor = fit.taylor
    if taylor is not None:
        more = len(multi_indices(low.rec.dim, order)) - taylor.shape[2]
        taylor = (jnp if is_traced(taylor) else np).pad(taylor, ((0, 0), (0, 0), (0, more)))
    return high, dz.numbers(high, fit.problem, taylor)


def _per_value(disc: Discretization, classes: Any, rows: Any, nums: Numbers, values: Any) -> tuple[Any, Any]:
    """The residual b - A u of every row, and the weight of the source in it, both (N, F)."""
    traced = is_traced(rows, values)
    xp = jnp if traced else np
    b = dz.right_side(disc, nums, classes, rows)
    data, r, c = dz.matrix(disc, classes, rows)
    free = np.flatnonzero(~disc.held.reshape(-1))
    u = xp.asarray(values).reshape(-1)[free]
    au = xp.zeros(len(free)).at[r].add(data * u[c]) if traced else np.bincount(r, data * u[c], len(free))
    residual, weight = xp.zeros(disc.held.size), xp.ones(disc.held.size)
    first = np.array(disc.rec.equation_rows)
    parts = [_strongest(xp.asarray(row.source)[:, :, first], xp) for row in rows]
    ids = np.concatenate([cls.ids for cls in classes])
    strength = xp.concatenate(parts)
    if traced:
        residual = residual.at[free].set(b - au)
        return residual.reshape(disc.held.shape), weight.reshape(disc.held.shape).at[ids].set(strength)
    residual[free] = b - au
    weight = weight.reshape(disc.held.shape)
    weight[ids] = strength
    return residual.reshape(disc.held.shape), weight


def _strongest(weights: Any, xp: Any) -> Any:
    """Of each row's weights of the sources (n, F, E), the largest in size: (n, F)."""
    place = xp.argmax(xp.abs(weights), axis=2)
    return xp.take_along_axis(weights, place[..., None], axis=2)[..., 0]


class Factorization:
    """A problem ready to be solved again; made by :func:`factorize`, which has an example.

    ``solve(problem)`` keeps the neighbours, the rows and the factors as long as only the source and
    the values in the conditions changed, and makes anew what else did.
    """

    def __init__(self, disc: Discretization, problem: Problem, solver: str, repair: bool, formulation: str):
        self._disc, self._options = disc, (solver, repair, formulation)
        problem = disc.problem
        self._run = Run(disc, problem, solver, True, repair, formulation)
        self._nums = dz.numbers(disc, problem)
        self._parts: list[Any] = []  # of the least-squares form
        data, rows, cols, self._right = self._run.assembled(self._nums, self._parts)
        self._matrix = data, rows, cols
        self._factor: Any = None  # kept as long as this is, whatever else is solved

    @bar("solve")
    def solve(self, problem: Problem) -> Solution:
        """The solution of a problem with the same operator; source and boundary values may differ.

        Raises ValueError for another kind of operator or conditions, SolveError as :func:`jsmitsm.solve` does.
        """
        old = self._disc
        method, order, kernel = old.scheme.method, old.rec.order, old.kernel
        check(problem, old.cloud, method, order, kernel, None)
        disc = dz.discretize(problem, old.cloud, method, order, kernel, Stencils(dz.table(old), None), old.basis_terms)
        if disc.scheme != old.scheme or not np.array_equal(disc.held, old.held):
            raise ValueError(
                "problem: its operator or the kind of its conditions differs from the one that was factorised; "
                "call js.factorize again"
            )
        problem = disc.problem
        nums = dz.numbers(disc, problem)
        same = _same(nums.jac, self._nums.jac) and _same(nums.own, self._nums.own) and _same(nums.data, self._nums.data)
        if not same or disc.scheme.method in ("I", "II"):
            made = Factorization(disc, problem, *self._options)
            return made._finish(problem, made._nums, made._right)
        return self._finish(problem, nums, self._right_side(nums))

    def _right_side(self, nums: Numbers) -> Any:
        if self._run.formulation == "lsq":
            return dz.least_squares_right_side(self._disc, nums, self._parts)
        assert self._run.rows is not None
        return dz.right_side(self._disc, nums, *self._run.rows)

    def _finish(self, problem: Problem, nums: Numbers, right: Any) -> Solution:
        disc = self._disc
        run = copy(self._run)  # the solution's own: what it says of itself must not change with the next
        run.problem, run.messages, run.against = problem, list(run.messages), list(run.against)
        x, good = run.solved(*self._matrix, right)
        if self._factor is None and not is_traced(self._matrix, x):
            self._factor = run.factor_of(*self._matrix)
        values = dz.with_held(disc, nums, x)
        traced = is_traced(values)
        if not traced:
            run.nums, run.values = nums, np.asarray(values)
        recipe = Recipe(disc.scheme.method, disc.rec.order, disc.basis_terms, run.formulation, problem.fields)
        fit = Fit(problem, disc.cloud, disc.kernel, dz.table(disc), None, recipe)
        fine = jnp.isfinite(values).all() if traced else good
        return Solution(values, disc.cloud, recipe, fit, fine, 1, run.stats(), report=None if traced else run)

    def __reduce__(self):
        raise TypeError(
            "a Factorization is not pickled, nor copied: keep the problem and the cloud, and call js.factorize again"
        )

    def __repr__(self) -> str:
        return f"Factorization({int((~self._disc.held).sum())} unknowns, method={self._disc.scheme.method!r})"


def _same(x: Any, y: Any) -> bool:
    return np.shape(x) == np.shape(y) and not is_traced(x, y) and bool(np.array_equal(np.asarray(x), np.asarray(y)))


@bar("factorize")
def factorize(
    problem: Problem, cloud: Cloud, *, method: str = "S", order: int = 4, kernel: Kernel | None = None,
    stencils: Stencils | None = None, basis_terms: int | None = None, formulation: str = "auto", solver: str = "auto",
) -> Factorization:  # fmt: skip
    """Prepare a linear problem for many right-hand sides.

    Returns an object whose ``solve(problem)`` reuses everything that a change of the source or of
    the values in the conditions leaves valid: neighbours, moment systems, ordering and factors.

    ``method``, ``order``, ``kernel``, ``stencils``, ``basis_terms``, ``formulation`` and ``solver`` as for
    :func:`jsmitsm.solve`.
    Raises ValueError for a nonlinear problem: its matrix changes in every step.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> cloud = js.interval(0.0, 1.0, 11)
    >>> def heated(q):
    ...     ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    ...     return js.Problem(lambda u, x: js.laplacian(u)(x) + q, ends)
    >>> ready = js.factorize(heated(1.0), cloud)
    >>> round(float(ready.solve(heated(8.0)).u[5]), 10)
    1.0
    """
    disc = discretized(problem, cloud, method, order, kernel, stencils, basis_terms, formulation, solver)
    if not disc.linear:
        raise ValueError("problem: it is nonlinear, so its matrix changes in every step; use js.solve")
    return Factorization(disc, problem, solver, kernel is None and stencils is None, formulation)
