"""What the repair of weak stencils gains, and what finding them costs: ``python -m benchmarks.repair`` (some minutes).

Errors of method S, order 4, with the stencils as repaired and as first found, on clouds with weak particles: 2D and
3D, Dirichlet and Neumann sides, a system, density ratios to 1:1000. Then the time of the local phase, and of looking
through its Lebesgue constants. Writes benchmarks/data/repair.json.
"""

import json
import time
from pathlib import Path

import jax
import numpy as np

import jsmitsm as js
from benchmarks import stability as st
from benchmarks.commandline import arguments
from benchmarks.machine import describe
from benchmarks.problems.families import at_home, smooth
from jsmitsm.discretization import health
from jsmitsm.discretization.coefficients import numbers
from jsmitsm.discretization.layout import discretize
from jsmitsm.discretization.rows import all_rows

DATA = Path(__file__).parent / "data" / "repair.json"


def pair(u, x, q):
    """Two fields, each with the other in its equation."""
    known = [lambda y: smooth(y, q), lambda y: smooth(y[::-1], q)]
    own = jax.numpy.stack([js.laplacian(u[0])(x) + u[1](x), js.laplacian(u[1])(x) - u[0](x)])
    f = [js.laplacian(known[0])(x) + known[1](x), js.laplacian(known[1])(x) - known[0](x)]
    return own - jax.numpy.stack(f)


def system(dim):
    both = lambda x, q: jax.numpy.stack([smooth(x, q), smooth(x[::-1], q)])
    bcs = {side: js.dirichlet(both) for side in ("left", "right", "bottom", "top", "front", "back")[: 2 * dim]}
    return js.Problem(pair, bcs, fields=2, params=at_home(dim))


def cases():
    """Name, problem, cloud."""
    for dim in (2, 3):
        clouds = {"random": st.scattered(dim, 0), **{f"1:{r}": st.clustered(dim, r) for r in (10, 100, 1000)}}
        for name, cloud in clouds.items():
            yield f"{dim}D, {name}", st.problem("poisson", dim, at_home(dim)), cloud
            yield f"{dim}D, {name}, Neumann side", st.problem("poisson", dim, at_home(dim), True), cloud
            yield f"{dim}D, {name}, system", system(dim), cloud


def error(sol, task):
    x, q = np.asarray(sol.cloud.points).T, task.params
    exact = smooth(x, q, np) if task.fields == 1 else np.stack([smooth(x, q, np), smooth(x[::-1], q, np)], 1)
    return float(np.linalg.norm(np.asarray(sol.u) - exact) / np.linalg.norm(exact))


def compared(name, task, cloud):
    """Errors as found and as repaired, and how many stencils were repaired and stay weak."""
    repaired = js.solve(task, cloud)
    disc = discretize(task, cloud, "S", 4, None, None, None)
    try:
        plain = js.solve(task, cloud, stencils=disc.stencils)
        found = [error(plain, task), plain.stats["lebesgue_max"]]
    except js.SolveError:
        found = [None, None]
    after = [error(repaired, task), repaired.stats["lebesgue_max"]]
    return [name, *found, *after, len(repaired.stats["repaired"]), len(repaired.stats["weak"])]


def cost(n=200):
    """Seconds of the local phase of n^2 particles, and of looking through their Lebesgue constants."""
    task, cloud = st.problem("poisson", 2, at_home(2)), st.lattice(2, 0.3, shape=(n, n))
    disc = discretize(task, cloud, "S", 4, None, None, None)
    nums = numbers(disc, task)
    classes, rows = all_rows(disc, nums)

    def seconds(call):
        took = []
        for _ in range(5):
            start = time.perf_counter()
            call()
            took.append(time.perf_counter() - start)
        return min(took)

    return seconds(lambda: all_rows(disc, nums)), seconds(lambda: health.examine(classes, rows))


def main():
    jax.config.update("jax_enable_x64", True)
    rows = []
    for case in cases():
        rows.append(compared(*case))
        print(*rows[-1], flush=True)
    local, looked = cost()
    print(f"local phase {local:.3f} s, Lebesgue constants looked through in {looked:.4f} s ({looked / local:.1%})")
    columns = ["case", "error as found", "largest L", "error repaired", "largest L", "repaired", "still weak"]
    data = {"machine": describe(), "columns": columns, "rows": rows, "local": local, "examined": looked}
    DATA.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    arguments(__doc__)
    main()
