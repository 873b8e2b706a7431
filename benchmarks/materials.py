"""Several regions with known solutions, and the errors they are held to: ``python -m benchmarks.materials [case ...]``.

Errors are relative, in the Euclidean norm over all particles. Solutions that satisfy no conditions by themselves get
the jumps, sources and boundary values that they have.
"""

import json
import time
from pathlib import Path

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks.commandline import arguments
from benchmarks.machine import describe
from benchmarks.regions import BOX, disk, error, exact, flux, truth, wall

jax.config.update("jax_enable_x64", True)
DATA = Path(__file__).parent / "data" / "materials.json"


def manufactured(cloud, k, solution):
    """div(k grad u) = f with everything that the solution has; k: a number or a function for each region."""
    known = {n: c if callable(c) else lambda x, c=c: c for n, c in k.items()}
    heat = lambda n: lambda x: jnp.trace(jax.jacfwd(lambda y: known[n](y) * jax.grad(solution[n])(y))(x))  # noqa: E731
    pde = {
        n: lambda u, x, n=n, c=c: js.divergence(lambda y: c(y) * js.grad(u)(y))(x) - heat(n)(x)
        for n, c in known.items()
    }
    through = {n: lambda u, x, normal, c=c: c(x) * normal @ js.grad(u)(x) for n, c in known.items()}
    bcs = {"boundary": js.dirichlet(truth(cloud, solution)[cloud.groups["boundary"]])}
    for name, pairs in cloud.interfaces.items():
        a, b = name.split("|")
        at, normals = cloud.points[pairs[:, 0]], cloud.interface_normals[name]
        step = lambda x, a=a, b=b: solution[a](x) - solution[b](x)  # noqa: E731
        source = lambda x, n, a=a, b=b: n @ (  # noqa: E731
            known[a](x) * jax.grad(solution[a])(x) - known[b](x) * jax.grad(solution[b])(x)
        )
        bcs[name] = js.interface(
            {s: through[s] for s in (a, b)}, jump=jax.vmap(step)(at), source=jax.vmap(source)(at, normals)
        )
    return js.Problem(pde, bcs)


def circle(spacing, k):
    """A disk in a uniform gradient."""
    cloud, solution = disk(spacing), exact(k)
    bcs = {"boundary": js.dirichlet(solution["out"]), "in|out": js.interface(flux({"in": k, "out": 1.0}))}
    return cloud, js.Problem(dict.fromkeys(solution, lambda u, x: js.laplacian(u)(x)), bcs), solution


def contact(spacing):
    """The same, k = 10, behind a contact of resistance 1."""
    k, r, cloud = 10.0, 0.5, disk(spacing)
    inner, outer = np.linalg.solve([[k, 1 / r**2], [r + k, -1 / r]], [1.0, r])
    solution = {"in": lambda x: inner * x[0], "out": lambda x: x[0] + outer * x[0] / (x @ x)}
    between = js.interface(flux({"in": k, "out": 1.0}), resistance=1.0)
    bcs = {"boundary": js.dirichlet(solution["out"]), "in|out": between}
    return cloud, js.Problem(dict.fromkeys(solution, lambda u, x: js.laplacian(u)(x)), bcs), solution


def leveque_li(spacing, b=10.0, c=0.1):
    """LeVeque and Li (1994): k = 1 + r^2 inside, a source on the circle."""
    solution = {
        "in": lambda x: x @ x,
        "out": lambda x: (1 - 1 / (8 * b)) / 4 + ((x @ x) ** 2 / 2 + x @ x - 1 / 4 + c / 2 * jnp.log(4 * x @ x)) / b,
    }
    cloud = disk(spacing)
    return cloud, manufactured(cloud, {"in": lambda x: 1 + x @ x, "out": b}, solution), solution


def star(spacing, k):
    """Five tips, with jumps of value and flux; the flux of both sides is of one size."""
    shape = lambda x: jnp.sqrt(x @ x + 1e-30) - (0.5 + 0.1 * jnp.cos(5 * jnp.arctan2(x[1], x[0])))  # noqa: E731
    cloud = js.regions({"in": shape, "out": js.sdf.difference(js.sdf.rectangle(*BOX), shape)}, BOX, spacing)
    solution = {
        "in": lambda x: jnp.exp(x[0]) * jnp.cos(x[1]) / max(k, 1.0),
        "out": lambda x: jnp.sin(x[0]) * jnp.cosh(x[1]) + x[0] * x[1],
    }
    return cloud, manufactured(cloud, {"in": k, "out": 1.0}, solution), solution


