"""Values and gradients in numpy against Taylor arithmetic of degree one, and against exact slopes."""

import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud.sdf.recorded import Recorded
from jsmitsm.taylor import jets, series
from jsmitsm.taylor.first_degree import first_degree

TURNED = jnp.array([[1.0, 2.0], [0.0, 1.0]])
FLAT = {
    "circle": js.sdf.circle((0.0, 0.0), 1.0),
    "rectangle": js.sdf.rectangle((-0.3, -0.2), (0.4, 0.5)),
    "difference": js.sdf.difference(js.sdf.rectangle((-0.8, -0.7), (0.9, 0.8)), js.sdf.circle((0.1, 0.1), 0.2)),
    "rotate": js.sdf.rotate(js.sdf.rectangle((0.0, 0.0), (1.0, 2.0)), 0.3),
    "capsule": js.sdf.capsule((0.0, 0.0), (1.0, 1.0), 0.2),
    "ellipse": js.sdf.ellipse((0.0, 0.0), (1.0, 2.0)),
    "by hand": lambda x: jnp.hypot(x[0], x[1]) - 1.0 - 0.2 * jnp.cos(5 * jnp.arctan2(x[1], x[0])),
    "powers": lambda x: (x @ x) ** 0.7 - 0.3 + jnp.max(jnp.abs(x)) * jnp.tanh(x[0]) / (2.0 + x[1] ** 3),
    "matrix": lambda x: jnp.linalg.norm(TURNED @ x) - jnp.exp(-x[0]) * jnp.sin(x[1]) - jnp.sum(x * x[0]),
    "flat": lambda x: jnp.where(x[0] > 0.2, 1.0, jnp.minimum(x[1], 0.3)) + 0.5,
}
SOLID = {
    "sphere": js.sdf.sphere((0.0, 0.0, 0.0), 1.0),
    "torus": js.sdf.torus((0.0, 0.0, 0.0), 0.7, 0.3),
    "cylinder": js.sdf.cylinder((0.0, 0.0, -0.5), (0.0, 0.0, 0.5), 0.4),
}


@pytest.mark.parametrize("name", [*FLAT, *SOLID])
def test_as_taylor_arithmetic(name):
    """Both are exact but for round-off; 1e-13 leaves room for quotients of small numbers."""
    dim = 3 if name in SOLID else 2
    recorded = Recorded((SOLID if dim == 3 else FLAT)[name], dim)
    closed = recorded._closed
    steps = first_degree(closed.jaxpr)
    assert steps is not None
    x = np.random.default_rng(0).uniform(-1, 1, (50, dim))
    value, slope = steps(closed.consts, x, True)
    (terms,) = jets.evaluate(closed.jaxpr, closed.consts, [series.variable(x, 1)], dim, 1)
    expected = np.zeros((1 + dim, len(x)))
    expected[: len(terms)] = terms
    assert np.allclose(value, expected[0], rtol=0, atol=1e-13)
    assert np.allclose(slope.T, expected[1:], rtol=0, atol=1e-13)
    assert np.array_equal(steps(closed.consts, x, False)[0], value)


def test_exact_slopes():
    """x^2 y + sin y has the gradient (2 x y, x^2 + cos y)."""
    closed = Recorded(lambda x: x[0] ** 2 * x[1] + jnp.sin(x[1]), 2)._closed
    x = np.random.default_rng(1).uniform(-1, 1, (20, 2))
    value, slope = first_degree(closed.jaxpr)(closed.consts, x, True)
    a, b = x.T
    assert np.allclose(value, a**2 * b + np.sin(b), rtol=0, atol=1e-15)
    assert np.allclose(slope, np.stack([2 * a * b, a**2 + np.cos(b)], axis=1), rtol=0, atol=1e-15)


def test_what_is_unknown_is_left_to_taylor_arithmetic():
    """The gradient of a determinant is that of its cofactors: of x y - 1/4, (y, x)."""

    def matrix(x):
        return jnp.eye(4).at[:2, :2].set(jnp.array([[x[0], 0.5], [0.5, x[1]]]))

    recorded = Recorded(lambda x: jnp.linalg.det(matrix(x)), 2)
    assert first_degree(recorded._closed.jaxpr) is None
    x = np.array([[0.3, 0.7], [0.9, 0.2]])
    value, slope = recorded(x)
    assert np.allclose(value, x.prod(axis=1) - 0.25, atol=1e-14) and np.allclose(slope, x[:, ::-1], atol=1e-14)
