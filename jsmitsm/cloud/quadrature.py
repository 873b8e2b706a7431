"""Integrals over boundary groups: curved facets between boundary particles, Gauss points on them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.domain_quadrature import domain_rule
from jsmitsm.cloud.regions.region_cloud import RegionCloud, sides
from jsmitsm.cloud.triangulation import boundary_facets, lying_on
from jsmitsm.runtime.errors import explaining
from jsmitsm.taylor.multi_indices import multi_indices

# A particle's normal shapes a facet if it is within 30 degrees of the facet's own; beyond, there is a corner.
_SMOOTH = math.cos(math.radians(30.0))
_GAUSS = 4
# Boundary particles around a facet among which its group is looked for.
_AROUND = 30


class Quadrature(NamedTuple):
    """sum(weights * f(points)) approximates the integral of f over a boundary group, or over the domain.

    points (Q, D), weights (Q,) in units of length, area or volume (1 at ends in 1D), normals (Q, D), unit and outward.
    """

    points: np.ndarray
    weights: np.ndarray
    normals: np.ndarray

    def __repr__(self) -> str:
        return f"Quadrature({len(self.points)} points, weights that sum to {self.weights.sum():.6g})"


@explaining
def quadrature(cloud: Cloud, group: str | None = None, degree: int = 8) -> Quadrature:
    """Points and weights for integrals over a boundary group, or over the domain where no group is named.

    Over the domain: exact for polynomials of the ``degree`` where the boundary is straight, of error
    O(spacing^(degree + 1)) where it curves smoothly; the normals are NaN.

    Between neighbouring boundary particles lie cubic facets that follow their normals (curved PN
    triangles, Vlachos et al. 2001, and their counterpart in 2D), flat at corners and where the
    cloud has no normals. A facet belongs to the group whose normals it continues. The
    error is O(spacing^4) on smooth boundaries, none on straight ones. Over the domain of a cloud of several regions
    the rules of all stand one after another; over an interface ``"a|b"`` the normals point from a to b.

    Parameters
    ----------
    cloud : Cloud
        The particles.
    group : str, optional
        The name of a boundary group; the domain if not given.
    degree : int
        Of the polynomials that are integrated exactly over the domain.

    Returns
    -------
    Quadrature
        ``points`` (Q, D), ``weights`` (Q,) and ``normals`` (Q, D).

    Raises
    ------
    ValueError
        For a group that is no boundary group, and a degree that is no whole number from 1.

    Examples
    --------
    >>> import jsmitsm as js
    >>> cloud = js.rectangle((0.0, 0.0), (2.0, 1.0), (9, 5))
    >>> round(float(js.quadrature(cloud, "top").weights.sum()), 12)
    2.0
    >>> round(float(js.quadrature(cloud).weights.sum()), 12)
    2.0
    """
    if isinstance(degree, bool) or not isinstance(degree, (int, np.integer)) or degree < 1:
        raise ValueError(f"degree: expected a whole number from 1, got {degree!r}")
    if not isinstance(cloud, Cloud):
        raise ValueError(f"cloud: expected a js.Cloud, got {type(cloud).__name__}")
    if group is not None and not isinstance(group, str):
        raise ValueError(f"group: expected the name of a boundary group, got {group!r}")
    if isinstance(cloud, RegionCloud):
        return _of_regions(cloud, group, degree)
    if group is None:
        at, weights = domain_rule(cloud, int(degree))
        return Quadrature(at, weights, np.full(at.shape, np.nan))
    if group not in cloud.groups or group == "interior":
        known = ", ".join(repr(name) for name in cloud.groups if name != "interior")
        raise ValueError(f"group: expected a boundary group ({known}), got {group!r}")
    points = np.asarray(cloud.points, float)
    facets, normal = boundary_facets(cloud)
    facets, normal = (x[_members(cloud, facets, normal, group)] for x in (facets, normal))
    if cloud.dim == 1:
        return Quadrature(points[facets[:, 0]], np.ones(len(facets)), normal)
    net = _control_net(points[facets], _vertex_normals(cloud, facets, normal))
    return _gauss(net, normal)


def _of_regions(cloud: RegionCloud, group: str | None, degree: int) -> Quadrature:
    """That of all regions together; of an interface once, with its normals from the first region to the second."""
    parts = [cloud.region(name) for name in cloud.regions]
    if group in cloud.interfaces:
        parts = [cloud.region(sides(str(group))[0])]
    elif group is not None:
        parts = [part for part in parts if group in part.groups] or parts[:1]
    made = [quadrature(part, group, degree) for part in parts]
    return Quadrature(*(np.concatenate(arrays) for arrays in zip(*made)))


def _members(cloud: Cloud, facets: np.ndarray, normal: np.ndarray, group: str) -> np.ndarray:
    """Mask of a group's facets: the nearest particle whose normal is like the facet's belongs to it.

    At edges and corners of the domain all corners of a facet may be of other groups. Without
    normals, or with none alike, most of its corners decide.
    """
    named = np.zeros(len(cloud), bool)
    named[np.asarray(cloud.groups[group])] = True
    mask = named[facets].sum(axis=1) * 2 > facets.shape[1]
    if cloud.normals is None:
        return mask
    from scipy.spatial import cKDTree

    points, own, rim = np.asarray(cloud.points), np.asarray(cloud.normals), cloud.boundary
    count = min(_AROUND, len(rim))
    near = rim[cKDTree(points[rim]).query(points[facets].mean(axis=1), k=range(1, count + 1))[1]]
    alike = np.nan_to_num(np.sum(own[near] * normal[:, None], axis=2), nan=-1.0) >= _SMOOTH
    first = np.take_along_axis(near, alike.argmax(axis=1)[:, None], axis=1)[:, 0]
    return np.where(alike.any(axis=1), named[first], mask)


def _vertex_normals(cloud: Cloud, facets: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The particles' normals (M, D, D) where the boundary is smooth, those of the flat facet elsewhere."""
    flat = np.broadcast_to(normal[:, None], (*facets.shape, cloud.dim))
    if cloud.normals is None:
        return flat
    own = np.asarray(cloud.normals)[facets]
    smooth = (np.sum(own * flat, axis=2) >= _SMOOTH) & ~lying_on(cloud, facets)[:, None]
    return np.where(smooth[..., None], own, flat)


