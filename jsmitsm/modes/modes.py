"""Modes of an operator: values, vectors, and local polynomials between the particles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.discretization.layout import table
from jsmitsm.discretization.regions.layout import Regions
from jsmitsm.modes.estimate import conditions, errors
from jsmitsm.modes.mass import mass_times
from jsmitsm.modes.question import Question
from jsmitsm.modes.spectrum import Pairs
from jsmitsm.runtime import notebooks
from jsmitsm.runtime.arrays import Array, ArrayLike
from jsmitsm.runtime.errors import explained, explaining, is_whole, short, some
from jsmitsm.runtime.tracers import Copied, frozen, is_traced, owned
from jsmitsm.solution.fit import Fit, Recipe
from jsmitsm.solution.regions.fit import RegionsFit
from jsmitsm.solution.regions.solution import RegionsSolution
from jsmitsm.solution.solution import Solution

# An estimated error above this part of the value is a flag; of values near zero, of this part of the largest.
LARGE, SMALL = 0.02, 0.01
# A condition number of a value above this says that the operator is far from self-adjoint.
LOOSE = 1e3


@jax.tree_util.register_pytree_node_class
class Modes(Copied):
    """Eigenvalues and modes of an operator, by their distance from what was asked for.

    ``modes(j, points)`` evaluates mode j at points (M, D), ``modes.grad(j, points)`` its gradient: by local Taylor
    polynomials, which satisfy L u = lambda mass u. ``js.plot.values(cloud, modes.u[:, j])`` draws it.

    Attributes
    ----------
    values : array (k,)
        (k,) eigenvalues; real, unless one has an imaginary part beyond its estimated error.
    u : array (N, k) or (N, k, F)
        (N, k) the modes at the particles, (N, k, F) for a system. The mean of their square over the particles is 1,
        and their largest value is positive.
    converged : bool
        Whether the values were found.
    residuals : array (k,)
        (k,) largest entries of A u - lambda B mass u, relative to those of A u's terms.
    stats : dict
        Seconds, and sizes.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> string = js.Problem(lambda u, x: -js.laplacian(u)(x), ends)
    >>> modes = js.eigen(string, js.interval(0.0, 1.0, 41), 2)
    >>> modes
    Modes(2 of 41 particles, order=6, from 9.8696 to 39.4784)
    >>> modes.u.shape, round(float(modes(0, [[0.5]])[0] ** 2), 3)  # 2 sin^2 41/40
    ((41, 2), 2.05)
    >>> bool((modes.error_estimate() < 1e-6 * modes.values).all())
    True
    """

    def __init__(self, values, u, cloud, converged, stats, question, found):
        self._values, self._u = frozen(values), frozen(u)  # (k,), (N, k, F)
        self.cloud: Cloud = cloud
        self.converged: bool | jax.Array = converged
        self.stats: dict[str, Any] = stats
        self._question: Question | None = question
        self._found: Pairs | None = found
        self._errors: np.ndarray | None = None
        self._fitted: dict[int, Solution] = {}

    @property
    def values(self) -> Array:
        """The eigenvalues (k,)."""
        return self._values

    @property
    def u(self) -> Array:
        """The modes (N, k) at the particles; (N, k, F) for a system."""
        return self._u[..., 0] if np.shape(self._u)[-1] == 1 else self._u

    def __len__(self) -> int:
        return int(np.shape(self._values)[-1])

    @explaining
    def __call__(self, k: int, points: ArrayLike, *, blend: bool = False, outside: str = "nan") -> jax.Array:
        """A mode anywhere.

        Parameters
        ----------
        k : int
            Its number.
        points : array_like (M, D)
            Where.
        blend, outside : optional
            As for ``js.Solution``.

        Returns
        -------
        jax.Array
            (M,), for a system (M, F).

        Raises
        ------
        ValueError
            For other numbers, complex modes, and points of another shape.

        Examples
        --------
        >>> import jax, jsmitsm as js; jax.config.update("jax_enable_x64", True)
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> string = js.Problem(lambda u, x: -js.laplacian(u)(x), ends)
        >>> modes = js.eigen(string, js.interval(0.0, 1.0, 41), 2)
        >>> bool(abs(modes(1, [[0.5]])[0]) < 1e-4)
        True
        """
        return self._between(k)(points, blend=blend, outside=outside)

    @explaining
    def grad(self, k: int, points: ArrayLike, *, blend: bool = False, outside: str = "nan") -> jax.Array:
        """The gradient of a mode anywhere.

        Parameters
        ----------
        k : int
            Its number.
        points : array_like (M, D)
            Where.
        blend, outside : optional
            As for ``js.Solution``.

        Returns
        -------
        jax.Array
            (M, D), for a system (M, F, D).

        Raises
        ------
        ValueError
            For other numbers, complex modes, and points of another shape.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> string = js.Problem(lambda u, x: -js.laplacian(u)(x), ends)
        >>> modes = js.eigen(string, js.interval(0.0, 1.0, 41), 2)
        >>> bool(abs(modes.grad(0, [[0.5]])[0, 0]) < 1e-4)
        True
        """
        return self._between(k).grad(points, blend=blend, outside=outside)

    @explaining
    def derivative(self, k: int, points: ArrayLike, multi_index: Sequence[int], *, outside: str = "nan") -> jax.Array:
        """Any derivative d^b of a mode anywhere.

        Parameters
        ----------
        k : int
            Its number.
        points : array_like (M, D)
            Where.
        multi_index : sequence of int (D,)
            b, the order along each axis.
        outside : optional
            As for ``js.Solution``.

        Returns
        -------
        jax.Array
            (M,), for a system (M, F).

        Raises
        ------
        ValueError
            For other numbers, complex modes, wrong points or orders.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> string = js.Problem(lambda u, x: -js.laplacian(u)(x), ends)
        >>> modes = js.eigen(string, js.interval(0.0, 1.0, 41), 2)
        >>> round(float(modes.derivative(0, [[0.5]], (2,))[0] / modes(0, [[0.5]])[0]), 3)
        -9.87
        """
        return self._between(k).derivative(points, multi_index, outside=outside)

    def _between(self, k: Any) -> Solution:
        """Mode k with its local polynomials: those of the equation L u - lambda mass u = 0."""
        n = len(self)
        if not is_whole(k, -n, n - 1):
            raise ValueError(f"k: expected the number of a mode, 0 to {n - 1}, got {short(k)}")
        k = int(k) % n
        if k in self._fitted:
            return self._fitted[k]
        q = self._known("modes between the particles")
        value, u = self._values[k], self._u[:, k]
        if not is_traced(value) and np.iscomplexobj(value) and (value.imag != 0 or np.abs(u.imag).max() > 0):
            raise ValueError(
                f"k: mode {k} is complex, and local polynomials are real; take its values at the particles, .u[:, {k}]"
            )
        value, u = (jnp.real(x) if is_traced(x) else np.real(x) for x in (value, u))
        written, number = q.problem, jnp.asarray(value)

        def shifted(operator: Any, mass: Any) -> Any:
            return lambda u, x, *params: operator(u, x, *params) - number * mass_times(written, mass, u, x)

        disc: Any = q.pencil.layout.disc
        recipe = Recipe("S", q.order, None, "loo", written.fields, q.depth)
        made: Solution
        if isinstance(disc, Regions):
            pde = {n: shifted(f, q.mass[n] if isinstance(q.mass, Mapping) else q.mass) for n, f in written.pde.items()}
            whole = RegionsFit(written.replace(pde=pde), disc.cloud, disc.near, None, recipe)
            made = RegionsSolution(u, disc.cloud, recipe, whole, self.converged, 1, {})
        else:
            disc.classes = [cls for cls, _ in q.pencil.layout.classes]
            fit = Fit(written.replace(pde=shifted(written.pde, q.mass)), disc.cloud, None, table(disc), None, recipe)
            made = Solution(u, disc.cloud, recipe, fit, self.converged, 1, {})
        if not is_traced(value, u):
            self._fitted[k] = made
        return made

    def _known(self, what: str) -> Question:
        if np.ndim(self._values) != 1:
            raise ValueError(
                "these Modes are a stack that came out of jax.vmap, of which only values, u and converged can be read"
            )
        if self._question is None:
            raise ValueError(f"{what}: these Modes came out of a JAX transform or a pickle, which keep values and u "
                             "alone; ask inside, or before")  # fmt: skip
        return self._question

    @property
    def residuals(self) -> np.ndarray:
        """The largest entry (k,) of A u - lambda B mass u, relative to the sum of the sizes of its terms."""
        found = self._host("residuals")
        q = self._known("residuals")
        a = q.stiff.host
        rest = np.abs(a @ found.right - (q.inert.host @ found.right) * found.values).max(axis=0)
        return rest / (abs(a) @ np.abs(found.right)).max(axis=0)

    def _host(self, what: str) -> Pairs:
        self._known(what)
        if self._found is None:
            raise ValueError(f"{what}: these Modes were made under a JAX transform, or not found; ask outside of it")
        return self._found

    @explaining
    def error_estimate(self) -> np.ndarray:
        """Estimated errors of the values, by the pencil of order p + 2, assembled when first asked for.

        In one region jumps and corners count too, which no order sees. For values of a cluster that of the cluster.
        Infinite where there is no other order to compare with.

        Returns
        -------
        array (k,)
            In units of the values.

        Raises
        ------
        ValueError
            For modes that were made under a JAX transform, or pickled.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> string = js.Problem(lambda u, x: -js.laplacian(u)(x), ends)
        >>> modes = js.eigen(string, js.interval(0.0, 1.0, 41), 2)
        >>> bool((modes.error_estimate() < 1e-6 * modes.values).all())
        True
        """
        if self._errors is None:
            found, question = self._host("error_estimate"), self._known("error_estimate")
            self._errors = frozen(errors(question, found, self._between))
        return self._errors

    @property
    def flags(self) -> list[str]:
        """What speaks against these modes, a sentence each; none for healthy ones.

        A value whose estimated error is large is not resolved, or spurious. Asks for the error estimate.
        """
        if not is_traced(self.converged) and not np.all(self.converged):
            return ["The values were not found."]
        error, part = self.error_estimate(), self._part()
        out = []
        if np.isinf(error).any():
            out.append("There is no error estimate: the cloud has too few particles for expansions of another order.")
        if len(bad := np.flatnonzero(np.isfinite(part) & (part > LARGE))):
            out.append(
                f"{len(bad)} of {len(part)} modes, {some(bad)}, are not resolved, or spurious: their estimated errors "
                f"are up to {part[bad].max():.0%} of their values; refine the cloud, or raise the order."
            )
        short_waves = np.setdiff1d(np.flatnonzero(np.abs(self._values) > self._known("flags").highest()), bad)
        if len(short_waves):
            out.append(
                f"{len(short_waves)} of {len(part)} modes, {some(short_waves)}, have waves shorter than four "
                "particles, which the cloud does not resolve: refine it, or ask for fewer."
            )
        feel = conditions(self._known("flags"), self._host("flags"))
        loose = np.setdiff1d(np.flatnonzero(feel > LOOSE), bad)
        if len(loose):
            out.append(
                f"{len(loose)} of {len(part)} values, {some(loose)}, feel small errors {feel.max():.0e} "
                "times, since the operator is far from self-adjoint, as strong convection makes it: the error estimate "
                "says little; write u = exp(b . x / 2) v for a drift b, or compare with a finer cloud."
            )
        return explained(out + self._known("flags").poles())

    def _part(self) -> np.ndarray:
        """The estimated errors (k,) relative to the values, or to a part of the largest, where those are small."""
        values = np.abs(self._values)
        size = np.maximum(values, SMALL * values.max(initial=0.0))
        return self.error_estimate() / np.where(size > 0, size, 1.0)

    def diagnose(self) -> str:
        """In words: how well the values are known, which are multiple, and what was repaired.

        Returns
        -------
        str
            Several lines; those that begin with FLAG speak against the modes.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> string = js.Problem(lambda u, x: -js.laplacian(u)(x), ends)
        >>> modes = js.eigen(string, js.interval(0.0, 1.0, 41), 2)
        >>> "FLAG" in modes.diagnose()
        False
        """
        lines = [repr(self)]
        lines += [f"FLAG: {line}" for line in self.flags]
        if not np.all(self.converged):
            return "\n".join(lines)
        found, q = self._host("diagnose"), self._known("diagnose")
        for cluster in np.unique(found.cluster):
            at = np.flatnonzero(found.cluster == cluster)
            if len(at) > 1:
                lines.append(
                    f"Modes {at[0]} to {at[-1]} are of one value, or nearly: together they span its modes, each by "
                    "itself is arbitrary."
                )
        if np.iscomplexobj(self._values):
            lines.append("Some values are complex by more than their error: the operator is not self-adjoint.")
        lines.append(f"The estimated errors are up to {self._part().max():.1e} of the values.")
        lines.append(f"The largest residual is {self.residuals.max():.1e}.")
        fitness = q.pencil.layout.fitness
        if fitness is not None:
            lines.append(
                f"Largest Lebesgue constant {fitness.lebesgue:.3g} (up to 1.5 is healthy), sources of the neighbours "
                f"up to {fitness.dominance:.3g} times the own."
            )
        return "\n".join([*lines, *q.pencil.health])

    def __repr__(self) -> str:
        n, k = len(self.cloud), len(self)
        order = "" if self._question is None else f", order={self._question.order}"
        if is_traced(self._values) or np.ndim(self._values) != 1:
            return f"Modes({k} of {n} particles{order})"
        first, last = (f"{complex(x):.6g}" if np.iscomplexobj(x) else f"{float(x):.6g}" for x in self._values[[0, -1]])
        return f"Modes({k} of {n} particles{order}, from {first} to {last})"

    def _repr_html_(self) -> str:
        if is_traced(self._values, self._u) or np.ndim(self._values) != 1:
            return repr(self)
        known = [""] * len(self) if self._errors is None else [f", error {e:.0e}" for e in self._errors]
        rows = [(f"value {k}", f"{v:.6g}{e}") for k, (v, e) in enumerate(zip(self._values[:12], known))]
        first = np.real(np.asarray(self._u)[:, 0, 0]) if len(self) else np.zeros(len(self.cloud))
        return notebooks.shown(repr(self), rows, notebooks.dots(np.asarray(self.cloud.points), first, 0))

    def tree_flatten(self):
        return (self._values, self._u, self.cloud, self.converged), None

    @classmethod
    def tree_unflatten(cls, _, leaves):
        new = object.__new__(cls)
        values, u, new.cloud, new.converged = leaves
        new._values, new._u = owned(values), owned(u)
        new.stats, new._question, new._found, new._errors, new._fitted = {}, None, None, None, {}
        return new

    def __getstate__(self):
        return {**self.__dict__, "_question": None, "_found": None, "_fitted": {}}
