"""Programs compiled to one kernel: the same numbers, and none that the compiler cannot hold."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.runtime import one_kernel, whole_program

METHODS = ("I", "II", "III", "S", "SSPH")
needs_one_kernel = pytest.mark.skipif(not one_kernel.available(), reason="this JAX makes no single kernels")
X = np.array([0.3, -0.4, 1.2])


def run(function, **arguments):
    leaves, tree = jax.tree.flatten(arguments)
    program = whole_program._whole(function, (), tree, (), True)
    return program, program.run(*leaves)


def looped(x, unused):
    """A loop with a constant too large to be written into a kernel, and an argument that does nothing."""
    large = np.linspace(0.0, 1.0, 3000)
    return jax.lax.fori_loop(0, 3, lambda k, y: y * large[:3] + jnp.sum(large) * k, x), jnp.zeros((0, 3))


def squared(x, unused):
    return jax.lax.fori_loop(0, 3, lambda k, y: y * y + k, x), jnp.zeros((0, 3)), unused[:0]


@needs_one_kernel
@pytest.mark.parametrize("function", [looped, squared])
def test_constants_and_arguments_that_the_compiler_would_lose(function):
    # In a process of its own, which the compiler would end.
    source = f"""
import jax; jax.config.update("jax_enable_x64", True)
import numpy as np
from tests.runtime.test_onekernel import *
program, made = run({function.__name__}, x=X, unused=np.ones(7))
want = {function.__name__}(X, np.ones(7))
assert program.small
for a, b in zip(made, want, strict=True):
    np.testing.assert_allclose(a, b, rtol=1e-14)
"""
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr[-2000:]


@needs_one_kernel
def test_an_operation_that_no_kernel_holds_takes_many():
    program, made = run(lambda x: jnp.sort(x) + jnp.fft.fft(x).real, x=X)
    np.testing.assert_allclose(made, np.sort(X) + np.fft.fft(X).real, rtol=1e-14)
    assert not program.small


@needs_one_kernel
@pytest.mark.parametrize("side, method", [*((9, m) for m in METHODS), (50, "S"), (50, "II")])
def test_the_local_phase_is_one_kernel(method, side, monkeypatch, usual_effort):
    made = []

    class Kept(whole_program.Program):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            made.append(self)

    monkeypatch.setattr(whole_program, "Program", Kept)
    whole_program._whole.cache_clear()
    cloud = js.rectangle((0, 0), (1, 1), (side, side), jitter=0.2)
    posed = js.Problem(lambda u, x: js.laplacian(u)(x) - x[1], held(cloud, 0.0))
    js.solve(posed, cloud, method=method, order=2)
    assert any("rows" in p.name for p in made) and all(p.small for p in made if not p.on_host)


def held(cloud, value):
    return {g: js.dirichlet(value) for g in cloud.groups if g != "interior"}


@pytest.mark.parametrize("dim, method", [*((1, m) for m in METHODS), (2, "S"), (2, "I"), (3, "S")])
def test_one_kernel_gives_the_numbers_of_many(method, dim, monkeypatch, usual_effort):
    clouds = js.interval(0, 1, 30), js.rectangle((0, 0), (1, 1), (9, 9)), js.box((0, 0, 0), (1, 1, 1), (5, 5, 5))
    cloud = clouds[dim - 1]
    exact = lambda x: jnp.sin(jnp.sum(x)) + x[0] ** 2
    posed = js.Problem(
        lambda u, x: js.laplacian(u)(x) + u(x) - js.laplacian(exact)(x) - exact(x),
        held(cloud, exact),
    )
    one = js.solve(posed, cloud, method=method, order=2 if method != "S" else 4).u
    monkeypatch.setattr(one_kernel, "_TRIED", ())
    many = js.solve(posed, cloud, method=method, order=2 if method != "S" else 4).u
    np.testing.assert_allclose(one, many, rtol=1e-9, atol=1e-11)
