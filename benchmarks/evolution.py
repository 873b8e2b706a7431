"""Evolutions against known ones, other packages beside them: ``python -m benchmarks.evolution [names] [--quick]``.

Names: heat, grid, orders, random, impulse, front, burgers, wave, grayscott, taylorgreen, flow, slip, cost, gradient,
large; all but the last without any. Each writes its part of benchmarks/data/evolution.json.

heat, grid, orders, random, cost: u_t = laplacian(u) + s with the answer exp(x - t/2) sin(2 y + t), which its boundary
knows; on the unit disk, on the square, and on uniformly random particles of it. impulse: u = 1 in a disk that is held
at 0, against its Bessel series. front: a bistable travelling wave. burgers: u_t + u (u_x + u_y) = 0.1 laplacian(u).
wave: a standing wave of a square membrane over 20 periods. grayscott: two reacting fields on a periodic square, against
a Fourier spectral reference of 128 x 128 points. taylorgreen: the vortex's stream function, from whose gradient
velocities come.
flow: the same vortex, and a cavity from rest, in velocities and pressure; errors are those of the velocities. slip: a
cell of the vortex between walls along which it slips.
gradient: what jax.value_and_grad costs beside a forward run. large: 100,489 particles, 100 steps.

Peers: scikit-fem's P2 elements, on triangles with curved sides (isoparametric), stepped by this package's own KenCarp4
with this package's own factors; py-pde's finite differences of second order.
"""

from __future__ import annotations

import json
import resource
import statistics
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.special import j0, j1, jn_zeros  # noqa: E402

import jsmitsm as js  # noqa: E402
from benchmarks import evolution_peers as peers  # noqa: E402
from benchmarks.commandline import arguments  # noqa: E402

DATA = Path(__file__).parent / "data" / "evolution.json"
SIDES = ("left", "right", "bottom", "top")
Line = dict[str, Any]


def disk(spacing: float) -> js.Cloud:
    return js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.1, -1.1), (1.1, 1.1)), spacing)


def square(n: int, lo: float = 0.0, hi: float = 1.0) -> js.Cloud:
    return js.rectangle((lo, lo), (hi, hi), (n, n), jitter=0.25)


def everywhere(cloud: js.Cloud, condition: Any) -> dict[str, Any]:
    return {name: condition for name in cloud.groups if name != "interior"}


def values(f: Callable[..., Any], cloud: js.Cloud, *more: Any) -> np.ndarray:
    return np.asarray(jax.vmap(lambda x: f(x, *more))(cloud.points))


def line(case: str, order: Any, unknowns: int, steps: int, error: float, seconds: float, wanted: float | None = None,
         **more: Any) -> Line:  # fmt: skip
    """One line of the table; wanted: what the error is meant to stay below."""
    return {"case": case, "order": order, "unknowns": unknowns, "steps": steps, "error": float(error),
            "wanted": wanted, "seconds": round(seconds, 2), **more}  # fmt: skip


def evolved(case: str, problem: js.Problem, cloud: js.Cloud, u0: Any, t: tuple[float, float], exact: Any,
            wanted: float | None = None, **options: Any) -> Line:  # fmt: skip
    """One run against its answer, the largest error at the end."""
    began = time.perf_counter()
    run = js.evolve(problem, cloud, u0, t, progress=False, **options)
    spent = time.perf_counter() - began
    error = np.abs(np.asarray(run.u[-1]) - exact).max()
    return line(case, options.get("order", 4), run.stats["unknowns"], run.stats["steps"], error, spent, wanted,
                scheme=run.stats["scheme"], flags=list(run.flags))  # fmt: skip


# --------------------------------------------------------------------------------------- heat


def warm(x: Any, t: Any) -> Any:
    return jnp.exp(x[0] - 0.5 * t) * jnp.sin(2 * x[1] + t)


def source(x: Any, t: Any) -> Any:
    return jax.grad(warm, 1)(x, t) - js.laplacian(lambda y: warm(y, t))(x)


def heating(cloud: js.Cloud) -> js.Problem:
    return js.Problem(
        lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) - source(x, t), everywhere(cloud, js.dirichlet(warm))
    )


