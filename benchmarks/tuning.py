"""Tuning a kernel without knowing the solution, against a grid search that knows it.

``python -m benchmarks.tuning [names] [--quick] [--again]`` tunes (h, d) of the paper's kernel with the
objective "estimate" from two starts, and one h per particle on clouds whose density varies 1:20 and 1:400.
It prints tables and writes ``benchmarks/data/tuning.json`` line by line: a run that was stopped goes on
where it was, ``names`` pick problems, ``--again`` makes their lines anew, ``--table`` only prints what is there.

Errors are relative L2 norms over all particles, in percent. ``grid`` is the 10th percentile of the true
error over a grid of (h, d) within the Lebesgue bound: a choice that needs the exact solution.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks.commandline import arguments
from benchmarks.machine import describe
from benchmarks.problems import CASES, Case, laplace
from jsmitsm.tuning.objective import nearest_distance, reference

DATA = Path(__file__).parent / "data" / "tuning.json"
STARTS = (0.7, 2.0)
METHODS = ("SSPH", "III", "S")
# Smoothing lengths in spacings and support radii of the grid; supports wider than REACH are left out.
GRID_H = np.geomspace(0.5, 2.2, 15)
GRID_D = np.geomspace(1.5, 6.0, 15)
REACH = 6.0
BOUND = 1.5


@dataclass(frozen=True)
class Setup:
    """A problem on a cloud, and another solution of the same operator and cloud.

    orders : the order of SSPH, III and S.
    spacing : that of the lattice, where the cloud is one that was jittered; else the smallest distance.
    """

    name: str
    case: Case
    cloud: Callable[[], js.Cloud]
    orders: tuple[int, int, int]
    other: Case | None = None
    smooth: bool = True
    spacing: float | None = None


def _setups() -> dict[str, Setup]:
    wave, skew = (lambda x: jnp.cos(0.8 * x[0] + 0.5) * jnp.cos(0.7 * x[1])), (lambda x: jnp.sin(7 * x[0] + 6 * x[1]))
    rod = lambda x: jnp.sin(2 * x[0]) + jnp.exp(x[0] / 2)
    wider = lambda x: jnp.exp(-((x[0] - 0.45) ** 2 + (x[1] - 0.55) ** 2) / 0.2**2)
    found = [
        _setup("rod (4.1)", "rod", (2, 2, 2), rod),
        _setup("plate (4.2)", "plate", (2, 2, 4)),
        _setup("source (4.3)", "source", (2, 2, 4), wave, {"bottom": js.neumann(0.0)}),
        _setup("oscillatory", "oscillatory", (2, 2, 4), skew),
        _setup("jittered", "jittered", (2, 2, 4), lambda x: jnp.cos(3 * x[0]) * jnp.exp(x[1]), spacing=1 / 13),
        _setup("narrow peak", "narrow peak", (2, 2, 4), wider),
        _setup("3D", "solid", (2, 2, 4), lambda x: jnp.cos(2 * x[0] + x[1]) * jnp.exp(-x[2]), spacing=1 / 6),
        _setup("3D wave", "solid wave", (2, 2, 4), lambda x: jnp.sin(3 * x[0] + 2 * x[1]) * jnp.cos(3 * x[2] + 0.3),
               spacing=1 / 7),
    ]
    return {s.name: s for s in found}


def _setup(name: str, case: str, orders: tuple[int, int, int], other: Any = None, bcs: Any = None,
           spacing: float | None = None) -> Setup:  # fmt: skip
    """A case of the table on its own cloud, and the other solution of its operator."""
    known = CASES[case]
    rest = None if other is None else known.solved_by(other, f"{case}, other", bcs)
    return Setup(name, known, known.cloud, orders, rest, known.smooth, spacing)


SETUPS = _setups()


@dataclass
class Bench:
    """One method on one setup: a solver of the setup's problem at any (h, d), h in spacings."""

    setup: Setup
    method: str
    order: int
    cloud: js.Cloud
    spacing: float
    solves: int = 0
    stencils: js.Stencils | None = field(default=None)

    def error(self, h: float, d: float, case: Case | None = None) -> tuple[float, float]:
        """True error in percent and largest Lebesgue constant; NaN where the solve fails."""
        case = case or self.setup.case
        kernel = js.SuperGaussian(h * self.spacing, d)
        options = {"method": self.method, "order": self.order, "stencils": self.stencils if h * d <= REACH else None}
        try:
            sol = js.solve(case.problem(), self.cloud, kernel=kernel, **options)
        except (js.SolveError, ValueError):  # singular, or too few neighbours
            return np.nan, np.nan
        return 100 * case.error(sol), float(sol.stats["lebesgue_max"])


