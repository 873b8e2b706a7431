"""Errors of evolutions that are not like those of smooth heat: what grows, what is over soon, what was never seen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js

ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}


@pytest.mark.parametrize("rate", [12.0, 20.0, 30.0])
@pytest.mark.parametrize("waves", [1, 2])
def test_what_grows(rate, waves):
    """u_t = u'' + rate u: from two half-waves the error, of which the lowest grows, is soon all there is."""
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) - rate * u(x), ENDS)
    start = lambda x: jnp.sin(waves * jnp.pi * x[0])
    run = js.evolve(problem, js.interval(0.0, 1.0, 41), start, t=(0.0, 1.0), tol=1e-8)
    exact = np.exp(rate - (waves * np.pi) ** 2) * np.sin(waves * np.pi * run.cloud.points[:, 0])
    ratio = float(run.error_estimate()[-1].max()) / np.abs(run.u[-1] - exact).max()
    assert 0.5 < ratio < 2.0


RATES = {
    "square": lambda u, x, t: 4.0 * u(x) ** 2,
    "in time": lambda u, x, t: 8.0 * (1.0 + 0.5 * jnp.sin(t)) * u(x),
    "convection": lambda u, x, t: 5.0 * u(x) - 0.3 * u(x) * js.grad(u)(x)[0],
}


@pytest.mark.parametrize("name", RATES)
@pytest.mark.parametrize("scheme", ["imex", "esdirk"])
def test_what_grows_by_a_reaction(name, scheme):
    """Errors go on as small changes of the run do, which what is nonlinear drives too."""
    cloud = js.interval(0.0, 1.0, 33)
    exact = lambda x, t: 1.0 + 0.5 * jnp.cos(2 * jnp.pi * x[0]) * jnp.cos(t)
    made = lambda u, x, t: 0.01 * js.laplacian(u)(x) + RATES[name](u, x, t)
    problem = js.Problem(
        lambda u, x, t: js.dt(u)(x) - made(u, x, t) - jax.grad(exact, 1)(x, t) + made(lambda y: exact(y, t), x, t),
        {"left": js.neumann(0.0), "right": js.neumann(0.0)},
    )
    run = js.evolve(problem, cloud, lambda x: exact(x, 0.0), t=(0.0, 1.0), steps=80, scheme=scheme)
    error = np.abs(run.u[-1] - np.asarray(jax.vmap(exact, (0, None))(cloud.points, 1.0))).max()
    assert error > 1e-3 and 0.7 * error < float(run.error_estimate()[-1].max()) < 1.5 * error


@pytest.mark.parametrize("scheme", ["imex", "esdirk"])
def test_what_steps_leave_grows_as_well(scheme):
    """u' = 10 u (1 - u), no error in space: what the first steps leave grows a thousandfold."""
    rate = lambda u, x, t: js.dt(u)(x) - 0.01 * js.laplacian(u)(x) - 10 * u(x) * (1 - u(x))
    problem = js.Problem(rate, {"left": js.neumann(0.0), "right": js.neumann(0.0)})
    for n in (10, 40):
        run = js.evolve(problem, js.interval(0.0, 1.0, 17), 1e-3, t=(0.0, 0.7), steps=n, scheme=scheme)
        error = np.abs(run.u[-1] - 1 / (1 + 999 * np.exp(-7.0))).max()
        assert 0.3 * error < float(run.error_estimate()[-1].max()) < 10 * error


def test_what_is_over_soon():
    """A wave of five particles is gone after a hundredth of the time, and its error goes on with the slow one."""
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ENDS)
    start = lambda x: jnp.sin(jnp.pi * x[0]) + jnp.sin(9 * jnp.pi * x[0])
    run = js.evolve(problem, js.interval(0.0, 1.0, 41), start, t=(0.0, 0.2), tol=1e-6, save=20)
    x = run.cloud.points[:, 0]
    exact = [sum(np.exp(-((k * np.pi) ** 2) * t) * np.sin(k * np.pi * x) for k in (1, 9)) for t in run.t]
    error, told = np.abs(run.u - np.array(exact)).max(), run.error_estimate().max()
    assert 0.3 * error < told < 30 * error


