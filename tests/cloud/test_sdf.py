"""Signed distances: values, gradients (also where a plain norm has none), composition, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsmitsm import sdf

L_SHAPE = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)

# name: function, a box around the shape, whether the distance is exact everywhere
SHAPES = {
    "interval": (sdf.interval(-1, 2), (-2, 3), True),
    "circle": (sdf.circle((0.5, 0), 1.2), ((-2, -2), (2, 2)), True),
    "ball": (sdf.ball((0, 0, 0.5), 1.0), ((-2,) * 3, (2,) * 3), True),
    "rectangle": (sdf.rectangle((-1, -0.5), (1.5, 0.7)), ((-2, -2), (2, 2)), True),
    "box": (sdf.box((-1, -0.5, -1), (1.5, 0.7, 0)), ((-2,) * 3, (2,) * 3), True),
    "half_space": (sdf.half_space((0.1, 0.2), (3, 4)), ((-2, -2), (2, 2)), True),
    "capsule": (sdf.capsule((-1, 0), (1, 0.5), 0.3), ((-2, -2), (2, 2)), True),
    "cylinder": (sdf.cylinder((0, 0, -1), (0.3, 0.2, 1), 0.6), ((-2,) * 3, (2,) * 3), True),
    "torus": (sdf.torus((0, 0, 0), 1.0, 0.3, axis=(1, 0, 1)), ((-2,) * 3, (2,) * 3), True),
    "polygon": (sdf.polygon(L_SHAPE), ((-1, -1), (3, 3)), True),
    "polygon clockwise": (sdf.polygon(L_SHAPE[::-1]), ((-1, -1), (3, 3)), True),
    "rotated": (sdf.rotate(sdf.rectangle((0, 0), (1, 2)), 0.7, center=(0.3, 0)), ((-3, -3), (3, 3)), True),
    "rotated 3D": (sdf.rotate(sdf.box((0, 0, 0), (1, 2, 1)), 0.7, axis=(1, 2, 0)), ((-3,) * 3, (3,) * 3), True),
    "scaled": (sdf.scale(sdf.rectangle((0, 0), (1, 2)), 1.5, center=(1, 0)), ((-3, -3), (3, 4)), True),
    "ellipse": (sdf.ellipse((0, 0), (1.5, 0.5)), ((-2, -2), (2, 2)), False),
    "ellipsoid": (sdf.ellipsoid((0, 0, 0), (1.5, 0.5, 1)), ((-2,) * 3, (2,) * 3), False),
    "union": (sdf.union(sdf.circle((0, 0), 1), sdf.rectangle((0, 0), (2, 1))), ((-2, -2), (3, 2)), False),
    "difference": (sdf.difference(sdf.circle((0, 0), 1), sdf.circle((0.5, 0), 0.4)), ((-2, -2), (2, 2)), False),
    "smooth": (sdf.smooth_union(sdf.circle((0, 0), 1), sdf.circle((1.5, 0), 0.8), 0.4), ((-2, -2), (3, 2)), False),
}


def sample(bounds, n=3000, seed=0):
    lo, hi = (np.atleast_1d(np.asarray(b, float)) for b in bounds)
    return np.random.default_rng(seed).uniform(lo, hi, (n, len(lo)))


@pytest.mark.parametrize("name", SHAPES)
def test_is_a_distance_and_smooth_enough(name):
    """Values are 1-Lipschitz (exactly steep 1 for distances), the zero level is crossed, gradients are finite."""
    shape, bounds, exact = SHAPES[name]
    x = sample(bounds)
    value, gradient = jax.jit(jax.vmap(jax.value_and_grad(shape)))(x)
    assert (value < 0).any() and (value > 0).any()
    slope = np.linalg.norm(gradient, axis=1)
    assert np.isfinite(slope).all()
    if exact:
        np.testing.assert_allclose(slope, 1.0, atol=1e-12)
        # a step along the gradient by the distance ends on the zero level, away from the medial axis
        foot = x - np.asarray(value)[:, None] * np.asarray(gradient)
        assert np.abs(jax.jit(jax.vmap(shape))(foot)).max() < 1e-12
    else:
        near = np.abs(value) < 0.05
        assert near.any() and (np.abs(slope[near] - 1) < 0.6).all()


@pytest.mark.parametrize(
    "shape, x",
    [
        (sdf.circle((0, 0), 1), (0, 0)),
        (sdf.ellipse((0, 0), (2, 1)), (0, 0)),
        (sdf.rectangle((0, 0), (1, 1)), (1, 1)),
        (sdf.rectangle((0, 0), (2, 1)), (1, 0.5)),
        (sdf.capsule((0, 0), (1, 0), 0.2), (0.5, 0)),
        (sdf.torus((0, 0, 0), 1, 0.2), (0, 0, 0)),
        (sdf.cylinder((0, 0, 0), (0, 0, 1), 0.2), (0, 0, 0.3)),
        (sdf.polygon(L_SHAPE), (1, 1)),
        (sdf.smooth_union(sdf.circle((0, 0), 1), sdf.circle((1, 0), 1), 0.2), (0.5, 0)),
    ],
)
def test_gradient_is_finite_at_centres_axes_and_corners(shape, x):
    assert np.isfinite(jax.jit(jax.grad(shape))(jnp.array(x, float))).all()


def test_values_by_hand():
    assert sdf.box((0, 0), (2, 2))(jnp.array([5.0, 6.0])) == 5.0
    assert sdf.cylinder((0, 0, 0), (0, 0, 2), 1.0)(jnp.array([4.0, 0.0, 6.0])) == 5.0
    assert sdf.torus((0, 0, 0), 2.0, 0.5)(jnp.array([0.0, 2.0, 0.75])) == 0.25
    np.testing.assert_allclose(sdf.half_space((1, 0), (2, 0))(jnp.array([3.0, 9.0])), 2.0)
    plate = sdf.difference(sdf.rectangle((0, 0), (2, 1)), sdf.circle((1, 0.5), 0.25))
    assert plate(jnp.array([1.0, 0.5])) == 0.25
    np.testing.assert_allclose(plate(jnp.array([0.1, 0.5])), -0.1)
    ring = sdf.shell(sdf.circle((0, 0), 1.0), 0.2)
    np.testing.assert_allclose(ring(jnp.array([1.05, 0.0])), -0.05, atol=1e-15)
    np.testing.assert_allclose(sdf.round(sdf.rectangle((0, 0), (1, 1)), 0.1)(jnp.array([1.3, 1.4])), 0.4)
    np.testing.assert_allclose(sdf.translate(sdf.circle((0, 0), 1), (3, 0))(jnp.array([3.0, 0.0])), -1.0)


def test_polygon_is_the_rectangle_it_describes():
    x = sample(((-1, -1), (3, 2)))
    box, corners = sdf.rectangle((0, 0), (2, 1)), sdf.polygon([(0, 0), (2, 0), (2, 1), (0, 1)])
    np.testing.assert_allclose(jax.jit(jax.vmap(corners))(x), jax.jit(jax.vmap(box))(x), atol=1e-14)


def test_polygon_normals_on_edges_and_vertices():
    """On the zero level, to round-off, the gradient is the edge's normal; at a vertex, the bisector."""
    gradient = jax.jit(jax.grad(sdf.polygon(L_SHAPE)))
    np.testing.assert_allclose(gradient(jnp.array([1.0 + 1e-17, 1.5])), (1, 0), atol=1e-14)
    np.testing.assert_allclose(gradient(jnp.array([1.7, 1.0 - 1e-17])), (0, 1), atol=1e-14)
    for vertex, bisector in (((1, 1), (1, 1)), ((0, 0), (-1, -1)), ((2, 0), (1, -1))):
        np.testing.assert_allclose(gradient(jnp.array(vertex, float)), np.divide(bisector, np.sqrt(2)), atol=1e-14)


