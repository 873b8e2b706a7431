"""Point sources, and the singular part of the solution that they make under a constant-coefficient operator.

With r = |x - x0| and m = c / a the operator a laplacian(u) + c u has the fundamental solutions, entire in m,

    1D   r sum_j (-m r^2)^j / (2 j + 1)! / (2 a)
    2D   sum_j (-m r^2 / 4)^j / j!^2 (log r - H_j) / (2 pi a),        H_j = 1 + 1/2 + ... + 1/j
    3D   -sum_j (-m r^2)^j / (2 j)! / (4 pi a r),

which are |x|/2, log r and 1/r for Laplace (m = 0), and regular solutions away from Y0, K0, cos(k r)/r and cosh(k r)/r
for Helmholtz (m > 0) and screened (m < 0) operators. The D displacements under a laplacian(u) + b grad(div u),
elasticity with a = mu and b = lambda + mu (plane strain), answer to a force F by Kelvin's solution,

    (F Phi - b / (a + b) grad grad Psi F) / a,        laplacian Phi = delta,  laplacian Psi = Phi,

    2D   Phi = log r / (2 pi),  Psi = r^2 (log r - 1) / (8 pi)        3D   Phi = -1 / (4 pi r),  Psi = -r / (8 pi).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.equation.unknowns.constraint import checked_number
from jsmitsm.runtime.arrays import ArrayLike
from jsmitsm.runtime.errors import explaining, numbers, refuse_masked, short
from jsmitsm.runtime.tracers import is_traced

# Terms of the series, and the largest root(|m|) r for which they are enough and do not cancel beyond 1e-11.
TERMS, FARTHEST = 36, 12.0


class PointSource(NamedTuple):
    """strength delta(x - place); made by ``js.point_source``."""

    place: Any
    strength: Any

    def __repr__(self) -> str:
        return "point_source(<traced>)" if is_traced(tuple(self)) else f"point_source({self.place}, {self.strength})"


@explaining
def point_source(x0: ArrayLike, strength: ArrayLike = 1.0) -> PointSource:
    """A source concentrated at one point: the residual of the pde is strength delta(x - x0).

    Its singular part is known where the operator is a laplacian(u) + c u with constants a and c (Laplace, Helmholtz,
    screened Poisson), and for displacements under a laplacian(u) + b grad(div u) (elasticity, plane or in space); it is
    subtracted, what is left is solved for, and the solution adds it again. In a cloud of several regions it lies in one
    of them, whose operator is asked.

    Parameters
    ----------
    x0 : array_like (D,)
        Where, inside of the domain and at no particle.
    strength : float or array_like (F,)
        By how much: the integral of the residual over any ball around x0. ``js.laplacian(u)(x)`` with a strength of 1
        is laplacian(u) = delta; ``-js.laplacian(u)(x)`` is -laplacian(u) = delta. Of elasticity, one for each
        displacement: a residual div(stress) with a strength F is pulled by the force -F.

    Returns
    -------
    PointSource
        To be put into ``js.Problem(..., sources=[...])``.

    Raises
    ------
    ValueError
        For what is no point, and a strength that is no finite number or vector of them.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import numpy as np
    >>> import jsmitsm as js
    >>> disk = js.from_sdf(
    ...     js.sdf.circle((0.0, 0.0), 1.0), ((-1.0, -1.0), (1.0, 1.0)), 0.2
    ... )
    >>> problem = js.Problem(
    ...     lambda u, x: js.laplacian(u)(x),
    ...     {"boundary": js.dirichlet(0.0)},
    ...     sources=[js.point_source((0.01, 0.0), 2.0 * np.pi)],
    ... )
    >>> sol = js.solve(problem, disk)  # log of 0.5 / 0.9949, by the image at x = 100
    >>> round(float(sol([[0.51, 0.0]])[0]), 3)
    -0.688
    """
    if is_traced(x0):
        place = x0
    else:
        refuse_masked(x0, "x0")
        try:
            place = numbers("x0", x0)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"x0: expected one point (D,), got {short(x0)}") from None
        if not np.isfinite(place).all():
            raise ValueError("x0: NaN or infinite coordinates; give a point of the domain")
    if np.ndim(place) != 1 or not 1 <= np.shape(place)[0] <= 3:
        raise ValueError(f"x0: expected one point (D,), got shape {np.shape(place)}")
    return PointSource(place, _checked_strength(strength))


def _checked_strength(strength: Any) -> Any:
    """A finite number, or a vector of them; traced ones pass."""
    if np.ndim(strength) != 1 or is_traced(strength):
        return strength if np.ndim(strength) == 1 else checked_number(strength, "strength")
    return np.array([checked_number(s, f"strength[{k}]") for k, s in enumerate(strength)], float)


class Singular(NamedTuple):
    """The sum of the singular parts of sources at ``places`` (S, D) with ``strengths`` (S,), for a (laplacian + m)."""

    places: Any
    strengths: Any
    a: Any
    m: Any
    sound: Any = True  # under a JAX transform that hides the coefficients, whether they are those of the operator

    def at(self, x: Any) -> Any:
        """At one point (D,)."""
        return sum(s * _fundamental(x - p, self.m) for p, s in zip(self.places, self.strengths, strict=True)) / self.a


class Kelvin(NamedTuple):
    """The same of forces with ``strengths`` (S, D), for a laplacian(u) + b grad(div u)."""

    places: Any
    strengths: Any
    a: Any
    b: Any
    sound: Any = True

    @property
    def m(self) -> float:
        return 0.0

    def at(self, x: Any) -> Any:
        """The displacements (D,) at one point (D,)."""
        part = self.b / (self.a + self.b)
        return sum(
            _displacement(x - p, s, part) for p, s in zip(self.places, self.strengths, strict=True)
        ) / self.a  # fmt: skip


def _displacement(way: Any, force: Any, part: Any) -> Any:
    """Of laplacian(u) + b / a grad(div u) with part = b / (a + b), at a place ``way`` (D,) from the force (D,)."""
    square, along = way @ way, way * (way @ force)
    if len(way) == 2:
        logarithm = 0.5 * jnp.log(square)
        return force * logarithm / (2.0 * math.pi) - part * (
            force * (2.0 * logarithm - 1.0) + 2.0 * along / square
        ) / (8.0 * math.pi)  # fmt: skip
    r = jnp.sqrt(square)
    return -force / (4.0 * math.pi * r) + part * (force / r - along / r**3) / (8.0 * math.pi)


def _fundamental(way: Any, m: Any) -> Any:
    """Of laplacian + m, at a place ``way`` (D,) from the source."""
    dim, square = len(way), way @ way
    step = -m * square
    if dim == 2:
        total, harmonic, logarithm = 0.0, sum(1.0 / j for j in range(1, TERMS)), 0.5 * jnp.log(square)
        for j in range(TERMS - 1, -1, -1):  # Horner's scheme
            total = logarithm - harmonic + total * step / (4.0 * (j + 1) ** 2)
            harmonic -= 1.0 / j if j else 0.0
        return total / (2.0 * math.pi)
    total, first = 1.0, 0 if dim == 3 else 1
    for j in range(TERMS - 1, 0, -1):
        total = 1.0 + total * step / ((2 * j + first) * (2 * j + first - 1))
    return -total / (4.0 * math.pi * jnp.sqrt(square)) if dim == 3 else 0.5 * jnp.sqrt(square) * total


def derivative_of(singular: Singular | Kelvin, multi_index: tuple[int, ...]) -> Any:
    """The function x -> d^b of the singular part."""
    function: Any = singular.at
    for axis, count in enumerate(multi_index):
        for _ in range(count):
            function = _along(function, axis)
    return function


def _along(function: Any, axis: int) -> Any:
    return lambda x: jax.jvp(function, (x,), (jnp.zeros_like(x).at[axis].set(1.0),))[1]
