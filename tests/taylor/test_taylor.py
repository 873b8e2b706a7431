"""Multi-indices, their tables, and the Taylor coefficients of plain functions."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsmitsm.taylor.jets import evaluate, taylor_coefficients
from jsmitsm.taylor.multi_indices import count, degree_of_count, factorial, index_of, multi_indices
from jsmitsm.taylor.series import Ring, add, div, mul, variable


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_multi_indices_are_graded_and_complete(dim):
    found = multi_indices(dim, 5)
    assert len(found) == len(set(found)) == math.comb(5 + dim, dim) == count(dim, 5)
    assert [sum(a) for a in found] == sorted(sum(a) for a in found)
    assert multi_indices(dim, 3) == found[: count(dim, 3)]
    assert all(index_of(dim, 5)[a] == i for i, a in enumerate(found))
    assert degree_of_count(dim, len(found)) == 5


def test_order_inside_a_degree():
    assert multi_indices(2, 2)[3:] == ((2, 0), (1, 1), (0, 2))
    assert multi_indices(3, 1) == ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    assert multi_indices(2, -1) == ()
    assert factorial((3, 0, 2)) == 12
    with pytest.raises(ValueError, match="dim"):
        multi_indices(0, 2)
    with pytest.raises(ValueError, match="not a number of Taylor coefficients"):
        degree_of_count(2, 5)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_product_is_the_truncated_cauchy_product(dim):
    """Against the sum over all pairs a + b = c, for factors of full and of lower degree."""
    rng = np.random.default_rng(0)
    for left, right in ((4, 4), (1, 4), (2, 1)):
        ring = Ring(dim, 4)
        x, y = rng.normal(size=(count(dim, left), 3)), rng.normal(size=(count(dim, right), 3))
        expected = np.zeros((count(dim, min(4, left + right)), 3))
        place = index_of(dim, 8)
        for a, u in zip(multi_indices(dim, left), x, strict=True):
            for b, v in zip(multi_indices(dim, right), y, strict=True):
                c = place[tuple(m + n for m, n in zip(a, b, strict=True))]
                if c < len(expected):
                    expected[c] += u * v
        assert np.allclose(mul(ring, x, y), expected, rtol=0, atol=1e-14)
        device = jax.jit(lambda x, y, ring=ring: mul(ring, x, y))(x, y)
        assert np.allclose(device, expected, rtol=0, atol=1e-14)


def test_division_undoes_multiplication():
    ring = Ring(2, 5)
    x = variable(np.array([[0.3, 0.4]]), 5)
    y = add(mul(ring, x[:, 0], x[:, 1]), np.full((1, 1), 2.0))
    back = mul(ring, div(ring, x[:, 0], y), y)
    assert np.allclose(back[:3], x[:, 0], atol=1e-15) and np.allclose(back[3:], 0, atol=1e-15)


J = jnp
S = jax.scipy.special
FUNCTIONS = {
    "polynomial": lambda x: x[0] ** 3 * x[1] - 2 * x[1] ** 2 + 1,
    "exp": lambda x: J.exp(x[0] * x[1]) + J.exp2(x[0] - x[1]) + J.expm1(x[1]),
    "rational": lambda x: (1 + x[0]) / (2 + x[1] * x[0]) + (2 + x[0]) ** -2,
    "circular": lambda x: J.sin(x[0] + 2 * x[1]) * J.cos(x[0] * x[1]) + J.tan(x[0] * 0.5 * x[1]),
    "hyperbolic": lambda x: J.sinh(x[0]) * J.cosh(x[1]) + J.tanh(x[0] + x[1]),
    "log": lambda x: J.log(1.5 + x[0] * x[1]) + J.log1p(0.5 * x[0]),
    "roots": lambda x: J.sqrt(1.5 + x[0] * x[1]) + J.cbrt(2 + x[0]) * jax.lax.rsqrt(3 + x[1]),
    "norm": lambda x: J.linalg.norm(x + 2) + J.hypot(1.5 + x[0], x[1]),
    "power": lambda x: (1.5 + x[0]) ** (x[1] + 0.3) + (2 + x[1]) ** 1.5,
    "whole power of zero": lambda x: (x[0] - x[0] + x[1] * 0) ** 3.0 + x[1] ** 4.0,
    "inverse circular": lambda x: J.arcsin(x[0] * x[1] * 0.5) + J.arccos(x[0] * 0.5) + J.arctan(x[1]),
    "inverse hyperbolic": lambda x: J.arcsinh(x[0]) + J.arctanh(0.3 * x[0]) + J.arccosh(3 + x[1]),
    "arctan2": lambda x: J.arctan2(x[1] + 2, x[0] - 1),
    "error functions": lambda x: S.erf(x[0]) * S.erfc(x[1]) + S.erfinv(0.4 * x[0]),
    "gamma": lambda x: S.gammaln(2 + x[0] * x[1]) + S.digamma(3 + x[0]) + S.gammainc(2.0, 1.5 + x[0]),
    "bessel": lambda x: S.i0(x[0] + 2) + S.i1(x[1] + 2),
    "kinks": lambda x: J.abs(x[0] - 0.11) * J.maximum(x[0], x[1]) + J.minimum(x[0], 0.1) + J.clip(x[1], -0.2, 0.3),
    "where": lambda x: J.where(x[0] > 0, J.sin(x[1]), x[0] * x[1]),
    "mod": lambda x: J.mod(3 * x[0], 1.0) * x[1] + J.floor(4 * x[0]) * x[1] + J.sign(x[0]) * x[0],
    "interp": lambda x: J.interp(x[0], J.linspace(-2, 2, 7), J.sin(J.arange(7.0))) * x[1],
    "lookup": lambda x: J.sin(J.arange(5.0))[(x[0] * 2 + 2).astype(int)] * x[1],
    "activations": lambda x: jax.nn.softplus(x[0] - x[1]) + jax.nn.silu(x[1]) + jax.nn.gelu(x[0]),
    "relu": lambda x: jax.nn.relu(x[0]) * x[1],
    "sinc": lambda x: J.sinc(x[0]),
    "xlogy": lambda x: S.xlogy(x[0] + 2, x[1] + 2),
    "solve": lambda x: J.linalg.solve(J.outer(x, x) + 2 * J.eye(2) + J.array([[0, 1], [0, 0]]) * x[0], J.sin(x)),
    "inverse": lambda x: J.linalg.inv(J.outer(J.append(x, 1.0), J.append(x, 2.0)) + J.diag(J.array([3, 2.0, 1]))),
    "det": lambda x: J.linalg.det(J.outer(J.append(x, x), J.append(x, J.exp(x))) + J.diag(J.array([3, 2.0, 1, 4]))),
    "cholesky": lambda x: J.linalg.cholesky(J.outer(x, x) + 2 * J.eye(2)),
    "eigenvalues": lambda x: J.linalg.eigvalsh(J.outer(x, x) + J.diag(J.array([1.0, 5.0]))),
    "network": lambda x: J.tanh(x @ J.sin(J.arange(32.0)).reshape(2, 16)) @ J.cos(J.arange(16.0)),
    "softmax": lambda x: jax.nn.softmax(3 * x) + jax.nn.logsumexp(x),
    "fori_loop": lambda x: jax.lax.fori_loop(0, 5, lambda i, s: s * x[0] + i, x[1]),
    "scan": lambda x: jax.lax.scan(lambda c, t: (c * x[0] + t, c), x[1], J.arange(4.0), reverse=True)[1],
    "while on x": lambda x: jax.lax.while_loop(lambda s: s < 2, lambda s: 2 * s + x[1] * 0.1, 1.7 + x[0]),
    "cond": lambda x: jax.lax.cond(x[0] > 0, J.sin, J.cos, x[1]),
    "switch": lambda x: jax.lax.switch((x[0] > 0).astype(int) + 1, [J.tan, J.sin, J.cos], x[1]),
    "reductions": lambda x: J.prod(1 + x) * J.max(x) * J.cumprod(x + 2)[1] * J.cumsum(x)[::-1][0] + J.min(x),
    "stacks": lambda x: J.stack([x, x**2], 1)[0] * J.unstack(x)[1] + J.hstack([x[:1], x[1:]]),
    "order": lambda x: J.sort(x) * J.arange(1, 3.0) + J.argmax(x),
    "update": lambda x: J.zeros(3).at[1].set(x[0]).at[2].add(x[1] ** 2),
    "pieces": lambda x: J.pad(J.roll(x, 1), (1, 2))[1:4] + J.concatenate([x, x[:1] ** 2]) + J.tile(x, 2)[::-1][:3],
    "contractions": lambda x: J.einsum("ij,jk,k->i", J.outer(x, x), J.ones((2, 2)), x) + J.kron(x, x)[:2],
    "update slice": lambda x: jax.lax.dynamic_update_slice(J.zeros(4), x, ((x[0] > 0).astype(int),)),
}


# Away from every kink and jump of the functions above, by more than the offsets below.
POINTS = np.array([[0.41, 0.63], [-0.45, 0.12], [0.18, -0.55], [-0.83, -0.37], [0.71, 0.85]])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_taylor_polynomial_of_a_function(name):
    """f(x + s) minus its Taylor polynomial of degree q falls like s^(q+1) along any line.

    A wrong coefficient of degree k <= q would leave a remainder that falls like s^k only.
    """
    f, degree = FUNCTIONS[name], 4
    points = POINTS
    got = taylor_coefficients(f, points, degree)
    assert isinstance(got, np.ndarray)
    exact = jax.jit(jax.vmap(f, out_axes=-1))
    assert np.allclose(got[0], exact(points), rtol=1e-13, atol=1e-13)
    indices = np.array(multi_indices(2, degree))
    for direction in ((1.0, 0.0), (-0.6, 0.8), (0.3, 0.9)):
        remainders = []
        for size in (0.02, 0.01):
            s = size * np.array(direction)
            polynomial = np.tensordot((s**indices).prod(1), got, 1)
            remainders.append(np.abs(np.asarray(exact(points + s)) - polynomial))
        # Halving s divides the remainder by 32; 1e-13 is round-off.
        assert np.all(remainders[1] <= remainders[0] / 25 + 1e-13), name


@pytest.mark.parametrize(
    "name",
    ["hyperbolic", "power", "where", "interp", "network", "activations", "cholesky", "fori_loop", "cond", "update"],
)
def test_compiled_rules_agree_with_numpy(name):
    points = POINTS
    host = taylor_coefficients(FUNCTIONS[name], points, 3)
    device = jax.jit(lambda p: taylor_coefficients(FUNCTIONS[name], p, 3))(points)
    assert np.allclose(host, device, rtol=1e-13, atol=1e-13)


def test_long_loops_stay_loops_when_compiled():
    """A loop of 300 steps: the program does not grow with it, the numbers agree."""
    points = np.array([[0.3, 0.9], [0.1, 0.2]])

    def f(x):
        s = jax.lax.fori_loop(0, 300, lambda i, s: s * x[0] + i, x[1])
        return s + jax.lax.while_loop(lambda t: t[0] < 300, lambda t: (t[0] + 1, t[1] * x[1]), (0, x[0]))[1]

    program = jax.jit(lambda p: taylor_coefficients(f, p, 2))
    assert len(program.lower(points).as_text()) < 200_000
    assert np.allclose(program(points), taylor_coefficients(f, points, 2), rtol=1e-12, atol=1e-12)


def test_one_and_three_dimensions():
    got = taylor_coefficients(lambda x: jnp.exp(2 * x[0]), np.zeros((1, 1)), 6)
    assert np.allclose(got[:, 0], [2**k / math.factorial(k) for k in range(7)], rtol=1e-15)
    got = taylor_coefficients(lambda x: jnp.exp(x.sum()), np.zeros((1, 3)), 4)
    assert np.allclose(got[:, 0], [1 / factorial(a) for a in multi_indices(3, 4)], rtol=1e-14)


def test_arguments_are_shared_by_all_points():
    points = np.array([[0.1], [0.2]])
    got = taylor_coefficients(lambda x, k: k["a"] * x[0] ** 2, points, 2, {"a": 3.0})
    assert np.allclose(got, [[0.03, 0.12], [0.6, 1.2], [3.0, 3.0]])


def test_gradient_with_respect_to_closed_over_values():
    """d/dk of the Taylor coefficients of exp(k x) at 0 is that of k^n / n!."""

    def total(k, points):
        return taylor_coefficients(lambda x: jnp.exp(k * x[0]), points, 3).sum()

    zero = jnp.zeros((1, 1))
    for derivative in (jax.grad, jax.jacfwd):
        assert np.allclose(derivative(total)(2.0, zero), 1 + 2.0 + 4.0 / 2)
    assert np.allclose(jax.hessian(total)(2.0, zero), 1 + 2.0)
    # d/dx at x = 0 multiplies by k.
    assert np.allclose(jax.grad(total, 1)(2.0, zero), 2 * total(2.0, zero))


def test_symbols_without_an_expansion_are_named():
    def f(x):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), x.dtype), x[0])

    with pytest.raises(ValueError, match="pure_callback"):
        taylor_coefficients(f, np.zeros((2, 2)), 2)


def test_no_warnings_from_singular_points(recwarn):
    got = taylor_coefficients(lambda x: jnp.sqrt(x[0]), np.zeros((1, 1)), 2)
    assert got[0, 0] == 0 and not np.isfinite(got[1:]).any() and not recwarn.list


def test_evaluate_prunes_what_is_not_wanted():
    closed = jax.make_jaxpr(lambda x: (jnp.sin(x[0]), jnp.cos(x[0])))(jax.ShapeDtypeStruct((1,), float))
    out = evaluate(closed.jaxpr, closed.consts, [variable(np.zeros((2, 1)), 3)], 1, 3, np, [0, 1])
    assert out[0] is None and out[1].shape == (1, 2)


@pytest.mark.parametrize("low, high, inner", [(2, 0, 0), (-1, 2, 0), (-2, -1, 0), (1, 1, 2), (-3, 4, 1), (-1, -2, 2)])
def test_padding_of_any_sign(low, high, inner):
    parts = lambda x: jnp.stack([x[0], x[0] * x[1], jnp.sin(x[1]), 2.0 + 0.0 * x[0], x[1] ** 2])
    padded = lambda x: jax.lax.pad(parts(x), jnp.asarray(7.0), [(low, high, inner)])
    points = np.random.default_rng(0).uniform(0.3, 0.9, (5, 2))
    found = taylor_coefficients(padded, points, 3)
    np.testing.assert_allclose(found[0], jax.vmap(padded)(points).T, rtol=1e-14)
    np.testing.assert_allclose(found[1], jax.vmap(jax.jacfwd(padded))(points)[..., 0].T, rtol=1e-13, atol=1e-15)
    compiled = jax.jit(lambda p: taylor_coefficients(padded, p, 3))(points)
    np.testing.assert_allclose(found, compiled, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("dim, left, right, degree", [(1, 5, 7, 9), (2, 6, 6, 6), (2, 3, 8, 10), (3, 4, 5, 6)])
def test_long_rows_are_multiplied_as_short_ones(dim, left, right, degree):
    rng = np.random.default_rng(1)
    x, y = (rng.normal(size=(count(dim, d), 700)) for d in (left, right))
    whole = mul(Ring(dim, degree), x, y)
    parts = [mul(Ring(dim, degree), x[:, k : k + 100], y[:, k : k + 100]) for k in range(0, 700, 100)]
    np.testing.assert_allclose(whole, np.concatenate(parts, axis=1), rtol=0, atol=1e-13)