def test_rotation_follows_the_right_hand_rule():
    point = jnp.array([0.0, 0.9, 0.0])  # (0.9, 0, 0) turned by 90 degrees about z
    bar = sdf.box((0, -0.1, -0.1), (1, 0.1, 0.1))
    np.testing.assert_allclose(sdf.rotate(bar, jnp.pi / 2, axis=(0, 0, 2))(point), -0.1, atol=1e-15)
    assert sdf.rotate(sdf.rectangle((0, -0.1), (1, 0.1)), jnp.pi / 2)(point[:2]) < 0


def test_differentiable_in_the_parameters():
    """d/dr of |x| - r is -1; of a rotated, scaled union the derivative agrees with differences."""

    def value(p):
        shape = sdf.union(sdf.circle((p[0], 0.0), p[1]), sdf.rotate(sdf.rectangle((0, 0), (p[2], 1)), p[3]))
        return sdf.scale(shape, p[2])(jnp.array([2.1, 1.7]))

    p = jnp.array([1.0, 0.5, 1.3, 0.4])
    assert jax.grad(lambda r: sdf.circle((0, 0), r)(jnp.array([3.0, 4.0])))(1.0) == -1.0
    step = 1e-6 * np.eye(4)
    differences = [(value(p + e) - value(p - e)) / 2e-6 for e in step]
    np.testing.assert_allclose(jax.grad(value)(p), differences, atol=1e-8)


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: sdf.circle((0, 0), -1), "radius"),
        (lambda: sdf.circle((0, 0, 0), 1), r"center: shape \(3,\)"),
        (lambda: sdf.ball(0.0, 1), "center"),
        (lambda: sdf.ball((0, np.nan), 1), "finite"),
        (lambda: sdf.rectangle((1, 0), (0, 1)), "hi"),
        (lambda: sdf.half_space((0, 0), (0, 0)), "normal"),
        (lambda: sdf.polygon([(0, 0), (1, 1)]), "vertices"),
        (lambda: sdf.ellipse((0, 0), (1, 0)), "semi_axes"),
        (lambda: sdf.union(), "shapes"),
        (lambda: sdf.union([sdf.circle((0, 0), 1)]), "one by one"),
        (lambda: sdf.scale(sdf.circle((0, 0), 1), 0), "factor"),
        (lambda: sdf.rotate(sdf.ball((0, 0, 0), 1), 1.0)(jnp.zeros(3)), "axis"),
    ],
)
def test_bad_input(build, message):
    with pytest.raises(ValueError, match=message):
        build()
