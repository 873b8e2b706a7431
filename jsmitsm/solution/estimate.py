"""Error estimate: the rows of a higher order, applied to the solution, and solved for what they miss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.discretization.coefficients import Numbers, numbers
from jsmitsm.discretization.health import LEBESGUE
from jsmitsm.discretization.layout import Class, Discretization, mean_spacing
from jsmitsm.discretization.least_squares import misfit
from jsmitsm.discretization.leave_one_out import matrix, right_side, with_held
from jsmitsm.discretization.resolution.digits import lags, room
from jsmitsm.discretization.rows import all_coefficients, all_rows
from jsmitsm.linear.linsolve import times
from jsmitsm.particle.moments import Row
from jsmitsm.particle.recursion import constraints
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.progress import bar
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.runtime.whole_program import in_one_program
from jsmitsm.solution.arguments import discretized
from jsmitsm.solution.fit import Fit
from jsmitsm.solution.look.between import unseen
from jsmitsm.solution.look.sizes import share
from jsmitsm.solution.run import Run
from jsmitsm.taylor.multi_indices import HIGHEST, multi_indices

# Ratios of weights are taken for outliers beyond this factor of their median.
OUTLIER = 2.0
# From this order on, rows of order p + 2 of which some are trusted less may be worse than those of order p.
HIGH, TRUSTED = 6, 0.7
# Where a lower order sees a smaller error than these, the estimate lies so far between the two, in logarithms.
DOUBT = 1.0 / 3.0
# In the least-squares form order p + 2 is nearer to the solution where its fits miss one another by this part of what
# those of p do. Measured: below 0.15 in nearly all cases where it is, above 0.25 where it is not.
BETTER = 0.2
# So many particles tell the units of the fields.
LOOKED_AT = 9


@dataclass(frozen=True)
class Correction:
    """What an estimate knows besides the size of the error.

    error (N, F): the estimated u_exact - u, with its sign.
    towards (N, F): what leads to the solution of the other order, of which the error may be a part.
    made: the defect (N, F), for ``defect``; None for the methods other than S, which have none.
    between: for ``missed``, None where there is nothing that rows could miss.
    adjoint: of weights (N, F) of the values in a number, those of the defects in it; None where there are no rows.
    through: of defects (N, F) what they make of u; None where there are no rows.
    units (F,): what the fields are multiplied with to be compared with one another.
    """

    error: Any
    towards: Any
    made: Callable[[], Any] | None
    adjoint: Callable[[np.ndarray], np.ndarray] | None
    units: Any = 1.0
    through: Callable[[np.ndarray], np.ndarray] | None = None
    between: Callable[[], Any] | None = None

    @cached_property
    def missed(self) -> tuple[Any, Any] | None:
        """What the source makes of u where its Taylor series do not tell it between the particles, and the defect.

        (N, F) each; rows of all orders miss it alike, and so does the distance of their solutions. None where the
        source is constant and no coefficient has kinks.
        """
        return None if self.between is None else self.between()

    @cached_property
    def defect(self) -> Any:
        """By how much every value misses its prediction by rows of a higher order, in the scale of u, (N, F).

        What each particle contributes to the error, which is about the inverse of the global matrix times this. In the
        least-squares form the misfit of its local fit. Made when asked for: an error estimate does without.
        """
        return None if self.made is None else self.made()


@bar("error estimate", parts=(("local fits", 3.0), ("unknowns", 1.0)))
def correction(fit: Fit, values: Any, made: Run | None = None) -> Correction:
    """The estimated error of the values (N, F), and what it comes from.

    made: the run of the solve, where its numbers and rows are still there. The defect of the solution
    in rows of order p + 2, taken through the inverse of their matrix,

        e = A_{p+2}^-1 (b_{p+2} - A_{p+2} u_p),

    is what leads to the solution of order p + 2, or of a lower one where that knows nothing more (see ``compared``).
    Where that matrix is singular a lower order is compared with, which is off by as much as p, or more. For those who
    ask what each particle contributes, and where no order is lower, the defect is taken through the solution's own:
    A_p^-1 D (b_{p+2} - A_{p+2} u_p). D brings the rows of both orders to one scale, that of the source in them; rows of
    one-sided stencils count less: they amplify what order p + 2 misses itself. Solutions of other methods, and of the
    least-squares form, whose rows are no such predictions or have no common scale, are compared with that of method S
    of order p + 2 (see ``_by_misfits``). Held values have no error; where p + 2 is no better the estimate says little.
    """
    low = fit.discretization()
    known = None if made is None else made.nums
    nums = cache(lambda: numbers(low, fit.problem, fit.taylor) if known is None else known)

    if fit.recipe.formulation == "lsq" or fit.recipe.method != "S":
        return _against(fit, low, values, nums)
    order = _beside(fit, low)
    try:
        high, high_nums = _of_order(fit, low, order)
        above = Run(high, fit.problem, "auto", True, True, "loo")
        high_rows = above.local_rows(high_nums)
    except (SolveError, ValueError) as fault:  # too few neighbours for so high an order
        few = isinstance(fault, SolveError) or str(fault).startswith("cloud:")
        if not few or (below := _below(fit, low, values)) is None:
            raise
        return Correction(below[0], below[0], None, None, below[1])
    entries = matrix(high, *high_rows)
    residual = _residual(high, *high_rows, high_nums, entries, values)
    trust = _trust(high, *high_rows)
    free = np.flatnonzero(~low.held.reshape(-1))
    spread = partial(_spread, free=free, shape=low.held.shape)
    run = Run(low, fit.problem, "auto", True, False, "loo")

    @cache
    def own() -> tuple[list[Class], list[Row]]:
        return all_rows(low, nums()) if made is None or made.rows is None else made.rows

    def defect() -> Any:
        return _one_scale(_weights(low, *own()), _weights(high, *high_rows), low) * trust * spread(residual)

    def through(defects: np.ndarray, transpose: bool = False) -> np.ndarray:
        right = np.concatenate([defects.reshape(-1)[free], np.zeros(len(low.floating))])
        return spread(run.factor_of(*matrix(low, *own())).solve(right, transpose=transpose)[: len(free)])

    def between() -> Any:
        of = made.fitted if made is not None and made.nums is not None else partial(all_coefficients, low)
        fitted = lambda: np.asarray(of(nums(), values), float)
        defect = unseen(low, nums(), fit.problem, own(), fitted)
        if defect is None:
            return None
        return through(defect), defect

    try:
        x, _ = above.solved(*entries, residual, balanced=False)
        error = towards = spread(x)
    except SolveError:  # as on few particles
        below = _below(fit, low, values)
        error = towards = through(defect()) if below is None else below[0]
    if order > fit.recipe.order and not is_traced(error, trust) and trust.min(initial=1.0) < TRUSTED:
        if fit.recipe.order >= HIGH or share(np.asarray(error), np.asarray(values)) > 1.0:
            error = _doubted(fit, low, values, error)
    turned = partial(through, transpose=True)
    return Correction(error, towards, defect, turned, comparable(high, high_nums), through, between)


def _one_scale(mine: Any, theirs: Any, disc: Discretization) -> Any:
    """The ratios (N, F) of the weights that the source has in the rows of both orders, without outliers.

    A row with a condition of its own hardly hangs on the source, whose weights may vanish there in one of the two.
    """
    xp = jnp if is_traced(mine, theirs) else np
    known = (mine != 0) & (theirs != 0)
    ratio = xp.where(known, mine / xp.where(known, theirs, 1.0), 1.0)
    typical = xp.ones(ratio.shape)
    for some in (disc.n_own == 0, disc.n_own > 0):
        for f in range(ratio.shape[1]):
            ids = np.flatnonzero(some & ~disc.held[:, f])
            if len(ids):
                typical = xp.where((np.isin(np.arange(len(ratio)), ids))[:, None] & (np.arange(ratio.shape[1]) == f),
                                   xp.median(ratio[ids, f]), typical)  # fmt: skip
    part = ratio / typical
    return typical * xp.where(part > 0, xp.clip(part, 1.0 / OUTLIER, OUTLIER), 1.0)


def _trust(disc: Discretization, classes: list[Class], rows: list[Row]) -> Any:
    """How far the rows of the higher order are trusted, (N, 1): those of one-sided stencils amplify what they miss."""
    ids = np.concatenate([cls.ids for cls in classes])
    return _trusted([row.lebesgue for row in rows], ids, len(disc.cloud))


@partial(in_one_program, static=("n",))
def _trusted(lebesgue: list[Any], ids: np.ndarray, n: int) -> Any:
    traced = is_traced(lebesgue)
    xp: Any = jnp if traced else np
    largest = xp.concatenate([xp.asarray(some).max(axis=1) for some in lebesgue])
    part = xp.minimum(1.0, LEBESGUE / xp.maximum(largest, 1.0))
    return (jnp.ones(n).at[ids].set(part) if traced else _put(np.ones(n), ids, part))[:, None]


def _against(fit: Fit, low: Discretization, values: Any, nums: Callable[[], Numbers]) -> Correction:
    """What leads to the solution by method S of order p + 2; nums: makes the numbers of the solution's own order."""
    order = _beside(fit, low)
    if fit.recipe.formulation != "lsq" or is_traced(values, low.cloud.points, fit.problem.params):
        error, units, _ = _towards(fit, low, values, order)
        return Correction(error, error, None, None, units)
    own = cache(lambda: np.asarray(misfit(low, nums(), values)))
    missed = lambda: _put(np.zeros(low.held.shape), nums().ids, own()[:, None])
    if order < fit.recipe.order:
        error, units, _ = _towards(fit, low, values, order)
    else:
        error, units = _by_misfits(fit, low, values, order, own())
    return Correction(error, error, missed, None, units)


