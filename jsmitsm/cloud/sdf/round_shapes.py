"""Signed distances of ellipses, capsules, cylinders and tori."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.sdf.combine import Sdf
from jsmitsm.cloud.sdf.vectors import corner_distance, norm, offset_from, positive, vector


def ellipse(center: Any, semi_axes: Any) -> Sdf:
    """The ellipse (in 3D ellipsoid) sum ((x - center) / semi_axes)^2 < 1.

    Not a true distance but k (k - 1) / |grad k|-like: exact zero level, first-order distance near it.

    Parameters
    ----------
    center : array_like (D,)
        Its centre, length units.
    semi_axes : array_like (D,)
        Half of its widths, positive.

    Returns
    -------
    Sdf
        The function x (D,) -> scalar.

    Raises
    ------
    ValueError
        For semi-axes that are not positive.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.ellipse((0, 0), (2, 1))(jnp.array([2.0, 0.0])))
    0.0
    """
    center = vector("center", center)
    axes = positive("semi_axes", vector("semi_axes", semi_axes, np.shape(center)[0]))

    def sdf(x: jax.Array) -> jax.Array:
        y = offset_from(x, center) / axes
        radius, slope = norm(y), norm(y / axes)
        # At the centre the ratio radius / slope has no limit; any value between the semi-axes serves.
        ratio = jnp.where(slope > 0, radius / jnp.where(slope > 0, slope, 1.0), jnp.min(axes))
        return (radius - 1.0) * ratio

    return sdf


ellipsoid = ellipse


def capsule(a: Any, b: Any, radius: Any) -> Sdf:
    """All points closer than ``radius`` to the segment from ``a`` to ``b``: a stadium, a rod with round ends.

    Parameters
    ----------
    a, b : array_like (D,)
        The ends of the segment, length units.
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
    >>> float(js.sdf.capsule((0, 0), (2, 0), 0.5)(jnp.array([1.0, 2.0])))
    1.5
    """
    a, radius = vector("a", a), positive("radius", radius)
    along = vector("b", b, np.shape(a)[0]) - a

    def sdf(x: jax.Array) -> jax.Array:
        t = jnp.clip(jnp.dot(offset_from(x, a), along) / jnp.dot(along, along), 0.0, 1.0)
        return norm(x - a - t * along) - radius

    return sdf


def cylinder(a: Any, b: Any, radius: Any) -> Sdf:
    """The solid cylinder of flat ends around the axis from ``a`` to ``b``. Exact distance.

    Parameters
    ----------
    a, b : array_like (3,)
        The ends of the axis, length units.
    radius : float
        Length units, positive.

    Returns
    -------
    Sdf
        The function x (3,) -> scalar.

    Raises
    ------
    ValueError
        For a radius that is not positive.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.cylinder((0, 0, 0), (0, 0, 2), 1.0)(jnp.array([0.0, 3.0, 1.0])))
    2.0
    """
    a, radius = vector("a", a, 3), positive("radius", radius)
    along = vector("b", b, 3) - a

    def sdf(x: jax.Array) -> jax.Array:
        length = norm(along)
        axis = along / length
        z = jnp.dot(offset_from(x, a), axis)
        across = norm(x - a - z * axis)
        return corner_distance(jnp.stack([across - radius, jnp.abs(z - length / 2) - length / 2]))

    return sdf


def torus(center: Any, major: Any, minor: Any, axis: Any = (0.0, 0.0, 1.0)) -> Sdf:
    """The solid torus: a tube of radius ``minor`` bent round ``axis`` with radius ``major``.

    Parameters
    ----------
    center : array_like (3,)
        Its centre, length units.
    major, minor : float
        The radius of the ring and that of the tube, positive.
    axis : array_like (3,)
        The axis of the ring, of any length.

    Returns
    -------
    Sdf
        The function x (3,) -> scalar.

    Raises
    ------
    ValueError
        For radii that are not positive.

    Examples
    --------
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> float(js.sdf.torus((0, 0, 0), 2.0, 0.5)(jnp.array([2.0, 0.0, 1.5])))
    1.0
    """
    center, axis = vector("center", center, 3), vector("axis", axis, 3)
    major, minor = positive("major", major), positive("minor", minor)

    def sdf(x: jax.Array) -> jax.Array:
        unit = axis / norm(axis)
        z = jnp.dot(offset_from(x, center), unit)
        across = norm(x - center - z * unit)
        return norm(jnp.stack([across - major, z])) - minor

    return sdf
