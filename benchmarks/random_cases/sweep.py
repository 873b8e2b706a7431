"""Many random cases, in several processes, and the tables of what came out."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import describe, tidy
from benchmarks.random_cases.cases import MEMBERS, case
from benchmarks.random_cases.judging import BETWEEN, FLOOR, KINDS, RIGHT, WRONG, attempt, counts, effectivity, judged

DATA = Path(__file__).parent.parent / "data" / "random.json"
# So many cases make the sweep.
WHOLE = 4000
# So many cases of a recipe at a time.
TURN = 20
CLASSES, METHODS = ("linear", "nonlinear", "system"), ("S", "I", "II", "III", "SSPH")


def swept(seed: int, cases: int, jobs: int, scratch: Path) -> list[dict[str, Any]]:
    """The records of cases 0 to ``cases`` - 1; those that ``scratch`` holds already are not run again."""
    scratch.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "benchmarks.stability", "--random", "--seed", str(seed), "--cases", str(cases),
               "--jobs", str(jobs), "--scratch", str(scratch), "--part"]  # fmt: skip
    running = [subprocess.Popen([*command, str(k)]) for k in range(jobs)]
    for process in running:
        process.wait()
    return found(scratch, seed, cases)


def part(seed: int, cases: int, jobs: int, k: int, scratch: Path) -> None:
    """One process's share: every ``jobs``-th recipe, each record written when it is there.

    A few members of every recipe, then the next few: a run that is broken off has seen all kinds.
    """
    done = {r["case"] for r in found(scratch, seed, cases)}
    with (scratch / f"seed{seed}-{k}of{jobs}.jsonl").open("a") as out:
        for first in range(0, MEMBERS, TURN):
            for start in range(k * MEMBERS, cases, jobs * MEMBERS):
                turn = range(start + first, min(start + first + TURN, start + MEMBERS, cases))
                for number in [n for n in turn if n not in done]:
                    out.write(json.dumps({"seed": seed, **attempt(case(seed, number))}) + "\n")
                    out.flush()
                tidy()


def found(scratch: Path, seed: int, cases: int) -> list[dict[str, Any]]:
    """What the files of a scratch folder hold, by number."""
    lines = [line for path in sorted(scratch.glob(f"seed{seed}-*.jsonl")) for line in path.read_text().splitlines()]
    by_number = {r["case"]: judged(r) for r in map(json.loads, lines)}
    return [by_number[k] for k in sorted(by_number) if k < cases]


def _rows(records: list[dict[str, Any]]) -> list[tuple[str, list[dict[str, Any]]]]:
    """Names and records of the rows of both tables."""
    rows = [(name, [r for r in records if r["class"] == name]) for name in CLASSES]
    rows += [("in 3D", [r for r in records if r["dim"] == 3])]
    rows += [(f"method {m}", [r for r in records if r["method"] == m and r["form"] != "lsq"]) for m in METHODS]
    rows += [("least squares", [r for r in records if r["form"] == "lsq"])]
    return [(name, some) for name, some in [*rows, ("**all**", records)] if some]


def judgement(records: list[dict[str, Any]], seed: int) -> dict[str, Any]:
    """What became of the cases, by class and method."""
    machine = describe()
    right = sum(r["kind"] in ("accurate", "right, yet flagged") for r in records)
    needless = sum(r["kind"] == "right, yet flagged" for r in records)
    kinds = ", ".join(f"{sum(r['class'] == name for r in records)} {name}" for name in CLASSES)
    asked, part = max(WHOLE, len(records)), ""
    if len(records) < asked:
        some, every = len({r["case"] // MEMBERS for r in records}), asked // MEMBERS
        part = f"{len(records)} of the cases have run, made by {some} of the {every} recipes: "
    note = (
        f"`python -m benchmarks.stability --random --seed {seed} --cases {asked}` on {machine['processor']}, "
        f"JAX {machine['jax']}: drawn from operators of first to fourth order with variable and steep coefficients, "
        "nonlinear ones and systems, on intervals, boxes, stars, balls, shapes with notches and holes, lattices to "
        "random clouds, conditions of every kind, orders 2 to 8 (in 3D to 4), solutions from smooth to narrower than "
        f"the spacing, in float64. {part}{kinds}, {sum(r['dim'] == 3 for r in records)} in 3D. "
        f"*Wrong*: an error above {WRONG:.0%} (relative L2, of the worst field); *accurate*: below {RIGHT:.0%}. "
        f"Flagged are {needless} of the {right} solutions with an error below {RIGHT:.0%} "
        f"({needless / max(right, 1):.1%}). *Another solution*: of a nonlinear problem that has more than the one it "
        "was made from; found again on a cloud twice as fine two orders higher, while from its own the case keeps that."
    )
    rows = [[name, *counts(some)] for name, some in _rows(records)]
    return {"columns": ["cases", "tried", *KINDS], "rows": rows, "note": note}


def estimates(records: list[dict[str, Any]]) -> dict[str, Any]:
    """The error estimate over the error of unflagged cases, by class and method."""
    low, high = BETWEEN
    note = (
        f"Estimated over true error (relative L2) of the unflagged solutions with an error above {FLOOR:.0e}, from the "
        "same cases; below that is round-off."
    )
    rows = []
    for name, some in _rows(records):
        ratios = np.array(effectivity(some))
        if len(ratios):
            inside = np.mean((ratios >= low) & (ratios <= high))
            quantiles = np.quantile(ratios, [0.01, 0.05, 0.5, 0.95, 0.99])
            rows.append([name, len(ratios), f"{inside:.1%}", *(f"{q:.2g}" for q in quantiles)])
    columns = ["cases", "unflagged", f"{low:g} to {high:g}", "1 %", "5 %", "median", "95 %", "99 %"]
    return {"columns": columns, "rows": rows, "note": note}


def show(table: dict[str, Any]) -> None:
    print("\n" + table["note"] + "\n")
    for row in [table["columns"], *table["rows"]]:
        print(f"{row[0]:>16}" + "".join(f"{cell!s:>20}" for cell in row[1:]))


def report(records: list[dict[str, Any]], seed: int) -> dict[str, Any]:
    """Prints the tables and the faults; returns the tables."""
    tables = {"random": judgement(records, seed), "effectivity": estimates(records)}
    for table in tables.values():
        show(table)
    for r in records:
        if r["kind"] == "silently wrong":
            print(f"silently wrong: --seed {seed} --case {r['case']}: {r['operator']} {r['dim']}D, {r['method']} of "
                  f"order {r['order']}, error {r['error']:.1e}, estimate {r['estimate']:.1e}")  # fmt: skip
    return tables


def write(path: Path, records: list[dict[str, Any]], seed: int, tables: dict[str, Any], seconds: float) -> None:
    head = {"machine": describe(), "seed": seed, "cases": len(records), "seconds": round(seconds), "tables": tables}
    kept = [{k: _short(v) for k, v in r.items() if k != "seed"} for r in records]
    text = json.dumps({**head, "records": kept}, separators=(",", ":"))
    path.write_text(text.replace("},{", "},\n{") + "\n")


def _short(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.3g}") if np.isfinite(value) else str(value)
    if isinstance(value, list):
        return [v[:48] for v in value]
    return value[:120] if isinstance(value, str) else value


def main(args: Any) -> None:
    """What ``python -m benchmarks.stability --random`` does."""
    scratch = Path(args.scratch)
    if args.part is not None:
        part(args.seed, args.cases, args.jobs, args.part, scratch)
    elif args.case is not None:
        one = case(args.seed, args.case)
        print(one)
        print(json.dumps(attempt(one), indent=1))
    else:
        start = time.perf_counter()
        records = swept(args.seed, args.cases, args.jobs, scratch)
        tables = report(records, args.seed)
        write(Path(args.output or DATA), records, args.seed, tables, time.perf_counter() - start)
