"""What a scene does not need, with and without: ``python -m benchmarks.skipping``.

Each line measures the same problem twice in one run, by turns: as the package solves it, and with one thing done that
it left out. Seconds are medians of repeats after a first call that compiles.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks import machine
from benchmarks.commandline import arguments
from jsmitsm.discretization import repeated_stencils, rows
from jsmitsm.discretization.coefficients import numbers
from jsmitsm.discretization.layout import discretize, sorted_classes
from jsmitsm.discretization.rows import all_rows
from jsmitsm.linear import linsolve
from jsmitsm.solution.arguments import discretized
from jsmitsm.taylor.multi_indices import count

DATA = Path(__file__).parent / "data" / "skipping.json"
REPEATS = 9
SIDES = ("left", "right", "bottom", "top")
SPACING = 0.01


def wave(x: Any) -> Any:
    return jnp.sin(2 * x[0] + 1) * jnp.cos(3 * x[1])


def poisson(scale: float = 1.0) -> js.Problem:
    """With a source and boundary values of this size; a fresh lambda each time."""
    exact = lambda x: scale * wave(x)
    pde = lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x)
    return js.Problem(pde, dict.fromkeys(SIDES, js.dirichlet(exact)))


def laplace() -> js.Problem:
    harmonic = js.dirichlet(lambda x: jnp.exp(x[0]) * jnp.sin(x[1]))
    return js.Problem(lambda u, x: js.laplacian(u)(x), dict.fromkeys(SIDES, harmonic))


def conducting() -> js.Problem:
    """A variable conductivity, and no source."""
    conductivity = lambda x: 1.5 + jnp.sin(2 * x[0] + x[1])
    pde = lambda u, x: js.divergence(lambda y: conductivity(y) * js.grad(u)(y))(x)
    return js.Problem(pde, dict.fromkeys(SIDES, js.dirichlet(lambda x: x[0])))


def scattered(k: int, side: int = 100) -> js.Cloud:
    """Ten thousand jittered particles; another trifle for every k."""
    cloud = js.rectangle((0, 0), (1, 1), (side, side), jitter=0.3)
    return js.Cloud(np.asarray(cloud.points) * (1.0 + 1e-12 * k), cloud.groups, cloud.normals)


def lattice(k: int) -> js.Cloud:
    cloud = js.rectangle((0, 0), (1, 1), (100, 100))
    return js.Cloud(np.asarray(cloud.points) * (1.0 + 1e-13 * k), cloud.groups, cloud.normals)


def both(without: Callable[[int], Any], with_it: Callable[[int], Any]) -> tuple[float, float]:
    """The medians of both after their first calls, which compile; by turns, for the machine has slow minutes."""
    took: tuple[list[float], list[float]] = [], []
    for k in range(REPEATS + 1):
        for run, seconds in zip((without, with_it), took):
            start = time.perf_counter()
            jax.block_until_ready(run(k))
            seconds.append(time.perf_counter() - start)
    return float(np.median(took[0][1:])), float(np.median(took[1][1:]))


def local(
    problem: Callable[[], js.Problem], cloud: Callable[[int], js.Cloud], order: int, **options: Any
) -> Callable[[int], Any]:
    """The local phase alone."""
    ready = {}

    def run(k: int) -> Any:
        return _weights(*ready[k])

    for k in range(REPEATS + 1):
        disc = discretize(problem(), cloud(k), "S", order, None, None, None, **options)
        ready[k] = disc, numbers(disc, problem())
    return run


def patched(run: Callable[[int], Any], *patches: Any) -> Callable[[int], Any]:
    def other(k: int) -> Any:
        with ExitStack() as stack:
            for patch in patches:
                stack.enter_context(patch)
            return run(k)

    return other


def lines() -> Iterator[tuple[str, str, float, float]]:
    """(what is left out, where it was measured, seconds without it, seconds with it)."""
    order = 6
    yield "recursion of a constant operator for every particle", "local phase", *both(
        local(laplace, scattered, order),
        patched(_for_each(order), mock.patch.object(rows, "shared_elimination", lambda *a: None)))
    yield "kernel derivatives (S needs none)", "local phase, III against S in one kernel", *both(
        _rows_of("S"), _rows_of("III"))
    yield "weights of a source that is zero", "local phase, variable coefficients", *both(
        local(conducting, scattered, order, sources=False), local(conducting, scattered, order))
    never_repeated = mock.patch.object(repeated_stencils, "FEWEST", 10**9)
    yield "moment systems of repeated stencils", "local phase on a lattice, order 8", *both(
        local(poisson, lattice, 8), patched(local(poisson, lattice, 8), never_repeated))
    yield "rows of Dirichlet particles", *_held_rows()

    def solve(k: int) -> Any:
        linsolve.clear_cache()
        return js.solve(poisson(), scattered(k), order=order)

    yield "Taylor coefficients of all particles", "solve", *both(
        lambda k: solve(k).u, lambda k: solve(k).coefficients)
    yield "error estimate", "solve", *both(lambda k: solve(k).u, lambda k: solve(k).error_estimate())
    yield "what a gradient with respect to h needs", "solve at a given kernel and stencils", *_gradient()
    ready = js.factorize(poisson(), scattered(0), order=order)
    yield "neighbours, rows and factors, when only data changed", "js.factorize against solve", *both(
        lambda k: ready.solve(poisson(1.0 + k)).u, lambda k: solve(k).u)
    kept = _kept_factor()
    yield "the factorisation, when only a value on the boundary changed", "solve of the same cloud again", *kept
    yield "neighbours and the order of elimination, when only the kernel changed", "solve at a given kernel", *_kernel()
    yield "compiling for another cloud of similar size", "solve, 9,801 particles after 10,000", *_compiled_again()


def _for_each(order: int) -> Callable[[int], Any]:
    """The local phase as if the operator's coefficients varied."""
    disc = discretized(laplace(), scattered(0), "S", order)
    nums = numbers(disc, laplace())
    nums.jac = np.broadcast_to(nums.jac, (*nums.jac.shape[:2], 1, len(nums.ids)))
    slopes = np.zeros((*nums.jac.shape[:2], count(2, disc.rec.degree) - 1, len(nums.ids)))
    nums.jac = np.concatenate([nums.jac, slopes], 2)
    return lambda k: _weights(disc, nums)


