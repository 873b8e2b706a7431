"""Conditions at corners within a group hold for a side, and not along the bisector."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud.corners import mean_normals, side_normals

SQUARE = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
SHAPES = {
    "square": lambda: js.from_polygon(SQUARE, 0.2),
    "ell": lambda: js.from_polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], 0.2),
    "triangle far away": lambda: js.from_polygon([(1e4, 1e4), (1e4 + 2, 1e4 + 0.3), (1e4 + 0.7, 1e4 + 1.5)], 0.2),
    "rectangle": lambda: js.from_sdf(js.sdf.rectangle((0, 0), (2, 1)), ((0, 0), (2, 1)), 0.15),
    "half disk": lambda: js.from_sdf(
        js.sdf.intersection(js.sdf.circle((0, 0), 1.0), js.sdf.rectangle((-2, 0), (2, 2))), ((-1, 0), (1, 1)), 0.15
    ),
    "cube": lambda: js.from_sdf(js.sdf.box((0, 0, 0), (1, 1, 1)), ((0, 0, 0), (1, 1, 1)), 0.25),
    "cylinder": lambda: js.from_sdf(js.sdf.cylinder((0, 0, 0), (0, 0, 1), 0.5), ((-1, -1, 0), (1, 1, 1)), 0.22),
}


def quadratic(x):
    return x @ x + 3.0 * x[0] * x[1] - x[-1]


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("kind", ["robin", "condition"])
def test_slopes_along_a_side_hold_to_its_end(name, kind):
    """The slope of a quadratic along the normals that a condition is called with, or, in arrays, along the cloud's."""
    cloud = SHAPES[name]()
    slope = lambda x, n: quadratic(x) + jax.grad(quadratic)(x) @ n
    if kind == "condition":
        bc = js.condition(lambda u, x, n: u(x) + js.grad(u)(x) @ n - slope(x, n))
    else:
        ids = np.asarray(cloud.groups["boundary"])
        bc = js.robin(1.0, 1.0, np.asarray(jax.vmap(slope)(cloud.points[ids], cloud.normals[ids])))
    origin = jnp.asarray(cloud.points).mean(0)
    exact = np.asarray(jax.vmap(quadratic)(cloud.points))
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 2 * cloud.dim, {"boundary": bc}), cloud)
    assert np.abs(sol.u - exact).max() < 1e-11 * max(np.abs(exact).max(), float(origin @ origin))
    assert not sol.flags


@pytest.mark.parametrize("kind", ["neumann", "robin"])
def test_slopes_that_are_the_same_on_all_sides(kind):
    """u = |x|^2 / 2 on a square and on a cube: its slope is one on every side, and not along bisectors."""
    for cloud in (SHAPES["square"](), js.from_sdf(js.sdf.box((-1,) * 3, (1,) * 3), ((-1,) * 3, (1,) * 3), 0.5)):
        exact = 0.5 * (cloud.points**2).sum(axis=1)
        bc = js.neumann(1.0) if kind == "neumann" else js.robin(1.0, 2.0, lambda x: 0.5 * (x @ x) + 2.0)
        sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - cloud.dim, {"boundary": bc}), cloud)  # noqa: B023
        off = sol.u - exact
        assert np.abs(off - (off.mean() if kind == "neumann" else 0.0)).max() < 1e-11


def test_the_point_source_of_a_square():
    """Beside a source what is left of a slope given as a number is an array, along the same normals."""
    sources = [js.point_source(np.array([0.1, 0.2]), 1.0)]
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": js.robin(1.0, 1.0, 0.0)}, sources=sources)
    sides = {"south": lambda x: x[:, 1] < -1 + 1e-9, "north": lambda x: x[:, 1] > 1 - 1e-9,
             "west": lambda x: x[:, 0] < -1 + 1e-9, "east": lambda x: x[:, 0] > 1 - 1e-9}  # fmt: skip
    split = js.Problem(problem.pde, dict.fromkeys(sides, js.robin(1.0, 1.0, 0.0)), sources=sources)
    one = js.solve(problem, js.from_polygon(SQUARE, 0.1), order=6)
    four = js.solve(split, js.from_polygon(SQUARE, 0.1, groups=sides), order=6)
    assert np.abs(one.u - four.u).max() < 1e-4


def test_one_group_is_as_good_as_four():
    """Cooled all around, which nobody splits into sides: the same as with a group for every side."""
    sides = {"south": lambda x: x[:, 1] < -1 + 1e-9, "north": lambda x: x[:, 1] > 1 - 1e-9,
             "west": lambda x: x[:, 0] < -1 + 1e-9, "east": lambda x: x[:, 0] > 1 - 1e-9}  # fmt: skip
    pde, cooled = lambda u, x: js.laplacian(u)(x) + 1.0, js.robin(1.0, 1.0, 0.0)
    one, four = js.from_polygon(SQUARE, 0.1), js.from_polygon(SQUARE, 0.1, groups=sides)
    sol = js.solve(js.Problem(pde, {"boundary": cooled}), one, order=6)
    split = js.solve(js.Problem(pde, dict.fromkeys(sides, cooled)), four, order=6)
    assert np.abs(sol.u - split(one.points)).max() < 1e-6  # along bisectors: 0.02


def test_fluxes_that_balance_are_not_refused():
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 2.0, {"boundary": js.neumann(1.0)})
    cloud = js.from_polygon(SQUARE, 0.2)
    sol = js.solve(problem, cloud)
    off = sol.u - 0.5 * (cloud.points**2).sum(axis=1)
    assert np.ptp(off) < 1e-12


