"""Eigenvalues against known ones, finite elements beside them: ``python -m benchmarks.modes [names] [--quick]``.

Names: disk, free, plate, buckling, ball, elastic, beam, mass, spectra, flow; all without any. Each writes its part of
benchmarks/data/modes.json.

disk, free: -laplacian(u) = lambda u on the unit disk, u or its normal derivative zero: Bessel's zeros. plate: the
clamped square, against sqrt(lambda) = 35.98519. buckling: the same under pressure from all sides, 52.34469. ball: the
unit ball, pi^2. elastic: a square between rollers, whose waves are known. beam: a strip of length 2 and height 0.4 with
free faces, held across at its ends, against the equations of Rayleigh and Lamb (Graff, Wave Motion in Elastic Solids,
1975, section 8.1). mass: div(a grad u) with mass 1 + x y, against order 8 on 2209 particles. spectra: the largest real
part of the eigenvalues of B^-1 A, of L = laplacian, on clouds of about 400 particles; none may be above 1e-6. flow: the
same of Stokes' equations, with div u = 0 and with an equation for the pressure.
Elements: scikit-fem's P2 on triangles with curved sides (isoparametric) on the disk.
"""

from __future__ import annotations

import json
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.special import jn_zeros, jnp_zeros  # noqa: E402
from scipy.stats import qmc  # noqa: E402

import jsmitsm as js  # noqa: E402
from benchmarks.commandline import arguments  # noqa: E402
from jsmitsm.discretization.pencil.assemble import assemble_pencil  # noqa: E402

DATA = Path(__file__).parent / "data" / "modes.json"
SIDES = ("left", "right", "bottom", "top")
HELD, FREE, ROBIN = js.dirichlet(0.0), js.neumann(0.0), js.robin(1.0, 1.0, 0.0)


def minus_laplacian(u: Any, x: Any) -> Any:
    return -js.laplacian(u)(x)


def disk(spacing: float) -> js.Cloud:
    return js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.1, -1.1), (1.1, 1.1)), spacing)


def bessel(zeros: Callable[[int, int], np.ndarray], count: int, first: tuple[float, ...] = ()) -> np.ndarray:
    some = [np.repeat(zeros(m, 8) ** 2, 1 + (m > 0)) for m in range(14)]
    return np.sort(np.concatenate([*some, first]))[:count]


def line(what: str, order: Any, unknowns: int, values: np.ndarray, exact: np.ndarray, seconds: float) -> dict[str, Any]:
    """One line of the table: relative errors of the first value and the largest of all."""
    error = np.abs(values[: len(exact)] - exact) / np.where(exact > 0, exact, 1.0)
    first = int(exact[0] == 0)
    return {
        "case": what, "order": order, "unknowns": unknowns, "values": len(exact),
        "zero": float(error[0]) if first else None,
        "first": float(error[first]), "largest": float(error[first:].max()), "seconds": round(seconds, 2),
    }  # fmt: skip


def solved(what: str, problem: js.Problem, cloud: js.Cloud, exact: np.ndarray, orders: tuple[int, ...], **options: Any):
    for order in orders:
        start = time.perf_counter()
        modes = js.eigen(problem, cloud, len(exact), order=order, **options)
        spent = time.perf_counter() - start
        out = line(what, order, modes.stats["unknowns"], modes.values, exact, spent)
        error = np.abs(modes.values[: len(exact)] - exact)[exact > 0]
        out["estimate"] = float(np.median(modes.error_estimate()[: len(exact)][exact > 0] / error))
        yield out | {"flags": len(modes.flags)}


def on_disk(quick: bool) -> Iterator[dict[str, Any]]:
    exact = bessel(jn_zeros, 10)
    for spacing in (0.067,) if quick else (0.067, 0.0337):
        yield from solved("disk", js.Problem(minus_laplacian, {"boundary": HELD}), disk(spacing), exact, (4, 6, 8))
    for refined in (3,) if quick else (3, 4, 5):
        yield elements(refined, exact)