def heated(case: str, cloud: js.Cloud, wanted: float | None = None, **options: Any) -> Line:
    return evolved(
        case, heating(cloud), cloud, lambda x: warm(x, 0.0), (0.0, 1.0), values(warm, cloud, 1.0), wanted, **options
    )


def heat(quick: bool) -> Iterator[Line]:
    cloud = disk(1 / 16)
    for order, wanted in ((4, 2e-6), (6, 1e-8)):
        yield heated("heat on the disk", cloud, wanted, order=order, steps=40)
    for refined in (3,) if quick else (3, 4, 5):
        unknowns, error, spent = peers.elements(refined, 40)
        yield line("heat on the disk, scikit-fem", "P2", unknowns, 40, error, spent)


def grid(quick: bool) -> Iterator[Line]:
    yield heated("heat on the square", square(25), order=6, steps=40)
    for n in (32,) if quick else (32, 64):
        known = peers.heated_grid(warm, source, n)
        if known is not None:
            yield line("heat on the square, py-pde", 2, n * n, known[2], known[0], known[1])


def orders(quick: bool) -> Iterator[Line]:
    """Observed orders: in space over many spacings, in time between 10 and 20 steps.

    Every packing of particles has an error of its own, up to three times that of the next: pairs of clouds have orders
    from 3 to 7, and what counts is the slope over all of them.
    """
    spacings = np.array([8, 16] if quick else [8, 12, 16, 20, 24, 28, 32, 36, 40])
    for order in (4, 6):
        found = [heated(f"space, order {order}", disk(1 / n), order=order, steps=60, scheme="radau") for n in spacings]
        errors = np.log([out["error"] for out in found])
        observed = -np.polyfit(np.log(spacings), errors, 1)[0]
        yield found[-1] | {"observed": float(observed), "least": order - 0.3,
                           "all": [out["error"] for out in found]}  # fmt: skip
    cloud = disk(1 / 12)
    best = np.asarray(js.evolve(heating(cloud), cloud, lambda x: warm(x, 0.0), (0.0, 1.0), steps=160, order=8,
                                scheme="radau", progress=False).u[-1])  # fmt: skip
    for scheme, least in (("esdirk", 3.3), ("radau", 4.2)):
        pair = [evolved(f"time, {scheme}", heating(cloud), cloud, lambda x: warm(x, 0.0), (0.0, 1.0), best, order=8,
                        steps=steps, scheme=scheme) for steps in (10, 20)]  # fmt: skip
        yield pair[1] | {"observed": float(np.log2(pair[0]["error"] / pair[1]["error"])), "least": least}


def random(quick: bool) -> Iterator[Line]:
    """The error must not grow with the number of steps: an unstable pencil hides behind large ones."""
    lattice = js.rectangle((0, 0), (1, 1), (31, 31))
    points, inside = np.array(lattice.points), np.asarray(lattice.groups["interior"])
    points[inside] = np.random.default_rng(0).uniform(0.01, 0.99, (len(inside), 2))
    cloud = js.Cloud(points, lattice.groups, lattice.normals)
    exact = values(warm, cloud, 1.0)
    for order in (4,) if quick else (4, 6, 8):
        runs, seconds = {}, {}
        for steps in (10, 100, 1000):
            began = time.perf_counter()
            runs[steps] = js.evolve(heating(cloud), cloud, lambda x: warm(x, 0.0), (0.0, 1.0), steps=steps, order=order,
                                    scheme="esdirk", progress=False)  # fmt: skip
            seconds[steps] = time.perf_counter() - began
        last = [np.asarray(run.u[-1]) for run in runs.values()]
        errors = [float(np.abs(u - exact).max()) for u in last]
        for (steps, run), u, error in zip(runs.items(), last, errors):
            yield line("heat on random particles", order, run.stats["unknowns"], steps, error, seconds[steps],
                       1.1 * errors[0], scheme=run.stats["scheme"], flags=list(run.flags),
                       in_time=float(np.abs(u - last[-1]).max()))  # fmt: skip


