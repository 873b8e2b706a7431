"""The pencil A u = B f + Bg g: exact on polynomials, stable in time, differentiable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jsmitsm as js
from jsmitsm.discretization.pencil import grades
from jsmitsm.discretization.pencil.assemble import assemble_pencil

SIDES = ("left", "right", "bottom", "top")
D, N, R = js.dirichlet(0.0), js.neumann(0.0), js.robin(1.0, 1.0, 0.0)


def square(kind, n=16, seed=0):
    """A unit square: the boundary of a lattice, and inside jittered, Halton's or random particles."""
    cloud = js.rectangle((0, 0), (1, 1), (n, n), jitter=0.3 if kind == "jittered" else 0.0, seed=seed)
    points, inside = np.array(cloud.points), cloud.groups["interior"]
    if kind == "halton":
        points[inside] = 0.02 + 0.96 * scipy.stats.qmc.Halton(2, scramble=False).random(len(inside) + 20)[20:]
    if kind == "random":
        points[inside] = 0.01 + 0.98 * np.random.default_rng(seed).uniform(size=(len(inside), 2))
    return js.Cloud(points, cloud.groups, cloud.normals)


def misfit(pencil, u, f):
    """The largest entry of A u - B f - Bg g."""
    return float(np.abs(pencil.A.times(u) - pencil.B.times(f) - pencil.Bg.times(pencil.conditions)).max())


def test_exact_on_polynomials_with_every_condition():
    """Where f = L u has degree p - 2 the fit of the source reproduces it: here both are of degree 2."""

    def u(x):
        return x[0] ** 2 - 2 * x[0] * x[1] + 3 * x[1] ** 2 + x[0]

    def operator(u, x):
        return js.laplacian(u)(x) + (1 + x[0]) * js.grad(u)(x)[1] - 2 * u(x)

    def f(x):
        d2, d1 = jax.hessian(u)(x), jax.grad(u)(x)
        return d2[0, 0] + d2[1, 1] + (1 + x[0]) * d1[1] - 2 * u(x)

    def slope(x):  # on the right side
        return jax.grad(u)(x)[0]

    cloud = square("random", 11, 3)
    bcs = {"left": js.dirichlet(u), "right": js.neumann(slope), "bottom": js.dirichlet(u),
           "top": js.robin(2.0, 1.0, lambda x: 2 * u(x) + jax.grad(u)(x)[1])}  # fmt: skip
    pencil = assemble_pencil(js.Problem(operator, bcs), cloud, order=4)
    values, sources = (np.asarray(jax.vmap(g)(cloud.points)) for g in (u, f))
    assert misfit(pencil, values, sources) < 1e-11  # rounding; a term left out is 1e-2 and more
    assert abs(pencil.held_values[pencil.held, 0] - values[pencil.held]).max() < 1e-15
    assert misfit(pencil, values, sources + 1e-6) > 1e-9


@pytest.mark.parametrize("dim", [1, 3])
def test_exact_on_polynomials_in_line_and_space(dim):
    cloud = js.interval(0.0, 1.0, 21) if dim == 1 else js.box((0,) * 3, (1,) * 3, (6, 6, 6), jitter=0.2)

    def u(x):
        return x[0] ** 4 + x[-1] ** 3 * x[0] - x.sum()

    ends = {name: js.dirichlet(u) for name in cloud.groups if name != "interior"}
    pencil = assemble_pencil(js.Problem(lambda u, x: -js.laplacian(u)(x), ends), cloud, order=4)
    f = jax.vmap(lambda x: -jnp.trace(jax.hessian(u)(x)))(cloud.points)
    assert misfit(pencil, np.asarray(jax.vmap(u)(cloud.points)), np.asarray(f)) < 1e-11


