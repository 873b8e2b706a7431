"""Small arrays followed element by element: the same numbers as JAX's, by fewer operations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsmitsm.equation.elements import SMALL
from jsmitsm.equation.linearizing import open_fields
from jsmitsm.equation.operators import divergence, grad
from jsmitsm.equation.tracing import trace
from jsmitsm.runtime.jaxprs import EVERYTHING, levels

X = jnp.asarray([0.3, -1.7, 2.2])
M = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3)))
ROW = jnp.arange(float(SMALL + 3))


def followed(function, *args):
    """The jaxpr of the function with small arrays followed, and its results."""
    closed = jax.make_jaxpr(function)(*args)
    made = jax.make_jaxpr(lambda *a: open_fields(closed.jaxpr, closed.consts, a, {}))(*args)
    return made.jaxpr, jax.core.eval_jaxpr(made.jaxpr, made.consts, *args)


PLACED = {
    "transpose": lambda x, m: m.T[1:, ::2],
    "reshape": lambda x, m: m.reshape(-1)[2:7].reshape(5, 1),
    "stack": lambda x, m: jnp.stack([x, m[0], jnp.zeros(3)], axis=1),
    "concatenate": lambda x, m: jnp.concatenate([x, jnp.ones(2), m[:, 1]]),
    "flip and tile": lambda x, m: jnp.tile(jnp.flip(x), (3, 1)),
    "split": lambda x, m: jnp.split(x, [1, 2])[1] + jnp.split(m, 3, axis=1)[0],
    "diagonal": lambda x, m: jnp.diag(m) + jnp.trace(m),
    "identity": lambda x, m: m * jnp.eye(3),
    "to a long array and back": lambda x, m: (jnp.broadcast_to(x[:, None], (3, SMALL)) * 2.0)[:, 0],
    "from a long array": lambda x, m: ROW[2:5] * x,
}
COMPUTED = {
    "matrix by vector": lambda x, m: m @ x,
    "matrix by matrix": lambda x, m: m @ m.T,
    "inner product": lambda x, m: jnp.vdot(x, m[0]),
    "two axes": lambda x, m: jnp.tensordot(m, m + 1.0, 2),
    "outer product": lambda x, m: jnp.outer(x, x),
    "a batch": lambda x, m: jnp.einsum("ij,ij->i", m, m),
    "sums": lambda x, m: m.sum(0) + m.sum(1) + m.sum(),
    "products": lambda x, m: x.prod() + jnp.cumsum(x)[-1],
    "extremes": lambda x, m: jnp.maximum(x, 0.5).max() - jnp.abs(m).min(),
    "choice": lambda x, m: jnp.where(x > 0, x, m[0]),
    "integers": lambda x, m: x ** jnp.arange(3) + (jnp.arange(3) % 2 == 1) * 2.0,
    "powers": lambda x, m: x**1 + x**2 + (x**2) ** 1.5 + 1.0 / x,
    "known numbers": lambda x, m: jnp.sin(jnp.asarray(2.0)) * x + jnp.exp(jnp.linspace(0.0, 1.0, 3)),
    "a matrix's inverse": lambda x, m: jnp.linalg.solve(m, x),
    "a loop": lambda x, m: jax.lax.fori_loop(0, 4, lambda k, v: jnp.cos(m @ v), x),
    "single precision": lambda x, m: x.astype(jnp.float32).astype(float) + m.astype(jnp.float32).sum(),
}


@pytest.mark.parametrize("name", [*PLACED, *COMPUTED])
def test_the_numbers_are_those_of_jax(name):
    function = {**PLACED, **COMPUTED}[name]
    _, (got,) = followed(function, X, M)
    right = function(X, M)
    assert got.shape == right.shape and got.dtype == right.dtype
    np.testing.assert_allclose(got, right, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("name", [*PLACED, *COMPUTED])
def test_derivatives_are_those_of_jax(name):
    function = {**PLACED, **COMPUTED}[name]
    _, got = followed(lambda x, m: jax.jvp(lambda y: function(y, m), (x,), (m[1],)), X, M)
    for one, right in zip(got, jax.jvp(lambda y: function(y, M), (X,), (M[1],)), strict=True):
        np.testing.assert_allclose(one, right, rtol=1e-13, atol=1e-14)


def names(jaxpr):
    """The operations that the results need."""
    return [eqn.primitive.name for eqn, _ in levels(jaxpr, [EVERYTHING] * len(jaxpr.outvars))]


def test_unit_vectors_and_zeros_leave_nothing_behind():
    jaxpr, _ = followed(lambda x, m: jax.jacfwd(lambda y: jnp.sin(y[0]) * y)(x)[1, 0], X, M)
    assert sorted(set(names(jaxpr))) == ["cos", "mul", "reshape", "slice"] and names(jaxpr).count("mul") == 1


def test_equal_operations_are_performed_once():
    jaxpr, _ = followed(lambda x, m: jnp.sin(x[0] * x[1]) + jnp.sin(x[1] * x[0]) + jnp.sin(x[:2].prod()), X, M)
    assert names(jaxpr).count("sin") == 2  # a product over an axis is left as it is
    jaxpr, _ = followed(lambda x, m: jnp.sin(x[0] * x[1]) + jnp.sin(x[1] * x[0]), X, M)
    assert names(jaxpr).count("sin") == names(jaxpr).count("mul") == 1


def test_what_is_multiplied_by_zero_may_be_infinite():
    _, (got,) = followed(lambda x, m: 0.0 * jnp.log(x - x) + x, X, M)
    assert np.array_equal(got, X)


def test_the_record_of_a_varying_operator_is_short():
    """Diffusion a(x) with a's own gradient: nothing in it is carried from array to array."""
    made = trace(lambda u, x: divergence(lambda y: (2 + jnp.sin(x[0]) * y[1]) * grad(u)(y))(x), 2)
    assert not {"iota", "dot_general", "concatenate", "stack", "eq"} & set(names(made._record.jaxpr))
