# mypy: ignore-errors
"""Choose a kernel's parameters by gradient descent, without knowing the exact solution.

The objective "estimate" is the distance to one reference solution of higher order, computed once,
held by a bound on the Lebesgue constant: without it the descent finds kernels that are accurate
only for the very numbers they were tuned to.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm import discretize as dz
from jsmitsm.boundary import is_traced
from jsmitsm.clouds import Cloud
from jsmitsm.errors import SolveError
from jsmitsm.health import DEFECT, LEBESGUE
from jsmitsm.kernels import EDGE, Kernel, SuperGaussian
from jsmitsm.neighbours import Stencils, nearest
from jsmitsm.newton import newton
from jsmitsm.problem import Problem
from jsmitsm.progress import bar
from jsmitsm.solution import Recipe, Solution
from jsmitsm.solve import Fit, _check, solve
from jsmitsm.system import Run
from jsmitsm.taylor import multi_indices

OPTIONS = ("method", "order", "stencils", "basis_terms", "formulation", "solver", "u0", "throw")
# Adam's step on the logarithms; it decays to a tenth.
LEARNING_RATE = 0.1
# Weight of the Lebesgue bound: being e times above it costs as much as an error e^5 times larger.
PENALTY = 5.0
# A pattern is this much wider than the support, and one that a growing support needs, by the second:
# every new pattern is compiled for.
MARGINS = (1.1, 1.35)
# No parameter changes by more than this factor's logarithm in one step.
STRIDE = 0.5
# The search ends when so many steps in a row gained less than GAIN.
PATIENCE = 12
GAIN = 0.005
RETREATS = 8
# Logarithms of parameters stay within this of the start: no optimizer may overflow them.
FAR = 20.0
# In place of a Lebesgue bound while there is none; finite, for the sake of derivatives.
UNBOUNDED = 1e300
# A kernel must stand a support wider and narrower by this part.
SHAKE = 0.02


@dataclass
class TuneResult:
    """What :func:`tune` found.

    Attributes
    ----------
    kernel : the best kernel met, never worse than the one it started from.
    solution : the solution with it.
    history : per evaluated step, ready to plot: ``"objective"`` (for "estimate" the relative
        distance to the reference solution), ``"lebesgue"`` (the largest Lebesgue constant), and
        each tuned parameter under its name, (steps,) or (steps, N); ``"params"`` has the form of
        the kernel's own, every leaf with a leading axis of steps.
    messages : in words, where tuning had to step back, widen a support or stop.
    solves : number of solves, those of the reference and of the returned solution included.
    """

    kernel: Kernel
    solution: Solution
    history: dict[str, Any]
    messages: list[str] = field(default_factory=list)
    solves: int = 0

    def __repr__(self) -> str:
        seen = self.history["objective"]
        best = np.nanmin(seen) if len(seen) else np.nan
        return f"TuneResult({self.kernel!r}, objective {seen[0]:.3g} -> {best:.3g}, {self.solves} solves)"


def tune(
    problem: Problem,
    cloud: Cloud,
    kernel: Kernel,
    *,
    objective: str | Callable[[Solution], Any] = "estimate",
    parameters: tuple[str, ...] = ("h", "d"),
    optimizer: Any = None,
    steps: int = 50,
    progress: bool = True,
    groups: Any = None,
    **solve_options: Any,
) -> TuneResult:
    """Tune the parameters of a kernel by gradient descent.

    Positive parameters are changed on their logarithms, so they stay positive; the support is kept
    wide enough that every particle has the neighbours its fit needs. Where a solve fails or an
    objective is not finite, the search returns to the best kernel found and halves its step.

    Parameters
    ----------
    kernel : where to start. ``h`` scalar, or (N,) to tune one smoothing length per particle.
    objective : "estimate", the distance to a reference solution of higher order that is computed
        once; or a function of a :class:`jsmitsm.Solution` that returns a scalar to be made small.
        Both are held by a bound on the Lebesgue constant: 1.5, or that of h = spacing, d = 4.
    parameters : some of "h", "d" and, for a kernel that has them, "params". Every floating-point
        leaf of ``params`` is tuned, its sign kept where it starts positive.
    optimizer : any optax transformation; Adam with a decaying step if not given.
    steps : at most so many steps; fewer where nothing is gained any more.
    progress : show a bar, where tqdm is installed and stderr is a terminal.
    groups : (N,) whole numbers; particles with the same one share a factor on ``h``, so that a
        graded ``h`` keeps its grading.
    solve_options : ``method``, ``order`` and the others of :func:`jsmitsm.solve`.

    Raises
    ------
    ValueError
        For bad input, such as a parameter that the kernel lacks.
    SolveError
        If the problem cannot be solved with the starting kernel, nor with wider ones.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp
    >>> import jsmitsm as js
    >>> cloud = js.interval(0.0, 1.0, 17)
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) + jnp.sin(jnp.pi * x[0]), ends)
    >>> start = js.SuperGaussian(h=2 * cloud.spacing, d=4.0)
    >>> found = js.tune(problem, cloud, start, order=3, steps=10)
    >>> bool(found.history["objective"].min() < found.history["objective"][0] / 2)
    True
    """
    names = _checked_names(kernel, parameters)
    _check_input(problem, cloud, kernel, objective, optimizer, steps, solve_options)
    options = {"method": "S", "order": 4, **solve_options}
    space = _Space(kernel, names, _checked_groups(groups, cloud, names))
    with bar("tune", steps, progress) as shown:
        scene = _Scene(problem, cloud, kernel, objective, options)
        search = _Search(space, scene, optimizer, steps)
        search.run(shown)
        best = search.best
        assert best is not None
        if not scene.linear:
            options["u0"] = best.values
        solution = solve(problem, cloud, kernel=best.kernel, **options)
    return TuneResult(best.kernel, solution, search.history(), scene.messages, scene.solves + 1)


# ------------------------------------------------------------------ parameters


class _Space:
    """The parameters as z: all zero at the start, p = p0 exp(z) where p0 > 0, p0 + z elsewhere."""

    def __init__(self, kernel: Kernel, names: tuple[str, ...], groups: np.ndarray | None):
        self.start, self.names = kernel, names
        self.labels = None if groups is None else np.unique(groups, return_inverse=True)[1]
        if groups is not None and "h" in names:
            self.start = kernel.replace(h=np.broadcast_to(np.asarray(kernel.h, float), groups.shape))
        leaves, self.shape = jax.tree.flatten(kernel.params)
        # A scalar h moves at a fixed support d h: the support has a lower bound, and the search slides along it.
        self.by_support = {"h", "d"} <= set(names) and not np.ndim(self.start.h)
        self.moving = [np.asarray(x).dtype.kind == "f" for x in leaves]

    def zero(self) -> dict[str, Any]:
        z: dict[str, Any] = {}
        for name in self.names:
            if name == "params":
                z[name] = [jnp.zeros(np.shape(x)) for x, m in zip(jax.tree.leaves(self.start.params), self.moving) if m]
            elif name == "h" and self.labels is not None:
                z[name] = jnp.zeros(self.labels.max() + 1)
            else:
                z[name] = jnp.zeros(np.shape(getattr(self.start, name)))
        return z

    def kernel(self, z: dict[str, Any]) -> Kernel:
        changes: dict[str, Any] = {}
        for name in self.names:
            if name == "params":
                moved, leaves = iter(z[name]), jax.tree.leaves(self.start.params)
                parts = [_moved(x, next(moved)) if m else x for x, m in zip(leaves, self.moving)]
                changes[name] = jax.tree.unflatten(self.shape, parts)
            else:
                by = z[name][self.labels] if name == "h" and self.labels is not None else z[name]
                if name == "d" and self.by_support:
                    by = by - z["h"]
                changes[name] = getattr(self.start, name) * jnp.exp(by)
        return self.start.replace(**changes)

    def raised(self, z: dict[str, Any], lowest: np.ndarray, highest: np.ndarray) -> dict[str, Any]:
        """z with every support between ``lowest`` and ``highest``, (N,), as far as h and d can."""
        z = dict(z)
        if "h" not in z and "d" not in z:
            return z
        kernel = self.kernel(z)
        support = np.broadcast_to(np.asarray(kernel.h) * np.asarray(kernel.d), lowest.shape)
        up, down = np.log(np.maximum(lowest / support, 1.0)), np.log(np.minimum(highest / support, 1.0))
        if "h" in z and np.ndim(kernel.h):
            shift = _per_label(np.where(up > 0, up, down), self.labels)
            z["h"] = z["h"] + shift
            return z
        shift = up.max() if up.max() > 0 else down.min()
        share = ["d"] if self.by_support else [n for n in ("h", "d") if n in z]
        for name in share:
            z[name] = z[name] + shift / len(share)
        return z


def _moved(x: Any, z: Any) -> Any:
    x = jnp.asarray(x)
    return jnp.where(x > 0, x * jnp.exp(z), x + z)


def _per_label(shift: np.ndarray, labels: np.ndarray | None) -> np.ndarray:
    """The largest upward shift of every group, or its largest downward one."""
    if labels is None:
        return shift
    up, down = np.zeros(labels.max() + 1), np.zeros(labels.max() + 1)
    np.maximum.at(up, labels, shift)
    np.minimum.at(down, labels, shift)
    return np.where(up > 0, up, down)


# ------------------------------------------------------------------ what is minimised


class _Watched(Run):
    """A solve that remembers the Lebesgue constants and the defects of its rows."""

    seen: tuple[Any, Any] | None = None

    def local_rows(self, nums):
        classes, rows = super().local_rows(nums)
        self.seen = jnp.concatenate([jnp.max(r.lebesgue, axis=1) for r in rows]), jnp.concatenate([r.defect for r in rows])
        self.seen = self.seen[0], jnp.where(jnp.isfinite(self.seen[0]), self.seen[1], jnp.inf)
        return classes, rows


class _Point(NamedTuple):
    """One evaluation: the score is what is minimised, objective and Lebesgue bound together."""

    z: Any
    kernel: Kernel
    score: float
    objective: float
    lebesgue: float
    slope: Any
    values: np.ndarray  # (N, F)


class _Scene:
    """The problem, its stencil pattern, and the score of a kernel."""

    def __init__(self, problem: Problem, cloud: Cloud, kernel: Kernel, objective: Any, options: dict[str, Any]):
        self.problem, self.cloud, self.options = problem, cloud, options
        self.points = np.asarray(cloud.points)
        self.given: Stencils | None = options.get("stencils")
        self.messages: list[str] = []
        self.solves = 0
        self.values: Any = options.get("u0")
        self.pattern: Stencils | None = None
        self.fit_pattern(kernel)
        self.linear = self.disc.linear
        self.bound = UNBOUNDED
        self.undetermined = np.zeros(len(cloud), bool)
        self.scale, self.rowless = 1.0, False
        self.objective = objective
        self.reference = self._reference() if objective == "estimate" else None

    # -- stencils

    def support(self, kernel: Kernel) -> np.ndarray:
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
        self.numbers = dz.numbers(self.disc, self.problem) if self.disc.linear else None

    def discretized(self, kernel: Kernel, radius: np.ndarray) -> dz.Discretization:
        """The problem on a pattern of this radius (N,), or a wider one where it holds too few particles."""
        o = self.options
        if o["method"] in ("I", "II"):  # their first stage may look farther than the support
            radius = np.maximum(radius, self._recovery_reach(o))
        attempts = 1 if self.given is not None else 8
        for k in range(attempts):
            reach = radius * 1.3**k if self.given is None else np.asarray(self.given.radius)
            wide = kernel.replace(h=reach / np.asarray(kernel.d))
            try:
                disc = dz.discretize(
                    self.problem, self.cloud, o["method"], o["order"], wide, self.given, o.get("basis_terms")
                )
                break
            except ValueError as error:
                if k == attempts - 1 or "too few neighbours" not in str(error):
                    raise
        return replace(disc, kernel=kernel, given_stencils=True)

    def _recovery_reach(self, o: dict[str, Any]) -> np.ndarray:
        """What covers 1.5 times as many particles as there are Taylor coefficients, generously."""
        size = len(multi_indices(self.cloud.dim, o["order"]))
        return nearest(self.points, min(len(self.points), 3 * size // 2 + 1)).radius / 0.85

    def smallest_support(self) -> np.ndarray:
        """The support (N,) that holds as many particles as the particle's fit needs."""
        from scipy.spatial import cKDTree

        disc, method = self.disc, self.options["method"]
        needed = np.full(len(self.cloud), 2 if method in ("I", "II") else dz.scheme_size(disc.scheme))
        needed = np.maximum(needed - disc.n_own // disc.rec.fields, 1) + (method != "SSPH")
        points = disc.images.searched(self.points)
        most = min(int(needed.max()), len(points))
        distance = cKDTree(points).query(self.points, k=range(1, most + 1))[0]
        reach = distance[np.arange(len(needed)), np.minimum(needed, most) - 1]
        return np.where(disc.held.all(axis=1), 0.0, reach)

    # -- the score

    def _reference(self) -> np.ndarray:
        """A solution of higher order: (N, F)."""
        o = self.options
        hand = hand_kernel(self.points)
        rest = {k: o[k] for k in ("solver", "u0", "formulation") if k in o}
        for more in (4, 2):
            for kernel in (hand, None):
                self.solves += 1
                try:
                    found = solve(self.problem, self.cloud, order=min(o["order"] + more, 14), kernel=kernel, **rest)
                except (ValueError, SolveError):
                    continue
                if found.converged:
                    return np.asarray(found._values)
        raise SolveError(
            f"objective: no reference solution of order {o['order'] + 2} or {o['order'] + 4} could be computed on this cloud; "
            "lower the order, refine the cloud, or give an objective of your own"
        )

    def solution(self, kernel: Kernel) -> tuple[Solution, Any, Any]:
        """The solution on the pattern, its largest Lebesgue constant and its worst defect."""
        o, disc = self.options, replace(self.disc, kernel=kernel)
        run = _Watched(disc, self.problem, o.get("solver", "auto"), True, False, o.get("formulation", "auto"))
        if self.linear:
            values, good = run.step(self.numbers)
            taylor, iterations = None, 1
        else:
            values, taylor, good, iterations = newton(run, self.values)
        recipe = Recipe(o["method"], o["order"], o.get("basis_terms"), run.formulation, self.problem.fields)
        fit = Fit(self.problem, self.cloud, kernel, dz.table(disc), taylor, recipe)
        found = Solution(values, self.cloud, recipe, fit, good, iterations, {})
        self.rowless = run.seen is None
        if run.seen is None:  # the least-squares form has no rows
            return found, jnp.ones(1), jnp.zeros(1)
        return found, *run.seen

    def score(self, kernel: Kernel) -> tuple[Any, Any]:
        """The score, and (objective, Lebesgue constant, defect, values)."""
        found, lebesgue, defect = self.solution(kernel)
        if self.reference is None:
            value = self.objective(found)
            if jnp.shape(value) != () or not jnp.issubdtype(jnp.result_type(value), jnp.floating):
                raise ValueError(f"objective: expected a function that returns a real scalar, got {value!r}")
            score = value / self.scale
        else:
            size = np.sqrt(np.mean(self.reference**2, axis=0))
            apart = (found._values - self.reference) / np.where(size > 0, size, 1.0)
            # Round-off is no distance; the floor keeps the root differentiable at zero.
            value = jnp.sqrt(jnp.mean(apart**2) + 1e-30)
            score = jnp.log(value)
        largest = jnp.max(lebesgue)
        above = jnp.maximum(jnp.log(lebesgue / self.bound), 0.0)
        score = score + PENALTY * (jnp.sum(above) if jnp.ndim(kernel.h) else jnp.max(above))
        return score, (value, largest, defect, found._values)

    def shaken(self, kernel: Kernel, bound: float) -> np.ndarray:
        """The particles (N,) bool that a slightly wider or narrower support leaves weak."""
        weak = np.zeros(len(self.cloud), bool)
        if self.numbers is None or self.rowless:
            return weak
        # A smaller h narrows weights and support, a larger d widens the support alone.
        for other in (kernel.replace(h=kernel.h * (1.0 - SHAKE)), kernel.replace(d=kernel.d * (1.0 + SHAKE))):
            near = replace(self.disc, kernel=other)
            classes, rows = dz.all_rows(near, self.numbers)
            for cls, row in zip(classes, rows):
                bad = ~(np.asarray(row.defect) < DEFECT) | ~(np.asarray(row.lebesgue).max(axis=1) <= bound)
                weak[cls.ids[bad]] = True
        return weak


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


# ------------------------------------------------------------------ the search


class _Search:
    """Gradient descent that steps back where it must."""

    def __init__(self, space: _Space, scene: _Scene, optimizer: Any, steps: int):
        self.space, self.scene, self.steps = space, scene, steps
        self.optimizer = _adam(steps) if optimizer is None else optimizer
        self.points: list[_Point] = []
        self.best: _Point | None = None
        self.retreats: list[tuple[int, str]] = []
        free = scene.given is None
        self.highest = np.full(len(scene.cloud), np.inf) if free else np.asarray(scene.given.radius)

    def run(self, shown: Any) -> None:
        scene, space = self.scene, self.space
        lowest, z, point = self._start()
        state, part, last = self.optimizer.init(z), 1.0, 0
        for step in range(1, self.steps + 1):
            move, state = self._update(point, state)
            move = jax.tree.map(lambda x, p=part: p * jnp.clip(jnp.nan_to_num(x), -STRIDE, STRIDE), move)
            new = jax.tree.map(lambda x, y: jnp.clip(x + y, -FAR, FAR), z, move)
            new = space.raised(new, lowest, self.highest)
            if _largest(jax.tree.map(jnp.subtract, new, z)) < 1e-5:
                scene.messages.append(f"Step {step}: nothing moves any more.")
                break
            trial, reason = self._tried(new)
            shown.update(1)
            if trial is None:
                self.retreats.append((step, reason))
                part, point, z = part / 2.0, self.best, self.best.z
                state = self.optimizer.init(z)
                lowest = self._floor(lowest, new)
                if len(self.retreats) == RETREATS:
                    break
                continue
            z, point, part = new, trial, min(1.0, 1.5 * part)
            if self._accept(point):
                last = step
            shown.note(f"objective {self.best.objective:.3g}")
            if step - last >= PATIENCE:
                break
        self._tell_retreats()

    def _tell_retreats(self) -> None:
        """The steps back, by their reasons."""
        for reason in dict.fromkeys(r for _, r in self.retreats):
            at = ", ".join(str(step) for step, r in self.retreats if r == reason)
            self.scene.messages.append(f"Back to the best kernel with half the step, at step {at}: {reason}.")
        if len(self.retreats) == RETREATS:
            self.scene.messages.append(f"Stopped after {RETREATS} steps back.")

    def _floor(self, lowest: np.ndarray, failed: Any) -> np.ndarray:
        """The smallest supports admitted, raised half way from those that failed to the best ones."""
        scene = self.scene
        support, good = scene.support(_concrete(self.space.kernel(failed))), scene.support(self.best.kernel)
        raised = np.where(scene.undetermined & (support < good), np.sqrt(support * good), lowest)
        return np.maximum(lowest, raised)

    def _start(self) -> tuple[np.ndarray, Any, _Point]:
        """The first point: the user's kernel, or a wider one where that does not determine the solution."""
        scene, space = self.scene, self.space
        lowest, start = scene.smallest_support(), space.zero()
        scene.bound = self._bound()
        z, reason = space.raised(start, np.minimum(lowest, self.highest), self.highest), "too few neighbours"
        raised = _largest(jax.tree.map(jnp.subtract, z, start)) > 1e-9
        z = z if raised else start
        point, why = self._tried(z)
        if point is None and scene.reference is None and why.startswith("the objective is"):
            raise ValueError(f"objective: it is {why.split()[-1]} at the start; return a finite scalar there")
        reason = reason if raised else why
        widen = 1.0
        while point is None and widen < 3.0 and ("h" in z or "d" in z):
            z, raised = space.raised(z, np.minimum(lowest * widen * 1.01, self.highest), self.highest), True
            point, _ = self._tried(z)
            widen *= 1.2
        if point is None:
            raise SolveError(f"kernel: tuning cannot start from {space.start!r}: {reason}; start from a wider support")
        if raised:
            scene.messages.append(f"The starting kernel fails ({reason}); started from {point.kernel!r}.")
        if scene.bound == UNBOUNDED:
            scene.bound = max(LEBESGUE, point.lebesgue)
        if scene.reference is None and point.objective:
            scene.scale = abs(point.objective)
            self.points.clear()
            point, _ = self._tried(z)
            assert point is not None
        self._accept(point)
        return np.minimum(lowest, self.highest), z, point

    def _bound(self) -> float:
        """The Lebesgue bound of the paper's choice; none where that fails."""
        scene = self.scene
        o = {k: v for k, v in scene.options.items() if k not in ("stencils", "throw")}
        hand = hand_kernel(scene.points)
        scene.solves += 1
        try:
            usual = solve(scene.problem, scene.cloud, kernel=hand, **o).stats.get("lebesgue_max", 1.0)
        except (ValueError, SolveError):
            return UNBOUNDED
        return max(LEBESGUE, usual)

    def _tried(self, z: Any) -> tuple[_Point | None, str]:
        """Score and gradient at z, or why there is none."""
        scene, space = self.scene, self.space
        kernel = _concrete(space.kernel(z))
        scene.fit_pattern(kernel)
        scene.solves += 1
        scene.undetermined = np.zeros(len(scene.cloud), bool)
        try:
            (score, (value, lebesgue, defect, values)), slope = jax.value_and_grad(
                lambda z: scene.score(space.kernel(z)), has_aux=True
            )(z)
        except SolveError as error:
            return None, str(error)
        bad = ~(np.asarray(defect) < DEFECT)
        if bad.any():
            scene.undetermined[np.concatenate([c.ids for c in scene.disc.classes])[bad]] = True
            return None, "the support does not determine the solution everywhere"
        if not np.isfinite(float(score)) or not np.isfinite(_largest(slope)):
            what = "the objective's gradient" if np.isfinite(float(score)) else "the objective"
            return None, f"{what} is {float(value) if what == 'the objective' else 'not finite'}"
        point = _Point(z, kernel, float(score), float(value), float(lebesgue), slope, np.asarray(values))
        if self.best is not None and point.score < self.best.score:
            weak = scene.shaken(kernel, max(scene.bound, 1.1 * point.lebesgue))
            if weak.any():
                scene.undetermined |= weak
                return None, "a slightly different support would not do"
        if not scene.linear:
            scene.values = point.values
        self.points.append(point)
        return point, ""

    def _accept(self, point: _Point) -> bool:
        """Keep the best point; whether it gained enough to go on."""
        best = self.best
        if best is None:
            self.best = point
            return True
        if point.score >= best.score or point.objective > self.points[0].objective:
            return False
        size = 1.0 if self.scene.reference is not None else abs(best.score)
        self.best = point
        return best.score - point.score > GAIN * size

    def _update(self, point: _Point, state: Any) -> tuple[Any, Any]:
        import optax

        score = lambda z: self.scene.score(self.space.kernel(z))[0]
        update = optax.with_extra_args_support(self.optimizer).update
        return update(point.slope, state, point.z, value=point.score, grad=point.slope, value_fn=score)

    def history(self) -> dict[str, Any]:
        out: dict[str, Any] = {
            "objective": np.array([p.objective for p in self.points]),
            "lebesgue": np.array([p.lebesgue for p in self.points]),
        }
        for name in self.space.names:
            each = [getattr(p.kernel, name) for p in self.points]
            out[name] = jax.tree.map(lambda *x: np.stack([np.asarray(v) for v in x]), *each)
        return out


def _adam(steps: int) -> Any:
    """Adam on clipped gradients, its step decaying to a tenth."""
    import optax

    rate = optax.cosine_decay_schedule(LEARNING_RATE, max(steps, 1), 0.1)
    return optax.chain(optax.clip_by_global_norm(5.0), optax.adam(rate))


def _concrete(kernel: Kernel) -> Kernel:
    """The kernel with numpy leaves: scalars as floats."""
    return jax.tree.map(lambda x: np.asarray(x).item() if np.ndim(x) == 0 else np.asarray(x), kernel)


def _largest(tree: Any) -> float:
    """The largest entry in size; NaN where any is."""
    return max((float(np.max(np.abs(x), initial=0.0)) for x in jax.tree.leaves(tree)), default=0.0)


# ------------------------------------------------------------------ input


def _checked_names(kernel: Any, parameters: Any) -> tuple[str, ...]:
    if not isinstance(kernel, Kernel):
        raise ValueError(
            f"kernel: expected a kernel to start from such as js.SuperGaussian(cloud.spacing, 4.0), got {kernel!r}"
        )
    names = (parameters,) if isinstance(parameters, str) else tuple(parameters)
    known = ["h", "d"] + (["params"] if jax.tree.leaves(kernel.params) else [])
    for name in names:
        if name not in known:
            raise ValueError(
                f"parameters: {name!r} is no parameter of {type(kernel).__name__}; it has {', '.join(map(repr, known))}"
            )
    if not names or len(set(names)) < len(names):
        raise ValueError(f"parameters: expected some of {', '.join(map(repr, known))}, each once, got {parameters!r}")
    return names


def _check_input(problem, cloud, kernel, objective, optimizer, steps, options) -> None:
    for name in options:
        if name not in OPTIONS:
            raise ValueError(f"{name}: no argument of js.tune or js.solve; those of js.solve are {', '.join(OPTIONS)}")
    o = {"method": "S", "order": 4, "formulation": "auto", "solver": "auto", "stencils": None, **options}
    _check(problem, cloud, o["method"], o["order"], kernel, o["stencils"], o["formulation"], o["solver"])
    if is_traced(kernel, cloud, problem.params):
        raise ValueError("kernel, cloud, problem: traced by a JAX transform; js.tune runs on the host, call it outside")
    if objective != "estimate" and not callable(objective):
        raise ValueError(f'objective: expected "estimate" or a function of a Solution, got {objective!r}')
    if optimizer is not None and not (hasattr(optimizer, "init") and hasattr(optimizer, "update")):
        raise ValueError(f"optimizer: expected an optax transformation such as optax.adam(0.1), got {optimizer!r}")
    if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 0:
        raise ValueError(f"steps: expected a whole number, 0 or more, got {steps!r}")


def _checked_groups(groups: Any, cloud: Cloud, names: tuple[str, ...]) -> np.ndarray | None:
    if groups is None:
        return None
    array = np.asarray(groups)
    if array.shape != (len(cloud),) or array.dtype.kind not in "iu":
        raise ValueError(f"groups: expected ({len(cloud)},) whole numbers, one per particle, got {array.dtype} {array.shape}")
    if "h" not in names:
        raise ValueError(f'groups: particles share a factor on h, but parameters={names!r} does not tune "h"')
    return array
