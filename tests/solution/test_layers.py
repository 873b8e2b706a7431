"""Thin layers between the particles that hardly conduct, and coefficients narrower than the spacing in regions.

Between ends held at 0 and 1 the slope of (k u')' = 0 is c / k: what a layer adds to the integral of 1 / k is missed.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js

HELD = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
MISSED = "Between the particles the equation"


def bump(x, at, width):
    return jnp.exp(-(((x - at) / width) ** 2))


def layer(at=0.525, width=0.002, part=0.9999):
    return lambda y: 1.0 - part * bump(y[0], at, width)


def flow(k):
    return lambda u, x: js.divergence(lambda y: k(y) * js.grad(u)(y))(x)


def told(sol):
    return any(flag.startswith(MISSED) for flag in sol.flags)


@pytest.mark.parametrize("source", [0.0, 1.0])
@pytest.mark.parametrize("n, options", [(21, {}), (11, {}), (21, {"method": "SSPH"}), (21, {"formulation": "lsq"})])
def test_a_layer_that_hardly_conducts(n, options, source):
    """A sixth of the solution is lost, of which two orders agree to round-off."""
    pde = lambda u, x: flow(layer())(u, x) + source
    assert told(js.solve(js.Problem(pde, HELD), js.interval(0.0, 1.0, n), **options))


def test_where_the_equation_is_not_linear():
    pde = lambda u, x: js.divergence(lambda y: layer()(y) * (1.0 + u(y) ** 2) * js.grad(u)(y))(x)
    assert told(js.solve(js.Problem(pde, HELD), js.interval(0.0, 1.0, 21)))


def test_a_conductivity_that_is_small_at_a_value_between():
    """Of k(u) the integral is linear: a narrow dip of it takes nothing away, and u = x is right."""
    k = lambda u: 1.0 - 0.9999 * bump(u, 0.525, 0.002)
    pde = lambda u, x: js.divergence(lambda y: k(u(y)) * js.grad(u)(y))(x)
    assert not js.solve(js.Problem(pde, HELD), js.interval(0.0, 1.0, 21), u0=lambda x: x[0]).flags


@pytest.mark.parametrize("source, right", [(0.0, True), (1.0, False)])
def test_a_coefficient_that_is_no_flux(source, right):
    """k u'' = 0 is u'' = 0, layer or not; k u'' = -1 bends within it."""
    pde = lambda u, x: layer()(x) * js.laplacian(u)(x) + source
    sol = js.solve(js.Problem(pde, HELD), js.interval(0.0, 1.0, 21))
    assert told(sol) is not right and (not right or not sol.flags)


def test_a_flux_of_its_own():
    """q = k u', q' = -1: two equations of first order."""
    pde = lambda u, x: jnp.stack([u(x)[0] - layer()(x) * js.grad(u[1])(x)[0], js.grad(u[0])(x)[0] + 1.0])
    held = {"left": js.dirichlet(0.0, field=1), "right": js.dirichlet(1.0, field=1)}
    assert told(js.solve(js.Problem(pde, held, fields=2), js.interval(0.0, 1.0, 21)))


@pytest.mark.parametrize("tensor", [jnp.eye(2), jnp.array([[1.0, 0.3], [0.3, 2.0]])])
def test_on_a_lattice(tensor):
    pde = lambda u, x: js.divergence(lambda y: layer()(y) * tensor @ js.grad(u)(y))(x)
    held = {side: js.dirichlet(lambda x: x[0]) for side in ("left", "right", "bottom", "top")}
    assert told(js.solve(js.Problem(pde, held), js.rectangle((0, 0), (1, 0.5), (21, 11))))


def test_a_soft_layer_in_an_elastic_body():
    def pde(u, x):
        strain = lambda y: js.grad(u)(y) + js.grad(u)(y).T
        stress = lambda y: layer()(y) * (0.7 * strain(y) + 0.65 * jnp.trace(strain(y)) * jnp.eye(2))
        return js.divergence(stress)(x)

    pulled = {side: js.dirichlet(lambda x: jnp.array([x[0], 0.0])) for side in ("left", "right", "bottom", "top")}
    assert told(js.solve(js.Problem(pde, pulled, fields=2), js.rectangle((0, 0), (1, 0.5), (21, 11))))


def test_a_layer_along_the_flux_takes_nothing_away():
    ends = {**HELD, "bottom": js.neumann(0.0), "top": js.neumann(0.0)}
    pde = flow(lambda y: layer(at=0.225)(y[1:]))
    sol = js.solve(js.Problem(pde, ends), js.rectangle((0, 0), (1, 0.5), (21, 11)))
    np.testing.assert_allclose(sol.u, np.asarray(sol.cloud.points)[:, 0], atol=1e-9)
    assert not sol.flags


@pytest.mark.parametrize(
    "k", [lambda y: jnp.exp(8.0 * y[0]), lambda y: 1.0 + 0.9 * jnp.sin(2.0 * jnp.pi * y[0] + 0.3),
          lambda y: 1.0 - 0.9 * bump(y[0], 0.525, 0.3), lambda y: 1.0 + 5e3 * (1.0 + jnp.tanh((y[0] - 0.512) / 0.05))],
)  # fmt: skip
def test_resolved_coefficients_are_no_layers(k):
    assert not js.solve(js.Problem(flow(k), HELD), js.interval(0.0, 1.0, 41)).flags


# ------------------------------------------------------------------ several regions


def solved(pde, flux, **options):
    cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.05,
                       groups={"left": lambda x: x[:, 0] < 0.1, "right": lambda x: x[:, 0] > 0.9})  # fmt: skip
    return js.solve(js.Problem(pde, {**HELD, "a|b": js.interface(flux=flux)}), cloud, **options)


@pytest.mark.parametrize("at", [0.225, 0.725])
def test_a_layer_in_one_of_several_regions(at):
    flux = lambda u, x, n: layer(at)(x) * n @ js.grad(u)(x)
    sol = solved(dict.fromkeys("ab", flow(layer(at))), dict.fromkeys("ab", flux))
    assert any(flag.startswith("Between the particles the equations") for flag in sol.flags)


@pytest.mark.parametrize("width", [0.01, 0.0125, 0.015])
def test_regions_are_told_of_steep_coefficients_as_one_region_is(width):
    """A fifth is lost, while two orders agree to less than a hundredth: an estimate clears neither."""
    sink = lambda u, x: js.laplacian(u)(x) + 1.0 - 20.0 / width * bump(x[0], 0.725, width) * u(x)
    plain = lambda u, x: js.laplacian(u)(x) + 1.0
    flux = lambda u, x, n: n @ js.grad(u)(x)
    one = js.solve(js.Problem(sink, HELD), js.interval(0.0, 1.0, 21))
    several = solved({"a": plain, "b": sink}, {"a": flux, "b": flux})
    assert any("coefficients of the operator change" in flag for flag in one.flags)
    assert any("coefficients of the operator change" in flag for flag in several.flags)
