"""Signed distances of simple shapes, and how to compose them.

Every function here returns a function ``x (D,) -> scalar``, negative inside, zero on the boundary,
positive outside, written in ``jax.numpy``: it can be mapped, differentiated and handed to
:func:`jsmitsm.from_sdf`. Centres, lengths and angles may be traced values. Gradients are finite
everywhere but where a docstring says otherwise, also where a plain norm would give NaN.

The formulas are those of Quilez, "2D / 3D distance functions" (iquilezles.org/articles), rewritten
so that the gradient is exact *on* the boundary, where particles are put.

>>> import jax.numpy as jnp, jsmitsm as js
>>> plate = js.sdf.difference(js.sdf.rectangle((0, 0), (2, 1)), js.sdf.circle((1, 0.5), 0.25))
>>> float(plate(jnp.array([1.0, 0.5])))
0.25
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

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

Sdf = Callable[[jax.Array], jax.Array]


def ball(center: Any, radius: Any) -> Sdf:
    """The ball |x - center| < radius in any dimension, also called :func:`sphere`; ``center`` (D,), lengths in length
    units.

    Raises ValueError for a radius that is not positive.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.ball((0, 0, 0), 2.0)(jnp.array([0.0, 3.0, 4.0])))
    3.0
    """
    center, radius = _vector("center", center), _positive("radius", radius)
    return lambda x: _norm(_from(x, center)) - radius


def circle(center: Any, radius: Any) -> Sdf:
    """The disk |x - center| < radius in 2D, also called :func:`disk`; see :func:`ball`. Errors as there.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.circle((0, 0), 1.0)(jnp.array([3.0, 4.0])))
    4.0
    """
    return ball(_vector("center", center, 2), radius)


disk = circle
sphere = ball


def box(lo: Any, hi: Any) -> Sdf:
    """The box lo < x < hi in any dimension; ``lo``, ``hi`` (D,). Exact distance.

    Raises ValueError unless hi > lo along every axis.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.box((0, 0), (2, 2))(jnp.array([5.0, 6.0])))
    5.0
    """
    lo = _vector("lo", lo)
    hi = _vector("hi", hi, np.shape(lo)[0])
    if _concrete(lo) and _concrete(hi) and not (hi > lo).all():
        raise ValueError(f"hi: {hi} must be greater than lo = {lo} along every axis; swap the two corners")
    center, half = (lo + hi) / 2, (hi - lo) / 2
    return lambda x: _corner_distance(jnp.abs(_from(x, center)) - half)


def rectangle(lo: Any, hi: Any) -> Sdf:
    """The rectangle lo < x < hi in 2D; see :func:`box`. Errors as there.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.rectangle((0, 0), (2, 1))(jnp.array([1.0, 0.75])))
    -0.25
    """
    return box(_vector("lo", lo, 2), _vector("hi", hi, 2))


def interval(a: Any, b: Any) -> Sdf:
    """The interval a < x < b in 1D, a function of x (1,); see :func:`box`. Errors as there.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.interval(0, 2)(jnp.array([2.5])))
    0.5
    """
    return box((a,), (b,))


def half_space(point: Any, normal: Any) -> Sdf:
    """The half-space behind the plane (in 2D the line) through ``point``; ``normal`` (D,) points out of it.

    ``normal`` need not be of unit length. Raises ValueError for a zero normal.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.half_space((0, 0), (0, 2))(jnp.array([5.0, -3.0])))
    -3.0
    """
    point = _vector("point", point)
    normal = _vector("normal", normal, np.shape(point)[0])
    if _concrete(normal) and not np.any(normal):
        raise ValueError("normal: a zero vector came, a direction out of the half-space was expected")
    unit = normal / (jnp if isinstance(normal, jax.core.Tracer) else np).linalg.norm(normal)
    return lambda x: jnp.dot(_from(x, point), unit)


def ellipse(center: Any, semi_axes: Any) -> Sdf:
    """The ellipse (in 3D ellipsoid) sum ((x - center) / semi_axes)^2 < 1; both (D,).

    Not a true distance but k (k - 1) / |grad k|-like: exact zero level, first-order distance near it.
    Raises ValueError for semi-axes that are not positive.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.ellipse((0, 0), (2, 1))(jnp.array([2.0, 0.0])))
    0.0
    """
    center = _vector("center", center)
    axes = _positive("semi_axes", _vector("semi_axes", semi_axes, np.shape(center)[0]))

    def sdf(x: jax.Array) -> jax.Array:
        y = _from(x, center) / axes
        radius, slope = _norm(y), _norm(y / axes)
        # At the centre the ratio radius / slope has no limit; any value between the semi-axes serves.
        ratio = jnp.where(slope > 0, radius / jnp.where(slope > 0, slope, 1.0), jnp.min(axes))
        return (radius - 1.0) * ratio

    return sdf


ellipsoid = ellipse


def capsule(a: Any, b: Any, radius: Any) -> Sdf:
    """All points closer than ``radius`` to the segment from ``a`` to ``b`` (D,): a stadium, a rod with round ends.

    Raises ValueError for a radius that is not positive.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.capsule((0, 0), (2, 0), 0.5)(jnp.array([1.0, 2.0])))
    1.5
    """
    a, radius = _vector("a", a), _positive("radius", radius)
    along = _vector("b", b, np.shape(a)[0]) - a

    def sdf(x: jax.Array) -> jax.Array:
        t = jnp.clip(jnp.dot(_from(x, a), along) / jnp.dot(along, along), 0.0, 1.0)
        return _norm(x - a - t * along) - radius

    return sdf


def cylinder(a: Any, b: Any, radius: Any) -> Sdf:
    """The solid cylinder of flat ends around the axis from ``a`` to ``b`` (3,). Exact distance.

    Raises ValueError for a radius that is not positive.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.cylinder((0, 0, 0), (0, 0, 2), 1.0)(jnp.array([0.0, 3.0, 1.0])))
    2.0
    """
    a, radius = _vector("a", a, 3), _positive("radius", radius)
    along = _vector("b", b, 3) - a

    def sdf(x: jax.Array) -> jax.Array:
        length = _norm(along)
        axis = along / length
        z = jnp.dot(_from(x, a), axis)
        across = _norm(x - a - z * axis)
        return _corner_distance(jnp.stack([across - radius, jnp.abs(z - length / 2) - length / 2]))

    return sdf


def torus(center: Any, major: Any, minor: Any, axis: Any = (0.0, 0.0, 1.0)) -> Sdf:
    """The solid torus around ``center`` (3,): a tube of radius ``minor`` bent round ``axis`` with radius ``major``.

    Raises ValueError for radii that are not positive.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.torus((0, 0, 0), 2.0, 0.5)(jnp.array([2.0, 0.0, 1.5])))
    1.0
    """
    center, axis = _vector("center", center, 3), _vector("axis", axis, 3)
    major, minor = _positive("major", major), _positive("minor", minor)

    def sdf(x: jax.Array) -> jax.Array:
        unit = axis / _norm(axis)
        z = jnp.dot(_from(x, center), unit)
        across = _norm(x - center - z * unit)
        return _norm(jnp.stack([across - major, z])) - minor

    return sdf


def polygon(vertices: Any) -> Sdf:
    """The polygon of ``vertices`` (V, 2) in order, either way round, last joined to first. Exact distance.

    The gradient is the edge's normal on an edge and the normalised bisector at a vertex. A polygon
    with holes is ``difference(polygon(outer), polygon(hole))``. Whether it crosses itself is checked
    by :func:`jsmitsm.from_polygon`, not here. Raises ValueError for a wrong shape.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.polygon([(0, 0), (2, 0), (0, 2)])(jnp.array([0.5, -1.0])))
    1.0
    """
    start = vertices if isinstance(vertices, jax.core.Tracer) else np.asarray(vertices, dtype=np.float64)
    if start.ndim != 2 or start.shape[1] != 2 or start.shape[0] < 3:
        raise ValueError(f"vertices: shape {start.shape} came, (V, 2) with V >= 3 was expected")

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
        distance = _norm(away)
        above = begin[:, 1] > x[1]
        crossed = (above != (end[:, 1] > x[1])) & (
            x[0] - begin[:, 0] < edge[:, 0] * (x[1] - begin[:, 1]) / jnp.where(edge[:, 1] == 0, 1.0, edge[:, 1])
        )
        sign = jnp.where(jnp.sum(crossed) % 2 == 1, -1.0, 1.0)
        bisector = corner[vertex] / jnp.maximum(_norm(corner[vertex]), 1e-300)
        pointed = jnp.where(distance > 0, sign * distance, jnp.dot(away, bisector))
        return jnp.where((t > 0) & (t < 1), flat, pointed)

    return sdf


def union(*shapes: Sdf) -> Sdf:
    """What lies in any of the shapes (the smallest distance; exact outside, a bound inside). ValueError without any.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.union(js.sdf.circle((0, 0), 1.0), js.sdf.circle((3, 0), 1.0))(jnp.array([3.0, 0.0])))
    -1.0
    """
    return _combine(jnp.minimum, shapes)


def intersection(*shapes: Sdf) -> Sdf:
    """What lies in all of the shapes (the largest distance; exact inside, a bound outside). ValueError without any.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.intersection(js.sdf.circle((0, 0), 1.0), js.sdf.circle((1, 0), 1.0))(jnp.array([0.5, 0.0])))
    -0.5
    """
    return _combine(jnp.maximum, shapes)


def difference(shape: Sdf, *holes: Sdf) -> Sdf:
    """What lies in ``shape`` and in none of the ``holes``. ValueError for what is no function.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.difference(js.sdf.circle((0, 0), 2.0), js.sdf.circle((0, 0), 1.0))(jnp.array([1.5, 0.0])))
    -0.5
    """
    return intersection(shape, *map(complement, holes))


def complement(shape: Sdf) -> Sdf:
    """What lies outside of ``shape``.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.complement(js.sdf.circle((0, 0), 1.0))(jnp.array([0.0, 0.0])))
    1.0
    """
    return lambda x: -shape(x)


def smooth_union(first: Sdf, second: Sdf, radius: Any) -> Sdf:
    """The union with its seam filled over a width ``radius`` (length units); quadratic blend, C1.

    Raises ValueError for a width that is not positive.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.smooth_union(js.sdf.circle((-1, 0), 1.0), js.sdf.circle((1, 0), 1.0), 0.5)(jnp.zeros(2)))
    -0.125
    """
    radius = _positive("radius", radius)

    def sdf(x: jax.Array) -> jax.Array:
        a, b = first(x), second(x)
        overlap = jnp.maximum(radius - jnp.abs(a - b), 0.0)
        return jnp.minimum(a, b) - overlap**2 / (4.0 * radius)

    return sdf


def translate(shape: Sdf, offset: Any) -> Sdf:
    """The shape moved by ``offset`` (D,). Raises ValueError for what is no vector.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.translate(js.sdf.circle((0, 0), 1.0), (3, 0))(jnp.array([3.0, 0.0])))
    -1.0
    """
    offset = _vector("offset", offset)
    return lambda x: shape(_from(x, offset))


def scale(shape: Sdf, factor: Any, center: Any = None) -> Sdf:
    """The shape enlarged by ``factor`` > 0 about ``center`` (the origin by default). ValueError for another factor.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.scale(js.sdf.circle((0, 0), 1.0), 3.0)(jnp.zeros(2)))
    -3.0
    """
    factor = _positive("factor", factor)
    middle = 0.0 if center is None else _vector("center", center)
    return lambda x: factor * shape(middle + (x - middle) / factor)


def rotate(shape: Sdf, angle: Any, center: Any = None, axis: Any = None) -> Sdf:
    """The shape turned by ``angle`` (radians, counter-clockwise) about ``center`` (the origin by default).

    In 3D about the line through ``center`` along ``axis`` (3,), by the right-hand rule.
    Raises ValueError, when called, for a 3D point without an axis and for a 2D one with it.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> upright = js.sdf.rotate(js.sdf.rectangle((0, 0), (2, 1)), jnp.pi / 2)
    >>> print(f"{upright(jnp.array([-0.5, 1.0])):.3f}")
    -0.500
    """
    middle = 0.0 if center is None else _vector("center", center)
    direction = None if axis is None else _vector("axis", axis, 3)

    def sdf(x: jax.Array) -> jax.Array:
        if x.shape[0] == 1 or (x.shape[0] == 3) != (direction is not None):
            raise ValueError(
                f"axis: {axis} came with a point in {x.shape[0]}D; 3D needs an axis (3,), 2D takes none, 1D has none"
            )
        c, s, y = jnp.cos(angle), jnp.sin(angle), x - middle
        if direction is None:
            turned = jnp.stack([c * y[0] + s * y[1], c * y[1] - s * y[0]])
        else:
            unit = direction / _norm(direction)  # Rodrigues' formula with the opposite angle
            turned = c * y - s * jnp.cross(unit, y) + (1.0 - c) * jnp.dot(unit, y) * unit
        return shape(middle + turned)

    return sdf


def round(shape: Sdf, radius: Any) -> Sdf:
    """The shape grown by ``radius``, its convex corners rounded with it (exact distances only).

    To keep the size, shrink the shape first: ``round(box(lo + r, hi - r), r)``.
    Raises ValueError for a radius that is not positive.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.round(js.sdf.rectangle((0, 0), (2, 1)), 0.25)(jnp.array([1.0, 2.0])))
    0.75
    """
    radius = _positive("radius", radius)
    return lambda x: shape(x) - radius


def shell(shape: Sdf, thickness: Any) -> Sdf:
    """The wall of the given thickness with the boundary of ``shape`` in its middle.

    Raises ValueError for a thickness that is not positive.

    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.shell(js.sdf.circle((0, 0), 1.0), 0.5)(jnp.array([1.0, 0.0])))
    -0.25
    """
    half = _positive("thickness", thickness) / 2
    return lambda x: jnp.abs(shape(x)) - half


def _combine(pick: Callable[[jax.Array, jax.Array], jax.Array], shapes: Sequence[Sdf]) -> Sdf:
    """Fold the values of all shapes with min or max."""
    if not shapes or not all(map(callable, shapes)):
        raise ValueError(f"shapes: expected one or more functions x -> scalar, got {shapes!r}; pass them one by one")

    def sdf(x: jax.Array) -> jax.Array:
        value = shapes[0](x)
        for shape in shapes[1:]:
            value = pick(value, shape(x))
        return value

    return sdf


def _from(x: jax.Array, origin: Any) -> jax.Array:
    """x - origin; a point of another dimension would be broadcast to a shape that nobody meant."""
    if jnp.shape(x) != jnp.shape(origin):
        raise ValueError(
            f"sdf: a shape in {len(origin)}D was asked at a point of shape {jnp.shape(x)}; bounds and points must have "
            "its dimension"
        )
    return x - origin


def _norm(v: jax.Array) -> jax.Array:
    """Euclidean norm whose gradient at zero is zero instead of NaN."""
    square = jnp.sum(v * v)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def _corner_distance(q: jax.Array) -> jax.Array:
    """Distance to the orthant q < 0; on a face the gradient is that of the face, at a corner the mean."""
    return jnp.where(jnp.any(q > 0), _norm(jnp.where(q > 0, q, 0.0)), jnp.max(q))


def _concrete(value: Any) -> bool:
    return isinstance(value, (np.ndarray, float))


def _vector(name: str, value: Any, dim: int | None = None) -> Any:
    """A (D,) float64 host array, so that nothing depends on the precision at the time of the call."""
    if isinstance(value, jax.core.Tracer):
        vector: Any = value
    else:
        try:
            if any(isinstance(v, jax.core.Tracer) for v in value):
                vector = jnp.stack([jnp.asarray(v) for v in value])
            else:
                vector = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"{name}: expected {dim or 'D'} numbers, got {value!r}") from None
    if vector.ndim != 1 or (dim is not None and vector.shape != (dim,)) or vector.shape[0] not in (1, 2, 3):
        expected = f"({dim},)" if dim else "(D,) with D = 1, 2 or 3"
        raise ValueError(f"{name}: shape {vector.shape} came, {expected} was expected")
    if _concrete(vector) and not np.isfinite(vector).all():
        raise ValueError(f"{name}: expected finite numbers, got {value!r}")
    return vector


def _positive(name: str, value: Any) -> Any:
    """A positive number (or vector of them); traced values pass unchecked."""
    if isinstance(value, jax.core.Tracer):
        return value
    array = np.asarray(value, dtype=np.float64)
    if not (np.isfinite(array).all() and (array > 0).all()):
        raise ValueError(f"{name}: expected a positive finite length, got {value!r}")
    return array if array.ndim else float(array)