def _by_misfits(fit: Fit, low: Discretization, values: Any, order: int, own: np.ndarray) -> tuple[Any, Any]:
    """The error towards order p + 2, or towards a companion that is less than p, and units of the fields.

    The least-squares form says by itself which order is nearer to the solution: the one whose local fits agree better.
    On a cloud too small or too uneven for order p + 2 they do not, and the difference tells the error of that order. A
    companion, of a lower order or a recursion less deep, is off by about as much as p, or more. own: the misfits of p.
    """
    companion = lower(fit.recipe.order, max(low.rec.orders))
    error: Any = None
    try:
        error, units, theirs = _towards(fit, low, values, order)
        if _mean_size(theirs()) <= BETTER * _mean_size(own) or companion == fit.recipe.order and not low.rec.depth:
            return error, units
    except SolveError:
        if companion == fit.recipe.order and not low.rec.depth:
            raise
    depth = None if companion < fit.recipe.order else low.rec.depth - 1
    try:
        other, units, _ = _towards(fit, low, values, companion, depth)
    except SolveError:
        if error is None:
            raise
        return error, units
    if error is None or share(np.asarray(other), np.asarray(values)) < share(np.asarray(error), np.asarray(values)):
        return other, units
    return error, units


def _mean_size(missed: np.ndarray) -> float:
    largest = float(np.abs(missed).max(initial=0.0)) or 1.0  # no square overflows
    return largest * float(np.sqrt(np.mean((missed / largest) ** 2)))


