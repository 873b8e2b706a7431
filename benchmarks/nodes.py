"""Quality and speed of the particles that ``from_sdf`` makes: ``python -m benchmarks.nodes``.

On the amoeba r < 1 + 0.2 cos 5t, beside ``min_energy_nodes`` of treverhines-rbf where that is
installed. The separation is the smallest distance between two particles and the fill distance the
radius of the largest hole between them, both over the mean distance to the nearest neighbour.

Then clouds of one spacing and graded ones in a disk and a ball: the least time of many calls beside what is
wanted, the worst of six seeds by ``js.quality``, and errors of Poisson's equation at several orders.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks import machine
from benchmarks.commandline import arguments
from benchmarks.problems import CASES
from benchmarks.problems.shapes import quality

DATA = Path(__file__).parent / "data" / "nodes.json"
AMOEBA = CASES["amoeba"]
SIZES = (1000, 5000, 20_000, 100_000)
AREA = np.pi * 1.02
DISK, BALL = (lambda: js.sdf.circle((0, 0), 1.0)), (lambda: js.sdf.ball((0, 0, 0), 1.0))


def graded(finest: float):
    """A spacing that grows from the point (1, 0) to seven times as much on the other side."""
    return lambda x: finest * (1.0 + 3.0 * np.hypot(x[:, 0] - 1, x[:, 1]))


# Shape, dimension, spacing, wanted milliseconds, orders at which errors are measured.
CLOUDS = (
    ("disk", DISK, 2, 0.141, 6, (4, 6, 8)),
    ("disk", DISK, 2, 0.0995, 8, (4, 6, 8)),
    ("disk", DISK, 2, 0.0402, 14, (4, 6, 8)),
    ("disk", DISK, 2, 0.0201, 30, (4, 6, 8)),
    ("disk", DISK, 2, 0.00604, 250, ()),
    ("graded disk", DISK, 2, graded(0.0225), 20, (4, 6, 8)),
    ("graded disk", DISK, 2, graded(0.0078), 100, (4, 6, 8)),
    ("ball", BALL, 3, 0.251, 18, (2, 4, 6)),
    ("ball", BALL, 3, 0.1705, 32, (2, 4, 6)),
    ("ball", BALL, 3, 0.0271, 3000, ()),
)
CLOUD_COLUMNS = ["shape", "particles", "wanted, ms", "reached, ms", "function written anew, ms", "fill", "separation",
                 "boundary off by", "errors at these orders"]  # fmt: skip
COLUMNS = ["made by", "particles", "seconds", "separation", "fill distance", "fill / separation"]


def rim(n: int) -> np.ndarray:
    """n points along the amoeba's boundary."""
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return (1 + 0.2 * np.cos(5 * t))[:, None] * np.stack([np.cos(t), np.sin(t)], axis=1)


def made(n: int) -> np.ndarray:
    return np.asarray(AMOEBA.cloud((AREA / n / 0.87) ** 0.5).points)


def energy(n: int) -> np.ndarray:
    from rbf.pde.nodes import min_energy_nodes

    np.random.seed(0)  # noqa: NPY002, that package draws from numpy's global state
    m = 2000 if n < 50_000 else 4000
    return min_energy_nodes(n, (rim(m), np.stack([np.arange(m), np.roll(np.arange(m), -1)], axis=1)))[0]


def least(make, seconds: float = 2.0) -> float:
    """The least time of many calls, in milliseconds."""
    taken = []
    while sum(taken) < seconds or len(taken) < 2:
        start = time.perf_counter()
        make()
        taken.append(time.perf_counter() - start)
    return 1e3 * min(taken)


def error(cloud: js.Cloud, order: int) -> str:
    """The relative error of Poisson's equation, marked where a flag is raised."""
    u = lambda x: jnp.exp(x[0]) * jnp.sin(2 * x[1]) * (jnp.cos(x[2]) if cloud.dim == 3 else 1.0)  # noqa: E731
    problem = js.Problem(
        lambda v, x: js.laplacian(v)(x) - jnp.trace(jax.hessian(u)(x)), {"boundary": js.dirichlet(u)}
    )
    sol, exact = js.solve(problem, cloud, order=order), jax.vmap(u)(cloud.points)
    return f"{order}: {np.linalg.norm(sol.u - exact) / np.linalg.norm(exact):.1e}" + "!" * bool(sol.flags)


def clouds() -> list[list[str]]:
    """Wanted and reached."""
    rows = []
    for name, shape, dim, h, wanted, orders in CLOUDS:
        box, kept = ((-1.0,) * dim, (1.0,) * dim), shape()
        cloud = js.from_sdf(kept, box, h)
        reached = least(lambda: js.from_sdf(kept, box, h))  # noqa: B023
        # Another radius every time: as far as JAX knows a function that it has never seen.
        fresh = least(lambda: js.from_sdf(js.sdf.ball((0.0,) * dim, 1.0 - 1e-6 * np.random.random()), box, h))  # noqa: B023, NPY002
        seeds = range(6) if orders else (0,)
        worst = [js.quality(js.from_sdf(kept, box, h, seed=s), h) for s in seeds]
        off = np.abs(np.linalg.norm(cloud.points[cloud.boundary], axis=1) - 1.0).max() / 2
        rows.append([name, str(len(cloud)), f"{wanted}", f"{reached:.1f}", f"{fresh:.1f}",
                     f"{max(q.fill for q in worst):.2f}", f"{min(q.separation for q in worst):.2f}", f"{off:.0e}",
                     ", ".join(error(cloud, order) for order in orders)])  # fmt: skip
        print(" | ".join(rows[-1]) + (" MISSED" if reached > wanted else ""), flush=True)
    return rows


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    rows = []
    for name, make in (("js.from_sdf", made), ("min_energy_nodes", energy)):
        for n in SIZES:
            try:
                make(200)  # compiles
            except ImportError as error:
                print(f"{name}: left out, {error.name} is not installed")
                break
            start = time.perf_counter()
            points = make(n)
            seconds = time.perf_counter() - start
            separation, fill = quality(points)
            rows.append([name, str(len(points)), f"{seconds:.2f}", f"{separation:.2f}", f"{fill:.2f}",
                         f"{fill / separation:.2f}"])  # fmt: skip
            slow = make is made and seconds > AMOEBA.seconds.get(n, np.inf)
            print(" ".join(f"{cell:>17}" for cell in rows[-1]) + (" MISSED seconds" if slow else ""), flush=True)
    made_clouds = clouds()
    about = machine.describe()
    note = f"The amoeba in 2D on {about['cores']} cores of {about['processor']} (`python -m benchmarks.nodes`)."
    tables = {
        "nodes": {"columns": COLUMNS, "rows": rows, "note": note},
        "clouds": {"columns": CLOUD_COLUMNS, "rows": made_clouds, "note": note.replace("The amoeba in 2D", "Clouds")},
    }
    DATA.write_text(json.dumps({"machine": about, "tables": tables}, indent=1) + "\n")


if __name__ == "__main__":
    if arguments(__doc__, "clouds").clouds:  # without the comparison, nothing written
        jax.config.update("jax_enable_x64", True)
        clouds()
    else:
        main()
