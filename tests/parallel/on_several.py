"""What several processes find, against one: run under mpiexec by test_parallel, which reads what is printed last."""

import importlib.util
import json
import sys
import tempfile

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from mpi4py import MPI  # noqa: E402
from petsc4py import PETSc  # noqa: E402
from scipy import sparse  # noqa: E402

import jsmitsm as js  # noqa: E402
import jsmitsm.parallel as jp  # noqa: E402
from jsmitsm.cloud import contour, filling, levelset  # noqa: E402
from jsmitsm.cloud.packing.lattice import lattice_part  # noqa: E402
from jsmitsm.discretization.leave_one_out import matrix  # noqa: E402

COMM = MPI.COMM_WORLD
# Of low order, whose programs compile quickly: what several processes share does not hang on it.
CHEAP = {"order": 2, "depth": 0}
SIDES = ("left", "right", "bottom", "top")


def exact(x):
    return jnp.sin(2.0 * x[0]) * jnp.exp(x[1])


def mixed():
    """Dirichlet, Neumann and Robin sides, jitter, and one particle held inside."""
    sides = {
        "left": js.dirichlet(exact), "bottom": js.dirichlet(exact),
        "right": js.neumann(lambda x: 2.0 * jnp.cos(2.0 * x[0]) * jnp.exp(x[1])),
        "top": js.robin(1.0, 1.0, lambda x: 2.0 * exact(x)), "pin": js.fix([210], exact),
    }  # fmt: skip
    pde = lambda u, x: (1 + x[0]) * js.laplacian(u)(x) + 3.0 * (1 + x[0]) * exact(x)  # noqa: E731
    return js.Problem(pde, sides), js.rectangle((0, 0), (1, 1), (20, 20), jitter=0.3)


def graded():
    """Sixteen times denser in a corner, and jittered until stencils are weak; a side given by an array."""
    square = js.rectangle((0, 0), (1, 1), (20, 20), jitter=0.45, seed=3)
    points = np.asarray(square.points) ** 1.7
    cloud = js.Cloud(points, square.groups, square.normals)
    sides = {name: js.dirichlet(exact) for name in SIDES[1:]}
    sides["left"] = js.dirichlet(np.asarray(jax.vmap(exact)(points[cloud.groups["left"]])))
    return js.Problem(lambda u, x: js.laplacian(u)(x) + 3.0 * exact(x), sides), cloud


def system():
    """Two fields, coupled."""
    def pde(u, x):
        return jnp.array([js.laplacian(u[0])(x) + u[1](x), js.laplacian(u[1])(x) - js.partial(u[0], (1, 0))(x) + 1.0])

    sides = {name: js.dirichlet(0.0) for name in SIDES[:3]}
    sides["top"] = [js.dirichlet(1.0, field=0), js.neumann(0.5, field=1)]
    return js.Problem(pde, sides, fields=2), js.rectangle((0, 0), (1, 1), (14, 14), jitter=0.2)


def quasilinear():
    """A conductivity that depends on u, and a side that radiates."""
    sides = {name: js.dirichlet(lambda x: x[0] * x[1]) for name in SIDES[:3]}
    sides["top"] = js.condition(lambda u, x, n: n @ js.grad(u)(x) + u(x) ** 3 - 1.0)
    pde = lambda u, x: js.divergence(lambda y: (1 + u(y) ** 2) * js.grad(u)(y))(x) + 1.0 + x[0]  # noqa: E731
    return js.Problem(pde, sides), js.rectangle((0, 0), (1, 1), (14, 14), jitter=0.2)


def heated(source, level):
    sides = {name: js.dirichlet(lambda x: level * x[0]) for name in SIDES[:3]}
    sides["top"] = js.robin(1.0, 1.0, level)
    return js.Problem(lambda u, x: (1 + x[0]) * js.laplacian(u)(x) + source * jnp.sin(x[1]), sides)


