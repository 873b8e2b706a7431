"""Corners and changes of conditions at which solutions are singular: orders are blind there, the estimate is not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.solution.look.reach import _at_ends

SIDES = ("left", "right", "bottom", "top")


def elastic(u, x):
    """Plane strain with both Lame constants 1."""
    return jnp.stack([-js.laplacian(u[k])(x) - 2 * js.grad(js.divergence(u))(x)[k] for k in range(2)])


def traction(u, x, n):
    g = jnp.stack([js.grad(u[0])(x), js.grad(u[1])(x)])
    return jnp.trace(g) * n + (g + g.T) @ n


def told(sol, error):
    return np.abs(sol.error_estimate()).max() / error


@pytest.mark.parametrize(("spacing", "order", "tol"), [(0.1, 4, 1e-9), (0.1, 6, 1e-9), (0.1, 4, -1e-9)])
def test_a_condition_that_changes_within_a_side(spacing, order, tol):
    """-lap u = 1, half of the bottom held and the rest free; at (0.8, 0.2) the value is 0.5498."""
    groups = {"held": lambda x: (x[:, 1] < 1e-9) & (x[:, 0] < 0.5 + tol), "free": lambda x: x[:, 0] > -9}
    cloud = js.from_sdf(js.sdf.rectangle((0, 0), (1, 1)), ((0, 0), (1, 1)), spacing, groups=groups)
    bcs = {"held": js.dirichlet(0.0), "free": js.neumann(0.0)}
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) + 1.0, bcs), cloud, order=order)
    assert 0.3 < told(sol, abs(float(sol([[0.8, 0.2]])[0]) - 0.54979)) < 5
    assert sol.flags


def test_a_clamped_plate_under_its_weight():
    """It is singular where the clamped side ends; the tip sinks by 1.11942."""
    bcs = {side: js.condition(traction) for side in SIDES} | {"left": js.dirichlet(0.0)}
    problem = js.Problem(lambda u, x: elastic(u, x) - jnp.array([0.0, 1.0]), bcs, fields=2)
    sol = js.solve(problem, js.rectangle((0, 0), (1, 1), (13, 13)), order=6)
    assert 0.3 < told(sol, abs(float(sol([[1.0, 0.5]])[0, 1]) - 1.11942)) < 5


@pytest.mark.parametrize("waves", [2.0, 6.0])
def test_smooth_solutions_have_no_such_ends(waves):
    """Held and free sides that meet, resolved well and hardly."""
    exact = lambda x: jnp.sin(waves * x[0] + 0.3) * jnp.exp(x[1])
    slope = lambda u, x, n: n @ js.grad(u)(x) - n @ jax.grad(exact)(x)
    bcs = {"left": js.dirichlet(exact), "top": js.dirichlet(exact), "right": js.condition(slope)}
    pde = lambda u, x: js.laplacian(u)(x) - (1.0 - waves**2) * exact(x)
    problem = js.Problem(pde, bcs | {"bottom": js.condition(slope)})
    sol = js.solve(problem, js.rectangle((0, 0), (1, 1), (11, 11), jitter=0.2))
    assert not _at_ends(sol._report, np.asarray(sol._values)).any()
    assert told(sol, np.abs(sol.u - jax.vmap(exact)(sol.cloud.points)).max()) < 3