def test_exact_for_a_system_whose_equations_mix_the_sources():
    """Heat and stress: the field of one equation is in the other, and a side holds one field of two."""

    def u(x):
        return jnp.stack([x[0] ** 2 - x[1] * x[0], x[0] * x[1] - 2 * x[1] ** 2])

    def operator(u, x):
        return jnp.stack([js.laplacian(u[0])(x) + js.grad(u[1])(x)[0], 2 * js.laplacian(u[1])(x) - u(x)[0]])

    def f(x):
        d2, d1 = jax.hessian(u)(x), jax.jacfwd(u)(x)
        trace = d2[:, 0, 0] + d2[:, 1, 1]
        return jnp.stack([trace[0] + d1[1, 0], 2 * trace[1] - u(x)[0]])

    cloud = square("jittered", 11)
    right = [js.dirichlet(lambda x: u(x)[0], field=0), js.neumann(lambda x: jax.jacfwd(u)(x)[1, 0], field=1)]
    bcs = {**dict.fromkeys(SIDES, js.dirichlet(u)), "right": right}
    pencil = assemble_pencil(js.Problem(operator, bcs, fields=2), cloud, order=4)
    values, sources = (np.asarray(jax.vmap(g)(cloud.points)).reshape(-1) for g in (u, f))
    assert misfit(pencil, values, sources) < 1e-11


def test_particles_that_follow_their_neighbours_do_so_exactly(monkeypatch):
    """On polynomials of degree p; a source has no weight in their rows."""
    monkeypatch.setattr(grades, "HOPELESS", 1.0)
    monkeypatch.setitem(grades.DOMINANCE, 2, 0.3)
    cloud = square("random", 11, 1)

    def u(x):
        return x[0] ** 2 - 3 * x[1] * x[0] ** 3

    problem = js.Problem(lambda u, x: js.laplacian(u)(x), dict.fromkeys(SIDES, js.dirichlet(u)))
    pencil = assemble_pencil(problem, cloud, order=4)
    assert len(pencil.slaved) > 3 and "follow their neighbours" in " ".join(pencil.health)
    assert not np.isin(pencil.B.rows, pencil.slaved).any()
    f = np.asarray(jax.vmap(lambda x: jnp.trace(jax.hessian(u)(x)))(cloud.points))
    assert misfit(pencil, np.asarray(jax.vmap(u)(cloud.points)), f) < 1e-11


def growth(pencil):
    """The largest real part of the eigenvalues of B^-1 A, particles that follow their neighbours eliminated."""
    a, b = (m.host.toarray()[np.ix_(pencil.free, pencil.free)] for m in (pencil.A, pencil.B))
    slaved = np.isin(pencil.free, pencil.slaved)
    own = ~slaved
    extended = np.zeros((len(own), own.sum()))
    extended[own] = np.eye(own.sum())
    extended[slaved] = -np.linalg.solve(a[np.ix_(slaved, slaved)], a[np.ix_(slaved, own)])
    return np.linalg.eigvals(np.linalg.solve((b @ extended)[own], (a @ extended)[own])).real.max()


@pytest.mark.parametrize(
    "kind, seed, order, bcs",
    [
        ("halton", 0, 6, dict.fromkeys(SIDES, R)),
        ("random", 0, 4, dict.fromkeys(SIDES, N)),
        ("random", 1, 4, dict.fromkeys(SIDES, D)),
    ],
)
def test_no_mode_of_diffusion_grows(kind, seed, order, bcs):
    """Zero is a value where nothing holds u, and 1e-6 its rounding. All cases: benchmarks/modes.py."""
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), bcs)
    assert growth(assemble_pencil(problem, square(kind, seed=seed), order=order)) < 1e-6


def test_without_the_repair_modes_of_a_random_cloud_grow(monkeypatch):
    monkeypatch.setattr(grades, "_TRIALS", ())
    monkeypatch.setattr(grades, "HOPELESS", np.inf)
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), dict.fromkeys(SIDES, D))
    assert growth(assemble_pencil(problem, square("random", seed=1), order=4)) > 1.0
