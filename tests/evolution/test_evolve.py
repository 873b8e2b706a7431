"""Evolutions by their public name: exact on polynomials, every kind of condition, systems, waves, failures."""

import pickle

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.discretization.pencil import assemble
from jsmitsm.evolution.gradient import adjoint

ROD = js.interval(0.0, 1.0, 17)
SQUARE = js.rectangle((0.0, 0.0), (1.0, 1.0), (9, 9), jitter=0.2)
CUBE = js.box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (5, 5, 5), jitter=0.1)
SIDES = ("left", "right", "bottom", "top", "front", "back")


def at(f, cloud, *more):
    return np.asarray(jax.vmap(lambda x: f(x, *more))(cloud.points))


def everywhere(cloud, condition):
    return {name: condition for name in SIDES if name in cloud.groups}


def heat(exact, rate=1.0):
    """u_t = rate lap u + s with this answer."""
    source = lambda x, t: jax.grad(exact, 1)(x, t) - rate * js.laplacian(lambda y: exact(y, t))(x)  # noqa: E731
    return lambda u, x, t: js.dt(u)(x) - rate * js.laplacian(u)(x) - source(x, t)


def smooth(x, t):
    return jnp.sin(x[0] + 2.0 * t) + (jnp.cos(x[1] - t) if len(x) > 1 else 0.0)


def polynomial(x, t):
    """Of degree 4 in x and 2 in t, which every stage of KenCarp4 and Radau IIA has exactly."""
    return (1.0 + t + t**2) * (x[0] ** 4 - x[0] * x[-1] + x[-1] ** 3)


@pytest.mark.parametrize("cloud", [ROD, SQUARE, CUBE], ids=["1D", "2D", "3D"])
@pytest.mark.parametrize("scheme", ["esdirk", "radau"])
def test_exact_on_polynomials(cloud, scheme):
    problem = js.Problem(heat(polynomial), everywhere(cloud, js.dirichlet(polynomial)))
    run = js.evolve(problem, cloud, lambda x: polynomial(x, 0.0), t=(0.0, 1.0), steps=4, scheme=scheme, save=2)
    assert run.converged and not run.flags and run.t.tolist() == [0.0, 0.5, 1.0]
    for t, u in zip(run.t, run.u):
        assert np.abs(u - at(polynomial, cloud, t)).max() < 1e-11  # round-off of some 20 solves


@pytest.mark.parametrize("condition", [
    js.neumann(lambda x, t: jnp.where(x[0] < 0.5, -1.0, 1.0) * jax.grad(polynomial)(x, t)[0]),
    js.robin(2.0, 1.0, lambda x, t: 2 * polynomial(x, t) + jnp.where(x[0] < 0.5, -1.0, 1.0)
             * jax.grad(polynomial)(x, t)[0]),
    js.condition(lambda u, x, n, t: u(x) + n @ js.grad(u)(x) - polynomial(x, t) - n @ jax.grad(polynomial)(x, t)),
    js.condition(lambda u, x, t: u(x) - polynomial(x, t)),
])  # fmt: skip
def test_every_kind_of_condition(condition):
    problem = js.Problem(heat(polynomial), {"left": condition, "right": js.dirichlet(polynomial)})
    run = js.evolve(problem, ROD, lambda x: polynomial(x, 0.0), t=(0.0, 1.0), steps=5)
    assert np.abs(run.u[-1] - at(polynomial, ROD, 1.0)).max() < 1e-11


def test_pure_neumann_needs_no_value():
    """The resolvent of the pencil is regular though the operator is not; the mean of u grows by the source, 2."""
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) - 2.0, {"left": js.neumann(0.0),
                                                                                 "right": js.neumann(0.0)})  # fmt: skip
    run = js.evolve(problem, ROD, 1.0, t=(0.0, 3.0), steps=10)
    assert np.abs(run.u[-1] - 7.0).max() < 1e-11


def test_orders_in_time_and_space():
    """In time at fixed particles of order 6, and in space with many steps: order p - 0.3 at least."""
    problem = js.Problem(heat(smooth), everywhere(SQUARE, js.dirichlet(smooth)))

    def error(cloud, order, steps, scheme):
        start = lambda x: smooth(x, 0.0)  # noqa: E731
        run = js.evolve(problem, cloud, start, t=(0.0, 1.0), steps=steps, order=order, scheme=scheme)
        return np.abs(run.u[-1] - at(smooth, cloud, 1.0)).max()

    assert np.log2(error(SQUARE, 8, 3, "esdirk") / error(SQUARE, 8, 6, "esdirk")) > 3.3
    fine = js.rectangle((0.0, 0.0), (1.0, 1.0), (17, 17), jitter=0.2)
    coarse, half = error(SQUARE, 4, 40, "radau"), error(fine, 4, 40, "radau")
    assert half < 3e-7 and np.log2(coarse / half) > 3.7


def test_small_steps_do_no_harm_on_a_random_cloud():
    """An unstable pencil hides behind large steps of an L-stable scheme: 10 and 400 steps have one error."""
    points = np.array(SQUARE.points)
    inner = np.asarray(SQUARE.groups["interior"])
    points[inner] = np.random.default_rng(3).uniform(0.03, 0.97, (len(inner), 2))
    cloud = js.Cloud(points, SQUARE.groups, SQUARE.normals)
    problem = js.Problem(heat(smooth), everywhere(cloud, js.dirichlet(smooth)))
    errors = []
    for steps in (10, 400):
        run = js.evolve(problem, cloud, lambda x: smooth(x, 0.0), t=(0.0, 1.0), steps=steps, scheme="esdirk")
        errors.append(np.abs(run.u[-1] - at(smooth, cloud, 1.0)).max())
    assert errors[0] < 1e-3 and errors[1] < 1.2 * errors[0]


def test_a_start_that_contradicts_the_conditions_is_an_impulse():
    """u = 1 between ends that are held at 0, against its Fourier series."""
    cloud = js.interval(0.0, 1.0, 41)
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), everywhere(cloud, js.dirichlet(0.0)))
    run = js.evolve(problem, cloud, 1.0, t=(0.0, 0.1), steps=40, order=6)
    k = np.arange(1, 60, 2) * np.pi
    x = np.asarray(cloud.points)
    exact = (4 / k * np.sin(k * x) * np.exp(-(k**2) * 0.1)).sum(axis=1)
    assert np.abs(run.u[-1] - exact).max() < 1e-6