def _towards(
    fit: Fit, low: Discretization, values: Any, order: int, depth: int | None = None
) -> tuple[Any, Any, Callable[[], np.ndarray]]:
    """What leads from the values to the solution by method S of another order, (N, F), units of the fields, and what
    computes the misfits of its local fits in the least-squares form."""
    other, nums = _of_order(fit, low, order, depth)
    form = "lsq" if fit.recipe.formulation == "lsq" else "auto"
    run = Run(other, fit.problem, "auto", True, form == "auto", form)
    parts: list[Any] | None = [] if form == "lsq" else None
    found = with_held(other, nums, run.solved(*run.assembled(nums, parts), balanced=False)[0])
    missed = lambda: np.asarray(misfit(other, nums, found, parts))
    return found - values, comparable(other, nums), missed


def _doubted(fit: Fit, low: Discretization, values: Any, error: Any) -> Any:
    """The error towards order p + 2, or between it and that towards a lower order where this is smaller.

    On a cloud too small or too uneven for order p + 2 this order is worse than p, and the difference tells its error,
    not that of p; a lower order, at worst as bad as p there, is off by about as much as p. Under a JAX transform nobody
    is asked again.
    """
    try:
        below = _below(fit, low, values)
    except SolveError:
        return error
    return error if below is None else between_orders(error, below[0], values)


def _below(fit: Fit, low: Discretization, values: Any) -> tuple[Any, Any] | None:
    """What leads to a lower order, which is off by as much as p, or more, and units; None where no order is lower."""
    order = lower(fit.recipe.order, max(low.rec.orders))
    return None if order == fit.recipe.order else _towards(fit, low, values, order)[:2]


def between_orders(higher: Any, below: Any, values: Any) -> Any:
    """The error (N, F) towards a higher order, or between it and that towards a lower one where this is smaller.

    A higher order that is farther away than the solution is large has lost it, and says nothing.
    """
    far, near = (share(np.asarray(e), np.asarray(values)) for e in (higher, below))
    if near < 1.0 < far:
        return below
    return below * (far / near) ** DOUBT if 0.0 < near < far else higher


def comparable(disc: Discretization, nums: Numbers) -> Any:
    """What fields of unlike units, a velocity and a pressure, are multiplied with to be compared, (F,).

    As they are in the local fits, at the mean spacing; the median of some particles.
    """
    rec = disc.rec
    if not (any(rec.weights) or rec.sizes) or is_traced(nums.jac, disc.cloud.points):
        return 1.0
    jac, length = np.asarray(nums.jac)[:, :, :1], mean_spacing(disc)
    some = np.linspace(0, jac.shape[-1] - 1, min(jac.shape[-1], LOOKED_AT)).astype(int)
    units = np.median([constraints(rec, jac[..., k], length, np)[2] for k in some], axis=0)
    return length ** np.array(rec.weights, float) / units


