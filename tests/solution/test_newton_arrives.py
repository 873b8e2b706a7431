"""Newton's method from far starts, its rate at the end, and what it says where it fails."""

import re

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest
from scipy.linalg import solve_banded
from scipy.optimize import brentq

import jsmitsm as js
from benchmarks.problems import CASES

ROOT = np.sqrt(2.0)


def ends(left, right):
    return {"left": js.dirichlet(left), "right": js.dirichlet(right)}


def differences(f, slope, x, start):
    """u'' = f(u, x) with the end values of ``start``, by second-order differences and undamped Newton steps."""
    u, h = start.copy(), x[1] - x[0]
    for _ in range(60):
        left = (u[2:] - 2 * u[1:-1] + u[:-2]) / h**2 - f(u[1:-1], x[1:-1])
        band = np.ones((3, len(left))) / h**2
        band[1] = -2 / h**2 - slope(u[1:-1], x[1:-1])
        step = solve_banded((1, 1), band, left)
        u[1:-1] -= step
        if np.abs(step).max() < 1e-12 * np.abs(u).max():
            return u
    raise AssertionError("the reference does not converge")


def kink(start, order, n):
    far = np.tanh(6 / ROOT)
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - u(x) ** 3 + u(x), ends(-far, far))
    cloud = js.interval(-6.0, 6.0, n)
    sol = js.solve(problem, cloud, order=order, u0=start)
    return sol, np.abs(sol.u - np.tanh(cloud.points[:, 0] / ROOT)).max()


# Twice the errors of the discretisation; the matrix, whose condition is about 1e7, leaves 2e-8 of round-off.
@pytest.mark.parametrize("order, ceilings", [(2, (1e-3, 4e-3)), (4, (3e-6, 4e-5)), (6, (1e-7, 6e-7))])
def test_a_kink_is_reached_from_everywhere(order, ceilings):
    """Its place is nearly free: the linearised equation is nearly singular there, and singular on the way.

    From the straight line it comes there without depth first, and goes on with it: the steps of both are counted.
    """
    for n, ceiling in zip((121, 61), ceilings):  # programs for more particles serve fewer too
        for start, most in (
            (None, 36), (lambda x: x[0] / 6, 20), (lambda x: jnp.sign(x[0]), 9), (lambda x: jnp.tanh(x[0] / ROOT), 5)
        ):  # fmt: skip
            sol, error = kink(start, order, n)
            assert sol.converged and sol.iterations <= most and error < ceiling


def test_a_p_n_junction_from_neutral_charges():
    """u'' = (sinh u - doping) / lambda^2, from asinh(doping): the field of the junction is lambda wide."""
    doping = lambda x, xp=jnp: 10.0 * xp.tanh(x / 0.1)
    cloud, fine = js.interval(-1.0, 1.0, 121), np.linspace(-1.0, 1.0, 12001)
    neutral = lambda x: jnp.arcsinh(doping(x[0]))
    for width in (1.0, 0.1, 0.02):
        problem = js.Problem(
            lambda u, x, w: w**2 * js.laplacian(u)(x) - jnp.sinh(u(x)) + doping(x[0]),
            {"left": js.dirichlet(lambda x, w: neutral(x)), "right": js.dirichlet(lambda x, w: neutral(x))},
            params=width,
        )  # fmt: skip
        sol = js.solve(problem, cloud, u0=lambda x, w: neutral(x))
        f = lambda u, x, w=width: (np.sinh(u) - doping(x, np)) / w**2
        known = differences(f, lambda u, x, w=width: np.cosh(u) / w**2, fine, np.arcsinh(doping(fine, np)))
        assert sol.converged and sol.iterations <= 8
        # At width 0.02 the layer has 1.2 particles to its length, and order 4 leaves 4e-3.
        np.testing.assert_allclose(sol.u, known[::100], atol=6e-3)


def test_uptake_from_a_line():
    """Monod: u'' = a u / (K + u); full steps lead below -K, where the rate has a pole."""
    cloud, fine = js.interval(0.0, 1.0, 61), np.linspace(0.0, 1.0, 12001)
    for a, k in ((5.0, 0.1), (5.0, 0.01), (2.0, 0.001)):
        sol = js.solve(
            js.Problem(lambda u, x, p: js.laplacian(u)(x) - p[0] * u(x) / (p[1] + u(x)), ends(0.0, 1.0), params=(a, k)),
            cloud, u0=lambda x, p: x[0],
        )  # fmt: skip
        rate, slope = lambda u, x, a=a, k=k: a * u / (k + u), lambda u, x, a=a, k=k: a * k / (k + u) ** 2
        known = differences(rate, slope, fine, fine**8)
        assert sol.converged
        np.testing.assert_allclose(sol.u, known[::200], atol=2e-3)


