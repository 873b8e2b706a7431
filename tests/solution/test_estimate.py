"""The error estimate: what it is, and that it knows the error where one order knows no more than another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.solution.estimate import compared, lower


def peak(x):
    return 1.0 + 1.0 / (1.0 + 30.0 * (x[0] - 0.4) ** 2)


def variable(u, x):
    return js.divergence(lambda y: (1.0 + 0.4 * jnp.sin(3.0 * y[0])) * js.grad(u)(y))(x)


def first_order(u, x):
    return js.grad(u)(x)[0] + u(x)


def carried(u, x):
    """The convection between neighbours is 20 times the diffusion."""
    return js.grad(u)(x)[0] - 1.0 / 320.0 * js.laplacian(u)(x)


def solved(operator, n, right=None, **options):
    held = js.dirichlet(peak)
    pde = lambda u, x: operator(u, x) - operator(peak, x)  # noqa: E731
    return js.solve(js.Problem(pde, {"left": held, "right": right or held}), js.interval(0.0, 1.0, n), **options)


def test_it_is_the_way_to_the_solution_of_the_next_order():
    sol = solved(variable, 15)
    next_one = solved(variable, 15, order=6, depth=sol.depth)
    np.testing.assert_allclose(sol.error_estimate(), np.abs(next_one.u - sol.u), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("order", [4, 5, 6, 8])
@pytest.mark.parametrize("operator", [first_order, carried])
def test_recursions_that_end_at_one_degree_are_not_compared(operator, order):
    """Orders 6 and 8 of a first-order equation have recursions to degree 10: one solution in 1D, an estimate of 0."""
    sol = solved(operator, 17, right=js.free() if operator is first_order else None, order=order)
    error = np.linalg.norm(sol.u - jax.vmap(peak)(sol.cloud.points))
    assert error > 1e-7
    assert 0.3 < np.linalg.norm(sol.error_estimate()) / error < 10.0


def test_which_order_is_compared_with():
    assert compared(order=4, depth=4, most=20, least=2) == 6
    assert compared(order=6, depth=4, most=2, least=1) == 5  # both end at 10
    assert compared(order=4, depth=4, most=2, least=2) == 3
    assert compared(order=4, depth=4, most=2, least=4) == 6  # a beam has no lower one
    assert [lower(p, 2) for p in range(2, 9)] == [2, 2, 3, 3, 5, 5, 7]


def test_where_no_higher_order_is_determined_a_lower_one_is_compared(monkeypatch):
    """Systems of rows of order p + 2 that determine nothing were the end of the estimate."""
    from jsmitsm.runtime.errors import SolveError
    from jsmitsm.solution.run import Run

    own = Run.local_rows

    def local_rows(self, nums):
        if self.disc.rec.order > 4:
            raise SolveError("the moment systems of 18 particle(s) do not determine the solution", [1])
        return own(self, nums)

    exact = lambda x: jnp.exp(x[0]) * jnp.sin(2 * x[1])
    problem = js.Problem(
        lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x),
        {side: js.dirichlet(exact) for side in ("left", "right", "bottom", "top")},
    )
    sol = js.solve(problem, js.rectangle((0, 0), (1, 1), (11, 11), jitter=0.2), order=4)
    error = np.abs(sol.u - np.asarray(jax.vmap(exact)(sol.cloud.points))).max()
    monkeypatch.setattr(Run, "local_rows", local_rows)
    assert error < sol.error_estimate().max() < 1000 * error


FEW = [(lambda x: jnp.sin(2 * x[0] + 0.5) * jnp.exp(x[1]), 10, 0.3), (lambda x: jnp.exp(x[0]) * jnp.sin(x[1]), 8, 0.36)]


@pytest.mark.parametrize("exact, order, spacing", FEW)
def test_few_particles_of_which_a_higher_order_makes_nothing(exact, order, spacing):
    """Rows of order p + 2 are there, and their solution is farther away than this one is large."""
    ring = lambda u, x, n: u(x) + n @ js.grad(u)(x) - exact(x) - n @ jax.grad(exact)(x)
    problem = js.Problem(
        lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x), {"boundary": js.condition(ring)}
    )  # fmt: skip
    cloud = js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.1, -1.1), (1.1, 1.1)), spacing)
    sol = js.solve(problem, cloud, order=order)
    error = np.abs(sol.u - np.asarray(jax.vmap(exact)(cloud.points))).max()
    assert 0.5 * error < sol.error_estimate().max() < 10 * error


@pytest.mark.parametrize("seed", [0, 4, 24])
def test_few_particles_whose_higher_order_is_singular(seed):
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inside = rng.uniform(-1, 1, (100, 2))
    inside = inside[np.linalg.norm(inside, axis=1) < 0.95][:25]
    normals = np.concatenate([np.full(inside.shape, np.nan), rim])
    groups = {"interior": np.arange(25), "rim": np.arange(25, 39)}
    cloud = js.Cloud(np.concatenate([inside, rim]), groups=groups, normals=normals)
    exact = FEW[0][0]
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x), {"rim": js.dirichlet(exact)})
    sol = js.solve(problem, cloud, order=6)
    error = np.abs(sol.u - np.asarray(jax.vmap(exact)(cloud.points))).max()
    assert 0.5 * error < sol.error_estimate().max() < 10 * error


@pytest.mark.parametrize("seed", [0, 1])
def test_four_by_four_particles_of_order_four(seed):
    exact = lambda x: jnp.sin(3 * x[0]) * jnp.cos(2 * x[1])
    problem = js.Problem(
        lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x),
        dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(exact)),
    )
    cloud = js.rectangle((0, 0), (1, 1), (4, 4), jitter=0.2, seed=seed)
    sol = js.solve(problem, cloud)
    error = np.abs(sol.u - np.asarray(jax.vmap(exact)(cloud.points))).max()
    assert 0.5 * error < sol.error_estimate().max() < 50 * error
