"""Families of problems on boxes, of any dimension, whose numbers are parameters: new ones compile nothing again.

Every exact solution is f(x, q, xp): coordinates first, q the parameters, xp numpy or jax.numpy.
``SWEPT`` holds one case of each family for the table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks.problems.case import SIDES, Case, on_box, table, zero


def smooth(x, q, xp=jnp):
    """A smooth function of the coordinates in units of the domain."""
    s = [(x[i] - q["at"][i]) / q["size"] for i in range(len(x))]
    rest = sum(s[1:]) if len(s) > 1 else 0.0
    return xp.exp(s[0]) * xp.sin(2.0 * s[-1] + 0.3) + rest


def peak(x, q, xp=jnp):
    square = sum((x[i] - q["centre"][i]) ** 2 for i in range(len(x)))
    return xp.exp(-square / q["w"] ** 2) + 1.0 + x[0]


def reaction(x, q, xp=jnp):
    return (xp.exp(-x[0] / q["eps"]) + xp.exp(-(1.0 - x[0]) / q["eps"])) / (1.0 + xp.exp(-1.0 / q["eps"]))


def swept(x, q, xp=jnp):
    """The outflow layer of -eps u'' + u' = 0, u(0) = 0, u(1) = 1."""
    return (xp.exp((x[0] - 1.0) / q["eps"]) - xp.exp(-1.0 / q["eps"])) / (1.0 - xp.exp(-1.0 / q["eps"]))


def wave(x, q, xp=jnp):
    return xp.sin(q["k"] * (0.8 * x[0] + 0.6 * x[1] if len(x) > 1 else x[0]) + 0.3)


def jump(x, q, xp=jnp):
    """Harmonic, with boundary values that jump from 1 to 0 at (x0, 0)."""
    return xp.arctan2(x[1], x[0] - q["x0"]) / np.pi


def laplace(u, x, q):
    return js.laplacian(u)(x)


def damped(u, x, q):
    return q["eps"] ** 2 * js.laplacian(u)(x) - u(x)


def helmholtz(u, x, q):
    return js.laplacian(u)(x) + q["k"] ** 2 * u(x)


def convected(u, x, q):
    return js.partial(u, (1,) + (0,) * (len(x) - 1))(x) - q["eps"] * js.laplacian(u)(x)


@dataclass(frozen=True)
class Family:
    """An operator (u, x, q) and a solution; the source is made from it, or zero where it needs none."""

    about: str
    operator: Callable[..., Any]
    exact: Callable[..., Any]
    homogeneous: bool = False

    def pde(self) -> Callable[..., Any]:
        operator, exact = self.operator, self.exact
        if self.homogeneous:
            return operator
        return lambda u, x, q: operator(u, x, q) - operator(lambda y: exact(y, q), x, q)

    def problem(self, dim: int, q: Any, neumann: bool = False) -> js.Problem:
        """The member with parameters q, Dirichlet sides, or the left one Neumann."""
        exact = self.exact
        bcs: dict[str, Any] = {side: js.dirichlet(exact) for side in SIDES[: 2 * dim]}
        if neumann:
            bcs["left"] = js.neumann(lambda x, q: -js.grad(lambda y: exact(y, q))(x)[0])
        return js.Problem(self.pde(), bcs, params=q)

    def case(self, name: str, dim: int, q: Any, **more: Any) -> Case:
        """The member as a case of the table, its parameters bound."""
        operator, exact = self.operator, self.exact
        return on_box(
            name, self.about, lambda u, x: operator(u, x, q), lambda x: exact(x, q), (0.0,) * dim, (1.0,) * dim,
            {1: 41, 2: 15, 3: 7}[dim], 0.2, source=zero if self.homogeneous else None, **more,
        )  # fmt: skip


FAMILIES = {
    "poisson": Family("laplacian(u) = f", laplace, smooth),
    "peak": Family("laplacian(u) = f, u = exp(-r^2/w^2) + 1 + x", laplace, peak),
    "reaction": Family("eps^2 laplacian(u) = u, layers on two sides", damped, reaction, homogeneous=True),
    "layer": Family("u_x = eps laplacian(u), an outflow layer", convected, swept, homogeneous=True),
    "carried": Family("u_x - eps laplacian(u) = f, smooth", convected, smooth),
    "jump": Family("laplacian(u) = 0, boundary values that jump", laplace, jump, homogeneous=True),
    "resonance": Family("laplacian(u) + k^2 u = f", helmholtz, smooth),
    "wave": Family("laplacian(u) + k^2 u = 0, a plane wave", helmholtz, wave, homogeneous=True),
}


def at_home(dim: int) -> dict[str, Any]:
    """The parameters of ``smooth`` on the unit box."""
    return {"at": np.zeros(dim), "size": 1.0}


# One member of each, mild ones, so that the table knows them too; and the ceiling of its error at order 4.
_MEMBERS: dict[str, tuple[dict[str, Any], float]] = {
    "poisson": ({}, 2e-6), "peak": ({"centre": np.array([0.52, 0.52]), "w": 0.3}, 1e-3),
    "reaction": ({"eps": 0.2}, 2e-4), "layer": ({"eps": 0.2}, 1e-3), "carried": ({"eps": 1e-3}, 5e-6),
    "jump": ({"x0": 0.52}, 5e-2), "resonance": ({"k": 5.0}, 4e-6), "wave": ({"k": 5.0}, 1e-3),
}  # fmt: skip
SWEPT = table(
    *(
        FAMILIES[name].case(f"swept {name}", 2, at_home(2) | q, smooth=name != "jump", ceilings={4: ceiling})
        for name, (q, ceiling) in _MEMBERS.items()
    )
)
