"""From a shape to the answer, beside high-order elements: ``python -m benchmarks.from_shape [--explore] [scene ...]``.

Six scenes, four errors. Method S has its best order and spacing for each of them, NGSolve its best degree and mesh
size (``pip install ngsolve``). Two clocks: from the shape (cloud or mesh made anew, then everything up to the values),
and from the finished cloud or mesh. What is warm is compiled programs: shapes, clouds, meshes, problems are made anew
for every repeat, clouds with another seed.

``--explore`` solves on finer and finer clouds and meshes and keeps, for every order and error, the coarsest that
reaches it (small clouds with three seeds; NGSolve's meshes know no seed). Without it these are raced, ours and theirs
in turns; the least seconds of the repeats count. Errors are relative L2: ours over the particles, theirs over the
domain.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jsmitsm as js
from benchmarks import hp_elements, machine, scenes
from benchmarks.commandline import arguments
from benchmarks.problems import CASES, Case
from benchmarks.problems.case import laplace

DATA = Path(__file__).parent / "data" / "from_shape.json"
PICTURE = Path(__file__).parent.parent / "docs" / "images" / "from_shape.png"
ERRORS = (1e-4, 1e-6, 1e-8, 1e-10)
# From one size to the next finer one; seeds of ours that must reach an error, of clouds up to so many particles.
FINER, SEEDS, FEW = 0.84, 3, 1000
# No more unknowns than so many are explored, and not so many times those of another order.
LARGEST, MANY = 60_000, 6
# Those that are not near the quickest of their side are left after a few runs, and all that take so many seconds.
REPEATS, SECOND_LOOK, SLOW = 9, 3, 0.4
FLAT, SOLID = (4, 6, 8, 10, 12, 14), (4, 5, 6, 7, 8, 9, 10)


@dataclass(frozen=True)
class Scene:
    """case : its equation and exact solution; cloud : of a spacing and a seed, the shape written anew.

    coarsest : spacing and element size to begin with.
    """

    case: Case
    cloud: Callable[[float, int], js.Cloud]
    coarsest: tuple[float, float]
    dim: int = 2


def _disk(spacing: float, seed: int) -> js.Cloud:
    return js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.1, -1.1), (1.1, 1.1)), spacing, seed=seed)


def _amoeba(spacing: float, seed: int) -> js.Cloud:
    return js.from_sdf(lambda x: scenes.amoeba_level(x), ((-1.3, -1.3), (1.3, 1.3)), spacing, seed=seed)


def _plate(spacing: float, seed: int) -> js.Cloud:
    shape = js.sdf.difference(
        js.sdf.rectangle((0.0, 0.0), (3.0, 2.0)), js.sdf.circle((0.9, 1.2), 0.35), js.sdf.circle((2.1, 0.7), 0.45)
    )
    return js.from_sdf(shape, ((0.0, 0.0), (3.0, 2.0)), spacing, seed=seed)


def _ball(spacing: float, seed: int) -> js.Cloud:
    return js.from_sdf(js.sdf.sphere((0.0, 0.0, 0.0), 1.0), ((-1.1,) * 3, (1.1,) * 3), spacing, seed=seed)


def _solid(x: Any) -> Any:
    return jax.numpy.exp(x[0]) * jax.numpy.sin(2.0 * x[1]) * jax.numpy.cos(x[2])


def _held(name: str, exact: Callable[[Any], Any] | None = None, operator: Any = None) -> Case:
    """A case of the table with all of its boundary in one group."""
    case = CASES[name]
    return Case(name, case.about, operator or case.operator, exact or case.exact, case.cloud, ("boundary",))


SCENES = {
    "disk": Scene(_held("amoeba"), _disk, (0.5, 1.4)),
    "amoeba": Scene(_held("amoeba"), _amoeba, (0.4, 1.0)),
    "waves": Scene(_held("oscillating disk"), _disk, (0.10, 0.6)),
    "ball": Scene(_held("smooth ball", _solid, laplace), _ball, (0.5, 1.0), 3),
    "plate": Scene(_held("two holes"), _plate, (0.3, 1.0)),
    "conductor": Scene(_held("conducting amoeba"), _amoeba, (0.35, 1.0)),
}


# ------------------------------------------------------------------ both sides


def ours(scene: Scene, order: int, size: float, seed: int) -> tuple[float, float, Any]:
    """Seconds of the cloud, seconds from there to the values, and the solution."""
    start = time.perf_counter()
    cloud = scene.cloud(size, seed)
    made = time.perf_counter()
    sol = js.solve(scene.case.problem(), cloud, order=order)
    np.asarray(sol.u)
    return made - start, time.perf_counter() - made, sol


def attempt(name: str, side: str, order: int, size: float, seed: int) -> dict[str, Any] | None:
    """One run; None where it is refused."""
    scene = SCENES[name]
    try:
        if side == "ours":
            made, solved, sol = ours(scene, order, size, seed)
            error, unknowns = scene.case.error(sol), len(sol.cloud)
        else:
            theirs = hp_elements.scenes()[name]
            made, solved, answer = hp_elements.run(theirs, order, size)
            error, unknowns = hp_elements.error(theirs, answer, order), hp_elements.unknowns(answer)
    except (ValueError, js.SolveError, RuntimeError):
        return None
    return {"made": made, "solved": solved, "error": error, "unknowns": unknowns}


def explored(name: str, side: str) -> list[dict[str, Any]]:
    """For every order and error the coarsest size that reaches it."""
    scene, found = SCENES[name], []
    few: dict[float, float] = {}  # the least unknowns that reached an error
    orders = (FLAT if scene.dim == 2 else SOLID) if side == "ours" else range(4, 15 if scene.dim == 2 else 11)
    for order in reversed(orders):
        size, left = scene.coarsest[side == "theirs"], list(ERRORS)
        while left:
            runs = [attempt(name, side, order, size, 0)]
            if side == "ours" and (runs[0] is None or runs[0]["unknowns"] <= FEW):
                runs += [attempt(name, side, order, size, seed) for seed in range(1, SEEDS)]
            good = [r for r in runs if r is not None]
            if len(good) == len(runs):
                worst = max(good, key=lambda r: r["error"])
                while left and worst["error"] <= left[0]:
                    few[left[0]] = min(worst["unknowns"], few.get(left[0], np.inf))
                    found.append({"side": side, "order": order, "size": size, "target": left.pop(0), **worst})
                    shown = f"{name:10}{side:8}{order:3d}{size:8.3f}{worst['unknowns']:7d}{worst['error']:10.1e}"
                    print(shown, flush=True)
                if worst["unknowns"] > LARGEST or (left and worst["unknowns"] > MANY * few.get(left[0], np.inf)):
                    break
            size *= FINER
            if size < 0.02 * scene.coarsest[side == "theirs"]:
                break
    return found


def raced(name: str, entries: list[dict[str, Any]], target: float) -> dict[str, dict[str, Any]]:
    """The quickest way of each side to an error, all of them in turns."""
    runners = [e | {"runs": []} for e in entries if e["target"] == target]
    for k in range(REPEATS):
        for runner in runners:
            least = min((_whole(r) for r in runners if r["side"] == runner["side"] and r["runs"]), default=np.inf)
            if k >= SECOND_LOOK and (_whole(runner) > 1.3 * least or least > SLOW):
                continue
            one = attempt(name, runner["side"], runner["order"], runner["size"], 100 + k)
            if one is not None:
                runner["runs"].append(one)
    best = {}
    for side in ("ours", "theirs"):
        mine = [r for r in runners if r["side"] == side and len(r["runs"]) >= SECOND_LOOK]
        mine = [r for r in mine if np.median([one["error"] for one in r["runs"]]) <= target]
        for clock, of in (("whole", _whole), ("solve", _solve)):
            if mine:
                best[f"{side} {clock}"] = _summary(min(mine, key=of))
    return best


def _whole(runner: dict[str, Any]) -> float:
    return min((r["made"] + r["solved"] for r in runner["runs"]), default=np.inf)


def _solve(runner: dict[str, Any]) -> float:
    return min((r["solved"] for r in runner["runs"]), default=np.inf)


def _summary(runner: dict[str, Any]) -> dict[str, Any]:
    return {
        "order": runner["order"], "size": runner["size"], "unknowns": runner["runs"][-1]["unknowns"],
        "error": float(np.median([r["error"] for r in runner["runs"]])), "whole": _whole(runner),
        "solve": _solve(runner), "repeats": len(runner["runs"]),
    }  # fmt: skip


# ------------------------------------------------------------------ the table


def table(lines: dict[str, Any], about: dict[str, Any]) -> dict[str, Any]:
    rows = []
    for name in SCENES:
        for error in ERRORS:
            best = _quickest(lines.get(name, {}), error)
            if best:
                cells = [_cell(best, side, clock) for clock in ("whole", "solve") for side in ("ours", "theirs")]
                ratios = [_ratio(best, clock) for clock in ("whole", "solve")]
                rows.append([name, f"{error:.0e}", *cells[:2], ratios[0], *cells[2:], ratios[1]])
    note = (
        f"Milliseconds, least of {REPEATS}, warm, on {about['cores']} cores of {about['processor']}, NGSolve "
        f"{about.get('ngsolve', '')} (`python -m benchmarks.from_shape`); in brackets order and particles, degree and "
        "unknowns. Ratios above 1: method S is ahead."
    )
    clocks = "shape to answer", "cloud or mesh to answer"
    columns = ["scene", "error", *(part for clock in clocks for part in (f"{clock}: S", "NGSolve", "ratio"))]
    return {"columns": columns, "rows": rows, "note": note}


def _quickest(lines: dict[str, Any], error: float) -> dict[str, Any]:
    """The quickest way of each side and clock to an error; what reached a smaller one reached this too."""
    best: dict[str, Any] = {}
    for target, found in lines.items():
        for which, one in found.items() if float(target) <= error * 1.01 else ():
            clock = which.split()[1]
            if which not in best or one[clock] < best[which][clock]:
                best[which] = one
    return best


def _cell(best: dict[str, Any], side: str, clock: str) -> str:
    one = best.get(f"{side} {clock}")
    return "-" if one is None else f"{1e3 * one[clock]:.3g} ({one['order']}, {one['unknowns']})"


def _ratio(best: dict[str, Any], clock: str) -> str:
    ours, theirs = best.get(f"ours {clock}"), best.get(f"theirs {clock}")
    return f"{theirs[clock] / ours[clock]:.2g}" if ours and theirs else "-"


def picture(lines: dict[str, Any]) -> None:
    """Error against milliseconds, one panel for each scene."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(11, 6.2), sharey=True)
    for ax, name in zip(axes.ravel(), SCENES):
        for side, label, colour in (("ours", "method S", "#0072B2"), ("theirs", "NGSolve", "#E69F00")):
            for clock, style in (("whole", "-"), ("solve", ":")):
                found = [_quickest(lines.get(name, {}), error).get(f"{side} {clock}") for error in ERRORS]
                found = [one for one in found if one]
                what = f"{label}, from the {'shape' if clock == 'whole' else 'cloud or mesh'}"
                x, y = [1e3 * one[clock] for one in found], [one["error"] for one in found]
                ax.loglog(x, y, style, marker=".", color=colour, label=what)
        ax.set(title=name, xlim=(1, 4000), ylim=(1e-12, 1e-3))
        ax.grid(alpha=0.3)
    for ax in axes[:, 0]:
        ax.set_ylabel("relative L2 error")
    for ax in axes[1]:
        ax.set_xlabel("milliseconds")
    axes[0, 0].legend(fontsize=7, loc="upper right")
    figure.tight_layout()
    figure.savefig(PICTURE, dpi=110)


