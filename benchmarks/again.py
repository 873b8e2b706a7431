"""The same problem solved again, its functions written anew: ``python -m benchmarks.again``.

Milliseconds, the least of many. What a function sees is compared, and it is not recorded again. ``--against=DIRECTORY``
measures another tree of the package in turns with this one, and prints the ratio.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jsmitsm as js  # noqa: E402

ROUNDS, REPEATS = 12, 25
SIDES = ("left", "right", "bottom", "top")
AMPLITUDE, AT = 2.0, np.linspace(0.0, 1.0, 20)
WAVES = {"k": np.array([1.0, 2.0]), "shift": (0.1, 0.2)}


def wave(x):
    return AMPLITUDE * jnp.sin(WAVES["k"][0] * x[0] + WAVES["shift"][0]) * math.pi


def number(cloud, k=1.5):
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - k, ends), cloud)


def table(cloud, at=AT, values=AT**2):
    ends = {"left": js.dirichlet(0.0), "right": js.neumann(0.0)}
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - jnp.interp(x[0], at, values), ends), cloud)


def helpers(cloud):
    pde = lambda u, x: js.divergence(lambda y: jnp.exp(y[0]) * js.grad(u)(y))(x) - wave(x)
    return js.solve(js.Problem(pde, dict.fromkeys(SIDES, js.dirichlet(0.0))), cloud)


def conditions(cloud):
    ends = {
        "left": js.dirichlet(lambda x: wave(x)),
        "right": js.neumann(lambda x: jnp.cos(x[1])),
        "bottom": js.robin(1.0, 2.0, lambda x: x[0]),
        "top": js.condition(lambda u, x, n: n @ js.grad(u)(x) - wave(x)),
    }
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, ends), cloud)


def params(cloud):
    ends = dict.fromkeys(SIDES, js.dirichlet(lambda x, p: p["wall"]))
    pde = lambda u, x, p: js.laplacian(u)(x) - p["source"] * x[0]
    return js.solve(js.Problem(pde, ends, params={"wall": 1.0, "source": 2.0}), cloud)


CASES = {
    "a number, 9 particles": (number, lambda: js.interval(0.0, 1.0, 9)),
    "a table, 101 particles": (table, lambda: js.interval(0.0, 1.0, 101)),
    "helpers, 144 particles": (helpers, lambda: js.rectangle((0, 0), (1, 1), (12, 12))),
    "four conditions, 144 particles": (conditions, lambda: js.rectangle((0, 0), (1, 1), (12, 12))),
    "params, 900 particles": (params, lambda: js.rectangle((0, 0), (1, 1), (30, 30))),
}


def serve() -> None:
    """Milliseconds of each case, every time a line comes in."""
    made = {name: (solve, cloud()) for name, (solve, cloud) in CASES.items()}
    for solve, cloud in made.values():
        solve(cloud)
    for _ in sys.stdin:
        best = []
        for solve, cloud in made.values():
            took = []
            for _ in range(REPEATS):
                start = time.perf_counter()
                solve(cloud)
                took.append(time.perf_counter() - start)
            best.append(1e3 * min(took))
        print(*best, flush=True)


def main(trees: list[str]) -> None:
    servers = []
    for tree in trees:
        where = dict(os.environ, PYTHONPATH=tree)
        command = [sys.executable, __file__, "--serve"]
        servers.append(subprocess.Popen(command, env=where, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
    best = np.full((len(trees), len(CASES)), np.inf)
    for _ in range(ROUNDS):
        for row, server in zip(best, servers):
            print("again", file=server.stdin, flush=True)
            np.minimum(row, [float(word) for word in server.stdout.readline().split()], out=row)
    for server in servers:
        server.stdin.close()
        server.wait()
    for name, *times in zip(CASES, *best):
        ratio = f" | {times[0] / times[1]:.2f}" if len(times) > 1 else ""
        print(f"{name} | " + " | ".join(f"{t:.2f}" for t in times) + ratio)


if __name__ == "__main__":
    if sys.argv[1:] == ["--serve"]:
        serve()
    else:
        from benchmarks.commandline import arguments

        other = arguments(__doc__, "against=").against
        main([str(Path(__file__).parent.parent)] + ([other] if other else []))