# ------------------------------------------------------------------ nonlinear problems


def front(x, t):
    """u_t = u_xx / 16 + u (1 - u) (u - 0.3) has this travelling wave."""
    return 1.0 / (1.0 + jnp.exp((4.0 * x[0] - jnp.sqrt(2.0) * 0.2 * t) / jnp.sqrt(2.0)))


@pytest.mark.parametrize(("scheme", "second"), [("imex", False), ("esdirk", False), ("imex", True)])
def test_orders_of_reactions(scheme, second):
    """No error in space: u' = 3 u (1 - u), and the angle of a pendulum, u'' = -sin u, that falls from the side."""
    cloud = js.interval(0.0, 1.0, 9)
    rate = (lambda u, x, t: js.dt(u, 2)(x) + jnp.sin(u(x))) if second else (
        lambda u, x, t: js.dt(u)(x) - 3 * u(x) * (1 - u(x))
    )  # fmt: skip
    pde = lambda u, x, t: rate(u, x, t) - 0.01 * js.laplacian(u)(x)  # noqa: E731
    problem = js.Problem(pde, everywhere(cloud, js.neumann(0.0)))
    # The pendulum is at the bottom after a quarter of its period, K(1/sqrt 2).
    start, end = ((np.pi / 2, 0.0), 1.8540746773013719) if second else (0.1, 1.0)
    exact = 0.0 if second else 1.0 / (1.0 + 9.0 * np.exp(-3.0))
    runs = [js.evolve(problem, cloud, start, t=(0.0, end), steps=n, scheme=scheme) for n in (8, 32)]
    few, many = (np.abs(run.u[-1] - exact).max() for run in runs)
    assert few < 3e-3 and np.log2(few / many) / 2 > 3.6


def test_nothing_nonlinear_is_left_of_a_cube_at_rest():
    """Newton's method begins with a matrix in which u^3 has no entry."""
    problem = js.Problem(
        lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) + u(x) ** 3 - jnp.pi**2 * jnp.sin(jnp.pi * x[0]),
        everywhere(ROD, js.dirichlet(0.0)),
    )
    found = [js.evolve(problem, ROD, 0.0, t=(0.0, 0.2), steps=40, scheme=s).u[-1] for s in ("imex", "esdirk")]
    assert np.abs(found[0]).max() > 0.5 and np.abs(found[0] - found[1]).max() < 1e-7


PULSE = lambda t: jnp.exp(-(((t - 0.5) / 0.03) ** 2))  # noqa: E731


def test_a_run_has_no_derivative_forward():
    def last(s):
        p = {"k": 0.3, "s": s, "b": 0.5, "a": 0.4}
        return jnp.sum(js.evolve(reacting(p), ROD, 0.5, t=(0.0, 0.5), steps=2, order=2, scheme="imex").u[-1])

    with pytest.raises(ValueError, match="jax.grad, jax.vjp"):
        jax.jvp(last, (jnp.asarray(0.3),), (jnp.asarray(1.0),))


def cooled(k):
    """By its operator: what is traced are the matrices."""
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - k * js.laplacian(u)(x), everywhere(ROD, js.dirichlet(0.0)))
    return js.evolve(problem, ROD, 1.0, t=(0.0, 0.1), steps=2, order=2).u[-1, 5]


@pytest.mark.parametrize(("derivative", "words"), [
    (jax.jacfwd, "jax.grad, jax.vjp"),
    (lambda f: lambda k: jax.jit(lambda k: jax.jvp(f, (k,), (1.0,)))(k), "jax.grad, jax.vjp"),
    (lambda f: lambda k: jax.linearize(f, k)[1](1.0), "jax.grad, jax.vjp"),
    (jax.hessian, "first derivatives alone"),
    (lambda f: jax.grad(jax.grad(f)), "first derivatives alone"),
])  # fmt: skip
def test_what_a_run_has_no_derivatives_for_is_said_in_words(derivative, words):
    with pytest.raises(ValueError, match=words):
        derivative(cooled)(0.3)


@pytest.mark.parametrize("scheme", ["imex", "esdirk"])
def test_sources_that_vanish_digit_by_digit(scheme):
    """Far from its middle a pulse is hardly a number any more; no residual is small then."""
    problem = js.Problem(
        lambda u, x, t: js.dt(u)(x) - 0.1 * js.laplacian(u)(x) + u(x) ** 2
        - jnp.exp(-(((t - 0.7) / 0.02) ** 2)) * jnp.sin(3 * x[0]),
        everywhere(ROD, js.dirichlet(0.0)),
    )  # fmt: skip
    found = [js.evolve(problem, ROD, 0.0, t=(0.0, 1.0), steps=n, scheme=scheme).u[-1].max() for n in (50, 100, 200)]
    assert found[0] > 0.02 and max(found) - min(found) < 1e-4


@pytest.mark.parametrize("held", [False, True])
def test_a_smooth_pulse_from_rest(held):
    """Before it begins nothing is there, whose digits nobody wants: thousands of steps were made for them."""
    source = 0.0 if held else 1.0
    problem = js.Problem(
        lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) - source * PULSE(t) * jnp.sin(jnp.pi * x[0]),
        {"left": js.dirichlet(lambda x, t: (1.0 - source) * PULSE(t)), "right": js.dirichlet(0.0)},
    )
    found = js.evolve(problem, ROD, 0.0, t=(0.0, 1.0), tol=1e-6, order=6)
    exact = js.evolve(problem, ROD, 0.0, t=(0.0, 1.0), steps=1000, order=6)
    assert found.stats["steps"] < 300 and np.abs(found.u[-1] - exact.u[-1]).max() < 1e-6


