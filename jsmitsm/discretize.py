"""From a problem and a cloud to numbers: classes of particles, their operands, the global system."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm import assembly, moments
from jsmitsm.assembly import Operands
from jsmitsm.boundary import Group, group_conditions, is_traced, merged
from jsmitsm.clouds import Cloud
from jsmitsm.kernels import Gaussian, Kernel
from jsmitsm.moments import Elimination, Row, Scheme
from jsmitsm.neighbours import Stencils, nearest, within
from jsmitsm.problem import Problem
from jsmitsm.recursion import Recursion, Slot, free_indices, recursion, source_rows
from jsmitsm.series import Ring, mul
from jsmitsm.taylor import factorial, index_of, multi_indices
from jsmitsm.trace import Traced, trace

METHODS = ("I", "II", "III", "S", "SSPH")


@dataclass
class Class:
    """Particles whose moment systems have the same shape.

    ids (n,) ascending, neighbours (n, w), the particle itself first and -1 for none.
    """

    ids: np.ndarray
    neighbours: Any
    scheme: Scheme


@dataclass
class Discretization:
    """What is static about a problem on a cloud: decided once, on the host."""

    cloud: Cloud
    kernel: Kernel | None
    stencils: Stencils
    traced: Traced
    rec: Recursion
    groups: list[Group]
    scheme: Scheme  # of interior particles
    classes: list[Class]
    held: np.ndarray  # (N, F) bool
    n_own: np.ndarray  # (N,) own conditions of each particle
    given_stencils: bool  # the user's: nothing outside them is looked at

    @property
    def linear(self) -> bool:
        return self.traced.linear and all(g.linear for g in self.groups)

    @property
    def floating(self) -> tuple[int, ...]:
        """Fields that the problem determines only up to a constant: no value of theirs enters."""
        zero = (0,) * self.rec.dim
        values = {f for f, b in (*self.rec.slots, *self.scheme.own) if b == zero}
        return tuple(f for f in range(self.rec.fields) if f not in values) if self.linear else ()

    @property
    def active(self) -> np.ndarray:
        """The particles that carry equations, ascending."""
        return np.flatnonzero(~self.held.all(axis=1))

    @property
    def unknowns(self) -> np.ndarray:
        """The number of each unknown among all values, (N, F); -1 for held ones."""
        number = np.full(self.held.size, -1)
        free = ~self.held.reshape(-1)
        number[free] = np.arange(free.sum())
        return number.reshape(self.held.shape)


def discretize(
    problem: Problem, cloud: Cloud, method: str, order: int, kernel: Kernel | None,
    stencils: Stencils | None, basis_terms: int | None,
) -> Discretization:  # fmt: skip
    """Trace the problem, lay out its recursion and conditions, and find neighbours."""
    traced = trace(problem.pde, cloud.dim, problem.fields, params=problem.params)
    _check_operator(traced, problem, order)
    rec = recursion(cloud.dim, order, problem.fields, traced.slots, traced.pattern, traced.order)
    groups = group_conditions(problem, cloud, order, max(traced.order))
    held = np.zeros((len(cloud), problem.fields), bool)
    for group in groups:
        for k in group.held:
            held[group.ids, k] = True
    n_own = np.zeros(len(cloud), int)
    for group in groups:
        n_own[group.ids] = group.n_rows + len(group.held)
    scheme = _scheme(method, rec, traced, problem, cloud, basis_terms)
    scheme = replace(scheme, **_conditions_layout(groups, rec))
    given_stencils = stencils is not None
    if stencils is None:
        stencils = find_stencils(cloud, kernel, default_size(scheme), scheme_size(scheme))
    elif len(stencils) != len(cloud):
        raise ValueError(f"stencils: built for {len(stencils)} particles, the cloud has {len(cloud)}; build them again")
    if kernel is None and method in ("I", "II"):
        kernel = _default_kernel(cloud, stencils)
    disc = Discretization(cloud, kernel, stencils, traced, rec, groups, scheme, [], held, n_own, given_stencils)
    disc.classes = sorted_classes(disc, np.flatnonzero(~held.all(axis=1)), stencils)
    return disc


def sorted_classes(disc: Discretization, ids: np.ndarray, stencils: Stencils) -> list[Class]:
    """The particles ``ids`` sorted by the number of their own conditions and the width of their stencils."""
    near = stencils.indices
    if is_traced(near):
        wide = np.zeros(len(ids), bool)
        used = [near.shape[1]] * 2
    else:
        counts = np.max(np.where(near[ids] >= 0, np.arange(near.shape[1]), 0), axis=1, initial=0) + 1
        narrow = int(np.quantile(counts, 0.8)) if len(ids) else 1
        wide = counts > 1.25 * narrow
        used = [int(counts[~wide].max(initial=1)), near.shape[1]]
    classes = []
    for count in np.unique(disc.n_own[ids]):
        for some in (ids[(disc.n_own[ids] == count) & (wide == k)] for k in (False, True)):
            if len(some):
                width = used[int(wide[np.searchsorted(ids, some[0])])]
                classes.append(Class(some, near[some][:, :width], replace(disc.scheme, n_own=int(count))))
    return classes


def table(disc: Discretization) -> Any:
    """All stencils in one padded array (N, w), repaired ones too."""
    near = disc.stencils.indices
    if is_traced(near) or not disc.classes:
        return near
    width = max(near.shape[1], *(c.neighbours.shape[1] for c in disc.classes))
    out = np.full((len(near), width), -1, np.int32)
    out[:, : near.shape[1]] = near
    for c in disc.classes:
        out[c.ids] = -1
        out[c.ids, : c.neighbours.shape[1]] = c.neighbours
    return out


def _conditions_layout(groups: list[Group], rec: Recursion) -> dict[str, Any]:
    """The slots of all own conditions, and of those that only neighbours can use.

    Where a group's values are all held, no equation of its own carries its other conditions
    (the slope of a clamped plate): they are data for the neighbours.
    """
    zero = (0,) * rec.dim
    own = tuple(dict.fromkeys(slot for g in groups for slot in [*((k, zero) for k in g.held), *g.slots]))
    closed = [g for g in groups if _closed(g, rec)]
    data = tuple(dict.fromkeys(slot for g in closed for slot in g.slots))
    return {"own": own, "data": data, "n_data": max((g.n_rows for g in closed), default=0)}


def _closed(group: Group, rec: Recursion) -> bool:
    return len(group.held) == rec.fields and bool(group.parts)


def _check_operator(traced: Traced, problem: Problem, order: int) -> None:
    if traced.n_equations != problem.fields:
        raise ValueError(
            f"pde: returns {traced.n_equations} residual(s) for fields={problem.fields}; "
            "a system of F fields needs F residuals"
        )
    for e, m in enumerate(traced.order):
        if m < 0:
            raise ValueError(f"pde: residual {e} does not depend on u; use u(x), js.grad(u)(x), js.laplacian(u)(x) ...")
        if m > order:
            raise ValueError(
                f"order: {order} is below the order {m} of the equation; use order={m} or more (even orders pay)"
            )
    for k in range(problem.fields):
        if not any(f == k for f, _ in traced.slots):
            raise ValueError(f"pde: field {k} appears in no equation; lower fields={problem.fields} or use it")


def _scheme(method: str, rec: Recursion, traced: Traced, problem: Problem, cloud: Cloud, basis_terms: Any) -> Scheme:
    """The method and its free coefficients."""
    if method in ("S", "SSPH"):
        if basis_terms is not None:
            raise ValueError(f"basis_terms: only I, II and III keep single free coefficients, not method={method!r}")
        return Scheme(method, rec)
    if problem.fields > 1:
        raise ValueError(f'method: {method} treats one field, the problem has {problem.fields}; use method="S"')
    slots = None if traced.linear else np.zeros((len(traced.slots), 1, len(cloud)))
    jac, _ = traced.coefficients(cloud.points, 0, params=problem.params, slots=slots)
    jac = None if is_traced(jac) else np.asarray(jac)[0, :, 0]
    free, dependent = free_indices(rec, jac)
    if basis_terms is not None:
        if isinstance(basis_terms, bool) or not 1 <= basis_terms <= len(free):
            raise ValueError(f"basis_terms: expected 1 to {len(free)} free coefficients at this order, got {basis_terms}")
        free = free[:basis_terms]
    return Scheme(method, rec, tuple(map(int, free)), tuple(map(int, dependent)))


def scheme_size(scheme: Scheme) -> int:
    """Free coefficients per field: how many neighbours a fit needs at the least."""
    rec = scheme.rec
    if scheme.method == "SSPH":
        return rec.size
    if scheme.free:
        return len(scheme.free)
    return -(-(rec.fields * rec.size - rec.n_rows) // rec.fields)


def default_size(scheme: Scheme) -> int:
    """Neighbours, the particle itself counted, that make a good fit."""
    free = scheme_size(scheme)
    return min(2 * free + 2, 5) if scheme.rec.dim == 1 and scheme.rec.fields == 1 else 2 * free + 2


def find_stencils(cloud: Cloud, kernel: Kernel | None, size: int, needed: int) -> Stencils:
    """Neighbours from the kernel's support, or the nearest ``size`` without a kernel."""
    if is_traced(cloud.points) or is_traced(kernel):
        what = "kernel's h or d" if is_traced(kernel) else "points"
        raise ValueError(
            f"stencils: the {what} is traced by a JAX transform, and neighbours are found on the host; "
            "build stencils = js.stencils(cloud, radius=...) before the transform and pass solve(..., stencils=stencils)"
        )
    points = np.asarray(cloud.points)
    if kernel is None:
        if len(points) < needed + 1:
            raise ValueError(
                f"cloud: {len(points)} particles are too few for this order, which needs at least {needed + 1} "
                "in every stencil; lower the order or add particles"
            )
        return nearest(points, min(size, len(points)))
    return within(points, np.asarray(kernel.d) * np.asarray(kernel.h))