def square(x, y, width=1.0, height=1.0):
    return [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]


def junction(spacing):
    """Three materials, 10, 1 and 0.1, that meet as a T."""
    shapes = {"a": square(-1, -1, 1, 2), "b": square(0, -1), "c": square(0, 0)}
    cloud, solution = js.regions(shapes, spacing=spacing), dict.fromkeys("abc", lambda x: jnp.sin(x[0]) * jnp.exp(x[1]))
    return cloud, manufactured(cloud, {"a": 10.0, "b": 1.0, "c": 0.1}, solution), solution


def checkerboard(spacing, k=10.0):
    """Four quadrants of conductivities k, 1, k, 1: u = r^0.39 f(angle)."""
    power = 4 / np.pi * np.arctan(np.sqrt(1 / k))
    ratio = np.cos(power * np.pi / 4) / np.sin(power * np.pi / 4)

    def part(quadrant):
        middle = (quadrant + 0.5) * np.pi / 2
        wave, size = ((jnp.cos, 1.0), (jnp.sin, -ratio), (jnp.cos, -1.0), (jnp.sin, ratio))[quadrant]

        def u(x):
            c, s = np.cos(middle), np.sin(middle)
            angle = jnp.arctan2(c * x[1] - s * x[0], c * x[0] + s * x[1] + 1e-300)
            return (x @ x + 1e-300) ** (power / 2) * size * wave(power * angle)

        return u

    solution = {n: part(q) for q, n in enumerate("abcd")}
    corners = {"a": (0, 0), "b": (-1, 0), "c": (-1, -1), "d": (0, -1)}
    cloud = js.regions({n: square(*at) for n, at in corners.items()}, spacing=spacing)
    conducted = flux(dict(zip("abcd", (k, 1.0, k, 1.0))))
    bcs = {"boundary": js.dirichlet(truth(cloud, solution)[cloud.groups["boundary"]])}
    bcs |= {i: js.interface({s: conducted[s] for s in i.split("|")}) for i in cloud.interfaces}
    return cloud, js.Problem(dict.fromkeys("abcd", lambda u, x: js.laplacian(u)(x)), bcs), solution


def checkered():
    """Errors of the checkerboard as the spacing is halved, and the orders between them."""
    rows = []
    for spacing in (1 / 8, 1 / 16, 1 / 32):
        cloud, problem, solution = checkerboard(spacing)
        sol, right = js.solve(problem, cloud), truth(cloud, solution)
        off = np.asarray(sol.u) - right
        estimate = float(np.linalg.norm(sol.error_estimate()) / np.linalg.norm(off))
        rows.append({"spacing": spacing, "error": error(np.asarray(sol.u), right), "estimate": estimate,
                     "flags": sol.flags})  # fmt: skip
    orders = [float(np.log2(a["error"] / b["error"])) for a, b in zip(rows, rows[1:])]
    return {"case": "checkerboard, halved", "spacing": rows[-1]["spacing"], "order": 4, "bound": 2e-2,
            "error": rows[-1]["error"], "orders": orders, "rows": rows}  # fmt: skip


def sphere(spacing, k=50.0, r=0.5):
    """A ball in a uniform gradient, in a cube."""
    ball, box = js.sdf.sphere((0, 0, 0), r), ((-1,) * 3, (1,) * 3)
    cloud = js.regions({"in": ball, "out": js.sdf.difference(js.sdf.box(*box), ball)}, box, spacing)
    solution = {
        "in": lambda x: 3 / (2 + k) * x[0],
        "out": lambda x: x[0] + (1 - k) / (2 + k) * r**3 * x[0] / (x @ x) ** 1.5,
    }
    bcs = {"boundary": js.dirichlet(solution["out"]), "in|out": js.interface(flux({"in": k, "out": 1.0}))}
    return cloud, js.Problem(dict.fromkeys(solution, lambda u, x: js.laplacian(u)(x)), bcs), solution


