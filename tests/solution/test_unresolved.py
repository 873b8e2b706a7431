"""What the cloud does not resolve is flagged in every class of problems, and what it resolves is not.

Each exact solution is known: a conductivity k that steps along one direction has u' = c / k, a conductivity k(u) makes
the integral of k linear. Errors are relative, in the L2 norm over the particles.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js

SIDES = ("left", "right", "bottom", "top")
FINE = np.linspace(0.0, 1.0, 40001)


def away(sol, exact):
    return np.linalg.norm(sol.u - exact) / np.linalg.norm(exact)


def step(width, at=0.5123, low=1.0, high=100.0, xp=jnp):
    return lambda s: low + 0.5 * (high - low) * (1.0 + xp.tanh((s - at) / width))


def primitive(f, x):
    """The integral of f from 0 over that from 0 to 1, by the trapezoidal rule on a fine line."""
    values = f(FINE)
    sums = np.concatenate([[0.0], np.cumsum(values[1:] + values[:-1])])
    return np.interp(x, FINE, sums / sums[-1])


def laminate(width, n, dim, aspect=0.0, **options):
    """div(K grad u) = 0 with K = k(x) (I + aspect e e'), e = (0, 1) the direction in which nothing happens."""
    k = step(width)
    line = jnp.asarray(np.append(FINE, 2.0))  # a table for the values on the sides
    exact = primitive(lambda s: 1.0 / step(width, xp=np)(s), FINE)
    side = lambda x: jnp.interp(x[0], line, jnp.asarray(np.append(exact, 1.0)))
    across = np.eye(dim)[-1]
    flow = lambda u: lambda y: k(y[0]) * (js.grad(u)(y) + aspect * across * js.grad(u)(y)[-1])
    cloud = js.interval(0.0, 1.0, n) if dim == 1 else js.rectangle((0, 0), (1, 1), (n, 9))
    held = {g: js.dirichlet(side) for g in SIDES[: 2 * dim]}
    sol = js.solve(js.Problem(lambda u, x: js.divergence(flow(u))(x), held), cloud, **options)
    return sol, primitive(lambda s: 1.0 / step(width, xp=np)(s), np.asarray(cloud.points)[:, 0])


@pytest.mark.parametrize(
    "width, n, dim, aspect", [(0.01, 21, 1, 0.0), (0.005, 41, 1, 0.0), (0.002, 81, 1, 0.0), (0.01, 21, 2, 0.0),
                              (0.01, 21, 2, 5.0)],
)  # fmt: skip
def test_a_conductivity_steeper_than_the_cloud_resolves(width, n, dim, aspect):
    """25 to 34 % off on the line, less between sides that know the values; narrow steps no particle sees at all."""
    sol, exact = laminate(width, n, dim, aspect)
    assert away(sol, exact) > (0.2 if dim == 1 else 0.04) and any("coefficient" in flag for flag in sol.flags)


def test_a_conductivity_that_the_cloud_resolves():
    """The same step over four spacings: right to 1e-5, and no flag."""
    sol, exact = laminate(0.01, 321, 1)
    assert away(sol, exact) < 1e-4 and sol.flags == []


def test_a_convection_field_that_turns_within_the_spacing():
    """0.05 u'' = b(x) u' with b from 2 to -2 like tanh: u' is the exponential of an integral of b."""
    b = lambda s, xp: -2.0 * xp.tanh((s - 0.5123) / 0.004)
    rod = js.interval(0.0, 1.0, 21)
    held = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    sol = js.solve(js.Problem(lambda u, x: 0.05 * js.laplacian(u)(x) - b(x[0], jnp) * js.grad(u)(x)[0], held), rod)
    slope = np.exp(np.cumsum(b(FINE, np)) * (FINE[1] - FINE[0]) / 0.05)
    exact = primitive(lambda _: slope, np.asarray(rod.points)[:, 0])
    assert away(sol, exact) < 0.01 or sol.flags


def test_a_reaction_that_happens_between_particles():
    """u'' = c u with c a peak of height 6e4 and width 0.002 between two of 21 particles; refined, u(1/2) is another."""
    c = lambda x: 6e4 * jnp.exp(-(((x[0] - 0.525) / 0.002) ** 2))
    held = {"left": js.dirichlet(1.0), "right": js.dirichlet(1.0)}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - c(x) * u(x), held)
    solved = lambda n: js.solve(problem, js.interval(0.0, 1.0, n))
    fine, coarse = solved(2001), solved(21)  # programs for more particles serve fewer too
    assert abs(fine.u[1000] - coarse.u[10]) > 0.3 and coarse.flags and fine.flags == []


