"""What a gradient costs: ``python -m benchmarks.gradients``.

A Poisson problem on a jittered lattice, method S of order 4, its sum of squares differentiated by plain jax.grad. Every
size runs in processes of its own: one for the times, forward solves and gradients in turn, and one each for the two
peaks of memory. Before every call h changes by a thousandth, so that no factor of an earlier one is found again.
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

from benchmarks import machine
from benchmarks.commandline import arguments

DATA = Path(__file__).parent / "data" / "gradients.json"
SIDES, REPEATS = (32, 141), 7
# What is differentiated with respect to: the kernel's numbers alone, and more and more of the problem.
PARAMETERS = {
    "h, d": ("h", "d"),
    "and a source's strength and 4 boundary values": ("h", "d", "source", "walls"),
    "and a coefficient of the operator": ("h", "d", "source", "walls", "reaction"),
}


class Scene:
    """The problem, and its objective as a function of a dict of numbers."""

    def __init__(self, side: int):
        import jax
        import numpy as np

        import jsmitsm as js

        jax.config.update("jax_enable_x64", True)
        self.js = js
        self.cloud = js.rectangle((0.0, 0.0), (1.0, 1.0), (side, side), jitter=0.2)
        spacing = 1.0 / (side - 1)
        self.numbers = {"h": 1.2 * spacing, "d": 3.2, "source": 2.0, "walls": np.arange(4.0), "reaction": 1.0}
        self.stencils = js.stencils(self.cloud, radius=4.0 * spacing)

    def value(self, given):
        import jax.numpy as jnp

        js, t = self.js, {**self.numbers, **given}
        pde = lambda u, x, p: js.laplacian(u)(x) - p[1] * u(x) - p[0] * jnp.sin(3 * x[0]) * x[1]
        names = ("left", "right", "bottom", "top")
        bcs = {name: js.dirichlet(t["walls"][k]) for k, name in enumerate(names)}
        problem = js.Problem(pde, bcs, params=(t["source"], t["reaction"]))
        kernel = js.SuperGaussian(h=t["h"], d=t["d"])
        return jnp.sum(js.solve(problem, self.cloud, order=4, kernel=kernel, stencils=self.stencils).u ** 2)

    def gradient(self, names, given):
        """Value and gradient with respect to ``names``; ``given``: numbers in place of the scene's own."""
        import jax

        return jax.value_and_grad(self.value)({k: {**self.numbers, **given}[k] for k in names})


def seconds(call) -> float:
    import jax

    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def times(side: int) -> dict:
    """First calls, repeated calls in turn, and what else they did."""
    import jax
    from jax.interpreters import mlir

    from jsmitsm.linear import linsolve

    scene, compiled, callbacks = Scene(side), [], []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, took, **_: compiled.append(took) if name.endswith("backend_compile_duration") else None
    )
    emit = mlir.emit_python_callback
    mlir.emit_python_callback = lambda *a, **k: callbacks.append(1) or emit(*a, **k)
    calls = {"forward": scene.value}
    for name, some in PARAMETERS.items():
        calls[name] = lambda t, some=some: scene.gradient(some, t)
    found: dict = {"side": side, "particles": len(scene.cloud), "first": {}, "programs": {}, "factorisations": {}}
    runs: dict = {name: [] for name in calls}
    for name, call in calls.items():
        before = len(compiled)
        found["first"][name] = seconds(lambda call=call: call({"h": scene.numbers["h"]}))
        found["programs"][name] = len(compiled) - before
    for k in range(REPEATS):
        for name, call in calls.items():
            before = linsolve.factorisations()
            h = scene.numbers["h"] * (1 + 1e-3 * (1 + k + 0.1 * len(name)))
            runs[name].append(seconds(lambda call=call, h=h: call({"h": h})))
            found["factorisations"][name] = linsolve.factorisations() - before
    return found | {"seconds": runs, "callbacks": len(callbacks)}


def peak(side: int, gradient: bool) -> float:
    """Bytes at the highest, of two calls."""
    scene = Scene(side)
    for factor in (1.0, 1.001):
        given = {"h": factor * scene.numbers["h"]}
        seconds(lambda given=given: scene.gradient(("h", "d"), given) if gradient else scene.value(given))
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def apart(*arguments: str):
    """The same in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.gradients", *arguments], capture_output=True, text=True, check=True,
        cwd=Path(__file__).parent.parent,
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    about, results, rows = machine.describe(), [], []
    for side in SIDES:
        found = apart(f"--times={side}")
        found["peak"] = {"forward": apart(f"--peak={side}"), "gradient": apart(f"--peak={side}", "--gradient")}
        results.append(found)
        forward = found["seconds"]["forward"]
        for name in PARAMETERS:
            own = found["seconds"][name]
            rows.append([
                found["particles"], name, f"{found['first'][name]:.1f}", found["programs"][name],
                f"{statistics.median(forward):.3f}", f"{statistics.median(own):.3f}",
                f"{statistics.median(a / b for a, b in zip(own, forward)):.2f}", found["factorisations"][name],
                f"{found['peak']['gradient'] / found['peak']['forward']:.2f}" if name == "h, d" else "",
            ])  # fmt: skip
            print(rows[-1], flush=True)
    callbacks = sum(found["callbacks"] for found in results)
    columns = ["particles", "with respect to", "first call (s)", "programs", "forward (s)", "value_and_grad (s)"]
    note = (
        f"Plain `jax.value_and_grad` of a Poisson problem, method S of order 4, medians of {REPEATS} calls in turn on "
        f"{about['cores']} cores of {about['processor']} (`python -m benchmarks.gradients`). programs: compiled at the "
        "first call, each set of parameters after the one above; ratio: median over the calls, to the forward solve "
        "before each; memory: peak of a process with gradients over that of one with forward solves. "
        f"Callbacks emitted: {callbacks}."
    )
    made = {"columns": [*columns, "ratio", "factorisations", "memory"], "rows": rows, "note": note}
    DATA.write_text(json.dumps({"machine": about, "results": results, "tables": {"gradients": made}}, indent=1) + "\n")


if __name__ == "__main__":
    given = arguments(__doc__, "times=", "peak=", "gradient")  # in processes of their own
    if given.times:
        print(json.dumps(times(int(given.times))))
    elif given.peak:
        print(json.dumps(peak(int(given.peak), given.gradient)))
    else:
        main()
