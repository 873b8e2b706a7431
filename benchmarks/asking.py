"""What it costs to ask a solution for its flags and its error: ``python -m benchmarks.asking``.

Seconds of a solve whose programs are compiled, of ``sol.flags`` after it, and of ``sol.error_estimate()`` alone. The
flags of a linear problem of one field cost some sums where it is far from its bounds; elsewhere they ask the estimate.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp

import jsmitsm as js
from benchmarks import machine
from benchmarks.commandline import arguments
from jsmitsm.linear.factor_cache import clear_cache

DATA = Path(__file__).parent / "data" / "asking.json"
REPEATS = 3
SIDES = ("left", "right", "bottom", "top", "front", "back")


def wave(x):
    return jnp.sin(2.0 * x[0] + x[-1])


def square(n: int, **options) -> js.Cloud:
    return js.rectangle((0.0, 0.0), (1.0, 1.0), (n, n), jitter=0.3, **options)


def held(dim: int, value=wave) -> dict[str, js.Condition]:
    return dict.fromkeys(SIDES[: 2 * dim], js.dirichlet(value))


def made(operator: Callable, exact: Callable = wave) -> Callable:
    return lambda u, x: operator(u, x) - operator(exact, x)


def diffusion(u, x):
    return js.divergence(lambda y: (1.0 + 0.5 * jnp.sin(3.0 * y[0])) * js.grad(u)(y))(x)


def elasticity(u, x):
    def stress(y):
        g = js.grad(u)(y)
        return jnp.trace(g) * jnp.eye(2) + g + g.T

    return js.divergence(stress)(x)


def both(x):
    return jnp.stack([wave(x), jnp.cos(x[0] - x[1])])


SCENES: dict[str, Callable[[], tuple[js.Problem, js.Cloud]]] = {
    "a rod": lambda: (js.Problem(made(lambda u, x: js.laplacian(u)(x)), held(1)), js.interval(0.0, 1.0, 201)),
    "Poisson": lambda: (js.Problem(made(lambda u, x: js.laplacian(u)(x)), held(2)), square(60)),
    "Poisson, a coarse cloud": lambda: (
        js.Problem(made(lambda u, x: js.laplacian(u)(x), lambda x: jnp.sin(9.0 * x[0] + x[1])),
                   held(2, lambda x: jnp.sin(9.0 * x[0] + x[1]))), square(15)),
    "variable diffusion": lambda: (js.Problem(made(diffusion), held(2)), square(60)),
    "nonlinear": lambda: (js.Problem(made(lambda u, x: js.laplacian(u)(x) - u(x) ** 3), held(2)), square(60)),
    "elasticity": lambda: (js.Problem(made(elasticity, both), held(2, both), fields=2), square(40)),
    "Poisson in 3D": lambda: (
        js.Problem(made(lambda u, x: js.laplacian(u)(x)), held(3)),
        js.box((0.0,) * 3, (1.0,) * 3, (13,) * 3, jitter=0.3)),
}  # fmt: skip


def timed(problem: js.Problem, cloud: js.Cloud) -> tuple[float, float, float, bool, int]:
    """Seconds of the solve, of its flags, of the estimate alone; whether the flags asked for it; how many there are."""
    clock = time.perf_counter
    clear_cache()
    start = clock()
    sol = js.solve(problem, cloud)
    solved = clock()
    flags = sol.flags
    told = clock()
    asked = "estimated error" in sol.diagnose()
    other = js.solve(problem, cloud)
    begun = clock()
    other.error_estimate()
    return solved - start, told - solved, clock() - begun, asked, len(flags)


def row(name: str) -> list[str]:
    problem, cloud = SCENES[name]()
    runs = [timed(problem, cloud) for _ in range(1 + REPEATS)][1:]
    solve, flags, estimate = (min(run[k] for run in runs) for k in range(3))
    asked = "yes" if runs[0][3] else "no"
    print(f"{name}: {solve:.3f} {flags:.3f} {estimate:.3f} asked: {asked}, flags {runs[0][4]}", flush=True)
    return [name, str(len(cloud)), *(f"{s:.3g}" for s in (solve, flags, estimate)), asked, f"{1 + flags / solve:.2g}"]


def main() -> None:
    about = machine.describe()
    rows = [row(name) for name in SCENES]
    note = (
        f"Seconds, the least of {REPEATS} runs of compiled programs with no factors kept, on {about['cores']} cores of "
        f"{about['processor']} (`python -m benchmarks.asking`): of the solve, of its flags, and of the error estimate "
        "asked for by itself; order 4. The last column is the solve with its flags over the solve."
    )
    columns = ["", "particles", "solve", "flags", "estimate", "flags asked for the estimate", "with flags"]
    table = {"columns": columns, "rows": rows, "note": note}
    DATA.write_text(json.dumps({"machine": about, "tables": {"asking": table}}, indent=1) + "\n")


if __name__ == "__main__":
    arguments(__doc__)
    jax.config.update("jax_enable_x64", True)
    main()
