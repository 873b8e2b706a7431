"""From a residual in Python to its slots, its kind and the Taylor coefficients of its linearisation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm.equation.traced as trace_module
from jsmitsm.equation.field import local_field
from jsmitsm.equation.operators import divergence, grad, hessian, laplacian, partial
from jsmitsm.equation.tracing import trace
from jsmitsm.taylor.multi_indices import count, multi_indices

NU = 0.25


def a(x):
    return 2 + jnp.sin(x[0]) * x[1]


def stress(v):
    def sigma(y):
        g = grad(v)(y)
        return NU * jnp.trace(g) * jnp.eye(2) + g + g.T

    return sigma


def stokes(u, x):
    velocity, p = u[:2], u[2]
    momentum = -laplacian(velocity)(x) + grad(p)(x)
    return [momentum[0], momentum[1], divergence(velocity)(x)]


# name: (residual, fields), slots (derivatives only, for one field), order, linear, constant, source
LAPLACE = ((2, 0), (0, 2))
SECOND = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
TABLE = {
    "Laplace": (lambda u, x: laplacian(u)(x), LAPLACE, 2, True, True, "zero"),
    "Poisson": (lambda u, x: laplacian(u)(x) - x[0] ** 3, LAPLACE, 2, True, True, "variable"),
    "constant source": (lambda u, x: laplacian(u)(x) + 1, LAPLACE, 2, True, True, "constant"),
    "Helmholtz": (lambda u, x: laplacian(u)(x) + 4 * u(x), ((0, 0), *LAPLACE), 2, True, True, "zero"),
    "biharmonic": (lambda u, x: laplacian(laplacian(u))(x), ((4, 0), (2, 2), (0, 4)), 4, True, True, "zero"),
    "heat": (lambda u, x: partial(u, (0, 1))(x) - partial(u, (2, 0))(x), ((0, 1), (2, 0)), 2, True, True, "zero"),
    "field algebra": (
        lambda u, x: (2 * laplacian(u) - laplacian(u) - partial(u, (0, 2)) + 0 * u)(x),
        ((2, 0),), 2, True, True, "zero",
    ),
    "div(a grad u)": (
        lambda u, x: divergence(lambda y: a(y) * grad(u)(y))(x), ((1, 0), (0, 1), *LAPLACE), 2, True, False, "zero",
    ),
    "div(K grad u)": (
        lambda u, x: divergence(lambda y: jnp.array([[2.0, 1.0], [1.0, 3.0]]) @ grad(u)(y))(x),
        ((2, 0), (1, 1), (0, 2)), 2, True, True, "zero",
    ),
    "jax.hessian": (lambda u, x: jnp.trace(jax.hessian(u)(x)), LAPLACE, 2, True, True, "zero"),
    "jax.grad": (lambda u, x: jax.grad(lambda y: jax.grad(u)(y)[0])(x)[1], ((1, 1),), 2, True, True, "zero"),
    "hessian": (lambda u, x: jnp.sum(hessian(u)(x) * jnp.eye(2)), LAPLACE, 2, True, True, "zero"),
    "zero literal": (lambda u, x: laplacian(u)(x) + 0.0 * jnp.sin(u(x)), LAPLACE, 2, True, True, "zero"),
    "Burgers": (
        lambda u, x: u(x) * partial(u, (1, 0))(x) - partial(u, (0, 2))(x),
        ((0, 0), (1, 0), (0, 2)), 2, False, False, "zero",
    ),
    "Bratu": (lambda u, x: laplacian(u)(x) + jnp.exp(u(x)), ((0, 0), *LAPLACE), 2, False, False, "constant"),
    "minimal surface": (
        lambda u, x: divergence(lambda y: grad(u)(y) / jnp.sqrt(1 + grad(u)(y) @ grad(u)(y)))(x),
        SECOND, 2, False, False, "zero",
    ),
    "where(u)": (
        lambda u, x: laplacian(u)(x) + jnp.where(u(x) > 0, u(x), 0.0), ((0, 0), *LAPLACE), 2, False, False, "zero",
    ),
    "where(x)": (
        lambda u, x: laplacian(u)(x) + jnp.where(x[0] > 0, u(x), 0.0), ((0, 0), *LAPLACE), 2, True, False, "zero",
    ),
    "floor(u)": (lambda u, x: laplacian(u)(x) + jnp.floor(u(x)), ((0, 0), *LAPLACE), 2, False, False, "zero"),
    "frozen coefficient": (
        lambda u, x: jax.lax.stop_gradient(u(x)) * laplacian(u)(x), ((0, 0), *LAPLACE), 2, False, False, "zero",
    ),
    "abs(u)": (lambda u, x: laplacian(u)(x) + jnp.abs(u(x)), ((0, 0), *LAPLACE), 2, False, False, "zero"),
    "loop": (
        lambda u, x: laplacian(u)(x) + jax.lax.fori_loop(0, 3, lambda i, s: s + x[0] * u(x), 0.0),
        ((0, 0), *LAPLACE), 2, True, False, "zero",
    ),
    "branch": (
        lambda u, x: jax.lax.cond(x[0] > 0, lambda: laplacian(u)(x), lambda: u(x)),
        ((0, 0), *LAPLACE), 2, True, False, "zero",
    ),
    "jit": (lambda u, x: jax.jit(lambda y: a(y) * u(y))(x), ((0, 0),), 0, True, False, "zero"),
    "remat": (lambda u, x: jax.checkpoint(lambda y: jnp.sin(y[0]) * u(y))(x), ((0, 0),), 0, True, False, "zero"),
    "no field": (lambda u, x: x[0], (), -1, True, True, "variable"),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLE)
def test_classification(name):
    residual, slots, order, linear, constant, source = TABLE[name]
    got = trace(residual, 2)
    assert [index for _, index in got.slots] == sorted(slots, key=lambda b: (sum(b), tuple(-k for k in b)))
    assert (got.order, got.linear, got.constant, got.source) == ((order,), linear, constant, source)
    assert got.n_equations == 1 and got.pattern.shape == (1, len(slots)) and not got.uses_extras
    if name not in ("floor(u)", "frozen coefficient"):
        assert got.pattern.all()


def test_elasticity():
    """div sigma: each equation holds four of the six second derivatives."""
    got = trace(lambda v, x: divergence(stress(v))(x), 2, 2)
    assert got.linear and got.constant and got.source == "zero" and got.order == (2, 2)
    jac, res = got.coefficients(np.zeros((3, 2)), 2)
    assert res is None and jac.shape == (2, 6, 1, 1)
    table = {slot: jac[:, k, 0, 0] for k, slot in enumerate(got.slots)}
    assert np.allclose(table[0, (2, 0)], [NU + 2, 0]) and np.allclose(table[1, (1, 1)], [NU + 1, 0])
    assert np.allclose(table[1, (2, 0)], [0, 1]) and np.allclose(table[0, (0, 2)], [1, 0])
    assert np.array_equal(got.pattern, jac[..., 0, 0] != 0)


def test_stokes_has_an_order_per_equation():
    got = trace(stokes, 2, 3)
    assert got.order == (2, 2, 1) and got.constant
    assert got.slots[:4] == ((0, (1, 0)), (2, (1, 0)), (1, (0, 1)), (2, (0, 1)))
    assert got.pattern.sum(1).tolist() == [3, 3, 2]


def test_extras_and_params():
    got = trace(lambda u, x, n: n @ grad(u)(x), 2, extras=((2,),))
    assert got.linear and not got.constant and got.uses_extras and got.order == (1,)
    normals = np.random.default_rng(0).normal(size=(4, 2))
    jac, _ = got.coefficients(np.zeros((4, 2)), 1, extras=(normals,))
    assert np.allclose(jac[0, :, 0], normals.T) and not jac[0, :, 1:].any()
    got = trace(lambda u, x, g, p: u(x) - p["k"] * g, 2, extras=((),), params={"k": 3.0})
    assert got.constant and got.source == "variable" and got.uses_extras
    _, res = got.coefficients(np.zeros((2, 2)), 0, extras=(np.array([1.0, 2.0]),), params={"k": 3.0})
    assert np.allclose(res, [[[-3.0, -6.0]]])
    got = trace(lambda u, x, p: p["k"] * laplacian(u)(x) - p["f"], 2, params={"k": 1.0, "f": 2.0})
    assert got.constant and got.source == "constant"
    got = trace(lambda u, x, p: laplacian(p * laplacian(u))(x), 2, params=2.0)
    assert got.constant and got.order == (4,)


def test_variable_coefficients_match_nested_derivatives():
    """div(a grad u) = a lap u + grad a . grad u."""
    points = np.random.default_rng(1).uniform(size=(5, 2))
    got = trace(lambda u, x: divergence(lambda y: a(y) * grad(u)(y))(x) - jnp.cos(x[1]), 2)
    jac, res = got.coefficients(points, 3)
    assert jac.shape == (1, 4, 10, 5) and isinstance(jac, np.ndarray)
    x, y = points.T
    zero = np.zeros(5)
    # a = 2 + y sin x and its derivative in x, expanded by hand.
    series_a = [2 + y * np.sin(x), y * np.cos(x), np.sin(x), -y * np.sin(x) / 2, np.cos(x), zero,
                -y * np.cos(x) / 6, -np.sin(x) / 2, zero, zero]  # fmt: skip
    series_ax = [y * np.cos(x), -y * np.sin(x), np.cos(x), -y * np.cos(x) / 2, -np.sin(x), zero,
                 y * np.sin(x) / 6, -np.cos(x) / 2, zero, zero]  # fmt: skip
    assert np.allclose(jac[0, got.slots.index((0, (2, 0)))], series_a, atol=1e-15)
    assert np.allclose(jac[0, got.slots.index((0, (0, 2)))], series_a, atol=1e-15)
    assert np.allclose(jac[0, got.slots.index((0, (1, 0)))], series_ax, atol=1e-15)
    assert np.allclose(res[0, 0], -np.cos(y)) and np.allclose(res[0, 2], np.sin(y))


def test_nonlinear_linearisation():
    """Of u u_x - u_yy at u = sin(x) y: coefficients u_x, u, -1, residual u u_x."""
    points = np.random.default_rng(1).uniform(size=(4, 2))
    got = trace(lambda u, x: u(x) * partial(u, (1, 0))(x) - partial(u, (0, 2))(x), 2)
    from jsmitsm.taylor.jets import taylor_coefficients

    def series(f):
        return taylor_coefficients(f, points, 3)

    u, ux = series(lambda x: jnp.sin(x[0]) * x[1]), series(lambda x: jnp.cos(x[0]) * x[1])
    slots = np.stack([{(0, 0): u, (1, 0): ux, (0, 2): 0 * u}[index] for _, index in got.slots])
    jac, res = got.coefficients(points, 3, slots=slots)
    assert np.allclose(jac[0, got.slots.index((0, (0, 0)))], ux)
    assert np.allclose(jac[0, got.slots.index((0, (1, 0)))], u)
    assert np.allclose(jac[0, got.slots.index((0, (0, 2)))], [[-1.0] * 4] + [[0.0] * 4] * 9)
    assert np.allclose(res[0], series(lambda x: jnp.sin(x[0]) * jnp.cos(x[0]) * x[1] ** 2), atol=1e-15)
    compiled = jax.jit(lambda p, s: got.coefficients(p, 3, slots=s))(points, slots)
    assert np.allclose(jac, compiled[0], atol=1e-14) and np.allclose(res, compiled[1], atol=1e-14)


def test_large_clouds_are_cut_into_chunks(monkeypatch):
    points = np.random.default_rng(1).uniform(size=(23, 2))
    got = trace(lambda u, x: a(x) * u(x) - jnp.exp(x[0]), 2)
    whole = got.coefficients(points, 2)
    monkeypatch.setattr(trace_module, "CHUNK", 5)
    monkeypatch.setattr(trace_module, "LEAST", 5)
    for one, other in zip(whole, got.coefficients(points, 2), strict=True):
        assert np.array_equal(one, other)


def test_one_and_three_dimensions():
    got = trace(lambda u, x: partial(u, 2)(x) + jnp.sin(x[0]) * grad(u)(x)[0], 1)
    assert got.slots == ((0, (1,)), (0, (2,))) and got.coefficients(np.zeros((2, 1)), 4)[0].shape == (1, 2, 5, 2)
    got = trace(lambda u, x: laplacian(u)(x), 3)
    assert got.slots == ((0, (2, 0, 0)), (0, (0, 2, 0)), (0, (0, 0, 2)))


def test_operators_on_plain_functions():
    x = jnp.array([0.3, 0.7])

    def f(y):
        return y[0] ** 3 * jnp.sin(y[1])

    assert np.allclose(grad(f)(x), jax.grad(f)(x)) and np.allclose(hessian(f)(x), jax.hessian(f)(x))
    assert np.allclose(laplacian(f)(x), jnp.trace(jax.hessian(f)(x)))
    assert np.allclose(partial(f, (2, 1))(x), 6 * x[0] * jnp.cos(x[1]))
    assert np.allclose(divergence(lambda y: [y[0] ** 2, y[0] * y[1]])(x), 3 * x[0])
    assert np.allclose(divergence(lambda y: jnp.outer(y, y))(x), 3 * x)
    assert np.allclose(grad(lambda y: jnp.outer(y, y)[0])(x), [[2 * x[0], 0], [x[1], x[0]]])


def test_fields_of_a_system():
    u = local_field(2, 3)
    assert len(u) == 3 and u.shape == (3,) and [f.terms for f in u] == [u[k].terms for k in range(3)]
    assert grad(u).shape == (3, 2) and hessian(u).shape == (3, 2, 2) and divergence(grad(u)).shape == (3,)
    assert laplacian(u)[1].terms == divergence(grad(u[1])).terms
    assert (grad(u[0])[0] - partial(u[0], (1, 0))).terms == {}
    assert sum([u[0], u[1]]).terms == (u[0] + u[1]).terms and (-u / 2)[0].terms == (u[0] * -0.5).terms


def count_compilations():
    return trace_module.COMPILATIONS


def test_a_fresh_lambda_does_not_compile_again():
    points = np.random.default_rng(1).uniform(size=(6, 2))

    def total(k, scale):
        got = trace(lambda u, x: jnp.sin(k * x[0]) * laplacian(u)(x) - scale * jax.nn.softplus(x[1]), 2)
        jac, res = got.coefficients(points, 2)
        return jnp.sum(jac**2) + jnp.sum(res**2)

    jax.grad(total)(1.0, jnp.array(2.0))
    before = count_compilations()
    first, second = jax.grad(total)(1.5, jnp.array(2.0)), jax.grad(total)(1.7, jnp.array(3.0))
    assert count_compilations() == before and first != second


def test_nothing_is_compiled_for_concrete_data(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("jax.jit was called")

    got = trace(lambda u, x: a(x) * laplacian(u)(x) - jnp.exp(x[0]) / (2 + x[1]), 2)
    monkeypatch.setattr(jax, "jit", refuse)
    got.coefficients(np.random.default_rng(1).uniform(size=(6, 2)), 3)


def test_a_coefficient_that_rests_on_nothing_traced_stays_on_the_host():
    kinds = []

    def total(k):
        got = trace(lambda u, x: laplacian(u)(x) - k * x[0], 2)
        jac, res = got.coefficients(np.zeros((2, 2)), 1)
        kinds.append((type(jac), isinstance(res, jax.core.Tracer)))
        return res.sum()

    jax.grad(total)(2.0)
    assert kinds == [(np.ndarray, True)]


def central(function, at, step=1e-6):
    """Central differences of a scalar function of an array."""
    at = np.asarray(at, float)
    out = np.zeros(at.shape)
    for k in np.ndindex(at.shape):
        shift = np.zeros(at.shape)
        shift[k] = step
        out[k] = (function(at + shift) - function(at - shift)) / (2 * step)
    return out


def weighted(pair):
    """A scalar that every coefficient enters with a weight of its own."""
    parts = [jnp.ravel(p) for p in pair if p is not None]
    return sum(jnp.sum(p * jnp.cos(jnp.arange(p.size) + k)) for k, p in enumerate(parts))


def test_gradients_match_differences():
    """With respect to closed-over values, parameters, points and slots; 1e-6 steps leave about 1e-9."""
    points = np.random.default_rng(1).uniform(0.2, 1, size=(3, 2))
    slots = np.random.default_rng(2).normal(size=(2, count(2, 2), 3))

    def total(k, params, points, slots):
        def pde(u, x, p):
            return a(k * x) * laplacian(u)(x) * u(x) + p["q"] * u(x) ** 3 - jnp.sqrt(x[0])

        got = trace(pde, 2, params=params)
        full = jnp.concatenate([slots, slots[:1]])
        return weighted(got.coefficients(points, 2, params=params, slots=full))

    args = (1.3, {"q": 0.7}, points, slots)
    got = jax.grad(total, (0, 1, 2, 3))(*args)
    forward = jax.jacfwd(total)(*args)
    assert np.allclose(got[0], forward, rtol=1e-12)
    tolerance = {"rtol": 1e-6, "atol": 1e-7}
    assert np.allclose(got[0], central(lambda k: total(float(k), *args[1:]), 1.3), **tolerance)
    assert np.allclose(got[1]["q"], central(lambda q: total(1.3, {"q": float(q)}, points, slots), 0.7), **tolerance)
    assert np.allclose(got[2], central(lambda p: total(1.3, args[1], p, slots), points), **tolerance)
    assert np.allclose(got[3], central(lambda s: total(1.3, args[1], points, s), slots), **tolerance)


def test_under_vmap_and_jit():
    points = np.random.default_rng(1).uniform(size=(3, 2))

    def total(k):
        return weighted(trace(lambda u, x: jnp.exp(k * x[0]) * u(x) - k, 2).coefficients(points, 2))

    ks = jnp.array([0.5, 1.0])
    assert np.allclose(jax.jit(jax.vmap(total))(ks), [total(0.5), total(1.0)], rtol=1e-12)


@pytest.mark.parametrize(
    ("residual", "message"),
    [
        (lambda u, x: u(2 * x), "at a point other than x"),
        (lambda u, x: u(jnp.zeros(2)), "at a point other than x"),
        (lambda u, x: u(x[::-1]), "at a point other than x"),
        (lambda u, x: grad(lambda y: u(y + 1))(x)[0], "at a point other than x"),
        (lambda u, x: jax.vmap(u)(jnp.stack([x, x])).sum(), "batch of points"),
        (lambda u, x: divergence(a(x) * grad(u))(x), "factor that depends on x"),
        (lambda u, x: laplacian(u), "is a field, not its value"),
        (lambda u, x: [u, u], "holds a field"),
        (lambda u, x: grad(u)(x)[None], r"shape \(1, 2\)"),
        (lambda u, x: None, "returned None"),
        (lambda u, x: u(x) * 1j, "must be real"),
        (lambda u, x: u(x[:1]), r"shape \(2,\), got shape \(1,\)"),
        (lambda u, x: divergence(lambda y: grad(u)(y)[:1])(x), "2 components"),
        (lambda u, x: divergence(u)(x), "did you mean grad"),
        (lambda u, x: partial(u, (1,))(x), "multi_index must be 2"),
        (lambda u, x: grad(u(x))(x)[0], "not js.grad"),
    ],
)
def test_mistakes_are_named(residual, message):
    with pytest.raises(ValueError, match=message):
        trace(residual, 2)


def test_a_field_is_not_a_number():
    u = local_field(2)
    with pytest.raises(TypeError, match="evaluate it at the point first"):
        laplacian(u) - jnp.ones(2)
    with pytest.raises(ValueError, match="only inside a pde"):
        u(jnp.zeros(2))


def test_wrong_shapes_are_named():
    got = trace(lambda u, x, n, p: n @ grad(u)(x) - p, 2, extras=((2,),), params=jnp.zeros(()))
    points, normals = np.zeros((3, 2)), np.zeros((3, 2))
    good = {"extras": (normals,), "params": 1.0}
    got.coefficients(points, 1, **good)
    for bad, message in (
        ((np.zeros((3, 3)), good), "points must have shape"),
        ((points, {**good, "extras": ()}), "extras must be 1"),
        ((points, {**good, "extras": (np.zeros((3, 3)),)}), r"extras\[0\]"),
        ((points, {**good, "params": {"k": 1.0}}), "structure"),
        ((points, {**good, "params": np.zeros(2)}), "leaf of params"),
        ((points, {**good, "slots": np.zeros((1, 3, 3))}), "slots must have shape"),
    ):
        with pytest.raises(ValueError, match=message):
            got.coefficients(bad[0], 1, **bad[1])


def test_integer_slots_order_is_that_of_multi_indices():
    got = trace(lambda u, x: sum(partial(u, b)(x) for b in reversed(multi_indices(2, 3))), 2)
    assert tuple(index for _, index in got.slots) == multi_indices(2, 3)
