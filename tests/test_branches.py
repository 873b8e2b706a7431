"""Jumps that the operator differentiates are refused, whatever makes them; all other uses of branches are not."""

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest

import jsmitsm as js

ROD = js.interval(0.0, 1.0, 21)
ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
SQUARE = js.rectangle((0, 0), (1, 1), (11, 11), jitter=0.2)
SIDES = {side: js.dirichlet(lambda x: x[0]) for side in ("left", "right", "bottom", "top")}
TABLE, NODES = jnp.array([1.0, 1.0, 1.0, 5.0, 5.0, 5.0]), jnp.linspace(0.0, 1.0, 6)
at = 0.503  # no particle's place


def flux(k):
    """div(k grad u), with k a number or a tensor."""

    def pde(u, x):
        def conducted(y):
            a = k(y)
            return a @ js.grad(u)(y) if jnp.ndim(a) else a * js.grad(u)(y)

        return js.divergence(conducted)(x)

    return pde


def jump(y):
    return jnp.where(y[0] < at, 1.0, 100.0)


REFUSED = {
    "where": flux(jump),
    "by partials": lambda u, x: js.partial(lambda y: jump(y) * js.partial(u, 1)(y), 1)(x),
    "compiled": flux(jax.jit(jump)),
    "sign": flux(lambda y: 2.0 + jnp.sign(y[0] - at)),
    "heaviside": flux(lambda y: 1.0 + jnp.heaviside(y[0] - at, 0.5)),
    "truth as number": flux(lambda y: 1.0 + 9.0 * (y[0] > at)),
    "floor": flux(lambda y: 1.0 + jnp.floor(3 * y[0])),
    "round": flux(lambda y: 1.0 + jnp.round(2 * y[0])),
    "remainder": flux(lambda y: 1.0 + (3 * y[0]) % 1.0),
    "argmax": flux(lambda y: TABLE[3 * jnp.argmax(jnp.stack([y[0], at]))]),
    "gather": flux(lambda y: TABLE[jnp.clip((6 * y[0]).astype(int), 0, 5)]),
    "searchsorted": flux(lambda y: TABLE[jnp.searchsorted(NODES, y[0])]),
    "cond": flux(lambda y: jax.lax.cond(y[0] < at, lambda: 1.0, lambda: 100.0)),
    "switch": flux(lambda y: jax.lax.switch((3 * y[0]).astype(int), [lambda: 1.0, lambda: 7.0, lambda: 2.0])),
    "layers in a loop": flux(lambda y: jax.lax.fori_loop(0, 3, lambda i, a: a + (y[0] > 0.2 + 0.3 * i), 1.0)),
    "while": flux(lambda y: 1.0 + jax.lax.while_loop(lambda a: a < y[0], lambda a: a + 0.3, 0.0)),
    "nonlinear": lambda u, x: js.divergence(lambda y: jump(y) * (1.0 + u(y) ** 2) * js.grad(u)(y))(x),
    "kink twice": lambda u, x: js.laplacian(u)(x) - js.laplacian(lambda y: jnp.abs(y[0] - at))(x),
    "a source's potential": lambda u, x: js.laplacian(u)(x) - js.grad(jump)(x)[0],
    "jax.grad": lambda u, x: jax.grad(lambda y: jump(y) * js.grad(u)(y)[0])(x)[0],
    "jax.jacfwd": lambda u, x: jax.jacfwd(lambda y: jump(y) * js.grad(u)(y)[0])(x)[0],
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_differentiated_jump_is_refused_with_its_place_and_remedy(name):
    with pytest.raises(ValueError, match=r"^pde: .*test_branches.py, line \d+ .* jumps near x = .*js\.meant"):
        js.solve(js.Problem(REFUSED[name], ENDS), ROD)


@pytest.mark.parametrize(
    "k",
    [
        lambda y: jnp.where(y[1] < 0.47, jnp.eye(2), jnp.array([[2.0, 0.5], [0.5, 3.0]])),
        lambda y: jnp.where((y[0] - 0.5) ** 2 + (y[1] - 0.5) ** 2 < 0.1, 1.0, 50.0),
        lambda y: 4.0 + jnp.arctan2(y[1] - 0.53, y[0] - 0.53),
    ],
    ids=["tensor", "inclusion", "angle"],
)
def test_jumps_in_the_plane_are_refused(k):
    with pytest.raises(ValueError, match="jumps near x"):
        js.solve(js.Problem(flux(k), SIDES), SQUARE)


def test_a_jump_in_one_equation_of_a_system_is_refused():
    def pde(u, x):
        return jnp.stack([flux(jump)(u[0], x) + u[1](x), js.laplacian(u[1])(x)])

    with pytest.raises(ValueError, match="jumps near x"):
        js.solve(js.Problem(pde, ENDS, fields=2), ROD)


@pytest.mark.parametrize("k", [lambda v: jnp.where(v < 0.4, 1.0, 10.0), lambda v: TABLE[(5.99 * v).astype(int)]])
def test_a_jump_that_depends_on_u_is_refused_once_u_is_known(k):
    pde = lambda u, x: js.divergence(lambda y: k(jnp.clip(u(y), 0.0, 1.0)) * js.grad(u)(y))(x)  # noqa: E731
    with pytest.raises(ValueError, match="jumps near x"):
        js.solve(js.Problem(pde, ENDS), ROD)


def quotient(y):
    """sin(r) / r with its value at 0, as it is written safely."""
    r = jnp.where(y[0] > 0, y[0], 1.0)
    return jnp.where(y[0] > 0, jnp.sin(r) / r, 1.0)


def through(k):
    """The solution of (k u')' = 0 with u = 0, 1 at the ends: u = int 1/k / int_0^1 1/k, by a fine midpoint rule."""
    s = (np.arange(200_000) + 0.5) / 200_000
    total = np.concatenate([[0.0], np.cumsum(1.0 / np.asarray(jax.vmap(lambda z: k(z[None]))(s)))])
    return np.interp(np.asarray(ROD.points[:, 0]), np.linspace(0, 1, len(total)), total / total[-1])


# Coefficients, and how near the solution comes: a kink costs half a spacing's change of the slope, order h.
ACCEPTED = {
    "maximum": (lambda y: jnp.maximum(y[0], 0.3), 3e-2),
    "minimum": (lambda y: 1.0 + jnp.minimum(y[0], 0.3), 3e-2),
    "clip": (lambda y: jnp.clip(y[0], 0.3, 0.6), 3e-2),
    "abs": (lambda y: 1.0 + jnp.abs(y[0] - at), 3e-2),
    "relu": (lambda y: 1.0 + jax.nn.relu(y[0] - at), 3e-2),
    "comparison times zero": (lambda y: 1.0 + (y[0] > at) * (y[0] - at), 3e-2),
    "interp": (lambda y: jnp.interp(y[0], NODES, 1.0 + NODES**2), 3e-2),
    "one piece everywhere": (lambda y: jnp.where(y[0] < 2.0, 1.0 + y[0], 100.0), 1e-5),
    "safe division": (quotient, 1e-5),
    "smooth joint": (lambda y: jnp.where(y[0] < 0.5, 1 + y[0] ** 2, 0.75 + y[0] + (y[0] - 0.5) ** 2), 1e-5),
}


@pytest.mark.parametrize("name", ACCEPTED)
def test_legitimate_branches_are_solved(name):
    k, near = ACCEPTED[name]
    assert np.abs(js.solve(js.Problem(flux(k), ENDS), ROD).u - through(k)).max() < near


def test_jumps_that_no_operator_differentiates_are_data():
    """u'' = H(x - 1/2): u = x^2 pieces; the source may jump, a reaction and a flux given on a side too."""
    half = lambda x: jnp.where(x[0] < 0.5, 0.0, 1.0)  # noqa: E731
    zero = dict.fromkeys(ENDS, js.dirichlet(0.0))
    s = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - half(x), zero), ROD, order=2)
    x = np.asarray(ROD.points[:, 0])
    exact = np.maximum(x - 0.5, 0.0) ** 2 / 2 - x / 8
    assert np.abs(s.u - exact).max() < 1e-2  # the jump is placed to half a spacing: h / 8 of u
    js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - half(x) * u(x), ENDS), ROD)
    js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), {**SIDES, "top": js.neumann(half)}), SQUARE)


