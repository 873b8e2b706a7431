"""Constraints and global unknowns: values against exact solutions, gradients against formulas, and bad input."""

import pickle

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.particle import batches

SQUARE = js.rectangle((0.0, 0.0), (1.0, 1.0), (8, 8), jitter=0.2)
ROD = js.interval(0.0, 1.0, 11)


def electrode(k, charge=3.0, **more):
    """k laplacian(u) = 1: u = x^2 / 2k + c x with the flux `charge` through the right, whose potential is found."""
    return js.Problem(
        lambda u, x, k, g: k * js.laplacian(u)(x) - 1.0,
        {"left": js.dirichlet(0.0), "right": js.dirichlet(lambda x, k, g: g["V"]), "top": js.neumann(0.0),
         "bottom": js.neumann(0.0)},
        params=k, unknowns={"V": 0.3}, constraints=[js.constraint(lambda sol: sol.flux("right"), charge)], **more,
    )  # fmt: skip


def test_a_floating_electrode_and_its_gradient():
    """V = c + 1 / 2k with c = 3 - 1 / k, a polynomial of the order: exact to round-off."""
    sol = js.solve(electrode(2.0), SQUARE, order=2, depth=0)
    x = SQUARE.points[:, 0]
    assert abs(sol.u - (x**2 / 4 + 2.5 * x)).max() < 1e-11
    assert abs(sol.unknowns["V"] - 2.75) < 1e-11
    assert sol.converged and not sol.flags and sol.error_estimate().max() < 1e-10


def test_gradients_and_jit():
    """u'' k = 1 in 1D: V = Q - 1 / 2k."""

    def rod(k, charge):
        ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(lambda x, k, g: g["V"])}
        given = [js.constraint(lambda sol: sol.flux("right"), charge)]
        pde = lambda u, x, k, g: k * js.laplacian(u)(x) - 1.0
        problem = js.Problem(pde, ends, params=k, unknowns={"V": 0.3}, constraints=given)
        return js.solve(problem, ROD, order=2)

    def potential(k, charge):
        sol = rod(k, charge)
        return sol.unknowns["V"], sol.converged

    graded = mm.quickly(jax.value_and_grad(potential, (0, 1), has_aux=True))
    (value, converged), (by_k, by_charge) = graded(2.0, 3.0)
    assert bool(converged) and abs(value - (3 - 1 / 4)) < 1e-10
    assert abs(by_k - 1 / 8) < 1e-9 and abs(by_charge - 1.0) < 1e-9


def test_slopes_all_around_with_a_multiplier_and_a_mean():
    """laplacian(u) = 4 - q with slopes of x^2 - y^2: the multiplier q = 4 makes the data balance."""
    exact = lambda x: x[0] ** 2 - x[1] ** 2
    slope = js.condition(lambda u, x, n, g: n @ (js.grad(u)(x) - js.grad(exact)(x)))
    problem = js.Problem(
        lambda u, x, g: js.laplacian(u)(x) - 4.0 + g["q"], {s: slope for s in ("left", "right", "top", "bottom")},
        unknowns={"q": 0.0}, constraints=[js.constraint(lambda sol: sol.integral(), 5.0)],
    )  # fmt: skip
    sol = js.solve(problem, SQUARE, order=2, depth=0)
    assert abs(sol.unknowns["q"] - 4.0) < 1e-9
    assert abs(sol.u - (jax.vmap(exact)(SQUARE.points) + 5.0)).max() < 1e-9
    assert abs(sol.integral() - 5.0) < 1e-11


