"""Kernels: values, supports, smoothness, and kernels as pytrees."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js

NAMED = (js.SuperGaussian, js.Gaussian, js.Wendland, js.CubicSpline, js.Constant)
VALUES = {  # at r = 0, d / 2 and d for d = 2, by hand
    js.SuperGaussian: (4.0, 3.0 * np.exp(-1.0), 0.0),
    js.Gaussian: (1.0, np.exp(-1.0), np.exp(-4.0)),
    js.Wendland: (1.0, 0.5**6 * 20.75 / 3, 0.0),
    js.CubicSpline: (1.0, 0.25, 0.0),
    js.Constant: (1.0, 1.0, 1.0),
}


@pytest.mark.parametrize("kind", NAMED)
def test_values(kind):
    kernel = kind(h=0.3, d=2.0)
    # Each formula is a handful of operations: a few units in the last place.
    assert np.allclose(kernel.weight(np.array([0.0, 1.0, 2.0])), VALUES[kind], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("kind", NAMED)
def test_the_support_ends_at_d_and_counts_its_edge(kind):
    kernel = kind(h=0.3, d=2.0)
    assert kernel.weight(2.0 + 1e-6) == 0 and kernel.weight(50.0) == 0
    inside = kernel.weight(np.linspace(0.0, 1.999, 50))
    assert (inside > 0).all() and (np.diff(inside) <= 1e-15).all()
    if kind in (js.Gaussian, js.Constant):
        assert kernel.weight(2.0 * (1 + 1e-12)) > 0, "rounding must not push a particle off the edge"


@pytest.mark.parametrize("kind, order", [(js.Wendland, 4), (js.CubicSpline, 2)])
def test_smooth_at_the_edge(kind, order):
    """Wendland C4 and the cubic spline C2: that many derivatives vanish at r = d."""
    f = kind(h=1.0, d=2.0).profile
    for k in range(order + 1):
        # The k-th derivative of (1 - q)^n leaves a rounding of about 1e-16 times its largest coefficient, 1e3.
        assert abs(f(2.0)) < 1e-12, k
        f = jax.grad(f)
    if kind is js.CubicSpline:
        assert abs(f(1.999)) > 0.1


@pytest.mark.parametrize("kind", NAMED[:-1])
def test_derivatives_by_ad_match_differences(kind):
    f = kind(h=1.0, d=2.0).profile
    step = 1e-5
    for r in (0.3, 0.7, 1.6):
        # Truncation step^2 times a third derivative below 100, rounding 1e-16 / step.
        assert jax.grad(f)(r) == pytest.approx(float((f(r + step) - f(r - step)) / (2 * step)), abs=1e-7)


def test_cubic_spline_is_smooth_where_its_pieces_meet():
    f = js.CubicSpline(h=1.0, d=2.0).profile
    for _ in range(3):
        assert f(1.0 - 1e-9) == pytest.approx(float(f(1.0 + 1e-9)), abs=1e-7)
        f = jax.grad(f)


def test_the_constants_of_the_super_gaussian():
    """Karamanli (2015), eq. (30): G = 1.04823, 1.10081, 1.18516 in 1, 2 and 3 dimensions."""
    kernel = js.SuperGaussian(h=0.5, d=2.0)
    for dim, g in ((1, 1.04823), (2, 1.10081), (3, 1.18516)):
        assert kernel.normalization(dim) == pytest.approx(g / (0.5 * np.sqrt(np.pi)) ** dim, rel=1e-14)


def test_a_kernel_of_ones_own_equals_the_named_one():
    own = js.Kernel(lambda r: jnp.exp(-(r**2)), h=0.3, d=2.0)
    r = np.linspace(0.0, 3.0, 31)
    assert np.array_equal(own.weight(r), js.Gaussian(h=0.3, d=2.0).weight(r))


def test_further_parameters_of_a_profile():
    kernel = js.Kernel(lambda r, p: jnp.exp(-p["s"] * r**2), h=1.0, d=2.0, params={"s": 2.0})
    assert kernel.profile(1.0) == pytest.approx(np.exp(-2.0))
    assert kernel.replace(params={"s": 1.0}).profile(1.0) == pytest.approx(np.exp(-1.0))
    slope = jax.grad(lambda k: k.profile(1.0))(kernel)
    assert float(slope.params["s"]) == pytest.approx(-np.exp(-2.0))


@pytest.mark.parametrize("kind", NAMED)
def test_a_kernel_is_a_pytree_of_h_and_d(kind):
    kernel = kind(h=0.3, d=2.0)
    leaves, shape = jax.tree.flatten(kernel)
    assert leaves == [0.3, 2.0]
    back = jax.tree.unflatten(shape, [0.5, 3.0])
    assert type(back) is kind and (back.h, back.d) == (0.5, 3.0)
    doubled = jax.jit(lambda k: k.replace(h=2 * k.h))(kernel)
    assert type(doubled) is kind and float(doubled.h) == pytest.approx(0.6)


def test_one_smoothing_length_per_particle():
    for given in (np.array([0.1, 0.2]), [0.1, 0.2], jnp.array([0.1, 0.2])):
        kernel = js.Gaussian(h=given, d=2.0)
        assert kernel.at(1).h == 0.2 and kernel.at(1).d == 2.0 and len(jax.tree.leaves(kernel)) == 2
    single = js.Gaussian(h=0.1, d=2.0)
    assert single.at(5) is single


def test_replace_leaves_the_original():
    kernel = js.Wendland(h=0.1, d=2.0)
    assert kernel.replace(h=0.2).h == 0.2 and kernel.replace(d=3.0).d == 3.0 and kernel.h == 0.1


def test_pickle_and_repr():
    kernel = js.SuperGaussian(h=0.1, d=2.0)
    assert pickle.loads(pickle.dumps(kernel)).h == 0.1
    assert repr(kernel) == "SuperGaussian(h=0.1, d=2)"
    assert repr(js.Gaussian(np.array([0.1, 0.2]), 2.0)) == "Gaussian(h=0.1..0.2 (2 particles), d=2)"