def lower(order: int, least: int) -> int:
    """A lower order whose errors are larger, itself where there is none; on even clouds odd orders are those below."""
    return min(order, max(order - 1 - order % 2, 2, least))


def compared(order: int, depth: int, most: int, least: int, lagging: bool = False) -> int:
    """The order whose solution tells the error of one of this order and depth: p + 2, or a lower one.

    most : by how many degrees the recursion of order p + 2 may go deeper; least : the equation's order.
    In one dimension, and along characteristics, the equation gives all of the coefficients but a few, and solutions of
    two orders whose recursions end at the same degree are one and the same; not so where an axis is ``lagging``, as
    time does.
    """
    deeper = order + 2 + min(depth, most) > order + depth
    below = lower(order, least)
    return order + 2 if deeper or lagging or below == order else below


def _beside(fit: Fit, low: Discretization) -> int:
    """The order whose solution is compared with."""
    order = fit.recipe.order
    host = concrete(fit.cloud.points)
    if host is None:
        return order + 2  # told where the stencils are made
    most = room(low.rec, order + 2)
    return compared(order, low.rec.depth, most, max(low.rec.orders), lags(low.rec))


def _put(array: np.ndarray, at: np.ndarray, value: Any) -> np.ndarray:
    array[at] = value
    return array


def _of_order(
    fit: Fit, low: Discretization, order: int, depth: int | None = None
) -> tuple[Discretization, Numbers]:  # fmt: skip
    """The same problem with method S of another order on its own stencils; depth: of the recursion, if not as it is."""
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
    # The cloud of the solve knows its walls.
    same = not is_traced(fit.cloud.points, fit.cloud.normals)
    cloud = fit.cloud if same else Cloud(np.asarray(host), low.cloud.groups, low.cloud.normals)
    if depth is None:
        depth = min(low.rec.depth, room(low.rec, order))
    other = discretized(fit.problem, cloud, "S", order, depth=depth)
    other.cloud = fit.cloud
    taylor = fit.taylor
    if taylor is not None:
        count = len(multi_indices(low.rec.dim, other.rec.reach))
        more = ((0, 0), (0, 0), (0, max(0, count - taylor.shape[2])))
        taylor = (jnp if is_traced(taylor) else np).pad(taylor, more)[:, :, :count]
    return other, numbers(other, fit.problem, taylor)


def _residual(disc: Discretization, classes: Any, rows: Any, nums: Numbers, entries: Any, values: Any) -> Any:
    """The residual b - A u of every row (n,), by the entries of A."""
    free = np.flatnonzero(~disc.held.reshape(-1))
    return _left(entries, values, right_side(disc, nums, classes, rows), free)


@in_one_program
def _left(entries: Any, values: Any, right: Any, free: np.ndarray) -> Any:
    """b - A u, of the values that are ``free``."""
    data, r, c = entries
    xp: Any = jnp if is_traced(data, values, right) else np
    u = xp.asarray(values).reshape(-1)[free]
    return right - times(data, r, c, u)


@partial(in_one_program, static=("shape",))
def _spread(x: Any, free: np.ndarray, shape: tuple[int, int]) -> Any:
    """Numbers at their places, zero elsewhere, (N, F)."""
    zero = np.zeros(int(np.prod(shape)))
    every: Any = jnp.asarray(zero).at[free].set(x) if is_traced(x) else _put(zero, free, x)
    return every.reshape(shape)


def _weights(disc: Discretization, classes: Any, rows: Any) -> Any:
    """The weight of the source in every row (N, F)."""
    traced = is_traced(rows)
    xp = jnp if traced else np
    first = np.array(disc.rec.equation_rows)
    strength = xp.concatenate([_strongest(xp.asarray(row.source)[:, :, first], xp) for row in rows])
    ids, one = np.concatenate([cls.ids for cls in classes]), np.ones(disc.held.shape)
    return jnp.asarray(one).at[ids].set(strength) if traced else _put(one, ids, strength)


def _strongest(weights: Any, xp: Any) -> Any:
    """Of each row's weights of the sources (n, F, E), the largest in size: (n, F)."""
    place = xp.argmax(xp.abs(weights), axis=2)
    return xp.take_along_axis(weights, place[..., None], axis=2)[..., 0]
