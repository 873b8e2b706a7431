"""Meshless solutions of boundary-value problems by local Taylor expansions, in JAX."""

from importlib import import_module
from typing import Any

from jsmitsm.clouds import Cloud, box, interval, rectangle
from jsmitsm.errors import SolveError
from jsmitsm.estimate import Factorization, factorize
from jsmitsm.kernels import Constant, CubicSpline, Gaussian, Kernel, SuperGaussian, Wendland
from jsmitsm.neighbours import Stencils, stencils
from jsmitsm.operators import divergence, grad, hessian, laplacian, partial
from jsmitsm.problem import Condition, Problem, condition, dirichlet, fix, free, neumann, periodic, robin
from jsmitsm.progress import no_progress
from jsmitsm.solution import Solution
from jsmitsm.solve import solve
from jsmitsm.taylor import multi_indices

__version__ = "0.1.0"

# Imported when first used: they need more than solving does.
_LAZY = {"files": "jsmitsm.files", "plot": "jsmitsm.plot", "sdf": "jsmitsm.sdf"}
_LAZY_NAMES = {
    "Quality": "jsmitsm.evenness",
    "TuneResult": "jsmitsm.tuning",
    "continuation": "jsmitsm.stages",
    "from_polygon": "jsmitsm.shapes",
    "from_sdf": "jsmitsm.shapes",
    "quadrature": "jsmitsm.boundary_quadrature",
    "quality": "jsmitsm.evenness",
    "show_versions": "jsmitsm.versions",
    "tune": "jsmitsm.tuning",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return import_module(_LAZY[name])
    if name in _LAZY_NAMES:
        return getattr(import_module(_LAZY_NAMES[name]), name)
    raise AttributeError(f"module 'jsmitsm' has no attribute {name!r}")
