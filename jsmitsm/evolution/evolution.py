"""What an evolution returns: saved states, anything between them, and what speaks against them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.evolution.space.local_fits import state_fit
from jsmitsm.evolution.steps import dense_output
from jsmitsm.runtime import notebooks
from jsmitsm.runtime.arrays import Array
from jsmitsm.runtime.errors import explained, explaining
from jsmitsm.runtime.tracers import Copied, frozen, is_traced
from jsmitsm.solution.fit import Recipe
from jsmitsm.solution.regions.solution import RegionsSolution
from jsmitsm.solution.solution import Solution


@jax.tree_util.register_pytree_node_class
class Evolution(Copied):
    """A solution in time, at saved moments and between them.

    ``at(t)`` is the solution at any time, callable like a ``js.Solution``. To go on from the end give
    ``u0=run.u[-1]``, of second order ``u0=(run.u[-1], run.rate[-1])``.

    Attributes
    ----------
    t : array (S,)
        (S,) the saved times, from the start to the end.
    u : array (S, N) or (S, N, F)
        (S, N) values at the particles, (S, N, F) for a system.
    rate : array (S, N) or (S, N, F), optional
        The same of du/dt for a problem of second order in time, else None.
    converged : bool
        Whether the run reached its end.
    flags : list of str
        Sentences that speak against it; none for a healthy one.
    stats : dict
        Seconds, steps, scheme, factorisations, what was skipped.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ends)
    >>> run = js.evolve(
    ...     heat,
    ...     js.interval(0.0, 1.0, 21),
    ...     lambda x: jnp.sin(jnp.pi * x[0]),
    ...     t=(0.0, 0.1),
    ...     steps=20,
    ... )
    >>> run
    Evolution(t: 0 to 0.1, u: 2x21, converged=True)
    >>> bool(abs(run.at(0.05)([[0.5]])[0] - jnp.exp(-jnp.pi**2 * 0.05)) < 1e-4)
    True
    """

    def __init__(self, t, u, rate, cloud, recipe, converged, stats, history=None, report=None, fit=None):
        self.t = frozen(t)
        self._u, self._rate = frozen(u), frozen(rate)  # (S, N, F)
        self.cloud: Cloud = cloud
        self._recipe: Recipe = recipe
        self.converged: bool | jax.Array = converged
        self.stats: dict[str, Any] = stats
        self._history = history  # times (K,), values (K, N, F): what lies between the saved moments
        self._report: Report | None = report
        self._fit = fit

    @property
    def u(self) -> Array:
        """Values (S, N), or (S, N, F) for a system."""
        return self._u[..., 0] if self._recipe.fields == 1 else self._u

    @property
    def rate(self) -> Array | None:
        """du/dt at the saved times, of a problem of second order in time."""
        if self._rate is None:
            return None
        return self._rate[..., 0] if self._recipe.fields == 1 else self._rate

    @property
    @explaining
    def flags(self) -> list[str]:
        """What speaks against this evolution, a sentence each."""
        return [] if self._report is None else explained(self._report.flags)

    def diagnose(self) -> str:
        """In words: how the run went.

        Returns
        -------
        str
            Several lines; those that begin with FLAG speak against the run.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp, jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ends)
        >>> start = lambda x: jnp.sin(jnp.pi * x[0])
        >>> run = js.evolve(heat, js.interval(0.0, 1.0, 21), start, t=(0.0, 0.1), steps=20)
        >>> "FLAG" in run.diagnose()
        False
        """
        lines = [repr(self)]
        if not is_traced(self.converged) and not bool(np.all(self.converged)):
            lines.append(f"The run did NOT reach its end; the last good state is that of t = {float(self.t[-1]):g}.")
        lines += [f"FLAG: {line}" for line in self.flags]
        if self._report is not None:
            lines += self._report.told
        s = self.stats
        if "steps" in s:
            lines.append(
                f"{s['steps']} steps of {s['scheme']}"
                + (f", {s['rejected']} more rejected" if s.get("rejected") else "")
                + f", {s.get('factorisations', 0)} factorisation(s)."
            )
        if s.get("error_in_time") is not None:
            lines.append(f"The estimated error in time is {s['error_in_time']:.1e} of the solution.")
        return "\n".join(lines)

    @explaining
    def at(self, t: Any) -> Solution:
        """The solution at any time: values anywhere, gradients, integrals.

        Between the steps of the run by the polynomial in t through the six nearest of them.

        Parameters
        ----------
        t : float
            The time.

        Returns
        -------
        Solution
            Of that moment.

        Raises
        ------
        ValueError
            For times outside of the run.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp, jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ends)
        >>> start = lambda x: jnp.sin(jnp.pi * x[0])
        >>> run = js.evolve(heat, js.interval(0.0, 1.0, 21), start, t=(0.0, 0.1), steps=20)
        >>> round(float(run.at(0.05)([[0.5]])[0]), 3)
        0.611
        """
        if is_traced(self._u) or jnp.ndim(self._u) != 3:
            raise ValueError(
                "at: inside of a JAX transform, or of what jax.vmap made, only .t and .u can be read; make what is "
                "wanted of the values at the particles, an integral as js.node_weights(cloud) @ run.u[-1] (docs: time)"
            )
        try:
            time = float(t)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"t: expected a number, got {t!r}") from None
        times, values = (np.asarray(self.t), np.asarray(self._u)) if self._history is None else self._history
        slack = 1e-12 * (times[-1] - times[0])
        if not times[0] - slack <= time <= times[-1] + slack:
            raise ValueError(f"t: {time:g} is outside of the run, from {times[0]:g} to {times[-1]:g}")
        index, weights = dense_output.weights(times, np.array([time]))
        u = np.tensordot(weights[0], np.asarray(values)[index[0]], axes=1)
        return self._solution(u, time)

    def _solution(self, u: np.ndarray, time: float) -> Solution:
        stats = {"messages": [f"The state at t = {time:g} of an evolution."]}
        if self._fit is None:
            self._fit = state_fit(self.cloud, self._recipe.reach)
        kind = RegionsSolution if isinstance(self.cloud, RegionCloud) else Solution
        return kind(u, self.cloud, self._recipe, self._fit, self.converged, 1, stats)

    @explaining
    def error_estimate(self) -> Array:
        """Estimated error at every particle and saved time.

        In space by the defect that a pencil of order p + 2 finds, in time by what the scheme says of its steps, and the
        interpolation of states between them. Computed when asked; from then on an error above 2 % of the solution is
        a flag, that of a field by its own size. Where order p + 2 makes more of it than there is of the solution,
        another order is asked.

        Returns
        -------
        array (S, N) or (S, N, F)
            In units of u.

        Raises
        ------
        ValueError
            For what came out of a JAX transform or a pickle.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp, jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ends)
        >>> start = lambda x: jnp.sin(jnp.pi * x[0])
        >>> run = js.evolve(heat, js.interval(0.0, 1.0, 21), start, t=(0.0, 0.1), steps=20)
        >>> run.error_estimate().shape
        (2, 21)
        """
        if self._report is None:
            raise ValueError(
                "error_estimate: this evolution came out of a JAX transform or a pickle; ask outside, before pickling"
            )
        found = self._report.estimate()
        return found[..., 0] if self._recipe.fields == 1 else found

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        shape = "x".join(map(str, self.u.shape))
        if is_traced(self.t, self.converged):
            return f"Evolution(u: {shape})"
        ends = f"t: {float(np.min(self.t)):g} to {float(np.max(self.t)):g}"
        return f"Evolution({ends}, u: {shape}, converged={bool(np.all(self.converged))})"

    def _repr_html_(self) -> str:
        if is_traced(self.t, self.u, self.converged) or np.ndim(self.t) != 1:
            return repr(self)
        last = np.asarray(self.u)[-1].reshape(len(self.cloud), -1)
        rows: list[tuple[str, Any]] = [("t", f"{notebooks.span(self.t)}, {len(self.t)} saved")]
        rows.append(("particles", len(self.cloud)))
        rows += [(f"u[{k}] at the end" if last.shape[1] > 1 else "u at the end", notebooks.span(v))
                 for k, v in enumerate(last.T)]  # fmt: skip
        rows += [("converged", bool(np.all(self.converged))), ("flags", " ".join(self.flags) or "none")]
        return notebooks.shown("Evolution", rows, notebooks.dots(np.asarray(self.cloud.points), last[:, 0], 0))

    @explaining
    def to_xarray(self) -> Any:
        """The saved states as a data set with the dimensions time, particle (and field).

        Returns
        -------
        xarray.Dataset
            ``u``, and ``rate`` for second order in time.

        Raises
        ------
        ImportError
            Where xarray is not installed.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp, jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ends)
        >>> start = lambda x: jnp.sin(jnp.pi * x[0])
        >>> run = js.evolve(heat, js.interval(0.0, 1.0, 21), start, t=(0.0, 0.1), steps=20)
        >>> run.to_xarray().u.dims
        ('time', 'particle')
        """
        try:
            import xarray
        except ImportError:
            raise ImportError("to_xarray: it needs the package xarray; pip install xarray") from None
        dims = ("time", "particle", "field")[: np.ndim(self.u)]
        points = np.asarray(self.cloud.points)
        places = {name: ("particle", points[:, k]) for k, name in zip(range(points.shape[1]), "xyz")}
        data = {"u": (dims, np.asarray(self.u))}
        if self.rate is not None:
            data["rate"] = (dims, np.asarray(self.rate))
        return xarray.Dataset(data, {"time": np.asarray(self.t), **places})

    def tree_flatten(self):
        return (self.t, self._u, self._rate, self.cloud, self.converged), self._recipe

    @classmethod
    def tree_unflatten(cls, recipe, leaves):
        new = object.__new__(cls)
        new.t, new._u, new._rate, new.cloud, new.converged = leaves
        new._recipe, new.stats, new._history, new._report = recipe, {}, None, None
        new._fit = None
        return new

    def __getstate__(self):
        return {**self.__dict__, "_report": None, "_fit": None}


class Report:
    """What a run can still say of itself when asked: its flags, and an estimate of its error.

    in_space: makes the error (N, F) in space at the end, u_exact - u with its sign.
    """

    def __init__(self, flags: list[str], told: list[str], estimate: Callable[[], Any], in_space: Callable[[], Any]):
        self.flags, self.told, self.in_space = flags, told, in_space
        self._estimate, self._found = estimate, None

    def estimate(self) -> Any:
        if self._found is None:
            self._found = frozen(self._estimate())
        return self._found
