"""The paper's tables and figures, beside this run's: ``python -m benchmarks.paper`` (under three minutes).

Solves the three problems of Karamanli (2015) with SMITSM I, II, III, SSPH and S; prints Tables 1
to 5 with the paper's number, this run's and the seconds, then the data of Figures 3 to 15, the
stability limits, run times, and the claim the paper rests on: SMITSM ahead of SSPH under
nonsmooth sources. Writes benchmarks/data/paper.json and pictures into benchmarks/figures.
``--quick`` stops after the tables and writes nothing.
"""

from __future__ import annotations

import argparse
import json
import math
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jsmitsm as js
from benchmarks import machine, problems, published
from benchmarks.problems import CASES, Case

HERE = Path(__file__).parent
METHODS = ("I", "II", "III", "SSPH", "S")

# The rows of Table 5: label, method, order, free coefficients kept.
PLATE_ROWS = (
    ("I", "I", 3, 6),
    ("II", "II", 3, 6),
    ("III", "III", 3, 6),
    ("SSPH", "SSPH", 2, None),
    ("I, seven", "I", 3, None),
    ("II, seven", "II", 3, None),
    ("S, seven", "S", 3, None),
)

# Figures 7 to 15, in spacings. I and II on 629 particles need gigabytes at the widest supports,
# so that they get one of them, the widest the paper calls stable.
RADII = (2.0, 2.5, 3.0, 3.5, 4.0, 5.0)
LENGTHS = (0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.2, 2.4)
FEW_LENGTHS = (0.6, 0.8, 1.0, 1.2, 2.2)
SLOPE_LENGTHS = (0.8, 1.0, 1.2)


# ------------------------------------------------------------------ one solve


@dataclass(frozen=True)
class Job:
    """One solve with the paper's kernel; ``h`` and ``reach`` in spacings of the cloud.

    reach: the radius of stencils that several jobs share, so that one compiled program serves
    them all; None takes the support itself.
    """

    case: Case
    shape: Any
    method: str
    order: int
    d: float
    h: float = 1.0
    basis_terms: int | None = None
    reach: float | None = None

    def ready(self) -> Callable[[], js.Solution]:
        """The solve with everything before it done, so that a clock sees nothing else."""
        cloud, problem = self.case.cloud(self.shape, jitter=0.0), self.case.problem()  # lattices, as the paper's
        near = None if self.reach is None else js.stencils(cloud, radius=self.reach * cloud.spacing)
        kernel = js.SuperGaussian(h=self.h * cloud.spacing, d=self.d)
        return lambda: js.solve(
            problem, cloud, method=self.method, order=self.order, basis_terms=self.basis_terms, kernel=kernel,
            stencils=near, depth=0,
        )  # fmt: skip


@dataclass
class Result:
    """Percent of error, None where the solve was refused; seconds; the values."""

    percent: float | None
    seconds: float
    u: np.ndarray | None = None
    said: str = ""


def run(job: Job) -> Result:
    """Solve and compare; a refusal is a result, too."""
    solve = job.ready()
    start = time.perf_counter()
    try:
        sol = solve()
        u = np.asarray(sol.u)
    except (js.SolveError, ValueError) as fault:
        return Result(None, time.perf_counter() - start, said=str(fault))
    seconds = time.perf_counter() - start
    return Result(100 * job.case.error(sol), seconds, u)


def run_all(jobs: Sequence[Job]) -> list[Result]:
    """All jobs, two at a time where there are two cores: most of a first call is compilation."""
    with ThreadPoolExecutor(min(2, machine.cores())) as pool:
        return list(pool.map(run, jobs))


@contextmanager
def compiled_fast() -> Iterator[None]:
    """Spend less on compiling: for measurements of errors, where nobody looks at the clock."""
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", False)


# ------------------------------------------------------------------ Tables 1 to 5


def rod_job(terms: int, method: str, nodes: int) -> Job:
    """An entry of Tables 1 to 4; the paper counts Taylor terms."""
    d = published.SSPH_SUPPORT[terms] if method == "SSPH" else 2.0
    return Job(CASES["rod"], nodes, method, terms - 1, d)


def plate_job(row: tuple[str, str, int, int | None], grid: tuple[int, int]) -> Job:
    """An entry of Table 5; its six terms are free coefficients for I, II and III."""
    _, method, order, basis_terms = row
    return Job(CASES["plate"], grid, method, order, 4.0, basis_terms=basis_terms)


