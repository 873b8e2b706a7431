"""Equations that transport: what nothing damps is refused, an axis is none of it."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import j0

import jsmitsm as js

ROD = js.interval(0.0, 1.0, 21)
SQUARE = js.rectangle((0.0, 0.0), (1.0, 1.0), (7, 7))


def slope(u, x, axis=0):
    return js.grad(u)(x)[axis]


WAVES = {
    "acoustics": (ROD, lambda u, x: [slope(u[1], x), slope(u[0], x)], "equations \\[0, 1\\]"),
    "with friction": (ROD, lambda u, x: [slope(u[1], x), slope(u[0], x) + u(x)[1]], "js.dt\\(u, 2\\)"),
    "beside diffusion": (
        ROD,
        lambda u, x: [slope(u[1], x), slope(u[0], x) + slope(u[2], x), -js.laplacian(u[2])(x)],
        "equations \\[0, 1\\]",
    ),
    "Maxwell": (
        SQUARE,
        lambda u, x: [slope(u[1], x, 1) - slope(u[2], x), slope(u[0], x, 1), -slope(u[0], x)],
        "equations \\[0, 1, 2\\]",
    ),
}
DAMPED = {
    "diffusion in one of them": lambda u, x: [slope(u[1], x), slope(u[0], x) - js.laplacian(u[1])(x)],
    "a wave by its rate": lambda u, x: [-u(x)[1], -js.laplacian(u[0])(x)],
    "Schroedinger": lambda u, x: [js.laplacian(u[1])(x), -js.laplacian(u[0])(x)],
    "diffusion with drift": lambda u, x: [
        slope(u[1], x) - js.laplacian(u[0])(x),
        slope(u[0], x) - js.laplacian(u[1])(x),
    ],
}


def stated(cloud, space, fields):
    pde = lambda u, x, t: js.dt(u)(x) + jnp.stack(space(u, x))  # noqa: E731
    sides = [name for name in cloud.groups if name != "interior"]
    return js.Problem(pde, dict.fromkeys(sides, js.dirichlet(0.0, field=0)), fields=fields)


@pytest.mark.parametrize("name", WAVES)
def test_waves_of_first_order_are_refused(name):
    cloud, space, words = WAVES[name]
    with pytest.raises(ValueError, match=words):
        js.evolve(
            stated(cloud, space, 3 if name in ("Maxwell", "beside diffusion") else 2), cloud, 0.0, (0.0, 0.1), steps=1
        )


@pytest.mark.parametrize("name", DAMPED)
def test_what_an_equation_of_higher_order_damps_is_not(name):
    found = js.evolve(stated(ROD, DAMPED[name], 2), ROD, jnp.zeros(2), (0.0, 0.1), steps=1, order=4, progress=False)
    assert found.converged


def test_a_flux_without_a_rate_is_no_wave():
    """Heat by its flux: q = u_x has no rate, and what is transported diffuses."""
    pde = lambda u, x, t: jnp.stack([js.dt(u)(x)[0] - slope(u[1], x), u(x)[1] - slope(u[0], x)])
    problem = js.Problem(pde, dict.fromkeys(("left", "right"), js.dirichlet(0.0, field=0)), fields=2)
    assert js.evolve(problem, ROD, jnp.zeros(2), (0.0, 0.1), steps=1, order=4, progress=False).converged


@pytest.mark.parametrize("begin", [0.0, 1e-9, 1e-4])
@pytest.mark.parametrize("left", [js.neumann(0.0), js.free()])
def test_a_cylinder_cools_from_its_axis_on(left, begin):
    """Multiplied by the radius rate, diffusion and convection end with u_r = 0 on the axis: J0(k r) exp(-k^2 t)."""
    k, rod = 2.404825557695773, js.interval(begin, 1.0, 31)
    pde = lambda u, x, t: x[0] * (js.dt(u)(x) - js.laplacian(u)(x)) - js.grad(u)(x)[0]
    problem = js.Problem(pde, {"left": left, "right": js.dirichlet(0.0)})
    start = j0(k * np.asarray(rod.points[:, 0]))
    found = js.evolve(problem, rod, start, (0.0, 0.3), steps=20, order=6, progress=False)
    assert found.flags == [] and np.abs(found.u[-1] - start * np.exp(-(k**2) * 0.3)).max() < 2e-6


def test_a_layer_that_conducts_little_is_no_axis():
    """Its rate and its diffusion are small throughout, and what flows through it is refused as ever."""
    part = lambda x: 0.501 + 0.499 * jnp.tanh(50 * (x[0] - 0.5))
    pde = lambda u, x, t: part(x) * (js.dt(u)(x) - js.laplacian(u)(x)) - js.grad(u)(x)[0]
    with pytest.raises(ValueError, match="cell Peclet number"):
        js.evolve(js.Problem(pde, dict.fromkeys(("left", "right"), js.dirichlet(0.0))), ROD, 0.0, (0.0, 0.1), steps=1)
