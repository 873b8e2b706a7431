"""Modes of several regions: two layers of other conductivity and capacity, against the roots of their equation."""

import numpy as np
import pytest
from scipy.optimize import brentq

import jsmitsm as js

K, HEAT = {"a": 1.0, "b": 10.0}, {"a": 1.0, "b": 3.0}
LAYERS = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=1 / 40)
FLUX = {name: lambda u, x, n, c=c: c * n @ js.grad(u)(x) for name, c in K.items()}
PDE = {name: lambda u, x, c=c: -c * js.laplacian(u)(x) for name, c in K.items()}


def roots(count):
    """k_a a cos(a / 2) sin(b / 2) + k_b b cos(b / 2) sin(a / 2) = 0 with a^2 = l c_a / k_a."""

    def flux(value):
        a, b = (np.sqrt(value * HEAT[name] / K[name]) for name in K)
        return K["a"] * a * np.cos(a / 2) * np.sin(b / 2) + K["b"] * b * np.cos(b / 2) * np.sin(a / 2)

    at = np.linspace(1.0, 400.0, 4001)
    signs = np.sign([flux(x) for x in at])
    where = np.flatnonzero(signs[1:] != signs[:-1])[:count]
    return np.array([brentq(flux, at[i], at[i + 1], xtol=1e-13) for i in where])


def test_values_of_two_layers_are_the_roots_and_their_errors_are_known():
    problem = js.Problem(PDE, {"boundary": js.dirichlet(0.0), "a|b": js.interface(FLUX)})
    modes = js.eigen(problem, LAYERS, 3, mass=HEAT)
    exact = roots(3)
    off = np.abs(modes.values / exact - 1.0)
    # 20 intervals a layer, order 6: 2e-9, 9e-8 and 2e-6 were measured.
    assert (off < [1e-8, 3e-7, 1e-5]).all() and modes.flags == []
    assert (np.abs(modes.values - exact) < 10.0 * modes.error_estimate()).all()
    a = np.sqrt(exact[0])
    half, quarter = modes(0, [[0.5], [0.25]])
    assert abs(half / quarter - np.sin(a / 2) / np.sin(a / 4)) < 1e-8
    i, j = LAYERS.interfaces["a|b"][0]
    assert np.abs(modes.u[i] - modes.u[j]).max() < 1e-12
    with pytest.raises(ValueError, match=r"mass: given for the regions \['a'\]; the cloud has \['a', 'b'\]"):
        js.eigen(problem, LAYERS, 1, mass={"a": 1.0})


def test_every_region_has_its_condition_on_one_group():
    """The same as on a group for each end."""
    ends = {"left": lambda x: x[:, 0] < 0.1, "right": lambda x: x[:, 0] > 0.9}
    parted = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=1 / 40, groups=ends)
    held, loses = js.dirichlet(0.0), js.condition(lambda u, x, n: FLUX["b"](u, x, n) + u(x))
    between = {"a|b": js.interface(FLUX)}
    one = js.eigen(js.Problem(PDE, {"boundary": {"a": held, "b": loses}, **between}), LAYERS, 2, mass=HEAT)
    two = js.eigen(js.Problem(PDE, {"left": held, "right": loses, **between}), parted, 2, mass=HEAT)
    assert (one.values == two.values).all() and one.values[0] > 1.0
