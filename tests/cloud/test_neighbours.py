"""Stencils against a search by brute force."""

import jax
import manufactured as mm
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud import neighbours as room

CLOUDS = [mm.jittered(1, 12), mm.jittered(2, 7), mm.jittered(3, 4)]


def distances(cloud):
    return np.linalg.norm(cloud.points[:, None] - cloud.points[None], axis=2)


def members(stencils):
    return [set(row[row >= 0].tolist()) for row in np.asarray(stencils.indices)]


def check_layout(stencils, n):
    """The particle itself first, -1 only behind, nobody twice, no column of -1 alone."""
    index = np.asarray(stencils.indices)
    assert len(stencils) == n and index.dtype == np.int32 and stencils.width == index.shape[1]
    assert np.array_equal(index[:, 0], np.arange(n))
    assert (np.diff((index >= 0).astype(int), axis=1) <= 0).all()
    assert (index >= 0).any(axis=0).all()
    assert all(len(row[row >= 0]) == len(set(row[row >= 0].tolist())) for row in index)


@pytest.mark.parametrize("cloud", CLOUDS, ids=["1D", "2D", "3D"])
@pytest.mark.parametrize("size", [2, 5, 9])
def test_nearest(cloud, size):
    found = js.stencils(cloud, size=size)
    check_layout(found, len(cloud))
    apart = distances(cloud)
    reach = np.sort(apart, axis=1)[:, size - 1]
    for i, ids in enumerate(members(found)):
        assert ids == set(np.flatnonzero(apart[i] <= reach[i] * (1 + 1e-6)).tolist())
    assert np.allclose(found.radius, reach, rtol=1e-6)


@pytest.mark.parametrize("cloud", CLOUDS, ids=["1D", "2D", "3D"])
@pytest.mark.parametrize("varying", [False, True])
def test_within_a_radius(cloud, varying):
    radius = np.linspace(0.15, 0.6, len(cloud)) if varying else 0.4
    found = js.stencils(cloud, radius=radius)
    check_layout(found, len(cloud))
    apart = distances(cloud)
    for i, ids in enumerate(members(found)):
        assert ids == set(np.flatnonzero(apart[i] <= np.broadcast_to(radius, len(cloud))[i]).tolist())


def test_a_radius_that_reaches_nobody():
    found = js.stencils(CLOUDS[1], radius=1e-6)
    assert found.width == 1 and members(found) == [{i} for i in range(len(CLOUDS[1]))]


@pytest.mark.parametrize("size, shell", [(2, 5), (5, 5), (6, 9), (10, 13), (14, 21), (22, 25)])
def test_shells_of_a_lattice_are_closed(size, shell):
    """An interior particle's shells on a square lattice hold 5, 9, 13, 21, 25, ... particles."""
    cloud = js.rectangle((0, 0), (1, 1), (9, 9))
    middle = int(np.argmin(np.linalg.norm(cloud.points - 0.5, axis=1)))
    assert len(members(js.stencils(cloud, size=size))[middle]) == shell


