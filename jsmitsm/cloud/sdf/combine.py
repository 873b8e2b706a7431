"""Signed distances combined, moved, rounded and hollowed out; all of it is in ``js.sdf`` too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jsmitsm.cloud.sdf.vectors import norm, offset_from, positive, vector

Sdf = Callable[[jax.Array], jax.Array]


def union(*shapes: Sdf) -> Sdf:
    """What lies in any of the shapes (the smallest distance; exact outside, a bound inside).

    Parameters
    ----------
    *shapes : Sdf
        One or more functions x (D,) -> scalar.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        Without any shape, and for what is no function.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> left, right = js.sdf.circle((0, 0), 1.0), js.sdf.circle((3, 0), 1.0)
    >>> float(js.sdf.union(left, right)(jnp.array([3.0, 0.0])))
    -1.0
    """
    return _combine(jnp.minimum, shapes)


def intersection(*shapes: Sdf) -> Sdf:
    """What lies in all of the shapes (the largest distance; exact inside, a bound outside).

    Parameters
    ----------
    *shapes : Sdf
        One or more functions x (D,) -> scalar.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        Without any shape, and for what is no function.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> left, right = js.sdf.circle((0, 0), 1.0), js.sdf.circle((1, 0), 1.0)
    >>> float(js.sdf.intersection(left, right)(jnp.array([0.5, 0.0])))
    -0.5
    """
    return _combine(jnp.maximum, shapes)


def difference(shape: Sdf, *holes: Sdf) -> Sdf:
    """What lies in ``shape`` and in none of the ``holes``.

    Parameters
    ----------
    shape : Sdf
        What is cut.
    *holes : Sdf
        What is cut out.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        For what is no function.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> disk, hole = js.sdf.circle((0, 0), 2.0), js.sdf.circle((0, 0), 1.0)
    >>> float(js.sdf.difference(disk, hole)(jnp.array([1.5, 0.0])))
    -0.5
    """
    return intersection(shape, *map(complement, holes))


def complement(shape: Sdf) -> Sdf:
    """What lies outside of ``shape``.

    Parameters
    ----------
    shape : Sdf
        A function x (D,) -> scalar.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.complement(js.sdf.circle((0, 0), 1.0))(jnp.array([0.0, 0.0])))
    1.0
    """
    return lambda x: -shape(x)


def smooth_union(first: Sdf, second: Sdf, radius: Any) -> Sdf:
    """The union with its seam filled; quadratic blend, C1.

    Parameters
    ----------
    first, second : Sdf
        Functions x (D,) -> scalar.
    radius : float
        Width of the seam, length units, positive.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        For a width that is not positive.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> left, right = js.sdf.circle((-1, 0), 1.0), js.sdf.circle((1, 0), 1.0)
    >>> float(js.sdf.smooth_union(left, right, 0.5)(jnp.zeros(2)))
    -0.125
    """
    radius = positive("radius", radius)

    def sdf(x: jax.Array) -> jax.Array:
        a, b = first(x), second(x)
        overlap = jnp.maximum(radius - jnp.abs(a - b), 0.0)
        return jnp.minimum(a, b) - overlap**2 / (4.0 * radius)

    return sdf


def translate(shape: Sdf, offset: Any) -> Sdf:
    """The shape moved by ``offset``.

    Parameters
    ----------
    shape : Sdf
        A function x (D,) -> scalar.
    offset : array_like (D,)
        Length units.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        For what is no vector.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> moved = js.sdf.translate(js.sdf.circle((0, 0), 1.0), (3, 0))
    >>> float(moved(jnp.array([3.0, 0.0])))
    -1.0
    """
    offset = vector("offset", offset)
    return lambda x: shape(offset_from(x, offset))


def scale(shape: Sdf, factor: Any, center: Any = None) -> Sdf:
    """The shape enlarged by ``factor`` about ``center``.

    Parameters
    ----------
    shape : Sdf
        A function x (D,) -> scalar.
    factor : float
        Positive.
    center : array_like (D,), optional
        What stays in its place, the origin by default.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        For a factor that is not positive.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.scale(js.sdf.circle((0, 0), 1.0), 3.0)(jnp.zeros(2)))
    -3.0
    """
    factor = positive("factor", factor)
    middle = 0.0 if center is None else vector("center", center)
    return lambda x: factor * shape(middle + (x - middle) / factor)


def rotate(shape: Sdf, angle: Any, center: Any = None, axis: Any = None) -> Sdf:
    """The shape turned about ``center``; in 3D about the line through it along ``axis``, by the right-hand rule.

    Parameters
    ----------
    shape : Sdf
        A function x (D,) -> scalar.
    angle : float
        Radians, counter-clockwise.
    center : array_like (D,), optional
        What stays in its place, the origin by default.
    axis : array_like (3,), optional
        Needed in 3D, and there alone.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        When called, for a 3D point without an axis and for a 2D one with it.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> upright = js.sdf.rotate(js.sdf.rectangle((0, 0), (2, 1)), jnp.pi / 2)
    >>> print(f"{upright(jnp.array([-0.5, 1.0])):.3f}")
    -0.500
    """
    middle = 0.0 if center is None else vector("center", center)
    direction = None if axis is None else vector("axis", axis, 3)

    def sdf(x: jax.Array) -> jax.Array:
        if x.shape[0] == 1 or (x.shape[0] == 3) != (direction is not None):
            raise ValueError(
                f"axis: {axis} came with a point in {x.shape[0]}D; 3D needs an axis (3,), 2D takes none, 1D has none "
                "(docs: clouds)"
            )
        c, s, y = jnp.cos(angle), jnp.sin(angle), x - middle
        if direction is None:
            turned = jnp.stack([c * y[0] + s * y[1], c * y[1] - s * y[0]])
        else:
            unit = direction / norm(direction)  # Rodrigues' formula with the opposite angle
            turned = c * y - s * jnp.cross(unit, y) + (1.0 - c) * jnp.dot(unit, y) * unit
        return shape(middle + turned)

    return sdf


def round(shape: Sdf, radius: Any) -> Sdf:
    """The shape grown by ``radius``, its convex corners rounded with it (exact distances only).

    To keep the size, shrink the shape first: ``round(box(lo + r, hi - r), r)``.

    Parameters
    ----------
    shape : Sdf
        A function x (D,) -> scalar.
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
    >>> rounded = js.sdf.round(js.sdf.rectangle((0, 0), (2, 1)), 0.25)
    >>> float(rounded(jnp.array([1.0, 2.0])))
    0.75
    """
    radius = positive("radius", radius)
    return lambda x: shape(x) - radius


def shell(shape: Sdf, thickness: Any) -> Sdf:
    """The wall of the given thickness with the boundary of ``shape`` in its middle.

    Parameters
    ----------
    shape : Sdf
        A function x (D,) -> scalar.
    thickness : float
        Length units, positive.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        For a thickness that is not positive.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.shell(js.sdf.circle((0, 0), 1.0), 0.5)(jnp.array([1.0, 0.0])))
    -0.25
    """
    half = positive("thickness", thickness) / 2
    return lambda x: jnp.abs(shape(x)) - half


def _combine(pick: Callable[[jax.Array, jax.Array], jax.Array], shapes: Sequence[Sdf]) -> Sdf:
    """Fold the values of all shapes with min or max."""
    if not shapes or not all(map(callable, shapes)):
        raise ValueError(
            f"shapes: expected one or more functions x -> scalar, got {shapes!r}; pass them one by one (docs: clouds)"
        )

    def sdf(x: jax.Array) -> jax.Array:
        value = shapes[0](x)
        for shape in shapes[1:]:
            value = pick(value, shape(x))
        return value

    return sdf
