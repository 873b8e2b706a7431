"""One particle's moment system: its row of the global system, and its Taylor coefficients.

Written once for one particle and vmapped by ``batches``. All polynomials are in the offset
s = (x_g - x_i) / l, scaled by a length l of the support, so nothing here knows of units.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.particle.elimination import Deep, Elimination, Scheme, as_matrix, transposed
from jsmitsm.particle.kernels import EDGE, Kernel, fitted
from jsmitsm.particle.polynomials import FEW, Combinations, Separated, functionals, monomials
from jsmitsm.particle.recursion import Recursion, fit_and_tail
from jsmitsm.particle.small_systems import (
    general_inverse,
    gram_inverse,
    min_norm,
    null_space,
    product,
    safe_root,
    solve_gram,
)
from jsmitsm.taylor.multi_indices import multi_indices

# Lengths of which the nearest stands for a particle's own, where the operator is constant, are apart by this ratio.
COMMON = 1.25


class Row(NamedTuple):
    """A particle's equations: own u_i - sum_g weights u_g = source . F + condition . g.

    The first axis runs over the F equations of the particle.
    """

    weights: Any  # (F, ns, F)
    data: Any  # (F, ns, n_data)
    source: Any  # (F, rows)
    condition: Any  # (F, n_own)
    lebesgue: Any  # (F,)
    defect: Any  # (), how far the moment system is from determining what was asked
    constant: Any  # (F,) a further part of the right-hand side (I and II)


class Support(NamedTuple):
    """A particle's neighbours: scaled offsets, their distances and kernel weights."""

    offset: Any  # (ns, D), scaled by length
    weight: Any  # (ns,)
    inside: Any  # (ns,) bool
    length: Any  # ()
    kernel: Kernel  # the particle's own


def support(points: Any, i: Any, neighbours: Any, kernel: Kernel | None, decay: float = 2.0) -> Support:
    """Offsets and weights of one particle's neighbours.

    Without a kernel the weight is exp(-(decay r / r_max)^2), r_max the distance of the farthest.
    """
    valid = neighbours >= 0
    offset = points[jnp.where(valid, neighbours, i)] - points[i]
    square = jnp.sum(offset**2, axis=1)
    apart = square > 0
    distance = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)
    own = kernel.at(i) if kernel is not None else fitted(jnp.max(distance), decay)
    inside = valid & (distance <= own.d * own.h * EDGE) if kernel is not None else valid
    weight = jnp.maximum(own.profile(distance / own.h), 0.0)
    return Support(offset / own.length, jnp.where(inside, weight, 0.0), inside, own.length, own)


def at_length(near: Support, length: Any) -> Support:
    """The same neighbours with their offsets scaled by another length."""
    return near._replace(offset=near.offset * (near.length / length), length=length)


def at_common_length(near: Support) -> Support:
    """The same with the nearest of the lengths that particles have in common.

    Particles share an elimination at these; one that does not is to have the same row.
    """
    length = jax.lax.stop_gradient(near.length)
    steps = jnp.rint(jnp.log(jnp.where(length > 0, length, 1.0)) / math.log(COMMON))
    return at_length(near, jnp.where(length > 0, jnp.exp(steps * math.log(COMMON)), length))


def _fit(scheme: Scheme, weight: Any, phi: Any, tests: Any, target: Any) -> Any:
    """Weights w (n, m) on the data with phi^T w = target, in the method's test space."""
    if tests is None:
        root = safe_root(weight)[:, None]
        tolerance = 1e-13 if scheme.method == "SSPH" else None
        return root * min_norm(root * phi, target, tolerance)
    return tests @ (general_inverse(phi.T @ tests) @ target)


class System(NamedTuple):
    """One particle's local fit before a functional of it is asked for."""

    elimination: Elimination
    reduced: Any  # (F K, free after the own conditions)
    own_rows: Any  # (n_own, F K)
    own_scale: Any  # (n_own,)
    own_solve: Any  # (free, n_own)
    values: Any  # (rows of data, F K): the data as functionals of U, an array or what stands for it
    phi: Any  # values @ reduced
    weight: Any  # (rows of data,)
    tests: Any  # (rows of data, free) or None
    data_scale: Any  # (ns, n_data)


