"""Signed distances of simple shapes, and how to compose them.

Every function here returns a function ``x (D,) -> scalar``, negative inside, zero on the boundary,
positive outside, written in ``jax.numpy``: it can be mapped, differentiated and handed to
``js.from_sdf``. Centres, lengths and angles may be traced values. Gradients are finite
everywhere but where a docstring says otherwise, also where a plain norm would give NaN.

The formulas are those of Quilez, "2D / 3D distance functions" (iquilezles.org/articles), rewritten
so that the gradient is exact *on* the boundary, where particles are put.

Examples
--------
>>> import jax.numpy as jnp, jsmitsm as js
>>> plate = js.sdf.difference(
...     js.sdf.rectangle((0, 0), (2, 1)), js.sdf.circle((1, 0.5), 0.25)
... )
>>> float(plate(jnp.array([1.0, 0.5])))
0.25
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.sdf.combine import (
    Sdf,
    complement,
    difference,
    intersection,
    rotate,
    round,
    scale,
    shell,
    smooth_union,
    translate,
    union,
)
from jsmitsm.cloud.sdf.round_shapes import capsule, cylinder, ellipse, ellipsoid, torus
from jsmitsm.cloud.sdf.vectors import corner_distance, floats, known, norm, offset_from, positive, vector

__all__ = [
    "ball",
    "box",
    "capsule",
    "circle",
    "complement",
    "cylinder",
    "difference",
    "disk",
    "ellipse",
    "ellipsoid",
    "half_space",
    "intersection",
    "interval",
    "polygon",
    "rectangle",
    "rotate",
    "round",
    "scale",
    "shell",
    "smooth_union",
    "sphere",
    "torus",
    "translate",
    "union",
]


def __dir__() -> list[str]:
    return __all__


def ball(center: Any, radius: Any) -> Sdf:
    """The ball |x - center| < radius in any dimension, also called ``sphere``.

    Parameters
    ----------
    center : array_like (D,)
        Its centre, length units.
    radius : float
        Length units, positive.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        For a radius that is not positive.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.ball((0, 0, 0), 2.0)(jnp.array([0.0, 3.0, 4.0])))
    3.0
    """
    center, radius = vector("center", center), positive("radius", radius)
    return lambda x: norm(offset_from(x, center)) - radius


def circle(center: Any, radius: Any) -> Sdf:
    """The disk |x - center| < radius in 2D, also called ``disk``.

    Parameters
    ----------
    center : array_like (2,)
        Its centre, length units.
    radius : float
        Length units, positive.

    Returns
    -------
    Sdf
        The function x (2,) -> scalar.

    Raises
    ------
    ValueError
        For a radius that is not positive, or a centre that is not (2,).

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.circle((0, 0), 1.0)(jnp.array([3.0, 4.0])))
    4.0
    """
    return ball(vector("center", center, 2), radius)


disk = circle
sphere = ball


def box(lo: Any, hi: Any) -> Sdf:
    """The box lo < x < hi in any dimension. Exact distance.

    Parameters
    ----------
    lo, hi : array_like (D,)
        Two opposite corners, length units.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        Unless hi > lo along every axis.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.box((0, 0), (2, 2))(jnp.array([5.0, 6.0])))
    5.0
    """
    lo = vector("lo", lo)
    hi = vector("hi", hi, np.shape(lo)[0])
    if known(lo) and known(hi) and not (hi > lo).all():
        raise ValueError(
            f"hi: {hi} must be greater than lo = {lo} along every axis; swap the two corners (docs: clouds)"
        )
    center, half = (lo + hi) / 2, (hi - lo) / 2
    return lambda x: corner_distance(jnp.abs(offset_from(x, center)) - half)


def rectangle(lo: Any, hi: Any) -> Sdf:
    """The rectangle lo < x < hi in 2D. Exact distance.

    Parameters
    ----------
    lo, hi : array_like (2,)
        The lower left and the upper right corner, length units.

    Returns
    -------
    Sdf
        The function x (2,) -> scalar.

    Raises
    ------
    ValueError
        Unless hi > lo along both axes.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.rectangle((0, 0), (2, 1))(jnp.array([1.0, 0.75])))
    -0.25
    """
    return box(vector("lo", lo, 2), vector("hi", hi, 2))


def interval(a: Any, b: Any) -> Sdf:
    """The interval a < x < b in 1D.

    Parameters
    ----------
    a, b : float
        Its ends, length units.

    Returns
    -------
    Sdf
        The function x (1,) -> scalar.

    Raises
    ------
    ValueError
        Unless b > a.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.interval(0, 2)(jnp.array([2.5])))
    0.5
    """
    return box((a,), (b,))


def half_space(point: Any, normal: Any) -> Sdf:
    """The half-space behind the plane (in 2D the line) through ``point``.

    Parameters
    ----------
    point : array_like (D,)
        A point of the plane.
    normal : array_like (D,)
        Points out of the half-space; of any length.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        For a zero normal.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.half_space((0, 0), (0, 2))(jnp.array([5.0, -3.0])))
    -3.0
    """
    point = vector("point", point)
    normal = vector("normal", normal, np.shape(point)[0])
    if known(normal) and not np.any(normal):
        raise ValueError("normal: a zero vector came, a direction out of the half-space was expected (docs: clouds)")
    unit = normal / (jnp if isinstance(normal, jax.core.Tracer) else np).linalg.norm(normal)
    return lambda x: jnp.dot(offset_from(x, point), unit)


def polygon(vertices: Any) -> Sdf:
    """The polygon of ``vertices``, last joined to first. Exact distance.

    The gradient is the edge's normal on an edge and the normalised bisector at a vertex. A polygon
    with holes is ``difference(polygon(outer), polygon(hole))``. Whether it crosses itself is checked
    by ``js.from_polygon``, not here.

    Parameters
    ----------
    vertices : array_like (V, 2)
        In order, either way round.

    Returns
    -------
    Sdf
        The function x (2,) -> scalar.

    Raises
    ------
    ValueError
        For a wrong shape.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.polygon([(0, 0), (2, 0), (0, 2)])(jnp.array([0.5, -1.0])))
    1.0
    """
    start = floats("vertices", vertices)
    if start.ndim != 2 or start.shape[1] != 2 or start.shape[0] < 3:
        raise ValueError(f"vertices: shape {start.shape} came, (V, 2) with V >= 3 was expected (docs: clouds)")

    def sdf(x: jax.Array) -> jax.Array:
        begin = jnp.asarray(start)
        end = jnp.roll(begin, -1, axis=0)
        edge = end - begin
        turn = jnp.sign(jnp.sum(begin[:, 0] * end[:, 1] - end[:, 0] * begin[:, 1]))
        normal = turn * jnp.stack([edge[:, 1], -edge[:, 0]], axis=1) / jnp.linalg.norm(edge, axis=1, keepdims=True)
        corner = normal + jnp.roll(normal, 1, axis=0)  # vertex k lies between the edges k - 1 and k
        offset = x - begin
        t = jnp.sum(offset * edge, axis=1) / jnp.sum(edge * edge, axis=1)
        foot = begin + jnp.clip(t, 0.0, 1.0)[:, None] * edge
        nearest = jnp.argmin(jnp.sum((x - foot) ** 2, axis=1))
        t = t[nearest]
        # Off the ends of the edge the distance is to a vertex. On the edge it is the linear function,
        # whose gradient is exact at the zero level; a root of squares would return round-off there.
        flat = jnp.dot(offset[nearest], normal[nearest])
        vertex = jnp.where(t > 0.5, (nearest + 1) % len(begin), nearest)
        away = x - begin[vertex]
        distance = norm(away)
        above = begin[:, 1] > x[1]
        crossed = (above != (end[:, 1] > x[1])) & (
            x[0] - begin[:, 0] < edge[:, 0] * (x[1] - begin[:, 1]) / jnp.where(edge[:, 1] == 0, 1.0, edge[:, 1])
        )
        sign = jnp.where(jnp.sum(crossed) % 2 == 1, -1.0, 1.0)
        bisector = corner[vertex] / jnp.maximum(norm(corner[vertex]), 1e-300)
        pointed = jnp.where(distance > 0, sign * distance, jnp.dot(away, bisector))
        return jnp.where((t > 0) & (t < 1), flat, pointed)

    return sdf