def elastic(spacing):
    """A disk a hundred times as stiff as the plate; with jumps of displacements and tractions."""
    cloud, stiff = disk(spacing), {"in": 100.0, "out": 1.0}
    solution = {
        "in": lambda x: 0.01 * jnp.array([x[0] + x[1] ** 2 * jnp.sin(x[0]), 2 * x[0] * x[1]]),
        "out": lambda x: jnp.array([jnp.sin(x[0]) * x[1], jnp.cos(x[1]) * x[0]]),
    }
    stress = lambda g, c: c * (g + g.T + jnp.trace(g) * jnp.eye(2))  # noqa: E731
    inside = lambda n: lambda x: stress(jax.jacfwd(solution[n])(x), stiff[n])  # noqa: E731
    force = lambda n: lambda x: jnp.trace(jax.jacfwd(inside(n))(x), axis1=1, axis2=2)  # noqa: E731
    pde = {
        n: lambda u, x, n=n, c=c: js.divergence(lambda y: stress(js.grad(u)(y), c))(x) - force(n)(x)
        for n, c in stiff.items()
    }
    traction = {n: lambda u, x, normal, c=c: stress(js.grad(u)(x), c) @ normal for n, c in stiff.items()}
    at = cloud.points[cloud.interfaces["in|out"][:, 0]]
    source = jax.vmap(lambda x, n: (inside("in")(x) - inside("out")(x)) @ n)(at, cloud.interface_normals["in|out"])
    between = js.interface(traction, jump=lambda x: solution["in"](x) - solution["out"](x), source=source)
    bcs = {"boundary": js.dirichlet(solution["out"]), "in|out": between}
    return cloud, js.Problem(pde, bcs, fields=2), solution


# Of each case what makes it, the spacing, and the error held to at each order.
CASES = {
    "disk, k = 10": (lambda h: circle(h, 10.0), 0.08, {4: 8e-5, 8: 5e-6}),
    "disk, k = 10, finer": (lambda h: circle(h, 10.0), 0.05, {4: 1.5e-5, 8: 3e-7}),
    "disk, k = 1e3": (lambda h: circle(h, 1e3), 0.08, {4: 1e-4, 8: 4e-6}),
    "disk, k = 1e6": (lambda h: circle(h, 1e6), 0.08, {4: 1e-4, 8: 4e-6}),
    "disk, k = 1e-3": (lambda h: circle(h, 1e-3), 0.05, {4: 8e-5, 8: 2e-6}),
    "disk behind a contact": (contact, 0.05, {4: 2e-5, 8: 6e-7}),
    "LeVeque and Li": (leveque_li, 0.05, {4: 2e-6, 8: 3e-8}),
    "star, k = 1e-3": (lambda h: star(h, 1e-3), 0.08, {4: 1.2e-5, 6: 7e-8, 8: 5e-10}),
    "star, k = 1e6": (lambda h: star(h, 1e6), 0.08, {8: 3e-9}),
    "three materials as a T": (junction, 1 / 16, {4: 1.5e-7, 6: 5e-10}),
    "checkerboard": (checkerboard, 1 / 32, {4: 2e-2}),
    "elastic disk, 100": (elastic, 0.08, {4: 1.5e-4}),
    "ball, k = 50": (sphere, 0.13, {4: 1.5e-4}),
}


def measured(name, order):
    make, spacing, bounds = CASES[name]
    cloud, problem, solution = make(spacing)
    sol = js.solve(problem, cloud, order=order)
    right = np.zeros(np.shape(sol.u))
    for region, ids in cloud.regions.items():
        right[ids] = jax.vmap(solution[region])(cloud.points[ids])
    jump = 0.0
    for i, j in (pairs.T for pairs in cloud.interfaces.values()):
        jump = max(jump, float(np.abs(sol.u[i] - sol.u[j] - (right[i] - right[j])).max()))
    return {"case": name, "spacing": spacing, "order": order, "particles": len(cloud), "depth": sol.stats["depth"],
            "error": error(np.asarray(sol.u), right), "bound": bounds[order],
            "jump": jump / float(np.abs(sol.u).max()), "lebesgue": sol.stats["lebesgue_interfaces"],
            "flags": sol.flags}  # fmt: skip


def of_the_wall(order, bound):
    """The wall of ``benchmarks.regions``, conductivities a million apart."""
    made = wall(1 / 16, order)
    return {"case": "wall, ratio 1e6", "spacing": 1 / 16, "order": order, "bound": bound, **made}


