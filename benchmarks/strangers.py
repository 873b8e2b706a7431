"""Problems for ``js.adapt`` that nothing in it was tuned on: corners of odd angles, kinks in data, mixed conditions,
nonlinear problems, systems, other domains and dimensions, each with its exact solution."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks.nist import UNIT, Case, elastic, polar, sector

Function = Callable[[Any], Any]


def _laplacian(f: Function) -> Function:
    return lambda x: jnp.trace(jax.hessian(f)(x))


def _power(r: Any, a: float) -> Any:
    """r^a, with a slope of zero where r is."""
    return jnp.where(r > 0, jnp.where(r > 0, r, 1.0) ** a, 0.0)


def _case(name: str, pde: Any, exact: Function, make: Any, bcs: Any = None, fields: int = 1) -> Case:
    return Case(name, js.Problem(pde, bcs or {"boundary": js.dirichlet(exact)}, fields=fields), make, exact)


def _polygon(corners: Any, groups: Any = None) -> Callable[[Any], js.Cloud]:
    return lambda spacing: js.from_polygon(corners, spacing, groups=groups)


def corner(angle: float = 4.1) -> Case:
    """r^a sin(a t) at an odd angle, and something smooth that is no smaller."""
    a, cut = np.pi / angle, angle / 2 + np.pi
    smooth = lambda x: jnp.exp(x[0]) * jnp.cos(2 * x[1])

    def exact(x):
        r, t = polar(x, cut)
        return _power(r, a) * jnp.sin(a * t) + smooth(x)

    pde = lambda u, x: js.laplacian(u)(x) - _laplacian(smooth)(x)
    return _case("corner of 4.1", pde, exact, _polygon(sector(angle)))


def mixed(angle: float = 2.9) -> Case:
    """Held on one side of a corner, free on the other."""
    a, cut = np.pi / (2 * angle), angle / 2 + np.pi
    end = np.array([np.cos(angle), np.sin(angle)])

    def exact(x):
        r, t = polar(x, cut)
        return _power(r, a) * jnp.sin(a * t)

    free = lambda x: (np.abs(x @ [-end[1], end[0]]) < 1e-9) & (x @ end > 1e-12)
    groups = {"free": free, "held": lambda x: ~free(x)}
    bcs = {"free": js.neumann(0.0), "held": js.dirichlet(exact)}
    return _case("corner of 2.9, held and free", lambda u, x: js.laplacian(u)(x), exact,
                 _polygon(sector(angle), groups), bcs)  # fmt: skip


def kinked_data(at: float = 0.37) -> Case:
    """|x - 0.37| along a side: harmonic, singular at no vertex."""

    def exact(x):
        z = x[0] - at, x[1]
        square = z[0] ** 2 + z[1] ** 2
        inner = square == 0
        log = jnp.where(inner, 0.0, 0.5 * jnp.log(jnp.where(inner, 1.0, square)))
        angle = jnp.arctan2(jnp.where(inner, 0.0, z[1]), jnp.where(inner, 1.0, z[0]))
        return z[1] * log + z[0] * (angle - np.pi / 2)

    return _case("kink in the boundary's values", lambda u, x: js.laplacian(u)(x), exact, _polygon(UNIT))


def moved_front() -> Case:
    exact = lambda x: jnp.arctan(43.0 * (jnp.hypot(x[0] - 1.31, x[1] + 0.27) - 0.83))
    return _case("moved front", lambda u, x: js.laplacian(u)(x) - _laplacian(exact)(x), exact, _polygon(UNIT))


def jump(radius: float = 0.37) -> Case:
    """A source of 1 within a circle, and of 0 outside of it."""
    r = lambda x: jnp.hypot(x[0] - 0.45, x[1] - 0.52)

    def exact(x):
        away = jnp.maximum(r(x), radius)
        return jnp.minimum(r(x), radius) ** 2 / 4 + radius**2 / 2 * jnp.log(away / radius)

    source = lambda x: jnp.where(r(x) < radius, 1.0, 0.0)
    return _case("source with a jump", lambda u, x: js.laplacian(u)(x) - source(x), exact, _polygon(UNIT))


def nonlinear() -> Case:
    """laplacian(u) = u^3 + f at a corner of 4.6."""
    angle = 4.6
    a, cut = np.pi / angle, angle / 2 + np.pi

    def exact(x):
        r, t = polar(x, cut)
        return _power(r, a) * jnp.sin(a * t)

    pde = lambda u, x: js.laplacian(u)(x) - u(x) ** 3 + exact(x) ** 3
    return _case("nonlinear at a corner of 4.6", pde, exact, _polygon(sector(angle)))


def burgers() -> Case:
    """u u_x + u_y = eps laplacian(u) + f with a slanted step."""
    eps = 0.01
    exact = lambda x: 1.2 + jnp.tanh((x[0] - 0.4 - 0.3 * x[1]) / 0.06)

    def pde(u, x):
        rest = lambda v, slope, bent: v * slope[0] + slope[1] - eps * bent
        known = rest(exact(x), jax.grad(exact)(x), _laplacian(exact)(x))
        return rest(u(x), js.grad(u)(x), js.laplacian(u)(x)) - known

    return _case("Burgers, slanted step", pde, exact, _polygon(UNIT))


def coupled() -> Case:
    """Two fields: a layer in the first, a peak in the second."""
    eps = 0.02

    def exact(x):
        layer = jnp.exp(-x[0] / eps) + jnp.cos(2 * x[1])
        peak = jnp.exp(-150.0 * ((x[0] - 0.62) ** 2 + (x[1] - 0.31) ** 2))
        return jnp.stack([layer, peak])

    def pde(u, x):
        both = exact(x)
        one, two = (lambda x, k=k: exact(x)[k] for k in range(2))
        first = -(eps**2) * _laplacian(one)(x) + both[0] - both[1]
        second = -_laplacian(two)(x) + both[0]
        return (-(eps**2) * js.laplacian(u[0])(x) + u[0](x) - u[1](x) - first,
                -js.laplacian(u[1])(x) + u[0](x) - second)  # fmt: skip

    return _case("two fields, a layer and a peak", pde, exact, _polygon(UNIT), fields=2)


def conductor() -> Case:
    """div(k grad u) on a ring, k from 0.05 to 1.95 across a line; a flux is given outside."""
    k = lambda x: 1.0 + 0.95 * jnp.tanh(15.0 * (x[0] - 0.6 * x[1]))
    exact = lambda x: jnp.exp(0.7 * x[0]) * jnp.sin(1.9 * x[1] + 0.3)
    flux = lambda f: lambda x: k(x) * jax.grad(f)(x)
    source = lambda x: jnp.trace(jax.jacfwd(flux(exact))(x))
    pde = lambda u, x: k(x) * js.laplacian(u)(x) + jax.grad(k)(x) @ js.grad(u)(x) - source(x)
    shape = js.sdf.difference(js.sdf.circle((0.0, 0.0), 1.0), js.sdf.circle((-0.15, 0.1), 0.4))
    near = lambda x: np.hypot(x[:, 0] + 0.15, x[:, 1] - 0.1) < 0.45
    groups = {"hole": near, "rim": lambda x: ~near(x)}
    given = js.condition(lambda u, x, n: n @ js.grad(u)(x) + u(x) - n @ jax.grad(exact)(x) - exact(x))
    make = lambda spacing: js.from_sdf(shape, ((-1.0, -1.0), (1.0, 1.0)), spacing, groups=groups)
    return _case("conductor, a ring", pde, exact, make, {"hole": js.dirichlet(exact), "rim": given})


def waves() -> Case:
    """A plane wave, twelve of them across the square, let out by a condition of Robin's kind."""
    k, way = 25.0, np.array([np.cos(0.7), np.sin(0.7)])
    exact = lambda x: jnp.sin(k * (way @ x) + 0.4)
    out = js.condition(lambda u, x, n: n @ js.grad(u)(x) + k * u(x) - n @ jax.grad(exact)(x) - k * exact(x))
    groups = {"out": lambda x: x[:, 0] > 1 - 1e-9, "in": lambda x: x[:, 0] <= 1 - 1e-9}
    return _case("plane waves", lambda u, x: js.laplacian(u)(x) + k**2 * u(x), exact, _polygon(UNIT, groups),
                 {"in": js.dirichlet(exact), "out": out})  # fmt: skip


