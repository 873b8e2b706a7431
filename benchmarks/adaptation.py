"""Tolerances in, answers out: ``python -m benchmarks.adaptation [name ...] [--tol 1e-3 1e-6] [--most 300000]``.

Every problem of :mod:`benchmarks.nist`, and of :mod:`benchmarks.strangers` those that are named, from the default
start, nothing told of its solution; beside it adaptive finite elements (:mod:`benchmarks.elements`) where NGSolve is
installed. Prints a table as it goes and writes ``benchmarks/data/adaptation.json``, problem by problem: rows of earlier
runs stay. With ``--only elements`` those rows get their elements anew, with ``--only seconds`` their seconds. A line
that begins with WRONG tells of an answer called reached whose true error is more than three times the tolerance, or
whose estimate is not between a third and five times the true error.

Seconds are those of a second run in the same process, in which nothing is compiled.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jsmitsm as js
from benchmarks import elements
from benchmarks.machine import describe
from benchmarks.nist import CASES as NIST
from benchmarks.nist import Case
from benchmarks.strangers import STRANGERS

CASES = NIST | STRANGERS
# Where the parts of a search are compared.
LARGE = 5000
DATA = Path(__file__).parent / "data" / "adaptation.json"


def true_error(case: Case, found: js.Adapted) -> float:
    """The largest error at the particles (or where values are known) over the largest value, or that of the number:
    what the tolerance is on."""
    if case.number is not None:
        assert found.quantity is not None
        return abs(found.quantity - case.number) / abs(case.number)
    if case.known is not None:
        points, values = case.known
        return float(np.abs(np.asarray(found.solution(points)) - values).max() / np.abs(values).max())
    exact = np.asarray(jax.vmap(case.exact)(np.asarray(found.cloud.points)))
    return float(np.abs(np.asarray(found.solution.u) - exact).max() / np.abs(exact).max())


def measure(name: str, tol: float, most: int) -> dict[str, Any]:
    case = CASES[name]()
    row: dict[str, Any] = {"case": name, "name": case.name, "tol": tol}
    try:
        found = searched(case, tol, most)
    except (ValueError, js.SolveError, MemoryError) as error:
        return row | {"reached": False, "failed": f"{type(error).__name__}: {error}"[:200]}
    counts = found.history["particles"]
    row |= {
        "reached": found.reached,
        "true": true_error(case, found),
        "estimate": found.error,
        "particles": len(found.cloud),
        "order": found.solution.order,
        "rounds": len(counts),
        "history": {name: column.tolist() for name, column in found.history.items()},
        "said": found.messages + found.flags,
    }
    return row | (again(case, tol, most) if found.reached else {})  # who ends elsewhere is not raced


def searched(case: Case, tol: float, most: int) -> js.Adapted:
    return js.adapt(case.problem, case.make, tol, quantity=case.quantity, max_particles=most, progress=False)


def again(case: Case, tol: float, most: int) -> dict[str, Any]:
    """The seconds of a run that compiles nothing, and how many times those of its last round."""
    start = time.perf_counter()
    found = searched(case, tol, most)
    seconds = time.perf_counter() - start
    rounds = found.history["seconds"]
    return {"seconds": seconds, "rounds_seconds": rounds.tolist(), "over_last": float(rounds.sum() / rounds[-1])}


def beside(name: str, tol: float, most: int) -> dict[str, Any] | None:
    """What adaptive finite elements need for the same, None where there are none, or no polygon."""
    case = CASES[name]()
    if not elements.available() or case.polygon is None or case.quantity is not None:
        return None
    return elements.adaptive(case, tol, most)


def shown(row: dict[str, Any]) -> str:
    if "failed" in row:
        return f"| {row['name']} | {row['tol']:.0e} | failed: {row['failed']} |"
    return "| " + " | ".join(map(str, cells(row))) + " |"


COLUMNS = ("problem", "tolerance", "reached", "true error", "estimate / true", "particles", "order", "rounds",
           "seconds", "all rounds / last", "elements: unknowns", "seconds")  # fmt: skip


def cells(row: dict[str, Any]) -> list[Any]:
    """A row of the table; elements that stopped before the tolerance are marked."""
    other = row.get("elements")
    ratio = f"{row['estimate'] / row['true']:.2f}" if row["true"] else ""
    times = (f"{row['seconds']:.1f}", f"{row['over_last']:.1f}") if "over_last" in row else ("", "")
    fem = ("", "")
    if other:
        clocked = f"{other['seconds']:.1f}" if times[0] and "seconds" in other else ""  # of a quiet machine
        fem = f"{other['unknowns']}{'' if other['reached'] else ' (not)'}", clocked
    return [row["name"], f"{row['tol']:.0e}", "yes" if row["reached"] else "no", f"{row['true']:.1e}", ratio,
            row["particles"], row["order"], row["rounds"], *times, *fem]  # fmt: skip


def kept(path: Path) -> list[dict[str, Any]]:
    """Rows of earlier runs, which one of a single problem does not lose."""
    return json.loads(path.read_text())["rows"] if path.exists() else []


def check(rows: list[dict[str, Any]]) -> list[str]:
    """What would be dishonest of "reached": a true error beyond the tolerance, or an estimate that is far from it."""
    wrong = []
    for row in rows:
        if not row.get("reached"):
            continue
        where = f"{row['name']} at {row['tol']:.0e}: reached, but the true error is {row['true']:.1e}"
        if row["true"] > 3 * row["tol"]:
            wrong.append(where)
        elif not row["true"] / 3 <= row["estimate"] <= 5 * row["true"]:
            wrong.append(f"{where} and the estimate {row['estimate']:.1e}")
    return wrong


def sizes(row: dict[str, Any]) -> tuple[int, int]:
    """Unknowns of the particles and of the elements."""
    return row["particles"] * CASES[row["case"]]().problem.fields, row["elements"]["unknowns"]


def tally(rows: list[dict[str, Any]]) -> str:
    """Who needs less of those that both reach."""
    both = [r for r in rows if r.get("reached") and (r.get("elements") or {}).get("reached") and "over_last" in r]
    fewer = sum(a < b for a, b in map(sizes, both))
    clocked = [r for r in both if "seconds" in r["elements"]]
    quicker = sum(r["seconds"] < r["elements"]["seconds"] for r in clocked)
    large = [r["over_last"] for r in rows if r.get("particles", 0) > LARGE and "over_last" in r]
    told = [f"Of {len(both)} timed that both reach, fewer unknowns in {fewer}, less time in {quicker} of "
            f"{len(clocked)}."] if both else []  # fmt: skip
    if large:
        told.append(f"All rounds over the last where it has more than {LARGE} particles: {min(large):.1f} to "
                    f"{max(large):.1f} in {len(large)}.")  # fmt: skip
    return " ".join(told)


def table(rows: list[dict[str, Any]], cases: Any) -> dict[str, Any]:
    """For the documentation; problems in the order of their list."""
    own = [r for r in rows if "failed" not in r and r["case"] in cases]
    own = sorted(own, key=lambda r: (list(cases).index(r["case"]), -r["tol"]))
    about = describe()
    where = f"{about['processor']}, {about['cores']} cores, JAX {about['jax']}"
    note = f"{where}; seconds without compiling. {tally(own)}"
    return {"columns": COLUMNS, "rows": [cells(row) for row in own], "note": note}


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*CASES, []], default=[])
    parser.add_argument("--tol", nargs="+", type=float, default=[1e-3, 1e-6])
    parser.add_argument("--most", type=int, default=300_000)
    parser.add_argument("--out", type=Path, default=DATA)
    parser.add_argument("--only", choices=["elements", "particles", "seconds"])
    given = parser.parse_args()
    if not elements.available():
        print("No finite elements: NGSolve is not installed (pip install ngsolve).")
    print("| " + " | ".join(COLUMNS) + " |\n" + "| --- " * len(COLUMNS) + "|", flush=True)
    for name in given.names or NIST:
        for tol in given.tol:
            before = [r for r in kept(given.out) if (r["case"], r["tol"]) == (name, tol)]
            if given.only in ("elements", "seconds") and (not before or "failed" in before[0]):
                continue
            write(given.out, updated(name, tol, given.most, before[0] if before else {}, given.only))
    for line in check(kept(given.out)):
        print(f"WRONG: {line}")


def updated(name: str, tol: float, most: int, before: dict[str, Any], only: str | None) -> dict[str, Any]:
    """The row of a problem, of which parts may be as ``before``."""
    if only == "seconds":
        case = CASES[name]()
        searched(case, tol, most)
        return before | again(case, tol, most)
    row = before if only == "elements" else measure(name, tol, most)
    return row | {"elements": before.get("elements") if only == "particles" else beside(name, tol, most)}


def write(path: Path, row: dict[str, Any]) -> None:
    print(shown(row), flush=True)
    rows = [r for r in kept(path) if (r["case"], r["tol"]) != (row["case"], row["tol"])] + [row]
    tables = {"adaptation": table(rows, NIST), "adaptation-strangers": table(rows, STRANGERS)}
    path.write_text(json.dumps({"machine": describe(), "rows": rows, "tables": tables}, indent=1) + "\n")


if __name__ == "__main__":
    main()