def warming():
    """Heat with data that depend on time, and a start that contradicts them."""
    sides = {name: js.dirichlet(lambda x, t: t * x[0]) for name in SIDES[:3]}
    sides["top"] = js.robin(1.0, 1.0, lambda x, t: t)
    return js.Problem(lambda u, x, t: js.dt(u)(x) - (1 + x[0]) * js.laplacian(u)(x) - x[1] * jnp.sin(t), sides)


def of_rows(sol, one):
    """The largest difference of any entry of the two matrices, rows and columns by the particles' numbers."""
    first, last, entries = sol.system.matrix.getValuesCSR()
    halo, held = sol._local.halo, sol._local.disc.held[:, 0]
    mine = halo.slab.number[halo.own & ~held]
    every = np.concatenate(COMM.allgather(mine))
    n = len(one.u)
    here = sparse.csr_array((entries, (np.repeat(mine, np.diff(first)), every[last])), shape=(n, n))
    run = one._report
    data, r, c = matrix(run.disc, *run.rows)
    free = np.flatnonzero(~run.disc.held[:, 0])
    there = sparse.csr_array((np.asarray(data), (free[r], free[c])), shape=(n, n))
    return float(abs((here - there)[mine]).max())


def off(sol, one):
    return jp.norm(sol.u - np.asarray(one.u)[sol.numbers])


def refused(call):
    try:
        call()
    except (ValueError, js.SolveError) as error:
        return f"{type(error).__name__}: {error}"
    return "nothing was refused"