def notch() -> Case:
    """The elastic field of Mitchell's first mode at a right-angled notch, whose sides are free: a stress concentration
    that no end of a condition marks."""
    both = elastic(1).exact
    s = 1.0 / np.sqrt(2.0)
    corners = [(0.0, 0.0), (-s, -s), (0.0, -2 * s), (2 * s, 0.0), (0.0, 2 * s), (-s, s)]
    shear, first = 1.0 / 2.6, 0.3 / (1.3 * 0.4)
    stress = lambda slope: first * jnp.trace(slope) * jnp.eye(2) + shear * (slope + slope.T)
    side = lambda x: (np.abs(np.abs(x[:, 1]) + x[:, 0]) < 1e-9) & (x[:, 0] < -1e-12) & (x[:, 0] > -s + 1e-9)
    groups = {"free": side, "held": lambda x: ~side(x)}
    bcs = {"free": js.condition(lambda u, x, n: stress(js.grad(u)(x)) @ n), "held": js.dirichlet(both)}
    pde = lambda u, x: shear * js.laplacian(u)(x) + (first + shear) * js.grad(js.divergence(u))(x)
    return _case("elastic notch, free sides", pde, both, _polygon(corners, groups), bcs, fields=2)


def thin(eps: float) -> Case:
    """A layer at either end of a line."""
    exact = lambda x: jnp.exp(-x[0] / eps) + 0.5 * jnp.exp((x[0] - 1.0) / eps) + jnp.cos(2 * x[0])
    source = lambda x: (1.0 + 4.0 * eps**2) * jnp.cos(2 * x[0])
    bcs = {"left": js.dirichlet(2.0), "right": js.dirichlet(0.5 + np.cos(2.0))}
    pde = lambda u, x: u(x) - eps**2 * js.laplacian(u)(x) - source(x)
    return _case(f"layers of {eps:.0e} on a line", pde, exact, _interval, bcs)


