"""A solution in files that ParaView reads: a piece a process, and one that names them all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from jsmitsm.parallel.files.mesh import CELLS, Piece, piece_of
from jsmitsm.parallel.files.xdmf import write_xdmf
from jsmitsm.parallel.local import Local
from jsmitsm.parallel.solution import ParallelSolution
from jsmitsm.parallel.team import Team, collective
from jsmitsm.runtime.arrays import ArrayLike
from jsmitsm.show.mesh_files import needed

# Names that a file has of its own.
_TAKEN = ("points", "cells", "groups", "normals", "number")


@collective
def save(sol: ParallelSolution, path: str | os.PathLike[str], **more: ArrayLike) -> None:
    """Write a solution for ParaView, every process its part.

    Parameters
    ----------
    sol : ParallelSolution
        What is written: ``u`` at the particles, on triangles or tetrahedra between them.
    path : path
        ``.pvtu``: beside it stands a .vtu of every process; needs meshio. ``.xdmf``: beside it stands one HDF5 file
        (.h5), which the processes write in turn, with ``points``, ``cells``, ``groups``, ``normals`` and the ``number``
        of every particle in the whole cloud; needs h5py. ``jp.read`` reads the particles of such a file.
    **more : array_like (n,) or (n, F)
        Further values at this process's own particles, as in ``jp.save(sol, "u.pvtu", error=jp.error_estimate(sol))``.

    Raises
    ------
    ValueError
        For another ending, values of another length, and names that the file has of its own.

    Examples
    --------
    ``jp.save(sol, "heat.pvtu")``
    """
    us, local = sol._team, sol._local
    halo, target = local.halo, Path(os.fspath(path))
    with us.phase():
        if target.suffix not in (".pvtu", ".xdmf"):
            raise ValueError(f"path: expected a name that ends in .pvtu or .xdmf, got {target.name!r}")
        for name, values in more.items():
            if np.shape(values)[:1] != (len(halo.ids),):
                raise ValueError(f"{name}: shape {np.shape(values)}, expected ({len(halo.ids)}, ...) on this process")
            if name in _TAKEN:
                raise ValueError(f"{name}: the file has {', '.join(_TAKEN)} of its own; choose another name")
        needed(*(("meshio", "mesh") if target.suffix == ".pvtu" else ("h5py", "mpi")))
    piece = piece_of(local, {"u": sol.u, **more})
    (_write_pvtu if target.suffix == ".pvtu" else write_xdmf)(us, local, piece, target)
    us.gather(None)


def _write_pvtu(us: Team, local: Local, piece: Piece, target: Path) -> None:
    with us.phase():
        meshio, halo = needed("meshio", "mesh"), local.halo
        used = np.unique(np.concatenate([piece.cells.reshape(-1), halo.ids]))
        points = np.zeros((len(used), 3))
        points[:, : local.mine.dim] = halo.slab.points[used]
        data = {name: values[used] for name, values in piece.data.items()}
        cells = [(CELLS[local.mine.dim], np.searchsorted(used, piece.cells))]
        meshio.Mesh(points, cells, point_data=data).write(target.with_name(f"{target.stem}_{us.rank}.vtu"))
        if us.rank == 0:
            target.write_text(_index(target.stem, us.size, data))


def _index(stem: str, count: int, data: dict[str, Any]) -> str:
    arrays = "".join(
        f'      <PDataArray type="Float64" Name="{name}" NumberOfComponents="{np.prod(v.shape[1:], dtype=int)}"/>\n'
        for name, v in data.items()
    )
    pieces = "".join(f'    <Piece Source="{stem}_{rank}.vtu"/>\n' for rank in range(count))
    return (
        '<?xml version="1.0"?>\n<VTKFile type="PUnstructuredGrid" version="0.1" byte_order="LittleEndian">\n'
        '  <PUnstructuredGrid GhostLevel="0">\n    <PPointData>\n' + arrays + "    </PPointData>\n    <PPoints>\n"
        '      <PDataArray type="Float64" Name="Points" NumberOfComponents="3"/>\n    </PPoints>\n' + pieces +
        "  </PUnstructuredGrid>\n</VTKFile>\n"
    )  # fmt: skip
