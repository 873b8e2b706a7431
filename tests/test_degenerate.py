"""Axes, and zeros of the leading coefficient: what the equation says there by itself counts once."""

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest
import scipy.special

import jsmitsm as js

lap, grad = js.laplacian, js.grad
RADIUS = js.interval(0.0, 1.0, 21)
LINE = js.interval(-1.0, 1.0, 21)  # a particle at 0
SMOOTH = {2: 1e-2, 4: 1e-4, 6: 1e-7}  # errors of resolved smooth solutions by order, a digit to spare


def off(sol, exact):
    return float(np.abs(sol.u - jax.vmap(exact)(sol.cloud.points)).max())


def sphere(u, x):
    """r u'' + 2 u' = -6 r, u(1) = 0: u = 1 - r^2."""
    return x[0] * lap(u)(x) + 2.0 * grad(u)(x)[0] + 6.0 * x[0]


def bowl(x):
    return 1.0 - x[0] ** 2


def shifted(cloud, particle, place):
    points = np.array(cloud.points)
    points[particle] = place
    return js.Cloud(points, cloud.groups, cloud.normals)


@pytest.mark.parametrize("axis, order", [(js.neumann(0.0), 2), (js.neumann(0.0), 6), (js.free(), 4)])
def test_the_axis_is_exact_as_people_write_it(axis, order):
    sol = js.solve(js.Problem(sphere, {"left": axis, "right": js.dirichlet(0.0)}), RADIUS, order=order)
    assert off(sol, bowl) < 1e-11 and sol.flags == []
    assert abs(sol.grad([[0.0]])[0, 0]) < 1e-9


def test_the_axis_in_the_least_squares_form_and_by_collocation():
    problem = js.Problem(sphere, {"left": js.neumann(0.0), "right": js.dirichlet(0.0)})
    assert off(js.solve(problem, RADIUS, formulation="lsq"), bowl) < 1e-9  # it squares the operator
    assert off(js.solve(problem, RADIUS, method="SSPH"), bowl) < 1e-11


@pytest.mark.parametrize("method", ["I", "II", "III"])
def test_methods_that_divide_by_the_leading_coefficient_refuse(method):
    problem = js.Problem(sphere, {"left": js.neumann(0.0), "right": js.dirichlet(0.0)})
    with pytest.raises(ValueError, match='method="S"'):
        js.solve(problem, RADIUS, method=method)


@pytest.mark.parametrize("place", [1e-17, 1e-4])
def test_rounding_of_the_axis_does_not_matter(place):
    problem = js.Problem(sphere, {"left": js.neumann(0.0), "right": js.dirichlet(0.0)})
    # u'(r) = 0 beside the axis moves the solution by its cube.
    assert off(js.solve(problem, shifted(RADIUS, 0, place)), bowl) < 1e-9


def test_a_condition_against_the_equation_is_told():
    problem = js.Problem(sphere, {"left": js.neumann(1.0), "right": js.dirichlet(0.0)})
    with pytest.raises(js.SolveError, match="contradicts") as told:
        js.solve(problem, RADIUS)
    assert told.value.particles == (0,)
    assert not js.solve(problem, RADIUS, throw=False).converged


HELD = {  # pde and the value that it has at 0 by itself
    "euler": (lambda u, x: x[0] ** 2 * lap(u)(x) - 2.0 * u(x), 0.0),  # u = x^2
    "euler with a source": (lambda u, x: x[0] ** 2 * lap(u)(x) + x[0] * grad(u)(x)[0] - 4.0 * u(x) + 4.0, 1.0),  # 1
    "sphere": (lambda u, x: x[0] * lap(u)(x) + 2.0 * grad(u)(x)[0], 1.0),  # 1
}


@pytest.mark.parametrize("name", HELD)
def test_a_held_value_that_the_equation_denies_is_told(name):
    pde, value = HELD[name]
    end = js.dirichlet(1.0)  # the solutions x^2 and 1 both have it
    told = js.solve(js.Problem(pde, {"left": js.dirichlet(value + 2.0), "right": end}), RADIUS, order=2).flags
    assert any("1 particle(s), first [0], contradict the equation" in flag for flag in told)
    assert js.solve(js.Problem(pde, {"left": js.dirichlet(value), "right": end}), RADIUS, order=2).flags == []