def entries(keys: Iterable[Any], make: Callable[..., Job], paper: Callable[..., float | None]) -> list[dict[str, Any]]:
    """Paper's number, this run's, and seconds of a first and a second call, for every key."""
    keys = list(keys)
    jobs = [make(*key) for key in keys]
    first = run_all(jobs)
    again = [run(job).seconds for job in jobs]  # one at a time: these are compared
    return [
        {"key": key, "paper": paper(*key), "here": r.percent, "first": r.seconds, "again": s, "u": r.u, "said": r.said}
        for key, r, s in zip(keys, first, again)
    ]


def rod_tables() -> dict[int, list[dict[str, Any]]]:
    keys = [(t, m, n) for t in published.RODS for m in METHODS for n in published.NODES]

    def paper(terms, method, nodes):
        return published.RODS[terms].get(method, (None,) * 3)[published.NODES.index(nodes)]

    made = entries(keys, rod_job, paper)
    return {terms: [e for e in made if e["key"][0] == terms] for terms in published.RODS}


def plate_table() -> list[dict[str, Any]]:
    def paper(row, grid):
        return published.PLATE.get(row[0].split(",")[0], (None,) * 3)[published.GRIDS.index(grid)]

    return entries([(row, grid) for row in PLATE_ROWS for grid in published.GRIDS], plate_job, paper)


def shown(percent: float | None) -> str:
    if percent is None:
        return "none"
    return f"{percent:.2g}" if percent < 1e-4 else f"{percent:.5g}"


def table(columns: Sequence[str], rows: Sequence[Sequence[Any]], note: str) -> dict[str, Any]:
    return {"columns": list(columns), "rows": [list(map(str, row)) for row in rows], "note": note}


def printed(name: str, made: dict[str, Any], more: Iterable[str] = ()) -> None:
    """A table with aligned columns, its note above and remarks below."""
    print()
    print(textwrap.fill(f"{name}{'' if name.endswith('?') else '.'} {made['note']}", 118))
    lines = [made["columns"], *made["rows"]]
    widths = [max(len(line[k]) for line in lines) for k in range(len(made["columns"]))]
    for line in lines:
        cells = (cell.ljust(w) if k == 0 else cell.rjust(w) for k, (cell, w) in enumerate(zip(line, widths)))
        print(("  " + "  ".join(cells)).rstrip())
    for remark in dict.fromkeys(more):
        print(textwrap.fill(remark, 118, initial_indent="  * ", subsequent_indent="    "))


def comparison(found: list[dict[str, Any]], note: str) -> dict[str, Any]:
    """Paper, this run, and seconds, a row for every entry; * marks what differs."""
    rows = []
    for e in found:
        plain = _plain(e)
        ours = plain["method"].startswith("S,") or plain["method"] == "S"
        rows.append([
            plain["method"], plain["nodes"], "" if ours else shown(e["paper"]), shown(e["here"]),
            "" if ours or published.reproduced(e["paper"], e["here"]) else "*",
            f"{e['first']:.2f}", f"{e['again']:.4f}",
        ])  # fmt: skip
    return table(["method", "nodes", "paper", "here", "", "first s", "again s"], rows, note)


def print_tables(rods: dict[int, list[dict[str, Any]]], plate: list[dict[str, Any]]) -> dict[str, Any]:
    """Print Tables 1 to 5; returns them by name."""
    made = {}
    for terms, found in rods.items():
        note = f"u'' = x^3 on [0, 2], {terms} terms (order {terms - 1}); relative L2 error in percent"
        made[f"paper-{terms - 2}"] = comparison(found, note)
        off = {e["key"][1] for e in found if not published.reproduced(e["paper"], e["here"])}
        why = [published.WHY_RODS[terms, m] for m in METHODS if m in off and (terms, m) in published.WHY_RODS]
        printed(f"Table {terms - 2}", made[f"paper-{terms - 2}"], why)
    note = "Laplace's equation on [0, 4] x [0, 9], 100 on top, six terms; relative L2 error in percent"
    made["paper-5"] = comparison(plate, note)
    seven = "seven: all free coefficients of order 3, where six keep (0,0) (1,0) (0,1) (2,0) (1,1) (3,0)."
    printed("Table 5", made["paper-5"], (*published.WHY_PLATE.values(), seven))
    return made