def local_system(
    scheme: Scheme, near: Support, solution: Elimination, own: Any, data: Any, tests: Any, skip_self: bool,
    values: Any = None,
) -> System:  # fmt: skip
    """Set up the moment system of one particle.

    own (n_own, S_own): coefficients of its own conditions, imposed exactly; data
    (ns, n_data, S_data): coefficients of its neighbours' conditions, fitted like values;
    tests (rows of data, free): what the rows of I, II and III are multiplied with; values
    (rows of data, F K): what the data are, the neighbours' values if not given.
    """
    rec = scheme.rec
    ns, fields = len(near.offset), rec.fields
    weight = near.weight.at[0].set(0.0) if skip_self else near.weight
    plain = values is None and fields == 1 and not scheme.n_data
    if plain and rec.size <= FEW and not isinstance(solution.particular, Deep):
        values = Combinations(near.offset, rec.reach)
    elif plain and scheme.flat and rec.depth and rec.dim < 3:
        values = Separated(near.offset, rec.reach)  # of those beyond the fit sums alone are asked for
    else:
        p = monomials(near.offset, rec.reach)
    if values is None:
        values = jnp.einsum("gk,fh->gfhk", p, jnp.eye(fields)).reshape(ns * fields, -1) if fields > 1 else p
    weights = jnp.repeat(weight, fields)
    data_scale = jnp.zeros((ns, 0))
    if scheme.n_data:
        made = partial(functionals, scheme.data, rec=rec, length=near.length, units=solution.units)
        rows, data_scale = jax.vmap(made)(data, p)
        given = jnp.any(data != 0, axis=2)
        values = jnp.concatenate([values, rows.reshape(ns * scheme.n_data, -1)])
        weights = jnp.concatenate([weights, (given * weight[:, None]).reshape(-1)])
    basis = solution.basis
    own_rows, own_scale = jnp.zeros((0, basis.shape[0])), jnp.zeros(0)
    own_solve = jnp.zeros((basis.shape[1], 0))
    if scheme.n_own and scheme.method != "SSPH":
        at = jnp.zeros(rec.size, basis.dtype).at[0].set(1.0)
        own_rows, own_scale = functionals(scheme.own, own, at, rec, near.length, solution.units)
        z, own_solve = null_space(own_rows @ basis)
        basis = basis @ z
        tests = None if tests is None else tests @ z
    phi = _data_of(scheme, near, values, basis, plain)
    return System(solution, basis, own_rows, own_scale, own_solve, values, phi, weights, tests, data_scale)


def _data_of(scheme: Scheme, near: Support, values: Any, basis: Any, plain: bool) -> Any:
    """The data (rows of data, free) of the local solutions; those that end with the fit are looked at no further.

    plain: whether the data are the neighbours' values of one field.
    """
    if scheme.flat and scheme.rec.depth:
        low = fit_and_tail(scheme.rec)[0]
        basis = basis[low]
        if plain and len(low) <= FEW:
            values = Combinations(near.offset, scheme.rec.order)
        elif isinstance(values, Separated):
            values = monomials(near.offset, scheme.rec.order)
        else:
            values = values[:, low]
    return values @ basis if isinstance(values, Combinations) else product(values, basis)


def balance(rec: Recursion, length: Any, solution: Elimination) -> Any:
    """What the values of the fields are multiplied with inside the fit, (F,)."""
    return length ** jnp.asarray(rec.weights, length.dtype) / solution.units


def moment_matrix(system: System) -> Any:
    """What is inverted: sqrt(W) phi (data, free) for a least-squares fit, else tests^T phi (free, free)."""
    if system.tests is None:
        return safe_root(system.weight)[:, None] * system.phi
    return system.tests.T @ system.phi


def functional(scheme: Scheme, near: Support, system: System, wanted: Any) -> tuple[Any, Any, Any, Any]:
    """Weights of the data, the source and the own conditions in ``wanted`` (m, F K) . U.

    Returns w (rows of data, m), v (rows, m), v_own (n_own, m) and the defect of the system.
    """
    target = system.reduced.T @ wanted.T
    w = _fit(scheme, system.weight, system.phi, system.tests, target)
    size = jnp.max(jnp.abs(target), initial=0.0)
    # What phi^T w lacks of the target.
    defect = jnp.max(jnp.abs(target - system.phi.T @ w), initial=0.0) / jnp.where(size > 0, size, 1.0)
    if not (scheme.sourced or scheme.n_own):
        return w, jnp.zeros((scheme.rec.n_rows, wanted.shape[0])), jnp.zeros((0, wanted.shape[0])), defect
    basis, particular = system.elimination.basis, system.elimination.particular
    v_own = system.own_solve.T @ _lacking(system, wanted, w, basis) if scheme.n_own else jnp.zeros((0, wanted.shape[0]))
    v = _lacking(system, wanted, w, particular)
    if scheme.n_own:
        v = v - transposed(particular, system.own_rows.T @ v_own)
    return w, v, v_own, defect


