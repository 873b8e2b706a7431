"""The rows of all particles, and the global system they make.

The per-particle moment systems are vmapped in blocks that stay in cache; the sparsity pattern
is fixed by the stencils and known before.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jsmitsm import closure, moments
from jsmitsm.closure import Recovery
from jsmitsm.kernels import Kernel
from jsmitsm.moments import Elimination, Row, Scheme, Support
from jsmitsm.recursion import row_levels

# Particles per block: larger blocks leave the cache and are several times slower.
_BLOCK = 64

# How often the local phase was compiled; read by the tests.
TRACES = {"rows": 0, "coefficients": 0}


class Operands(NamedTuple):
    """The numbers behind the rows of n particles.

    jac (n, E, S, T): Taylor coefficients of the operator's coefficients, or (1, E, S, 1) where
    one set serves all; own (n, n_own, S_own): the particles' own conditions; data
    (N, n_data, S_data): the conditions neighbours contribute, of every particle of the cloud;
    shared: an elimination that is the same everywhere, with lifts for unit length.
    """

    jac: Any
    own: Any
    data: Any
    shared: Elimination | None


@partial(jax.jit, static_argnums=(0,))
def rows(scheme: Scheme, points: Any, kernel: Kernel | None, ids: Any, neighbours: Any, operands: Operands) -> Row:
    """The rows of the particles ``ids`` (n,) with ``neighbours`` (n, w); particle axis first."""
    TRACES["rows"] += 1

    def particle(i, near_ids, jac, own):
        return moments.row(scheme, *_prepared(scheme, points, kernel, i, near_ids, operands, jac, own))

    return _mapped(particle, ids, neighbours, operands)


@partial(jax.jit, static_argnums=(0,))
def coefficients(
    scheme: Scheme, points: Any, kernel: Kernel | None, ids: Any, neighbours: Any, operands: Operands,
    u: Any, gamma: Any, source: Any, given: Any,
) -> Any:  # fmt: skip
    """Taylor coefficients (n, F, K) of the particles ``ids`` from all values ``u`` (N, F).

    gamma (N, n_data): the values of the neighbours' conditions; source (n, rows); given (n, n_own).
    """
    TRACES["coefficients"] += 1

    def particle(i, near_ids, jac, own, source, given):
        prepared = _prepared(scheme, points, kernel, i, near_ids, operands, jac, own)
        index = jnp.where(near_ids >= 0, near_ids, i)
        values = jnp.concatenate([u[index].reshape(-1), gamma[index].reshape(-1)])
        return moments.coefficients(scheme, *prepared, values, source, given)

    return _mapped(particle, ids, neighbours, operands, source, given)


def _mapped(particle: Any, ids: Any, neighbours: Any, operands: Operands, *more: Any) -> Any:
    """``particle`` over all particles, in blocks; intermediates are made again in the adjoint."""
    one_for_all = operands.jac.shape[0] == 1

    def one(args):
        i, near_ids, jac, own, *rest = args
        made = particle(i, near_ids, operands.jac[0] if one_for_all else jac, own, *rest)
        empty.update({k: x for k, x in enumerate(jax.tree.leaves(made)) if not x.size})
        return _without_empty(made)

    # Arrays without numbers cannot be cut into blocks: None stands for them on the way.
    empty: dict[int, Any] = {}
    each = _without_empty([None if one_for_all else operands.jac, operands.own, *more])
    made = jax.lax.map(jax.checkpoint(one), (ids, neighbours, *each), batch_size=_BLOCK)
    leaves, shape = jax.tree.flatten(made, is_leaf=lambda x: x is None)
    full = [jnp.zeros((ids.shape[0], *empty[k].shape)) if k in empty else x for k, x in enumerate(leaves)]
    return jax.tree.unflatten(shape, full)


def _without_empty(tree: Any) -> Any:
    return jax.tree.map(lambda x: x if x.size else None, tree)


def _prepared(scheme, points, kernel, i, near_ids, operands: Operands, jac, own):
    """The support, elimination and conditions of one particle."""
    near = moments.support(points, i, near_ids, kernel)
    if operands.shared is None:
        solution = moments.eliminate(scheme, jac, near.length)
    else:
        lift = operands.shared.lift * near.length ** jnp.asarray(row_levels(scheme.rec))
        solution = operands.shared._replace(lift=lift)
    data = None
    if scheme.n_data:
        data = operands.data[jnp.where(near_ids >= 0, near_ids, i)]
        data = jnp.where(near.inside[:, None, None], data, 0.0).at[0].set(0.0)
    return near, solution, own, data, _tests(scheme, near)


def _tests(scheme: Scheme, near: Support) -> Any:
    return closure.tests_iii(scheme, near) if scheme.method == "III" else None


@partial(jax.jit, static_argnums=(0,))
def recoveries(scheme: Scheme, points: Any, kernel: Kernel, ids: Any, neighbours: Any, operands: Operands) -> Recovery:
    """Stage 1 of I and II for the particles ``ids``; ``operands.own`` without held values."""
    TRACES["rows"] += 1

    def particle(i, near_ids, jac, own):
        near, solution, own, *_ = _prepared(replace(scheme, method=""), points, kernel, i, near_ids, operands, jac, own)
        return closure.recover(scheme, near, solution, own)

    return _mapped(particle, ids, neighbours, operands)


@partial(jax.jit, static_argnums=(0,))
def closed_rows(
    scheme: Scheme, points: Any, kernel: Kernel, ids: Any, neighbours: Any, operands: Operands,
    far_ids: Any, recovered: Recovery, constant: Any,
) -> tuple[Any, Row]:  # fmt: skip
    """The rows of I and II over values only, and the neighbours they reach, (n, ns + ns nr)."""
    TRACES["rows"] += 1

    def particle(i, near_ids, jac, own):
        near, solution, own, *_ = _prepared(scheme, points, kernel, i, near_ids, operands, jac, own)
        made = closure.closing(scheme, near, solution, own)
        reached, weights, more = closure.composed(near_ids, made, far_ids, recovered, constant)
        size = jnp.sum(jnp.abs(weights))
        return reached, Row(
            weights[None, :, None], jnp.zeros((1, reached.shape[0], 0)), made.source[None], made.condition[None],
            size[None], made.defect, more[None],
        )  # fmt: skip

    return _mapped(particle, ids, neighbours, operands)
