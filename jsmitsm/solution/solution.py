"""The solution: values at the particles, local Taylor polynomials, evaluation anywhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.quadrature import quadrature
from jsmitsm.runtime.arrays import Array, ArrayLike, ValueOrFunction
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.tracers import frozen, is_traced, owned
from jsmitsm.solution.estimate import Correction, correction
from jsmitsm.solution.evaluation import checked_points, evaluated, in_domain, nearest_particles
from jsmitsm.solution.fit import Recipe
from jsmitsm.solution.flags import share

# An estimated error above this part of the solution is a flag.
LARGE = 0.02


class Report(Protocol):
    """What the solve can still say of itself when asked."""

    def flags(self, estimated: Callable[[], float]) -> list[str]: ...

    def condition_numbers(self) -> tuple[np.ndarray, float]: ...


@jax.tree_util.register_pytree_node_class
class Solution:
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
    >>> sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 6 * x[0], ends), js.interval(0.0, 1.0, 9))
    >>> sol
    Solution(u: 9, method='S', order=4, converged=True)
    >>> [round(float(value[0]), 9) for value in (sol([[0.3]]), sol.grad([[0.3]])[0], sol.derivative([[0.3]], (2,)))]
    [0.027, 0.27, 1.8]
    >>> round(float(sol.flux("right")), 9), sol.coefficients.shape, bool(sol.error_estimate().max() < 1e-12), sol.flags
    (3.0, (9, 5), True, [])
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
    def order(self) -> int:
        """The degree of the local fits."""
        return self._recipe.order

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

    def refuse_stacked(self) -> None:
        """Several solutions that came out of jax.vmap as one have values, and nothing else in common."""
        stack = jnp.shape(self._values)[:-2]
        if stack:
            raise ValueError(
                f"this Solution is a stack of {'x'.join(map(str, stack))} that came out of jax.vmap, of which only u "
                "and converged can be read: ask inside the mapped function, or take one, "
                "jax.tree.map(lambda x: x[0], sol)"
            )

    @property
    def unknowns(self) -> dict[str, Any]:
        """The global unknowns that were found with u, by their names; none for a problem without them."""
        return {}

    @property
    def coefficients(self) -> Array:
        """Taylor coefficients d^a u / a!, (N, K), ordered as ``js.multi_indices``; (N, K, F) for a system."""
        fitted = self._taylor
        return fitted[:, 0] if self._recipe.fields == 1 else jnp.swapaxes(fitted, 1, 2)

    @property
    def _taylor(self) -> Any:
        """Taylor coefficients (N, F, K)."""
        self.refuse_stacked()
        if self._fitted is None:
            fitted = self._fit.coefficients(self._values)
            if is_traced(fitted):
                return fitted
            self._fitted = frozen(fitted)
        return self._fitted

    def __call__(self, points: ArrayLike, *, blend: bool = False, outside: str = "nan") -> jax.Array:
        """Values anywhere, from the local Taylor polynomials.

        Each point takes the polynomial of its nearest particle, or with ``blend`` a smooth average
        of those of its nearest few, which is continuous across the cloud.

        Parameters
        ----------
        points : array_like (M, D)
            Where.
        blend : bool
            Average the polynomials of the nearest few particles.
        outside : {"nan", "raise", "extrapolate"}
            What becomes of points outside of the domain and in its holes: NaN, a ValueError, or the polynomial of
            the particle nearest to them. Points up to half the local spacing outside count as inside. The particles
            tell what is inside; where all of a cloud's points are traced by jax.jit or jax.vmap nothing is known of
            them, and everything counts as inside.

        Returns
        -------
        jax.Array
            (M,), for a system (M, F).

        Raises
        ------
        ValueError
            For points of another shape, NaN or infinite ones.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
        >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 6 * x[0], ends)  # x^3
        >>> sol = js.solve(problem, js.interval(0.0, 1.0, 9))
        >>> round(float(sol([[0.5]])[0]), 9)
        0.125
        """
        return self.derivative(points, (0,) * self.cloud.dim, blend=blend, outside=outside)

    def grad(self, points: ArrayLike, *, blend: bool = False, outside: str = "nan") -> jax.Array:
        """Gradients anywhere.

        Parameters
        ----------
        points : array_like (M, D)
            Where.
        blend : bool
            Average the polynomials of the nearest few particles, as for values.
        outside : {"nan", "raise", "extrapolate"}
            What becomes of points outside of the domain, as for values.

        Returns
        -------
        jax.Array
            (M, D), for a system (M, F, D).

        Raises
        ------
        ValueError
            For points of another shape, NaN or infinite ones.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
        >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 6 * x[0], ends)  # x^3
        >>> sol = js.solve(problem, js.interval(0.0, 1.0, 9))
        >>> round(float(sol.grad([[0.5]])[0, 0]), 9)
        0.75
        """
        unit = [tuple(map(int, b)) for b in np.eye(self.cloud.dim, dtype=int)]
        return jnp.stack([self.derivative(points, b, blend=blend, outside=outside) for b in unit], axis=-1)

    def derivative(
        self, points: ArrayLike, multi_index: Sequence[int], *, blend: bool = False, outside: str = "nan"
    ) -> jax.Array:
        """Any derivative d^b u anywhere.

        Parameters
        ----------
        points : array_like (M, D)
            Where.
        multi_index : sequence of int (D,)
            b, the order along each axis, together at most the order.
        blend : bool
            Average the polynomials' derivatives, as for values.
        outside : {"nan", "raise", "extrapolate"}
            What becomes of points outside of the domain, as for values.

        Returns
        -------
        jax.Array
            (M,), for a system (M, F).

        Raises
        ------
        ValueError
            For wrong points or orders.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
        >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 6 * x[0], ends)  # x^3
        >>> sol = js.solve(problem, js.interval(0.0, 1.0, 9))
        >>> round(float(sol.derivative([[0.5]], (2,))[0]), 9)
        3.0
        """
        self.refuse_stacked()
        points = checked_points(points, self.cloud.dim)
        whole = isinstance(multi_index, (tuple, list)) and all(isinstance(v, (int, np.integer)) for v in multi_index)
        b = tuple(map(int, multi_index)) if whole else ()
        if len(b) != self.cloud.dim or min(b) < 0 or sum(b) > self.order:
            raise ValueError(
                f"multi_index: expected {self.cloud.dim} non-negative orders with a sum of at most {self.order}, "
                f"got {multi_index!r}"
            )
        near, weight = nearest_particles(self.cloud, points, self.cloud.dim + 2 if blend else 1)
        inside = in_domain(self.cloud, points, outside)
        values = evaluated(b, self._recipe.reach, self.cloud.points, self._taylor, points, near, weight)
        values = values if inside is None else jnp.where(inside[:, None], values, jnp.nan)
        return values[:, 0] if self._recipe.fields == 1 else values

    def integral(self, group: str | None = None) -> jax.Array:
        """The integral of u over a boundary group, or without a name over the domain.

        That over the domain has the order of the solution, on curved domains too; see ``js.quadrature``.

        Parameters
        ----------
        group : str, optional
            The name of a boundary group.

        Returns
        -------
        jax.Array
            A scalar, for a system (F,); units of u times length, area or volume.

        Raises
        ------
        ValueError
            For a group that is no boundary group.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
        >>> sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 2.0, ends), js.interval(0.0, 1.0, 9))
        >>> round(float(sol.integral()), 12)  # of x^2
        0.333333333333
        """
        self.refuse_stacked()
        points, weights, _ = quadrature(self.cloud, group, self.order)
        return jnp.tensordot(weights, self(points, outside="extrapolate"), axes=1)

    def flux(self, group: str, conductivity: ValueOrFunction = 1.0) -> jax.Array:
        """The integral of conductivity n . grad u over a boundary group, n outward.

        Parameters
        ----------
        group : str
            The name of a boundary group.
        conductivity : float or function
            A number, or a function of one point x (D,).

        Returns
        -------
        jax.Array
            A scalar, for a system (F,).

        Raises
        ------
        ValueError
            For a group that is no boundary group.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
        >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 6 * x[0], ends)  # x^3
        >>> sol = js.solve(problem, js.interval(0.0, 1.0, 9))
        >>> round(float(sol.flux("right", conductivity=2.0)), 9)
        6.0
        """
        self.refuse_stacked()
        points, weights, normals = quadrature(self.cloud, group)
        if callable(conductivity):
            conductivity = jax.vmap(conductivity)(points)
        elif not is_traced(conductivity) and np.asarray(conductivity).dtype.kind not in "iuf":
            raise ValueError(f"conductivity: expected a number or a function of one point x, got {conductivity!r}")
        slope = jnp.einsum("q...d,qd->q...", self.grad(points, outside="extrapolate"), normals)
        return jnp.tensordot(weights * conductivity, slope, axes=1)

    def error_estimate(self) -> Array:
        """Estimated error |u - u_exact| at every particle, by defect correction.

        Computed when asked for: one more assembly at order p + 2 and one solve with the kept factors.

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
        return self._kept(own(self._values)) if own else self._size(correction(self._fit, self._values))

    def _size(self, found: Correction) -> Array:
        """The size of an estimated error, kept for the next who asks."""
        return self._kept(abs(found.error)[..., 0] if self._recipe.fields == 1 else abs(found.error))

    def _kept(self, error: Array) -> Array:
        if not is_traced(error, self._values):
            self._error = frozen(error)
            self._share = share(np.reshape(error, np.shape(self._values)), np.asarray(self._values))
        return error

    @property
    def defects(self) -> bool:
        """Whether the estimate knows defects, and :meth:`correction` more than the size of the error."""
        return not hasattr(self._fit, "error_estimate")

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
        found = correction(self._fit, self._values)
        self._size(found)
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
    def flags(self) -> list[str]:
        """What speaks against this solution, a sentence each; none for a healthy one.

        Tested when first asked for: roughness between neighbours, near singularity, an unresolved
        source or coefficient, hopeless stencils, misfits of the equation. Linear problems of one field that pass
        by far are cleared. For all others, of up to 200,000 particles, the error is estimated: below 2 % clears what
        is only suspected, above is a flag. No flag is no proof.
        """
        self.refuse_stacked()
        if self._found is None and self._report is not None:
            self._found = self._report.flags(self._estimated)
        large = f"The estimated error is {self._share:.0%} of the solution: refine the cloud, or change the order."
        return [*(self._found or []), *self.stats.get("objections", []), *([] if self._share <= LARGE else [large])]

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
        lines += [f"FLAG: {line}" for line in self.flags if line not in told]
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
