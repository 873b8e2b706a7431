"""What several processes find, against one: run under mpiexec by test_parallel, which reads what is printed last."""

import importlib.util
import json
import sys
import tempfile
from pathlib import Path

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
from jsmitsm.modes.estimate import errors  # noqa: E402

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
    cloud = js.rectangle((0, 0), (1, 1), (20, 20), jitter=0.3)
    return js.Problem(lambda u, x: js.laplacian(u)(x) + 3.0 * exact(x), sides), cloud


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
    return js.Problem(pde, sides, fields=2), small()


def quasilinear():
    """A conductivity that depends on u, and a side that radiates."""
    sides = {name: js.dirichlet(lambda x, k: x[0] * x[1]) for name in SIDES[:3]}
    sides["top"] = js.condition(lambda u, x, n, k: n @ js.grad(u)(x) + k * u(x) ** 3 - 1.0)
    pde = lambda u, x, k: js.divergence(lambda y: (1 + k * u(y) ** 2) * js.grad(u)(y))(x) + 1.0 + x[0]  # noqa: E731
    return js.Problem(pde, sides, params=jnp.array(1.0)), small()


def heated(source, level):
    sides = {name: js.dirichlet(lambda x: level * x[0]) for name in SIDES[:3]}
    sides["top"] = js.robin(1.0, 1.0, level)
    return js.Problem(lambda u, x: (1 + x[0]) * js.laplacian(u)(x) + source * jnp.sin(x[1]), sides)


def shape():
    return js.sdf.difference(js.sdf.rectangle((0, 0), (1, 1.5)), js.sdf.circle((0.5, 0.5), 0.2))


def filled_by_one():
    """The interior of the shape as one process fills it."""
    lo, hi = np.array([0.0, 0.0]), np.array([1.0, 1.5])
    region = levelset.SdfRegion(shape(), lo, hi)
    boundary = levelset.checked(region, contour.contour(region, filling.spacing_function(0.05))).points
    return lattice_part(region, 0.05, lo, hi, boundary, 0, 1, np.array([-np.inf, np.inf]))


def of_params():
    """A number of a problem with parameters, on a jittered square: on a lattice the farthest of a stencil changes."""
    held = {name: js.dirichlet(lambda x, k: k["rim"] * x[0]) for name in SIDES}
    pde = lambda u, x, k: k["d"] * js.laplacian(u)(x) - x[0] * u(x) + 1.0  # noqa: E731
    problem = js.Problem(pde, held, params={"d": jnp.array(0.7), "rim": jnp.array(0.4)})
    return problem, js.rectangle((0, 0), (1, 1), (12, 12), jitter=0.2)


def plain():
    return js.Problem(lambda u, x: js.laplacian(u)(x) + jnp.exp(x[0]), {name: js.dirichlet(exact) for name in SIDES})


def narrow():
    """A source between the particles, of which flags tell; of the form of ``plain``, whose programs serve."""
    peak = lambda x: jnp.exp(-((x[0] - 0.5) ** 2 + (x[1] - 0.47) ** 2) / 1e-3)  # noqa: E731
    held = {name: js.dirichlet(lambda x: 0.0 * x[0]) for name in SIDES}
    return js.Problem(lambda u, x: js.laplacian(u)(x) + peak(x), held)


def axis():
    """On the axis x = 0 the highest derivatives have no weight, and the condition says nothing new."""
    held = {**{name: js.dirichlet(exact) for name in SIDES}, "left": js.neumann(0.0)}
    cloud = js.rectangle((0, 0), (1, 1), (20, 20), jitter=0.2)  # of which two particles on the axis are repaired
    return js.Problem(lambda u, x: x[0] * js.laplacian(u)(x) + js.partial(u, (1, 0))(x) + x[0], held), cloud


def reaction():
    """Terms of two orders: one process shares eliminations at a few lengths, of several each has too few particles."""
    cloud = js.rectangle((0, 0), (1, 1), (14, 14), jitter=0.2)
    return js.Problem(lambda u, x: js.laplacian(u)(x) - 400.0 * u(x), dict.fromkeys(SIDES, js.dirichlet(1.0))), cloud


def small():
    return js.rectangle((0, 0), (1, 1), (12, 12), jitter=0.2)


