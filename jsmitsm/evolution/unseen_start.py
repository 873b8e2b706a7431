"""How much of a start its particles do not see: a jump between them, or a spot narrower than the spacing.

No later time tells, whatever the steps and the order: what was not sampled is not carried on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.particle.polynomials import monomials_on_host
from jsmitsm.runtime.tracers import is_traced

# The degree of the polynomials that the start is compared with, and what differs by much, in parts of the largest
# value: four particles a wavelength leave a fortieth, a jump a half.
DEGREE, MUCH = 4, 0.1


def unseen_start(u0: Any, values: Any, cloud: Cloud, second: bool, expanded: Callable[[Any], Any]) -> float:
    """The part of the start, a function of x with ``values`` (N, F) at the particles, that these do not see.

    expanded: the local polynomials (N, F, K) of values, of degree ``DEGREE``. Halfway to the nearest neighbours they
    are compared with it. Those that differ by much are taken to be off by chance, each for the volume that it has: in a
    sum over the domain the squares add up. Zero for arrays, in several regions, and where JAX traces.
    """
    u0 = u0[0] if second and isinstance(u0, (tuple, list)) else u0
    if not callable(u0) or isinstance(cloud, RegionCloud) or len(cloud) < 3 or is_traced(values, cloud):
        return 0.0
    from scipy.spatial import cKDTree

    values, points = np.asarray(values), np.asarray(cloud.points)
    n, dim = points.shape
    far, near = cKDTree(points).query(points, k=range(2, min(2 * dim + 1, n) + 1))
    offset = 0.5 * (points[near] - points[:, None])
    vector = lambda x: jnp.broadcast_to(jnp.asarray(u0(x), float).reshape(-1), values.shape[1:])
    there = np.asarray(jax.vmap(jax.vmap(vector))(jnp.asarray(points[:, None] + offset)))
    much = MUCH * np.abs(values).max(axis=0)
    if not (np.abs(there - 0.5 * (values[:, None] + values[near])) > much).any():
        return 0.0
    powers = monomials_on_host(offset.reshape(-1, dim).T, DEGREE).T.reshape(*near.shape, -1)
    away = there - np.einsum("nkt,nft->nkf", powers, np.asarray(expanded(values)))
    away = np.where(np.abs(away) > much, away, 0.0).sum(axis=1) / (1 + near.shape[1])
    volume = far.mean(axis=1) ** dim
    whole = np.abs(values).T @ volume
    part = np.sqrt(np.square(away * volume[:, None]).sum(axis=0)) / np.where(whole > 0, whole, np.inf)
    return float(part.max(initial=0.0))
