"""Stencils where none are given: as many neighbours as the method of that order needs, and serves best."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js

LINE = js.interval(0.0, 2.0, 41)


def wave(x):
    return jnp.sin(3.0 * x[0])


def off(exact, pde, **options):
    ends = {side: js.dirichlet(exact) for side in ("left", "right")}
    problem = js.Problem(lambda u, x: pde(u, x) - pde(exact, x), ends, fields=np.size(exact(jnp.zeros(1))))
    return float(np.abs(js.solve(problem, LINE, **options).u - jax.vmap(exact)(LINE.points)).max())


@pytest.mark.parametrize("method, most", [
    ("SSPH", {2: 5e-3, 4: 1e-5, 5: 1e-5, 6: 3e-7, 8: 1e-8}), ("III", {5: 1e-5, 6: 3e-8, 8: 1e-9}),
    ("I", {5: 1e-5, 8: 1e-9}), ("II", {5: 1e-5, 8: 1e-9}),
])  # fmt: skip
def test_a_line_has_a_stencil_for_every_order(method, most):
    for order, bound in most.items():
        assert off(wave, lambda u, x: js.laplacian(u)(x), method=method, order=order) < bound


def test_the_fields_of_a_line_have_the_stencil_of_one():
    """Twice as many neighbours as coefficients, as in the plane, left errors of the size of the solution."""
    both = lambda x: jnp.stack([wave(x), jnp.exp(-x[0])])
    turned = lambda u, x: js.laplacian(u)(x) + jnp.stack([u(x)[1], -u(x)[0]])
    assert off(both, turned, method="SSPH", order=4) < 1e-5