def bench(setup: Setup, method: str) -> Bench:
    cloud = setup.cloud()
    spacing = setup.spacing or cloud.spacing
    order = setup.orders[METHODS.index(method)]
    return Bench(setup, method, order, cloud, spacing, stencils=js.stencils(cloud, radius=REACH * spacing * 1.0001))


def grid(b: Bench, thin: int = 1) -> list[tuple[float, float, float, float]]:
    """(h, d, error, Lebesgue constant) over the grid."""
    return [(h, d, *b.error(h, d)) for h in GRID_H[::thin] for d in GRID_D[::thin] if h * d <= REACH]


def tuned(b: Bench, start: float, **options: Any) -> dict[str, Any]:
    """Tune from h = start spacings, d = 4, and judge what came out by the exact solution."""
    begin = time.perf_counter()
    kernel = js.SuperGaussian(start * b.spacing, 4.0)
    found = js.tune(
        b.setup.case.problem(), b.cloud, kernel, method=b.method, order=b.order, progress=False, **options
    )
    h, d = float(found.kernel.h) / b.spacing, float(found.kernel.d)
    error, lebesgue = b.error(h, d)
    nearby = [b.error(h * a, d * c)[0] for a, c in ((1.01, 1), (0.99, 1), (1, 1.01), (1, 0.99))]
    out = {
        "h": h, "d": d, "start": b.error(start, 4.0)[0], "tuned": error, "lebesgue": lebesgue,
        "one_percent": max(abs(e / error - 1) if np.isfinite(e) else np.inf for e in nearby),
        "solves": found.solves, "seconds": time.perf_counter() - begin, "messages": found.messages,
        "history": {k: np.asarray(v).tolist() for k, v in found.history.items()},
    }  # fmt: skip
    if b.setup.other is not None:
        out["other"], out["other_paper"] = b.error(h, d, b.setup.other)[0], b.error(1.0, 4.0, b.setup.other)[0]
    return out


def reference_error(case: Case, cloud: js.Cloud, order: int) -> float:
    """True error in percent of the solution that "estimate" measures against."""
    values = reference(case.problem(), cloud, {"order": order})[0][:, 0]
    exact = case.values(cloud.points)
    return float(100 * np.linalg.norm(values - exact) / np.linalg.norm(exact))


def record(setup: Setup, method: str, quick: bool) -> dict[str, Any]:
    """Everything about one method on one setup."""
    b = bench(setup, method)
    paper, bounded = b.error(1.0, 4.0)
    points = grid(b, 3 if quick or b.cloud.dim == 3 else 1)
    bound = max(BOUND, bounded) if np.isfinite(bounded) else BOUND
    admitted = [e for *_, e, lebesgue in points if np.isfinite(e) and lebesgue <= bound]
    return {
        "setup": setup.name, "smooth": setup.smooth, "method": method, "order": b.order, "particles": len(b.cloud),
        "spacing": b.spacing, "lebesgue_bound": bound, "paper": paper, "untuned": b.error(0.8, 4.0)[0],
        "grid_best": min(admitted, default=np.nan),
        "grid_10th_percentile": float(np.quantile(admitted, 0.1)) if admitted else np.nan,
        "grid_solves": len(points), "grid": points, "reference": reference_error(setup.case, b.cloud, b.order),
        "runs": {str(h): tuned(b, h, steps=15 if quick else 50) for h in STARTS},
    }  # fmt: skip


