"""A residual is recorded again when something that it can see may have changed, and otherwise not; see test_changes."""

import functools
import math
import random
import time
import types

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.equation import tracing
from jsmitsm.equation.tracing import trace
from jsmitsm.runtime import compiled
from jsmitsm.runtime.recall.recording import Unknown, identity

FACTOR = 2.0


def helper(x):
    return FACTOR * x[0]


def reads_a_global(u, x):
    return js.laplacian(u)(x) - helper(x)


def made(value):
    return lambda u, x: js.laplacian(u)(x) - value * x[0]


def test_a_function_written_again_is_recognised():
    assert trace(made(1.5), 2) is trace(made(1.5), 2)
    assert trace(made(1.5), 2) is not trace(made(1.5), 1)


@pytest.mark.parametrize(
    ("one", "other"),
    [(1.5, 1.5000001), (1, 1.0), (0.0, -0.0), (np.ones(2), np.array([1.0, 2.0])), (True, 1), ((1, 2), [1, 2]),
     (0j, -0j), (range(0, 3, 2), range(0, 4, 2)), (np.eye(2), np.asfortranarray(np.eye(2)))],
)
def test_other_values_are_other_functions(one, other):
    assert identity(made(one)) == identity(made(one))
    assert identity(made(one)) != identity(made(other))


def test_a_changed_global_is_seen(monkeypatch):
    """Also where only a helper reads it: the answer must not be that of the old value."""
    cloud = js.interval(0.0, 1.0, 9)
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    u = js.solve(js.Problem(reads_a_global, ends), cloud).u
    monkeypatch.setitem(globals(), "FACTOR", 6.0)
    np.testing.assert_allclose(js.solve(js.Problem(reads_a_global, ends), cloud).u, 3 * u, rtol=1e-12)


def test_a_changed_array_is_seen():
    k = np.array([1.0, 2.0])
    before = identity(lambda u, x: k[0] * u(x))
    k[0] = 3.0
    assert identity(lambda u, x: k[0] * u(x)) != before


def test_what_cannot_be_compared_is_recorded_every_time():
    box = types.SimpleNamespace(k=1.0)
    for unknown in (box, np.ones(200_001), object()):
        with pytest.raises(Unknown):
            identity(made(unknown))
    first = trace(lambda u, x: box.k * u(x), 1)
    box.k = 2.0
    again = trace(lambda u, x: box.k * u(x), 1)
    assert float(again.coefficients(np.zeros((1, 1)), 0)[0].squeeze()) == 2.0 and again is not first


def test_traced_values_do_not_leak():
    """A residual that closes over a traced number, recorded in one transform, is not used in the next."""
    cloud = js.interval(0.0, 1.0, 9)
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}

    def middle(k):
        return js.solve(js.Problem(made(k), ends), cloud, solver="dense").u[4]

    one, two = (float(mm.quickly(jax.grad(middle))(k)) for k in (1.0, 2.0))
    assert one == pytest.approx(two, rel=1e-9) and one == pytest.approx(float(middle(1.0)), rel=1e-9)


def test_recursive_partial_and_wrapped_functions():
    def series(x, n):
        return x if n == 0 else x * series(x, n - 1)

    assert identity(functools.partial(series, n=3)) == identity(functools.partial(series, n=3))
    assert identity(functools.partial(series, n=3)) != identity(functools.partial(series, n=2))
    wave = lambda x: jnp.sin(x[0])
    assert identity(jax.grad(wave)) == identity(jax.grad(wave))
    assert identity(jax.grad(wave)) != identity(jax.grad(lambda x: jnp.cos(x[0])))


# ------------------------------------------------------------------ what is recorded once

TABLE = np.linspace(0.0, 1.0, 20)
WAVES = {"k": (1.0, np.array([2.0, 3.0]))}
ROD = js.interval(0.0, 1.0, 9)
ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}


def wave(x, k=3.0):
    return jnp.sin(k * x[0]) * math.pi * FACTOR


def written_anew(k, f):
    """The same problems with functions that are new objects; ``k`` and ``f`` come from outside."""
    poisson = lambda f: js.Problem(lambda u, x: js.laplacian(u)(x) - f(x), ENDS)
    slope = jax.grad(lambda x: jnp.exp(k * x[0]))
    disk = js.sdf.ball((0.5,), 0.2)
    nested = lambda n: (lambda x: x[0]) if n == 0 else (lambda x: nested(n - 1)(x) + 1.0)
    yield "a number", poisson(lambda x: k)
    yield "a function", poisson(lambda x: f(x[0]))
    yield "a table", poisson(lambda x: jnp.interp(x[0], TABLE, TABLE**2))
    yield "containers", poisson(lambda x: WAVES["k"][1][0] * x[0] + max(1, len(WAVES)))
    yield "a helper", poisson(lambda x: wave(x) + sum(wave(x, k) for k in (1.0, 2.0)))
    yield "numpy", poisson(lambda x: np.dot(TABLE, np.cos(TABLE)) * x[0] + np.pi)
    yield "loops", poisson(lambda x: jax.lax.fori_loop(0, 3, lambda i, t: t + x[0], 0.0))
    yield "modules of jax", poisson(lambda x: jax.nn.softplus(x[0]) + jnp.linalg.norm(x) + jax.scipy.special.erf(x[0]))
    yield "a partial", poisson(functools.partial(wave, k=k))
    yield "a derivative", poisson(lambda x: slope(x)[0])
    yield "a distance", poisson(lambda x: jnp.exp(-(disk(x) ** 2)))
    yield "a recursion", poisson(nested(3))
    yield "a coefficient", js.Problem(
        lambda u, x: js.divergence(lambda y: (1.0 + k * y[0]) * js.grad(u)(y))(x) - 1.0, ENDS
    )
    yield "conditions", js.Problem(
        lambda u, x: js.laplacian(u)(x) - 1.0,
        {"left": js.robin(1.0, lambda x: k, lambda x: wave(x)),
         "right": js.condition(lambda u, x, n: n @ js.grad(u)(x) - f(x[0]))},
    )  # fmt: skip
    yield "params", js.Problem(
        lambda u, x, p: js.laplacian(u)(x) - p["k"] * wave(x),
        {"left": js.dirichlet(lambda x, p: p["k"]), "right": js.dirichlet(0.0)},
        params={"k": k, "more": [np.ones(2)]},
    )


