"""What rows of all orders miss alike is in the errors of eigenvalues: jumps, corners, changes of conditions."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jsmitsm as js

ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}


def told(modes, exact):
    """The estimated errors in parts of the true ones."""
    values = np.asarray(modes.values)[: len(exact)]
    return modes.error_estimate()[: len(exact)] / np.abs(values - exact)


@pytest.mark.parametrize("n", [41, 161, 641])
def test_a_string_whose_mass_jumps(n):
    """Mass 1 and 9 left and right of c: 3 sin w c cos 3 w (1 - c) + cos w c sin 3 w (1 - c) = 0."""
    c = 0.4137
    zero = lambda w: 3 * np.sin(w * c) * np.cos(3 * w * (1 - c)) + np.cos(w * c) * np.sin(3 * w * (1 - c))
    string = js.Problem(lambda u, x: -js.laplacian(u)(x), ENDS)
    modes = js.eigen(string, js.interval(0.0, 1.0, n), 1, mass=lambda x: jnp.where(x[0] < c, 1.0, 9.0))
    assert 0.2 < told(modes, [brentq(zero, 1.0, 1.4) ** 2])[0] < 20


@pytest.mark.parametrize("n", [41, 161, 641])
def test_a_square_well(n):
    a, depth = 0.4337, 50.0
    zero = lambda e: np.sqrt(e + depth) * np.tan(np.sqrt(e + depth) * a) - np.sqrt(-e) / np.tanh(np.sqrt(-e) * (3 - a))
    exact = brentq(zero, -depth + 1e-6, -depth + (np.pi / 2 / a) ** 2 - 1e-6)
    well = js.Problem(lambda u, x: -js.laplacian(u)(x) - jnp.where(abs(x[0]) < a, depth, 0.0) * u(x), ENDS)
    assert 0.2 < told(js.eigen(well, js.interval(-3.0, 3.0, n), 1, near=-50.0), [exact])[0] < 10


def test_a_bead_that_no_particle_sees():
    """Its mass is that of half the string; the value without it is three times too large."""
    bead = lambda x: 1 + jnp.exp(-(((x[0] - 0.4137) / 0.003) ** 2)) / (0.003 * np.sqrt(np.pi))
    string = js.Problem(lambda u, x: -js.laplacian(u)(x), ENDS)
    modes = js.eigen(string, js.interval(0.0, 1.0, 41), 1, mass=bead)
    assert modes.error_estimate()[0] > 0.3 * abs(modes.values[0] - 3.05407) and modes.flags


@pytest.mark.parametrize(("spacing", "order"), [(0.1, 4), (0.1, 6), (0.05, 4)])
def test_where_a_held_side_meets_a_free_one(spacing, order):
    """The lowest mode of half a disk with half of its flat side free is sin(pi r) / sqrt(r) sin(t / 2)."""
    t = np.linspace(0, np.pi, 200)
    half = [(0.0, 0.0), *zip(np.cos(t), np.sin(t))]
    groups = {"held": lambda x: x[:, 0] >= -1e-9, "free": lambda x: x[:, 1] < 1e-9, "arc": lambda x: x[:, 1] > 0}
    bcs = {"held": js.dirichlet(0.0), "free": js.neumann(0.0), "arc": js.dirichlet(0.0)}
    problem, cloud = js.Problem(lambda u, x: -js.laplacian(u)(x), bcs), js.from_polygon(half, spacing, groups=groups)
    modes = js.eigen(problem, cloud, 1, order=order)
    assert 0.15 < told(modes, [np.pi**2])[0] < 5


def test_the_corner_of_an_ell():
    ell = js.from_polygon([(0, 0), (1, 0), (1, 1), (-1, 1), (-1, -1), (0, -1)], 0.1)
    modes = js.eigen(js.Problem(lambda u, x: -js.laplacian(u)(x), {"boundary": js.dirichlet(0.0)}), ell, 2)
    ratio = told(modes, [9.6397238440219, 15.197251926454335])
    assert (0.2 < ratio).all() and (ratio < 15).all()


@pytest.mark.parametrize("tol", [1e-9, -1e-9])
def test_a_condition_that_changes_within_a_free_boundary(tol):
    """Half of the bottom of a square is held, and all the rest is free; on graded finite elements."""
    groups = {"held": lambda x: (x[:, 1] < 1e-9) & (x[:, 0] < 0.5 + tol), "free": lambda x: x[:, 0] > -9}
    cloud = js.from_sdf(js.sdf.rectangle((0, 0), (1, 1)), ((0, 0), (1, 1)), 0.1, groups=groups)
    bcs = {"held": js.dirichlet(0.0), "free": js.neumann(0.0)}
    ratio = told(js.eigen(js.Problem(lambda u, x: -js.laplacian(u)(x), bcs), cloud, 3), [1.6303, 10.4251, 15.2419])
    assert (0.2 < ratio).all() and (ratio < 5).all()


def test_the_ends_of_a_clamped_side():
    """The lowest mode of an elastic square, both Lame constants 1: it is singular where the clamped side ends."""
    elastic = lambda u, x: jnp.stack([-js.laplacian(u[k])(x) - 2 * js.grad(js.divergence(u))(x)[k] for k in range(2)])

    def traction(u, x, n):
        g = jnp.stack([js.grad(u[0])(x), js.grad(u[1])(x)])
        return jnp.trace(g) * n + (g + g.T) @ n

    bcs = {side: js.condition(traction) for side in ("right", "bottom", "top")} | {"left": js.dirichlet(0.0)}
    modes = js.eigen(js.Problem(elastic, bcs, fields=2), js.rectangle((0, 0), (1, 1), (13, 13)), 1)
    assert 0.3 < told(modes, [1.14421])[0] < 5


def test_waves_of_equations_that_have_them_only_together():
    """A damped string, u_t = v and v_t = u_xx - 4 v: a wave of number k has a value of about the size k."""
    damped = lambda u, x: jnp.stack([u(x)[1], js.laplacian(u[0])(x) - 4 * u(x)[1]])
    string = js.Problem(damped, {side: js.dirichlet(0.0, field=0) for side in ENDS}, fields=2)
    modes = js.eigen(string, js.interval(0.0, 1.0, 41), 2, mass=(1.0, 1.0))
    assert modes.flags == []
    assert 0.9 < modes._question.highest() / (20 * np.pi) < 1.1


def test_smooth_modes_are_judged_by_two_orders_alone():
    """Where nothing is missed the other order decides, coefficients that vary or not."""
    for problem, exact in (
        (js.Problem(lambda u, x: -js.laplacian(u)(x), ENDS), None),
        (js.Problem(lambda u, x: -js.laplacian(u)(x) + x[0] ** 2 * u(x), ENDS), np.array([1.0, 3.0])),
    ):
        cloud = js.interval(0.0, 1.0, 41) if exact is None else js.interval(-8.0, 8.0, 81)
        exact = (np.pi * np.arange(1, 3)) ** 2 if exact is None else exact
        ratio = told(js.eigen(problem, cloud, 2), exact)
        assert (0.2 < ratio).all() and (ratio < 5).all()


@pytest.mark.parametrize(("order", "jitter"), [(2, 0.0), (4, 0.0), (4, 0.2)])
def test_the_seam_of_a_torus_is_no_gap(order, jitter):
    pairs = {"left": js.periodic("left", "right"), "bottom": js.periodic("bottom", "top")}
    torus = js.Problem(lambda u, x: -js.laplacian(u)(x), pairs)
    modes = js.eigen(torus, js.rectangle((0, 0), (1, 1), (13, 13), jitter=jitter), 5, order=order)
    error = np.abs(modes.values[1:5] - 4 * np.pi**2).max()
    assert error < modes.error_estimate()[1] * 4 < 60 * error and not modes.flags


@pytest.mark.parametrize("place", [0.4137, 0.988])
def test_a_bead_on_a_ring_is_told_beside_the_seam_too(place):
    """Half of the ring's mass; the sine that vanishes there has the value 4 pi^2, the others change."""
    away = lambda x: (x[0] - place + 0.5) % 1.0 - 0.5
    bead = lambda x: 1 + jnp.exp(-((away(x) / 0.003) ** 2)) / (0.003 * np.sqrt(np.pi))
    ring = js.Problem(lambda u, x: -js.laplacian(u)(x), {"left": js.periodic("left", "right")})
    modes = js.eigen(ring, js.interval(0.0, 1.0, 41), 3, mass=bead)
    assert modes.error_estimate()[1:].max() > 1.0 and modes.flags
