"""Sources and potentials that are infinite between the particles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh_tridiagonal

import jsmitsm as js
from jsmitsm.discretization.coefficients import numbers

DISK = js.from_sdf(lambda x: jnp.sqrt(jnp.sum(x**2)) - 1.0, ((-1.0, -1.0), (1.0, 1.0)), 0.12)
CENTRE = np.array([0.013, 0.021])


def radius(x):
    return jnp.sqrt(jnp.sum((x - CENTRE) ** 2))


def cusp(x):
    return jnp.exp(-radius(x))


def off(sol, exact):
    right = np.asarray(jax.vmap(exact)(sol.cloud.points))
    return np.linalg.norm(np.asarray(sol.u) - right) / np.linalg.norm(right)


POTENTIAL = js.Problem(
    lambda u, x: js.laplacian(u)(x) + u(x) / radius(x) - u(x), {"boundary": js.dirichlet(cusp)}
)
SOURCE = js.Problem(
    lambda u, x: js.laplacian(u)(x) - (1.0 - 1.0 / radius(x)) * cusp(x), {"boundary": js.dirichlet(cusp)}
)


@pytest.mark.parametrize(
    "problem, what, options",
    [(POTENTIAL, "A coefficient is infinite", {}), (SOURCE, "The source is infinite", {}),
     (POTENTIAL, "A coefficient is infinite", {"formulation": "lsq"}),
     (POTENTIAL, "A coefficient is infinite", {"method": "III"})],
)  # fmt: skip
def test_a_cusp_is_found_to_first_order_and_told(problem, what, options):
    """Series made of it a solution that vanishes at the point: 25 % off on clouds of every spacing."""
    sol = js.solve(problem, DISK, order=4, **options)
    error = off(sol, cusp)
    assert error < 0.06
    told = np.linalg.norm(sol.error_estimate()) / np.linalg.norm(sol.u)
    assert 0.3 < told / error < 10.0
    assert any(what in line and "0.013" in line for line in sol.flags)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.05, 0.01), (0.02, 0.06)])
def test_wherever_the_point_lies_in_the_spacing(shift):
    centre = CENTRE + np.array(shift)
    front = lambda x: jnp.arctan(5.0 * (jnp.sqrt(jnp.sum((x - centre) ** 2)) - 0.5))
    problem = js.Problem(
        lambda u, x: js.laplacian(u)(x) - js.laplacian(front)(x), {"boundary": js.dirichlet(front)}
    )
    sol = js.solve(problem, DISK, order=4)
    assert off(sol, front) < 0.03
    assert 0.3 < np.linalg.norm(sol.error_estimate()) / np.linalg.norm(sol.u) / off(sol, front) < 10.0


def test_what_is_only_steep_stays_as_it_is():
    """Where 1 / v has no zero there is no pole, however narrow it is."""
    narrow = lambda u, x: js.laplacian(u)(x) - 1.0 / (1e-4 + (jnp.sum((x - CENTRE) ** 2) - 0.2) ** 2)
    problem = js.Problem(narrow, {"boundary": js.dirichlet(0.0)})
    assert js.solve(problem, DISK, order=4)._report.nums.poles is None


@pytest.mark.parametrize("n", [20, 41])
def test_an_analytic_solution_across_a_pole_of_a_slope_keeps_its_order(n):
    """u'' + 2 u' / x + u = 0 by sin(x) / x: the series of both coefficients belong together."""
    exact = lambda x: jnp.sinc(x[0] / jnp.pi)
    ends = {"left": js.dirichlet(exact), "right": js.dirichlet(exact)}
    spherical = js.Problem(lambda u, x: js.laplacian(u)(x) + 2.0 * jax.grad(u)(x)[0] / x[0] + u(x), ends)
    sol = js.solve(spherical, js.interval(-1.0, 1.03, n), order=4)
    assert off(sol, exact) < 1e-9 and not sol.flags


def test_an_axis_keeps_its_order():
    """A potential 4 / r^2 on the axis: the cloud ends there."""
    exact = lambda x: x[0] ** 2 * jnp.cos(x[1])
    corner = [(0, 0), (1, 0), (1, 1), (0, 1)]
    groups = {"axis": lambda x: x[:, 0] < 1e-9, "rest": lambda x: x[:, 0] >= 1e-9}
    cloud = js.from_polygon(corner, 0.1, groups=groups)
    slope = lambda u, x: jax.grad(u)(x)[0]
    pde = lambda u, x: js.laplacian(u)(x) + slope(u, x) / x[0] - 4.0 * u(x) / x[0] ** 2 + u(x)
    problem = js.Problem(pde, {"axis": js.dirichlet(0.0), "rest": js.dirichlet(exact)})
    sol = js.solve(problem, cloud, order=4)
    assert off(sol, exact) < 1e-6 and sol._report.nums.poles is None


LINE = js.interval(-1.0, 1.0, 24)


def distance(x):
    return jnp.sqrt((x[0] - 0.013) ** 2)


def test_gradients_pass_through_what_takes_the_place_of_series():
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}

    def size(k):
        pde = lambda u, x: js.laplacian(u)(x) - k * u(x) / jnp.sqrt(distance(x)) + k / distance(x) ** 0.25
        return jnp.sum(js.solve(js.Problem(pde, ends), LINE, order=4).u ** 2)

    slope = (size(1.3 + 1e-5) - size(1.3 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(size)(1.3), slope, rtol=1e-7)


def test_modes_about_an_infinite_potential_say_that_they_are_not_smooth():
    """Against differences on 4,000 cells: -34.7, and of series -5.8; in the plane of a charge -0.5 for -2."""
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    well = js.Problem(lambda u, x: -js.laplacian(u)(x) - 10.0 * u(x) / jnp.sqrt(distance(x)), ends)
    modes = js.eigen(well, js.interval(-1.0, 1.0, 90), 1, near=-30.0, order=4)
    x = np.linspace(-1.0, 1.0, 4004)[1:-1]
    size = (2.0 / 4003) ** 2
    diagonal = 2.0 / size - 10.0 / np.sqrt(np.abs(x - 0.013))
    right = eigh_tridiagonal(diagonal, np.full(len(x) - 1, -1.0 / size), select="i", select_range=(0, 0))[0][0]
    assert abs(modes.values[0] / right - 1.0) < 0.05
    assert any("is infinite at x = [0.013]" in line for line in modes.flags)


def test_the_numbers_beside_a_pole_are_fits_and_all_others_series():
    found = js.solve(SOURCE, DISK, order=4)._report
    before = found.disc.traced.coefficients(found.disc.cloud.points[found.nums.ids], found.disc.rec.degree)[1]
    changed = np.flatnonzero((np.asarray(found.nums.source) != -before[0]).any(axis=0))
    assert set(found.nums.ids[changed]) == set(found.nums.poles.ids)
    near = np.linalg.norm(np.asarray(DISK.points)[found.nums.poles.ids] - CENTRE, axis=1)
    assert near.max() < 4 * DISK.spacing
    assert numbers(found.disc, found.problem).poles.at[0] == pytest.approx(CENTRE)
