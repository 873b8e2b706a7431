"""The recursion taken deeper than the fit: ``depth`` degrees more, with the same free coefficients."""

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.discretization.coefficients import numbers
from jsmitsm.discretization.layout import discretize

SIDES = ("left", "right", "bottom", "top")
SQUARE = js.rectangle((0, 0), (1, 1), (12, 12), jitter=0.3)
ROD = js.interval(0.0, 1.0, 21)


def wave(x):
    return jnp.sin(6.0 * x[0] + 0.3) * jnp.cos(5.0 * x[1] - 0.2)


def poisson(v, x):
    return js.laplacian(v)(x)


def helmholtz(v, x):
    return js.laplacian(v)(x) + 30.0 * v(x)  # between the resonances at 2 pi^2 and 5 pi^2


def diffusion(v, x):
    return js.divergence(lambda y: (1.0 + 0.5 * jnp.sin(y[0] + 2.0 * y[1])) * js.grad(v)(y))(x)


def quasilinear(v, x):
    return js.divergence(lambda y: (1.0 + v(y) ** 2) * js.grad(v)(y))(x)


def solved(operator, exact, cloud=SQUARE, fields=1, **options):
    """The solution whose source and values at the boundary are those of ``exact``, and its relative error."""
    held = {name: js.dirichlet(exact) for name in cloud.groups if name != "interior"}
    sol = js.solve(js.Problem(lambda u, x: operator(u, x) - operator(exact, x), held, fields=fields), cloud, **options)
    right = np.asarray(jax.vmap(exact)(cloud.points))
    return sol, float(np.linalg.norm(sol.u - right) / np.linalg.norm(right))


@pytest.mark.parametrize("dim, order, depth", [(1, 3, 4), (2, 3, 4), (2, 4, 1), (3, 2, 2)])
def test_polynomials_of_the_order_are_reproduced(dim, order, depth):
    """With a variable coefficient, on a jittered cloud: the tail of a polynomial of the fit's degree is zero."""
    exact = mm.polynomial(dim, order)
    operator = lambda v, x: js.divergence(lambda y: (1.5 + y[0]) * js.grad(v)(y))(x)
    sol, error = solved(operator, exact, mm.jittered(dim, {1: 14, 2: 8, 3: 5}[dim]), order=order, depth=depth)
    assert error < 1e-10  # round-off of the local systems, amplified by the inverse square of the spacing
    columns = js.multi_indices(dim, order + depth)
    assert sol.coefficients.shape == (len(sol.cloud), len(columns))
    tail = np.array([sum(a) > order for a in columns])
    assert np.abs(np.asarray(sol.coefficients)[:, tail]).max() < 1e-6


@pytest.mark.parametrize(
    "operator, order, gain",
    [(poisson, 4, 4), (poisson, 6, 15), (helmholtz, 5, 10), (diffusion, 4, 10),
     (quasilinear, 4, 15)],
)  # fmt: skip
def test_solutions_that_oscillate_gain(operator, order, gain):
    """About half of the factors measured on other clouds; values and gradients alike."""
    shift = 1.5 if operator is quasilinear else 0.0
    exact = lambda x: wave(x) + shift
    near = {"u0": exact} if operator is quasilinear else {}  # how Newton's method arrives is another matter
    errors, slopes = [], []
    inside = np.random.default_rng(1).uniform(0.1, 0.9, (50, 2))
    for depth in (0, 4):
        sol, error = solved(operator, exact, order=order, depth=depth, **near)
        errors.append(error)
        slopes.append(np.abs(sol.grad(inside) - jax.vmap(jax.grad(exact))(inside)).max())
    assert errors[1] * gain < errors[0]
    assert slopes[1] * gain / 3 < slopes[0]


def test_a_solid_gains_in_all_of_its_fields():
    def solid(v, x):
        def stress(y):
            strain = js.grad(v)(y) + js.grad(v)(y).T
            return strain + 0.75 * jnp.trace(strain) * jnp.eye(2)

        return js.divergence(stress)(x)

    exact = lambda x: jnp.stack([wave(x), jnp.cos(4.0 * x[0] + 1.0) * jnp.sin(3.0 * x[1])])
    errors = [solved(solid, exact, fields=2, order=6, depth=depth)[1] for depth in (0, 2)]
    assert errors[1] * 5 < errors[0]


