"""What depth gains and costs: ``python -m benchmarks.depth [waves|named|cost|reach ...]``.

``waves``: error against particles a wavelength at depth 0, 2 and 4, for waves that the operator makes and for waves
that the source makes; draws docs/images/depth.png. ``named``: problems of other kinds, at depth 0 and at the default.
``cost``: seconds of a whole solve with depth over those without, in turn in one process. ``reach``: the least seconds
to an error, with depth and without. Writes benchmarks/data/depth.json.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks import machine, scenes
from benchmarks.commandline import arguments
from benchmarks.pareto import SCENES, moved
from benchmarks.problems import CASES, curved, slope, smooth

DATA = Path(__file__).parent / "data" / "depth.json"
PICTURE = Path(__file__).parent.parent / "docs" / "images" / "depth.png"
DEPTHS, ORDERS = (0, 2, 4), (4, 6, 8)
PER_WAVELENGTH = (3.0, 3.5, 4.0, 5.0, 6.0, 8.0, 10.0, 13.0)
SIDE, REPEATS = 33, 7


def relative(sol: js.Solution, exact: Callable[[Any], Any]) -> float:
    right = np.asarray(jax.vmap(exact)(sol.cloud.points))
    return float(np.linalg.norm(sol.u - right) / np.linalg.norm(right))


def solved(operator: Callable, exact: Callable, cloud: js.Cloud, source: bool = True, **options: Any) -> js.Solution:
    """Dirichlet values of the exact solution all around."""
    pde = (lambda u, x: operator(u, x) - operator(exact, x)) if source else operator
    held = {name: js.dirichlet(exact) for name in cloud.groups if name != "interior"}
    return js.solve(js.Problem(pde, held), cloud, **options)


def laplace(u: Any, x: Any) -> Any:
    return js.laplacian(u)(x)


# ------------------------------------------------------------------ particles a wavelength


def between_resonances(k: float) -> float:
    """A wave number near k in the middle of the widest gap between those of the unit square's own waves."""
    m = np.arange(1, 60)
    own = np.unique(np.round(np.pi * np.hypot(*np.meshgrid(m, m)), 9))
    near = own[np.abs(own - k) < 0.8]
    at = np.argmax(np.diff(near))
    return float((near[at] + near[at + 1]) / 2)


def waves() -> dict[str, Any]:
    """Lines (kind, order, depth, particles a wavelength, error)."""
    cloud, lines = js.rectangle((0, 0), (1, 1), (SIDE, SIDE), jitter=0.3), []
    for per in PER_WAVELENGTH:
        k = between_resonances(2 * np.pi * (SIDE - 1) / per)
        plane = lambda x, k=k: jnp.cos(k * (0.28 * x[0] + 0.96 * x[1]) + 0.5)
        helmholtz = lambda u, x, k=k: js.laplacian(u)(x) + k**2 * u(x)
        for order in ORDERS:
            for depth in DEPTHS:
                options = {"order": order, "depth": depth, "throw": False}
                for kind, sol in (
                    ("operator", solved(helmholtz, plane, cloud, source=False, **options)),
                    ("source", solved(laplace, plane, cloud, **options)),
                ):
                    line = {"kind": kind, "order": order, "depth": depth, "error": relative(sol, plane)}
                    lines.append(line | {"per wavelength": 2 * np.pi * (SIDE - 1) / k})
            print(per, order, *(f"{line['error']:.1e}" for line in lines[-2 * len(DEPTHS) :]), flush=True)
    draw(lines)
    return {"waves": lines}


def draw(lines: list[dict[str, Any]]) -> None:
    from matplotlib.figure import Figure

    titles = {"operator": "waves of the operator: Δu + k²u = 0", "source": "waves of the source: Δu = f"}
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for ax, (kind, title) in zip(axes, titles.items()):
        for order, colour in zip(ORDERS, ("#009E73", "#0072B2", "#CC79A7")):
            for depth, style in zip(DEPTHS, (":", "--", "-")):
                run = [v for v in lines if (v["kind"], v["order"], v["depth"]) == (kind, order, depth)]
                x, y = [v["per wavelength"] for v in run], [v["error"] for v in run]
                ax.loglog(x, y, style, color=colour, marker=".", ms=4, lw=1.3, label=f"order {order}, depth {depth}")
        ax.set(title=title, xlabel="particles a wavelength", ylim=(1e-11, 10))
        ax.set_xticks([3, 4, 5, 6, 8, 10, 13], ["3", "4", "5", "6", "8", "10", "13"], minor=False)
        ax.set_xticks([], minor=True)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("relative L2 error")
    axes[1].legend(fontsize=7, ncol=3, loc="lower left")
    figure.savefig(PICTURE, dpi=130)


