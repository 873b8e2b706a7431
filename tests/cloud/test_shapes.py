"""Clouds of irregular domains: the boundary to round-off, corners, evenness, groups, bad input."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

import jsmitsm as js
from jsmitsm import sdf
from jsmitsm.cloud.quality import quality
from jsmitsm.cloud.shapes import from_polygon, from_sdf

SQUARE = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
L_SHAPE = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)
DISK = sdf.circle((0, 0), 1.0)
UNIT = ((-1, -1), (1, 1))


def star(x):
    """r < 1 + 0.2 cos 5t, no distance and without a gradient in the centre."""
    return jnp.sqrt(x @ x) - 1 - 0.2 * jnp.cos(5 * jnp.arctan2(x[1], x[0]))


def steep(x):
    return 100.0 * (x @ x - 1.0)


def evaluate(shape, x):
    """Values (M,) and gradients (M, D)."""
    value, gradient = jax.jit(jax.vmap(jax.value_and_grad(shape)))(x)
    return np.asarray(value), np.asarray(gradient)


def lattice_spacing(cloud, h):
    """Nearest distances among the boundary particles, in spacings."""
    x = cloud.points[cloud.boundary]
    return cKDTree(x).query(x, k=2)[0][:, 1] / (h(x) if callable(h) else h)


def graded(x):
    """From 0.004 at the point (1, 0) to 0.4 at a distance of 2: 1 to 100."""
    return 0.004 + 0.198 * np.hypot(x[:, 0] - 1, x[:, 1])


# name: sdf, bounds, spacing, worst mesh ratio (a relaxed cloud of 5000 particles by energy minimisation has 2.5)
CASES = {
    "star": (star, ((-1.3, -1.3), (1.3, 1.3)), 0.08, 2.3),
    "steep": (steep, UNIT, 0.1, 2.3),
    "plate": (
        sdf.difference(sdf.rectangle((0, 0), (2, 1)), sdf.circle((1, 0.5), 0.25)),
        ((0, 0), (2, 1)),
        0.06,
        2.3,
    ),
    "L": (sdf.polygon(L_SHAPE), ((0, 0), (2, 2)), 0.1, 2.3),
    "two": (sdf.union(sdf.circle((-1, 0), 0.6), sdf.circle((1, 0), 0.4)), ((-2, -1), (2, 1)), 0.08, 2.3),
    "graded": (DISK, UNIT, graded, 2.7),
    "ball": (sdf.ball((0, 0, 0), 1.0), ((-1,) * 3, (1,) * 3), 0.2, 2.4),
    "torus": (sdf.torus((0, 0, 0), 0.8, 0.35), ((-1.2,) * 3, (1.2,) * 3), 0.15, 2.4),
    "cube": (sdf.box((0, 0, 0), (1, 1, 1)), ((0,) * 3, (1,) * 3), 0.12, 2.5),
}


@pytest.fixture(scope="module")
def built():
    return {name: from_sdf(shape, bounds, h, seed=3) for name, (shape, bounds, h, _) in CASES.items()}


@pytest.mark.parametrize("name", CASES)
def test_boundary_and_interior(built, name):
    shape, _, h, ratio = CASES[name]
    cloud = built[name]
    edge, inside = cloud.boundary, cloud.groups["interior"]
    assert list(cloud.groups) == ["interior", "boundary"]
    slope = 200.0 if name == "steep" else 1.0
    assert np.abs(evaluate(shape, cloud.points[edge])[0]).max() < 1e-12 * slope
    np.testing.assert_allclose(np.linalg.norm(cloud.normals[edge], axis=1), 1.0, atol=1e-14)
    assert np.isnan(cloud.normals[inside]).all()
    value, gradient = evaluate(shape, cloud.points[inside])
    depth = -value / np.linalg.norm(gradient, axis=1)
    local = h(cloud.points[inside]) if callable(h) else h
    if name != "star":  # whose gradient blows up in the centre
        assert (depth > 0.4 * local).all()
    assert (value < 0).all()
    measured = quality(cloud, h)
    assert measured.mesh_ratio < ratio
    assert measured.separation > 0.65 and measured.evenness > 0.75
    assert lattice_spacing(cloud, h).min() > 0.7


@pytest.mark.parametrize("name", ["star", "plate", "torus"])
def test_normals_are_the_gradient(built, name):
    cloud = built[name]
    x, n = cloud.points[cloud.boundary], cloud.normals[cloud.boundary]
    gradient = evaluate(CASES[name][0], x)[1]
    gradient = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    smooth = np.ones(len(x), bool) if name != "plate" else ~np.isin(x, (0, 1, 2)).all(axis=1)
    np.testing.assert_allclose(n[smooth], gradient[smooth], atol=1e-12)


def test_curve_is_evenly_divided(built):
    gaps = lattice_spacing(built["steep"], 0.1)
    np.testing.assert_allclose(gaps, gaps.mean(), rtol=2e-3)  # chords of a polyline at a third of the spacing
    assert abs(gaps.mean() - 1) < 0.02


def test_corners_are_particles_with_bisectors(built):
    cloud = built["L"]
    for vertex, bisector in zip(L_SHAPE, [(-1, -1), (1, -1), (1, 1), (1, 1), (1, 1), (-1, 1)]):
        k = np.linalg.norm(cloud.points - vertex, axis=1).argmin()
        np.testing.assert_allclose(cloud.points[k], vertex, atol=1e-12)
        np.testing.assert_allclose(cloud.normals[k], np.divide(bisector, np.sqrt(2)), atol=1e-7)


@pytest.mark.parametrize("make", ["sdf", "polygon"])
def test_at_corners_between_groups_the_normal_is_that_of_the_own_side(make):
    """A flux on a side holds to its end: with bisectors at its corners u would be 3 % wrong, and no flag say so."""
    groups = {"flux": lambda x: x[:, 0] < 1e-9, "held": lambda x: x[:, 0] > -1}
    square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    cloud = (from_polygon(square, 0.1, groups=groups) if make == "polygon"
             else from_sdf(sdf.rectangle((0, 0), (1, 1)), ((0, 0), (1, 1)), 0.1, groups=groups))  # fmt: skip
    np.testing.assert_allclose(cloud.normals[cloud.groups["flux"]], [[-1, 0]] * len(cloud.groups["flux"]), atol=1e-9)
    exact = lambda x: jnp.exp(x[0]) * jnp.sin(x[1] + 0.3)
    conditions = {"flux": js.neumann(lambda x: -exact(x)), "held": js.dirichlet(exact)}
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), conditions), cloud)
    assert abs(sol.u - jax.vmap(exact)(cloud.points)).max() < 1e-5


def test_edges_between_groups_in_space_and_on_curved_sides():
    """The flat end of a cylinder against its wall: either group has its own normals on the rim, the wall is curved."""
    pipe = sdf.cylinder((0, 0, 0), (0, 0, 1), 0.5)
    ends = lambda x: np.abs(x[:, 2] - 0.5) > 0.5 - 1e-9
    wall = lambda x: np.linalg.norm(x[:, :2], axis=1) > 0.5 - 1e-9
    for groups in ({"ends": ends, "wall": wall}, {"wall": wall, "ends": ends}):
        cloud = from_sdf(pipe, ((-0.5, -0.5, 0), (0.5, 0.5, 1)), 0.13, groups=groups)
        x = cloud.points[cloud.groups["wall"]]
        wanted = np.pad(x[:, :2] / np.linalg.norm(x[:, :2], axis=1, keepdims=True), ((0, 0), (0, 1)))
        np.testing.assert_allclose(cloud.normals[cloud.groups["wall"]], wanted, atol=1e-6)
        end = cloud.groups["ends"]
        np.testing.assert_allclose(cloud.normals[end], np.sign(cloud.points[end, 2:] - 0.5) * [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_curved_corners(sign):
    """Two circles meet at (x, +-y): re-entrant in their union, a sharp tip of 24 degrees in their difference."""
    other = sdf.circle((0.4, 0), 0.9)
    shape = sdf.union(DISK, other) if sign > 0 else sdf.difference(DISK, other)
    cloud = from_sdf(shape, ((-1, -1), (1.3, 1)), 0.06)
    x = (1 + 0.16 - 0.81) / 0.8
    tip = np.array([x, np.sqrt(1 - x * x)])
    k = np.linalg.norm(cloud.points - tip, axis=1).argmin()
    np.testing.assert_allclose(cloud.points[k], tip, atol=1e-12)
    bisector = tip + sign * (tip - (0.4, 0)) / 0.9
    np.testing.assert_allclose(cloud.normals[k], bisector / np.linalg.norm(bisector), atol=1e-7)
    assert quality(cloud, 0.06).separation > 0.5  # sides that run together are thinned


def test_rounded_corners_are_not_corners():
    shape = sdf.round(sdf.rectangle((-0.9, -0.4), (0.9, 0.4)), 0.1)
    cloud = from_sdf(shape, ((-1, -0.5), (1, 0.5)), 0.03)
    x = np.abs(cloud.points[cloud.boundary])
    assert not (x > (0.98, 0.48)).all(axis=1).any()


def test_edges_of_a_cube():
    """Particles on an edge or at a corner have the bisector of the faces."""
    cloud = from_sdf(sdf.box((0, 0, 0), (1, 1, 1)), ((0,) * 3, (1,) * 3), 0.12)
    x = cloud.points[cloud.boundary]
    on = np.minimum(x, 1 - x) < 1e-10
    assert (on.sum(axis=1) > 1).any()
    expected = np.where(on, np.sign(x - 0.5), 0.0)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(cloud.normals[cloud.boundary], expected, atol=1e-7)


def test_touching_shapes_have_no_boundary_between():
    """The union of two rectangles is zero on the side they share; that is not a boundary."""
    shape = sdf.union(sdf.rectangle((0, 0), (1, 1)), sdf.rectangle((1, 0), (2, 1)))
    cloud = from_sdf(shape, ((0, 0), (2, 1)), 0.1)
    assert len(cloud.boundary) == 60
    assert quality(cloud, 0.1).mesh_ratio < 2.4


def test_other_parts_beyond_the_bounds_are_ignored():
    many = lambda x: jnp.linalg.norm(x - 4.0 * jnp.round(x / 4.0)) - 1.0  # disks at all multiples of 4
    assert np.abs(from_sdf(many, ((-1.5, -1.5), (1.5, 1.5)), 0.15).points).max() < 1.01


def test_same_seed_same_cloud():
    one, two, other = (from_sdf(DISK, UNIT, 0.1, seed=s).points for s in (5, 5, 6))
    np.testing.assert_array_equal(one, two)
    assert one.shape != other.shape or np.abs(one - other).max() > 0.01
    polygons = [from_polygon(SQUARE, 0.1, seed=s).points for s in (1, 1)]
    np.testing.assert_array_equal(*polygons)


def test_one_dimension():
    """Both intervals of cos x < 0 in (0, 4 pi), with normals out of them."""
    cloud = from_sdf(lambda x: jnp.cos(x[0]), (0.0, 4 * np.pi), 0.1)
    np.testing.assert_allclose(cloud.points[cloud.boundary, 0], np.pi * np.array([0.5, 1.5, 2.5, 3.5]), atol=1e-12)
    np.testing.assert_array_equal(cloud.normals[cloud.boundary, 0], [-1, 1, -1, 1])
    inside = cloud.points[cloud.groups["interior"], 0]
    assert (np.cos(inside) < 0).all() and len(inside) == 60
    np.testing.assert_allclose(quality(cloud).mesh_ratio, 1.0, rtol=1e-6)


def test_one_dimension_graded():
    cloud = from_sdf(sdf.interval(0, 1), (-1, 2), lambda x: 0.01 + 0.2 * x[:, 0])
    gaps = np.diff(np.sort(cloud.points[:, 0]))
    assert gaps[0] < 0.015 and gaps[-1] > 0.15
    assert quality(cloud).mesh_ratio < 2.0


def test_polygon_with_holes():
    holes = [0.2 * SQUARE + 0.2, 0.25 * L_SHAPE[::-1] / 2 + 0.6]
    cloud = from_polygon(SQUARE, 0.04, holes=holes)
    assert list(cloud.groups) == ["interior", "boundary", "hole0", "hole1"]
    x = cloud.points
    outer = x[cloud.groups["boundary"]]
    assert ((outer == 0) | (outer == 1)).any(axis=1).all()  # exactly on the edges
    hole = x[cloud.groups["hole0"]]
    np.testing.assert_allclose(np.abs(hole - 0.3).max(axis=1), 0.1, atol=1e-15)
    for polygon in [SQUARE, *holes]:  # every corner is a particle
        assert max(np.linalg.norm(x - v, axis=1).min() for v in polygon) < 1e-15
    shape = sdf.difference(sdf.polygon(SQUARE), *map(sdf.polygon, holes))
    assert evaluate(shape, x[cloud.groups["interior"]])[0].max() < -0.4 * 0.04
    middle = np.linalg.norm(x - (0.2, 0.32), axis=1).argmin()
    np.testing.assert_array_equal(cloud.normals[middle], (1, 0))  # out of the domain, into the hole
    corner = np.linalg.norm(x - (0.2, 0.2), axis=1).argmin()
    np.testing.assert_allclose(cloud.normals[corner], (0.5**0.5, 0.5**0.5), atol=1e-15)
    assert quality(cloud, 0.04).mesh_ratio < 2.5


@pytest.mark.parametrize("vertices", [SQUARE, SQUARE[::-1], np.concatenate([SQUARE, SQUARE[:1]])])
def test_polygon_either_way_round_open_or_closed(vertices):
    cloud = from_polygon(vertices, 0.1)
    assert len(cloud.groups["boundary"]) == 40
    side = cloud.points[:, 1] == 0
    assert (cloud.normals[side, 1] < 0).all()


def test_fine_polygon_of_a_curve_is_divided_evenly():
    """A thousand edges of a circle get particles a spacing apart, not at every vertex, and on the edges."""
    t = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    circle = np.stack([np.cos(t), np.sin(t)], axis=1)
    cloud = from_polygon(circle, 0.1)
    assert len(cloud.groups["boundary"]) == 63
    assert np.abs(evaluate(sdf.polygon(circle), cloud.points[cloud.boundary])[0]).max() < 1e-14
    assert lattice_spacing(cloud, 0.1).min() > 0.98


def test_spacing_may_be_undefined_outside():
    """The spacing 0.02 + 0.1 (r - 0.2) is negative inside of the hole, where nobody should ask."""
    grading = lambda x: 0.02 + 0.15 * (np.hypot(x[:, 0], x[:, 1]) - 0.2)
    plate = sdf.difference(sdf.rectangle((-1, -1), (1, 1)), sdf.circle((0, 0), 0.2))
    groups = {"hole": lambda x: np.hypot(x[:, 0], x[:, 1]) < 0.3, "rest": lambda x: x[:, 0] > -2}
    cloud = from_sdf(plate, UNIT, grading, groups=groups)
    assert len(cloud.groups["hole"]) == 63  # 2 pi 0.2 / 0.02
    assert quality(cloud, grading).mesh_ratio < 2.7


def test_groups_first_match_wins():
    groups = {"right": lambda x: x[:, 0] > 0, "top": lambda x: x[:, 1] > 0, "rest": lambda x: x[:, 0] < 9}
    for cloud in (from_sdf(DISK, UNIT, 0.1, groups=groups), from_polygon(2 * SQUARE - 1, 0.1, groups=groups)):
        x = {name: cloud.points[index] for name, index in cloud.groups.items()}
        assert (x["right"][:, 0] > 0).all()
        assert (x["top"][:, 0] <= 0).all() and (x["top"][:, 1] > 0).all()
        assert (x["rest"] <= 0).all()
        assert list(cloud.groups) == ["interior", "right", "top", "rest"]


def test_quality_of_lattices():
    """Squares: the empty ball has radius 1/sqrt 2 of the spacing. Also without normals, in 1D and 3D."""
    square = js.rectangle((0, 0), (1, 2), (11, 21))
    for cloud in (square, js.Cloud(square.points, square.groups)):
        measured = quality(cloud)
        np.testing.assert_allclose(measured.mesh_ratio, np.sqrt(2), rtol=1e-9)
        np.testing.assert_allclose(measured.fill_distance, 0.1 / np.sqrt(2), rtol=1e-9)
        np.testing.assert_allclose(measured.separation_distance, 0.1, rtol=1e-9)
    np.testing.assert_allclose(quality(js.box((0,) * 3, (1,) * 3, (5,) * 3)).mesh_ratio, np.sqrt(3), rtol=1e-6)
    np.testing.assert_allclose(quality(js.interval(0, 1, 11)).mesh_ratio, 1.0, rtol=1e-9)


def test_quality_sees_a_hole_and_a_pair():
    cloud = from_sdf(DISK, UNIT, 0.1)
    x, n, inner = cloud.points, len(cloud), len(cloud.groups["interior"])
    kept = np.linalg.norm(x, axis=1) > 0.25
    inner = kept[:inner].sum()  # interior particles come first
    holed = js.Cloud(x[kept], {"interior": np.arange(inner), "boundary": np.arange(inner, kept.sum())})
    assert quality(holed, 0.1).fill_distance > 0.24
    crowded = js.Cloud(
        np.concatenate([x, x[:1] + 0.001]),
        {"interior": np.append(cloud.groups["interior"], n), "boundary": cloud.boundary},
    )
    np.testing.assert_allclose(quality(crowded).separation_distance, 0.001 * np.sqrt(2), rtol=1e-6)


def test_fast_enough():
    """5000 particles take 0.2 s on one core; three seconds leave room for a busy machine, not for a bad algorithm."""
    h = 0.0265
    from_sdf(star, ((-1.3, -1.3), (1.3, 1.3)), h)
    start = time.process_time()
    cloud = from_sdf(star, ((-1.3, -1.3), (1.3, 1.3)), h)
    assert len(cloud) > 5000
    assert time.process_time() - start < 3.0


def disk(**options):
    return from_sdf(DISK, UNIT, 0.1, **options)


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: from_sdf(lambda x: x @ x + 0.1, UNIT, 0.1), "sdf: never negative"),
        (lambda: from_sdf(DISK, ((-0.9, -1), (1, 1)), 0.1), "bounds: cut the domain"),
        (lambda: from_sdf(lambda x: x @ x - 9, UNIT, 0.1), "bounds: cut the domain"),
        (lambda: from_sdf(lambda x: jnp.sqrt(x[0]) - 1, UNIT, 0.1), "sdf: returned nan"),
        (lambda: from_sdf(lambda x: x, UNIT, 0.1), "sdf: returned .* expected a real scalar"),
        (lambda: from_sdf(lambda x: -1, UNIT, 0.1), "expected a real scalar"),
        (lambda: from_sdf(lambda x: x[0] if x[0] > 0 else x[1], UNIT, 0.1), "jnp.where in place of if"),
        (lambda: from_sdf(lambda x: jnp.float32(x[0]), UNIT, 0.1), "float32"),
        (lambda: from_sdf(3.0, UNIT, 0.1), "sdf: expected a function"),
        (lambda: from_sdf(DISK, ((-1,) * 3, (1,) * 3), 0.1), r"sdf: failed for one point x of shape \(3,\)"),
        (lambda: from_sdf(lambda x: jnp.where(x @ x < 0.5, -1.0, 1.0), UNIT, 0.1), "sdf: .* slope"),
        (lambda: from_sdf(DISK, UNIT, 5.0), "spacing: too coarse"),
        (lambda: from_sdf(sdf.difference(DISK, sdf.circle((0.3, 0.1), 0.05)), UNIT, 0.1), "spacing: too coarse"),
        (lambda: from_sdf(sdf.difference(DISK, sdf.circle((0.3, 0.1), 0.003)), UNIT, 0.1), "spacing: too coarse"),
        (lambda: from_sdf(sdf.ball((0,) * 3, 1.0), ((-1,) * 3, (1,) * 3), 2.0), "spacing: too coarse"),
        (lambda: from_sdf(DISK, UNIT, 0.0), "spacing: expected a positive"),
        (lambda: from_sdf(DISK, UNIT, lambda x: 0.1), "spacing: the function returned shape"),
        (lambda: from_sdf(DISK, UNIT, lambda x: x[:, 0]), "spacing: the function returned -"),
        (lambda: from_sdf(DISK, UNIT, 1e-7), "spacing: as small as"),
        (lambda: from_sdf(DISK, ((-1, -1), (1, 1, 1)), 0.1), "bounds: expected"),
        (lambda: from_sdf(DISK, ((1, 1), (-1, -1)), 0.1), "bounds: hi"),
        (lambda: from_sdf(DISK, 5, 0.1), "bounds: expected"),
        (lambda: disk(seed=0.5), "seed"),
        (lambda: disk(groups={"a": lambda x: x[:, 0] > 0}), "groups: .* claimed by none"),
        (lambda: disk(groups={"a": lambda x: x}), r"groups\['a'\]: the predicate returned"),
        (lambda: disk(groups={"a": lambda x: x[:, 0]}), "expected bool"),
        (lambda: disk(groups={"a": lambda x: x[:, 0] > 5, "b": lambda x: x[:, 0] < 9}), "claims no boundary"),
        (lambda: disk(groups={"interior": lambda x: x[:, 0] < 9}), "'interior' is taken"),
        (lambda: disk(groups=[1]), "groups: expected a dict"),
        (lambda: from_polygon([(0, 0), (1, 1), (1, 0), (0, 1)], 0.1), "vertices: crosses or touches itself"),
        (lambda: from_polygon([(0, 0), (1, 0), (0.5, 0), (0.5, 1)], 0.1), "vertices: crosses or touches itself"),
        (lambda: from_polygon([(0, 0), (2, 0), (2, 2), (1, 0), (0, 2)], 0.1), "crosses or touches itself"),
        (lambda: from_polygon(SQUARE, 2.0), "spacing: too coarse"),
        (lambda: from_polygon(SQUARE, 0.7), "spacing: too coarse"),
        (lambda: from_polygon([(1e-3, 0), (1, 0), (1, 1), (0, 1), (0, 1e-3)], 0.1), "spacing: too coarse .* edge"),
        (lambda: from_polygon(SQUARE, 0.1, holes=[SQUARE + 2]), r"holes\[0\]: lies outside"),
        (lambda: from_polygon(SQUARE, 0.1, holes=[SQUARE * 0.5 + 0.8]), r"holes\[0\]: crosses"),
        (lambda: from_polygon(SQUARE, 0.1, holes=[SQUARE * 0.5]), r"holes\[0\]: crosses or touches"),
        (lambda: from_polygon(SQUARE, 0.1, holes=[SQUARE * 0.5 + 0.2, SQUARE * 0.2 + 0.3]), "lies inside of holes"),
        (lambda: from_polygon(SQUARE, 0.1, holes=SQUARE), r"pass holes=\[vertices\]"),
        (lambda: from_polygon(SQUARE.T, 0.1), "vertices: expected an array of shape"),
        (lambda: from_polygon(SQUARE[[0, 1, 1, 2]], 0.1), "vertices: vertex 1"),
        (lambda: from_polygon(SQUARE[:2], 0.1), "at least 3"),
        (lambda: from_polygon(SQUARE + np.nan, 0.1), "not finite"),
        (lambda: quality(js.interval(0, 1, 2)), "cloud: 2 particles"),
    ],
)
def test_bad_input(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_needs_double_precision():
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        disk()
