"""Ways along links: what is long, and what was found before."""

import numpy as np
from scipy.sparse import coo_array

import jsmitsm as js
from jsmitsm.cloud.sight import ways
from jsmitsm.cloud.sight.walls import nearest_seen
from jsmitsm.cloud.sight.ways import Looked, Ways
from jsmitsm.discretization.periodic import periodic_images
from jsmitsm.discretization.supports import walls_of

SLIT = [(0, 0), (1, 0), (1, 1), (-1, 1), (-1, -1), (1, -1), (1, -0.01)]


def walls(cloud):
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": js.dirichlet(0.0)})
    return walls_of(problem, cloud, periodic_images(problem, cloud, np.zeros(len(cloud), bool))[0])


def test_a_way_round_is_long_and_a_straight_one_is_not():
    """A ladder of two rows of points that only its far end joins."""
    x = np.arange(6.0)
    points = np.concatenate([np.stack([x, 0 * x], 1), np.stack([x, 0 * x + 1.0], 1)])
    a = np.array([0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 5])
    b = np.array([1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 11])
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(12, 12)).tocsr()
    found = Ways(points, np.arange(12), np.ones(12), graph)
    near, rows = np.array([[0, 1, 2, 6, -1], [4, 3, 5, 10, -1]]), np.array([0, 4])
    assert found.long(near, rows).tolist() == [[False, False, False, True, False], [False] * 3 + [True, False]]
    assert not found.long(np.array([[5, 11]]), np.array([5])).any()


def test_answers_are_kept_for_nearer_neighbours_and_forgotten_where_there_are_too_many(monkeypatch):
    looked = Looked(10)
    near, behind = np.array([[3, 1, 2], [4, 5, -1]]), np.array([[False, True, False], [True, False, False]])
    looked.add(near, np.array([3, 4]), behind)
    assert looked.known(near[:, :2], np.array([3, 4])).all() and not looked.known(near, np.array([3, 5])).all()
    assert not looked.known(np.array([[3, 2]]), np.array([3])).any()  # others were asked about
    assert looked.answer(np.array([4, 3]), 2).tolist() == [[True, False], [False, True]]
    looked.add(np.array([[4, 5, 6, 7]]), np.array([4]), np.array([[True, False, True, False]]))
    assert looked.known(np.array([[4, 5, 6, 7]]), np.array([4])).all() and looked.known(near[:1], np.array([3])).all()
    monkeypatch.setattr(ways, "_KEPT", 8)
    looked.add(np.array([[0, 1]]), np.array([0]), np.zeros((1, 2), bool))
    assert looked.known(np.array([[0, 1]]), np.array([0])).all() and not looked.known(near[:1], np.array([3])).any()


def test_asked_twice_a_cloud_with_a_slit_says_the_same():
    """In decades of spacing around its tip, where a search goes by particles of about one spacing."""
    cloud = js.from_polygon(SLIT, lambda x: np.clip(0.25 * np.linalg.norm(x, axis=1), 1e-5, 0.1))
    points, one = np.asarray(cloud.points), walls(cloud)
    wide = np.asarray(nearest_seen(points, 40, None, one).indices)
    again = np.asarray(nearest_seen(points, 40, None, one).indices)
    assert np.array_equal(wide, again)
    narrow = np.asarray(nearest_seen(points, 20, None, one).indices)
    assert np.array_equal(narrow, np.asarray(nearest_seen(points, 20, None, walls(cloud)).indices))
    # Beyond a few spacings from the tip nobody sees across the slit.
    r = np.linalg.norm(points, axis=1)
    beside = (points[:, 0] > 0.3) & (np.abs(points[:, 1]) < 0.15)
    side = np.where(beside, np.sign(points[:, 1] + 0.005 * points[:, 0]), 0.0)
    far = (r > 0.3) & (side != 0)
    across = (side[narrow] * side[:, None] < 0) & (narrow >= 0)
    assert far.sum() > 20 and not across[far].any()
