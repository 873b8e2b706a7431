"""Points outside of the domain: against exact membership, for clouds of many shapes and origins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud.inside import Table, inside_of

STAR = [(r * np.cos(t), r * np.sin(t)) for r, t in zip([1.0, 0.45] * 5, np.arange(10) * np.pi / 5)]
ELL = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
NOTCH = [(0, 0), (2, 0), (2, 1), (1.05, 1), (1.03, 0.3), (0.97, 0.3), (0.95, 1), (0, 1)]
TRIANGLE = [(0.3, 0.3), (0.7, 0.3), (0.5, 0.7)]


def size(x, centre=0.0):
    return np.linalg.norm(x - np.asarray(centre), axis=1)


def polygon(*loops):
    """The signed distance of a polygon with holes: by even and odd crossings, and the distance of its edges."""
    edges = [(np.array(a, float), np.array(b, float)) for loop in loops for a, b in zip(loop, [*loop[1:], loop[0]])]

    def distance(x):
        near, inside = np.full(len(x), np.inf), np.zeros(len(x), bool)
        for a, b in edges:
            t = np.clip((x - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            near = np.minimum(near, np.linalg.norm(x - a - t[:, None] * (b - a), axis=1))
            up = (a[1] > x[:, 1]) != (b[1] > x[:, 1])
            inside ^= up & (x[:, 0] < a[0] + (x[:, 1] - a[1]) * (b[0] - a[0]) / ((b[1] - a[1]) or 1.0))
        return np.where(inside, -near, near)

    return distance


def block(lo, hi):
    def distance(x):
        q = np.maximum(np.asarray(lo) - x, x - np.asarray(hi))
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)

    return distance


def torus(x):
    return jnp.sqrt((jnp.sqrt(x[0] ** 2 + x[1] ** 2 + 1e-30) - 1) ** 2 + x[2] ** 2) - 0.35


def bare(cloud):
    """The same without normals."""
    return js.Cloud(cloud.points, dict(cloud.groups))


def graded(x):
    return 0.03 + 0.1 * size(x, (1, 0))


DISK = lambda h: js.from_sdf(js.sdf.circle((0, 0), 1.0), ((-1, -1), (1, 1)), h)  # noqa: E731
RING = js.sdf.difference(js.sdf.circle((0, 0), 1.0), js.sdf.circle((0.2, 0), 0.3))
SHAPES = {
    "interval": (lambda: js.interval(0.0, 1.0, 11), block([0], [1]), 0.1),
    "disk": (lambda: DISK(0.08), lambda x: size(x) - 1, 0.08),
    "ring": (lambda: js.from_sdf(RING, ((-1, -1), (1, 1)), 0.07),
             lambda x: np.maximum(size(x) - 1, 0.3 - size(x, (0.2, 0))), 0.07),
    "star": (lambda: js.from_polygon(STAR, 0.05), polygon(STAR), 0.05),
    "ell": (lambda: js.from_polygon(ELL, 0.1), polygon(ELL), 0.1),
    "notch": (lambda: js.from_polygon(NOTCH, 0.05), polygon(NOTCH), 0.05),
    "hole": (lambda: js.from_polygon(ELL, 0.08, holes=[TRIANGLE]), polygon(ELL, TRIANGLE), 0.08),
    "lattice": (lambda: js.rectangle((0, 0), (1, 2), (11, 21), jitter=0.3), block((0, 0), (1, 2)), 0.1),
    "box": (lambda: js.box((0, 0, 0), (1, 1, 1), (9, 9, 9), jitter=0.3), block((0,) * 3, (1,) * 3), 0.125),
    "ball": (lambda: js.from_sdf(js.sdf.sphere((0, 0, 0), 1.0), ((-1,) * 3, (1,) * 3), 0.2),
             lambda x: size(x) - 1, 0.2),
    "torus": (lambda: js.from_sdf(torus, ((-1.4, -1.4, -0.4), (1.4, 1.4, 0.4)), 0.17),
              lambda x: np.hypot(np.hypot(x[:, 0], x[:, 1]) - 1, x[:, 2]) - 0.35, 0.17),
    "bare disk": (lambda: bare(DISK(0.08)), lambda x: size(x) - 1, 0.08),
    "bare star": (lambda: bare(js.from_polygon(STAR, 0.05)), polygon(STAR), 0.05),
    "graded disk": (lambda: DISK(graded), lambda x: size(x) - 1, graded),
}  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
def test_against_exact_membership(shape):
    """No point farther than a spacing outside is inside; none inside, or a quarter of one outside, is outside.

    Three of 200,000 points at the corners of a box, whose particles are 1.1 spacings apart on average, reach 1.04.
    """
    make, distance, spacing = SHAPES[shape]
    cloud = make()
    lo, hi = cloud.points.min(axis=0) - 0.8, cloud.points.max(axis=0) + 0.8
    points = np.random.default_rng(1).uniform(lo, hi, (30_000, cloud.dim))
    away, near = distance(points), spacing(points) if callable(spacing) else spacing
    outside = inside_of(cloud).outside(points)
    assert outside[away > 1.1 * near].all() and not outside[away < 0.25 * near].any()
    assert (outside[(away > 0.55 * near) & (away < near)]).mean() > 0.5  # half a spacing is the rule


@pytest.fixture(scope="module")
def sol():
    """u = x y on the ell."""
    held = {"boundary": js.dirichlet(lambda x: x[0] * x[1])}
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), held), js.from_polygon(ELL, 0.2))


POINTS = np.array([[0.5, 0.4], [1.8, 1.8], [1.05, 1.95], [-0.05, 0.5]])


def test_outside_is_nan_a_number_or_an_error(sol):
    nan = np.array([False, True, False, False])
    for ask in (sol, sol.grad, lambda x, **o: sol.derivative(x, (1, 0), **o)):
        values = np.asarray(ask(POINTS))
        assert (np.isnan(values).reshape(4, -1).any(axis=1) == nan).all()
        np.testing.assert_array_equal(np.asarray(ask(POINTS, outside="extrapolate"))[~nan], values[~nan])
        with pytest.raises(ValueError, match=r"points: 1 of 4 lie outside of the domain, first points\[1\]"):
            ask(POINTS, outside="raise")
    np.testing.assert_allclose(sol(POINTS)[~nan], np.prod(POINTS, axis=1)[~nan], atol=1e-12)
    with pytest.raises(ValueError, match="outside: 'none' is none of 'nan'"):
        sol(POINTS, outside="none")


def test_outside_under_transforms(sol):
    plain = np.asarray(sol(POINTS))
    np.testing.assert_allclose(jax.jit(sol)(POINTS), plain, atol=1e-14)
    np.testing.assert_allclose(jax.vmap(lambda x: sol(x[None])[0])(POINTS), plain, atol=1e-14)
    slopes = jax.grad(lambda x: jnp.nansum(sol(x)))(POINTS)
    np.testing.assert_allclose(slopes[0], [0.4, 0.5], atol=1e-11)
    assert np.isfinite(slopes).all()
    with pytest.raises(ValueError, match="outside: .*before the transform"):
        jax.jit(lambda x: sol(x, outside="raise"))(POINTS)


def test_a_cloud_that_is_open_on_one_side():
    """Interior particles only on the right: beyond them there is nothing."""
    lattice = js.rectangle((0, 0), (1, 1), (11, 11))
    right = lattice.groups["right"]
    groups = {**lattice.groups, "interior": np.concatenate([lattice.groups["interior"], right]), "right": []}
    domain = inside_of(js.Cloud(lattice.points, groups))
    assert domain.outside(np.array([[1.2, 0.5], [3.0, 0.4]])).all()
    assert not domain.outside(np.array([[0.95, 0.55], [1.02, 0.5], [0.45, 0.55]])).any()


CURVED = lambda x: np.exp(x[:, 0]) * np.cos(0.7 * x[:, 1])  # noqa: E731


def test_domain_quadrature_on_curved_domains():
    """Of the disk: the sum over t of J_0 like terms, here by Gauss points on the exact shape."""
    r, w = np.polynomial.legendre.leggauss(40)
    r, w, t = (r + 1) / 2, w / 2, np.arange(64) * 2 * np.pi / 64
    polar = np.stack([np.outer(r, np.cos(t)).ravel(), np.outer(r, np.sin(t)).ravel()], axis=1)
    exact = np.sum(np.repeat(w * r, 64) * CURVED(polar)) * 2 * np.pi / 64
    clouds = [DISK(0.2), DISK(0.1)]
    for degree in (2, 4, 6, 8):
        errors = []
        for cloud in clouds:
            points, weights, _ = js.quadrature(cloud, degree=degree)
            errors.append(abs(np.sum(weights * CURVED(points)) / exact - 1))
        rate = np.log(errors[0] / errors[1]) / (0.5 * np.log(len(clouds[1]) / len(clouds[0])))
        rounding = errors[0] < 2e-15  # on the coarser cloud too, at degree 8
        assert (rate > degree - 0.5 or rounding) and errors[1] < 2e-5, (degree, errors)


@pytest.mark.parametrize("cloud, exact", [
    (js.interval(0.0, 2.0, 9), 2.0**5 / 5), (js.rectangle((0, 0), (2, 1), (9, 9)), 2.0**5 / 5),
    (js.box((0, 0, 0), (2, 1, 1), (5, 5, 5)), 2.0**5 / 5), (js.from_polygon(ELL, 0.25), 1.0 * 2.0**5 / 5 + 1.0 / 5),
])  # fmt: skip
def test_domain_quadrature_is_exact_on_straight_domains(cloud, exact):
    """The integral of x^4."""
    points, weights, _ = js.quadrature(cloud, degree=4)
    np.testing.assert_allclose(np.sum(weights * points[:, 0] ** 4), exact, rtol=1e-12)


@pytest.mark.parametrize("inside, area, round_it", [
    (lambda x: np.full(len(x), True), 4.0, 8.0),
    (lambda x: ~(x > 1 + 1e-9).all(axis=1), 3.0, 8.0),
    (lambda x: abs(x - 1).max(axis=1) > 0.4 - 1e-9, 4.0 - 0.64, 8.0 + 3.2),
])  # fmt: skip
def test_quadrature_without_normals(inside, area, round_it):
    """A lattice of points with sides found by counting neighbours: convex corners, a notch, a hole, to rounding."""
    points = np.stack(np.meshgrid(*[np.linspace(0, 2, 21)] * 2), axis=-1).reshape(-1, 2)
    points = points[inside(points)]
    near = np.abs(points[:, None] - points[None]).max(axis=2) < 0.11
    rim = near.sum(axis=1) < 9
    cloud = js.Cloud(points, {"interior": np.flatnonzero(~rim), "rim": np.flatnonzero(rim)})
    np.testing.assert_allclose(js.quadrature(cloud).weights.sum(), area, rtol=1e-12)
    np.testing.assert_allclose(js.quadrature(cloud, "rim").weights.sum(), round_it, rtol=1e-12)


@pytest.mark.parametrize("gap", [0.03, 0.125, 0.5])
def test_quadrature_on_two_rods(gap):
    points = np.concatenate([np.linspace(0, 1, 9), np.linspace(1, 2, 9) + gap])[:, None]
    cloud = js.Cloud(points, {"interior": np.r_[1:8, 10:17], "ends": [0, 8, 9, 17]})
    np.testing.assert_allclose(js.quadrature(cloud).weights.sum(), 2.0, rtol=1e-12)
    assert len(js.quadrature(cloud, "ends").points) == 4


def test_the_integral_of_a_solution(sol):
    """Of x y over the ell: over [0, 2] x [0, 1] it is 1, over [0, 1] x [1, 2] 3 / 4; of fields one each."""
    np.testing.assert_allclose(sol.integral(), 1.75, rtol=1e-11)
    two = js.solve(js.Problem(lambda u, x: jnp.stack([js.laplacian(u[0])(x) - 2, js.laplacian(u[1])(x)]), {
        "left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}, fields=2), js.interval(0.0, 1.0, 9))  # fmt: skip
    np.testing.assert_allclose(two.integral(), [1 / 3, 1 / 2], rtol=1e-11)
    with pytest.raises(ValueError, match="degree: expected a whole number"):
        js.quadrature(sol.cloud, degree=0)


def test_a_table_finds_the_nearest_particles_of_a_tree():
    cloud = js.rectangle((0, 0), (3, 1), (31, 11), jitter=0.3)
    domain = inside_of(cloud)
    table = Table.of(domain.points, domain.trees[0])
    assert table is not None
    points = np.random.default_rng(0).uniform((0, 0), (3, 1), (5000, 2))
    for some in (points, np.concatenate([points[:10], [[5.0, 5.0]]])):  # one outside of the grid
        distance, number = domain.trees[0].query(some)
        found = table.nearest(some)
        np.testing.assert_array_equal(found.number, number)
        np.testing.assert_allclose(found.distance, distance, rtol=1e-14)


def test_a_cut_thinner_than_the_spacing():
    """Both of its sides are near every point beside it; the polygon knows on which it is."""
    half = 0.005
    vertices = [(0, 0), (2, 0), (2, 0.5 - half), (0.5, 0.5 - half), (0.5, 0.5 + half), (2, 0.5 + half), (2, 1), (0, 1)]
    cloud = js.from_polygon(vertices, 0.1)
    exact = lambda x: jnp.exp(x[0]) * jnp.sin(x[1])
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": js.dirichlet(exact)}), cloud)
    points = np.random.default_rng(0).uniform((0.55, 0.4), (1.95, 0.6), (4000, 2))
    values, cut = np.asarray(sol(points)), np.abs(points[:, 1] - 0.5) < half
    assert np.abs(values - np.asarray(jax.vmap(exact)(points)))[~cut].max() < 1e-3


def test_a_needle_thinner_than_the_spacing():
    """Its particles all but stand on a line, and little is known across it: slopes were 4,000, and are 1."""
    tip = [(0, 0), (0.99, 0), (1, -0.6), (1.01, 0), (2, 0), (2, 1), (0, 1)]
    cloud = js.from_polygon(tip, 0.05)
    exact = lambda x: 1 + x[0] + 0.5 * x[1]
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": js.dirichlet(exact)}), cloud)
    points = np.stack([np.full(20, 1.0), np.linspace(-0.55, -0.01, 20)], axis=1)
    np.testing.assert_allclose(sol(points), jax.vmap(exact)(points), atol=0.15)
    assert np.abs(sol.grad(points)).max() < 20.0 and sol.error_estimate().max() < 1e-10
