"""Pictures of vectors, deformed bodies, principal stresses and solids; outlines. How they look was judged by eye."""

import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud.triangulation import boundary_facets
from jsmitsm.show.pieces import outline, pieces
from jsmitsm.show.solid import _kept

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")
plt = pytest.importorskip("matplotlib.pyplot")


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def solved(cloud, values, fields):
    """Harmonic polynomials of the second degree: exact at order 2."""
    names = [name for name in cloud.groups if name != "interior"]
    pde = lambda u, x: jnp.stack([js.laplacian(u[k])(x) for k in range(fields)])
    return js.solve(js.Problem(pde, dict.fromkeys(names, js.dirichlet(values)), fields=fields), cloud, order=2)


@pytest.fixture(scope="module")
def flat():
    plate = js.from_polygon([(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)], 0.11)
    return solved(plate, lambda x: jnp.stack([x[1], -x[0], x[0] * x[1]]), 3)


@pytest.fixture(scope="module")
def box():
    return solved(js.box((0, 0, 0), (1, 1, 1), (4, 4, 4)), lambda x: jnp.stack([0.1 * x[2], 0 * x[0], x[0] * x[1]]), 3)


def area(places, triangles):
    a, b, c = places[triangles].transpose(1, 2, 0)
    return 0.5 * np.abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).sum()


def test_what_is_painted_is_the_domain():
    """Its area, with a slit a quarter of a spacing wide and on a circle; the outline ends it."""
    slit = [(0, 0), (1, 0), (1, 1), (0.51, 1), (0.51, 0.5), (0.49, 0.5), (0.49, 1), (0, 1)]
    disk = js.from_sdf(js.sdf.circle((0, 0), 1.0), ((-1, -1), (1, 1)), 0.3)
    for cloud, size in ((js.from_polygon(slit, 0.08), 0.99), (disk, np.pi)):
        (one,) = pieces(cloud, np.zeros(len(cloud)), lambda x: np.zeros(len(x)))
        # The outline of a signed distance is a polygon of some hundred sides, its triangles of half spacings.
        assert abs(area(one.places, one.triangles) / size - 1) < 2e-2 and one.outline
        assert len(one.triangles) >= 6000 and (one.places[: len(cloud)] == cloud.points).all()
        (plain,) = pieces(cloud, np.zeros(len(cloud)), None)
        assert plain.outline, "numbers at the particles are clipped too"
    (loop,) = outline(disk)
    assert np.abs(np.hypot(*loop.T) - 1).max() < 1e-4  # linear between the lines of the lattice, 1/150 apart


def test_sides_of_a_region_that_end_at_a_corner_are_found_whole():
    """The matrix round a quarter of a fibre: normals at the fibre's ends are those of the other side."""
    fibre, cell = js.sdf.circle((0.0, 0.0), 0.3), js.sdf.rectangle((0, 0), (0.5, 0.5))
    shapes = {"fibre": js.sdf.intersection(cell, fibre), "matrix": js.sdf.difference(cell, fibre)}
    cloud = js.regions(shapes, ((0, 0), (0.5, 0.5)), 0.05)
    part = cloud.region("matrix")
    length = np.linalg.norm(np.diff(np.asarray(part.points)[boundary_facets(part)[0]], axis=1), axis=2).sum()
    assert abs(length / (2 - 0.6 + 0.15 * np.pi) - 1) < 5e-3  # chords of a tenth of a right angle
    assert abs(js.quadrature(part, "fibre|matrix").weights.sum() / (0.15 * np.pi) - 1) < 1e-3


def test_blunt_corners_of_a_polygon_are_no_curve():
    """A cape that turns by fifty degrees: its bisector is within thirty of both sides."""
    turns = np.radians(np.arange(0, 360, 51.43))
    heptagon = js.from_polygon(np.c_[np.cos(turns), np.sin(turns)], 0.21)
    corner = np.c_[np.cos(turns), np.sin(turns)]
    ahead = np.roll(corner, -1, axis=0)
    area = 0.5 * (corner[:, 0] @ ahead[:, 1] - corner[:, 1] @ ahead[:, 0])
    assert abs(js.quadrature(heptagon).weights.sum() / area - 1) < 1e-12
    length = np.linalg.norm(ahead - corner, axis=1).sum()
    assert abs(js.quadrature(heptagon, "boundary").weights.sum() / length - 1) < 1e-12


