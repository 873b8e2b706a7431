"""Where smoothness ends at a boundary that does not hold the values: rows of all orders err alike there."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.equation.problem import Problem
from jsmitsm.solution.look.edges import turns

# The error beside such a point in parts of what the values around it are from a plane. Measured on r^(1/2) between
# held and free, and on r^(2/3) between two free sides: 0.2 to 0.45; as much as 2 where the point is not a particle.
_PART, _UNPLACED = 0.35, 1.0
# So many nearest particles are around a particle.
_AROUND = 9
# Conditions that give values, or nothing.
_HELD = ("dirichlet", "fix", "periodic", "free")


def off_at_free_ends(
    problem: Problem, cloud: Cloud, values: np.ndarray, slow: np.ndarray | None, before: np.ndarray | None
) -> np.ndarray:
    """What the values (N, F) may be off by, (N,), where smoothness ends beside a condition on derivatives.

    slow (N,): where it ends; None where no two rounds have told yet, and then it does where a side stops being held.
    before (M, D): the particles of the round before. Where such a stop is none of them it is no vertex of the domain,
    and lies anywhere between two particles.
    """
    points = np.asarray(cloud.points)
    free, rim = _free(problem, cloud), np.asarray(cloud.boundary)
    if not free.any() or cloud.dim == 1:
        return np.zeros(len(points))
    near = cKDTree(points).query(points, k=min(_AROUND, len(points)))[1]
    beside = rim[cKDTree(points[rim]).query(points[rim], k=min(3, len(rim)))[1]]
    stop, sought = np.zeros((2, len(points)), bool)
    stop[rim] = (free[beside] != free[rim][:, None]).any(axis=1)
    if before is not None:
        placed = cKDTree(before).query(points)[0] < 1e-9 * np.ptp(points, axis=0).max()
        sought[rim] = stop[rim] & ~placed[beside].any(axis=1)
    if slow is None:
        turned = False if cloud.normals is None else turns(np.asarray(cloud.normals, float)[beside])
        slow = np.zeros(len(points), bool)
        slow[rim] = stop[rim] & ~turned
    part = np.where(sought[near].any(axis=1), _UNPLACED, _PART)
    return np.where(slow & free[near].any(axis=1), part * _from_a_plane(points, values, near), 0.0)


def _free(problem: Problem, cloud: Cloud) -> np.ndarray:
    """The particles (N,) with a condition on more than values."""
    found = np.zeros(len(cloud), bool)
    for name, conditions in problem.bcs.items():
        if name in cloud.groups and any(condition.kind not in _HELD for condition in conditions):
            found[cloud.groups[name]] = True
    return found


def _from_a_plane(points: np.ndarray, values: np.ndarray, near: np.ndarray) -> np.ndarray:
    """By how much the values (N, F) of the particles ``near`` (N, k) differ from linear ones, (N,)."""
    x = points[near] - points[:, None]
    x = x / np.abs(x).max(axis=(1, 2), keepdims=True)
    linear = np.concatenate([np.ones((*near.shape, 1)), x], axis=2)
    around = values[near]
    return np.abs(around - linear @ (np.linalg.pinv(linear) @ around)).max(axis=(1, 2))
