"""A kept factorisation gives what a solve of its own gives, in the same form, and makes nothing again that it has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.linear import linsolve
from jsmitsm.particle import batches

SIDES = ("left", "right", "bottom", "top")
CLOUD = js.rectangle((0, 0), (1, 1), (17, 17), jitter=0.2)


def heat(strength, end=1.0):
    """u_t = u_xx + strength x, time along y: nothing is known at its end."""
    pde = lambda u, x: js.partial(u, (0, 1))(x) - js.partial(u, (2, 0))(x) - strength * x[0]
    start = js.dirichlet(lambda x: end * jnp.sin(3 * x[0]))
    return js.Problem(pde, {"left": js.dirichlet(0.0), "right": js.neumann(end), "bottom": start, "top": js.free()})


def convection(strength, end=1.0):
    pde = lambda u, x: js.laplacian(u)(x) - 200.0 * js.grad(u)(x)[0] - strength
    return js.Problem(pde, {**dict.fromkeys(SIDES, js.dirichlet(end)), "right": js.neumann(0.0)})


def poisson(strength, end=1.0):
    pde = lambda u, x: js.laplacian(u)(x) - strength * x[0]
    return js.Problem(pde, {**dict.fromkeys(SIDES, js.dirichlet(0.0)), "top": js.robin(1.0, 2.0, end)})


@pytest.mark.parametrize("problem, form", [(heat, "lsq"), (convection, "lsq"), (poisson, "loo")])
def test_it_follows_the_form_that_solve_chooses(problem, form):
    """Another source and other values: the same numbers as a solve, without a new local phase or factorisation."""
    ready = js.factorize(problem(1.0), CLOUD)
    first = ready.solve(problem(1.0))
    made, traced = linsolve.factorisations(), batches.TRACES["rows"]
    second = ready.solve(problem(-3.0, 0.5))
    assert (made, traced) == (linsolve.factorisations(), batches.TRACES["rows"])
    for sol, task in ((first, problem(1.0)), (second, problem(-3.0, 0.5))):
        own = js.solve(task, CLOUD)
        assert sol.stats["formulation"] == own.stats["formulation"] == form
        np.testing.assert_allclose(sol.u, own.u, rtol=0, atol=1e-10 * np.abs(own.u).max())
        np.testing.assert_allclose(sol.error_estimate(), own.error_estimate(), rtol=1e-4, atol=1e-9)
        assert sol.flags == own.flags


def test_its_factors_stay_whatever_else_is_solved():
    ready = js.factorize(poisson(1.0), CLOUD, solver="sparse")
    ready.solve(poisson(1.0))
    linsolve.clear_cache()
    made = linsolve.factorisations()
    assert ready.solve(poisson(2.0)).stats["linear"]["cached"]
    grad = jax.grad(lambda s: jnp.sum(ready.solve(poisson(s)).u))(2.0)
    assert linsolve.factorisations() == made
    assert np.isclose(grad, np.sum(ready.solve(poisson(1.0)).u - ready.solve(poisson(0.0)).u))


def test_under_jit_a_singular_system_gives_nan():
    """The second of two squares far apart has no value that holds it."""
    square = js.rectangle((0, 0), (1, 1), (13, 13))
    one, sides = np.asarray(square.points), np.concatenate([square.groups[side] for side in SIDES])
    out = np.sign(np.where(np.abs(one - 0.5) == 0.5, one - 0.5, 0.0))
    normals = np.full((338, 2), np.nan)
    for k in (0, 169):
        normals[sides + k] = out[sides] / np.linalg.norm(out[sides], axis=1, keepdims=True)
    groups = {"interior": np.setdiff1d(np.arange(338), [*sides, *(sides + 169)]), "held": sides, "loose": sides + 169}
    cloud = js.Cloud(np.concatenate([one, one + [50.0, 0.0]]), groups, normals)
    posed = lambda s: js.Problem(
        lambda u, x: js.laplacian(u)(x) - s, {"held": js.dirichlet(0.0), "loose": js.neumann(0.0)}
    )
    ready = js.factorize(posed(0.0), cloud)
    assert np.isnan(jax.jit(lambda s: ready.solve(posed(s)).u)(0.0)).any()
    with pytest.raises(js.SolveError, match="singular"):
        ready.solve(posed(0.0))


def test_the_form_may_be_given():
    forms = {form: js.factorize(heat(1.0), CLOUD, formulation=form).solve(heat(2.0)).u for form in ("loo", "lsq")}
    for form, u in forms.items():
        np.testing.assert_allclose(u, js.solve(heat(2.0), CLOUD, formulation=form).u, rtol=0, atol=1e-10)
    assert np.abs(forms["loo"] - forms["lsq"]).max() > 1e-8
    with pytest.raises(ValueError, match='formulation: "lsq" is a form of method S'):
        js.factorize(heat(1.0), CLOUD, method="SSPH", formulation="lsq")


def test_another_operator_is_set_up_anew():
    ready = js.factorize(convection(1.0), CLOUD)
    slower = js.Problem(lambda u, x: js.laplacian(u)(x) - 2.0 * js.grad(u)(x)[0] - 1.0, convection(1.0).bcs)
    own = js.solve(slower, CLOUD)
    sol = ready.solve(slower)
    assert sol.stats["formulation"] == own.stats["formulation"] == "loo"
    np.testing.assert_allclose(sol.u, own.u, rtol=0, atol=1e-10)


def test_few_free_coefficients():
    kernel = js.SuperGaussian(CLOUD.spacing, 6.0)
    options = dict(method="III", order=3, kernel=kernel, basis_terms=6)
    ready = js.factorize(poisson(1.0), CLOUD, **options)
    own = js.solve(poisson(2.0), CLOUD, **options)
    np.testing.assert_allclose(ready.solve(poisson(2.0)).u, own.u, rtol=0, atol=1e-10)
    assert np.abs(own.u - js.solve(poisson(2.0), CLOUD, **options | {"basis_terms": None}).u).max() > 1e-6


def test_periodic_sides():
    def ring(strength):
        pde = lambda u, x: js.laplacian(u)(x) - u(x) - strength * jnp.sin(2 * jnp.pi * x[0])
        walls = {"bottom": js.dirichlet(0.0), "top": js.dirichlet(0.0)}
        return js.Problem(pde, {"left": js.periodic("left", "right"), **walls})

    cloud = js.rectangle((0, 0), (1, 1), (17, 17))
    own = js.solve(ring(2.0), cloud)
    np.testing.assert_allclose(js.factorize(ring(1.0), cloud).solve(ring(2.0)).u, own.u, rtol=0, atol=1e-12)


def test_other_problems_are_refused_in_words():
    rod = js.interval(0.0, 1.0, 11)
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    ready = js.factorize(js.Problem(lambda u, x: js.laplacian(u)(x) - u(x), ends), rod)
    with pytest.raises(ValueError, match="it is nonlinear"):
        ready.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - u(x) ** 2, ends))
    with pytest.raises(ValueError, match="constraints and global unknowns"):
        ready.solve(
            js.Problem(lambda u, x, g: js.laplacian(u)(x) - g["q"], ends, unknowns={"q": 0.0},
                       constraints=[js.constraint(lambda sol: sol.integral(), 1.0)])
        )  # fmt: skip
    slope = {"left": js.dirichlet(0.0), "right": js.neumann(1.0)}
    radiating = {**slope, "right": js.condition(lambda u, x, n: n @ js.grad(u)(x) + u(x) ** 4)}
    with pytest.raises(ValueError, match="it is nonlinear"):
        js.factorize(js.Problem(lambda u, x: js.laplacian(u)(x), slope), rod).solve(
            js.Problem(lambda u, x: js.laplacian(u)(x), radiating)
        )


def test_other_problems_in_regions_are_refused_in_words():
    layers, names = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125), "ab"
    pde, flux = (lambda u, x: js.laplacian(u)(x) + 1.0), (lambda u, x, n: n @ js.grad(u)(x))
    warm = lambda u, x, n: (1.0 + u(x) ** 2) * (n @ js.grad(u)(x))  # noqa: E731

    def layered(second, **more):
        between = js.interface(flux={"a": flux, "b": second})
        return js.Problem(dict.fromkeys(names, pde), {"boundary": js.dirichlet(0.0), "a|b": between}, **more)

    ready = js.factorize(layered(flux), layers)
    with pytest.raises(ValueError, match="it is nonlinear"):
        ready.solve(layered(warm))
    with pytest.raises(ValueError, match="constraints and global unknowns"):
        ready.solve(layered(flux, constraints=[js.constraint(lambda sol: sol.integral(), 1.0)]))
    with pytest.raises(ValueError, match="give an equation for each"):
        ready.solve(js.Problem(pde, {"boundary": js.dirichlet(0.0)}))
    with pytest.raises(ValueError, match="expected a js.Problem"):
        ready.solve(None)