def elements(refined: int, exact: np.ndarray) -> dict[str, Any]:
    """Isoparametric P2 elements on the disk."""
    import scipy.sparse.linalg
    import skfem
    from skfem.models.poisson import laplace, mass

    start = time.perf_counter()
    mesh = skfem.MeshTri2.init_circle(refined)
    basis = skfem.Basis(mesh, skfem.ElementTriP2(), intorder=6)
    stiff, inert = laplace.assemble(basis), mass.assemble(basis)
    inner = basis.complement_dofs(basis.get_dofs())
    a, m = (x[inner][:, inner].tocsc() for x in (stiff, inert))
    values = np.sort(scipy.sparse.linalg.eigsh(a, len(exact), m, sigma=0.0, return_eigenvectors=False))
    return line("disk, P2 elements", "P2", len(inner), values, exact, time.perf_counter() - start)


def free_disk(quick: bool) -> Iterator[dict[str, Any]]:
    problem = js.Problem(minus_laplacian, {"boundary": FREE})
    yield from solved("free disk", problem, disk(0.067 if quick else 0.0337), bessel(jnp_zeros, 10, (0.0,)), (4, 6, 8))


def plate(quick: bool) -> Iterator[dict[str, Any]]:
    problem = js.Problem(lambda u, x: js.laplacian(js.laplacian(u))(x), dict.fromkeys(SIDES, [HELD, FREE]))
    for n in (17,) if quick else (17, 25, 33):
        for out in solved(
            "clamped plate", problem, js.rectangle((0, 0), (1, 1), (n, n)), np.array([35.98519**2]), (4, 6, 8)
        ):
            yield out | {"root": out["first"] / 2}


def ball(quick: bool) -> Iterator[dict[str, Any]]:
    cloud = js.from_sdf(js.sdf.sphere((0.0,) * 3, 1.0), ((-1.1,) * 3, (1.1,) * 3), 0.2 if quick else 0.134)
    exact = np.array([np.pi**2, *[20.190728556426629] * 3])
    yield from solved("ball", js.Problem(minus_laplacian, {"boundary": HELD}), cloud, exact, (2, 4, 6))


def buckling(quick: bool) -> Iterator[dict[str, Any]]:
    problem = js.Problem(lambda u, x: js.laplacian(js.laplacian(u))(x), dict.fromkeys(SIDES, [HELD, FREE]))
    for n in (13,) if quick else (13, 17):
        cloud = js.rectangle((0, 0), (1, 1), (n, n))
        yield from solved("buckling plate", problem, cloud, np.array([52.34469]), (4, 6), mass=minus_laplacian)


# Plane stress, nu = 0.3, Young's modulus 1.
MU, LAME = 0.5 / 1.3, 0.3 / (1 - 0.3**2)


def elasticity(u: Any, x: Any) -> Any:
    h = [js.hessian(u[k])(x) for k in range(2)]
    spread = jnp.stack([h[0][0, 0] + h[1][0, 1], h[0][0, 1] + h[1][1, 1]])
    return -MU * jnp.stack([jnp.trace(h[0]), jnp.trace(h[1])]) - (LAME + MU) * spread


def beam(quick: bool) -> Iterator[dict[str, Any]]:
    """No traction on the faces; at the ends no displacement across and no traction along."""
    length, half = 2.0, 0.2

    def traction(u: Any, x: Any, n: Any) -> Any:
        g = js.grad(u)(x)
        return LAME * jnp.trace(g) * n + MU * (g + g.T) @ n

    ends = [js.dirichlet(0.0, field=1), js.condition(lambda u, x, n: traction(u, x, n)[0])]
    bcs: Any = {**dict.fromkeys(SIDES[:2], ends), **dict.fromkeys(SIDES[2:], js.condition(traction))}
    values = [0.0]
    for number in np.pi / length * np.arange(1, 5):
        values += [v for bends in (True, False) for v in waves_of_a_strip(float(number), half, bends, 10.0)]
    exact = np.sort(values)[:6]
    cloud = js.rectangle((0, -half), (length, half), (31, 7) if quick else (41, 9), jitter=0.1)
    yield from solved("elastic beam", js.Problem(elasticity, bcs, fields=2), cloud, exact, (4, 6, 8))


