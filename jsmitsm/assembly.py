"""All particles' rows: the per-particle moment systems, vmapped in blocks that stay in cache."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.kernels import Kernel
from jsmitsm.moments import Elimination, Row, Scheme, eliminate, row, support

# Particles per block: larger ones leave the cache and are several times slower.
_BLOCK = 64

TRACES = {"rows": 0}


class Operands(NamedTuple):
    """What the particles of a class need besides their neighbours; the leading axis is theirs.

    jac is (n, E, S, T), or (1, E, S, 1) where one serves all; solution is given where one
    elimination serves all particles.
    """

    jac: Any
    own: Any  # (n, n_own, S_own)
    data: Any  # (N, n_data, S_data), of all particles


@partial(jax.jit, static_argnums=(0,))
def block_rows(
    scheme: Scheme, points: Any, kernel: Kernel | None, ids: Any, neighbours: Any, operands: Operands,
    shared: tuple[Any, Any, Any] | None,
) -> Row:  # fmt: skip
    """The rows of the particles ``ids`` (n,) with ``neighbours`` (n, w).

    shared: basis, particular part and row norms of a recursion that is the same everywhere.
    """
    TRACES["rows"] += 1
    constant = operands.jac.shape[0] == 1

    @partial(jax.checkpoint, policy=None)
    def particle(args):
        i, near_ids, jac, own = args
        near = support(points, i, near_ids, kernel)
        jac = operands.jac[0] if constant else jac
        solution = _rescaled(scheme, shared, near.length) if shared else eliminate(scheme, jac, near.length)
        data = operands.data[jnp.where(near.inside, near_ids, i)] if scheme.n_data else None
        if scheme.n_data:
            data = jnp.where(near.inside[:, None, None], data, 0.0)
        derivatives = kernel_derivatives(scheme, kernel, near) if scheme.method == "III" else None
        return row(scheme, near, solution, own, data, derivatives)

    jac = jnp.zeros((ids.shape[0], 0)) if constant else operands.jac
    return jax.lax.map(particle, (ids, neighbours, jac, operands.own), batch_size=_BLOCK)


def _rescaled(scheme: Scheme, shared: tuple[Any, Any, Any], length: Any) -> Elimination:
    """A shared elimination with this particle's powers of length."""
    from jsmitsm.recursion import lift_powers

    basis, particular, rows_norm = shared
    lift = length ** jnp.asarray(lift_powers(scheme.rec)) / rows_norm[0]
    return Elimination(basis, particular, lift, rows_norm[1])


def kernel_derivatives(scheme: Scheme, kernel: Kernel, near: Any) -> Any:
    raise NotImplementedError