@pytest.mark.parametrize("p", [3, 4])
def test_the_p_laplacian_from_zero(p):
    """((e^2 + u'^2)^((p-2)/2) u')' = -1: the flux is 1/2 - x, and u' the root of a scalar equation."""
    e = 0.3
    flux = lambda g: (e**2 + g**2) ** ((p - 2) / 2) * g
    problem = js.Problem(lambda u, x: js.divergence(lambda y: flux(js.grad(u)(y)))(x) + 1.0, ends(0.0, 0.0))
    cloud = js.interval(0.0, 1.0, 81)
    sol = js.solve(problem, cloud)
    fine = np.linspace(0.0, 1.0, 1601)
    slope = np.array([brentq(lambda g, x=x: flux(g) - 0.5 + x, -2.0, 2.0) for x in fine])
    known = np.concatenate([[0.0], np.cumsum((slope[1:] + slope[:-1]) / 3200)])
    assert sol.converged
    np.testing.assert_allclose(sol.u, known[::20], atol=1e-3)  # u' turns within 0.1, eight particles


def test_the_plain_p_laplacian_starts_at_a_slope():
    """(|u'| u')' = 0 degenerates where u is flat: zero is no start for it, what the held values span is one."""
    problem = js.Problem(lambda u, x: js.divergence(lambda y: js.grad(u)(y) ** 3)(x), ends(0.0, 2.0))
    cloud = js.interval(0.0, 1.0, 21)
    np.testing.assert_allclose(js.solve(problem, cloud).u, 2.0 * cloud.points[:, 0], atol=1e-9)
    with pytest.raises(js.SolveError, match="linearised at the start.*u0.*singular.*another start, u0="):
        js.solve(problem, cloud, u0=np.zeros(21))
    failed = js.solve(problem, cloud, u0=np.zeros(21), throw=False)
    assert not failed.converged and any("another start, u0=" in flag for flag in failed.flags)


def test_a_turing_pattern_from_a_disturbed_state():
    """Schnakenberg: with closed ends the mean of the first species is a + b, whatever the pattern."""
    a, b, d = 0.1, 0.9, (0.01, 0.4)

    def pde(u, x):
        v, w = u(x)
        return jnp.stack([d[0] * js.laplacian(u[0])(x) + a - v + v**2 * w, d[1] * js.laplacian(u[1])(x) + b - v**2 * w])

    problem = js.Problem(pde, {"left": js.neumann(0.0), "right": js.neumann(0.0)}, fields=2)
    cloud = js.interval(0.0, 2.0, 61)
    sol = js.solve(problem, cloud, u0=lambda x: jnp.stack([1.0 + 0.1 * jnp.cos(1.5 * jnp.pi * x[0]), 0.9 + 0.0 * x[0]]))
    assert sol.converged and sol.iterations <= 12
    assert abs(np.trapezoid(sol.u[:, 0], cloud.points[:, 0]) / 2.0 - (a + b)) < 1e-3


def test_burgers_and_fisher():
    front = lambda x: -jnp.tanh(x[0] / 0.1)
    problem = js.Problem(lambda u, x: 0.05 * js.laplacian(u)(x) - u(x) * js.grad(u)(x)[0], ends(1.0, -1.0))
    cloud = js.interval(-1.0, 1.0, 81)
    np.testing.assert_allclose(js.solve(problem, cloud).u, jax.vmap(front)(cloud.points), atol=1e-3)
    fine = np.linspace(0.0, 1.0, 6001)
    sol = js.solve(
        js.Problem(lambda u, x: js.laplacian(u)(x) + 100 * u(x) * (1 - u(x)), ends(0.0, 1.0)),
        js.interval(0.0, 1.0, 61), u0=lambda x: x[0],
    )  # fmt: skip
    known = differences(lambda u, x: -100 * u * (1 - u), lambda u, x: -100 * (1 - 2 * u), fine, 1 - np.exp(-7 * fine))
    known_there = known[::100]
    assert sol.converged and np.abs(sol.u - known_there).max() < 1e-3


def quadratic(sol):
    """Each of the last changes is at most ten squares of the one before, or round-off."""
    c = np.array(sol.stats["changes"][-3:])
    return len(c) == 3 and (c[1:] <= np.maximum(10 * c[:-1] ** 2, 1e-9)).all()


@pytest.mark.parametrize("method", ["S", "III", "II", "I", "SSPH"])
def test_it_ends_quadratically_by_every_method(method):
    """With a held end and a radiating one."""
    bcs = {"left": js.dirichlet(0.0), "right": js.condition(lambda u, x, n: n @ js.grad(u)(x) + u(x) ** 4 - 0.1)}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) + 2 * jnp.exp(u(x)), bcs)
    assert quadratic(js.solve(problem, js.interval(0.0, 0.8, 25), method=method))


@pytest.mark.parametrize("order", [2, 4])
def test_it_ends_quadratically_on_random_particles(order):
    assert quadratic(CASES["bratu 2D"].solve(order, CASES["bratu 2D"].cloud(300)))