def waves_of_a_strip(k: float, half: float, bends: bool, most: float) -> list[float]:
    """Squares of frequencies below ``most`` of waves with the number k along a strip with free faces, of density 1."""
    from scipy.optimize import brentq

    def misfit(square: float) -> float:
        p, q = (np.sqrt(complex(square / c - k * k)) for c in (LAME + 2 * MU, MU))
        one, two = (np.cos(p * half), np.sin(q * half) / q), (np.sin(p * half) / p, np.cos(q * half))
        own, other = (two, one) if bends else (one, two)
        factor = q * q if bends else p * p
        return float(((q * q - k * k) ** 2 * own[0] * own[1] + 4 * k * k * factor * other[0] * other[1]).real)

    places = np.linspace(1e-4, most, 4000)
    sign = np.sign([misfit(s) for s in places])
    return [float(brentq(misfit, places[i], places[i + 1], xtol=1e-14)) for i in np.flatnonzero(np.diff(sign))]


def elastic(quick: bool) -> Iterator[dict[str, Any]]:
    """No normal displacement and no shear on the sides."""
    def shear(u: Any, x: Any, n: Any) -> Any:
        return js.grad(u[0])(x)[1] + js.grad(u[1])(x)[0]

    bcs: Any = {side: [js.dirichlet(0.0, field=k), js.condition(shear)] for k, pair in enumerate((SIDES[:2], SIDES[2:]))
                for side in pair}  # fmt: skip
    waves = [(m * m + n * n, m * n > 0) for m in range(6) for n in range(6) if m + n]
    exact = np.sort(
        np.pi**2 * np.array([(LAME + 2 * MU) * k for k, _ in waves] + [MU * k for k, both in waves if both])
    )
    cloud = js.rectangle((0, 0), (1, 1), (16, 16) if quick else (26, 26), jitter=0.2)
    yield from solved("elastic square", js.Problem(elasticity, bcs, fields=2), cloud, exact[:6], (4, 6, 8))


def weighted(quick: bool) -> Iterator[dict[str, Any]]:
    def operator(u: Any, x: Any) -> Any:
        return -js.divergence(lambda y: (1 + 0.5 * y[0] * y[1]) * js.grad(u)(y))(x)

    problem = js.Problem(operator, dict.fromkeys(SIDES, HELD))
    options: Any = {"mass": lambda x: 1 + x[0] * x[1]}
    reference = js.eigen(problem, js.rectangle((0, 0), (1, 1), (47, 47), jitter=0.2), 3, order=8, **options).values
    cloud = js.rectangle((0, 0), (1, 1), (16, 16) if quick else (24, 24), jitter=0.2, seed=1)
    yield from solved("varying stiffness and mass", problem, cloud, reference, (4, 6, 8), **options)


# --------------------------------------------------------------------------------------- spectra


def square(kind: str, n: int = 20, seed: int = 0) -> js.Cloud:
    cloud = js.rectangle((0, 0), (1, 1), (n, n), jitter=0.3 if kind == "jittered" else 0.0, seed=seed)
    points, inside = np.array(cloud.points), cloud.groups["interior"]
    if kind == "Halton":
        points[inside] = 0.02 + 0.96 * qmc.Halton(2, scramble=False).random(len(inside) + 20)[20:]
    if kind == "random":
        points[inside] = 0.01 + 0.98 * np.random.default_rng(seed).uniform(size=(len(inside), 2))
    return js.Cloud(points, cloud.groups, cloud.normals)


