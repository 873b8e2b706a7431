"""Error against seconds: ``python -m benchmarks.pareto [--quick] [--only=NAME] [scene ...]``.

Every method and order of the package, and other discretisations where they are installed
(``pip install ".[bench]"``; updes, which brings Gmsh and pandas along, by ``pip install updes``), on
five scenes. ``--only=updes`` runs the contestants of that name and keeps the data of the others.
Seconds are from arrays to values: neighbours, weights, assembly, solve. The first call, which
compiles, stands apart from the median of the repeats; every repeat has its particles moved by a
trifle, so that no factor is used again. The package differentiates its sources itself; the others
get their numbers for nothing.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks import machine, peers
from benchmarks.commandline import arguments
from benchmarks.problems import CASES, Case
from benchmarks.problems.shapes import conducting
from jsmitsm.cloud.triangulation import simplices

DATA = Path(__file__).parent / "data" / "pareto.json"
PICTURE = Path(__file__).parent.parent / "docs" / "images" / "pareto.png"
REPEATS = 5
# No run is repeated, or made larger, that takes longer than this in seconds, or five times this to compile.
PATIENCE = 4.0


@dataclass(frozen=True)
class Scene:
    """A case div(k grad u) = f of the table, on clouds of growing size.

    sizes : arguments of ``cloud``; lattice : whether they are those of a lattice (nx, ny).
    """

    name: str
    about: str
    case: Case
    conductivity: Callable[[Any], Any]
    sizes: tuple[Any, ...]
    orders: tuple[int, ...]
    cloud: Callable[[Any], js.Cloud]
    lattice: bool = False

    @property
    def exact(self) -> Callable[[Any], Any]:
        return self.case.exact

    @property
    def slope(self) -> str | None:
        """The group with a Neumann condition."""
        return next(iter(self.case.bcs), None)

    @property
    def boundary(self) -> tuple[str, ...]:
        return tuple(name for name in self.case.sides if name != self.slope)

    def problem(self) -> js.Problem:
        """Written anew for every call, as in a script."""
        return self.case.problem()


def one(x: Any) -> float:
    return 1.0


def _ball(n: int) -> js.Cloud:
    return CASES["smooth ball"].cloud(n, round(1.6 * n ** (2 / 3) * 3.6))


SPACINGS = (0.16, 0.13, 0.1, 0.08, 0.06, 0.042, 0.028, 0.02, 0.0137, 0.0092, 0.0061)
LATTICES = ((9, 19), (17, 37), (25, 55), (33, 73), (49, 109), (65, 145), (129, 289), (257, 577))
AMOEBA, CONDUCTOR, WAVES = CASES["amoeba"], CASES["conducting amoeba"], CASES["oscillating disk"]
# Its source by AD as in the others.
LATTICE = replace(CASES["source"], source=None)
SCENES = {
    scene.name: scene
    for scene in (
        Scene("amoeba", "Poisson, scattered particles", AMOEBA, one, SPACINGS, (2, 4, 6, 8, 10), AMOEBA.cloud),
        Scene("lattice", "problem 4.3 of the paper, a Neumann side", LATTICE, one, LATTICES, (2, 4, 6, 8, 10),
              LATTICE.cloud, lattice=True),
        Scene("ball", "Poisson in 3D, uniformly random particles", CASES["smooth ball"], one,
              (500, 1000, 2000, 4000, 8000, 16000, 32000), (2, 4, 6), _ball),
        Scene("conductor", "div(k grad u) = f, k variable, scattered particles", CONDUCTOR, conducting, SPACINGS,
              (2, 4, 6, 8, 10), CONDUCTOR.cloud),
        Scene("waves", "Poisson, an oscillating source, scattered particles", WAVES, one, SPACINGS, (2, 4, 6, 8, 10),
              WAVES.cloud),
    )
}  # fmt: skip


# ------------------------------------------------------------------ the contestants


def posed(scene: Scene, cloud: js.Cloud, size: Any) -> peers.Posed:
    """The scene in numbers."""

    def functions(places):
        places = jnp.asarray(places)
        source = jax.vmap(lambda x: scene.case.operator(scene.exact, x))(places)
        values = source, _everywhere(scene.conductivity, places), jax.vmap(scene.exact)(places)
        return tuple(np.array(v) for v in values)

    points = np.asarray(cloud.points)
    source, conductivity, values = functions(points)
    gradient = np.zeros(points.shape) if scene.conductivity is one else np.array(
        jax.vmap(jax.grad(scene.conductivity))(jnp.asarray(points)))  # fmt: skip
    held = np.zeros(len(cloud), bool)
    for name in scene.boundary:
        held[cloud.groups[name]] = True
    slope = None
    if scene.slope:
        slope = np.zeros(len(cloud), bool)
        slope[cloud.groups[scene.slope]] = True
    cells = simplices(cloud) if cloud.dim == 2 else None
    return peers.Posed(
        points, held, source, values, conductivity, gradient, functions, cells, size if scene.lattice else (), slope,
        lambda x: scene.case.operator(scene.exact, x),
    )  # fmt: skip


def _everywhere(function: Callable, points: Any) -> np.ndarray:
    return np.broadcast_to(np.asarray(jax.vmap(lambda x: jnp.asarray(function(x), float))(points)), (len(points),))


def moved(cloud: js.Cloud, k: int, scene: Scene) -> js.Cloud:
    """The cloud with its interior particles moved by 1e-9 spacings; a lattice stays one, scaled as little."""
    points = np.array(cloud.points)
    if scene.lattice:
        return js.Cloud(points * (1.0 + 1e-13 * k), cloud.groups, cloud.normals)
    inside = cloud.groups["interior"]
    points[inside] += 1e-9 * cloud.spacing * np.random.default_rng(k).standard_normal((len(inside), cloud.dim))
    return js.Cloud(points, cloud.groups, cloud.normals)


def ours(method: str, order: int) -> Callable[[Scene, js.Cloud, Any], Callable[[js.Cloud], np.ndarray]]:
    def prepare(scene, cloud, size):
        kernel = None if method == "S" else js.SuperGaussian(_reach(scene, cloud, method, order) / 3.0, 3.0)
        return lambda moved: js.solve(scene.problem(), moved, method=method, order=order, kernel=kernel).u

    return prepare


def _reach(scene: Scene, cloud: js.Cloud, method: str, order: int) -> float:
    """A support radius that holds about twice as many particles as the method has unknowns."""
    dim = cloud.dim
    every = math.comb(order + dim, dim)
    unknowns = every if method == "SSPH" else every - math.comb(order + dim - 2, dim)
    spacing = (np.prod(np.ptp(np.asarray(cloud.points), axis=0)) / len(cloud)) ** (1 / dim)
    ball = math.pi if dim == 2 else 4 * math.pi / 3
    return float(spacing * (1.7**2 * 2 * unknowns / ball) ** (1 / dim))


def theirs(run: Callable[[peers.Posed], np.ndarray]) -> Callable[[Scene, js.Cloud, Any], Callable[[js.Cloud], Any]]:
    def prepare(scene, cloud, size):
        ready = {}

        def call(cloud):
            return run(ready[id(cloud)])

        def numbers(cloud):
            ready[id(cloud)] = posed(scene, cloud, size)

        call.numbers = numbers
        return call

    return prepare


def contestants(scene: Scene, only: str) -> Iterator[tuple[str, Any]]:
    """Names that begin with ``only``, and what makes a function from a cloud to values."""
    return (entry for entry in everyone(scene) if entry[0].startswith(only))


def everyone(scene: Scene) -> Iterator[tuple[str, Any]]:
    for order in scene.orders:
        yield f"S {order}", ours("S", order)
    for method in ("I", "II", "III", "SSPH"):
        yield f"{method} 4", ours(method, 4)
    flat = scene.name != "ball"
    for name, make in (
        ("rbf 2", lambda: peers.rbf(2)), ("rbf 4", lambda: peers.rbf(4)), ("rbf 6", lambda: peers.rbf(6)),
        ("gfdm 4", lambda: peers.gfdm),
        *([("P1", lambda: peers.elements(1)), ("P2", lambda: peers.elements(2))] if flat else []),
        *([("9-point", lambda: peers.compact), ("findiff 4", lambda: peers.differences(4))] if scene.lattice else []),
        *([("updes r3", lambda: peers.dense(3, 1)), ("updes r7", lambda: peers.dense(7, 3))] if flat else []),
    ):  # fmt: skip
        try:
            yield name, theirs(make())
        except ImportError as error:
            print(f"{name}: left out, {error.name} is not installed")


# ------------------------------------------------------------------ the run


def measure(scene: Scene, make: Any, size: Any) -> dict[str, Any] | None:
    """Error, first call and median of the repeats; None where the contestant refuses the cloud."""
    cloud = scene.cloud(size)
    call = make(scene, cloud, size)
    seconds = []
    for k in range(REPEATS + 1):
        other = moved(cloud, k, scene)
        getattr(call, "numbers", lambda _: None)(other)
        start = time.perf_counter()
        try:
            u = np.asarray(jax.block_until_ready(call(other)))
        except (ValueError, js.SolveError, RuntimeError, np.linalg.LinAlgError):
            return None
        seconds.append(time.perf_counter() - start)
        if k and (seconds[k] > PATIENCE or sum(seconds[1:]) > 3 * PATIENCE):
            break
    exact = np.array(jax.vmap(scene.exact)(jnp.asarray(other.points)))
    error = float(np.linalg.norm(u - exact) / np.linalg.norm(exact))
    warm = float(np.median(seconds[1:])) if len(seconds) > 1 else None
    return {"particles": len(cloud), "error": error, "first": seconds[0], "warm": warm, "repeats": len(seconds) - 1}


def raced(scene: Scene, quick: bool, only: str) -> list[dict[str, Any]]:
    lines = []
    print(f"\n{scene.name}: {scene.about}\n{'':10}{'N':>8}{'error':>10}{'first':>9}{'repeats':>9}  seconds")
    for name, make in contestants(scene, only):
        for size in scene.sizes[: 4 if quick else None]:
            line = measure(scene, make, size)
            if line is None:
                continue
            lines.append({"scene": scene.name, "name": name, **line})
            shown = line["warm"] if line["warm"] is not None else math.nan
            print(f"{name:10}{line['particles']:8d}{line['error']:10.1e}{line['first']:9.3f}{shown:9.4f}", flush=True)
            slow = line["warm"] or line["first"]
            rival = name.split()[0] in ("I", "II", "III", "SSPH")
            if slow > PATIENCE / 2 or line["first"] > 2.5 * PATIENCE or (rival and slow > 1.0):
                break
    return lines


def quickest(lines: list[dict[str, Any]], scene: str, error: float, ours: bool) -> dict[str, Any] | None:
    """The run with the fewest seconds that reaches an error."""
    good = [
        line for line in lines
        if line["scene"] == scene and line["error"] <= error and line["warm"] and line["name"].startswith("S ") == ours
        and (ours or line["name"].split()[0] not in ("I", "II", "III", "SSPH"))
    ]  # fmt: skip
    return min(good, key=lambda line: line["warm"], default=None)


def table(lines: list[dict[str, Any]], about: dict[str, Any]) -> dict[str, Any]:
    """Seconds to reach an error, ours and the best of the others."""
    rows = []
    for scene in SCENES:
        for digits in (4, 6, 8, 10, 12):
            best = [quickest(lines, scene, 10.0**-digits, ours) for ours in (True, False)]
            if best[0] is not None:
                cells = [
                    "-" if b is None else f"{1e3 * b['warm']:.3g} ms ({b['name']}, {b['particles']} particles)"
                    for b in best
                ]
                ratio = f"{best[1]['warm'] / best[0]['warm']:.1f}" if best[1] else "-"
                rows.append([scene, f"1e-{digits}", *cells, ratio])
    note = (
        f"Milliseconds from arrays to values, medians of {REPEATS} repeats, on {about['cores']} cores of "
        f"{about['processor']} (`python -m benchmarks.pareto`). The first call compiles for 0.5 to 3 s more."
    )
    return {"columns": ["scene", "relative error", "method S", "best other", "ratio"], "rows": rows, "note": note}


def picture(lines: list[dict[str, Any]]) -> None:
    """Error against seconds, one panel for each scene."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scenes = [s for s in SCENES if any(line["scene"] == s for line in lines)]
    figure, axes = plt.subplots(1, len(scenes), figsize=(4.6 * len(scenes), 4.6), squeeze=False)
    colours = {"S": "#0072B2", "I": "#56B4E9", "II": "#56B4E9", "III": "#009E73", "SSPH": "#CC79A7"}
    for ax, scene in zip(axes[0], scenes):
        for name in dict.fromkeys(line["name"] for line in lines if line["scene"] == scene):
            run = [line for line in lines if line["scene"] == scene and line["name"] == name and line["warm"]]
            colour = colours.get(name.split()[0], "#E69F00" if name.startswith("rbf") else "#999999")
            style = "-" if name.split()[0] in colours else "--"
            ax.loglog([r["warm"] for r in run], [r["error"] for r in run], style, marker=".", color=colour, lw=1.2)
            if run:
                last = run[-1]
                ax.annotate(name, (last["warm"], last["error"]), fontsize=7, color=colour, xytext=(3, 0),
                            textcoords="offset points")  # fmt: skip
        ax.set(title=f"{scene}: {SCENES[scene].about}", xlabel="seconds", ylabel="relative L2 error", ylim=(1e-14, 1))
        ax.title.set_fontsize(9)
        ax.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(PICTURE, dpi=130)


def main(names: list[str], quick: bool, only: str) -> None:
    jax.config.update("jax_enable_x64", True)
    names = names or list(SCENES)
    kept = json.loads(DATA.read_text())["lines"] if DATA.exists() else []
    lines = [line for line in kept if line["scene"] not in names or not line["name"].startswith(only)]
    about = machine.describe()
    for name in names:
        lines += raced(SCENES[name], quick, only)
        made = table(lines, about)
        if not quick:  # after every scene: a run that is stopped keeps what it has
            data = {"machine": about, "lines": lines, "tables": {"accuracy": made}}
            DATA.write_text(json.dumps(data, indent=1) + "\n")
            picture(lines)
    print("\n" + "\n".join(" | ".join(row) for row in [made["columns"], *made["rows"]]))


if __name__ == "__main__":
    given = arguments(__doc__, "quick", "only=", names="scene")
    main(given.names, given.quick, given.only)
