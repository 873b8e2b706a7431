"""A solution in an HDF5 file, which the processes write in turn, and an XDMF file that tells what is in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jsmitsm.parallel.files.mesh import CELLS, Piece
from jsmitsm.parallel.local import Local
from jsmitsm.parallel.team import Team
from jsmitsm.show.mesh_files import needed

_TYPES = {"triangle": "Triangle", "tetra": "Tetrahedron"}
_KINDS = {"f": "Float", "i": "Int"}


def write_xdmf(us: Team, local: Local, piece: Piece, target: Path) -> None:
    """Particles in the order of the processes; each has its number in the whole cloud, its group and its normal."""
    halo, slab = local.halo, local.halo.slab
    counts, cells = us.gather(len(halo.ids)), us.gather(len(piece.cells))
    first = sum(counts[: us.rank])
    at = np.zeros(len(halo), int)
    at[halo.ids] = first + np.arange(len(halo.ids))
    at = halo.spread(at)
    parts = {"points": slab.points, "number": slab.number, "groups": slab.group, **piece.data}
    if slab.with_normals:
        parts["normals"] = slab.normals
    parts = {name: values[halo.ids] for name, values in parts.items()}
    sizes = {name: (sum(counts), *v.shape[1:]) for name, v in parts.items()}
    places = dict.fromkeys(parts, slice(first, first + counts[us.rank]))
    parts["cells"], sizes["cells"] = at[piece.cells], (sum(cells), piece.cells.shape[1])
    places["cells"] = slice(sum(cells[: us.rank]), sum(cells[: us.rank + 1]))
    with us.phase():
        h5py = needed("h5py", "mpi")
        path = target.with_suffix(".h5")
        if us.rank == 0:
            with h5py.File(path, "w") as file:
                for name, values in parts.items():
                    file.create_dataset(name, sizes[name], values.dtype)
                for code, name in enumerate(slab.names):
                    file["groups"].attrs[name] = code
            kinds = {name: values.dtype for name, values in parts.items()}
            target.write_text(_index(path.name, sizes, kinds, list(piece.data), CELLS[local.mine.dim]))
    for rank in range(us.size):
        with us.phase():
            if rank == us.rank:
                with h5py.File(path, "r+") as file:
                    for name, values in parts.items():
                        if len(values):
                            file[name][places[name]] = values


def _index(file: str, sizes: dict[str, Any], kinds: dict[str, Any], fields: list[str], cell: str) -> str:
    def item(name: str) -> str:
        shape, kind = " ".join(map(str, sizes[name])), kinds[name]
        return (f'<DataItem DataType="{_KINDS[kind.kind]}" Dimensions="{shape}" Format="HDF" '
                f'Precision="{kind.itemsize}">{file}:/{name}</DataItem>')  # fmt: skip

    def attribute(name: str) -> str:
        width = int(np.prod(sizes[name][1:], dtype=int))
        kind = {1: "Scalar", 3: "Vector"}.get(width, "Matrix")
        return f'    <Attribute AttributeType="{kind}" Center="Node" Name="{name}">{item(name)}</Attribute>\n'

    geometry = "XY" if sizes["points"][1] == 2 else "XYZ"
    return (
        '<?xml version="1.0"?>\n<Xdmf Version="3.0">\n<Domain>\n  <Grid Name="Grid">\n'
        f'    <Geometry GeometryType="{geometry}">{item("points")}</Geometry>\n'
        f'    <Topology NumberOfElements="{sizes["cells"][0]}" TopologyType="{_TYPES[cell]}">'
        f'{item("cells")}</Topology>\n'
        + "".join(map(attribute, fields)) + "  </Grid>\n</Domain>\n</Xdmf>\n"
    )  # fmt: skip
