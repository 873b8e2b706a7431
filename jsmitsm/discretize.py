"""The way from a problem and a cloud to a global system, in one namespace.

``layout`` decides what is static, ``numbers`` evaluates what may be traced, ``rows`` sets up the
moment systems, ``globalsystem`` joins them.
"""

from jsmitsm.globalsystem import (
    cell_peclet,
    least_squares,
    matrix,
    mean_spacing,
    misfit,
    prefers_least_squares,
    right_side,
    wave_number,
    with_held,
)
from jsmitsm.layout import Class, Discretization, discretize, sorted_classes, table
from jsmitsm.numbers import Numbers, numbers
from jsmitsm.rows import all_coefficients, all_rows, class_moment_matrices, class_rows, shared_elimination
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
    "least_squares",
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
]