def test_division_by_the_radius_is_told_to_multiply():
    pde = lambda u, x: lap(u)(x) + 2.0 / x[0] * grad(u)(x)[0] + 6.0  # noqa: E731
    with pytest.raises(ValueError, match="multiply the equation by it"):
        js.solve(js.Problem(pde, {"left": js.neumann(0.0), "right": js.dirichlet(0.0)}), RADIUS)


@pytest.mark.parametrize("order", [2, 3])
def test_an_interior_zero_of_the_leading_coefficient(order):
    """x u'' + 2 x = 0, u(+-1) = 3: u = 4 - x^2."""
    ends = {"left": js.dirichlet(3.0), "right": js.dirichlet(3.0)}
    sol = js.solve(js.Problem(lambda u, x: x[0] * (lap(u)(x) + 2.0), ends), LINE, order=order)
    assert off(sol, lambda x: 4.0 - x[0] ** 2) < 1e-11
    assert order == 3 or sol.flags == []  # the flags compare with other orders, which are the same for both


@pytest.mark.parametrize("place", [1e-17, 1e-6, 1e-3])
def test_the_zero_may_lie_beside_a_particle(place):
    ends = {"left": js.dirichlet(np.cos(1.0)), "right": js.dirichlet(np.cos(1.0))}
    problem = js.Problem(lambda u, x: x[0] * lap(u)(x) + x[0] * jnp.cos(x[0]), ends)
    assert off(js.solve(problem, shifted(LINE, 10, place), order=6), lambda x: jnp.cos(x[0])) < 2e-9


def test_a_source_without_a_smooth_solution_is_told():
    """x u'' = 1 has u = x log x."""
    with pytest.raises(js.SolveError, match="contradicts"):
        js.solve(
            js.Problem(lambda u, x: x[0] * lap(u)(x) - 1.0, dict.fromkeys(("left", "right"), js.dirichlet(3.0))), LINE
        )


@pytest.mark.parametrize("n", [0, 1, 2])
def test_bessel(n):
    """r^2 u'' + r u' + (r^2 - n^2) u = 0: at r = 0 it says u = 0 for n > 0, and row n of the recursion is empty."""
    cloud = js.interval(0.0, 5.0, 41)
    axis = js.dirichlet(0.0) if n == 1 else js.neumann(0.0)
    pde = lambda u, x: x[0] ** 2 * lap(u)(x) + x[0] * grad(u)(x)[0] + (x[0] ** 2 - n**2) * u(x)  # noqa: E731
    sol = js.solve(js.Problem(pde, {"left": axis, "right": js.dirichlet(scipy.special.jv(n, 5.0))}), cloud, order=8)
    assert np.abs(sol.u - scipy.special.jv(n, np.asarray(cloud.points[:, 0]))).max() < 1e-10


def test_legendre_with_the_natural_condition_or_none():
    """((1 - x^2) u')' + 6 u = 0: P_2, where 6 u = 2 u' at x = 1 is what the equation says."""
    pde = lambda u, x: (1.0 - x[0] ** 2) * lap(u)(x) - 2.0 * x[0] * grad(u)(x)[0] + 6.0 * u(x)  # noqa: E731
    for right in (js.free(), js.robin(6.0, -2.0, 0.0)):
        sol = js.solve(js.Problem(pde, {"left": js.dirichlet(1.0), "right": right}), LINE, order=2)
        assert off(sol, lambda x: 1.5 * x[0] ** 2 - 0.5) < 1e-11


def lane_emden(p=1.0):
    pde = lambda u, x, p: x[0] * lap(u)(x) + 2.0 * grad(u)(x)[0] + p * x[0] * u(x) ** 5  # noqa: E731
    return js.Problem(pde, {"left": js.neumann(0.0), "right": js.dirichlet(np.sqrt(0.75))}, params=p)