def test_an_unchanged_problem_is_recorded_once(monkeypatch):
    """The usual kinds of functions, each an object of its own every time."""
    made = []
    plain = tracing.record
    monkeypatch.setattr(tracing, "record", lambda *a: (made.append(1), plain(*a))[1])
    for _ in range(2):
        counts = {}
        for kind, problem in written_anew(1.5, lambda y: jnp.cos(y)):
            before = len(made)
            js.solve(problem, ROD)
            counts[kind] = len(made) - before
    assert not any(counts.values()), counts


def test_another_problem_compiles_nothing_that_is_known():
    """A shape or a profile written anew computes the same, so its program is found."""
    rod = js.from_sdf(lambda x: jnp.abs(x[0]) - 1.0, ((-2.0,), (2.0,)), 0.25)
    kernels = [js.Kernel(lambda r: (2.0 - r) ** 4, 0.5, 2.0).recorded() for _ in range(2)]
    assert jax.tree.structure(kernels[0]) == jax.tree.structure(kernels[1])
    programs = len(compiled._programs)
    again = js.from_sdf(lambda x: jnp.abs(x[0]) - 1.0, ((-2.0,), (2.0,)), 0.25)
    np.testing.assert_array_equal(again.points, rod.points)
    assert len(compiled._programs) == programs


# ------------------------------------------------------------------ what is recorded every time


def middle(pde):
    return float(js.solve(js.Problem(pde, ENDS), ROD).u[4])


@pytest.mark.parametrize(
    "draw",
    [
        np.random.rand, random.random, np.random.default_rng(0).random, time.perf_counter,
        lambda: np.random.default_rng().random(), lambda: random.Random().random(),
    ],
)  # fmt: skip
def test_random_numbers_are_drawn_anew(draw):
    pde = lambda u, x: js.laplacian(u)(x) - draw()
    assert len({middle(pde) for _ in range(3)}) == 3


def test_a_function_that_changes_what_it_sees():
    """Its record must not stand for the next call: here every second one differs."""
    state = {"k": 1.0}

    def pde(u, x):
        state["k"] = 3.0 - state["k"]
        return js.laplacian(u)(x) - state["k"]

    assert [round(-8.0 * middle(pde)) for _ in range(6)] == [2, 1, 2, 1, 2, 1]


def test_a_record_owns_its_numbers():
    """A record of an array that was changed since stands for what it was, not for what has become of it."""
    k = np.ones(3)
    pde = lambda k: lambda u, x: js.laplacian(u)(x) - jnp.interp(x[0], np.linspace(0.0, 1.0, 3), k)
    assert middle(pde(k)) == pytest.approx(-0.125)
    k *= 2.0
    assert middle(pde(k)) == pytest.approx(-0.25)
    assert middle(pde(np.ones(3))) == pytest.approx(-0.125)


@jax.tree_util.register_pytree_node_class
class Material:
    """Parameters with a number that is no leaf."""

    def __init__(self, k, scale):
        self.k, self.scale = k, scale

    def tree_flatten(self):
        return (self.k,), self.scale

    @classmethod
    def tree_unflatten(cls, scale, leaves):
        return cls(*leaves, scale)


class Scale:
    value = 1.0


def test_parameters_with_more_than_numbers():
    """The static part of a pytree, compared by JAX by its identity, and the methods of its class."""
    scale = Scale()
    problem = js.Problem(
        lambda u, x, p: js.laplacian(u)(x) - p.k * p.scale.value, ENDS, params=Material(1.0, scale)
    )
    assert float(js.solve(problem, ROD).u[4]) == pytest.approx(-0.125)
    scale.value = 2.0
    assert float(js.solve(problem, ROD).u[4]) == pytest.approx(-0.25)


@pytest.mark.parametrize("method", ["S", "III"])
def test_the_profile_of_a_kernel(method, monkeypatch):
    """A global that it reads is changed: the solution is that of a kernel written so."""
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - jnp.sin(3.0 * x[0]), ENDS)
    solve = lambda kernel: js.solve(problem, ROD, kernel=kernel, method=method, depth=0).u
    kernel = js.Kernel(lambda r: (2.0 - r) ** FACTOR, 0.3, 2.0)
    before = solve(kernel)
    np.testing.assert_array_equal(before, solve(js.Kernel(lambda r: (2.0 - r) ** 2.0, 0.3, 2.0)))
    monkeypatch.setitem(globals(), "FACTOR", 4.0)
    np.testing.assert_array_equal(solve(kernel), solve(js.Kernel(lambda r: (2.0 - r) ** 4.0, 0.3, 2.0)))
    assert abs(solve(kernel) - before).max() > 1e-6
    assert kernel.recorded().as_written()._profile is kernel._profile