def test_smooth_boundaries_keep_their_normals():
    """Tips of ellipses that few particles see, and straight sides that end in arcs, have no corners."""
    ellipse = js.from_sdf(lambda x: jnp.hypot(x[0] / 2, x[1] / 0.3) - 1, ((-2.2, -0.5), (2.2, 0.5)), 0.15)
    stadium = js.from_sdf(js.sdf.capsule((-1, 0), (1, 0), 0.5), ((-2, -1), (2, 1)), 0.12)
    ball = js.from_sdf(js.sdf.sphere((0, 0, 0), 1.0), ((-1,) * 3, (1,) * 3), 0.3)
    for cloud in (ellipse, stadium, ball, js.interval(0, 1, 9), js.rectangle((0, 0), (1, 1), (6, 6))):
        assert side_normals(cloud) is cloud.normals and mean_normals(cloud) is cloud.normals


def test_the_sides_of_a_cube_are_those_of_its_faces():
    found = side_normals(SHAPES["cube"]())
    at = np.isfinite(found[:, 0])
    assert np.allclose(np.abs(found[at]).max(axis=1), 1.0)


def test_it_does_not_matter_how_particles_are_numbered():
    cloud = SHAPES["ell"]()
    new = np.random.default_rng(0).permutation(len(cloud))
    place = np.argsort(new)
    other = js.Cloud(cloud.points[new], {n: place[ids] for n, ids in cloud.groups.items()}, cloud.normals[new])
    assert np.array_equal(side_normals(cloud)[new], side_normals(other), equal_nan=True)


def test_derivatives_by_the_normals_are_those_of_the_side():
    cloud = js.from_polygon(SQUARE, 0.4)

    def mean(turn):
        n = jnp.nan_to_num(cloud.normals)
        turned = jnp.stack([n[:, 0] * jnp.cos(turn) - n[:, 1] * jnp.sin(turn),
                            n[:, 0] * jnp.sin(turn) + n[:, 1] * jnp.cos(turn)], axis=1)  # fmt: skip
        moved = cloud.replace(normals=jnp.where(jnp.isnan(cloud.normals), jnp.nan, turned))
        problem = js.Problem(lambda u, x: js.laplacian(u)(x) + x[1], {"boundary": js.robin(1.0, 1.0, 0.0)})
        return js.solve(problem, moved).u @ cloud.points[:, 0]

    step = 2e-7  # sides are flat but for a millionth
    difference = (mean(step) - mean(-step)) / (2 * step)
    assert np.isclose(jax.grad(mean)(0.0), difference, rtol=1e-5)


def two_circles(apart, radius, join):
    """The lens of two circles, or what both cover; and the slope of |x|^2 / 2 along its sides, the same at corners."""
    centres = np.array([[-apart, 0.0], [apart, 0.0]])
    shape = join(*(js.sdf.circle(tuple(c), radius) for c in centres))
    lens = join is js.sdf.intersection

    def slope(x):
        centre = jnp.where((x[0] > 0) == lens, centres[0, 0], centres[1, 0])
        return x @ (x - jnp.array([1.0, 0.0]) * centre) / radius

    return shape, slope


@pytest.mark.parametrize("join", ["intersection", "union"])
@pytest.mark.parametrize("kind", ["robin", "condition"])
def test_corners_between_curved_sides(join, kind):
    """One group all around: what is said of a side holds to its end, reentrant corners included."""
    shape, slope = two_circles(0.5, 1.0, getattr(js.sdf, join))
    cloud = js.from_sdf(shape, ((-1.6, -1.1), (1.6, 1.1)), 0.2)
    if kind == "robin":
        bc = js.robin(1.0, 1.0, lambda x: 0.5 * (x @ x) + slope(x))
    else:
        bc = js.condition(lambda u, x, n: u(x) + js.grad(u)(x) @ n - 0.5 * (x @ x) - slope(x))
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 2.0, {"boundary": bc}), cloud)
    assert np.abs(sol.u - 0.5 * (cloud.points**2).sum(axis=1)).max() < 1e-10 and not sol.flags
    at = np.flatnonzero(np.abs(cloud.points[:, 0]) < 1e-9)
    at = at[np.isfinite(cloud.normals[at, 0])]
    assert len(at) == 2 and np.abs(cloud.normals[at, 0]).max() < 1e-9  # the cloud's own are the bisectors


def test_sharp_tips_are_no_corners():
    """Normals turn fast there, and go on turning."""
    for radii in ((1.0, 0.2), (1.0, 0.05)):
        cloud = js.from_sdf(js.sdf.ellipse((0.0, 0.0), radii), ((-1.1, -0.3), (1.1, 0.3)), 0.05)
        assert np.array_equal(side_normals(cloud), cloud.normals, equal_nan=True)
        assert np.array_equal(mean_normals(cloud), cloud.normals, equal_nan=True)


def test_a_corner_between_groups_keeps_the_normal_of_its_own_side():
    shape, slope = two_circles(0.5, 1.0, js.sdf.intersection)
    sides = {"left": lambda x: x[:, 0] < 1e-9, "right": lambda x: x[:, 0] >= 1e-9}
    cloud = js.from_sdf(shape, ((-0.6, -1.0), (0.6, 1.0)), 0.15, groups=sides)
    assert np.array_equal(side_normals(cloud), cloud.normals, equal_nan=True)
