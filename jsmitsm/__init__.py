"""Meshless solutions of boundary-value problems by local Taylor expansions, in JAX."""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if sys.version_info < (3, 11):  # noqa: UP036  # of a copy that pip did not put there
    raise ImportError(f"jsmitsm needs Python 3.11 or newer, this is {sys.version.split()[0]}: take another interpreter")

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.lattices.boxes import box, rectangle
from jsmitsm.cloud.lattices.interval import interval
from jsmitsm.cloud.neighbours import Stencils, stencils
from jsmitsm.equation.bcs import Condition, condition, dirichlet, fix, free, neumann, periodic, robin
from jsmitsm.equation.marks import meant
from jsmitsm.equation.operators import divergence, dt, grad, hessian, laplacian, partial
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.regions.interface import interface
from jsmitsm.equation.unknowns.constraint import constraint
from jsmitsm.equation.unknowns.point_source import point_source
from jsmitsm.particle.kernels import Constant, CubicSpline, Gaussian, Kernel, SuperGaussian, Wendland
from jsmitsm.runtime.errors import SolveError, did_you_mean
from jsmitsm.runtime.progress import no_progress
from jsmitsm.taylor.multi_indices import multi_indices

__version__ = "0.2.0"

__all__ = [
    "Adapted", "AdaptedEvolution", "Cloud", "Condition", "Constant", "CubicSpline", "Evolution", "Factorization",
    "Formulation", "Gaussian", "Kernel", "Method", "Modes", "Problem", "Quality", "Readapt", "Solution",
    "SolveError", "Solver", "Stencils", "SuperGaussian", "TuneResult", "Wendland", "adapt", "box", "condition",
    "constraint", "continuation", "dirichlet", "divergence", "dt", "eigen", "evolve", "factorize", "files", "fix",
    "free", "from_polygon", "from_sdf", "grad", "hessian", "interface", "interval", "laplacian", "meant",
    "multi_indices", "neumann", "no_progress", "node_weights", "partial", "periodic", "plot", "point_source",
    "quadrature", "quality", "rectangle", "regions", "robin", "sdf", "show_versions", "solve", "stencils", "tune",
]  # fmt: skip

# Imported when first used, the solver too: who draws or makes clouds need not wait for it. Where each stands is said
# twice, to type checkers and to Python: with a module's __getattr__ in sight a checker would believe in every name.
if TYPE_CHECKING:
    from jsmitsm.adaptation.adapt import Adapted, adapt
    from jsmitsm.cloud import sdf
    from jsmitsm.cloud.quadrature import quadrature
    from jsmitsm.cloud.quality import Quality, quality
    from jsmitsm.cloud.regions.making import regions
    from jsmitsm.cloud.regions.node_weights import node_weights
    from jsmitsm.cloud.shapes import from_polygon, from_sdf
    from jsmitsm.evolution.adaptive.adapted import AdaptedEvolution
    from jsmitsm.evolution.adaptive.readapt import Readapt
    from jsmitsm.evolution.evolution import Evolution
    from jsmitsm.evolution.evolve import evolve
    from jsmitsm.linear.linsolve import Solver
    from jsmitsm.modes.eigen import eigen
    from jsmitsm.modes.modes import Modes
    from jsmitsm.runtime.versions import show_versions
    from jsmitsm.show import files, plot
    from jsmitsm.solution.arguments import Formulation, Method
    from jsmitsm.solution.factorization import Factorization, factorize
    from jsmitsm.solution.nonlinear.continuation import continuation
    from jsmitsm.solution.solution import Solution
    from jsmitsm.solution.solve import solve
    from jsmitsm.tuning.tune import TuneResult, tune
else:
    _LAZY = {
        "Adapted": "adaptation.adapt",
        "AdaptedEvolution": "evolution.adaptive.adapted",
        "Evolution": "evolution.evolution",
        "Factorization": "solution.factorization",
        "Formulation": "solution.arguments",
        "Method": "solution.arguments",
        "Modes": "modes.modes",
        "Quality": "cloud.quality",
        "Readapt": "evolution.adaptive.readapt",
        "Solution": "solution.solution",
        "Solver": "linear.linsolve",
        "TuneResult": "tuning.tune",
        "adapt": "adaptation.adapt",
        "continuation": "solution.nonlinear.continuation",
        "eigen": "modes.eigen",
        "evolve": "evolution.evolve",
        "factorize": "solution.factorization",
        "files": "show",
        "from_polygon": "cloud.shapes",
        "from_sdf": "cloud.shapes",
        "node_weights": "cloud.regions.node_weights",
        "plot": "show",
        "quadrature": "cloud.quadrature",
        "quality": "cloud.quality",
        "sdf": "cloud",
        "regions": "cloud.regions.making",
        "show_versions": "runtime.versions",
        "solve": "solution.solve",
        "tune": "tuning.tune",
    }
    _MODULES = ("files", "plot", "sdf")

    def __getattr__(name: str) -> Any:
        if name in _MODULES:
            return import_module(f"jsmitsm.{_LAZY[name]}.{name}")
        if name in _LAZY:
            found = globals()[name] = getattr(import_module(f"jsmitsm.{_LAZY[name]}"), name)
            return found
        known = "" if name.startswith("_") else did_you_mean(name, __all__)
        raise AttributeError(f"module 'jsmitsm' has no attribute {name!r}{known}")


def __dir__() -> list[str]:
    """The public names, those that were not used yet too."""
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
