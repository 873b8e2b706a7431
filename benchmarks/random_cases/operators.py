"""Operators of the random cases, functions (u, x, q) of a field or a plain function u, with numbers q."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax.numpy as jnp

import jsmitsm as js
from benchmarks.random_cases.solutions import laminate


def coefficient(name: str, x: Any, q: Any) -> Any:
    """A positive coefficient: even, mild, in waves, or a smooth step or bump that the cloud may not resolve."""
    if name == "even":
        return 1.0
    s = q["across"] @ (x - q["at"]) / q["steep"]
    if name == "mild":
        return 1.0 + 0.4 * jnp.sin(2.0 * x[0] + x[-1])
    if name == "waves":
        return 1.0 + 0.8 * jnp.sin(s)
    if name == "step":
        return 1.0 + q["contrast"] * (1.0 + jnp.tanh(s))
    return 1.0 + q["contrast"] * jnp.exp(-(s**2))  # a bump


COEFFICIENTS = ("even", "mild", "waves", "step", "bump")


def _unit(dim: int, axis: int, times: int = 1) -> tuple[int, ...]:
    return tuple(times if k == axis else 0 for k in range(dim))


def _part(u: Any, k: int) -> Callable[[Any], Any]:
    return lambda y: u(y)[k]


def _rotating(x: Any, q: Any) -> Any:
    """A direction that turns, (D,)."""
    t = q["angle"] + 0.8 * x[0]
    return jnp.stack([jnp.cos(t), jnp.sin(t), 0.5 + 0.0 * t][: len(x)])


# ------------------------------------------------------------------ linear, one field


def diffusion(u, x, q, k):
    if k == "even":
        return js.laplacian(u)(x)
    return js.divergence(lambda y: coefficient(k, y, q) * js.grad(u)(y))(x)


def tensor(u, x, q, k):
    def flow(y):
        e, g = _rotating(y, q), js.grad(u)(y)
        return coefficient(k, y, q) * (g + q["aspect"] * e * (e @ g))

    return js.divergence(flow)(x)


def convection(u, x, q, k):
    return coefficient(k, x, q) * (_rotating(x, q) @ js.grad(u)(x)) - q["small"] * js.laplacian(u)(x)


def reaction(u, x, q, k):
    return q["small"] * js.laplacian(u)(x) - coefficient(k, x, q) * u(x)


def helmholtz(u, x, q, k):
    return js.laplacian(u)(x) + q["square"] * coefficient(k, x, q) * u(x)


def general(u, x, q, k):
    return diffusion(u, x, q, k) + q["speed"] * (_rotating(x, q) @ js.grad(u)(x)) + q["rate"] * u(x)


def third(u, x, q, k):
    return js.partial(u, (3,))(x) + q["speed"] * js.partial(u, (1,))(x) - coefficient(k, x, q) * u(x)


def beam(u, x, q, k):
    bent = lambda y: coefficient(k, y, q) * js.partial(u, (2,))(y)
    return js.laplacian(bent)(x) + q["rate"] * u(x)


def plate(u, x, q, k):
    return js.laplacian(js.laplacian(u))(x) + coefficient(k, x, q) * u(x)


def transport(u, x, q, k):
    return q["velocity"] @ js.grad(u)(x) + coefficient(k, x, q) * u(x)


def heat(u, x, q, k):
    return js.partial(u, (0, 1))(x) - q["small"] * coefficient(k, x, q) * js.partial(u, (2, 0))(x)


def vibration(u, x, q, k):
    return js.partial(u, (0, 2))(x) - coefficient(k, x, q) * js.partial(u, (2, 0))(x)


# ------------------------------------------------------------------ nonlinear, one field


def cubic(u, x, q, k):
    return diffusion(u, x, q, k) - q["rate"] * u(x) ** 3


def bratu(u, x, q, k):
    return diffusion(u, x, q, k) + 0.5 * jnp.exp(0.5 * u(x))


def disturbed(u, x, q, k):
    """A Helmholtz equation with a nonlinear term that hardly matters."""
    return helmholtz(u, x, q, k) + 1e-3 * u(x) ** 3


def quasilinear(u, x, q, k):
    return js.divergence(lambda y: (1.0 + u(y) ** 2) * js.grad(u)(y))(x)


def melting(u, x, q, k):
    """Conductivity that steps with the temperature."""
    k = lambda v: 1.0 + 0.5 * q["contrast"] * (1.0 + jnp.tanh((v - q["rate"]) / 0.2))
    return js.divergence(lambda y: k(u(y)) * js.grad(u)(y))(x)


def burgers(u, x, q, k):
    return u(x) * js.partial(u, _unit(len(x), 0))(x) - q["small"] * js.laplacian(u)(x)


def film(u, x, q, k):
    flow = lambda y: js.grad(u)(y) / jnp.sqrt(1.0 + js.grad(u)(y) @ js.grad(u)(y))
    return js.divergence(flow)(x)


def hilliard(u, x, q, k):
    """Cahn and Hilliard's equation in space and time."""
    v = lambda y: u(y) ** 3 - u(y) - 0.01 * js.partial(u, (2, 0))(y)
    return js.partial(u, (0, 1))(x) - 0.1 * js.partial(v, (2, 0))(x)


# ------------------------------------------------------------------ systems


def elasticity(u, x, q, k):
    def stress(y):
        g = js.grad(u)(y)
        return coefficient(k, y, q) * (q["lame"] * jnp.trace(g) * jnp.eye(len(y)) + g + g.T)

    return js.divergence(stress)(x)


