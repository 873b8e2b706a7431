"""The measurements of docs/choosing.md: ``python -m benchmarks.choosing`` (some minutes).

Writes benchmarks/data/choosing.json; ``python -m benchmarks.readme`` puts its tables into the pages.
"""

import json
import os
import platform
import time
from pathlib import Path

import jax
import numpy as np

import jsmitsm as js
from benchmarks.commandline import arguments
from benchmarks.problems import CASES, slope

jax.config.update("jax_enable_x64", True)
DATA = Path(__file__).parent / "data" / "choosing.json"
ORDERS = (2, 4, 6, 8)


def table(columns, rows, note=""):
    return {"columns": columns, "rows": rows, "note": note}


def orders():
    """Error by degree and spacing, a smooth solution on scattered particles."""
    case, rows, every = CASES["two holes"], [], range(2, 9)
    for spacing in (0.2, 0.1, 0.05):
        cloud = case.cloud(spacing)
        rows.append([len(cloud), *(show(case.error(case.solve(p, cloud))) for p in every)])
    return table(["particles", *(f"order {p}" for p in every)], rows,
                 "Poisson on the plate of the README's picture, method S, defaults; relative L2 error.")  # fmt: skip


def smoothness():
    """Where the source is not smooth a higher degree brings little."""
    rows = []
    for name in ("poisson 2D", "kink 2D", "jump 2D", "peak 2D"):
        case = CASES[name]
        cloud = case.cloud(41, jitter=0.3)
        rows.append([f"{name.split()[0]}: {case.about}",
                     *(show(case.error(js.solve(case.problem(), cloud, order=p))) for p in ORDERS)])  # fmt: skip
    return table(["source", *(f"order {p}" for p in ORDERS)], rows,
                 "Unit square, 41 x 41 jittered particles, method S, defaults; relative L2 error.")  # fmt: skip


def sizes():
    """Error and Lebesgue constant by the number of neighbours."""
    case = CASES["poisson 2D"]
    cloud = case.cloud(31, jitter=0.45)
    rows = []
    for p in (4, 6):
        free = 2 * p + 1
        for ratio in (1.3, 1.6, 2.0, 2.5, 3.0, 4.0):
            size = int(round(ratio * free)) + 1
            near = js.stencils(cloud, size=size)
            sol = js.solve(case.problem(), cloud, order=p, stencils=near, throw=False)
            rows.append([p, free, size, show(case.error(sol)), f"{float(sol.stats['lebesgue_max']):.2g}"])
    return table(["order", "free coefficients", "neighbours", "error", "largest Lebesgue constant"], rows,
                 "Poisson on the unit square, 31 x 31 particles jittered by 0.45 spacings, method S.")  # fmt: skip


def supports():
    """Error by h at d = 4 on the paper's problem 4.3."""
    case = CASES["source"]
    cloud = case.cloud((9, 19))
    rows = []
    for method, p in (("S", 4), ("III", 2), ("SSPH", 2), ("SSPH", 4)):
        row = [f"{method}, order {p}"]
        for ratio in (0.6, 0.8, 1.0, 1.25, 1.6, 2.0):
            row.append(show(attempt(case, cloud, method, p, js.SuperGaussian(h=ratio * cloud.spacing, d=4.0))))
        rows.append(row)
    return table(["method", *(f"h = {r} Δ" for r in (0.6, 0.8, 1.0, 1.25, 1.6, 2.0))], rows,
                 "Problem 4.3 on 171 particles, super Gauss, d = 4, Δ the spacing; relative L2 error.")  # fmt: skip


def kernels():
    """Error by kernel at one support."""
    case = CASES["poisson 2D"]
    cloud = case.cloud(31, jitter=0.3)
    reach = 3.6 * 1 / 30
    rows = []
    for kernel in (js.SuperGaussian(reach / 4, 4.0), js.Gaussian(reach / 2, 2.0), js.Wendland(reach, 1.0),
                   js.CubicSpline(reach, 1.0), js.Constant(reach, 1.0)):  # fmt: skip
        found = (attempt(case, cloud, method, 4, kernel) for method in ("S", "III", "SSPH"))
        rows.append([type(kernel).__name__, *(show(e) for e in found)])
    rows.append(["none given (stencils and weights chosen)", *(show(attempt(case, cloud, m, 4, None))
                                                               for m in ("S", "III", "SSPH"))])  # fmt: skip
    return table(["kernel", "S", "III", "SSPH"], rows,
                 "Poisson on the unit square, 31 x 31 jittered particles, order 4, support 3.6 spacings.")  # fmt: skip


def methods():
    """Error of the five methods."""
    case = CASES["source"]
    rows = []
    for p in (2, 4):
        for method in ("I", "II", "III", "SSPH", "S"):
            cloud = case.cloud((33, 73))
            kernel = js.SuperGaussian(h=cloud.spacing, d=4.0) if method != "S" else None
            rows.append([method, p, show(attempt(case, cloud, method, p, kernel))])
    return table(["method", "order", "error"], rows,
                 "Problem 4.3 on 33 x 73 particles with its Neumann side; the paper's kernel with h = Δ, d = 4, "
                 "S with its defaults; relative L2 error.")  # fmt: skip


def clouds():
    """Error by the kind of cloud."""
    case = CASES["poisson 2D"]
    problem = case.problem(left=slope(case.exact))
    rows = []
    for name, cloud in (
        ("lattice", case.cloud(31)),
        ("jittered by 0.2 spacings", case.cloud(31, jitter=0.2)),
        ("jittered by 0.45 spacings", case.cloud(31, jitter=0.45)),
        ("uniformly random inside", random_cloud(case.cloud(31))),
    ):
        sols = [js.solve(problem, cloud, order=p) for p in ORDERS]
        rows.append([name, *(show(case.error(s)) for s in sols), len(sols[1].stats.get("repaired", ()))])
    return table(["cloud", *(f"order {p}" for p in ORDERS), "stencils repaired at order 4"], rows,
                 "Poisson on the unit square with one Neumann side, 961 particles, method S, defaults.")  # fmt: skip


def random_cloud(lattice):
    """The lattice's boundary with as many uniformly random particles inside."""
    inside = lattice.groups["interior"]
    points = np.array(lattice.points)
    points[inside] = np.random.default_rng(0).uniform(0.01, 0.99, (len(inside), lattice.dim))
    return js.Cloud(points, lattice.groups, lattice.normals)


def attempt(case, cloud, method, order, kernel):
    """Relative error, or None where the solve refuses."""
    try:
        return case.error(js.solve(case.problem(), cloud, method=method, order=order, kernel=kernel))
    except (js.SolveError, ValueError) as fault:
        print(f"  {method}, order {order}, {kernel}: {str(fault)[:200]}")
        return None


def show(error):
    return "refused" if error is None else f"{error:.1e}"


EXPERIMENTS = (orders, smoothness, clouds, methods, sizes, supports, kernels)


def main(names=()):
    DATA.parent.mkdir(exist_ok=True)
    found = json.loads(DATA.read_text()) if DATA.exists() else {"tables": {}}
    for experiment in EXPERIMENTS:
        if names and experiment.__name__ not in names:
            continue
        start = time.perf_counter()
        result = experiment()
        found["tables"][f"choosing-{experiment.__name__}"] = result
        print(f"\n{experiment.__name__} ({time.perf_counter() - start:.0f} s): {result['note']}")
        for row in [result["columns"], *result["rows"]]:
            print("  ".join(f"{cell!s:>12}" for cell in row))
        found["machine"] = f"{platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__}"
        DATA.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main(arguments(__doc__, names="experiment").names)
