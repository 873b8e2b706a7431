"""Pictures: what is drawn, where it ends, and that they compose. How they look was judged by eye."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm import plot, sdf
from jsmitsm.cloud.shapes import from_polygon, from_sdf
from jsmitsm.cloud.triangulation import cut, simplices

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")
plt = pytest.importorskip("matplotlib.pyplot")


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def measure(points, cells):
    """Total length, area or volume of simplices in their own dimension."""
    sides = points[cells[:, 1:]] - points[cells[:, :1]]
    return np.abs(np.linalg.det(sides)).sum() / (1, 1, 2, 6)[points.shape[1]]


HOLED = from_polygon([(0, 0), (3, 0), (3, 2), (0, 2)], 0.25, holes=[[(1, 0.5), (2, 0.5), (2, 1.5), (1, 1.5)]])


@pytest.fixture(scope="module")
def holed():
    """u = x y on a plate with a hole, exact for every method of order 2 or more."""
    bcs = {name: js.dirichlet(lambda x: x[0] * x[1]) for name in ("boundary", "hole0")}
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), bcs), HOLED, order=3)


@pytest.fixture(scope="module")
def line():
    bcs = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 6 * x[0], bcs), js.interval(0.0, 1.0, 9), order=3)


@pytest.mark.parametrize("keep", [True, False], ids=["with normals", "without"])
def test_triangles_leave_holes_and_notches_out(keep):
    shape = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
    for cloud, area, slack in (
        (from_polygon(shape, 0.1), 3.0, 0.01),
        (HOLED, 5.0, 0.05),  # without normals the hole's corners are guesswork
        (js.rectangle((0, 0), (1, 20 if keep else 1.5), (11, 11)), 20.0 if keep else 1.5, 0.01),
    ):
        shown = cloud if keep else js.Cloud(cloud.points, cloud.groups)
        found = measure(cloud.points, simplices(shown))
        assert abs(found / area - 1) < (1e-12 if keep else slack)


def test_intervals_and_tetrahedra():
    gap = js.Cloud(np.array([[0.0], [0.5], [1.0], [3.0], [3.5], [4.0]]), {"interior": [1, 4], "rim": [0, 2, 3, 5]},
                   np.array([[-1.0], [np.nan], [1.0], [-1.0], [np.nan], [1.0]]))  # fmt: skip
    assert abs(measure(gap.points, simplices(gap)) - 2.0) < 1e-12
    shell = from_sdf(sdf.difference(sdf.ball((0, 0, 0), 1.0), sdf.ball((0, 0, 0), 0.5)), ((-1,) * 3, (1,) * 3), 0.25)
    # Facets between particles 0.25 apart lie inside of the sphere: some percent are lost.
    assert 0.9 < measure(shell.points, simplices(shell)) / (4 / 3 * np.pi * (1 - 0.5**3)) < 1.02


@pytest.mark.parametrize("position", [0.5, 0.3])  # through lattice nodes, and between them
def test_a_cut_covers_the_section_and_lies_in_its_plane(position):
    box = js.box((0, 0, 0), (1, 2, 3), (3, 5, 7))
    cells, points, edges = cut(box.points, simplices(box), 0, position)
    np.testing.assert_allclose(points[:, 0], position, atol=1e-6)  # a plane through particles is shifted by 1e-7
    assert abs(measure(points[:, 1:], cells) - 6.0) < 1e-5


def test_cloud_draws_every_group_normals_and_a_support():
    for cloud in (js.interval(0, 1, 7), js.rectangle((0, 0), (1, 1), (5, 5)), js.box((0, 0, 0), (1, 1, 1), (3, 3, 3))):
        middle = len(cloud) // 2
        ax = plot.cloud(cloud, normals=True, support=middle, kernel=js.Gaussian(cloud.spacing, 1.0))
        names = [text.get_text() for text in ax.get_legend().get_texts()]
        assert [n.split(" (")[0] for n in names] == [*cloud.groups, f"support of {middle}"]
        assert names[-1].endswith(f"({2 * cloud.dim + 1})")  # the edge of the support counts
        drawn = sum(len(c.get_offsets()) for c in ax.collections if c.get_label() in names[:-1])
        assert drawn == len(cloud)
        ax.figure.canvas.draw()


def test_support_from_stencils_and_from_a_solution(holed):
    for ax in (plot.cloud(HOLED, support=3, stencils=js.stencils(HOLED, size=6)), plot.cloud(holed, support=3)):
        assert "support of 3" in ax.get_legend().get_texts()[-1].get_text()


def test_a_line_is_drawn_from_the_local_polynomials(line):
    ax = plot.solution(line, exact=lambda x: x[0] ** 3)
    curve, dots, truth = ax.lines
    x, y = curve.get_data()
    fine = np.isfinite(x)
    assert fine.sum() > 100 and len(dots.get_xdata()) == 9
    np.testing.assert_allclose(y[fine], x[fine] ** 3, atol=1e-12)
    np.testing.assert_allclose(truth.get_ydata()[fine], x[fine] ** 3, atol=1e-12)


def test_contours_follow_the_shape(holed):
    """The picture's own pixels: colour in the plate, nothing in the hole."""
    ax = plot.solution(holed, colorbar=False)
    figure = ax.figure
    figure.canvas.draw()
    image = np.asarray(figure.canvas.buffer_rgba())[..., :3]

    def colour(x, y):
        column, row = ax.transData.transform((x, y)).astype(int)
        return tuple(map(int, image[image.shape[0] - 1 - row, column]))

    assert colour(1.5, 1.0) == colour(1.05, 1.45) == (255, 255, 255)
    low, high = colour(0.1, 0.1), colour(2.95, 1.95)
    assert low != (255, 255, 255) and sum(high) > sum(low) + 200  # viridis goes from dark to light


