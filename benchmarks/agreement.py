"""What several processes say of a problem, beside one: ``mpiexec -n 3 python -m benchmarks.agreement``.

Problems at which flags have something to tell, or rows something to mend, each solved by one process and by all
together: how far values, estimates and the weights of rows are apart, and whether the flags, the repaired stencils or
the words of an error are the same. Where one process takes the least-squares form, which several do not make, they
say so, or values are within what both estimate. What differs is named, and ends the run with an error. ``NAME ...``
asks for some.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
import jsmitsm.parallel as jp
from benchmarks import machine
from benchmarks.commandline import arguments
from jsmitsm.parallel.team import team

DATA = Path(__file__).parent / "data" / "agreement.json"
SIDES = ("left", "right", "bottom", "top")
# Rounding times the condition of such systems; estimates are differences of solutions.
VALUES, ESTIMATES = 1e-9, 1e-4

Posed = tuple[js.Problem, js.Cloud, dict[str, Any]]


def smooth(x):
    return jnp.sin(2.0 * x[0]) * jnp.exp(x[1])


def square(n: int = 20, jitter: float = 0.2) -> js.Cloud:
    return js.rectangle((0, 0), (1, 1), (n, n), jitter=jitter)


def scalar(pde: Any, value: Any = 0.0, cloud: Any = None, **options: Any) -> Posed:
    """An equation on the square, its values held around."""
    return js.Problem(pde, {name: js.dirichlet(value) for name in SIDES}), cloud or square(), {"order": 4} | options


def conducting(k: Any, source: Any = 1.0, **options: Any) -> Posed:
    def pde(u, x):
        return js.divergence(lambda y: k(y) * js.grad(u)(y))(x) + source

    return scalar(pde, **options)


def weighted(weight: Any) -> Posed:
    """A first derivative keeps the equation where the weight is none."""
    def pde(u, x):
        return weight(x) * js.laplacian(u)(x) + js.partial(u, (1, 0))(x) - u(x) + x[1]

    return scalar(pde, formulation="loo")


def source_between() -> Posed:
    return scalar(lambda u, x: js.laplacian(u)(x) + jnp.exp(-((x[0] - 0.51) ** 2 + (x[1] - 0.47) ** 2) / 5e-4))


def held_by_a_jump() -> Posed:
    problem, cloud, options = scalar(lambda u, x: js.laplacian(u)(x))
    bcs = dict(problem.bcs) | {"top": js.dirichlet(lambda x: jnp.where(x[0] > 0.52, 1.0, 0.0))}
    return js.Problem(problem.pde, bcs), cloud, options


def radiating() -> Posed:
    sides = {name: js.dirichlet(lambda x: x[0] * x[1]) for name in SIDES[:3]}
    sides["top"] = js.condition(lambda u, x, n: n @ js.grad(u)(x) + u(x) ** 3 - 1.0)
    pde = lambda u, x: js.divergence(lambda y: (1 + u(y) ** 2) * js.grad(u)(y))(x) + 1.0 + x[0]  # noqa: E731
    return js.Problem(pde, sides), square(12), {"order": 4}


def axisymmetric() -> Posed:
    held = {**{name: js.dirichlet(smooth) for name in SIDES}, "left": js.neumann(0.0)}
    pde = lambda u, x: x[0] * js.laplacian(u)(x) + js.partial(u, (1, 0))(x) + x[0]  # noqa: E731
    return js.Problem(pde, held), square(), {"order": 4}


def crowded_corner() -> Posed:
    """Denser in a corner, jittered until stencils are weak."""
    cloud = square(20, 0.45)
    points = np.asarray(cloud.points) ** 1.7
    cloud = js.Cloud(points, cloud.groups, cloud.normals)
    return scalar(lambda u, x: js.laplacian(u)(x) + 3.0 * smooth(x), smooth, cloud)


def graded_solid() -> Posed:
    """In 3D, denser in a corner, with values, slopes and a mixed condition on its sides."""
    def exact(x):
        return smooth(x) * jnp.cos(x[2])

    def flux(u, x, n):
        return n @ js.grad(u)(x) + u(x) - n @ jax.grad(exact)(x) - exact(x)

    cloud = js.box((0, 0, 0), (1, 1, 1), (11, 11, 11), jitter=0.3)
    points = np.asarray(cloud.points) ** 1.4
    sides = {name: js.dirichlet(exact) for name in cloud.groups if name != "interior"}
    sides["right"] = js.neumann(lambda x: jax.grad(exact)(x)[0])
    sides["top" if "top" in sides else list(sides)[-1]] = js.condition(flux)
    pde = lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x)  # noqa: E731
    return js.Problem(pde, sides), js.Cloud(points, cloud.groups, cloud.normals), {"order": 3}


def coupled() -> Posed:
    def pde(u, x):
        return jnp.array([js.laplacian(u[0])(x) + u[1](x), js.laplacian(u[1])(x) - js.partial(u[0], (1, 0))(x) + 1.0])

    sides = {name: js.dirichlet(0.0) for name in SIDES[:3]}
    sides["top"] = [js.dirichlet(1.0, field=0), js.neumann(0.5, field=1)]
    return js.Problem(pde, sides, fields=2), square(12), {"order": 4}


CASES: dict[str, Callable[[], Posed]] = {
    "smooth": lambda: scalar(lambda u, x: js.laplacian(u)(x) + 3.0 * smooth(x), smooth),
    "a layer": lambda: scalar(lambda u, x: 1e-4 * js.laplacian(u)(x) - u(x) + 1.0),
    "a source between particles": source_between,
    "a coefficient between particles": lambda: conducting(lambda x: 1.0 + 0.9 * jnp.sin(70.0 * x[0])),
    "a jump of the coefficient": lambda: conducting(lambda x: jnp.where(x[0] > 0.52, 10.0, 1.0)),
    "waves": lambda: scalar(lambda u, x: js.laplacian(u)(x) + 1600.0 * u(x) + 1.0),
    "a resonance": lambda: scalar(lambda u, x: js.laplacian(u)(x) + 2.0002 * np.pi**2 * u(x) + 1.0),
    "held by a jump": held_by_a_jump,
    "nonlinear": radiating,
    "method III": lambda: conducting(lambda x: 1.0 + 0.9 * jnp.sin(30.0 * x[0]), method="III"),
    "convection": lambda: scalar(
        lambda u, x: 0.02 * js.laplacian(u)(x) - js.partial(u, (1, 0))(x) + 1.0, formulation="loo"
    ),
    "an axis": axisymmetric,
    "a sign that changes across": lambda: weighted(lambda x: x[0] - 0.47),
    "a sign that changes aslant": lambda: weighted(lambda x: x[0] - 0.6 * x[1] - 0.2),
    "a sign that changes on a circle": lambda: weighted(lambda x: x[0] ** 2 + x[1] ** 2 - 0.5),
    "a sign that changes under divergence": lambda: conducting(lambda x: x[0] - 0.47, formulation="loo"),
    "weak stencils": crowded_corner,
    "graded in 3D": graded_solid,
    "two fields": coupled,
}


def alone(posed: Posed) -> dict[str, Any]:
    """What one process finds, or the words of its refusal."""
    problem, cloud, options = posed
    try:
        sol = js.solve(problem, cloud, **options)
    except (ValueError, js.SolveError) as error:
        return {"error": str(error)}
    return {
        "u": np.asarray(sol.u), "flags": sol.flags, "estimate": estimated(sol.error_estimate),
        "repaired": np.sort(sol.stats.get("repaired", ())), "lebesgue": sol.stats.get("lebesgue_max", 1.0),
        "form": sol.stats["formulation"],
    }  # fmt: skip


def estimated(asked: Callable[[], Any]) -> Any:
    try:
        return np.asarray(asked())
    except (ValueError, js.SolveError):
        return None


def together(posed: Posed) -> dict[str, Any]:
    problem, cloud, options = posed
    try:
        sol = jp.solve(problem, cloud, **options)
    except (ValueError, js.SolveError) as error:
        return {"error": str(error)}
    return {
        "u": sol.u, "flags": sol.flags, "estimate": estimated(lambda: jp.error_estimate(sol)),
        "repaired": sol.stats["repaired"], "lebesgue": sol.stats["lebesgue_max"], "numbers": sol.numbers,
    }  # fmt: skip


def apart(mine: Any, whole: Any, numbers: np.ndarray) -> float | None:
    """The largest difference over the largest of all; nothing where both have none, infinite where one has."""
    if mine is None or whole is None:
        return None if mine is whole else np.inf
    size = np.abs(whole).max()
    return jp.norm(mine - whole[numbers]) / float(size if size and np.isfinite(size) else 1.0)


def compared(one: dict[str, Any], all_: dict[str, Any]) -> dict[str, Any]:
    if "error" in one or "error" in all_:
        if one.get("form", "loo") != "loo" and all_["error"].startswith("formulation:"):
            return {"one": one["form"], "together": "refused by name", "same": True}
        told = [found.get("error", "solved") for found in (one, all_)]
        # Of a line along which something jumps every process meets another point first.
        words = [re.sub(r" \(on process \d+ of \d+\)$| near x = \[[^]]*\]", "", text) for text in told]
        return {"one": told[0], "together": told[1], "same": words[0] == words[1]}
    values = apart(all_["u"], one["u"], all_["numbers"])
    if one["form"] != "loo":  # another system for the same equation: as near as what both are held to
        held = [jp.norm(all_["estimate"]), float(np.linalg.norm(one["estimate"]))]
        return {"one": one["form"], "together": "loo", "values": values, "estimates": held,
                "same": values * float(np.abs(one["u"]).max()) < sum(held)}  # fmt: skip
    estimate = apart(all_["estimate"], one["estimate"], all_["numbers"])
    lebesgue = abs(all_["lebesgue"] / one["lebesgue"] - 1.0)
    flags, repaired = all_["flags"] == one["flags"], np.array_equal(all_["repaired"], one["repaired"])
    near = values < VALUES and (estimate is None or estimate < ESTIMATES) and lebesgue < VALUES
    differ = [] if flags else [one["flags"], all_["flags"]]
    return {"values": values, "estimate": estimate, "weights": lebesgue, "flags": len(one["flags"]), "differ": differ,
            "repaired": len(one["repaired"]), "same": bool(flags and repaired and near)}  # fmt: skip


def main(names: list[str]) -> int:
    us = team()
    asked = names or list(CASES)
    mine = {name: alone(CASES[name]()) for name in asked[us.rank :: us.size]}
    known = {name: one for part in us.gather(mine) for name, one in part.items()}
    found = {}
    for name in asked:
        found[name] = compared(known[name], together(CASES[name]()))
        if us.rank == 0:
            print(f"{name}: {json.dumps(found[name])}", flush=True)
    if us.rank == 0:
        data = json.loads(DATA.read_text()) if DATA.exists() else {}
        kind = f"{us.size} processes"
        data |= {kind: data.get(kind, {}) | found, "machine": machine.describe()}
        DATA.write_text(json.dumps(data, indent=1) + "\n")
    return int(not all(one["same"] for one in found.values()))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.exit(main(arguments(__doc__, names="problems").names))
