"""What clouds are made of: signed distances at many points, thin parts, lattices, curves through cells."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm import sdf
from jsmitsm.cloud import contour, filling, levelset
from jsmitsm.cloud.packing.graded import blocks, graded_part, owners
from jsmitsm.cloud.packing.octree import morton
from jsmitsm.cloud.packing.relaxation import thin
from jsmitsm.cloud.sdf import recorded

UNIT = ((-1, -1), (1, 1))
PLATE = sdf.difference(sdf.rectangle((0, 0), (2, 1)), sdf.circle((1, 0.5), 0.25))


def looped(x):
    """A loop of unknown length, of which JAX has no gradient."""
    return jnp.linalg.norm(jax.lax.while_loop(lambda y: y[0] > 9, lambda y: y - 1, x)) - 0.7


SHAPES = [(PLATE, 2), (sdf.torus((0, 0, 0), 1.0, 0.3), 3), (sdf.polygon([(0, 0), (2, 0), (0, 2)]), 2)]


@pytest.mark.parametrize("shape, dim", SHAPES)
@pytest.mark.parametrize("count", [1, 700])
def test_interpreted_and_compiled_are_the_same_function(monkeypatch, shape, dim, count):
    """Batches of every size, padded or in pieces, against JAX."""
    x = np.random.default_rng(count).uniform(-1, 2, (count, dim))
    value, gradient = jax.jit(jax.vmap(jax.value_and_grad(shape)))(x)
    for most in (np.inf, -1):
        monkeypatch.setattr(recorded, "_AT_ONCE", most)
        monkeypatch.setattr(recorded, "_CALLS", (16, 512))
        found = recorded.Recorded(shape, dim)(x)
        # Round-off of a few operations on numbers up to 3, divided by distances down to 1e-3.
        np.testing.assert_allclose(found[0], value, atol=1e-14)
        np.testing.assert_allclose(found[1], gradient, atol=1e-11)
    assert recorded.Recorded(shape, dim)(np.zeros((0, dim)))[0].shape == (0,)


def test_a_loop_of_unknown_length_is_interpreted():
    cloud = js.from_sdf(looped, UNIT, 0.2)
    np.testing.assert_allclose(np.linalg.norm(cloud.points[cloud.boundary], axis=1), 0.7, atol=1e-14)


def test_a_function_written_anew_gives_the_same_cloud_and_a_changed_one_another():
    radius = [0.9]
    make = lambda: lambda x: jnp.sqrt(x @ x) - radius[0]  # noqa: E731
    first, again = (js.from_sdf(make(), UNIT, 0.15).points for _ in range(2))
    np.testing.assert_array_equal(first, again)
    radius[0] = 0.8
    assert np.abs(js.from_sdf(make(), UNIT, 0.15).points).max() < 0.81


@pytest.mark.parametrize("inner, message", [(0.95, "spacing: too coarse"), (0.75, None)])
def test_rings(inner, message):
    """Half a spacing of 0.1 wide is refused; two and a half are filled."""
    ring = sdf.difference(sdf.circle((0, 0), 1.0), sdf.circle((0, 0), inner))
    if message:
        with pytest.raises(ValueError, match=message):
            js.from_sdf(ring, UNIT, 0.1)
    else:
        cloud = js.from_sdf(ring, UNIT, 0.1)
        assert js.quality(cloud, 0.1).mesh_ratio < 2.6 and len(cloud.groups["interior"]) > 80


def test_a_boundary_that_leaves_the_cells_near_it_is_followed():
    """Values a hundred times too steep on one side: the first-order distance there is far too large."""
    odd = lambda x: jnp.where(x[0] > 0, 1.0, 100.0) * jnp.tanh(3 * (x @ x - 0.5))  # noqa: E731
    cloud = js.from_sdf(odd, UNIT, 0.1)
    radius = np.linalg.norm(cloud.points[cloud.boundary], axis=1)
    np.testing.assert_allclose(radius, np.sqrt(0.5), atol=1e-13)
    assert len(radius) == 44  # 2 pi sqrt(1/2) / 0.1


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_the_curve_visits_one_half_before_the_other(dim):
    x = np.random.default_rng(0).uniform(size=(4000, dim))
    order = np.argsort(morton(x, np.zeros(dim), np.ones(dim)))
    for _ in range(dim):  # the last axis is cut first, and every part by the next one
        assert (np.diff((x[order, dim - 1] > 0.5).astype(int)) >= 0).all()
        x, order = (x[order][: (x[:, dim - 1] < 0.5).sum()], np.arange((x[:, dim - 1] < 0.5).sum()))
        x = np.roll(x, 1, axis=1)


@pytest.mark.parametrize("radii", [np.full(900, 0.05), np.geomspace(0.02, 0.2, 900)])
def test_a_thinned_set_is_apart_and_maximal(radii):
    x = np.random.default_rng(1).uniform(size=(900, 2))
    kept = thin(x, radii, np.arange(900))
    gap = np.linalg.norm(x[:, None] - x[None], axis=2)
    close = gap < np.minimum(radii[:, None], radii[None])
    np.fill_diagonal(close, False)
    assert not close[np.ix_(kept, kept)].any()
    assert close[:, kept].any(axis=1)[np.setdiff1d(np.arange(900), kept)].all()


def test_graded_parts_are_the_whole():
    """Of 13,000 particles, five times as near at the rim of a plate, three parts have each its own."""
    lo, hi = np.zeros(2), np.array([2.0, 1.0])
    spacing = filling.spacing_function(lambda x: 0.005 + 0.016 * np.hypot(x[:, 0] - 1.8, x[:, 1] - 0.5))
    region = levelset.SdfRegion(PLATE, lo, hi)
    rim = levelset.checked(region, contour.contour(region, spacing)).points
    grid = blocks(region, spacing, lo, hi)
    fill = lambda mine: graded_part(region, spacing, lo, hi, rim, 0, grid, mine)  # noqa: E731
    whole, of = fill(np.ones(len(grid.share), bool)), owners(grid, 3)
    parts = [fill(of == k) for k in range(3)]
    assert len(whole) == pytest.approx(grid.share.sum(), rel=0.03)
    assert max(map(len, parts)) < 1.1 * min(map(len, parts))
    together = np.concatenate(parts)
    np.testing.assert_array_equal(together[np.lexsort(together.T)], whole[np.lexsort(whole.T)])
    # As near as those that one process fills: 0.79 of the spacing at the least.
    every = np.concatenate([whole, rim])
    gap = np.sort(np.linalg.norm(every[None, :400] - every[:, None], axis=2), axis=0)[1]
    assert (gap > 0.75 * spacing(every[:400])).all()


def test_a_convex_corner_may_be_fine():
    """All of the outside near it has its foot there, at a spacing that no more of it needs."""
    square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    graded = lambda x: np.minimum(0.1, 1e-8 + np.hypot(*x.T) / 4)
    cloud = js.from_polygon(square, graded)
    assert len(cloud) < 2500
    x = np.asarray(cloud.points)
    away = np.sort(np.hypot(*x.T))
    assert away[0] == 0 and away[1] < 3e-8
    with pytest.raises(ValueError, match="takes about"):
        js.from_sdf(PLATE, ((0, 0), (2, 1)), lambda x: np.full(len(x), 1e-7))