def test_a_jump_across_the_direction_of_the_derivative_is_none():
    """d/dx of where(y < 1/2, 1, 2) u: the coefficient does not change along x."""
    c = lambda y: jnp.where(y[1] < 0.47, 1.0, 2.0)  # noqa: E731
    pde = lambda u, x: js.laplacian(u)(x) + js.partial(lambda y: c(y) * u(y), (1, 0))(x) - c(x)  # noqa: E731
    assert np.abs(js.solve(js.Problem(pde, SIDES), SQUARE).u - SQUARE.points[:, 0]).max() < 1e-10


def test_the_users_own_derivatives_of_kinks_pass():
    for kink in (lambda y: jnp.maximum(y[0] - at, 0.0), lambda y: jnp.abs(y[0] - at)):
        for derive in (jax.grad, jax.jacfwd, jax.jacrev):
            slope = derive(kink)
            js.solve(js.Problem(lambda u, x, f=slope: js.laplacian(u)(x) - f(x)[0], ENDS), ROD)


@pytest.mark.parametrize("pde", [flux(js.meant(jump)), js.meant(flux(jump))], ids=["coefficient", "pde"])
def test_what_is_meant_is_solved(pde):
    """Each piece alone says u'' = 0."""
    assert np.abs(js.solve(js.Problem(pde, ENDS), ROD).u - ROD.points[:, 0]).max() < 1e-12


def test_meant_takes_a_function():
    with pytest.raises(ValueError, match="function: expected a function"):
        js.meant(1.0)


def parametrised(k, p):
    pde = lambda u, x, p: js.divergence(lambda y: k(y, p) * js.grad(u)(y))(x)  # noqa: E731
    return js.Problem(pde, ENDS, params=p)


def test_a_branch_on_parameters_alone_passes_and_is_differentiated():
    k = lambda y, p: jnp.where(p > 0, 1.0, 3.0) * (1.0 + p * y[0])  # noqa: E731
    middle = lambda p: js.solve(parametrised(k, p), ROD).u[10]  # noqa: E731
    exact = np.log(1.5) / np.log(2.0)
    assert abs(middle(1.0) - exact) < 1e-6 and abs(mm.quickly(middle)(1.0) - exact) < 1e-6


def test_under_jit_what_is_seen_decides_and_what_is_not_is_refused():
    table = lambda y, p: jnp.interp(y[0], NODES, p)  # noqa: E731
    values = 1.0 + NODES**2
    middle = lambda p: js.solve(parametrised(table, p), ROD).u[10]  # noqa: E731
    assert abs(mm.quickly(middle)(values) - middle(values)) < 1e-12
    inside = lambda p: js.solve(parametrised(lambda y, p: jnp.where(y[0] < p, 1.0, 3.0), p), ROD).u[10]  # noqa: E731
    with pytest.raises(ValueError, match="cannot be seen under jit"):
        mm.quickly(inside)(0.5)
    assert jax.grad(inside)(1.5) == 0.0  # outside of the cloud: one piece
    with pytest.raises(ValueError, match="jumps near x"):
        jax.grad(inside)(at)