def main():
    found = {}
    problem, cloud = mixed()
    one = js.solve(problem, cloud, **CHEAP)
    # PETSc comes with hypre or without.
    hypre = ("hypre",) if PETSc.Sys.hasExternalPackage("hypre") else ()
    for solver in (*hypre, "gamg", "mumps"):
        sol = jp.solve(problem, cloud, solver=solver, **CHEAP)
        found[f"values {solver}"] = off(sol, one)
        found[f"iterations {solver}"] = sol.stats["linear"]["iterations"]
    found["rows"] = jp.norm(of_rows(sol, one))
    places = np.random.default_rng(COMM.rank).uniform(0.0, 1.0, (5 + COMM.rank, 2))
    found["anywhere"] = jp.norm(jp.evaluate(sol, places) - np.asarray(one(places)))
    slope = np.asarray(one.derivative(places, (0, 1)))
    found["slopes"] = jp.norm(jp.evaluate(sol, places, (0, 1)) - slope)
    error = jp.error_estimate(sol)
    found["estimate"] = jp.norm(error - np.asarray(one.error_estimate())[sol.numbers]) / jp.norm(error)
    found["own"] = COMM.allgather(len(sol.numbers))
    folder = COMM.bcast(tempfile.mkdtemp(), root=0)
    if COMM.rank == 0:
        group = np.zeros(len(cloud), int)
        for k, name in enumerate(cloud.groups):
            group[cloud.groups[name]] = k
        np.save(f"{folder}/x.npy", cloud.points)
        np.save(f"{folder}/g.npy", group)
        np.save(f"{folder}/n.npy", cloud.normals)
    COMM.Barrier()
    names = {name: k for k, name in enumerate(cloud.groups)}
    slabs = jp.read(f"{folder}/x.npy", f"{folder}/g.npy", f"{folder}/n.npy", names=names)
    found["read"] = off(jp.solve(problem, slabs, **CHEAP), one)
    jp.save(sol, f"{folder}/u.pvtu", error=error)
    found["folder"] = folder

    problem, cloud = graded()
    one, sol = js.solve(problem, cloud, **CHEAP), jp.solve(problem, cloud, **CHEAP)
    found["graded"], found["graded rows"] = off(sol, one), jp.norm(of_rows(sol, one))
    found["repaired"] = [sol.stats["repaired"].tolist(), np.sort(one.stats["repaired"]).tolist()]
    kernel = js.SuperGaussian(h=0.8 * np.asarray(js.stencils(cloud, size=14).radius), d=1.5)
    options = {"kernel": kernel, **CHEAP}
    found["kernel"] = off(jp.solve(problem, cloud, **options), js.solve(problem, cloud, **options))
    options = {"method": "III", **CHEAP}
    problem, cloud = mixed()
    found["III"] = off(jp.solve(problem, cloud, **options), js.solve(problem, cloud, **options))

    problem, cloud = system()
    sol = jp.solve(problem, cloud, **CHEAP)
    found["system"], found["gathered"] = off(sol, js.solve(problem, cloud, **CHEAP)), np.shape(sol.gathered())

    cube = js.box((0, 0, 0), (1, 1, 1), (8, 8, 8), jitter=0.2)
    sides = {name: js.dirichlet(0.0) for name in cube.groups if name != "interior"}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) + x[2], sides)
    found["cube"] = off(jp.solve(problem, cube, **CHEAP), js.solve(problem, cube, **CHEAP))

    cloud = js.rectangle((0, 0), (1, 1), (12, 12), jitter=0.2)  # on a lattice the farthest of a stencil changes
    held = {name: js.dirichlet(lambda x, k: k["rim"] * x[0]) for name in SIDES}
    pde = lambda u, x, k: k["d"] * js.laplacian(u)(x) - x[0] * u(x) + 1.0  # noqa: E731
    problem = js.Problem(pde, held, params={"d": jnp.array(0.7), "rim": jnp.array(0.4)})
    value, slope = jp.value_and_grad(lambda u, x, k: (u**2).sum(), problem, cloud, **CHEAP)
    alone = lambda p: (js.solve(problem.replace(params=p), cloud, **CHEAP).u ** 2).sum()  # noqa: E731
    value_one, slope_one = jax.value_and_grad(alone)(problem.params)
    found["value"] = abs(value - float(value_one))
    found["gradient"] = max(abs(float(slope[k] - slope_one[k])) for k in slope)
    _, moved = jp.value_and_grad(lambda u, x, k: (u**2).sum(), problem, cloud, wrt="points", **CHEAP)
    found["by points"] = _differences(problem, cloud, moved)

    _more(found)
    none = {name: js.neumann(0.0) for name in SIDES}
    lap = lambda u, x: js.laplacian(u)(x)  # noqa: E731
    zero = {name: js.dirichlet(0.0) for name in SIDES}
    pair = {**{name: zero[name] for name in SIDES[2:]}, "left": js.periodic("left", "right")}
    found["refused"] = {
        "floating": refused(lambda: jp.solve(js.Problem(lap, none), cloud)),
        "nonlinear": refused(lambda: jp.factorize(js.Problem(lambda u, x: lap(u, x) - u(x) ** 2, zero), cloud)),
        "in time": refused(lambda: jp.evolve(
            js.Problem(lambda u, x, t: js.dt(u)(x) - lap(u, x) + u(x) ** 3, zero), cloud, 0.0, (0.0, 1.0), steps=2)),
        "lattice": refused(lambda: jp.cloud_from(js.rectangle, (0, 0), (1, 1), (9, 9))),
        "II": refused(lambda: jp.solve(js.Problem(lap, zero), cloud, method="II")),
        "periodic": refused(lambda: jp.solve(js.Problem(lap, pair), cloud)),
        "first order": refused(lambda: jp.solve(
            js.Problem(lambda u, x: js.partial(u, (1, 0))(x), {**zero, "right": js.free()}), cloud)),
        "one process": refused(lambda: jp.solve(js.Problem(lap, zero), cloud if COMM.rank else None)),
        "mass": refused(lambda: jp.eigen(
            js.Problem(lambda u, x: jnp.stack([u(x)[1] - lap(u[0], x), lap(u[0], x)]), zero, fields=2), cloud, 1,
            mass=(0.0, 1.0), order=4)),
        "array": refused(lambda: jp.solve(js.Problem(lap, {**zero, "top": js.dirichlet(np.zeros(3))}), cloud)),
    }  # fmt: skip
    if COMM.rank == 0:
        print(json.dumps(found))
    sys.stdout.flush()


