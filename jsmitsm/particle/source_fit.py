"""One particle's source as values: its Taylor coefficients from the values of its neighbours.

Where the source f of L u = f is known at the particles only, its Taylor coefficients about one of them are fitted,
pinned at the particle's own value: f_i[0] = f_i, and for 1 <= |c| <= q a least-squares fit of f_g - f_i with weights
exp(-(2 r / r_max)^2). What the particle's row says of these coefficients, s . f_i[c], so becomes weights of the values.
A fit that is not pinned has smaller errors and makes evolutions unstable.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.particle.moments import Support
from jsmitsm.particle.polynomials import monomials, whitening
from jsmitsm.particle.recursion import Recursion
from jsmitsm.particle.small_systems import min_norm, safe_root
from jsmitsm.taylor.multi_indices import index_of, multi_indices


def source_weights(rec: Recursion, near: Support, sensitivity: Any) -> Any:
    """Weights (F, ns, E) of the sources at the neighbours, the particle itself first.

    sensitivity (F, rows): what the particle's rows say of the Taylor coefficients of all sources.
    """
    fields, ns = sensitivity.shape[0], near.offset.shape[0]
    columns = []
    for e, q in enumerate(rec.degrees):
        place = index_of(rec.dim, q)
        at = np.array([k for k, (of, _) in enumerate(rec.row_index) if of == e])
        assert [rec.row_index[k][1] for k in at] == list(place)
        wanted = sensitivity[:, at]
        own = jnp.zeros((fields, ns)).at[:, 0].set(wanted[:, 0])
        columns.append(own if q == 0 else own + _pinned(rec.dim, q, near, wanted[:, 1:]))
    return jnp.stack(columns, axis=2)


def _pinned(dim: int, degree: int, near: Support, wanted: Any) -> Any:
    """Weights (F, ns) of f_g - f_i in ``wanted`` (F, T - 1), functionals of the coefficients without the first."""
    degrees = np.array([sum(c) for c in multi_indices(dim, degree)[1:]])
    scale = jnp.stack([near.length ** -int(k) for k in range(1, degree + 1)])[degrees - 1]
    white = jnp.asarray(_white(dim, degree))
    phi = monomials(near.offset, degree)[:, 1:] @ white
    root = safe_root(near.weight.at[0].set(0.0))[:, None]
    w = (root * min_norm(root * phi, white.T @ (scale * wanted).T)).T
    return w.at[:, 0].set(-jnp.sum(w, axis=1))


@lru_cache(maxsize=64)
def _white(dim: int, degree: int) -> np.ndarray:
    """Combinations (T - 1, T - 1) of the monomials but for the constant that are orthonormal over a full support."""
    return whitening(dim, degree, pinned=True)
