"""The lid-driven cavity in velocities and pressure: ``python -m benchmarks.cavity [names] [--quick]``.

Names: smooth, singular, fast; all without any. Each writes its part of benchmarks/data/cavity.json.

smooth: the lid moves with 16 x^2 (1 - x)^2, at Re = 100, from zero, against a Chebyshev collocation of the stream
function (polynomials of degree 24, whose digits shown agree with those of degree 20). singular: the lid moves with 1;
Re = 100 and 400 from zero, on scattered particles that are closer at the walls and most of all at the corners of the
lid. fast: Re = 1000, on more of them, from that solution at 400. What is compared are the extremes of the
velocities on the centre lines, with Ghia, Ghia and Shin (1982) and, at 100 and 1000, with Botella and Peyret (1998),
whose converged values differ from the former by 1.4 to 3.4 %. ``--quick`` takes few particles.
"""

from __future__ import annotations

import json
import time
from argparse import Namespace
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jsmitsm as js  # noqa: E402
from benchmarks.commandline import arguments  # noqa: E402
from benchmarks.machine import describe  # noqa: E402

DATA = Path(__file__).parent / "data" / "cavity.json"
# Least u on x = 1/2, largest and least v on y = 1/2.
CHEBYSHEV = (-0.163369, 0.139291, -0.195346)
GHIA = {100: (-0.21090, 0.17527, -0.24533), 400: (-0.32726, 0.30203, -0.44993), 1000: (-0.38289, 0.37095, -0.51550)}
BOTELLA = {100: (-0.2140424, 0.1795728, -0.2538030), 1000: (-0.3885698, 0.3769447, -0.5270771)}
# At order 4 the errors are eight times as large (smooth lid, 729 particles).
ORDER = 6
# Spacing in the middle, at the walls and in the corners of the lid as parts of it, and how it grows from there.
COARSE, FINE, WALL, CORNER, GROWTH = 0.07, 0.05, 0.3, 0.03, (2.2, 2.5)


def flow(u: Any, x: Any, q: Any) -> Any:
    """The equations of Navier and Stokes, and no divergence."""
    part = lambda k: lambda y: u(y)[k]
    velocity, slope = jnp.stack([u(x)[0], u(x)[1]]), js.grad(part(2))(x)
    forces = [velocity @ js.grad(part(k))(x) + slope[k] - js.laplacian(part(k))(x) / q["Re"] for k in range(2)]
    return jnp.stack([*forces, js.partial(part(0), (1, 0))(x) + js.partial(part(1), (0, 1))(x)])


def problem(lid: Any, reynolds: float) -> js.Problem:
    wall = [js.dirichlet(0.0, field=0), js.dirichlet(0.0, field=1)]
    bcs = {"left": wall, "right": wall, "bottom": wall, "top": [js.dirichlet(lid, field=0), js.dirichlet(0.0, field=1)]}
    return js.Problem(flow, bcs, fields=3, params={"Re": float(reynolds)})


def smooth_lid(x: Any, q: Any) -> Any:
    return 16.0 * x[0] ** 2 * (1.0 - x[0]) ** 2


def graded(middle: float) -> js.Cloud:
    """Scattered particles, ``middle`` apart in the middle, closer at the walls and most of all where the lid ends."""

    def spacing(x: Any) -> Any:
        wall = np.minimum(x, 1.0 - x).min(axis=1)
        corner = np.hypot(np.minimum(x[:, 0], 1.0 - x[:, 0]), 1.0 - x[:, 1])
        return middle * np.minimum(np.minimum(1.0, WALL + GROWTH[0] * wall), CORNER + GROWTH[1] * corner)

    # The corners belong to the walls, which stand still.
    ends = {"left": (0, 0.0), "right": (0, 1.0), "bottom": (1, 0.0), "top": (1, 1.0)}
    groups = {name: lambda x, k=k, at=at: np.abs(x[:, k] - at) < 1e-9 for name, (k, at) in ends.items()}
    return js.from_polygon([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], spacing, groups=groups)


