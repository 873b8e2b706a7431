"""The battery of W. F. Mitchell's collection: seven rectangles of five materials, conditions of Robin's kind around.

Its solution is not known: ``python -m benchmarks.battery`` writes that of elements of degree 10 on rectangles that
shrink towards all lines on which materials meet (NGSolve), at some points, to ``benchmarks/data/battery.json``. Two
such meshes agree there to 2e-6 of the largest value.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks.commandline import arguments

DATA = Path(__file__).parent / "data" / "battery.json"
X = (0.0, 6.1, 6.5, 8.0, 8.4)
Y = (0.0, 0.8, 1.6, 3.6, 18.8, 21.2, 23.2, 24.0)
# The materials of the rectangles between these lines, from below; of each the conductivities along x and y, the source.
LAYOUT = ("1111", "5451", "2451", "3451", "2451", "5551", "1111")
MATERIALS = {"1": (25.0, 25.0, 0.0), "2": (7.0, 0.8, 1.0), "3": (5.0, 1e-4, 1.0), "4": (0.2, 0.2, 0.0),
             "5": (0.05, 0.05, 0.0)}  # fmt: skip
# c u + flux = g on the sides.
SIDES = {"left": (0.0, 0.0), "top": (1.0, 3.0), "right": (2.0, 2.0), "bottom": (3.0, 1.0)}


def _box(x0: float, x1: float, y0: float, y1: float) -> np.ndarray:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


REGIONS = {
    "case": ("1", np.array([(0, 0), (8.4, 0), (8.4, 24), (0, 24), (0, 23.2), (8, 23.2), (8, 0.8), (0, 0.8)])),
    "lower": ("2", _box(0.0, 6.1, 1.6, 3.6)),
    "upper": ("2", _box(0.0, 6.1, 18.8, 21.2)),
    "core": ("3", _box(0.0, 6.1, 3.6, 18.8)),
    "wall": ("4", _box(6.1, 6.5, 0.8, 21.2)),
    "floor": ("5", _box(0.0, 6.1, 0.8, 1.6)),
    "lining": ("5", np.array([(6.5, 0.8), (8, 0.8), (8, 23.2), (0, 23.2), (0, 21.2), (6.5, 21.2)])),
}
MEETING = ("case|floor", "case|wall", "case|lining", "lower|floor", "lower|core", "lower|wall", "upper|core",
           "upper|wall", "upper|lining", "core|wall", "wall|floor", "wall|lining")  # fmt: skip


def _equation(p: float, q: float, f: float) -> Any:
    def pde(u: Any, x: Any) -> Any:
        curved = js.hessian(u)(x)
        return p * curved[0, 0] + q * curved[1, 1] + f

    return pde


def _flux(p: float, q: float, _: float) -> Any:
    return lambda u, x, n: jnp.array([p, q]) * n @ js.grad(u)(x)


def problem() -> js.Problem:
    numbers = {name: MATERIALS[material] for name, (material, _) in REGIONS.items()}
    flux = {name: _flux(*some) for name, some in numbers.items()}
    around = {}
    for side, (c, g) in SIDES.items():
        around[side] = js.condition(lambda u, x, n, c=c, g=g: flux["case"](u, x, n) + c * u(x) - g)
    around["left"] = js.neumann(0.0)
    between = {pair: js.interface(flux={name: flux[name] for name in pair.split("|")}) for pair in MEETING}
    return js.Problem({name: _equation(*some) for name, some in numbers.items()}, {**around, **between})


def make(spacing: Any) -> js.RegionCloud:
    on = lambda axis, value: lambda x: np.abs(x[:, axis] - value) < 1e-9
    groups = {"left": on(0, X[0]), "right": on(0, X[-1]), "bottom": on(1, Y[0]), "top": on(1, Y[-1])}
    return js.regions({name: shape for name, (_, shape) in REGIONS.items()}, spacing=spacing, groups=groups)


def known() -> tuple[np.ndarray, np.ndarray]:
    """Points (M, 2) and the solution's values (M,) there."""
    data = json.loads(DATA.read_text())
    return np.asarray(data["points"]), np.asarray(data["values"])