def _default_kernel(cloud: Cloud, stencils: Stencils) -> Kernel:
    """A Gauss function per particle that has fallen to exp(-4) at its farthest neighbour."""
    near, points = stencils.indices, cloud.points
    xp = jnp if is_traced(near, points) else np
    square = xp.sum((points[xp.maximum(near, 0)] - points[:, None]) ** 2, axis=2)
    return Gaussian(xp.sqrt(xp.max(xp.where(near >= 0, square, 0.0), axis=1)) / 2.0, 2.0)


# ------------------------------------------------------------------ numbers


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


def numbers(disc: Discretization, problem: Problem, taylor: Any = None, everywhere: bool = False) -> Numbers:
    """Evaluate the operator's Taylor coefficients, the source and the conditions.

    taylor (N, F, K): the current local expansions, where the problem is nonlinear.
    everywhere: also at particles whose values are held, which carry no equation.
    """
    everywhere = everywhere or disc.scheme.method in ("I", "II")  # neighbours recover derivatives too
    ids = np.arange(len(disc.cloud)) if everywhere else disc.active
    here = None if taylor is None else taylor[ids]
    jac, source = operator_numbers(disc, problem, disc.cloud.points[ids], here)
    held = np.zeros(disc.held.shape)
    for group in disc.groups:
        for k, value in group.held.items():
            held = _set(held, (group.ids, k), value())
    own_ids, own, given = _own_numbers(disc, taylor)
    data, gamma = _data_numbers(disc, taylor)
    return Numbers(ids, jac, source, own_ids, own, given, held, data, gamma)


