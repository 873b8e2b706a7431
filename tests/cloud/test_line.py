"""Intervals by their spacing, and paths that follow any grading."""

import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud.lattices.path import followed


def test_a_number_gives_the_lattice():
    assert np.allclose(js.interval(-1.0, 2.0, spacing=0.25).points, js.interval(-1.0, 2.0, 13).points, atol=1e-14)


def test_gaps_follow_a_function():
    """Every gap is the spacing in its middle, up to the one factor that makes the ends particles."""
    rule = lambda x: 0.001 + 0.1 * np.abs(x[:, 0] - 0.3)
    cloud = js.interval(0.0, 1.0, spacing=rule)
    x = np.asarray(cloud.points)[:, 0]
    gap, middle = np.diff(x), (x[1:] + x[:-1]) / 2
    ratio = gap / rule(middle[:, None])
    # The spacing has a kink and changes by a tenth across a gap.
    assert ratio == pytest.approx(np.full(len(gap), ratio.mean()), rel=0.04)
    assert ratio.mean() == pytest.approx(1.0, abs=0.02)
    assert (cloud.points[0], cloud.points[-1]) == (0.0, 1.0)
    assert list(cloud.groups["left"]) == [0] and list(cloud.groups["right"]) == [len(x) - 1]
    assert cloud.normals[0] == -1.0 and cloud.normals[-1] == 1.0


def test_nine_decades_of_spacing():
    x = np.asarray(js.interval(0.0, 1.0, spacing=lambda x: 1e-9 + 0.2 * x[:, 0]).points)[:, 0]
    assert x[1] == pytest.approx(1e-9, rel=0.2)
    assert len(x) == pytest.approx(np.log1p(0.2 / 1e-9) / 0.2, rel=0.02)  # the integral of one over the spacing


def test_a_path_ends_where_it_should():
    a, b = np.array([0.0, 1.0]), np.array([2.0, 3.0])
    path = followed(a, b, lambda x: 1e-6 + 0.1 * np.linalg.norm(x - b, axis=1))
    assert (path[0] == a).all() and (path[-1] == b).all()
    assert np.linalg.norm(path[-1] - path[-2]) < 1e-6


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"n": 5, "spacing": 0.1}, "n, spacing: got both"),
        ({"spacing": 3.0}, "spacing: too coarse for the shape"),
        ({"spacing": -1.0}, "spacing: expected a positive finite number or a function"),
        ({"spacing": lambda x: x}, "spacing: the function returned shape"),
    ],
)
def test_bad_input_is_told(given, said):
    with pytest.raises(ValueError, match=said):
        js.interval(0.0, 1.0, **given)