@pytest.mark.parametrize(
    "functional, value",
    [(lambda s: s([[0.5]])[0], 2.0), (lambda s: s.integral(), 2 + 1 / 6 - 1 / 8), (lambda s: s.u[0], 2 - 1 / 8)],
)
def test_a_constraint_without_unknowns_fixes_the_free_constant(functional, value):
    """u'' = 1 with slopes 0 and 1: u = x^2 / 2 + 2 - 1 / 8."""
    ends = {"left": js.neumann(0.0), "right": js.neumann(1.0)}
    pde = lambda u, x: js.laplacian(u)(x) - 1.0
    sol = js.solve(js.Problem(pde, ends, constraints=[js.constraint(functional, value)]), ROD)
    x = ROD.points[:, 0]
    assert abs(sol.u - (x**2 / 2 + 2 - 1 / 8)).max() < 1e-12 and sol.unknowns == {} and not sol.flags
    unbalanced = js.Problem(pde, {**ends, "right": js.neumann(2.0)}, constraints=[js.constraint(functional, value)])
    with pytest.raises(js.SolveError, match="do not balance"):
        js.solve(unbalanced, ROD)


def test_two_unknowns_in_a_system_and_a_constraint_between_them():
    """u'' = a, v'' = b x with the means of both and a + b given: u = a (x^2 - x) / 2, v = b (x^3 - x) / 6."""
    ends = {side: js.dirichlet(0.0) for side in ("left", "right")}
    pde = lambda u, x, g: jnp.stack([js.laplacian(u[0])(x) - g["a"], js.laplacian(u[1])(x) - g["b"] * x[0]])
    both = js.constraint(lambda s: s.unknowns["a"] + s.unknowns["b"], 1.0)
    given = [js.constraint(lambda s: s.integral()[0], -0.5), both]
    sol = js.solve(js.Problem(pde, ends, fields=2, unknowns={"b": 0.0, "a": 1.0}, constraints=given), ROD, order=3)
    x = np.asarray(ROD.points[:, 0])
    assert abs(sol.unknowns["a"] - 6.0) < 1e-9 and abs(sol.unknowns["b"] + 5.0) < 1e-9
    assert abs(sol.u - np.stack([3 * (x**2 - x), -5 * (x**3 - x) / 6], 1)).max() < 1e-10
    again = pickle.loads(pickle.dumps(sol))
    assert again.unknowns == sol.unknowns and abs(again([[0.3]]) - sol([[0.3]])).max() < 1e-14


def test_a_constraint_that_is_not_linear_is_met_by_newton_steps():
    """u'' = q, u = q (x^2 - x) / 2: the integral of u^2 over the particles' polynomials, q > 0."""
    ends = {side: js.dirichlet(0.0) for side in ("left", "right")}
    square = js.constraint(lambda s: jnp.mean(s.u**2), 1.0)
    pde = lambda u, x, g: js.laplacian(u)(x) - g["q"]
    sol = js.solve(js.Problem(pde, ends, unknowns={"q": 1.0}, constraints=[square]), ROD)
    assert sol.converged and 2 < sol.iterations < 12 and abs(jnp.mean(sol.u**2) - 1.0) < 1e-8


BOTH = {side: js.dirichlet(0.0) for side in ("left", "right")}


def test_a_nonlinear_problem_on_both_sides_of_its_fold():
    """u'' + c exp(u) = 0: u = 2 log(cosh(a) / cosh(a (1 - 2 x))), c = 8 a^2 / cosh(a)^2, by its value in the middle."""
    pde, traces = lambda u, x, g: js.laplacian(u)(x) + g["c"] * jnp.exp(u(x)), []
    for middle in (0.5, 2.0):
        given = [js.constraint(lambda s: s([[0.5]])[0], middle)]
        problem = js.Problem(pde, BOTH, unknowns={"c": 1.0}, constraints=given)
        sol = js.solve(problem, js.interval(0.0, 1.0, 17), order=6)
        a = np.arccosh(np.exp(middle / 2))
        assert abs(sol.unknowns["c"] - 8 * a**2 / np.cosh(a) ** 2) < 1e-7
        exact = 2 * np.log(np.cosh(a) / np.cosh(a * (1 - 2 * np.asarray(sol.cloud.points[:, 0]))))
        assert abs(sol.u - exact).max() < 1e-7 and sol.converged and not sol.flags
        assert abs(sol.u - exact).max() < 10 * sol.error_estimate().max() + 1e-12
        traces.append(dict(batches.TRACES))
    assert traces[0] == traces[1]  # steps and slopes of another solution of the kind


