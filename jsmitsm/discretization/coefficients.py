"""The numbers of a problem: Taylor coefficients of its operator and source, and its conditions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud, kept
from jsmitsm.discretization.degenerate import Degenerate, settled
from jsmitsm.discretization.layout import Discretization, crowded
from jsmitsm.discretization.periodic import with_corners
from jsmitsm.discretization.resolution.kinks import endless, softened
from jsmitsm.discretization.resolution.poles import Poles, joined, without_poles
from jsmitsm.equation.conditions import group_conditions, merged
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.traced import Traced
from jsmitsm.particle.recursion import Recursion, source_rows
from jsmitsm.runtime.compiled import Same
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program, picked
from jsmitsm.taylor.multi_indices import Slot, count, factorial, index_of, multi_indices
from jsmitsm.taylor.series import Ring, mul

# Series of no more numbers are kept with a cloud.
_LARGEST_SERIES = 8_000_000
_EXPECTED = "estimate"
# Coefficients and sources up to this have squares that are numbers.
LARGEST = 1e150
_SINGLE = (
    "they must be finite and smooth there, and no larger than 3e38, where the numbers of float32 end, in which JAX "
    'computes here: enable float64 with jax.config.update("jax_enable_x64", True), or measure lengths in units of the '
    "size of the domain"
)


@dataclass
class Numbers:
    """The numbers of a linear (or linearised) problem: everything that may be traced.

    jac (E, S, T, n or 1) and source (rows, n or 1) at the particles ``ids`` (ascending); own (m, n_own, S) and
    given (m, n_own) at the particles ``own_ids``; held (N, F); data (N, n_data, S) and gamma
    (N, n_data), the conditions that neighbours use.
    """

    ids: np.ndarray
    jac: Any
    source: Any
    own_ids: np.ndarray
    own: Any
    given: Any
    held: Any
    data: Any
    gamma: Any
    degenerate: Degenerate | None = None  # what was found where the equation degenerates
    poles: Poles | None = None  # beside which fits took the place of series

    @property
    def of_matrix(self) -> list[Any]:
        """What the rows are made of; the rest stands on the right."""
        return [self.jac, self.own, self.data]


def numbers(disc: Discretization, problem: Problem, taylor: Any = None, everywhere: bool = False) -> Numbers:
    """Evaluate the operator's Taylor coefficients, the source and the conditions.

    taylor (N, F, K): the current local expansions, where the problem is nonlinear.
    everywhere: also at particles whose values are held, which carry no equation.
    """
    everywhere = everywhere or disc.scheme.method in ("I", "II")  # neighbours recover derivatives too
    ids = np.arange(len(disc.cloud)) if everywhere else disc.active
    here = None if taylor is None else picked(taylor, ids)
    jac, source, poles = _judged_numbers(disc, problem, ids, here)
    held = _held_values(disc)
    own_ids, own, given = _own_numbers(disc, held, taylor)
    data, gamma = _data_numbers(disc, taylor)
    made = Numbers(ids, jac, source, own_ids, own, given, _at(disc, held), data, gamma, poles=poles)
    return settled(disc, problem, made)


def _judged_numbers(disc: Discretization, problem: Problem, ids: np.ndarray, taylor: Any) -> tuple[Any, Any, Any]:
    """Operator and source at particles, without the series that end within a support, and the poles beside these."""
    jac, source = operator_numbers(disc, problem, ids, taylor)
    poles = None
    if disc.linear:
        jac, source, poles = without_poles(disc, problem, ids, jac, source)
    if disc.rec.depth and disc.linear and disc.traced.source == "variable":
        source = _softened(disc, problem, ids, source)
    return jac, source, poles


def judge_again(disc: Discretization, nums: Numbers) -> None:
    """Replace the series of sources at particles, those of the classes, whose supports have become wider."""
    traced = disc.traced
    varies = disc.linear and traced.source == "variable" and np.shape(nums.source)[-1] > 1
    if not varies or not disc.classes or nums.degenerate is not None:
        return
    if traced.kinked_source or traced.unbounded[0]:
        ids = np.sort(np.concatenate([cls.ids for cls in disc.classes]))
        _, source, poles = _judged_numbers(disc, disc.problem, ids, None)
        nums.source = np.array(nums.source)
        nums.source[:, np.searchsorted(nums.ids, ids)] = source
        nums.poles = joined(nums.poles, poles)


def _softened(disc: Discretization, problem: Problem, ids: np.ndarray, source: Any) -> Any:
    """The source's series without those that mislead, beside kinks and around points where a source is infinite."""
    if not (disc.traced.kinked_source or disc.traced.unbounded[0]):
        return source
    at = lambda x: -disc.traced.residuals(x, params=problem.params)
    points, values = disc.cloud.points, at(disc.cloud.points)
    if not is_traced(values):
        seen = disc.traced.kinked_source or endless(values, disc.held.all(axis=1))
        return softened(disc, ids, source, values) if seen else source
    finite = jnp.isfinite(values).all(axis=0)
    # Derivatives of what is infinite are not asked for: times nothing they would not be nothing.
    values = jnp.where(finite, at(jnp.where(finite[:, None], points, points[ids[0]])), jnp.nan)
    new = softened(disc, ids, source, values)
    return new if disc.traced.kinked_source else jnp.where(finite.all(), source, new)


