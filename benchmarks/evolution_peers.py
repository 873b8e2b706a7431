"""Other ways through the problems of ``benchmarks.evolution``: elements, finite differences, Fourier's."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.pencil.sparse import Sparse
from jsmitsm.evolution.space.system import System
from jsmitsm.evolution.steps.stepping import Stepper
from jsmitsm.evolution.steps.tableaux import KENCARP4

# --------------------------------------------------------------------------------------- elements


class Loads:
    """What drives elements: loads of a source at the points of a quadrature, and held values."""

    def __init__(self, sampling: Any, source: Any, held: Any, weights: Any, stiff_held: Any, mass_held: Any):
        self.sampling, self.source, self.held = sampling, source, held
        self.weights, self.stiff_held, self.mass_held = weights, stiff_held, mass_held

    def start(self, t: float) -> Any:
        return tuple(v[0] for v in self._at(np.array([t]), np.eye(1), np.zeros(1, int)))

    def step(self, t: float, h: float) -> Any:
        return self._at(t + h * self.sampling.nodes, self.sampling.blend, self.sampling.stages)

    def _at(self, times: np.ndarray, blend: np.ndarray, stages: np.ndarray) -> Any:
        known = np.stack([self.held(t) for t in times], axis=1)
        loads = self.weights @ np.stack([self.source(t) for t in times[stages]], axis=1)
        mixed = known @ blend.T
        return (loads - self.stiff_held @ mixed).T, (self.mass_held @ mixed).T, known[:, stages].T


def elements(refined: int, steps: int) -> tuple[int, float, float]:
    """Heat on the unit disk by isoparametric P2 elements: unknowns, largest error at the nodes, seconds."""
    import skfem
    from skfem.models.poisson import laplace, mass

    from benchmarks.evolution import source, warm

    values = jax.jit(jax.vmap(warm, (1, None)))
    driven = jax.jit(jax.vmap(source, (1, None)))
    mesh = skfem.MeshTri2.init_circle(refined)
    began = time.perf_counter()
    basis = skfem.Basis(mesh, skfem.ElementTriP2(), intorder=5)
    stiff, inert = (m.assemble(basis).tocsr() for m in (laplace, mass))
    held = basis.get_dofs().flatten()
    free = np.setdiff1d(np.arange(basis.N), held)
    x = np.asarray(basis.global_coordinates())
    places = x.reshape(2, -1)
    weights = _quadrature(basis)[free]
    part = lambda m, c: m[free][:, c].tocoo()  # noqa: E731
    plain = lambda m: Sparse(m.data, m.row, m.col, m.shape)  # noqa: E731
    at = basis.doflocs
    system = System(plain(part(stiff, free)), (plain(part(inert, free)),), at[:, free].T)
    drive = Loads(
        KENCARP4.sampling(True), lambda t: np.asarray(driven(places, t)), lambda t: np.asarray(values(at[:, held], t)),
        weights, part(stiff, held).tocsr(), part(inert, held).tocsr(),
    )  # fmt: skip
    stepper: Any = Stepper(system, drive, KENCARP4)
    step = stepper.first(np.asarray(values(at[:, free], 0.0)), 0.0)
    for k in range(steps):
        step = stepper.advance(step, k / steps, 1.0 / steps)
    spent = time.perf_counter() - began
    return len(free), float(np.abs(step.y - np.asarray(values(at[:, free], 1.0))).max()), spent


def _quadrature(basis: Any) -> Any:
    """The matrix (N, points) from a function's values at the points of the quadrature to its loads."""
    from scipy.sparse import csr_array

    cells, points = basis.dx.shape
    columns = np.arange(cells * points).reshape(cells, points)
    rows, cols, found = [], [], []
    for i in range(basis.Nbfun):
        phi = np.broadcast_to(np.asarray(basis.basis[i][0]), (cells, points))
        rows.append(np.broadcast_to(basis.element_dofs[i][:, None], (cells, points)).ravel())
        cols.append(columns.ravel())
        found.append((phi * basis.dx).ravel())
    return csr_array((np.concatenate(found), (np.concatenate(rows), np.concatenate(cols))),
                     shape=(basis.N, cells * points))  # fmt: skip


# --------------------------------------------------------------------------------------- Gray and Scott's equations


