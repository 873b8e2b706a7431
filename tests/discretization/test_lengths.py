"""A constant operator whose terms differ in order shares its elimination among particles of about the same length."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.discretization import local_data


def exact(x):
    return jnp.exp(x[0]) * jnp.sin(2.0 * x[1])


def operator(u, x):
    return js.laplacian(u)(x) + 9.0 * u(x) - 2.0 * js.partial(u, (1, 0))(x)


def problem(cloud, robin):
    bcs = {name: js.dirichlet(exact) for name in cloud.groups if name != "interior"}
    if robin:
        flux = lambda x: jax.grad(exact)(x)[0] + 2.0 * exact(x)
        bcs["right"] = js.robin(2.0, 1.0, flux)
    return js.Problem(lambda u, x: operator(u, x) - operator(exact, x), bcs)


def graded():
    x = np.linspace(0.0, 1.0, 25) ** 1.5
    square = js.rectangle((0, 0), (1, 1), (25, 25), jitter=0.2)
    points = np.interp(np.asarray(square.points), np.linspace(0.0, 1.0, 25), x)
    return js.Cloud(points, square.groups, square.normals)


CASES = {
    "even": (lambda: js.rectangle((0, 0), (1, 1), (21, 21), jitter=0.2), {}),
    "graded": (graded, {}),
    "a kernel": (lambda: js.rectangle((0, 0), (1, 1), (21, 21), jitter=0.2), {"kernel": js.Gaussian(0.09, 2.0)}),
    "least squares": (lambda: js.rectangle((0, 0), (1, 1), (21, 21), jitter=0.2), {"formulation": "lsq"}),
}


@pytest.mark.parametrize("name", CASES)
def test_the_same_solution_as_with_an_elimination_for_each(name, monkeypatch):
    """The norm that holds deeper tails down knows the length: who makes its own elimination takes the common one."""
    make, options = CASES[name]
    cloud = make()
    posed = problem(cloud, robin=name == "graded")
    few = js.solve(posed, cloud, order=4, **options)
    monkeypatch.setattr(local_data, "_WORTH", 10**9)
    each = js.solve(posed, cloud, order=4, **options)
    told = [line for line in few.stats["skipped"] if line.startswith("recursion per particle, but for")]
    assert len(told) == 1 and not [line for line in each.stats["skipped"] if line.startswith("recursion")]
    lengths = int(told[0].split()[-2])
    assert lengths == 1 if name == "a kernel" else 1 < lengths < 10
    true = np.asarray(jax.vmap(exact)(jnp.asarray(cloud.points)))
    assert abs(np.asarray(few.u) - true).max() < 1e-5
    np.testing.assert_allclose(few.u, each.u, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(few.coefficients, each.coefficients, rtol=1e-6, atol=1e-7)
