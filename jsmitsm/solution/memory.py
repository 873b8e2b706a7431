"""What will not fit in memory is refused before it is made."""

from __future__ import annotations

import numpy as np

from jsmitsm.discretization.layout import Discretization
from jsmitsm.linear import linsolve
from jsmitsm.runtime.tracers import is_traced

# Entries of the matrix, and of it and all that it is made of, in those of the rows of method S: of methods I and II,
# whose rows reach the neighbours of neighbours, and of the least-squares form, where every row is a square block.
# Measured from the growth of the peak memory with 3,000 to 39,000 particles in 2D (orders 4, 6) and 6,000 in 3D: 3.2
# and 6.5; 0.65 to 0.95 and 0.4 to 0.6 of the square.
NESTED, SQUARED = (3.2, 6.5), (0.85, 0.6)


def refuse_too_large(disc: Discretization, formulation: str, solver: str) -> None:
    """Raises SolveError where the estimated entries of the rows and of the global system exceed the memory."""
    near, fields = disc.stencils.indices, disc.rec.fields
    if is_traced(near, disc.cloud.points):
        return
    n, width = int((~disc.held).sum()), fields * int(np.shape(near)[1])
    entries = made = float(n * width)
    if disc.scheme.method in ("I", "II"):
        entries, made = NESTED[0] * entries, NESTED[1] * made
    elif formulation == "lsq":
        entries, made = SQUARED[0] * width * entries, SQUARED[1] * width * made
    points = np.asarray(disc.cloud.points)
    linsolve.refuse_too_large(n, int(entries), points, solver, fields == 1, int(made))