@pytest.mark.parametrize("scheme", ["imex", "esdirk"])
def test_a_travelling_front(scheme):
    cloud = js.interval(0.0, 1.0, 31)
    problem = js.Problem(
        lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) / 16 - u(x) * (1 - u(x)) * (u(x) - 0.3),
        everywhere(cloud, js.dirichlet(front)),
    )
    run = js.evolve(problem, cloud, lambda x: front(x, 0.0), t=(0.0, 2.0), steps=40, order=6, scheme=scheme)
    assert np.abs(run.u[-1] - at(front, cloud, 2.0)).max() < 1e-7 and not run.flags


def test_burgers():
    exact = lambda x, t: 1.0 / (1.0 + jnp.exp((x[0] - 0.5 * t) / 0.2))  # noqa: E731
    problem = js.Problem(
        lambda u, x, t: js.dt(u)(x) + u(x) * js.grad(u)(x)[0] - 0.1 * js.laplacian(u)(x), everywhere(ROD,
        js.dirichlet(exact)),
    )  # fmt: skip
    run = js.evolve(problem, ROD, lambda x: exact(x, 0.0), t=(0.0, 0.5), steps=40, order=6)
    assert np.abs(run.u[-1] - at(exact, ROD, 0.5)).max() < 1e-4 and run.stats["scheme"].startswith("KenCarp4, imp")


@pytest.mark.parametrize("flux", [
    lambda u, x, t: (1 + u(x)) * js.grad(u)(x), lambda u, x, t: (1 + 0.5 * jnp.sin(3 * t)) * js.grad(u)(x),
], ids=["quasilinear", "in time"])  # fmt: skip
def test_operators_that_change(flux):
    """Newton's method on a pencil that is made anew where the coefficients have moved."""
    exact = lambda x, t: 1.0 + 0.5 * jnp.sin(x[0] + t)  # noqa: E731

    def residual(u, rate, x, t):
        return rate - js.divergence(lambda y: flux(u, y, t))(x)

    def pde(u, x, t):
        known = lambda y: exact(y, t)  # noqa: E731
        return residual(u, js.dt(u)(x), x, t) - residual(known, jax.grad(exact, 1)(x, t), x, t)

    problem = js.Problem(pde, everywhere(ROD, js.dirichlet(exact)))
    run = js.evolve(problem, ROD, lambda x: exact(x, 0.0), t=(0.0, 1.0), steps=10, order=6)
    assert np.abs(run.u[-1] - at(exact, ROD, 1.0)).max() < 1e-6 and run.stats["pencils"] > 1


# ------------------------------------------------------------------ systems, waves


def test_two_fields_whose_rates_mix():
    """2 u_t + v_t = lap u + ..., v_t = lap v + u + ...: the mass is a matrix."""
    # The source lap u + ... has the degree of its fits, 2.
    exact = lambda x, t: jnp.stack([(1 + t**2) * x[0] ** 2, polynomial(x, t)])  # noqa: E731

    def residual(rate, lap, u):
        return jnp.stack([2 * rate[0] + rate[1] - lap[0], rate[1] - lap[1] - u[0]])

    def pde(u, x, t):
        known = residual(jax.jacfwd(exact, 1)(x, t), js.laplacian(lambda y: exact(y, t))(x), exact(x, t))
        return residual(js.dt(u)(x), js.laplacian(u)(x), u(x)) - known

    problem = js.Problem(pde, everywhere(ROD, js.dirichlet(exact)), fields=2)
    run = js.evolve(problem, ROD, lambda x: exact(x, 0.0), t=(0.0, 1.0), steps=5)
    assert run.u.shape == (2, 17, 2) and np.abs(run.u[-1] - at(exact, ROD, 1.0)).max() < 1e-10


@pytest.mark.parametrize("scheme", ["radau", "esdirk"])
def test_an_equation_without_a_rate(scheme):
    """v follows u at every moment, from a start that knows nothing of it."""
    exact = lambda x, t: jnp.stack([jnp.sin(x[0] + t), jnp.cos(x[0] - t)])  # noqa: E731

    def residual(rate, lap, u):
        return jnp.stack([rate - lap[0] + u[1], -lap[1] - u[0]])

    def pde(u, x, t):
        known = residual(jax.jacfwd(exact, 1)(x, t)[0], js.laplacian(lambda y: exact(y, t))(x), exact(x, t))
        return residual(js.dt(u[0])(x), js.laplacian(u)(x), u(x)) - known

    problem = js.Problem(pde, everywhere(ROD, js.dirichlet(exact)), fields=2)
    start = lambda x: jnp.stack([jnp.sin(x[0]), 0.0])  # noqa: E731
    run = js.evolve(problem, ROD, start, t=(0.0, 1.0), steps=20, order=6, scheme=scheme)
    assert np.abs(run.u[-1] - at(exact, ROD, 1.0)).max() < 1e-7


def separating(u, x, t):
    """Cahn and Hilliard's equation, interfaces of 0.1."""
    potential = u(x)[0] ** 3 - u(x)[0] - 0.01 * js.laplacian(u[0])(x)
    return jnp.stack([js.dt(u[0])(x) - js.laplacian(u[1])(x), u(x)[1] - potential])


def test_a_mixture_separates():
    """Of values that outweigh derivatives in a recursion over four spacings each corner would make a growing mode.

    Against a Fourier series of 32 x 32 terms in steps of 1.25e-5; the error of the cloud is below 0.01.
    """
    cloud = js.rectangle((0, 0), (1, 1), (13, 13), jitter=0.2)
    problem = js.Problem(separating, everywhere(cloud, [js.neumann(0.0, field=k) for k in (0, 1)]), fields=2)
    start = lambda x: jnp.stack([0.1 * jnp.cos(2 * jnp.pi * x[0]) * jnp.cos(jnp.pi * x[1]), 0.0])  # noqa: E731
    run = js.evolve(problem, cloud, start, t=(0.0, 0.05), steps=12, progress=False)
    found = run.at(0.05)([[0.0, 0.0], [0.5, 0.0], [0.3, 0.3], [1.0, 0.5]])[:, 0]
    assert run.flags == [] and np.abs(found - np.array([0.319597, -0.319597, -0.062657, 0.0])).max() < 0.01


