"""Named test problems on boxes with exact solutions, shared by tests, benchmarks and notebooks.

``PAPER`` holds the three problems of Karamanli (2015), ``NONSMOOTH`` sources with a kink, a jump
or a narrow peak, ``EXAMPLES`` what the notebooks solve, ``GENERIC`` everything else; ``ALL`` is their union. A problem added to
``GENERIC`` reaches every user of the table. Cases with clouds and ceilings of their own stand in ``equations``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js

SIDES = ("left", "right", "bottom", "top", "front", "back")


@dataclass(frozen=True)
class Case:
    """A boundary-value problem on a box whose solution is known.

    Attributes
    ----------
    name, about : how it is called, and its equation in one line.
    lo, hi : corners of the box; their length is the number of dimensions.
    pde : the residual ``(u, x) -> scalar`` as :class:`jsmitsm.Problem` takes it.
    exact : the solution, a function of one point x (D,), written in ``jax.numpy``.
    bcs : conditions that differ from Dirichlet data taken from ``exact``, by group.
    corrected : puts right what ``exact`` cannot say at single points (values at corners):
        ``(points, values) -> values`` in numpy.
    """

    name: str
    about: str
    lo: tuple[float, ...]
    hi: tuple[float, ...]
    pde: Callable[..., Any]
    exact: Callable[[Any], Any]
    bcs: Mapping[str, Any] = field(default_factory=dict)
    corrected: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None

    @property
    def dim(self) -> int:
        return len(self.lo)

    def cloud(self, shape: int | tuple[int, ...], jitter: float = 0.0, seed: int = 0) -> js.Cloud:
        """A lattice of ``shape`` particles; jitter moves interior ones (2D and 3D)."""
        if self.dim == 1:
            n = shape if isinstance(shape, int) else shape[0]
            return js.interval(self.lo[0], self.hi[0], n)
        make = js.rectangle if self.dim == 2 else js.box
        shape = (shape,) * self.dim if isinstance(shape, int) else shape
        return make(self.lo, self.hi, shape, jitter=jitter, seed=seed)

    def problem(self, **bcs: Any) -> js.Problem:
        """The problem, with Dirichlet data from the exact solution wherever nothing else is said.

        A condition given by the name of its group, ``left=slope(case)``, replaces the case's own.
        """
        data = {side: js.dirichlet(self.exact) for side in SIDES[: 2 * self.dim]}
        return js.Problem(self.pde, {**data, **self.bcs, **bcs})

    def values(self, points: Any) -> np.ndarray:
        """The exact solution at ``points`` (N, D): (N,)."""
        points = np.asarray(points)
        values = np.array(_mapped(self.exact)(points))
        return values if self.corrected is None else self.corrected(points, values)

    def error(self, sol: js.Solution) -> float:
        """The relative L2 norm of the error over all particles (not in percent)."""
        exact = self.values(sol.cloud.points)
        return float(np.linalg.norm(np.asarray(sol.u) - exact) / np.linalg.norm(exact))


@lru_cache(maxsize=256)
def _mapped(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return jax.jit(jax.vmap(function))


def slope(case: Case) -> Any:
    """A Neumann condition with the exact solution's slope, for any group with normals."""
    return js.condition(lambda u, x, n: n @ (js.grad(u)(x) - jax.grad(case.exact)(x)))


def manufactured(
    name: str, about: str, lo: tuple[float, ...], hi: tuple[float, ...], operator: Callable[..., Any],
    exact: Callable[[Any], Any],
) -> Case:  # fmt: skip
    """The case ``operator(u) = operator(exact)``; its source is what the exact solution needs."""
    return Case(name, about, lo, hi, lambda u, x: operator(u, x) - operator(exact, x), exact)


def _distance(x: Any, centre: tuple[float, ...]) -> Any:
    return jnp.sqrt(sum((x[k] - c) ** 2 for k, c in enumerate(centre)))


