"""A residual is recorded again exactly when something that it can see has changed."""

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.equation.recording import Unknown, identity
from jsmitsm.equation.tracing import trace

FACTOR = 2.0


def helper(x):
    return FACTOR * x[0]


def reads_a_global(u, x):
    return js.laplacian(u)(x) - helper(x)


def made(value):
    return lambda u, x: js.laplacian(u)(x) - value * x[0]


def test_a_function_written_again_is_recognised():
    assert trace(made(1.5), 2) is trace(made(1.5), 2)
    assert trace(made(1.5), 2) is not trace(made(1.5), 1)


@pytest.mark.parametrize(
    ("one", "other"),
    [(1.5, 1.5000001), (1, 1.0), (0.0, -0.0), (np.ones(2), np.array([1.0, 2.0])), (True, 1), ((1, 2), [1, 2])],
)
def test_other_values_are_other_functions(one, other):
    assert identity(made(one)) == identity(made(one))
    assert identity(made(one)) != identity(made(other))


def test_a_changed_global_is_seen(monkeypatch):
    """Also where only a helper reads it: the answer must not be that of the old value."""
    cloud = js.interval(0.0, 1.0, 9)
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    u = js.solve(js.Problem(reads_a_global, ends), cloud).u
    monkeypatch.setitem(globals(), "FACTOR", 6.0)
    np.testing.assert_allclose(js.solve(js.Problem(reads_a_global, ends), cloud).u, 3 * u, rtol=1e-12)


def test_a_changed_array_is_seen():
    k = np.array([1.0, 2.0])
    before = identity(lambda u, x: k[0] * u(x))
    k[0] = 3.0
    assert identity(lambda u, x: k[0] * u(x)) != before


def test_what_cannot_be_compared_is_recorded_every_time():
    box = types.SimpleNamespace(k=1.0)
    for unknown in (box, np.ones(200_001), object()):
        with pytest.raises(Unknown):
            identity(made(unknown))
    first = trace(lambda u, x: box.k * u(x), 1)
    box.k = 2.0
    again = trace(lambda u, x: box.k * u(x), 1)
    assert float(again.coefficients(np.zeros((1, 1)), 0)[0].squeeze()) == 2.0 and again is not first


def test_traced_values_do_not_leak():
    """A residual that closes over a traced number, recorded in one transform, is not used in the next."""
    cloud = js.interval(0.0, 1.0, 9)
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}

    def middle(k):
        return js.solve(js.Problem(made(k), ends), cloud, solver="dense").u[4]

    one, two = (float(jax.jit(jax.grad(middle))(k)) for k in (1.0, 2.0))
    assert one == pytest.approx(two, rel=1e-9) and one == pytest.approx(float(middle(1.0)), rel=1e-9)


def test_recursive_partial_and_wrapped_functions():
    def series(x, n):
        return x if n == 0 else x * series(x, n - 1)

    assert identity(functools.partial(series, n=3)) == identity(functools.partial(series, n=3))
    assert identity(functools.partial(series, n=3)) != identity(functools.partial(series, n=2))
    wave = lambda x: jnp.sin(x[0])
    assert identity(jax.grad(wave)) == identity(jax.grad(wave))
    assert identity(jax.grad(wave)) != identity(jax.grad(lambda x: jnp.cos(x[0])))
