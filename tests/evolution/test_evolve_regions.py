"""Heat in several regions: the exact mode of two layers, data that move, gradients, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jsmitsm as js

K, HEAT = {"a": 1.0, "b": 10.0}, {"a": 1.0, "b": 3.0}  # conductivities, heat capacities
LAYERS = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=1 / 24)
FLUX = {name: lambda u, x, n, c=c: c * n @ js.grad(u)(x) for name, c in K.items()}


def heat(name):
    return lambda u, x, t: HEAT[name] * js.dt(u)(x) - K[name] * js.laplacian(u)(x)


def slowest():
    """The decay of two layers held at 0 and its mode: sin(a x) and A sin(b (1 - x)), a^2 = l c / k."""

    def roots(value):
        return [np.sqrt(value * HEAT[name] / K[name]) for name in K]

    def flux(value):
        a, b = roots(value)
        return K["a"] * a * np.cos(a / 2) * np.sin(b / 2) + K["b"] * b * np.cos(b / 2) * np.sin(a / 2)

    value = brentq(flux, 15.0, 30.0, xtol=1e-14)
    a, b = roots(value)
    factor = np.sin(a / 2) / np.sin(b / 2)
    return value, {"a": lambda x: jnp.sin(a * x[0]), "b": lambda x: factor * jnp.sin(b * (1.0 - x[0]))}


def test_the_slowest_mode_of_two_layers_decays_as_it_should():
    value, mode = slowest()
    problem = js.Problem({n: heat(n) for n in K}, {"boundary": js.dirichlet(0.0), "a|b": js.interface(FLUX)})
    run = js.evolve(problem, LAYERS, mode, t=(0.0, 0.05), steps=20, order=6, progress=False)
    truth = np.zeros(len(LAYERS))
    for name, ids in LAYERS.regions.items():
        truth[ids] = jax.vmap(mode[name])(LAYERS.points[ids]) * np.exp(-0.05 * value)
    # 12 intervals a layer at order 6; the estimate is of the same size.
    assert np.abs(run.u[-1] - truth).max() < 4e-6 and run.flags == []
    assert run.error_estimate()[-1].max() < 1e-5
    i, j = LAYERS.interfaces["a|b"][0]
    assert abs(run.u[-1, i] - run.u[-1, j]) < 1e-12
    end = run.at(0.05)
    assert abs(end([[0.5]], region="a") - end([[0.5]], region="b"))[0] < 1e-12
    # Fluxes from the values of either side alone: of the order of the method less one.
    assert abs(end.flux("a|b", K["a"], region="a") - end.flux("a|b", K["b"], region="b")) < 1e-4


def test_jumps_sources_and_values_that_move_are_met_at_every_moment():
    """u = t x on the left, t x + 1 + t on the right is exact for every scheme and order."""
    u = {"a": lambda x, t: t * x[0], "b": lambda x, t: t * x[0] + 1.0 + t}
    rate = {"a": lambda x: x[0], "b": lambda x: x[0] + 1.0}
    pde = {n: lambda v, x, t, n=n: js.dt(v)(x) - K[n] * js.laplacian(v)(x) - rate[n](x) for n in K}
    sides = js.interface(FLUX, jump=lambda x, t: -1.0 - t, source=lambda x, t: (K["a"] - K["b"]) * t)
    ends = js.dirichlet(lambda x, t: jnp.where(x[0] < 0.5, u["a"](x, t), u["b"](x, t)))
    problem = js.Problem(pde, {"boundary": ends, "a|b": sides})
    start = {"a": 0.0, "b": lambda x: 1.0 + 0.0 * x[0]}
    run = js.evolve(problem, LAYERS, start, t=(0.0, 1.0), steps=4, progress=False)
    for name, ids in LAYERS.regions.items():
        exact = jax.vmap(lambda x, name=name: u[name](x, 1.0))(LAYERS.points[ids])
        assert np.abs(run.u[-1, ids] - exact).max() < 1e-9  # round-off


def test_the_normal_of_a_flux_has_any_name():
    flux = {name: lambda u, x, nu, f=f: f(u, x, nu) for name, f in FLUX.items()}
    held, options = js.dirichlet(lambda x, t: t), {"t": (0.0, 0.1), "steps": 2, "progress": False}
    problems = [js.Problem({n: heat(n) for n in K}, {"boundary": held, "a|b": js.interface(f)}) for f in (FLUX, flux)]
    runs = [js.evolve(problem, LAYERS, 0.0, **options) for problem in problems]
    assert np.abs(runs[0].u[-1]).max() > 0.01 and np.array_equal(runs[0].u, runs[1].u)


def test_what_several_regions_do_not_take_is_named():
    ends = {"boundary": js.dirichlet(0.0), "a|b": js.interface(FLUX)}
    rest = {"t": (0.0, 1.0), "steps": 2, "progress": False}

    def refused(told, pde, u0=0.0):
        with pytest.raises(ValueError, match=told):
            js.evolve(js.Problem({"a": heat("a"), "b": pde}, ends), LAYERS, u0, **rest)

    refused(r"pde\['b'\]: nonlinear in u", lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) + u(x) ** 3)
    refused(r"pde\['b'\]: of second order in time", lambda u, x, t: js.dt(u, 2)(x) - js.laplacian(u)(x))
    refused(r"no rate in it.*\(in the region 'b'\)", lambda u, x, t: js.laplacian(u)(x))
    refused(r"u0: values for the regions \['a'\]; the cloud has \['a', 'b'\]", heat("b"), {"a": 0.0})


def test_every_region_has_its_condition_on_one_group():
    """The same as on a group for each end."""
    ends = {"left": lambda x: x[:, 0] < 0.1, "right": lambda x: x[:, 0] > 0.9}
    parted = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=1 / 24, groups=ends)
    held = js.dirichlet(lambda x, t: jnp.sin(t))
    loses = js.condition(lambda u, x, n, t: FLUX["b"](u, x, n) + u(x) - t)
    between = {"a|b": js.interface(FLUX)}
    runs = [
        js.evolve(js.Problem({n: heat(n) for n in K}, bcs | between), cloud, 0.0, t=(0.0, 0.1), steps=5, progress=False)
        for bcs, cloud in (({"boundary": {"a": held, "b": loses}}, LAYERS), ({"left": held, "right": loses}, parted))
    ]
    assert np.abs(runs[0].u[-1]).max() > 0.01 and (runs[0].u == runs[1].u).all()


def test_gradients_by_what_functions_close_over():
    def last(k):
        pde = {n: lambda u, x, t, n=n: heat(n)(u, x, t) - (k * t if n == "a" else 0.0) for n in K}
        sides = js.interface(FLUX, jump=lambda x, t: k * t, source=lambda x, t: k)
        problem = js.Problem(pde, {"boundary": js.dirichlet(lambda x, t: k * t), "a|b": sides})
        return js.evolve(problem, LAYERS, 1.0, t=(0.0, 0.1), steps=3, order=2, progress=False).u[-1, 3]

    found = jax.grad(last)(0.7)
    assert abs(found - (last(0.8) - last(0.6)) / 0.2) < 1e-8 * abs(found)  # linear in k


def test_rates_in_conditions_and_their_derivatives_are_refused():
    slope = {n: lambda u, x, t, n=n: heat(n)(u, x, t) - js.laplacian(js.dt(u))(x) for n in K}
    rated = js.interface({**FLUX, "b": lambda u, x, n: n @ js.grad(u)(x) + js.dt(u)(x)})
    for pde, sides, words in (
        (slope, js.interface(FLUX), "derivative of a rate as an unknown of its own.*region 'a'"),
        ({n: heat(n) for n in K}, rated, r"js.dt\(u\) in a condition"),
    ):
        with pytest.raises(ValueError, match=words):
            js.evolve(js.Problem(pde, {"boundary": js.dirichlet(0.0), "a|b": sides}), LAYERS, 1.0, (0.0, 0.1), steps=2)
