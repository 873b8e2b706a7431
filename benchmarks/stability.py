"""Where a solve goes wrong, and whether it says so: ``python -m benchmarks.stability`` (some 40 minutes).

Sweeps of kernels, clouds, units, sources, layers and operators through every method, order and
dimension. Every case has an exact solution. It is *accurate*, *flagged* (refused, not converged, or
with a warning), or *silently wrong*, by the thresholds below, which were fixed before the first run.
Writes benchmarks/data/stability.json after every sweep, and benchmarks/data/stability.png at the end;
``--quick`` runs a subset, names run single sweeps and replace their part of the data, and ``--resume``
goes on where a run was broken off.
"""

import argparse
import gc
import itertools
import json
import subprocess
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path

import jax
import numpy as np

if "--float32" not in sys.argv:
    jax.config.update("jax_enable_x64", True)

import jsmitsm as js
from benchmarks import scenes
from benchmarks.machine import describe
from benchmarks.problems.families import FAMILIES, at_home
from jsmitsm.cloud.neighbours import Stencils

DATA = Path(__file__).parent / "data" / "stability.json"

# A relative L2 error above this is wrong.
LARGE = 0.1
# So is one above this many times the median of its neighbours in the sweep ...
JUMP = 100.0
# ... of which so many on either side count,
NEARBY = 2
# unless it is below this: nobody is misled by 1e-9 among 1e-12.
NEGLIGIBLE = 1e-6
# An estimated error above this part of the solution is a flag.
ESTIMATE = 0.1
# The estimate costs another solve: it is asked for above this error, and in one of so many other cases.
ASK, EVERY = 1e-2, 8

METHODS = ("I", "II", "III", "S", "SSPH")
# By dimension; few of the methods that compile long.
ORDERS = {
    "S": {1: (2, 4, 6), 2: (2, 4, 6), 3: (2, 4)},
    "III": {1: (2, 4, 6), 2: (2, 4), 3: (2,)}, "SSPH": {1: (2, 4, 6), 2: (2, 4), 3: (2,)},
    "I": {1: (2, 4), 2: (2, 4), 3: ()}, "II": {1: (2, 4), 2: (2, 4), 3: ()},
}  # fmt: skip
SIDE = {1: 41, 2: 15, 3: 7}  # particles along an edge: one array shape per dimension
WIDTH = {1: 13, 2: 81, 3: 203}  # of the stencils that a kernel's support selects from
# Messages that tell what was done, not that something is wrong.
NEUTRAL = ("widened or balanced", "its mean over the particles")


def problem(name, dim, q, neumann=False):
    return FAMILIES[name].problem(dim, q, neumann)


# ------------------------------------------------------------------ clouds


def lattice(dim, jitter=0.0, seed=0, lo=None, size=1.0, shape=None):
    """A jittered lattice on a box; in 1D too."""
    lo = np.zeros(dim) if lo is None else lo
    return scenes.lattice(lo, lo + size, SIDE[dim] if shape is None else shape, jitter, seed)()


def moved(cloud, inside):
    """The cloud with other interior particles."""
    points = np.array(cloud.points)
    points[cloud.groups["interior"]] = inside
    return js.Cloud(points, cloud.groups, cloud.normals)


def scattered(dim, seed):
    """Uniformly random inside, a lattice on the boundary."""
    cloud = lattice(dim)
    n = len(cloud.groups["interior"])
    return moved(cloud, np.random.default_rng(seed).uniform(0.01, 0.99, (n, dim)))


def clustered(dim, ratio):
    """A lattice on the boundary around :func:`dense`."""
    cloud = lattice(dim)
    return moved(cloud, dense(dim, ratio, len(cloud.groups["interior"])))


