"""Equations with known solutions on clouds of their own, from transport to elasticity, with error ceilings.

``python -m benchmarks.equations [names] [--no-estimate]`` solves them with the default kernel and
stencils, prints a table and writes ``benchmarks/data/equations.json``; ``--list`` names them.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks import machine, scenes

DATA = Path(__file__).parent / "data" / "equations.json"


@dataclass(frozen=True)
class Equation:
    """A boundary-value problem with a known solution on a cloud of its own.

    Attributes
    ----------
    name, about : how it is called, and the equation in one line.
    make : the problem on a cloud.
    cloud : makes the cloud.
    exact : the solution, a function of one point x (D,): a scalar, or (F,) for a system.
    ceilings : for each order the largest relative L2 error that is accepted.
    fields : number of fields; the error is the largest over them.
    floating : fields determined up to a constant, compared without their mean.
    steps : most Newton steps accepted; None for a linear problem.
    coarse, rates : a coarser cloud, and for each order the least observed order between the two.
    further : named further errors of a solution, each with its ceilings by order.
    """

    name: str
    about: str
    make: Callable[[js.Cloud], js.Problem]
    cloud: Callable[[], js.Cloud]
    exact: Callable[[Any], Any]
    ceilings: Mapping[int, float]
    fields: int = 1
    floating: tuple[int, ...] = ()
    steps: int | None = None
    coarse: Callable[[], js.Cloud] | None = None
    rates: Mapping[int, float] = field(default_factory=dict)
    further: Mapping[str, tuple[Callable[[Any], float], Mapping[int, float]]] = field(default_factory=dict)

    def values(self, points: Any) -> np.ndarray:
        """The exact solution at points (N, D): (N, F)."""
        return np.array(jax.jit(jax.vmap(self.exact))(np.asarray(points))).reshape(len(points), self.fields)

    def errors(self, sol: js.Solution) -> np.ndarray:
        """Errors at the particles over the size (root mean square) of their field, (N, F)."""
        true = self.values(sol.cloud.points)
        off = np.asarray(sol.u).reshape(true.shape) - true
        for k in self.floating:
            off[:, k] -= off[:, k].mean()
            true[:, k] -= true[:, k].mean()
        return off / np.sqrt(np.mean(true**2, axis=0))

    def error(self, sol: js.Solution) -> float:
        """The relative L2 error, the largest over the fields that have no ceiling of their own."""
        each = np.sqrt(np.mean(self.errors(sol) ** 2, axis=0))
        return float(max(e for k, e in enumerate(each) if k not in self.floating or self.fields == 1))

    def solve(self, order: int, cloud: js.Cloud | None = None, **options: Any) -> js.Solution:
        cloud = self.cloud() if cloud is None else cloud
        return js.solve(self.make(cloud), cloud, order=order, **options)


# ------------------------------------------------------------------ ingredients


def smooth(x: Any) -> Any:
    """A function without symmetry, neither harmonic nor polynomial, wave numbers about 2."""
    return jnp.sin(2 * x[0] - x[1] + 0.3) * jnp.exp(0.5 * x[1]) + jnp.log(3.0 + x[0] + x[1] ** 2)


def slope(exact: Callable) -> js.Condition:
    """The normal derivative of a known function, for groups with normals."""
    return js.condition(lambda u, x, n: n @ (js.grad(u)(x) - jax.grad(exact)(x)))


def sourced(operator: Callable[..., Any], exact: Callable[..., Any]) -> Callable[..., Any]:
    """The residual operator(u) - operator(exact)."""
    return lambda u, x: operator(u, x) - operator(exact, x)


def on_sides(exact: Callable, **others: Any) -> dict[str, Any]:
    """Dirichlet data on the sides of the square, except where something else is said."""
    return {**{side: js.dirichlet(exact) for side in scenes.SIDES}, **others}


def scattered(name: str, about: str, operator: Callable, ceilings: Mapping[int, float], exact: Callable = smooth,
              cloud: Callable[[], js.Cloud] = scenes.square, bcs: Any = None, **more: Any) -> Equation:  # fmt: skip
    """A manufactured problem on the unit square."""
    bcs = on_sides(exact) if bcs is None else bcs
    fields = more.get("fields", 1)
    return Equation(
        name, about, lambda _: js.Problem(sourced(operator, exact), bcs, fields=fields), cloud, exact, ceilings, **more
    )


def _laplace(u, x):
    return js.laplacian(u)(x)


# ------------------------------------------------------------------ linear operators


def _conductive(u, x):
    return js.divergence(lambda y: (1.5 + jnp.sin(3 * y[0] - y[1]) * y[1]) * js.grad(u)(y))(x)


def _anisotropic(u, x):
    return 1000 * js.partial(u, (2, 0))(x) + js.partial(u, (0, 2))(x)


def _rotated(angle: float) -> Callable:
    c, s = math.cos(angle), math.sin(angle)
    rotation = np.array([[c, -s], [s, c]])
    tensor = rotation @ np.diag([1000.0, 1.0]) @ rotation.T
    return lambda u, x: jnp.sum(jnp.asarray(tensor) * js.hessian(u)(x))


def _helmholtz(u, x):
    return js.laplacian(u)(x) + 10.5**2 * u(x)


def _plane_wave(x):
    return jnp.cos(10.5 * (0.28 * x[0] + 0.96 * x[1]) + 0.5)


def _convective(u, x):
    return -1e-3 * js.laplacian(u)(x) + jnp.array([0.8, -0.4 + x[0]]) @ js.grad(u)(x)


def _heat(u, x):
    return js.partial(u, (0, 1))(x) - 0.25 * js.partial(u, (2, 0))(x)


def _cooling(x):
    decay = lambda k: jnp.exp(-0.25 * (k * math.pi) ** 2 * x[1])
    return decay(1) * jnp.sin(math.pi * x[0]) + 0.3 * decay(2) * jnp.sin(2 * math.pi * x[0]) + 1.0 + x[0]


def _wave(u, x):
    return js.partial(u, (0, 2))(x) - js.partial(u, (2, 0))(x)


def _travelling(x):
    return jnp.cos(2.5 * (x[0] - x[1]) + 0.2) + jnp.sin(2 * (x[0] + x[1]))


def _mixed_derivative(u, x):
    return js.partial(u, (1, 1))(x) + u(x)


def _biharmonic(u, x):
    return js.laplacian(js.laplacian(u))(x)


STARTED = [js.dirichlet(_travelling), slope(_travelling)]
LINEAR = [
    scattered(
        "diffusion", "div(a(x) grad u) = f on random particles", _conductive, {4: 1e-6, 6: 1e-9, 8: 1e-12},
        cloud=lambda: scenes.square(scattered="random"),
    ),
    scattered("anisotropy", "1000 u_xx + u_yy = f", _anisotropic, {4: 1e-6, 6: 1e-9}),
    scattered("rotated", "conductivity 1000:1 at 0.5 rad", _rotated(0.5), {4: 1e-6, 6: 1e-9}),
    scattered(
        "helmholtz", "laplacian(u) + 10.5^2 u = 0, a plane wave", _helmholtz, {4: 3e-3, 6: 4e-5, 8: 4e-7}, _plane_wave
    ),
    scattered(
        "convection", "-1e-3 laplacian(u) + b(x) . grad u = f, smooth", _convective, {4: 1e-5, 6: 1e-8, 8: 1e-11}
    ),
    scattered(
        "heat", "u_t = u_xx/4 in space-time", _heat, {4: 1e-3, 6: 1e-5, 8: 1e-6}, _cooling,
        bcs=on_sides(_cooling, top=js.free()),
    ),
    scattered(
        "wave", "u_tt = u_xx in space-time", _wave, {6: 1e-7}, _travelling,
        bcs=on_sides(_travelling, bottom=STARTED, top=js.free()),
    ),
    scattered(
        "u_xy", "u_xy + u = f, data on two sides", _mixed_derivative, {4: 1e-5, 6: 1e-8},
        bcs=on_sides(smooth, right=js.free(), top=js.free()),
    ),
    scattered(
        "biharmonic", "laplacian^2(u) = f, clamped", _biharmonic, {4: 1e-5, 6: 1e-8, 8: 1e-11},
        bcs={side: [js.dirichlet(smooth), slope(smooth)] for side in scenes.SIDES},
    ),
]  # fmt: skip


# ------------------------------------------------------------------ shapes and bad clouds


def _balanced(x):
    """The smooth function in the star's coordinates."""
    return jnp.exp(0.7 * x[0]) * jnp.cos(1.8 * x[1] + 0.4) + x[0] * x[1] ** 3