def reacting():
    """Two fields in time, by Newton's method in every stage, from a start that contradicts the conditions.

    A diffusion that grows with the field, so that the pencil is made anew on the way; transport by the other one.
    """
    def pde(u, x, t):
        a, b = u[0], u[1]
        flux = lambda y: (1.0 + a(y)) * js.grad(a)(y)  # noqa: E731
        return jnp.array([js.dt(a)(x) - js.divergence(flux)(x) + b(x) * js.partial(a, (1, 0))(x) - t,
                          js.dt(b)(x) - 0.5 * js.laplacian(b)(x) + a(x) * b(x) ** 2])  # fmt: skip

    sides = {name: js.dirichlet(0.0) for name in SIDES[:3]}
    sides["top"] = [js.dirichlet(lambda x, t: t, field=0), js.neumann(0.5, field=1)]
    return js.Problem(pde, sides, fields=2), {"steps": 2, "save": 2, "order": 2}


END = 0.02


def ramps(x):
    return jnp.array([x[0] * x[1], 1.0])


def drum():
    sides = {**{name: js.dirichlet(0.0) for name in SIDES[:3]}, "top": js.neumann(0.0)}
    return js.Problem(lambda u, x: -js.laplacian(u)(x) + x[0] * u(x), sides), {"order": 2, "mass": lambda x: 1 + x[1]}


def weighted_kernel(cloud):
    return {"kernel": js.SuperGaussian(h=0.8 * np.asarray(js.stencils(cloud, size=14).radius), d=1.5), **CHEAP}


PLACES = np.array([[0.31, 0.42], [0.505, 0.773], [0.9, 0.08], [0.12, 0.95], [0.66, 0.3]])


# -- what one process finds: each by one of them, and once for all numbers of processes


def _rows(one):
    run = one._report
    data, r, c = matrix(run.disc, *run.rows)
    free = np.flatnonzero(~run.disc.held[:, 0])
    return {"data": np.asarray(data), "r": free[r], "c": free[c]}


def _mixed():
    one = js.solve(*mixed(), **CHEAP)
    return {"u": one.u, "at": one(PLACES), "slope": one.derivative(PLACES, (0, 1)), **_rows(one)}


def _plain():
    one = js.solve(plain(), small(), **CHEAP)
    return {"u": one.u, "error": one.error_estimate(), "flags": np.array(one.flags, str)}


def _narrow():
    one = js.solve(narrow(), small(), **CHEAP)
    return {"u": one.u, "flags": np.array(one.flags, str)}


def _graded():
    one = js.solve(*graded(), **CHEAP)
    return {"u": one.u, "repaired": np.sort(one.stats["repaired"]), **_rows(one)}


def _quasilinear():
    problem, cloud = quasilinear()
    one = js.solve(problem, cloud, **CHEAP)
    at = lambda k: float((js.solve(problem.replace(params=jnp.array(k)), cloud, **CHEAP).u ** 2).sum())  # noqa: E731
    slope = (8.0 * (at(1.0 + STEP) - at(1.0 - STEP)) - at(1.0 + 2 * STEP) + at(1.0 - 2 * STEP)) / (12.0 * STEP)
    return {"u": one.u, "steps": one.iterations, "slope": slope}


def _of_params():
    """Differences of fourth order by params, and central ones by two particles' places, at the neighbours they have."""
    problem, cloud = of_params()

    def total(name, step):
        params = problem.params | {name: problem.params[name] + step}
        return float((js.solve(problem.replace(params=params), cloud, **CHEAP).u ** 2).sum())

    def slope(name, h=STEP):
        return (8.0 * (total(name, h) - total(name, -h)) - total(name, 2 * h) + total(name, -2 * h)) / (12.0 * h)

    near = js.stencils(cloud, size=9).__class__(js.solve(problem, cloud, **CHEAP)._fit.neighbours, None)
    points, step, moved = np.array(cloud.points), 1e-5, []
    for at, axis in MOVED:
        sides = []
        for sign in (1.0, -1.0):
            there = points.copy()
            there[at, axis] += sign * step
            sides.append(float((js.solve(problem, cloud.replace(points=there), **CHEAP, stencils=near).u ** 2).sum()))
        moved.append((sides[0] - sides[1]) / (2.0 * step))
    return {"value": total("d", 0.0), "d": slope("d"), "rim": slope("rim"), "moved": moved}


def _in_time(problem, start, end, **options):
    one = js.evolve(problem, small(), start, (0.0, end), **options, progress=False)
    return {"u": one.u, "pencils": one.stats["pencils"], "flags": np.array(one.flags, str)}


def _drum():
    problem, options = drum()
    one = js.eigen(problem, small(), 3, **options)
    # What two orders tell, as the processes do.
    return {"values": one.values, "u": one.u, "errors": errors(one._question, one._found)}


