"""The solution of a problem with point sources: a regular part on the cloud, and the singular one in a formula."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.unknowns.point_source import Singular, derivative_of
from jsmitsm.runtime.tracers import concrete
from jsmitsm.solution.evaluation import checked_points, in_domain
from jsmitsm.solution.solution import Solution


@jax.tree_util.register_pytree_node_class
class PointSolution(Solution):
    """A solution that adds the singular part of its sources; estimates and flags are those of the regular part."""

    regular: Solution
    singular: Singular

    @classmethod
    def of(cls, regular: Solution, singular: Singular) -> PointSolution:
        """The solution whose regular part was solved for."""
        new = object.__new__(cls)
        new.__dict__.update(regular.__dict__)
        new.regular, new.singular = regular, singular
        return new

    @property
    def u(self) -> Any:
        return jnp.asarray(self._values[..., 0]) + jax.vmap(self.singular.at)(jnp.asarray(self.cloud.points))

    @property
    def coefficients(self) -> Any:
        raise ValueError(
            "coefficients: the Taylor series of a solution with point sources do not converge near them; ask "
            "sol.regular.coefficients for those of the regular part"
        )

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


def _placeholder(cls: type, leaves: Any) -> Any:
    """What JAX's tree tools make of a solution on their way, of parts that are none."""
    new: Any = object.__new__(cls)
    new.regular, new.singular = leaves
    return new


def check_inside(singular: Singular, cloud: Cloud) -> None:
    """ValueError for sources outside of the domain."""
    places = concrete(singular.places)
    if places is None or concrete(cloud.points) is None:
        return
    inside = in_domain(cloud, np.asarray(places), "nan")
    if inside is not None and not np.all(inside):
        at = np.asarray(places)[np.flatnonzero(~np.asarray(inside))[0]]
        raise ValueError(f"sources: x0 = {at} is outside of the domain; a point source lies inside of it")
