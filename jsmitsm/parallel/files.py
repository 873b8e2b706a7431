"""A solution in files that ParaView reads: a piece a process, and one that names them all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from jsmitsm.cloud.triangulation import simplices
from jsmitsm.parallel.solution import ParallelSolution
from jsmitsm.runtime.arrays import ArrayLike
from jsmitsm.runtime.errors import explaining
from jsmitsm.show.mesh_files import needed

_CELLS = {2: "triangle", 3: "tetra"}


@explaining
def save(sol: ParallelSolution, path: str | os.PathLike[str], **more: ArrayLike) -> None:
    """Write ``path`` (.pvtu) and beside it a .vtu of every process. Needs meshio.

    Parameters
    ----------
    sol : ParallelSolution
        What is written: ``u`` at the particles, on triangles or tetrahedra between them.
    path : path
        Ends in ``.pvtu``.
    **more : array_like (n,) or (n, F)
        Further values at this process's own particles, as in ``jp.save(sol, "u.pvtu", error=jp.error_estimate(sol))``.

    Raises
    ------
    ValueError
        For another ending, and values of another length.

    Examples
    --------
    ``jp.save(sol, "heat.pvtu")``
    """
    us, local = sol._team, sol._local
    halo, target = local.halo, Path(os.fspath(path))
    with us.phase():
        if target.suffix != ".pvtu":
            raise ValueError(f"path: expected a name that ends in .pvtu, got {target.name!r}")
        for name, values in more.items():
            if np.shape(values)[:1] != (len(halo.ids),):
                raise ValueError(f"{name}: shape {np.shape(values)}, expected ({len(halo.ids)}, ...) on this process")
        meshio = needed("meshio", "mesh")
    data = {"u": sol._values[:, 0] if sol._recipe.fields == 1 else sol._values}
    for name, values in more.items():
        whole = np.zeros((len(halo), *np.shape(values)[1:]))
        whole[halo.ids] = values
        data[name] = halo.spread(whole)
    with us.phase():
        cells = simplices(local.cloud)
        cells = cells[halo.own[cells.min(axis=1)]]  # of the process that has its first particle
        used = np.unique(np.concatenate([cells.reshape(-1), halo.ids]))
        points = np.zeros((len(used), 3))
        points[:, : local.mine.dim] = halo.slab.points[used]
        data = {name: values[used] for name, values in data.items()}
        piece = target.with_name(f"{target.stem}_{us.rank}.vtu")
        meshio.Mesh(points, [(_CELLS[local.mine.dim], np.searchsorted(used, cells))], point_data=data).write(piece)
        if us.rank == 0:
            target.write_text(_index(target.stem, us.size, data))
    us.gather(None)


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
