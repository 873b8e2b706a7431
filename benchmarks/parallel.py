"""Several processes: memory and seconds of whole solves, and what parts of a cloud tell one another.

``mpiexec -n 2 python -m benchmarks.parallel 47 58`` solves Poisson's equation in a jittered cube of so many particles
along an axis (order 4), whose files every process maps; kept is the peak of each process beyond what it had after a
small solve. Compiling takes memory too: run it twice, with a cache of compiled programs. With ``iterations`` instead,
squares and cubes by every multigrid that this PETSc has, and the iterations alone are kept.
``python -m benchmarks.parallel parts`` deals one cloud out to 1 to 64 parts and counts, by the package's own bisection
and halos, ghosts, messages and bytes: parts are threads there, so that no cores are needed.
"""

from __future__ import annotations

import gc
import json
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import machine
from benchmarks.commandline import arguments

DATA = Path(__file__).parent / "data" / "parallel.json"
ORDER, JITTER = 4, 0.3
# Particles along an axis of the cloud that is dealt out; to so many parts; neighbours that a row of the matrix has.
DEALT, PARTS, WIDTH = 64, (1, 2, 4, 8, 16, 32, 64), 40
SIDES = ("left", "right", "bottom", "top", "front", "back")
# Of the time of a solve, what a process with a core of its own computes at least.
ALONE = 0.8
# Dimension, particles along an axis of the clouds whose iterations are counted.
COUNTED = ((2, 40), (2, 126), (2, 400), (3, 18), (3, 29), (3, 62))


def cube(count: int, dim: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, dim) of a jittered cube or square, and the numbers (n,) of their groups."""
    line = np.linspace(0.0, 1.0, count)
    points = np.stack(np.meshgrid(*[line] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    group = np.zeros(len(points), np.int8)
    for k in range(2 * dim):
        group[(points[:, k // 2] == k % 2) & (group == 0)] = k + 1
    inner = group == 0
    points[inner] += JITTER / (count - 1) * np.random.default_rng(0).uniform(-1.0, 1.0, (inner.sum(), dim))
    return points, group


# ------------------------------------------------------------------------------------- parts of a cloud


class Threads:
    """A communicator whose processes are threads."""

    def __init__(self, size: int):
        self.size, self.board, self.barrier = size, [None] * size, threading.Barrier(size)

    def rank(self, rank: int) -> Any:
        board, barrier, size = self.board, self.barrier, self.size

        class One:
            Get_rank, Get_size = staticmethod(lambda: rank), staticmethod(lambda: size)

            @staticmethod
            def allgather(value: Any) -> list[Any]:
                board[rank] = value
                barrier.wait()
                found = list(board)
                barrier.wait()
                return found

            @classmethod
            def alltoall(cls, parcels: list[Any]) -> list[Any]:
                return [sent[rank] for sent in cls.allgather(parcels)]

        return One()


def dealt(count: int, parts: int) -> dict[str, Any]:
    """What ``parts`` parts of a cube have to tell one another."""
    from jsmitsm.cloud.cloud import Cloud
    from jsmitsm.cloud.neighbours import nearest
    from jsmitsm.parallel.distributed import bisected, slab_of
    from jsmitsm.parallel.halo import Halo, boxes_of
    from jsmitsm.parallel.local import first_reach
    from jsmitsm.parallel.team import Team

    points, group = cube(count)
    names = ("interior", *SIDES)
    cloud = Cloud(points, {name: np.flatnonzero(group == k) for k, name in enumerate(names)})
    comm, halos = Threads(parts), [None] * parts

    def one(rank: int) -> None:
        team = Team(comm.rank(rank))
        mine = bisected(team, slab_of(team, cloud))
        halos[rank] = Halo(team, mine, boxes_of(team, mine), team.most(first_reach(mine, ORDER)))

    threads = [threading.Thread(target=one, args=(rank,)) for rank in range(parts)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    owner = np.zeros(len(points), int)
    for rank, halo in enumerate(halos):
        owner[halo.slab.number[halo.ids]] = rank
    near = np.asarray(nearest(points, WIDTH).indices)
    away = (near >= 0) & (owner[np.maximum(near, 0)] != owner[:, None])
    asked = np.unique(np.stack([np.broadcast_to(owner[:, None], near.shape)[away], near[away]]), axis=1)
    pairs = np.unique(np.stack([asked[0], owner[asked[1]]]), axis=1)
    own, lent = np.bincount(owner, minlength=parts), [sum(map(len, h.lent)) for h in halos]
    return {
        "parts": parts, "particles": len(points), "own": [int(own.min()), int(own.max())],
        "ghosts": float(np.mean([len(h) / len(h.ids) - 1.0 for h in halos])), "reach": float(halos[0].reach),
        "halo_bytes": int(8 * max(lent)), "halo_messages": int(max(sum(len(a) > 0 for a in h.lent) for h in halos)),
        "product_bytes": int(8 * np.bincount(asked[0], minlength=parts).max()),
        "product_messages": int(np.bincount(pairs[0], minlength=parts).max()),
    }  # fmt: skip


# ------------------------------------------------------------------------------------- whole solves


def memory(name: str) -> int:
    """Bytes of this process: VmRSS now, or VmHWM at its peak since that was last cleared."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return 1024 * int(line.split()[1])