def _robin(exact: Callable) -> js.Condition:
    return js.condition(
        lambda u, x, n: 2.0 * (u(x) - exact(x)) + (1.0 + 0.3 * x[0]) * (n @ (js.grad(u)(x) - jax.grad(exact)(x)))
    )


def _star(name: str, about: str, bcs: Any, ceilings: Mapping[int, float], groups: Any = None, **more: Any) -> Equation:
    return Equation(
        name, f"laplacian(u) = f in a star, {about}", lambda _: js.Problem(sourced(_laplace, _balanced), bcs),
        lambda: scenes.star(groups=groups), _balanced, ceilings, **more,
    )  # fmt: skip


def _in_ball(x):
    return jnp.exp(0.8 * x[0]) * jnp.sin(1.5 * x[1] + 0.2) * jnp.cos(x[2]) + x[0] * x[2] ** 2


LOOSE = {4: 5e-6, 6: 5e-9, 8: 5e-12}
JUMPS = {2: 0.1, 4: 1e-2, 6: 1e-3, 8: 1e-5}
SHAPES = [
    _star("star", "Dirichlet", {"boundary": js.dirichlet(_balanced)}, {4: 1e-7, 6: 1e-10, 8: 1e-13}),
    _star(
        "star mixed", "Dirichlet below, Neumann above", {"lower": js.dirichlet(_balanced), "upper": slope(_balanced)},
        LOOSE, scenes.STAR_PARTS,
    ),
    _star("star robin", "Robin", {"boundary": _robin(_balanced)}, LOOSE),
    _star("star neumann", "Neumann, up to a constant", {"boundary": slope(_balanced)}, LOOSE, floating=(0,)),
    Equation(
        "ball", "laplacian(u) = f, 7300 random particles in 3D",
        lambda _: js.Problem(sourced(_laplace, _in_ball), {"sphere": js.dirichlet(_in_ball)}),
        scenes.ball, _in_ball, {2: 2e-3, 4: 2e-5, 6: 2e-7},
    ),
    scattered("step", "laplacian(u) = f, the density jumps 1:100", _laplace, JUMPS, cloud=scenes.step),
    scattered("cluster", "laplacian(u) = f, a cluster 100 times as dense", _laplace, JUMPS, cloud=scenes.cluster),
]  # fmt: skip