def test_the_order_of_equations_says_nothing():
    """Two fields with different conditions, the second equation first."""
    def warm(u, x, t):
        a, b = u(x)
        lap = js.laplacian(u)(x)
        return jnp.stack([js.dt(u[0])(x) - lap[0] - b + jnp.sin(t), js.dt(u[1])(x) - 0.3 * lap[1] + 2 * a - b])

    ends = {"left": [js.dirichlet(1.0, field=0), js.neumann(0.0, field=1)],
            "right": [js.neumann(0.0, field=0), js.dirichlet(lambda x, t: t, field=1)]}  # fmt: skip
    made = [
        js.evolve(js.Problem(pde, ends, fields=2), ROD, lambda x: jnp.stack([1.0, 0.0 * x[0]]), (0.0, 0.5), steps=10)
        for pde in (warm, lambda u, x, t: warm(u, x, t)[::-1])
    ]
    assert np.abs(made[0].u[-1] - made[1].u[-1]).max() < 1e-11 and made[0].flags == made[1].flags == []
    assert made[1].stats["damping"] == 0.0 and made[1].diagnose() == made[0].diagnose()


def test_a_normal_and_the_time_are_known_by_their_names():
    out = js.condition(lambda u, x, n: n @ js.grad(u)(x) + u(x))
    runs = [js.evolve(js.Problem(COOLING.pde, {**COOLING.bcs, "right": c}), ROD, 1.0, (0.0, 0.1), steps=4)
            for c in (out, js.robin(1.0, 1.0, 0.0))]  # fmt: skip
    assert np.abs(runs[0].u[-1] - runs[1].u[-1]).max() < 1e-12
    runs = [js.evolve(js.Problem(lambda u, x, t, k: js.dt(u)(x) - k * js.laplacian(u)(x),
                                 everywhere(ROD, js.dirichlet(value)), params=2.0), ROD, 0.0, (0.0, 0.1), steps=4)
            for value in (lambda x, t: t, lambda x, t, k: t)]  # fmt: skip
    assert np.array_equal(runs[0].u, runs[1].u) and runs[0].u[-1, 0] == 0.1


def test_the_third_argument_of_a_condition_is_the_normal_whatever_its_name():
    """As in js.solve; the time where it is called so."""
    out = lambda u, x, n: n @ js.grad(u)(x) + u(x)
    same = [js.condition(f) for f in (out, lambda u, x, nu: out(u, x, nu), lambda u, x, q, k: out(u, x, q))]
    runs = [js.evolve(js.Problem(lambda u, x, t, *k: js.dt(u)(x) - js.laplacian(u)(x), {**COOLING.bcs, "right": c},
                                 params=params), ROD, 1.0, (0.0, 0.1), steps=4)
            for c, params in zip(same, (None, None, 2.0))]  # fmt: skip
    assert np.array_equal(runs[0].u, runs[1].u) and np.array_equal(runs[0].u, runs[2].u)
    held = js.condition(lambda u, x, time: u(x) - time)
    run = js.evolve(js.Problem(COOLING.pde, {**COOLING.bcs, "right": held}), ROD, 0.0, (0.0, 0.1), steps=4)
    assert run.u[-1][ROD.groups["right"]] == pytest.approx(0.1)


def test_a_wave_over_ten_periods():
    wave = lambda x, t: jnp.sin(jnp.pi * x[0]) * jnp.cos(jnp.pi * t)  # noqa: E731
    problem = js.Problem(lambda u, x, t: js.dt(u, 2)(x) - js.laplacian(u)(x), everywhere(ROD, js.dirichlet(0.0)))
    run = js.evolve(problem, ROD, (lambda x: wave(x, 0.0), 0.0), t=(0.0, 20.0), steps=400, order=6)
    assert run.stats["damping"] > 0 and np.abs(run.u[-1] - at(wave, ROD, 20.0)).max() < 3e-4
    assert np.abs(run.rate[-1]).max() < 1e-3


def test_a_wave_that_its_ends_drive():
    wave = lambda x, t: jnp.sin(x[0] - t)  # noqa: E731
    problem = js.Problem(lambda u, x, t: js.dt(u, 2)(x) - js.laplacian(u)(x), everywhere(ROD, js.dirichlet(wave)))
    start = (lambda x: wave(x, 0.0), lambda x: jax.grad(wave, 1)(x, 0.0))
    run = js.evolve(problem, ROD, start, t=(0.0, 2.0), steps=40, order=6)
    assert np.abs(run.u[-1] - at(wave, ROD, 2.0)).max() < 1e-7


def test_periodic_pairs():
    cloud = js.rectangle((0.0, 0.0), (1.0, 1.0), (13, 13), jitter=0.1)
    k = 2 * jnp.pi
    exact = lambda x, t: jnp.exp(-0.1 * k**2 * t) * jnp.sin(k * (x[0] - t))  # noqa: E731
    problem = js.Problem(
        lambda u, x, t: js.dt(u)(x) + js.grad(u)(x)[0] - 0.1 * js.laplacian(u)(x),
        {"left": js.periodic("left", "right"), "bottom": js.periodic("bottom", "top")},
    )
    run = js.evolve(problem, cloud, lambda x: exact(x, 0.0), t=(0.0, 0.25), steps=20, order=6)
    assert np.abs(run.u[-1] - at(exact, cloud, 0.25)).max() < 1e-3  # 12 particles a wave
    assert np.array_equal(run.u[-1][cloud.groups["left"]], run.u[-1][cloud.groups["right"]])


def test_schroedinger_is_damped_enough():
    wave = lambda x, t: jnp.stack([jnp.cos(2 * x[0] - 2 * t), jnp.sin(2 * x[0] - 2 * t)])  # noqa: E731
    problem = js.Problem(
        lambda u, x, t: jnp.stack([js.dt(u[0])(x) + 0.5 * js.laplacian(u[1])(x),
                                   js.dt(u[1])(x) - 0.5 * js.laplacian(u[0])(x)]),
        everywhere(ROD, js.dirichlet(wave)), fields=2,
    )  # fmt: skip
    run = js.evolve(problem, ROD, lambda x: wave(x, 0.0), t=(0.0, 2.0), steps=100, order=6)
    assert run.stats["damping"] > 0 and np.abs(run.u[-1] - at(wave, ROD, 2.0)).max() < 1e-4


