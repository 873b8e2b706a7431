"""Clouds of several regions: copies on interfaces, their normals and groups, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.runtime.errors import TooCoarse
from jsmitsm.solution.regions.located import located

BOX = ((-1.0, -1.0), (1.0, 1.0))
DISK = js.sdf.circle((0.1, 0.0), 0.5)
AROUND = js.sdf.difference(js.sdf.rectangle(*BOX), DISK)
TANGENT = js.sdf.circle((-0.4, 0.0), 0.4), js.sdf.circle((0.4, 0.0), 0.4)


def corners(x0, y0, x1, y1):
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


@pytest.fixture(scope="module")
def inclusion():
    return js.regions({"in": DISK, "out": AROUND}, BOX, 0.15)


def test_a_closed_interface_has_copies_at_one_point_and_normals_from_the_first(inclusion):
    pairs, normals = inclusion.interfaces["in|out"], inclusion.interface_normals["in|out"]
    points = inclusion.points
    assert (points[pairs[:, 0]] == points[pairs[:, 1]]).all()
    outward = (points[pairs[:, 0]] - [0.1, 0.0]) / 0.5
    assert np.abs(normals - outward).max() < 1e-12  # gradients of a circle's distance, to round-off
    assert np.abs(inclusion.normals[pairs] - outward[:, None]).max() < 1e-12
    assert sorted(inclusion.groups["in|out"]) == sorted(pairs.ravel())
    # The region's own cloud has outward normals.
    inner = inclusion.region("out")
    at, n = inner.points[inner.groups["in|out"]], inner.normals[inner.groups["in|out"]]
    assert (np.einsum("nd,nd->n", at - [0.1, 0.0], n) < 0).all()


def test_regions_part_all_particles(inclusion):
    distance = np.array(jax.vmap(DISK)(inclusion.points))
    assert (distance[inclusion.regions["in"]] < 1e-12).all()
    assert (distance[inclusion.regions["out"]] > -1e-12).all()
    assert len(inclusion) == sum(map(len, inclusion.regions.values()))
    assert inclusion.spacing > 0.5 * 0.15


@pytest.mark.parametrize("kind", ["polygons", "distances", "shapely"])
def test_where_three_regions_meet_each_has_a_copy_and_every_pair_its_own_normal(kind):
    corner = {"a": (-1, -1, 0, 1), "b": (0, -1, 1, 0), "c": (0, 0, 1, 1)}
    if kind == "distances":
        shapes = {name: js.sdf.rectangle(c[:2], c[2:]) for name, c in corner.items()}
    elif kind == "shapely":
        shapely = pytest.importorskip("shapely")
        shapes = {name: shapely.box(*c) for name, c in corner.items()}
    else:
        shapes = {name: corners(*c) for name, c in corner.items()}
    sides = {"left": lambda x: x[:, 0] < -1 + 1e-9, "rest": lambda x: x[:, 0] > -2}
    cloud = js.regions(shapes, BOX, 0.25, groups=sides)
    there = np.flatnonzero((np.abs(cloud.points) < 1e-12).all(axis=1))
    assert len(there) == 3
    assert list(cloud.interfaces) == ["a|b", "a|c", "b|c"]
    for name, normal in (("a|b", (1, 0)), ("a|c", (1, 0)), ("b|c", (0, 1))):
        assert np.abs(cloud.interface_normals[name] - normal).max() < 1e-6, name
        assert len(cloud.interfaces[name]) == 5
    # Ends of interfaces belong to the outer boundary, with its normal.
    end = np.flatnonzero((np.abs(cloud.points - [0, 1]) < 1e-12).all(axis=1))
    assert len(end) == 2 and np.isin(end, cloud.groups["rest"]).all()
    assert np.abs(cloud.normals[end] - [0, 1]).max() < 1e-6


@pytest.mark.parametrize("first", ["in", "out"])
def test_a_curve_ends_on_the_boundary_where_the_other_shape_touches_zero(first):
    """A half disk on a side of the box: the difference of the two is zero all along that piece of the side."""
    half = js.sdf.intersection(js.sdf.circle((-1.0, 0.0), 0.5), js.sdf.rectangle(*BOX))
    shapes = {"in": half, "out": js.sdf.difference(js.sdf.rectangle(*BOX), half)}
    cloud = js.regions({n: shapes[n] for n in (first, *(set(shapes) - {first}))}, BOX, 0.2)
    (pairs,) = cloud.interfaces.values()
    at = cloud.points[pairs[:, 0]]
    assert np.abs(np.linalg.norm(at + [1.0, 0.0], axis=1) - 0.5).max() < 1e-12 and 7 <= len(pairs) <= 11
    ends = pairs[at[:, 0] < -1 + 1e-12]
    assert len(ends) == 2 and np.isin(ends, cloud.groups["boundary"]).all()
    assert np.abs(cloud.normals[ends] - [-1.0, 0.0]).max() < 1e-6
    side = cloud.points[cloud.regions["out"]]
    assert (np.abs(side[side[:, 0] < -1 + 1e-12, 1]) > 0.5 - 1e-9).all()


def test_layers_of_a_wall_share_their_ends():
    cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 2.0)}, spacing=lambda x: np.where(x[:, 0] < 0.5, 0.1, 0.3))
    assert cloud.points[cloud.interfaces["a|b"]].tolist() == [[[0.5], [0.5]]]
    assert [len(ids) for ids in cloud.regions.values()] == [6, 6]
    assert cloud.interface_normals["a|b"].tolist() == [[1.0]]


def test_space_takes_closed_surfaces_alone():
    ball, unit = js.sdf.sphere((0, 0, 0), 0.5), ((-1.0,) * 3, (1.0,) * 3)
    cloud = js.regions({"in": ball, "out": js.sdf.difference(js.sdf.sphere((0, 0, 0), 1.0), ball)}, unit, 0.3)
    pairs = cloud.interfaces["in|out"]
    assert np.abs(np.linalg.norm(cloud.points[pairs], axis=2) - 0.5).max() < 1e-12
    halves = {"low": js.sdf.box((-1, -1, -1), (1, 1, 0)), "high": js.sdf.box((-1, -1, 0), (1, 1, 1))}
    with pytest.raises(ValueError, match="in 3D an interface ends.*closed surfaces"):
        js.regions(halves, ((-1.5,) * 3, (1.5,) * 3), 0.4)


def test_the_side_of_a_point_is_that_of_the_true_shape():
    """A square with corners, and a star whose normals turn by 25 degrees between particles."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (1500, 2))
    inner = corners(-0.5, -0.5, 0.5, 0.5)
    shapely = pytest.importorskip("shapely")
    cloud = js.regions({"in": inner, "out": shapely.Polygon(corners(-1, -1, 1, 1), [inner])}, spacing=0.12)
    assert (located(cloud, x) == (np.abs(x).max(axis=1) > 0.5)).all()

    def star(x):
        return jnp.sqrt(x @ x + 1e-30) - 0.5 - 0.1 * jnp.cos(5 * jnp.arctan2(x[1], x[0]))

    cloud = js.regions({"in": star, "out": js.sdf.difference(js.sdf.rectangle(*BOX), star)}, BOX, 0.08)
    wrong = located(cloud, x) != (jax.vmap(star)(x) > 0)
    # Between particles 0.08 apart on a curve of radius 0.06 the third order decides: a thin sliver.
    assert np.abs(jax.vmap(star)(x[wrong])).max(initial=0.0) < 5e-3


