"""Gradient descent over a kernel's parameters that steps back where it must.

The steps are optax's. By its loop alone one search of 24 steps ended with NaN, after 7 kernels that determine no
solution; no transformation of optax's looks at a new point before it is taken, nor returns to the best one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.health import LEBESGUE
from jsmitsm.particle.kernels import EDGE, Kernel
from jsmitsm.runtime.errors import SolveError
from jsmitsm.tuning.objective import SHAKE, UNBOUNDED, Objective, Score
from jsmitsm.tuning.parameter_maps import ParameterMap, Steps

# Adam's step on the logarithms; it decays to a tenth.
LEARNING_RATE = 0.1
# No parameter changes by more than this factor's logarithm in one step.
STRIDE = 0.5
# The search ends when so many steps in a row gained less than GAIN.
PATIENCE = 12
GAIN = 0.005
RETREATS = 8
# Logarithms of parameters stay within this of the start: no optimizer may overflow them.
FAR = 20.0
OVERFLOW = "Supports were held inside the given stencils; wider ones need wider stencils, or none given."


class Point(NamedTuple):
    """One evaluated kernel."""

    z: Steps
    kernel: Kernel
    score: Score


class Descent:
    """A search from the start of ``space``; ``run`` leaves ``points``, ``best`` and ``messages``."""

    def __init__(self, space: ParameterMap, objective: Objective, optimizer: Any, steps: int):
        self.space, self.objective, self.steps = space, objective, steps
        self.optimizer = _adam(steps) if optimizer is None else optimizer
        self.points: list[Point] = []
        self.messages: list[str] = []
        self.step = 0
        self.retreats: list[tuple[int, str]] = []
        self.weak = np.zeros(len(objective.cloud), bool)  # the particles that the last failure was about
        given = objective.given
        self.highest = np.full(len(objective.cloud), np.inf) if given is None else np.asarray(given.radius)
        needed = objective.smallest_support()
        self.needed = np.minimum(needed, self.highest)
        # A support that just holds enough particles must stand being shaken.
        self.lowest = np.minimum(needed / (1.0 - 1.1 * SHAKE), self.highest)

    def run(self, shown: Any) -> None:
        """Take the steps; ``shown`` is a progress bar."""
        self.best = self._start()
        self._descend(shown)
        if self.space.by_support and len(self.retreats) < RETREATS and self._elsewhere(shown):
            self._descend(shown)
        self._tell_retreats()
        self._tell_not_taken()

    @property
    def place(self) -> int:
        """Where the best point stands among all."""
        return next(k for k, point in enumerate(self.points) if point is self.best)

    def _descend(self, shown: Any) -> None:
        """Down from the best point, until nothing is gained any more or the steps are used up."""
        point, part, last = self.best, 1.0, self.step
        state = self.optimizer.init(point.z)
        while self.step < self.steps and self.step - last < PATIENCE:
            move, state = self._move(point, state)
            z = self._admitted(point.z, move, part)
            if _largest(jax.tree.map(jnp.subtract, z, point.z)) < 1e-5:
                self.messages.append(f"Step {self.step + 1}: nothing moves any more.")
                return
            tried, reason = self._step(z, shown)
            if tried is None:
                self.retreats.append((self.step, reason))
                self._raise_floor(z)
                part, point = part / 2.0, self.best
                state = self.optimizer.init(point.z)
                if len(self.retreats) == RETREATS:
                    return
                continue
            point, part = tried, min(1.0, 1.5 * part)
            if self._accept(point):
                last = self.step

    def _step(self, z: Steps, shown: Any) -> tuple[Point | None, str]:
        self.step += 1
        found = self._tried(z)
        shown.update(1)
        shown.note(f"objective {self.best.score.objective:.3g}")
        return found

    def _elsewhere(self, shown: Any) -> bool:
        """Whether another form of the kernel is better: a valley that no descent reaches from here."""
        gained, z = False, self.best.z
        for narrower in (1.0, 0.7, 0.5):
            for smaller in (0.6, 0.4):  # d; h follows from the support
                if self.step == self.steps:
                    return gained
                form = {**z, "d": z["d"] + np.log(narrower), "h": z["h"] + np.log(narrower / smaller)}
                point, _ = self._step(self.space.kept_within(form, self.lowest, self.highest), shown)
                gained |= point is not None and self._accept(point)
        return gained

    def _tell_retreats(self) -> None:
        """The steps back, by their reasons."""
        for reason in dict.fromkeys(r for _, r in self.retreats):
            at = ", ".join(str(step) for step, r in self.retreats if r == reason)
            self.messages.append(f"Back to the best kernel with half the step, at step {at}: {reason}.")
        if len(self.retreats) == RETREATS:
            self.messages.append(f"Stopped after {RETREATS} steps back.")

    def _tell_not_taken(self) -> None:
        """The kernels with a smaller objective than the best one has, which the Lebesgue bound held off."""
        smaller = [k for k, p in enumerate(self.points) if p.score.objective < self.best.score.objective]
        if smaller:
            k = min(smaller, key=lambda k: self.points[k].score.objective)
            least, bound = self.points[k].score, self.objective.bound
            self.messages.append(
                f"Not taken: {len(smaller)} kernel(s) with objectives down to {least.objective:.3g} (place {k} of the "
                f"history), whose Lebesgue constants, there {least.lebesgue:.3g}, are above the bound {bound:.3g}."
            )

    def tell_nearer(self, plain: Any) -> None:
        """Say where the objective ``plain`` of a solve without a kernel is smaller than that of the best one."""
        best = self.best.score.objective
        if float(plain) < best - GAIN * abs(best):
            self.messages.append(
                f"Without a kernel js.solve, which balances single stencils, has the objective {float(plain):.3g}, the "
                f"best kernel {best:.3g}: leave the kernel out."
            )

    # -- one step

    def _move(self, point: Point, state: Any) -> tuple[Any, Any]:
        """The optimizer's step from a point, and its new state."""
        import optax

        score = lambda z: self.objective.score(self.space.kernel(z))[0]
        update = optax.with_extra_args_support(self.optimizer).update
        slope = point.score.slope
        return update(slope, state, point.z, value=point.score.score, grad=slope, value_fn=score)

    def _admitted(self, z: Steps, move: Any, part: float) -> Steps:
        """Where a part of the move leads, within all bounds."""
        move = jax.tree.map(lambda x: part * jnp.clip(jnp.nan_to_num(x), -STRIDE, STRIDE), move)
        new = jax.tree.map(lambda x, y: jnp.clip(x + y, -FAR, FAR), z, move)
        wide = self.objective.support(_concrete(self.space.kernel(new))) > self.highest * EDGE
        if wide.any() and OVERFLOW not in self.messages:
            self.messages.append(OVERFLOW)
        return self.space.kept_within(new, self.lowest, self.highest)

    def _tried(self, z: Steps) -> tuple[Point | None, str]:
        """The evaluated point at z, or why there is none."""
        objective = self.objective
        kernel = _concrete(self.space.kernel(z))
        self.weak[:] = False
        try:
            objective.fit_pattern(kernel)
            score = objective.scored(self.space.kernel, z)
        except SolveError as error:
            return None, str(error)
        self.weak = objective.undetermined(score)
        if self.weak.any():
            return None, "the support does not determine the solution everywhere"
        if not np.isfinite(score.score):
            return None, f"the objective is {score.objective}"
        if not np.isfinite(_largest(score.slope)):
            return None, "the objective's gradient is not finite"
        if self.points and score.score < self.best.score.score:
            self.weak = objective.shaken(kernel, score, max(objective.bound, 1.1 * score.lebesgue))
            if self.weak.any():
                return None, "a slightly different support would not do"
        if not objective.linear:
            objective.values = score.values
        point = Point(z, kernel, score)
        self.points.append(point)
        return point, ""

    def _accept(self, point: Point) -> bool:
        """Keep the best point; whether it gained enough to go on."""
        new, best = point.score, self.best.score
        if new.score >= best.score or new.objective > self.points[0].score.objective:
            return False
        size = 1.0 if self.objective.reference is not None else abs(best.score)
        self.best = point
        return best.score - new.score > GAIN * size

    def _raise_floor(self, failed: Steps) -> None:
        """The smallest supports admitted rise half way from those that failed to the best ones."""
        support = self.objective.support(_concrete(self.space.kernel(failed)))
        good = self.objective.support(self.best.kernel)
        raised = np.where(self.weak & (support < good), np.sqrt(support * good), self.lowest)
        self.lowest = np.maximum(self.lowest, raised)

    # -- the start

    def _start(self) -> Point:
        """The user's kernel, or a wider one where that does not determine the solution."""
        objective, space, start = self.objective, self.space, self.space.zero()
        objective.bound_lebesgue()
        z, reason = space.kept_within(start, self.needed, self.highest), "too few neighbours"
        widened = _largest(jax.tree.map(jnp.subtract, z, start)) > 1e-9
        z = z if widened else start
        point, why = self._tried(z)
        if point is None and objective.reference is None and why.startswith("the objective is"):
            raise ValueError(f"objective: it is {why.split()[-1]} at the start; return a finite scalar there")
        reason = reason if widened else why
        factor = 1.0
        while point is None and factor < 3.0 and ("h" in z or "d" in z):
            wider = np.minimum(self.needed * factor * 1.01, self.highest)
            z, widened = space.kept_within(z, wider, self.highest), True
            point, _ = self._tried(z)
            factor *= 1.2
        if point is None:
            raise SolveError(f"kernel: tuning cannot start from {space.start!r}: {reason}; start from a wider support")
        if widened:
            self.messages.append(f"The starting kernel fails ({reason}); started from {point.kernel!r}.")
        return self._rescaled(point)

    def _rescaled(self, point: Point) -> Point:
        """The first point again, with the bound and the scale that it sets itself where nothing else did."""
        objective = self.objective
        if objective.bound == UNBOUNDED:
            objective.bound = max(LEBESGUE, point.score.lebesgue)
        if objective.reference is not None or not point.score.objective:
            return point
        objective.scale = abs(point.score.objective)
        self.points.clear()
        again, _ = self._tried(point.z)
        assert again is not None
        return again

    # -- what is told afterwards

    def history(self) -> dict[str, Any]:
        """Objective, Lebesgue constant and parameters of every evaluated point."""
        out: dict[str, Any] = {
            "objective": np.array([p.score.objective for p in self.points]),
            "lebesgue": np.array([p.score.lebesgue for p in self.points]),
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
