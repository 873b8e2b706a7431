"""What a cloud keeps for the next solve: found again where it is the same, and nowhere else."""

import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from jsmitsm.discretization import supports
from jsmitsm.discretization.coefficients import expect_estimate
from jsmitsm.equation.traced import Traced
from jsmitsm.equation.tracing import trace
from jsmitsm.solution import estimate, fit, run

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


def test_polynomials_are_fitted_once_for_estimate_flags_and_evaluation(monkeypatch):
    """A source that varies, so that all of them are asked; those of held particles alone are fitted afterwards."""
    fits, plain = [], run.all_coefficients
    counted = lambda disc, *rest: fits.append(sum(len(cls.ids) for cls in disc.classes)) or plain(disc, *rest)
    for where in (run, estimate, fit):
        monkeypatch.setattr(where, "all_coefficients", counted)
    steep = js.Problem(
        lambda u, x: js.laplacian(u)(x) - jnp.exp(4.0 * x[0]) * u(x) - jnp.sin(9.0 * x[0] * x[1]),
        dict.fromkeys(SIDES, js.dirichlet(0.0)),
    )
    sol = js.solve(steep, cloud(), order=4)
    sol.error_estimate()
    assert sol.correction().missed is not None and sol.flags == [] and fits == [49]
    found = np.array(sol.coefficients)
    assert fits == [49, 32]
    alone = sol._fit.coefficients(sol._values)[:, 0]
    np.testing.assert_allclose(found, alone, rtol=0, atol=1e-12 * np.abs(found).max())


def test_series_are_kept_with_the_cloud_and_grow_with_the_degree(monkeypatch):
    asked, plain = [], Traced.coefficients
    monkeypatch.setattr(
        Traced, "coefficients",
        lambda self, points, degree, **more: asked.append((len(points), degree)) or plain(self, points, degree, **more),
    )  # fmt: skip
    wavy = lambda x: jnp.sin(5.0 * x[0]) * jnp.exp(x[1])
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - wavy(x), dict.fromkeys(SIDES, js.dirichlet(0.0)))
    on = cloud()
    degrees = lambda: [degree for count, degree in asked if count == 49]
    alone = js.solve(problem, on, order=4, depth=2)
    assert degrees() == [4]
    js.solve(problem, on, order=6, depth=2)
    js.solve(problem, on, order=4, depth=2)
    js.solve(problem, on, order=2, depth=2)
    assert degrees() == [4, 6]
    expected = cloud()
    expect_estimate(expected)
    asked.clear()
    again = js.solve(problem, expected, order=4, depth=2)
    np.testing.assert_array_equal(again.u, alone.u)
    again.error_estimate()
    assert degrees() == [6]