def dense(dim, ratio, n):
    """n points, half of them in a small box with ``ratio`` times the density of the rest."""
    from scipy.stats import qmc

    half = 0.5 * (1.0 / (1.0 + ratio)) ** (1.0 / dim)
    inner = 0.45 + half * (2.0 * qmc.Halton(dim, seed=1).random(n // 2) - 1.0)
    rest = 0.02 + 0.96 * qmc.Halton(dim, seed=2).random(20 * n)
    rest = rest[(np.abs(rest - 0.45) > half).any(axis=1)][: n - n // 2]
    return np.concatenate([inner, rest])


def paired(dim, distance):
    """A jittered lattice with one particle moved next to another."""
    cloud = lattice(dim, 0.2)
    inside = np.array(cloud.points)[cloud.groups["interior"]]
    k = len(inside) // 2
    inside[k + 1] = inside[k] + distance * np.eye(dim)[0]
    return moved(cloud, inside)


def spacing(dim):
    return 1.0 / (SIDE[dim] - 1)


def wide_stencils(cloud):
    """The nearest particles in a table of one width for all clouds of a dimension."""
    width = min(WIDTH[cloud.dim], len(cloud))
    near = js.stencils(cloud, size=min(width, len(cloud)))
    table = np.asarray(near.indices)
    # Ties beyond the width are cut at the rim, far outside every support used here.
    table = np.pad(table, ((0, 0), (0, max(0, width - table.shape[1]))), constant_values=-1)[:, :width]
    return Stencils(table, near.radius)


# ------------------------------------------------------------------ sweeps
# A sweep yields (dim, method, order, variant, value, make); make() gives problem, cloud and options.


def everywhere(dims=(1, 2, 3), orders=None):
    """All methods and orders, or those of ``orders`` by dimension; method S alone where that has no third."""
    for dim in dims:
        for method in METHODS:
            for order in ORDERS[method][dim] if orders is None else orders[dim]:
                yield dim, method, order
    if 3 not in dims:
        for order in (2, 4):
            yield 3, "S", order


def kernel_case(dim, jitter, h, radius):
    def make():
        cloud, gap = lattice(dim, jitter), spacing(dim)
        kernel = js.SuperGaussian(h=h * gap, d=radius / h)
        return problem("poisson", dim, at_home(dim)), cloud, {"kernel": kernel, "stencils": wide_stencils(cloud)}

    return make


def smoothing():
    """Smoothing length in spacings, at a support of 4 (1D), 3.6 (2D) and 2.9 (3D) spacings."""
    for (dim, method, order), jitter in itertools.product(everywhere(), (0.0, 0.3)):
        if dim == 3 and not jitter:
            continue
        for h in (0.4, 0.6, 1.0, 2.0, 4.0) if dim == 3 else (0.4, 0.5, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0, 4.0):
            yield dim, method, order, f"jitter {jitter}", h, kernel_case(dim, jitter, h, {1: 4.0, 2: 3.6, 3: 2.9}[dim])


def radius():
    """Support radius in spacings, smoothing length a third of it."""
    for (dim, method, order), jitter in itertools.product(everywhere(), (0.0, 0.3)):
        if dim == 3 and not jitter:
            continue
        for r in (1.45, 1.8, 2.3, 2.9, 3.2) if dim == 3 else (1.05, 1.45, 1.8, 2.05, 2.3, 2.7, 3.05, 3.5, 4.0):
            yield dim, method, order, f"jitter {jitter}", r, kernel_case(dim, jitter, r / 3.0, r)


def cloud_case(dim, make_cloud, neumann=False):
    return lambda: (problem("poisson", dim, at_home(dim), neumann), make_cloud(), {})


def jitter():
    """Jitter in spacings, supports chosen by the package."""
    for (dim, method, order), neumann in itertools.product(everywhere(), (False, True)):
        if neumann and (method != "S" or dim == 3):
            continue
        for j in (0.0, 0.1, 0.3, 0.4, 0.49):
            made = cloud_case(dim, lambda dim=dim, j=j: lattice(dim, j), neumann)
            yield dim, method, order, "neumann" if neumann else "dirichlet", j, made


def random():
    """Uniformly random particles, by seed."""
    for (dim, method, order), neumann in itertools.product(everywhere(), (False, True)):
        if neumann and (method != "S" or dim == 3):
            continue
        for seed in range(3):
            made = cloud_case(dim, lambda dim=dim, seed=seed: scattered(dim, seed), neumann)
            yield dim, method, order, "neumann" if neumann else "dirichlet", seed, made


def cluster():
    """Density ratio of two regions that touch."""
    for dim, method, order in everywhere():
        for ratio in (1, 10, 100, 1000):
            yield dim, method, order, "", ratio, cloud_case(dim, lambda dim=dim, r=ratio: clustered(dim, r))


def pair():
    """Two particles at a small distance, absolute."""
    for dim, method, order in everywhere((1, 2)):
        for distance in (1e-2, 1e-4, 1e-6, 1e-8, 1e-10):
            yield dim, method, order, "", distance, cloud_case(dim, lambda dim=dim, d=distance: paired(dim, d))


def sliver():
    """Aspect of a box with a fixed lattice: nearest neighbours on one line, or in one plane."""
    for dim, method, order in everywhere((2, 3)):
        for aspect in (1, 3, 10, 30, 100, 1000):
            size = np.array([1.0, 1.0 / aspect, 1.0][:dim])
            for j in (0.0, 0.3):
                made = cloud_case(dim, lambda dim=dim, s=size, j=j: lattice(dim, j, size=s))
                yield dim, method, order, f"jitter {j}", aspect, made
            if dim == 3:
                flat = np.array([1.0 / aspect, 1.0 / aspect, 1.0])
                yield dim, method, order, "in planes", aspect, cloud_case(3, lambda s=flat: lattice(3, 0.0, size=s))


def thin():
    """Strips and plates of equally spaced particles, by aspect; the last two have one row, or layer, inside."""
    for dim, method, order in everywhere((2,)):
        flat = ((15, 15), (25, 9), (45, 5), (75, 3), (2001, 3))
        for shape in flat if dim == 2 else ((7, 7, 7), (9, 9, 5), (12, 12, 3)):
            if max(shape) > 1000 and method in ("I", "II"):  # quadratic in the number of particles
                continue
            size = (np.array(shape) - 1.0) / (shape[0] - 1.0)
            made = cloud_case(dim, lambda dim=dim, s=size, shape=shape: lattice(dim, 0.2, size=s, shape=shape))
            yield dim, method, order, "", 1.0 / size[-1], made


def units():
    """The same problem in other units of length."""
    for dim, method, order in everywhere((1, 2), {1: (4,), 2: (2, 4)}):
        for k in (-8, -4, -2, 0, 2, 4, 8):
            def make(dim=dim, size=10.0**k):
                q = {"at": np.zeros(dim), "size": size}
                return problem("poisson", dim, q), lattice(dim, 0.3, size=size), {}

            yield dim, method, order, "", 10.0**k, make


def shift():
    """The same problem far from the origin, in sizes of the domain."""
    for dim, method, order in everywhere((1, 2), {1: (4,), 2: (2, 4)}):
        for far in (0.0, 1e2, 1e4, 1e6):
            def make(dim=dim, far=far):
                at = np.full(dim, far)
                return problem("poisson", dim, {"at": at, "size": 1.0}), lattice(dim, 0.3, lo=at), {}

            yield dim, method, order, "", far, make


def narrow():
    """A peak between particles, width in spacings."""
    for dim, method, order in everywhere((1, 2)):
        for w in (6.0, 4.0, 3.0, 2.0, 1.5, 1.0, 0.7, 0.5, 0.3, 0.1):
            q = {"centre": np.full(dim, 0.5) + spacing(dim) / 3.0, "w": w * spacing(dim)}
            yield dim, method, order, "", w, (lambda dim=dim, q=q: (problem("peak", dim, q), lattice(dim, 0.2), {}))


def layers():
    """eps^2 laplacian u = u: a boundary layer, width in spacings."""
    for dim, method, order in everywhere((1, 2)):
        for w in (10.0, 5.0, 3.0, 2.0, 1.0, 0.5, 0.3, 0.1, 0.03, 0.01):
            q = {"eps": w * spacing(dim)}
            yield dim, method, order, "", w, (lambda dim=dim, q=q: (problem("reaction", dim, q), lattice(dim, 0.2), {}))


def discontinuous():
    """Boundary data with a jump, by its distance to the next particle in spacings."""
    for dim, method, order in everywhere((2,)):
        for part in (0.5, 0.3, 0.1, 0.03):
            q = {"x0": 0.5 + part * spacing(dim)}
            yield dim, method, order, "", part, (lambda dim=dim, q=q: (problem("jump", dim, q), lattice(dim, 0.2), {}))


def resonance():
    """k^2 = lambda_1 (1 + delta), by delta: the first eigenvalue of the Laplacian."""
    for dim, method, order in everywhere((1, 2), {1: (2, 4), 2: (2, 4)}):
        for delta in (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 0.0):
            q = {**at_home(dim), "k": float(np.sqrt(dim * np.pi**2 * (1.0 + delta)))}
            made = lambda dim=dim, q=q: (problem("resonance", dim, q), lattice(dim, 0.2), {})
            yield dim, method, order, "", delta, made


def waves():
    """Helmholtz waves by particles per wavelength."""
    for dim, method, order in everywhere((1, 2)):
        for per in (39, 21, 13.5, 9.7, 7.7, 6.2, 4.8, 3.9, 3.1, 2.6):  # none at a resonance, k = n pi
            q = {"k": 2.0 * np.pi / (per * spacing(dim))}
            yield dim, method, order, "", per, (lambda dim=dim, q=q: (problem("wave", dim, q), lattice(dim, 0.2), {}))


def convection():
    """-eps laplacian u + u_x with an outflow layer, and with a smooth solution, by 1 / eps."""
    for (dim, method, order), name in itertools.product(everywhere((1, 2)), ("layer", "carried")):
        for peclet in (1.0, 1e1, 3e1, 1e2, 3e2, 1e3, 1e4, 1e6):
            q = {**at_home(dim), "eps": 1.0 / peclet}
            made = lambda dim=dim, q=q, name=name: (problem(name, dim, q), lattice(dim, 0.2), {})
            yield dim, method, order, name, peclet, made


def degree():
    """Order 1 (refused for an operator of order 2) to 10."""
    orders = {1: range(1, 11), 2: (1, 2, 3, 4, 6, 8, 10), 3: (2, 4, 6, 8, 10)}
    for dim, method, order in everywhere(orders=orders):
        # Their programs grow with the square of the terms and take minutes to compile.
        if method in ("I", "II") and (dim == 3 or order > 6 and dim == 2) or dim == 3 and method != "S" and order > 6:
            continue
        made = cloud_case(dim, lambda dim=dim: lattice(dim, 0.2))
        yield dim, method, 0, "by order", order, made


def cube():
    """Methods I and II in 3D, on few particles: h in spacings, jitter, seed and density ratio."""
    gap, shape = 0.25, (5, 5, 5)
    few = lambda j=0.0, seed=0: lattice(3, j, seed, shape=shape)
    inside = lambda make: lambda: moved(few(), make(len(few().groups["interior"])))
    scatter = lambda seed: inside(lambda n: np.random.default_rng(seed).uniform(0.01, 0.99, (n, 3)))
    graded = lambda ratio: inside(lambda n: dense(3, ratio, n))
    for method in ("I", "II"):
        for h in (0.4, 0.6, 1.0, 2.0, 4.0):
            def make(h=h):
                kernel = js.SuperGaussian(h=h * gap, d=2.3 / h)
                return problem("poisson", 3, at_home(3)), few(0.3), {"kernel": kernel}

            yield 3, method, 2, "h", h, make
        clouds = (("jitter", (0.0, 0.1, 0.3, 0.4, 0.49), lambda j: lambda: few(j)), ("random", (0, 1, 2), scatter),
                  ("ratio", (1, 10, 100, 1000), graded))  # fmt: skip
        for variant, values, made in clouds:
            for value in values:
                yield 3, method, 2, variant, value, cloud_case(3, made(value))


SWEEPS = {f.__name__: f for f in (
    smoothing, radius, jitter, random, cluster, pair, sliver, thin, units, shift, narrow, layers, discontinuous,
    resonance, waves, convection, degree, cube)}  # fmt: skip
# In float32: these orders in 1D and 2D, all of them where it is the order that is swept.
SINGLE = {name: (0, 4) for name in SWEEPS if name != "cube"} | {"smoothing": (2, 4)}  # fmt: skip


# ------------------------------------------------------------------ one case


def attempt(name, method, order, make, ask):
    """Error and flags of one solve."""
    out = {"error": None, "estimate": None, "flags": [], "refused": None}
    try:
        task, cloud, options = make()
        exact = FAMILIES[name].exact(np.asarray(cloud.points, float).T, jax.tree.map(np.asarray, task.params), np)
        size = float(np.linalg.norm(exact))
        sol = js.solve(task, cloud, method=method, order=order, **options)
    except (ValueError, js.SolveError) as fault:
        out["refused"] = f"{type(fault).__name__}: {str(fault)[:160]}"
        return out
    u = np.asarray(sol.u, float)
    out["error"] = float(np.linalg.norm(u - exact) / size) if np.isfinite(u).all() else float("inf")
    out["flags"] = [f[:48] for f in flags(sol)]
    out["messages"] = [m[:48] for m in messages(sol)]
    stats = sol.stats
    for key in ("lebesgue_max", "residual"):
        if key in stats:
            out[key] = float(stats[key])
    out.update(weak_particles=len(stats.get("weak", ())), repaired=len(stats.get("repaired", ())))
    if jax.config.jax_enable_x64 and bool(sol.converged):
        local, whole = sol.condition_numbers()
        out.update(local_condition=float(np.nanmax(local)), condition=whole)
    if ask or not out["error"] <= ASK:
        try:
            out["estimate"] = float(np.linalg.norm(np.asarray(sol.error_estimate(), float)) / np.linalg.norm(u))
        except (ValueError, js.SolveError) as fault:
            out["estimate_refused"] = str(fault)[:120]
    return out


def flags(sol):
    """What the solution says against itself, in sentences."""
    found = [] if bool(sol.converged) else ["not converged"]
    return found + sol.flags


def messages(sol):
    """What messages and weak particles alone would say."""
    found = [] if bool(sol.converged) else ["not converged"]
    found += [m for m in sol.stats.get("messages", []) if not any(n in m for n in NEUTRAL)]
    found += [f"{len(sol.stats['weak'])} weak particles"] if len(sol.stats.get("weak", ())) else []
    return found + list(sol.stats["linear"].get("messages", []))


PDE_OF = {"narrow": "peak", "layers": "reaction", "discontinuous": "jump", "resonance": "resonance", "waves": "wave"}


def run(sweep, quick, single):
    """All cases of a sweep, as records."""
    records, start = [], time.perf_counter()
    for n, (dim, method, order, variant, value, make) in enumerate(SWEEPS[sweep]()):
        if single and not (dim < 3 and order in SINGLE[sweep] and (order or value <= 8)):
            continue
        if quick and not (dim == 2 and order in (0, 4) and (order or value in (2, 4)) and variant != "jitter 0.0"):
            continue
        name = variant if sweep == "convection" else PDE_OF.get(sweep, "poisson")
        found = attempt(name, method, int(order or value), make, n % EVERY == 0)
        head = {"sweep": sweep, "dim": dim, "method": method, "order": order, "variant": variant,
                "value": float(value), "bits": 32 if single else 64}  # fmt: skip
        records.append({**head, **found})
        tidy()
    print(f"  {sweep}{' in float32' if single else ''}: {len(records)} cases, {time.perf_counter() - start:.0f} s",
          flush=True, file=sys.stderr)  # fmt: skip
    return records


def tidy():
    """Compiled programs hold memory maps, of which a process has a limited number."""
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 30000:
        jax.clear_caches()
        gc.collect()


def run_single(sweep, quick):
    """The same in float32, which is a setting of the whole process."""
    command = [sys.executable, "-m", "benchmarks.stability", "--float32", sweep, *(["--quick"] if quick else [])]
    return json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)


# ------------------------------------------------------------------ judgement


def judged(records):
    """Put "wrong", "flagged" and "kind" into every record."""
    series = defaultdict(list)
    for r in records:
        # Orders are no neighbours: an error a hundred times that of the next order is convergence.
        alone = r["value"] if r["sweep"] == "degree" else None
        series[r["sweep"], r["dim"], r["method"], r["order"], r["variant"], r["bits"], alone].append(r)
    for some in series.values():
        some.sort(key=lambda r: r["value"])
        for k, r in enumerate(some):
            near = [*some[max(0, k - NEARBY) : k], *some[k + 1 : k + 1 + NEARBY]]
            errors = [s["error"] for s in near if s.get("error") is not None]
            usual = max(float(np.median(errors)), NEGLIGIBLE) if errors else np.inf
            error = r["error"]
            r["wrong"] = None if r["refused"] is not None else not error <= min(LARGE, JUMP * usual)
            large = r.get("estimate") is not None and not r["estimate"] <= ESTIMATE
            r["told"] = bool(r.get("flags"))
            r["kind"] = kind(r["refused"], r["wrong"], r["told"] or large)
            r["kind_by_messages"] = kind(r["refused"], r["wrong"], bool(r.get("messages")) or large)
    return records


def kind(refused, wrong, flagged):
    if refused is not None:
        return "refused"
    if wrong:
        return "flagged" if flagged else "silently wrong"
    return "flagged needlessly" if flagged else "accurate"


KINDS = ("accurate", "refused", "flagged", "flagged needlessly", "silently wrong")


def summary(records, which="kind"):
    """Counts by sweep and by method."""
    def counts(some):
        found = Counter(r[which] for r in some)
        return [len(some), *(found[k] for k in KINDS)]

    rows = [[("float32 " if bits == 32 else "") + name, *counts(some)]
            for (bits, name), some in by(records, lambda r: (r["bits"], r["sweep"]))]  # fmt: skip
    rows += [[f"method {name}", *counts(some)] for name, some in by(records, lambda r: r["method"])]
    rows.append(["all", *counts(records)])
    return {"columns": ["sweep", "cases", *KINDS], "rows": rows}


SUBJECTS = {
    "smoothing length, support radius": ("smoothing", "radius"),
    "jittered, random and clustered clouds (to 1:1000)": ("jitter", "random", "cluster", "cube"),
    "particles 1e-10 apart, slivers, thin domains (to 1:1000)": ("pair", "sliver", "thin"),
    "units (1e-8 to 1e8), shifts (to 1e6 sizes)": ("units", "shift"),
    "steep sources, layers, discontinuous data": ("narrow", "layers", "discontinuous"),
    "Helmholtz: waves, resonance": ("waves", "resonance"),
    "convection (Peclet 1 to 1e6)": ("convection",),
    "order 1 to 10": ("degree",),
}  # fmt: skip


def by_subject(records, machine):
    """The table of the README."""
    rows = []
    for name, sweeps in (*SUBJECTS.items(), ("**all**", tuple(SWEEPS))):
        kinds = Counter(r["kind"] for r in records if r["sweep"] in sweeps)
        rows.append([name, sum(kinds.values()), *(kinds[k] for k in KINDS)])
    needless = [r["error"] for r in records if r["kind"] == "flagged needlessly"]
    inexact = sum(error > 0.01 for error in needless)
    note = (
        f"`python -m benchmarks.stability` on {machine['processor']}, JAX {machine['jax']}: every method, 1D to 3D, "
        "orders 1 to 10, float64 and float32. *Wrong* is an error above 10 %, or above 100 times that of the "
        "neighbouring cases; *refused* cases raise an error that names the cause. Of those right, yet flagged, "
        f"{inexact} have an error above 1 %."
    )
    columns = ["cases", "tried", "accurate", "refused", "wrong and flagged", "right, yet flagged", "silently wrong"]
    return {"columns": columns, "rows": rows, "note": note}


def by(records, key):
    groups = defaultdict(list)
    for r in records:
        groups[key(r)].append(r)
    return groups.items()


def show(table):
    print()
    for row in [table["columns"], *table["rows"]]:
        print(f"{row[0]:>24}" + "".join(f"{cell!s:>20}" for cell in row[1:]))


def picture(records, path):
    """Error of every case by sweep; silently wrong ones ringed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    colours = {"accurate": "#4c78a8", "flagged needlessly": "#9ecae9", "flagged": "#f2a900",
               "silently wrong": "#d62728"}  # fmt: skip
    names = list(dict.fromkeys(r["sweep"] for r in records))
    fig, axes = plt.subplots(figsize=(10, 5))
    rng = np.random.default_rng(0)
    for kind_, colour in colours.items():
        some = [r for r in records if r["kind"] == kind_]
        x = [names.index(r["sweep"]) + rng.uniform(-0.35, 0.35) for r in some]
        y = [min(max(r["error"], 1e-16), 1e6) for r in some]
        axes.scatter(x, y, s=30 if kind_ == "silently wrong" else 6, color=colour, lw=0, label=f"{kind_} ({len(some)})")
    axes.axhline(LARGE, color="0.6", lw=0.8)
    axes.set(yscale="log", ylabel="relative L2 error (cut at 1e6)", xticks=range(len(names)))
    axes.set_xticklabels(names, rotation=40, ha="right")
    refused = sum(r["kind"] == "refused" for r in records)
    axes.legend(title=f"{len(records)} cases, {refused} refused", fontsize=8, ncols=2)
    fig.tight_layout()
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="sweeps to run; all of them if none is named")
    parser.add_argument("--quick", action="store_true", help="2D, order 4 alone")
    parser.add_argument("--resume", action="store_true", help="keep the sweeps that the output holds")
    parser.add_argument("--float32", action="store_true", help="run in float32 and print the records")
    parser.add_argument("--output", default=str(DATA))
    args = parser.parse_args()
    names = args.names or list(SWEEPS)
    if args.float32:
        print(json.dumps([r for n in names for r in run(n, args.quick, True)]))
        return
    path = Path(args.output)
    start = time.perf_counter()
    old = json.loads(path.read_text()) if (args.names or args.resume) and path.exists() else {"records": []}
    every, before = old["records"], old["seconds"] if args.resume and "seconds" in old else 0
    if args.resume:
        names = [name for name in names if name not in {r["sweep"] for r in every}]
    for name in names:
        records = run(name, args.quick, False)
        if name in SINGLE:
            records += run_single(name, args.quick)
        every = judged([r for r in every if r["sweep"] != name] + records)
        write(path, every, before + round(time.perf_counter() - start))
    every = judged(every)
    write(path, every, before + round(time.perf_counter() - start))
    show(summary(every))
    for r in every:
        if r["kind"] == "silently wrong":
            print("silently wrong:", r["sweep"], f"{r['dim']}D", r["method"], f"order {r['order']}", r["variant"],
                  f"at {r['value']:g}, error {r['error']:.1e}")  # fmt: skip
    picture(every, path.with_suffix(".png"))


def write(path, records, seconds):
    thresholds = {"large": LARGE, "jump": JUMP, "nearby": NEARBY, "negligible": NEGLIGIBLE, "estimate": ESTIMATE}
    machine = describe()
    head = {"machine": machine, "seconds": seconds, "thresholds": thresholds, "table": summary(records),
            "tables": {"stability": by_subject(records, machine)}}  # fmt: skip
    text = json.dumps({**head, "records": [rounded(r) for r in records]}, separators=(",", ":"))
    path.write_text(text.replace("},{", "},\n{") + "\n")


def rounded(record):
    """Three digits, and nothing that is not there."""
    short = {k: float(f"{v:.3g}") if isinstance(v, float) else v for k, v in record.items()}
    return {k: v for k, v in short.items() if v is not None and v != [] or k in ("error", "refused")}


if __name__ == "__main__":
    main()
