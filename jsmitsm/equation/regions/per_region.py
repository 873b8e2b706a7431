"""What differs from region to region."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import numpy as np

from jsmitsm.equation.traced import Traced
from jsmitsm.runtime.errors import did_you_mean

# Between a boundary group and the region whose part of it a condition is for.
_IN = " in "


@jax.tree_util.register_pytree_node_class
class PerRegion(Mapping[str, Any]):
    """The equation of each region, by its name; functions are static, records are leaves."""

    def __init__(self, equations: Mapping[str, Any]):
        self._equations = dict(equations)

    def __getitem__(self, name: str) -> Any:
        return self._equations[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._equations)

    def __len__(self) -> int:
        return len(self._equations)

    def tree_flatten(self) -> tuple[Any, Any]:
        names, values = tuple(self._equations), tuple(self._equations.values())
        if all(isinstance(v, Traced) for v in values):
            return values, (names, None)
        return (), (names, values)

    @classmethod
    def tree_unflatten(cls, static: Any, leaves: Any) -> PerRegion:
        names, values = static
        return cls(dict(zip(names, leaves if values is None else values, strict=True)))


def per_region(equations: Mapping[str, Callable[..., Any]]) -> PerRegion:
    """A user's dict of equations. ValueError for what is none."""
    if not equations:
        raise ValueError("pde: an empty dict; give an equation for each region of the cloud")
    for name, pde in equations.items():
        if not isinstance(name, str):
            raise ValueError(f"pde: the key {name!r} is no string; use the names of the regions")
        if not callable(pde) and not isinstance(pde, Traced):
            raise ValueError(
                f"pde[{name!r}]: expected a function pde(u, x) returning the residual, got {type(pde).__name__}; it is "
                "js.Problem(pde, bcs), the equation first"
            )
    return PerRegion(equations)


def by_region(bcs: Mapping[str, Any], pde: Any) -> dict[Any, Any]:
    """Conditions of which some are dicts by region, as one key for each region: ``"side in steel"``."""
    out: dict[Any, Any] = {}
    for group, given in bcs.items():
        if not isinstance(given, Mapping):
            out[group] = given
            continue
        known = list(pde) if isinstance(pde, PerRegion) else []
        for region, condition in given.items():
            if region not in known:
                raise ValueError(
                    f"bcs[{group!r}]: a condition for the region {region!r}; the problem has "
                    f"{f'the regions {known}' if known else 'none, give the group one condition, or a list of them'}"
                    f"{did_you_mean(str(region), known)}"
                )
            out[f"{group}{_IN}{region}"] = condition
    return out


def group_and_region(key: str, cloud: Any) -> tuple[str, str | None]:
    """The boundary group and the region that the conditions under a key are for; None: all regions that it bounds."""
    group, _, region = key.rpartition(_IN)
    return (group, region) if key not in cloud.groups and region in getattr(cloud, "regions", ()) else (key, None)


def members(key: str, cloud: Any) -> np.ndarray:
    """The particles for which the conditions under a key are."""
    group, region = group_and_region(key, cloud)
    ids = np.asarray(cloud.groups.get(group, ()), int)
    return ids if region is None else ids[np.isin(ids, cloud.regions[region])]