def main(names: list[str], explore: bool, side: str) -> None:
    jax.config.update("jax_enable_x64", True)
    if not hp_elements.available():
        raise SystemExit("NGSolve is not installed: pip install ngsolve")
    hp_elements.threads(machine.cores())
    for name in names or list(SCENES):
        if explore:
            for one in [side] if side else ["ours", "theirs"]:
                found = explored(name, one)
                data = _data()
                kept = [e for e in data["explored"].get(name, []) if e["side"] != one]
                data["explored"][name] = kept + found
                _write(data)
        else:
            entries = _data()["explored"][name]
            lines = {f"{error:.0e}": raced(name, entries, error) for error in ERRORS}
            data = _data()
            data["lines"][name] = lines
            data["machine"] = machine.describe() | {"ngsolve": hp_elements.ngsolve.__version__}
            made = table(data["lines"], data["machine"])
            data["tables"] = {"from-shape": made}
            _write(data)
            picture(data["lines"])
            print("\n".join(" | ".join(row) for row in made["rows"] if row[0] == name), flush=True)


def _data() -> dict[str, Any]:
    """What is there by now: scenes may run beside one another."""
    return json.loads(DATA.read_text()) if DATA.exists() else {"explored": {}, "lines": {}}


def _write(data: dict[str, Any]) -> None:
    DATA.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    given = arguments(__doc__, "explore", "side=", names="scene")
    main(given.names, given.explore, given.side)
