"""Clouds from meshes, polygons and tables; solutions to meshes, data frames and data sets.

The libraries are optional extras, imported when a function needs them: ``pip install "jsmitsm[mesh]"`` for meshio
and shapely, ``pip install "jsmitsm[tables]"`` for pandas and xarray. CSV needs nothing.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.mesh_facets import Mesh
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.cloud.shapes import from_polygon
from jsmitsm.cloud.triangulation import simplices
from jsmitsm.runtime.errors import explaining
from jsmitsm.show.mesh_cloud import cloud_of
from jsmitsm.show.mesh_files import needed, read_mesh
from jsmitsm.show.mesh_regions import regions_of
from jsmitsm.show.series import to_pvd
from jsmitsm.show.tables import a_kind, from_csv, per_particle, to_csv, to_pandas, to_xarray
from jsmitsm.solution.solution import Solution

__all__ = ["from_csv", "from_mesh", "from_shapely", "to_csv", "to_mesh", "to_pandas", "to_pvd", "to_xarray"]


def __dir__() -> list[str]:
    return __all__

_AXES = "xyz"
_CELLS = {1: "line", 2: "triangle", 3: "tetra"}


@explaining
def from_mesh(mesh: Any, tags: str | None = None, *, regions: bool | list[str] = False) -> Cloud:
    """The nodes of a mesh as particles, boundary groups from its physical tags, normals from its boundary facets.

    Parameters
    ----------
    mesh : meshio.Mesh or path
        A ``meshio.Mesh``, or the path of a file: SU2 and Abaqus or CalculiX (.inp), what meshio reads besides
        (Gmsh, VTK, XDMF, ...). Lines, triangles, quadrilaterals, tetrahedra, hexahedra, wedges and pyramids, of
        first and of second order. The cells of the highest dimension are the domain; nodes that none of them uses
        are dropped.
    tags : str or list of str, optional
        The name of the cell data that hold the groups; found by itself for Gmsh (``gmsh:physical``, names from its
        physical groups), Medit and others, whose groups are cell sets or point sets. Or a list of the names of
        groups: those alone, the first first.
    regions : bool or sequence of str
        True, or the names of the cells' tags in their order: a cloud of several regions, see ``js.regions``. Nodes
        between two of them are copied, and their normals are those of the facets there.

    Returns
    -------
    Cloud
        Groups ``"interior"`` and one for every tag of boundary facets and every set of boundary nodes. A node of
        several belongs to the one named first, but a set that holds another whole comes after it, and none goes
        away empty-handed; a boundary node of none belongs to ``"boundary"``. Normals are those of the group's
        facets, averaged by angle: on curved sides as exact as the facets follow them (those of second order are
        parabolas); ``cloud.replace(normals=...)`` takes better ones. What has a name and is no side (materials,
        lines inside, sets that reach inside) is in ``cloud.cell_groups``: indices by name, which may overlap.

    Raises
    ------
    ImportError
        Where a path is given and meshio is missing: ``pip install "jsmitsm[mesh]"``.
    ValueError
        For a mesh without cells, a surface in space, parts of several dimensions, an unknown kind of cell; for cells
        without volume, with crossing sides, folded or overlapping; for hanging nodes and nodes that were not merged;
        for a domain that touches itself in a point or an edge; for a group without a node of its own, and tags that do
        not exist or name nothing. Which way round the nodes of a cell run does not matter.

    Examples
    --------
    >>> import meshio, numpy as np, jsmitsm as js
    >>> corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]]
    >>> mesh = meshio.Mesh(
    ...     corners,
    ...     [
    ...         ("triangle", [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]),
    ...         ("line", [[0, 1], [1, 2]]),
    ...     ],
    ...     cell_data={"gmsh:physical": [[7] * 4, [1, 2]]},
    ...     field_data={"bottom": np.array([1, 1]), "side": np.array([2, 1])},
    ... )
    >>> js.files.from_mesh(mesh)
    Cloud(5 particles in 2D, groups {interior: 1, bottom: 2, side: 1, boundary: 1}, cell groups {7: 5})
    """
    if isinstance(mesh, (str, os.PathLike)):
        mesh = read_mesh(mesh)
    if not all(hasattr(mesh, name) for name in Mesh._fields):
        raise ValueError(f"mesh: expected a meshio.Mesh or the path of a mesh file, got {type(mesh).__name__}")
    if regions is not False:
        return regions_of(mesh, _tag_key(tags)[0], None if regions is True else list(regions))
    return cloud_of(mesh, *_tag_key(tags))


def _tag_key(tags: Any) -> tuple[str | None, list[str] | None]:
    """The cell data that hold the groups, or the groups themselves."""
    if tags is None or isinstance(tags, str):
        return tags, None
    if isinstance(tags, (list, tuple)) and tags and all(isinstance(name, str) for name in tags):
        return None, list(tags)
    raise ValueError(f"tags: expected the name of cell data, or a list of the names of groups, got {tags!r}")


@explaining
def from_shapely(polygon: Any, spacing: Any, seed: int = 0, groups: Any = None) -> Cloud:
    """Particles of a shapely ``Polygon`` with its holes; see ``js.from_polygon``.

    Parameters
    ----------
    polygon : shapely.Polygon or str
        Or its well-known text, which needs shapely: ``pip install "jsmitsm[mesh]"``. The parts of a
        ``MultiPolygon`` are solved one by one.
    spacing, seed, groups : optional
        As for ``js.from_polygon``.

    Returns
    -------
    Cloud
        Groups ``"boundary"`` and ``"hole0"``, ... unless ``groups`` names them.

    Raises
    ------
    ValueError
        For other geometries, and empty ones.

    Examples
    --------
    >>> import shapely, jsmitsm as js
    >>> sorted(
    ...     js.files.from_shapely(
    ...         shapely.box(0, 0, 2, 1).difference(shapely.Point(1, 0.5).buffer(0.2)),
    ...         0.1,
    ...     ).groups
    ... )
    ['boundary', 'hole0', 'interior']
    """
    if isinstance(polygon, str):
        shapely, text = needed("shapely", "mesh"), polygon
        try:
            polygon = shapely.from_wkt(text)
        except shapely.errors.ShapelyError as error:
            raise ValueError(
                f"polygon: {text!r} is no well-known text, as 'POLYGON ((0 0, 1 0, 0 1))' ({error})"
            ) from None
    if not (hasattr(polygon, "exterior") and hasattr(polygon, "interiors")):
        kind = getattr(polygon, "geom_type", type(polygon).__name__)
        raise ValueError(f"polygon: expected a shapely Polygon, got {kind}; of a MultiPolygon pass one of .geoms")
    if polygon.is_empty:
        raise ValueError("polygon: is empty, it has no inside to put particles in")
    holes = [np.asarray(hole.coords)[:, :2] for hole in polygon.interiors]
    return from_polygon(np.asarray(polygon.exterior.coords)[:, :2], spacing, holes=holes, seed=seed, groups=groups)


@explaining
def to_mesh(sol: Solution, **more: Any) -> Any:
    """The solution on a mesh of triangles (lines, tetrahedra) between its particles; holes stay open.

    ``to_mesh(sol).write("u.vtu")`` makes a file for ParaView. Needs meshio: ``pip install "jsmitsm[mesh]"``.

    Parameters
    ----------
    sol : Solution
        What is written.
    **more : array_like (N,) or (N, F)
        Further point data, as in ``to_mesh(sol, estimate=sol.error_estimate())``.

    Returns
    -------
    meshio.Mesh
        With ``u`` as point data.

    Raises
    ------
    ValueError
        For data of another length.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    >>> sol = js.solve(
    ...     js.Problem(lambda u, x: js.laplacian(u)(x), ends), js.interval(0.0, 1.0, 9)
    ... )
    >>> js.files.to_mesh(sol).point_data["u"].shape
    (9,)
    """
    meshio = needed("meshio", "mesh")
    cloud = a_kind(sol, (Solution,), "sol").cloud
    points = np.zeros((len(cloud), 3))
    points[:, : cloud.dim] = cloud.points
    data = {"u": np.asarray(sol.u)} | per_particle(more, len(cloud), (1, 2))
    cells, tags = simplices(cloud), {}
    if isinstance(cloud, RegionCloud):
        number = np.zeros(len(cloud), int)
        for k, ids in enumerate(cloud.regions.values()):
            number[ids] = k
        data["region"], tags["region"] = number, [number[cells[:, 0]]]
    return meshio.Mesh(points, [(_CELLS[cloud.dim], cells)], point_data=data, cell_data=tags)