@pytest.mark.parametrize("peclet", [5, 100, 1000])
def test_strong_convection_is_no_worse(peclet):
    """A tail that met the deep equations exactly would grow as the Peclet number to the power of the depth."""
    speed = peclet * 11.0  # in spacings of 1/11
    wind = lambda v, x: js.laplacian(v)(x) - speed * (0.8 * js.grad(v)(x)[0] + 0.6 * js.grad(v)(x)[1])
    exact = lambda x: jnp.sin(3.0 * x[0] + x[1])
    flat, deep = (solved(wind, exact, formulation="lsq", depth=depth)[1] for depth in (0, 4))
    assert deep * 20 < flat


@pytest.mark.parametrize("formulation", ["lsq", "loo"])
def test_strong_convection_keeps_its_digits(formulation):
    """A polynomial, all of whose error is round-off: parts of a tail by factors rounded apart made it 1e-9."""
    turning = lambda v, x: jnp.array([0.5 - x[1], x[0] - 0.5]) @ js.grad(v)(x) - 1.5e-3 * js.laplacian(v)(x)
    assert solved(turning, mm.polynomial(2, 4), depth=4, formulation=formulation)[1] < 1e-10


def test_the_error_estimate_knows_deep_solutions():
    for operator in (poisson, helmholtz, diffusion):
        sol, error = solved(operator, wave, depth=4)
        right = np.asarray(jax.vmap(wave)(SQUARE.points))
        estimate = np.linalg.norm(sol.error_estimate()) / np.linalg.norm(right)
        assert 0.3 < estimate / error < 4


@pytest.mark.parametrize("order", [4, 6])
def test_beside_a_kink_of_the_source_its_values_tell(order):
    """A series tells of one side only. Measured gains are 11 and 8, without them the depth has none."""
    along = jnp.array([0.8, 0.6])
    kinked = lambda x: jnp.abs(along @ x - 0.73) ** 3 / 6.0
    held = {s: js.dirichlet(kinked) for s in SIDES}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - jnp.abs(along @ x - 0.73), held)
    right = np.asarray(jax.vmap(kinked)(SQUARE.points))
    flat, deep = (np.linalg.norm(js.solve(problem, SQUARE, order=order, depth=d).u - right) for d in (0, 4))
    assert deep * 4 < flat


def test_a_series_that_diverges_beside_a_line_gives_way_to_values():
    """sqrt(s) beyond a line s = 0: at s the series ends after a distance of s, and deep recursions made of it 1e10."""
    along = jnp.array([0.8, 0.6])
    beyond = lambda x: jnp.maximum(along @ x - 0.73, 0.0)
    bent = lambda x: beyond(x) ** 2.5 / 3.75
    held = {s: js.dirichlet(bent) for s in SIDES}
    root = lambda x: jnp.where(beyond(x) > 0, jnp.sqrt(jnp.where(beyond(x) > 0, beyond(x), 1.0)), 0.0)
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - root(x), held), SQUARE, order=4)
    right = np.asarray(jax.vmap(bent)(SQUARE.points))
    assert np.abs(sol.u - right).max() < 3e-3 * np.abs(right).max()


def test_around_a_point_where_the_source_is_infinite_its_values_tell():
    """u = r, whose source is 1 / r: beside the corner its series made 80 of 1e-4, on spacings that shrink toward it."""
    radius = lambda x: jnp.sqrt(x @ x)
    cloud = js.from_polygon(
        [(0, 0), (1, 0), (1, 1), (0, 1)], lambda x: np.clip(0.25 * np.linalg.norm(x, axis=1), 1e-4, 0.2)
    )
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0 / radius(x), {"boundary": js.dirichlet(radius)})
    sol = js.solve(problem, cloud, order=6)
    right = np.linalg.norm(cloud.points, axis=1)
    near = right < 1e-3
    assert sol.depth == 4 and near.sum() > 10
    # Every value there is below 1e-3, and a straight line through the values of a spacing misses a tenth of them.
    assert np.abs(sol.u - right)[near].max() < 1e-4