# ------------------------------------------------------------------ what is returned


def moving_heat(**options):
    problem = js.Problem(heat(smooth), everywhere(ROD, js.dirichlet(smooth)))
    return js.evolve(problem, ROD, lambda x: smooth(x, 0.0), t=(0.0, 1.0), **{"order": 6, **options})


def test_states_between_the_steps_are_solutions():
    run = moving_heat(steps=20, save=[0.31, 0.5])
    assert run.t.tolist() == [0.0, 0.31, 0.5, 1.0]
    assert max(np.abs(u - at(smooth, ROD, t)).max() for t, u in zip(run.t, run.u)) < 1e-6
    points = np.array([[0.123], [0.77]])
    state = run.at(0.613)
    then = lambda x: smooth(x, 0.613)  # noqa: E731
    assert np.abs(state(points) - jax.vmap(then)(points)).max() < 1e-6
    assert np.abs(state.grad(points) - jax.vmap(jax.grad(then))(points)).max() < 1e-6
    assert abs(state.integral() - (np.cos(2 * 0.613) - np.cos(1 + 2 * 0.613))) < 1e-6
    with pytest.raises(ValueError, match="outside of the run, from 0 to 1"):
        run.at(1.2)
    with pytest.raises(ValueError, match="ask the evolution"):
        state.error_estimate()


def test_a_tolerance_is_kept_and_saved_times_are_met():
    run = moving_heat(tol=1e-5, save=3)
    assert 3 <= run.stats["steps"] < 60 and run.stats["factorisations"] <= 8
    assert max(np.abs(u - at(smooth, ROD, t)).max() for t, u in zip(run.t, run.u)) < 3e-5


def test_the_error_estimate_bounds_the_error_and_is_no_larger_than_it_must():
    """In space at order 4, with steps that add nothing."""
    run = moving_heat(steps=40, order=4)
    error = np.abs(run.u[-1] - at(smooth, ROD, 1.0)).max()
    found = run.error_estimate()
    assert found.shape == run.u.shape and error / 3 < found[-1].max() < 100 * error + 1e-7


def test_errors_of_the_past_are_estimated_too():
    """A cloud that was carried along and is wide by now was sharp before, and its error then is still there."""
    exact = lambda x, t: jnp.exp(-((x[0] - 0.3 - 0.5 * t) ** 2) / (0.08 * (t + 0.5))) / jnp.sqrt(t + 0.5)  # noqa: E731
    cloud = js.interval(0.0, 1.0, 33)
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) + 0.5 * js.grad(u)(x)[0] - 0.02 * js.laplacian(u)(x),
                         everywhere(cloud, js.dirichlet(exact)))  # fmt: skip
    run = js.evolve(problem, cloud, lambda x: exact(x, 0.0), t=(0.0, 0.6), steps=40)
    error = np.abs(run.u[-1] - at(exact, cloud, 0.6)).max()
    assert error / 2 < run.error_estimate()[-1].max() < 20 * error


def test_a_pencil_serves_the_next_run(monkeypatch):
    """Another source and other values, the same operator: nothing is laid out again."""
    cloud, made = js.interval(0.0, 1.0, 21), []
    plain = assemble.laid_out
    monkeypatch.setattr(assemble, "laid_out", lambda *given: made.append(1) or plain(*given))

    def run(rate, s):
        problem = js.Problem(lambda u, x, t: js.dt(u)(x) - rate * js.laplacian(u)(x) - s,
                             everywhere(cloud, js.dirichlet(s)))  # fmt: skip
        return js.evolve(problem, cloud, s, (0.0, 1.0), steps=5).u

    first = run(1.0, 1.0)
    assert np.abs(run(1.0, 2.0) - 2 * first).max() < 1e-12 and len(made) == 1
    run(2.0, 1.0)
    assert len(made) == 2


def test_a_run_goes_on_where_it_was_left():
    half = moving_heat(steps=20)
    problem = js.Problem(heat(smooth), everywhere(ROD, js.dirichlet(smooth)))
    again = js.evolve(problem, ROD, half.u[-1], t=(1.0, 2.0), steps=20, order=6)
    assert np.abs(again.u[-1] - at(smooth, ROD, 2.0)).max() < 1e-6


def test_a_run_pickles_and_goes_to_xarray():
    run = moving_heat(steps=10, save=2)
    copy = pickle.loads(pickle.dumps(run))
    assert np.array_equal(copy.u, run.u) and abs(copy.at(0.3)([[0.4]])[0] - run.at(0.3)([[0.4]])[0]) < 1e-9
    pytest.importorskip("xarray")
    table = run.to_xarray()
    assert table["u"].dims == ("time", "particle") and table["time"].values.tolist() == [0.0, 0.5, 1.0]


def test_a_run_goes_to_paraview(tmp_path):
    meshio = pytest.importorskip("meshio")
    run = moving_heat(steps=10, save=2)
    js.files.to_pvd(run, tmp_path / "u.pvd")
    listed = (tmp_path / "u.pvd").read_text()
    assert [f'timestep="{t}" file="u_0000{k}.vtu"' in listed for k, t in enumerate(("0.0", "0.5", "1.0"))] == [True] * 3
    assert np.array_equal(meshio.read(tmp_path / "u_00001.vtu").point_data["u"], run.u[1])
    with pytest.raises(ValueError, match="path: expected the name of a .pvd file"):
        js.files.to_pvd(run, tmp_path / "u.vtu")


# ------------------------------------------------------------------ gradients


def hot(p):
    return js.Problem(
        lambda u, x, t, p: js.dt(u)(x) - p["k"] * js.laplacian(u)(x) - p["s"] * jnp.sin(x[0] + t),
        everywhere(ROD, js.dirichlet(lambda x, t, p: p["b"] * jnp.cos(t))), params=p,
    )  # fmt: skip


def reacting(p):
    return js.Problem(
        lambda u, x, t, p: js.dt(u)(x) - p["k"] * js.laplacian(u)(x) + u(x) * js.grad(u)(x)[0] - p["s"] * u(x) ** 2,
        everywhere(ROD, js.dirichlet(lambda x, t, p: p["b"] * jnp.cos(t))), params=p,
    )  # fmt: skip