def _more(found):
    """Newton's method, factors, heat, modes, and shapes filled in parts."""
    problem, cloud = quasilinear()
    one, sol = js.solve(problem, cloud, **CHEAP), jp.solve(problem, cloud, **CHEAP)
    found["newton"], found["steps"] = off(sol, one), [sol.iterations, one.iterations]
    places = np.array([[0.3, 0.4], [0.51, 0.77]])
    found["newton anywhere"] = jp.norm(jp.evaluate(sol, places) - np.asarray(one(places)))
    ready, alone = jp.factorize(heated(0.0, 0.0), cloud, **CHEAP), js.factorize(heated(0.0, 0.0), cloud, **CHEAP)
    found["factorize"] = off(ready.solve(heated(2.0, 0.3)), alone.solve(heated(2.0, 0.3)))
    found["kept"] = ready.solve(heated(1.0, 0.0)).system is ready.system
    options = {"steps": 3, "order": 4, "save": 2}
    one = js.evolve(warming(), cloud, lambda x: 1.0 + x[0], (0.0, 0.5), **options, progress=False)
    run = jp.evolve(warming(), cloud, lambda x: 1.0 + x[0], (0.0, 0.5), **options)
    found["heat"], found["times"] = jp.norm(run.u - np.asarray(one.u)[:, run.numbers]), run.t.tolist()
    if importlib.util.find_spec("slepc4py"):
        sides = {**{name: js.dirichlet(0.0) for name in SIDES[:3]}, "top": js.neumann(0.0)}
        drum, mass = js.Problem(lambda u, x: -js.laplacian(u)(x) + x[0] * u(x), sides), lambda x: 1 + x[1]
        one, several = (of.eigen(drum, cloud, 3, order=4, mass=mass) for of in (js, jp))
        found["values of modes"] = float(np.abs(several.values / np.asarray(one.values) - 1.0).max())
        found["modes"] = jp.norm(several.u - np.asarray(one.u)[several.numbers])
    shape = js.sdf.difference(js.sdf.rectangle((0, 0), (1, 1.5)), js.sdf.circle((0.5, 0.5), 0.2))
    slab = jp.cloud_from(js.from_sdf, shape, ((0, 0), (1, 1.5)), 0.05)
    inside = COMM.gather(slab.points[slab.slab.group == 0])
    if COMM.rank == 0:
        mine, whole = (x[np.lexsort(x.T)] for x in (np.concatenate(inside), filled_by_one(shape)))
        found["filled"] = float(np.abs(mine - whole).max()) if len(mine) == len(whole) else -1.0
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) + 3.0 * exact(x), {"boundary": js.dirichlet(exact)})
    sol = jp.solve(problem, slab, **CHEAP)
    found["on a shape"] = jp.norm(sol.u - np.asarray(jax.vmap(exact)(sol.points)))


def filled_by_one(shape):
    """The interior of the shape in ``_more`` as one process fills it."""
    lo, hi = np.array([0.0, 0.0]), np.array([1.0, 1.5])
    region = levelset.SdfRegion(shape, lo, hi)
    boundary = levelset.checked(region, contour.contour(region, filling.spacing_function(0.05))).points
    return lattice_part(region, 0.05, lo, hi, boundary, 0, 1, np.array([-np.inf, np.inf]))


def _differences(problem, cloud, moved):
    """By how much the gradient by two particles' places misses central differences of one process."""
    whole = np.zeros(np.shape(cloud.points))
    parts = COMM.allgather(moved)
    own = COMM.allgather(jp.solve(problem, cloud, **CHEAP).numbers)
    for ids, part in zip(own, parts):
        whole[ids] = part
    worst = 0.0
    points, step = np.array(cloud.points), 1e-5
    one = js.solve(problem, cloud, **CHEAP)
    near = js.stencils(cloud, size=9).__class__(one._fit.neighbours, None)
    for at, axis in ((66, 0), (78, 1)):
        sides = []
        for sign in (1.0, -1.0):
            there = points.copy()
            there[at, axis] += sign * step
            one = js.solve(problem, cloud.replace(points=there), **CHEAP, stencils=near)
            sides.append(float((np.asarray(one.u) ** 2).sum()))
        worst = max(worst, abs((sides[0] - sides[1]) / (2.0 * step) - whole[at, axis]))
    return worst


if __name__ == "__main__":
    main()