def test_many_ties_are_all_found():
    """A ring around its centre: 24 particles at one distance, six asked for."""
    angle = 2 * np.pi * np.arange(24) / 24
    points = np.concatenate([[[0.0, 0.0]], np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    cloud = js.Cloud(points, {"interior": [0], "ring": np.arange(1, 25)})
    found = js.stencils(cloud, size=6)
    assert members(found)[0] == set(range(25))
    check_layout(found, 25)


def test_the_edge_of_a_radius_is_included():
    """0.3 = 3 * 0.1 holds in decimals, not in binary: rounding must not drop the particle."""
    cloud = js.interval(0.0, 1.0, 11)
    assert members(js.stencils(cloud, radius=0.3))[5] == {2, 3, 4, 5, 6, 7, 8}


def test_the_whole_cloud():
    found = js.stencils(CLOUDS[0], size=len(CLOUDS[0]))
    assert members(found) == [set(range(12))] * 12


def test_renumbering_renumbers_the_stencils():
    cloud = CLOUDS[1]
    order = np.random.default_rng(0).permutation(len(cloud))
    place = np.argsort(order)
    shuffled = js.Cloud(cloud.points[order], {name: place[ids] for name, ids in cloud.groups.items()})
    before, after = members(js.stencils(cloud, size=9)), members(js.stencils(shuffled, size=9))
    assert [{int(order[k]) for k in after[place[i]]} for i in range(len(cloud))] == before


@pytest.mark.parametrize("scale, shift", [(1e-8, 0.0), (1e8, 0.0), (1.0, 1e4)])
def test_units_and_origin_do_not_matter(scale, shift):
    cloud = js.rectangle((0, 0), (1, 1), (9, 9))
    moved = cloud.replace(points=cloud.points * scale + shift)
    assert members(js.stencils(cloud, size=9)) == members(js.stencils(moved, size=9))


def test_stencils_are_a_pytree_and_print_briefly():
    found = js.stencils(CLOUDS[1], size=9)
    leaves, shape = jax.tree.flatten(found)
    assert len(leaves) == 2 and np.array_equal(jax.tree.unflatten(shape, leaves).indices, found.indices)
    assert "49 particles" in repr(found) and len(repr(found)) < 100


def stepped():
    """Two lattices side by side, the right one four times finer."""
    coarse = np.stack(np.meshgrid(np.arange(0.0, 1.0, 0.1), np.arange(0.0, 1.01, 0.1)), -1).reshape(-1, 2)
    fine = np.stack(np.meshgrid(np.arange(1.0, 1.501, 0.025), np.arange(0.0, 1.01, 0.025)), -1).reshape(-1, 2)
    return np.concatenate([coarse, fine])


def test_a_jump_in_the_spacing_is_found_and_nothing_else():
    lattice = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), -1).reshape(-1, 2)
    near = room.nearest(lattice, 16)
    assert not len(room.jumps(near.radius, near.indices))
    points = stepped()
    near = room.nearest(points, 16)
    found = room.jumps(near.radius, near.indices)
    assert len(found) and (abs(points[found, 0] - 1.0) < 0.4).all()
    beside = np.flatnonzero(abs(points[:, 0] - 0.9) < 1e-9)
    assert np.isin(beside, found).all()


def test_even_clouds_have_smaller_stencils_except_at_jumps():
    bcs = {"edge": js.dirichlet(0.0)}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) + x[0], bcs)
    size = lambda cloud: (js.solve(problem, cloud, order=6)._fit.neighbours >= 0).sum(axis=1)  # noqa: E731

    def cloud(points):
        edge = (points == points.min(axis=0)).any(axis=1) | (points == points.max(axis=0)).any(axis=1)
        return js.Cloud(points, {"interior": np.flatnonzero(~edge), "edge": np.flatnonzero(edge)})

    rng = np.random.default_rng(0)
    points = stepped()
    inner = ~np.isclose(points, points.min(axis=0)).any(axis=1) & ~np.isclose(points, points.max(axis=0)).any(axis=1)
    points[inner] += rng.uniform(-0.1, 0.1, (inner.sum(), 2)) * np.where(points[inner, :1] < 1.0, 0.1, 0.025)
    counts = size(cloud(points))
    assert np.median(counts) == 22 and np.median(counts[abs(points[:, 0] - 0.9) < 0.02]) >= 28
    random = rng.random((400, 2))
    along, up = np.linspace(0, 1, 20), np.linspace(0, 1, 22)[1:-1]
    random[:80] = np.concatenate(
        [np.stack([along, 0 * along + o], 1) for o in (0, 1)] + [np.stack([0 * up + o, up], 1) for o in (0, 1)]
    )
    assert np.median(size(cloud(random))) >= 28


def test_a_support_that_reaches_outside_of_the_given_stencils_is_reported():
    """Five neighbours in 1D reach two spacings; all twelve particles are cut off by nothing."""
    rod = js.interval(0.0, 1.1, 12)
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)})

    def told(size, d):
        sol = js.solve(problem, rod, kernel=js.Gaussian(h=0.1, d=d), stencils=js.stencils(rod, size=size))
        return "reach outside of the given stencils" in sol.diagnose()

    assert told(5, 3.5)
    assert not told(5, 2.0) and not told(12, 20.0)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_all_pairs_answer_as_the_tree_does(dim):
    points = np.random.default_rng(dim).random((300, dim))
    centres = points[:130]  # more than one piece of rows
    distance, index = room._AllPairs(points).query(centres, 20)
    expected = room._tree(points).query(centres, 20)
    np.testing.assert_array_equal(distance, expected[0])
    np.testing.assert_array_equal(index, expected[1])


def test_the_first_search_of_a_process_gives_the_same_stencils(monkeypatch):
    cloud = js.rectangle((0, 0), (1, 1), (9, 8))  # a lattice, with neighbours equally far
    expected = js.stencils(cloud, size=9)
    monkeypatch.setattr(room, "_searcher", room._AllPairs)
    found = js.stencils(cloud, size=9)
    np.testing.assert_array_equal(np.sort(found.indices), np.sort(expected.indices))
    np.testing.assert_array_equal(found.radius, expected.radius)