@pytest.mark.parametrize("seed", [0, 1])
def test_sources_are_judged_in_the_stencils_that_the_rows_have(seed):
    """The same on spacings that shrink fast: a third of the stencils are widened, and reach the corner only then.

    With the series of the narrow ones the error was 8 and 18.
    """
    radius = lambda x: jnp.sqrt(x @ x)
    cloud = js.from_polygon(
        [(0, 0), (1, 0), (1, 1), (0, 1)], lambda x: np.clip(0.45 * np.linalg.norm(x, axis=1), 1e-5, 0.15), seed=seed
    )
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0 / radius(x), {"boundary": js.dirichlet(radius)})
    sol = js.solve(problem, cloud, order=6)
    run = sol._report
    assert len(run.health.repaired) > 30
    np.testing.assert_allclose(run.nums.source, numbers(run.disc, run.problem).source, rtol=1e-12)
    assert np.abs(sol.u - np.linalg.norm(cloud.points, axis=1)).max() < 0.05


@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-9, 1e-7])
@pytest.mark.parametrize("order", [4, 6])
def test_a_corner_that_all_but_meets_a_point_where_the_source_is_infinite(away, order):
    """u = r^(1/2) about a point a little outside: there the source is finite, and a million times as large as around.

    Fits that took it for a value like others made errors of 0.08 at order 6, and estimates of 45.
    """
    radius = lambda x: jnp.linalg.norm(x + away)
    root = lambda x: jnp.sqrt(radius(x))
    cloud = js.from_polygon(
        [(0, 0), (1, 0), (1, 1), (0, 1)], lambda x: np.minimum(0.12, 1e-4 + 0.25 * np.linalg.norm(x, axis=1))
    )
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 0.25 * radius(x) ** -1.5, {"boundary": js.dirichlet(root)})
    sol = js.solve(problem, cloud, order=order)
    error = np.abs(sol.u - jax.vmap(root)(cloud.points)).max()
    assert error < 1e-3 and error / 3.0 < np.abs(sol.error_estimate()).max() < 10.0 * error and not sol.flags


@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-8])
def test_beyond_a_root_there_is_no_number_and_no_pole(away):
    """u = x^0.8 about a point a little beyond the end, behind which the source is no number: that was taken for the
    pole, and 6e5 was estimated of an error of 7e-5."""
    root = lambda x: (x[0] + away) ** 0.8
    line = js.interval(0.0, 1.0, spacing=lambda x: np.minimum(0.05, 1e-4 + 0.3 * x[:, 0]))
    held = {"left": js.dirichlet(root), "right": js.dirichlet(root)}
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) + 0.16 * (x[0] + away) ** -1.2, held), line)
    error = np.abs(sol.u - jax.vmap(root)(line.points)).max()
    assert error < 2e-4 and error / 3.0 < np.abs(sol.error_estimate()).max() < 20.0 * error and not sol.flags


def test_a_kink_outside_of_the_domain_changes_nothing():
    smooth, kinked = (lambda x: wave(x) + (x[0] + 1.0) ** 3 / 6.0), (lambda x: x[0] + 1.0)
    held = {s: js.dirichlet(smooth) for s in SIDES}
    made = lambda bend: js.Problem(lambda u, x: js.laplacian(u)(x) - js.laplacian(wave)(x) - bend(kinked(x)), held)
    plain, bent = (js.solve(made(bend), SQUARE).u for bend in (lambda s: s, jnp.abs))
    np.testing.assert_allclose(bent, plain, rtol=0, atol=1e-13)


@pytest.mark.parametrize("formulation, bent", [("loo", False), ("lsq", False), ("loo", True)])
def test_gradients_through_a_deep_solve(formulation, bent):
    """With respect to a coefficient and a source, against differences; of values and slopes between particles too."""

    def value(a):
        bend = jnp.abs if bent else jnp.sin
        pde = lambda u, x, a: js.laplacian(u)(x) + a * jnp.exp(x[0]) * u(x) - a**2 * bend(7.0 * x[0] - a)
        ends = {"left": js.dirichlet(1.0), "right": js.dirichlet(lambda x, a: a)}
        sol = js.solve(js.Problem(pde, ends, params=a), ROD, order=4, depth=4, formulation=formulation)
        at = jnp.array([[0.33]])
        return jnp.sum(sol.u**2) + sol(at)[0] + 0.1 * sol.grad(at)[0, 0]

    step = 1e-5
    expected = (value(3.0 + step) - value(3.0 - step)) / (2 * step)
    assert jax.grad(value)(3.0) == pytest.approx(float(expected), rel=1e-6)