@pytest.mark.parametrize(
    ("shapes", "told"),
    [
        ({"in": DISK, "out": js.sdf.rectangle(*BOX)}, "overlap.*js.sdf.difference"),
        ({"a": corners(-1, -1, 0, 1), "b": corners(-0.1, -1, 1, 1)}, "'a' overlaps"),
        ({"a": corners(-1, -1, 0, 1), "b": corners(0.01, -1, 1, 1)}, "gap between 'b' and 'a'.*touch exactly"),
        ({"a": corners(-1, -1, 0, 1), "b": corners(0.4, -1, 1, 1)}, "touches no other region"),
        ({"a": corners(-1, -1, 0, 1), "b": corners(0, -1, 0.02, 1)}, r"too coarse.*edge of shapes\['b'\]"),
        ({"a": corners(-1, -1, 0, 1), "b": corners(0, -1, 0.15, 1)}, r"shapes\['b'\].*too small for the spacing"),
        ({"a|b": DISK}, "'a|b' cannot name a region"),
        ({"a": 3.0}, r"shapes\['a'\]: expected a signed distance.*polygon.*layer"),
        ({}, "expected a dict"),
        ({"a": (0.0, 0.5), "b": (0.6, 1.0)}, "touches no other region"),
        ({"a": (0.0, 0.5), "b": DISK}, "different dimensions"),
        ({"a": corners(-1, -1, 0, 0), "b": corners(0, 0, 1, 1)}, "'a' and 'b' touch in a point alone"),
        ({"out": js.sdf.difference(js.sdf.rectangle(*BOX), js.sdf.union(*TANGENT))}, r"shapes\['out'\]: .*touch in a"),
    ],
)
def test_shapes_that_do_not_fit_are_named_with_the_remedy(shapes, told):
    with pytest.raises(ValueError, match=told):
        js.regions(shapes, BOX, 0.2)