# ------------------------------------------------------------------ nonlinear equations

BRATU = 0.140539214400472


def _bratu(u, x):
    return js.laplacian(u)(x) + jnp.exp(u(x))


def _bratu_line(x):
    """u = 2 log(cosh(t/4) / cosh((x - 1/2) t/2)) with t = sqrt(2) cosh(t/4)."""
    t = 1.5171645990507543
    return 2 * jnp.log(jnp.cosh(t / 4) / jnp.cosh((x[0] - 0.5) * t / 2))


def _liouville(x):
    """A solution of laplacian(u) + exp(u) = 0, Liouville's."""
    a = 0.45
    return jnp.log(8 * a) - 2 * jnp.log(1 + a * ((x[0] - 0.3) ** 2 + (x[1] - 0.6) ** 2))


def _quasilinear(u, x):
    return js.divergence(lambda y: (1 + u(y) ** 2) * js.grad(u)(y))(x)


def _burgers(u, x):
    return js.partial(u, (0, 1))(x) + u(x) * js.partial(u, (1, 0))(x) - 0.1 * js.partial(u, (2, 0))(x)


def _front(x):
    """A travelling front of Burgers' equation with viscosity 0.1."""
    return 0.6 - 0.4 * jnp.tanh(0.4 * (x[0] - 0.3 - 0.6 * x[1]) / 0.2)


def _steady_burgers(u, x):
    v, w = (lambda y: u(y)[0]), (lambda y: u(y)[1])
    along = lambda f: u(x)[0] * js.partial(f, (1, 0))(x) + u(x)[1] * js.partial(f, (0, 1))(x)
    return jnp.stack([along(v) - 0.1 * js.laplacian(v)(x), along(w) - 0.1 * js.laplacian(w)(x)])


def _coarse():
    return scenes.square(400)


