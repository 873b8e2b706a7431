"""What a test problem is: an equation, its domain, its exact solution, and the bounds its errors must keep."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks import scenes

SIDES = ("left", "right", "bottom", "top", "front", "back")
# An error estimate is good that is within this factor of the error, and whose ranks correlate with those of the error.
FACTOR, RANK = 5.0, 0.8


def zero(x: Any) -> float:
    """The source of a homogeneous equation."""
    return 0.0


@dataclass(frozen=True)
class Case:
    """A boundary-value problem operator(u) = source with a known solution, and what a solve must reach.

    Attributes
    ----------
    name, about : how it is called, and the equation in one line.
    operator : ``(u, x)`` -> scalar, or (F,) for a system, of a field or a plain function u.
    exact : the solution, a function of one point x (D,) in ``jax.numpy``: a scalar, or (F,).
    cloud : makes its particles; called without arguments, those that the bounds below speak of.
    sides : the boundary groups.
    bcs : conditions that differ from Dirichlet data taken from ``exact``, by group.
    source : a function of x; None for the one that ``exact`` needs, made by AD.
    fields : number of fields F; the error is the largest over them.
    floating : fields determined up to a constant, compared without their mean.
    corrected : puts right what ``exact`` cannot say at single points: ``(points, values) -> values`` in numpy.
    ceilings : for each order the largest relative L2 error that is accepted, default kernel and stencils.
    steps : most Newton steps accepted; None for a linear problem.
    particles : most particles the cloud may have.
    coarse : the size, an argument of ``cloud``, of a coarser cloud.
    before, rates : for each order the largest error on the coarser cloud, and the least observed order between the two.
    estimates : orders at which the error estimate must be good.
    further : named further numbers, each a function ``(case, sol)`` with its ceilings by order.
    seconds : for a number of particles the longest time that making them may take.
    smooth : False where the solution, or a derivative that matters, is singular.
    """

    name: str
    about: str
    operator: Callable[..., Any]
    exact: Callable[[Any], Any]
    cloud: Callable[..., js.Cloud]
    sides: tuple[str, ...]
    bcs: Mapping[str, Any] = field(default_factory=dict)
    source: Callable[[Any], Any] | None = None
    fields: int = 1
    floating: tuple[int, ...] = ()
    corrected: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    ceilings: Mapping[int, float] = field(default_factory=dict)
    steps: int | None = None
    particles: int | None = None
    coarse: Any = None
    before: Mapping[int, float] = field(default_factory=dict)
    rates: Mapping[int, float] = field(default_factory=dict)
    estimates: tuple[int, ...] = ()
    further: Mapping[str, tuple[Callable[..., float], Mapping[int, float]]] = field(default_factory=dict)
    seconds: Mapping[int, float] = field(default_factory=dict)
    smooth: bool = True

    @property
    def pde(self) -> Callable[[Any, Any], Any]:
        """The residual ``(u, x)``, as :class:`jsmitsm.Problem` takes it: a function written anew each time."""
        operator, exact, source = self.operator, self.exact, self.source
        if source is None:
            return lambda u, x: operator(u, x) - operator(exact, x)
        return lambda u, x: operator(u, x) - source(x)

    def problem(self, **bcs: Any) -> js.Problem:
        """The problem, with Dirichlet data from the exact solution wherever nothing else is said.

        A condition given by the name of its group, ``left=slope(case.exact)``, replaces the case's own.
        """
        data = {side: js.dirichlet(self.exact) for side in self.sides}
        return js.Problem(self.pde, {**data, **self.bcs, **bcs}, fields=self.fields)

    def solve(self, order: int, cloud: js.Cloud | None = None, **options: Any) -> js.Solution:
        """Its solution, on its own cloud where none is given."""
        return js.solve(self.problem(), self.cloud() if cloud is None else cloud, order=order, **options)

    def solved_by(self, exact: Callable[[Any], Any], name: str | None = None, bcs: Mapping | None = None) -> Case:
        """The same operator and domain with another solution, and Dirichlet data where ``bcs`` says nothing else."""
        return Case(name or self.name, self.about, self.operator, exact, self.cloud, self.sides, bcs or {},
                    fields=self.fields)  # fmt: skip

    def values(self, points: Any) -> np.ndarray:
        """The exact solution at ``points`` (N, D): (N,), or (N, F) for a system."""
        points = np.asarray(points)
        values = np.array(_mapped(self.exact)(points))
        return values if self.corrected is None else self.corrected(points, values)

    def errors(self, sol: js.Solution) -> np.ndarray:
        """Errors at the particles over the size (root mean square) of their field, (N, F)."""
        true = self.values(sol.cloud.points).reshape(-1, self.fields)
        off = np.asarray(sol.u).reshape(true.shape) - true
        for k in self.floating:
            off[:, k] -= off[:, k].mean()
            true[:, k] -= true[:, k].mean()
        return off / np.sqrt(np.mean(true**2, axis=0))

    def error(self, sol: js.Solution) -> float:
        """The relative L2 error (not in percent), the largest over the fields that have no ceiling of their own."""
        each = np.sqrt(np.mean(self.errors(sol) ** 2, axis=0))
        return float(max(e for k, e in enumerate(each) if k not in self.floating or self.fields == 1))


@lru_cache(maxsize=256)
def _mapped(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return jax.jit(jax.vmap(function))


# ------------------------------------------------------------------ conditions


def slope(exact: Callable[[Any], Any]) -> Any:
    """The normal derivative of a known function, for groups with normals."""
    return js.condition(lambda u, x, n: n @ (js.grad(u)(x) - jax.grad(exact)(x)))


def robin(exact: Callable[[Any], Any]) -> Any:
    """A Robin condition with a variable coefficient that a known function fulfils."""
    return js.condition(
        lambda u, x, n: 2.0 * (u(x) - exact(x)) + (1.0 + 0.3 * x[0]) * (n @ (js.grad(u)(x) - jax.grad(exact)(x)))
    )


# ------------------------------------------------------------------ makers of cases


def on_box(name: str, about: str, operator: Callable, exact: Callable, lo: tuple[float, ...] = (0.0, 0.0),
           hi: tuple[float, ...] = (1.0, 1.0), shape: Any = 21, jitter: float = 0.0, seed: int = 0,
           **more: Any) -> Case:  # fmt: skip
    """A case on a lattice of a box, the unit square where nothing else is said."""
    return Case(name, about, operator, exact, scenes.lattice(lo, hi, shape, jitter, seed), SIDES[: 2 * len(lo)], **more)


def scattered(name: str, about: str, operator: Callable, exact: Callable, ceilings: Mapping[int, float],
              cloud: Callable[..., js.Cloud] = scenes.square, **more: Any) -> Case:  # fmt: skip
    """A case on scattered particles of the unit square."""
    return Case(name, about, operator, exact, cloud, SIDES[:4], ceilings=ceilings, **more)


def table(*cases: Case) -> dict[str, Case]:
    """Cases by name, which must differ."""
    found = {case.name: case for case in cases}
    if len(found) < len(cases):
        raise ValueError(f"names of cases: {sorted(c.name for c in cases)} must differ")
    return found


# ------------------------------------------------------------------ ingredients of several families


def laplace(u: Any, x: Any) -> Any:
    return js.laplacian(u)(x)


def diffusion(conductivity: Callable[[Any], Any]) -> Callable[..., Any]:
    """div(conductivity grad u)."""
    return lambda u, x: js.divergence(lambda y: conductivity(y) * js.grad(u)(y))(x)


def smooth(x: Any) -> Any:
    """A function without symmetry, neither harmonic nor polynomial, wave numbers about 2."""
    return jnp.sin(2 * x[0] - x[1] + 0.3) * jnp.exp(0.5 * x[1]) + jnp.log(3.0 + x[0] + x[1] ** 2)


def curved(x: Any) -> Any:
    """exp(x) sin 2y + x^3 y and its kin in one and three dimensions."""
    if x.shape[0] == 1:
        return jnp.exp(x[0]) * jnp.sin(2 * x[0])
    if x.shape[0] == 2:
        return jnp.exp(x[0]) * jnp.sin(2 * x[1]) + x[0] ** 3 * x[1]
    return jnp.exp(x[0]) * jnp.sin(2 * x[1]) * jnp.cos(x[2]) + x[0] ** 3 * x[1] * x[2]