def test_gradients_where_the_source_is_infinite():
    """At an end; what an infinite value does to its own derivatives does not spread."""

    def value(a):
        pde = lambda u, x, a: js.laplacian(u)(x) - a * x[0] ** (-0.1 * a)
        ends = {"left": js.dirichlet(1.0), "right": js.dirichlet(0.0)}
        return jnp.sum(js.solve(js.Problem(pde, ends, params=a), ROD, order=4, depth=4).u ** 2)

    step = 1e-5
    expected = (value(3.0 + step) - value(3.0 - step)) / (2 * step)
    assert jax.grad(value)(3.0) == pytest.approx(float(expected), rel=1e-6)


def test_the_tail_of_method_iii():
    """The paper's elimination, and the same tail beyond it."""
    operator = lambda v, x: js.laplacian(v)(x) + 4.0 * v(x)
    exact = lambda x: jnp.sin(5.0 * x[0])
    flat, deep = (solved(operator, exact, ROD, method="III", order=3, depth=depth)[1] for depth in (0, 2))
    assert deep * 3 < flat


@pytest.mark.parametrize("method, depth", [("S", 4), ("III", 0)])
def test_without_a_word_it_is_as_deep_as_pays(method, depth):
    """The paper's methods stay the paper's."""
    plain, asked = (solved(poisson, wave, method=method, **options)[0] for options in ({}, {"depth": depth}))
    assert np.array_equal(plain.u, asked.u)
    assert plain.stats["depth"] == plain.depth == depth and (f"depth={depth}" in repr(plain)) == (depth > 0)


def test_auto_goes_as_deep_as_pays():
    harmonic = js.Problem(lambda u, x: js.laplacian(u)(x), {s: js.dirichlet(lambda x: x[0] * x[1]) for s in SIDES})
    assert js.solve(harmonic, SQUARE, depth="auto").depth == 0  # neither operator nor source says anything there
    found = [solved(poisson, wave, order=order, depth="auto")[0].depth for order in (2, 3, 4)]
    assert found == [2, 4, 4]
    cube = mm.jittered(3, 5)
    exact = lambda x: jnp.sin(x[0] + x[1] + x[2])
    assert solved(poisson, exact, cube, order=2, depth="auto")[0].depth == 2
    assert solved(helmholtz, exact, cube, order=3, depth="auto")[0].depth == 2
    assert solved(poisson, wave, order=3, method="III", depth="auto")[0].depth == 0


def deep(operator, exact, order=6, cloud=SQUARE, params=None):
    """How deep it goes by itself; nothing is solved."""
    held = {name: js.dirichlet(0.0) for name in cloud.groups if name != "interior"}
    pde = lambda u, x, *p: operator(u, x) - exact(x, *p)
    problem = js.Problem(pde, held, params=params)
    return discretize(problem, cloud, "S", order, None, None, None, sources=False).rec.depth


def turned(x, k):
    return jnp.sin(k * (0.6 * x[0] + 0.8 * x[1]) + 0.3)


@pytest.mark.parametrize(
    "operator, k, order, depth",
    [
        (poisson, 2.0, 6, 4), (poisson, 8.0, 6, 4), (poisson, 20.0, 6, 6), (poisson, 2.0, 4, 4), (poisson, 20.0, 12, 4),
        (diffusion, 1.0, 4, 2), (diffusion, 8.0, 4, 4), (diffusion, 20.0, 6, 4),
        (lambda v, x: poisson(v, x) + 0.1 * v(x), 2.0, 6, 4), (lambda v, x: poisson(v, x) + 400.0 * v(x), 2.0, 6, 6),
        (lambda v, x: poisson(v, x) + 20.0 * js.grad(v)(x)[0], 20.0, 6, 6),
    ],
)  # fmt: skip
def test_the_data_decide_how_deep(operator, k, order, depth):
    """By the angle k r, r the radius of a support, here about .25 at order 6: below .8 they are mild, above 3.2 they
    oscillate; only a constant operator goes deeper than four."""
    assert deep(operator, lambda x: turned(x, k), order) == depth