def conditions_of(disc: Discretization, problem: Problem) -> tuple[Any, Any, Any]:
    """The conditions' values (held, given, gamma; see Numbers) of another problem of the same form."""
    return conditions_at(disc, problem, with_corners(problem, disc.cloud))


def conditions_at(disc: Discretization, problem: Problem, cloud: Cloud) -> tuple[Any, Any, Any]:
    """The same at other points and normals, those of a cloud ``with_corners``."""
    groups = group_conditions(problem, cloud, disc.rec.order, disc.traced.order, disc.part is None)
    other = replace(disc, groups=groups)
    held = _held_values(other)
    _, _, given = _own_numbers(other, held, None)
    _, gamma = _data_numbers(other, None)
    return _at(other, held), given, gamma


def held_values(disc: Discretization) -> Any:
    """The values that conditions hold, at their places (N, F), zero elsewhere."""
    return _at(disc, _held_values(disc))


def _held_values(disc: Discretization) -> list[dict[int, Any]]:
    """Of every group the values (n,) of the fields that it holds."""
    return [{k: value() for k, value in group.held.items()} for group in disc.groups]


def _at(disc: Discretization, held: list[dict[int, Any]]) -> Any:
    """The held values at their places, (N, F)."""
    places = [((group.ids, k), value) for group, some in zip(disc.groups, held) for k, value in some.items()]
    return _filled(np.zeros(disc.held.shape), places)


class _Known(NamedTuple):
    """Taylor coefficients up to a degree, (..., T, N), or (..., 1, 1) the same for all; and of which particles."""

    degree: int
    particles: np.ndarray
    jac: Any = None
    residual: Any = None


class _Series:
    """Taylor coefficients of a linear operator and its residual at the particles of a cloud, as far as was asked."""

    def __init__(self, traced: Traced, points: np.ndarray):
        self.traced, self.points = traced, points
        self.known = _Known(-1, np.zeros(len(points), bool))

    def at(self, ids: np.ndarray, degree: int, ahead: int, params: Any) -> tuple[Any, Any]:
        """Those at particles, see ``Traced.coefficients``; ahead: degrees more that will be asked for soon.

        params: with the numbers they had before; the arrays that held them then may hold others by now.
        """
        known = self.known  # replaced as a whole: solves run in threads too
        if degree > known.degree:
            known = _Known(degree + ahead, np.zeros(len(self.points), bool))
        new = ids[~known.particles[ids]]
        if len(new):
            jac, residual = self.traced.coefficients(self.points[new], known.degree, params=params)
            particles = known.particles.copy()
            particles[new] = True
            jac, residual = self._with(known.jac, jac, new), self._with(known.residual, residual, new)
            self.known = known = _Known(known.degree, particles, jac, residual)
        return self._part(known.jac, ids, degree), self._part(known.residual, ids, degree)

    def _with(self, every: Any, some: Any, ids: np.ndarray) -> Any:
        """The coefficients of all particles with those (..., T, m) of some."""
        if some is None or some.shape[-2:] == (1, 1):
            return some
        shape = (*some.shape[:-1], len(self.points))
        every = np.zeros(shape, some.dtype) if every is None else every.copy()
        every[..., ids] = some
        return every

    def _part(self, every: Any, ids: np.ndarray, degree: int) -> Any:
        if every is None or every.shape[-2:] == (1, 1):
            return every
        return every[..., : count(self.traced.dim, degree), :][..., ids]


