"""Integrals over solids with edges, on which no particles stand: facets reach across them."""

import pickle
import warnings

import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud.quadrature import rule
from jsmitsm.cloud.triangulation import boundary_facets

CAPS = {
    "bottom": lambda x: x[:, 2] < -0.7 + 1e-6,
    "top": lambda x: x[:, 2] > 0.7 - 1e-6,
    "side": lambda x: abs(x[:, 2]) < 0.7 - 1e-6,
}
PLATE = {
    "flat": lambda x: (abs(x[:, 2]) < 1e-6) | (abs(x[:, 2] - 0.5) < 1e-6),
    "hole": lambda x: np.hypot(x[:, 0] - 0.5, x[:, 1] - 0.5) < 0.2 + 1e-6,
    "outer": lambda x: x[:, 0] > -1,
}


def unit_box(height=1.0):
    return js.sdf.box((0, 0, 0), (1, 1, height))


def cylinder(spacing):
    sdf = js.sdf.cylinder((0, 0, -0.7), (0, 0, 0.7), 0.5)
    return js.from_sdf(sdf, ((-0.6, -0.6, -0.8), (0.6, 0.6, 0.8)), spacing, groups=CAPS)


def plate(spacing):
    sdf = js.sdf.difference(unit_box(0.5), js.sdf.cylinder((0.5, 0.5, -1), (0.5, 0.5, 1), 0.2))
    return js.from_sdf(sdf, ((-0.1,) * 3, (1.1, 1.1, 0.6)), spacing, groups=PLATE)


def bitten(spacing):
    """A box without an eighth of a ball at a corner."""
    return js.from_sdf(js.sdf.difference(unit_box(), js.sdf.sphere((1, 1, 1), 0.5)), ((-0.1,) * 3, (1.1,) * 3), spacing)


def angle(spacing):
    sdf = js.sdf.difference(unit_box(0.5), js.sdf.box((0.5, 0.5, -1), (2, 2, 2)))
    return js.from_sdf(sdf, ((-0.1,) * 3, (1.1, 1.1, 0.6)), spacing)


def wedge(spacing):
    """Of 31 degrees."""
    slope = lambda x: (x[2] - 0.6 * x[0]) / np.sqrt(1.36)
    return js.from_sdf(js.sdf.intersection(unit_box(), slope), ((-0.1,) * 3, (1.1,) * 3), spacing)


def ring(spacing):
    return js.from_sdf(js.sdf.torus((0, 0, 0), 1.0, 0.4), ((-1.5, -1.5, -0.5), (1.5, 1.5, 0.5)), spacing)


def outflow(found):
    """Through the boundary, of the gradient of x^2 + 2 y^2 + 3 z^2 + x y, whose divergence is 12."""
    x, y, z = found.points.T
    return np.sum(found.weights * np.sum(np.stack([2 * x + y, 4 * y + x, 6 * z], axis=1) * found.normals, axis=1))


@pytest.mark.parametrize("make, spacing, areas, volume", [
    (cylinder, 0.2, {"bottom": np.pi / 4, "top": np.pi / 4, "side": 1.4 * np.pi}, 0.35 * np.pi),
    (cylinder, 0.15, {"bottom": np.pi / 4, "top": np.pi / 4, "side": 1.4 * np.pi}, 0.35 * np.pi),
    (plate, 0.12, {"flat": 2 - 0.08 * np.pi, "hole": 0.2 * np.pi, "outer": 2.0}, 0.5 - 0.02 * np.pi),
    (bitten, 0.2, {"boundary": 6 - np.pi / 16}, 1 - np.pi / 48),
    (bitten, 0.12, {"boundary": 6 - np.pi / 16}, 1 - np.pi / 48),
    (angle, 0.12, {"boundary": 3.5}, 0.375),
    (wedge, 0.1, {"boundary": 2.2 + np.sqrt(1.36)}, 0.3),
    (ring, 0.3, {"boundary": 1.6 * np.pi**2}, 0.32 * np.pi**2),
])  # fmt: skip
def test_every_side_has_its_area_and_what_flows_through_all_is_made_inside(make, spacing, areas, volume):
    cloud = make(spacing)
    found = {group: js.quadrature(cloud, group) for group in areas}
    assert {group: one.weights.sum() for group, one in found.items()} == pytest.approx(areas, rel=5e-4)
    assert sum(map(outflow, found.values())) == pytest.approx(12 * volume, rel=2e-4)
    assert js.quadrature(cloud).weights.sum() == pytest.approx(volume, rel=1e-5)


def test_a_cap_has_its_flux():
    """Of the gradient above: 6 z over the bottom, where the rim was cut off."""
    assert outflow(js.quadrature(cylinder(0.2), "bottom")) == pytest.approx(4.2 * np.pi / 4, rel=5e-4)


def test_the_boundary_is_closed_and_each_facet_looks_somewhere():
    """Flat simplices over the mouth of the bite were a skin, and particles on one line a facet without a normal."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for cloud in (bitten(0.12), wedge(0.12), js.box((0, 0, 0), (2, 1, 1), (5, 5, 5))):
            facets, normals = boundary_facets(cloud)
            assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-12
            at = np.asarray(cloud.points)[facets]
            area = np.linalg.norm(np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]), axis=1) / 2
            assert np.abs(area @ normals).max() < 1e-12
            js.quadrature(cloud, next(name for name in cloud.groups if name != "interior"))


def test_a_particle_beyond_an_edge_says_nothing_of_the_side_it_is_on():
    """A predicate with a tolerance claims one: a piece of the side was counted to the bottom."""
    cloud = cylinder(0.2)
    points, side = np.asarray(cloud.points), cloud.groups["side"]
    stray = side[points[side, 2].argmin()]
    groups = {**cloud.groups, "side": side[side != stray], "bottom": np.append(cloud.groups["bottom"], stray)}
    moved = js.Cloud(points, groups, cloud.normals)
    same = js.Cloud(points, cloud.groups, cloud.normals)
    for group in CAPS:
        assert js.quadrature(moved, group).weights.sum() == js.quadrature(same, group).weights.sum()


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("degree", [2, 4])
def test_the_other_rule_tells_the_error(known, degree):
    """Of the area of a disk at the end of a cylinder, in the sense of a flux through it."""
    groups = {"end": lambda x: x[:, 0] > 1 - 1e-6, "rest": lambda x: x[:, 0] <= 1 - 1e-6}
    shape = js.sdf.cylinder((0, 0, 0), (1, 0, 0), 0.5)
    cloud = js.from_sdf(shape, ((-0.1, -0.6, -0.6), (1.1, 0.6, 0.6)), 0.25, groups=groups)
    cloud = cloud if known else pickle.loads(pickle.dumps(cloud))
    own, other = rule(cloud, "end", degree), rule(cloud, "end", degree + 2, otherwise=True)
    through, told = (q.weights @ q.normals[:, 0] for q in (own, other))
    error = abs(through - np.pi / 4)
    assert error > 1e-4 and error / 3 < abs(told - through) < 3 * error