def poisson(source: Callable[[Any], Any]) -> Callable[..., Any]:
    """The residual of laplacian(u) = source."""
    return lambda u, x: js.laplacian(u)(x) - source(x)


# ------------------------------------------------------------------ the paper's three problems


def _heated(x: Any) -> Any:
    """The series (34): a rectangle [0, 4] x [0, 9] heated to 100 on its top."""
    k = jnp.arange(1, 400, 2) * (math.pi / 4)
    # sinh(k y) / sinh(9 k) without overflow.
    ratio = jnp.exp(k * (x[1] - 9)) * (1 - jnp.exp(-2 * k * x[1])) / (1 - jnp.exp(-18 * k))
    return 100 * jnp.sum(jnp.sin(k * x[0]) * ratio / k)


def _heated_edges(points: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The series does not converge on the top: 100 there, and 0 at its two corners."""
    x, y = points.T
    return np.where((x <= 0) | (x >= 4), 0.0, np.where(y >= 9, 100.0, values))


def _wave(x: Any) -> Any:
    return jnp.sin(x[0]) * jnp.cos(x[1])


PAPER = {
    "rod": Case(
        "rod", "u'' = x^3, u = x^5/20 + 2x + 1 (section 4.1)", (0.0,), (2.0,),
        poisson(lambda x: x[0] ** 3), lambda x: x[0] ** 5 / 20 + 2 * x[0] + 1,
        {"left": js.dirichlet(1.0), "right": js.dirichlet(6.6)},
    ),
    "plate": Case(
        "plate", "laplacian(T) = 0, T = 100 on top, else 0 (section 4.2)", (0.0, 0.0), (4.0, 9.0),
        lambda u, x: js.laplacian(u)(x), _heated,
        {side: js.dirichlet(100.0 if side == "top" else 0.0) for side in SIDES[:4]}, _heated_edges,
    ),
    "source": Case(
        "source", "laplacian(T) = -2 sin x cos y, T = sin x cos y, dT/dy = 0 at y = 0 (section 4.3)",
        (0.0, 0.0), (4.0, 9.0), poisson(lambda x: -2 * _wave(x)), _wave, {"bottom": js.neumann(0.0)},
    ),
}  # fmt: skip


# ------------------------------------------------------------------ nonsmooth sources

# Every singularity has a free place, so that it can be moved relative to the particles.


def kink_1d(at: float = 0.4472) -> Case:
    """u'' = |x - at|."""
    return Case(
        "kink 1D", "u'' = |x - c|, u = |x - c|^3/6", (0.0,), (1.0,),
        poisson(lambda x: jnp.abs(x[0] - at)), lambda x: jnp.abs(x[0] - at) ** 3 / 6,
    )  # fmt: skip


def jump_1d(at: float = 0.4472) -> Case:
    """u'' = 1 to the right of ``at``, else 0."""
    return Case(
        "jump 1D", "u'' = [x > c], u = max(x - c, 0)^2/2", (0.0,), (1.0,),
        poisson(lambda x: jnp.where(x[0] > at, 1.0, 0.0)), lambda x: jnp.maximum(x[0] - at, 0.0) ** 2 / 2,
    )  # fmt: skip


def peak_1d(at: float = 0.4472, width: float = 0.05) -> Case:
    """u'' = a peak of area 1 and the given width: a smoothed point load."""
    return Case(
        "peak 1D", "u'' = w^2/(2 s^3), u = s/2, s = sqrt((x - c)^2 + w^2)", (0.0,), (1.0,),
        poisson(lambda x: 0.5 * width**2 / ((x[0] - at) ** 2 + width**2) ** 1.5),
        lambda x: 0.5 * jnp.sqrt((x[0] - at) ** 2 + width**2),
    )  # fmt: skip


def kink_2d(at: float = 0.8, centre: tuple[float, float] = (-0.2, -0.1)) -> Case:
    """laplacian(u) = |r - at|, a kink along a circle whose centre lies outside the square."""

    def exact(x):
        r, c = _distance(x, centre), at
        inside = c * r**2 / 4 - r**3 / 9
        return jnp.where(r < c, inside, -inside + c**3 * (5 / 18 + jnp.log(r / c) / 3))

    return Case(
        "kink 2D", "laplacian(u) = |r - c|", (0.0, 0.0), (1.0, 1.0),
        poisson(lambda x: jnp.abs(_distance(x, centre) - at)), exact,
    )  # fmt: skip


def jump_2d(at: float = 0.3, centre: tuple[float, float] = (0.4472, 0.5345)) -> Case:
    """laplacian(u) = 1 inside a circle, else 0."""

    def exact(x):
        r2, c = sum((x[k] - centre[k]) ** 2 for k in range(2)), at
        return jnp.where(r2 < c**2, r2 / 4, c**2 / 4 * (1 + jnp.log(jnp.maximum(r2, c**2) / c**2)))

    def source(x):
        return jnp.where(sum((x[k] - centre[k]) ** 2 for k in range(2)) < at**2, 1.0, 0.0)

    return Case("jump 2D", "laplacian(u) = [r < c]", (0.0, 0.0), (1.0, 1.0), poisson(source), exact)


def peak_2d(centre: tuple[float, float] = (0.4472, 0.5345), width: float = 0.05) -> Case:
    """laplacian(u) = a peak of volume 1 and the given width: a smoothed point load."""

    def square(x):
        return sum((x[k] - centre[k]) ** 2 for k in range(2)) + width**2

    return Case(
        "peak 2D", "laplacian(u) = w^2/(pi s^2), u = log(s)/(4 pi), s = r^2 + w^2", (0.0, 0.0), (1.0, 1.0),
        poisson(lambda x: width**2 / (math.pi * square(x) ** 2)), lambda x: jnp.log(square(x)) / (4 * math.pi),
    )  # fmt: skip


NONSMOOTH = {case.name: case for case in (kink_1d(), jump_1d(), peak_1d(), kink_2d(), jump_2d(), peak_2d())}


# ------------------------------------------------------------------ smooth problems of every kind


def _smooth(x: Any) -> Any:
    """exp(x) sin 2y + x^3 y and its kin in one and three dimensions."""
    if x.shape[0] == 1:
        return jnp.exp(x[0]) * jnp.sin(2 * x[0])
    if x.shape[0] == 2:
        return jnp.exp(x[0]) * jnp.sin(2 * x[1]) + x[0] ** 3 * x[1]
    return jnp.exp(x[0]) * jnp.sin(2 * x[1]) * jnp.cos(x[2]) + x[0] ** 3 * x[1] * x[2]


def _laplace(u: Any, x: Any) -> Any:
    return js.laplacian(u)(x)


def _conductivity(x: Any) -> Any:
    return 1.0 + 0.5 * jnp.sin(x[0] + 2 * x[1])


def _diffusion(u: Any, x: Any) -> Any:
    return js.divergence(lambda y: _conductivity(y) * js.grad(u)(y))(x)


def _convection(u: Any, x: Any) -> Any:
    return -0.1 * js.laplacian(u)(x) + js.grad(u)(x) @ jnp.array([1.0, 0.5])


def _helmholtz(u: Any, x: Any) -> Any:
    return js.laplacian(u)(x) + 9.0 * u(x)


def _reaction(u: Any, x: Any) -> Any:
    return js.laplacian(u)(x) - (1.0 + x[0] ** 2) * u(x)


def _anisotropic(u: Any, x: Any) -> Any:
    return js.partial(u, (2, 0))(x) + 0.8 * js.partial(u, (1, 1))(x) + 3.0 * js.partial(u, (0, 2))(x)


_UNIT = {d: ((0.0,) * d, (1.0,) * d) for d in (1, 2, 3)}

GENERIC = {
    case.name: case
    for case in (
        *(manufactured(f"poisson {d}D", "laplacian(u) = f", *_UNIT[d], _laplace, _smooth) for d in (1, 2, 3)),
        manufactured("reaction 1D", "u'' - (1 + x^2) u = f", *_UNIT[1], _reaction, _smooth),
        manufactured("diffusion 2D", "div((1 + sin(x + 2y)/2) grad u) = f", *_UNIT[2], _diffusion, _smooth),
        manufactured("convection 2D", "-0.1 laplacian(u) + (1, 0.5) . grad u = f", *_UNIT[2], _convection, _smooth),
        manufactured("helmholtz 2D", "laplacian(u) + 9 u = f", *_UNIT[2], _helmholtz, _smooth),
        manufactured("anisotropic 2D", "u_xx + 0.8 u_xy + 3 u_yy = f", *_UNIT[2], _anisotropic, _smooth),
    )
}

# ------------------------------------------------------------------ the examples of the notebooks


def _skew_wave(x: Any) -> Any:
    return jnp.sin(2 * x[0] + x[1])


def _growing(x: Any) -> Any:
    return jnp.exp(x[0]) * jnp.sin(x[1])


def _steep(x: Any) -> Any:
    return jnp.exp(x[0]) * jnp.sin(3 * x[1])


def _film(u: Any, x: Any) -> Any:
    return js.divergence(lambda y: js.grad(u)(y) / jnp.sqrt(1 + js.grad(u)(y) @ js.grad(u)(y)))(x)


def _load(x: Any) -> Any:
    return jnp.cos(jnp.pi * x[0] / 2) * jnp.cos(jnp.pi * x[1] / 2)


def _conducting(u: Any, x: Any) -> Any:
    return js.divergence(lambda y: jnp.exp(y[0] * y[1]) * js.grad(u)(y))(x)


def layer(eps: float) -> Case:
    """A wind from left to right with little diffusion: a layer of thickness eps at x = 1."""
    return Case(
        f"layer {eps:g}", "-eps laplacian(u) + u_x = 1", (0.0, 0.0), (1.0, 1.0),
        lambda u, x: -eps * js.laplacian(u)(x) + js.grad(u)(x)[0] - 1.0,
        lambda x: x[0] - jnp.expm1(x[0] / eps) / jnp.expm1(1 / eps),
    )  # fmt: skip


_WIDE = ((-1.0, -1.0), (1.0, 1.0))
_RESTING = [js.dirichlet(0.0), js.condition(lambda u, x, n: js.laplacian(u)(x))]

EXAMPLES = {
    case.name: case
    for case in (
        Case("harmonic", "laplacian(u) = 0, u = exp(x) sin y", *_UNIT[2], _laplace, _growing),
        Case("steep", "laplacian(u) = f, u = exp(x) sin 3y", *_UNIT[2], poisson(lambda x: -8 * _steep(x)), _steep),
        manufactured("conductor", "div(exp(x y) grad u) = f, u = sin(2x + y)", *_WIDE, _conducting, _skew_wave),
        Case(
            "soap film", "no mean curvature, u = log(cos y / cos x) (Scherk)", *_WIDE, _film,
            lambda x: jnp.log(jnp.cos(x[1]) / jnp.cos(x[0])),
        ),
        Case(
            "resting plate", "laplacian^2(w) = q = cos(pi x/2) cos(pi y/2), w = 4 q / pi^4", *_WIDE,
            lambda u, x: js.laplacian(js.laplacian(u))(x) - _load(x), lambda x: 4 * _load(x) / jnp.pi**4,
            {side: _RESTING for side in SIDES[:4]},
        ),
        Case(
            "oscillating rod", "u'' = -16 sin 4x, u = sin 4x + x", (0.0,), (2.0,),
            poisson(lambda x: -16 * jnp.sin(4 * x[0])), lambda x: jnp.sin(4 * x[0]) + x[0],
        ),
        layer(0.05),
    )
}  # fmt: skip

ALL = {**PAPER, **NONSMOOTH, **GENERIC, **EXAMPLES}