def spectra(quick: bool) -> Iterator[dict[str, Any]]:
    four: dict[str, Any] = {
        "Dirichlet": dict.fromkeys(SIDES, HELD), "Neumann": dict.fromkeys(SIDES, FREE),
        "mixed": {"left": HELD, "right": FREE, "bottom": HELD, "top": FREE}, "Robin": dict.fromkeys(SIDES, ROBIN),
    }  # fmt: skip
    for kind in ("jittered", "Halton"):
        for name, bcs in four.items():
            for order in (4,) if quick else (2, 4, 6, 8):
                for depth in (0,) if quick else (0, 2):
                    yield spectrum(kind, name, square(kind), bcs, order, depth)
    for seed in range(1 if quick else 5):
        for name in ("Dirichlet", "Neumann", "mixed"):
            for order in (4,) if quick else (2, 4, 6, 8):
                yield spectrum(f"random, seed {seed}", name, square("random", seed=seed), four[name], order, 0)
    cloud = js.from_sdf(js.sdf.sphere((0.0,) * 3, 1.0), ((-1.1,) * 3, (1.1,) * 3), 0.26)
    for name, condition in (("Dirichlet", HELD), ("Neumann", FREE), ("Robin", ROBIN)):
        for order in (4,) if quick else (2, 4, 6):
            yield spectrum("ball", name, cloud, {"boundary": condition}, order, 0)


def spectrum(kind: str, name: str, cloud: js.Cloud, bcs: Any, order: int, depth: int) -> dict[str, Any]:
    """The eigenvalues of B^-1 A; particles that follow their neighbours are eliminated."""
    pencil = assemble_pencil(js.Problem(lambda u, x: js.laplacian(u)(x), bcs), cloud, order=order, depth=depth)
    a, b = (m.host.toarray()[np.ix_(pencil.free, pencil.free)] for m in (pencil.A, pencil.B))
    slaved = np.isin(pencil.free, pencil.slaved)
    own = ~slaved
    extended = np.zeros((len(own), own.sum()))
    extended[own] = np.eye(own.sum())
    extended[slaved] = -np.linalg.solve(a[np.ix_(slaved, slaved)], a[np.ix_(slaved, own)])
    b, a = (b @ extended)[own], (a @ extended)[own]
    values = np.linalg.eigvals(np.linalg.solve(b, a))
    fitness = pencil.layout.fitness
    return {
        "case": "spectrum", "cloud": kind, "conditions": name, "order": order, "depth": depth, "unknowns": len(a),
        "unstable": int((values.real > 1e-6).sum()), "largest": float(values.real.max()),
        "condition": float(np.linalg.cond(b)), "repaired": len(fitness.repaired), "following": int(slaved.sum()),
    }  # fmt: skip


# --------------------------------------------------------------------------------------- flow


def flows(quick: bool) -> Iterator[dict[str, Any]]:
    """Stokes' equations u_t - lap u + grad p = 0 between walls, with div u = 0 and with the pressure's own equation."""
    def constrained(u: Any, x: Any) -> Any:
        return jnp.append(-js.laplacian(u[:2])(x) + js.grad(u[2])(x), js.divergence(u[:2])(x))

    def reduced(u: Any, x: Any) -> Any:
        return jnp.append(-js.laplacian(u[:2])(x) + js.grad(u[2])(x), js.laplacian(u[2])(x))

    walls = [js.dirichlet(0.0, field=k) for k in range(2)]
    free = [*walls, js.condition(lambda u, x, n: js.divergence(u[:2])(x))]
    clouds = {"jittered": square("jittered", 13), "random": square("random", 13), "disk": disk(0.15)}
    for kind, cloud in clouds.items():
        names = [name for name in cloud.groups if name != "interior"]
        for what, pde, conditions in (("div u = 0", constrained, walls), ("pressure equation", reduced, free)):
            for order in (4,) if quick else (4, 6):
                problem = js.Problem(pde, dict.fromkeys(names, conditions), fields=3)
                yield flow_spectrum(kind, what, cloud, problem, order)