def test_arrows_are_the_field_and_stay_inside(flat):
    (quiver,) = [c for c in js.plot.vectors(flat, count=10).collections if hasattr(c, "U")]
    x, y = quiver.get_offsets().T
    assert np.allclose(quiver.U * -x, quiver.V * y, atol=1e-9), "(y, -x)"
    assert not ((x > 0.6) & (y > 0.6)).any()
    other = js.plot.vectors(flat, of=lambda p: np.ones((len(p), 2)), count=10)
    (quiver,) = [c for c in other.collections if hasattr(c, "U")]
    assert np.ptp(quiver.U) == 0
    assert js.plot.streamlines(flat).collections


def test_a_body_is_drawn_where_it_moved(flat, box):
    ax = js.plot.deformed(flat, scale=0.5)
    assert ax.get_title() == "displacements times 0.5"
    moved = np.concatenate([np.c_[line.get_data()] for line in ax.lines[1:]])
    moved = moved[np.isfinite(moved).all(axis=1)]
    # x + y / 2 and y - x / 2 of the corners (1, 0) and (0, 1)
    for corner in ((1.0, -0.5), (0.5, 1.0)):
        assert np.hypot(*(moved - corner).T).min() < 1e-9
    ax = js.plot.deformed(box, scale=0.5, engine="matplotlib")
    assert ax.get_zlabel() == "z" and ax.get_title() == "displacements times 0.5"


def test_principal_stresses_of_simple_shear(flat):
    ax = js.plot.principal(flat, lambda g: jnp.array([[0.0, 1.0], [1.0, 0.0]]), count=6)
    pulled, pushed = [line for line in ax.lines if line.get_label() in ("tension", "compression")
                      or line.get_color() in ("#D55E00", "#0072B2")][1:3]  # fmt: skip
    tension = [line for line in ax.lines if line.get_color() == "#D55E00" and np.isfinite(line.get_xdata()).any()]
    for line in tension:
        x, y = line.get_xdata(), line.get_ydata()
        assert np.allclose((x[1::3] - x[::3]), (y[1::3] - y[::3])), "along the diagonal"
    assert len(tension) == 1


def test_every_field_has_a_panel(flat, box):
    axes = js.plot.fields(flat, names=["u", "v", "w"])
    assert [ax.get_title() for ax in axes] == ["u", "v", "w"]
    assert [a.get_ylabel() for a in axes[0].figure.axes if a not in axes] == ["u", "v", "w"], "beside the bars"
    solids = js.plot.fields(box, names=["a", "b", "c (m)"], cut={"x": 0.5}, engine="matplotlib")
    assert len(solids) == 3 and solids[0].figure.axes[-1].get_ylabel() == "c (m)"
    assert js.plot.fields(box, at={"z": 0.5}).shape == (3, 1)
    line = solved(js.interval(0.0, 1.0, 7), lambda x: jnp.stack([x[0], 2 * x[0]]), 2)
    assert [ax.get_ylabel() for ax in js.plot.fields(line)] == ["u[0]", "u[1]"]


def test_a_solid_is_cut_along_the_plane(box):
    corners = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    kept, shades = _kept(corners, corners[:, :, 0], 0, 0.25)
    sides = kept[:, 1:] - kept[:, :1]
    assert abs(0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() - (0.5 - 0.5 * 0.75**2)) < 1e-12
    assert np.allclose(shades, kept[:, :, 0]) and kept[:, :, 0].max() == 0.25
    ax = js.plot.solid(box, field=2, cut={"x": 0.5, "z": 0.75}, engine="matplotlib")
    (body,) = ax.collections
    assert ax.get_xlim()[1] <= 0.53 and body is not None


def test_arrows_in_space_are_coloured_by_their_size(box):
    ax = js.plot.vectors(box, count=6, label="speed (m/s)", engine="matplotlib")
    (arrows,) = [c for c in ax.collections if c.get_array() is not None and len(c.get_array()) == 3 * 27]
    at = (np.mgrid[0:3, 0:3, 0:3].reshape(3, -1).T + 0.5) / 3
    sizes = np.hypot(0.1 * at[:, 2], at[:, 0] * at[:, 1])
    assert np.allclose(np.sort(arrows.get_array()[:27]), np.sort(sizes), atol=1e-9)
    assert ax.figure.axes[-1].get_ylabel() == "speed (m/s)"