@pytest.mark.parametrize("last", [4.0, 20.0])
def test_a_string_that_goes_on_and_on(last):
    """The error grows for as long as it is in phase with what makes it, over sixty periods."""
    problem = js.Problem(lambda u, x, t: js.dt(u, 2)(x) - js.laplacian(u)(x), ENDS)
    k = 6 * np.pi
    start = (lambda x: jnp.sin(k * x[0]), 0.0)
    run = js.evolve(problem, js.interval(0.0, 1.0, 41), start, t=(0.0, last), tol=1e-4, order=6)
    exact = np.sin(k * run.cloud.points[:, 0]) * np.cos(k * last)
    ratio = float(run.error_estimate()[-1].max()) / np.abs(run.u[-1] - exact).max()
    assert 0.8 < ratio < 1.25


@pytest.mark.parametrize("n", [21, 31, 51])
def test_a_start_that_jumps(n):
    """A hot disk in an insulated box: at the end its heat is spread evenly, what the particles have of it."""
    box = js.rectangle((0, 0), (1, 1), (n, n))
    hot = lambda x: jnp.where(jnp.hypot(x[0] - 0.5, x[1] - 0.5) < 0.3, 1.0, 0.0)
    sides = dict.fromkeys(("left", "right", "bottom", "top"), js.neumann(0.0))
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), sides)
    run = js.evolve(problem, box, hot, t=(0.0, 1.0), tol=1e-5)
    error = np.abs(run.u[-1] / (np.pi * 0.09) - 1).max()
    assert run.error_estimate()[-1].max() / (np.pi * 0.09) > error / 6
    assert (run.error_estimate()[0] == 0).all()


def test_a_spot_that_no_particle_sees():
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ENDS)
    spot = lambda x: jnp.exp(-(((x[0] - 0.5137) / 0.004) ** 2)) + 0.01 * jnp.sin(jnp.pi * x[0])
    run = js.evolve(problem, js.interval(0.0, 1.0, 41), spot, t=(0.0, 0.01), steps=20)
    assert any("The start changes within the spacing" in flag for flag in run.flags)


def test_smooth_starts_and_arrays_are_not_doubted():
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ENDS)
    cloud = js.interval(0.0, 1.0, 41)
    start = lambda x: jnp.exp(-(((x[0] - 0.5) / 0.1) ** 2)) + jnp.sin(6 * jnp.pi * x[0])
    for given in (start, np.asarray(jax.vmap(start)(cloud.points))):
        run = js.evolve(problem, cloud, given, t=(0.0, 0.1), tol=1e-6)
        assert run.flags == [] and run.error_estimate().max() < 1e-3


def test_nobody_looks_across_a_gap():
    """The angle in a ring that is cut, with a jump across the cut alone: nothing of it is between the particles."""
    angle = lambda x: jnp.mod(jnp.arctan2(x[1], x[0]), 2 * jnp.pi)
    outer, inner = np.arcsin(0.01), np.arcsin(0.02)
    rim = [(np.cos(a), np.sin(a)) for a in np.linspace(outer, 2 * np.pi - outer, 200)]
    rim += [(0.5 * np.cos(a), 0.5 * np.sin(a)) for a in np.linspace(2 * np.pi - inner, inner, 120)]
    pde = lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) + angle(x) * jnp.exp(-t)
    problem = js.Problem(pde, {"boundary": js.dirichlet(lambda x, t: angle(x) * jnp.exp(-t))})
    run = js.evolve(problem, js.from_polygon(rim, 0.1), angle, t=(0.0, 1.0), steps=20)
    error = np.abs(run.u[-1] - np.asarray(jax.vmap(angle)(run.cloud.points)) * np.exp(-1.0)).max()
    assert 0.3 < run.error_estimate()[-1].max() / error < 10.0