# ------------------------------------------------------------------ problems of other kinds


def _bratu(order: int, depth: Any) -> tuple[js.Solution, str]:
    rate = 1.9
    b = float(min(np.roots([rate, 2 * rate - 8, rate]).real))
    exact = lambda x: 2 * jnp.log((1 + b) / (1 + b * (x @ x)))
    pde = lambda u, x: js.laplacian(u)(x) + rate * jnp.exp(u(x))
    sol = js.solve(js.Problem(pde, {"boundary": js.dirichlet(0.0)}), scenes.disk(0.121), order=order, depth=depth)
    return sol, f"{relative(sol, exact):.1e}"


def _turning(form: Any) -> Callable[[int, Any], tuple[js.Solution, str]]:
    """A wind that turns, cell Peclet number 20 at its mean speed."""

    def run(order: int, depth: Any) -> tuple[js.Solution, str]:
        cloud = js.rectangle((0, 0), (1, 1), (21, 21), jitter=0.3)
        wind = lambda x: jnp.array([0.5 - x[1], x[0] - 0.5])
        eps = 0.38 * 0.05 / 20
        operator = lambda u, x: wind(x) @ js.grad(u)(x) - eps * js.laplacian(u)(x)
        sol = solved(operator, smooth, cloud, order=order, depth=depth, formulation=form)
        return sol, f"{relative(sol, smooth):.1e}"

    return run


def _stokes(order: int, depth: Any) -> tuple[js.Solution, str]:
    case = CASES["stokes"]
    sol = case.solve(order, scenes.square(300, scattered="random"), depth=depth)
    return sol, f"{case.error(sol):.1e}, pressure {case.further['pressure'][0](case, sol):.1e}"


def _half_disk(order: int, depth: Any) -> tuple[js.Solution, str]:
    half = js.sdf.intersection(js.sdf.circle((0.0, 0.0), 1.0), js.sdf.rectangle((-2.0, 0.0), (2.0, 2.0)))
    sides = {"flat": lambda x: x[:, 1] < 1e-6, "arc": lambda x: x[:, 1] >= 1e-6}
    cloud = js.from_sdf(half, ((-1.1, -0.1), (1.1, 1.1)), 0.056, groups=sides)
    problem = js.Problem(
        lambda u, x: js.laplacian(u)(x) - js.laplacian(curved)(x), {"flat": slope(curved), "arc": js.dirichlet(curved)}
    )
    sol = js.solve(problem, cloud, order=order, depth=depth)
    return sol, f"{relative(sol, curved):.1e}"


def _resonant(order: int, depth: Any) -> tuple[js.Solution, str]:
    k = 30.0
    exact = lambda x: jnp.cos(k * (0.6 * x[0] + 0.8 * x[1]) + 0.3) + jnp.sin(k * (0.96 * x[1] - 0.28 * x[0]))
    operator = lambda u, x: js.laplacian(u)(x) + k**2 * u(x)
    sol = solved(operator, exact, scenes.disk(2 * np.pi / k / 5), source=False, order=order, depth=depth)
    return sol, f"{relative(sol, exact):.1e}"


def _oscillating(order: int, depth: Any) -> tuple[js.Solution, str]:
    exact = lambda x: jnp.sin(25 * x[0]) * jnp.cos(22 * x[1])
    sol = solved(laplace, exact, scenes.disk(0.03), order=order, depth=depth)
    return sol, f"{relative(sol, exact):.1e}"


NAMED: dict[str, tuple[Callable[[int, Any], tuple[js.Solution, str]], tuple[int, ...]]] = {
    "Bratu on the unit disk, lambda 1.9": (_bratu, (4, 6)),
    "a wind that turns, cell Péclet number 20, least squares": (_turning("lsq"), (4,)),
    "the same, leave-one-out": (_turning("loo"), (4,)),
    "Stokes flow on random particles": (_stokes, (6,)),
    "Poisson on the half disk, Neumann below": (_half_disk, (4, 6)),
    "Helmholtz, 5 particles a wavelength, k = 30 on the unit disk (resonances at 29.96, 30.03)": (_resonant, ORDERS),
    "sin 25x cos 22y by its source, spacing 0.03": (_oscillating, ORDERS),
}


def named() -> dict[str, Any]:
    rows = []
    for name, (run, orders) in NAMED.items():
        for order in orders:
            (flat, before), (deep, after) = run(order, 0), run(order, "auto")
            rows.append([name, order, len(flat.cloud), before, after, deep.depth])
            print(" | ".join(map(str, rows[-1])), flush=True)
    columns = ["problem", "order", "particles", "depth 0", "the default", "its depth"]
    note = "Relative L2 errors, method S (`python -m benchmarks.depth named`)."
    return {"tables": {"depth-named": {"columns": columns, "rows": rows, "note": note}}}