def expect_estimate(cloud: Cloud) -> None:
    """An estimate will follow the next solve on a cloud: its series are two degrees longer, and hold all others."""
    kept(cloud, _EXPECTED, lambda: True)


def _series(disc: Discretization, problem: Problem, ids: np.ndarray) -> tuple[Any, Any]:
    """Taylor coefficients of a linear operator and its residual at particles, kept with the cloud for other orders."""
    traced, cloud, degree = disc.traced, disc.cloud, disc.rec.degree
    size = len(cloud) * count(cloud.dim, degree) * int(traced.pattern.sum())
    if size > _LARGEST_SERIES or is_traced(cloud.points, jax.tree.leaves((traced, problem.params))):
        return traced.coefficients(picked(cloud.points, ids), degree, params=problem.params)
    made = lambda: _Series(traced, np.asarray(cloud.points))  # noqa: E731
    numbers = tuple(np.asarray(x).tobytes() for x in jax.tree.leaves(problem.params))
    ahead = 2 if kept(cloud, _EXPECTED, lambda: None) else 0
    return kept(cloud, ("series", Same(traced), numbers), made).at(ids, degree, ahead, problem.params)


def operator_numbers(disc: Discretization, problem: Problem, ids: np.ndarray, taylor: Any) -> tuple[Any, Any]:
    """Taylor coefficients of the (linearised) operator and the right-hand side of the recursion at particles."""
    rec, traced, points = disc.rec, disc.traced, picked(disc.cloud.points, ids)
    if traced.linear:
        jac, res = _series(disc, problem, ids)
        if res is None:
            _refuse_nonfinite(points, jac)
            return jac, np.zeros((rec.n_rows, 1))
    else:
        # The residual linearised about the local expansion U: R(U) + R'(U) (u - U) = 0.
        at = slot_series(rec, traced.slots, taylor, rec.degree)
        jac, res = traced.coefficients(points, rec.degree, params=problem.params, slots=at)
        res = _moved(rec, jac, res, at)
    if traced.linear:
        _refuse_nonfinite(points, jac, res)
    return jac, source_rows(rec, res)


@partial(in_one_program, static=("rec",))
def _moved(rec: Recursion, jac: Any, res: Any, at: Any) -> Any:
    """R(U) - R'(U) U: the residual (E, T, n) of a linearised operator at u = 0."""
    ring = Ring(rec.dim, rec.degree)
    for e in range(jac.shape[0]):
        change = sum(mul(ring, jac[e, s], at[s]) for s in range(len(rec.slots)) if rec.pattern[e][s])
        res = _filled(res, [(e, res[e] - change)])
    return res


def _refuse_nonfinite(points: Any, *series: Any) -> None:
    """Name the point where the operator or the source is not a number, or its squares are none."""
    for values in series:
        if is_traced(values, points) or float(np.max(np.abs(values), initial=0.0)) < LARGEST:
            continue
        if np.isfinite(values).all():
            raise ValueError(
                f"pde: numbers up to {np.abs(values).max():.0e}, whose squares leave the range of floats; divide the "
                "equation by a number of their size, or use other units"
            )
        bad = np.flatnonzero(~np.isfinite(np.asarray(values)).all(axis=tuple(range(np.ndim(values) - 1))))
        raise ValueError(
            f"pde: NaN or infinity at {len(bad)} particle(s), first at x = {np.asarray(points)[bad[0]]}, in the "
            "coefficients, the source or their derivatives; "
            + (_SINGLE if np.asarray(values).dtype == np.float32 else "they must be finite and smooth there: where a "
               "term is divided by a coordinate (2 / r on an axis), multiply the equation by it")
        )


