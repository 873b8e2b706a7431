"""Clouds from files, of which every process reads its own slab."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import INTERIOR
from jsmitsm.parallel.distributed import ParallelCloud, Slab, own_slab, placed, slab_of
from jsmitsm.parallel.team import Team, collective, team
from jsmitsm.show.files import from_mesh
from jsmitsm.show.mesh_files import needed

_HDF5 = (".h5", ".hdf5", ".hdf")


@collective
def read(
    points: str | os.PathLike[str], groups: Any = None, normals: Any = None, *, names: Mapping[str, int] | None = None,
    tags: str | None = None,
) -> ParallelCloud:  # fmt: skip
    """A cloud from files, of which every process reads its own slab.

    Parameters
    ----------
    points : path
        ``.npy``: an array (N, D), which is mapped, so that no process reads more than its slab. ``.h5``, ``.hdf5``: an
        HDF5 file with a dataset ``"points"`` (N, D), of which every process reads its slab; needs h5py. Any other name:
        a mesh, as ``js.files.from_mesh`` reads it; every process reads the whole of it, and keeps its slab.
    groups : path or str
        With ``.npy``: an integer array (N,) in another ``.npy``, the group of every particle. With HDF5: the name of
        such a dataset, ``"groups"`` if not given.
    normals : path or str, optional
        With ``.npy``: an array (N, D) of unit outward normals, NaN in the interior. With HDF5: the name of such a
        dataset; ``"normals"`` if not given, where there is one.
    names : mapping
        With ``.npy``: the integer that stands for each group, ``"interior"`` among them. With HDF5 too, or these
        numbers are attributes of the dataset of groups, as in what ``jp.save(sol, "u.xdmf")`` writes.
    tags : str, optional
        With a mesh: as in ``js.files.from_mesh``.

    Returns
    -------
    ParallelCloud
        The slab of this process.

    Raises
    ------
    ValueError
        For arrays of other shapes, and groups without a name.

    Examples
    --------
    On every process::

        cloud = jp.read(
            "points.npy", "groups.npy", "normals.npy",
            names={"interior": 0, "wall": 1},
        )
    """
    us = team()
    with us.phase():
        path = os.fspath(points)
        if path.endswith(".npy"):
            slab = _mapped(us, points, groups, normals, names)
        elif path.endswith(_HDF5):
            slab = _from_hdf5(us, path, groups, normals, names)
        else:
            slab = slab_of(us, from_mesh(path, tags))
    return ParallelCloud(placed(us, slab))


def _mapped(us: Team, points: Any, groups: Any, normals: Any, names: Any) -> Slab:
    if groups is None:
        raise ValueError("groups: an .npy of points needs another of integers, one a particle")
    mapped = lambda path: None if path is None else np.load(path, mmap_mode="r")  # noqa: E731
    return _slab(us, mapped(points), mapped(groups), mapped(normals), names)


def _from_hdf5(us: Team, path: str, groups: Any, normals: Any, names: Any) -> Slab:
    h5py = needed("h5py", "mpi")
    if not os.path.isfile(path):
        raise ValueError(f"points: there is no file {path!r}; give the path of an HDF5 file")
    with h5py.File(path, "r") as file:
        asked = {"points": "points", "groups": groups or "groups", "normals": normals or "normals"}
        found = {name: file.get(dataset) for name, dataset in asked.items()}
        for name, dataset in asked.items():
            if found[name] is None and (name != "normals" or normals is not None):
                raise ValueError(f"{name}: {path!r} has no dataset {dataset!r}, but {', '.join(map(repr, file))}")
        if names is None:
            names = {name: int(k) for name, k in sorted(found["groups"].attrs.items(), key=lambda one: one[1])}
        return _slab(us, found["points"], found["groups"], found["normals"], names)


def _slab(us: Team, points: Any, groups: Any, normals: Any, names: Any) -> Slab:
    """The own slab of arrays that are mapped, or read in part."""
    if not isinstance(names, Mapping) or INTERIOR not in names:
        raise ValueError(f'names: expected the integer of each group, {{"{INTERIOR}": 0, ...}}, got {names!r}')
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"points: expected an array (N, 2) or (N, 3), got shape {points.shape}")
    some = own_slab(us, len(points))
    codes = _part_of(groups, "groups", (len(points),), some)
    known = np.array(list(names.values()))
    which = np.argmax(codes[:, None] == known, axis=1)
    stray = np.flatnonzero(known[which] != codes)
    if len(stray):
        raise ValueError(f"groups: particle {some.start + stray[0]} has {codes[stray[0]]}, which names does not name")
    own = np.array(points[some], float)
    given = np.zeros((len(own), 0)) if normals is None else _part_of(normals, "normals", points.shape, some)
    number = np.arange(some.start, some.stop)
    return Slab(tuple(names), len(points), number, own, np.array(given, float), which, np.zeros(len(own), int),
                normals is not None)  # fmt: skip


def _part_of(array: Any, name: str, shape: tuple[int, ...], some: slice) -> np.ndarray:
    if array.shape != shape:
        raise ValueError(f"{name}: expected an array {shape}, got shape {array.shape}")
    return np.array(array[some])
