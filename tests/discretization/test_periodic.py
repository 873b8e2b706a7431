"""Sides that repeat each other: as accurate as held ones, corners included, and beside every kind of condition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.discretization.periodic import periodic_images, with_corners

wave = lambda x: jnp.sin(2 * jnp.pi * x[0]) * jnp.exp(x[-1])
slope = js.condition(lambda u, x, n: n @ (js.grad(u)(x) - js.grad(wave)(x)))
mixed = js.condition(lambda u, x, n: n @ (js.grad(u)(x) - js.grad(wave)(x)) + 2.0 * (u(x) - wave(x)))
held = js.dirichlet(wave)


def strip(**sides):
    around = {"left": js.periodic("left", "right"), "bottom": held, "top": held}
    return js.Problem(lambda u, x: js.laplacian(u)(x) - js.laplacian(wave)(x), around | sides)


def off(problem, cloud, order):
    sol = js.solve(problem, cloud, order=order)
    return np.abs(sol.u - jax.vmap(wave)(cloud.points)).max()


@pytest.mark.parametrize("jitter", [0.0, 0.2])
@pytest.mark.parametrize("bottom", [held, slope, mixed], ids=["dirichlet", "neumann", "robin"])
def test_a_strip_is_as_accurate_as_a_square(jitter, bottom):
    """Its corners too: with an equation of their own, one-sided and without the bottom's condition, they miss by 2e-4
    to 2e-3."""
    cloud = js.rectangle((0, 0), (1, 1), (13, 13), jitter=jitter)
    square = strip(bottom=bottom, left=held, right=held)
    assert off(strip(bottom=bottom), cloud, 8) < 3.0 * off(square, cloud, 8) < 1e-4


def test_a_bar_has_edges():
    cloud = js.box((0, 0, 0), (1, 0.5, 0.5), (13, 7, 7))
    sides = {"bottom": slope, "top": held, "front": held, "back": mixed}
    assert off(strip(**sides), cloud, 6) < 2.0 * off(strip(left=held, right=held, **sides), cloud, 6) < 5e-3


def test_corners_that_cannot_be_moved_stay():
    """Values by array have none for a corner; one that is held by hand is held once."""
    cloud = js.rectangle((0, 0), (1, 1), (13, 13))
    values = np.asarray(jax.vmap(wave)(cloud.points))
    bottom, left = cloud.groups["bottom"], cloud.groups["left"]
    assert off(strip(bottom=js.dirichlet(values[bottom])), cloud, 4) < 3e-3
    corners = left[[0, -1]]
    by_hand = strip(corners=js.fix(corners, values[corners]))
    assert off(by_hand, cloud, 8) < 1e-5
    assert [len(with_corners(p, cloud).groups["left"]) for p in (strip(), by_hand)] == [11, 13]


@pytest.mark.parametrize("method, most", [("S", 1e-5), ("III", 5e-3), ("SSPH", 2e-2)])
def test_corners_that_are_one_are_one_unknown(method, most):
    """The pair of the bottom has no corners: left with an equation each, two that fall on one another stated it twice,
    which made SSPH singular."""
    cloud = js.rectangle((0, 0), (1, 1), (13, 13))
    exact = lambda x: jnp.sin(2 * jnp.pi * x[0]) * jnp.cos(2 * jnp.pi * x[1])
    pde = lambda u, x: js.laplacian(u)(x) - u(x) - (js.laplacian(exact)(x) - exact(x))
    sides = {"left": js.periodic("left", "right"), "bottom": js.periodic("bottom", "top")}
    sol = js.solve(js.Problem(pde, sides), cloud, method=method)
    corners = [int(np.argmin(np.linalg.norm(cloud.points - np.array(at), axis=1))) for at in np.ndindex(2, 2)]
    assert np.ptp(np.asarray(sol.u)[corners]) == 0.0 and sol.stats["unknowns"] == 144
    assert np.abs(sol.u - jax.vmap(exact)(cloud.points)).max() < most


def test_a_corner_lends_the_value_that_it_is_given():
    """Of two that are one it is the other that takes, whichever is held; two held ones stay as they are."""
    cloud = js.rectangle((0, 0), (1, 1), (9, 9))
    sides = {"left": js.periodic("left", "right"), "bottom": js.periodic("bottom", "top")}
    low, high = (int(np.argmin(np.linalg.norm(cloud.points - np.array(at), axis=1))) for at in ((0, 0), (0, 1)))
    for given, partners in (([low], (low, low)), ([high], (high, high)), ([low, high], (low, high))):
        held = np.isin(np.arange(len(cloud)), given)
        _, partner = periodic_images(js.Problem(lambda u, x: js.laplacian(u)(x), sides), cloud, held)
        assert (partner[low], partner[high]) == partners


def test_a_torus_has_no_sides():
    """Periodic both ways, held at one particle by nothing but its equation."""
    cloud = js.rectangle((0, 0), (1, 1), (17, 17), jitter=0.2)
    exact = lambda x: jnp.sin(2 * jnp.pi * x[0]) * jnp.cos(2 * jnp.pi * x[1])
    pde = lambda u, x: js.laplacian(u)(x) - u(x) - (js.laplacian(exact)(x) - exact(x))
    bcs = {"left": js.periodic("left", "right"), "bottom": js.periodic("bottom", "top")}
    sol = js.solve(js.Problem(pde, bcs), cloud, order=8)
    assert np.abs(sol.u - jax.vmap(exact)(cloud.points)).max() < 1e-4
    assert sol.flags == []