def composite():
    """Three layers, 1, 50 and 5, a flux of 1000 through them: the hot side's temperature."""
    ends, k = (0.0, 0.1, 0.3, 0.35), {"a": 1.0, "b": 50.0, "c": 5.0}
    sides = {"hot": lambda x: x[:, 0] == ends[0], "cold": lambda x: x[:, 0] == ends[-1]}
    cloud = js.regions({n: ends[i : i + 2] for i, n in enumerate("abc")}, spacing=0.01, groups=sides)
    conducted = flux(k)
    bcs = {"hot": js.condition(lambda u, x, n: n @ js.grad(u)(x) - 1000.0), "cold": js.dirichlet(20.0)}
    bcs |= {i: js.interface({s: conducted[s] for s in i.split("|")}) for i in cloud.interfaces}
    sol = js.solve(js.Problem(dict.fromkeys("abc", lambda u, x: js.laplacian(u)(x)), bcs), cloud)
    right = 20 + 1000 * sum((b - a) / c for a, b, c in zip(ends, ends[1:], k.values()))
    found = float(sol.u[cloud.groups["hot"]].item())
    return {"case": "three layers", "spacing": 0.01, "order": 4, "bound": 1e-10, "error": abs(found / right - 1)}


def equal(order):
    """One material in two regions without a jump beside the same in one, whose error is the bound."""
    solution = lambda x: jnp.exp(x[0]) * jnp.cos(2 * x[1])  # noqa: E731
    cloud = disk(0.08)
    problem = manufactured(cloud, {"in": 1.0, "out": 1.0}, {"in": solution, "out": solution})
    two = js.solve(problem, cloud, order=order)
    plain = js.from_sdf(js.sdf.rectangle(*BOX), BOX, 0.08)
    one = js.solve(js.Problem(problem.pde["out"], {"boundary": js.dirichlet(solution)}), plain, order=order)
    errors = [error(np.asarray(s.u), np.asarray(jax.vmap(solution)(s.cloud.points))) for s in (two, one)]
    return {"case": "equal materials", "spacing": 0.08, "order": order, "error": errors[0], "bound": errors[1]}


def in_space(order):
    """A ball of k = 10 with smooth solutions on both sides, and their jumps."""
    ball, box = js.sdf.sphere((0, 0, 0), 0.5), ((-1,) * 3, (1,) * 3)
    cloud = js.regions({"in": ball, "out": js.sdf.difference(js.sdf.sphere((0, 0, 0), 1.0), ball)}, box, 0.2)
    solution = {
        "in": lambda x: jnp.exp(x[0]) * jnp.cos(x[1]) / 10.0,
        "out": lambda x: jnp.sin(x[0]) * jnp.cosh(x[2]) + x[0] * x[1],
    }
    sol = js.solve(manufactured(cloud, {"in": 10.0, "out": 1.0}, solution), cloud, order=order)
    off = np.abs(np.asarray(sol.u) - truth(cloud, solution))
    estimate = float(np.max(sol.error_estimate()) / off.max()) if order < 8 else None
    return {"case": "ball, smooth", "spacing": 0.2, "order": order, "particles": len(cloud), "bound": None,
            "error": error(np.asarray(sol.u), truth(cloud, solution)), "estimate": estimate,
            "lebesgue": sol.stats["lebesgue_interfaces"], "flags": sol.flags}  # fmt: skip


def strip():
    """Two elastic layers with a symmetry plane and a free end, where conditions follow from one another: linear."""
    layers = {"a": square(0, 0, 1, 0.5), "b": square(0, 0.5, 1, 0.5)}
    sides = {"left": lambda x: x[:, 0] < 1e-9, "right": lambda x: x[:, 0] > 1 - 1e-9, "rest": lambda x: x[:, 0] > -1}
    cloud, stiff, pull = js.regions(layers, spacing=0.125, groups=sides), {"a": 10.0, "b": 1.0}, {"a": 0.01, "b": 0.1}
    solution = {n: lambda x, e=e: e * jnp.array([x[0], -3.0 * x[1]]) for n, e in pull.items()}
    stress = lambda u, x, c: c * (js.grad(u)(x) + js.grad(u)(x).T + jnp.trace(js.grad(u)(x)) * jnp.eye(2))  # noqa: E731
    force = {n: lambda u, x, normal, c=c: stress(u, x, c) @ normal for n, c in stiff.items()}
    pde = {n: lambda u, x, c=c: js.divergence(lambda y: stress(u, y, c))(x) for n, c in stiff.items()}
    right = np.zeros((len(cloud), 2))
    for n, ids in cloud.regions.items():
        right[ids] = jax.vmap(solution[n])(cloud.points[ids])
    plane = {
        n: js.condition(lambda u, x, m, f=f: jnp.array([u(x)[0], f(u, x, m)[1]])) for n, f in force.items()
    }
    bcs = {"left": plane, "right": {n: js.condition(f) for n, f in force.items()}}
    bcs |= {"rest": js.dirichlet(right[cloud.groups["rest"]])}
    bcs |= {"a|b": js.interface(force, jump=lambda x: solution["a"](x) - solution["b"](x))}
    sol = js.solve(js.Problem(pde, bcs, fields=2), cloud, order=2)
    return {"case": "elastic strip", "spacing": 0.125, "order": 2, "bound": 1e-12, "error": error(sol.u, right),
            "flags": sol.flags}  # fmt: skip


