"""Integrals over the domain of what is known at the particles only: a weight for each of them."""

from __future__ import annotations

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.quadrature import rule
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.runtime.errors import explaining, is_whole
from jsmitsm.taylor.multi_indices import count, multi_indices

# Particles fitted at a time.
_CHUNK = 1000


@explaining
def node_weights(cloud: Cloud, degree: int = 4) -> np.ndarray:
    """Weights of the particles, for integrals over the domain of what is known there only.

    ``weights @ f`` is the integral of f, of an error O(spacing^(degree + 1)). The rule of ``js.quadrature`` asks for f
    between the particles; there it is the polynomial of the nearest one, fitted to its neighbours, and its own value
    has to be met.

    Parameters
    ----------
    cloud : Cloud
        The particles; of several regions each by itself.
    degree : int
        Of the polynomials that are integrated exactly, lower where the particles are too few.

    Returns
    -------
    ndarray (N,)
        A weight for each particle, in units of length to the power D; some may be negative.

    Raises
    ------
    ValueError
        For what is no cloud, and a degree that is no whole number from 1.

    Examples
    --------
    >>> import jsmitsm as js
    >>> cloud = js.rectangle((0.0, 0.0), (2.0, 1.0), (9, 5))
    >>> weights = js.node_weights(cloud)
    >>> round(float(weights @ cloud.points[:, 0] ** 2), 12)
    2.666666666667
    """
    if not isinstance(cloud, Cloud):
        raise ValueError(f"cloud: expected a js.Cloud, got {type(cloud).__name__}")
    if not is_whole(degree, 1):
        raise ValueError(f"degree: expected a whole number from 1, got {degree!r}")
    return weights_by(cloud, int(degree))


def weights_by(cloud: Cloud, degree: int, otherwise: bool = False) -> np.ndarray:
    """The weights of ``node_weights``; otherwise: by another rule, whose difference tells the error of the first."""
    if isinstance(cloud, RegionCloud):
        out = np.zeros(len(cloud))
        for name, ids in cloud.regions.items():
            out[ids] = weights_by(cloud.region(name), degree, otherwise)
        return out
    from scipy.spatial import cKDTree

    points, dim = np.asarray(cloud.points, float), cloud.dim
    while degree > 1 and _neighbours(dim, degree) > len(points):
        degree -= 1
    at, weight, _ = rule(cloud, None, degree, otherwise)
    tree = cKDTree(points)
    nearest = tree.query(at)[1]
    used, place = np.unique(nearest, return_inverse=True)
    near = tree.query(points[used], k=min(_neighbours(dim, degree), len(points)))[1].reshape(len(used), -1)
    size = np.linalg.norm(points[near] - points[used][:, None], axis=2).max(axis=1)
    some = np.array(multi_indices(dim, degree))
    # What the rule makes of the monomials about every particle.
    moments = np.zeros((len(used), len(some)))
    offset = (at - points[nearest]) / size[place][:, None]
    np.add.at(moments, place, weight[:, None] * np.prod(offset[:, None] ** some, axis=2))
    out = np.zeros(len(points))
    for k in range(0, len(used), _CHUNK):
        part = slice(k, k + _CHUNK)
        np.add.at(out, near[part], _of_values(points, used[part], near[part], size[part], moments[part], some))
    return out


def _neighbours(dim: int, degree: int) -> int:
    """How many particles, itself counted, a fit takes; on a line hardly more than there are coefficients."""
    return degree + 2 if dim == 1 else 2 * count(dim, degree)


def _of_values(
    points: np.ndarray, ids: np.ndarray, near: np.ndarray, size: np.ndarray, moments: np.ndarray, some: np.ndarray
) -> np.ndarray:
    """The weights (n, w) of the neighbours' values in moments (n, K) of the polynomials fitted to them."""
    s = (points[near] - points[ids][:, None]) / size[:, None, None]
    root = np.exp(-2.0 * (s**2).sum(axis=2)) * (near != ids[:, None])
    powers = np.prod(s[:, :, None, :] ** some[1:], axis=3)
    fit = np.linalg.pinv(root[:, :, None] * powers, rcond=1e-12) * root[:, None, :]  # (n, K - 1, w), of u_g - u_i
    weights = np.einsum("nk,nkw->nw", moments[:, 1:], fit)
    own = near == ids[:, None]
    return weights + own * (moments[:, :1] - weights.sum(axis=1, keepdims=True))
