"""Whole programs under eager transformations, against the same functions in plain JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.runtime import whole_program
from jsmitsm.runtime.whole_program import called, in_one_program

X = {"x": np.array([0.3, -0.4, 1.2]), "scale": 1.5}
OPTIONS = (("xla_backend_optimization_level", 0),)


def plain(x, scale, index, power):
    """Results of several kinds: of everything, of the scale alone, of whole numbers."""
    return {"all": jnp.sin(scale * x[index]) ** power, "scale": scale**2, "index": index + 1}


INDEX = np.array([2, 0, 1])


def whole(x, scale, index=INDEX, power=3):
    return called(plain, {"power": power}, {"x": x, "scale": scale, "index": index}, OPTIONS)


@in_one_program
def on_host(x, scale):
    xp = jnp if any(isinstance(v, jax.core.Tracer) for v in (x, scale)) else np
    return {"all": xp.sin(scale * x[np.array([2, 0, 1])]) ** 3, "scale": scale**2 + 0.0 * x[0]}


def total(make):
    def f(t):
        made = make(t["x"], t["scale"])
        return jnp.sum(made["all"] * jnp.array([1.0, -2.0, 0.5])) * made["scale"]

    return f


SAME = total(lambda x, scale: plain(x, scale, np.array([2, 0, 1]), 3))
TRANSFORMS = {
    "value": lambda f: f(X),
    "grad": lambda f: jax.grad(f)(X),
    "jvp": lambda f: jax.jvp(f, (X,), ({"x": np.ones(3), "scale": 2.0},)),
    "of some": lambda f: jax.grad(lambda scale: f({**X, "scale": scale}))(1.5),
    "jacfwd": lambda f: jax.jacfwd(f)(X),
    "hessian": lambda f: jax.hessian(f)(X),
    "grad of grad": lambda f: jax.grad(lambda s: jax.grad(lambda x: f({**X, "scale": x}))(s) ** 2)(1.5),
    "vmap": lambda f: jax.vmap(lambda s: f({**X, "scale": s}))(jnp.arange(3.0)),
    "vmap of grad": lambda f: jax.vmap(jax.grad(lambda s: f({**X, "scale": s})))(jnp.arange(3.0)),
    "grad of vmap": lambda f: jax.grad(
        lambda x: jnp.sum(jax.vmap(lambda s: f({"x": x, "scale": s}))(jnp.arange(3.0))))(X["x"]),
    "jit": lambda f: jax.jit(f)(X),
    "jit of grad": lambda f: jax.jit(jax.grad(f))(X),
    "grad of jit": lambda f: jax.grad(jax.jit(f))(X),
    "grad of checkpoint": lambda f: jax.grad(jax.checkpoint(f))(X),
    "a vjp under jit": lambda f: jax.jit(jax.vjp(f, X)[1])(2.0),
    "a vjp in a loop": lambda f: jax.lax.map(lambda c: jax.vjp(f, X)[1](c), jnp.arange(2.0)),
    "a linear map under jit": lambda f: jax.jit(jax.linearize(f, X)[1])(X),
    "single precision": lambda f: jax.grad(f)(jax.tree.map(np.float32, X)),
}  # fmt: skip


@pytest.mark.parametrize("make", [whole, on_host])
@pytest.mark.parametrize("name", TRANSFORMS)
def test_every_transform(name, make):
    """Round-off only; in single precision 1e-7 times a few."""
    apply = TRANSFORMS[name]
    found, expected = apply(total(make)), apply(SAME)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected)):
        assert jnp.result_type(a) == jnp.result_type(b)
        assert np.allclose(a, b, rtol=1e-5 if name == "single precision" else 1e-13, atol=1e-13)


def test_derivatives_are_compiled_once_with_the_given_options(monkeypatch):
    made = []
    jit = jax.jit
    monkeypatch.setattr(jax, "jit", lambda f, **k: made.append((f.__name__, k.get("compiler_options"))) or jit(f, **k))
    fresh = lambda x, scale: jnp.cos(scale * x)
    f = lambda x, scale: jnp.sum(called(fresh, {}, {"x": x, "scale": scale}, OPTIONS))
    slopes = [jax.grad(f)(X["x"], scale) for scale in (1.0, 2.0)]
    assert np.allclose(slopes[1], -2.0 * np.sin(2.0 * X["x"]), rtol=1e-14)
    with_options = [name for name, options in made if options == dict(OPTIONS)]
    assert with_options == ["<lambda>", "moved_<lambda>", "pulled_moved_<lambda>"]


def test_a_result_that_does_not_move_has_no_derivative():
    """Otherwise what follows would be differentiated in vain."""
    arguments = {"index": np.array([0]), "scale": 1.5, "x": X["x"]}
    tree = jax.tree.structure(arguments)
    program = whole_program._whole(plain, (("power", 3),), tree, OPTIONS, False)
    result = program.result(whole_program._avals(arguments.values()))
    names = sorted(plain(*(arguments[k] for k in ("x", "scale", "index")), 3))
    reached = {name: [names[k] for k in result.reached([k])] for k, name in enumerate(arguments)}
    assert reached == {"index": ["all"], "scale": ["all", "scale"], "x": ["all"]}


def test_settings_of_the_moment_are_kept_apart():
    """A function that makes numbers of its own does so in the precision of the call."""
    f = lambda x: called(_ones, {}, {"x": x}, OPTIONS)["y"]
    x = np.ones(2, np.float32)
    wide = jax.jvp(f, (x,), (x,))[0]
    with jax.enable_x64(False):
        narrow = jax.jvp(f, (x,), (x,))[0]
    assert (wide.dtype, narrow.dtype) == (np.float64, np.float32)


def _ones(x):
    return {"y": x + jnp.arange(2, dtype=float)}


def test_without_jit_a_solve_goes_step_by_step():
    """As one debugs it: jax.disable_jit()."""
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - x[0], ends)
    cloud = js.interval(0.0, 1.0, 7)
    compiled = js.solve(problem, cloud, order=2).u
    with jax.disable_jit():
        np.testing.assert_allclose(js.solve(problem, cloud, order=2).u, compiled, rtol=1e-12)