def slope(f, p, way, eps=1e-4):
    """Of fourth order in eps: the tolerance below is that of its round-off."""
    moved = lambda s: f(jax.tree.map(lambda a, b: a + s * b, p, way))  # noqa: E731
    return (8 * (moved(eps) - moved(-eps)) - moved(2 * eps) + moved(-2 * eps)) / (12 * eps)


def spreading(p):
    """Quasilinear: the pencil is made anew on the way."""
    return js.Problem(
        lambda u, x, t, p: js.dt(u)(x) - js.divergence(lambda y: (1 + p["k"] * u(y) ** 2) * js.grad(u)(y))(x)
        - p["s"] * jnp.sin(x[0] + t),
        {"left": js.dirichlet(lambda x, t, p: p["b"] * (1 + 2 * t)), "right": js.neumann(lambda x, t, p: p["b"])},
        params=p,
    )  # fmt: skip


@pytest.mark.parametrize(("made", "scheme"), [
    (hot, "esdirk"), (hot, "radau"), (reacting, "imex"), (reacting, "esdirk"), (spreading, "esdirk"),
])  # fmt: skip
def test_gradients_are_those_of_differences(made, scheme):
    """By everything at once: the operator, the source, the conditions, the start and the end.

    Where the pencil is made anew, half way, both serve two steps.
    """
    def total(p):
        start = lambda x: p["b"] + 0.1 * p["a"] * x[0]  # noqa: E731
        run = js.evolve(made(p), ROD, start, t=(0.0, p["end"]), steps=4, order=2, save=2, scheme=scheme)
        return jnp.sum(run.u[-1] ** 2) + run.u[1, 5]

    p = {"k": 0.3, "s": 0.7, "b": 0.5, "a": 0.4, "end": 0.4}
    p = {name: jnp.asarray(v) for name, v in p.items()}
    way = dict(zip(p, (0.3, -0.5, 0.8, 1.0, 0.6)))
    value, found = jax.value_and_grad(total)(p)
    assert abs(value - total(p)) < 1e-10
    along = sum(found[name] * way[name] for name in p)
    assert abs(along - slope(total, p, way)) < 1e-7 * abs(along)


@pytest.mark.parametrize("end", [
    lambda k: js.dirichlet(k),
    lambda k: js.dirichlet(lambda x, t: 0.2 + k * t),
    lambda k: js.neumann(lambda x, t: jnp.sin(k * t)),
    lambda k: js.condition(lambda u, x, n, t: u(x) + n @ js.grad(u)(x) - k * t),
])  # fmt: skip
def test_gradients_by_what_conditions_close_over(end):
    """Not under jit, and with neither times nor parameters traced."""

    def last(k):
        problem = js.Problem(COOLING.pde, {"left": end(k), "right": js.dirichlet(0.0)})
        return js.evolve(problem, ROD, 0.2, t=(0.0, 0.2), steps=3, order=2).u[-1, 5]

    k = jnp.asarray(0.7)
    found = jax.grad(last)(k)
    assert abs(found - slope(last, k, 1.0)) < 1e-7 * abs(found)
    assert np.abs(jax.vmap(last)(jnp.array([0.7, 0.9])) - jnp.stack([last(k), last(0.9)])).max() < 1e-12


@pytest.mark.parametrize(("rate", "scheme"), [(1, "radau"), (1, "imex"), (1, "esdirk"), (2, "auto")])
def test_gradients_by_what_a_source_closes_over(rate, scheme):
    reacts = 1.0 if rate == 1 and scheme != "radau" else 0.0

    def last(k):
        problem = js.Problem(
            lambda u, x, t: js.dt(u, rate)(x) - js.laplacian(u)(x) + reacts * u(x) ** 2 - k * jnp.sin(k * t),
            COOLING.bcs,
        )
        start = 0.2 if rate == 1 else (0.0, 0.0)
        return js.evolve(problem, ROD, start, t=(0.0, 0.2), steps=3, order=2, scheme=scheme).u[-1, 5]

    k = jnp.asarray(0.7)
    found = jax.grad(last)(k)
    assert abs(found - slope(last, k, 1.0)) < 1e-7 * abs(found)


def test_the_way_back_makes_its_stages_anew_where_they_do_not_fit(monkeypatch):
    def total(k, scheme):
        problem = hot({"k": k, "s": 0.7, "b": 0.5})
        return jnp.sum(js.evolve(problem, ROD, 0.2, (0.0, 0.5), steps=6, order=2, scheme=scheme).u[-1])

    for scheme in ("esdirk", "radau"):
        kept = jax.grad(total)(jnp.asarray(0.3), scheme)
        with monkeypatch.context() as patch:
            patch.setattr(adjoint, "TAPE", 0)
            assert abs(jax.grad(total)(jnp.asarray(0.3), scheme) - kept) < 1e-13 * abs(kept)


def test_gradients_by_positions():
    near = js.stencils(ROD, size=17)

    def total(moved):
        points = jnp.asarray(ROD.points).at[5, 0].add(moved).at[8, 0].add(-0.5 * moved)
        placed = js.Cloud(points, ROD.groups, ROD.normals)
        problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) - jnp.sin(3 * x[0] + t),
                             everywhere(ROD, js.dirichlet(0.0)))  # fmt: skip
        run = js.evolve(problem, placed, lambda x: x[0] * (1 - x[0]), (0.0, 0.1), steps=6, order=2, stencils=near)
        return jnp.sum(run.u[-1] ** 2)

    found = jax.grad(total)(jnp.asarray(0.01))
    assert abs(found - slope(total, jnp.asarray(0.01), 1.0)) < 1e-7 * abs(found)


def test_jit_and_vmap():
    def last(s):
        p = {"k": 0.3, "s": s, "b": 0.5}
        return jnp.sum(js.evolve(hot(p), ROD, 0.5, t=(0.0, 0.5), steps=6, order=2, scheme="esdirk").u[-1])

    some = jnp.array([0.2, 0.4])
    one = jnp.stack([last(k) for k in some])
    assert np.abs(jax.vmap(last)(some) - one).max() < 1e-12
    value, found = mm.quickly(jax.value_and_grad(last))(some[0])
    assert abs(value - one[0]) < 1e-12 and abs(found - jax.grad(last)(some[0])) < 1e-9 * abs(found)


