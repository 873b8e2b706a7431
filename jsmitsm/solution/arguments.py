"""Arguments of a solve, judged before any work."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypeAlias, TypedDict, get_args

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.discretization.layout import Discretization, discretize
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.regions.interface import INTERFACE
from jsmitsm.equation.regions.per_region import PerRegion
from jsmitsm.linear.linsolve import SOLVERS, Solver
from jsmitsm.particle.kernels import Kernel
from jsmitsm.runtime.errors import is_whole, numbers, refuse_masked, refuse_no_switch, refuse_word, short
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.taylor.multi_indices import HIGHEST

Method: TypeAlias = Literal["I", "II", "III", "S", "SSPH"]
"""What ``method`` may be, a type for annotations."""
Formulation: TypeAlias = Literal["auto", "loo", "lsq"]
"""What ``formulation`` may be, a type for annotations."""
Depth: TypeAlias = int | Literal["auto"]
"""What ``depth`` may be, a type for annotations."""
METHODS, FORMULATIONS = get_args(Method), get_args(Formulation)
# Local polynomials end so many degrees beyond the highest order.
DEEPEST = 4


class SolveOptions(TypedDict, total=False):
    """Options of ``js.solve`` that others pass on to it."""

    method: Method
    order: int
    depth: Depth
    stencils: Stencils | None
    basis_terms: int | None
    formulation: Formulation
    solver: Solver
    throw: bool


def discretized(
    problem: Problem, cloud: Cloud, method: str = "S", order: int = 4, kernel: Kernel | None = None,
    stencils: Stencils | None = None, basis_terms: int | None = None, formulation: str = "auto", solver: str = "auto",
    depth: Depth = "auto",
) -> Discretization:  # fmt: skip
    """Checked arguments, discretised."""
    check(problem, cloud, method, order, kernel, stencils, formulation, solver, depth=depth)
    return discretize(problem, cloud, method, order, kernel, stencils, basis_terms, depth=depth)


def of_regions(problem: Any, cloud: Any) -> bool:
    """Whether this is a problem with several regions on a cloud of them; ValueError where only one of the two is."""
    several = isinstance(getattr(problem, "pde", None), PerRegion)
    if several and not isinstance(cloud, RegionCloud):
        raise ValueError(
            f"cloud: the problem has the regions {list(problem.pde)}, the cloud has none; make it with js.regions"
        )
    if isinstance(cloud, RegionCloud) and isinstance(problem, Problem) and not several:
        raise ValueError(
            f"pde: the cloud has the regions {list(cloud.regions)}; give an equation for each, "
            f"js.Problem({{{list(cloud.regions)[0]!r}: pde, ...}}, bcs)"
        )
    if not several and isinstance(problem, Problem):
        for group, conditions in problem.bcs.items():
            if any(c.kind == INTERFACE for c in conditions):
                raise ValueError(
                    f"bcs[{group!r}]: js.interface binds two regions, and the cloud has none; make it with js.regions, "
                    "or give the boundary a condition of its own (js.dirichlet, js.neumann, js.robin, js.condition)"
                )
    return several


def check(
    problem, cloud, method, order, kernel, stencils, formulation="auto", solver="auto", u0=None, throw=True,
    depth="auto",
) -> None:
    """Arguments of ``js.solve`` that can be judged before any work."""
    for value, kind, name in ((problem, Problem, "problem"), (cloud, Cloud, "cloud")):
        if not isinstance(value, kind):
            raise ValueError(f"{name}: expected a js.{kind.__name__}, got {type(value).__name__}")
    if kernel is not None and not isinstance(kernel, Kernel):
        raise ValueError(
            f"kernel: expected a kernel such as js.SuperGaussian(h, d), got {kernel!r}; wrap your own with js.Kernel"
        )
    if stencils is not None and not isinstance(stencils, Stencils):
        raise ValueError(f"stencils: expected js.stencils(cloud, size=...), got {type(stencils).__name__}")
    for value, known, name in (
        (method, METHODS, "method"), (formulation, FORMULATIONS, "formulation"), (solver, SOLVERS, "solver")
    ):  # fmt: skip
        refuse_word(name, value, known)
    if formulation == "lsq" and method != "S":
        raise ValueError(f'formulation: "lsq" is a form of method S, not of {method!r}; use method="S" or "loo"')
    if stencils is not None and any(c.kind == "periodic" for cs in problem.bcs.values() for c in cs):
        raise ValueError("stencils: those of a cloud do not reach periodic images; leave stencils out")
    refuse_no_switch("throw", throw)
    if isinstance(u0, Mapping):
        _check_starts(u0, cloud, problem.fields)
    else:
        _check_start(u0, (len(cloud), problem.fields))
    if not is_whole(order, 1, HIGHEST):
        raise ValueError(
            f"order: expected a whole number from 1 to {HIGHEST}, the degree of the expansions, got {short(order)}"
        )
    _check_depth(depth, method, order)


def _check_depth(depth: Any, method: str, order: Any) -> None:
    """Degrees beyond the order: "auto" or a whole number."""
    if isinstance(depth, str) and depth == "auto":
        return
    if not is_whole(depth, 0):
        raise ValueError(f'depth: expected "auto" or a whole number from 0, degrees beyond the order, got {depth!r}')
    if depth and method == "SSPH":
        raise ValueError(f"depth: SSPH has no recursion to take {depth} degrees further; use depth=0, or method=\"S\"")
    if order + depth > HIGHEST + DEEPEST:
        raise ValueError(
            f"depth: order {order} and depth {depth} make polynomials of degree {order + depth}, and "
            f"{HIGHEST + DEEPEST} is the highest; more than 4 pay for coarse waves alone, and 6 have all of the gain"
        )


def _check_starts(u0: Mapping[str, Any], cloud: Any, fields: int) -> None:
    """A start for each region, a number too."""
    regions = getattr(cloud, "regions", {})
    if set(u0) != set(regions) or not regions:
        raise ValueError(f"u0: starts for the regions {list(u0)}; the cloud has {list(regions) or 'none'}")
    for name, given in u0.items():
        _check_start(given, (len(regions[name]), fields), f"u0[{name!r}]")


def _check_start(u0: Any, shape: tuple[int, int], name: str = "u0") -> None:
    """A start for Newton's method: nothing, a function, a number, or finite values of the right shape."""
    if u0 is None or callable(u0) or is_traced(u0):
        return
    refuse_masked(u0, name)
    try:
        if np.iscomplexobj(u0):
            raise TypeError
        values = numbers(name, u0)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name}: expected a function of x, a number or an array, got {short(u0)}") from None
    if values.shape not in ((), shape, shape[:1]):
        raise ValueError(f"{name}: expected a function, a number, ({shape[0]},) or {shape}, got shape {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: NaN or infinite values; start from finite ones")