def misses(entry: dict[str, Any], run: dict[str, Any]) -> list[str]:
    """Which of the bounds that a tuned kernel should keep it does not."""
    error, paper = run["tuned"], entry["paper"]
    if not entry["smooth"]:
        return [] if error <= 1.05 * max(paper, entry["reference"]) else ["paper or reference"]
    judged = {
        "grid": error <= 1.2 * entry["grid_10th_percentile"],
        "paper": not np.isfinite(paper) or error <= 0.8 * paper,
        "start": not np.isfinite(run["start"]) or error <= run["start"] * (1 + 1e-9),
        "1%": run["one_percent"] < 0.2,
        "other": "other" not in run or not np.isfinite(run["other_paper"]) or run["other"] < run["other_paper"],
    }
    # Marked where no kernel of the grid keeps it either.
    mark = {"paper": "*" if entry["grid_best"] > 0.8 * paper else ""}
    return [name + mark.get(name, "") for name, kept in judged.items() if not kept]


HEAD = f"{'problem':<14}{'method':<8}{'from':>5}{'start':>10}{'tuned':>10}{'grid':>10}{'h=0.8':>10}{'paper':>10}"
HEAD += f"{'reference':>11}{'solves':>8}{'(grid)':>8}  misses"


def lines(entry: dict[str, Any]) -> list[str]:
    """The table's lines of one method on one setup."""
    out = []
    for start, run in entry["runs"].items():
        numbers = (run["start"], run["tuned"], entry["grid_10th_percentile"], entry["untuned"], entry["paper"])
        out.append(
            f"{entry['setup']:<14}{entry['method'] + ' ' + str(entry['order']):<8}{start:>5}"
            + "".join(f"{x:>10.3g}" for x in numbers)
            + f"{entry['reference']:>11.3g}{run['solves']:>8}{entry['grid_solves']:>8}  {', '.join(misses(entry, run))}"
        )
    return out


# ------------------------------------------------------------------ one h per particle


@dataclass(frozen=True)
class Graded:
    """A cloud on the unit square, fine around one corner, and a solution as narrow as it is there.

    fine, coarse : spacings at the corner and opposite to it.
    """

    name: str
    fine: float
    coarse: float

    def cloud(self) -> js.Cloud:
        spacing = lambda x: self.fine + (self.coarse - self.fine) * np.hypot(*x.T) / np.sqrt(2)
        return js.from_sdf(js.sdf.box((0.0, 0.0), (1.0, 1.0)), ((0.0, 0.0), (1.0, 1.0)), spacing)

    def case(self, shift: float = 0.0) -> Case:
        """A logarithm with its pole a little outside of the corner."""
        near = 3 * self.fine

        def exact(x):
            square = (x[0] + near + shift) ** 2 + (x[1] + near + 0.5 * shift) ** 2
            return jnp.log(square) * (1.0 + x[0] * x[1])

        return Case(self.name, "laplacian(u) = f", laplace, exact, self.cloud, ("boundary",))


GRADED = {g.name: g for g in (Graded("density 1:20", 0.02, 0.09), Graded("density 1:400", 0.006, 0.12))}


