"""What JAX's default device gains over the CPU of the same machine: ``python -m benchmarks.device``.

Each part runs twice, in a process that sees the device and in one that sees the CPU alone: the local phase in
microseconds a particle (float64 and float32), beside what the device's memory and arithmetic would allow; the global
system by multigrid (where pyamg is installed); whole solves, in 2D and 3D, phase by phase; and a value with its
gradient. Needs no more than the package's own dependencies, and ends within four minutes: parts that no longer fit are
left out by name. Several devices share the local phase of a solve, the program alone runs on the first. Where JAX finds
no other device than the CPU that is measured alone, and its numbers are printed and not kept.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import machine
from benchmarks.commandline import arguments
from benchmarks.scale import scattered

ROOT = Path(__file__).parent.parent
DATA = Path(__file__).parent / "data" / "device.json"
# Dimension, order, neighbours with the particle itself, particles along an axis.
LOCAL = ((2, 4, 20, 400), (2, 6, 28, 400), (2, 8, 36, 400), (3, 2, 20, 50), (3, 4, 50, 50))
# Dimension, particles along an axis; order 4.
WHOLE = ((2, 316), (3, 63), (2, 1000))
REPEATS, ORDER = 5, 4


def least(call: Any, repeats: int = REPEATS) -> tuple[float, float]:
    """Seconds of the first call and the least of some more, each until its results are there."""
    import jax

    took = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(call())
        took.append(time.perf_counter() - start)
    return took[0], min(took[1:])


def poisson(cloud: Any, dim: int) -> Any:
    import jax.numpy as jnp

    import jsmitsm as js

    def exact(x):
        u = jnp.sin(5 * x[0] + 1) * jnp.cos(4 * x[1] - 0.5)
        return u if dim == 2 else u * jnp.cos(3 * x[2])

    residual = lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x)  # noqa: E731
    return js.Problem(residual, {"rim": js.dirichlet(exact)}), exact


def peaks() -> dict[str, Any]:
    """Bytes and operations a second that the device reaches: a long sum of two arrays, and a product of matrices."""
    import jax
    import jax.numpy as jnp

    found = {}
    for name, kind in (("float64", jnp.float64), ("float32", jnp.float32)):
        if jnp.zeros(1, kind).dtype != kind:
            continue
        long, side = jnp.ones(1 << 26, kind), jnp.ones((4096, 4096), kind)
        _, copy = least(partial(jax.jit(lambda a: 2.0 * a + 1.0), long))
        _, product = least(partial(jax.jit(jnp.matmul), side, side), 2)
        found[name] = {"bytes_per_s": 2 * long.nbytes / copy, "flops": 2 * 4096**3 / product}
    return found


def work(dim: int, order: int, size: int, width: int) -> tuple[float, float]:
    """Bytes that must move and operations that must be done for one particle's row, at least.

    Its neighbours' numbers and coordinates come, its weights go; the free columns of the moments are made, their normal
    matrix and its Cholesky factor.
    """
    columns = (order + 1) * (order + 2) // 2 if dim == 2 else (order + 1) * (order + 2) * (order + 3) // 6
    free = 2 * order + 1 if dim == 2 else (order + 1) ** 2
    made = size * columns * 2 + 2 * size * columns * free
    return size * (4 + width * dim + width), made + size * free**2 + free**3 / 3


def local(width: int) -> dict[str, Any]:
    """The rows of all particles as a solve makes them, and the program alone on arrays that are on the device."""
    from dataclasses import replace

    import jax

    import jsmitsm as js
    from jsmitsm.discretization.coefficients import numbers
    from jsmitsm.discretization.local_data import around, operands, shared_elimination
    from jsmitsm.discretization.rows import all_rows
    from jsmitsm.particle import batches
    from jsmitsm.solution.arguments import discretized

    found = {}
    for dim, order, size, side in LOCAL:
        cloud = scattered(dim, side, 0)
        near = js.stencils(cloud, size=size)
        # A tie in one particle of thousands would make all stencils wider.
        near = replace(near, indices=near.indices[:, :size])
        problem, _ = poisson(cloud, dim)
        disc = discretized(problem, cloud, "S", order, None, near)
        nums: Any = numbers(disc, problem)
        first, again = least(partial(all_rows, disc, nums))
        (cls,) = disc.classes
        there = around(disc, nums)
        given = operands(disc, nums, cls, shared_elimination(disc, nums), there.data)
        arrays = jax.device_put((there.points, None, cls.ids, cls.neighbours, given))
        # On a CPU the solve's own programs are better than this one, and nothing has to be moved.
        alone = jax.jit(partial(batches.rows, cls.scheme))
        kernel = None if jax.default_backend() == "cpu" else least(partial(alone, *arrays))[1] / len(cls.ids)
        moved, done = work(dim, order, size, width)
        found[f"{dim}D, order {order}, {size} neighbours"] = {
            "particles": len(cls.ids), "first_s": first, "us": 1e6 * again / len(cls.ids),
            "us_on_device": kernel and 1e6 * kernel, "bytes": moved, "operations": done,
        }  # fmt: skip
    return found


def whole(dim: int, side: int) -> dict[str, Any]:
    """Two solves, the second on other particles."""
    import jax
    import jax.numpy as jnp

    import jsmitsm as js

    line: dict[str, Any] = {}
    for name, seed in (("first_s", 0), ("again_s", 1)):
        cloud = scattered(dim, side, seed)
        problem, exact = poisson(cloud, dim)
        start = time.perf_counter()
        sol = js.solve(problem, cloud, order=ORDER)
        u = np.asarray(sol.u)
        line[name] = time.perf_counter() - start
    true = np.asarray(jax.vmap(exact)(jnp.asarray(cloud.points)))
    linear = sol.stats["linear"]
    return line | {
        "particles": len(cloud), "parts": {k: v for k, v in sol.stats["seconds"].items() if k != "total"},
        "backend": linear["backend"], "iterations": linear["iterations"],
        "error": float(np.linalg.norm(u - true) / np.linalg.norm(true)),
    }  # fmt: skip


def multigrid(side: int = 316) -> dict[str, Any] | str:
    """A global system solved again, its hierarchy kept."""
    if not find_spec("pyamg"):
        return "left out: pyamg is not installed"
    import jsmitsm as js

    cloud = scattered(2, side, 0)
    problem, _ = poisson(cloud, 2)
    sol = js.solve(problem, cloud, order=ORDER, solver="iterative")
    first = sol.stats["seconds"]["solve"]
    again = min(
        js.solve(problem, cloud, order=ORDER, solver="iterative").stats["seconds"]["solve"] for _ in range(2)
    )  # fmt: skip
    linear = sol.stats["linear"]
    return {
        "particles": len(cloud), "first_s": first, "again_s": again,
        "backend": linear["backend"], "iterations": linear["iterations"],
    }  # fmt: skip


def gradient(side: int = 141) -> dict[str, Any]:
    """A sum of squares and its derivatives by h, d, the source and four boundary values, beside the value alone."""
    from benchmarks.gradients import Scene

    scene = Scene(side)
    names = ("h", "d", "source", "walls")
    turn = iter(range(100))
    near = lambda: {"h": scene.numbers["h"] * (1 + 1e-4 * next(turn))}  # noqa: E731  # no factor is found again
    first, both = least(lambda: scene.gradient(names, near()), 3)
    _, value = least(lambda: scene.value(near()), 3)
    return {"particles": side**2, "first_s": first, "value_and_grad_s": both, "value_s": value}


PARTS = {
    "peaks": peaks,
    "local, float64": lambda: local(8),
    "local, float32": lambda: local(4),
    "multigrid": multigrid,
    **{f"whole, {d}D": (lambda d=d, n=n: whole(d, n)) for d, n in WHOLE[:2]},
    "gradient": gradient,
    "whole, a million": lambda: whole(*WHOLE[2]),
}


def parts(limit: float) -> None:
    """Every part in this process, a line of JSON each, as long as there is time."""
    start = time.perf_counter()
    import jax

    device = jax.devices()[0]
    about = {"device": getattr(device, "device_kind", str(device)), "devices": jax.device_count()}
    print(json.dumps(about | {"platform": device.platform}), flush=True)
    for name, part in PARTS.items():
        if time.perf_counter() - start > limit:
            print(json.dumps({name: "left out: no time"}), flush=True)
            continue
        jax.config.update("jax_enable_x64", "float32" not in name)
        began = time.perf_counter()
        try:
            made: Any = part()
        except Exception as error:  # one part that a device cannot do does not hide the others
            made = f"failed: {type(error).__name__}: {error}"[:2000]
        print(json.dumps({name: made, "seconds": time.perf_counter() - began}), flush=True)


def run(cpu: bool, limit: float) -> dict[str, Any]:
    """The parts in a process of its own that sees the CPU alone, or whatever JAX finds."""
    env = dict(os.environ, JAX_PLATFORMS="cpu") if cpu else dict(os.environ)
    command = [sys.executable, "-m", "benchmarks.device", "--one", f"--limit={limit}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=env)
    try:
        out, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        process.kill()
        out, _ = process.communicate()
    found: dict[str, Any] = dict.fromkeys(PARTS, "left out: no time") | {"exit": process.returncode}
    for line in out.splitlines():
        if line.startswith("{"):
            found |= {k: v for k, v in json.loads(line).items() if k != "seconds"}
    return found


def local_table(about: dict[str, Any], cpu: dict[str, Any], device: dict[str, Any]) -> dict[str, Any]:
    """Microseconds a particle, and the least that memory and arithmetic of the device allow."""
    rows = []
    for kind in ("float64", "float32"):
        peak = device["peaks"][kind]
        for case, line in device[f"local, {kind}"].items():
            least_us = 1e6 * max(line["bytes"] / peak["bytes_per_s"], line["operations"] / peak["flops"])
            host = cpu[f"local, {kind}"][case]["us"]
            alone = line["us_on_device"] or line["us"]
            cells = (host, line["us"], alone, least_us)
            rows.append([case, kind, *(f"{x:.2g}" for x in cells), f"{100 * least_us / alone:.0f} %"])
    peak = device["peaks"]["float64"]
    note = (
        f"Microseconds a particle: {about['cores']} cores ({about['processor']}) against one {device['device']}, JAX "
        f"{about['jax']} (`python -m benchmarks.device`). In a solve the rows come back to the host, where the matrix "
        "is assembled; alone, everything is on the device already. Least: what must be read, written and computed, at "
        f"the {peak['bytes_per_s'] / 1e12:.1f} TB/s and {peak['flops'] / 1e12:.0f} TFLOP/s (float64) that a long sum "
        "and a product of matrices reach on it."
    )
    columns = ["", "", "CPU", "device, in a solve", "device, alone", "least", "share"]
    return {"columns": columns, "rows": rows, "note": note}


def whole_table(about: dict[str, Any], cpu: dict[str, Any], device: dict[str, Any]) -> dict[str, Any]:
    """Seconds of whole calls."""
    rows = []
    for name in PARTS:
        one, other = device.get(name), cpu.get(name)
        if not (name.startswith("whole") and isinstance(one, dict) and isinstance(other, dict)):
            continue
        for place, line in (("CPU", other), ("device", one)):
            parts = [f"{line['parts'][k]:.2g}" for k in ("set-up", "local", "assembly", "solve")]
            cells = [f"{line['first_s']:.3g}", f"{line['again_s']:.3g}", *parts, line["backend"]]
            rows.append([f"{name[7:]}: {line['particles']:,}", place, *cells])
    note = f"Seconds, order {ORDER}, on the same machine: first call, another cloud, and its phases."
    one, other = device["gradient"], cpu["gradient"]
    if isinstance(one, dict) and isinstance(other, dict):
        note += (
            f" A value with its gradient at {one['particles']:,} particles: {one['value_and_grad_s']:.2g} s on the "
            f"device, {other['value_and_grad_s']:.2g} s on the CPU; first {one['first_s']:.2g} and "
            f"{other['first_s']:.2g} s."
        )
    one, other = device["multigrid"], cpu["multigrid"]
    if isinstance(one, dict) and isinstance(other, dict):
        note += (
            f" A multigrid solve of {one['particles']:,} unknowns whose hierarchy is kept: {1e3 * one['again_s']:.0f} "
            f"and {1e3 * other['again_s']:.0f} ms."
        )
    columns = ["particles", "", "first call", "another cloud", "set-up", "local", "assembly", "solve", "linear solver"]
    return {"columns": columns, "rows": rows, "note": note}


def main(to: Path, limit: float) -> None:
    found = {"device": run(False, limit / 2)}
    other = found["device"].get("platform") != "cpu"
    if other:
        found["cpu"] = run(True, limit / 2)
    made: dict[str, Any] = {"machine": machine.describe(), **found}
    print(json.dumps(found, indent=1))
    if other:
        given = made["machine"], found["cpu"], found["device"]
        made["tables"] = {"device-local": local_table(*given), "device-whole": whole_table(*given)}
        to.write_text(json.dumps(made, indent=1) + "\n")


if __name__ == "__main__":
    given = arguments(__doc__, "to=", "limit=", "one")
    if given.one:
        parts(float(given.limit or 110))
    else:
        main(Path(given.to or DATA), float(given.limit or 230))
