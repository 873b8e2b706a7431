"""A solution between its particles: which polynomial serves a point, and whether the point is in the domain."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.inside import Nearest, inside_of
from jsmitsm.particle.polynomials import derivative_table, monomials, monomials_on_host
from jsmitsm.runtime.errors import refuse_masked
from jsmitsm.runtime.tracers import concrete, is_traced

# Points evaluated at a time.
_AT_ONCE = 4096
OUTSIDE = ("nan", "extrapolate", "raise")


def in_domain(cloud: Cloud, points: Any, outside: str, first: Nearest | None = None) -> Any:
    """Mask (M,) of the points that are inside; None where all are, or may be taken to be.

    first: the nearest particles of the points, where they are known.
    """
    if not isinstance(outside, str) or outside not in OUTSIDE:
        raise ValueError(f"outside: {outside!r} is none of {', '.join(map(repr, OUTSIDE))}")
    domain = None if outside == "extrapolate" else inside_of(cloud)
    if domain is None:
        return None
    beyond = domain.outside(points, first)
    if is_traced(beyond):
        if outside == "raise":
            raise ValueError(
                'outside: "raise" needs to look at the points, which JAX traces here; use outside="nan", or check them '
                "before the transform"
            )
        return ~beyond
    if cloud._shape is not None and beyond.any():  # which knows, where particles of two sides are near each other
        beyond[beyond] = cloud._shape.distance(np.asarray(concrete(points), float)[beyond])[0] > 0.0
    if not beyond.any():
        return None
    if outside == "raise":
        at_first = int(np.argmax(beyond))
        at = np.asarray(jax.lax.stop_gradient(points))[at_first] if not is_traced(points) else at_first
        raise ValueError(
            f"points: {int(beyond.sum())} of {len(beyond)} lie outside of the domain, first points[{at_first}] = {at}; "
            'take them out, or say outside="nan" or outside="extrapolate"'
        )
    return ~beyond


def checked_points(points: Any, dim: int) -> Any:
    if not is_traced(points):
        refuse_masked(points, "points")
        try:
            if np.iscomplexobj(points):
                raise TypeError
            points = np.asarray(points, dtype=float)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(
                f"points: expected real numbers of shape (M, {dim}), got {type(points).__name__}"
            ) from None
        if points.ndim == 2 and not np.isfinite(points).all():
            raise ValueError("points: NaN or infinite coordinates; evaluate at finite points")
    if points.ndim != 2 or points.shape[1] != dim:
        raise ValueError(f"points: expected shape (M, {dim}), got {points.shape}; one point is [point]")
    return points


def nearest_particles(cloud: Cloud, points: Any, count: int) -> tuple[Any, Any, Nearest | None]:
    """The particles (M, count) that serve each point and their weights, which sum to one; and the nearest of all."""
    centres, first = cloud.points, None
    count, domain = min(count, centres.shape[0]), None if is_traced(centres, points) else inside_of(cloud)
    if domain is None:
        square = jnp.sum((jax.lax.stop_gradient(points)[:, None] - jax.lax.stop_gradient(centres)[None]) ** 2, axis=2)
        index: Any = jax.lax.top_k(-square, count)[1]
    else:
        index, first = domain.nearest(points, count)
    if count == 1:
        return index, np.ones(index.shape), first
    xp = jnp if is_traced(centres, points) else np
    square = xp.sum((points[:, None] - xp.asarray(centres)[index]) ** 2, axis=2)
    # At a particle the root has no slope; it is taken as zero there.
    distance = xp.where(square > 0, xp.sqrt(xp.where(square > 0, square, 1.0)), 0.0)
    # The farthest of them gets weight zero, so that none enters or leaves with a jump.
    weight = xp.maximum(1.0 - distance / distance.max(axis=1, keepdims=True), 0.0) ** 2
    weight = weight + 1e-12  # where all are equally far; its square is a number in float32 too
    return index, weight / weight.sum(axis=1, keepdims=True), first


def evaluated(b, order, centres, taylor, points, near, weight):
    """sum_k weight[k] d^b p_k(x): (M, F)."""
    if is_traced(centres, taylor, points):
        return _traced_evaluation(b, order, centres, taylor, points, near, weight)
    # In numpy: a program would be compiled for every number of points.
    numbers = [np.asarray(x) for x in (centres, taylor, points, near, weight)]
    parts = [_on_host(b, order, *numbers[:2], *(x[k : k + _AT_ONCE] for x in numbers[2:]))
             for k in range(0, max(len(points), 1), _AT_ONCE)]  # fmt: skip
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _on_host(b, order, centres, taylor, points, near, weight):
    lower, factor = derivative_table(points.shape[1], order, b)
    total = 0.0
    for k in range(near.shape[1]):
        p = monomials_on_host((points - centres[near[:, k]]).T, order)[lower] * factor[:, None]
        total = total + weight[:, k, None] * np.einsum("mfk,km->mf", taylor[near[:, k]], p)
    return total


@partial(jax.jit, static_argnums=(0, 1))
def _traced_evaluation(b, order, centres, taylor, points, near, weight):
    dim = points.shape[1]
    lower, factor = derivative_table(dim, order, b)
    total = 0.0
    for k in range(near.shape[1]):
        p = monomials(points - centres[near[:, k]], order)[:, lower] * factor
        total = total + weight[:, k, None] * jnp.einsum("mfk,mk->mf", taylor[near[:, k]], p)
    return total