def impulse(quick: bool) -> Iterator[Line]:
    cloud = disk(1 / 16)
    zeros, radius = jn_zeros(0, 60), np.linalg.norm(np.asarray(cloud.points), axis=1)
    exact = sum(2 / (a * j1(a)) * j0(a * radius) * np.exp(-a * a * 0.1) for a in zeros)
    problem = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), {"boundary": js.dirichlet(0.0)})
    yield evolved("incompatible start", problem, cloud, 1.0, (0.0, 0.1), exact, 1e-7, order=8, steps=40)


# --------------------------------------------------------------------------------------- nonlinear, waves


def front(quick: bool) -> Iterator[Line]:
    def wave(x: Any, t: Any) -> Any:
        return 1 / (1 + jnp.exp((3 * (0.8 * x[0] + 0.6 * x[1]) - 0.2 * jnp.sqrt(2.0) * t) / jnp.sqrt(2.0)))

    cloud = square(25, -0.5, 0.5)
    problem = js.Problem(
        lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x) / 9 - u(x) * (1 - u(x)) * (u(x) - 0.3),
        everywhere(cloud, js.dirichlet(wave)),
    )
    yield evolved("travelling front", problem, cloud, lambda x: wave(x, 0.0), (0.0, 2.0), values(wave, cloud, 2.0),
                  2e-6, order=6, steps=40)  # fmt: skip


def burgers(quick: bool) -> Iterator[Line]:
    def shock(x: Any, t: Any) -> Any:
        return 1 / (1 + jnp.exp((x[0] + x[1] - t) / 0.2))

    cloud = square(37)
    problem = js.Problem(
        lambda u, x, t: js.dt(u)(x) + u(x) * jnp.sum(js.grad(u)(x)) - 0.1 * js.laplacian(u)(x),
        everywhere(cloud, js.dirichlet(shock)),
    )
    yield evolved("Burgers, nu = 0.1", problem, cloud, lambda x: shock(x, 0.0), (0.0, 0.5), values(shock, cloud, 0.5),
                  1e-6, order=6, steps=80)  # fmt: skip


def wave(quick: bool) -> Iterator[Line]:
    cloud = square(31)
    problem = js.Problem(
        lambda u, x, t: js.dt(u, 2)(x) - js.laplacian(u)(x), everywhere(cloud, js.dirichlet(0.0))
    )

    def standing(x: Any) -> Any:
        return jnp.sin(jnp.pi * x[0]) * jnp.sin(jnp.pi * x[1])

    yield evolved("membrane, 20 periods", problem, cloud, (standing, 0.0), (0.0, 20 * 2**0.5), values(standing, cloud),
                  1e-4, order=6, steps=800)  # fmt: skip


FEED, KILL, SPREAD, LONG = 0.04, 0.06, (8e-4, 4e-4), 60.0


def spot(x: Any) -> Any:
    bump = jnp.exp(-30.0 * ((jnp.sin(jnp.pi * (x[0] - 0.5)) ** 2 + jnp.sin(jnp.pi * (x[1] - 0.45)) ** 2) / jnp.pi**2))
    return jnp.stack([1.0 - 0.5 * bump, 0.25 * bump])


def gray_scott() -> js.Problem:
    def pde(u: Any, x: Any, t: Any) -> Any:
        a, b = u(x)
        lap = js.laplacian(u)(x)
        return js.dt(u)(x) - jnp.stack(
            [SPREAD[0] * lap[0] - a * b * b + FEED * (1 - a), SPREAD[1] * lap[1] + a * b * b - (FEED + KILL) * b]
        )

    return js.Problem(pde, {"left": js.periodic("left", "right"), "bottom": js.periodic("bottom", "top")}, fields=2)


def grayscott(quick: bool) -> Iterator[Line]:
    exact = peers.spectral(spot, SPREAD, FEED, KILL, LONG)
    cloud = js.rectangle((0, 0), (1, 1), (33, 33), jitter=0.2)
    for order in (4, 6):
        yield evolved("Gray-Scott", gray_scott(), cloud, spot, (0.0, LONG), exact(np.asarray(cloud.points)), 1e-4,
                      order=order, steps=120)  # fmt: skip
    for n in (32,) if quick else (32, 64):
        found = peers.differences(spot, SPREAD, FEED, KILL, LONG, n, exact)
        if found is not None:
            yield line("Gray-Scott, py-pde", 2, 2 * n * n, found[2], found[0], found[1])