def operator_numbers(disc: Discretization, problem: Problem, points: Any, taylor: Any) -> tuple[Any, Any]:
    """Taylor coefficients of the (linearised) operator and the right-hand side of the recursion."""
    rec, traced = disc.rec, disc.traced
    if traced.linear:
        jac, res = traced.coefficients(points, rec.degree, params=problem.params)
        if res is None:
            return jac, np.zeros((rec.n_rows, 1))
    else:
        # The residual linearised about the local expansion U: R(U) + R'(U) (u - U) = 0.
        at = slot_series(rec, traced.slots, taylor, rec.degree)
        jac, res = traced.coefficients(points, rec.degree, params=problem.params, slots=at)
        ring = Ring(rec.dim, rec.degree)
        for e in range(jac.shape[0]):
            change = sum(mul(ring, jac[e, s], at[s]) for s in range(len(traced.slots)) if rec.pattern[e][s])
            res = _set(res, e, res[e] - change)
    return jac, source_rows(rec, res)


def slot_series(rec: Recursion, slots: tuple[Slot, ...], taylor: Any, degree: int) -> Any:
    """Taylor coefficients (S, T, n) of the slots' derivatives from local expansions (n, F, K)."""
    place = index_of(rec.dim, rec.order)
    out = []
    for f, b in slots:
        up = [tuple(ti + bi for ti, bi in zip(t, b)) for t in multi_indices(rec.dim, degree)]
        index = np.array([place.get(a, 0) for a in up])
        factor = np.array([
            factorial(a) / factorial(t) if a in place else 0.0 for a, t in zip(up, multi_indices(rec.dim, degree))
        ])
        out.append((taylor[:, f][:, index] * factor).T)
    return (jnp if is_traced(taylor) else np).stack(out)


