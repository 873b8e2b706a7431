"""Derivatives of what test_gradients.py leaves out: nonlinear problems by every method, estimates, systems.

Central differences of fourth order as there, of one weighted sum of everything: with a step of 5e-5 an exact
gradient agrees to 1e-6 of the sum's own size, the rounding of the differences included.
"""

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest
from test_gradients import BOUND, Case, difference, turned

import jsmitsm as js


@pytest.fixture(scope="module")
def line():
    return Case(1, 9, 3, 3.6)


def solved(case, t, problem, method, form="auto", order=3):
    return js.solve(
        problem(t), case.moved(t), method=method, order=2 if method in ("I", "II", "III") else order, formulation=form,
        kernel=js.SuperGaussian(h=t["h"], d=t["d"]), stencils=case.stencils, depth=0,
    )  # fmt: skip


def check(f, theta, names):
    """One eager gradient by everything, along a direction of every name, against differences on the host."""
    size = abs(float(f(theta)))
    gradient = jax.grad(f)(theta)
    rng = np.random.default_rng(7)
    for name in names:
        moved = rng.uniform(-1, 1, np.shape(theta[name]))
        direction = {k: moved if k == name else np.zeros(np.shape(v)) for k, v in theta.items()}
        measured = difference(f, theta, direction)
        exact = float(np.sum(np.asarray(gradient[name]) * moved))
        assert abs(exact - measured) <= BOUND * max(abs(measured), size), name
        assert abs(measured) > 100 * BOUND * size, f"{name} moves next to nothing: nothing was tested"


def away(case, values):
    """Weighted squares, so that no entry hides another."""
    return jnp.sum(case.weights.reshape(-1, *[1] * (values.ndim - 1)) * values**2)


def held(t):
    """Values at both ends: one class of particles, and so half the programs to compile."""
    return {"left": js.dirichlet(0.3), "right": js.dirichlet(t["wall"][0])}


ROBIN = ("robin_a", "robin_b", "robin_value")


def bent(t, ends=held):
    """u'' + u' = s (1 + u^2 / 2) exp(x), of the same derivatives as Case.problem and so of its programs."""
    pde = lambda u, x, p: js.laplacian(u)(x) + js.grad(u)(x)[0] - p * jnp.exp(x[0]) * (1.0 + u(x) ** 2 / 2)
    return js.Problem(pde, ends(t), params=t["source"])


def open_to_the_left(t):
    return held(t) | {"left": js.robin(*(t[name] for name in ROBIN))}


def straight(t):
    pde = lambda u, x, p: js.laplacian(u)(x) + js.grad(u)(x)[0] - (1.0 + x[0]) * u(x) - p * jnp.exp(x[0])
    return js.Problem(pde, held(t), params=t["source"])


@pytest.mark.parametrize("method, form", [("I", "loo"), ("II", "loo"), ("III", "loo"), ("S", "lsq")])
def test_newtons_method_by_every_method(line, method, form):
    check(lambda t: away(line, solved(line, t, bent, method, form).u), line.theta, ("h", "source", "wall"))


def test_newtons_method_beside_a_robin_side(line):
    u = lambda t: solved(line, t, lambda t: bent(t, open_to_the_left), "SSPH").u
    check(lambda t: away(line, u(t)), line.theta, ("h", "source", "wall", "points", *ROBIN))


@pytest.mark.parametrize("method, form", [("II", "loo"), ("S", "lsq")])
def test_error_estimates_of_other_methods(line, method, form):
    estimate = lambda t: away(line, solved(line, t, straight, method, form).error_estimate())
    check(estimate, line.theta, ("h", "wall"))


def coupled(t, product):
    """Two fields that reach each other, and multiply each other where ``product`` is not zero."""

    def pde(u, x, p):
        one = js.laplacian(u[0])(x) - u[1](x) - product * u[0](x) * u[1](x) - p
        return jnp.stack([one, js.laplacian(u[1])(x) + js.grad(u[0])(x)[0] - x[0]])

    return js.Problem(pde, held(t), fields=2, params=t["source"])


def test_a_nonlinear_system(line):
    f = lambda t: away(line, solved(line, t, lambda t: coupled(t, 1.0), "S", order=2).u)
    check(f, line.theta, ("h", "source", "wall"))


def test_the_error_estimate_of_a_system(line):
    f = lambda t: away(line, solved(line, t, lambda t: coupled(t, 0.0), "S", order=2).error_estimate())
    check(f, line.theta, ("h", "wall"))


def elastic(t):
    """An elastic square that slips along its left side, is pulled at its right one, and held below."""

    def pde(u, x, p):
        stress = lambda y: js.grad(u)(y) + js.grad(u)(y).T + p * jnp.trace(js.grad(u)(y)) * jnp.eye(2)
        return js.divergence(stress)(x) + jnp.array([0.0, 1.0])

    def traction(u, x, n, p):
        stress = js.grad(u)(x) + js.grad(u)(x).T + p * jnp.trace(js.grad(u)(x)) * jnp.eye(2)
        return stress @ n - jnp.array([0.3, 0.1 * x[1]])

    def slip(u, x, n, p):
        tangent = jnp.array([-n[1], n[0]])
        return jnp.stack([u(x) @ n - 0.1, tangent @ (js.grad(u)(x) + js.grad(u)(x).T) @ n])

    bcs = {"left": js.condition(slip), "right": js.condition(traction)}
    bcs |= {"bottom": js.dirichlet(0.0), "top": js.dirichlet(0.2)}
    return js.Problem(pde, bcs, fields=2, params=t["modulus"])


def test_traction_and_slip_with_respect_to_normals():
    """The angle turns every normal."""
    cloud = mm.jittered(2, 5, jitter=0.2)
    near = js.stencils(cloud, size=14)
    theta = {"h": 0.3, "modulus": 1.3, "points": cloud.points, "tilt": 0.0}
    weights = np.cos(3.0 * cloud.points.sum(axis=1))[:, None] + 0.5

    def f(t):
        kernel = js.Gaussian(h=t["h"], d=10.0)
        sol = js.solve(elastic(t), turned(cloud, t), order=2, kernel=kernel, stencils=near, depth=0)
        return jnp.sum(weights * sol.u**2)

    check(f, theta, ("modulus", "tilt"))