# ------------------------------------------------------------------ Figures 3 to 5


def temperatures(plate: list[dict[str, Any]]) -> dict[str, Any]:
    """Temperatures along x = 2, from the solutions of Table 5."""
    lines = {}
    for grid in published.GRIDS:
        points = np.asarray(CASES["plate"].cloud(grid).points)
        on = np.flatnonzero(np.abs(points[:, 0] - 2.0) < 1e-9)
        on = on[np.argsort(points[on, 1])]
        line = {"y": points[on, 1], "exact": CASES["plate"].values(points[on])}
        for e in plate:
            if e["key"][1] == grid and e["u"] is not None and e["key"][0][3] != 7:
                line[e["key"][0][0]] = e["u"][on]
        lines[str(grid[0] * grid[1])] = {name: np.round(v, 6).tolist() for name, v in line.items()}
    return lines


def print_temperatures(lines: dict[str, Any]) -> None:
    for k, (nodes, line) in enumerate(lines.items()):
        names = [n for n in line if n == "y" or n == "exact" or n in METHODS or n == "S, seven"]
        step = 2 if len(line["y"]) > 20 else 1
        rows = [[f"{line[n][i]:.4g}" for n in names] for i in range(0, len(line["y"]), step)]
        every = ", every second particle" if step == 2 else ""
        printed(f"Figure {3 + k}", table(names, rows, f"temperature along x = 2, {nodes} nodes{every}"))


# ------------------------------------------------------------------ Figures 7 to 15


def sweep_jobs(grid: tuple[int, int], method: str) -> dict[str, list[tuple[float, Job]]]:
    """The jobs of one curve against d and one against h."""
    heavy = method in ("I", "II") and grid == published.GRIDS[-1]
    reach = 5.0 if heavy else 4.0 * max(LENGTHS)

    def job(h, d):
        return Job(CASES["source"], grid, method, 2, d, h, reach=reach if h * d <= reach else None)

    lengths = FEW_LENGTHS if heavy else LENGTHS
    return {"d": [(d, job(1.0, d)) for d in RADII], "h": [(h, job(h, 4.0)) for h in lengths]}


def sweeps() -> dict[str, Any]:
    """Error against the support radius d and against the smoothing length h, problem 4.3, order 2."""
    curves = [(grid, m, sweep_jobs(grid, m)) for grid in published.GRIDS for m in METHODS]
    curves.sort(key=lambda c: -c[0][0] * (2 if c[1] in ("I", "II") else 1))  # the longest first: two at a time

    def trace(curve):
        grid, method, jobs = curve
        done = {axis: {str(x): run(job).percent for x, job in pairs} for axis, pairs in jobs.items()}
        return str(grid[0] * grid[1]), method, done

    found: dict[str, Any] = {str(a * b): {} for a, b in published.GRIDS}
    with compiled_fast(), ThreadPoolExecutor(min(2, machine.cores())) as pool:
        for nodes, method, done in pool.map(trace, curves):
            found[nodes][method] = done
    return found


def stability_limit(curve: dict[str, float | None]) -> tuple[float, bool]:
    """The largest h up to which the error grows no faster than h^4, and whether the sweep ends there.

    An order-2 truncation error grows like h^2; twice that says that something else is at work.
    """
    points = sorted((float(h), e) for h, e in curve.items() if float(h) >= 1.0)
    for (h, e), (h_next, e_next) in zip(points, points[1:]):
        if e is None or e_next is None or math.log(e_next / e) > 4 * math.log(h_next / h):
            return h, False
    return points[-1][0], True


def rate(curve: dict[str, float | None]) -> float:
    """The slope of log error against log h on one cloud."""
    errors = [curve[str(h)] or math.nan for h in SLOPE_LENGTHS]
    return float(np.polyfit(np.log(SLOPE_LENGTHS), np.log(errors), 1)[0])


