"""The one table of test problems with known solutions, shared by tests and benchmarks.

``CASES`` maps a name to a :class:`Case`: the equation, its domain and particles, the exact solution, and
the bounds that a solve must keep. ``python -m benchmarks.equations`` measures every case that has
ceilings, ``tests/test_problems.py`` checks that every exact solution solves its equation. A case added to
a module of this package reaches them all.
"""

from benchmarks.problems.case import (
    FACTOR,
    RANK,
    SIDES,
    Case,
    curved,
    laplace,
    on_box,
    robin,
    scattered,
    slope,
    smooth,
    table,
    zero,
)  # fmt: skip
from benchmarks.problems.families import FAMILIES, SWEPT
from benchmarks.problems.linear import LINEAR, layer
from benchmarks.problems.nonlinear import NONLINEAR
from benchmarks.problems.paper import NONSMOOTH, PAPER, jump_1d, jump_2d, kink_1d, kink_2d, peak_1d, peak_2d
from benchmarks.problems.shapes import SHAPES
from benchmarks.problems.systems import SYSTEMS

CASES = table(
    *(case for part in (LINEAR, SHAPES, NONLINEAR, SYSTEMS, PAPER, NONSMOOTH, SWEPT) for case in part.values())
)

__all__ = [
    "CASES", "FACTOR", "FAMILIES", "RANK", "SIDES", "Case", "curved", "jump_1d", "jump_2d", "kink_1d", "kink_2d",
    "laplace", "layer", "on_box", "peak_1d", "peak_2d", "robin", "scattered", "slope", "smooth", "table", "zero",
]  # fmt: skip
