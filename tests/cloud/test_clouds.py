"""Clouds: lattices, groups, normals, and what a cloud keeps."""

import pickle

import jax
import numpy as np
import pytest

import jsmitsm as js

LATTICES = [
    pytest.param(js.interval(-1.0, 2.0, 7), (7,), (-1.0,), (2.0,), id="interval"),
    pytest.param(js.rectangle((0, -1), (4, 9), (5, 6)), (5, 6), (0, -1), (4, 9), id="rectangle"),
    pytest.param(js.rectangle((0, -1), (4, 9), (5, 6), jitter=0.4), (5, 6), (0, -1), (4, 9), id="jittered"),
    pytest.param(js.box((0, 0, 0), (1, 2, 3), (3, 4, 5)), (3, 4, 5), (0, 0, 0), (1, 2, 3), id="box"),
    pytest.param(js.box((0, 0, 0), (1, 2, 3), (3, 4, 5), 0.3), (3, 4, 5), (0, 0, 0), (1, 2, 3), id="jittered-box"),
]
SIDES = ("left", "right", "bottom", "top", "front", "back")


@pytest.mark.parametrize("cloud, shape, lo, hi", LATTICES)
def test_groups_partition_the_lattice(cloud, shape, lo, hi):
    dim = len(shape)
    assert set(cloud.groups) == {"interior", *SIDES[: 2 * dim]}
    everyone = np.concatenate(list(cloud.groups.values()))
    assert np.array_equal(np.sort(everyone), np.arange(len(cloud)))
    assert len(cloud) == np.prod(shape) and cloud.points.shape == (len(cloud), dim) and cloud.dim == dim
    assert len(cloud.groups["interior"]) == np.prod(np.array(shape) - 2)
    assert np.array_equal(cloud.boundary, np.setdiff1d(np.arange(len(cloud)), cloud.groups["interior"]))


@pytest.mark.parametrize("cloud, shape, lo, hi", LATTICES)
def test_sides_lie_where_they_are_named(cloud, shape, lo, hi):
    """A corner belongs to the first side that claims it: left, right, bottom, top, front, back."""
    x = cloud.points
    on = [np.isclose(x[:, k // 2], (hi if k % 2 else lo)[k // 2]) for k in range(2 * len(shape))]
    claimed = np.zeros(len(cloud), bool)
    for name, side in zip(SIDES, on):
        assert np.array_equal(cloud.groups[name], np.flatnonzero(side & ~claimed)), name
        claimed |= side
    assert np.array_equal(cloud.groups["interior"], np.flatnonzero(~claimed))


@pytest.mark.parametrize("cloud, shape, lo, hi", LATTICES)
def test_normals_point_outward(cloud, shape, lo, hi):
    middle = (np.array(lo) + np.array(hi)) / 2
    edge = cloud.boundary
    assert np.array_equal(np.linalg.norm(cloud.normals[edge], axis=1), np.ones(len(edge)))
    assert (np.sum(cloud.normals[edge] * (cloud.points[edge] - middle), axis=1) > 0).all()
    assert np.isnan(cloud.normals[cloud.groups["interior"]]).all()
    for k, name in enumerate(SIDES[: 2 * len(shape)]):
        assert (cloud.normals[cloud.groups[name], k // 2] == (1.0 if k % 2 else -1.0)).all()


def test_an_interval_ascends():
    cloud = js.interval(0.0, 2.0, 20)
    assert np.array_equal(cloud.points, np.linspace(0.0, 2.0, 20)[:, None])
    assert cloud.groups["left"].tolist() == [0] and cloud.groups["right"].tolist() == [19]


def test_jitter_moves_interior_particles_only_and_reproducibly():
    plain, moved, again, other = (
        js.rectangle((0, 0), (4, 1), (9, 9), jitter=j, seed=s) for j, s in ((0, 0), (0.4, 0), (0.4, 0), (0.4, 1))
    )
    shift = np.abs(moved.points - plain.points) / [0.5, 0.125]
    assert shift.max() <= 0.4 and shift[plain.groups["interior"]].max() > 0.3
    assert shift[plain.boundary].max() == 0
    assert np.array_equal(moved.points, again.points) and not np.array_equal(moved.points, other.points)


def test_spacing_is_the_smallest_distance():
    cloud = js.rectangle((0, 0), (1, 2), (6, 6), jitter=0.3)
    apart = np.linalg.norm(cloud.points[:, None] - cloud.points[None], axis=2)
    # The tree and the norm sum squares in another order: a few units in the last place.
    assert cloud.spacing == pytest.approx(apart[apart > 0].min(), rel=1e-14)
    assert js.rectangle((0, 0), (4, 9), (5, 10)).spacing == pytest.approx(1.0, rel=1e-14)


def test_a_cloud_is_a_pytree_with_static_groups():
    cloud = js.rectangle((0, 0), (1, 1), (4, 4))
    leaves, shape = jax.tree.flatten(cloud)
    assert [leaf.shape for leaf in leaves] == [(16, 2), (16, 2)]
    back = jax.tree.unflatten(shape, leaves)
    assert back.groups == cloud.groups and back.spacing == cloud.spacing
    assert shape == jax.tree.structure(js.rectangle((5, 5), (6, 7), (4, 4))), "equal groups: one compiled program"
    assert shape != jax.tree.structure(js.rectangle((0, 0), (1, 1), (4, 5)))
    moved = jax.jit(lambda c: c.replace(points=2 * c.points))(cloud)
    assert moved.spacing == pytest.approx(2 * cloud.spacing) and moved.groups == cloud.groups


def test_a_cloud_of_bare_points_has_one_leaf():
    bare = js.Cloud([[0.0], [0.5], [1.0]], {"interior": [1], "ends": [0, 2]})
    assert len(jax.tree.leaves(bare)) == 1 and bare.normals is None


def test_replace_forgets_the_spacing():
    cloud = js.interval(0.0, 1.0, 5)
    assert cloud.spacing == 0.25
    assert cloud.replace(points=3 * cloud.points).spacing == pytest.approx(0.75)
    assert cloud.replace(normals=cloud.normals).spacing == 0.25


def test_groups_are_immutable():
    cloud = js.interval(0.0, 1.0, 5)
    with pytest.raises(ValueError):
        cloud.groups["left"][0] = 3
    with pytest.raises(TypeError):
        cloud.groups["left"] = np.array([3])


def test_a_group_may_be_empty():
    """On a 2 x 2 lattice left and right claim all corners."""
    cloud = js.rectangle((0, 0), (1, 1), (2, 2))
    assert len(cloud.groups["bottom"]) == len(cloud.groups["interior"]) == 0


def test_single_precision_stays():
    assert js.Cloud(np.zeros((1, 2), np.float32), {"interior": [0]}).points.dtype == np.float32
    assert js.Cloud(np.zeros((1, 2), int), {"interior": [0]}).points.dtype == np.float64


def test_interior_normals_are_ignored():
    cloud = js.Cloud([[0.0], [0.5], [1.0]], {"interior": [1], "ends": [0, 2]}, [[-1.0], [0.0], [1.0]])
    assert np.isnan(cloud.normals[1, 0]) and cloud.normals[2, 0] == 1.0


def test_pickle_and_repr():
    cloud = js.box((0, 0, 0), (1, 1, 1), (3, 3, 3), jitter=0.1)
    back = pickle.loads(pickle.dumps(cloud))
    assert np.array_equal(back.points, cloud.points) and back.groups == cloud.groups
    assert repr(cloud).startswith("Cloud(27 particles in 3D") and len(repr(cloud)) < 160
