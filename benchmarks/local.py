"""The local phase, microseconds a particle: ``python -m benchmarks.local``.

One small system for every particle: support, moments, weights, no neighbour search and no assembly. On one core, and
in pieces side by side on all of them, as it is solved; the same as the many kernels that XLA makes of it by itself; and
for a variable operator against its constant twin.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import jsmitsm as js
from benchmarks import machine
from benchmarks.commandline import arguments
from jsmitsm.discretization.coefficients import numbers
from jsmitsm.discretization.rows import all_rows
from jsmitsm.runtime import one_kernel
from jsmitsm.solution.arguments import discretized

DATA = Path(__file__).parent / "data" / "local.json"
REPEATS = 15
# Dimension, order, neighbours with the particle itself, particles along an axis.
CASES = ((2, 4, 20, 150), (2, 6, 28, 150), (2, 8, 36, 150), (3, 2, 20, 28), (3, 4, 50, 28))


def problem(dim: int, variable: bool) -> js.Problem:
    conductivity = lambda x: 1.5 + jnp.sin(2 * x[0] + x[1])
    source = lambda x: jnp.sin(x[0] + 2 * x[1])
    if variable:
        pde = lambda u, x: js.divergence(lambda y: conductivity(y) * js.grad(u)(y))(x) - source(x)
    else:
        pde = lambda u, x: js.laplacian(u)(x) - source(x)
    sides = ("left", "right", "bottom", "top", "front", "back")[: 2 * dim]
    return js.Problem(pde, dict.fromkeys(sides, js.dirichlet(0.0)))


def microseconds(dim: int, order: int, size: int, side: int, variable: bool, many: bool) -> float:
    """The least of the repeats, for one particle."""
    jax.config.update("jax_enable_x64", True)
    make = js.rectangle if dim == 2 else js.box
    cloud = make((0,) * dim, (1,) * dim, (side,) * dim, jitter=0.3)
    posed = problem(dim, variable)
    found = js.stencils(cloud, size=size)
    # A tie in one particle of thousands would make all stencils wider.
    exactly = replace(found, indices=found.indices[:, :size])
    disc = discretized(posed, cloud, "S", order, None, exactly)
    nums: Any = numbers(disc, posed)
    if many:
        one_kernel.available = lambda: False
    took = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        all_rows(disc, nums)
        took.append(time.perf_counter() - start)
    return 1e6 * min(took) / len(disc.active)


def apart(case: tuple[int, ...], cores: set[int], variable: bool = False, many: bool = False) -> float:
    """The same in a process of its own, whose threads have never known other cores."""
    mine = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)  # a process starts on the cores of its parent
    try:
        numbers = map(str, (*case, int(variable), int(many)))
        command = [sys.executable, "-m", "benchmarks.local", "--one", *numbers]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parent.parent)
    finally:
        os.sched_setaffinity(0, mine)
    return float(done.stdout.split()[-1])


def main() -> None:
    about, lines = machine.describe(), []
    every = os.sched_getaffinity(0)
    for case in CASES:
        here = {min(every)}
        one, variable, many = apart(case, here), apart(case, here, variable=True), apart(case, here, many=True)
        both, many_both = apart(case, every), apart(case, every, many=True)
        dim, order, size, _ = case
        cells = [f"{one:.3g}", f"{both:.3g}", f"{one / both:.2g}", f"{many:.3g}", f"{many_both:.3g}"]
        cells += [f"{variable:.3g}", f"{variable / one:.2g}"]
        lines.append([f"{dim}D", str(order), str(size), *cells])
        print(" | ".join(lines[-1]), flush=True)
    note = (
        f"Microseconds a particle, the least of {REPEATS} runs over some 20,000 particles, each column from a process "
        f"of its own, on {about['processor']} (`python -m benchmarks.local`)."
    )
    all_cores = f"{about['cores']} cores"
    columns = ["", "order", "neighbours", "one core", all_cores, "gain"]
    columns += ["many kernels, one core", f"many kernels, {all_cores}", "variable coefficients, one core", "ratio"]
    made = {"columns": columns, "rows": lines, "note": note}
    DATA.write_text(json.dumps({"machine": about, "tables": {"local": made}}, indent=1) + "\n")


if __name__ == "__main__":
    given = arguments(__doc__, "one", names="number")  # one of them: in a process of its own
    if given.one:
        *case, variable, many = map(int, given.names)
        print(microseconds(*case, bool(variable), bool(many)))
    else:
        main()