def _slot_values(slots: tuple[Slot, ...], rec: Recursion, taylor: Any, ids: np.ndarray) -> Any:
    """Derivatives (S, n) of the local expansions at the particles themselves."""
    return None if taylor is None else slot_series(rec, slots, taylor[ids], 0)[:, 0]


def _own_numbers(disc: Discretization, taylor: Any) -> tuple[np.ndarray, Any, Any]:
    """Every conditioned particle's own conditions: held values first, then the functionals."""
    slots, zero = disc.scheme.own, (0,) * disc.rec.dim
    ids = np.flatnonzero(disc.n_own)
    most = int(disc.n_own.max(initial=0))
    own, given = np.zeros((len(ids), most, len(slots))), np.zeros((len(ids), most))
    for group in disc.groups:
        at = np.searchsorted(ids, group.ids)
        for row, (k, value) in enumerate(group.held.items()):
            own[at, row, slots.index((k, zero))] = 1.0
            given = _set(given, (at, row), value())
    for group in disc.groups:
        if group.parts:
            at = np.searchsorted(ids, group.ids)
            coef, value = merged(group, slots, _slot_values(slots, disc.rec, taylor, group.ids))
            index = (at[:, None], (len(group.held) + np.arange(coef.shape[1]))[None, :])
            own, given = _set(own, index, coef), _set(given, index, value)
    return ids, own, given


def _data_numbers(disc: Discretization, taylor: Any) -> tuple[Any, Any]:
    """The conditions of particles whose values are all held, as data for their neighbours."""
    scheme, n = disc.scheme, len(disc.cloud)
    data, gamma = np.zeros((n, scheme.n_data, len(scheme.data))), np.zeros((n, scheme.n_data))
    for group in disc.groups:
        if _closed(group, disc.rec):
            coef, value = merged(group, scheme.data, _slot_values(scheme.data, disc.rec, taylor, group.ids))
            index = (group.ids[:, None], np.arange(coef.shape[1])[None, :])
            data, gamma = _set(data, index, coef), _set(gamma, index, value)
    return data, gamma


def _set(array: Any, index: Any, value: Any) -> Any:
    """array[index] = value; in place where both are concrete."""
    if isinstance(array, np.ndarray) and not is_traced(value, index):
        array[index] = np.asarray(value)
        return array
    return jnp.asarray(array).at[index].set(value)


# ------------------------------------------------------------------ rows


def operands(disc: Discretization, nums: Numbers, ids: np.ndarray, scheme: Scheme, shared: Any) -> Operands:
    """What the particles ``ids`` need; the particle axis first."""
    jac = nums.jac
    if jac.shape[-1] > 1:
        jac = jac[..., np.searchsorted(nums.ids, ids)]
    elif shared is not None:
        jac = np.zeros((1, 1, 1, 1))
    own = np.zeros((len(ids), 0, len(scheme.own)))
    if scheme.n_own:
        own = nums.own[np.searchsorted(nums.own_ids, ids), : scheme.n_own]
    return Operands((jnp if is_traced(jac) else np).moveaxis(jac, -1, 0), own, nums.data, shared)


def shared_elimination(disc: Discretization, nums: Numbers) -> Elimination | None:
    """One elimination for all particles, where the operator allows it."""
    if not (disc.traced.constant and disc.rec.scale_free):
        return None
    if is_traced(nums.jac) or isinstance(nums.jac, jax.Array):
        return moments.eliminate(disc.scheme, jnp.asarray(nums.jac[..., 0]), 1.0)
    return moments.eliminate_on_host(disc.scheme, nums.jac[..., 0])


def all_rows(disc: Discretization, nums: Numbers) -> tuple[list[Class], list[Row]]:
    """The rows of every class, and the classes with the neighbours that the rows reach."""
    shared = shared_elimination(disc, nums)
    if disc.scheme.method in ("I", "II"):
        return _two_stage_rows(disc, nums, shared)
    return disc.classes, [class_rows(disc, nums, cls, shared) for cls in disc.classes]


