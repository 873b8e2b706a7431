"""Nothing that a function sees can change without being seen: every way of `changes`, in every place of a problem."""

import jax.numpy as jnp
import numpy as np
import pytest
from changes import WAYS

import jsmitsm as js

ROD = js.interval(0.0, 1.0, 9)
ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
PLACES = {}


def place(function):
    PLACES[function.__name__] = function
    return function


def laplace(right, more=()):
    return js.Problem(lambda u, x: js.laplacian(u)(x), {"left": js.dirichlet(0.0), "right": right, **dict(more)})


def middle(problem):
    return js.solve(problem, ROD).u[4]


# Each place takes read() -> k, and returns a function that solves again, and its right value as a function of k.


@place
def pde(read):
    """u'' = k, u = 0 at the ends: u = k x (x - 1) / 2. The same function, and one written anew."""
    same = js.Problem(lambda u, x: js.laplacian(u)(x) - read(), ENDS)
    anew = lambda: js.Problem(lambda u, x: js.laplacian(u)(x) - read(), ENDS)
    return lambda: (middle(same), middle(anew())), lambda k: (-k / 8, -k / 8)


@place
def source(read):
    """u'' = k x: u = k (x^3 - x) / 6."""
    f = lambda x: read() * x[0]
    return lambda: middle(js.Problem(lambda u, x: js.laplacian(u)(x) - f(x), ENDS)), lambda k: -k / 16


@place
def params(read):
    """As the pde's, with parameters beside."""
    problem = js.Problem(lambda u, x, p: js.laplacian(u)(x) - p["one"] * read(), ENDS, params={"one": 1.0})
    return lambda: middle(problem.replace(params={"one": 1.0})), lambda k: -k / 8


@place
def dirichlet(read):
    """u'' = 0, u(1) = k: u = k x."""
    return lambda: middle(laplace(js.dirichlet(lambda x: read() * x[0]))), lambda k: k / 2


@place
def neumann(read):
    """u'' = 0, u'(1) = k: u = k x."""
    return lambda: middle(laplace(js.neumann(lambda x: read() * x[0]))), lambda k: k / 2


@place
def robin(read):
    """u'' = 0, k u + u' = 1 at x = 1: u = x / (1 + k)."""
    return lambda: middle(laplace(js.robin(lambda x: read() * x[0], 1.0, 1.0))), lambda k: 0.5 / (1 + k)


@place
def condition(read):
    """u'' = 0, u' u = k^2 at x = 1, started from u = x: u = k x. Nonlinear."""
    end = js.condition(lambda u, x, n: n @ js.grad(u)(x) * u(x) - read() ** 2)
    return lambda: js.solve(laplace(end), ROD, u0=lambda x: x[0]).u[4], lambda k: k / 2


@place
def fix(read):
    """u'' = 0, u(1) = k, held at the particle."""
    problem = lambda: laplace(js.free(), {"held": js.fix([8], lambda x: read() * x[0])}.items())
    return lambda: middle(problem()), lambda k: k / 2


@place
def factorized(read):
    """k u'' = 1, prepared once."""
    problem = js.Problem(lambda u, x: read() * js.laplacian(u)(x) - 1.0, ENDS)
    ready = js.factorize(problem, ROD)
    return lambda: ready.solve(problem).u[4], lambda k: -1 / (8 * k)


@place
def signed_distance(read):
    """The interval |x| < k."""
    sdf = lambda x: jnp.abs(x[0]) - read()
    return lambda: js.from_sdf(sdf, ((-3.0,), (3.0,)), 0.25).points.max(), lambda k: k


@place
def spacing(read):
    """[0, 1] in steps of k / 16."""
    step = lambda x: np.full(len(x), read() / 16)
    return lambda: len(js.from_sdf(js.sdf.interval(0.0, 1.0), ((-1.0,), (2.0,)), step)) - 1, lambda k: 16 / k


# A spacing is called with numbers, not recorded: JAX itself keeps an older state of these, whoever calls them.
KEPT_BY_JAX = (
    "a_jitted_helper", "the_body_of_a_loop_in_jax", "a_branch_in_jax", "a_loop_over_rows_in_jax", "a_ufunc_of_jax",
    "a_piece_of_a_function_in_jax", "a_function_recomputed_by_jax",
)  # fmt: skip


def cases():
    """Every way in the pde; of the other places each takes its turn."""
    for k, way in enumerate(WAYS):
        for j, where in enumerate(PLACES):
            if where == "pde" or (k + j) % 6 == 0 and not (where == "spacing" and way in KEPT_BY_JAX):
                yield where, way


@pytest.mark.parametrize(("where", "way"), list(cases()))
def test_a_change_is_seen(where, way, tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        read, change = WAYS[way](patch, tmp_path)
        solve, right = PLACES[where](read)
        for k in (1.0, 1.0, 2.0):
            if k == 2.0:
                change()
            # The problems are exact for the method: round-off alone.
            np.testing.assert_allclose(solve(), right(k), rtol=1e-9)


def test_there_are_enough_of_them():
    assert len(WAYS) >= 60
    for where in PLACES:
        assert sum(where == w for w, _ in cases()) >= 12