def flow_spectrum(kind: str, what: str, cloud: js.Cloud, problem: js.Problem, order: int) -> dict[str, Any]:
    """All finite modes, with the mean of the pressure held at zero: v = -lambda A^-1 B M v has those of velocities."""
    pencil = assemble_pencil(problem, cloud, order=order, mass=(True, True, False))
    a, b = (m.host.toarray()[np.ix_(pencil.free, pencil.free)] for m in (pencil.A, pencil.B))
    pressure = pencil.free % 3 == 2
    whole = np.block([[a, pressure[:, None]], [pressure[None], np.zeros((1, 1))]])
    moved = np.vstack([-b[:, ~pressure], np.zeros((1, (~pressure).sum()))])
    values = 1 / np.linalg.eigvals(np.linalg.solve(whole, moved)[:-1][~pressure])
    return {
        "case": "flow", "cloud": kind, "conditions": what, "order": order, "unknowns": len(a),
        "unstable": int((values.real > 1e-6).sum()), "largest": float(values.real.max()),
    }  # fmt: skip


CASES = {
    "disk": on_disk, "free": free_disk, "plate": plate, "buckling": buckling, "ball": ball, "elastic": elastic,
    "beam": beam, "mass": weighted,
    "spectra": spectra, "flow": flows,
}  # fmt: skip


def table(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """What the documentation shows: all but spectra, of which it says how many are unstable."""
    rows = []
    for out in lines:
        if out["case"] not in ("spectrum", "flow"):
            estimate = f"{out['estimate']:.2f}" if "estimate" in out else ""
            rows.append([out["case"], out["order"], out["unknowns"], f"{out['first']:.1e}",
                         f"{out['largest']:.1e} of {out['values']}", estimate])  # fmt: skip
    spectra = [out for out in lines if out["case"] == "spectrum"]
    note = "Relative errors of values (`python -m benchmarks.modes`)."
    if spectra:
        kinds = ", ".join(dict.fromkeys(out["cloud"].split(",")[0] for out in spectra))
        unstable = sum(out["unstable"] > 0 for out in spectra)
        note += (f" Of {len(spectra)} spectra of diffusion at orders 2 to 8 ({kinds} particles) {unstable or 'none'} "
                 f"{'has' if unstable < 2 else 'have'} a growing mode.")  # fmt: skip
    columns = ["problem", "order", "unknowns", "first value above zero", "largest", "estimated / true error"]
    return {"columns": columns, "rows": rows, "note": note}


def flow_table(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """The spectra of flow."""
    rows = [[out["conditions"], out["cloud"], out["order"], out["unknowns"], out["unstable"], f"{out['largest']:.3g}"]
            for out in lines]  # fmt: skip
    note = (
        "Modes of Stokes' equations between walls (`python -m benchmarks.modes flow`): those of the square begin at "
        "-52.3, those of the disk at -14.7; a divergence that diffuses begins at -49.3, on the disk at -14.7."
    )
    return {"columns": ["third equation", "particles", "order", "unknowns", "growing modes", "largest real part"],
            "rows": rows, "note": note}  # fmt: skip


def main(given: Namespace) -> None:
    unknown = sorted(set(given.names) - set(CASES))
    if unknown:
        raise SystemExit(f"{unknown[0]}: none of {', '.join(CASES)}")
    data = json.loads(DATA.read_text()) if DATA.exists() else {}
    for name in given.names or CASES:
        lines = []
        for out in CASES[name](given.quick):
            print(" ".join(f"{k} {v:.2e}" if isinstance(v, float) else f"{k} {v}" for k, v in out.items()), flush=True)
            lines.append(out)
        if not given.quick:
            data[name] = lines
            data["tables"] = {
                "modes": table([out for case in CASES for out in data.get(case, [])]),
                "flow-modes": flow_table(data.get("flow", [])),
            }
            DATA.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    main(arguments(__doc__, "quick", names="case"))
