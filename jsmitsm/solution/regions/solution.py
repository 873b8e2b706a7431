"""The solution in several regions: on every interface two values, one from either side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.regions.region_cloud import sides
from jsmitsm.runtime.arrays import ArrayLike, ValueOrFunction
from jsmitsm.runtime.errors import did_you_mean, explaining
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.evaluation import checked_points
from jsmitsm.solution.regions.between import out_of_reach
from jsmitsm.solution.regions.fit import RegionPart
from jsmitsm.solution.regions.located import located
from jsmitsm.solution.solution import Solution


@jax.tree_util.register_pytree_node_class
class RegionsSolution(Solution):
    """A solution in several regions: a ``js.Solution`` whose values jump where the problem says so.

    ``sol(points)`` takes the region in which each point lies, as the particles of the interfaces tell;
    ``sol(points, region="a")`` the expansions of that region, on the interface its side of it. ``sol.region("a")`` is
    the solution of one region alone. Integrals and fluxes over an interface ``"a|b"`` take the side ``region``.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
    >>> k = {"a": 1.0, "b": 3.0}
    >>> flux = {name: lambda u, x, n, k=k[name]: k * n @ js.grad(u)(x) for name in k}
    >>> bcs = {"boundary": js.dirichlet(lambda x: x[0]), "a|b": js.interface(flux=flux)}
    >>> sol = js.solve(
    ...     js.Problem({name: lambda u, x: js.laplacian(u)(x) for name in k}, bcs),
    ...     cloud,
    ... )
    >>> value, flux = sol([[0.5]], region="b")[0], sol.flux("a|b", region="a")
    >>> round(float(value), 12), round(float(flux), 12)
    (0.75, 1.5)
    """

    cloud: Any

    def _beyond(self, values: np.ndarray, known: np.ndarray) -> np.ndarray:
        return out_of_reach(self._report, values)

    @explaining
    def region(self, name: str) -> Solution:
        """The solution of one region, on its own cloud with outward normals.

        Parameters
        ----------
        name : str
            Of the region.

        Returns
        -------
        Solution
            Of that region alone.

        Raises
        ------
        ValueError
            For other names.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
        >>> k = {"a": 1.0, "b": 3.0}
        >>> flux = {name: lambda u, x, n, k=k[name]: k * n @ js.grad(u)(x) for name in k}
        >>> bcs = {"boundary": js.dirichlet(lambda x: x[0]), "a|b": js.interface(flux=flux)}
        >>> problem = js.Problem({name: lambda u, x: js.laplacian(u)(x) for name in k}, bcs)
        >>> sol = js.solve(problem, cloud)
        >>> len(sol.region("a").u)
        5
        """
        self.refuse_stacked()
        cloud, ids = self.cloud.region(name), self.cloud.regions[name]
        fitted = None if self._fitted is None else self._fitted[ids]
        fit = None if self._fit is None else RegionPart(self._fit, self._values, tuple(map(int, ids)))
        return Solution(
            self._values[ids], cloud, self._recipe, fit, self.converged, self.iterations, self.stats, fitted=fitted
        )

    def _one(self, name: str) -> Solution:
        """The same, once its polynomials are fitted."""
        found = self.__dict__.setdefault("_regions", {})
        if name in found:
            return found[name]
        taylor = self._taylor
        one = self.region(name)
        one._fitted = taylor[self.cloud.regions[name]]
        if not is_traced(taylor, self.cloud.points):
            found[name] = one
        return one

    @explaining
    def __call__(
        self, points: ArrayLike, *, region: str | None = None, blend: bool = False, outside: str = "nan"
    ) -> jax.Array:
        """Values anywhere.

        Parameters
        ----------
        points : array_like (M, D)
            Where.
        region : str, optional
            The region whose polynomials are taken; that in which each point lies if not given.
        blend, outside : optional
            As for ``js.Solution``.

        Returns
        -------
        jax.Array
            (M,), for a system (M, F).

        Raises
        ------
        ValueError
            For other names, and for points that are traced without ``region``.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
        >>> k = {"a": 1.0, "b": 3.0}
        >>> flux = {name: lambda u, x, n, k=k[name]: k * n @ js.grad(u)(x) for name in k}
        >>> bcs = {"boundary": js.dirichlet(lambda x: x[0]), "a|b": js.interface(flux=flux)}
        >>> problem = js.Problem({name: lambda u, x: js.laplacian(u)(x) for name in k}, bcs)
        >>> sol = js.solve(problem, cloud)
        >>> round(float(sol([[0.5]], region="a")[0]), 9)
        0.75
        """
        return self.derivative(points, (0,) * self.cloud.dim, region=region, blend=blend, outside=outside)

    @explaining
    def grad(
        self, points: ArrayLike, *, region: str | None = None, blend: bool = False, outside: str = "nan"
    ) -> jax.Array:
        """Gradients anywhere.

        Parameters
        ----------
        points : array_like (M, D)
            Where.
        region : str, optional
            The region whose polynomials are taken; that in which each point lies if not given.
        blend, outside : optional
            As for ``js.Solution``.

        Returns
        -------
        jax.Array
            (M, D), for a system (M, F, D).

        Raises
        ------
        ValueError
            For other names, and for points that are traced without ``region``.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
        >>> k = {"a": 1.0, "b": 3.0}
        >>> flux = {name: lambda u, x, n, k=k[name]: k * n @ js.grad(u)(x) for name in k}
        >>> bcs = {"boundary": js.dirichlet(lambda x: x[0]), "a|b": js.interface(flux=flux)}
        >>> problem = js.Problem({name: lambda u, x: js.laplacian(u)(x) for name in k}, bcs)
        >>> sol = js.solve(problem, cloud)
        >>> round(float(sol.grad([[0.5]], region="b")[0, 0]), 9)
        0.5
        """
        unit = [tuple(map(int, b)) for b in np.eye(self.cloud.dim, dtype=int)]
        made = [self.derivative(points, b, region=region, blend=blend, outside=outside) for b in unit]
        return jnp.stack(made, axis=-1)

    @explaining
    def derivative(
        self, points: ArrayLike, multi_index: Sequence[int], *, region: str | None = None, blend: bool = False,
        outside: str = "nan",
    ) -> jax.Array:  # fmt: skip
        """Any derivative d^b u anywhere.

        Parameters
        ----------
        points : array_like (M, D)
            Where.
        multi_index : sequence of int (D,)
            b, the order along each axis.
        region : str, optional
            The region whose polynomials are taken; that in which each point lies if not given.
        blend, outside : optional
            As for ``js.Solution``.

        Returns
        -------
        jax.Array
            (M,), for a system (M, F).

        Raises
        ------
        ValueError
            For other names, and for points that are traced without ``region``.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
        >>> k = {"a": 1.0, "b": 3.0}
        >>> flux = {name: lambda u, x, n, k=k[name]: k * n @ js.grad(u)(x) for name in k}
        >>> bcs = {"boundary": js.dirichlet(lambda x: x[0]), "a|b": js.interface(flux=flux)}
        >>> problem = js.Problem({name: lambda u, x: js.laplacian(u)(x) for name in k}, bcs)
        >>> sol = js.solve(problem, cloud)
        >>> round(float(sol.derivative([[0.25]], (1,))[0]), 9)
        1.5
        """
        self.refuse_stacked()
        if region is not None:
            return self._one(region).derivative(points, multi_index, blend=blend, outside=outside)
        at: Any = checked_points(points, self.cloud.dim)
        if is_traced(at) or isinstance(self.cloud.points, jax.core.Tracer):
            raise ValueError(
                "points: traced by a JAX transform, which side of an interface they are on is found on the host; name "
                'the region, sol(points, region="a")'
            )
        where = located(self.cloud, np.asarray(at))
        out: Any = None
        for k, name in enumerate(self.cloud.regions):
            here = np.flatnonzero(where == k)
            if len(here):
                made = self._one(name).derivative(at[here], multi_index, blend=blend, outside=outside)
                if out is None:
                    out = jnp.full((len(at), *made.shape[1:]), jnp.nan, made.dtype)
                out = out.at[here].set(made)
        return jnp.zeros((0, *jnp.shape(self.u)[1:])) if out is None else out

    def integral(self, group: str | None = None, *, region: str | None = None) -> jax.Array:
        """The integral of u over the domain or a region, over a boundary group, or over one side of an interface.

        Parameters
        ----------
        group : str, optional
            A boundary group or an interface ``"a|b"``; the domain if not given.
        region : str, optional
            The region; for an interface the side, which must be named.

        Returns
        -------
        jax.Array
            A scalar, for a system (F,).

        Raises
        ------
        ValueError
            For other names.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
        >>> k = {"a": 1.0, "b": 3.0}
        >>> flux = {name: lambda u, x, n, k=k[name]: k * n @ js.grad(u)(x) for name in k}
        >>> bcs = {"boundary": js.dirichlet(lambda x: x[0]), "a|b": js.interface(flux=flux)}
        >>> problem = js.Problem({name: lambda u, x: js.laplacian(u)(x) for name in k}, bcs)
        >>> sol = js.solve(problem, cloud)
        >>> round(float(sol.integral(region="a")), 9)
        0.1875
        """
        self.refuse_stacked()
        total: Any = 0.0
        for name in self._those(group, region):
            total = total + self._one(name).integral(group)
        return total

    def flux(
        self, group: str, conductivity: ValueOrFunction | Mapping[str, ValueOrFunction] = 1.0, *,
        region: str | None = None,
    ) -> jax.Array:  # fmt: skip
        """The integral of conductivity n . grad u over a boundary group or one side of an interface.

        ``n`` points outward, on an interface ``"a|b"`` from a to b for both sides.

        Parameters
        ----------
        group : str
            A boundary group or an interface ``"a|b"``.
        conductivity : float, function or mapping
            A number, or a function of one point x (D,); by the names of the regions where each has its own.
        region : str, optional
            The region; for an interface the side, which must be named.

        Returns
        -------
        jax.Array
            A scalar, for a system (F,).

        Raises
        ------
        ValueError
            For other names.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jsmitsm as js
        >>> cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
        >>> k = {"a": 1.0, "b": 3.0}
        >>> flux = {name: lambda u, x, n, k=k[name]: k * n @ js.grad(u)(x) for name in k}
        >>> bcs = {"boundary": js.dirichlet(lambda x: x[0]), "a|b": js.interface(flux=flux)}
        >>> problem = js.Problem({name: lambda u, x: js.laplacian(u)(x) for name in k}, bcs)
        >>> sol = js.solve(problem, cloud)
        >>> round(float(sol.flux("a|b", 3.0, region="b")), 9)
        1.5
        """
        self.refuse_stacked()
        total: Any = 0.0
        for name in self._those(group, region):
            turned = group in self.cloud.interfaces and sides(group)[1] == name
            own: Any = conductivity
            if isinstance(conductivity, Mapping):
                if name not in conductivity:
                    raise ValueError(f"conductivity: given for {list(conductivity)}, and {group!r} bounds {name!r} too")
                own = conductivity[name]
            total = total + self._one(name).flux(group, own) * (-1.0 if turned else 1.0)
        return total

    def _those(self, group: str | None, region: str | None) -> list[str]:
        """The regions that an integral goes over."""
        names = list(self.cloud.regions)
        if region is not None and region not in names:
            raise ValueError(f"region: {region!r} is none of {names}{did_you_mean(region, names)}")
        if group is None:
            return names if region is None else [region]
        if group in self.cloud.interfaces:
            if region not in sides(group):
                raise ValueError(
                    f"region: {region!r} is no side of {group!r}, on which u has two values; name one of "
                    f"{list(sides(group))}"
                )
            return [str(region)]
        if group not in self.cloud.groups or group == "interior":
            known = [name for name in self.cloud.groups if name != "interior"]
            raise ValueError(f"group: expected one of {known}, got {group!r}{did_you_mean(str(group), known)}")
        touched = [n for n in names if np.isin(self.cloud.groups[group], self.cloud.regions[n]).any()]
        return touched if region is None else [n for n in touched if n == region]

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in super().__getstate__().items() if k != "_regions"}