NONLINEAR = [
    Equation(
        "bratu 1D", "u'' + exp(u) = 0, u(1/2) = 0.140539214400472, 41 particles",
        lambda _: js.Problem(_bratu, {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}),
        lambda: js.interval(0.0, 1.0, 41), _bratu_line, {8: 1e-11}, steps=6,
        further={"middle": (lambda sol: abs(float(sol.u[20]) - BRATU), {8: 1e-12})},
    ),
    scattered(
        "bratu 2D", "laplacian(u) + exp(u) = 0", _bratu, {4: 1e-6, 6: 1e-9}, _liouville,
        steps=8, coarse=_coarse, rates={4: 3.5, 6: 5.5},
    ),
    scattered(
        "quasilinear", "div((1 + u^2) grad u) = f", _quasilinear, {4: 6e-7, 6: 1.1e-9},
        steps=8, coarse=_coarse, rates={4: 3.5, 6: 5.5},
    ),
    scattered(
        "burgers", "u_t + u u_x = u_xx/10 in space-time, a front", _burgers, {4: 1e-4, 6: 1e-6}, _front,
        bcs=on_sides(_front, top=js.free()), steps=8, coarse=_coarse, rates={4: 3.5, 6: 5.5},
    ),
]  # fmt: skip


# ------------------------------------------------------------------ systems

LAME, SHEAR = 1.3, 0.7


def stress(u: Callable, x: Any) -> Any:
    """Stress of a displacement field u: x -> (D,), plane strain in 2D."""
    g = js.grad(u)(x)
    return LAME * jnp.trace(g) * jnp.eye(len(x)) + SHEAR * (g + g.T)


def _equilibrium(u, x):
    return js.divergence(lambda y: stress(u, y))(x)


FREE_SURFACE = js.condition(lambda u, x, n: stress(u, x) @ n)


def _kirsch(x):
    """Displacements of the infinite plate with a hole of radius 1 under unit tension along x."""
    kappa = (LAME + 3 * SHEAR) / (LAME + SHEAR)
    r, angle = jnp.sqrt(x[0] ** 2 + x[1] ** 2), jnp.arctan2(x[1], x[0])
    c, s, c3, s3 = jnp.cos(angle), jnp.sin(angle), jnp.cos(3 * angle), jnp.sin(3 * angle)
    ux = r * (kappa + 1) * c + 2 / r * ((1 + kappa) * c + c3) - 2 / r**3 * c3
    uy = r * (kappa - 3) * s + 2 / r * ((1 - kappa) * s + s3) - 2 / r**3 * s3
    return jnp.stack([ux, uy]) / (8 * SHEAR)


def _concentration(sol: js.Solution) -> float:
    """Relative error of the hoop stress, 3, at the two points of the hole off the axis of tension."""
    g = np.asarray(sol.grad(np.array([[0.0, 1.0], [0.0, -1.0]])))
    hoop = LAME * np.trace(g, axis1=1, axis2=2) + 2 * SHEAR * g[:, 0, 0]
    return float(np.abs(hoop / 3 - 1).max())


LENGTH, HALF_HEIGHT = 4.0, 0.5


def _cantilever(x):
    """Timoshenko's cubic solution: a beam held at x = 0, an end load at x = LENGTH, plane strain."""
    nu = LAME / (2 * (LAME + SHEAR))
    # Plane strain in the formulas of plane stress.
    young, nu = 2 * SHEAR * (1 + nu) / (1 - nu**2), nu / (1 - nu)
    inertia = 2 * HALF_HEIGHT**3 / 3
    y, height = x[1], 2 * HALF_HEIGHT
    ux = y * ((6 * LENGTH - 3 * x[0]) * x[0] + (2 + nu) * (y**2 - height**2 / 4))
    uy = 3 * nu * y**2 * (LENGTH - x[0]) + (4 + 5 * nu) * height**2 * x[0] / 4 + (3 * LENGTH - x[0]) * x[0] ** 2
    return jnp.stack([-ux, uy]) / (6 * young * inertia)


def _loaded(exact: Callable) -> js.Condition:
    return js.condition(lambda u, x, n: (stress(u, x) - stress(exact, x)) @ n)


def _displaced(x):
    return jnp.stack([jnp.sin(1.2 * x[0]) * jnp.cosh(x[1]) + x[1] ** 2, jnp.exp(0.6 * x[0]) * jnp.cos(1.7 * x[1] + 0.2)])


def _displaced_3d(x):
    return jnp.stack([
        jnp.sin(x[0] + 0.5 * x[1]) * jnp.cos(x[2]), jnp.exp(0.5 * x[1]) * jnp.sin(x[2] + 0.4), jnp.cos(x[0] - x[1]) * x[2]
    ])  # fmt: skip