@pytest.mark.parametrize("thick", [1e-2, 1e-3, 1e-4])
def test_a_layer_thinner_than_the_spacing_is_no_overlap(thick):
    """Even where the probes that look for its boundary step over it."""
    layers = {"brick": (0.0, 0.4), "foil": (0.4, 0.4 + thick), "wool": (0.4 + thick, 1.0)}
    with pytest.raises(TooCoarse, match=r"'foil'\]: .*too small for"):
        js.regions(layers, spacing=0.05)


def test_bounds_and_spacing_are_asked_for():
    with pytest.raises(ValueError, match="bounds: needed for the signed distance"):
        js.regions({"a": DISK}, spacing=0.2)
    with pytest.raises(ValueError, match="spacing: not given"):
        js.regions({"a": (0.0, 1.0)})


def test_copies_stay_pairs():
    cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.25)
    i, j = cloud.interfaces["a|b"][0]
    moved = np.array(cloud.points)
    moved[i] += 0.01
    with pytest.raises(ValueError, match="copies with unequal positions"):
        cloud.replace(points=moved)
    moved[j] += 0.01
    assert cloud.replace(points=moved).points[j, 0] == 0.51
    parts = [cloud.points, dict(cloud.groups), cloud.normals, dict(cloud.regions)]
    with pytest.raises(ValueError, match="unpaired particle"):
        RegionCloud(*parts, {"a|b": np.zeros((0, 2), int)}, {"a|b": np.zeros((0, 1))})
    with pytest.raises(ValueError, match="belong to no region"):
        RegionCloud(*parts[:3], {"a": cloud.regions["a"]}, {}, {})
    with pytest.raises(ValueError, match="'c' is none of the cloud's"):
        cloud.region("c")


def test_neighbours_quadrature_and_quality_respect_the_regions(inclusion):
    near = np.asarray(js.stencils(inclusion, size=12).indices)
    owner = np.zeros(len(inclusion), int)
    owner[inclusion.regions["out"]] = 1
    assert (owner[near][near >= 0] == np.broadcast_to(owner[:, None], near.shape)[near >= 0]).all()
    assert abs(js.quadrature(inclusion).weights.sum() - 4.0) < 1e-3  # arcs of both sides, 20 particles round the circle
    rule = js.quadrature(inclusion, "in|out")
    assert abs(rule.weights.sum() / np.pi - 1) < 1e-3  # cubic arcs of a circle at 20 particles
    assert (np.einsum("qd,qd->q", rule.normals, rule.points - [0.1, 0]) > 0).all()
    assert js.quality(inclusion).mesh_ratio < 3


def test_a_mesh_with_tagged_cells_is_a_cloud_of_regions():
    meshio = pytest.importorskip("meshio")
    n = 5
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    left, low = x[:-1, :-1].ravel() < 0.5, y[:-1, :-1].ravel() < 0.5
    tag = np.where(left, 1, np.where(low, 2, 3))
    names = {"steel": np.array([1, 2]), "air": np.array([2, 2]), "wool": np.array([3, 2])}
    mesh = meshio.Mesh(
        np.stack([x.ravel(), y.ravel()], axis=1), [("quad", np.stack([a, b, c, d], axis=1))],
        cell_data={"gmsh:physical": [tag]}, field_data=names,
    )  # fmt: skip
    cloud = js.files.from_mesh(mesh, regions=True)
    assert [len(ids) for ids in cloud.regions.values()] == [15, 9, 9]
    assert list(cloud.interfaces) == ["steel|air", "steel|wool", "air|wool"]
    assert np.abs(cloud.interface_normals["air|wool"] - [0, 1]).max() < 1e-12
    assert list(js.files.from_mesh(mesh, regions=["wool", "steel", "air"]).interfaces)[0] == "wool|steel"
    with pytest.raises(ValueError, match="quad cell|'quad' cell 0 belongs to no region"):
        js.files.from_mesh(mesh, regions=["air", "wool"])