def print_sweeps(found: dict[str, Any]) -> dict[str, Any]:
    """Print the data of Figures 7 to 15 and the stability limits."""
    made: dict[str, Any] = {}
    for axis, start, values, what in (
        ("d", 7, RADII, "error in percent against the support radius d, h = spacing"),
        ("h", 10, LENGTHS, "error in percent against the smoothing length h in spacings, d = 4"),
    ):
        for k, (nodes, curves) in enumerate(found.items()):
            rows = [
                [m, *(shown(curves[m][axis][str(v)]) if str(v) in curves[m][axis] else "" for v in values)]
                for m in METHODS
            ]
            printed(f"Figure {start + k}", table(["method", *map(str, values)], rows, f"{what}, {nodes} nodes"))
    rows = []
    for m in METHODS:
        cells = [m]
        for nodes in found:
            limit, ended = stability_limit(found[nodes][m]["h"])
            cells += [str(published.STABLE.get(int(nodes), {}).get(m, "")), f"{limit} +" if ended else str(limit)]
        rows.append(cells)
    note = "Stable up to h (spacings): the error grows no faster than h^4; + is the end of the sweep"
    made["paper-stability"] = table(["method", *(c for n in found for c in (f"{n}: paper", "here"))], rows, note)
    printed("Figures 10 to 12, limits", made["paper-stability"])
    rows = []
    for m in METHODS:
        errors = [found[nodes][m]["d"]["4.0"] for nodes in found]
        rows.append([m, *(f"{rate(found[nodes][m]['h']):.2f}" for nodes in found),
                     *(f"{math.log2(a / b):.2f}" for a, b in zip(errors, errors[1:]))])  # fmt: skip
    note = "Slope of log error against log h, 0.8 to 1.2, on one cloud; and the order from cloud to cloud, h = spacing"
    made["paper-rates"] = table(["method", *(f"{n} nodes" for n in found), "50 to 171", "171 to 629"], rows, note)
    printed("Figures 13 to 15", made["paper-rates"])
    return made


# ------------------------------------------------------------------ run time, and nonsmooth sources


def run_times() -> dict[str, Any]:
    """Median seconds of warm solves of Table 5's largest grid, against SSPH."""
    seconds = {}
    for row in (r for r in PLATE_ROWS if r[0] in METHODS or r[1] == "S"):
        job = plate_job(row, published.GRIDS[-1])
        seconds[row[1]] = float(np.median([run(job).seconds for _ in range(7)]))
    return seconds


SHIFTS = {1: (0.0, 0.0061, 0.0122, 0.0183), 2: (0.0, 0.0122)}


def families() -> dict[str, Callable[[float], Case]]:
    """Sources by the shift of their singularity; widths of peaks are 1 and 3 spacings of the clouds used."""
    at = 0.4472
    return {
        "smooth 1D": lambda s: CASES["poisson 1D"],
        "kink 1D": lambda s: problems.kink_1d(at + s),
        "jump 1D": lambda s: problems.jump_1d(at + s),
        "peak 1D, narrow": lambda s: problems.peak_1d(at + s, width=1 / 40),
        "peak 1D, wide": lambda s: problems.peak_1d(at + s, width=3 / 40),
        "smooth 2D": lambda s: CASES["poisson 2D"],
        "kink 2D": lambda s: problems.kink_2d(0.8 + s),
        "jump 2D": lambda s: problems.jump_2d(0.3 + s),
        "peak 2D, narrow": lambda s: problems.peak_2d((at + s, 0.5345), width=1 / 24),
        "peak 2D, wide": lambda s: problems.peak_2d((at + s, 0.5345), width=3 / 24),
    }


def nonsmooth() -> list[dict[str, Any]]:
    """Root mean square of the error over places of the singularity relative to the particles."""
    made = families()
    rows = [{"source": name, "order": order} for order in (2, 4) for name in made]

    def measure(task):
        row, method = task
        dim = 1 if "1D" in row["source"] else 2
        shape = 41 if dim == 1 else 25
        found = [run(Job(made[row["source"]](s), shape, method, row["order"], 4.0)).percent for s in SHIFTS[dim]]
        return math.nan if None in found else float(np.sqrt(np.mean(np.square(found))))

    tasks = [(row, m) for row in rows for m in METHODS]
    with compiled_fast(), ThreadPoolExecutor(min(2, machine.cores())) as pool:
        for (row, method), percent in zip(tasks, pool.map(measure, tasks)):
            row[method] = percent
    for row in rows:
        row["ratio"] = row["SSPH"] / min(row[m] for m in ("I", "II", "III"))
    return rows


