"""Several regions beside finite elements on a fitted mesh: error against unknowns, ``python -m benchmarks.regions``.

A disk of radius 0.5 and conductivity k in a plate, u = x + (1 - k) / (1 + k) R^2 x / r^2 outside, and a wall of two
layers whose conductivities are a million apart. The elements are isoparametric triangles of degree 2 (scikit-fem), on a
triangulation of the same particles, the middles of edges on the circle moved onto it: the usual fitted mesh; and of
degree 4 (NGSolve), on a mesh of its own of that spacing, curved to the circle by polynomials of degree 4.
Errors are relative, in the Euclidean norm over the particles. Times are of the second of two solves, programs compiled.
"""

import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks.commandline import arguments
from benchmarks.machine import describe
from jsmitsm.cloud.triangulation import simplices

jax.config.update("jax_enable_x64", True)
DATA = Path(__file__).parent / "data" / "regions.json"
BOX, RADIUS = ((-1.0, -1.0), (1.0, 1.0)), 0.5
SPACINGS, ORDERS = (0.16, 0.08, 0.05), (4, 8)


def exact(k):
    """The temperature in both regions."""
    return {
        "in": lambda x: 2.0 / (1.0 + k) * x[0],
        "out": lambda x: x[0] + (1.0 - k) / (1.0 + k) * RADIUS**2 * x[0] / (x @ x),
    }


def disk(spacing):
    shape = js.sdf.circle((0.0, 0.0), RADIUS)
    return js.regions({"in": shape, "out": js.sdf.difference(js.sdf.rectangle(*BOX), shape)}, BOX, spacing)


def truth(cloud, functions):
    out = np.zeros(len(cloud))
    for name, ids in cloud.regions.items():
        out[ids] = jax.vmap(functions[name])(cloud.points[ids])
    return out


def flux(k):
    return {name: lambda u, x, n, c=c: c * n @ js.grad(u)(x) for name, c in k.items()}


def error(values, right):
    return float(np.linalg.norm(values - right) / np.linalg.norm(right))


def timed(solve):
    solve()
    start = time.perf_counter()
    made = solve()
    return made, time.perf_counter() - start


def ours(cloud, k, order):
    functions = exact(k)
    bcs = {"boundary": js.dirichlet(functions["out"]), "in|out": js.interface(flux({"in": k, "out": 1.0}))}
    problem = js.Problem(dict.fromkeys(functions, lambda u, x: js.laplacian(u)(x)), bcs)
    sol, seconds = timed(lambda: js.solve(problem, cloud, order=order))
    return {"unknowns": sol.stats["unknowns"], "depth": sol.stats["depth"],
            "error": error(sol.u, truth(cloud, functions)), "seconds": seconds,
            "lebesgue": sol.stats["lebesgue_interfaces"]}  # fmt: skip


def elements(cloud, k):
    """Isoparametric triangles of degree 2 on the triangulation of the particles."""
    import skfem
    from skfem.helpers import dot, grad

    functions, points = exact(k), np.asarray(cloud.points)
    unique, place = np.unique(np.round(points, 12), axis=0, return_inverse=True)
    inside = np.zeros(len(points), bool)
    inside[cloud.regions["in"]] = True
    cells = simplices(cloud)
    flat = skfem.MeshTri(unique.T, place.reshape(-1)[cells].T)
    mesh = skfem.MeshTri2.from_mesh(flat)
    on = np.abs(np.linalg.norm(unique, axis=1) - RADIUS) < 1e-9
    edges = np.flatnonzero(on[flat.facets].all(axis=0))
    where = mesh.doflocs.copy()
    middle = unique[flat.facets[:, edges]].mean(axis=0)
    from scipy.spatial import cKDTree

    found = cKDTree(where.T).query(middle)[1]
    where[:, found] = (middle / np.linalg.norm(middle, axis=1, keepdims=True) * RADIUS).T
    mesh = skfem.MeshTri2(where, mesh.t)
    conductivity = np.where(inside[cells].all(axis=1), k, 1.0)

    def solve():
        basis = skfem.Basis(mesh, skfem.ElementTriP2())
        weight = np.broadcast_to(conductivity[:, None], basis.dx.shape)
        matrix = skfem.BilinearForm(lambda u, v, w: w.k * dot(grad(u), grad(v))).assemble(basis, k=weight)
        held = basis.get_dofs().all()
        u = np.zeros(matrix.shape[0])
        u[held] = jax.vmap(functions["out"])(basis.doflocs[:, held].T)
        return skfem.solve(*skfem.condense(matrix, x=u, D=held)), len(u) - len(held)

    (u, unknowns), seconds = timed(solve)
    basis = skfem.Basis(mesh, skfem.ElementTriP2())
    vertices = u[basis.nodal_dofs[0]]
    right = np.where(
        np.linalg.norm(unique, axis=1) < RADIUS, jax.vmap(functions["in"])(unique), jax.vmap(functions["out"])(unique)
    )
    return {"unknowns": unknowns, "error": error(vertices, right), "seconds": seconds}


