"""Integral terms: what a user may add to an equation besides derivatives at the point."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from jsmitsm.equation.regions.per_region import PerRegion
from jsmitsm.equation.traced import Traced
from jsmitsm.equation.tracing import trace
from jsmitsm.runtime.errors import IN_FUNCTIONS, did_you_mean, in_words

# The kernels by region, None for the only one.
Kernels = tuple[tuple[str | None, Callable[..., Any]], ...]


def kernels(integral: Any, pde: Any) -> Kernels:
    """The kernels that a user gave, judged: none, one for all equations, or some by region."""
    if integral is None:
        return ()
    names = list(pde) if isinstance(pde, PerRegion) else []
    if isinstance(integral, Mapping):
        for name, kernel in integral.items():
            if name not in names:
                known = f"one of {names}" if names else "a function: the problem has no regions"
                raise ValueError(f"integral: {name!r}, expected {known}{did_you_mean(str(name), names)}")
            if not callable(kernel):
                raise ValueError(f"integral[{name!r}]: expected a function kernel(x, y), got {kernel!r:.60}")
        return tuple(integral.items())
    if not callable(integral):
        raise ValueError(f"integral: expected a function kernel(x, y), got {integral!r:.60}")
    return tuple((name, integral) for name in names) if names else ((None, integral),)


def recorded_kernel(kernel: Callable[..., Any], dim: int, fields: int, params: Any) -> Traced:
    """The record of kernel(x, y[, params]) as a residual without u, (F F,), the point y an extra of every particle."""

    def flat(_: Any, x: Any, y: Any, *more: Any) -> Any:
        value = jnp.asarray(kernel(x, y, *more))
        expected = () if fields == 1 else (fields, fields)
        if value.shape != expected:
            raise ValueError(
                f"kernel(x, y) returns shape {value.shape}, expected {expected} for {fields} field(s)"
            )
        return value.reshape(-1)

    try:
        record = trace(flat, dim, fields, extras=((dim,),), params=params)
    except IN_FUNCTIONS as error:
        called = "kernel(x, y)" if params is None else "kernel(x, y, params)"
        raise ValueError(f"integral: {in_words(error)}; it is called as {called}, for one x and one y") from error
    if record.kinked_source:
        raise ValueError(
            "integral: the kernel has kinks or jumps (abs, max, where, ...), which neither Taylor series nor sums over "
            "particles follow; write it smoothly, as sqrt(|x - y|^2 + w^2) for |x - y| with w of two spacings or more, "
            "or give the integral a field and an equation of its own"
        )
    return record


def added(kernel: Callable[..., Any], points: Any, carried: Any, fields: int) -> Callable[..., Any]:
    """x, params -> sum_j kernel(x, y_j) c_j, with carried (N, F) the values at the particles times their weights."""

    def term(x: Any, *more: Any) -> Any:
        value = jax.vmap(lambda y: jnp.asarray(kernel(x, y, *more)))(points)
        return value @ carried[:, 0] if fields == 1 else jnp.einsum("jef,jf->e", value, carried)

    return term
