"""High-order finite elements beside method S: NGSolve, curved, inner unknowns condensed, on all cores it is given.

Their best is measured: sources and coefficients are formulas written out (nothing is differentiated while the clock
runs), the mesh is curved to the degree, the matrix symmetric and factorised by NGSolve's own sparse Cholesky, which is
quicker here than the PARDISO and UMFPACK it comes with.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

try:
    import ngsolve
    from netgen.csg import CSGeometry, Pnt, Sphere
    from netgen.geom2d import SplineGeometry
except ImportError:
    ngsolve = None


@dataclass(frozen=True)
class Scene:
    """div(k grad u) = f with values on the boundary.

    mesh : of a largest element size and a degree, the curved mesh, from the shape on; exact, source, conductivity :
    coefficient functions.
    """

    mesh: Callable[[float, int], Any]
    exact: Any
    source: Any
    conductivity: Any = 1.0


def available() -> bool:
    return ngsolve is not None


def threads(n: int) -> None:
    ngsolve.ngsglobals.msg_level = 0
    ngsolve.SetNumThreads(n)


def run(scene: Scene, order: int, size: float) -> tuple[float, float, Any]:
    """Seconds of the mesh, seconds from there to the solution, and the solution."""
    start = time.perf_counter()
    mesh = scene.mesh(size, order)
    meshed = time.perf_counter()
    with ngsolve.TaskManager():
        solution = solved(scene, mesh, order)
    return meshed - start, time.perf_counter() - meshed, solution


def solved(scene: Scene, mesh: Any, order: int) -> Any:
    n = ngsolve
    space = n.H1(mesh, order=order, dirichlet=".*")
    u, v = space.TnT()
    system, load = n.BilinearForm(space, symmetric=True, condense=True), n.LinearForm(space)
    system += scene.conductivity * n.grad(u) * n.grad(v) * n.dx
    load += -scene.source * v * n.dx
    solution = n.GridFunction(space)
    system.Assemble()
    load.Assemble()
    solution.Set(scene.exact, n.BND)
    residual = load.vec.CreateVector()
    residual.data = load.vec - system.mat * solution.vec
    residual.data += system.harmonic_extension_trans * residual
    inverse = system.mat.Inverse(space.FreeDofs(True), inverse="sparsecholesky")
    solution.vec.data += inverse * residual
    solution.vec.data += system.harmonic_extension * solution.vec
    solution.vec.data += system.inner_solve * residual
    return solution


def error(scene: Scene, solution: Any, order: int) -> float:
    """The relative L2 error over the domain."""
    mesh = solution.space.mesh
    with ngsolve.TaskManager():
        off, size = (ngsolve.Integrate(f**2, mesh, order=2 * order + 6) for f in (solution - scene.exact, scene.exact))
    return math.sqrt(off / size)


def scenes() -> dict[str, Scene]:
    """The scenes of benchmarks.from_shape, by name."""
    n = ngsolve
    x, y, z = n.x, n.y, n.z
    smooth = n.exp(x) * n.sin(2 * y) + x**3 * y
    bent = -3 * n.exp(x) * n.sin(2 * y) + 6 * x * y  # its Laplacian
    slope = n.exp(x) * n.sin(2 * y) + 3 * x**2 * y, 2 * n.exp(x) * n.cos(2 * y) + x**3
    k, falls = 1.5 + n.sin(2 * x + y), n.cos(2 * x + y)
    waves = n.sin(30 * x + 0.3) * n.cos(24 * y)
    solid = n.exp(x) * n.sin(2 * y) * n.cos(z)
    held = n.exp(x / 2) * n.sin(2 * y) + x * y
    return {
        "disk": Scene(_disk, smooth, bent),
        "amoeba": Scene(_amoeba, smooth, bent),
        "waves": Scene(_disk, waves, -1476 * waves),
        "ball": Scene(_ball, solid, -4 * solid),
        "plate": Scene(_plate, held, -3.75 * n.exp(x / 2) * n.sin(2 * y)),
        "conductor": Scene(_amoeba, smooth, k * bent + falls * (2 * slope[0] + slope[1]), k),
    }


# ------------------------------------------------------------------ meshes

def _disk(size: float, order: int) -> Any:
    shape = SplineGeometry()
    shape.AddCircle((0, 0), 1)
    return _curved(shape, size, order)


def _plate(size: float, order: int) -> Any:
    shape = SplineGeometry()
    shape.AddRectangle((0, 0), (3, 2))
    for centre, radius in (((0.9, 1.2), 0.35), ((2.1, 0.7), 0.45)):
        shape.AddCircle(centre, radius, leftdomain=0, rightdomain=1)
    return _curved(shape, size, order)


def _curved(shape: Any, size: float, order: int) -> Any:
    with ngsolve.TaskManager():
        mesh = ngsolve.Mesh(shape.GenerateMesh(maxh=size))
        mesh.Curve(order)
    return mesh


def _amoeba(size: float, order: int) -> Any:
    """A polygon with corners on the curve, then its sides moved to the curve: of a curve given by a function Netgen
    keeps five digits, and crashes now and then."""
    sides = max(12, math.ceil(7.6 / size))
    turns = [2 * math.pi * k / sides for k in range(sides)]
    shape = SplineGeometry()
    corners = []
    for t in turns:
        r = 1 + 0.2 * math.cos(5 * t)
        corners.append(shape.AppendPoint(r * math.cos(t), r * math.sin(t)))
    for a, b in zip(corners, corners[1:] + corners[:1]):
        shape.Append(["line", a, b])
    with ngsolve.TaskManager():
        mesh = ngsolve.Mesh(shape.GenerateMesh(maxh=size))
        x, y = ngsolve.x, ngsolve.y
        radius = ngsolve.sqrt(x * x + y * y)
        out = (1 + 0.2 * (x**5 - 10 * x**3 * y**2 + 5 * x * y**4) / radius**5) / radius - 1
        moved = ngsolve.GridFunction(ngsolve.VectorH1(mesh, order=order))
        moved.Set(ngsolve.CF((out * x, out * y)), definedon=mesh.Boundaries(".*"))
        mesh.SetDeformation(moved)
    return mesh


def _ball(size: float, order: int) -> Any:
    shape = CSGeometry()
    shape.Add(Sphere(Pnt(0, 0, 0), 1))
    return _curved(shape, size, order)


def unknowns(solution: Any) -> int:
    return int(np.asarray(solution.vec).size)