C = 0.4137  # where something jumps, between particles


def jumping(name):
    """The problem, its start, and the exact state at the end of three (reaction: five) units of time."""
    if name == "source":
        a = 5 * (1 - C) ** 2
        pde = lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) - jnp.where(x[0] > C, 10.0, 0.0)
        return pde, ENDS, lambda x: 0.0 * x[0], lambda x: a * x - np.where(x > C, 5 * (x - C) ** 2, 0.0)
    if name == "capacity":  # the lowest mode of a string whose mass is 1 and 9
        value = 1.45285783
        w = np.sqrt(value)
        b = np.sin(w * C) / np.sin(3 * w * (1 - C))
        mode = lambda x, of: of.where(x < C, of.sin(w * x), b * of.sin(3 * w * (1 - x)))
        pde = lambda u, x, t: jnp.where(x[0] < C, 1.0, 9.0) * js.dt(u)(x) - js.laplacian(u)(x)
        return pde, ENDS, lambda x: mode(x[0], jnp), lambda x: mode(x, np) * np.exp(-3 * value)
    k = 20.0
    a = 1 / (np.cosh(k * (1 - C)) + C * k * np.sinh(k * (1 - C)))
    slope = -k * a * np.sinh(k * (1 - C))
    pde = lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) + jnp.where(x[0] > C, k**2, 0.0) * u(x)
    bcs = {"left": js.dirichlet(1.0), "right": js.neumann(0.0)}
    return pde, bcs, lambda x: 1 - x[0], lambda x: np.where(x < C, 1 + slope * x, a * np.cosh(k * (1 - x)))


@pytest.mark.parametrize("n", [41, 161])
@pytest.mark.parametrize("name", ["source", "capacity", "reaction"])
def test_what_jumps_between_the_particles(name, n):
    pde, bcs, start, exact = jumping(name)
    end = 5.0 if name == "reaction" else 3.0
    run = js.evolve(js.Problem(pde, bcs), js.interval(0.0, 1.0, n), start, t=(0.0, end), tol=1e-6)
    error = np.abs(run.u[-1] - exact(run.cloud.points[:, 0])).max()
    assert 0.5 < run.error_estimate()[-1].max() / error < 15.0


OPERATORS = {
    "1 + u": lambda u, x, t: js.divergence(lambda y: (1.0 + u(y)) * js.grad(u)(y))(x),
    "1 + u^2, a reaction": lambda u, x, t: js.divergence(lambda y: (1.0 + u(y) ** 2) * js.grad(u)(y))(x) + 3.0 * u(x),
    "in time": lambda u, x, t: (1.0 + jnp.sin(5.0 * t)) * js.laplacian(u)(x),
    "in time and space": lambda u, x, t: js.divergence(
        lambda y: (1.0 + 0.5 * jnp.sin(5.0 * t) * y[0]) * js.grad(u)(y)
    )(x),
}


@pytest.mark.parametrize("name", OPERATORS)
@pytest.mark.parametrize("order", [4, 6])
def test_highest_derivatives_that_change(name, order):
    """The pencil of two orders more changes as that of the run does."""
    exact, op = lambda x, t: 1.5 + jnp.sin(6.0 * x[0]) * jnp.cos(3.0 * t), OPERATORS[name]
    problem = js.Problem(
        lambda u, x, t: js.dt(u)(x) - op(u, x, t) - jax.grad(exact, 1)(x, t) + op(lambda y: exact(y, t), x, t),
        {"left": js.dirichlet(exact), "right": js.dirichlet(exact)},
    )
    cloud = js.interval(0.0, 1.0, 23)
    run = js.evolve(problem, cloud, lambda x: exact(x, 0.0), t=(0.0, 0.5), steps=60, order=order)
    error = np.abs(run.u[-1] - np.asarray(jax.vmap(exact, (0, None))(cloud.points, 0.5))).max()
    assert error > 1e-7 and 0.4 * error < float(run.error_estimate()[-1].max()) < 3 * error
