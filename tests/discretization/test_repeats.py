"""Repeated stencils on lattices: found, verified, and without any effect on the answer."""

import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud.neighbours import nearest
from jsmitsm.discretization import repeated_stencils as room

exact = lambda x: jnp.sin(2 * x[0]) * jnp.exp(x[1])
problem = js.Problem(
    lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x),
    {"left": js.dirichlet(exact), "right": js.dirichlet(exact), "top": js.dirichlet(exact),
     "bottom": js.condition(lambda u, x, n: n @ (js.grad(u)(x) - js.grad(exact)(x)))},
)  # fmt: skip


def skipped(sol):
    return [line for line in sol.stats["skipped"] if "repeated" in line]


@pytest.mark.parametrize(("method", "order"), [("S", 8), ("III", 4)])
def test_the_answer_is_the_same(method, order, monkeypatch):
    cloud = js.rectangle((0, 0), (1, 2), (31, 61))
    kernel = None if method == "S" else js.SuperGaussian(cloud.spacing, 3.0)
    fast = js.solve(problem, cloud, method=method, order=order, kernel=kernel)
    monkeypatch.setattr(room, "FEWEST", 10**9)
    slow = js.solve(problem, cloud, method=method, order=order, kernel=kernel)
    assert skipped(fast) and not skipped(slow)
    assert int(skipped(fast)[0].split()[3]) > 1500
    np.testing.assert_allclose(fast.u, slow.u, rtol=1e-10)


def test_scattered_particles_have_none():
    cloud = js.rectangle((0, 0), (1, 2), (31, 61), jitter=0.3)
    assert not skipped(js.solve(problem, cloud, order=8))


def test_small_systems_are_not_worth_the_search():
    assert not skipped(js.solve(problem, js.rectangle((0, 0), (1, 2), (31, 61))))


def found(points, own=None):
    near = nearest(points, 9).indices
    return room.repeats(points, np.arange(len(points)), near, np.zeros((len(points), 0)) if own is None else own)


def lattice():
    x, y = np.meshgrid(np.arange(40) * 0.1, np.arange(40) * 0.07, indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=1)


def test_every_kind_of_place_counts_once():
    """A lattice has 9 kinds of places with the nearest ring: inside, 4 sides, 4 corners; their widths may differ."""
    got = found(lattice())
    assert 9 <= len(got.first) <= 30
    for x in room._offsets(lattice(), np.arange(1600), got.neighbours):
        np.testing.assert_allclose(x, x[got.first][got.of], atol=1e-14)


def test_a_particle_moved_by_little_stands_alone():
    points = lattice()
    points[820] += 1e-7
    inside = found(points)
    assert inside is None or inside.of[820] not in np.delete(inside.of, 820)
    assert found(lattice() + 1e-9 * np.random.default_rng(0).random((1600, 2))) is None


def test_other_conditions_are_another_kind():
    own = np.ones((1600, 1, 2))
    own[:800, 0, 0] = 2.0
    got = found(lattice(), own)
    np.testing.assert_array_equal(own[got.first][got.of], own)