def test_error_and_estimate_maps(holed, line):
    exact = HOLED.points[:, 0] * HOLED.points[:, 1]
    for ax in (plot.error(holed, exact + 1e-3), plot.error(holed, lambda x: x[0] * x[1] + 1e-3, log=False)):
        assert ax.get_aspect() == 1.0 and ax.get_xlabel() == "x"
    ax = plot.error(line, lambda x: x[0] ** 3 + 0.01 * np.float64(x[0]))
    top = ax.lines[0].get_ydata().max()
    assert ax.get_yscale() == "log" and abs(top - 0.01) < 1e-10


@pytest.mark.parametrize(("height", "below"), [(0.5, True), (1.0, False)])
def test_the_colour_bar_of_a_long_domain_lies_below_it(height, below):
    """Beside a low picture its numbers collide."""
    long = js.rectangle((0.0, 0.0), (2.0, height), (9, 5))
    ax = plot.values(long, long.points[:, 0])
    (bar,) = [other for other in ax.figure.axes if other is not ax]
    assert (bar.get_position().y1 < ax.get_position().y0) == below
    assert (bar.get_position().x0 > ax.get_position().x1) == (not below)


def test_slices_of_a_solid():
    box = js.box((0, 0, 0), (1, 1, 1), (5, 5, 5))
    axes = plot.values(box, box.points.sum(axis=1))
    assert [ax.get_title() for ax in axes] == ["z = 0.5", "y = 0.5", "x = 0.5"]
    assert [(ax.get_xlabel(), ax.get_ylabel()) for ax in axes] == [("x", "y"), ("x", "z"), ("y", "z")]
    (one,) = plot.values(box, box.points[:, 2], at={"z": 0.3}, colorbar=False)
    assert one.get_title() == "z = 0.3"


def test_sparsity_of_stencils_and_matrices(holed):
    from scipy.sparse import eye_array

    assert plot.sparsity(js.stencils(js.interval(0, 1, 7), size=3)).get_title() == "7 rows, 21 entries, 3.0 a row"
    assert plot.sparsity(eye_array(2000)).get_title() == "2000 rows, 2000 entries, 1.0 a row"
    assert plot.sparsity(holed).get_title().startswith(f"{len(HOLED)} rows")


def test_tuning_history():
    history = {"objective": [3.0, 1.0, 2.0], "h": [0.1, 0.2, 0.3], "d": [[4.0, 5.0], [3.0, 5.0], [3.0, 4.0]]}
    axes = plot.tuning(history)
    assert [ax.get_ylabel() for ax in axes] == ["objective", "h", "d"]
    assert axes[0].get_title(loc="right") == "best 1 at step 1"
    assert axes[2].lines[0].get_ydata().tolist() == [4.5, 4.0, 3.5]
    history |= {"params": {"a": np.ones(3), "b": np.ones((3, 2))}, "objective": [3.0, np.nan, 2.0]}
    axes = plot.tuning(history)
    assert [ax.get_ylabel() for ax in axes[3:]] == ["params['a']", "params['b']"]
    assert axes[0].get_title(loc="right") == "best 2 at step 2"
    steps = [{"objective": 1.0, "h": 0.1}, {"objective": 0.5, "h": 0.2}]
    assert len(plot.tuning(steps)) == 2


def test_orders_of_lines_that_end_together_do_not_overlap():
    h = np.array([0.1, 0.05])
    first, second = plot.convergence(h, {"one": h**2, "other": 1.001 * h**2}).texts
    assert second.xyann[1] - first.xyann[1] > 10, "a line of text is about ten points high"