def test_solids_arrows_bodies_and_fields_by_pyvista(box):
    pyvista = pytest.importorskip("pyvista")
    pyvista.OFF_SCREEN = True
    plotter = js.plot.solid(box, field=2, cut={"x": 0.5}, label="heat (K)")
    body = plotter.mesh
    section = np.abs(body.points[:, 0] - 0.5) < 1e-6
    assert abs(body.bounds[1] - 0.5) < 1e-6 and section.sum() > 16
    inside = section & (np.abs(body.points[:, 1:] - 0.5) < 0.49).all(axis=1)  # the surface is linear between particles
    assert np.abs(body["heat (K)"] - body.points[:, 0] * body.points[:, 1])[inside].max() < 1e-6  # in float32
    shown = [plotter, js.plot.vectors(box, count=6), js.plot.deformed(box, scale=0.5)]
    shown.append(js.plot.fields(box, cut={"x": 0.5}))
    assert abs(shown[2].meshes[0].bounds[1] - 1.05) < 1e-6, "x + 0.5 times 0.1 z"
    assert shown[3].shape == (1, 3)
    for one in shown:
        picture = one.screenshot(return_img=True)
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100, "nothing was drawn"
        one.close()


def test_what_a_polynomial_adds_to_held_values_is_not_drawn():
    """Round an inner corner, where slopes are infinite, it dips below the zero that is held on both sides."""
    plate = js.from_polygon([(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)], 0.11)
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) + 1.0, {"boundary": js.dirichlet(0.0)}), plate, order=4)
    (one,) = pieces(plate, np.asarray(sol.u), lambda x: np.asarray(sol(x, blend=True, outside="extrapolate")))
    assert sol(one.places, outside="extrapolate").min() < -1e-3 * sol.u.max() and one.values.min() == sol.u.min() == 0


def test_what_cannot_be_drawn_is_named(flat, box):
    line = solved(js.interval(0.0, 1.0, 7), lambda x: jnp.stack([x[0], 2 * x[0]]), 2)
    two = solved(js.box((0, 0, 0), (1, 1, 1), (4, 4, 4)), lambda x: jnp.stack([x[0], x[1]]), 2)
    plot = js.plot
    for call, text in (
        (lambda: plot.vectors(line), "js.plot.vectors draws in two dimensions or three"),
        (lambda: plot.vectors(two), "2 fields are no vectors in 3 dimensions"),
        (lambda: plot.vectors(flat, of=lambda p: p[:, 0]), "of: expected .* numbers"),
        (lambda: plot.vectors(flat, count=0.5), "count: expected a number from 2, got 0.5"),
        (lambda: plot.vectors(flat.cloud), "sol: expected a js.Solution, got Cloud"),
        (lambda: plot.streamlines(box), "stream lines are drawn in two dimensions"),
        (lambda: plot.deformed(two), "a deformed shape needs 3 fields.* has 2"),
        (lambda: plot.principal(box, lambda g: g), "principal stresses are drawn for two fields"),
        (lambda: plot.principal(flat, lambda g: g[0]), r"stress: expected an array of shape \(2, 2\)"),
        (lambda: plot.fields(flat, names=["a"]), "names: expected 3"),
        (lambda: plot.solid(flat), "a solid has three dimensions, this solution 2"),
        (lambda: plot.solid(box, engine="vtk"), "engine: expected one of"),
        (lambda: plot.solid(box, cut={"w": 1.0}, engine="matplotlib"), "at: .*positions by axis"),
    ):
        with pytest.raises(ValueError, match=text):
            call()


def test_colours_begin_with_the_data(flat):
    """The bar's ends are the smallest and the largest value, to what lies between the particles."""
    ax = js.plot.solution(flat, field=2)
    bar = next(a for a in ax.figure.axes if a is not ax)
    assert abs(bar.get_ylim()[0]) < 1e-9 and abs(bar.get_ylim()[1] - 0.5) < 1e-3
