"""Integrals over the domain and its boundary: Gauss points in the simplices between the particles and in thin layers.

Between a facet of the outermost simplices and a curved boundary lies a thin layer, swept along the particles' normals,
interpolated, so that neighbouring layers fit together; it ends on the boundary. That is the zero level of the shape
where the cloud knows it, else the graph, over the plane of the facet, of the polynomial through the boundary particles
around it. Facets that reach across an edge of a known solid are for ``integrals.edges``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.integrals.edges import SMOOTH, open_ways, over_edges
from jsmitsm.cloud.integrals.swept import Swept, simplex_rule
from jsmitsm.cloud.triangulation import boundary_facets, lying_on, normals_of, simplices
from jsmitsm.taylor.multi_indices import multi_indices

# Which points (Q, D) belong to a group, by their normals (Q, D) and whether (Q,) most corners of their facet do.
Members = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
_STEPS = 8
# Heights over a facet, in sizes of its surroundings, and differences of normals, that are round-off.
_FLAT = 1e-9
# The boundary is at most so many widths of a facet away, and its normal at such an angle (its cosine) to the way there.
_FAR, _STEEP = 0.5, 0.1
# No polynomial is followed farther than so many sizes of its surroundings.
_ASTRAY = 10.0
# A way that meets the boundary at a smaller angle (its cosine) would count for too much.
_GRAZING = 0.02
# Gauss points more along a facet, of the rule that tells the error of the first.
_MORE = 2


def domain_rule(cloud: Cloud, degree: int, otherwise: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Points (Q, D) and weights (Q,) for integrals over the domain of functions that polynomials of a degree follow.

    otherwise: by a rule that follows the boundary in another way, whose difference tells the error of the first; so
    too in ``surface_rule``.
    """
    points = np.asarray(cloud.points, float)
    at, weights = simplex_rule(cloud.dim, degree // 2 + 1)
    corners = points[simplices(cloud)]
    sides = corners[:, 1:] - corners[:, :1]
    volume = np.abs(np.linalg.det(sides))
    inner = np.einsum("qk,mkd->mqd", at, corners), volume[:, None] * weights
    inner = inner[0].reshape(-1, cloud.dim), inner[1].ravel()
    return inner if cloud.dim == 1 else tuple(map(np.concatenate, zip(inner, _layers(cloud, degree, otherwise))))  # type: ignore


def surface_rule(
    cloud: Cloud, named: np.ndarray, members: Members, degree: int, otherwise: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (Q, D), weights (Q,) and unit normals (Q, D) on the part of the boundary with the particles named (N,)."""
    facets, normal = boundary_facets(cloud)
    ways, near = _ways(cloud, facets, normal)
    most = named[facets].sum(axis=1) * 2 > facets.shape[1]
    own = members(np.asarray(cloud.points, float)[facets].mean(axis=1), normal, most)
    found = []
    if otherwise and (cut := _cutting(cloud, facets, normal)).any():
        own, cut = own & ~cut, cut & named[facets].any(axis=1)
        found.append(list(_shadows(cloud, named, facets[cut], normal[cut], degree)))
    # Facets of another part may reach across an edge to this one.
    some = np.flatnonzero(own | near)
    for swept, which in _swept(cloud, facets[some], normal[some], ways[some], degree, otherwise):
        at, volume = swept.at(1.0)
        # A layer that ends at the surface is as thick as the way's part along the normal.
        steep = np.einsum("mqd,mqd->mq", swept.way, swept.outward)
        weights = volume / np.copysign(np.maximum(np.abs(steep), _GRAZING), steep)
        apart = at.shape[1] == 1  # their points may lie on different sides of an edge
        mine = members(at[:, 0], swept.outward[:, 0], most[some[which]]) if apart else own[some[which]]
        found.append([x[mine].reshape(-1, *x.shape[2:]) for x in (at, weights, swept.outward)])
    return tuple(np.concatenate(part) for part in zip(*found))  # type: ignore


def _cutting(cloud: Cloud, facets: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Which facets (M, D) cut off an edge of a solid whose shape is not known: they look elsewhere than a corner."""
    if cloud._shape is not None or cloud.dim < 3:
        return np.zeros(len(facets), bool)
    return (np.einsum("mkd,md->mk", normals_of(cloud)[facets], normal) < SMOOTH).any(axis=1)


def _shadows(
    cloud: Cloud, named: np.ndarray, facets: np.ndarray, normal: np.ndarray, degree: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, weights and normals of facets (M, 3) that cut edges off, by their shadows on the side of their corners
    named: what a flat side lacks up to its edge."""
    corners = np.asarray(cloud.points, float)[facets]
    at, weights = simplex_rule(2, degree // 2 + 1)
    side = np.einsum("mkd,mk->md", np.nan_to_num(normals_of(cloud)[facets]), named[facets].astype(float))
    side = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-300)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    shadow = area * np.maximum(np.einsum("md,md->m", side, normal), 0.0)
    spots = np.einsum("qk,mkd->mqd", at, corners).reshape(-1, 3)
    return spots, (shadow[:, None] * weights).ravel(), np.repeat(side, len(at), axis=0)


def _layers(cloud: Cloud, degree: int, otherwise: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points (Q, D) and signed weights (Q,) between the facets and the boundary."""
    facets, normal = boundary_facets(cloud)
    ways, near = _ways(cloud, facets, normal)
    layered = near | ~lying_on(cloud, facets)
    if otherwise:
        layered &= ~_cutting(cloud, facets, normal)
    some = np.flatnonzero(layered)
    found, measure = [np.zeros((0, cloud.dim))], [np.zeros(0)]
    x, w = np.polynomial.legendre.leggauss(degree // 2 + 1)
    for swept, _ in _swept(cloud, facets[some], normal[some], ways[some], degree, otherwise):
        for share, part in zip((x + 1.0) / 2.0, w / 2.0):
            here, volume = swept.at(share)
            found.append(here.reshape(-1, cloud.dim))
            measure.append((part * swept.reach * volume).ravel())
    return np.concatenate(found), np.concatenate(measure)


def _ways(cloud: Cloud, facets: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The ways (M, D, D) from the corners of all facets (M, D), and which (M,) come near an edge of a known shape."""
    own = normals_of(cloud)
    if cloud._shape is not None and cloud.dim == 3:
        return open_ways(np.asarray(cloud.points, float), facets, normal, own)
    flat = np.broadcast_to(normal[:, None], (*facets.shape, cloud.dim))
    alike = np.sum(own[facets] * flat, axis=2) >= SMOOTH
    return np.where(alike[..., None], own[facets], flat), np.zeros(len(facets), bool)


def _swept(
    cloud: Cloud, facets: np.ndarray, normal: np.ndarray, ways: np.ndarray, degree: int, otherwise: bool
) -> list[tuple[Swept, np.ndarray]]:
    """The ways from facets (M, D) with outward normals (M, D) to the boundary, and which facets they are from.

    Where it is not smooth over facets of a solid whose shape is known, they come last, a point a row.
    """
    if cloud._shape is None or cloud.dim < 3:
        return [(_over_sides(cloud, facets, normal, ways, degree, otherwise)[0], np.arange(len(facets)))]
    own = (np.einsum("mkd,md->mk", normals_of(cloud)[facets], normal) >= SMOOTH).all(axis=1)
    some = np.flatnonzero(own)
    swept, good = _over_sides(cloud, facets[some], normal[some], ways[some], degree, otherwise)
    good &= (np.einsum("mqd,mrd->mqr", swept.outward, swept.outward) >= SMOOTH).all(axis=(1, 2))
    kept = Swept(*(x if x is swept.weights else x[good] for x in swept))
    rest = np.concatenate([np.flatnonzero(~own), some[~good]])
    corners = np.asarray(cloud.points, float)[facets[rest]]
    parted, of = over_edges(cloud._shape, corners, ways[rest], normal[rest], degree, otherwise)
    return [(kept, some[good]), (parted, rest[of])]


def _over_sides(
    cloud: Cloud, facets: np.ndarray, normal: np.ndarray, ways: np.ndarray, degree: int, otherwise: bool
) -> tuple[Swept, np.ndarray]:
    """The ways to a boundary that is smooth over each facet, and over which facets (M,) it was found so."""
    corners = np.asarray(cloud.points, float)[facets]
    # An even number: the middle of a side is as near to one particle as to the other, whose polynomials differ there.
    at, weights = simplex_rule(cloud.dim - 1, 2 * (degree // 4 + 1) + _MORE * otherwise)
    base, way = (np.einsum("qk,mkd->mqd", at, x) for x in (corners, ways))
    # Where the shape is known the graph is the start of the way there only.
    graph = _graphs(cloud, corners, facets, normal, degree if cloud._shape is None else min(degree, 4))
    reach, outward, good = _to_shape(cloud, base, way, normal, *graph(base, way))
    # No boundary is so far from a facet: polynomials of particles across a gap, or around a sharp corner, go astray.
    width = np.linalg.norm(np.ptp(corners, axis=1), axis=1)[:, None]
    sane = (np.abs(reach) <= _FAR * width) & (np.einsum("mqd,mqd->mq", way, outward) >= _STEEP)
    sane = sane.all(axis=1)
    reach, outward = np.where(sane[:, None], reach, 0.0), np.where(sane[:, None, None], outward, normal[:, None])
    sides, turns = (x[:, 1:] - x[:, :1] for x in (corners, ways))
    handed = np.sign(np.linalg.det(np.concatenate([sides, normal[:, None]], axis=1)))
    return Swept(base, way, reach, weights, sides, turns, handed[:, None], outward), good & sane


def _graphs(cloud: Cloud, corners: np.ndarray, facets: np.ndarray, normal: np.ndarray, degree: int):
    """How far from points of the facets, along given ways, the boundary is: a function of both (M, Q, D) -> (M, Q)."""
    from scipy.spatial import cKDTree

    points, rim, dim = np.asarray(cloud.points, float), cloud.boundary, cloud.dim
    middle = corners.mean(axis=1)
    tangents = np.linalg.svd(normal[:, None])[2][:, 1:]  # (M, D - 1, D)
    some = np.array(multi_indices(dim - 1, degree))
    count = min(len(rim), degree + 2 if dim == 2 else 2 * len(some))
    distance, near = cKDTree(points[rim]).query(middle, k=range(1, count + 1))
    near = rim[near]
    own = np.nan_to_num(normals_of(cloud)[near])
    alike = np.einsum("mkd,md->mk", own, normal) > 0.5
    # A facet's own corners are on its side, whatever normal they have.
    alike |= (near[:, :, None] == facets[:, None, :]).any(axis=2)
    size = np.where(alike, distance, 0.0).max(axis=1)
    size = np.where(size > 0.0, size, 1.0)  # nobody around looks where the facet does: it is flat
    offset = (points[near] - middle[:, None]) / size[:, None, None]
    place, level = np.einsum("mkd,mtd->mkt", offset, tangents), np.einsum("mkd,md->mk", offset, normal)
    weight = np.where(alike, np.exp(-((1.5 * distance / size[:, None]) ** 2)), 0.0)
    matrix = np.prod(place[:, :, None] ** some, axis=3) * weight[..., None]
    fitted = np.einsum("mak,mk->ma", np.linalg.pinv(matrix, rcond=1e-10), weight * level)
    # A particle in the facet's plane that looks where the facet does: the side is flat, whatever is round the corner.
    flat = (np.abs(level) < _FLAT) & (np.abs(own - normal[:, None]).max(axis=2) < _FLAT)
    fitted[flat.any(axis=1) | (np.abs(weight * level).max(axis=1) < 1e-13)] = 0.0

    def reach(base: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        t = np.zeros(base.shape[:2])
        for _ in range(_STEPS):
            at = (base + t[..., None] * way - middle[:, None]) / size[:, None, None]
            xi, rise = np.einsum("mqd,mtd->mqt", at, tangents), np.einsum("mqd,md->mq", at, normal)
            miss = rise - np.einsum("mqa,ma->mq", np.prod(xi[:, :, None] ** some, axis=3), fitted)
            t = t - miss * size[:, None] / np.einsum("mqd,md->mq", way, normal)
            t = np.clip(t, -_ASTRAY * size[:, None], _ASTRAY * size[:, None])
        unit = np.eye(dim - 1, dtype=int)
        powers = [b * np.prod(xi[:, :, None] ** np.maximum(some - e, 0), axis=3) for e, b in zip(unit, some.T)]
        slope = np.einsum("tmqa,ma->mqt", powers, fitted)
        outward = normal[:, None] - np.einsum("mqt,mtd->mqd", slope, tangents)
        return t, outward / np.linalg.norm(outward, axis=2, keepdims=True)

    return reach


def _to_shape(
    cloud: Cloud, base: np.ndarray, way: np.ndarray, normal: np.ndarray, reach: np.ndarray, outward: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far it is to the boundary, and its normals, by the shape where the cloud knows it: the graph came close.

    Also for which facets (M,) it did; for all where no shape is known.
    """
    if cloud._shape is None or not len(base):
        return reach, outward, np.ones(len(base), bool)

    def off(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distance, direction = cloud._shape.distance((base + t[..., None] * way).reshape(-1, cloud.dim))
        return distance.reshape(t.shape), direction.reshape(base.shape)

    near = 1e-10 * np.ptp(base, axis=(0, 1)).max()
    straight = (np.abs(off(np.zeros_like(reach))[0]) < near).all(axis=1, keepdims=True)
    t = reach
    for _ in range(_STEPS):
        miss, own = off(t)
        steep = np.einsum("mqd,mqd->mq", own, way)
        if np.abs(miss).max() < 1e-4 * near:
            break
        t = t - miss / np.where(steep > 0.1, steep, np.inf)
    # Where the shape has ridges, or the polynomial went astray, the graph stays.
    width = np.linalg.norm(np.ptp(base, axis=1), axis=1)[:, None]
    good = ((np.abs(miss) < near) & (steep > 0.1) & (np.abs(t - reach) < 0.3 * width)).all(axis=1, keepdims=True)
    t, outward = np.where(good, t, reach), np.where(good[..., None], own, outward)
    t, outward = np.where(straight, 0.0, t), np.where(straight[..., None], normal[:, None], outward)
    return t, outward, (good | straight)[:, 0]
