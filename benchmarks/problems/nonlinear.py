"""Nonlinear equations of one field."""

from __future__ import annotations

import jax.numpy as jnp

import jsmitsm as js
from benchmarks import scenes
from benchmarks.problems.case import Case, on_box, scattered, smooth, table, zero

BRATU = 0.140539214400472


def _bratu(u, x):
    return js.laplacian(u)(x) + jnp.exp(u(x))


def _bratu_line(x):
    """u = 2 log(cosh(t/4) / cosh((x - 1/2) t/2)) with t = sqrt(2) cosh(t/4)."""
    t = 1.5171645990507543
    return 2 * jnp.log(jnp.cosh(t / 4) / jnp.cosh((x[0] - 0.5) * t / 2))


def _middle(case: Case, sol: js.Solution) -> float:
    return abs(float(sol.u[20]) - BRATU)


def _liouville(x):
    """A solution of laplacian(u) + exp(u) = 0, Liouville's."""
    a = 0.45
    return jnp.log(8 * a) - 2 * jnp.log(1 + a * ((x[0] - 0.3) ** 2 + (x[1] - 0.6) ** 2))


def _quasilinear(u, x):
    return js.divergence(lambda y: (1 + u(y) ** 2) * js.grad(u)(y))(x)


def _burgers(u, x):
    return js.partial(u, (0, 1))(x) + u(x) * js.partial(u, (1, 0))(x) - 0.1 * js.partial(u, (2, 0))(x)


def _front(x):
    """A travelling front of Burgers' equation with viscosity 0.1."""
    return 0.6 - 0.4 * jnp.tanh(0.4 * (x[0] - 0.3 - 0.6 * x[1]) / 0.2)


def _film(u, x):
    return js.divergence(lambda y: js.grad(u)(y) / jnp.sqrt(1 + js.grad(u)(y) @ js.grad(u)(y)))(x)


_SQUARE = {"cloud": scenes.square, "steps": 8, "coarse": 400, "rates": {4: 3.5, 6: 5.5}, "estimates": (4, 6)}
NONLINEAR = table(
    on_box(
        "bratu 1D", "u'' + exp(u) = 0, u(1/2) = 0.140539214400472", _bratu, _bratu_line, (0.0,), (1.0,), 41,
        source=zero, bcs={"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}, ceilings={8: 1e-11}, steps=6,
        particles=41, further={"middle": (_middle, {8: 1e-12})},
    ),
    scattered("bratu 2D", "laplacian(u) + exp(u) = 0", _bratu, _liouville, {4: 1e-6, 6: 1e-9}, source=zero, **_SQUARE),
    scattered(
        "quasilinear", "div((1 + u^2) grad u) = f", _quasilinear, smooth, {4: 6e-7, 6: 1.1e-9},
        before={4: 8e-6, 6: 5e-8}, **_SQUARE,
    ),
    scattered(
        "burgers", "u_t + u u_x = u_xx/10 in space-time, a front", _burgers, _front, {4: 1e-4, 6: 1e-6}, source=zero,
        # Depth gains more on the coarser cloud at order 4, where the observed order is 3.05 for it.
        bcs={"top": js.free()}, **_SQUARE | {"rates": {4: 3.0, 6: 5.5}},
    ),
    on_box(
        "soap film", "no mean curvature, u = log(cos y / cos x) (Scherk)", _film,
        lambda x: jnp.log(jnp.cos(x[1]) / jnp.cos(x[0])), (-1.0, -1.0), (1.0, 1.0), 19, 0.3, source=zero,
        ceilings={6: 1e-4}, steps=8,
    ),
)  # fmt: skip
