"""What a cloud keeps for the next solve: found again where it is the same, and nowhere else."""

import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from jsmitsm.discretization import supports
from jsmitsm.equation.tracing import trace

EXACT = lambda x: jnp.exp(x[0]) * jnp.sin(x[1])  # harmonic
SIDES = ("left", "right", "bottom", "top")


def cloud():
    return js.rectangle((0, 0), (1, 1), (9, 9), jitter=0.2)


def solved(on, right, order=4, **options):
    bcs = {**dict.fromkeys(SIDES, js.dirichlet(EXACT)), "right": right}
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), bcs), on, order=order, **options)


def test_neighbours_are_searched_once_for_each_form_of_a_problem(monkeypatch):
    searches, plain = [], supports.nearest_seen
    monkeypatch.setattr(supports, "nearest_seen", lambda *a: searches.append(1) or plain(*a))
    flux = js.neumann(lambda x: EXACT(x))  # d/dx exp(x) sin(y) is itself
    on, counts = cloud(), []
    for right, order in ((js.dirichlet(EXACT), 4), (js.dirichlet(0.0), 4), (flux, 4), (flux, 6)):
        before = len(searches)
        solved(on, right, order)
        counts.append(len(searches) - before > 0)
    assert counts == [True, False, True, True]


def test_what_is_kept_gives_the_answer_of_a_fresh_cloud():
    """Conditions of other kinds in turn on one cloud, and each alone."""
    on, near = cloud(), js.stencils(cloud(), size=20)
    flux, value = js.neumann(lambda x: EXACT(x)), js.dirichlet(lambda x: 2.0 * EXACT(x))
    cases = [(value, {}), (flux, {}), (value, {"method": "SSPH"}), (flux, {"stencils": near}), (value, {}), (flux, {})]
    for right, options in cases:
        np.testing.assert_array_equal(solved(on, right, **options).u, solved(cloud(), right, **options).u)


def test_a_record_holds_only_what_is_not_known_beforehand():
    """exp(x) sin(y) is harmonic: each second derivative is one product, and no unit vector is left."""
    record = trace(lambda u, x: js.laplacian(u)(x) - js.laplacian(EXACT)(x), 2)
    assert len(record._record.jaxpr.eqns) <= 16
    points = np.random.default_rng(0).uniform(size=(5, 2))
    np.testing.assert_allclose(record.coefficients(points, 3)[1], 0.0, atol=1e-14)
