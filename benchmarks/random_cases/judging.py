"""Solving random cases and judging what comes out: by error, flags and error estimate."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

import jsmitsm as js
from benchmarks.random_cases.cases import Case, case

# A relative error above the first is wrong, below the second right; between them neither flag nor silence is a fault.
WRONG, RIGHT = 0.1, 0.01
# Estimates are judged where the error is above this: below it is round-off.
FLOOR = 1e-10
# Estimate over error, of nearly all unflagged cases.
BETWEEN = (0.3, 10.0)
KINDS = ("accurate", "between", "refused", "wrong and flagged", "right, yet flagged", "silently wrong")


def error_of(one: Case, values: Any) -> float:
    """The relative L2 error, the largest over the fields, each by its own size."""
    u, exact = np.asarray(values, float).reshape(-1, one.fields), one.exact
    if not np.isfinite(u).all():
        return np.inf
    off = u - exact
    for f in floating(one):
        off[:, f] -= off[:, f].mean()
        exact = exact.copy()
        exact[:, f] -= exact[:, f].mean()
    return float(np.max(np.linalg.norm(off, axis=0) / np.linalg.norm(exact, axis=0)))


def floating(one: Case) -> tuple[int, ...]:
    """The fields that the problem fixes only up to a constant: a pressure."""
    return (one.dim,) if one.operator in ("stokes", "flow") else ()


def attempt(one: Case) -> dict[str, Any]:
    """The record of one case."""
    start = time.process_time()
    out: dict[str, Any] = {
        "case": one.number, "dim": one.dim, "class": one.kind, "operator": one.operator,
        "coefficient": one.coefficient, "solution": one.solution, "width": one.width, "domain": one.domain,
        "method": one.method, "order": one.order, "form": one.formulation,
    }  # fmt: skip
    try:
        sol = one.solve()
        out["form"] = sol.stats["formulation"]
        out["error"] = error_of(one, sol.u)
        out["flags"] = sol.flags
        out["estimate"] = sol._estimated()
    except (ValueError, js.SolveError) as fault:
        out["refused"] = f"{type(fault).__name__}: {fault}"
    out["seconds"] = time.process_time() - start
    return judged(out)


def judged(r: dict[str, Any]) -> dict[str, Any]:
    """The record with its kind."""
    if "refused" in r:
        kind = "refused"
    elif not r["error"] <= WRONG:
        kind = "wrong and flagged" if r["flags"] else "silently wrong"
    elif r["error"] >= RIGHT:
        kind = "between"
    else:
        kind = "right, yet flagged" if r["flags"] else "accurate"
    return {**r, "kind": kind}


def records(seed: int, numbers: Iterable[int]) -> Iterable[dict[str, Any]]:
    """The records of these cases, one after another."""
    for number in numbers:
        yield {"seed": seed, **attempt(case(seed, number))}


def counts(some: list[dict[str, Any]]) -> list[int]:
    found = Counter(r["kind"] for r in some)
    return [len(some), *(found[kind] for kind in KINDS)]


def effectivity(some: list[dict[str, Any]]) -> list[float]:
    """Estimate over error of the unflagged cases whose error is above round-off."""
    return [
        r["estimate"] / r["error"] for r in some
        if "error" in r and not r["flags"] and np.isfinite(r["error"]) and r["error"] > FLOOR
    ]  # fmt: skip
