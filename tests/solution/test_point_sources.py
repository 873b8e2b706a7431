"""Point sources: Green's functions, fundamental solutions against scipy's, gradients, and what is refused."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import k0, y0

import jsmitsm as js
from jsmitsm.equation.unknowns.point_source import Kelvin, Singular

DISK = js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.0, -1.0), (1.0, 1.0)), 0.15)
Y = np.array([0.31, -0.22])
SQUARE = js.rectangle((0.0, 0.0), (1.0, 1.0), (11, 11), jitter=0.2)
SIDES = ("left", "right", "top", "bottom")


def green(x):
    """Of the unit disk, by the image charge."""
    image = Y / (Y @ Y)
    away = lambda p: jnp.log(jnp.linalg.norm(x - p))
    return (away(Y) - jnp.log(jnp.linalg.norm(Y)) - away(image)) / (2 * jnp.pi)


def laplace(u, x):
    return js.laplacian(u)(x)


@pytest.mark.parametrize(
    "boundary",
    [
        js.dirichlet(0.0),
        js.robin(2.0, 1.0, lambda x: 3.0 * jax.grad(green)(x) @ x),
        js.condition(lambda u, x, n: u(x) * (1.0 + u(x) ** 2)),
    ],
    ids=["dirichlet", "robin", "nonlinear"],
)
def test_greens_function_of_the_disk(boundary):
    """At order 6 the regular part, a harmonic function with its pole at 2.6 radii, is right to 1e-7 of 3."""
    problem = js.Problem(laplace, {"boundary": boundary}, sources=[js.point_source(Y, 3.0)])
    sol = js.solve(problem, DISK, order=6)
    assert sol.converged and not sol.flags
    assert abs(sol.u - 3.0 * jax.vmap(green)(DISK.points)).max() < 1e-7
    points = np.array([[0.3, 0.4], [0.31, -0.2], [-0.9, 0.0]])
    assert abs(sol(points) - 3.0 * jax.vmap(green)(points)).max() < 1e-7
    slope = 3.0 * jax.vmap(jax.grad(green))(points)
    assert abs(sol.grad(points) / slope - 1.0).max() < 1e-6
    assert np.isnan(sol([[2.0, 0.0]])[0])
    assert abs(sol.flux("boundary") - 3.0) < 1e-5  # what the source gives leaves


def test_a_regular_part_of_round_off_is_no_flag():
    """With its own singular part for boundary values a source leaves nothing to solve for."""
    log = lambda x: 0.5 * jnp.log((x - Y) @ (x - Y)) / (2 * jnp.pi)  # noqa: E731
    own = js.dirichlet(jax.vmap(log)(DISK.points[DISK.groups["boundary"]]))
    for given, told in ((own, 0), (js.dirichlet(0.0), 1)):
        sol = js.solve(js.Problem(laplace, {"boundary": given}, sources=[js.point_source(Y)]), DISK, order=6)
        sol._found = ["rough"]
        assert len(sol.flags) == told


def test_a_source_survives_pickling_and_jit():
    problem = js.Problem(laplace, {"boundary": js.dirichlet(0.0)}, sources=[js.point_source(Y)])
    sol = js.solve(problem, DISK)
    again = pickle.loads(pickle.dumps(sol))
    assert abs(again(Y[None] + 0.1) - sol(Y[None] + 0.1)).max() < 1e-14
    assert abs(jax.tree.map(lambda v: v, sol).u - sol.u).max() == 0.0


def test_gradients_by_place_and_strength():
    """u(z) = s G(z, y): by s it is G, by y a derivative of the image formula."""
    z, ends = np.array([[-0.4, 0.3]]), {"boundary": js.dirichlet(0.0)}
    value = lambda y, s: js.solve(js.Problem(laplace, ends, sources=[js.point_source(y, s)]), DISK, order=6)(z)[0]
    by_place, by_strength = jax.grad(value, (0, 1))(jnp.asarray(Y), 2.0)
    assert abs(by_strength - green(z[0])) < 1e-7

    def exact(y):
        image = y / (y @ y)
        away = lambda p: jnp.log(jnp.linalg.norm(z[0] - p))
        return 2.0 * (away(y) - jnp.log(jnp.linalg.norm(y)) - away(image)) / (2 * jnp.pi)

    assert abs(by_place - jax.grad(exact)(jnp.asarray(Y))).max() < 1e-6


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_singular_parts_solve_the_equation(dim, m=9.0):
    """Away from the source (laplacian + m) is zero, and a unit flux leaves a small ball."""
    part = Singular(np.zeros((1, dim)), np.ones(1), 1.0, m)
    x = jnp.array([0.7, -0.4, 0.5])[:dim]
    rest = jax.jit(lambda x: jnp.trace(jax.hessian(part.at)(x)) + m * part.at(x))(x)
    assert abs(rest) < 1e-12
    near = 1e-4 * jnp.eye(dim)[0]
    strength = {1: 2.0, 2: 2 * jnp.pi * 1e-4, 3: 4 * jnp.pi * 1e-8}[dim] * jax.grad(part.at)(near)[0]
    assert abs(strength - 1.0) < 1e-5  # the flux out of a small ball


@pytest.mark.parametrize("c", [16.0, -16.0])
def test_helmholtz_and_screened_poisson(c):
    """2 (laplacian + c / 2 ...) with Y0(k r) / 8 and -K0(k r) / (4 pi) on the boundary: k^2 = |c| / 2."""
    place, k = np.array([0.43, 0.37]), np.sqrt(abs(c) / 2)
    radius = lambda x: np.linalg.norm(np.asarray(x) - place, axis=-1)
    exact = lambda x: y0(k * radius(x)) / 8 if c > 0 else -k0(k * radius(x)) / (4 * np.pi)
    bcs = {s: js.dirichlet(exact(SQUARE.points[SQUARE.groups[s]])) for s in SIDES}
    problem = js.Problem(
        lambda u, x: 2.0 * js.laplacian(u)(x) + c * u(x), bcs, sources=[js.point_source(place)]
    )
    sol = js.solve(problem, SQUARE, order=6)
    assert abs(sol.u - exact(SQUARE.points)).max() < 1e-6


def test_one_dimension_and_two_sources_beside_a_smooth_one():
    """u'' = 2 + delta(x - 0.33) - delta(x - 0.61) with ends held: polynomials by pieces."""
    line = js.interval(0.0, 1.0, 11)
    sources = [js.point_source([0.33]), js.point_source([0.61], -1.0)]
    hat = lambda x: jnp.maximum(x - 0.33, 0.0) - jnp.maximum(x - 0.61, 0.0)
    bcs = {"left": js.dirichlet(0.0), "right": js.neumann(2.0)}
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 2.0, bcs, sources=sources), line)
    x = line.points[:, 0]
    assert abs(sol.u - (x**2 + hat(x))).max() < 1e-12


@pytest.mark.parametrize("place", [0.47, 0.53])
def test_a_source_within_a_spacing_of_an_interface(place):
    """k u'' = delta on two layers held at zero, beside the place where they meet: piecewise linear."""
    k, cloud = {"a": 1.0, "b": 3.0}, js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.1)
    pde = {n: lambda u, x, c=c: c * js.laplacian(u)(x) for n, c in k.items()}
    flux = {n: lambda u, x, normal, c=c: c * normal @ js.grad(u)(x) for n, c in k.items()}
    bcs = {"boundary": js.dirichlet(0.0), "a|b": js.interface(flux)}
    sol = js.solve(js.Problem(pde, bcs, sources=[js.point_source([place], 1.0)]), cloud)
    left = place if place < 0.5 else 0.5 + (place - 0.5) / 3.0  # resistances to both ends
    whole = 0.5 + 0.5 / 3.0
    assert abs(sol([[place]])[0] + left * (whole - left) / whole) < 1e-12 and sol.flags == []


def test_what_is_refused():
    ends = {"boundary": js.dirichlet(0.0)}
    there = [js.point_source(Y)]
    refused = [
        (lambda u, x: js.divergence(lambda y: (1 + y[0] ** 2) * js.grad(u)(y))(x), there, "Gaussian"),
        (lambda u, x: js.laplacian(u)(x) + js.grad(u)(x)[0], there, "first, mixed or higher"),
        (lambda u, x: js.partial(u, (2, 0))(x) + 2 * js.partial(u, (0, 2))(x), there, "same in all directions"),
        (lambda u, x: js.laplacian(u)(x) - u(x) ** 2, there, "nonlinear"),
        (lambda u, x: js.laplacian(u)(x) + 400.0 * u(x), there, "as seen from x0.*Gaussian"),
        (laplace, [js.point_source([2.0, 0.0])], "outside of the domain"),
        (laplace, [js.point_source(DISK.points[DISK.groups["interior"][3]])], "where u is infinite"),
        (laplace, [js.point_source([0.1, 0.2, 0.3])], "3 coordinate"),
        (laplace, [3.0], r"sources\[0\]: expected js.point_source"),
    ]
    for pde, sources, told in refused:
        with pytest.raises(ValueError, match=told):
            js.solve(js.Problem(pde, ends, sources=sources), DISK)
    wrong = [("a", 1.0, "x0: expected one point"), ([np.nan], 1.0, "x0: NaN"), ([0.0], "b", "strength")]
    for x0, strength, told in wrong:
        with pytest.raises(ValueError, match=told):
            js.point_source(x0, strength)
    problem = js.Problem(laplace, ends, sources=there)
    sol = js.solve(problem, DISK)
    for ask in (sol.integral, lambda: sol.coefficients, lambda: js.factorize(problem, DISK)):
        with pytest.raises(ValueError, match="point source"):
            ask()


def test_kelvins_solution_in_plane_elasticity():
    """Tractions on one side and displacements on the others are those of a force and a polynomial: exact."""
    mu, lam, place, force = 1.3, 2.1, np.array([0.43, 0.37]), np.array([1.0, -0.5])
    part = Kelvin(place[None], force[None], mu, lam + mu)

    def stress(gradient):
        strain = (gradient + gradient.T) / 2
        return 2 * mu * strain + lam * jnp.trace(strain) * jnp.eye(2)

    exact = lambda x: part.at(x) + jnp.array([x[0] * x[1], x[0] ** 2 - x[1]])
    pde = lambda u, x: js.divergence(lambda y: stress(js.grad(u)(y)))(x) - jnp.array([0.0, 2 * mu + (lam + mu)])
    traction = js.condition(lambda u, x, n: (stress(js.grad(u)(x)) - stress(jax.jacfwd(exact)(x))) @ n)
    slope = lambda x: -jax.jacfwd(exact)(x)[1, 0]
    bcs = {"left": [js.dirichlet(lambda x: exact(x)[0], field=0), js.neumann(slope, field=1)], "right": traction,
           "top": js.dirichlet(exact), "bottom": js.dirichlet(exact)}  # fmt: skip
    problem = js.Problem(pde, bcs, fields=2, sources=[js.point_source(place, force)])
    sol = js.solve(problem, SQUARE)
    assert abs(sol.u - jax.vmap(exact)(SQUARE.points)).max() < 1e-11 and not sol.flags
    other = lambda u, x: pde(u, x) + u(x)
    with pytest.raises(ValueError, match="other terms than those of elasticity"):
        js.solve(js.Problem(other, bcs, fields=2, sources=[js.point_source(place, force)]), SQUARE)
    with pytest.raises(ValueError, match=r"strength of shape \(\), but \(2,\) is expected"):
        js.solve(js.Problem(pde, bcs, fields=2, sources=[js.point_source(place, 1.0)]), SQUARE)


@pytest.mark.parametrize("dim", [2, 3])
def test_kelvins_solution_balances_its_force(dim, a=1.3, b=3.4):
    """No residual away from the force, and tractions around it that sum to it."""
    force = np.array([1.0, -0.5, 0.3])[:dim]
    part = Kelvin(np.zeros((1, dim)), force[None], a, b)
    bent = jax.jit(jax.jacfwd(jax.jacfwd(part.at)))(jnp.array([0.7, -0.4, 0.5])[:dim])
    assert abs(a * jnp.einsum("ijj->i", bent) + b * jnp.einsum("jji->i", bent)).max() < 1e-12
    # a grad u + b div(u) I has the same divergence; on the sphere the design of the axes is exact for what is odd.
    angle = 2 * np.pi * np.arange(12) / 12
    if dim == 2:
        normals, weights = np.stack([np.cos(angle), np.sin(angle)], 1), np.full(12, 2 * np.pi / 12)
    else:
        z, w = np.polynomial.legendre.leggauss(6)
        ring = np.sqrt(1 - z**2)[:, None]
        normals = np.stack([ring * np.cos(angle), ring * np.sin(angle), z[:, None] + 0 * angle], -1).reshape(-1, 3)
        weights = np.repeat(w, 12) * 2 * np.pi / 12
    slope = jax.vmap(jax.jacfwd(part.at))(normals)
    pull = a * jnp.einsum("nij,nj->ni", slope, normals) + b * jnp.trace(slope, axis1=1, axis2=2)[:, None] * normals
    assert abs(weights @ pull - force).max() < 1e-12


@pytest.mark.parametrize(("distance", "told"), [(0.4, False), (0.06, True), (0.02, True), (0.005, True)])
def test_a_source_nearer_to_the_wall_than_its_particles_to_one_another_is_told(distance, told):
    disk = js.from_sdf(js.sdf.circle((0, 0), 1.0), ((-1, -1), (1, 1)), 0.12)
    sources = [js.point_source(np.array([1 - distance, 0.01]), 2 * np.pi)]
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": js.dirichlet(0.0)}, sources=sources)
    assert any("nearer to the boundary" in flag for flag in js.solve(problem, disk).flags) == told
