"""What differs from region to region."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax

from jsmitsm.equation.traced import Traced


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