def record_graded(g: Graded, method: str, quick: bool) -> dict[str, Any]:
    """The best scalar h that a grid finds, knowing the solution, against one tuned h per particle."""
    cloud, order = g.cloud(), (2, 2, 4)[METHODS.index(method)]
    own = nearest_distance(cloud.points)  # every particle's spacing
    everyone = js.stencils(cloud, size=len(cloud))
    cases = [g.case(), g.case(3 * g.fine)]
    problems = [case.problem() for case in cases]
    options = {"method": method, "order": order}

    def error(h: Any, d: float, which: int = 0, near: js.Stencils | None = None) -> tuple[float, float]:
        try:
            sol = js.solve(problems[which], cloud, kernel=js.SuperGaussian(h, d), stencils=near, **options)
        except (js.SolveError, ValueError):
            return np.nan, np.nan
        return 100 * cases[which].error(sol), float(sol.stats["lebesgue_max"])

    widest = own.max()
    ratios, radii = np.geomspace(0.4, 1.6, 4 if quick else 9), np.geomspace(1.6, 4.0, 3 if quick else 6)
    points = [(r, d, *error(r * widest, d, near=everyone)) for r in ratios for d in radii if 1.4 < r * d < 4.5]
    best = min((p for p in points if np.isfinite(p[2])), key=lambda p: p[2])
    runs = {}
    for start in STARTS:
        begin = time.perf_counter()
        kernel = js.SuperGaussian(start * own, 4.0)
        found = js.tune(problems[0], cloud, kernel, steps=15 if quick else 60, progress=False, **options)
        h, d = np.asarray(found.kernel.h), float(found.kernel.d)
        runs[str(start)] = {
            "start": error(start * own, 4.0)[0], "tuned": error(h, d)[0], "lebesgue": error(h, d)[1],
            "other": error(h, d, 1)[0], "solves": found.solves, "seconds": time.perf_counter() - begin,
            "d": d, "h_in_spacings": np.quantile(h / own, [0.0, 0.5, 1.0]).tolist(), "messages": found.messages,
            "objective": np.asarray(found.history["objective"]).tolist(),
        }  # fmt: skip
    return {
        "setup": g.name, "method": method, "order": order, "particles": len(cloud),
        "density_ratio": float((own.max() / own.min()) ** 2), "grid": points, "grid_solves": len(points),
        "scalar": best[2], "scalar_h": best[0] * widest, "scalar_d": best[1],
        "scalar_other": error(best[0] * widest, best[1], 1, everyone)[0],
        "graded": error(own, 4.0)[0], "graded_other": error(own, 4.0, 1)[0],
        "reference": reference_error(cases[0], cloud, order),
        "runs": runs,
    }  # fmt: skip


GRADED_HEAD = f"{'cloud':<15}{'method':<8}{'from':>5}{'start':>10}{'tuned':>10}{'scalar':>10}{'graded':>10}"
GRADED_HEAD += f"{'reference':>11}{'other':>10}{'(scalar)':>10}{'solves':>8}{'(grid)':>8}  misses"


def graded_lines(entry: dict[str, Any]) -> list[str]:
    """The lines of the table of per-particle h."""
    out = []
    for start, run in entry["runs"].items():
        judged = {
            "scalar": run["tuned"] < entry["scalar"], "other": run["other"] < entry["scalar_other"],
            "start": not run["tuned"] > run["start"] * (1 + 1e-9), "graded": run["tuned"] < entry["graded"],
        }  # fmt: skip
        numbers = run["start"], run["tuned"], entry["scalar"], entry["graded"], entry["reference"]
        out.append(
            f"{entry['setup']:<15}{entry['method'] + ' ' + str(entry['order']):<8}{start:>5}"
            + "".join(f"{x:>{w}.3g}" for x, w in zip(numbers, (10, 10, 10, 10, 11)))
            + f"{run['other']:>10.3g}{entry['scalar_other']:>10.3g}{run['solves']:>8}{entry['grid_solves']:>8}  "
            + ", ".join(name for name, kept in judged.items() if not kept)
        )
    return out


# ------------------------------------------------------------------ all of it

