"""The lid-driven cavity in velocities and pressure: ``python -m benchmarks.cavity [names] [--quick]``.

Names: smooth, singular; both without any. Each writes its part of benchmarks/data/cavity.json.

smooth: the lid moves with 16 x^2 (1 - x)^2, at Re = 100, from zero, against a Chebyshev collocation of the stream
function (polynomials of degree 24, whose digits shown agree with those of degree 20). singular: the lid moves with 1;
Re = 100 and 400 from zero, 1000 by continuation, on clouds that are finer at the corners of the lid. What is compared
are the extremes of the velocities on the centre lines, with Ghia, Ghia and Shin (1982) and, at 1000, with Botella and
Peyret (1998), whose values differ from the former by 1.5 to 2 %. ``--quick`` takes few particles.
"""

from __future__ import annotations

import json
import time
from argparse import Namespace
from collections.abc import Iterator
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
# On clouds this coarse order 4 is up to 40 % off, and with a deeper recursion Newton's steps do not arrive.
HOW: dict[str, Any] = {"order": 6, "depth": 0}
BOTELLA = (-0.3885698, 0.3769447, -0.5270771)


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


def graded(n: int, least: float = 0.25) -> js.Cloud:
    """n x n rows of particles, at the walls ``least`` times as far apart as between equal rows."""
    t = np.linspace(0.0, 1.0, n)
    t = t - (1.0 - least) * np.sin(2.0 * np.pi * t) / (2.0 * np.pi)
    x, y = (g.reshape(-1) for g in np.meshgrid(t, t, indexing="ij"))
    left, right, bottom, top = x == 0.0, x == 1.0, y == 0.0, y == 1.0
    sides = {"left": left, "right": right & ~left, "bottom": bottom & ~left & ~right, "top": top & ~left & ~right}
    groups = {name: np.flatnonzero(where) for name, where in sides.items()}
    groups["interior"] = np.flatnonzero(~(left | right | bottom | top))
    normals = np.full((n * n, 2), np.nan)
    for name, normal in {"left": (-1, 0), "right": (1, 0), "bottom": (0, -1), "top": (0, 1)}.items():
        normals[groups[name]] = normal
    return js.Cloud(np.stack([x, y], axis=1), groups, normals)


def extremes(sol: js.Solution) -> tuple[float, float, float]:
    t = np.linspace(0.01, 0.99, 981)
    half = np.full_like(t, 0.5)
    u, v = np.asarray(sol(np.stack([half, t], 1)))[:, 0], np.asarray(sol(np.stack([t, half], 1)))[:, 1]
    return float(u.min()), float(v.max()), float(v.min())


def line(what: str, sol: js.Solution, known: tuple[float, ...], began: float) -> dict[str, Any]:
    found = extremes(sol)
    off = [f / k - 1.0 for f, k in zip(found, known)]
    row = {
        "case": what, "particles": len(sol.u), "steps": int(sol.iterations), "found": found, "known": known,
        "off": off, "estimate": sol._estimated(), "seconds": round(time.process_time() - began, 1),
    }  # fmt: skip
    print(what, len(sol.u), *(f"{f:.4f} ({o:+.1%})" for f, o in zip(found, off)), flush=True)
    return row


def smooth(quick: bool) -> Iterator[dict[str, Any]]:
    for n in (13, 17) if quick else (13, 17, 21, 27):
        began, cloud = time.process_time(), js.rectangle((0.0, 0.0), (1.0, 1.0), (n, n), jitter=0.2)
        yield line("smooth lid, Re 100", js.solve(problem(smooth_lid, 100.0), cloud, **HOW), CHEBYSHEV, began)


def singular(quick: bool) -> Iterator[dict[str, Any]]:
    for n in (17,) if quick else (25, 41):
        cloud, before = graded(n), None
        for reynolds in (100, 400, 1000):
            began = time.process_time()
            # The last one starts from the one before.
            sol = js.solve(
                problem(1.0, reynolds), cloud, u0=before if reynolds == 1000 else None, throw=False, **HOW
            )  # fmt: skip
            before = sol.u
            if bool(sol.converged):
                yield line(f"lid, Re {reynolds}", sol, GHIA[reynolds], began)
            else:
                print(f"lid, Re {reynolds}: not converged", sol.stats.get("messages"), flush=True)
        if bool(sol.converged):
            yield line("lid, Re 1000, Botella and Peyret", sol, BOTELLA, began)


PARTS = {"smooth": smooth, "singular": singular}


def table(parts: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    rows = [
        [r["case"], r["particles"], r["steps"], *(f"{f:.4f} ({o:+.1%})" for f, o in zip(r["found"], r["off"])),
         f"{r['estimate']:.1%}"]
        for part in parts.values() for r in part
    ]  # fmt: skip
    note = (
        "`python -m benchmarks.cavity`, order 6, depth 0: extremes of the velocities on the centre lines, and by how "
        "much they differ from those of a Chebyshev collocation (smooth lid), of Ghia, Ghia and Shin (1982), and of "
        "Botella and Peyret (1998) where it says so."
    )
    return {
        "columns": ["case", "particles", "steps", "least u", "largest v", "least v", "estimated error"],
        "rows": rows, "note": note,
    }  # fmt: skip


def main(given: Namespace) -> None:
    old = json.loads(DATA.read_text()) if DATA.exists() else {"parts": {}}
    for name in given.names or PARTS:
        rows = old["parts"][name] = []
        for row in PARTS[name](given.quick):
            rows.append(row)
            text = {"machine": describe(), "parts": old["parts"], "tables": {"cavity": table(old["parts"])}}
            DATA.write_text(json.dumps(text, separators=(",", ":")).replace("},{", "},\n{") + "\n")


if __name__ == "__main__":
    main(arguments(__doc__, "quick", names="part"))