def _two_stage_rows(disc: Discretization, nums: Numbers, shared: Any) -> tuple[list[Class], list[Row]]:
    """Methods I and II: recover every particle's coefficients, then insert them into the rows."""
    wide, far = _recovery_kernel(disc)
    n_free, rec = len(disc.scheme.free), disc.rec
    parts, constants, order = [], [], []
    conditioned = np.zeros(len(disc.cloud), int)
    for group in disc.groups:
        conditioned[group.ids] = 0 if group.held else group.n_rows
    for count in np.unique(conditioned):
        ids = np.flatnonzero(conditioned == count)
        cls = Class(ids, far[ids], replace(disc.scheme, n_own=int(count)))
        given = operands(disc, nums, ids, cls.scheme, shared)
        made = assembly.recoveries(cls.scheme, disc.cloud.points, wide, ids, cls.neighbours, given)
        source, values = _right_sides(disc, nums, cls)
        constants.append(jnp.einsum("nbr,nr->nb", made.source, source) + jnp.einsum("nbk,nk->nb", made.condition, values))
        parts.append(made._replace(source=jnp.zeros((len(ids), n_free, 0)), condition=jnp.zeros((len(ids), n_free, 0))))
        order.append(ids)
    back = np.argsort(np.concatenate(order))
    recovered = jax.tree.map(lambda *x: jnp.concatenate(x)[back], *parts)
    constant = jnp.concatenate(constants)[back]
    classes, rows = [], []
    for cls in disc.classes:
        given = operands(disc, nums, cls.ids, cls.scheme, shared)
        reached, row = assembly.closed_rows(
            cls.scheme, disc.cloud.points, disc.kernel, cls.ids, cls.neighbours, given, (), (far, recovered, constant)
        )
        classes.append(replace(cls, neighbours=reached if is_traced(reached) else np.asarray(reached)))
        rows.append(row)
    return classes, rows


def _recovery_kernel(disc: Discretization) -> tuple[Kernel, Any]:
    """The kernel of stage 1 and its neighbours: wide enough to hold 1.5 times the free coefficients."""
    points, kernel, near = disc.cloud.points, disc.kernel, disc.stencils.indices
    count = math.ceil(1.5 * len(disc.scheme.free)) + 1
    if disc.given_stencils or is_traced(near, points, kernel):
        away = jnp.where(near >= 0, jnp.sum((points[jnp.maximum(near, 0)] - points[:, None]) ** 2, axis=2), jnp.inf)
        reach = jnp.sqrt(jnp.sort(away, axis=1)[:, min(count, near.shape[1]) - 1])
        reach = jnp.where(jnp.isfinite(reach), reach, 0.0)
        return kernel.replace(h=jnp.maximum(kernel.h, reach / (0.9 * kernel.d))), near
    host = np.asarray(points)
    reach = nearest(host, min(count, len(host))).radius
    h = np.maximum(np.asarray(kernel.h), reach / (0.9 * np.asarray(kernel.d)))
    return kernel.replace(h=h), within(host, h * np.asarray(kernel.d)).indices


def class_rows(disc: Discretization, nums: Numbers, cls: Class, shared: Any) -> Row:
    """The rows of one class of particles."""
    given = operands(disc, nums, cls.ids, cls.scheme, shared)
    return assembly.rows(cls.scheme, disc.cloud.points, disc.kernel, cls.ids, cls.neighbours, given)


def class_coefficients(disc: Discretization, nums: Numbers, cls: Class, shared: Any, u: Any) -> Any:
    """Taylor coefficients (n, F, K) of one class of particles from all values u (N, F)."""
    given = operands(disc, nums, cls.ids, cls.scheme, shared)
    source, values = _right_sides(disc, nums, cls)
    return assembly.coefficients(
        cls.scheme, disc.cloud.points, disc.kernel, cls.ids, cls.neighbours, given, (source, values), (u, nums.gamma)
    )


def _right_sides(disc: Discretization, nums: Numbers, cls: Class) -> tuple[Any, Any]:
    """The recursion's right-hand side (n, rows) and the own conditions' values (n, n_own)."""
    n = len(cls.ids)
    xp = jnp if is_traced(nums.source) else np
    source = nums.source
    if source.shape[1] > 1:
        source = source[:, np.searchsorted(nums.ids, cls.ids)]
    source = xp.broadcast_to(source, (source.shape[0], n)).T
    if not cls.scheme.n_own:
        return source, np.zeros((n, 0))
    return source, nums.given[np.searchsorted(nums.own_ids, cls.ids), : cls.scheme.n_own]