def test_an_eigenvalue_is_an_unknown():
    """u'' + c u = 0 with the mean square of one half: c = pi^2; from u = 0 no step is determined."""
    pde = lambda u, x, p, g: js.laplacian(u)(x) + p * g["c"] * u(x)
    given = [js.constraint(lambda s: jnp.mean(s.u**2), 0.5)]
    problem = js.Problem(pde, BOTH, params=2.0, unknowns={"c": 4.0}, constraints=given)
    sol = js.solve(problem, ROD, order=8, u0=lambda x, p: x[0] * (1 - x[0]))
    assert abs(sol.unknowns["c"] - np.pi**2 / 2) < 1e-8
    with pytest.raises(js.SolveError, match="determine no step"):
        js.solve(problem, ROD, order=8)


def test_an_unknown_that_enters_nonlinearly_and_derivatives():
    """k u'' = exp(q) with the mean -p: q = log(12 k p)."""

    def q(k, mean):
        given = [js.constraint(lambda s: s.integral(), -mean)]
        pde = lambda u, x, k, g: k * js.laplacian(u)(x) - jnp.exp(g["q"])
        problem = js.Problem(pde, BOTH, params=k, unknowns={"q": 0.0}, constraints=given)
        return js.solve(problem, ROD, order=2, depth=0).unknowns["q"]

    assert abs(q(2.0, 0.25) - np.log(6.0)) < 1e-10
    slopes = jax.grad(q, (0, 1))(2.0, 0.25)
    assert np.allclose(slopes, (0.5, 4.0), rtol=1e-7)
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(lambda x, g: jnp.exp(g["q"]))}
    middle = js.constraint(lambda s: s.u[5], 1.0)
    ask = js.Problem(lambda u, x, g: js.laplacian(u)(x), ends, unknowns={"q": 0.0}, constraints=[middle])
    sol = jax.jit(lambda: js.solve(ask, ROD, order=2, depth=0, solver="dense"))()
    assert bool(sol.converged) and abs(sol.unknowns["q"] - np.log(2.0)) < 1e-10


def test_steps_without_depth_where_deep_ones_do_not_settle():
    """u'' / 4000 + u - u^3 + q = 0 on layers that the particles do not resolve: q = 0 by a value of its solution."""
    plain = lambda u, x: js.laplacian(u)(x) / 4e3 + u(x) - u(x) ** 3
    ends, rod = {"left": js.dirichlet(-1.0), "right": js.dirichlet(1.0)}, js.interval(0.0, 1.0, 21)
    known = js.solve(js.Problem(plain, ends), rod)
    assert known.depth == 0 and any("without depth" in told for told in known.stats["messages"])
    given = [js.constraint(lambda s: s.u[8], float(known.u[8]))]
    problem = js.Problem(lambda u, x, g: plain(u, x) + g["q"], ends, unknowns={"q": 0.01}, constraints=given)
    sol = js.solve(problem, rod)
    assert sol.converged and sol.depth == 0 and any("without depth" in told for told in sol.stats["messages"])
    assert abs(sol.unknowns["q"]) < 1e-9 and abs(sol.u - known.u).max() < 1e-9


def test_a_coefficient_is_found_under_jit():
    """u'' + p c u = -1 by its value in the middle, as without jit; p is traced, so that nothing says that c is a factor
    but what is traced."""
    rod = js.interval(0.0, 1.0, 9)

    def found(p, middle):
        pde = lambda u, x, p, g: js.laplacian(u)(x) + p * g["c"] * u(x) + 1.0
        given = [js.constraint(lambda s: s.u[4], middle)]
        problem = js.Problem(pde, BOTH, params=p, unknowns={"c": 3.0}, constraints=given)
        sol = js.solve(problem, rod, order=2, depth=0, solver="dense")
        return sol.unknowns["c"], sol.converged

    right, _ = found(2.0, 0.2)
    (value, converged), slope = mm.quickly(jax.value_and_grad(found, (0, 1), has_aux=True))(2.0, 0.2)
    assert bool(converged) and abs(value - right) < 1e-9
    step = (found(2.0, 0.2 + 1e-5)[0] - found(2.0, 0.2 - 1e-5)[0]) / 2e-5
    assert abs(slope[0] + right / 2.0) < 1e-6 and abs(slope[1] - step) < 1e-6 * abs(step)  # p c is one number


