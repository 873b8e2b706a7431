"""Parts of the domain that come close do not see each other: every one has the answer that it has alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js

LOAD = lambda u, x: js.laplacian(u)(x) - 1.0  # noqa: E731
FLAT = lambda u, x: js.laplacian(u)(x)  # noqa: E731


def joined(*clouds, normals=True):
    """One cloud of several, the boundary of each a group of its own."""
    start = np.cumsum([0, *map(len, clouds)])
    groups = {"interior": np.concatenate([c.groups["interior"] + k for c, k in zip(clouds, start)])}
    groups |= {f"part{n}": c.boundary + k for n, (c, k) in enumerate(zip(clouds, start))}
    return js.Cloud(
        np.concatenate([c.points for c in clouds]),
        groups,
        np.concatenate([c.normals for c in clouds]) if normals else None,
    )


@pytest.mark.parametrize("gap", [0.01, 0.125, 1.0, 100.0])
@pytest.mark.parametrize("normals", [True, False])
def test_rods(gap, normals):
    """u'' = 1, u = 0 at the ends: -1/8 in the middle of each of three rods, whatever chooses the neighbours."""
    rods = [js.interval(k * (1 + gap), k * (1 + gap) + 1, 9) for k in range(3)]
    cloud = joined(*rods, normals=normals)
    problem = js.Problem(LOAD, {f"part{k}": js.dirichlet(0.0) for k in range(3)})
    given = {"order 6": {"order": 6}, "kernel": {"kernel": js.SuperGaussian(0.125, 3.0)}, "III": {"method": "III"},
             "stencils": {"stencils": js.stencils(cloud, size=7)}, "lsq": {"formulation": "lsq"}}  # fmt: skip
    for name, options in given.items():
        sol = js.solve(problem, cloud, **options)
        np.testing.assert_allclose(sol.u[[4, 13, 22]], -0.125, rtol=1e-9, err_msg=name)
        assert sol.flags == []
    np.testing.assert_allclose(sol([[0.93], [1.07 + gap]]), [-0.03255] * 2, rtol=1e-9)


FIRST = lambda x: jnp.sin(2 * x[0]) * jnp.exp(2 * x[1])  # noqa: E731
OTHER = lambda x: 5 * jnp.cos(3 * x[0]) * jnp.exp(3 * x[1])  # noqa: E731


@pytest.mark.parametrize("gap, shift, normals", [(0.1, 0.0, True), (0.1, 0.3, True), (0.5, 0.2, True), (1.0, 0.0, True),
                                                 (1.0, 0.0, False), (1.0, 0.4, False)])  # fmt: skip
def test_plates(gap, shift, normals):
    """Two plates with different fields, ``gap`` spacings apart: the solution of the first is that of it alone."""
    h = 1 / 12
    one = js.rectangle((0, 0), (1, 1), (13, 13), jitter=0.2, seed=1)
    two = js.rectangle((shift * h, -1 - gap * h), (1 + shift * h, -gap * h), (13, 13), jitter=0.2, seed=2)
    cloud = joined(one, two, normals=normals)
    sol = js.solve(js.Problem(FLAT, {"part0": js.dirichlet(FIRST), "part1": js.dirichlet(OTHER)}), cloud)
    alone = js.solve(js.Problem(FLAT, {g: js.dirichlet(FIRST) for g in one.groups if g != "interior"}), one)
    exact = np.asarray(jax.vmap(FIRST)(one.points))
    error = np.abs(sol.u[: len(one)] - exact).max()
    # Particles may have a few other neighbours at the corners of the plates.
    assert error < 2.0 * np.abs(alone.u - exact).max()
    points = np.stack([np.linspace(0.15, 0.85, 19), np.full(19, 0.02 * h)], axis=1)
    np.testing.assert_allclose(sol(points), jax.vmap(FIRST)(points), atol=1e-4)


def angle(x):
    t = jnp.arctan2(x[1], x[0])
    return jnp.where(t < 0, t + 2 * jnp.pi, t)


@pytest.mark.parametrize("gap", [1.0, 0.5])
def test_slit_annulus(gap):
    """u is the angle, which jumps by a turn across the slit."""
    h = 0.08
    outer, inner = (np.arcsin(gap * h / 2 / r) for r in (1.0, 0.4))
    loop = [(np.cos(t), np.sin(t)) for t in np.linspace(outer, 2 * np.pi - outer, 80)]
    loop += [(0.4 * np.cos(t), 0.4 * np.sin(t)) for t in np.linspace(2 * np.pi - inner, inner, 40)]
    cloud = js.from_polygon(loop, h)
    sol = js.solve(js.Problem(FLAT, {"boundary": js.dirichlet(angle)}), cloud)
    assert np.abs(sol.u - jax.vmap(angle)(cloud.points)).max() < 5e-5 and sol.flags == []


def test_spheres_that_nearly_touch():
    h = 0.25
    one = js.from_sdf(js.sdf.sphere((0, 0, 0), 1.0), ((-1,) * 3, (1,) * 3), h)
    two = js.from_sdf(js.sdf.sphere((2 + 0.3 * h, 0, 0), 1.0), ((1, -1, -1), (3.2, 1, 1)), h, seed=2)
    first, other = lambda x: x[0] ** 2 - x[1] ** 2 + x[2], lambda x: 5 * x[0] * x[1] - 7
    sol = js.solve(
        js.Problem(FLAT, {"part0": js.dirichlet(first), "part1": js.dirichlet(other)}), joined(one, two), order=2
    )
    exact = np.concatenate([jax.vmap(first)(one.points), jax.vmap(other)(two.points)])
    np.testing.assert_allclose(sol.u, exact, atol=1e-11)


def test_inward_normals_are_refused():
    cloud = js.from_sdf(js.sdf.circle((0, 0), 1.0), ((-1, -1), (1, 1)), 0.2)
    problem = js.Problem(LOAD, {"boundary": js.robin(1.0, 1.0, 0.0)})
    with pytest.raises(ValueError, match="normals: those of .* of the group 'boundary' point into the domain.*outward"):
        js.solve(problem, cloud.replace(normals=-cloud.normals))
    js.solve(problem, cloud)


@pytest.mark.parametrize("turned", [[5], [5, 6], [4, 9, 14, 15]])
def test_single_normals_that_point_inward_are_refused_by_number(turned):
    """One of 21 is as wrong as all of them; normals at the ends of holes and slits are no such."""
    cloud = js.rectangle((0, 0), (1, 1), (21, 21))
    sides = {**dict.fromkeys(("left", "bottom", "top"), js.dirichlet(0.0)), "right": js.neumann(1.0)}
    ids, normals = np.asarray(cloud.groups["right"])[turned], np.array(cloud.normals)
    normals[ids] *= -1
    with pytest.raises(ValueError, match=f"normals: those of {len(ids)} of .* 'right' .*first at particle {ids[0]}"):
        js.solve(js.Problem(LOAD, sides), cloud.replace(normals=normals))


def test_stencils_of_one_piece_stay_as_they_are():
    """Holes and blunt corners hide nobody who is near, but for some seen past the very edge of a corner."""
    ell = js.from_polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], 0.1)
    plate = js.from_sdf(
        js.sdf.difference(js.sdf.rectangle((0, 0), (2, 1)), js.sdf.circle((1, 0.5), 0.25)), ((0, 0), (2, 1)), 0.05
    )
    for cloud in (ell, plate):
        held = {g: js.dirichlet(0.0) for g in cloud.groups if g != "interior"}
        table = np.asarray(
            js.solve(js.Problem(LOAD, held), cloud, stencils=js.stencils(cloud, size=14))._fit.neighbours
        )
        plain = np.asarray(js.stencils(cloud, size=14).indices)
        kept = [set(a[a >= 0]) == set(b[b >= 0]) for a, b in zip(table, plain)]
        assert np.mean(kept) > 0.99


def test_both_sides_of_a_slit_have_their_particles():
    """The sides of a slit lie nearer to each other than half a spacing, with nothing of the domain between them."""
    corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (1.0, -0.01)]
    cloud = js.from_polygon(corners, 0.12)
    points = np.asarray(cloud.points)[cloud.groups["boundary"]]
    inner = points[(points[:, 0] > 0.1) & (points[:, 0] < 0.9)]
    assert (inner[:, 1] == 0.0).sum() == (np.abs(inner[:, 1] + 0.01 * inner[:, 0]) < 1e-12).sum() == 7
    # At the open end two corners lie close together; each sees its own side of the domain.
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": js.dirichlet(lambda x: x[0] * x[1])})
    right = np.prod(np.asarray(cloud.points), axis=1)
    np.testing.assert_allclose(js.solve(problem, cloud, order=4).u, right, rtol=0, atol=1e-12)  # exact, to round-off


@pytest.mark.parametrize("width", [1e-2, 5e-4, 1e-5])
def test_a_wedge_that_closes(width):
    """Particles on its two sides are beside each other, a thousandth of their distance in front."""
    vertices = [(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, width), (0, 0), (-1, -width)]
    exact = lambda x: jnp.hypot(*x) ** 2.5 * jnp.sin(2.5 * jnp.arctan2(x[1], x[0]))
    cloud = js.from_polygon(vertices, 0.1)
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": js.dirichlet(exact)}), cloud)
    error = np.abs(sol.u - np.nan_to_num(jax.vmap(exact)(cloud.points)))
    assert error.max() < 5e-4 and not sol.flags


def test_a_plate_thinner_than_its_spacing_is_no_gap():
    """Its sides have opposite normals as well, and are behind each other."""
    cloud = js.from_polygon([(0, 0), (2, 0), (2, 0.03), (0, 0.03)], lambda x: 0.012 + 0 * x[:, 0])
    exact = lambda x: jnp.exp(x[0]) * jnp.sin(x[1] + 1.0)
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": js.dirichlet(exact)}), cloud)
    assert np.abs(sol.u - jax.vmap(exact)(cloud.points)).max() < 1e-6