MOVED = ((66, 0), (78, 1))
STEP = 5e-4  # of differences
ALONE = {
    "mixed": _mixed, "plain": _plain, "narrow": _narrow, "graded": _graded, "quasilinear": _quasilinear,
    "params": _of_params,
    "system": lambda: {"u": js.solve(*system(), **CHEAP).u}, "cube": lambda: {"u": js.solve(*cube(), **CHEAP).u},
    "III": lambda: {"u": js.solve(*mixed(), method="III", **CHEAP).u},
    "kernel": lambda: {"u": js.solve(*graded(), **weighted_kernel(graded()[1])).u},
    "factorize": lambda: {"u": js.factorize(heated(0.0, 0.0), small(), **CHEAP).solve(heated(2.0, 0.3)).u},
    "reacting": lambda: _in_time(reacting()[0], ramps, END, **reacting()[1]),
    "drum": _drum, "axis": lambda: {"u": js.solve(*axis(), order=4, depth=2).u},
    "reaction": lambda: {"u": js.solve(*reaction(), order=4, depth=4).u},
}  # fmt: skip


def cube():
    cloud = js.box((0, 0, 0), (1, 1, 1), (8, 8, 8), jitter=0.2)
    sides = {name: js.dirichlet(0.0) for name in cloud.groups if name != "interior"}
    return js.Problem(lambda u, x: js.laplacian(u)(x) + x[2], sides), cloud


def known(folder, names):
    """What one process finds, by name: each process finds some of it, unless it stands in the folder already."""
    for k, name in enumerate(names):
        path = Path(folder) / f"{name}.npz"
        if k % COMM.size == COMM.rank and not path.exists():
            np.savez(path, **ALONE[name]())
    COMM.Barrier()
    return {name: dict(np.load(Path(folder) / f"{name}.npz")) for name in names}


def of_rows(sol, one):
    """The largest difference of any entry of the two matrices, rows and columns by the particles' numbers."""
    first, last, entries = sol.system.matrix.getValuesCSR()
    halo, held = sol._local.halo, sol._local.disc.held[:, 0]
    mine = halo.slab.number[halo.own & ~held]
    every = np.concatenate(COMM.allgather(mine))
    n = len(one["u"])
    here = sparse.csr_array((entries, (np.repeat(mine, np.diff(first)), every[last])), shape=(n, n))
    there = sparse.csr_array((one["data"], (one["r"], one["c"])), shape=(n, n))
    return jp.norm(abs((here - there)[mine]).max())


def off(found, one):
    """The largest difference of values (..., n) or (..., n, F) of own particles."""
    whole = one["u"]
    axis = next(k for k, (a, b) in enumerate(zip(found.u.shape, whole.shape)) if a != b)
    return jp.norm(found.u - np.take(whole, found.numbers, axis))


def refused(call):
    try:
        call()
    except (ValueError, js.SolveError) as error:
        return f"{type(error).__name__}: {error}"
    return "nothing was refused"


def always(found, one):
    """What may hang on the number of processes."""
    problem, cloud = mixed()
    sol = jp.solve(problem, cloud, solver="gamg", **CHEAP)
    found["values gamg"], found["iterations gamg"] = off(sol, one["mixed"]), sol.stats["linear"]["iterations"]
    found["rows"] = of_rows(sol, one["mixed"])
    some = slice(COMM.rank, None)
    found["anywhere"] = jp.norm(jp.evaluate(sol, PLACES[some]) - one["mixed"]["at"][some])
    found["slopes"] = jp.norm(jp.evaluate(sol, PLACES[some], (0, 1)) - one["mixed"]["slope"][some])
    found["own"] = COMM.allgather(len(sol.numbers))
    _files(found, sol, one["mixed"])

    found["reaction"] = off(jp.solve(*reaction(), order=4, depth=4), one["reaction"])
    sol = jp.solve(*graded(), **CHEAP)
    found["graded"], found["graded rows"] = off(sol, one["graded"]), of_rows(sol, one["graded"])
    found["repaired"] = [sol.stats["repaired"].tolist(), one["graded"]["repaired"].tolist()]

    slab = jp.cloud_from(js.from_sdf, shape(), ((0, 0), (1, 1.5)), 0.05)
    inside = COMM.gather(slab.points[slab.slab.group == 0])
    if COMM.rank == 0:
        mine, whole = (x[np.lexsort(x.T)] for x in (np.concatenate(inside), filled_by_one()))
        found["filled"] = float(np.abs(mine - whole).max()) if len(mine) == len(whole) else -1.0

    # Graded, of few particles, and so made by the first process.
    spacing = lambda x: 0.05 + 0.1 * x[:, 0]  # noqa: E731
    slab = jp.cloud_from(js.from_sdf, shape(), ((0, 0), (1, 1.5)), spacing)
    if COMM.rank == 0:
        whole = np.asarray(js.from_sdf(shape(), ((0, 0), (1, 1.5)), spacing).points)
    whole = COMM.bcast(whole if COMM.rank == 0 else None)
    found["dealt"] = jp.norm(slab.points - whole[slab.numbers])


