"""How evenly the particles of a cloud lie: fill distance, separation distance, mesh ratio."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jsmitsm.cloud import filling
from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.runtime.errors import explaining


class Quality(NamedTuple):
    """How evenly the particles of a cloud lie; made by ``js.quality``.

    Attributes
    ----------
    fill : float
        Radius of the largest empty ball in the domain over the local spacing (0.58 for hexagons).
    separation : float
        Smallest distance of a pair over the local spacing (1 for any lattice).
    mesh_ratio : float
        fill / (separation / 2): 1.15 for hexagons, below 2 is even, above 4 is poor.
    evenness : float
        The least over the mean nearest distance, in local spacings.
    fill_distance, separation_distance : float
        The first two in length units (Wendland, Scattered Data Approximation, 2005, has half the latter).

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.quality(js.interval(0.0, 1.0, 11)).mesh_ratio > 0.9
    True
    """

    fill: float
    separation: float
    mesh_ratio: float
    evenness: float
    fill_distance: float
    separation_distance: float

    def __repr__(self) -> str:
        return f"Quality({', '.join(f'{name}={value:.3g}' for name, value in self._asdict().items())})"


@explaining
def quality(cloud: Cloud, spacing: filling.SpacingLike | None = None) -> Quality:
    """How evenly the particles of a cloud lie, measured in local spacings so that graded clouds count alike.

    Parameters
    ----------
    cloud : Cloud
        With normals the boundary is told exactly; without them the domain is taken to be convex. Of several regions
        the worst of each measure counts.
    spacing : float or function, optional
        A number or a function (M, D) -> (M,); by default the mean nearest distance near each particle.

    Returns
    -------
    Quality
        A named tuple.

    Raises
    ------
    ValueError
        For fewer than D + 2 particles, and normals that point inward.

    Examples
    --------
    >>> import jsmitsm as js
    >>> round(js.quality(js.rectangle((0, 0), (1, 1), (11, 11))).mesh_ratio, 3)
    1.414
    """
    if not isinstance(cloud, Cloud):
        raise ValueError(f"cloud: expected a js.Cloud, got {type(cloud).__name__}")
    if isinstance(cloud, RegionCloud):
        parts = [quality(cloud.region(name), spacing) for name in cloud.regions]
        least = ("separation", "evenness", "separation_distance")
        worst = {name: (min if name in least else max)(getattr(q, name) for q in parts) for name in Quality._fields}
        return Quality(**worst)
    from scipy.spatial import cKDTree

    points = np.asarray(cloud.points)
    dim = points.shape[1]
    if len(points) < dim + 2:
        raise ValueError(f"cloud: {len(points)} particles, at least {dim + 2} are needed to measure how they lie")
    tree = cKDTree(points)
    gap, near = tree.query(points, k=min(4 * dim + 1, len(points)))
    nearest = gap[:, 1]
    local = nearest[near].mean(axis=1) if spacing is None else filling.spacing_function(spacing)(points)
    if dim == 1:
        order = np.argsort(points[:, 0])
        radii, vertices = np.diff(points[order, 0]) / 2, np.stack([order[:-1], order[1:]], axis=1)
        if cloud.normals is not None:  # no gap of the domain begins where a normal points right
            inside = ~(np.asarray(cloud.normals)[order[:-1], 0] > 0)
            radii, vertices = radii[inside], vertices[inside]
    else:
        centers, radii, vertices, mesh = _circumspheres(points)
        inside = np.asarray(np.isin(vertices, cloud.groups[INTERIOR]).any(axis=1))
        inside[inside] = _in_domain(cloud, centers[inside], mesh)
        if not inside.any():
            raise ValueError("cloud: no empty ball lies in the domain; do the normals point outward?")
        radii, vertices = radii[inside], vertices[inside]
    fill = float((radii / local[vertices].mean(axis=1)).max())
    relative = nearest / local
    return Quality(
        fill,
        float(relative.min()),
        2.0 * fill / float(relative.min()),
        float(relative.min() / relative.mean()),
        float(radii.max()),
        float(nearest.min()),
    )


def _in_domain(cloud: Cloud, centers: np.ndarray, mesh: Any) -> np.ndarray:
    """Whether circumcentres lie in the convex hull and, by the normal of the nearest boundary particle, the domain."""
    from scipy.spatial import cKDTree

    inside = mesh.find_simplex(centers) >= 0
    if cloud.normals is not None and len(cloud.boundary):
        points, outward = np.asarray(cloud.points)[cloud.boundary], np.asarray(cloud.normals)[cloud.boundary]
        which = cKDTree(points).query(centers)[1]
        inside &= np.einsum("md,md->m", centers - points[which], outward[which]) < 0
    return inside


def _circumspheres(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, Any]:
    """Centres (T, D), radii (T,) and vertices (T, D + 1) of the Delaunay simplices, and the triangulation.

    These are the largest balls without particles.
    """
    from scipy.spatial import Delaunay, QhullError

    try:
        mesh = Delaunay(points)
    except QhullError as error:
        raise ValueError(
            f"points: {len(points)} particles in {points.shape[1]}D span no simplex (all on one line or plane?)"
        ) from error
    simplices = mesh.simplices
    corner = points[simplices]
    edges = corner[:, 1:] - corner[:, :1]
    volume = np.linalg.det(edges)
    size = np.prod(np.linalg.norm(edges, axis=2), axis=1)
    solid = np.abs(volume) > 1e-6 * size  # slivers have no centre to speak of
    corner, edges = corner[solid], edges[solid]
    offset = np.linalg.solve(2.0 * edges, np.einsum("tid,tid->ti", edges, edges)[..., None])[..., 0]
    return corner[:, 0] + offset, np.linalg.norm(offset, axis=1), simplices[solid], mesh