def _control_net(corners: np.ndarray, normals: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
    """Control points of the cubic facets, by the exponents of the barycentric coordinates."""
    dim = corners.shape[1]
    net = {}
    for a in (a for a in multi_indices(dim, 3) if sum(a) == 3):
        i = int(np.argmax(a))
        if max(a) == 3:
            net[a] = corners[:, i]
        elif max(a) == 2:
            j = a.index(1)
            side = corners[:, j] - corners[:, i]
            rise = np.sum(side * normals[:, i], axis=1, keepdims=True) * normals[:, i]
            net[a] = corners[:, i] + (side - rise) / 3.0
    if dim == 3:
        edge = np.mean([net[a] for a in net if max(a) == 2], axis=0)
        net[1, 1, 1] = edge + (edge - corners.mean(axis=1)) / 2.0
    return net


def _reference(dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points as barycentric coordinates (Q, D) and weights, on a segment or, collapsed, a triangle."""
    x, w = np.polynomial.legendre.leggauss(_GAUSS)
    x, w = (x + 1.0) / 2.0, w / 2.0
    if dim == 2:
        return np.stack([x, 1.0 - x], axis=1), w
    s, t = (v.ravel() for v in np.meshgrid(x, x, indexing="ij"))
    return np.stack([s, (1 - s) * t, (1 - s) * (1 - t)], axis=1), (np.outer(w, w) * (1 - x)[:, None]).ravel()


def _gauss(net: dict[tuple[int, ...], np.ndarray], outward: np.ndarray) -> Quadrature:
    """Points, weights and normals on Bezier facets."""
    dim = outward.shape[1]
    at, weights = _reference(dim)
    points = np.zeros((len(outward), len(at), dim))
    slopes = np.zeros((dim, len(outward), len(at), dim))
    for a, control in net.items():
        factor = 6.0 / math.prod(map(math.factorial, a))
        points += factor * np.prod(at ** np.array(a), axis=1)[:, None] * control[:, None]
        for k in range(dim):
            if a[k]:
                lower = np.array([v - (k == m) for m, v in enumerate(a)])
                slopes[k] += factor * a[k] * np.prod(at**lower, axis=1)[:, None] * control[:, None]
    along = slopes[:-1] - slopes[-1]
    if dim == 2:
        normal = np.stack([along[0][..., 1], -along[0][..., 0]], axis=-1)
    else:
        normal = np.cross(along[0], along[1])
    size = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / size * np.sign(np.sum(normal * outward[:, None], axis=-1, keepdims=True))
    return Quadrature(points.reshape(-1, dim), (size[..., 0] * weights).ravel(), normal.reshape(-1, dim))