def all_coefficients(disc: Discretization, nums: Numbers, values: Any) -> Any:
    """Taylor coefficients (N, F, K) of the particles of all classes; zeros elsewhere."""
    shared = shared_elimination(disc, nums)
    parts = [class_coefficients(disc, nums, c, shared, values) for c in disc.classes]
    shape = (len(disc.cloud), disc.rec.fields, disc.rec.size)
    ids = np.concatenate([c.ids for c in disc.classes])
    if is_traced(parts):
        return jnp.zeros(shape).at[ids].set(jnp.concatenate(parts))
    out = np.zeros(shape)
    out[ids] = np.concatenate([np.asarray(p) for p in parts])
    return out


# ------------------------------------------------------------------ the global system


@dataclass
class System:
    """A x = b over the unknowns, A as coordinates with duplicates to be summed."""

    data: Any
    rows: Any
    cols: Any
    b: Any
    n: int


def matrix(disc: Discretization, classes: list[Class], rows: list[Row]) -> tuple[Any, Any, Any]:
    """The global matrix as coordinates: own u_i - sum_g weights u_g over the unknowns."""
    unknown, fields = disc.unknowns, disc.rec.fields
    parts = []
    for cls, row in zip(classes, rows):
        near, xp = cls.neighbours, np
        if is_traced(near):
            xp = jnp
        number = xp.asarray(unknown)
        own = unknown[cls.ids]
        col = xp.where((near >= 0)[..., None], number[near], -1)  # (n, w, F)
        shape = (len(cls.ids), fields, near.shape[1], fields)
        r = np.broadcast_to(own[:, :, None, None], shape)
        c = xp.broadcast_to(col[:, None], shape)
        keep = (r >= 0) & (c >= 0)
        if is_traced(near):
            parts.append((jnp.where(keep, -row.weights, 0.0).ravel(), jnp.where(keep, r, 0).ravel(), jnp.where(keep, c, 0).ravel()))
        else:
            place = np.flatnonzero(keep)
            weights = row.weights.reshape(-1) if is_traced(row.weights) else np.asarray(row.weights).reshape(-1)
            parts.append((-weights[place], r.reshape(-1)[place], c.reshape(-1)[place]))
    n = int(unknown.max(initial=-1)) + 1
    if disc.scheme.method != "SSPH":
        parts.append((np.ones(n), np.arange(n), np.arange(n)))
    traced = is_traced(parts)
    join = jnp.concatenate if traced else np.concatenate
    data, r, c = zip(*parts)
    return join(data), (jnp if is_traced(r) else np).concatenate(r), (jnp if is_traced(c) else np).concatenate(c)


def right_side(disc: Discretization, nums: Numbers, classes: list[Class], rows: list[Row]) -> Any:
    """The global right-hand side (n,): source, own conditions and held neighbours."""
    unknown = disc.unknowns
    parts, places = [], []
    for cls, row in zip(classes, rows):
        xp = jnp if is_traced(nums, row, cls.neighbours) else np
        source, given = _right_sides(disc, nums, cls)
        w, v, v_own = (xp.asarray(x) for x in (row.weights, row.source, row.condition))
        index = xp.maximum(cls.neighbours, 0)
        total = xp.einsum("nfr,nr->nf", v, source) + xp.einsum("nfk,nk->nf", v_own, given) + row.constant
        total = total + xp.einsum("nfgh,ngh->nf", w, xp.asarray(nums.held)[index])
        if disc.scheme.n_data:
            total = total + xp.einsum("nfgd,ngd->nf", xp.asarray(row.data), xp.asarray(nums.gamma)[index])
        own = unknown[cls.ids]
        parts.append(total.reshape(-1)[np.flatnonzero(own >= 0)])
        places.append(own[own >= 0])
    xp = jnp if is_traced(parts) else np
    order = np.argsort(np.concatenate(places)) if places else np.zeros(0, int)
    return xp.concatenate(parts)[order] if parts else np.zeros(0)


