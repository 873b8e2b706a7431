"""Clouds from meshes, polygons and tables; solutions to meshes, data frames and data sets.

The libraries are optional extras, imported when a function needs them: ``pip install "jsmitsm[mesh]"`` for meshio
and shapely, ``pip install "jsmitsm[tables]"`` for pandas and xarray. CSV needs nothing.
"""

from __future__ import annotations

import csv
import importlib
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.cloud.mesh_facets import (
    boundary_normals,
    check_cells,
    named_facets,
    outer_facets,
    side_normals,
    volume_cells,
)
from jsmitsm.cloud.shapes import from_polygon
from jsmitsm.cloud.triangulation import simplices
from jsmitsm.solution.solution import Solution

__all__ = ["from_csv", "from_mesh", "from_shapely", "to_csv", "to_mesh", "to_pandas", "to_xarray"]

_AXES = "xyz"
_CELLS = {1: "line", 2: "triangle", 3: "tetra"}


def from_mesh(mesh: Any, tags: str | None = None) -> Cloud:
    """The nodes of a mesh as particles, boundary groups from its physical tags, normals from its boundary facets.

    Parameters
    ----------
    mesh : a ``meshio.Mesh``, or the path of a file that meshio reads (Gmsh, VTK, Abaqus, XDMF, ...). Lines,
        triangles and quadrilaterals, tetrahedra, hexahedra, wedges and pyramids, triangles and tetrahedra also of
        second order. The cells of the highest dimension are the domain; nodes that none of them uses are dropped.
    tags : the name of the cell data that hold the groups; found by itself for Gmsh (``gmsh:physical``, names
        from its physical groups), Medit and others, whose groups are cell sets or point sets.

    Returns
    -------
    Cloud : groups ``"interior"`` and one for every tag of boundary facets. A node on two of them belongs to the one
        named first, a boundary node on none to ``"boundary"``. Normals are those of the group's facets, averaged by
        angle: on curved sides as exact as the facets follow them; ``cloud.replace(normals=...)`` takes better ones.

    Raises
    ------
    ImportError
        Where a path is given and meshio is missing: ``pip install "jsmitsm[mesh]"``.
    ValueError
        For a mesh without cells, a surface in space, an unknown kind of cell, or tags that do not exist.

    >>> import meshio, numpy as np, jsmitsm as js
    >>> corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]]
    >>> mesh = meshio.Mesh(corners, [("triangle", [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]),
    ...                              ("line", [[0, 1], [1, 2]])], cell_data={"gmsh:physical": [[7] * 4, [1, 2]]},
    ...                    field_data={"bottom": np.array([1, 1]), "side": np.array([2, 1])})
    >>> js.files.from_mesh(mesh)
    Cloud(5 particles in 2D, groups {interior: 1, bottom: 2, side: 1, boundary: 1})
    """
    if isinstance(mesh, (str, os.PathLike)):
        mesh = _read(mesh)
    if not (hasattr(mesh, "points") and hasattr(mesh, "cells")):
        raise ValueError(f"mesh: expected a meshio.Mesh or the path of a mesh file, got {type(mesh).__name__}")
    dim, cells = volume_cells(mesh.cells)
    points = _checked_nodes(mesh.points, dim)
    check_cells(len(points), cells)
    size = np.ptp(points, axis=0).max()
    if points.shape[1] > dim and np.ptp(points[:, dim:], axis=0).max() > 1e-12 * size:
        raise ValueError(
            f"mesh: its cells are {dim}-dimensional but its points are not in the first {dim} axes; "
            "a surface in space is no domain, mesh the volume"
        )
    used = np.unique(np.concatenate([block.ravel() for _, block in cells]))
    new = np.full(len(points), -1)
    new[used] = np.arange(len(used))
    points = np.ascontiguousarray(points[used, :dim])
    # Products of coordinates must neither overflow nor vanish: the geometry is found in units of its size.
    unit = float(np.ptp(points, axis=0).max()) or 1.0
    corner = points.min(axis=0)
    cells = [(kind, new[block]) for kind, block in cells]
    scaled = (points - corner) / unit
    outer = outer_facets(scaled, cells)
    normals = boundary_normals(scaled, outer)
    free = np.isfinite(normals[:, 0])
    groups = {INTERIOR: np.flatnonzero(~free)}
    for name, nodes in named_facets(mesh, dim, tags).items():
        nodes = new[nodes]
        nodes = np.unique(nodes[nodes >= 0])
        claimed = nodes[free[nodes]]  # tags inside of the domain are no boundary
        if len(claimed):
            if name == INTERIOR:
                raise ValueError(f"mesh: boundary facets are tagged {INTERIOR!r}, the name of what lies inside; rename")
            groups[name] = claimed
            free[claimed] = False
            members = np.zeros(len(points), bool)
            members[nodes] = True
            # At a corner between groups the normal is that of the own side: what is said of a side holds to its end.
            own = side_normals(scaled, outer, members)[claimed]
            normals[claimed] = np.where(np.isfinite(own), own, normals[claimed])
    if free.any():
        groups["boundary"] = np.union1d(groups.get("boundary", np.zeros(0, int)), np.flatnonzero(free))
    return Cloud(points, groups, normals)


