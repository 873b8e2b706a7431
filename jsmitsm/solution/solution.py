"""The solution: values at the particles, local Taylor polynomials, evaluation anywhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.runtime import notebooks
from jsmitsm.runtime.arrays import Array
from jsmitsm.runtime.errors import SolveError, explained, explaining
from jsmitsm.runtime.tracers import frozen, is_traced, owned
from jsmitsm.solution.anywhere import Anywhere
from jsmitsm.solution.estimate import Correction, correction
from jsmitsm.solution.fit import Fit, Recipe
from jsmitsm.solution.flags import SQUARED, too_large
from jsmitsm.solution.look.reach import beyond_orders
from jsmitsm.solution.look.sizes import NOTHING, share
from jsmitsm.solution.run import Run


class Report(Protocol):
    """What the solve can still say of itself when asked."""

    def flags(self, estimated: Callable[[], float], known: bool = False) -> list[str]: ...

    def condition_numbers(self) -> tuple[np.ndarray, float]: ...


@jax.tree_util.register_pytree_node_class
class Solution(Anywhere):
    """A solution at the particles, and anywhere through local Taylor polynomials.

    ``sol(points)`` evaluates it at points (M, D), ``sol.grad(points)`` its gradient.

    A solution is a pytree: it passes through ``jax.jit``, ``jax.grad`` and ``pickle``.

    Attributes
    ----------
    u : array (N,) or (N, F)
        (N,) values at the particles in the cloud's order, (N, F) for a system.
    coefficients : array (N, K) or (N, K, F)
        (N, K) unscaled Taylor coefficients d^a u / a! at every particle, in the order of
        ``js.multi_indices``; (N, K, F) for a system. Fitted when first asked for.
    converged : bool
        Whether the solve met its tolerance.
    iterations : int
        Newton steps (1 if linear).
    stats : dict
        Seconds per phase, sizes, what was skipped or repaired.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    >>> # The answer is x^3.
    >>> sol = js.solve(
    ...     js.Problem(lambda u, x: js.laplacian(u)(x) - 6 * x[0], ends),
    ...     js.interval(0.0, 1.0, 9),
    ... )
    >>> sol
    Solution(u: 9, method='S', order=4, depth=4, converged=True)
    >>> x = [[0.3]]
    >>> found = sol(x)[0], sol.grad(x)[0, 0], sol.derivative(x, (2,))[0]
    >>> [round(float(value), 9) for value in found]
    [0.027, 0.27, 1.8]
    >>> round(float(sol.flux("right")), 9), sol.coefficients.shape
    (3.0, (9, 9))
    >>> bool(sol.error_estimate().max() < 1e-12), sol.flags
    (True, [])
    """

    def __init__(self, values, cloud, recipe, fit, converged, iterations, stats, fitted=None, report=None):
        self._values = frozen(values)  # (N, F)
        self.cloud: Cloud = cloud
        self._recipe: Recipe = recipe
        self._fit = fit  # a pytree with a method .coefficients(values) and friends
        self._fitted = fitted  # (N, F, K) or None
        self.converged: bool | jax.Array = converged
        self.iterations: int | jax.Array = iterations
        self.stats: dict[str, Any] = stats
        self._report: Report | None = report
        self._found: list[str] | None = None  # what the report said
        self._error: np.ndarray | None = None  # the estimate, once asked for
        self._share = 0.0  # estimated error over solution
        self._untold = ""  # why there is no estimate, where flags asked in vain

    @property
    def method(self) -> str:
        """The method it was solved with, "S" for instance."""
        return self._recipe.method

    @property
    def depth(self) -> int:
        """Degrees by which the local Taylor polynomials exceed the order."""
        return self._recipe.depth

    @property
    def operator_orders(self) -> tuple[int, ...]:
        """Of every equation the order of its highest derivatives."""
        return self._recipe.operator_orders

    @property
    def u(self) -> Array:
        """Values (N,) at the particles, in the cloud's order; (N, F) for a system."""
        return self._values[..., 0] if self._recipe.fields == 1 else self._values

    @property
    def unknowns(self) -> dict[str, Any]:
        """The global unknowns that were found with u, by their names; none for a problem without them."""
        return {}

    @property
    def coefficients(self) -> Array:
        """Taylor coefficients d^a u / a!, (N, K), ordered as ``js.multi_indices``; (N, K, F) for a system."""
        fitted = self._taylor
        return fitted[:, 0] if self._recipe.fields == 1 else jnp.swapaxes(fitted, 1, 2)

    def _expanded(self) -> Any:
        run = self._report
        if not isinstance(self._fit, Fit) or type(run) is not Run or not run.disc.linear or run.nums is None:
            return super()._expanded()
        return self._fit.coefficients(self._values, known=run.fitted(run.nums, np.asarray(self._values, float)))

    @explaining
    def error_estimate(self) -> Array:
        """Estimated error |u - u_exact| at every particle: what leads to the solution of order p + 2.

        Computed when asked for: one more assembly at order p + 2 and one more solve. Where rows of that order are weak,
        and in the least-squares form, a lower order is asked too. What no order sees is measured beside: kinks and
        jumps, and values that the local polynomials around do not reach, as beside a singular point.

        Returns
        -------
        array (N,) or (N, F)
            In units of u.

        Raises
        ------
        ValueError
            For a solution that was pickled, and where the points are traced.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
        >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 6 * x[0], ends)  # x^3
        >>> sol = js.solve(problem, js.interval(0.0, 1.0, 9))
        >>> bool(sol.error_estimate().max() < 1e-10)
        True
        """
        self.refuse_stacked()
        if self._error is not None:
            return self._error
        if self._fit is None:
            raise ValueError("error_estimate: this solution was pickled without its problem; ask before pickling")
        own = getattr(self._fit, "error_estimate", None)  # one of several regions brings its own
        if own:
            return self._size(own(self._values).reshape(jnp.shape(self._values)))
        found = self._corrected()
        return self._size(abs(found.error), found.units)

    def _corrected(self) -> Correction:
        """The estimate, with the rows of the solve where they are still there."""
        return correction(self._fit, self._values, self._report if isinstance(self._report, Run) else None)

    def _size(self, error: Any, units: Any = 1.0) -> Array:
        """The size of an estimated error (N, F), no less than what no order sees, kept for the next who asks."""
        if isinstance(self._report, Run) and not is_traced(error, self._values):
            error = np.maximum(error, self._beyond(np.asarray(self._values, float), np.asarray(error)))
        return self._kept(error[..., 0] if self._recipe.fields == 1 else error, units)

    def _beyond(self, values: np.ndarray, known: np.ndarray) -> np.ndarray:
        """What no order sees of the values (N, F), beside the error that two orders tell."""
        return beyond_orders(self._report, values, known)

    def _kept(self, error: Array, units: Any = 1.0) -> Array:
        if not is_traced(error, self._values):
            self._error = frozen(error)
            # The least-squares form has the squares of the systems: what is left of a field that is zero is larger.
            nothing = SQUARED if self._recipe.formulation == "lsq" else NOTHING
            error_of = np.reshape(error, np.shape(self._values))
            self._share = share(error_of * units, np.asarray(self._values) * units, nothing)
        return error

    @property
    def neighbours(self) -> np.ndarray:
        """Every particle's stencil (N, w): itself and those that it sees, padded with -1; images count from N."""
        return np.asarray(self._fit.neighbours)

    @property
    def poles(self) -> np.ndarray:
        """Where (P, D) the source or a potential was found to be infinite between the particles, beside each of them.

        Sought for linear problems by method S, in the series that end within a stencil; see ``flags``.
        """
        found = getattr(getattr(self._report, "nums", None), "poles", None)
        return np.zeros((0, self.cloud.dim)) if found is None else found.at

    @property
    def defects(self) -> bool:
        """Whether the estimate knows defects, and ``correction`` more than the size of the error."""
        return not hasattr(self._fit, "error_estimate")

    @explaining
    def correction(self) -> Correction:
        """What the error estimate is made of, for those who refine by it.

        Returns
        -------
        Correction
            Signed errors, defects and their weights.

        Raises
        ------
        ValueError
            For a solution in several regions, which has no defects to refine by.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
        >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 6 * x[0], ends)  # x^3
        >>> sol = js.solve(problem, js.interval(0.0, 1.0, 9))
        >>> bool(abs(sol.correction().error).max() < 1e-10)
        True
        """
        self.refuse_stacked()
        if not self.defects:
            raise ValueError("correction: several regions have an error estimate, but no defects to refine by")
        found = self._corrected()
        self._size(abs(found.error), found.units)
        return found

    def _estimated(self) -> float:
        """The estimated error over the solution, infinite where there is none."""
        try:
            self.error_estimate()
        except (ValueError, SolveError) as fault:
            self._untold = f"There is no error estimate: {fault}."
            return np.inf
        return self._share if np.isfinite(self._share) else np.inf

    @property
    @explaining
    def flags(self) -> list[str]:
        """What speaks against this solution, a sentence each; none for a healthy one.

        Tested when first asked for: roughness between neighbours, near singularity, an unresolved
        source or coefficient, hopeless stencils, misfits of the equation. Linear problems of one field that pass
        by far are cleared. For all others, of up to 200,000 particles or where it is known, the error is
        estimated: below 2 % clears what is only suspected, above is a flag. Between the particles, and beyond
        periodic pairs, equation and data are looked at too. No flag is no proof.
        """
        self.refuse_stacked()
        if self._found is None and self._report is not None:
            self._found = self._report.flags(self._estimated, self._error is not None)
        return explained([*(self._found or []), *self.stats.get("objections", []), *too_large(self._share)])

    @explaining
    def condition_numbers(self) -> tuple[np.ndarray, float]:
        """Condition numbers of every particle's moment matrix and of the global system.

        The matrices are those with rows and columns scaled to about one, so that units do not count.
        They say how many digits round-off may take; they do not predict the error: the Lebesgue constants do more.

        Returns
        -------
        tuple of (array (N,), float)
            Every particle's, NaN where the value is held; and an estimate of the global system's.

        Raises
        ------
        ValueError
            For a solution that was pickled or made under ``jax.jit``.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
        >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 6 * x[0], ends)  # x^3
        >>> sol = js.solve(problem, js.interval(0.0, 1.0, 9))
        >>> sol.condition_numbers()[0].shape
        (9,)
        """
        if self._report is None:
            raise ValueError(
                "condition_numbers: this solution was pickled or made by a JAX transform, and its systems are gone; "
                "solve outside and ask before pickling"
            )
        return self._report.condition_numbers()

    def diagnose(self) -> str:
        """In words: how the solve went, which particles were weak and what was done.

        Returns
        -------
        str
            Several lines; those that begin with FLAG speak against the solution.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
        >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 6 * x[0], ends)  # x^3
        >>> sol = js.solve(problem, js.interval(0.0, 1.0, 9))
        >>> "FLAG" in sol.diagnose()
        False
        """
        self.refuse_stacked()
        s = self.stats
        lines = [repr(self)]
        if not bool(self.converged):
            lines.append("The solve did NOT converge; do not trust these values.")
        told = s.get("messages", [])
        lines += [f"FLAG: {line}" for line in self.flags if not any(line.startswith(one) for one in told)]
        lines += [str(line) for line in told]
        if self._error is not None:
            lines.append(f"The estimated error is {self._share:.1e} of the solution.")
        elif self._untold:
            lines.append(self._untold)
        if "lebesgue_max" in s:
            lines.append(f"Largest Lebesgue constant {s['lebesgue_max']:.3g} (up to 1.5 is healthy).")
        if "residual" in s:
            lines.append(f"Relative residual of the global system {s['residual']:.1e}.")
        return "\n".join(lines)

    def __repr__(self) -> str:
        shape = "x".join(map(str, self.u.shape))
        deep = f", depth={self.depth}" if self.depth else ""
        state = "" if is_traced(self.converged) else f", converged={bool(np.all(self.converged))}"
        return f"Solution(u: {shape}, method={self.method!r}, order={self.order}{deep}{state})"

    def _repr_html_(self) -> str:
        """What is known already: nothing is estimated for it."""
        if is_traced(self._values) or np.ndim(self._values) != 2:
            return repr(self)
        s, values = self.stats, np.asarray(self.u).reshape(len(self.cloud), -1)
        rows = [("particles", len(self.cloud)), ("method, order, depth", f"{self.method}, {self.order}, {self.depth}")]
        rows += [("u" if values.shape[1] == 1 else f"u[{k}]", notebooks.span(v)) for k, v in enumerate(values.T)]
        rows.append(("converged", f"{bool(np.all(self.converged))}, {self.iterations} iteration(s)"))
        rows += [("estimated error", f"{self._share:.1e} of it")] if self._error is not None else []
        rows += [("flags", " ".join(explained(self._found)) or "none")] if self._found is not None else []
        rows += [("seconds", f"{s['seconds']['total']:.3g}")] if "total" in (s.get("seconds") or {}) else []
        picture = notebooks.dots(np.asarray(self.cloud.points), np.abs(values[:, 0]) if np.iscomplexobj(values)
                                 else values[:, 0], 0)  # fmt: skip
        return notebooks.shown("Solution", rows, picture)

    def tree_flatten(self):
        return (self._values, self.cloud, self._fit, self._fitted, self.converged, self.iterations), self._recipe

    @classmethod
    def tree_unflatten(cls, recipe, leaves):
        new = object.__new__(cls)
        new._values, new.cloud, new._fit, new._fitted, new.converged, new.iterations = leaves
        new._values, new._fitted = owned(new._values), owned(new._fitted)
        new._recipe = recipe
        new.stats = {}
        new._report, new._found, new._error, new._share, new._untold = None, None, None, 0.0, ""
        return new

    def __getstate__(self):
        # Records need not pickle: what they give, the local polynomials, does.
        fitted = jax.tree.map(np.asarray, self._taylor)
        return {**self.__dict__, "_fit": None, "_fitted": fitted, "_found": self.flags, "_report": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({name: frozen(value) for name, value in state.items()})