def test_a_reaction_inside_of_a_program():
    def last(s):
        p = {"k": 0.3, "s": s, "b": 0.5, "a": 0.4}
        return jnp.sum(js.evolve(reacting(p), ROD, 0.5, t=(0.0, 0.5), steps=6, order=2, scheme="imex").u[-1])

    alone, compiled = (jax.value_and_grad(f)(jnp.asarray(0.3)) for f in (last, jax.jit(last)))
    assert abs(alone[0] - compiled[0]) < 1e-12 and abs(alone[1] - compiled[1]) < 1e-10


def test_no_explicit_half_for_an_equation_without_a_rate():
    problem = js.Problem(
        lambda u, x, t: jnp.stack([js.dt(u)(x)[0] - js.laplacian(u)(x)[1], u(x)[1] - u(x)[0] ** 3]),
        everywhere(ROD, js.dirichlet(0.0)), fields=2,
    )  # fmt: skip
    with pytest.raises(ValueError, match='imex.*without a rate.*"esdirk"'):
        js.evolve(problem, ROD, jnp.zeros(2), t=(0.0, 0.1), steps=4, scheme="imex")


# ------------------------------------------------------------------ refusals and failures

COOLING = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), everywhere(ROD, js.dirichlet(0.0)))


def evolved(problem=COOLING, u0=1.0, t=(0.0, 1.0), **options):
    return js.evolve(problem, ROD, u0, t, **(options or {"steps": 4}))


def stated(pde, **bcs):
    return evolved(js.Problem(pde, {**COOLING.bcs, **bcs}))


def constrained(u, x, t):
    """A constraint of index 2 that is no incompressible flow."""
    a = js.laplacian(u[0])(x) + u(x)[1]
    return jnp.stack([js.dt(u[0])(x) - a, u(x)[0] - x[0]])


RADIATING = js.condition(lambda u, x, n: js.dt(u)(x) + n @ js.grad(u)(x))


@pytest.mark.parametrize("term", [
    lambda u, x: js.laplacian(js.dt(u))(x),
    lambda u, x: js.laplacian(js.dt(u, 2))(x),
    lambda u, x: js.grad(js.dt(u))(x)[0],
    lambda u, x: js.partial(js.dt(u), (2,))(x),
    lambda u, x: js.hessian(js.dt(u))(x)[0, 0],
    lambda u, x: js.divergence(lambda y: js.grad(u)(y) + 0.1 * js.grad(js.dt(u))(y))(x),
    lambda u, x: js.divergence(lambda y: y * js.dt(u)(y))(x),
    lambda u, x: js.laplacian(lambda y: u(y) + 0.1 * js.dt(u)(y))(x),
    lambda u, x: jax.grad(js.dt(u))(x)[0] * u(x),
])  # fmt: skip
def test_a_derivative_of_a_rate_is_refused_in_words(term):
    words = "derivative of a rate as an unknown of its own"
    for order in (1, 2):
        with pytest.raises(ValueError, match=words):
            stated(lambda u, x, t, order=order: js.dt(u, order)(x) - js.laplacian(u)(x) - 0.1 * term(u, x))

    def coupled(u, x, t):
        other = js.dt(u[1])(x) - js.laplacian(u[1])(x)
        return jnp.stack([js.dt(u[0])(x) - js.laplacian(u[0])(x) - 0.1 * term(u[1], x), other])

    with pytest.raises(ValueError, match=f"of field 1.*{words}"):
        evolved(js.Problem(coupled, COOLING.bcs, fields=2), jnp.zeros(2))


def test_a_rate_as_a_field_of_its_own():
    """The remedies: a pseudo-parabolic equation, and a rate in a condition, u_t + u_x = 0 at the end."""
    decay = np.pi**2 / (1 + 0.1 * np.pi**2)

    def pseudo(w, x, t):
        u, v = w
        return jnp.stack([js.dt(u)(x) - v(x), v(x) - 0.1 * js.laplacian(v)(x) - js.laplacian(u)(x)])

    start = lambda x: jnp.array([1.0, -decay]) * jnp.sin(jnp.pi * x[0])  # noqa: E731
    run = js.evolve(js.Problem(pseudo, COOLING.bcs, fields=2), ROD, start, t=(0.0, 0.1), steps=10, order=6)
    truth = np.stack([start(x) for x in np.asarray(ROD.points)]) * np.exp(-0.1 * decay)
    assert np.abs(run.u[-1] - truth).max() < 1e-4 * decay

    k = 0.8603335890193798  # k tan k = 1

    def heat(w, x, t):
        u, v = w
        return jnp.stack([js.dt(u)(x) - v(x), v(x) - js.laplacian(u)(x)])

    end = js.condition(lambda w, x, n: w[1](x) + n @ js.grad(w[0])(x))
    start = lambda x: jnp.array([1.0, -(k**2)]) * jnp.sin(k * x[0])  # noqa: E731
    run = js.evolve(js.Problem(heat, {"left": js.dirichlet(0.0), "right": end}, fields=2), ROD, start, t=(0.0, 0.5),
                    steps=10, order=6)  # fmt: skip
    truth = np.stack([start(x) for x in np.asarray(ROD.points)]) * np.exp(-0.5 * k**2)
    assert np.abs(run.u[-1] - truth).max() < 1e-6