def taylorgreen(quick: bool) -> Iterator[Line]:
    """Stream function and vorticity between walls that slip; the error is that of the velocity."""
    nu, end = 0.1, 1.0

    def pde(u: Any, x: Any, t: Any) -> Any:
        g, h, lap = js.grad(u[0])(x), js.grad(u[1])(x), js.laplacian(u)(x)
        return jnp.stack([lap[0] + u(x)[1], js.dt(u[1])(x) + g[1] * h[0] - g[0] * h[1] - nu * lap[1]])

    def stream(x: Any, t: Any) -> Any:
        return jnp.sin(x[0]) * jnp.sin(x[1]) * jnp.exp(-2 * nu * t)

    cloud = square(21, 0.0, np.pi)
    problem = js.Problem(pde, everywhere(cloud, js.dirichlet(0.0)), fields=2)
    began = time.perf_counter()
    run = js.evolve(problem, cloud, lambda x: jnp.stack([stream(x, 0.0), 2 * stream(x, 0.0)]), (0.0, end), steps=20,
                    order=6, progress=False)  # fmt: skip
    spent = time.perf_counter() - began
    found = np.asarray(run.at(end).grad(cloud.points))[:, 0]
    exact = values(jax.grad(stream), cloud, end)
    yield line("Taylor-Green vortex, velocity", 6, run.stats["unknowns"], 20, np.abs(found - exact).max(), spent, 1e-5,
               scheme=run.stats["scheme"], flags=list(run.flags))  # fmt: skip


def velocities(u: Any, x: Any, t: Any, nu: float) -> Any:
    """Navier's and Stokes' equations in velocities and pressure."""
    v, p = u[:2], u[2]
    momentum = js.dt(v)(x) + js.grad(v)(x) @ v(x) - nu * js.laplacian(v)(x) + js.grad(p)(x)
    return jnp.append(momentum, js.divergence(v)(x))


def vortex(x: Any, t: Any, nu: float = 0.1) -> Any:
    """Velocities and pressure of Taylor and Green's vortex."""
    v = jnp.stack([jnp.sin(x[0]) * jnp.cos(x[1]), -jnp.cos(x[0]) * jnp.sin(x[1])])
    decay = jnp.exp(-2 * nu * t)
    return jnp.append(v * decay, (jnp.cos(2 * x[0]) + jnp.cos(2 * x[1])) / 4 * decay**2)