# ------------------------------------------------------------------ the values, by elements


def _points() -> np.ndarray:
    """Some anywhere, and some a tenth, a hundredth and a thousandth away from where lines cross."""
    anywhere = np.random.default_rng(0).uniform((X[0], Y[0]), (X[-1], Y[-1]), (300, 2))
    angles = 0.3 + np.pi / 2 * np.arange(4)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    near = [np.array([x, y]) + r * way for x in X for y in Y for r in (0.1, 0.01, 0.001) for way in ring]
    near = np.asarray([at for at in near if X[0] < at[0] < X[-1] and Y[0] < at[1] < Y[-1]])
    return np.round(np.concatenate([anywhere, near]), 9)


def _lines(ends: tuple[float, ...], levels: int, shrink: float = 0.2) -> np.ndarray:
    """Lines that crowd towards each of ``ends``."""
    found = set(ends)
    for a, b in zip(ends, ends[1:]):
        half = 0.5 * (b - a)
        steps = half * shrink ** np.arange(levels + 1)
        found |= set(np.round(a + steps, 11)) | set(np.round(b - steps, 11))
    return np.array(sorted(found))


def _mesh(levels: int) -> Any:
    import ngsolve
    from netgen.meshing import Element1D, Element2D, Mesh, MeshPoint, Pnt

    xs, ys, mesh = _lines(X, levels), _lines(Y, levels), Mesh()
    mesh.dim = 2
    at = [[mesh.Add(MeshPoint(Pnt(x, y, 0.0))) for y in ys] for x in xs]
    material = {name: mesh.AddRegion(name, 2) for name in MATERIALS}
    side = {name: mesh.AddRegion(name, 1) for name in SIDES}
    for i in range(len(xs) - 1):
        column = np.searchsorted(X, xs[i : i + 2].mean()) - 1
        mesh.Add(Element1D([at[i][0], at[i + 1][0]], index=side["bottom"]))
        mesh.Add(Element1D([at[i + 1][-1], at[i][-1]], index=side["top"]))
        for j in range(len(ys) - 1):
            name = LAYOUT[np.searchsorted(Y, ys[j : j + 2].mean()) - 1][column]
            mesh.Add(Element2D(material[name], [at[i][j], at[i + 1][j], at[i + 1][j + 1], at[i][j + 1]]))
    for j in range(len(ys) - 1):
        mesh.Add(Element1D([at[-1][j], at[-1][j + 1]], index=side["right"]))
        mesh.Add(Element1D([at[0][j + 1], at[0][j]], index=side["left"]))
    return ngsolve.Mesh(mesh)


def _solved(levels: int, degree: int, points: np.ndarray) -> np.ndarray:
    import ngsolve as n

    mesh = _mesh(levels)
    space = n.H1(mesh, order=degree)
    u, v = space.TnT()
    p, q, f = (n.CF([MATERIALS[name][k] for name in mesh.GetMaterials()]) for k in range(3))
    system, load = n.BilinearForm(space), n.LinearForm(space)
    system += (p * n.grad(u)[0] * n.grad(v)[0] + q * n.grad(u)[1] * n.grad(v)[1]) * n.dx
    load += f * v * n.dx
    for side, (c, g) in SIDES.items():
        system += c * u * v * n.ds(definedon=mesh.Boundaries(side))
        load += g * v * n.ds(definedon=mesh.Boundaries(side))
    solution = n.GridFunction(space)
    with n.TaskManager():
        system.Assemble()
        load.Assemble()
        solution.vec.data = system.mat.Inverse(space.FreeDofs(), inverse="umfpack") * load.vec
    return np.asarray(solution(mesh(points[:, 0], points[:, 1]))).ravel()


def main() -> None:
    points = _points()
    coarser, values = (_solved(levels, 10, points) for levels in (6, 8))
    print(f"{len(points)} points, largest value {np.abs(values).max():.6f}")
    print(f"two meshes apart by {np.abs(values - coarser).max():.1e}")
    DATA.write_text(json.dumps({"points": points.tolist(), "values": np.round(values, 7).tolist()}) + "\n")


if __name__ == "__main__":
    arguments(__doc__)
    main()