def moved():
    """Derivatives by the place and the size of an inclusion, through the particles, beside central differences."""
    cloud = disk(0.16)
    near = js.stencils(cloud, size=20)

    def loss(p):
        x = cloud.points
        bump = jnp.maximum(1.0 - jnp.sum(x**2, axis=1, keepdims=True), 0.0) ** 2
        there = cloud.replace(points=x + bump * (p["to"] + p["by"] * x))
        through = {n: lambda u, x, n, p, c=c: p["k"] ** c * n @ js.grad(u)(x) for n, c in {"in": 1, "out": 0}.items()}
        bcs = {"boundary": js.dirichlet(lambda x, p: x[0] + x[0] * x[1]), "in|out": js.interface(through)}
        problem = js.Problem(dict.fromkeys(through, lambda u, x, p: js.laplacian(u)(x)), bcs, params=p)
        sol = js.solve(problem, there, stencils=near)
        return jnp.sum(sol.u**2)

    here = {"k": 7.0, "to": jnp.array([0.03, -0.02]), "by": 0.05}
    flat, back = jax.flatten_util.ravel_pytree(here)
    slope = jax.flatten_util.ravel_pytree(jax.grad(loss)(here))[0]
    steps = 1e-5 * np.eye(len(flat))
    apart = np.array([(loss(back(flat + d)) - loss(back(flat - d))) / 2e-5 for d in steps])
    off = float(np.max(np.abs(slope - apart) / np.maximum(1.0, np.abs(apart))))
    return {"case": "gradient by place", "spacing": 0.16, "order": 4, "bound": 1e-7, "error": off}


def large(spacing=0.0063):
    """An inclusion in 100,000 particles beside one material: seconds of the processor, the second of two solves."""
    cloud, problem, solution = circle(spacing, 10.0)
    plain = js.from_sdf(js.sdf.rectangle(*BOX), BOX, spacing)
    alone = js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": js.dirichlet(lambda x: x[0] * x[1] + x[0])})
    spent = []
    for stated, where in ((problem, cloud), (alone, plain)):
        js.solve(stated, where)
        start = time.process_time()
        sol = js.solve(stated, where)
        spent.append(time.process_time() - start)
        if stated is problem:
            off = error(np.asarray(sol.u), truth(cloud, solution))
    return {"case": "large", "spacing": spacing, "order": 4, "particles": [len(cloud), len(plain)], "bound": None,
            "error": off, "seconds": spent, "ratio": spent[0] / spent[1]}  # fmt: skip


def table(rows):
    """The rows as they stand on the page."""
    lines = ["| | spacing | order | error | held to |", "|---|---|---|---|---|"]
    for r in rows:
        held = f"{r['bound']:.1e}" if r["bound"] else ""
        lines.append(f"| {r['case']} | {r['spacing']:.4g} | {r['order']} | {r['error']:.1e} | {held} |")
    return lines


def main(names):
    runs = [(n, lambda n=n, p=p: measured(n, p)) for n in CASES for p in CASES[n][2]]
    bounds = {2: 1e-3, 4: 4e-6, 6: 1e-8, 8: 1e-10}
    runs += [("wall", lambda p=p, b=b: of_the_wall(p, b)) for p, b in bounds.items()]
    runs += [("in space", lambda p=p: in_space(p)) for p in (4, 5, 6, 8)]
    runs += [("checkerboard, halved", checkered), ("strip", strip), ("moved", moved), ("large", large)]
    runs += [("three layers", composite)] + [("equal", lambda p=p: equal(p)) for p in (4, 8)]
    old = json.loads(DATA.read_text())["rows"] if names and DATA.exists() else []
    rows = []
    for name, row in runs:
        if not names or any(n in name for n in names):
            rows.append(row())
            print(rows[-1], flush=True)
    kept = {(r["case"], r["order"]): r for r in (*old, *rows)}
    DATA.write_text(json.dumps({"machine": describe(), "rows": list(kept.values())}, indent=1) + "\n")
    print("\n".join(table(kept.values())))


if __name__ == "__main__":
    main(arguments(__doc__, names="case").names)
