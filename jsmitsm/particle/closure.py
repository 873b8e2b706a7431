"""Kernel derivatives for the tests of II and III, and a well-posed closure of I and II.

As printed, methods I and II make the neighbours' derivatives unknowns of the global system,
which is then singular (I) or nearly so (II). Here the derivatives are eliminated in two stages:

1. Every particle, at the boundary too, recovers its free Taylor coefficients from its
   neighbours' values: kernel-weighted least squares on the recursion's local solutions, held
   exactly at the particle's own value and boundary conditions.
2. The rows of the method are written with these coefficients in place of the neighbours'
   derivatives, and solved for the particle's own; its value closes the system, u_i = U_i(0).

The kernel of method II is differentiated with respect to the particle x_i, a factor
(-1)^|a-b| on its derivative with respect to the neighbour: with the other sign every row is a
discrete integral of a total derivative, which is nearly zero for any U.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.particle.elimination import Elimination, Scheme
from jsmitsm.particle.kernels import Kernel
from jsmitsm.particle.moments import Support, System, functional, local_system
from jsmitsm.particle.polynomials import derivative_table, monomials
from jsmitsm.taylor import jets
from jsmitsm.taylor.multi_indices import factorial, index_of, multi_indices
from jsmitsm.taylor.series import variable


def kernel_taylor(kernel: Kernel, near: Support, degree: int) -> Any:
    """Taylor coefficients (ns, T) of the kernel about every neighbour, in the scaled offset.

    By Taylor-mode AD of the profile. The particle itself and padding get zeros: there the norm
    has no derivative, and no row needs one.
    """
    apart = near.inside & jnp.any(near.offset != 0, axis=1)
    at = jnp.where(apart[:, None], near.offset, 1.0)
    stretch = near.length / kernel.h

    def weight(s):
        return kernel.profile(jnp.sqrt(jnp.sum((s * stretch) ** 2)))

    closed = jax.make_jaxpr(weight)(at[0])
    (out,) = jets.evaluate(closed.jaxpr, closed.consts, [variable(at, degree)], at.shape[1], degree)
    out = jnp.broadcast_to(out[:, 0] if out.ndim == 3 else out, (out.shape[0], at.shape[0]))
    missing = len(multi_indices(at.shape[1], degree)) - out.shape[0]
    out = jnp.concatenate([out, jnp.zeros((missing, out.shape[1]), out.dtype)])
    return jnp.where(apart[:, None], out.T, 0.0)


def free_multi_indices(scheme: Scheme) -> tuple[tuple[int, ...], ...]:
    """The multi-indices of the free coefficients that are kept."""
    every = multi_indices(scheme.rec.dim, scheme.rec.order)
    return tuple(every[k] for k in scheme.free)


def tests_iii(scheme: Scheme, near: Support) -> Any:
    """Method III tests with d^a W for every free multi-index a: (ns, free).

    The factor a! multiplies a whole row and is left out.
    """
    free = free_multi_indices(scheme)
    degree = max(sum(a) for a in free)
    place = index_of(scheme.rec.dim, degree)
    return kernel_taylor(near.kernel, near, degree)[:, np.array([place[a] for a in free])]


@lru_cache(maxsize=64)
def _leibniz(free: tuple[tuple[int, ...], ...], dim: int, degree: int) -> tuple[np.ndarray, ...]:
    """Terms of d^a (W e) by the product rule: b, a, the place of a - b, and the factor

    C(a, b) (-1)^|a-b| (a-b)!, for Taylor coefficients of W instead of derivatives."""
    place = index_of(dim, degree)
    terms = []
    for j, a in enumerate(free):
        for k, b in enumerate(free):
            c = tuple(ai - bi for ai, bi in zip(a, b))
            if min(c) >= 0:
                choose = math.prod(math.comb(ai, bi) for ai, bi in zip(a, b))
                terms.append((k, j, place[c], choose * (-1.0) ** sum(c) * factorial(c)))
    return tuple(np.array(column) for column in zip(*terms))


def tests_i_ii(scheme: Scheme, near: Support) -> Any:
    """The rows of I and II: weights of the neighbour's d^b u in row a, (ns, b, a)."""
    free = free_multi_indices(scheme)
    n = len(free)
    if scheme.method == "I":
        return near.weight.at[0].set(0.0)[:, None, None] * jnp.eye(n)
    degree = max(sum(a) for a in free)
    b, a, c, factor = _leibniz(free, scheme.rec.dim, degree)
    derivatives = kernel_taylor(near.kernel, near, degree)
    return jnp.zeros((near.weight.shape[0], n, n)).at[:, b, a].add(derivatives[:, c] * factor)