def test_a_mesh_in_space_with_tagged_cells_has_pairs_on_the_facets_between():
    """Hexahedra: a cube in a cube, and three regions that meet along a line."""
    meshio = pytest.importorskip("meshio")
    n = 5
    nodes = np.stack(np.meshgrid(*[np.linspace(0, 1, n)] * 3, indexing="ij"), axis=-1)
    at = np.arange(n**3).reshape(n, n, n)
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    ends = lambda i: slice(i, n - 1 + i)  # noqa: E731
    cells = np.stack([at[ends(i), ends(j), ends(k)].ravel() for i, j, k in corners], axis=1)
    middle = nodes.reshape(-1, 3)[cells].mean(axis=1)

    def made(tag):
        mesh = meshio.Mesh(nodes.reshape(-1, 3), [("hexahedron", cells)], cell_data={"gmsh:physical": [tag]})
        return js.files.from_mesh(mesh, regions=True)

    cloud = made(np.where((np.abs(middle - 0.5) < 0.25).all(axis=1), 1, 2))
    pairs, normals = cloud.interfaces["1|2"], cloud.interface_normals["1|2"]
    points = cloud.points[pairs]
    assert len(pairs) == 26 and (points[:, 0] == points[:, 1]).all()  # all nodes of the inner cube but its middle
    face = (points[:, 0] == [0.75, 0.5, 0.5]).all(axis=1)
    assert np.abs(normals[face] - [1.0, 0.0, 0.0]).max() < 1e-12
    side = middle[:, 0] < 0.5
    three = made(np.where(side, 1, np.where(middle[:, 1] < 0.5, 2, 3)))
    assert {name: len(p) for name, p in three.interfaces.items()} == {"1|2": 15, "1|3": 15, "2|3": 15}


def test_a_lattice_is_cut_by_predicates():
    """Cells belong to whom their middle satisfies: copies and normals along the sides of cells, an L for a domain."""
    halves = {"a": lambda x: x[:, 0] < 0.5, "b": lambda x: (x[:, 0] > 0.5) & (x[:, 1] < 0.5)}
    sides = {"left": lambda x: x[:, 0] < 1e-9, "rest": lambda x: x[:, 0] > -1.0}
    cloud = js.regions(halves, ((0, 0), (1, 1)), lattice=(9, 9), groups=sides)
    assert [len(ids) for ids in cloud.regions.values()] == [45, 25] and len(cloud.groups["left"]) == 9
    assert len(cloud.interfaces["a|b"]) == 5 and np.array_equal(cloud.interface_normals["a|b"], [[1.0, 0.0]] * 5)
    corner = next(i for i in cloud.groups["rest"] if np.array_equal(cloud.points[i], [1.0, 0.5]))
    assert np.allclose(cloud.normals[corner], [0.5**0.5, 0.5**0.5]) and cloud.spacing == 0.125
    inside = lambda x: (np.abs(x) < 0.3).all(axis=1)  # noqa: E731
    space = js.regions({"in": inside, "out": lambda x: ~inside(x)}, ((-1,) * 3, (1,) * 3), lattice=(11,) * 3)
    assert len(space.regions["in"]) == 64 and len(space.interfaces["in|out"]) == 56
    disk = js.sdf.circle((0.0, 0.0), 0.5)
    rings = js.regions({"in": disk, "out": lambda x: np.hypot(*x.T) > 0.5}, ((-1, -1), (1, 1)), lattice=(9, 9))
    assert len(rings.interfaces["in|out"]) == 16  # around twelve cells
    box = {"bounds": ((0, 0), (1, 1)), "lattice": (9, 9)}
    checks = lambda x: (x[:, 0] < 0.5) == (x[:, 1] < 0.5)  # noqa: E731
    for shapes, more, told in [
        ({**halves, "c": lambda x: x[:, 1] > 0.4}, {}, "'a' and 'c' overlap"),
        ({**halves, "c": lambda x: x[:, 1] > 4}, {}, "holds the middle of no cell"),
        ({"a": checks, "b": lambda x: ~checks(x)}, {}, "touch in a point alone"),
        ({"a": [(0, 0), (1, 0), (1, 1)]}, {}, "expected a predicate"),
        (halves, {"lattice": 9}, "expected 2 whole numbers from 3"),
        (halves, {"spacing": 0.1}, "no spacing"),
    ]:
        with pytest.raises(ValueError, match=told):
            js.regions(shapes, **{**box, **more})