def curved_elements(spacing, k, degree=4):
    """Isoparametric triangles of a higher degree."""
    import ngsolve as ng
    from netgen.geom2d import SplineGeometry

    shape = SplineGeometry()
    shape.AddRectangle(*BOX, bc="outer", leftdomain=1, rightdomain=0)
    shape.AddCircle((0.0, 0.0), RADIUS, leftdomain=2, rightdomain=1)
    shape.SetMaterial(1, "out")
    shape.SetMaterial(2, "in")
    mesh = ng.Mesh(shape.GenerateMesh(maxh=spacing))
    mesh.Curve(degree)
    square = ng.x**2 + ng.y**2
    outside = ng.x + (1.0 - k) / (1.0 + k) * RADIUS**2 * ng.x / square

    def solve():
        space = ng.H1(mesh, order=degree, dirichlet="outer")
        u, v = space.TnT()
        conductivity = mesh.MaterialCF({"in": k, "out": 1.0})
        matrix = ng.BilinearForm(conductivity * ng.grad(u) * ng.grad(v) * ng.dx).Assemble().mat
        found = ng.GridFunction(space)
        found.Set(outside, ng.BND)
        rest = (-matrix * found.vec).Evaluate()
        found.vec.data += matrix.Inverse(space.FreeDofs(), "sparsecholesky") * rest
        return found, sum(space.FreeDofs())

    (u, unknowns), seconds = timed(solve)
    at = np.array([v.point for v in mesh.vertices])
    radius = np.linalg.norm(at, axis=1)
    functions = exact(k)
    right = np.where(radius < RADIUS, jax.vmap(functions["in"])(at), jax.vmap(functions["out"])(at + 1e-300))
    values = np.array([u(mesh(*p)) for p in at])
    return {"unknowns": unknowns, "error": error(values, right), "seconds": seconds}


def wall(spacing, order, ratio=1e6):
    """Two layers; what conducts better varies as the inverse of the ratio."""
    corners = {"a": [(0, 0), (0.5, 0), (0.5, 1), (0, 1)], "b": [(0.5, 0), (1, 0), (1, 1), (0.5, 1)]}
    cloud = js.regions(corners, spacing=spacing)
    k = {"a": 1.0, "b": ratio}
    shape = lambda x: jnp.exp(x[1]) * jnp.sin(x[0] - 0.5) + (x[0] - 0.5) ** 2 * x[1]  # noqa: E731
    functions = {n: lambda x, c=c: shape(x) / c + jnp.cos(x[1]) for n, c in k.items()}
    values = truth(cloud, functions)
    pde = {n: lambda u, x, c=c, n=n: c * (js.laplacian(u)(x) - js.laplacian(functions[n])(x)) for n, c in k.items()}
    source = lambda x: k["a"] * jax.grad(functions["a"])(x)[0] - k["b"] * jax.grad(functions["b"])(x)[0]  # noqa: E731
    bcs = {"boundary": js.dirichlet(values[cloud.groups["boundary"]]), "a|b": js.interface(flux(k), source=source)}
    sol = js.solve(js.Problem(pde, bcs), cloud, order=order)
    return {"unknowns": sol.stats["unknowns"], "depth": sol.stats["depth"], "error": error(sol.u, values)}


def main():
    rows = []
    for spacing in SPACINGS:
        cloud = disk(spacing)
        for k in (10.0, 1e6, 1e-3):
            for order in ORDERS:
                row = {"case": "disk", "k": k, "spacing": spacing, "order": order, **ours(cloud, k, order)}
                rows.append(row)
                print(row, flush=True)
        for factor in (1, 2):
            if any(r["case"] == "elements" and r["spacing"] == spacing / factor for r in rows):
                continue
            fine = cloud if factor == 1 else disk(spacing / factor)
            for degree, made in ((2, elements(fine, 10.0)), (4, curved_elements(spacing / factor, 10.0))):
                rows.append({"case": "elements", "k": 10.0, "spacing": spacing / factor, "order": degree, **made})
                print(rows[-1], flush=True)
    for spacing in (1 / 8, 1 / 16):
        for order in (2, 4, 6, 8):
            rows.append({"case": "wall", "k": 1e6, "spacing": spacing, "order": order, **wall(spacing, order)})
            print(rows[-1], flush=True)
    DATA.write_text(json.dumps({"machine": describe(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    arguments(__doc__)
    main()
