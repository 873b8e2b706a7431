"""The way from a problem and a cloud to a global system, in one namespace.

``layout`` decides what is static, ``numbers`` evaluates what may be traced, ``rows`` and ``twostage``
set up the moment systems, ``globalsystem`` and ``leastsquares`` join them, ``character`` tells which of the two suits.
"""

from jsmitsm.character import cell_peclet, mean_spacing, prefers_least_squares, wave_number
from jsmitsm.globalsystem import matrix, right_side, with_held
from jsmitsm.heldparticles import held_particles, with_held_expansions
from jsmitsm.layout import Class, Discretization, discretize, sorted_classes, table
from jsmitsm.leastsquares import least_squares, least_squares_right_side, misfit
from jsmitsm.numbers import Numbers, numbers
from jsmitsm.operands import shared_elimination
from jsmitsm.rows import all_coefficients, all_rows, class_moment_matrices, class_rows
from jsmitsm.supports import default_size, scheme_size

__all__ = [
    "Class",
    "Discretization",
    "Numbers",
    "all_coefficients",
    "all_rows",
    "cell_peclet",
    "class_moment_matrices",
    "class_rows",
    "default_size",
    "discretize",
    "held_particles",
    "least_squares",
    "least_squares_right_side",
    "matrix",
    "mean_spacing",
    "misfit",
    "numbers",
    "prefers_least_squares",
    "right_side",
    "scheme_size",
    "shared_elimination",
    "sorted_classes",
    "table",
    "wave_number",
    "with_held",
    "with_held_expansions",
]
