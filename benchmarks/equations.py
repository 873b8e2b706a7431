"""Every case of the table of problems against its ceilings, with the default kernel and stencils.

``python -m benchmarks.equations [names] [--no-estimate] [--resume]`` solves the cases that have ceilings, prints a
table and writes ``benchmarks/data/equations.json`` line by line; ``--resume`` keeps the lines already there,
``--list`` names the cases.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jsmitsm as js
from benchmarks import machine
from benchmarks.commandline import arguments
from benchmarks.problems import CASES, FACTOR, RANK, Case

DATA = Path(__file__).parent / "data" / "equations.json"
# Errors below this are rounding alone: they have no order, and no estimate knows where they are.
ROUND_OFF = {"loo": 1e-13, "lsq": 5e-13}
MEASURED = {name: case for name, case in CASES.items() if case.ceilings}


def run(case: Case, order: int, estimate: bool = True, **options: Any) -> dict[str, Any]:
    """Solve one case at one order: its line of the table."""
    cloud = case.cloud()
    start = time.perf_counter()
    sol = case.solve(order, cloud, **options)
    seconds = time.perf_counter() - start
    line: dict[str, Any] = {
        "case": case.name, "order": order, "particles": len(cloud), "error": case.error(sol),
        "ceiling": case.ceilings[order], "seconds": seconds, "formulation": sol.stats["formulation"],
        "repaired": len(sol.stats.get("repaired", ())), "weak": len(sol.stats.get("weak", ())),
        "lebesgue": sol.stats.get("lebesgue_max"), "steps": sol.iterations if case.steps else None,
    }  # fmt: skip
    line["further"] = {
        name: {"error": measure(case, sol), "ceiling": limits[order]}
        for name, (measure, limits) in case.further.items()
        if order in limits
    }
    if case.coarse is not None:
        before = case.cloud(case.coarse)
        line["before"] = case.error(case.solve(order, before, **options))
        ratio = line["before"] / line["error"]
        line["rate"] = math.log(ratio) / math.log((len(cloud) / len(before)) ** (1 / cloud.dim))
    if estimate:
        line |= estimated(case, sol)
    return line


def estimated(case: Case, sol: js.Solution) -> dict[str, Any]:
    """How well the error estimate knows the error: ratio of their norms, rank correlation."""
    from scipy.stats import spearmanr

    start = time.perf_counter()
    true = case.values(sol.cloud.points).reshape(-1, case.fields)
    guess = np.asarray(sol.error_estimate()).reshape(true.shape)
    for k in case.floating:
        true[:, k] -= true[:, k].mean()
    guess = guess / np.sqrt(np.mean(true**2, axis=0))
    off = np.abs(case.errors(sol))
    there = off > 0
    return {
        "effectivity": float(np.linalg.norm(guess) / np.linalg.norm(off)),
        "rank": float(spearmanr(guess[there], off[there])[0]),
        "estimate seconds": time.perf_counter() - start,
    }


def missed(line: dict[str, Any]) -> list[str]:
    """What a line of the table fails to reach."""
    case, order = CASES[line["case"]], line["order"]
    rounded = line["error"] <= ROUND_OFF[line["formulation"]]
    kept = {
        "error": line["error"] <= line["ceiling"],
        "particles": case.particles is None or line["particles"] <= case.particles,
        "steps": line["steps"] is None or line["steps"] <= case.steps,
        "coarse error": "rate" not in line or line["before"] <= case.before.get(order, math.inf),
        "rate": "rate" not in line or rounded or line["rate"] >= case.rates[order],
        "estimate": "rank" not in line or rounded or order not in case.estimates or good(line),
        **{name: one["error"] <= one["ceiling"] for name, one in line["further"].items()},
    }
    return [name for name, well in kept.items() if not well]


def good(line: dict[str, Any]) -> bool:
    """Whether the error estimate knows the size of the error and where it is."""
    return 1 / FACTOR <= line["effectivity"] <= FACTOR and line["rank"] > RANK


def shown(line: dict[str, Any]) -> str:
    """One line of the printed table."""
    text = (
        f"{line['case']:19s} {line['order']:2d} {line['particles']:5d}  {line['error']:.1e}  {line['ceiling']:.1e} "
        f"{line['seconds']:6.1f}  {line['formulation']}  {line['repaired']:4d} {line['weak']:4d}"
    )
    text += f"  {line['effectivity']:8.2f} {line['rank']:5.2f}" if "effectivity" in line else " " * 16
    text += "".join(f"  {name} {one['error']:.1e} ({one['ceiling']:.0e})" for name, one in line["further"].items())
    text += f"  steps {line['steps']}" if line["steps"] else ""
    text += f"  order {line['rate']:.2f}" if "rate" in line else ""
    return text + "".join(f"  MISSED {name}" for name in missed(line))


HEAD = "case                 p     N  error    ceiling seconds form  rep. weak  effectiv.  rank"


COLUMNS = ["case", "equation", "order", "particles", "error", "ceiling", "estimate / error", "rank correlation", "also"]


def table(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """The lines as a table of the documentation."""
    return {"columns": COLUMNS, "rows": [cells(line) for line in lines], "note": ""}


def cells(line: dict[str, Any]) -> list[Any]:
    also = [f"{name} {one['error']:.1e} (at most {one['ceiling']:.2g})" for name, one in line["further"].items()]
    also += [f"{line['steps']} Newton steps"] if line["steps"] else []
    also += [f"observed order {line['rate']:.2f}"] if "rate" in line else []
    also += [f"**missed: {name}**" for name in missed(line)]
    known = [f"{line['effectivity']:.2f}", f"{line['rank']:.2f}"] if "rank" in line else ["", ""]
    return [line["case"], CASES[line["case"]].about, line["order"], line["particles"], f"{line['error']:.1e}",
            f"{line['ceiling']:.1e}", *known, ", ".join(also)]  # fmt: skip


def write(lines: dict[tuple[str, int], dict[str, Any]]) -> None:
    places = list(MEASURED)
    ordered = [lines[key] for key in sorted(lines, key=lambda key: (places.index(key[0]), key[1]))]
    data = {"machine": machine.describe(), "lines": ordered, "tables": {"equations": table(ordered)}}
    DATA.write_text(json.dumps(data, indent=1) + "\n")


def main(names: list[str], only_list: bool, resumed: bool, estimate: bool) -> None:
    jax.config.update("jax_enable_x64", True)
    unknown = sorted(set(names) - set(MEASURED))
    if only_list or unknown:
        known = "\n".join(f"{name:19s} {case.about}" for name, case in MEASURED.items())
        sys.exit(f"no such case: {', '.join(unknown)}\n{known}" if unknown else known)
    kept = json.loads(DATA.read_text())["lines"] if DATA.exists() and (names or resumed) else []
    lines = {(line["case"], line["order"]): line for line in kept if line["case"] in MEASURED}
    print(HEAD)
    for name in names or MEASURED:
        for order in MEASURED[name].ceilings:
            if not resumed or (name, order) not in lines:
                lines[name, order] = run(MEASURED[name], order, estimate)
                write(lines)
            print(shown(lines[name, order]), flush=True)


if __name__ == "__main__":
    given = arguments(__doc__, "list", "resume", "no-estimate", names="case")
    main(given.names, given.list, given.resume, not given.no_estimate)
