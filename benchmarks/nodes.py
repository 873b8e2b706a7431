"""Quality and speed of the particles that ``from_sdf`` makes: ``python -m benchmarks.nodes``.

On the amoeba r < 1 + 0.2 cos 5t, beside ``min_energy_nodes`` of treverhines-rbf where that is
installed. The separation is the smallest distance between two particles and the fill distance the
radius of the largest hole between them, both over the mean distance to the nearest neighbour.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import jax
import numpy as np

from benchmarks import machine
from benchmarks.commandline import arguments
from benchmarks.problems import CASES
from benchmarks.problems.shapes import quality

DATA = Path(__file__).parent / "data" / "nodes.json"
AMOEBA = CASES["amoeba"]
SIZES = (1000, 5000, 20_000, 100_000)
AREA = np.pi * 1.02
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
    about = machine.describe()
    note = f"The amoeba in 2D on {about['cores']} cores of {about['processor']} (`python -m benchmarks.nodes`)."
    tables = {"nodes": {"columns": COLUMNS, "rows": rows, "note": note}}
    DATA.write_text(json.dumps({"machine": about, "tables": tables}, indent=1) + "\n")


if __name__ == "__main__":
    arguments(__doc__)
    main()