def least_squares(disc: Discretization, nums: Numbers) -> tuple[Any, Any, Any, Any]:
    """The normal equations of the least-squares form, as coordinates, and their right-hand side.

    Every particle contributes the misfit of its local fit, those with held values too: the
    projector of a fit is idempotent, so nothing is squared.
    """
    shared = shared_elimination(disc, nums)
    unknown, fields = disc.unknowns, disc.rec.fields
    held = nums.held
    n = int(unknown.max(initial=-1)) + 1
    parts, b = [], np.zeros(n)
    for cls in sorted_classes(disc, nums.ids, Stencils(table(disc), None)):
        given = operands(disc, nums, cls.ids, cls.scheme, shared)
        made = assembly.blocks(
            cls.scheme, disc.cloud.points, disc.kernel, cls.ids, cls.neighbours, given, _right_sides(disc, nums, cls)
        )
        near = cls.neighbours
        xp = jnp if is_traced(near, made, held, nums.gamma) else np
        index = xp.maximum(near, 0)
        place = xp.where((near >= 0)[..., None], xp.asarray(unknown)[index], -1).reshape(len(cls.ids), -1)
        known = xp.where((near >= 0)[..., None], xp.asarray(held)[index], 0.0).reshape(len(cls.ids), -1)
        known = xp.where(place >= 0, 0.0, known)
        extra = xp.asarray(nums.gamma)[index].reshape(len(cls.ids), -1)
        given_data = xp.concatenate([known, extra], axis=1)
        m = place.shape[1]
        matrix, load = xp.asarray(made.matrix), xp.asarray(made.load)
        right = (load - xp.einsum("nij,nj->ni", matrix, given_data))[:, :m]
        r = xp.broadcast_to(place[:, :, None], (len(cls.ids), m, m))
        c = xp.broadcast_to(place[:, None, :], (len(cls.ids), m, m))
        keep = (r >= 0) & (c >= 0)
        if xp is np:
            np.add.at(b, place[place >= 0], right[place >= 0])
            parts.append((matrix[:, :m, :m][keep], r[keep], c[keep]))
        else:
            b = jnp.asarray(b).at[jnp.maximum(place, 0)].add(jnp.where(place >= 0, right, 0.0))
            if is_traced(near):
                flat = (jnp.where(keep, matrix[:, :m, :m], 0.0), jnp.where(keep, r, 0), jnp.where(keep, c, 0))
                parts.append(tuple(x.reshape(-1) for x in flat))
            else:
                at = np.nonzero(np.asarray(keep))
                parts.append((matrix[:, :m, :m][at], np.asarray(r)[at], np.asarray(c)[at]))
    data, r, c = zip(*parts)
    xp = jnp if is_traced(parts) else np
    return xp.concatenate(data), (jnp if is_traced(r) else np).concatenate(r), (jnp if is_traced(c) else np).concatenate(c), b


def prefers_least_squares(disc: Discretization, nums: Numbers) -> bool:
    """Whether information travels: operators of first order, hyperbolic ones of second, and those
    whose convection outweighs diffusion between neighbours (cell Peclet number above 2).

    There a value predicted by neighbours on all sides is the wrong global form.
    """
    rec = disc.rec
    orders = {rec.order - q for q in rec.degrees}
    if disc.scheme.method != "S" or rec.fields > 1 or is_traced(nums.jac):
        return False
    if orders == {1}:
        return True
    if orders != {2}:
        return False
    symbol = np.zeros((nums.jac.shape[-1], rec.dim, rec.dim))
    for s, (_, b) in enumerate(rec.slots):
        if sum(b) == 2:
            i, j = [axis for axis in range(rec.dim) for _ in range(b[axis])]
            symbol[:, i, j] += nums.jac[0, s, 0] / 2
            symbol[:, j, i] += nums.jac[0, s, 0] / 2
    values = np.linalg.eigvalsh(symbol)
    diffusion = np.abs(values).max(axis=1)
    if (values[:, 0] * values[:, -1] < -1e-10 * diffusion**2).any():
        return True
    drift = [s for s, (_, b) in enumerate(rec.slots) if sum(b) == 1]
    if not drift or is_traced(disc.cloud.points):
        return False
    speed = np.linalg.norm(nums.jac[0, drift, 0], axis=0)
    points = np.asarray(disc.cloud.points)
    apart = (np.prod(np.ptp(points, axis=0)) / len(points)) ** (1.0 / rec.dim)
    return bool(np.median(speed * apart / diffusion) > 2.0)


def with_held(disc: Discretization, nums: Numbers, x: Any) -> Any:
    """All values (N, F) from the unknowns x (n,)."""
    place = np.flatnonzero(~disc.held.reshape(-1))
    if is_traced(x, nums.held):
        return jnp.asarray(nums.held).reshape(-1).at[place].set(x).reshape(disc.held.shape)
    values = np.array(nums.held).reshape(-1)
    values[place] = x
    return values.reshape(disc.held.shape)
