"""Problems for adaptive methods: W. F. Mitchell, A collection of 2D elliptic problems for testing adaptive grid
refinement algorithms, Appl. Math. Comput. 220 (2013), with their published parameters, and some in 1D and 3D.

The solution of the battery is known at some points (:mod:`benchmarks.battery`). A slit of 2 pi is opened by a hair. The
intersecting interfaces are taken with r^0.5 besides the published r^0.1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks import battery

UNIT = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
SQUARE = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
# Half the angle that is cut out of a plane with a slit.
HAIR = 0.005


class Case(NamedTuple):
    """A problem with its domain and the exact solution.

    operator: diffusion, wind and reaction (a function, None without one) of scalar problems other than Poisson's, for
    who states it in another form; homogeneous: without a source. quantity, number: what the tolerance is on instead
    of the solution, and its exact value. known: points and values of a solution without a formula.
    """

    name: str
    problem: js.Problem
    make: Callable[[Any], js.Cloud]
    exact: Callable[[Any], Any]
    polygon: tuple[tuple[float, float], ...] | None = None
    operator: tuple[float, tuple[float, float], Any] | None = None
    homogeneous: bool = False
    quantity: Callable[[js.Solution], Any] | None = None
    number: float | None = None
    known: tuple[np.ndarray, np.ndarray] | None = None


def _polygon(name: str, polygon: Any, exact: Any, pde: Any, fields: int = 1) -> Case:
    problem = js.Problem(pde, {"boundary": js.dirichlet(exact)}, fields=fields)
    return Case(name, problem, lambda spacing: js.from_polygon(polygon, spacing), exact, tuple(map(tuple, polygon)))


def _poisson(name: str, polygon: Any, exact: Any) -> Case:
    source = lambda x: jnp.trace(jax.hessian(exact)(x))
    return _polygon(name, polygon, exact, lambda u, x: js.laplacian(u)(x) - source(x))


def analytic(p: int = 10) -> Case:
    return _poisson(
        "analytic", UNIT, lambda x: 2.0 ** (4 * p) * (x[0] * (1 - x[0])) ** p * (x[1] * (1 - x[1])) ** p
    )


def sector(angle: float) -> list[tuple[float, float]]:
    """The square without what lies beyond the angle, seen from its middle."""
    corners = [(1, 1), (-1, 1), (-1, -1), (1, -1)]
    kept = [c for c in corners if np.arctan2(c[1], c[0]) % (2 * np.pi) < angle - 1e-9]
    end = np.array([np.cos(angle), np.sin(angle)])
    end = end / np.abs(end).max()
    if kept and np.allclose(end, kept[-1]):
        kept = kept[:-1]
    return [(0.0, 0.0), (1.0, 0.0), *kept, tuple(end)]


def polar(x: Any, cut: float) -> tuple[Any, Any]:
    """Radius and angle from 0; the jump of the angle lies at ``cut``, outside of the domain."""
    square = x[0] ** 2 + x[1] ** 2
    middle = square == 0
    safe = jnp.where(middle, 1.0, square)
    angle = jnp.arctan2(jnp.where(middle, 0.0, x[1]), jnp.where(middle, 1.0, x[0]))
    angle = jnp.where(angle < cut - 2 * np.pi, angle + 2 * np.pi, angle)
    return jnp.where(middle, 0.0, jnp.sqrt(safe)), angle


def reentrant(angle: float, name: str) -> Case:
    """r^a sin(a t) at a corner of this angle, a = pi / angle."""
    angle = min(angle, 2 * np.pi - 2 * HAIR)
    a, cut = np.pi / angle, angle / 2 + np.pi

    def exact(x):
        r, t = polar(x, cut)
        return jnp.where(r > 0, jnp.where(r > 0, r, 1.0) ** a * jnp.sin(a * t), 0.0)

    case = _polygon(f"reentrant corner, {name}", sector(angle), exact, lambda u, x: js.laplacian(u)(x))
    return case._replace(homogeneous=True)


def elastic(mode: int) -> Case:
    """A crack: two equations with a mixed derivative, E = 1, nu = 0.3, plane strain."""
    nu, modulus = 0.3, 1.0
    exponent, q = {1: (0.5444837367825, 0.5430755788367), 2: (0.9085291898461, -0.2189232362488)}[mode]
    kappa, shear, angle = 3.0 - 4.0 * nu, modulus / (2 * (1 + nu)), 2 * np.pi - 2 * HAIR
    cut = angle / 2 + np.pi

    def exact(x):
        r, t = polar(x, cut)
        s = jnp.where(r > 0, jnp.where(r > 0, r, 1.0) ** exponent, 0.0) / (2 * shear)
        a, b = exponent * t, (exponent - 2) * t
        if mode == 1:
            one = (kappa - q * (exponent + 1)) * jnp.cos(a) - exponent * jnp.cos(b)
            two = (kappa + q * (exponent + 1)) * jnp.sin(a) + exponent * jnp.sin(b)
        else:
            one = (kappa - q * (exponent + 1)) * jnp.sin(a) - exponent * jnp.sin(b)
            two = -(kappa + q * (exponent + 1)) * jnp.cos(a) - exponent * jnp.cos(b)
        return s * jnp.stack([one, two])

    def pde(u, x):
        dilatation = 1.0 / (1.0 - 2.0 * nu)
        mixed = js.partial(u[0], (1, 1))(x), js.partial(u[1], (1, 1))(x)
        return (
            js.laplacian(u[0])(x) + dilatation * (js.partial(u[0], (2, 0))(x) + mixed[1]),
            js.laplacian(u[1])(x) + dilatation * (mixed[0] + js.partial(u[1], (0, 2))(x)),
        )

    return _polygon(f"elasticity, mode {mode}", sector(angle), exact, pde, fields=2)


def peak(a: float, centre: tuple[float, float]) -> Case:
    return _poisson(
        f"peak, {a:.0e}", UNIT, lambda x: jnp.exp(-a * ((x[0] - centre[0]) ** 2 + (x[1] - centre[1]) ** 2))
    )


def layer(eps: float) -> Case:
    def exact(x):
        decay = (1 - jnp.exp(-(1 - x[0]) / eps)) * (1 - jnp.exp(-(1 - x[1]) / eps))
        return decay * jnp.cos(np.pi * (x[0] + x[1]))

    def pde(u, x):
        known = jax.grad(exact)(x)
        source = -eps * jnp.trace(jax.hessian(exact)(x)) + 2 * known[0] + known[1]
        slope = js.grad(u)(x)
        return -eps * js.laplacian(u)(x) + 2 * slope[0] + slope[1] - source

    return _polygon(f"boundary layer, {eps:.0e}", SQUARE, exact, pde)._replace(operator=(eps, (2.0, 1.0), None))


def line(a: float = 0.6) -> Case:
    """x^a on the unit square, singular along a side."""
    exact = lambda x: jnp.where(x[0] > 0, jnp.where(x[0] > 0, x[0], 1.0) ** a, 0.0)
    return _polygon(
        "boundary line singularity", UNIT, exact, lambda u, x: js.laplacian(u)(x) - a * (a - 1) * x[0] ** (a - 2)
    )


def oscillatory(count: int) -> Case:
    a = 1.0 / (count * np.pi)

    def exact(x):
        return jnp.sin(1.0 / (a + jnp.sqrt(x[0] ** 2 + x[1] ** 2)))

    def known(x):  # -laplacian(exact) - exact / (a + r)^4, in which the largest terms cancel
        r = jnp.sqrt(x[0] ** 2 + x[1] ** 2)
        s = a + r
        return jnp.cos(1.0 / s) * (1.0 / (r * s**2) - 2.0 / s**3)

    def pde(u, x):
        r = jnp.sqrt(x[0] ** 2 + x[1] ** 2)
        return -js.laplacian(u)(x) - u(x) / (a + r) ** 4 - known(x)

    reaction = lambda x: -1.0 / (a + jnp.sqrt(x[0] ** 2 + x[1] ** 2)) ** 4
    case = _polygon(f"oscillatory, 1/({count} pi)", UNIT, exact, pde)
    return case._replace(operator=(1.0, (0.0, 0.0), reaction))


def front(a: float, centre: tuple[float, float], radius: float, name: str) -> Case:
    def exact(x):
        return jnp.arctan(a * (jnp.sqrt((x[0] - centre[0]) ** 2 + (x[1] - centre[1]) ** 2) - radius))

    return _poisson(f"wave front, {name}", UNIT, exact)


def interior_line(a: float = 2.5, b: float = 0.6) -> Case:
    def exact(x):
        s = x[0] - b * (x[1] + 1)
        return jnp.cos(np.pi * x[1] / 2) + jnp.where(s > 0, jnp.where(s > 0, s, 1.0) ** a, 0.0)

    def pde(u, x):
        s = x[0] - b * (x[1] + 1)
        bent = jnp.where(s > 0, a * (a - 1) * jnp.where(s > 0, s, 1.0) ** (a - 2) * (1 + b * b), 0.0)
        return js.laplacian(u)(x) + np.pi**2 / 4 * jnp.cos(np.pi * x[1] / 2) - bent

    return _polygon("interior line singularity", SQUARE, exact, pde)


def several() -> Case:
    """A corner, a peak, a front and a boundary layer at once."""
    angle, cut = 1.5 * np.pi, 1.75 * np.pi
    a = np.pi / angle

    def smooth(x):
        front = jnp.arctan(200.0 * (jnp.sqrt(x[0] ** 2 + (x[1] + 0.75) ** 2) - 0.75))
        peak = jnp.exp(-1000.0 * ((x[0] + np.sqrt(5) / 4) ** 2 + (x[1] + 0.25) ** 2))
        return front + peak + jnp.exp(-(1 + x[1]) / 0.01)

    def exact(x):
        r, t = polar(x, cut)
        return jnp.where(r > 0, jnp.where(r > 0, r, 1.0) ** a * jnp.sin(a * t), 0.0) + smooth(x)

    polygon = sector(angle)
    return _polygon(
        "several difficulties", polygon, exact, lambda u, x: js.laplacian(u)(x) - jnp.trace(jax.hessian(smooth)(x))
    )


# Exponent, ratio of the materials and the angle that belongs to them, for interfaces that cross at right angles.
KELLOGG = {0.1: (161.4476387975881, -14.92256510455152), 0.5: (5.828427124746191, -2.356194490192345)}


def crossing(a: float) -> Case:
    """r^a m(t) about a point where four materials meet, of which those across from one another are the same."""
    ratio, sigma = KELLOGG[a]
    rho = np.pi / 4

    def exact(x):
        r, t = polar(x, 2 * np.pi)
        quarter = np.pi / 2
        parts = [
            jnp.cos((quarter - sigma) * a) * jnp.cos((t - quarter + rho) * a),
            jnp.cos(rho * a) * jnp.cos((t - np.pi + sigma) * a),
            jnp.cos(sigma * a) * jnp.cos((t - np.pi - rho) * a),
            jnp.cos((quarter - rho) * a) * jnp.cos((t - 3 * quarter - sigma) * a),
        ]
        turned = jnp.clip((t / quarter).astype(int), 0, 3)
        return jnp.where(r > 0, jnp.where(r > 0, r, 1.0) ** a * jnp.stack(parts)[turned], 0.0)

    unit = np.array(UNIT)
    shapes = {"ne": unit, "nw": unit - [1, 0], "sw": unit - 1, "se": unit - [0, 1]}
    k = {"ne": ratio, "nw": 1.0, "sw": ratio, "se": 1.0}
    flux = {name: lambda u, x, n, k=k[name]: k * n @ js.grad(u)(x) for name in k}
    meet = {"|".join(pair): js.interface(flux={name: flux[name] for name in pair})
            for pair in (("ne", "nw"), ("nw", "sw"), ("sw", "se"), ("ne", "se"))}  # fmt: skip
    equations = {name: lambda u, x: js.laplacian(u)(x) for name in k}
    problem = js.Problem(equations, {"boundary": js.dirichlet(exact), **meet})
    make = lambda spacing: js.regions(shapes, spacing=spacing)
    return Case(f"intersecting interfaces, r^{a}", problem, make, exact)


def thermal_battery() -> Case:
    return Case("battery", battery.problem(), battery.make, None, known=battery.known())


def point_value() -> Case:
    """The corner of 3 pi / 2 again, for one value beside it."""
    case, at = reentrant(1.5 * np.pi, "3 pi / 2"), np.array([-0.1, 0.1])
    return case._replace(
        name="value beside the corner", quantity=lambda sol: sol(at[None])[0], number=float(case.exact(jnp.asarray(at)))
    )


def capacitor(radius: float = 0.25, away: float = 0.4) -> Case:
    """Two circles, one in the other: the flux between them is 2 pi / arcosh((1 + r^2 - d^2) / 2 r)."""
    shape = js.sdf.difference(js.sdf.circle((0.0, 0.0), 1.0), js.sdf.circle((away, 0.0), radius))
    inner = lambda x: np.hypot(x[:, 0] - away, x[:, 1]) < 1.2 * radius
    groups = {"inner": inner, "outer": lambda x: ~inner(x)}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), {"inner": js.dirichlet(1.0), "outer": js.dirichlet(0.0)})
    number = 2 * np.pi / np.arccosh((1 + radius**2 - away**2) / (2 * radius))
    make = lambda spacing: js.from_sdf(shape, ((-1.0, -1.0), (1.0, 1.0)), spacing, groups=groups)
    return Case("flux between circles", problem, make, None, quantity=lambda sol: sol.flux("inner"), number=number)


def kirsch() -> Case:
    """A plate with a hole under tension: the stress beside the hole is three times that far away."""

    def exact(x):  # both Lame constants are 1
        r, t = jnp.hypot(*x), jnp.arctan2(x[1], x[0])
        once, twice, sides = jnp.array([[3.0, -1.0]] * 2 + [[1.0, 1.0]])
        c, c3 = jnp.stack([jnp.cos(t), jnp.sin(t)]), jnp.stack([jnp.cos(3 * t), jnp.sin(3 * t)])
        return (r * once * c + 2 / r * (twice * c + sides * c3) - 2 / r**3 * c3) / 8

    stress = lambda slope: jnp.trace(slope) * jnp.eye(2) + slope + slope.T
    shape = js.sdf.difference(js.sdf.circle((0.0, 0.0), 3.0), js.sdf.circle((0.0, 0.0), 1.0))
    near = lambda x: np.hypot(*x.T) < 2
    groups = {"hole": near, "far": lambda x: ~near(x)}
    free = js.condition(lambda u, x, n: stress(js.grad(u)(x)) @ n)
    pde = lambda u, x: js.laplacian(u)(x) + 2 * js.grad(js.divergence(u))(x)
    problem = js.Problem(pde, {"hole": free, "far": js.dirichlet(exact)}, fields=2)
    make = lambda spacing: js.from_sdf(shape, ((-3.0, -3.0), (3.0, 3.0)), spacing, groups=groups)
    beside = lambda sol: stress(sol.grad(np.array([[0.0, 1.0]]))[0])[0, 0]
    return Case("stress beside a hole (Kirsch)", problem, make, exact, quantity=beside, number=3.0)


def _solid(name: str, shape: Any, exact: Any, source: Any) -> Case:
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - source(x), {"boundary": js.dirichlet(exact)})
    make = lambda spacing: js.from_sdf(shape, ((-1.0,) * 3, (1.0,) * 3), spacing)
    return Case(name, problem, make, exact)


def fichera(a: float = 0.5) -> Case:
    """|x|^a where one of eight cubes is missing."""
    shape = js.sdf.difference(js.sdf.box((-1.0,) * 3, (1.0,) * 3), js.sdf.box((0.0,) * 3, (2.0,) * 3))
    radius = lambda x: jnp.sqrt(jnp.where(x @ x > 0, x @ x, 1.0))
    exact = lambda x: jnp.where(x @ x > 0, radius(x) ** a, 0.0)
    return _solid("corner of a solid (Fichera)", shape, exact, lambda x: a * (a + 1) * radius(x) ** (a - 2))


def edge() -> Case:
    """The reentrant corner of 3 pi / 2, drawn out to an edge."""
    shape = js.sdf.difference(js.sdf.box((-1.0,) * 3, (1.0,) * 3), js.sdf.box((0.0, -2.0, -2.0), (2.0, 0.0, 2.0)))
    return _solid("edge of a solid", shape, reentrant(1.5 * np.pi, "").exact, lambda x: 0.0)


CASES: dict[str, Callable[[], Case]] = {
    "analytic": analytic,
    "corner-180": lambda: reentrant(np.pi + 0.01, "pi + 0.01"),
    "corner-270": lambda: reentrant(1.5 * np.pi, "3 pi / 2"),
    "corner-360": lambda: reentrant(2 * np.pi, "2 pi"),
    "elastic-1": lambda: elastic(1),
    "elastic-2": lambda: elastic(2),
    "battery": thermal_battery,
    "peak-3": lambda: peak(1e3, (0.5, 0.5)),
    "peak-5": lambda: peak(1e5, (0.51, 0.117)),
    "layer-1": lambda: layer(1e-1),
    "layer-3": lambda: layer(1e-3),
    "line": line,
    "oscillatory-10": lambda: oscillatory(10),
    "oscillatory-50": lambda: oscillatory(50),
    "front-20": lambda: front(20.0, (-0.05, -0.05), 0.7, "mild"),
    "front-1000": lambda: front(1000.0, (-0.05, -0.05), 0.7, "steep"),
    "front-asymmetric": lambda: front(1000.0, (1.5, 0.25), 0.92, "asymmetric"),
    "front-well": lambda: front(50.0, (0.5, 0.5), 0.25, "well"),
    "interior-line": interior_line,
    "several": several,
    "crossing-5": lambda: crossing(0.5),
    "crossing-1": lambda: crossing(0.1),
    "point": point_value,
    "flux": capacitor,
    "kirsch": kirsch,
    "fichera": fichera,
    "edge": edge,
}