def test_what_cannot_be_known_is_taken_for_usual():
    mild = lambda x: turned(x, 2.0)
    assert deep(poisson, mild) == 4  # so few particles of a constant operator gain nothing by less
    assert deep(poisson, mild, cloud=js.rectangle((0, 0), (1, 1), (33, 33))) == 2
    assert deep(diffusion, mild) == 2
    finer = js.from_polygon([(0, 0), (1, 0), (1, 1), (0, 1)], lambda x: 0.01 + 0.2 * np.linalg.norm(x, axis=1))
    assert deep(diffusion, mild, cloud=finer) == 4  # supports of very different sizes
    assert deep(diffusion, lambda x: jnp.abs(x[0] - 0.5)) == 4  # a kink
    found = []

    def in_sum(k):
        found.append(deep(diffusion, lambda x, p: turned(x, p), params=k))
        return 0.0 * k

    in_sum(2.0), jax.grad(in_sum)(2.0), jax.jit(in_sum)(2.0)
    assert found == [2, 2, 4]  # a derivative alone changes nothing


def test_waves_are_worth_six_degrees():
    exact = lambda x: turned(x, 20.0)
    (usual, four), (found, six) = (solved(poisson, exact, order=6, depth=depth) for depth in (4, "auto"))
    assert (usual.depth, found.depth) == (4, 6) and six * 1.5 < four


@pytest.mark.parametrize(
    "options, words",
    [
        ({"depth": -1}, "depth: expected"), ({"depth": 1.5}, "depth: expected"), ({"depth": "deep"}, "depth: expected"),
        ({"depth": True}, "depth: expected"), ({"depth": 2, "method": "SSPH"}, "SSPH has no recursion"),
        ({"depth": 9, "order": 10}, "polynomials of degree 19"),
    ],
)  # fmt: skip
def test_bad_depths_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        solved(poisson, wave, **options)


def test_factorize_goes_deep_too():
    held = {s: js.dirichlet(wave) for s in SIDES}
    make = lambda k: js.Problem(lambda u, x: js.laplacian(u)(x) - k * js.laplacian(wave)(x), held)
    ready = js.factorize(make(2.0), SQUARE, depth=4)
    again = ready.solve(make(1.0))
    assert again.depth == 4
    np.testing.assert_allclose(again.u, js.solve(make(1.0), SQUARE, depth=4).u, atol=1e-12)


@pytest.mark.parametrize("order", [4, 6, 8])
@pytest.mark.parametrize("form, peclet", [("lsq", 20.0), ("lsq", 300.0), ("lsq", 3000.0), ("loo", 300.0)])
def test_strong_winds_take_no_digits(order, peclet, form):
    """Local solutions that the wind carries, and those with long tails, are of very different size: made orthonormal,
    both count. At order 8 everything was lost from a cell Peclet number of 20 on."""
    cloud = js.rectangle((0, 0), (1, 1), (17, 17), jitter=0.3)
    exact = lambda x: jnp.sin(5 * x[0] + 2 * x[1]) + jnp.cos(4 * x[1])
    operator = lambda u, x: 0.8 * js.grad(u)(x)[0] + 0.6 * js.grad(u)(x)[1] - 0.0625 / peclet * js.laplacian(u)(x)
    sides = {name: js.dirichlet(exact) for name in cloud.groups if name != "interior"}
    problem = js.Problem(lambda u, x: operator(u, x) - operator(exact, x), sides)
    sol = js.solve(problem, cloud, order=order, formulation=form)
    error = np.abs(sol.u - jax.vmap(exact)(cloud.points)).max()
    assert sol.depth >= 4 and error < {4: 2e-5, 6: 3e-7, 8: 5e-8}[order] and not sol.flags
    if form == "lsq":  # which "auto" takes here
        assert 0.2 * error < sol.error_estimate().max() < 30 * error