def print_nonsmooth(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Print the errors under nonsmooth sources and what they say of the paper's claim."""
    rows = [[r["source"], r["order"], *(shown(r[m]) for m in METHODS), f"{r['ratio']:.2f}"] for r in found]
    note = (
        "Sources with a kink, a jump or a peak, 41 particles on [0, 1] and 25 x 25 on its square, h = spacing, d = 4: "
        "error in percent, root mean square over shifted singularities; last column SSPH / best of I, II and III"
    )
    made = table(["source", "order", *METHODS, "SSPH / SMITSM"], rows, note)
    remarks = []
    for order, why in (
        (2, "At order 2 the recursion takes of f what SSPH takes, its value at the particle."),
        (4, "At order 4 the recursion takes the derivatives of f at the particle for those of its whole support, which "
            "a kink, a jump or an unresolved peak belies; SSPH never differentiates f."),
    ):  # fmt: skip
        rough = [r["ratio"] for r in found if r["order"] == order and not r["source"].startswith("smooth")]
        smooth = [r["ratio"] for r in found if r["order"] == order and r["source"].startswith("smooth")]
        ahead, behind = sum(x > 1.02 for x in rough), sum(x < 0.98 for x in rough)
        remarks.append(
            f"order {order}: SMITSM ahead of SSPH (by more than 2 percent) under {ahead} of {len(rough)} nonsmooth "
            f"sources, behind under {behind}; ratios {min(rough):.2g} to {max(rough):.2g}, under smooth ones "
            f"{min(smooth):.2g} to {max(smooth):.2g}. {why}"
        )
    printed("Is SMITSM ahead under nonsmooth sources?", made, remarks)
    return made


# ------------------------------------------------------------------ all of it


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="Tables 1 to 5 only; writes nothing")
    quick = parser.parse_args(arguments).quick
    jax.config.update("jax_enable_x64", True)
    start = time.perf_counter()
    where = machine.describe()
    print(f"{where['processor']}, {where['cores']} cores, jax {where['jax']}")
    print("First calls compile and are made two at a time where there are two cores; repeats one at a time.")
    rods, plate = rod_tables(), plate_table()
    tables = print_tables(rods, plate)
    if quick:
        print(f"\n{time.perf_counter() - start:.0f} s in all")
        return
    clock = lambda: f"({time.perf_counter() - start:.0f} s, {time.process_time():.0f} cpu)"  # noqa: E731
    print(clock())
    lines = temperatures(plate)
    print_temperatures(lines)
    seconds = run_times()
    tables["paper-seconds"] = table(
        ["method", "seconds", "against SSPH"],
        [[m, f"{s:.4f}", f"{s / seconds['SSPH']:.2f}"] for m, s in seconds.items()],
        "Table 5's problem on 629 nodes, warm, median of seven; the paper finds SMITSM much slower than SSPH",
    )
    curves = sweeps()
    tables |= print_sweeps(curves)
    printed("Run time", tables["paper-seconds"])
    print(clock())
    rough = nonsmooth()
    tables["paper-nonsmooth"] = print_nonsmooth(rough)
    data = {
        "machine": where,
        "tables": tables,
        "table_entries": {
            **{f"{t - 2}": [_plain(e) for e in found] for t, found in rods.items()},
            "5": [_plain(e) for e in plate],
        },
        "figures_3_to_5": lines,
        "figures_7_to_15": curves,
        "run_time_seconds": seconds,
        "nonsmooth": rough,
        "seconds_in_all": round(time.perf_counter() - start, 1),
    }
    (HERE / "data").mkdir(exist_ok=True)
    (HERE / "data" / "paper.json").write_text(json.dumps(data, indent=1) + "\n")
    print("\nraw data: benchmarks/data/paper.json")
    draw(data)
    print(f"{time.perf_counter() - start:.0f} s in all")


def _plain(entry: dict[str, Any]) -> dict[str, Any]:
    """An entry as it stands in the data file."""
    *_, method, size = entry["key"]
    label = method if isinstance(method, str) else method[0]
    seconds = {k: round(entry[k], 4) for k in ("first", "again")}
    nodes = size if isinstance(size, int) else size[0] * size[1]
    return {"method": label, "nodes": nodes, "paper": entry["paper"], "here": entry["here"], "seconds": seconds}


def draw(data: dict[str, Any]) -> None:
    """The pictures, where matplotlib is installed."""
    try:
        from benchmarks import plots
    except ImportError:
        print("no pictures: matplotlib is not installed (pip install matplotlib)")
        return
    print("pictures: " + ", ".join(plots.draw_all(data, HERE / "figures")))


if __name__ == "__main__":
    main()
