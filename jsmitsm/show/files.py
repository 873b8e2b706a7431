"""Clouds from meshes, polygons and tables; solutions to meshes, data frames and data sets.

The libraries are optional extras, imported when a function needs them: ``pip install "jsmitsm[mesh]"`` for meshio
and shapely, ``pip install "jsmitsm[tables]"`` for pandas and xarray. CSV needs nothing.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.cloud.mesh_facets import Mesh
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.cloud.shapes import from_polygon
from jsmitsm.cloud.triangulation import simplices
from jsmitsm.runtime.errors import refuse_masked
from jsmitsm.show.mesh_cloud import cloud_of
from jsmitsm.show.mesh_files import needed, read_mesh
from jsmitsm.show.mesh_regions import regions_of
from jsmitsm.solution.solution import Solution

__all__ = ["from_csv", "from_mesh", "from_shapely", "to_csv", "to_mesh", "to_pandas", "to_xarray"]

_AXES = "xyz"
_CELLS = {1: "line", 2: "triangle", 3: "tetra"}


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
    >>> mesh = meshio.Mesh(corners, [("triangle", [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]),
    ...                              ("line", [[0, 1], [1, 2]])], cell_data={"gmsh:physical": [[7] * 4, [1, 2]]},
    ...                    field_data={"bottom": np.array([1, 1]), "side": np.array([2, 1])})
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
    >>> sorted(js.files.from_shapely(shapely.box(0, 0, 2, 1).difference(shapely.Point(1, 0.5).buffer(0.2)), 0.1).groups)
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


def from_csv(path: Any) -> Cloud:
    """A cloud from a CSV file with a header; ``js.files.to_csv`` writes such files.

    Columns ``x`` (``y``, ``z``) and ``group``; normals in ``nx`` (``ny``, ``nz``) where there are any, empty in the
    interior. Other columns are ignored.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    Cloud
        With the groups of the file.

    Raises
    ------
    ValueError
        For a column that is missing or comes twice, and a cell that is no number, with its line.

    Examples
    --------
    >>> import os, tempfile, jsmitsm as js
    >>> path = os.path.join(tempfile.mkdtemp(), "cloud.csv")
    >>> js.files.to_csv(js.interval(0.0, 1.0, 3), path)
    >>> js.files.from_csv(path)
    Cloud(3 particles in 1D, groups {interior: 1, left: 1, right: 1})
    """
    try:
        with open(_a_path(path), newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, skipinitialspace=True, strict=True)
            lines = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"path: {path} is no text in UTF-8 ({error}); save it as CSV in UTF-8") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"path: cannot read {path!r} ({error}); give the path of a CSV file") from None
    if len(lines) < 2:
        raise ValueError(f"path: {path} has no rows below its header")
    header = [name.strip() for name in lines[0][1]]
    if "region" in header:
        raise ValueError(f"path: {path} holds several regions, whose pairs CSV does not tell; pickle the cloud instead")
    axes = [name for name in _AXES if name in header]
    normals = [f"n{name}" for name in axes]
    if "group" not in header or "".join(axes) not in ("x", "xy", "xyz"):
        raise ValueError(f"path: {path} has the columns {header}; expected x (and y, z) and group")
    twice = [name for name in dict.fromkeys(header) if header.count(name) > 1 and name in (*axes, *normals, "group")]
    if twice:
        raise ValueError(f"path: {path} has several columns of the name {twice[0]!r}; keep one")
    if 0 < sum(name in header for name in normals) < len(axes):
        raise ValueError(f"path: {path} has the columns {header}; expected all of {normals} for normals, or none")
    for line, row in lines:
        if any(cell.strip() for cell in row[len(header) :]):
            raise ValueError(
                f"path: {path}, line {line}: has {len(row)} cells under {len(header)} columns; write one under each, "
                "numbers with a point"
            )
    rows = [(line, dict(zip(header, row))) for line, row in lines[1:]]
    points = _numbers(rows, axes, path)
    names = [row.get("group", "").strip() for _, row in rows]
    for (line, _), name in zip(rows, names):
        if not name or (name != INTERIOR and name.lower() == INTERIOR):
            raise ValueError(
                f"path: {path}, line {line}: has {f'the group {name!r}' if name else 'no group'}; expected "
                f"{INTERIOR} or the name of a side"
            )
    groups = {name: np.flatnonzero([n == name for n in names]) for name in dict.fromkeys([INTERIOR, *names])}
    return Cloud(points, groups, _numbers(rows, normals, path) if normals[0] in header else None)


def to_csv(what: Cloud | Solution, path: Any) -> None:
    """Write a cloud, or a solution with its cloud, as CSV: coordinates, group, normals and the values ``u``.

    Numbers are written so that they read back to the last bit; cell groups are not written.

    Parameters
    ----------
    what : Cloud or Solution
        What is written.
    path : str or path
        The file; one that exists is overwritten.

    Raises
    ------
    ValueError
        For groups whose names would not read back, and a file that cannot be written.

    Examples
    --------
    >>> import os, tempfile, jsmitsm as js
    >>> js.files.to_csv(js.interval(0.0, 1.0, 3), os.path.join(tempfile.mkdtemp(), "cloud.csv"))
    """
    columns = _columns(_a_kind(what, (Cloud, Solution), "what"))
    for name in set(columns["group"]):
        if name != name.strip() or not name or (name != INTERIOR and name.lower() == INTERIOR):
            raise ValueError(f"what: the name {name!r} of a group would not read back from CSV; rename the group")
    try:
        with open(_a_path(path), "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            for row in zip(*columns.values()):
                writer.writerow(["" if v != v else v if isinstance(v, str) else repr(float(v)) for v in row])
    except OSError as error:
        raise ValueError(f"path: cannot write {path!r} ({error}); give the path of a file in a folder") from None


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
    >>> sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), ends), js.interval(0.0, 1.0, 9))
    >>> js.files.to_mesh(sol).point_data["u"].shape
    (9,)
    """
    meshio = needed("meshio", "mesh")
    cloud = _a_kind(sol, (Solution,), "sol").cloud
    points = np.zeros((len(cloud), 3))
    points[:, : cloud.dim] = cloud.points
    data = {"u": np.asarray(sol.u)} | _per_particle(more, len(cloud), (1, 2))
    cells, tags = simplices(cloud), {}
    if isinstance(cloud, RegionCloud):
        number = np.zeros(len(cloud), int)
        for k, ids in enumerate(cloud.regions.values()):
            number[ids] = k
        data["region"], tags["region"] = number, [number[cells[:, 0]]]
    return meshio.Mesh(points, [(_CELLS[cloud.dim], cells)], point_data=data, cell_data=tags)


