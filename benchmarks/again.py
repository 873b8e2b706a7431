"""What is done again, its functions written anew: ``python -m benchmarks.again``.

Milliseconds, the least of many: solves, what is asked of a solution, gradients; and what a fresh process takes to its
first solution. What a function sees is compared, and it is not recorded again. ``--against=DIRECTORY`` measures another
tree of the package in turns with this one, as it is and without depth, and writes the ratios down.
"""

from __future__ import annotations

import compileall
import inspect
import json
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

DATA = Path(__file__).parent / "data" / "again.json"
ROUNDS, REPEATS, SECONDS, COLD = 6, 25, 0.1, 8
# Without depth, where a tree knows what that is.
FLAT = {"depth": 0} if "--flat" in sys.argv and "depth" in inspect.signature(js.solve).parameters else {}
SIDES = ("left", "right", "bottom", "top")
AMPLITUDE, AT = 2.0, np.linspace(0.0, 1.0, 20)
WAVES = {"k": np.array([1.0, 2.0]), "shift": (0.1, 0.2)}


def wave(x):
    return AMPLITUDE * jnp.sin(WAVES["k"][0] * x[0] + WAVES["shift"][0]) * math.pi


def number(cloud, k=1.5):
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - k, ends), cloud, **FLAT)


def table(cloud, at=AT, values=AT**2):
    ends = {"left": js.dirichlet(0.0), "right": js.neumann(0.0)}
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - jnp.interp(x[0], at, values), ends), cloud, **FLAT)


def helpers(cloud):
    pde = lambda u, x: js.divergence(lambda y: jnp.exp(y[0]) * js.grad(u)(y))(x) - wave(x)
    return js.solve(js.Problem(pde, dict.fromkeys(SIDES, js.dirichlet(0.0))), cloud, **FLAT)


def conditions(cloud):
    ends = {
        "left": js.dirichlet(lambda x: wave(x)),
        "right": js.neumann(lambda x: jnp.cos(x[1])),
        "bottom": js.robin(1.0, 2.0, lambda x: x[0]),
        "top": js.condition(lambda u, x, n: n @ js.grad(u)(x) - wave(x)),
    }
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, ends), cloud, **FLAT)


def params(cloud):
    ends = dict.fromkeys(SIDES, js.dirichlet(lambda x, p: p["wall"]))
    pde = lambda u, x, p: js.laplacian(u)(x) - p["source"] * x[0]
    return js.solve(js.Problem(pde, ends, params={"wall": 1.0, "source": 2.0}), cloud, **FLAT)


def exact(x):
    return jnp.exp(x[0]) * jnp.sin(2 * x[1]) + x[0] ** 3 * x[1]


def smooth(cloud, order=4):
    """A Poisson problem whose source is made of its solution, as users test."""
    ends = {name: js.dirichlet(exact) for name in cloud.groups if name != "interior"}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x), ends)
    return js.solve(problem, cloud, order=order, **FLAT)


def on_another(cloud, order):
    """On a cloud of its own."""
    return smooth(js.Cloud(np.array(cloud.points), cloud.groups, cloud.normals), order)


def objective(cloud, near, given):
    kernel = js.SuperGaussian(h=given[0], d=given[1])
    ends = {name: js.dirichlet(float(k)) for k, name in enumerate(SIDES)}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 2.0 * jnp.sin(3 * x[0]) * x[1], ends)
    return jnp.sum(js.solve(problem, cloud, order=4, kernel=kernel, stencils=near, **FLAT).u ** 2)


def square(side):
    return js.rectangle((0, 0), (1, 1), (side, side), jitter=0.2)


def disk(spacing):
    return js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.2, -1.2), (1.2, 1.2)), spacing)


def asked(question):
    """Seconds of a question to a solution that nobody asked before."""

    def case(cloud):
        solution = smooth(cloud)
        start = time.perf_counter()
        jax.block_until_ready(question(solution))
        return time.perf_counter() - start

    return case


def values(cloud):
    points = np.random.default_rng(0).uniform(0.01, 0.99, (1000, 2))
    solution = smooth(cloud)
    return lambda: solution(points)


def local(cloud):
    return smooth(cloud).stats["seconds"]["local"]


def gradient(cloud):
    """Value and gradient by h and d, each time at another h, so that no factors are found again."""
    spacing, calls = 1.0 / (math.isqrt(len(cloud)) - 1), iter(range(10**9))
    near = js.stencils(cloud, radius=4.0 * spacing)
    both = jax.value_and_grad(lambda given: objective(cloud, near, given))
    return lambda: jax.block_until_ready(both((1.2 * spacing * (1 + 1e-4 * next(calls)), 3.2)))


