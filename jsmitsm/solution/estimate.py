"""Error estimate by defect correction: the rows of a higher order, applied to the solution."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.discretization.coefficients import Numbers, numbers
from jsmitsm.discretization.layout import Discretization
from jsmitsm.discretization.leave_one_out import matrix, right_side
from jsmitsm.discretization.rows import all_rows
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.solution.arguments import discretized
from jsmitsm.solution.fit import Fit
from jsmitsm.solution.run import Run
from jsmitsm.taylor.multi_indices import HIGHEST, multi_indices


@bar("error estimate")
def error_estimate(fit: Fit, values: Any) -> Any:
    """Estimated error |u - u_exact| of every particle, (N,) or (N, F).

    The defect of the solution in rows of order p + 2, taken through the inverse of its own
    matrix: e = A_p^-1 D (b_{p+2} - A_{p+2} u_p). D brings the rows of the two orders to one scale,
    that of the source in them. A least-squares solution is compared with that of order p + 2: its
    rows have no common scale. Held values have no error; where p + 2 is no better than p (no
    smoothness, or round-off) the estimate says little.
    """
    low = fit.discretization()
    if fit.recipe.formulation == "lsq":
        return _against_higher(fit, low, values)
    run = Run(low, fit.problem, "auto", True, False, "loo")
    nums = numbers(low, fit.problem, fit.taylor)
    classes, rows = all_rows(low, nums)
    high, high_nums = _higher(fit, low)
    high_rows = Run(high, fit.problem, "auto", True, True, "loo").local_rows(high_nums)
    defect = _per_value(high, *high_rows, high_nums, values)
    own = _per_value(low, classes, rows, nums, values)
    free = np.flatnonzero(~low.held.reshape(-1))
    mine, theirs = own[1].reshape(-1)[free], defect[1].reshape(-1)[free]
    xp = jnp if is_traced(mine, theirs) else np
    known = (mine != 0) & (theirs != 0)
    ratio = xp.where(known, mine / xp.where(known, theirs, 1.0), 1.0)
    data, r, c = matrix(low, classes, rows)
    x, _ = run.solved(data, r, c, ratio * defect[0].reshape(-1)[free], balanced=False)
    zero = np.zeros(low.held.size)
    error: Any = jnp.asarray(zero).at[free].set(x) if is_traced(x) else _put(zero, free, x)
    error = abs(error).reshape(low.held.shape)
    return error[:, 0] if low.rec.fields == 1 else error


def _against_higher(fit: Fit, low: Discretization, values: Any) -> Any:
    """The distance to the least-squares solution of order p + 2, (N,) or (N, F)."""
    high, nums = _higher(fit, low)
    reference, _ = Run(high, fit.problem, "auto", True, False, "lsq").step(nums)
    error = abs(reference - values)
    return error[:, 0] if low.rec.fields == 1 else error


def _put(array: np.ndarray, at: np.ndarray, value: Any) -> np.ndarray:
    array[at] = value
    return array


def _higher(fit: Fit, low: Discretization) -> tuple[Discretization, Numbers]:
    """The same problem with method S of order p + 2 on its own stencils."""
    order = fit.recipe.order + 2
    if order > HIGHEST:
        raise ValueError(
            f"error_estimate: needs expansions of order p + 2 = {order}, and {HIGHEST} is the highest; solve at order "
            f"{HIGHEST - 2} or below, or compare with the solution on a finer cloud"
        )
    host = concrete(fit.cloud.points)
    if host is None:
        raise ValueError(
            "error_estimate: the points are traced by a JAX transform, and the wider stencils it needs are found on "
            "the host; ask for it outside the transform"
        )
    cloud = Cloud(np.asarray(host), low.cloud.groups, low.cloud.normals)
    high = discretized(fit.problem, cloud, "S", order, depth=low.rec.depth)
    high.cloud = fit.cloud
    taylor = fit.taylor
    if taylor is not None:
        more = len(multi_indices(low.rec.dim, high.rec.reach)) - taylor.shape[2]
        taylor = (jnp if is_traced(taylor) else np).pad(taylor, ((0, 0), (0, 0), (0, more)))
    return high, numbers(high, fit.problem, taylor)


def _per_value(disc: Discretization, classes: Any, rows: Any, nums: Numbers, values: Any) -> tuple[Any, Any]:
    """The residual b - A u of every row, and the weight of the source in it, both (N, F)."""
    traced = is_traced(rows, values)
    xp = jnp if traced else np
    b = right_side(disc, nums, classes, rows)
    data, r, c = matrix(disc, classes, rows)
    free = np.flatnonzero(~disc.held.reshape(-1))
    u = xp.asarray(values).reshape(-1)[free]
    au = xp.zeros(len(free)).at[r].add(data * u[c]) if traced else np.bincount(r, data * u[c], len(free))
    residual, weight = xp.zeros(disc.held.size), xp.ones(disc.held.size)
    first = np.array(disc.rec.equation_rows)
    parts = [_strongest(xp.asarray(row.source)[:, :, first], xp) for row in rows]
    ids = np.concatenate([cls.ids for cls in classes])
    strength = xp.concatenate(parts)
    if traced:
        residual = residual.at[free].set(b - au)
        return residual.reshape(disc.held.shape), weight.reshape(disc.held.shape).at[ids].set(strength)
    residual[free] = b - au
    weight = weight.reshape(disc.held.shape)
    weight[ids] = strength
    return residual.reshape(disc.held.shape), weight


def _strongest(weights: Any, xp: Any) -> Any:
    """Of each row's weights of the sources (n, F, E), the largest in size: (n, F)."""
    place = xp.argmax(xp.abs(weights), axis=2)
    return xp.take_along_axis(weights, place[..., None], axis=2)[..., 0]