def slip(quick: bool) -> Iterator[Line]:
    for order, n in ((4, 11),) if quick else ((4, 17), (6, 17)):
        cloud = square(n, 0.0, np.pi)
        bcs = {side: [js.dirichlet(0.0, field=k // 2), js.neumann(0.0, field=1 - k // 2)]
               for k, side in enumerate(SIDES)}  # fmt: skip
        problem = js.Problem(velocities, bcs, fields=3, params=0.1)
        began = time.perf_counter()
        run = js.evolve(problem, cloud, lambda x: vortex(x, 0.0), (0.0, 1.0), steps=10, order=order, progress=False)
        error = np.abs(np.asarray(run.u[-1]) - values(vortex, cloud, 1.0))[:, :2].max()
        yield line("Taylor-Green vortex between slip walls", order, run.stats["unknowns"], 10, error,
                   time.perf_counter() - began, scheme=run.stats["scheme"], flags=list(run.flags))  # fmt: skip


def flow(quick: bool) -> Iterator[Line]:
    """Velocities and pressure: a window on the decaying vortex, and fluid at rest in a cavity whose lid starts."""
    nu = 0.1

    def compared(case: str, run: js.Evolution, exact: Any, began: float, wanted: float | None = None) -> Line:
        found = np.asarray(run.u[-1])[:, : exact.shape[1]]
        return line(case, order, run.stats["unknowns"], run.stats["steps"], np.abs(found - exact).max(),
                    time.perf_counter() - began, wanted, scheme=run.stats["scheme"], flags=list(run.flags))  # fmt: skip

    window = [js.dirichlet(lambda x, t, nu, k=k: vortex(x, t)[k], field=k) for k in range(2)]
    for order, n in ((4, 17),) if quick else ((4, 17), (6, 17), (6, 23)):
        cloud = js.rectangle((0.3, 0.2), (2.0, 2.1), (n, n), jitter=0.2)
        problem = js.Problem(velocities, everywhere(cloud, window), fields=3, params=nu)
        began = time.perf_counter()
        run = js.evolve(problem, cloud, lambda x: vortex(x, 0.0), (0.0, 1.0), steps=10, order=order, progress=False)
        exact = values(vortex, cloud, 1.0)
        yield compared("Taylor-Green vortex, velocity and pressure", run, exact[:, :2], began,
                       1e-5 if (order, n) == (6, 23) else None)  # fmt: skip
    known = peers.started_cavity(nu, 0.25, 12)
    still = [js.dirichlet(0.0, field=k) for k in range(2)]
    lid = [js.dirichlet(lambda x, t, nu: 16 * (x[0] * (1 - x[0])) ** 2, field=0), still[1]]
    for order, n in ((6, 17),) if quick else ((6, 17), (6, 23), (6, 29)):
        cloud = js.rectangle((0, 0), (1, 1), (n, n), jitter=0.15)
        problem = js.Problem(velocities, {**dict.fromkeys(SIDES, still), "top": lid}, fields=3, params=nu)
        began = time.perf_counter()
        run = js.evolve(problem, cloud, 0.0, (0.0, 0.25), steps=20, order=order, progress=False)
        yield compared("cavity whose lid starts", run, known(np.asarray(cloud.points)), began)


# --------------------------------------------------------------------------------------- cost


def cost(quick: bool) -> Iterator[Line]:
    """Heat on the disk to 1e-7, twelve steps, everything but the particles and the mesh; compiled code is kept."""
    target, steps, repeats = 1e-7, 12, 3
    ours = [disk(s) for s in (1 / 10, 1 / 10.01, 1 / 10.02, 1 / 10.03)]
    heated("", ours[-1], order=6, steps=steps)
    runs = [heated("heat to 1e-7", cloud, target, order=6, steps=steps) for cloud in ours[:repeats]]
    best = min(runs, key=lambda out: out["seconds"])
    best["error"] = max(out["error"] for out in runs)
    for refined in range(4, 8):
        found = min((peers.elements(refined, steps) for _ in range(1 if refined > 5 else 2)), key=lambda out: out[2])
        fem = line("heat to 1e-7, scikit-fem", "P2", found[0], steps, found[1], found[2], target)
        if fem["error"] <= target or quick:
            break
    yield best | {"times faster": fem["seconds"] / best["seconds"]}
    yield fem


def gradient(quick: bool) -> Iterator[Line]:
    """By a source's, a conductivity's and the boundary values' strength; equal to differences of fourth order."""
    cloud = disk(0.1 if quick else 0.0345)
    steps = 20 if quick else 100

    def total(p: Any) -> Any:
        problem = js.Problem(
            lambda u, x, t, p: js.dt(u)(x) - p[0] * js.laplacian(u)(x) - p[1] * source(x, t),
            everywhere(cloud, js.dirichlet(lambda x, t, p: p[2] * warm(x, t))), params=p,
        )  # fmt: skip
        run = js.evolve(problem, cloud, lambda x: p[2] * warm(x, 0.0), (0.0, 1.0), steps=steps, scheme="esdirk",
                        progress=False)  # fmt: skip
        return jnp.sum(run.u[-1] ** 2) / len(cloud)

    def timed(call: Callable[[Any], Any], k: int) -> tuple[float, Any]:
        p = jnp.array([1.0 + 1e-3 * k, 1.0, 1.0])  # no factor of an earlier call is found again
        began = time.perf_counter()
        out = jax.block_until_ready(call(p))
        return time.perf_counter() - began, out

    both = jax.value_and_grad(total)
    timed(total, 90), timed(both, 91)
    pairs = [(timed(total, 2 * k)[0], timed(both, 2 * k + 1)[0]) for k in range(3 if quick else 5)]
    ratio = statistics.median(b / a for a, b in pairs)
    at, way, eps = jnp.ones(3), jnp.array([0.3, -0.5, 0.8]), 1e-3
    along = float(both(at)[1] @ way)
    moved = [float(total(at + s * eps * way)) for s in (1, -1, 2, -2)]
    slope = (8 * (moved[0] - moved[1]) - moved[2] + moved[3]) / (12 * eps)
    yield line("value and gradient", 4, len(cloud) - len(cloud.groups["boundary"]), steps, abs(along / slope - 1),
               min(b for _, b in pairs), 1e-7, forward=min(a for a, _ in pairs), ratio=ratio)  # fmt: skip


def large(quick: bool) -> Iterator[Line]:
    cloud = js.rectangle((0, 0), (1, 1), (101, 101) if quick else (317, 317), jitter=0.2)
    out = heated("heat, many particles", cloud, order=4, steps=100)
    yield out | {"GiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20}


CASES: dict[str, Callable[[bool], Iterator[Line]]] = {
    "heat": heat, "grid": grid, "orders": orders, "random": random, "impulse": impulse, "front": front,
    "burgers": burgers, "wave": wave, "grayscott": grayscott, "taylorgreen": taylorgreen, "flow": flow, "slip": slip,
    "cost": cost, "gradient": gradient, "large": large,
}  # fmt: skip


def remark(out: Line) -> str:
    """What a line says beside its error."""
    if "observed" in out:
        return f"order {out['observed']:.1f} (at least {out['least']:.1f})"
    if "ratio" in out:
        return f"{out['ratio']:.1f} times the forward run"
    if "times faster" in out:
        return f"{out['times faster']:.0f} times faster than P2"
    if "in_time" in out:
        return f"{out['in_time']:.1e} of it in time" if out["in_time"] else ""
    return f"{out['GiB']:.1f} GiB" if "GiB" in out else ""


# Cases whose seconds count; they are run on a quiet machine.
TIMED = ("cost", "gradient", "large")


def table(data: dict[str, Any]) -> dict[str, Any]:
    """What the documentation shows."""
    lines = [out | {"timed": case in TIMED} for case in CASES for out in data.get(case, [])]
    rows = [
        [out["case"], out["order"], f"{out['unknowns']:,}", f"{out['steps']:,}", f"{out['error']:.1e}",
         f"{out['wanted']:.1e}" if out["wanted"] else "", f"{out['seconds']:.2f}" if out["timed"] else "",
         remark(out)] for out in lines
    ]  # fmt: skip
    note = (
        "Largest errors at the end (`python -m benchmarks.evolution`), seconds of a call on two cores where they were "
        "measured on a quiet machine. On random particles the error must not grow with the number of steps. "
        "scikit-fem's P2 elements have curved sides and are stepped by this package's KenCarp4 and factors; the error "
        "of a gradient is relative to differences of fourth order."
    )
    return {"columns": ["problem", "order", "unknowns", "steps", "error", "wanted", "seconds", ""], "rows": rows,
            "note": note}  # fmt: skip


def main(given: Namespace) -> None:
    unknown = sorted(set(given.names) - set(CASES))
    if unknown:
        raise SystemExit(f"{unknown[0]}: none of {', '.join(CASES)}")
    for name in given.names or [name for name in CASES if name != "large"]:
        lines = []
        for out in CASES[name](given.quick):
            print(" ".join(f"{k} {v:.2e}" if isinstance(v, float) else f"{k} {v}" for k, v in out.items()), flush=True)
            lines.append(out)
        if not given.quick:
            data = json.loads(DATA.read_text()) if DATA.exists() else {}
            data[name] = lines
            data["tables"] = {"evolution": table(data)}
            DATA.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    main(arguments(__doc__, "quick", names="case"))