def extremes(sol: js.Solution) -> tuple[float, float, float]:
    t = np.linspace(0.01, 0.99, 981)
    half = np.full_like(t, 0.5)
    u, v = np.asarray(sol(np.stack([half, t], 1)))[:, 0], np.asarray(sol(np.stack([t, half], 1)))[:, 1]
    return float(u.min()), float(v.max()), float(v.min())


def row(what: str, sol: js.Solution, known: tuple[float, ...], seconds: float) -> dict[str, Any]:
    found = extremes(sol)
    off = [f / k - 1.0 for f, k in zip(found, known)]
    last = sol.stats["changes"][-3:]
    print(what, len(sol.u), *(f"{f:.4f} ({o:+.1%})" for f, o in zip(found, off)), last, seconds, flush=True)
    return {
        "case": what, "particles": len(sol.u), "steps": int(sol.iterations), "found": found, "known": known,
        "off": off, "changes": last, "seconds": seconds,
    }  # fmt: skip


def solved(cloud: js.Cloud, lid: Any, reynolds: int, u0: Any = None) -> tuple[js.Solution, float]:
    """The solution, and what it took."""
    began = time.process_time()
    sol = js.solve(problem(lid, reynolds), cloud, order=ORDER, depth=0, throw=False, u0=u0)
    return sol, round(time.process_time() - began, 1)


def smooth(quick: bool) -> Iterator[dict[str, Any]]:
    for n in (17,) if quick else (17, 27):
        sol, seconds = solved(js.rectangle((0.0, 0.0), (1.0, 1.0), (n, n), jitter=0.2), smooth_lid, 100)
        yield row("smooth lid, Re 100", sol, CHEBYSHEV, seconds)


@cache
def coarse(reynolds: int) -> tuple[js.Solution, float]:
    """The solution from zero, kept for the next part."""
    return solved(graded(COARSE), 1.0, reynolds)


def singular(quick: bool) -> Iterator[dict[str, Any]]:
    for reynolds in (100,) if quick else (100, 400):
        yield from told(reynolds, *coarse(reynolds))


def fast(quick: bool) -> Iterator[dict[str, Any]]:
    if not quick:
        cloud = graded(FINE)
        yield from told(1000, *solved(cloud, 1.0, 1000, coarse(400)[0](cloud.points, outside="extrapolate")))


def told(reynolds: int, sol: js.Solution, seconds: float) -> Iterator[dict[str, Any]]:
    """The rows of one solution."""
    if not bool(sol.converged):
        print(f"lid, Re {reynolds}: not converged on {len(sol.u)} particles", sol.stats["messages"], flush=True)
        return
    for name, known in (("Ghia", GHIA), ("Botella", BOTELLA)):
        if reynolds in known:
            yield row(f"lid, Re {reynolds}, {name}", sol, known[reynolds], seconds)


PARTS = {"smooth": smooth, "singular": singular, "fast": fast}


def table(parts: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    rows = [
        [r["case"], r["particles"], r["steps"], *(f"{f:.4f} ({o:+.1%})" for f, o in zip(r["found"], r["off"])),
         " ".join(f"{c:.0e}" for c in r["changes"])]
        for part in parts.values() for r in part
    ]  # fmt: skip
    note = (
        f"`python -m benchmarks.cavity`, order {ORDER}, depth 0: extremes of the velocities on the centre lines, and "
        "by how much they differ from those of a Chebyshev collocation (smooth lid), of Ghia, Ghia and Shin (1982), "
        "and of Botella and Peyret (1998). The last column has the last changes of Newton's steps."
    )
    return {
        "columns": ["case", "particles", "steps", "least u", "largest v", "least v", "last changes"],
        "rows": rows, "note": note,
    }  # fmt: skip


def main(given: Namespace) -> None:
    parts = json.loads(DATA.read_text())["parts"] if given.names and DATA.exists() else {}
    for name in given.names or PARTS:
        rows = parts[name] = []
        for row in PARTS[name](given.quick):
            rows.append(row)
            text = {"machine": describe(), "parts": parts, "tables": {"cavity": table(parts)}}
            DATA.write_text(json.dumps(text, separators=(",", ":")).replace("},{", "},\n{") + "\n")


if __name__ == "__main__":
    main(arguments(__doc__, "quick", names="part"))
