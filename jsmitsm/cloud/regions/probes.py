"""Probes around a particle, which tell what meets there."""

from __future__ import annotations

import numpy as np

from jsmitsm.cloud.packing.octree import Spacing
from jsmitsm.cloud.regions.shapes import Shape

# So many of them.
_PROBES = 24
# A probe is inside of a shape from this part of its distance on.
_INSIDE = 1e-3


def share_a_side(one: np.ndarray, two: np.ndarray, member: np.ndarray, at: np.ndarray, dim: int) -> np.ndarray:
    """Mask of the particles ``at`` at which two shapes share a piece of boundary, not only that point.

    Of the probes in a ring those of each shape follow one another; shapes that share a side have neighbouring ones.
    """
    if dim != 2:
        return np.ones(len(at), bool)
    a, b = one[:, at], two[:, at]
    touch = (a & np.roll(b, 1, axis=0)) | (b & np.roll(a, 1, axis=0)) | (a & b)
    return np.asarray(touch.any(axis=0))


def on_boundary(shape: Shape, points: np.ndarray, reach: Spacing, tolerance: float) -> np.ndarray:
    """Mask of the points (M, D) where a shape ends: zero there, and negative on some side at the distance ``reach``, a
    function of the place.

    A difference, ``max(box, -disk)``, is zero too along the side of the box that the disk has taken away from it.
    """
    mask = np.asarray(np.abs(shape.distance(points)[0]) <= tolerance)
    at = np.flatnonzero(mask)
    if len(at):
        steps, away = directions(points.shape[1], 4 * _PROBES), reach(points[at])
        around = points[at][:, None] + away[:, None, None] * steps
        depth = shape.distance(around.reshape(-1, points.shape[1]))[0].reshape(len(at), len(steps))
        mask[at] = depth.min(axis=1) < -_INSIDE * away
    return mask


def outward(shape: Shape, points: np.ndarray, spacing: Spacing) -> np.ndarray:
    """Unit outward normals of a shape at points of its boundary; at corners the bisector of what is around."""
    if not len(points):
        return points
    normal = shape.distance(points)[1]
    if points.shape[1] != 2:
        return normal
    # A ring of probes just outside: the gradient at a corner itself may be that of either side, or nothing.
    h = spacing(points)
    total, angles = np.zeros(points.shape), np.arange(16) * np.pi / 8
    for angle in angles:
        step = 1e-4 * h[:, None] * np.array([np.cos(angle), np.sin(angle)])
        distance, slope = shape.distance(points + step)
        total += np.where((distance >= 0)[:, None], slope, 0.0)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    mean = np.where(length > 1e-6, total / np.maximum(length, 1e-300), normal)
    corner = (mean * normal).sum(axis=1) < np.cos(np.radians(5.0))
    return np.where(np.asarray(corner | ~normal.any(axis=1))[:, None], mean, normal)


def directions(dim: int, count: int = _PROBES) -> np.ndarray:
    """Unit vectors to all sides."""
    if dim == 1:
        return np.array([[-1.0], [1.0]])
    if dim == 2:
        # Off the axes, along which boundaries often run.
        angle = 2.0 * np.pi * (np.arange(count) + 0.37) / count
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
