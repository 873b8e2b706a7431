"""Meshless solutions of boundary-value problems by local Taylor expansions, in JAX."""

from importlib import import_module
from typing import Any

from jsmitsm.clouds import Cloud, box, interval, rectangle
from jsmitsm.errors import SolveError
from jsmitsm.estimate import Factorization, factorize
from jsmitsm.kernels import Constant, CubicSpline, Gaussian, Kernel, SuperGaussian, Wendland
from jsmitsm.marks import meant
from jsmitsm.neighbours import Stencils, stencils
from jsmitsm.operators import divergence, grad, hessian, laplacian, partial
from jsmitsm.problem import Condition, Problem, condition, dirichlet, fix, free, neumann, periodic, robin
from jsmitsm.progress import no_progress
from jsmitsm.solution import Solution
from jsmitsm.solve import solve
from jsmitsm.taylor import multi_indices

__version__ = "0.1.0"

__all__ = [
    "Cloud", "Condition", "Constant", "CubicSpline", "Factorization", "Gaussian", "Kernel", "Problem", "Quality",
    "Solution", "SolveError", "Stencils", "SuperGaussian", "TuneResult", "Wendland", "box", "condition",
    "continuation", "dirichlet", "divergence", "factorize", "files", "fix", "free", "from_polygon", "from_sdf", "grad",
    "hessian", "interval", "laplacian", "meant", "multi_indices", "neumann", "no_progress", "partial", "periodic",
    "plot", "quadrature", "quality", "rectangle", "robin", "sdf", "show_versions", "solve", "stencils", "tune",
]  # fmt: skip

# Imported when first used: they need more than solving does.
_LAZY_MODULES = ("files", "plot", "sdf")
_LAZY_NAMES = {
    "Quality": "evenness",
    "TuneResult": "tuning",
    "continuation": "stages",
    "from_polygon": "shapes",
    "from_sdf": "shapes",
    "quadrature": "boundary_quadrature",
    "quality": "evenness",
    "show_versions": "versions",
    "tune": "tuning",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY_MODULES:
        return import_module(f"jsmitsm.{name}")
    if name in _LAZY_NAMES:
        return getattr(import_module(f"jsmitsm.{_LAZY_NAMES[name]}"), name)
    raise AttributeError(f"module 'jsmitsm' has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names, those that were not used yet too."""
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
