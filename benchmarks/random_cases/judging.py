"""Solving random cases and judging what comes out: by error, flags and error estimate."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
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
KINDS = (
    "accurate", "between", "refused", "wrong and flagged", "right, yet flagged", "silently wrong", "another solution",
)  # fmt: skip
# Systems that are nonlinear, beside the class of that name.
NONLINEAR = ("brusselator", "flow")


def error_of(one: Case, values: Any) -> float:
    """The relative L2 error, the largest over the fields, each by its own size."""
    return _apart(one, values, one.exact)


def _apart(one: Case, values: Any, known: Any) -> float:
    """By how much values differ from known ones, as above."""
    u, known = (np.array(v, float).reshape(-1, one.fields) for v in (values, known))
    if not np.isfinite(u).all():
        return np.inf
    for v in (u, known):
        v[:, floating(one)] -= v[:, floating(one)].mean(axis=0)
    return float(np.max(np.linalg.norm(u - known, axis=0) / np.linalg.norm(known, axis=0)))


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
        if judged(out)["kind"] == "silently wrong":
            out["another"] = another(one, sol)
    except (ValueError, js.SolveError) as fault:
        out["refused"] = f"{type(fault).__name__}: {fault}"
    out["seconds"] = time.process_time() - start
    return judged(out)


def another(one: Case, sol: js.Solution) -> bool:
    """Whether a nonlinear problem has more solutions than the one it was made from, and this is another.

    From its own solution the case finds that; from the one found, on a cloud twice as fine and two orders higher, what
    was found, as far off as it was. Both without a flag: so it solves the equations, not this discretisation of them.
    """
    if one.kind != "nonlinear" and one.operator not in NONLINEAR:
        return False
    finer = replace(one, size=2 * one.size - 1)
    try:
        its_own = one.solve(u0=one.exact)
        fine = finer.solve(order=one.order + 2, u0=np.asarray(sol(finer.cloud.points, outside="extrapolate")))
        kept = _apart(one, fine(one.cloud.points, outside="extrapolate"), sol.u)
        return bool(
            error_of(one, its_own.u) <= RIGHT and kept <= RIGHT and error_of(finer, fine.u) > WRONG
            and not its_own.flags and not fine.flags
        )  # fmt: skip
    except (ValueError, js.SolveError):
        return False


def judged(r: dict[str, Any]) -> dict[str, Any]:
    """The record with its kind."""
    if "refused" in r:
        kind = "refused"
    elif not r["error"] <= WRONG:
        silent = "another solution" if r.get("another") else "silently wrong"
        kind = "wrong and flagged" if r["flags"] else silent
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
        if "error" in r and not r["flags"] and not r.get("another") and np.isfinite(r["error"]) and r["error"] > FLOOR
    ]  # fmt: skip