def _files(found, sol, one):
    """Clouds from .npy and HDF5, solutions to .pvtu and to XDMF."""
    problem, cloud = mixed()
    folder = COMM.bcast(tempfile.mkdtemp(), root=0)
    group = np.zeros(len(cloud), int)
    for k, name in enumerate(cloud.groups):
        group[cloud.groups[name]] = k
    if COMM.rank == 0:
        for name, array in (("x", cloud.points), ("g", group), ("n", cloud.normals)):
            np.save(f"{folder}/{name}.npy", array)
    COMM.Barrier()
    names = {name: k for k, name in enumerate(cloud.groups)}
    slabs = jp.read(f"{folder}/x.npy", f"{folder}/g.npy", f"{folder}/n.npy", names=names)
    found["read"] = off(jp.solve(problem, slabs, **CHEAP), one)
    jp.save(sol, f"{folder}/u.pvtu", twice=2.0 * sol.u)
    found["folder"] = folder
    if importlib.util.find_spec("h5py"):
        jp.save(sol, f"{folder}/v.xdmf", twice=2.0 * sol.u)
        again = jp.read(f"{folder}/v.h5")
        at = np.concatenate(COMM.allgather(sol.numbers))  # in the file they stand process by process
        found["hdf5"] = jp.norm(again.points - np.asarray(cloud.points)[at[again.numbers]])
        code = np.array([names[name] for name in again.slab.names])
        found["hdf5 groups"] = jp.norm(code[again.slab.group] - group[at[again.numbers]])


def once(found, one):
    """What several processes do as two do."""
    problem, cloud = mixed()
    # PETSc comes with hypre or without.
    hypre = ("hypre",) if PETSc.Sys.hasExternalPackage("hypre") else ()
    for solver in (*hypre, "mumps"):
        sol = jp.solve(problem, cloud, solver=solver, **CHEAP)
        found[f"values {solver}"] = off(sol, one["mixed"])
        found[f"iterations {solver}"] = sol.stats["linear"]["iterations"]
    sol = jp.solve(plain(), small(), **CHEAP)
    error = jp.error_estimate(sol)
    found["estimate"] = jp.norm(error - one["plain"]["error"][sol.numbers]) / jp.norm(error)
    rough = jp.solve(narrow(), small(), **CHEAP)
    found["steady flags"] = [[s.flags, one[name]["flags"].tolist()] for s, name in ((sol, "plain"), (rough, "narrow"))]
    found["III"] = off(jp.solve(problem, cloud, method="III", **CHEAP), one["III"])
    problem, cloud = graded()
    found["kernel"] = off(jp.solve(problem, cloud, **weighted_kernel(cloud)), one["kernel"])
    sol = jp.solve(*system(), **CHEAP)
    found["system"], found["gathered"] = off(sol, one["system"]), np.shape(sol.gathered())
    sol = jp.solve(*axis(), order=4, depth=2)
    found["axis"], found["repaired on the axis"] = off(sol, one["axis"]), len(sol.stats["repaired"])
    found["cube"] = off(jp.solve(*cube(), **CHEAP), one["cube"])
    problem, cloud = of_params()
    value, slope = jp.value_and_grad(lambda u, x, k: (u**2).sum(), problem, cloud, **CHEAP)
    found["value"] = abs(value - float(one["params"]["value"]))
    found["gradient"] = max(abs(float(slope[k] - one["params"][k])) for k in slope)
    _, moved = jp.value_and_grad(lambda u, x, k: (u**2).sum(), problem, cloud, wrt="points", **CHEAP)
    whole = np.zeros(np.shape(cloud.points))
    numbers = jp.solve(problem, cloud, **CHEAP).numbers
    for ids, part in zip(COMM.allgather(numbers), COMM.allgather(moved)):
        whole[ids] = part
    found["by points"] = max(abs(whole[at] - m) for at, m in zip(MOVED, one["params"]["moved"]))
    problem, cloud = quasilinear()
    _, slope = jp.value_and_grad(lambda u, x, k: (u**2).sum(), problem, cloud, **CHEAP)
    found["nonlinear gradient"] = abs(float(slope) / float(one["quasilinear"]["slope"]) - 1.0)
    sol = jp.solve(problem, cloud, **CHEAP)
    found["newton"] = off(sol, one["quasilinear"])
    found["steps"] = [sol.iterations, int(one["quasilinear"]["steps"])]
    ready = jp.factorize(heated(0.0, 0.0), cloud, **CHEAP)
    found["factorize"] = off(ready.solve(heated(2.0, 0.3)), one["factorize"])
    found["kept"] = ready.solve(heated(1.0, 0.0)).system is ready.system

    problem, options = reacting()
    run = jp.evolve(problem, cloud, ramps, (0.0, END), **options)
    found["reacting"], found["times"] = off(run, one["reacting"]), run.t.tolist()
    found["pencils"] = [run.stats["pencils"], int(one["reacting"]["pencils"])]
    found["flags"] = [run.flags, one["reacting"]["flags"].tolist()]
    if importlib.util.find_spec("slepc4py"):
        problem, options = drum()
        several = jp.eigen(problem, cloud, 3, **options)
        found["values of modes"] = float(np.abs(several.values / one["drum"]["values"] - 1.0).max())
        error = jp.error_estimate(several)
        found["errors of modes"] = float(np.abs(error / one["drum"]["errors"] - 1.0).max())
        found["modes"] = jp.norm(several.u - one["drum"]["u"][several.numbers])
    found["refused"] = _refused(cloud)


