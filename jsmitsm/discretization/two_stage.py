"""The rows of methods I and II in two stages: every particle's coefficients recovered, then inserted into the rows."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.sight.walls import nearest_seen, within_seen
from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.discretization.local_data import around, operands, right_sides, sent
from jsmitsm.discretization.sharing import in_pieces, on_all_cores
from jsmitsm.particle import batches
from jsmitsm.particle.closure import Recovery
from jsmitsm.particle.kernels import Kernel
from jsmitsm.particle.moments import Row
from jsmitsm.runtime.tracers import is_traced

# Smoothing lengths at which a Gauss function has fallen to 1e-4: a fit without LAPACK forms its normal
# equations, which in float32 cannot use much less.
_FAR = 3.0


def two_stage_rows(disc: Discretization, nums: Numbers, shared: Any) -> tuple[list[Class], list[Row]]:
    """Methods I and II: recover every particle's coefficients, then insert them into the rows."""
    there = around(disc, nums)
    wide, far = _recovery_kernel(disc)
    wide = batches.in_cloud_size(wide, len(far))
    conditioned = np.zeros(len(disc.cloud), int)
    for group in disc.groups:
        conditioned[group.ids] = 0 if group.held else group.n_rows
    wholes = []
    for count in np.unique(conditioned):
        ids = np.flatnonzero(conditioned == count)
        wholes.append(Class(ids, far[ids], replace(disc.scheme, n_own=int(count))))

    def recoveries(cls: Class) -> Recovery:
        given, sides = operands(disc, nums, cls, shared, there.data), right_sides(disc, nums, cls)
        return batches.recoveries(cls.scheme, there.points, wide, cls.ids, cls.neighbours, given, sides)

    cut = in_pieces(disc, nums, wholes)
    parts = on_all_cores("recoveries", recoveries, disc, nums, cut)
    xp = jnp if is_traced(parts) else np
    back = np.argsort(np.concatenate([cls.ids for cls in cut]))
    recovered = jax.tree.map(lambda *x: xp.concatenate(x)[back], *parts)
    reach = _reach(disc.stencils.indices, far)
    known = sent(batches.in_cloud_size((far, recovered), len(far)))

    def closed(cls: Class) -> Row:
        given, reached = operands(disc, nums, cls, shared, there.data), (reach[cls.ids],)
        return batches.closed_rows(
            cls.scheme, there.points, there.kernel, cls.ids, cls.neighbours, given, reached, known
        )

    classes = in_pieces(disc, nums, disc.classes)
    made = on_all_cores("local fits", closed, disc, nums, classes)
    return [replace(cls, neighbours=reach[cls.ids]) for cls in classes], made


def _recovery_kernel(disc: Discretization) -> tuple[Kernel, Any]:
    """The kernel of stage 1 and its neighbours: wide enough to hold 1.5 times the free coefficients."""
    points, kernel = disc.points, disc.kernel
    near: Any = disc.stencils.indices
    assert kernel is not None  # layout gives I and II one
    count = math.ceil(1.5 * len(disc.scheme.free)) + 1
    if disc.given_stencils or is_traced(near, points, kernel):
        xp = jnp if is_traced(near, points) else np
        near, points = xp.asarray(near), xp.asarray(points)
        away = xp.where(near >= 0, xp.sum((points[xp.maximum(near, 0)] - points[:, None]) ** 2, axis=2), xp.inf)
        reach = xp.sqrt(xp.sort(away, axis=1)[:, min(count, near.shape[1]) - 1])
        reach = xp.where(xp.isfinite(reach), reach, 0.0)
    else:
        near = None
        reach = nearest_seen(np.asarray(points), min(count, len(points)), None, disc.walls).radius
    xp = jnp if is_traced(reach, kernel) else np
    # Inside the support, and where the weight is not yet lost to rounding.
    wide = kernel.replace(h=xp.maximum(kernel.h, reach / xp.minimum(0.9 * kernel.d, _FAR)))
    if near is None:
        radius = np.maximum(kernel.h * np.asarray(kernel.d), reach / 0.9)
        near = within_seen(np.asarray(points), radius, None, disc.walls).indices
    return wide, near


def _reach(near: Any, far: Any) -> np.ndarray:
    """The neighbours of every particle's neighbours, those included: (N, w), -1 for none."""
    n = len(near)
    if is_traced(near, far):  # nothing is known of them but that they are in the cloud
        return np.broadcast_to(np.arange(n), (n, n))
    one, two = (_pattern(np.asarray(x), n) for x in (near, far))
    both = (one @ two + one).tocsr()
    both.sort_indices()
    count = np.diff(both.indptr)
    out = np.full((n, count.max()), -1, np.int32)
    out[np.arange(out.shape[1]) < count[:, None]] = both.indices
    return out


def _pattern(near: np.ndarray, n: int) -> Any:
    """Who is whose neighbour, as a sparse matrix (N, N) of ones."""
    from scipy.sparse import csr_matrix

    i, k = np.nonzero(near >= 0)
    return csr_matrix((np.ones(len(i), np.float32), (i, near[i, k])), (n, n))
