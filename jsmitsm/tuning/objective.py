"""What tuning minimises: the score of a kernel, on a stencil pattern that covers its support.

The objective "estimate" is the distance to one reference solution of higher order, computed once.
A bound on the Lebesgue constant is part of every score: without it the descent finds kernels that
are accurate only for the very numbers they were tuned to.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import Stencils, nearest
from jsmitsm.discretization.coefficients import numbers
from jsmitsm.discretization.health import DEFECT, LEBESGUE
from jsmitsm.discretization.layout import Discretization, discretize, table
from jsmitsm.discretization.rows import all_rows
from jsmitsm.discretization.supports import scheme_size
from jsmitsm.equation.problem import Problem
from jsmitsm.particle.batches import QUICKLY
from jsmitsm.particle.kernels import EDGE, Kernel, SuperGaussian
from jsmitsm.runtime.compiler_options import on_cpu
from jsmitsm.runtime.errors import SolveError
from jsmitsm.solution.fit import Fit, Recipe
from jsmitsm.solution.nonlinear.newton import newton
from jsmitsm.solution.run import Run
from jsmitsm.solution.solution import Solution
from jsmitsm.solution.solve import solve
from jsmitsm.taylor.multi_indices import HIGHEST, multi_indices

# Weight of the Lebesgue bound: being e times above it costs as much as an error e^5 times larger.
PENALTY = 5.0
# A pattern is this much wider than the support, and one that a growing support needs, by the second:
# every new pattern is compiled for.
MARGINS = (1.1, 1.35)
# In place of a Lebesgue bound while there is none; finite, for the sake of derivatives.
UNBOUNDED = 1e300
# A kernel must stand a support wider and narrower by this part.
SHAKE = 0.02
# Up to so many particles score and gradient are one compiled program. Beyond, what the program
# would hold as constants takes long to compile, and a step is long anyway.
COMPILED = 3000


class Score(NamedTuple):
    """What one evaluation tells.

    score : what is minimised, objective and Lebesgue bound together; slope : its gradient.
    lebesgue, defect : largest Lebesgue constant, and every particle's defect, in the order of the
        classes; the least-squares form has no rows, and None.
    values (N, F), taylor (N, F, K) : the solution, and the expansions of a nonlinear one.
    """

    score: float
    slope: Any
    objective: float
    lebesgue: float
    defect: np.ndarray | None
    values: np.ndarray
    taylor: np.ndarray | None


class Objective:
    """A problem, a function to be made small, and the stencil pattern on which kernels are compared.

    target : "estimate" or a function Solution -> scalar.
    options : of ``js.solve``, method and order among them.
    """

    def __init__(self, problem: Problem, cloud: Cloud, kernel: Kernel, target: Any, options: dict[str, Any]):
        self.problem, self.cloud, self.options = problem, cloud, options
        self.points = np.asarray(cloud.points)
        self.given: Stencils | None = options.get("stencils")
        self.solves = 0
        self.values: Any = options.get("u0")  # where Newton's method starts
        self.pattern: Stencils | None = None
        self.fit_pattern(kernel)
        self.bound = UNBOUNDED
        self.scale = 1.0
        self.target: Callable[[Solution], Any] = target
        self.reference: np.ndarray | None = None
        if target == "estimate":
            self.reference, self.solves = reference(problem, cloud, options)

    @property
    def linear(self) -> bool:
        return self.disc.linear

    # -- stencils

    def support(self, kernel: Kernel) -> np.ndarray:
        """Every particle's support (N,)."""
        return np.broadcast_to(np.asarray(kernel.h) * np.asarray(kernel.d), (len(self.cloud),))

    def fit_pattern(self, kernel: Kernel) -> None:
        """Find neighbours for the kernel's support, unless the pattern still covers it."""
        support = self.support(kernel)
        if self.pattern is not None and (support <= np.asarray(self.pattern.radius) * EDGE).all():
            return
        radius = support * MARGINS[0]
        if self.pattern is not None:
            radius = np.maximum(support * MARGINS[1], np.asarray(self.pattern.radius))
        self.disc = self.discretized(kernel, radius)
        self.pattern = self.disc.stencils
        self.numbers = numbers(self.disc, self.problem) if self.linear else None
        self._compiled: dict[Any, Any] = {}

    def discretized(self, kernel: Kernel, radius: np.ndarray) -> Discretization:
        """The problem on a pattern of this radius (N,), or a wider one where it holds too few particles."""
        o = self.options
        if o["method"] in ("I", "II"):  # their first stage may look farther than the support
            radius = np.maximum(radius, self._recovery_reach())
        attempts = 1 if self.given is not None else 8
        for k in range(attempts):
            reach = radius * 1.3**k if self.given is None else np.asarray(self.given.radius)
            wide = kernel.replace(h=reach / np.asarray(kernel.d))
            try:
                disc = discretize(
                    self.problem, self.cloud, o["method"], o["order"], wide, self.given, o.get("basis_terms"),
                    depth=o.get("depth", "auto"),
                )
                break
            except ValueError as error:
                if k == attempts - 1 or "too few neighbours" not in str(error):
                    raise
        return replace(disc, kernel=kernel, given_stencils=True)

    def _recovery_reach(self) -> np.ndarray:
        """What covers 1.5 times as many particles as there are Taylor coefficients, generously."""
        size = len(multi_indices(self.cloud.dim, self.options["order"]))
        return np.asarray(nearest(self.points, min(len(self.points), 3 * size // 2 + 1)).radius) / 0.85

    def smallest_support(self) -> np.ndarray:
        """The support (N,) that holds as many particles as the particle's fit needs."""
        from scipy.spatial import cKDTree

        disc, method = self.disc, self.options["method"]
        needed = np.full(len(self.cloud), 2 if method in ("I", "II") else scheme_size(disc.scheme))
        needed = np.maximum(needed - disc.n_own // disc.rec.fields, 1) + (method != "SSPH")
        points = disc.images.searched(self.points)
        most = min(int(needed.max()), len(points))
        distance = cKDTree(points).query(self.points, k=range(1, most + 1))[0]
        reach = distance[np.arange(len(needed)), np.minimum(needed, most) - 1]
        return np.where(disc.held.all(axis=1), 0.0, reach)

    # -- the score

    def scored(self, kernel_of: Callable[[Any], Kernel], z: Any) -> Score:
        """Score and gradient of the kernel ``kernel_of(z)`` at z; the pattern must cover its support."""
        self.solves += 1
        key = self.bound, self.scale
        if key not in self._compiled:
            graded = jax.value_and_grad(lambda z: self.score(kernel_of(z)), has_aux=True)
            if self.linear and len(self.cloud) <= COMPILED:
                # A few dozen calls do not repay an optimising compiler, which takes five times as long.
                graded = jax.jit(graded, compiler_options=on_cpu(QUICKLY))
            self._compiled = {key: graded}
        (score, (value, lebesgue, defect, values, taylor)), slope = self._compiled[key](z)
        defect, values, taylor = jax.tree.map(np.asarray, (defect, values, taylor))
        return Score(float(score), slope, float(value), float(lebesgue), defect, values, taylor)

    def score(self, kernel: Kernel) -> tuple[Any, Any]:
        """The score, and (objective, Lebesgue constant, defect, values, expansions); may be traced."""
        found, lebesgue, defect = self._solution(kernel)
        value = self.measured(found)
        score = value / self.scale if self.reference is None else jnp.log(value)
        above = jnp.maximum(jnp.log(lebesgue / self.bound), 0.0)
        score = score + PENALTY * (jnp.sum(above) if jnp.ndim(kernel.h) else jnp.max(above))
        return score, (value, jnp.max(lebesgue), defect, found._values, found._fit.taylor)

    def measured(self, found: Solution) -> Any:
        """The objective of a solution, whoever made it."""
        if self.reference is None:
            value = self.target(found)
            number = isinstance(value, float | np.floating | jax.Array)
            if not number or jnp.shape(value) != () or not jnp.issubdtype(jnp.result_type(value), jnp.floating):
                raise ValueError(f"objective: expected a function that returns a real scalar, got {value!r}")
            return value
        size = np.sqrt(np.mean(self.reference**2, axis=0))
        apart = (found._values - self.reference) / np.where(size > 0, size, 1.0)
        # Round-off is no distance; the floor keeps the root differentiable at zero.
        return jnp.sqrt(jnp.mean(apart**2) + 1e-30)

    def _solution(self, kernel: Kernel) -> tuple[Solution, Any, Any]:
        """The solution on the pattern, every row's Lebesgue constant and defect."""
        o, disc = self.options, replace(self.disc, kernel=kernel)
        run = _Watched(disc, self.problem, o.get("solver", "auto"), True, False, o.get("formulation", "auto"))
        taylor, iterations = None, 1
        if self.numbers is not None:
            values, good = run.step(self.numbers)
        else:
            values, taylor, good, iterations = newton(run, self.values)
        recipe = Recipe(o["method"], o["order"], o.get("basis_terms"), run.formulation, self.problem.fields,
            run.disc.rec.depth)
        fit = Fit(disc.problem, self.cloud, kernel, table(run.disc), taylor, recipe)
        found = Solution(values, self.cloud, recipe, fit, good, iterations, {})
        return found, *run.seen

    # -- what the score does not see

    def undetermined(self, score: Score) -> np.ndarray:
        """The particles (N,) bool whose moment system does not determine what is asked of it."""
        bad = np.zeros(len(self.cloud), bool)
        if score.defect is not None:
            bad[np.concatenate([c.ids for c in self.disc.classes])[~(score.defect < DEFECT)]] = True
        return bad

    def shaken(self, kernel: Kernel, score: Score, bound: float) -> np.ndarray:
        """The particles (N,) bool that a slightly wider or narrower support leaves weak."""
        weak = np.zeros(len(self.cloud), bool)
        if score.defect is None:
            return weak
        nums = self.numbers or numbers(self.disc, self.problem, score.taylor)
        # A smaller h narrows weights and support, a larger d widens the support alone.
        for other in (kernel.replace(h=kernel.h * (1.0 - SHAKE)), kernel.replace(d=kernel.d * (1.0 + SHAKE))):
            classes, rows = all_rows(replace(self.disc, kernel=other), nums)
            for cls, row in zip(classes, rows):
                bad = ~(np.asarray(row.defect) < DEFECT) | ~(np.asarray(row.lebesgue).max(axis=1) <= bound)
                weak[cls.ids[bad]] = True
        return weak

    def bound_lebesgue(self) -> None:
        """Bound the Lebesgue constant by that of the paper's choice; not at all where that fails."""
        o = {k: v for k, v in self.options.items() if k not in ("stencils", "throw")}
        self.solves += 1
        try:
            usual = solve(self.problem, self.cloud, kernel=hand_kernel(self.points), **o)
        except (ValueError, SolveError):
            return
        self.bound = max(LEBESGUE, usual.stats.get("lebesgue_max", 1.0))


class _Watched(Run):
    """A solve that remembers the Lebesgue constants and the defects of its rows."""

    seen: tuple[Any, Any] = (np.ones(1), None)

    def local_rows(self, nums: Any) -> Any:
        classes, rows = super().local_rows(nums)
        lebesgue = jnp.concatenate([jnp.max(r.lebesgue, axis=1) for r in rows])
        defect = jnp.concatenate([r.defect for r in rows])
        self.seen = lebesgue, jnp.where(jnp.isfinite(lebesgue), defect, jnp.inf)
        return classes, rows


def reference(problem: Problem, cloud: Cloud, options: dict[str, Any]) -> tuple[np.ndarray, int]:
    """The solution (N, F) that "estimate" measures from, and how many were made to choose it.

    Method S, four or two orders higher, with the paper's choice of kernel, one a fifth narrower, or the
    default where both fail; of these the one with the smallest estimated error. The highest order is
    not always the best: where the particles do not resolve the solution it is the worst.
    """
    order = options["order"]
    rest = {k: options[k] for k in ("solver", "u0", "formulation") if k in options}
    hand = hand_kernel(np.asarray(cloud.points))
    made: list[tuple[float, np.ndarray]] = []
    solves = 0
    for higher in dict.fromkeys(min(order + more, HIGHEST) for more in (4, 2)):
        before = len(made)
        for kernel in (hand, hand.replace(h=0.8 * hand.h), None):
            if kernel is None and len(made) > before:
                continue
            solves += 1
            try:
                found = solve(problem, cloud, order=higher, kernel=kernel, **rest)
            except (ValueError, SolveError):
                continue
            if found.converged:
                made.append((_estimated(found), np.asarray(found._values)))
    if not made:
        raise SolveError(
            f"objective: no reference solution of order {order + 2} or {order + 4} could be computed on this cloud; "
            "lower the order, refine the cloud, or give an objective of your own"
        )
    return min(made, key=lambda x: x[0])[1], solves


def _estimated(solution: Solution) -> float:
    """The estimated error's norm; infinite where there is none."""
    try:
        size = float(np.linalg.norm(solution.error_estimate()))
    except (ValueError, SolveError):
        return np.inf
    return size if np.isfinite(size) else np.inf


def hand_kernel(points: np.ndarray) -> Kernel:
    """The paper's choice, h = spacing and d = 4; one h per particle where the spacing varies."""
    spacing = nearest_distance(points)
    low, high = np.quantile(spacing, [0.05, 0.95])
    return SuperGaussian(float(np.median(spacing)) if high < 2.0 * low else spacing, 4.0)


def nearest_distance(points: np.ndarray) -> np.ndarray:
    """Every particle's spacing (N,): the mean distance of its D nearest neighbours."""
    from scipy.spatial import cKDTree

    dim = points.shape[1]
    distance = cKDTree(points).query(points, k=min(len(points), dim + 1))[0]
    return distance[:, 1:].mean(axis=1)
