"""The unit in which a pressure is counted, or a viscosity, is no part of the answer."""

import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.discretization.coefficients import numbers
from jsmitsm.discretization.layout import discretize
from jsmitsm.solution.estimate import comparable
from jsmitsm.solution.flags import SQUARED
from jsmitsm.solution.look.sizes import share


def exact(x):
    """A flow without divergence, and a pressure."""
    return jnp.stack([jnp.sin(x[0]) * jnp.exp(x[1]), -jnp.cos(x[0]) * jnp.exp(x[1]), jnp.sin(x[0] + 2.0 * x[1])])


CLOUD = js.rectangle((0.0, 0.0), (1.0, 1.0), (8, 8), jitter=0.2)


def stokes(unit, viscosity=1.0):
    """Stokes' equations with the pressure in so many times its unit."""

    def operator(u, x, q):
        part = lambda k: lambda y: u(y)[k]
        slope = q["unit"] * js.grad(part(2))(x)
        carried = [slope[k] - q["viscosity"] * js.laplacian(part(k))(x) for k in range(2)]
        return jnp.stack([*carried, js.partial(part(0), (1, 0))(x) + js.partial(part(1), (0, 1))(x)])

    def pde(u, x, q):
        true = lambda y: exact(y) * jnp.array([1.0, 1.0, q["viscosity"] / q["unit"]])
        return operator(u, x, q) - operator(true, x, q)

    walls = [js.dirichlet(lambda x, q, k=k: exact(x)[k], field=k) for k in range(2)]
    bcs = {group: walls for group in ("left", "right", "bottom", "top")}
    params = {"unit": float(unit), "viscosity": float(viscosity)}
    return js.Problem(pde, bcs, fields=3, params=params)


def solved(unit, viscosity=1.0):
    """Its solution with the pressure in the usual unit again."""
    return np.asarray(js.solve(stokes(unit, viscosity), CLOUD).u) * [1.0, 1.0, unit / viscosity]


@pytest.mark.parametrize(("unit", "viscosity"), [(1e-5, 1.0), (1e4, 1.0), (1.0, 1e-3)])
def test_a_flow_is_the_same_in_all_units(unit, viscosity):
    """Only round-off differs; by powers of the length alone velocities differed by as much as their errors."""
    usual, other = solved(1.0), solved(unit, viscosity)
    true = np.array([exact(x) for x in CLOUD.points])
    true[:, 2] -= true[:, 2].mean()
    assert np.abs(usual - true)[:, :2].max() < 1e-4  # truncation: seven spacings, order 4
    assert np.abs(usual - true)[:, 2].max() < 1e-2
    np.testing.assert_allclose(other, usual, atol=1e-9)


@pytest.mark.parametrize(("unit", "viscosity"), [(1e9, 1.0), (1.0, 1e-8)])
def test_a_pressure_in_a_large_unit_is_no_field_of_zeros(unit, viscosity):
    """Water in kinematic units: a wrong pressure of 1e-8 is no round-off of velocities of one; one of 1e-8 of its own
    unit is."""
    disc = discretize(stokes(unit, viscosity), CLOUD, "S", 2, None, None, None, depth=0)
    units = comparable(disc, numbers(disc, disc.problem))
    size = np.array([1.0, 1.0, viscosity / unit])
    values, error = np.ones((9, 1)) * size, 0.5 * np.eye(3)[2] * size * np.ones((9, 1))
    assert share(error * units, values * units, SQUARED) == pytest.approx(0.5)
    faint = np.array([1.0, 1.0, 1e-8])
    assert share(error * faint * units, values * faint * units, SQUARED) < 0.1