def _lacking(system: System, wanted: Any, w: Any, matrix: Any) -> Any:
    """matrix^T (wanted^T - values^T w): what the data leave of each wanted functional of matrix's columns."""
    if isinstance(system.values, Combinations):
        return matrix.T @ wanted.T - (system.values @ matrix).T @ w
    if isinstance(system.values, Separated):
        return transposed(matrix, wanted.T - system.values.summed(w))
    return transposed(matrix, wanted.T - system.values.T @ w)


def row(scheme: Scheme, near: Support, solution: Elimination, own: Any, data: Any, tests: Any) -> Row:
    """The particle's equations in the global system."""
    make = _collocated if scheme.method == "SSPH" else _predicted
    w, v, v_own, lebesgue, defect, system = make(scheme, near, solution, own, data, tests)
    rec, ns = scheme.rec, near.weight.shape[0]
    fields = rec.fields
    # Fields are balanced inside the fit; the global unknowns are not.
    power = balance(rec, near.length, solution)
    lift = jnp.ones(fields) if scheme.method == "SSPH" else 1.0 / power
    values = w[: ns * fields].T.reshape(fields, ns, fields) * power * lift[:, None, None]
    extra = w[ns * fields :].T.reshape(fields, ns, scheme.n_data) * system.data_scale * lift[:, None, None]
    return Row(values, extra, v.T * lift[:, None], v_own.T * lift[:, None], lebesgue, defect, jnp.zeros(fields))


def _predicted(scheme, near, solution, own, data, tests):
    """u_i = U_i(0): the particle's value as its neighbours predict it."""
    rec = scheme.rec
    system = local_system(scheme, near, solution, own, data, tests, skip_self=True)
    wanted = np.zeros((rec.fields, rec.fields * rec.size))
    wanted[np.arange(rec.fields), np.arange(rec.fields) * rec.size] = 1.0
    w, v, v_own, defect = functional(scheme, near, system, jnp.asarray(wanted))
    return w, v * solution.lift[:, None], v_own * system.own_scale[:, None], _lebesgue(rec, near, w), defect, system


def _lebesgue(rec: Recursion, near: Support, w: Any) -> Any:
    """sum_g |w_g| of each field over its neighbours' values of the same field: (F,).

    Weights of other fields and of conditions given as data have other units: they couple the
    equations and say nothing of the stencil.
    """
    values = w[: near.weight.shape[0] * rec.fields].reshape(-1, rec.fields, rec.fields)
    return jnp.einsum("gff->f", jnp.abs(values))


def _collocated(scheme, near, solution, own, data, tests):
    """The equation itself, or the particle's own boundary condition, applied to the fit (SSPH)."""
    rec = scheme.rec
    system = local_system(scheme, near, solution, own, data, tests, skip_self=False)
    at = np.array(rec.equation_rows)
    wanted, v = solution.rows, jnp.zeros((rec.n_rows, rec.fields)).at[at, np.arange(rec.fields)].set(solution.lift[at])
    v_own = jnp.zeros((0, rec.fields))
    if scheme.n_own:
        here = jnp.zeros(rec.size).at[0].set(1.0)
        wanted, scale = functionals(scheme.own, own, here, rec, near.length, solution.units)
        v, v_own = jnp.zeros_like(v), jnp.diag(scale)
    w, _, _, defect = functional(scheme, near, system, wanted)
    own_weight = jnp.abs(w[np.arange(rec.fields), np.arange(rec.fields)])
    others = jnp.sum(jnp.abs(w), axis=0) - own_weight
    return -w, v, v_own, others / jnp.where(own_weight > 0, own_weight, 1.0), defect, system


class Block(NamedTuple):
    """A particle's part of the least-squares form, sum_i |(I - A A^+) sqrt(W) (u - P U_part)|^2.

    matrix (m, m) over the fit's data: values of the neighbours, the particle itself first, then their
    conditions. right (m, rows + n_own): times the recursion's right-hand side, if the scheme is sourced,
    and the values of the own conditions, it is the load of the data.
    """

    matrix: Any
    right: Any


