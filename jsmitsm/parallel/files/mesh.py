"""The triangles or tetrahedra between particles, each with one process, and values at the particles."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jsmitsm.cloud.triangulation import simplices
from jsmitsm.parallel.local import Local

CELLS = {2: "triangle", 3: "tetra"}


class Piece(NamedTuple):
    """A process's cells (m, D + 1) by local particles, and values at all of these by name."""

    cells: np.ndarray
    data: dict[str, np.ndarray]


def piece_of(local: Local, own: dict[str, Any]) -> Piece:
    """The cells whose first particle is the process's own, and values of which every process gives its own."""
    halo, data = local.halo, {}
    for name, values in own.items():
        whole = np.zeros((len(halo), *np.shape(values)[1:]))
        whole[halo.ids] = values
        data[name] = halo.spread(whole)
    with local.team.phase():
        cells = simplices(local.cloud)
        return Piece(cells[halo.own[cells.min(axis=1)]], data)