def solved(count: int, folder: str, dim: int = 3, solver: str = "auto") -> dict[str, Any]:
    """One solve by all processes: seconds, iterations, the error, and every process's peak."""
    import jax
    import jax.numpy as jnp

    import jsmitsm as js
    import jsmitsm.parallel as jp
    from jsmitsm.parallel.team import give_back, team

    us = team()
    if us.rank == 0:
        for name, array in zip(("points", "groups"), cube(count, dim)):
            np.save(f"{folder}/{name}.npy", array)
    us.gather(None)

    def exact(x):
        return jnp.sin(2 * x[0]) * jnp.exp(x[1]) * (jnp.cos(x[2]) if dim == 3 else 1.0)

    sides = SIDES[: 2 * dim]
    problem = js.Problem(
        lambda u, x: js.laplacian(u)(x) + (dim + 1) * exact(x), {name: js.dirichlet(exact) for name in sides}
    )
    gc.collect()
    give_back()
    before = memory("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    began, busy = time.perf_counter(), time.process_time()
    names = {name: k for k, name in enumerate(("interior", *sides))}
    cloud = jp.read(f"{folder}/points.npy", f"{folder}/groups.npy", names=names)
    sol = jp.solve(problem, cloud, order=ORDER, solver=solver)
    seconds, peak = time.perf_counter() - began, memory("VmHWM")
    busy = (time.process_time() - busy) / seconds
    error = jp.norm(sol.u - np.asarray(jax.vmap(exact)(sol.points)))
    return {
        "particles": count**dim, "unknowns": sol.stats["linear"]["unknowns"], "processes": us.size,
        "seconds": seconds, "busy": us.gather(busy), "phases": sol.stats["seconds"],
        "iterations": sol.stats["linear"]["iterations"], "solver": sol.stats["linear"]["solver"], "error": error,
        "backward_error": sol.stats["linear"]["residual"], "ghosts": us.gather(sol.stats["ghosts"]),
        "own": us.gather(len(sol.numbers)), "before": us.gather(before), "peak": us.gather(peak),
        "a_particle": us.gather((peak - before) / len(sol.numbers)),
    }  # fmt: skip


def counted(dim: int, count: int, folder: str) -> list[dict[str, Any]]:
    """The iterations of every multigrid at hand."""
    from jsmitsm.parallel.team import engine

    sys = engine("petsc4py.PETSc").Sys
    rows = []
    for solver in ("hypre", "gamg"):
        if solver == "gamg" or sys.hasExternalPackage(solver):
            row = solved(count, folder, dim, solver)
            some = ("particles", "unknowns", "processes", "iterations", "solver", "error", "backward_error")
            rows.append({"dim": dim, "petsc": "{}.{}".format(*sys.getVersion()), **{key: row[key] for key in some}})
    return rows


KEYS = {
    "parts": ("parts",), "solves": ("particles", "solver", "processes"),
    "iterations": ("dim", "particles", "solver", "petsc"),
}  # fmt: skip


def keep(what: str, rows: list[dict[str, Any]]) -> None:
    """Beside what was kept of others."""
    data = json.loads(DATA.read_text()) if DATA.exists() else {}
    of = lambda row: tuple(row[key] for key in KEYS[what])  # noqa: E731
    rows = [row | {"machine": machine.describe()} for row in rows]
    data[what] = sorted([row for row in data.get(what, []) if of(row) not in map(of, rows)] + rows, key=of)
    data["tables"] = {f"parallel-{name}": table(data[name]) for name, table in TABLES.items() if name in data}
    DATA.write_text(json.dumps(data, indent=1) + "\n")


# ------------------------------------------------------------------------------------- tables


def table_of_solves(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Without the seconds of processes that did not have a core each."""
    alone = [min(row.get("busy", [1.0])) > ALONE for row in rows]
    cells = [
        [f"{row['particles']:,}", row["solver"], f"{row['seconds']:.3g}" if own else "",
         f"{row['phases']['solve']:.2g}" if own else "", row["iterations"], f"{max(row['a_particle']) / 1e3:.2f}",
         f"{row['error']:.1e}"] for row, own in zip(rows, alone)
    ]  # fmt: skip
    columns = ["particles", "solver", "seconds", "of which the solver", "iterations", "peak, kB a particle",
               "largest error"]  # fmt: skip
    return {"columns": columns, "rows": cells}


def table_of_iterations(rows: list[dict[str, Any]]) -> dict[str, Any]:
    kinds = sorted({(row["solver"], row["petsc"]) for row in rows}, reverse=True)
    found = {(row["dim"], row["particles"], row["solver"], row["petsc"]): row["iterations"] for row in rows}
    clouds = sorted({(row["dim"], row["particles"]) for row in rows})
    cells = [[f"{dim}D", f"{n:,}", *(found.get((dim, n, *kind), "") for kind in kinds)] for dim, n in clouds]
    names = [f"{solver}, PETSc {petsc}" for solver, petsc in kinds]
    return {"columns": ["", "particles", *names], "rows": cells}


def table_of_parts(rows: list[dict[str, Any]]) -> dict[str, Any]:
    cells = [
        [row["parts"], f"{100 * row['ghosts']:.0f}%", f"{row['halo_bytes'] / 1e3:.0f} kB", row["halo_messages"],
         f"{row['product_bytes'] / 1e3:.0f} kB", row["product_messages"]] for row in rows
    ]  # fmt: skip
    columns = ["parts", "ghosts beside the own", "a halo refreshed", "to so many", "a product with the matrix",
               "to so many"]  # fmt: skip
    return {"columns": columns, "rows": cells}


TABLES = {"solves": table_of_solves, "iterations": table_of_iterations, "parts": table_of_parts}


def main(names: list[str]) -> None:
    if names == ["parts"]:
        keep("parts", [dealt(DEALT, parts) for parts in PARTS])
        return
    import jax

    jax.config.update("jax_enable_x64", True)
    from jsmitsm.parallel.team import team

    us = team()
    folder = us.gather(tempfile.mkdtemp() if us.rank == 0 else "")[0]
    if names == ["iterations"]:
        for dim, count in COUNTED:
            rows = counted(dim, count, folder)
            if us.rank == 0:
                print(json.dumps(rows), flush=True)
                keep("iterations", rows)
        return
    solved(12, folder)  # compiles, and imports what is imported late
    for count in map(int, names):
        row = solved(count, folder)
        if us.rank == 0:
            print(json.dumps(row), flush=True)
            keep("solves", [row])


if __name__ == "__main__":
    main(arguments(__doc__, names="particles along an axis, iterations or parts").names)
