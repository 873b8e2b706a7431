"""Clouds, operators and polynomials that the tests share."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import jsmitsm as js

METHODS = ("I", "II", "III", "S", "SSPH")
SIDES = {1: ("left", "right"), 2: ("left", "right", "bottom", "top"),
         3: ("left", "right", "bottom", "top", "front", "back")}  # fmt: skip


def jittered(dim: int, n: int, jitter: float = 0.25, seed: int = 1) -> js.Cloud:
    """A jittered lattice of n^dim particles on [0, 1]^dim, ``js.interval`` having no jitter of its own."""
    if dim == 2:
        return js.rectangle((0, 0), (1, 1), (n, n), jitter=jitter, seed=seed)
    if dim == 3:
        return js.box((0, 0, 0), (1, 1, 1), (n, n, n), jitter=jitter, seed=seed)
    x = np.linspace(0.0, 1.0, n)
    x[1:-1] += jitter * x[1] * np.random.default_rng(seed).uniform(-1, 1, n - 2)
    groups = {"interior": np.arange(1, n - 1), "left": [0], "right": [n - 1]}
    return js.Cloud(x[:, None], groups, np.concatenate([[-1.0], np.full(n - 2, np.nan), [1.0]])[:, None])


def polynomial(dim: int, order: int, seed: int = 3):
    """A function with every monomial of degree up to ``order``, none of them small."""
    rng = np.random.default_rng(seed)
    index = js.multi_indices(dim, order)
    coefs = rng.choice([-1.0, 1.0], len(index)) * rng.uniform(0.5, 1.5, len(index))

    def u(x):
        total = 0.0
        for c, a in zip(coefs, index):
            term = c
            for i, k in enumerate(a):
                term = term * (x[i] - 0.3) ** k
            total = total + term
        return total

    return u


def laplace(u, x):
    return js.laplacian(u)(x)


def variable(u, x):
    """div(a grad u) + b . grad u - c u: every kind of term, no coefficient constant."""
    a = lambda y: 1.0 + 0.3 * jnp.sin(jnp.sum(y)) + 0.2 * y[0]
    flux = lambda y: a(y) * js.grad(u)(y)
    return js.divergence(flux)(x) + (1.0 + x[0]) * js.partial(u, (1,) + (0,) * (len(x) - 1))(x) - jnp.exp(x[-1]) * u(x)


def with_source(operator, exact):
    """The residual whose solution is ``exact``: the same operator applied to the known function."""
    return lambda u, x: operator(u, x) - operator(exact, x)


def along(normal, f):
    return lambda x: jnp.dot(jnp.asarray(normal), js.grad(f)(x))


def conditions(dim: int, exact, kind: str) -> dict:
    """All sides Dirichlet, or the left one Neumann and the right one Robin, of a known function."""
    bcs = {name: js.dirichlet(exact) for name in SIDES[dim]}
    if kind != "dirichlet":
        unit = np.eye(dim)[0]
        bcs["left"] = js.neumann(along(-unit, exact))
    if kind == "mixed":
        slope = along(unit, exact)
        bcs["right"] = js.robin(2.0, 0.5, lambda x: 2.0 * exact(x) + 0.5 * slope(x))
    return bcs


def values(f, points) -> np.ndarray:
    """A function of one point at all points, on the host."""
    return np.array([float(f(x)) for x in np.asarray(points)])


def error(sol, exact) -> float:
    """Largest error relative to the largest value."""
    true = values(exact, sol.cloud.points)
    return float(np.abs(np.asarray(sol.u) - true).max() / np.abs(true).max())


def lattice_kernel(dim: int, n: int, reach: float = 3.9) -> js.Kernel:
    """The paper's kernel with a support of ``reach`` lattice spacings of an n^dim cloud on the unit cube."""
    return js.SuperGaussian(h=reach / 3.0 / (n - 1), d=3.0)
