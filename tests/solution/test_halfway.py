"""Places on the way to the nearest neighbours: all of them, in whatever portions they are looked at."""

import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.solution.look import halfway


@pytest.fixture(scope="module")
def disc():
    sides = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
    square = js.rectangle((0, 0), (1, 1), (9, 9), jitter=0.3)
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, sides), square)._report.disc


def test_the_mean_of_what_is_found_halfway(disc):
    """Of the offset's square: a quarter of the neighbours' squared distances, and nothing at the particle itself."""
    ids, mean = halfway.around(disc, disc.classes, lambda at, there, offset: np.square(offset).sum(axis=1)[None])
    points = np.asarray(disc.points)
    away = np.sort(np.square(points[ids][:, None] - points).sum(axis=2), axis=1)[:, 1:9]
    np.testing.assert_allclose(mean[0], 0.25 * away.sum(axis=1) / 9.0, rtol=1e-13)


def test_the_largest_of_several_places_counts(disc):
    left = lambda at, there, offset: np.hypot(*offset.T)[None]
    far, both = (halfway.around(disc, disc.classes, left, ways)[1] for ways in ((0.5,), (0.25, 0.5)))
    np.testing.assert_allclose(both, far, rtol=1e-14)


def test_portions_change_nothing(disc, monkeypatch):
    points = np.asarray(disc.points)
    left = lambda at, there, offset: np.sin(9.0 * there[:, :1].T) * offset[:, 1] + points[at][:, 0]
    whole = halfway.around(disc, disc.classes, left, (0.5, 0.25))
    monkeypatch.setattr(halfway, "_TOGETHER", 50)
    for one, other in zip(whole, halfway.around(disc, disc.classes, left, (0.5, 0.25))):
        np.testing.assert_array_equal(one, other)
