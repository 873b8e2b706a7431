"""Rows of a program that the cores share under a transformation: the same numbers, forward and back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsmitsm.runtime import whole_program
from jsmitsm.runtime.whole_program import COUNT, called

N = 170  # in shares of 120 and 50 rows, the last of them filled up
X = np.linspace(0.5, 2.0, N)
ROWS = {"count": COUNT, "scale": False, "x": True, "y": True}


def made(count, scale, x, y):
    """What has no finite value where x is zero, as in rows that only fill up."""
    return {"one": scale[0] * jnp.log(x) + y @ scale, "two": (y * x[:, None]) ** 2 + scale[1]}


def total(scale, x, y, rows):
    arguments = {"count": np.int32(N), "scale": scale, "x": x, "y": y}
    out = called(made, {}, arguments, (), rows=rows)
    return jnp.sum(jnp.sin(out["one"])) + jnp.sum(out["two"] * np.arange(2.0))


@pytest.mark.parametrize("transform", [
    lambda f: jax.grad(f, (0, 1, 2)), lambda f: jax.value_and_grad(f), jax.jacfwd, jax.hessian,
])  # fmt: skip
def test_derivatives_are_those_of_the_whole(monkeypatch, transform):
    scale, y = np.array([1.5, -0.7]), np.stack([X, X**2], axis=1)
    monkeypatch.setattr(whole_program, "cores", lambda: 2)
    monkeypatch.setattr(whole_program, "_WORTH", 40)
    shared = transform(lambda s, x, y: total(s, x, y, ROWS))(scale, X, y)
    whole = transform(lambda s, x, y: total(s, x, y, None))(scale, X, y)
    # Sums of 170 terms in another order.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), shared, whole)


def test_what_is_differentiated_runs_as_the_program_of_more_rows():
    """Which is at hand, and stops after the rows wanted: nothing is compiled for fewer of them."""
    scale, y = np.array([0.3, 0.9]), np.stack([X, np.cos(X)], axis=1)
    arguments = {"count": np.int32(N), "scale": scale, "x": X, "y": y}
    called(made, {}, arguments, (), rows=ROWS)
    leaves, tree = jax.tree.flatten(arguments)
    program = whole_program._whole(made, (), tree, (), False, tuple(jax.tree.leaves(ROWS)))
    before = program.compiled._cache_size()
    some = lambda rows: jax.value_and_grad(lambda x: jnp.sum(  # noqa: E731
        called(made, {}, {"count": np.int32(70), "scale": scale, "x": x, "y": y[:70]}, (), rows=rows)["two"]
    ))(X[:70])  # fmt: skip
    for a, b in zip(some(ROWS), some(None)):
        np.testing.assert_allclose(a, b, rtol=1e-13)
    assert program.compiled._cache_size() == before