def _refused(cloud):
    none = {name: js.neumann(0.0) for name in SIDES}
    lap = lambda u, x: js.laplacian(u)(x)  # noqa: E731
    zero = {name: js.dirichlet(0.0) for name in SIDES}
    pair = {**{name: zero[name] for name in SIDES[2:]}, "left": js.periodic("left", "right")}
    return {
        "floating": refused(lambda: jp.solve(js.Problem(lap, none), cloud, **CHEAP)),
        "nonlinear": refused(lambda: jp.factorize(js.Problem(lambda u, x: lap(u, x) - u(x) ** 2, zero), cloud)),
        "in time": refused(lambda: jp.evolve(
            js.Problem(lambda u, x, t: js.dt(u)(x) - lap(u, x), zero), cloud, 0.0, (0.0, 1.0), steps=2,
            scheme="radau")),
        "by start": refused(lambda: jax.grad(lambda k: jp.evolve(
            js.Problem(lambda u, x, t: js.dt(u)(x) - lap(u, x), zero), cloud, lambda x: k * x[0], (0.0, 1.0), steps=2
        ).u.sum())(1.0)),
        "by params": refused(lambda: jax.grad(lambda k: jp.solve(
            js.Problem(lambda u, x, k: k * lap(u, x), zero, params=k), cloud, **CHEAP).u.sum())(1.0)),
        "a line": refused(lambda: jp.cloud_from(js.interval, 0.0, 1.0, 9)),
        "II": refused(lambda: jp.solve(js.Problem(lap, zero), cloud, method="II")),
        "periodic": refused(lambda: jp.solve(js.Problem(lap, pair), cloud)),
        "first order": refused(lambda: jp.solve(
            js.Problem(lambda u, x: js.partial(u, (1, 0))(x), {**zero, "right": js.free()}), cloud, **CHEAP)),
        "one process": refused(lambda: jp.solve(js.Problem(lap, zero), cloud if COMM.rank else None)),
        "mass": refused(lambda: jp.eigen(
            js.Problem(lambda u, x: jnp.stack([u(x)[1] - lap(u[0], x), lap(u[0], x)]), zero, fields=2), cloud, 1,
            mass=(0.0, 1.0), order=2)),
        "axis": refused(lambda: jp.factorize(axis()[0], cloud, **CHEAP)),
        "array": refused(lambda: jp.solve(js.Problem(lap, {**zero, "top": js.dirichlet(np.zeros(3))}), cloud, **CHEAP)),
    }  # fmt: skip


def main(folder, whole):
    """whole: whether all is asked, or what hangs on the number of processes alone."""
    found = {}
    one = known(folder, list(ALONE) if whole else ["mixed", "graded", "reaction"])
    always(found, one)
    if whole:
        once(found, one)
    if COMM.rank == 0:
        print(json.dumps(found))
    sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2] == "whole")