def spectral(start: Callable[[Any], Any], spread: Any, feed: float, kill: float, end: float, n: int = 128,
             steps: int = 1200) -> Callable[[np.ndarray], np.ndarray]:  # fmt: skip
    """A periodic unit square by Fourier's series and ETDRK4 (Kassam and Trefethen 2005), as a function of points."""
    grid = np.arange(n) / n
    x = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    fields = np.asarray(jax.vmap(start)(jnp.asarray(x))).T.reshape(2, n, n)
    k = 2 * np.pi * np.fft.fftfreq(n, 1 / n)
    square = k[:, None] ** 2 + k[None] ** 2
    linear = np.stack([-spread[0] * square - feed, -spread[1] * square - feed - kill])
    h = end / steps
    # Coefficients as means over a circle, where their formulas do not cancel.
    ring = np.exp(1j * np.pi * (np.arange(32) + 0.5) / 32)
    z = h * linear[..., None] + ring
    mean = lambda f: h * f.mean(axis=-1).real  # noqa: E731
    full, half = np.exp(h * linear), np.exp(h * linear / 2)
    q = mean((np.exp(z / 2) - 1) / z)
    f1 = mean((-4 - z + np.exp(z) * (4 - 3 * z + z**2)) / z**3)
    f2 = mean((2 + z + np.exp(z) * (z - 2)) / z**3)
    f3 = mean((-4 - 3 * z - z**2 + np.exp(z) * (4 - z)) / z**3)

    def rest(v: np.ndarray) -> np.ndarray:
        a, b = np.fft.ifft2(v).real
        eaten = a * b * b
        return np.fft.fft2(np.stack([feed - eaten, eaten]))

    v = np.fft.fft2(fields)
    for _ in range(steps):
        n0 = rest(v)
        a = half * v + q * n0
        na = rest(a)
        b = half * v + q * na
        nb = rest(b)
        c = half * a + q * (2 * nb - n0)
        v = full * v + f1 * n0 + 2 * f2 * (na + nb) + f3 * rest(c)

    def at(points: np.ndarray) -> np.ndarray:
        waves = [np.exp(1j * np.outer(points[:, d], k)) for d in range(2)]
        return np.einsum("pj,fjk,pk->pf", waves[0], v / n**2, waves[1], optimize=True).real

    return at


def differences(start: Callable[[Any], Any], spread: Any, feed: float, kill: float, end: float, n: int,
                exact: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float, int] | None:  # fmt: skip
    """The same by py-pde: largest error at the cells' centres, seconds, steps; None where it is not installed."""
    try:
        import pde
    except ImportError:
        print("py-pde is not installed: its lines are left out")
        return None
    grid = pde.CartesianGrid([[0, 1], [0, 1]], [n, n], periodic=True)
    centres = grid.cell_coords.reshape(-1, 2)
    fields = np.asarray(jax.vmap(start)(jnp.asarray(centres))).T.reshape(2, n, n)
    state = pde.FieldCollection([pde.ScalarField(grid, f) for f in fields])
    rhs = pde.PDE({
        "a": f"{spread[0]} * laplace(a) - a * b**2 + {feed} * (1 - a)",
        "b": f"{spread[1]} * laplace(b) + a * b**2 - {feed + kill} * b",
    })  # fmt: skip
    began = time.perf_counter()
    found, told = rhs.solve(state, end, dt=0.1, solver="runge-kutta", adaptive=True, tolerance=1e-5, tracker=None,
                            ret_info=True)  # fmt: skip
    spent = time.perf_counter() - began
    error = np.abs(np.stack([f.data.reshape(-1) for f in found], axis=1) - exact(centres)).max()
    return float(error), spent, int(told["solver"]["steps"])


def heated_grid(warm: Any, source: Any, n: int) -> tuple[float, float, int] | None:
    """Heat on the unit square with Dirichlet data in time by py-pde: what ``differences`` returns.

    Of py-pde's steppers the explicit one with adaptive steps; the data of the boundary are expressions of x, y, t.
    """
    try:
        import pde
    except ImportError:
        print("py-pde is not installed: its lines are left out")
        return None
    grid = pde.CartesianGrid([[0, 1], [0, 1]], [n, n])
    centres = grid.cell_coords.reshape(-1, 2)
    start = np.asarray(jax.vmap(lambda x: warm(x, 0.0))(jnp.asarray(centres))).reshape(n, n)
    answer = "exp(x - t / 2) * sin(2 * y + t)"
    rhs = pde.PDE({"u": f"laplace(u) + 2.5 * {answer} + exp(x - t / 2) * cos(2 * y + t)"},
                  bc={side: {"value_expression": answer} for side in ("x-", "x+", "y-", "y+")})  # fmt: skip
    at = jnp.asarray(centres)
    made = np.asarray(jax.vmap(lambda x: source(x, 0.3))(at))
    said = np.asarray(jax.vmap(lambda x: 2.5 * warm(x, 0.3) + jnp.exp(x[0] - 0.15) * jnp.cos(2 * x[1] + 0.3))(at))
    assert np.abs(made - said).max() < 1e-12  # the expression is the source
    began = time.perf_counter()
    found, told = rhs.solve(pde.ScalarField(grid, start), 1.0, dt=1e-4, solver="runge-kutta", adaptive=True,
                            tolerance=1e-6, tracker=None, ret_info=True)  # fmt: skip
    spent = time.perf_counter() - began
    exact = np.asarray(jax.vmap(lambda x: warm(x, 1.0))(at))
    return float(np.abs(found.data.reshape(-1) - exact).max()), spent, int(told["solver"]["steps"])


