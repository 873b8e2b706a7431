"""What signed distances are written with: points, lengths and norms, checked where they are known."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.runtime.errors import numbers


def offset_from(x: jax.Array, origin: Any) -> jax.Array:
    """x - origin; a point of another dimension would be broadcast to a shape that nobody meant."""
    if jnp.shape(x) != jnp.shape(origin):
        raise ValueError(
            f"sdf: a shape in {len(origin)}D was asked at a point of shape {jnp.shape(x)}; bounds and points must have "
            "its dimension (docs: clouds)"
        )
    return x - origin


def norm(v: jax.Array) -> jax.Array:
    """Euclidean norm whose gradient at zero is zero instead of NaN."""
    square = jnp.sum(v * v)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def corner_distance(q: jax.Array) -> jax.Array:
    """Distance to the orthant q < 0; on a face the gradient is that of the face, at a corner the mean."""
    return jnp.where(jnp.any(q > 0), norm(jnp.where(q > 0, q, 0.0)), jnp.max(q))


def known(value: Any) -> bool:
    return isinstance(value, (np.ndarray, float))


def vector(name: str, value: Any, dim: int | None = None) -> Any:
    """A (D,) float64 host array, so that nothing depends on the precision at the time of the call."""
    if isinstance(value, jax.core.Tracer):
        array: Any = value
    else:
        try:
            if any(isinstance(v, jax.core.Tracer) for v in value):
                array = jnp.stack([jnp.asarray(v) for v in value])
            else:
                array = numbers(name, value)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"{name}: expected {dim or 'D'} numbers, got {value!r} (docs: clouds)") from None
    if array.ndim != 1 or (dim is not None and array.shape != (dim,)) or array.shape[0] not in (1, 2, 3):
        expected = f"({dim},)" if dim else "(D,) with D = 1, 2 or 3"
        raise ValueError(f"{name}: shape {array.shape} came, {expected} was expected (docs: clouds)")
    if known(array) and not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got {value!r} (docs: clouds)")
    return array


def floats(name: str, value: Any) -> Any:
    """A float64 host array; traced values pass unchecked."""
    if isinstance(value, jax.core.Tracer):
        return value
    try:
        return numbers(name, value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name}: expected numbers, got {value!r} (docs: clouds)") from None


def positive(name: str, value: Any) -> Any:
    """A positive number (or array of them); traced values pass unchecked."""
    array = floats(name, value)
    if not known(array):
        return array
    if not (np.isfinite(array).all() and (array > 0).all()):
        raise ValueError(f"{name}: expected a positive finite length, got {value!r} (docs: clouds)")
    return array if array.ndim else float(array)