def _checked_nodes(points: Any, dim: int) -> np.ndarray:
    """The nodes of a mesh (N, D), real and finite, in at least as many axes as its cells have."""
    array = np.asarray(points)
    if array.dtype.kind not in "iuf" or array.ndim != 2 or array.shape[1] < dim:
        raise ValueError(
            f"mesh: its points have shape {array.shape} and type {array.dtype}; expected real numbers (N, D), D at "
            f"least {dim} for its cells"
        )
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if len(bad):
        raise ValueError(f"mesh: NaN or infinite coordinates at the points {bad[:5].tolist()}; remove or mend them")
    return array.astype(np.float64)


def _read(path: Any) -> Any:
    """The mesh in a file; whatever meshio does with one that is damaged, which may be to end the program."""
    meshio = _needed("meshio", "mesh")
    if not os.path.isfile(path):
        raise ValueError(f"mesh: there is no file {os.fspath(path)!r}; give the path of a mesh file")
    with open(path, "rb") as file:
        start = file.read(1)
        file.seek(-min(os.path.getsize(path), 100), os.SEEK_END)
        end = file.read().split()
        if os.fspath(path).endswith((".node", ".ele")):  # comments alone are nothing either
            file.seek(0)
            end = [line for line in file if not line.strip().startswith(b"#") and line.strip()]
    kind = {b"$": "gmsh", b"(": "ansys"}.get(start) if os.fspath(path).endswith(".msh") else None
    # Of such a file that ends too soon, or is of neither kind, meshio would look for the end for ever.
    whole = end and (end[-1].startswith(b"$End") if kind == "gmsh" else end[-1].endswith(b")") or kind != "ansys")
    if not whole:
        raise ValueError(f"mesh: the file {os.fspath(path)!r} is {'cut short' if end else 'empty'}; write it again")
    if kind is None and os.fspath(path).endswith(".msh"):
        raise ValueError(
            f"mesh: the file {os.fspath(path)!r} is of neither kind of .msh, Gmsh's or Ansys's; convert it"
        )
    try:
        return meshio.read(path, kind)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"mesh: meshio needs {error.name} for {os.fspath(path)!r}: pip install {error.name}"
        ) from None
    except (Exception, SystemExit) as error:
        what = f"{type(error).__name__}: {error}".strip(": ")
        raise ValueError(
            f"mesh: meshio cannot read {os.fspath(path)!r} ({what}); expected a whole file of a format that its "
            "extension names (.msh, .vtk, .vtu, .inp, .xdmf, ...)"
        ) from error


