"""Complex problems: plane waves with an impedance, systems, parameters, and the operations that have two parts."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.equation.unknowns.parts import parts

K, WAY = 4.0, jnp.array([0.6, 0.8])
SQUARE = js.rectangle((0.0, 0.0), (1.0, 1.0), (15, 15), jitter=0.2)
LINE = js.interval(0.0, 1.0, 21)


def wave(x):
    return jnp.exp(1j * K * (WAY @ x))


def test_a_plane_wave_with_impedance_all_around():
    """laplacian(u) + k^2 u = 0 with n . grad u - i k u given: order 6 is right to 1e-6 at k h = 0.3."""
    impedance = lambda u, x, n: n @ js.grad(u)(x) - 1j * K * u(x) - 1j * K * (n @ WAY - 1.0) * wave(x)
    pde = lambda u, x: js.laplacian(u)(x) + K**2 * u(x)
    sides = ("left", "right", "top", "bottom")
    sol = js.solve(js.Problem(pde, dict.fromkeys(sides, js.condition(impedance)), dtype=complex), SQUARE, order=6)
    truth = jax.vmap(wave)(SQUARE.points)
    assert sol.u.dtype == complex and sol.u.shape == (225,) and sol.converged and not sol.flags
    assert abs(sol.u - truth).max() < 1e-6
    points = np.array([[0.3, 0.4], [0.51, 0.22]])
    assert abs(sol(points) - jax.vmap(wave)(points)).max() < 1e-6
    assert abs(sol.grad(points) - 1j * K * WAY * jax.vmap(wave)(points)[:, None]).max() < 1e-5
    side = lambda d: (jnp.exp(1j * K * d) - 1.0) / (1j * K * d)
    assert abs(sol.integral() - side(0.6) * side(0.8)) < 1e-7
    estimate = sol.error_estimate()
    assert estimate.shape == (225,) and 1e-9 < estimate.max() < 1e-5
    assert sol.coefficients.dtype == complex and len(sol.coefficients) == 225
    again = pickle.loads(pickle.dumps(sol))
    assert abs(again(points) - sol(points)).max() < 1e-14


def test_robin_with_a_complex_factor_neumann_and_arrays():
    """The same wave in 1D with robin(-i k, 1, ...), and with values given as arrays."""
    pde = lambda u, x: js.laplacian(u)(x) + K**2 * u(x)
    exact = lambda x: jnp.exp(1j * K * x[0])
    truth = jax.vmap(exact)(LINE.points)
    ends = [
        {"left": js.dirichlet(1.0), "right": js.robin(-1j * K, 1.0, 0.0)},
        {"left": js.robin(1j * K, 1.0, lambda x: 0.0 * x[0]), "right": js.dirichlet(np.array([truth[-1]]))},
        {"left": js.neumann(-1j * K), "right": js.robin(2.0, 1.0, (2.0 + 1j * K) * exact(jnp.ones(1)))},
    ]
    ends[1]["left"] = js.robin(1j * K, 1.0, 0.0)  # outward is -x: -u' + i k u = 0
    for bcs in ends:
        sol = js.solve(js.Problem(pde, bcs, dtype=complex), LINE, order=6)
        assert abs(sol.u - truth).max() < 1e-8, bcs


def test_a_system_with_complex_params_and_a_gradient():
    """u'' = c v, v'' = 0 with v = x, u = c x^3 / 6: polynomials, exact; the derivative of |u(1/2)|^2 by c is known."""
    ends = {
        "left": js.dirichlet(0.0),
        "right": [js.dirichlet(lambda x, p: p["c"] / 6.0, field=0), js.dirichlet(1.0, field=1)],
    }
    pde = lambda u, x, p: jnp.stack([js.laplacian(u[0])(x) - p["c"] * u[1](x), (1.0 + 2j) * js.laplacian(u[1])(x)])
    problem = js.Problem(pde, ends, fields=2, params={"c": 3.0 - 1.0j}, dtype=complex)
    sol = js.solve(problem, LINE)
    x = LINE.points[:, 0]
    assert sol.u.shape == (21, 2) and sol([[0.3]]).shape == (1, 2) and sol.grad([[0.3]]).shape == (1, 2, 1)
    assert abs(sol.u - np.stack([(3.0 - 1.0j) * x**3 / 6, x + 0j], 1)).max() < 1e-11
    size = lambda a: abs(js.solve(problem.replace(params={"c": a - 1.0j}), LINE).u[10, 0]) ** 2
    assert abs(jax.grad(size)(3.0) - 2 * 3.0 / 48**2) < 1e-10


def test_a_nonlinear_complex_equation():
    """u'' = 2 u^3 for u = 1 / (x + i)."""
    exact = lambda x: 1.0 / (x[0] + 1j)
    ends = {side: js.dirichlet(exact) for side in ("left", "right")}
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 2.0 * u(x) ** 3, ends, dtype=complex), LINE, order=6)
    assert sol.converged and abs(sol.u - jax.vmap(exact)(LINE.points)).max() < 1e-7


def test_a_jump_that_is_differentiated_is_refused_and_a_meant_one_is_not():
    layers = lambda y: jnp.where(y[0] < 0.503, 1.0j, 100.0j)
    conduct = lambda k: lambda u, x: js.divergence(lambda y: k(y) * js.grad(u)(y))(x)
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0j)}
    with pytest.raises(ValueError, match="js.meant"):
        js.solve(js.Problem(conduct(layers), ends, dtype=complex), LINE)
    sol = js.solve(js.Problem(conduct(js.meant(layers)), ends, dtype=complex), LINE)
    assert abs(sol.u - 1j * LINE.points[:, 0]).max() < 1e-12


@pytest.mark.parametrize(
    "function",
    [
        lambda x: jnp.exp(1j * x[0]) / (x[1] + 2j), lambda x: jnp.sin(x[0] + 1j * x[1]) * jnp.cos(1j * x[0] - x[1]),
        lambda x: jnp.sinh(x[0] * 1j + x[1]) - jnp.cosh(x[0] + 3j), lambda x: jnp.sqrt(x[0] - 1j) + jnp.log(x[1] + 1j),
        lambda x: (x[0] + 1j) ** -3 + jnp.conj(x[1] + 2j) ** 2,
        lambda x: jnp.abs(x[0] + 1j) + jnp.real(1j * x[1] + x[0]),
        lambda x: jnp.array([[1.0, 1j], [2j, 3.0]]) @ (x + 1j), lambda x: jnp.where(x[0] > 0, x[0] + 1j, 2.0j),
        lambda x: jnp.sum(jnp.stack([x[0] * 1j, x[1] + 0j])), lambda x: jax.jit(lambda y: y * (2 + 1j))(x),
    ],
)  # fmt: skip
def test_operations_in_two_parts(function):
    x = jnp.array([0.7, -0.4])
    re, im = parts(function, x)
    assert abs(re + 1j * im - function(x)).max() < 1e-14


def test_what_is_refused():
    ends = {side: js.dirichlet(1j) for side in ("left", "right")}
    pde = lambda u, x: js.laplacian(u)(x)
    refused = [
        (lambda: js.Problem(pde, ends), "js.Problem.*dtype=complex"),
        (lambda: js.Problem(pde, ends, dtype=int), "dtype: expected float or complex"),
        (lambda: js.Problem(pde, ends, dtype=complex, constraints=[js.constraint(lambda s: 0.0)]), "made for real"),
        (lambda: js.solve(js.Problem(pde, ends, dtype=complex), LINE, method="III"), 'use "S"'),
        (lambda: js.factorize(js.Problem(pde, ends, dtype=complex), LINE), "dtype=complex is for js.solve alone"),
        (lambda: js.eigen(js.Problem(pde, ends, dtype=complex), LINE, 1), "dtype=complex is for js.solve alone"),
        (lambda: js.solve(js.Problem(lambda u, x: jnp.tan(1j * x[0]) * js.laplacian(u)(x), ends, dtype=complex), LINE),
         "the operation tan"),
        (lambda: js.solve(js.Problem(pde, {**ends, "left": js.robin(1j, 1.0, np.array([1.0]))}, dtype=complex), LINE),
         "as an array"),
    ]  # fmt: skip
    for ask, told in refused:
        with pytest.raises(ValueError, match=told):
            ask()


@pytest.mark.parametrize("source, exact", [
    (lambda x: ((2 + 1j) * jnp.exp(1j * x[0])).real, lambda x: (-(2 + 1j) * np.exp(1j * x)).real),
    (lambda x: jnp.square(jnp.exp(1j * x[0]).real), lambda x: x**2 / 4 - np.cos(2 * x) / 8),
    (lambda x: jnp.abs(jnp.exp((1 + 1j) * x[0])) + jnp.angle(jnp.asarray(1j)), lambda x: np.exp(x) + np.pi * x**2 / 4),
])  # fmt: skip
def test_complex_numbers_within_a_real_problem(source, exact):
    """u'' = the source, and the same with it in front of u'': values, coefficients and conditions."""
    ends = {"left": js.dirichlet(exact(0.0)), "right": js.dirichlet(exact(1.0))}
    for pde in (
        lambda u, x: js.laplacian(u)(x) - source(x),
        lambda u, x: ((1 + 1j) * (2 + source(x)) * (js.laplacian(u)(x) - source(x))).imag,
    ):
        sol = js.solve(js.Problem(pde, ends), LINE, order=6)
        assert abs(sol.u - exact(LINE.points[:, 0])).max() < 1e-11 and not sol.flags