def test_what_was_tried_is_told():
    bratu = js.Problem(lambda u, x: js.laplacian(u)(x) + 5.0 * jnp.exp(u(x)), ends(0.0, 0.0))
    tried = "damped steps, steps without depth, pseudo-time steps, full steps were tried, .*stages"
    with pytest.raises(js.SolveError, match=tried) as told:
        js.solve(bratu, js.interval(0.0, 1.0, 21))
    # A search ends where nothing falls any more.
    assert int(re.search(r"(\d+) linear solves", str(told.value))[1]) < 120


def test_under_jit_converged_is_honest():
    cloud = js.interval(0.0, 1.0, 21)
    near = js.stencils(cloud, size=6)
    bratu = js.Problem(lambda u, x, c: js.laplacian(u)(x) + c * jnp.exp(u(x)), ends(0.0, 0.0), params=1.0)
    solved = mm.quickly(lambda c: js.solve(bratu.replace(params=c), cloud, stencils=near, solver="dense", depth=0))
    good, bad = solved(1.0), solved(5.0)  # beyond 3.51 there is no solution
    assert good.converged and abs(good.u[10] - 0.140539214) < 1e-6
    assert not bad.converged


def test_a_pressure_without_a_value_is_pinned_to_mean_zero():
    """Kovasznay's flow, an exact solution of the Navier-Stokes equations, by its velocities on the boundary."""
    re = 20.0
    k = re / 2 - np.sqrt(re**2 / 4 + 4 * np.pi**2)

    def flow(x):
        e = jnp.exp(k * x[0])
        return jnp.stack([1 - e * jnp.cos(2 * jnp.pi * x[1]), k / (2 * jnp.pi) * e * jnp.sin(2 * jnp.pi * x[1])])

    def pde(w, x):
        v, p = w(x), js.grad(w[2])(x)
        momentum = [v[:2] @ js.grad(w[i])(x) + p[i] - js.laplacian(w[i])(x) / re for i in (0, 1)]
        return jnp.stack([*momentum, js.grad(w[0])(x)[0] + js.grad(w[1])(x)[1]])

    cloud = js.rectangle((0.0, 0.0), (0.5, 0.5), (11, 11), jitter=0.2)
    walls = [js.dirichlet(lambda x, i=i: flow(x)[i], field=i) for i in (0, 1)]
    sol = js.solve(js.Problem(pde, dict.fromkeys(("left", "right", "bottom", "top"), walls), fields=3), cloud)
    assert sol.converged and abs(sol.u[:, 2].mean()) < 1e-10
    assert any("its mean over the particles is 0" in m for m in sol.stats["messages"])
    pressure = -jnp.exp(2 * k * cloud.points[:, 0]) / 2
    np.testing.assert_allclose(sol.u[:, :2], jax.vmap(flow)(cloud.points), atol=5e-3)
    assert np.abs(sol.u[:, 2] - (pressure - pressure.mean())).max() < 0.05


# ------------------------------------------------------------------ arc length


def bratu(c):
    return js.Problem(lambda u, x: js.laplacian(u)(x) + c * jnp.exp(u(x)), ends(0.0, 0.0))


def exact(c, low, high, x):
    """u = 2 log(cosh(t/4) / cosh((x - 1/2) t/2)) with t = sqrt(2 c) cosh(t/4), of which there are two."""
    t = brentq(lambda t: t - np.sqrt(2 * c) * np.cosh(t / 4), low, high)
    return 2 * np.log(np.cosh(t / 4) / np.cosh((x - 0.5) * t / 2))


def test_arc_length_passes_a_turning_point():
    cloud = js.interval(0.0, 1.0, 41)
    sols = js.continuation(bratu, cloud, [1.0, 2.0, 2.0], arclength=True, order=6)
    assert sols.parameters == [1.0, 2.0, 2.0] and len(sols) == 3
    x = cloud.points[:, 0]
    np.testing.assert_allclose(sols[1].u, exact(2.0, 0.1, 4.79, x), atol=1e-9)
    np.testing.assert_allclose(sols[2].u, exact(2.0, 4.81, 20.0, x), atol=1e-6)
    assert abs(sols.folds[0] - 3.513830719) < 1e-3 and len(sols.folds) == 1
    for c, sol in sols.branch[1:]:
        low, high = (0.1, 4.79) if sol.u[20] < 1.19 else (4.81, 20.0)
        assert sol.converged and np.abs(sol.u - exact(c, low, high, x)).max() < 1e-5


def test_arc_length_ends_after_its_steps():
    sols = js.continuation(bratu, js.interval(0.0, 1.0, 21), [1.0, 4.0], arclength=True, steps=8)
    assert sols.parameters == [1.0] and len(sols.branch) == 9
    assert sols.branch[-1][0] < 3.6 and "folds at 3.51" in repr(sols)


def test_arc_length_refuses_what_it_cannot_follow():
    cloud = js.interval(0.0, 1.0, 21)
    with pytest.raises(ValueError, match="parameters: .*direction"):
        js.continuation(bratu, cloud, [1.0, 1.0], arclength=True)
    with pytest.raises(ValueError, match="steps: .*got 0"):
        js.continuation(bratu, cloud, [1.0, 2.0], arclength=True, steps=0)
