"""Integrals over boundary groups: exact on straight boundaries, of the order of their degree on curved ones."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js


def disc(spacing):
    return js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.2, -1.2), (1.2, 1.2)), spacing)


def ball(spacing):
    return js.from_sdf(lambda x: jnp.sqrt(jnp.sum(x**2) + 1e-300) - 1, ((-1.2,) * 3, (1.2,) * 3), spacing)


def ellipse(spacing):
    return js.from_sdf(lambda x: jnp.hypot(x[0] / 1.5, x[1] / 0.8) - 1, ((-1.6, -0.9), (1.6, 0.9)), spacing)


def flower(spacing):
    """r = 1 + cos(5 t) / 5."""
    level = lambda x: jnp.hypot(*x) - 1 - 0.2 * jnp.cos(5 * jnp.arctan2(x[1], x[0]))
    return js.from_sdf(level, ((-1.3, -1.3), (1.3, 1.3)), spacing)


def over_curve(curve):
    """The integral of u and that of x n . grad u, u = exp(x) cos(y + 0.3), by the periodic trapezoidal rule."""
    t = np.arange(4000) * (2 * np.pi / 4000)
    points, along = jax.vmap(lambda t: jax.jvp(curve, (t,), (1.0,)))(t)
    ds = np.linalg.norm(along, axis=1) * (t[1] - t[0])
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
    return two_integrals(points, ds, normal)


def two_integrals(points, weights, normals):
    u = np.exp(points[:, 0]) * np.cos(points[:, 1] + 0.3)
    slope = np.stack([u, -np.exp(points[:, 0]) * np.sin(points[:, 1] + 0.3)], axis=1)
    return np.array([np.sum(weights * u), np.sum(weights * points[:, 0] * np.sum(slope * normals, axis=1))])


@pytest.mark.parametrize("make, curve, spacings", [
    (ellipse, lambda t: jnp.stack([1.5 * jnp.cos(t), 0.8 * jnp.sin(t)]), (0.1, 0.05)),
    (flower, lambda t: (1 + 0.2 * jnp.cos(5 * t)) * jnp.stack([jnp.cos(t), jnp.sin(t)]), (0.05, 0.025)),
])  # fmt: skip
def test_curved_boundaries_have_the_order_asked_for(make, curve, spacings):
    """Values and fluxes, by the shape and, where it is not known (it is not pickled), by particles alone."""
    exact = over_curve(curve)
    clouds = [make(s) for s in spacings]
    for known in (True, False):
        for degree in (4, 6, 8):
            errors = [np.abs(two_integrals(*js.quadrature(c, "boundary", degree)) - exact) for c in clouds]
            order = np.log2(errors[0] / np.maximum(errors[1], 1e-13))
            assert np.all((order > degree - 0.5) | (errors[1] < 1e-10)), (known, degree, errors)
            assert np.all(errors[1] < (1e-8 if known else 1e-4)), (known, degree, errors)
        clouds = [pickle.loads(pickle.dumps(c)) for c in clouds]


def test_the_surface_of_a_ball():
    """By its shape of the order asked for; by the particles alone about fourth order."""
    known = [ball(0.4), ball(0.2)]
    alone = [pickle.loads(pickle.dumps(cloud)) for cloud in known]
    area = lambda cloud: abs(js.quadrature(cloud, "boundary", 4).weights.sum() / (4 * np.pi) - 1)
    off, far = ([area(cloud) for cloud in clouds] for clouds in (known, alone))
    assert off[1] < 1e-9 and far[1] < 1e-4 and np.log2(far[0] / far[1]) > 3.5


def test_a_polygon_of_particles_alone():
    """Sides that turn by 51 degrees at corners whose particles have a normal in between."""
    angle = np.arange(7) * 2 * np.pi / 7
    known = js.from_polygon(np.stack([np.cos(angle), np.sin(angle)], axis=1), 0.15)
    alone = pickle.loads(pickle.dumps(known))
    for cloud in (known, alone, alone.replace(normals=None)):
        points, weights, normals = js.quadrature(cloud, "boundary", 4)
        assert weights.sum() == pytest.approx(14 * np.sin(np.pi / 7), rel=1e-12)
        assert np.sum(weights * np.sum(points * normals, axis=1)) == pytest.approx(7 * np.sin(2 * np.pi / 7), rel=1e-12)
        assert js.quadrature(cloud).weights.sum() == pytest.approx(3.5 * np.sin(2 * np.pi / 7), rel=1e-12)


def test_normals_of_a_disc_point_outward():
    points, weights, normals = js.quadrature(disc(0.2), "boundary")
    assert np.abs(normals - points).max() < 1e-12
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
    points, weights, normals = js.quadrature(cloud, "boundary", 6)
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
