"""Seconds and memory against the number of particles: ``python -m benchmarks.scale [--quick]``.

A Poisson problem on scattered particles, method S of order 4, in 2D up to a million particles and in 3D up to a
quarter of a million. Every size runs in a process of its own, so that its peak of memory is its own; the first call,
which compiles, stands apart from a second one on moved particles.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks import machine
from benchmarks.commandline import arguments

DATA = Path(__file__).parent / "data" / "scale.json"
ORDER = 4
SIDES = {2: (100, 178, 316, 562, 1000), 3: (22, 32, 46, 63)}


def scattered(dim: int, side: int, seed: int):
    """The unit square or cube with side^dim particles, the inner ones moved by up to 0.3 spacings, in random order."""
    import jsmitsm as js

    rng = np.random.default_rng(seed)
    axis = (np.arange(side) + 0.5) / side
    points = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    rim = ((points < 1 / side) | (points > 1 - 1 / side)).any(axis=1)
    points[~rim] += rng.uniform(-0.3 / side, 0.3 / side, (np.count_nonzero(~rim), dim))
    mixed = rng.permutation(len(points))
    rim = rim[mixed]
    return js.Cloud(points[mixed], {"interior": np.flatnonzero(~rim), "rim": np.flatnonzero(rim)})


def one(dim: int, side: int) -> dict:
    """Solve twice; what it took."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    import jsmitsm as js

    def exact(x):
        u = jnp.sin(5 * x[0] + 1) * jnp.cos(4 * x[1] - 0.5)
        return u if dim == 2 else u * jnp.cos(3 * x[2])

    seconds, peaks = [], []
    for seed in (0, 1):
        cloud = scattered(dim, side, seed)
        problem = js.Problem(lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x), {"rim": js.dirichlet(exact)})
        start = time.perf_counter()
        sol = js.solve(problem, cloud, order=ORDER)
        u = np.asarray(sol.u)
        seconds.append(time.perf_counter() - start)
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)
    true = np.array(jax.vmap(exact)(jnp.asarray(cloud.points)))
    linear = sol.stats["linear"]
    return {
        "dim": dim, "particles": len(cloud), "first": seconds[0], "again": seconds[1],
        "parts": {k: v for k, v in sol.stats["seconds"].items() if k != "total"}, "backend": linear["backend"],
        "iterations": linear["iterations"], "error": float(np.linalg.norm(u - true) / np.linalg.norm(true)),
        "first_peak_gb": peaks[0], "peak_gb": peaks[1],
    }  # fmt: skip


def growth(lines: list[dict]) -> float:
    """The exponent e of seconds ~ N^e over all sizes, by least squares."""
    n, t = (np.log([line[key] for line in lines]) for key in ("particles", "again"))
    return float(np.polyfit(n, t, 1)[0])


def table(lines: list[dict], about: dict) -> dict:
    """As the documentation shows it."""
    rows = [
        [
            f"{line['dim']}D", f"{line['particles']:,}", f"{line['error']:.1e}", f"{line['first']:.3g}",
            f"{line['again']:.3g}", line["backend"], f"{line['first_peak_gb']:.2g}", f"{line['peak_gb']:.2g}",
        ]
        for line in lines
    ]  # fmt: skip
    exponents = ", ".join(f"N^{growth([x for x in lines if x['dim'] == d]):.2f} in {d}D" for d in (2, 3))
    note = (
        f"Order {ORDER}, scattered particles in random order, on {about['cores']} cores of {about['processor']} "
        f"(`python -m benchmarks.scale`). Seconds grow as {exponents}. Memory is the peak of the process after the "
        "first call, and after the second, while the first solution and its factors are kept."
    )
    columns = ["", "particles", "relative error", "first call (s)", "next cloud (s)", "linear solver", "peak (GB)"]
    columns += ["peak of both (GB)"]
    return {"columns": columns, "rows": rows, "note": note}


def main(quick: bool) -> None:
    about, lines = machine.describe(), []
    for dim, sides in SIDES.items():
        for side in sides[: 2 if quick else None]:
            command = [sys.executable, "-m", "benchmarks.scale", "--one", str(dim), str(side)]
            done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parent.parent)
            lines.append(json.loads(done.stdout.splitlines()[-1]))
            print(lines[-1], flush=True)
    made = table(lines, about)
    if not quick:
        DATA.write_text(json.dumps({"machine": about, "lines": lines, "tables": {"scale": made}}, indent=1) + "\n")
    print("\n".join(" | ".join(row) for row in [made["columns"], *made["rows"]]) + "\n" + made["note"])


if __name__ == "__main__":
    given = arguments(__doc__, "quick", "one", names="number")  # one: a dimension and a size, in a process of its own
    if given.one:
        print(json.dumps(one(*map(int, given.names))))
    else:
        main(given.quick)
