"""What is refused is refused in words: nothing of Python's or JAX's insides, and the name that was meant."""

import functools

import jax
import jax.numpy as jnp
import pytest

import jsmitsm as js

ROD = js.interval(0.0, 1.0, 9)
ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
HUGE = 10**400


def poisson(u, x):
    return js.laplacian(u)(x) - 1.0


def solved(pde=poisson, bcs=ENDS, **options):
    return js.solve(js.Problem(pde, bcs), ROD, **options)


def left(condition):
    return {**ENDS, "left": condition}


def shape(sdf, spacing=0.25, bounds=((-2.0,), (2.0,))):
    return js.from_sdf(sdf, bounds, spacing)


def nested(n, call):
    """``call`` within n functions."""
    return functools.reduce(lambda f, _: lambda *x: f(*x), range(n), call)


def refused(what, *words):
    with pytest.raises(ValueError) as caught:
        what()
    text = str(caught.value)
    assert all(word in text for word in words), text
    assert "Tracer" not in text and len(text) < 700, text


@pytest.mark.parametrize(
    ("what", "where"),
    [
        (lambda: solved(lambda u, x: js.laplacian(u)(x) - HUGE), "pde: a number too large"),
        (lambda: solved(lambda u, x: js.laplacian(u)(x) - 10**20 * x[0]), "1e20 for 10**20"),
        (lambda: solved(lambda u, x: js.laplacian(u)(x) - 10.0**400), "pde: a number too large"),
        (lambda: solved(bcs=left(js.dirichlet(HUGE))), "value: expected a number"),
        (lambda: solved(bcs=left(js.dirichlet(lambda x: HUGE))), "bcs['left'].value"),
        (lambda: solved(bcs=left(js.condition(lambda u, x, n: u(x) - HUGE))), "bcs['left']"),
        (lambda: js.Problem(poisson, ENDS, params=HUGE), "a whole number of 401 digits"),
        (lambda: js.Gaussian(HUGE, 2.0), "h: expected a positive number"),
        (lambda: js.Gaussian(10**5000, 2.0), "a whole number of 5001 digits"),
        (lambda: js.Kernel(lambda r: HUGE * r, 0.1, 2.0), "profile: expected"),
        (lambda: js.interval(0.0, HUGE, 9), "b: expected 1 finite number"),
        (lambda: shape(lambda x: jnp.abs(x[0]) - HUGE), "sdf: failed"),
        (lambda: shape(lambda x: jnp.abs(x[0]) - 1, lambda x: [HUGE] * len(x)), "spacing: the function returned"),
        (lambda: shape(lambda x: jnp.abs(x[0]) - 1, bounds=((-HUGE,), (2.0,))), "bounds: expected"),
        (lambda: solved(lambda u, x: js.laplacian(u)(x) - u(x) ** 2, u0=[HUGE] * 9), "u0: expected"),
    ],
)
def test_numbers_too_large(what, where):
    refused(what, where)


@pytest.mark.parametrize(
    ("what", "where"),
    [
        (lambda: solved(nested(1500, poisson)), "pde: functions within functions"),
        (lambda: solved(bcs=left(js.dirichlet(nested(1500, lambda x: x[0])))), "bcs['left'].value"),
        (lambda: shape(nested(1500, lambda x: jnp.abs(x[0]) - 1.0)), "sdf: failed"),
        (lambda: js.Kernel(nested(1500, lambda r: 1.0 - r), 0.1, 2.0), "profile: expected"),
    ],
)
def test_functions_nested_too_deep(what, where):
    refused(what, where, "sys.setrecursionlimit")


def test_functions_nested_deep_are_solved():
    assert float(solved(nested(150, poisson)).u[4]) == pytest.approx(-0.125)