def _stokes(u, x):
    part = lambda k: lambda y: u(y)[k]
    pressure = js.grad(part(2))(x)
    momentum = [-js.laplacian(part(k))(x) + pressure[k] for k in (0, 1)]
    return jnp.stack([*momentum, js.partial(part(0), (1, 0))(x) + js.partial(part(1), (0, 1))(x)])


def _flow(x):
    """A divergence-free velocity (the curl of sin(x + 0.2) sin(1.4 y) exp(x/2)) and a pressure."""
    stream = lambda y: jnp.sin(y[0] + 0.2) * jnp.sin(1.4 * y[1]) * jnp.exp(0.5 * y[0])
    g = jax.grad(stream)(x)
    return jnp.stack([g[1], -g[0], jnp.cos(2 * x[0] - x[1] + 0.5)])


def _pressure(sol: js.Solution) -> float:
    return float(np.sqrt(np.mean(EQUATIONS["stokes"].errors(sol)[:, 2] ** 2)))


def _brusselator(u, x):
    v, w = (lambda y: u(y)[0]), (lambda y: u(y)[1])
    a, b = u(x)[0], u(x)[1]
    return jnp.stack([0.5 * js.laplacian(v)(x) - 4 * a + a**2 * b, js.laplacian(w)(x) + 3 * a - a**2 * b])


def _species(x):
    return jnp.stack([1.5 + 0.5 * jnp.sin(2 * x[0] + x[1]), 2.0 + 0.4 * jnp.cos(1.5 * x[1] - x[0])])


ON_VELOCITY = [js.dirichlet(lambda x, k=k: _flow(x)[k], field=k) for k in (0, 1)]
SIX = ("left", "right", "bottom", "top", "front", "back")
SYSTEMS = [
    scattered(
        "elasticity", "plane elasticity, one side loaded", _equilibrium, {4: 1e-5, 6: 1e-8}, _displaced,
        cloud=lambda: scenes.square(700), bcs=on_sides(_displaced, right=_loaded(_displaced)), fields=2,
    ),
    Equation(
        "kirsch", "plate with a free hole under tension",
        lambda _: js.Problem(_equilibrium, {"outer": js.dirichlet(_kirsch), "hole": FREE_SURFACE}, fields=2),
        scenes.holed_plate, _kirsch, {6: 1e-4}, fields=2, further={"concentration": (_concentration, {6: 1e-3})},
    ),
    Equation(
        "cantilever", "a beam with an end load, a cubic solution",
        lambda _: js.Problem(_equilibrium, {
            "left": js.dirichlet(_cantilever), "right": _loaded(_cantilever), "bottom": FREE_SURFACE, "top": FREE_SURFACE,
        }, fields=2),
        lambda: js.rectangle((0.0, -HALF_HEIGHT), (LENGTH, HALF_HEIGHT), (41, 11), jitter=0.25, seed=6),
        _cantilever, {4: 1e-9}, fields=2,
    ),
    scattered(
        "stokes", "Stokes flow", _stokes, {6: 1e-6}, _flow, cloud=lambda: scenes.square(700),
        bcs={side: ON_VELOCITY for side in scenes.SIDES}, fields=3, floating=(2,),
        further={"pressure": (_pressure, {6: 1e-4})},
    ),
    scattered(
        "reaction-diffusion", "two species, cubic kinetics", _brusselator, {4: 1e-6, 6: 1e-9}, _species,
        cloud=lambda: scenes.square(700), fields=2, steps=8,
    ),
    Equation(
        "elasticity 3D", "a cube, one face loaded",
        lambda _: js.Problem(sourced(_equilibrium, _displaced_3d), {
            side: _loaded(_displaced_3d) if side == "top" else js.dirichlet(_displaced_3d) for side in SIX
        }, fields=3),
        lambda: js.box((0.0,) * 3, (1.0,) * 3, (9, 9, 9), jitter=0.25, seed=7), _displaced_3d, {4: 1e-4}, fields=3,
    ),
]  # fmt: skip

EQUATIONS = {case.name: case for case in (*LINEAR, *SHAPES, *NONLINEAR, *SYSTEMS)}


# ------------------------------------------------------------------ the run