def test_a_free_constant_of_a_nonlinear_problem():
    """u'' + u'^2 = 1 + x^2 with the slopes 0 and 1: u = x^2 / 2 + 2 - 1 / 6, whose mean is 2."""
    ends = {"left": js.neumann(0.0), "right": js.neumann(1.0)}
    pde = lambda u, x, more: js.laplacian(u)(x) + js.grad(u)(x)[0] ** 2 - 1 - x[0] ** 2 - more
    mean = js.constraint(lambda s: s.integral(), 2.0)
    sol = js.solve(js.Problem(pde, ends, params=0.0, constraints=[mean]), ROD, order=2, depth=0)
    assert abs(sol.u - (ROD.points[:, 0] ** 2 / 2 + 2 - 1 / 6)).max() < 1e-10 and not sol.flags
    with pytest.raises(js.SolveError, match="do not balance"):
        js.solve(js.Problem(pde, ends, params=1.0, constraints=[mean]), ROD, order=2, depth=0)


def test_a_nonlinear_conductivity_beside_another_material():
    """((1 + u) u')' = -q in a, u'' = 0 in b, with the value 0.3 in the middle of a: U + U^2 / 2 is a parabola in a."""
    cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.025)
    flux = {"a": lambda u, x, n, g: (1 + u(x)) * n @ js.grad(u)(x), "b": lambda u, x, n, g: 2 * n @ js.grad(u)(x)}
    pde = {
        "a": lambda u, x, g: js.divergence(lambda y: (1 + u(y)) * js.grad(u)(y))(x) + g["q"],
        "b": lambda u, x, g: 2 * js.laplacian(u)(x),
    }
    bcs = {"boundary": js.dirichlet(0.0), "a|b": js.interface(flux=flux)}
    given = [js.constraint(lambda s: s([[0.25]])[0], 0.3)]
    sol = js.solve(js.Problem(pde, bcs, unknowns={"q": 1.0}, constraints=given), cloud)
    # W = u + u^2 / 2 = c x - q x^2 / 2; at 1/2: u = v, and the flux c - q / 2 = -4 v goes on.
    w, half = 0.3 + 0.3**2 / 2, lambda q: 4 * (0.345 + q / 32) / 2 - q / 8
    v = lambda q: np.sqrt(1 + 2 * half(q)) - 1
    q = float(sol.unknowns["q"])
    assert abs(w - 0.345) < 1e-12 and abs(4 * (0.345 + q / 32) - q / 2 + 4 * v(q)) < 1e-5
    assert sol.converged and not sol.flags and abs(float(sol([[0.25]])[0]) - 0.3) < 1e-8


