"""Integrals over boundary groups: exact on straight boundaries, fourth order on curved ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js


def disc(spacing):
    return js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.2, -1.2), (1.2, 1.2)), spacing)


def ball(spacing):
    return js.from_sdf(lambda x: jnp.sqrt(jnp.sum(x**2) + 1e-300) - 1, ((-1.2,) * 3, (1.2,) * 3), spacing)


@pytest.mark.parametrize(("make", "exact", "spacings"), [(disc, 2 * np.pi, (0.2, 0.1)), (ball, 4 * np.pi, (0.4, 0.2))])
def test_curved_boundaries_converge_with_order_four(make, exact, spacings):
    off = [abs(js.quadrature(make(s), "boundary").weights.sum() / exact - 1) for s in spacings]
    assert off[1] < 1e-4 and np.log2(off[0] / off[1]) > 3.5


def test_normals_of_a_disc_point_outward():
    points, weights, normals = js.quadrature(disc(0.2), "boundary")
    assert np.abs(normals - points).max() < 5e-3
    np.testing.assert_allclose((weights[:, None] * normals).sum(axis=0), 0, atol=1e-12)


def test_sides_of_a_box_have_their_areas():
    """Lattice corners belong to the first side that claims them, their facets to the side they lie in."""
    cloud = js.box((0, 0, 0), (2, 1, 1), (6, 5, 5), jitter=0.2)
    areas = {side: js.quadrature(cloud, side).weights.sum() for side in cloud.groups if side != "interior"}
    exact = {"left": 1, "right": 1, "bottom": 2, "top": 2, "front": 2, "back": 2}
    assert areas == pytest.approx(exact, rel=1e-12)


def test_polynomials_on_a_straight_side_are_exact():
    points, weights, normals = js.quadrature(js.rectangle((0, 0), (2, 1), (5, 4)), "top")
    assert np.sum(weights * points[:, 0] ** 7) == pytest.approx(2**8 / 8, rel=1e-13)
    np.testing.assert_allclose(normals, np.tile([0.0, 1.0], (len(points), 1)), atol=1e-15)


def test_holes_face_inward():
    hole = [(1.2, 0.7), (1.8, 0.7), (1.8, 1.3), (1.2, 1.3)]
    cloud = js.from_polygon([(0, 0), (3, 0), (3, 2), (0, 2)], 0.15, holes=[hole])
    points, weights, normals = js.quadrature(cloud, "hole0")
    assert weights.sum() == pytest.approx(2.4, rel=1e-12)
    assert np.sum(weights * np.sum(points * normals, axis=1)) == pytest.approx(-2 * 0.36, rel=1e-12)


def test_flux_balances_the_source():
    """div(grad u) = -f: what the source makes leaves through the boundary."""
    cloud = disc(0.1)
    u = lambda x: jnp.sin(2 * x[0] + 0.3) * jnp.exp(x[1])
    lap = lambda x: jnp.trace(jax.hessian(u)(x))
    sol = js.solve(
        js.Problem(lambda v, x: js.laplacian(v)(x) - lap(x), {"boundary": js.dirichlet(u)}), cloud, order=6
    )
    points, weights, normals = js.quadrature(cloud, "boundary")
    exact = np.sum(weights * np.sum(np.asarray(jax.vmap(jax.grad(u))(points)) * normals, axis=1))
    assert float(sol.flux("boundary")) == pytest.approx(exact, abs=1e-5)
    twice = float(sol.flux("boundary", lambda x: 2.0 + 0 * x[0]))
    assert twice == pytest.approx(2 * float(sol.flux("boundary")), rel=1e-12)
    # u itself is off by 3e-8 between the particles.
    assert float(sol.integral("boundary")) == pytest.approx(float(np.sum(weights * jax.vmap(u)(points))), rel=1e-7)


def test_ends_of_an_interval():
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) + 2.0, ends), js.interval(0.0, 1.0, 11))
    assert float(sol.flux("left")) == pytest.approx(-1.0, abs=1e-12)
    assert float(sol.flux("right")) == pytest.approx(-1.0, abs=1e-12)


@pytest.mark.parametrize("group", ["interior", "lid"])
def test_only_boundary_groups(group):
    with pytest.raises(ValueError, match="group: expected a boundary group .'left', 'right', 'bottom', 'top'."):
        js.quadrature(js.rectangle((0, 0), (1, 1), (4, 4)), group)
