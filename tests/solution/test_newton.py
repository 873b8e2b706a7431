"""Newton's method: robust starts, continuation, and reports where it does not converge."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from benchmarks import scenes
from benchmarks.problems import CASES

ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
# Beyond this the equation u'' + c exp(u) = 0 with u = 0 at both ends has no solution.
TURNING_POINT = 3.513830719


def bratu(c):
    return js.Problem(lambda u, x: js.laplacian(u)(x) + c * jnp.exp(u(x)), ENDS)


def test_radiating_side_from_the_default_start():
    """n . grad u + u^3 given on one side: steps from zero must be judged by absolute length."""
    u = lambda x: 0.7 + jnp.sin(1.3 * x[0]) * jnp.cosh(1.3 * x[1])
    radiating = js.condition(lambda v, x, n: n @ js.grad(v)(x) + v(x) ** 3 - n @ jax.grad(u)(x) - u(x) ** 3)
    bcs = {"left": js.dirichlet(u), "bottom": js.dirichlet(u), "right": js.neumann(lambda x: jax.grad(u)(x)[0])}
    cloud = js.rectangle((0, 0), (1, 1), (13, 13), jitter=0.2, seed=1)
    sol = js.solve(js.Problem(lambda v, x: js.laplacian(v)(x), bcs | {"top": radiating}), cloud)
    assert sol.converged and sol.iterations <= 12
    np.testing.assert_allclose(sol.u, jax.vmap(u)(cloud.points), atol=2e-5)


def test_expansions_that_were_kept_from_moving_are_let_go_in_the_end():
    """At corners between Robin conditions they ended where the corner was off by 1e-3, unseen by half of the estimate:
    kept linearised about what they were on the way."""
    u = lambda x: jnp.sin(2 * x[0] + 3 * x[1] + 1) + 0.3 * jnp.exp(x[0])
    op = lambda v, x: js.laplacian(v)(x) - v(x) ** 3
    robin = js.condition(lambda v, x, n: n @ js.grad(v)(x) + 2 * v(x) - n @ jax.grad(u)(x) - 2 * u(x))
    corners = [(-1, -1), (1, -1), (1, 0), (0, 0), (0, 1), (-1, 1)]
    cloud = js.from_polygon(corners, lambda x: np.minimum(0.17, 0.02 + 0.2 * np.linalg.norm(x, axis=1)))
    sol = js.solve(js.Problem(lambda v, x: op(v, x) - op(u, x), {"boundary": robin}), cloud, order=8)
    assert sol.converged
    np.testing.assert_allclose(sol.u, jax.vmap(u)(cloud.points), atol=3e-5)


def test_continuation_returns_every_stage():
    cloud = js.interval(0.0, 1.0, 31)
    sols = js.continuation(bratu, cloud, [1.0, 2.0, 3.0], order=6)
    t = [1.5171645990507543, 2.3575510538774020, 3.3735077642858036]
    for sol, theta in zip(sols, t):
        exact = 2 * np.log(np.cosh(theta / 4) / np.cosh((cloud.points[:, 0] - 0.5) * theta / 2))
        np.testing.assert_allclose(sol.u, exact, atol=1e-7)


def test_continuation_stops_at_a_turning_point():
    with pytest.raises(js.SolveError, match="continuation stopped at the parameter 3.5") as raised:
        js.continuation(bratu, js.interval(0.0, 1.0, 21), [3.0, 4.0], order=4)
    reached = float(str(raised.value).split("parameter ")[1].split(" ")[0])
    assert 3.45 < reached < TURNING_POINT + 0.01


@pytest.mark.parametrize(("parameters", "said"), [([1.0], "two or more"), ([1.0, np.nan], "finite"), (2.0, "in a row")])
def test_continuation_refuses_bad_parameters(parameters, said):
    with pytest.raises(ValueError, match=f"parameters: .*{said}"):
        js.continuation(bratu, js.interval(0.0, 1.0, 9), parameters)


def test_a_problem_instead_of_a_function_is_refused():
    with pytest.raises(ValueError, match="problem: expected a function of the parameter"):
        js.continuation(bratu(1.0), js.interval(0.0, 1.0, 9), [1.0, 2.0])


def test_no_solution_is_reported():
    with pytest.raises(js.SolveError, match="did not converge.*next one would still change u"):
        js.solve(bratu(5.0), js.interval(0.0, 1.0, 21))
    sol = js.solve(bratu(5.0), js.interval(0.0, 1.0, 21), throw=False)
    assert not sol.converged and "NOT converge" in sol.diagnose()


def test_what_is_told_is_of_the_last_step():
    """The stencils are those of the first step; how weak they are changes with the coefficients."""
    cloud = scenes.step(sparse=0.2, ratio=5.0)
    sol = CASES["quasilinear"].solve(4, cloud, depth=0)  # with the weights of a deep fit none stays weak
    told = [m for m in sol.stats["messages"] if "stay weak" in m]
    assert sol.converged and sol.iterations > 2 and len(told) == 1
    assert f"{len(sol.stats['weak'])} particle(s)" in told[0]
    assert f"at most {sol.stats['lebesgue_max']:.3g})" in told[0]
    assert sum("widened or balanced" in m for m in sol.stats["messages"]) == 1