def test_what_is_refused():
    ends = {side: js.dirichlet(0.0) for side in ("left", "right")}
    mean = js.constraint(lambda s: s.integral(), 1.0)
    pde = lambda u, x, g: js.laplacian(u)(x) - g["q"]
    refused = [
        (dict(pde=pde, unknowns={"q": 0.0}), "1 unknown.*no constraint"),
        (dict(pde=pde, unknowns={"q": 0.0}, constraints=[mean, mean]), "got 2 for 1 unknown"),
        (dict(pde=lambda u, x: js.laplacian(u)(x), constraints=[mean]), "got 1 for 0 unknown"),
        (dict(pde=pde, unknowns={"q": 0.0}, constraints=[lambda s: 0.0]), r"constraints\[0\]: expected js.constraint"),
        (dict(pde=pde, unknowns={"q": "a"}, constraints=[mean]), r"unknowns\['q'\]: expected a number"),
        (dict(pde=pde, unknowns=["q"], constraints=[mean]), "unknowns: expected a dict"),
        (dict(pde=pde, unknowns={"q": 0.0}, constraints=[js.constraint(lambda s: s.u)]), "must return a real scalar"),
        (dict(pde=pde, unknowns={"q": 0.0}, constraints=[js.constraint(lambda s: s.nothing)]), "nothing"),
    ]  # fmt: skip
    for given, told in refused:
        with pytest.raises(ValueError, match=told):
            js.solve(js.Problem(given.pop("pde"), ends, **given), ROD)
    with pytest.raises(ValueError, match="functional: expected a function"):
        js.constraint(1.0)
    with pytest.raises(ValueError, match="value: NaN"):
        js.constraint(lambda s: s.u[0], np.nan)
    problem = js.Problem(pde, ends, unknowns={"q": 0.0}, constraints=[mean])
    others = [
        lambda: js.factorize(problem, ROD),
        lambda: js.eigen(problem, ROD, 2),
        lambda: js.evolve(problem, ROD, lambda x: 0.0, t=(0.0, 1.0), steps=2),
        lambda: js.tune(problem, ROD, js.SuperGaussian(ROD.spacing, 3.0)),
        lambda: js.adapt(problem, lambda h: js.interval(0.0, 1.0, spacing=h), 1e-3),
        lambda: js.solve(problem, ROD, method="I"),
    ]  # fmt: skip
    for ask in others:
        with pytest.raises(ValueError, match="constraints"):
            ask()


def test_a_singular_set_of_constraints_fails_by_name():
    ends = {side: js.dirichlet(0.0) for side in ("left", "right")}
    same = js.constraint(lambda s: s.integral(), 1.0)
    pde = lambda u, x, g: js.laplacian(u)(x) - g["p"] - g["q"] * x[0]
    problem = js.Problem(pde, ends, unknowns={"p": 0.0, "q": 0.0}, constraints=[same, same])
    with pytest.raises(js.SolveError, match="constraints"):
        js.solve(problem, ROD)


def amoeba(x):
    return jnp.hypot(x[0], x[1]) - 1.0 - 0.2 * jnp.cos(5 * jnp.arctan2(x[1], x[0]))


AMOEBA = js.from_sdf(amoeba, ((-1.3, -1.3), (1.3, 1.3)), 0.3)
# Of the amoeba: its area, and the integral of r^2.
AREA, SECOND = np.pi * 1.02, np.pi / 2 * (1 + 6 * 0.04 / 2 + 0.0016 * 3 / 8)


def bowl(constraint):
    """u = a r^2 with a = 1, by what a constraint says of it."""
    return js.Problem(
        lambda u, x, g: js.laplacian(u)(x) - 4 * g["a"],
        {"boundary": js.dirichlet(lambda x, g: g["a"] * (x @ x))},
        unknowns={"a": 0.0}, constraints=[constraint],
    )  # fmt: skip


@pytest.mark.parametrize("order", [2, 4])
@pytest.mark.parametrize(
    "constraint",
    [js.constraint(lambda s: s.flux("boundary"), 4 * AREA), js.constraint(lambda s: s.integral(), SECOND)],
)
def test_the_estimate_knows_the_error_of_the_quadrature(constraint, order):
    """The solution is a polynomial of the order: all that it misses is the quadrature's."""
    sol = js.solve(bowl(constraint), AMOEBA, order=order)
    error = np.abs(np.asarray(sol.u) - (np.asarray(AMOEBA.points) ** 2).sum(axis=1)).max()
    assert error > 1e-6 and 0.5 * error < sol.error_estimate().max() < 2.0 * error


def test_the_estimate_knows_the_quadrature_of_an_integral_term():
    """u - (the integral of u) = r^2."""
    problem = js.Problem(lambda u, x: u(x) - x @ x, {"boundary": js.free()}, integral=lambda x, y: -1.0 + 0.0 * (x @ y))
    sol = js.solve(problem, AMOEBA, order=2)
    exact = (np.asarray(AMOEBA.points) ** 2).sum(axis=1) + SECOND / (1.0 - AREA)
    error = np.abs(np.asarray(sol.u) - exact).max()
    assert error > 1e-7 and sol.error_estimate().max() > 0.3 * error
