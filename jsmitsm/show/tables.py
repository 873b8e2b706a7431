"""Clouds and solutions as tables: CSV, data frames, data sets."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.runtime.errors import explaining, refuse_masked
from jsmitsm.show.mesh_files import needed
from jsmitsm.solution.solution import Solution

_AXES = "xyz"


@explaining
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


@explaining
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
    >>> js.files.to_csv(
    ...     js.interval(0.0, 1.0, 3), os.path.join(tempfile.mkdtemp(), "cloud.csv")
    ... )
    """
    columns = _columns(a_kind(what, (Cloud, Solution), "what"))
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


@explaining
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
    columns = _columns(a_kind(what, (Cloud, Solution), "what"))
    return needed("pandas", "tables").DataFrame({**columns, **per_particle(more, len(columns["x"]), (1,), columns)})


@explaining
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
    >>> sol = js.solve(
    ...     js.Problem(lambda u, x: js.laplacian(u)(x), ends), js.interval(0.0, 1.0, 9)
    ... )
    >>> js.files.to_xarray(sol).u.sizes["particle"]
    9
    """
    xarray = needed("xarray", "tables")
    columns = _columns(a_kind(sol, (Solution,), "sol").cloud)
    more = per_particle(more, len(sol.cloud), (1,), columns)
    dims = ("particle", "field")[: np.ndim(sol.u)]
    return xarray.Dataset(
        {"u": (dims, np.asarray(sol.u))} | {name: ("particle", value) for name, value in more.items()},
        coords={name: ("particle", column) for name, column in columns.items()},
        attrs={"method": sol.method, "order": sol.order, "converged": int(bool(sol.converged))},
    )


def a_kind(what: Any, kinds: tuple[type, ...], name: str) -> Any:
    """``what``, or an error where it is none of ``kinds``."""
    if not isinstance(what, kinds):
        wanted = " or ".join(f"js.{kind.__name__}" for kind in kinds)
        raise ValueError(f"{name}: expected a {wanted}, got {type(what).__name__}")
    if isinstance(what, Solution):
        what.refuse_stacked()
    return what


def per_particle(more: Mapping[str, Any], count: int, dims: tuple[int, ...], taken: Any = ()) -> dict[str, np.ndarray]:
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
