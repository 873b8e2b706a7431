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


@pytest.mark.parametrize("n", [21, 31])
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


@pytest.mark.parametrize(
    "name, order", [*((name, 4) for name in OPERATORS), ("1 + u", 6), ("in time and space", 6)]
)
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


HEAT = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ENDS)


def modes(parts):
    """A start of half-waves, amplitudes by number, and what becomes of it."""
    start = lambda x: sum(a * jnp.sin(k * jnp.pi * x[0]) for k, a in parts.items())
    exact = lambda x, t: sum(a * np.exp(-((k * np.pi) ** 2) * t) * np.sin(k * np.pi * x) for k, a in parts.items())
    return start, exact


@pytest.mark.parametrize("order", [4, 6])
@pytest.mark.parametrize("steps", [5, 20, 40])
@pytest.mark.parametrize("name", ["shock", "two waves", "a faint one"])
def test_states_between_the_steps(name, steps, order):
    """What is over within the first step, of walls that are cold at once or of short waves, is not interpolated."""
    odd = {k: 4 / (k * np.pi) for k in range(1, 400, 2)}
    start, exact = modes({"shock": odd, "two waves": {1: 1.0, 8: 0.5}, "a faint one": {1: 1.0, 8: 0.01}}[name])
    start = 1.0 if name == "shock" else start
    run = js.evolve(HEAT, js.interval(0.0, 1.0, 41), start, t=(0.0, 0.2), steps=steps, order=order, save=100)
    error = np.abs(run.u[1:] - np.stack([exact(run.cloud.points[:, 0], t) for t in run.t[1:]])).max(axis=1)
    told = np.asarray(run.error_estimate()[1:]).max(axis=1)
    seen = error > 1e-2 * error.max()
    assert (told > error / 5)[seen].all() and told.max() < 5 * error.max()
    assert any("The estimated error in time" in flag for flag in run.flags) == (error.max() > 0.02)


@pytest.mark.parametrize("order", [4, 6])
def test_the_first_step_of_cold_walls(order):
    odd = {k: 4 / (k * np.pi) for k in range(1, 400, 2)}
    run = js.evolve(HEAT, js.interval(0.0, 1.0, 41), 1.0, t=(0.0, 0.2), steps=20, order=order, save=20)
    error = np.abs(run.u[1] - modes(odd)[1](run.cloud.points[:, 0], 0.01)).max()
    assert 0.5 < run.error_estimate()[1].max() / error < 5 and run.flags


@pytest.mark.parametrize("order", [6, 8])
@pytest.mark.parametrize("steps", [5, 20, 80])
def test_radau_is_not_doubted_without_need(order, steps):
    start, exact = modes({1: 1.0})
    run = js.evolve(HEAT, js.interval(0.0, 1.0, 41), start, t=(0.0, 0.3), steps=steps, order=order)
    error = np.abs(run.u[-1] - exact(run.cloud.points[:, 0], 0.3)).max()
    assert 0.5 < run.error_estimate()[-1].max() / error < 50


def test_radau_takes_the_steps_that_a_tolerance_needs():
    start, exact = modes({1: 1.0})
    run = js.evolve(HEAT, js.interval(0.0, 1.0, 41), start, t=(0.0, 0.3), tol=1e-8, order=8)
    assert np.abs(run.u[-1] - exact(run.cloud.points[:, 0], 0.3)).max() < 1e-7
    assert run.stats["steps"] < 40


@pytest.mark.parametrize("last", [2.3, 20.3])
def test_errors_of_steps_in_waves_add_up(last):
    """They turn with the wave: their sizes are added."""
    problem = js.Problem(lambda u, x, t: js.dt(u, 2)(x) - js.laplacian(u)(x), ENDS)
    start = (lambda x: jnp.sin(jnp.pi * x[0]), 0.0)
    run = js.evolve(problem, js.interval(0.0, 1.0, 21), start, t=(0.0, last), tol=1e-5, order=8)
    error = np.abs(run.u[-1] - np.sin(np.pi * run.cloud.points[:, 0]) * np.cos(np.pi * last)).max()
    assert 0.5 < run.stats["error_in_time"] / error < 20


def beside(large, **steps):
    """A field driven by cos 50 t, another of its own beside it: the run, and the first one's error."""
    shape, a = (lambda x: jnp.sin(jnp.pi * x[0])), 0.1 * np.pi**2
    driven = lambda x, t: (50 * jnp.cos(50 * t) + a * jnp.sin(50 * t)) * shape(x)
    pde = lambda w, x, t: jnp.stack([js.dt(w[0])(x) - 0.1 * js.laplacian(w[0])(x) - driven(x, t),
                                     js.dt(w[1])(x) - 0.1 * js.laplacian(w[1])(x)])  # fmt: skip
    start = lambda x: jnp.stack([0.0 * x[0], large * shape(x)])
    run = js.evolve(js.Problem(pde, ENDS, fields=2), js.interval(0.0, 1.0, 21), start, t=(0.0, 1.0), **steps)
    return run, np.abs(run.u[-1, :, 0] - np.sin(np.pi * run.cloud.points[:, 0]) * np.sin(50.0)).max()


@pytest.mark.parametrize("large", [1.0, 1e3, 1e8])
def test_each_field_by_its_own_size(large):
    run, error = beside(large, steps=12)
    assert error > 0.03 and run.stats["error_in_time"] > 0.02
    assert any("error in time" in flag for flag in run.flags)
    told = run.error_estimate()[-1].max(axis=0)
    assert error / 2 < told[0] < 10 * error and told[1] < 1e-3 * large