# Each makes of its cloud what is called again and again; what returns a number has taken its time itself.
CASES = {
    "a number, 9 particles": (number, lambda: js.interval(0.0, 1.0, 9)),
    "a table, 101 particles": (table, lambda: js.interval(0.0, 1.0, 101)),
    "helpers, 144 particles": (helpers, lambda: js.rectangle((0, 0), (1, 1), (12, 12))),
    "four conditions, 144 particles": (conditions, lambda: js.rectangle((0, 0), (1, 1), (12, 12))),
    "params, 900 particles": (params, lambda: js.rectangle((0, 0), (1, 1), (30, 30))),
    "square, order 4": (smooth, lambda: square(30)),
    "its local phase": (local, lambda: square(30)),
    "its error estimate": (asked(lambda s: s.error_estimate()), lambda: square(30)),
    "its coefficients": (asked(lambda s: s.coefficients), lambda: square(30)),
    "its value at 1000 points": (values, lambda: square(30)),
    "its gradient by h and d": (gradient, lambda: square(30)),
    "disk, order 6": (lambda c: smooth(c, 6), lambda: disk(0.14)),
    "disk, order 6, another cloud": (lambda c: on_another(c, 6), lambda: disk(0.14)),
    "disk, order 10": (lambda c: smooth(c, 10), lambda: disk(0.14)),
    "disk, order 10, finer": (lambda c: smooth(c, 10), lambda: disk(0.1)),
    "disk, order 8, finer": (lambda c: smooth(c, 8), lambda: disk(0.0405)),
}
READY = (values, gradient)  # these return the call


def serve() -> None:
    """Milliseconds of each case, every time a line comes in; first, how many particles they have."""
    made, sizes = {}, []
    for name, (case, cloud) in CASES.items():
        here = cloud()
        made[name] = case(here) if case in READY else lambda case=case, here=here: case(here)
        sizes.append(len(here))
        made[name]()
        made[name]()
    print(*sizes, flush=True)
    for _ in sys.stdin:
        best = []
        for call in made.values():
            took, began = [], time.perf_counter()
            while len(took) < 3 or (len(took) < REPEATS and time.perf_counter() - began < SECONDS):
                start = time.perf_counter()
                own = call()
                took.append(own if isinstance(own, float) else time.perf_counter() - start)
            best.append(1e3 * min(took))
        print(*best, flush=True)


def cold(tree: str, flat: bool) -> float:
    """Milliseconds of a fresh process from importing jax to the first solution."""
    from benchmarks.cold import SCRIPT

    script = SCRIPT.replace("order=4", "order=4, depth=0") if flat else SCRIPT
    # Nothing of a persistent cache of the user's.
    plain = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    done = subprocess.run([sys.executable, "-c", script], cwd=tree, env=plain, capture_output=True, text=True)
    if done.returncode:  # a tree without depth
        return cold(tree, False)
    return 1e3 * float(done.stdout.split()[1])


def main(other: str) -> None:
    own = str(Path(__file__).parent.parent)
    trees = [(own, True), (own, False)] if not other else [(other, True), (own, True), (own, False)]
    for tree in {tree for tree, _ in trees}:
        compileall.compile_dir(Path(tree) / "jsmitsm", quiet=1)  # as pip does when it installs
    servers = []
    for tree, flat in trees:
        where = {**os.environ, "PYTHONPATH": tree}
        command = [sys.executable, __file__, "--serve", *(["--flat"] if flat else [])]
        servers.append(subprocess.Popen(command, env=where, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
    sizes = [server.stdout.readline().split() for server in servers][-1]
    best = np.full((len(trees), len(CASES)), np.inf)
    for _ in range(ROUNDS):
        for row, server in zip(best, servers):
            print("again", file=server.stdin, flush=True)
            np.minimum(row, [float(word) for word in server.stdout.readline().split()], out=row)
    for server in servers:
        server.stdin.close()
        server.wait()
    first = np.array([[cold(*tree) for tree in trees] for _ in range(COLD)])
    names, sizes = [*CASES, "a fresh process, 1024 particles"], [*sizes, "1024"]
    times = np.concatenate([best, np.min(first, axis=0)[:, None]], axis=1)
    rows = []
    for name, size, column in zip(names, sizes, times.T):
        ratios = [f"{t / column[0]:.2f}" for t in column[1:]] if other else []
        label = name if "particles" in name else f"{name}, {size} particles"
        rows.append([label, *(f"{t:.2f}" for t in column), *ratios])
        print(" | ".join(rows[-1]), flush=True)
    if other:
        written(rows, times, first)


def written(rows: list[list[str]], times: np.ndarray, first: np.ndarray) -> None:
    from benchmarks import machine

    about = machine.describe()
    note = (
        f"Milliseconds, the least of {ROUNDS} rounds in turns on {about['cores']} cores of {about['processor']} "
        "(`python -m benchmarks.again --against=DIRECTORY`): before, with all modules in one folder, now without depth,"
        " now as it is; and the ratios of the latter two to the first."
    )
    columns = ["", "before", "now, depth=0", "now", "ratio, depth=0", "ratio"]
    found = {"times": times.tolist(), "fresh processes": first.tolist()}
    made = {"columns": columns, "rows": rows, "note": note}
    DATA.write_text(json.dumps({"machine": about, **found, "tables": {"again": made}}, indent=1) + "\n")


if __name__ == "__main__":
    if "--serve" in sys.argv:
        serve()
    else:
        from benchmarks.commandline import arguments

        main(arguments(__doc__, "against=").against)
