"""What a solution is anywhere: values, derivatives and integrals of its local Taylor polynomials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.quadrature import rule
from jsmitsm.runtime.arrays import ArrayLike, ValueOrFunction
from jsmitsm.runtime.errors import explaining, is_whole, refuse_no_switch
from jsmitsm.runtime.tracers import Copied, frozen, is_traced
from jsmitsm.solution.evaluation import checked_points, evaluated, in_domain, nearest_particles
from jsmitsm.solution.fit import Recipe


class Anywhere(Copied):
    """Local Taylor polynomials ``_taylor`` (N, F, K) about the particles of a cloud, and what follows from them."""

    cloud: Cloud
    _recipe: Recipe

    _values: Any  # (N, F)
    _fitted: Any  # (N, F, K) or None
    _fit: Any  # a pytree with a method .coefficients(values) and friends

    @property
    def order(self) -> int:
        """The degree of the local fits."""
        return self._recipe.order

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
    @explaining
    def _taylor(self) -> Any:
        """Taylor coefficients (N, F, K)."""
        self.refuse_stacked()
        if self._fitted is None:
            fitted = self._expanded()
            if is_traced(fitted):
                return fitted
            self._fitted = frozen(fitted)
        return self._fitted

    def _expanded(self) -> Any:
        """Taylor coefficients (N, F, K), fitted to the values."""
        return self._fit.coefficients(self._values)

    @explaining
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

    @explaining
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

    @explaining
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
        whole = isinstance(multi_index, (tuple, list)) and all(is_whole(v) for v in multi_index)
        b = tuple(map(int, multi_index)) if whole else ()
        if len(b) != self.cloud.dim or min(b) < 0 or sum(b) > self.order:
            raise ValueError(
                f"multi_index: expected {self.cloud.dim} non-negative orders with a sum of at most {self.order}, "
                f"got {multi_index!r}"
            )
        refuse_no_switch("blend", blend)
        near, weight, first = nearest_particles(self.cloud, points, self.cloud.dim + 2 if blend else 1)
        inside = in_domain(self.cloud, points, outside, first)
        values = evaluated(b, self._recipe.reach, self.cloud.points, self._taylor, points, near, weight)
        xp = jnp if is_traced(values, inside) else np
        values = values if inside is None else xp.where(inside[:, None], values, xp.nan)
        values = values[:, 0] if self._recipe.fields == 1 else values
        return jax.device_put(values) if xp is np else values

    @explaining
    def integral(self, group: str | None = None) -> jax.Array:
        """The integral of u over a boundary group, or without a name over the domain.

        Of the order of the solution, on curved domains and boundaries too; ``js.quadrature`` says where it is not.

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
        >>> sol = js.solve(
        ...     js.Problem(lambda u, x: js.laplacian(u)(x) - 2.0, ends),
        ...     js.interval(0.0, 1.0, 9),
        ... )
        >>> round(float(sol.integral()), 12)  # of x^2
        0.333333333333
        """
        self.refuse_stacked()
        points, weights, _ = rule(self.cloud, group, self.order, self._recipe.otherwise)
        return jnp.tensordot(weights, self(points, outside="extrapolate"), axes=1)

    @explaining
    def flux(self, group: str, conductivity: ValueOrFunction = 1.0) -> jax.Array:
        """The integral of conductivity n . grad u over a boundary group, n outward.

        Of the order of the solution, but at the edges of solids; ``js.quadrature`` says what holds there.

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
        points, weights, normals = rule(self.cloud, group, self.order, self._recipe.otherwise)
        if callable(conductivity):
            conductivity = jax.vmap(conductivity)(points)
        elif not is_traced(conductivity) and np.asarray(conductivity).dtype.kind not in "iuf":
            raise ValueError(f"conductivity: expected a number or a function of one point x, got {conductivity!r}")
        slope = jnp.einsum("q...d,qd->q...", self.grad(points, outside="extrapolate"), normals)
        return jnp.tensordot(weights * conductivity, slope, axes=1)