@pytest.mark.parametrize(("call", "words"), [
    (lambda: js.evolve(js.Problem(constrained, everywhere(SQUARE, js.dirichlet(0.0, field=0)), fields=2), SQUARE, 0.0,
                       (0.0, 1.0), steps=4), "pde: field 1 has no rate"),
    (lambda: evolved(steps=3, tol=1e-3), "steps, tol: give exactly one"),
    (lambda: evolved(order=4), "steps, tol: give exactly one"),
    (lambda: evolved(steps=0), "steps: expected a whole number from 1"),
    (lambda: evolved(steps=2.5), "steps: expected a whole number"),
    (lambda: evolved(tol=-1.0), "tol: expected a number from"),
    (lambda: evolved(steps=4, scheme="esdrik"), "did you mean 'esdirk'"),
    (lambda: evolved(t=(1.0, 0.0)), "t0 < t1"),
    (lambda: evolved(t=1.0), r"t: expected the start and the end"),
    (lambda: evolved(u0=np.zeros(5)), "u0: expected a function of x or an array \\(17,\\)"),
    (lambda: evolved(u0=np.nan), "u0: NaN or infinite"),
    (lambda: evolved(steps=4, save=[2.0]), "save: times from 2 to 2"),
    (lambda: evolved(steps=4, save=0), "save: expected 1 to 10,000,000"),
    (lambda: evolved(steps=4, damping=-1), "damping: expected"),
    (lambda: stated(lambda u, x: js.laplacian(u)(x)), r"pde: js.evolve calls it as f\(u, x, t"),
    (lambda: stated(lambda u, x, t: js.laplacian(u)(x)), "no rate in it"),
    (lambda: stated(lambda u, x, t: u(x) * js.dt(u)(x) - js.laplacian(u)(x)), "divide the equation"),
    (lambda: stated(lambda u, x, t: js.dt(u, 2)(x) - js.laplacian(u)(x)), "starts from a pair"),
    (lambda: stated(lambda u, x, t: js.dt(u)(x) + js.grad(u)(x)[0], right=js.free()), "unstable for pure advection"),
    (lambda: stated(lambda u, x, t: js.dt(u)(x) + js.grad(u)(x)[0] - 1e-3 * js.laplacian(u)(x)), "cell Peclet number"),
    (lambda: evolved(js.Problem(COOLING.pde, {**COOLING.bcs, "right": js.condition(
        lambda u, x, n, t: n @ js.grad(u)(x) + u(x) ** 4)})), "the condition is nonlinear in u"),
    (lambda: evolved(js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) + u(x) ** 2, COOLING.bcs), steps=4,
                     scheme="radau"), "radau\" serves linear problems"),
    (lambda: js.solve(js.Problem(lambda u, x: js.dt(u)(x) - js.laplacian(u)(x), COOLING.bcs), ROD), "js.evolve"),
    (lambda: js.dt(lambda x: x[0]), "js.dt takes the unknown u itself"),
    (lambda: js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, {**COOLING.bcs, "right": RADIATING}), ROD),
     r"bcs\['right'\]: js.dt\(u\) in a condition"),
    (lambda: js.eigen(js.Problem(lambda u, x: js.laplacian(u)(x), {**COOLING.bcs, "right": RADIATING}), ROD, 2),
     r"bcs\['right'\]: js.dt\(u\) in a condition"),
    (lambda: js.eigen(js.Problem(lambda u, x: js.laplacian(u)(x), COOLING.bcs), ROD, 2,
                      mass=lambda u, x: js.dt(u)(x)), "mass: js.dt.* has no rates"),
    (lambda: stated(COOLING.pde, right=RADIATING), r"bcs\['right'\]: js.dt\(u\) in a condition"),
    (lambda: stated(COOLING.pde, right=js.condition(lambda u, x, n, t: js.dt(u)(x) - 1.0)), "a field v of its own"),
])  # fmt: skip
def test_refused_in_words(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_a_run_that_blows_up_keeps_its_last_good_state():
    """u_t = u_xx + u^2 from a large start is infinite soon."""
    bcs = everywhere(ROD, js.neumann(0.0))
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) - u(x) ** 2, bcs)
    with pytest.raises(js.SolveError, match="the run stopped: the solution"):
        js.evolve(problem, ROD, 10.0, t=(0.0, 5.0), steps=100)
    run = js.evolve(problem, ROD, 10.0, t=(0.0, 5.0), steps=100, throw=False)
    assert not run.converged and run.flags[0].startswith("FAILED") and np.isfinite(run.u).all() and run.t[-1] < 5.0


def test_too_few_steps_are_flagged():
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) - 100 * jnp.sin(40 * t), COOLING.bcs)
    assert any("error in time" in flag for flag in js.evolve(problem, ROD, 0.0, t=(0.0, 3.0), steps=8).flags)


def test_stiff_reactions_are_told_the_scheme_that_solves_for_them():
    """u' = -1e6 (u^3 - cos t), explicitly: no step is small enough, or what there is blows up."""
    rate = lambda u, x, t: js.dt(u)(x) - 0.01 * js.laplacian(u)(x) + 1e6 * (u(x) ** 3 - jnp.cos(t))
    problem = js.Problem(rate, {"left": js.neumann(0.0), "right": js.neumann(0.0)})
    cloud = js.interval(0.0, 1.0, 9)
    with pytest.raises(js.SolveError, match='scheme="esdirk" solves for what is nonlinear'):
        js.evolve(problem, cloud, 1.0, t=(0.0, 1.0), steps=20, scheme="imex")
    run = js.evolve(problem, cloud, 1.0, t=(0.0, 1.0), steps=40, scheme="esdirk")
    assert np.abs(run.u[-1] - np.cos(1.0) ** (1 / 3)).max() < 1e-4


def test_gradients_of_a_quasilinear_start_against_its_conditions():
    """Coefficients are others once the conditions are met, and the pencil is made anew before the first step."""

    def last(k):
        pde = lambda u, x, t: js.dt(u)(x) - js.divergence(lambda y: (1 + u(y) ** 2) * js.grad(u)(y))(x)
        problem = js.Problem(pde, {"left": js.dirichlet(k), "right": js.dirichlet(k)})
        start = lambda x: 1.0 + jnp.sin(jnp.pi * x[0])
        return js.evolve(problem, ROD, start, t=(0.0, 0.05), steps=4, order=2).u[-1].sum()

    value, slope = jax.value_and_grad(last)(0.7)
    assert float(value) == pytest.approx(float(last(0.7)), rel=1e-12)
    assert float(slope) == pytest.approx(float(last(0.7 + 1e-5) - last(0.7 - 1e-5)) / 2e-5, rel=1e-6)
