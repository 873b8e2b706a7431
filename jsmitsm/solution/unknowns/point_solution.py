"""The solution of a problem with point sources: a regular part on the cloud, and the singular one in a formula."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.equation.unknowns.point_source import Kelvin, Singular, derivative_of
from jsmitsm.runtime.errors import explained, short
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.solution.evaluation import checked_points, in_domain
from jsmitsm.solution.look.sizes import NOTHING
from jsmitsm.solution.regions.located import located
from jsmitsm.solution.regions.solution import RegionsSolution
from jsmitsm.solution.solution import Solution

# What the singular part says on a boundary nearer than this part of the spacing there is not seen by its particles.
NEAR_BOUNDARY = 0.75
# A source nearer to a particle on an interface than this part of the spacing lies on it.
ON_INTERFACE = 1e-6
_TAYLOR = (
    "coefficients: the Taylor series of a solution with point sources do not converge near them; ask "
    "sol.regular.coefficients for those of the regular part"
)


@jax.tree_util.register_pytree_node_class
class PointSolution(Solution):
    """A solution that adds the singular part of its sources; estimates and flags are those of the regular part."""

    regular: Solution
    singular: Singular | Kelvin

    @classmethod
    def of(cls, regular: Solution, singular: Singular | Kelvin) -> PointSolution:
        """The solution whose regular part was solved for."""
        new = object.__new__(cls)
        new.__dict__.update(regular.__dict__)
        new.regular, new.singular = regular, singular
        new.converged = _sound(regular, [singular])
        return new

    @property
    def u(self) -> Any:
        return jnp.asarray(self.regular.u) + jax.vmap(self.singular.at)(jnp.asarray(self.cloud.points))

    @property
    def flags(self) -> list[str]:
        """Those of the regular part, unless it is round-off beside the singular one, and of sources at a boundary."""
        return explained([] if _negligible(self) else [*super().flags, *_at_boundary(self.cloud, [self.singular])])

    @property
    def coefficients(self) -> Any:
        raise ValueError(_TAYLOR)

    def derivative(self, points: Any, multi_index: Any, *, blend: bool = False, outside: str = "nan") -> Any:
        regular = super().derivative(points, multi_index, blend=blend, outside=outside)
        place = jnp.asarray(checked_points(points, self.cloud.dim), float)
        return regular + jax.vmap(derivative_of(self.singular, tuple(map(int, multi_index))))(place)

    def integral(self, group: str | None = None) -> Any:
        if group is None:
            raise ValueError(
                "integral: quadrature over the domain is not made for the singularity of a point source; "
                "sol.regular.integral() is that of the regular part"
            )
        return super().integral(group)

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, {len(self.singular.places)} point source(s))"

    def tree_flatten(self):
        return (self.regular, self.singular), None

    @classmethod
    def tree_unflatten(cls, _, leaves):
        return cls.of(*leaves) if isinstance(leaves[0], Solution) else _placeholder(cls, leaves)


@jax.tree_util.register_pytree_node_class
class RegionsPointSolution(RegionsSolution):
    """The same in several regions: ``singular`` has the singular part of each of those that have sources."""

    regular: RegionsSolution
    singular: dict[str, Singular | Kelvin]

    @classmethod
    def of(cls, regular: RegionsSolution, singular: dict[str, Singular | Kelvin]) -> RegionsPointSolution:
        """The solution whose regular part was solved for."""
        new = object.__new__(cls)
        new.__dict__.update({k: v for k, v in regular.__dict__.items() if k != "_regions"})
        new.regular, new.singular = regular, singular
        new.converged = _sound(regular, list(singular.values()))
        return new

    @property
    def u(self) -> Any:
        values = jnp.asarray(self.regular.u)
        for name, part in self.singular.items():
            ids = self.cloud.regions[name]
            values = values.at[ids].add(jax.vmap(part.at)(jnp.asarray(self.cloud.points)[ids]))
        return values

    @property
    def flags(self) -> list[str]:
        """Those of the regular part, unless it is round-off beside the singular one, and of sources at a boundary."""
        told = _at_boundary(self.cloud, list(self.singular.values()))
        return explained([] if _negligible(self) else [*super().flags, *told])

    @property
    def coefficients(self) -> Any:
        raise ValueError(_TAYLOR)

    def region(self, name: str) -> Solution:
        return self._with_singular(name, self.regular.region(name))

    def _one(self, name: str) -> Solution:
        return self._with_singular(name, self.regular._one(name))

    def _with_singular(self, name: str, part: Solution) -> Solution:
        return PointSolution.of(part, self.singular[name]) if name in self.singular else part

    def __repr__(self) -> str:
        count = sum(len(part.places) for part in self.singular.values())
        return f"{super().__repr__()[:-1]}, {count} point source(s))"

    def tree_flatten(self):
        return (self.regular, self.singular), None

    @classmethod
    def tree_unflatten(cls, _, leaves):
        return cls.of(*leaves) if isinstance(leaves[0], Solution) else _placeholder(cls, leaves)


def _at_boundary(cloud: Cloud, parts: list[Singular | Kelvin]) -> list[str]:
    """Of sources that are so close to a boundary that its particles do not see what the singular part is there."""
    from scipy.spatial import cKDTree

    boundary = cloud.boundary
    points, places = concrete(cloud.points), [concrete(part.places) for part in parts]
    if cloud.dim == 1 or len(boundary) < 3 or points is None or any(place is None for place in places):
        return []
    rim = np.asarray(points)[boundary]
    tree = cKDTree(rim)
    at = np.concatenate([np.asarray(place) for place in places])
    away, nearest = tree.query(at)
    spacing = tree.query(rim[nearest], k=[2])[0][:, 0]
    close = np.flatnonzero(away < NEAR_BOUNDARY * spacing)
    if not len(close):
        return []
    worst = close[np.argmin(away[close] / spacing[close])]
    return [
        f"{len(close)} point source(s), first at {np.round(at[worst], 6)}, are nearer to the boundary than its "
        f"particles to one another ({away[worst]:.2g} and {spacing[worst]:.2g}), which do not see what it makes of "
        "their conditions: refine the boundary there."
    ]


def _negligible(sol: Any) -> bool:
    """Whether the regular part is round-off beside the whole, at the particles."""
    if is_traced(sol.regular.u, sol.u):
        return False
    regular, whole = (np.abs(np.asarray(x, float)) for x in (sol.regular.u, sol.u))
    return bool(regular.max(initial=0.0) <= NOTHING * whole[np.isfinite(whole)].max(initial=0.0))


def _sound(regular: Solution, parts: list[Singular | Kelvin]) -> Any:
    """Whether the solve went well, and the singular parts are those of the operators."""
    out = regular.converged
    for part in parts:
        out = out if part.sound is True else jnp.logical_and(out, part.sound)
    return out


def _placeholder(cls: type, leaves: Any) -> Any:
    """What JAX's tree tools make of a solution on their way, of parts that are none."""
    new: Any = object.__new__(cls)
    new.regular, new.singular = leaves
    return new


