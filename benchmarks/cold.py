"""From a fresh process to the first solution: ``python -m benchmarks.cold``.

About a thousand scattered particles, order 4, equation and source as Python functions. Each run is a process of its
own; what importing jax alone takes is subtracted. With ``cache`` the compiled programs come from the persistent cache
of JAX, as the README shows.
"""

from __future__ import annotations

import compileall
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks import machine
from benchmarks.commandline import arguments

DATA = Path(__file__).parent / "data" / "cold.json"
REPEATS = 5
SCRIPT = """
import time
start = time.perf_counter()
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
imported = time.perf_counter()
import jsmitsm as js

cloud = js.rectangle((0, 0), (1, 1), (32, 32), jitter=0.3)
exact = lambda x: jnp.exp(x[0]) * jnp.sin(2 * x[1]) + x[0] ** 3 * x[1]
problem = js.Problem(
    lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x),
    {side: js.dirichlet(exact) for side in ("left", "right", "bottom", "top")},
)
first = js.solve(problem, cloud, order=4).u
print(imported - start, time.perf_counter() - imported)
"""


def seconds(cache: str | None) -> list[float]:
    """Importing jax, and everything after it, of one fresh process."""
    options = {} if cache is None else {
        "JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, env=os.environ | options,
        cwd=Path(__file__).parent.parent,
    )  # fmt: skip
    return [float(x) for x in done.stdout.split()]


def main() -> None:
    about, rows, found = machine.describe(), [], {}
    compileall.compile_dir(Path(__file__).parent.parent / "jsmitsm", quiet=1)  # as pip does when it installs
    with tempfile.TemporaryDirectory() as folder:
        for name, cache in (("without a cache", None), ("with the persistent cache", folder)):
            seconds(cache)  # fills the caches, of the disk too
            runs = [seconds(cache) for _ in range(REPEATS)]
            found[name] = runs
            rows.append([name, *(f"{statistics.median(r[k] for r in runs):.2f}" for k in (0, 1))])
            print(rows[-1], flush=True)
    note = (
        f"Seconds of a fresh process to the first solution (1024 scattered particles, order 4), medians of {REPEATS} "
        f"on {about['cores']} cores of {about['processor']} (`python -m benchmarks.cold`)."
    )
    made = {"columns": ["", "importing jax", "from there to the solution"], "rows": rows, "note": note}
    DATA.write_text(json.dumps({"machine": about, "runs": found, "tables": {"cold": made}}, indent=1) + "\n")


if __name__ == "__main__":
    arguments(__doc__)
    main()
