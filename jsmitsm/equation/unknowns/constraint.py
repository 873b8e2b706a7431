"""Constraints: numbers made of the whole solution that must have given values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jsmitsm.runtime.errors import explaining, short
from jsmitsm.runtime.tracers import is_traced


@jax.tree_util.register_pytree_node_class
class Constraint:
    """functional(sol) = value; made by ``js.constraint``. The value is a leaf of the pytree."""

    def __init__(self, functional: Callable[..., Any], value: Any):
        self.functional, self.value = functional, value

    def tree_flatten(self):
        return (self.value,), self.functional

    @classmethod
    def tree_unflatten(cls, functional, leaves):
        return cls(functional, *leaves)

    def __repr__(self) -> str:
        return "constraint(<function>)" if is_traced(self.value) else f"constraint(<function>, value={self.value})"


@explaining
def constraint(functional: Callable[..., Any], value: float = 0.0) -> Constraint:
    """A number made of the solution has a given value: an integral, a mean, a flux, the value at a point.

    Parameters
    ----------
    functional : function
        ``functional(sol)`` returns a scalar, made by JAX of what the solution offers: ``sol.u``, ``sol(points)``,
        ``sol.grad(points)``, ``sol.integral()``, ``sol.flux(group)``, ``sol.unknowns["name"]``; with several regions
        ``sol(points, region="a")``, ``sol.integral(region="a")``, ``sol.flux("a|b", k, region="a")``.
    value : float
        What it must be, in the units of the functional.

    Returns
    -------
    Constraint
        To be put into ``js.Problem(..., constraints=[...])``.

    Raises
    ------
    ValueError
        For what is no function, and a value that is no finite number.

    Examples
    --------
    A rod insulated at both ends, u'' = 1 - q: the outflow q that keeps it steady is found with it, and the mean given.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> problem = js.Problem(
    ...     lambda u, x, g: js.laplacian(u)(x) - 1.0 + g["q"],
    ...     {
    ...         "left": js.neumann(lambda x, g: 0.0),
    ...         "right": js.neumann(lambda x, g: 0.0),
    ...     },
    ...     unknowns={"q": 0.0},
    ...     constraints=[js.constraint(lambda sol: sol.integral(), 2.0)],
    ... )
    >>> sol = js.solve(problem, js.interval(0.0, 1.0, 11))
    >>> round(float(sol.unknowns["q"]), 9), round(float(sol.u[3]), 9)
    (1.0, 2.0)
    """
    if not callable(functional):
        raise ValueError(
            f"functional: expected a function of the solution, got {short(functional)}; write e.g. "
            "js.constraint(lambda sol: sol.integral(), 1.0)"
        )
    return Constraint(functional, checked_number(value, "value"))


def checked_number(value: Any, name: str) -> Any:
    """A finite real scalar, or a traced one."""
    if is_traced(value):
        if np.shape(value):
            raise ValueError(f"{name}: expected a number, got shape {np.shape(value)}")
        return value
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiu" or array.ndim:
            raise TypeError
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name}: expected a number, got {short(value)}") from None
    if not np.isfinite(array):
        raise ValueError(f"{name}: NaN or infinite; give a finite number")
    return value
