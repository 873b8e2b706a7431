"""Clouds, polynomials and conditions that the tests share; equations come from the table of problems."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks import scenes
from benchmarks.problems import SIDES
from jsmitsm.particle.batches import QUICKLY

METHODS = ("I", "II", "III", "S", "SSPH")
# For programs that run a few times only: compiling them takes longest.
quickly = partial(jax.jit, compiler_options=QUICKLY)


def jittered(dim: int, n: int, jitter: float = 0.25, seed: int = 1) -> js.Cloud:
    """A jittered lattice of n^dim particles on [0, 1]^dim."""
    return scenes.lattice((0.0,) * dim, (1.0,) * dim, n, jitter, seed)()


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


def along(normal, f):
    return lambda x: jnp.dot(jnp.asarray(normal), js.grad(f)(x))


def conditions(dim: int, exact, kind: str) -> dict:
    """All sides Dirichlet, or the left one Neumann and the right one Robin, of a known function."""
    bcs = {name: js.dirichlet(exact) for name in SIDES[: 2 * dim]}
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