def _interval(spacing: Any) -> js.Cloud:
    return js.interval(0.0, 1.0, spacing=spacing)


def root(a: float = 0.3) -> Case:
    """x^0.3 on a line."""
    exact = lambda x: _power(x[0], a) + jnp.sin(3 * x[0])
    source = lambda x: a * (a - 1) * x[0] ** (a - 2) - 9.0 * jnp.sin(3 * x[0])
    bcs = {"left": js.dirichlet(0.0), "right": js.dirichlet(exact)}
    return _case("x^0.3 on a line", lambda u, x: js.laplacian(u)(x) - source(x), exact, _interval, bcs)


def line_kink() -> Case:
    """A source that jumps at 0.37 of a line, and a nonlinear term."""
    exact = lambda x: jnp.where(x[0] > 0.37, 1.0, -2.0) * (x[0] - 0.37) ** 2
    source = lambda x: jnp.where(x[0] > 0.37, 2.0, -4.0) - exact(x) ** 2
    bcs = {"left": js.dirichlet(exact), "right": js.dirichlet(exact)}
    return _case("jump on a line, nonlinear", lambda u, x: js.laplacian(u)(x) - u(x) ** 2 - source(x), exact, _interval,
                 bcs)  # fmt: skip


def line_layer(eps: float = 3e-5) -> Case:
    """Convection to the right on a line."""
    exact = lambda x: x[0] - jnp.exp((x[0] - 1.0) / eps)
    bcs = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    return _case("layer of 3e-5 on a line", lambda u, x: -eps * js.laplacian(u)(x) + js.grad(u)(x)[0] - 1.0, exact,
                 _interval, bcs)  # fmt: skip


def solid_peak() -> Case:
    exact = lambda x: jnp.exp(-60.0 * ((x[0] - 0.35) ** 2 + (x[1] - 0.6) ** 2 + (x[2] - 0.55) ** 2))
    make = lambda spacing: js.from_sdf(js.sdf.box((0.0,) * 3, (1.0,) * 3), ((0.0,) * 3, (1.0,) * 3), spacing)
    return _case("peak in a cube", lambda u, x: js.laplacian(u)(x) - _laplacian(exact)(x), exact, make)


STRANGERS: dict[str, Callable[[], Case]] = {
    "odd-corner": corner,
    "odd-mixed": mixed,
    "odd-kinked": kinked_data,
    "odd-front": moved_front,
    "odd-jump": jump,
    "odd-nonlinear": nonlinear,
    "odd-burgers": burgers,
    "odd-coupled": coupled,
    "odd-conductor": conductor,
    "odd-waves": waves,
    "odd-root": root,
    "odd-line-kink": line_kink,
    "odd-line-layer": line_layer,
    "odd-solid-peak": solid_peak,
    "notch": notch,
    "thin-6": lambda: thin(1e-6),
    "thin-8": lambda: thin(1e-8),
}