def stokes(u, x, q, k):
    d = len(x)
    pressure = js.grad(_part(u, d))(x)
    momentum = [pressure[j] - js.laplacian(_part(u, j))(x) for j in range(d)]
    return jnp.stack([*momentum, sum(js.partial(_part(u, j), _unit(d, j))(x) for j in range(d))])


def coupled(u, x, q, k):
    a, b = u(x)[0], u(x)[1]
    first = js.divergence(lambda y: coefficient(k, y, q) * js.grad(_part(u, 0))(y))(x) - q["rate"] * (a - b)
    return jnp.stack([first, js.laplacian(_part(u, 1))(x) + q["speed"] * js.partial(_part(u, 0), _unit(len(x), 0))(x)])


def mixed_plate(u, x, q, k):
    return jnp.stack([js.laplacian(_part(u, 0))(x) - u(x)[1], js.laplacian(_part(u, 1))(x) + q["rate"] * u(x)[0]])


def brusselator(u, x, q, k):
    a, b = u(x)[0], u(x)[1]
    return jnp.stack([
        0.5 * js.laplacian(_part(u, 0))(x) - 4.0 * a + a**2 * b, js.laplacian(_part(u, 1))(x) + 3.0 * a - a**2 * b
    ])  # fmt: skip


def flow(u, x, q, k):
    """Navier and Stokes in two dimensions, its pressure held on a side."""
    v = jnp.stack([u(x)[0], u(x)[1]])
    carried = [v @ js.grad(_part(u, j))(x) for j in range(2)]
    return stokes(u, x, q, k) + jnp.stack([*carried, 0.0 * carried[0]])


@dataclass(frozen=True)
class Operator:
    """What may be asked of an operator: ``kind`` "linear", "nonlinear" or "system"; ``coefficients`` it takes.

    conditions : "elliptic" (one on every group for every field), or how the sides of a box are used: "third",
        "clamped", "inflow", "heat", "wave", "hilliard", "flow".
    """

    function: Callable[..., Any]
    kind: str
    order: int
    dims: tuple[int, ...]
    share: float = 1.0
    coefficients: tuple[str, ...] = ("even",)
    conditions: str = "elliptic"
    fields: Callable[[int], int] = lambda dim: 1


_ANY = (1, 2, 3)
OPERATORS = {
    op.function.__name__: op
    for op in (
        Operator(diffusion, "linear", 2, _ANY, 3.0, COEFFICIENTS),
        Operator(tensor, "linear", 2, (2, 3), 1.5, COEFFICIENTS),
        Operator(convection, "linear", 2, _ANY, 1.5, COEFFICIENTS),
        Operator(reaction, "linear", 2, _ANY, 1.5, COEFFICIENTS),
        Operator(helmholtz, "linear", 2, _ANY, 1.5, ("even", "mild", "step")),
        Operator(general, "linear", 2, _ANY, 1.5, COEFFICIENTS),
        Operator(third, "linear", 3, (1,), 1.5, ("even", "mild", "step"), "third"),
        Operator(beam, "linear", 4, (1,), 1.5, ("even", "mild", "step"), "clamped"),
        Operator(plate, "linear", 4, (2,), 0.7, ("even", "mild", "step"), "clamped"),
        Operator(transport, "linear", 1, _ANY, 0.7, ("even", "mild", "step"), "inflow"),
        Operator(heat, "linear", 2, (2,), 0.7, ("even", "mild", "step"), "heat"),
        Operator(vibration, "linear", 2, (2,), 0.7, ("even", "mild"), "wave"),
        Operator(cubic, "nonlinear", 2, _ANY, 1.5, ("even", "step")),
        Operator(bratu, "nonlinear", 2, _ANY, 1.0, ("even", "step")),
        Operator(disturbed, "nonlinear", 2, _ANY, 1.0),
        Operator(quasilinear, "nonlinear", 2, _ANY),
        Operator(melting, "nonlinear", 2, _ANY),
        Operator(burgers, "nonlinear", 2, _ANY),
        Operator(film, "nonlinear", 2, (1, 2)),
        Operator(hilliard, "nonlinear", 4, (2,), 0.3, conditions="hilliard"),
        Operator(elasticity, "system", 2, (2, 3), 1.5, COEFFICIENTS, fields=lambda dim: dim),
        Operator(stokes, "system", 2, (2, 3), 0.7, conditions="flow", fields=lambda dim: dim + 1),
        Operator(coupled, "system", 2, _ANY, 1.5, COEFFICIENTS, fields=lambda dim: 2),
        Operator(mixed_plate, "system", 2, _ANY, 1.0, fields=lambda dim: 2),
        Operator(brusselator, "system", 2, _ANY, 1.0, fields=lambda dim: 2),
        Operator(flow, "system", 2, (2,), 0.5, conditions="flow", fields=lambda dim: 3),
    )
}


@cache
def residual(name: str, coefficient_name: str, exact: Callable[[Any, Any], Any]) -> Callable[[Any, Any, Any], Any]:
    """The pde(u, x, q) with the source that the solution needs."""
    operator = OPERATORS[name].function
    if exact is laminate:  # without a source
        return lambda u, x, q: operator(u, x, q, coefficient_name)

    def pde(u, x, q):
        return operator(u, x, q, coefficient_name) - operator(lambda y: exact(y, q), x, q, coefficient_name)

    return pde