@pytest.mark.parametrize("large", [1.0, 1e5, 1e9])
def test_tolerances_are_each_fields_own(large):
    run, error = beside(large, tol=1e-4)
    assert error < 1e-3 and run.flags == []


def test_a_field_that_is_nothing_but_round_off_stops_nothing():
    """No coupling is left of the second one, but its matrix has the noise of one; from zero it would ask for all."""
    one = lambda w, x: js.dt(w)(x) - js.laplacian(w)(x)
    pde = lambda w, x, t: jnp.stack([one(w[0], x), one(w[1], x) + 0.0 * js.grad(w[0])(x)[0]])
    start = lambda x: jnp.stack([jnp.sin(jnp.pi * x[0]), 0.0 * x[0]])
    run = js.evolve(js.Problem(pde, ENDS, fields=2), js.interval(0.0, 1.0, 21), start, t=(0.0, 0.1), tol=1e-8)
    assert run.stats["steps"] < 60 and run.flags == []


def test_a_field_from_zero_that_another_makes():
    """Of the size of 1e-6 of the one that drives it; relative to nothing no first step would do."""
    a = np.pi**2
    pde = lambda w, x, t: jnp.stack([js.dt(w[0])(x) - js.laplacian(w[0])(x) - 1e-6 * w[1](x) ** 2,
                                     js.dt(w[1])(x) - 2 * js.laplacian(w[1])(x)])  # fmt: skip
    start = lambda x: jnp.stack([0.0 * x[0], jnp.sin(jnp.pi * x[0])])
    cloud = js.interval(0.0, 1.0, 21)
    coarse, fine = (js.evolve(js.Problem(pde, ENDS, fields=2), cloud, start, t=(0.0, 1.0 / a), tol=tol)
                    for tol in (1e-4, 1e-8))  # fmt: skip
    off = np.abs(coarse.u[-1] - fine.u[-1]).max(axis=0) / np.abs(fine.u[-1]).max(axis=0)
    assert off.max() < 5e-3 and coarse.stats["steps"] < 200


SEAM = {"left": js.periodic("left", "right")}


@pytest.mark.parametrize(
    "name, n",
    [("source", 41), ("source", 81), ("wave", 41), ("reaction", 41), ("capacity", 41), ("square", 41), ("start", 41)],
)
def test_what_jumps_across_the_seam_of_a_periodic_pair(name, n):
    """A saw's teeth, which no order sees: the error falls with the spacing alone. Compared with a finer cloud."""
    heat = lambda u, x: js.dt(u)(x) - 0.2 * js.laplacian(u)(x)
    pde, start = {
        "source": (lambda u, x, t: heat(u, x) - x[0], 0.0),
        "wave": (lambda u, x, t: js.dt(u, 2)(x) - js.laplacian(u)(x) + 3 * u(x) - x[0], (0.0, 0.0)),
        "reaction": (lambda u, x, t: heat(u, x) + 5 * x[0] * u(x), 1.0),
        "capacity": (lambda u, x, t: (1 + 4 * x[0]) * js.dt(u)(x) - js.laplacian(u)(x) - jnp.sin(5 * t), 0.0),
        "square": (lambda u, x, t: heat(u, x) + 5 * x[0] * u(x) ** 2, 1.0),
        "start": (lambda u, x, t: heat(u, x), lambda x: x[0]),
    }[name]
    run, fine = (js.evolve(js.Problem(pde, SEAM), js.interval(0.0, 1.0, m), start, t=(0.0, 0.5), steps=20)
                 for m in (n, 16 * (n - 1) + 1))  # fmt: skip
    error = np.abs(run.u[-1] - fine.u[-1][::16]).max()
    assert error > 1e-4 and 0.7 * error < run.error_estimate()[-1].max() < 3 * error


def test_a_seam_of_much_is_a_flag_and_one_of_nothing_is_none():
    heat = lambda k: lambda u, x, t: js.dt(u)(x) - 0.1 * js.laplacian(u)(x) + 5 * k(x[0]) * u(x)
    for k, wrong in ((lambda s: s, True), (lambda s: 1 + jnp.sin(2 * jnp.pi * s), False)):
        run = js.evolve(js.Problem(heat(k), SEAM), js.interval(0.0, 1.0, 41), 1.0, t=(0.0, 1.0), steps=20)
        assert any("both sides of a periodic pair" in flag for flag in run.flags) == wrong


def test_a_pencil_with_a_growing_mode_tells_nothing(monkeypatch):
    """Where that of two orders more makes the error grow beyond the solution, another is asked: here it is made to."""
    from jsmitsm.evolution.run import Run

    made, asked = Run.beside, []

    def beside(self, order, t, u):
        semi = made(self, order, t, u)
        asked.append(order)
        if order == self.order + 2:  # of u_t = u'' the equation that runs backwards
            values = tuple(np.negative(v) if k == 0 else v for k, v in enumerate(semi.system.values))
            semi.system = semi.system.with_values(values)
        return semi

    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ENDS)
    start = lambda x: jnp.sin(2 * jnp.pi * x[0])
    run = js.evolve(problem, js.interval(0.0, 1.0, 21), start, t=(0.0, 0.1), steps=40)
    monkeypatch.setattr(Run, "beside", beside)
    error = np.abs(run.u[-1] - np.exp(-0.4 * np.pi**2) * start(run.cloud.points.T)).max()
    assert error / 3 < run.error_estimate()[-1].max() < 100 * error and asked == [6, 5]