def _held_rows() -> tuple[str, float, float]:
    """In a box, a quarter of whose particles are on its sides."""
    cloud = js.box((0, 0, 0), (1, 1, 1), (24, 24, 24), jitter=0.3)
    posed = js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, dict.fromkeys(
        (*SIDES, "front", "back"), js.dirichlet(0.0)))  # fmt: skip
    disc, every = (discretized(posed, cloud, "S", 4) for _ in range(2))
    every.classes = sorted_classes(every, np.arange(len(cloud)), every.stencils)
    nums = numbers(disc, posed)
    where = f"local phase, {len(cloud) - len(disc.active)} of {len(cloud)} particles"
    return where, *both(lambda k: _weights(disc, nums), lambda k: _weights(every, nums))


def _weights(disc: Any, nums: Any) -> Any:
    return [row.weights for row in all_rows(disc, nums)[1]]


def _rows_of(method: str) -> Callable[[int], Any]:
    cloud = scattered(0)
    kernel = js.Gaussian(h=2.0 * SPACING, d=2.0)
    disc = discretized(laplace(), cloud, method, 4, kernel)
    nums = numbers(disc, laplace())
    return lambda k: _weights(disc, nums)


def _kernel_problem() -> tuple[Callable[[Any], Any], float]:
    """The mean square of the solution as a function of the smoothing length, and a length."""
    cloud, problem = scattered(0), poisson()
    near = js.stencils(cloud, radius=4.4 * SPACING)

    def mean(h: Any) -> Any:
        return jnp.mean(js.solve(problem, cloud, kernel=js.Gaussian(h=h, d=2.0), stencils=near, order=4).u ** 2)

    return mean, 2.0 * SPACING


def _gradient() -> tuple[float, float]:
    mean, h = _kernel_problem()
    # No length comes twice: a factor would be at hand.
    return both(lambda k: mean(h * (1 + 1e-9 * k)), lambda k: jax.value_and_grad(mean)(h * (1 - 1e-9 * (k + 1))))


def _kernel() -> tuple[float, float]:
    mean, h = _kernel_problem()

    def anew(k: int) -> Any:
        linsolve.clear_cache()
        return js.solve(poisson(), scattered(0), kernel=js.Gaussian(h=h * (1 - 1e-9 * (k + 1)), d=2.0), order=4).u

    # One after the other: what forgets everything must not come between.
    kept, _ = both(lambda k: mean(h * (1 + 1e-9 * k)), lambda k: None)
    return kept, both(anew, lambda k: None)[0]


def _kept_factor() -> tuple[float, float]:
    cloud = scattered(99)  # no other line's

    def solved(k: int, forget: bool) -> Any:
        if forget:
            linsolve.clear_cache()
        return js.solve(poisson(1.0 + k), cloud, order=6).u

    return both(lambda k: solved(k, False), lambda k: solved(k, True))


def _compiled_again() -> tuple[float, float]:
    first = js.solve(poisson(), scattered(0), order=6).u
    jax.block_until_ready(first)
    took = []
    for forget in (False, True):
        if forget:
            jax.clear_caches()
        start = time.perf_counter()
        jax.block_until_ready(js.solve(poisson(2.0), scattered(1, 99), order=6).u)
        took.append(time.perf_counter() - start)
    return took[0], took[1]


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    about, found = machine.describe(), []
    for what, where, without, with_it in lines():
        found.append([what, where, f"{1e3 * without:.3g}", f"{1e3 * with_it:.3g}", f"{with_it / without:.2g}"])
        print(" | ".join(found[-1]), flush=True)
    note = (
        f"Milliseconds, medians of {REPEATS}, ten thousand particles (more in the box), on {about['cores']} cores of "
        f"{about['processor']} (`python -m benchmarks.skipping`)."
    )
    made = {"columns": ["what is left out", "measured in", "without", "with", "ratio"], "rows": found, "note": note}
    DATA.write_text(json.dumps({"machine": about, "tables": {"skipping": made}}, indent=1) + "\n")


if __name__ == "__main__":
    arguments(__doc__)
    main()