def derivative_rows(scheme: Scheme, near: Support) -> Any:
    """The neighbours' derivatives d^b u, b free, as functionals of U_i: (ns, free, K)."""
    p = monomials(near.offset, scheme.rec.reach)
    rows = []
    for b in free_multi_indices(scheme):
        lower, factor = derivative_table(scheme.rec.dim, scheme.rec.reach, b)
        rows.append(p[:, lower] * factor)
    return jnp.stack(rows, axis=1)


class Recovery(NamedTuple):
    """Free Taylor coefficients (physical) of one particle from values, source and conditions."""

    weights: Any  # (free, ns)
    own: Any  # (free,) of the particle's own value
    constant: Any  # (free,) from the source and the particle's conditions
    defect: Any  # (), how far its moment system is from determining them


def recover(scheme: Scheme, near: Support, solution: Elimination, own: Any, source: Any, given: Any) -> Recovery:
    """Stage 1 for one particle: its free coefficients as functionals of its neighbours' values.

    source (rows,): the recursion's right-hand side; given (n_own,): the values of its conditions.
    """
    zero = (0, (0,) * scheme.rec.dim)
    slots = scheme.own if zero in scheme.own else (zero, *scheme.own)
    at = [slots.index(s) for s in scheme.own]
    rows = jnp.zeros((scheme.n_own + 1, len(slots))).at[0, slots.index(zero)].set(1.0)
    if scheme.n_own:
        rows = rows.at[1:, np.array(at)].set(own)
    held = replace(scheme, own=slots, n_own=scheme.n_own + 1)
    system = local_system(held, near, solution, rows, None, None, skip_self=True)
    wanted = np.zeros((len(scheme.free), scheme.rec.size))
    wanted[np.arange(len(scheme.free)), np.array(scheme.free)] = 1.0
    w, v, v_own, defect = functional(held, near, system, jnp.asarray(wanted))
    scale = near.length ** -np.array([float(sum(a)) for a in free_multi_indices(scheme)])
    v_own = v_own * system.own_scale[:, None]
    constant = (solution.lift * source) @ v
    if scheme.n_own:
        constant = constant + given @ v_own[1:]
    return Recovery((w * scale).T, v_own[0] * scale, constant * scale, defect)


class Closing(NamedTuple):
    """Stage 2: u_i = sum_g weights . (free coefficients of g) + source . F + condition . g."""

    weights: Any  # (ns, free)
    source: Any  # (rows,)
    condition: Any  # (n_own,)
    defect: Any


def closing(scheme: Scheme, near: Support, solution: Elimination, own: Any) -> Closing:
    """The particle's row of method I or II over its neighbours' free Taylor coefficients."""
    n = len(scheme.free)
    system = closing_system(scheme, near, solution, own)
    wanted = jnp.zeros((1, scheme.rec.size)).at[0, 0].set(1.0)
    w, v, v_own, defect = functional(scheme, near, system, wanted)
    free = free_multi_indices(scheme)
    lift = near.length ** np.array([float(sum(b)) for b in free]) * np.array([float(factorial(b)) for b in free])
    return Closing(w.reshape(-1, n) * lift, v[:, 0] * solution.lift, v_own[:, 0] * system.own_scale, defect)


def closing_system(scheme: Scheme, near: Support, solution: Elimination, own: Any) -> System:
    """The moment system of a row of method I or II, whose data are the neighbours' derivatives."""
    values = derivative_rows(scheme, near).reshape(-1, scheme.rec.size)
    tests = tests_i_ii(scheme, near).reshape(-1, len(scheme.free))
    return local_system(scheme, near, solution, own, None, tests, skip_self=True, values=values)


def composed(near_ids: Any, row: Closing, far_ids: Any, recovered: Recovery, reach: Any) -> tuple[Any, Any]:
    """Insert the recovered coefficients into one row: weights of the values of ``reach``, and a constant.

    near_ids (ns,), reach (w,); far_ids (N, nr) and ``recovered`` are those of every particle.
    """
    n = far_ids.shape[0]
    index = jnp.maximum(near_ids, 0)
    own = jnp.einsum("gb,gb->g", row.weights, recovered.own[index])
    far = jnp.einsum("gb,gbr->gr", row.weights, recovered.weights[index])
    # One entry for each particle of the cloud on the way: neighbours of neighbours meet in it.
    place = lambda ids: jnp.where(ids >= 0, ids, n)
    total = jnp.zeros(n).at[place(near_ids)].add(own, mode="drop").at[place(far_ids[index])].add(far, mode="drop")
    weights = total.at[place(reach)].get(mode="fill", fill_value=0.0)
    return weights, jnp.sum(row.weights * recovered.constant[index])