def test_observed_order_is_written_and_round_off_ignored():
    h = np.array([0.025, 0.1, 0.05, 0.0125])
    ax = plot.convergence(h, {"good": 3 * h**4, "flat": np.where(h < 0.02, 5e-14, h**6)})
    assert [text.get_text() for text in ax.texts] == ["order 4.00", "order 6.00"]


def test_pictures_compose(holed):
    figure, (left, right) = plt.subplots(1, 2)
    assert plot.cloud(HOLED, ax=left) is left
    assert plot.solution(holed, ax=right) is right
    assert plot.cloud(HOLED, ax=right, legend=False) is right and figure.axes[:2] == [left, right]
    box = js.box((0, 0, 0), (1, 1, 1), (3, 3, 3))
    _, three = plt.subplots(1, 3)
    assert (plot.values(box, box.points[:, 0], ax=three) == three).all()


def test_bad_input_is_named(holed, line):
    box = js.box((0, 0, 0), (1, 1, 1), (3, 3, 3))
    flat, many = plt.subplots(1, 3)
    cases = [
        (lambda: plot.cloud(3), "what: expected a js.Cloud or a js.Solution, got int"),
        (lambda: plot.cloud(HOLED, support=1), "support: pass kernel="),
        (lambda: plot.cloud(HOLED, support=10**6, kernel=js.Gaussian(1.0, 1.0)), "support: particle 1000000"),
        (lambda: plot.cloud(js.Cloud(HOLED.points, HOLED.groups), normals=True), "normals: this cloud has none"),
        (lambda: plot.cloud(box, ax=many[0]), "ax: three-dimensional axes"),
        (lambda: plot.cloud(HOLED, ax=many), "ax: one axes is needed, 3 came"),
        (lambda: plot.solution(HOLED), "sol: expected a js.Solution, got Cloud"),
        (lambda: plot.solution(holed, at={"x": 0.5}), "at: slices are for 3D"),
        (lambda: plot.values(box, np.ones(27), at={"w": 0.5}), "at: .*positions by axis"),
        (lambda: plot.values(box, np.ones(27), at={"z": 5.0}), "at: the plane z = 5 does not meet"),
        (lambda: plot.values(box, np.ones(27), ax=many[:2]), "ax: this picture has 3 panel"),
        (lambda: plot.values(HOLED, np.ones(3)), "numbers: expected shape"),
        (lambda: plot.values(HOLED, np.full(len(HOLED), np.nan)), "numbers: NaN"),
        (lambda: plot.error(line, np.ones(3)), "exact: expected 9 numbers"),
        (lambda: plot.convergence([0.1, 0.2], [1.0]), "errors: expected"),
        (lambda: plot.tuning({"h": [1.0]}), 'no "objective"'),
    ]
    for call, text in cases:
        with pytest.raises(ValueError, match=text):
            call()


def test_matplotlib_is_optional_and_imported_late():
    code = (
        "import sys, jsmitsm as js\njs.plot\n"
        "assert 'matplotlib' not in sys.modules\n"
        "sys.modules['matplotlib'] = None\n"
        "try: js.plot.cloud(js.interval(0, 1, 3))\n"
        "except ImportError as e: assert 'pip install \"jsmitsm[plot]\"' in str(e), e\n"
        "else: raise SystemExit('drew without matplotlib')"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_random_cloud_without_normals_leaves_no_white_triangles():
    """An interior particle proves a simplex innocent, however long its edges: only the hole is left out."""
    rng = np.random.default_rng(0)
    inside = rng.uniform(0, 1, (400, 2))
    side = np.linspace(0, 1, 20, endpoint=False)
    rim = np.concatenate([np.c_[side, 0 * side], np.c_[1 + 0 * side, side], np.c_[1 - side, 1 + 0 * side],
                          np.c_[0 * side, 1 - side]])  # fmt: skip
    round_ = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    hole = 0.5 + 0.2 * np.c_[np.cos(round_), np.sin(round_)]
    inside = inside[np.hypot(*(inside - 0.5).T) > 0.21]
    points = np.concatenate([inside, rim, hole])
    n = len(inside)
    cloud = js.Cloud(points, {"interior": np.arange(n), "rim": np.arange(n, len(points))})
    a, b, c = points[simplices(cloud)].transpose(1, 2, 0)
    area = 0.5 * np.abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).sum()
    # A 24-gon of radius 0.2; a sliver or two beside the rim may go.
    assert area == pytest.approx(1 - 12 * 0.2**2 * np.sin(2 * np.pi / 24), abs=2e-3)