def to_pandas(what: Cloud | Solution, **more: Any) -> Any:
    """A cloud, or a solution with its cloud, as a table of one row per particle.

    Needs pandas: ``pip install "jsmitsm[tables]"``.

    Parameters
    ----------
    what : Cloud or Solution
        What is written.
    **more : array_like (N,)
        Further columns.

    Returns
    -------
    pandas.DataFrame
        Coordinates, group, normals, and ``u`` (``u0``, ``u1``, ... for a system).

    Raises
    ------
    ValueError
        For columns of another length or of a name that is taken.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.files.to_pandas(js.interval(0.0, 1.0, 3)).group.tolist()
    ['left', 'interior', 'right']
    """
    columns = _columns(_a_kind(what, (Cloud, Solution), "what"))
    return needed("pandas", "tables").DataFrame({**columns, **_per_particle(more, len(columns["x"]), (1,), columns)})


def to_xarray(sol: Solution, **more: Any) -> Any:
    """A solution as a data set over the dimension ``particle`` (and ``field`` for a system).

    Needs xarray: ``pip install "jsmitsm[tables]"``.

    Parameters
    ----------
    sol : Solution
        What is written.
    **more : array_like (N,)
        Further variables.

    Returns
    -------
    xarray.Dataset
        Coordinates and groups as coordinates, method and order as attributes.

    Raises
    ------
    ValueError
        For variables of another length or of a name that is taken.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    >>> sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), ends), js.interval(0.0, 1.0, 9))
    >>> js.files.to_xarray(sol).u.sizes["particle"]
    9
    """
    xarray = needed("xarray", "tables")
    columns = _columns(_a_kind(sol, (Solution,), "sol").cloud)
    more = _per_particle(more, len(sol.cloud), (1,), columns)
    dims = ("particle", "field")[: np.ndim(sol.u)]
    return xarray.Dataset(
        {"u": (dims, np.asarray(sol.u))} | {name: ("particle", value) for name, value in more.items()},
        coords={name: ("particle", column) for name, column in columns.items()},
        attrs={"method": sol.method, "order": sol.order, "converged": int(bool(sol.converged))},
    )