@pytest.mark.parametrize("order", [2, 4])
def test_lane_emden(order):
    """r u'' + 2 u' + r u^5 = 0: u = (1 + r^2 / 3)^(-1/2)."""
    sol = js.solve(lane_emden(), RADIUS, order=order, u0=lambda x, p: 1.0 + 0.0 * x[0])
    assert off(sol, lambda x: (1.0 + x[0] ** 2 / 3.0) ** -0.5) < SMOOTH[order] and sol.flags == []


def test_gradients_pass_the_axis_and_the_zero_under_jit_too():
    """p (r u'' + 2 u') = -6 r: u(0) = 1 / p."""
    pde = lambda u, x, p: p * (x[0] * lap(u)(x) + 2.0 * grad(u)(x)[0]) + 6.0 * x[0]  # noqa: E731
    ends = {"left": js.neumann(0.0), "right": js.dirichlet(0.0)}
    top = lambda p: js.solve(js.Problem(pde, ends, params=p), RADIUS, order=2, depth=0).u[0]  # noqa: E731
    value, slope = mm.quickly(jax.value_and_grad(top))(2.0)
    assert abs(value - 0.5) < 1e-11 and abs(slope + 0.25) < 1e-10 and abs(jax.grad(top)(2.0) + 0.25) < 1e-10
    zero = dict.fromkeys(ends, js.dirichlet(0.0))
    flat = lambda u, x, p: x[0] * (lap(u)(x) + 2.0 * p)  # noqa: E731
    middle = lambda p: js.solve(js.Problem(flat, zero, params=p), LINE, order=2, depth=0).u[10]  # noqa: E731
    assert abs(jax.grad(middle)(3.0) - 1.0) < 1e-10 and abs(mm.quickly(middle)(3.0) - 3.0) < 1e-10


PLANE = lambda x: jnp.cos(x[0]) * jnp.exp(x[1])  # noqa: E731
SIDES = ("left", "right", "bottom", "top")


@pytest.mark.parametrize("order", [2, 4])
def test_cylinder_coordinates(order):
    """r (u_rr + u_zz) + u_r on r >= 0, with the slope zero on the axis as it is written."""
    op = lambda u, x: x[0] * lap(u)(x) + grad(u)(x)[0]  # noqa: E731
    bcs = {side: js.dirichlet(PLANE) for side in SIDES} | {"left": js.neumann(0.0)}
    cloud = js.rectangle((0, 0), (1, 1), (13, 13))
    assert (
        off(js.solve(js.Problem(lambda u, x: op(u, x) - op(PLANE, x), bcs), cloud, order=order), PLANE) < SMOOTH[order]
    )


@pytest.mark.parametrize("order", [2, 4])
def test_a_zero_on_a_line_in_the_plane(order):
    cloud = js.rectangle((-1, -1), (1, 1), (13, 13))
    problem = js.Problem(lambda u, x: x[0] * (lap(u)(x) - lap(PLANE)(x)), {side: js.dirichlet(PLANE) for side in SIDES})
    assert off(js.solve(problem, cloud, order=order), PLANE) < SMOOTH[order]


def test_where_the_equation_says_nothing_the_particles_are_named():
    cloud = js.rectangle((-1, -1), (1, 1), (13, 13))
    some = lambda x: jnp.where(x[0] < 0.1, 0.0, 1.0)  # noqa: E731
    problem = js.Problem(
        lambda u, x: some(x) * (lap(u)(x) - lap(PLANE)(x)), {side: js.dirichlet(PLANE) for side in SIDES}
    )
    with pytest.raises(js.SolveError, match="says nothing at") as told:
        js.solve(problem, cloud)
    assert (np.asarray(cloud.points)[list(told.value.particles), 0] < 0.1).all()
    with pytest.raises(js.SolveError, match="particles .*10"):
        ends = dict.fromkeys(("left", "right"), js.dirichlet(3.0))
        js.solve(js.Problem(lambda u, x: x[0] * (lap(u)(x) + 2.0), ends), LINE, method="SSPH")
