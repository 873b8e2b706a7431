"""Tolerances in, answers out: ``python -m benchmarks.adaptation [name ...] [--tol 1e-3 1e-6] [--most 300000]``.

Every problem of :mod:`benchmarks.nist` from the default start, nothing told of its solution; beside it adaptive finite
elements (:mod:`benchmarks.elements`) where NGSolve is installed. Prints a table as it goes and writes
``benchmarks/data/adaptation.json``, problem by problem: rows of earlier runs stay. With ``--only elements`` those
rows get their elements anew. A line that begins with WRONG tells of an answer called reached whose true error is more
than three times the tolerance.
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
from benchmarks.nist import CASES, LEFT_OUT, Case

DATA = Path(__file__).parent / "data" / "adaptation.json"


def true_error(case: Case, found: js.Adapted) -> float:
    """The largest error at the particles over the largest value, or that of the number: what the tolerance is on."""
    if case.number is not None:
        assert found.quantity is not None
        return abs(found.quantity - case.number) / abs(case.number)
    exact = np.asarray(jax.vmap(case.exact)(np.asarray(found.cloud.points)))
    return float(np.abs(np.asarray(found.solution.u) - exact).max() / np.abs(exact).max())


def measure(name: str, tol: float, most: int) -> dict[str, Any]:
    case = CASES[name]()
    start = time.perf_counter()
    row: dict[str, Any] = {"case": name, "name": case.name, "tol": tol}
    try:
        found = js.adapt(case.problem, case.make, tol, quantity=case.quantity, max_particles=most, progress=False)
    except (ValueError, js.SolveError, MemoryError) as error:
        return row | {"reached": False, "failed": f"{type(error).__name__}: {error}"[:200]}
    seconds = time.perf_counter() - start
    counts = found.history["particles"]
    return row | {
        "reached": found.reached,
        "true": true_error(case, found),
        "estimate": found.error,
        "particles": len(found.cloud),
        "order": found.solution.order,
        "rounds": len(counts),
        "seconds": seconds,
        "history": {name: column.tolist() for name, column in found.history.items()},
        "said": found.messages + found.flags,
    }


def beside(name: str, tol: float, most: int) -> dict[str, Any] | None:
    """What adaptive finite elements need for the same, None where there are none, or no polygon."""
    case = CASES[name]()
    if not elements.available() or case.polygon is None or case.quantity is not None:
        return None
    return elements.adaptive(case, tol, most)


def shown(row: dict[str, Any]) -> str:
    other = row.get("elements")
    fem = "- | -" if not other else f"{other['unknowns']}{'' if other['reached'] else '*'} | {other['seconds']:.1f}"
    if "failed" in row:
        return f"| {row['name']} | {row['tol']:.0e} | failed: {row['failed']} | | | | | | | {fem} |"
    ratio = row["estimate"] / row["true"] if row["true"] else float("nan")
    return (
        f"| {row['name']} | {row['tol']:.0e} | {'yes' if row['reached'] else 'no'} | {row['true']:.1e} | "
        f"{ratio:.2f} | {row['particles']} | {row['order']} | {row['rounds']} | {row['seconds']:.0f} | {fem} |"
    )


def kept(path: Path) -> list[dict[str, Any]]:
    """Rows of earlier runs, which one of a single problem does not lose."""
    return json.loads(path.read_text())["rows"] if path.exists() else []


def check(rows: list[dict[str, Any]]) -> list[str]:
    """What would be dishonest: "reached" where it is not."""
    return [
        f"{row['name']} at {row['tol']:.0e}: reached, but the true error is {row['true']:.1e}"
        for row in rows
        if row.get("reached") and row["true"] > 3 * row["tol"]
    ]


def table(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """For the documentation; problems in the order of their list."""
    lines = []
    for row in sorted((r for r in rows if "failed" not in r), key=lambda r: (list(CASES).index(r["case"]), -r["tol"])):
        other = row.get("elements")
        ratio = f"{row['estimate'] / row['true']:.2f}" if row["true"] else ""
        fem = f"{other['unknowns']}{'' if other['reached'] else ' (not)'}" if other else ""
        reached = "yes" if row["reached"] else "no"
        lines.append([
            row["name"], f"{row['tol']:.0e}", reached, f"{row['true']:.1e}", ratio, row["particles"], row["order"],
            row["rounds"], fem,
        ])  # fmt: skip
    columns = ["problem", "tolerance", "reached", "true error", "estimate / true", "particles", "order", "rounds",
               "elements: unknowns"]  # fmt: skip
    about = describe()
    where = f"{about['processor']}, {about['cores']} cores, JAX {about['jax']}"
    note = f"{where}; seconds are in the data, of a busy machine."
    return {"columns": columns, "rows": lines, "note": note}


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*CASES, []], default=[])
    parser.add_argument("--tol", nargs="+", type=float, default=[1e-3, 1e-6])
    parser.add_argument("--most", type=int, default=300_000)
    parser.add_argument("--out", type=Path, default=DATA)
    parser.add_argument("--only", choices=["elements", "particles"])
    given = parser.parse_args()
    print(f"Left out: {', '.join(LEFT_OUT)}.")
    if not elements.available():
        print("No finite elements: NGSolve is not installed (pip install ngsolve).")
    print(
        "| problem | tolerance | reached | true error | estimate / true | particles | order | rounds | seconds | "
        "unknowns of finite elements | seconds |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |", flush=True)
    for name in given.names or CASES:
        for tol in given.tol:
            before = [r for r in kept(given.out) if (r["case"], r["tol"]) == (name, tol)]
            if given.only == "elements" and not before:
                continue
            row = before[0] if given.only == "elements" else measure(name, tol, given.most)
            known = before[0].get("elements") if before else None
            row["elements"] = known if given.only == "particles" else beside(name, tol, given.most)
            print(shown(row), flush=True)
            rows = [r for r in kept(given.out) if (r["case"], r["tol"]) != (name, tol)] + [row]
            written = {"machine": describe(), "rows": rows, "tables": {"adaptation": table(rows)}}
            given.out.write_text(json.dumps(written, indent=1) + "\n")
    for line in check(kept(given.out)):
        print(f"WRONG: {line}")


if __name__ == "__main__":
    main()
