"""Evolutions whose cloud follows them: exact on polynomials, honest where something moves, refused in words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js


def line(spacing):
    return js.interval(0.0, 1.0, spacing=spacing)


def square(spacing):
    return js.from_polygon([(0, 0), (1, 0), (1, 1), (0, 1)], spacing)


def ball(spacing):
    return js.from_sdf(js.sdf.sphere((0.0, 0.0, 0.0), 1.0), ((-1.1,) * 3, (1.1,) * 3), spacing)


def diffused(exact, k=1.0, more=lambda u: 0.0):
    """u_t = k lap u + more(u) with this answer, held on the boundary."""
    at = lambda x, t: jax.grad(exact, 1)(x, t) - k * js.laplacian(lambda y: exact(y, t))(x) - more(exact(x, t))  # noqa: E731
    return lambda u, x, t: js.dt(u)(x) - k * js.laplacian(u)(x) - more(u(x)) - at(x, t)


def held(cloud, exact):
    return {name: js.dirichlet(exact) for name in cloud.groups if name != "interior"}


def off(run, exact):
    """The largest true error at the ends of the parts."""
    found = 0.0
    for part in run.parts:
        true = jax.vmap(lambda x, t=float(part.t[-1]): exact(x, t))(part.cloud.points)
        found = max(found, float(np.abs(true - part.u[-1]).max()))
    return found


@pytest.mark.parametrize(
    "make, spacing, order", [(line, 0.01, 4), (square, 0.045, 4), (ball, 0.8, 2)], ids=["1D", "2D", "3D"]
)
def test_polynomials_stay_exact_on_clouds_that_change(make, spacing, order):
    """In three dimensions at order 2, from too few particles for an error to be told."""
    degree = min(order, 3)
    exact = lambda x, t: (1.0 + t) * (x[0] ** degree - x[0] * x[-1] + 1.0)  # noqa: E731
    cloud = make(spacing)
    run = js.evolve(
        js.Problem(diffused(exact), held(cloud, exact)), cloud, lambda x: exact(x, 0.0), (0.0, 1.0), steps=8,
        order=order, readapt=js.Readapt(make, 1e-6, times=4), save=2,
    )  # fmt: skip
    assert run.reached and run.converged and not run.flags and run.t.tolist() == [0.0, 0.5, 1.0]
    assert off(run, exact) < 1e-9 and run.error < 1e-8
    assert len(run.parts) == 4
    if len(cloud) > 400 or cloud.dim == 1:
        assert len(run.cloud) < 0.8 * len(cloud)  # where nothing is missed it coarsens
    if cloud.dim == 3:
        assert len(run.cloud) > 4 * len(cloud)
    middle = np.asarray(run.at(0.4).cloud.points)
    assert np.abs(run.at(0.4).u - jax.vmap(lambda x: exact(x, 0.4))(middle)).max() < 1e-9


def spot(x, t):
    centre = jnp.array([0.3 + 0.4 * t, 0.5])
    return jnp.exp(-jnp.sum((x - centre) ** 2) / 0.005)


def test_particles_follow_what_moves():
    cloud = square(0.2)  # sees nothing of the start
    run = js.evolve(
        js.Problem(diffused(spot, 0.1), held(cloud, spot)), cloud, lambda x: spot(x, 0.0), (0.0, 1.0), steps=40,
        readapt=js.Readapt(square, 2e-2, times=8),
    )  # fmt: skip
    true = off(run, spot)
    assert run.reached and true < 2e-2
    assert true / 5 < run.history["error"].max() < 5 * true
    for part, end in zip(run.parts[3:], run.history["t"][3:]):
        points = np.asarray(part.cloud.points)
        here = np.abs(points - [0.3 + 0.4 * end, 0.5]).max(axis=1) < 0.1
        there = np.abs(points - [0.1, 0.1]).max(axis=1) < 0.1
        assert here.sum() > 4 * there.sum()
    assert run.history["particles"].max() < 2 * run.history["particles"].min()  # no trail
    assert "FLAG" not in run.diagnose() and "clouds" in run.diagnose() and "AdaptedEvolution" in run._repr_html_()


def test_a_front_of_a_semilinear_equation_with_steps_by_tolerance():
    front = lambda x, t: 0.5 * (1.0 + jnp.tanh((x[0] - 0.3 - 0.4 * t) / 0.05))  # noqa: E731
    cloud = line(0.1)
    problem = js.Problem(diffused(front, 0.01, lambda u: u * (1.0 - u)), held(cloud, front))
    run = js.evolve(
        problem, cloud, lambda x: front(x, 0.0), (0.0, 1.0), tol=1e-6, order=6,
        readapt=js.Readapt(line, 1e-4, times=5),
    )  # fmt: skip
    true = off(run, front)
    assert run.reached and true < 1e-4 and true / 5 < run.error < 5 * true + 1e-6


def test_two_fields_and_a_start_known_at_the_particles_alone():
    one = lambda x, t: jnp.sin(3.0 * x[0]) * jnp.exp(-t)  # noqa: E731
    two = lambda x, t: jnp.cos(2.0 * x[0]) * (1.0 + t)  # noqa: E731
    first = lambda u, x: js.laplacian(u[0])(x) - u[1](x)  # noqa: E731
    second = lambda u, x: js.laplacian(u[1])(x) + u[0](x)  # noqa: E731
    exact = lambda x, t: (lambda y: one(y, t), lambda y: two(y, t))  # noqa: E731

    def pde(u, x, t):
        source = [jax.grad(f, 1)(x, t) - g(exact(x, t), x) for f, g in ((one, first), (two, second))]
        return js.dt(u[0])(x) - first(u, x) - source[0], js.dt(u[1])(x) - second(u, x) - source[1]

    cloud = line(0.02)
    ends = {name: js.dirichlet(lambda x, t: jnp.stack([one(x, t), two(x, t)])) for name in ("left", "right")}
    start = np.stack([np.sin(3.0 * cloud.points[:, 0]), np.cos(2.0 * cloud.points[:, 0])], axis=1)
    run = js.evolve(
        js.Problem(pde, ends, fields=2), cloud, start, (0.0, 0.5), steps=20,
        readapt=js.Readapt(line, 1e-4, times=4),
    )  # fmt: skip
    assert run.parts[0].cloud is cloud and run.reached
    last = run.parts[-1]
    true = jax.vmap(lambda x: jnp.stack([one(x, 0.5), two(x, 0.5)]))(last.cloud.points)
    assert np.abs(true - last.u[-1]).max() < 1e-4


def test_what_is_not_reached_is_said():
    cloud = square(0.2)
    run = js.evolve(
        js.Problem(diffused(spot, 0.1), held(cloud, spot)), cloud, lambda x: spot(x, 0.0), (0.0, 0.2), steps=8,
        readapt=js.Readapt(square, 1e-7, times=2, max_particles=300),
    )  # fmt: skip
    assert not run.reached and run.error > 1e-7 and "Not reached" in run.messages[0]
    assert off(run, spot) < 5 * run.error


def test_a_front_whose_conductivity_follows_it():
    """The highest derivatives are nonlinear: a cloud of 26 particles is made finer where the front is."""
    front = lambda x, t: 1.5 + 0.5 * jnp.tanh((x[0] - 0.3 - 0.4 * t) / 0.06)  # noqa: E731
    op = lambda u, x: js.divergence(lambda y: 0.02 * (1 + u(y)) * js.grad(u)(y))(x)  # noqa: E731
    pde = lambda u, x, t: js.dt(u)(x) - op(u, x) - jax.grad(front, 1)(x, t) + op(lambda y: front(y, t), x)  # noqa: E731
    cloud = line(0.04)
    run = js.evolve(
        js.Problem(pde, held(cloud, front)), cloud, lambda x: front(x, 0.0), (0.0, 0.25), steps=20,
        readapt=js.Readapt(line, 1e-3, times=2),
    )  # fmt: skip
    assert run.reached and not run.flags and off(run, front) < 1e-3


HEAT = js.Problem(
    lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
)
WAVE = js.Problem(lambda u, x, t: js.dt(u, 2)(x) - js.laplacian(u)(x), HEAT.bcs)


def renamed(spacing):
    cloud = line(spacing)
    return js.Cloud(cloud.points, {"interior": cloud.groups["interior"], "ends": cloud.boundary}, cloud.normals)


PLAN = js.Readapt(line, 1e-3, times=2)


@pytest.mark.parametrize("change, word", [
    ({"problem": WAVE, "u0": (0.0, 0.0)}, "second order in time"),
    ({"stencils": js.stencils(line(0.1), size=9)}, "stencils: belong to one cloud"),
    ({"readapt": line}, "js.Readapt"),
    ({"readapt": js.Readapt(lambda spacing: js.interval(0.0, 1.0, spacing=spacing).points, 1e-9)}, "make: returned"),
    ({"readapt": js.Readapt(renamed, 1e-9)}, "groups"),
])  # fmt: skip
def test_refused_in_words(change, word):
    given = {"problem": HEAT, "cloud": line(0.1), "u0": lambda x: jnp.sin(jnp.pi * x[0]), "t": (0.0, 0.1), "steps": 4}
    with pytest.raises(ValueError, match=word):
        js.evolve(**given | {"readapt": PLAN} | change)


def heated(source=0.0, height=1.0):
    problem = js.Problem(lambda u, x, t: HEAT.pde(u, x, t) - source * x[0], HEAT.bcs)
    start = lambda x: height * jnp.sin(jnp.pi * x[0])  # noqa: E731
    return js.evolve(problem, line(0.1), start, (0.0, 0.1), steps=4, readapt=PLAN).at(0.1).u.sum()


def given_at_the_particles(values):
    return js.evolve(HEAT, line(0.1), values, (0.0, 0.1), steps=4, readapt=PLAN).at(0.1).u.sum()


@pytest.mark.parametrize("end, of", [
    (given_at_the_particles, np.ones(11)),
    (heated, 1.0),  # the source closes over it
    (lambda height: heated(height=height), 1.0),
])  # fmt: skip
def test_not_under_jax(end, of):
    with pytest.raises(ValueError, match="readapt: no cloud can be made from traced values"):
        jax.grad(end)(of)


@pytest.mark.parametrize("given, word", [
    ((3, 1e-3), "make: expected a function"),
    ((line, 2.0), "tol"),
    ((line, 1e-3, 0), "times"),
    ((line, 1e-3, 4, 0.5), "max_particles"),
])  # fmt: skip
def test_a_plan_is_judged(given, word):
    with pytest.raises(ValueError, match=word):
        js.Readapt(*given)


@pytest.mark.parametrize("order", [4, 6])
def test_the_error_of_a_wave_travels_with_it(order):
    """It grows all the way; taken through backward Euler it was told at an eighth."""
    exact = lambda x, t: jnp.exp(-(((x[0] - 0.3 - t) / 0.05) ** 2))  # noqa: E731
    cloud = js.interval(0.0, 1.0, 161)
    run = js.evolve(
        js.Problem(WAVE.pde, held(cloud, exact)), cloud,
        (lambda x: exact(x, 0.0), lambda x: jax.grad(exact, 1)(x, 0.0)), (0.0, 0.4), steps=50, order=order, save=2,
    )  # fmt: skip
    true = [np.abs(jax.vmap(lambda x, t=t: exact(x, t))(cloud.points) - u).max() for t, u in zip(run.t, run.u)]
    told = np.asarray(run.error_estimate()).max(axis=1)
    assert (told[1:] > np.array(true[1:]) / 2).all() and (told[1:] < 2 * np.array(true[1:])).all()
