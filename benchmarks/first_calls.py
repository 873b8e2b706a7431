"""What first calls of every kind cost, in seconds of CPU: ``python -m benchmarks.first_calls``.

One fresh process without a cache on disk makes them one after another, as a script would: what one has compiled serves
the next. Each is made once more with other numbers, on another cloud of the same size. Seconds of CPU, of all threads
together, hardly depend on what else a machine does; the least of some runs counts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from benchmarks import machine
from benchmarks.commandline import arguments

DATA = Path(__file__).parent / "data" / "first_calls.json"
REPEATS = 2
SCRIPT = """
import json, time
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import jsmitsm as js

clouds = [js.rectangle((0, 0), (1, 1), (32, 32), jitter=0.3, seed=k) for k in (1, 2)]
held = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
linear = js.Problem(lambda u, x, p: js.laplacian(u)(x) + p * jnp.exp(x[0]), held, params=1.0)
quasi = js.Problem(
    lambda u, x, p: js.divergence(lambda y: (1.0 + u(y) ** 2) * js.grad(u)(y))(x) + p, held, params=1.0
)
heat = js.Problem(lambda u, x, t, p: js.dt(u)(x) - p * js.laplacian(u)(x), held, params=1.0)
drum = js.Problem(lambda u, x, p: -p * js.laplacian(u)(x), held, params=1.0)
bump = lambda x: jnp.sin(jnp.pi * x[0]) * jnp.sin(jnp.pi * x[1])
solved = {}


def solve(cloud, p):
    solved[p] = js.solve(linear.replace(params=p), cloud)


calls = {
    "a linear solve": solve,
    "its error estimate": lambda cloud, p: solved[p].error_estimate(),
    "values between the particles": lambda cloud, p: solved[p](cloud.points[:50] + 1e-3),
    "a gradient by a parameter": lambda cloud, p: jax.grad(
        lambda q: (js.solve(linear.replace(params=q), cloud).u ** 2).sum())(p),
    "a nonlinear solve": lambda cloud, p: js.solve(quasi.replace(params=p), cloud),
    "six modes": lambda cloud, p: js.eigen(drum.replace(params=p), cloud, 6, order=4).values,
    "twenty steps in time": lambda cloud, p: js.evolve(heat.replace(params=p), cloud, bump, t=(0.0, 0.1), steps=20).u,
}
for name, call in calls.items():
    spent = []
    for cloud, p in zip(clouds, (1.0, 1.1)):
        start = time.process_time()
        jax.block_until_ready(call(cloud, p))
        spent.append(time.process_time() - start)
    print(json.dumps([name, *spent]), flush=True)
"""


def seconds() -> dict[str, list[float]]:
    """Seconds of CPU of the first call and of the next, by its name, of one fresh process."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, cwd=Path(__file__).parent.parent,
        env={name: value for name, value in os.environ.items() if not name.startswith("JAX_")},
    )  # fmt: skip
    return {name: both for name, *both in map(json.loads, done.stdout.splitlines())}


def main() -> None:
    about, runs = machine.describe(), [seconds() for _ in range(REPEATS)]
    rows = [[name, *(f"{min(run[name][k] for run in runs):.2g}" for k in (0, 1))] for name in runs[0]]
    note = (
        "Seconds of CPU in a fresh process, calls in this order, 1024 scattered particles, order 4, on "
        f"{about['cores']} cores of {about['processor']}, JAX {about['jax']} (`python -m benchmarks.first_calls`)."
    )
    made = {"columns": ["", "first call", "the next, with other numbers on another cloud"], "rows": rows, "note": note}
    DATA.write_text(json.dumps({"machine": about, "runs": runs, "tables": {"first-calls": made}}, indent=1) + "\n")
    for row in rows:
        print(*row)


if __name__ == "__main__":
    arguments(__doc__)
    main()