ABOUT = """Relative L2 errors in percent. start: h = 0.7 or 2 spacings, d = 4; grid: 10th percentile of a grid that
knows the solution; paper: h = 1 spacing, d = 4; reference: what "estimate" measures from; misses: the bounds not kept,
namely tuned at most 1.2 grid, 0.8 paper, start; less than 20 % change by 1 % of h or d; better than paper on
another solution of the same cloud; with the jump of 4.2 at most 1.05 of paper or reference. * : no kernel of the whole
grid keeps it.
"""
ABOUT_GRADED = """
One h per particle. start: 0.7 or 2 times every particle's own spacing; scalar: the best single h (and d) of a grid
that knows the solution; graded: h = every particle's own spacing, d = 4; other: another solution of the same cloud.
"""


def _short(x: Any) -> Any:
    """Numbers to six digits, everywhere inside."""
    if isinstance(x, dict):
        return {k: _short(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_short(v) for v in x]
    return float(f"{x:.6g}") if isinstance(x, float) else x


def tables(results: list[dict[str, Any]]) -> dict[str, Any]:
    """The two tables for the documentation (``python -m benchmarks.readme`` puts them there)."""
    percent = lambda x: "-" if not np.isfinite(x) else f"{x:.2g}"
    even, graded = [], []
    for e in results:
        for start, run in e["runs"].items():
            head = [e["setup"], f"{e['method']} {e['order']}", start]
            if e["setup"] in SETUPS:
                keys = ("grid_10th_percentile", "untuned", "paper", "reference")
                numbers = (run["start"], run["tuned"], *(e[k] for k in keys))
                missed = ", ".join(misses(e, run))
                even.append([*head, *map(percent, numbers), run["solves"], e["grid_solves"], missed])
            else:
                best = (e[k] for k in ("scalar", "graded", "reference"))
                numbers = (run["start"], run["tuned"], *best, run["other"], e["scalar_other"])
                graded.append([*head, *map(percent, numbers), run["solves"], e["grid_solves"]])
    return {
        "tuning": {
            "columns": ["problem", "method", "from h =", "start", "tuned", "grid", "h = 0.8", "paper", "reference",
                        "solves", "(grid)", "missed"],
            "rows": even,
            "note": " ".join(ABOUT.split()).replace("* :", "\\*:"),
        },
        "tuning-graded": {
            "columns": ["cloud", "method", "from h =", "start", "tuned", "scalar", "graded", "reference", "other",
                        "(scalar)", "solves", "(grid)"],
            "rows": graded,
            "note": " ".join(ABOUT_GRADED.split()),
        },
    }  # fmt: skip


def write(kept: dict[tuple[str, str], Any]) -> None:
    """All lines in their order, and the tables made of them."""
    order = [(n, m) for n in (*SETUPS, *GRADED) for m in METHODS]
    results = [_short(kept[k]) for k in order if k in kept]
    DATA.write_text(json.dumps({"machine": describe(), "tables": tables(results), "results": results}) + "\n")


def main(wanted: list[str], quick: bool, again: bool, only_table: bool) -> None:
    jax.config.update("jax_enable_x64", True)
    names = [n for n in (*SETUPS, *GRADED) if not wanted or any(w in n for w in wanted)]
    before = [] if quick or not DATA.exists() else json.loads(DATA.read_text())["results"]
    kept = {(e["setup"], e["method"]): e for e in before}
    head = None
    for name in names[:2] if quick and not wanted else names:
        new_head = ABOUT + "\n" + HEAD if name in SETUPS else ABOUT_GRADED + "\n" + GRADED_HEAD
        if new_head != head:
            print(head := new_head)
        for method in METHODS:
            key = name, method
            if not only_table and (key not in kept or again):
                make = record if name in SETUPS else record_graded
                kept[key] = make((SETUPS | GRADED)[name], method, quick)
                jax.clear_caches()  # hundreds of compiled programs otherwise
                if not quick:
                    write(kept)
            if key in kept:
                print("\n".join((lines if name in SETUPS else graded_lines)(kept[key])), flush=True)
    if only_table:
        write(kept)


if __name__ == "__main__":
    given = arguments(__doc__, "quick", "again", "table", names="name")
    main(given.names, given.quick, given.again, given.table)
