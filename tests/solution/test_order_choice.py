"""The order that a tolerance needs on a given cloud."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js


def exact(x):
    return jnp.sin(9.0 * x[0])


CLOUD = js.interval(0.0, 2.0, 25)
PROBLEM = js.Problem(
    lambda u, x: js.laplacian(u)(x) + 81.0 * exact(x), {"left": js.dirichlet(exact), "right": js.dirichlet(exact)}
)


@pytest.mark.parametrize("tol", [3e-2, 1e-5])
def test_the_lowest_order_that_is_good_enough(tol):
    sol = js.solve(PROBLEM, CLOUD, order="auto", tol=tol, depth=0)
    away = np.abs(np.asarray(sol.u) - np.asarray(jax.vmap(exact)(np.asarray(CLOUD.points)))).max()
    assert away <= 3 * tol and not sol.flags
    if sol.order > 4:
        below = js.solve(PROBLEM, CLOUD, order=sol.order - 2, depth=0)
        assert below.error_estimate().max() > tol * np.abs(below.u).max()


def test_where_no_order_reaches_it_a_flag_says_so():
    sol = js.solve(PROBLEM, js.interval(0.0, 2.0, 8), order="auto", tol=1e-10, depth=0)
    assert any("No order reaches the tolerance 1.0e-10" in flag for flag in sol.flags)
    assert "No order reaches" in sol.diagnose()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"order": "auto"}, 'tol: order="auto" needs the wanted error'),
        ({"order": "auto", "tol": 2.0}, 'tol: order="auto" needs the wanted error'),
        ({"order": 4, "tol": 1e-3}, "tol: got 0.001 with order=4"),
    ],
)
def test_bad_input_is_told(given, said):
    with pytest.raises(ValueError, match=said):
        js.solve(PROBLEM, CLOUD, **given)