def test_a_front_of_a_conductivity_that_depends_on_the_solution():
    """(k(u) u')' = 0, k from 1 to 100 at u = 0.5 within 0.01: the integral of k over u is linear in x."""
    k = lambda u, xp: 1.0 + 49.5 * (1.0 + xp.tanh((u - 0.5) / 0.01))
    rod = js.interval(0.0, 1.0, 21)
    held = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    problem = js.Problem(lambda u, x: js.divergence(lambda y: k(u(y), jnp) * js.grad(u)(y))(x), held)
    exact = np.interp(np.asarray(rod.points)[:, 0], primitive(lambda s: k(s, np), FINE), FINE)
    try:
        sol = js.solve(problem, rod, u0=exact)
    except js.SolveError:
        return  # refused
    assert away(sol, exact) < 0.1 or sol.flags


@pytest.mark.parametrize("small", [0.0, 1e-3])
def test_a_term_that_hardly_matters_switches_no_check_off(small):
    """Waves of 4 particles at order 4, from a source: wrong, linear or not."""
    wave = lambda x: jnp.sin(47.3 * x[0] + 1.0) * jnp.cos(37.9 * x[1])
    cloud = js.rectangle((0, 0), (1, 1), (15, 15), jitter=0.3)
    pde = lambda u, x: js.laplacian(u)(x) - js.laplacian(wave)(x) + small * (u(x) ** 3 - wave(x) ** 3)
    sol = js.solve(js.Problem(pde, {side: js.dirichlet(wave) for side in SIDES}), cloud)
    assert away(sol, np.asarray(jax.vmap(wave)(cloud.points))) > 1.0
    assert any("estimated error" in flag for flag in sol.flags)


def test_fourth_order_in_space_and_first_in_time():
    """Cahn and Hilliard's equation on 21 x 21 particles of space-time, a front that moves: wrong, and flagged."""
    width = 0.06
    front = lambda x: jnp.tanh((x[0] - 0.35 - 0.3 * x[1]) / width)
    potential = lambda u: lambda y: u(y) ** 3 - u(y) - width**2 / 2.0 * js.partial(u, (2, 0))(y)
    operator = lambda u, x: js.partial(u, (0, 1))(x) - js.partial(potential(u), (2, 0))(x)
    walls = [js.dirichlet(front), js.condition(lambda u, x, n: js.partial(u, (2, 0))(x) - js.partial(front, (2, 0))(x))]
    bcs = {"left": walls, "right": walls, "bottom": js.dirichlet(front), "top": js.free()}
    cloud = js.rectangle((0, 0), (1, 1), (21, 21))
    try:
        sol = js.solve(js.Problem(lambda u, x: operator(u, x) - operator(front, x), bcs), cloud, u0=front)
    except js.SolveError:
        return  # refused
    assert away(sol, np.asarray(jax.vmap(front)(cloud.points))) < 0.1 or sol.flags


# ------------------------------------------------------------------ no alarm where nothing is wrong


def test_a_constant_has_no_range_to_change_by():
    """u'' + 1 - u^3 = 0 with no flux at the ends: u = 1, and round-off."""
    ends = {side: js.neumann(0.0) for side in ("left", "right")}
    pde = lambda u, x: js.laplacian(u)(x) + 1.0 - u(x) ** 3
    sol = js.solve(js.Problem(pde, ends), js.interval(0.0, 1.0, 21), u0=lambda x: 0.8 + 0.0 * x[0])
    assert np.abs(sol.u - 1.0).max() < 1e-9 and sol.flags == []


def part(u, k):
    return lambda y: u(y)[k]


def stokes(u, x):
    pressure = js.grad(part(u, 2))(x)
    momentum = [pressure[k] - js.laplacian(part(u, k))(x) for k in (0, 1)]
    return jnp.stack([*momentum, js.partial(part(u, 0), (1, 0))(x) + js.partial(part(u, 1), (0, 1))(x)])


