"""Integrals over boundary groups and over the domain: Gauss points and what they weigh."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.domain_quadrature import SMOOTH, Members, domain_rule, surface_rule
from jsmitsm.cloud.regions.region_cloud import RegionCloud, sides
from jsmitsm.cloud.triangulation import boundary_facets
from jsmitsm.runtime.errors import explaining, is_whole

# Boundary particles around a facet among which its group is looked for.
_AROUND = 30
# Those by which a boundary particle is judged, by dimension, itself among them.
_BESIDE = {2: 5, 3: 13}


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

    Exact for polynomials of the ``degree`` where the boundary is straight, of error O(spacing^degree) or less where it
    curves smoothly. The boundary is the zero level of the shape where the cloud knows it; clouds that were made of
    points, read or unpickled do not, and there it is made of polynomials through the particles, flat where particles
    and normals say so. In 2D these have the same order; on the surfaces of solids about the fourth has been seen,
    whatever the degree. Corners that turn by less than 60 degrees between curved sides are then taken for smooth.

    Solids have edges, and no particles on them. Where the shape is known, the sides are followed to the edges where
    they meet: areas of single sides are then right to some 1e-4, at edges sharper than 45 degrees to some 1e-3, volumes
    to 1e-6, whatever the degree. Where it is not known, facets cut edges off: areas and fluxes are of first order there
    and wrong by percents at usual spacings.

    A facet belongs to the group whose normals it continues. Where a group ends inside of a smooth or flat side nothing
    tells where, between its last particle and the next: its integrals are of first order there. Over the domain the
    normals are NaN; over the domain of a cloud of several regions the rules of all stand one after another; over an
    interface ``"a|b"`` the normals point from a to b.

    Parameters
    ----------
    cloud : Cloud
        The particles.
    group : str, optional
        The name of a boundary group; the domain if not given.
    degree : int
        Of the polynomials that are integrated exactly.

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
    return rule(cloud, group, degree)


def rule(cloud: Cloud, group: str | None, degree: int, otherwise: bool = False) -> Quadrature:
    """The points and weights of ``quadrature``; otherwise: those of another rule, whose difference tells its error."""
    if not is_whole(degree, 1):
        raise ValueError(f"degree: expected a whole number from 1, got {degree!r}")
    if not isinstance(cloud, Cloud):
        raise ValueError(f"cloud: expected a js.Cloud, got {type(cloud).__name__}")
    if group is not None and not isinstance(group, str):
        raise ValueError(f"group: expected the name of a boundary group, got {group!r}")
    if isinstance(cloud, RegionCloud):
        return _of_regions(cloud, group, degree, otherwise)
    if group is None:
        at, weights = domain_rule(cloud, int(degree), otherwise)
        return Quadrature(at, weights, np.full(at.shape, np.nan))
    if group not in cloud.groups or group == "interior":
        known = ", ".join(repr(name) for name in cloud.groups if name != "interior")
        raise ValueError(f"group: expected a boundary group ({known}), got {group!r}")
    named = np.zeros(len(cloud), bool)
    named[np.asarray(cloud.groups[group])] = True
    if cloud.dim == 1:
        ends, normal = boundary_facets(cloud)
        here = ends[named[ends[:, 0]], 0]
        return Quadrature(np.asarray(cloud.points, float)[here], np.ones(len(here)), normal[named[ends[:, 0]]])
    return Quadrature(*surface_rule(cloud, named, _members(cloud, named), int(degree), otherwise))


def _of_regions(cloud: RegionCloud, group: str | None, degree: int, otherwise: bool) -> Quadrature:
    """That of all regions together; of an interface once, with its normals from the first region to the second."""
    parts = [cloud.region(name) for name in cloud.regions]
    if group in cloud.interfaces:
        parts = [cloud.region(sides(str(group))[0])]
    elif group is not None:
        parts = [part for part in parts if group in part.groups] or parts[:1]
    made = [rule(part, group, degree, otherwise) for part in parts]
    return Quadrature(*(np.concatenate(arrays) for arrays in zip(*made)))


def _members(cloud: Cloud, named: np.ndarray) -> Members:
    """Tells which points of the boundary, with their normals, belong to the group of the particles named (N,): those
    whose nearest particle with a normal like theirs does.

    At edges and corners of the domain all corners of a facet may be of other groups. Without
    normals, or with none alike, most of its corners decide.
    """
    if cloud.normals is None:
        return lambda at, normal, most: most
    from scipy.spatial import cKDTree

    points, own, rim = np.asarray(cloud.points), np.asarray(cloud.normals), cloud.boundary
    rim = rim[~_strays(cloud, rim)]
    tree, count = cKDTree(points[rim]), min(_AROUND, len(rim))

    def members(at: np.ndarray, normal: np.ndarray, most: np.ndarray) -> np.ndarray:
        near = rim[tree.query(at, k=range(1, count + 1))[1]]
        alike = np.nan_to_num(np.sum(own[near] * normal[:, None], axis=2), nan=-1.0) >= SMOOTH
        first = np.take_along_axis(near, alike.argmax(axis=1)[:, None], axis=1)[:, 0]
        return np.where(alike.any(axis=1), named[first], most)

    return members


def _strays(cloud: Cloud, rim: np.ndarray) -> np.ndarray:
    """Mask of the boundary particles that look where another group around does, and no other of their own.

    A predicate with a tolerance claims such particles a hair beyond an edge: they say nothing of the side they are on.
    """
    from scipy.spatial import cKDTree

    points, own, label = np.asarray(cloud.points)[rim], np.asarray(cloud.normals)[rim], np.empty(len(cloud), int)
    for k, ids in enumerate(cloud.groups.values()):
        label[ids] = k
    near = cKDTree(points).query(points, k=range(2, min(_BESIDE[cloud.dim], len(rim)) + 1))[1]
    same = label[rim][near] == label[rim][:, None]
    alike = np.nan_to_num(np.einsum("bkd,bd->bk", own[near], own), nan=-1.0) >= SMOOTH
    return same.any(axis=1) & ~(same & alike).any(axis=1) & (~same & alike).any(axis=1)