@pytest.mark.parametrize(
    ("what", "words"),
    [
        (lambda: solved(lambda u, x: js.laplacian(u)(x) - x(0)), ["pde: a traced array is not callable"]),
        (lambda: solved(lambda u, x: js.laplacian(u)(x) - x.foo), ["pde: a traced array has no attribute foo"]),
        (lambda: solved(lambda u, x: js.laplacian(u)(x) - (x[0] if x[0] > 0 else 0.0)), ["pde", "jnp.where for an if"]),
        (lambda: solved(bcs=left(js.condition(lambda u, x, n: u(x) - "a"))), ["left", "a traced array and 'str'"]),
        (lambda: solved(bcs=left(js.dirichlet(lambda x: x.foo))), ["bcs['left'].value", "no attribute foo"]),
        (lambda: js.Kernel(lambda r: r.foo, 0.1, 2.0), ["profile", "no attribute foo"]),
        (lambda: shape(lambda x: x[0].foo), ["sdf", "no attribute foo"]),
        (lambda: jax.jit(lambda b: js.interval(0.0, b, 9).points)(1.0), ["b: expected 1 finite number"]),
        (lambda: jax.jit(lambda k: solved(order=k).u)(4), ["order: expected a whole number"]),
        (lambda: jax.jit(lambda k: js.dirichlet(0.0, field=k))(0), ["field: expected", "a traced array"]),
        (lambda: jax.jit(lambda k: js.Problem(poisson, {"left": k}))(0.0), ["js.dirichlet(a traced array)"]),
        (lambda: jax.jit(lambda k: js.fix([k], 0.0))(4), ["indices: expected particle numbers"]),
        (lambda: jax.jit(lambda k: js.stencils(ROD, size=k).indices)(4), ["size: expected a whole number"]),
    ],
)
def test_traced_arrays_are_called_so(what, words):
    refused(what, *words)


@pytest.mark.parametrize(
    ("what", "meant"),
    [
        (lambda: solved(bcs={"lefft": js.dirichlet(0.0), "right": js.dirichlet(0.0)}), "left"),
        (lambda: solved(bcs={**ENDS, "Left": js.dirichlet(0.0)}), "left"),
        (lambda: solved(bcs={"p": js.periodic("left", "rigth")}), "right"),
        (lambda: solved(method="Ii"), "II"),
        (lambda: solved(solver="spars"), "sparse"),
        (lambda: solved(formulation="lqs"), "lsq"),
        (lambda: solved(lambda u, x: js.laplacan(u)(x)), "laplacian"),
        (lambda: solved(bcs=left(js.dirichlet(lambda x: js.sdf.circl((0,), 1.0)(x)))), "circle"),
        (lambda: js.Problem(poisson, ENDS).replace(parms=1.0), "params"),
        (lambda: js.Gaussian(0.1, 2.0).replace(H=1.0), "h"),
        (lambda: js.tune(js.Problem(poisson, ENDS), ROD, methd="S"), "method"),
        (lambda: js.tune(js.Problem(poisson, ENDS), ROD, parameters=("hh",)), "h"),
        (lambda: js.tune(js.Problem(poisson, ENDS), ROD, objective="estimat"), "estimate"),
    ],
)
def test_the_name_that_was_meant(what, meant):
    refused(what, f"did you mean {meant!r}?")


@pytest.mark.parametrize(("name", "meant"), [("solv", "solve"), ("from_sfd", "from_sdf")])
def test_the_public_name_that_was_meant(name, meant):
    with pytest.raises(AttributeError, match=f"did you mean '{meant}'"):
        getattr(js, name)
    with pytest.raises(AttributeError, match="no attribute 'nothing_like_it'$"):
        js.nothing_like_it  # noqa: B018


def test_single_precision_in_tiny_units():
    """Nanometres written as metres: the derivatives of a smooth source leave the range of float32."""
    rod = js.interval(0.0, 1e-9, 21)
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) + 1e18 * jnp.sin(3e9 * x[0]), ENDS)
    with jax.enable_x64(False):
        refused(lambda: js.solve(problem, rod, order=8), "float32", "jax_enable_x64", "units")
    assert js.solve(problem, rod, order=8).converged