@pytest.mark.parametrize("profile", [lambda y: 4.0 * y * (1.0 - y), lambda y: y], ids=["Poiseuille", "Couette"])
def test_each_field_has_a_scale_of_its_own(profile):
    """The velocity across is zero, the pressure linear or zero: what is left of them is round-off, not a layer."""
    given = [js.dirichlet(lambda x: profile(x[1]), field=0), js.dirichlet(0.0, field=1)]
    sol = js.solve(js.Problem(stokes, dict.fromkeys(SIDES, given), fields=3), js.rectangle((0, 0), (3, 1), (13, 7)))
    assert np.abs(sol.u[:, 0] - profile(np.asarray(sol.cloud.points)[:, 1])).max() < 1e-10 and sol.flags == []


def test_what_floats_is_named():
    """Outflow of another size than inflow: the pressure, field 2, cannot make up for it."""
    given = {side: [js.dirichlet(0.0, field=0), js.dirichlet(0.0, field=1)] for side in SIDES}
    given["left"] = [js.dirichlet(lambda x: x[1] * (1.0 - x[1]), field=0), js.dirichlet(0.0, field=1)]
    with pytest.raises(js.SolveError, match="the value of field 2, which enters by its derivatives only"):
        js.solve(js.Problem(stokes, given, fields=3), js.rectangle((0, 0), (1, 1), (9, 9)))


def test_a_slender_beam_is_not_singular():
    """Its condition is that of a beam, length over height to the fourth; the estimate knows that it is right."""
    lame, shear, length = 1.3, 0.7, 8.0

    def stress(u, x):
        g = js.grad(u)(x)
        return lame * jnp.trace(g) * jnp.eye(2) + shear * (g + g.T)

    free = js.condition(lambda u, x, n: stress(u, x) @ n)
    bent = lambda x: jnp.stack([-x[0] * x[1], 0.5 * x[0] ** 2 + lame / (lame + 2 * shear) * 0.5 * x[1] ** 2])
    end = js.condition(lambda u, x, n: (stress(u, x) - stress(bent, x)) @ n)
    bcs = {"left": js.dirichlet(bent), "right": end, "bottom": free, "top": free}
    cloud = js.rectangle((0.0, -0.5), (length, 0.5), (65, 9))
    sol = js.solve(js.Problem(lambda u, x: js.divergence(lambda y: stress(u, y))(x), bcs, fields=2), cloud)
    assert away(sol, np.asarray(jax.vmap(bent)(cloud.points))) < 1e-8 and sol.flags == []


def test_slopes_that_balance_up_to_their_corners():
    """Potential flow round a cylinder in a square by slopes, order 6: 1e-6 of the data are left, and solved for."""
    flow = lambda x: x[0] * (1.0 + 0.25 / (x @ x))
    shape = js.sdf.difference(js.sdf.rectangle((-2, -2), (2, 2)), js.sdf.circle((0, 0), 0.5))
    cloud = js.from_sdf(shape, ((-2.1, -2.1), (2.1, 2.1)), 0.2)
    slope = js.condition(lambda u, x, n: n @ (js.grad(u)(x) - js.grad(flow)(x)))
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": slope}), cloud, order=6)
    exact = np.asarray(jax.vmap(flow)(cloud.points))
    assert away(sol, exact - exact.mean()) < 0.01 and sol.flags == []


def test_an_estimate_of_a_floating_solution_in_the_least_squares_form():
    """It compares with another order, whose own balance is no matter of this solution."""
    exact = lambda x: jnp.sin(3.0 * x[0])
    ends = {side: js.condition(lambda u, x, n: n @ (js.grad(u)(x) - js.grad(exact)(x))) for side in ("left", "right")}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x), ends)
    sol = js.solve(problem, js.interval(0.0, 1.0, 21), formulation="lsq")
    assert np.max(sol.error_estimate()) < 1e-3 and sol.flags == []


# ------------------------------------------------------------------ under jit, where nothing raises


def test_jit_tells_of_problems_without_a_solution():
    """Heat that goes nowhere, and a plate driven at its resonance, say converged = False; the next ones True."""
    rod = js.interval(0.0, 1.0, 21)

    @jax.jit
    def floating(out):
        ends = {"left": js.neumann(0.0), "right": js.neumann(out)}
        return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, ends), rod).converged

    @jax.jit
    def driven(square):
        ends = {side: js.dirichlet(0.0) for side in ("left", "right")}
        return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) + square * u(x) - 1.0, ends), rod, order=6).converged

    assert not floating(0.0) and floating(1.0)
    assert not driven(jnp.pi**2) and driven(5.0)