def slot_series(rec: Recursion, slots: tuple[Slot, ...], taylor: Any, degree: int) -> Any:
    """Taylor coefficients (S, T, n) of the slots' derivatives from local expansions (n, F, K)."""
    return _derivatives(taylor, rec, slots, degree)


@partial(in_one_program, static=("rec", "slots", "degree"))
def _derivatives(taylor: Any, rec: Recursion, slots: tuple[Slot, ...], degree: int) -> Any:
    place = index_of(rec.dim, rec.reach)
    out = []
    for f, b in slots:
        up = [tuple(ti + bi for ti, bi in zip(t, b)) for t in multi_indices(rec.dim, degree)]
        index = np.array([place.get(a, 0) for a in up])
        factor = np.array(
            [factorial(a) / factorial(t) if a in place else 0.0 for a, t in zip(up, multi_indices(rec.dim, degree))]
        )
        out.append((taylor[:, f][:, index] * factor).T)
    return (jnp if is_traced(taylor) else np).stack(out)


def _slot_values(slots: tuple[Slot, ...], rec: Recursion, taylor: Any, ids: np.ndarray) -> Any:
    """Derivatives (S, n) of the local expansions at the particles themselves."""
    return None if taylor is None else slot_series(rec, slots, taylor[ids], 0)[:, 0]


def _own_numbers(disc: Discretization, held: list[dict[int, Any]], taylor: Any) -> tuple[np.ndarray, Any, Any]:
    """Every conditioned particle's own conditions: held values first, then the functionals."""
    slots, zero = disc.scheme.own, (0,) * disc.rec.dim
    ids = np.flatnonzero(disc.n_own)
    most = int(disc.n_own.max(initial=0))
    own: list[Any] = []
    given: list[Any] = []
    for group, values in zip(disc.groups, held):
        at = np.searchsorted(ids, group.ids)
        for row, (k, value) in enumerate(values.items()):
            own.append(((at, row, slots.index((k, zero))), 1.0))
            given.append(((at, row), value))
        if group.parts:
            coef, value = merged(group, slots, _slot_values(slots, disc.rec, taylor, group.ids))
            index = (at[:, None], (len(group.held) + np.arange(coef.shape[1]))[None, :])
            own.append((index, coef))
            given.append((index, value))
    return ids, _filled(np.zeros((len(ids), most, len(slots))), own), _filled(np.zeros((len(ids), most)), given)


def _data_numbers(disc: Discretization, taylor: Any) -> tuple[Any, Any]:
    """The conditions of particles whose values are all held, as data for their neighbours."""
    scheme, n = disc.scheme, len(disc.cloud)
    data: list[Any] = []
    gamma: list[Any] = []
    for group in disc.groups:
        if crowded(group, disc.rec):
            coef, value = merged(group, scheme.data, _slot_values(scheme.data, disc.rec, taylor, group.ids))
            index = (group.ids[:, None], np.arange(coef.shape[1])[None, :])
            data.append((index, coef))
            gamma.append((index, value))
    shape = (n, scheme.n_data)
    return _filled(np.zeros((*shape, len(scheme.data))), data), _filled(np.zeros(shape), gamma)


@in_one_program
def _filled(array: Any, places: list[tuple[Any, Any]]) -> Any:
    """A copy of the array with array[index] = value for every pair of ``places``."""
    if is_traced(array, places):
        for index, value in places:
            array = jnp.asarray(array).at[index].set(value)
        return array
    array = np.array(array)
    for index, value in places:
        array[index] = np.asarray(value)
    return array