# ------------------------------------------------------------------ cost


def cost() -> dict[str, Any]:
    """Whole solves in turn, every one on particles moved by a trifle."""
    rows = []
    for name, order in [(name, order) for name in ("amoeba", "conductor") for order in ORDERS]:
        scene = SCENES[name]
        cloud, took = scene.cloud(0.028), {depth: [] for depth in (0, "auto")}
        for k in range(REPEATS + 1):
            other = moved(cloud, k, scene)
            for depth, some in took.items():
                start = time.perf_counter()
                js.solve(scene.problem(), other, order=order, depth=depth)
                some.append(time.perf_counter() - start)
        flat, deep = (1e3 * min(some[1:]) for some in took.values())
        rows.append([scene.about, order, len(cloud), f"{flat:.0f}", f"{deep:.0f}", f"{deep / flat:.2f}"])
        print(" | ".join(map(str, rows[-1])), flush=True)
    about = machine.describe()
    note = (
        f"Milliseconds of a whole solve, the least of {REPEATS} in turn, on {about['cores']} cores of "
        f"{about['processor']} (`python -m benchmarks.depth cost`)."
    )
    columns = ["problem", "order", "particles", "depth 0", "the default", "ratio"]
    return {"tables": {"depth-cost": {"columns": columns, "rows": rows, "note": note}}}


# Orders, spacings and errors at which the least seconds are looked for.
REACHED = {
    "conductor": ((4, 6, 8), (0.16, 0.13, 0.1, 0.08), (1e-6, 1e-8, 1e-10)),
    "waves": ((6, 8, 10), (0.06, 0.042, 0.028, 0.02), (1e-3, 1e-4, 1e-6)),
}


def reach() -> dict[str, Any]:
    """The quickest run that reaches an error, of all orders and spacings: with depth and without."""
    rows, lines = [], []
    for name, (orders, spacings, errors) in REACHED.items():
        scene = SCENES[name]
        for order, spacing in [(order, spacing) for order in orders for spacing in spacings]:
            cloud = scene.cloud(spacing)
            for depth in (0, "auto"):
                took = []
                for k in range(REPEATS // 2 + 1):
                    other = moved(cloud, k, scene)
                    start = time.perf_counter()
                    sol = js.solve(scene.problem(), other, order=order, depth=depth)
                    took.append(time.perf_counter() - start)
                line = {"scene": name, "order": order, "depth": depth, "particles": len(cloud)}
                lines.append(line | {"error": relative(sol, scene.exact), "seconds": min(took[1:])})
                print(*lines[-1].values(), flush=True)
        for error in errors:
            best = [_quickest(lines, name, depth, error) for depth in (0, "auto")]
            shown = "{:.3g} ms (order {}, {} particles)"
            cells = ["-" if b is None else shown.format(1e3 * b["seconds"], b["order"], b["particles"]) for b in best]
            ratio = "-" if None in best else f"{best[0]['seconds'] / best[1]['seconds']:.1f}"
            rows.append([scene.about, f"{error:.0e}", *cells, ratio])
    columns = ["problem", "relative error", "depth 0", "the default", "ratio"]
    note = f"Milliseconds of a whole solve, the least of {REPEATS // 2} (`python -m benchmarks.depth reach`)."
    return {"reach": lines, "tables": {"depth-reach": {"columns": columns, "rows": rows, "note": note}}}


def _quickest(lines: list[dict[str, Any]], scene: str, depth: Any, error: float) -> dict[str, Any] | None:
    good = [v for v in lines if (v["scene"], v["depth"]) == (scene, depth) and v["error"] <= error]
    return min(good, key=lambda v: v["seconds"], default=None)


EXPERIMENTS: dict[str, Callable[[], dict[str, Any]]] = {"waves": waves, "named": named, "cost": cost, "reach": reach}


def main(names: list[str]) -> None:
    jax.config.update("jax_enable_x64", True)
    unknown = sorted(set(names) - set(EXPERIMENTS))
    if unknown:
        sys.exit(f"no such experiment: {', '.join(unknown)}; there are {', '.join(EXPERIMENTS)}")
    for name in names or EXPERIMENTS:
        made = EXPERIMENTS[name]()
        data = json.loads(DATA.read_text()) if DATA.exists() else {"tables": {}}
        data["tables"] |= made.pop("tables", {})
        DATA.write_text(json.dumps(data | made | {"machine": machine.describe()}, indent=1) + "\n")


if __name__ == "__main__":
    main(arguments(__doc__, names="experiment").names)