# --------------------------------------------------------------------------------------- a cavity's start


def started_cavity(nu: float, end: float, degree: int = 16) -> Callable[[np.ndarray], np.ndarray]:
    """Velocities (N, 2) of fluid at rest in the unit square at t = end, its lid moving with 16 x^2 (1 - x)^2 from 0 on.

    The stream function psi = lid(x) y^2 (y - 1) + sum c_ij f_i(x) f_j(y), f_k clamped polynomials, by Galerkin's
    method: int grad psi_t . grad f = -int nu lap psi lap f - int lap psi (psi_y f_x - psi_x f_y).
    """
    from numpy.polynomial import Polynomial
    from numpy.polynomial.legendre import Legendre, leggauss
    from scipy.integrate import solve_ivp
    from scipy.linalg import cho_factor, cho_solve

    s, w = leggauss(2 * degree + 8)
    s, w = (s + 1) / 2, w / 2
    clamped = Polynomial([0, 0, 16, -32, 16])  # 16 s^2 (1 - s)^2
    basis = [clamped * Legendre.basis(k, domain=[0, 1]).convert(kind=Polynomial, domain=[-1, 1]) for k in range(degree)]
    lift = Polynomial([0, 0, -1, 1])

    def at(polynomials: list[Any], points: np.ndarray) -> list[np.ndarray]:
        """Values, first and second derivatives (points, k)."""
        return [np.stack([p.deriv(m)(points) if m else p(points) for p in polynomials], axis=1) for m in range(3)]

    f, lid, rise = at(basis, s), [v[:, 0] for v in at([clamped], s)], [v[:, 0] for v in at([lift], s)]
    weight = np.outer(w, w)

    def field(c: np.ndarray, a: int, b: int) -> np.ndarray:
        return f[a] @ c @ f[b].T + np.outer(lid[a], rise[b])

    def tested(values: np.ndarray, a: int, b: int) -> np.ndarray:
        return f[a].T @ (weight * values) @ f[b]

    one, two = (f[m].T @ (w[:, None] * f[m]) for m in (0, 1))
    mass = cho_factor(np.kron(two, one) + np.kron(one, two))

    def rate(_: float, flat: np.ndarray) -> np.ndarray:
        c = flat.reshape(degree, degree)
        lap = field(c, 2, 0) + field(c, 0, 2)
        along, across = field(c, 0, 1), field(c, 1, 0)
        r = -nu * (tested(lap, 2, 0) + tested(lap, 0, 2)) - tested(lap * along, 1, 0) + tested(lap * across, 0, 1)
        return cho_solve(mass, r.reshape(-1))

    still = np.zeros((degree, degree))
    start = -cho_solve(mass, (tested(field(still, 1, 0), 1, 0) + tested(field(still, 0, 1), 0, 1)).reshape(-1))
    c = solve_ivp(rate, (0.0, end), start, method="BDF", rtol=1e-9, atol=1e-11).y[:, -1].reshape(degree, degree)

    def velocity(points: np.ndarray) -> np.ndarray:
        (x0, x1, _), (y0, y1, _) = (at(basis, points[:, k]) for k in range(2))
        g, h = at([clamped], points[:, 0]), at([lift], points[:, 1])
        along = np.einsum("pi,ij,pj->p", x0, c, y1, optimize=True) + (g[0] * h[1])[:, 0]
        across = np.einsum("pi,ij,pj->p", x1, c, y0, optimize=True) + (g[1] * h[0])[:, 0]
        return np.stack([along, -across], axis=1)

    return velocity