def _a_kind(what: Any, kinds: tuple[type, ...], name: str) -> Any:
    """``what``, or an error where it is none of ``kinds``."""
    if not isinstance(what, kinds):
        wanted = " or ".join(f"js.{kind.__name__}" for kind in kinds)
        raise ValueError(f"{name}: expected a {wanted}, got {type(what).__name__}")
    if isinstance(what, Solution):
        what.refuse_stacked()
    return what


def _per_particle(more: Mapping[str, Any], count: int, dims: tuple[int, ...], taken: Any = ()) -> dict[str, np.ndarray]:
    """Further columns as arrays with a row for every particle."""
    out = {}
    for name, value in more.items():
        refuse_masked(value, name)
        array = np.asarray(value)
        if array.ndim not in dims or len(array) != count or array.dtype.kind == "O":
            what = " of Python's objects (missing values?)" if array.dtype.kind == "O" and array.ndim else ""
            raise ValueError(
                f"{name}: values of shape {array.shape} came{what}, expected {count}, one per particle"
                + (", or rows of them" if 2 in dims else "")
            )
        if name in taken:
            raise ValueError(f"{name}: is a column already ({', '.join(taken)}); give it another name")
        out[name] = array
    return out


def _columns(what: Cloud | Solution) -> Mapping[str, np.ndarray]:
    """One column per coordinate, the group, the normals and the values."""
    cloud = what.cloud if isinstance(what, Solution) else what
    columns = {name: np.asarray(cloud.points)[:, k] for k, name in enumerate(_AXES[: cloud.dim])}
    group = np.empty(len(cloud), dtype=object)
    for name, index in cloud.groups.items():
        group[index] = name
    columns["group"] = group
    if isinstance(cloud, RegionCloud):
        columns["region"] = _region_names(cloud)
    if cloud.normals is not None:
        columns |= {f"n{name}": np.asarray(cloud.normals)[:, k] for k, name in enumerate(_AXES[: cloud.dim])}
    if isinstance(what, Solution):
        u = np.asarray(what.u)
        columns |= {"u": u} if u.ndim == 1 else {f"u{k}": u[:, k] for k in range(u.shape[1])}
    return columns


def _region_names(cloud: RegionCloud) -> np.ndarray:
    """The region (N,) of every particle."""
    out = np.empty(len(cloud), dtype=object)
    for name, ids in cloud.regions.items():
        out[ids] = name
    return out


def _numbers(rows: list[tuple[int, dict[str, str]]], names: list[str], path: Any) -> np.ndarray:
    """Columns of a table (N, len(names)); an empty cell is NaN."""
    table = np.empty((len(rows), len(names)))
    for i, (line, row) in enumerate(rows):
        for k, name in enumerate(names):
            cell = row.get(name, "").strip()
            try:
                if "_" in cell:  # 1_000 is a number of Python's alone
                    raise ValueError
                table[i, k] = float(cell) if cell else np.nan
            except ValueError:
                raise ValueError(f"path: {path}, line {line}: {name} = {cell!r} is no number") from None
    return table


def _a_path(path: Any) -> Any:
    """``path``, or an error: a number would be taken for an open file of the program's."""
    if not isinstance(path, (str, bytes, os.PathLike)):
        raise ValueError(f"path: cannot read or write {path!r}, a {type(path).__name__}; give the path of a CSV file")
    return path