def from_shapely(polygon: Any, spacing: Any, seed: int = 0, groups: Any = None) -> Cloud:
    """Particles of a shapely ``Polygon`` with its holes; everything else as in :func:`jsmitsm.from_polygon`.

    ``spacing``, ``seed`` and ``groups`` as there. ``polygon`` may also be its well-known text (which needs shapely:
    ``pip install "jsmitsm[mesh]"``). Raises ValueError for other geometries; the parts of a ``MultiPolygon`` are solved
    one by one.

    >>> import shapely, jsmitsm as js
    >>> sorted(js.files.from_shapely(shapely.box(0, 0, 2, 1).difference(shapely.Point(1, 0.5).buffer(0.2)), 0.1).groups)
    ['boundary', 'hole0', 'interior']
    """
    if isinstance(polygon, str):
        shapely, text = _needed("shapely", "mesh"), polygon
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
    """A cloud from a CSV file with a header: columns ``x`` (``y``, ``z``) and ``group``; normals in ``nx`` (``ny``,
    ``nz``) where there are any, empty in the interior. Other columns are ignored. :func:`to_csv` writes such files.

    Raises ValueError for a missing column or a cell that is no number, with its line. ``path``: a name or a path.

    >>> import os, tempfile, jsmitsm as js
    >>> path = os.path.join(tempfile.mkdtemp(), "cloud.csv")
    >>> js.files.to_csv(js.interval(0.0, 1.0, 3), path)
    >>> js.files.from_csv(path)
    Cloud(3 particles in 1D, groups {interior: 1, left: 1, right: 1})
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
    except (OSError, TypeError) as error:
        raise ValueError(f"path: cannot read {path!r} ({error}); give the path of a CSV file") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"path: {path} is no text in UTF-8 ({error}); save it as CSV in UTF-8") from None
    if not rows:
        raise ValueError(f"path: {path} has no rows below its header")
    axes = [name for name in _AXES if name in rows[0]]
    if "group" not in rows[0] or "".join(axes) not in ("x", "xy", "xyz"):
        raise ValueError(f"path: {path} has the columns {list(rows[0])}; expected x (and y, z) and group")
    points = _numbers(rows, axes, path)
    names = [(row["group"] or "").strip() for row in rows]
    if "" in names:
        raise ValueError(f"path: {path}, line {names.index('') + 2}: has no group; expected {INTERIOR} or a name")
    groups = {name: np.flatnonzero([n == name for n in names]) for name in dict.fromkeys([INTERIOR, *names])}
    normals = [f"n{name}" for name in axes]
    return Cloud(points, groups, _numbers(rows, normals, path) if normals[0] in rows[0] else None)


def to_csv(what: Cloud | Solution, path: Any) -> None:
    """Write a cloud, or a solution with its cloud, as CSV: coordinates, group, normals and the values ``u``.

    ``what``: a cloud or a solution; ``path``: a name or a path. Numbers are written so that they read back to the
    last bit, see :func:`from_csv`.
    """
    columns = _columns(_a_kind(what, (Cloud, Solution), "what"))
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*columns.values()):
            writer.writerow(["" if v != v else v if isinstance(v, str) else repr(float(v)) for v in row])


def to_mesh(sol: Solution, **more: Any) -> Any:
    """The solution on a mesh of triangles (lines, tetrahedra) between its particles, a ``meshio.Mesh``.

    ``to_mesh(sol).write("u.vtu")`` makes a file for ParaView. ``more``: further point data (N,) or (N, F), as in
    ``to_mesh(sol, estimate=sol.error_estimate())``. Holes stay open. Raises ValueError for data
    of another length. Needs meshio: ``pip install "jsmitsm[mesh]"``.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    >>> sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), ends), js.interval(0.0, 1.0, 9))
    >>> js.files.to_mesh(sol).point_data["u"].shape
    (9,)
    """
    meshio = _needed("meshio", "mesh")
    cloud = _a_kind(sol, (Solution,), "sol").cloud
    points = np.zeros((len(cloud), 3))
    points[:, : cloud.dim] = cloud.points
    data = {"u": np.asarray(sol.u)} | _per_particle(more, len(cloud), (1, 2))
    return meshio.Mesh(points, [(_CELLS[cloud.dim], simplices(cloud))], point_data=data)


def to_pandas(what: Cloud | Solution, **more: Any) -> Any:
    """``what``, a cloud or a solution with its cloud, as a ``pandas.DataFrame``: one row per particle, coordinates,
    group, normals, and ``u`` (``u0``, ``u1``, ... for a system). ``more``: further columns (N,).

    Needs pandas: ``pip install "jsmitsm[tables]"``.

    >>> import jsmitsm as js
    >>> js.files.to_pandas(js.interval(0.0, 1.0, 3)).group.tolist()
    ['left', 'interior', 'right']
    """
    columns = _columns(_a_kind(what, (Cloud, Solution), "what"))
    return _needed("pandas", "tables").DataFrame({**columns, **_per_particle(more, len(columns["x"]), (1,), columns)})


def to_xarray(sol: Solution, **more: Any) -> Any:
    """A solution as an ``xarray.Dataset`` over the dimension ``particle`` (and ``field`` for a system), with the
    coordinates and groups as coordinates, method and order as attributes. ``more``: further variables (N,).

    Needs xarray: ``pip install "jsmitsm[tables]"``.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    >>> sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), ends), js.interval(0.0, 1.0, 9))
    >>> js.files.to_xarray(sol).u.sizes["particle"]
    9
    """
    xarray = _needed("xarray", "tables")
    columns = _columns(_a_kind(sol, (Solution,), "sol").cloud)
    more = _per_particle(more, len(sol.cloud), (1,), columns)
    dims = ("particle", "field")[: np.ndim(sol.u)]
    return xarray.Dataset(
        {"u": (dims, np.asarray(sol.u))} | {name: ("particle", value) for name, value in more.items()},
        coords={name: ("particle", column) for name, column in columns.items()},
        attrs={"method": sol.method, "order": sol.order, "converged": int(bool(sol.converged))},
    )


def _needed(name: str, extra: str) -> Any:
    """An optional library, or an error that names its extra."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ImportError(f'{name} is needed here, an optional extra: pip install "jsmitsm[{extra}]"') from None


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
        array = np.asarray(value)
        if array.ndim not in dims or len(array) != count or array.dtype.kind == "O":
            raise ValueError(
                f"{name}: values of shape {array.shape} came, expected {count}, one per particle"
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
    if cloud.normals is not None:
        columns |= {f"n{name}": np.asarray(cloud.normals)[:, k] for k, name in enumerate(_AXES[: cloud.dim])}
    if isinstance(what, Solution):
        u = np.asarray(what.u)
        columns |= {"u": u} if u.ndim == 1 else {f"u{k}": u[:, k] for k in range(u.shape[1])}
    return columns


def _numbers(rows: list[dict[str, str]], names: list[str], path: Any) -> np.ndarray:
    """Columns of a table (N, len(names)); an empty cell is NaN."""
    table = np.empty((len(rows), len(names)))
    for i, row in enumerate(rows):
        for k, name in enumerate(names):
            cell = row.get(name)
            try:
                table[i, k] = float(cell) if cell else np.nan
            except ValueError:
                raise ValueError(f"path: {path}, line {i + 2}: {name} = {cell!r} is no number") from None
    return table