def run(case: Equation, order: int, estimate: bool = True, **options: Any) -> dict[str, Any]:
    """Solve one case at one order: its line of the table."""
    cloud = case.cloud()
    start = time.perf_counter()
    sol = case.solve(order, cloud, **options)
    seconds = time.perf_counter() - start
    line: dict[str, Any] = {
        "case": case.name, "order": order, "particles": len(cloud), "error": case.error(sol),
        "ceiling": case.ceilings[order], "seconds": seconds, "formulation": sol.stats["formulation"],
        "repaired": len(sol.stats.get("repaired", ())), "weak": len(sol.stats.get("weak", ())),
        "lebesgue": sol.stats.get("lebesgue_max"), "steps": sol.iterations if case.steps else None,
    }  # fmt: skip
    line["further"] = {
        name: {"error": measure(sol), "ceiling": limits[order]}
        for name, (measure, limits) in case.further.items()
        if order in limits
    }
    if case.coarse is not None:
        before = case.coarse()
        ratio = case.error(case.solve(order, before, **options)) / line["error"]
        line["rate"] = math.log(ratio) / math.log((len(cloud) / len(before)) ** (1 / cloud.dim))
    if estimate:
        line |= estimated(case, sol)
    return line


def estimated(case: Equation, sol: js.Solution) -> dict[str, Any]:
    """How well the error estimate knows the error: ratio of their norms, rank correlation."""
    from scipy.stats import spearmanr

    start = time.perf_counter()
    true = case.values(sol.cloud.points)
    guess = np.asarray(sol.error_estimate()).reshape(true.shape)
    for k in case.floating:
        true[:, k] -= true[:, k].mean()
    guess = guess / np.sqrt(np.mean(true**2, axis=0))
    off = np.abs(case.errors(sol))
    there = off > 0
    return {
        "effectivity": float(np.linalg.norm(guess) / np.linalg.norm(off)),
        "rank": float(spearmanr(guess[there], off[there])[0]),
        "estimate seconds": time.perf_counter() - start,
    }


def missed(line: dict[str, Any]) -> list[str]:
    """What a line of the table fails to reach."""
    case = EQUATIONS[line["case"]]
    out = [] if line["error"] <= line["ceiling"] else ["error"]
    out += [name for name, one in line["further"].items() if not one["error"] <= one["ceiling"]]
    if line["steps"] is not None and line["steps"] > (case.steps or 0):
        out.append("steps")
    if "rate" in line and line["rate"] < case.rates[line["order"]]:
        out.append("rate")
    return out


def shown(line: dict[str, Any]) -> str:
    """One line of the printed table."""
    text = (
        f"{line['case']:19s} {line['order']:2d} {line['particles']:5d}  {line['error']:.1e}  {line['ceiling']:.1e} "
        f"{line['seconds']:6.1f}  {line['formulation']}  {line['repaired']:4d} {line['weak']:4d}"
    )
    text += f"  {line['effectivity']:8.2f} {line['rank']:5.2f}" if "effectivity" in line else " " * 16
    text += "".join(f"  {name} {one['error']:.1e} ({one['ceiling']:.0e})" for name, one in line["further"].items())
    text += f"  steps {line['steps']}" if line["steps"] else ""
    text += f"  order {line['rate']:.2f}" if "rate" in line else ""
    return text + "".join(f"  MISSED {name}" for name in missed(line))


HEAD = "case                 p     N  error    ceiling seconds form  rep. weak  effectiv.  rank"


def main(arguments: list[str]) -> None:
    jax.config.update("jax_enable_x64", True)
    names = [a for a in arguments if not a.startswith("--")]
    unknown = sorted(set(names) - set(EQUATIONS))
    if "--list" in arguments or unknown:
        known = "\n".join(f"{name:19s} {case.about}" for name, case in EQUATIONS.items())
        sys.exit(f"no such case: {', '.join(unknown)}\n{known}" if unknown else known)
    kept = json.loads(DATA.read_text())["lines"] if names and DATA.exists() else []
    lines = {(line["case"], line["order"]): line for line in kept}
    print(HEAD)
    for name in names or EQUATIONS:
        for order in EQUATIONS[name].ceilings:
            line = run(EQUATIONS[name], order, "--no-estimate" not in arguments)
            print(shown(line), flush=True)
            lines[name, order] = line
    ordered = [lines[key] for key in sorted(lines, key=lambda key: (list(EQUATIONS).index(key[0]), key[1]))]
    DATA.parent.mkdir(exist_ok=True)
    DATA.write_text(json.dumps({"machine": machine.describe(), "lines": ordered}, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