def test_a_particle_just_behind_a_notch_does_not_bridge_it():
    """An L without normals: an interior particle 0.001 behind the side sees the other side of the notch."""
    corners = np.array([(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)], float)
    share = np.linspace(0, 1, 14, endpoint=False)[:, None]
    rim = np.concatenate([a * (1 - share) + b * share for a, b in zip(corners, np.roll(corners, -1, axis=0))])
    inside = np.random.default_rng(0).uniform(0.01, 0.99, (300, 2))
    inside = np.concatenate([inside[~(inside > 0.49).all(axis=1)], [[0.499, 0.66], [0.66, 0.499], [0.4985, 0.8]]])
    n, points = len(inside), np.concatenate([inside, rim])
    cloud = js.Cloud(points, {"interior": np.arange(n), "rim": np.arange(n, len(points))})
    cells = simplices(cloud)
    # One spacing of the rim, 0.036: triangles in the very corner of the notch may stay.
    across = points[cells[(points[cells].mean(axis=1) > 0.5).all(axis=1)]]
    assert not len(across) or across.max() < 0.5 + 2.1 / 28


ONE, FLAT = js.Cloud([[0.5, 0.5]], {"interior": [0]}), js.rectangle((0, 0), (1, 1), (6, 6))


def flat():
    zero = {side: js.dirichlet(0.0) for side in FLAT.groups if side != "interior"}
    return js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, zero), FLAT, order=2)


@pytest.mark.filterwarnings("error")
def test_what_cannot_be_drawn_is_named():
    sol, plot = flat(), js.plot
    for call, text in (
        (lambda: plot.values(FLAT, np.ones(36) * 1j), "numbers: expected real numbers, got complex128"),
        (lambda: plot.values(FLAT, ["a"] * 36), "numbers: expected real numbers"),
        (lambda: plot.values(FLAT, np.linspace(1e300, 1.7e308, 36)), "numbers of size 2e.308.*another unit"),
        (lambda: plot.values(FLAT, np.full(36, np.nan)), "NaN or infinite at 36 particles; set them"),
        (lambda: plot.values(FLAT, np.ones(3)), r"expected shape \(36,\)"),
        (lambda: plot.values(None, np.ones(3)), "cloud: expected a js.Cloud, got NoneType"),
        (lambda: plot.values(ONE, [1.0]), "1 particles make no 2D simplex; add"),
        (lambda: jax.jit(lambda q: plot.values(FLAT, q * jnp.ones(36)))(1.0),
         "traced by a JAX transform; draw outside"),
        (lambda: plot.error(sol, "x"), "exact: expected real numbers"),
        (lambda: plot.error(sol, np.ones(36) * 1j), "exact: expected real numbers"),
        (lambda: plot.error(sol, np.ones(3)), "exact: expected 36 numbers"),
        (lambda: plot.solution(sol, levels="many"), "levels: expected a number of contour levels.*'many'"),
        (lambda: plot.solution(sol, ax=3), "ax: expected axes of matplotlib.*got int"),
        (lambda: plot.solution(sol, at={"x": 0.5}), "at: slices are for 3D clouds"),
        (lambda: plot.solution(None), "sol: expected a js.Solution, got NoneType"),
        (lambda: plot.cloud(sol, support="first"), "support: particle 'first', but.*0 to 35"),
        (lambda: plot.cloud(sol, support=1.5), "support: particle 1.5, but.*0 to 35"),
        (lambda: plot.cloud(FLAT, support=3, kernel="gauss"), "kernel: expected a kernel such as.*'gauss'"),
        (lambda: plot.cloud(FLAT.points), "what: expected a js.Cloud or a js.Solution"),
        (lambda: plot.tuning(None), "result: expected what js.tune returned.*NoneType"),
        (lambda: plot.tuning([]), "result: expected what js.tune returned"),
        (lambda: sol.derivative([[0.5, 0.5]], 1), "multi_index: expected 2 non-negative orders.*got 1"),
        (lambda: sol.derivative([[0.5, 0.5]], "xy"), "multi_index: expected 2 non-negative orders"),
        (lambda: sol.derivative([[0.5, 0.5]], (0.5, 0)), "multi_index: expected 2 non-negative orders"),
    ):
        with pytest.raises(ValueError, match=text):
            call()


@pytest.mark.filterwarnings("error")
def test_odd_clouds_that_can_be_drawn():
    """One particle, one value everywhere, nothing positive on a logarithmic scale."""
    js.plot.cloud(ONE)
    js.plot.values(FLAT, np.full(36, 3.0))
    js.plot.values(FLAT, -np.ones(36), log=True)
    js.plot.error(flat(), np.asarray(flat().u))