def block(scheme: Scheme, near: Support, solution: Elimination, own: Any, data: Any) -> Block:
    """The least-squares misfit of the particle's local fit as a quadratic form of its data."""
    system = local_system(scheme, near, solution, own, data, None, skip_self=False)
    part = _parts(scheme, solution, system)
    root = safe_root(system.weight)
    a = root[:, None] * system.phi
    misfit = jnp.diag(system.weight) - root[:, None] * (a @ solve_gram(a, gram_inverse(a), a.T)) * root
    # Physical data are scaled like the unknowns inside the fit.
    ns = near.weight.shape[0]
    power = balance(scheme.rec, near.length, solution)
    scale = jnp.concatenate([jnp.tile(power, ns), system.data_scale.reshape(-1)])
    return Block(scale[:, None] * misfit * scale, scale[:, None] * (misfit @ _looked_at(scheme, ns, system, part)))


def _parts(scheme: Scheme, solution: Elimination, system: System) -> Any:
    """What each number of the recursion's right-hand side, where the scheme is sourced, and of the own conditions adds
    to ``particular_part``: (F K, rows + n_own)."""
    columns = []
    if scheme.sourced:
        part = as_matrix(solution.particular) * solution.lift
        if scheme.n_own:
            part = part - solution.basis @ (system.own_solve @ (system.own_rows @ part))
        columns.append(part)
    if scheme.n_own:
        columns.append(solution.basis @ (system.own_solve * system.own_scale))
    return jnp.concatenate(columns, axis=1) if columns else jnp.zeros((solution.basis.shape[0], 0))


def _looked_at(scheme: Scheme, ns: int, system: System, part: Any) -> Any:
    """The data (rows of data, m) of local polynomials (F K, m); a neighbour's value hangs on its own field alone."""
    fields = scheme.rec.fields
    if fields == 1:
        return system.values @ part
    own = system.values[: ns * fields : fields, : scheme.rec.size]
    seen = jnp.einsum("gk,fkm->gfm", own, part.reshape(fields, scheme.rec.size, -1)).reshape(ns * fields, -1)
    return jnp.concatenate([seen, system.values[ns * fields :] @ part])


def particular_part(scheme: Scheme, solution: Elimination, system: System, source: Any, given: Any) -> Any:
    """The scaled U (F K,) that meets the recursion and the particle's own conditions."""
    part = solution.particular @ (solution.lift * source)
    if scheme.n_own and scheme.method != "SSPH":
        lack = system.own_scale * given - system.own_rows @ part
        part = part + solution.basis @ (system.own_solve @ lack)
    return part


def coefficients(
    scheme: Scheme, near: Support, solution: Elimination, own: Any, data: Any, tests: Any,
    values: Any, source: Any, given: Any,
) -> Any:  # fmt: skip
    """The particle's Taylor coefficients (F, K), unscaled, from its neighbours' values.

    values (rows of data,): the neighbours' values and their conditions' values; source (rows,):
    the recursion's right-hand side; given (n_own,): the values of its own conditions.
    """
    rec, fields = scheme.rec, scheme.rec.fields
    collocated = scheme.method == "SSPH"
    system = local_system(scheme, near, solution, own, data, tests, skip_self=not collocated)
    ns = near.weight.shape[0]
    power = balance(rec, near.length, solution)
    scaled = (values[: ns * fields].reshape(ns, fields) * power).reshape(-1)
    scaled = jnp.concatenate([scaled, values[ns * fields :] * system.data_scale.reshape(-1)])
    part = particular_part(scheme, solution, system, source, given)
    rest = scaled - system.values @ part
    if system.tests is None:
        a = safe_root(system.weight)[:, None] * system.phi
        inverse = gram_inverse(a, 1e-13 if collocated else None)
        free = solve_gram(a, inverse, a.T @ (safe_root(system.weight) * rest))
    else:
        free = general_inverse(system.tests.T @ system.phi) @ (system.tests.T @ rest)
    scaled_u = (part + system.reduced @ free).reshape(fields, rec.size)
    degrees = np.array([float(sum(a)) for a in multi_indices(rec.dim, rec.reach)])
    return scaled_u * near.length ** (-degrees) / power[:, None]
