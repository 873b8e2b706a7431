"""Integrals where polynomials through boundary particles go astray: gaps, sharp tips, bores."""

import numpy as np
import pytest

import jsmitsm as js


def area_and_length(vertices):
    p, q = np.asarray(vertices), np.roll(vertices, -1, axis=0)
    return abs(np.sum(p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1])) / 2, np.linalg.norm(q - p, axis=1).sum()


def spiral(gap):
    t = np.linspace(0, 4 * np.pi, 161)
    r, width = 0.3 + 0.05 * t, 0.1 * np.pi - gap
    inner, outer = (np.stack([radius * np.cos(t), radius * np.sin(t)], 1) for radius in (r, r + width))
    return np.concatenate([inner, outer[::-1]])


@pytest.mark.parametrize(("gap", "spacing"), [(0.03, 0.04), (0.01, 0.05), (0.005, 0.04)])
def test_across_the_gap_of_a_spiral(gap, spacing):
    """The facets of one turn saw the particles of the next: areas were off by up to 1e67."""
    cloud = js.from_polygon(spiral(gap), spacing)
    area, length = area_and_length(spiral(gap))
    assert js.quadrature(cloud).weights.sum() == pytest.approx(area, rel=2e-3)
    assert js.quadrature(cloud, "boundary").weights.sum() == pytest.approx(length, rel=5e-3)


def test_in_a_thin_triangle():
    tip = [(0, -0.0524), (0, 0.0524), (2.0, 0)]
    cloud = js.from_polygon(tip, 0.05)
    area, length = area_and_length(tip)
    assert js.quadrature(cloud).weights.sum() == pytest.approx(area, rel=1e-6)
    assert js.quadrature(cloud, "boundary").weights.sum() == pytest.approx(length, rel=1e-6)


def test_around_a_bore():
    bounds = ((0, 0, 0), (1, 1, 1))
    bore = js.sdf.cylinder((0.5, 0.5, -1), (0.5, 0.5, 2), 0.25)
    cloud = js.from_sdf(js.sdf.difference(js.sdf.box(*bounds), bore), bounds, 0.125)
    assert js.quadrature(cloud).weights.sum() == pytest.approx(1 - np.pi / 16, rel=5e-3)
    assert js.quadrature(cloud, "boundary").weights.sum() == pytest.approx(6 + np.pi * 3 / 8, rel=2e-2)