def check_inside(sources: Any, cloud: Cloud) -> None:
    """ValueError for sources outside of the domain."""
    places = [concrete(source.place) for source in sources]
    if any(place is None or np.shape(place) != (cloud.dim,) for place in places) or concrete(cloud.points) is None:
        return  # refused by name elsewhere, or not known
    parts = [cloud.region(name) for name in cloud.regions] if isinstance(cloud, RegionCloud) else [cloud]
    found = [in_domain(part, np.array(places, float), "nan") for part in parts]
    inside = np.any([np.ones(len(places), bool) if one is None else np.asarray(one) for one in found], axis=0)
    if not inside.all():
        at = places[np.flatnonzero(~inside)[0]]
        raise ValueError(f"sources: x0 = {np.asarray(at)} is outside of the domain; a point source lies inside of it")


def regions_of_sources(sources: Any, cloud: RegionCloud) -> list[str]:
    """The region in which each source lies."""
    check_inside(sources, cloud)
    names, out = list(cloud.regions), []
    for k, source in enumerate(sources):
        place = concrete(source.place)
        if place is None or concrete(cloud.points) is None:
            raise ValueError(
                f"sources[{k}]: x0 is traced by jax.jit or jax.vmap, and the region in which it lies is found on the "
                "host; differentiate without jit"
            )
        if np.shape(place) != (cloud.dim,):
            raise ValueError(f"sources[{k}]: x0 has {len(place)} coordinate(s), the cloud {cloud.dim}")
        between = [cloud.points[pairs[:, 0]] for pairs in cloud.interfaces.values()]
        away = [np.linalg.norm(np.asarray(concrete(at)) - np.asarray(place, float), axis=1).min() for at in between]
        if min(away, default=np.inf) <= ON_INTERFACE * cloud.spacing:
            raise ValueError(
                f"sources[{k}]: x0 = {short(place)} lies on an interface, where its singular part belongs to neither "
                "region; move it into one of them, or state it as js.interface(source=...) of a width of its own"
            )
        out.append(names[int(located(cloud, np.asarray(place, float)[None])[0])])
    return out
