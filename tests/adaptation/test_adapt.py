"""A tolerance in, an answer out: what is reached is so, what is not is said."""

import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from benchmarks.adaptation import CASES
from benchmarks.nist import reentrant
from jsmitsm.adaptation import measure
from jsmitsm.adaptation.data import data_of, unresolved
from jsmitsm.adaptation.first_cloud import first_cloud
from jsmitsm.adaptation.free_ends import off_at_free_ends
from jsmitsm.adaptation.layers import along_outflow, layers
from jsmitsm.adaptation.marking import Marks, marks, next_spacing
from jsmitsm.adaptation.measure import Measured
from jsmitsm.adaptation.rounds import Rounds
from jsmitsm.adaptation.spacing_field import GROWTH, SpacingField
from jsmitsm.adaptation.witness import Earlier, remembered, stands_out, unseen
from jsmitsm.runtime.errors import SolveError
from jsmitsm.solution.look.edges import edges

CORNER = [(0, 0), (1, 0), (1, 1), (-1, 1), (-1, -1), (0, -1)]
SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]


def line(spacing):
    return js.interval(0.0, 1.0, spacing=spacing)


def ends(left, right):
    return {"left": js.dirichlet(left), "right": js.dirichlet(right)}


def true_error(found, exact):
    known = np.asarray(jax.vmap(exact)(np.asarray(found.cloud.points)))
    return float(np.abs(np.asarray(found.solution.u) - known).max() / np.abs(known).max())


def singular(x):
    """r^(2/3) sin(2 t / 3), harmonic, with an infinite slope at the corner."""
    square = x[0] ** 2 + x[1] ** 2
    safe = jnp.where(square == 0, 1.0, square)
    angle = jnp.arctan2(x[1], jnp.where(square == 0, 1.0, x[0]))
    angle = jnp.where(angle < -1e-9, angle + 2 * jnp.pi, angle)
    return jnp.where(square == 0, 0.0, safe ** (1 / 3) * jnp.sin(2 / 3 * angle))


@pytest.fixture(scope="module")
def cornered():
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": js.dirichlet(singular)})
    return js.adapt(problem, lambda spacing: js.from_polygon(CORNER, spacing), 2e-3, order=4)


def test_a_corner_is_found_by_the_estimate_alone(cornered):
    assert cornered.reached and cornered.error <= 2e-3 and not cornered.flags
    true = true_error(cornered, singular)
    assert true <= 3 * 2e-3  # what "reached" promises
    assert true / 5 <= cornered.error <= 20 * true  # near a corner the check by another order is on the safe side
    points = np.asarray(cornered.cloud.points)
    finest = np.argsort(np.linalg.norm(points[:, None] - points[None], axis=2) + 9 * np.eye(len(points)), axis=1)[:, 0]
    gap = np.linalg.norm(points - points[finest], axis=1)
    assert np.linalg.norm(points[np.argmin(gap)]) < 0.05  # the corner is the origin
    assert gap.max() > 10 * gap.min()


def test_the_history_has_every_round(cornered):
    history = cornered.history
    assert set(history) == {"particles", "order", "error", "seconds", "smallest"}
    assert len({len(column) for column in history.values()}) == 1
    assert history["particles"][-1] == len(cornered.cloud) and (history["order"] == 4).all()
    assert history["smallest"][-1] < history["smallest"][0] and (history["seconds"] > 0).all()
    assert "reached=True" in repr(cornered) and "Adapted(" in cornered.diagnose()


def test_a_gradient_passes_through_the_final_cloud(cornered):
    cloud, near = cornered.cloud, js.stencils(cornered.cloud, size=20)

    def middle(q):
        problem = js.Problem(lambda u, x: js.laplacian(u)(x) + q, {"boundary": js.dirichlet(0.0)})
        return js.solve(problem, cloud, order=4, stencils=near).u.max()

    # The problem is linear in q: the slope is the value at q = 1.
    assert float(jax.grad(middle)(2.0)) == pytest.approx(float(middle(1.0)), rel=1e-9)


def test_layers_at_both_ends_are_told_by_the_coefficients():
    """-eps^2 u'' + u = 0 with u = 1 at the ends: within the first spacing no particle sees anything but zero."""
    eps = 1e-4
    problem = js.Problem(lambda u, x: u(x) - eps**2 * js.laplacian(u)(x), ends(1.0, 1.0))
    found = js.adapt(problem, line, 1e-4, order=4)
    exact = lambda x: jnp.exp(-x[0] / eps) + jnp.exp((x[0] - 1.0) / eps)
    assert found.reached and true_error(found, exact) <= 3e-4
    # Between the particles too.
    at = np.linspace(0.0, 10 * eps, 201)[:, None]
    assert np.abs(np.asarray(found.solution(at)) - np.exp(-at[:, 0] / eps)).max() < 3e-3


def test_a_nonlinear_problem_and_its_quantity():
    """u'' = 6 u^2 has the solution (1 + x)^-2; its slope at the right end is -2 / 8."""
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 6.0 * u(x) ** 2, ends(1.0, 0.25))
    found = js.adapt(problem, line, 1e-5, order=4, quantity=lambda sol: sol.flux("right"))
    assert found.reached
    assert abs(found.quantity + 0.25) <= 3e-5 * 0.25
    assert found.error <= 1e-5


def test_the_tolerance_is_on_the_number():
    """A point value of u'' = -pi^2 sin(pi x) to a tolerance that the first cloud does not meet."""
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) + jnp.pi**2 * jnp.sin(jnp.pi * x[0]), ends(0.0, 0.0))
    found = js.adapt(problem, line, 1e-4, order=2, start=0.1, depth=0, quantity=lambda sol: sol(np.array([[0.3]]))[0])
    away = abs(found.quantity - np.sin(0.3 * np.pi)) / np.sin(0.3 * np.pi)
    assert len(found.history["particles"]) > 1
    assert found.reached and away <= 3e-4


@pytest.mark.parametrize("at, tol", [((0.0, 0.5), 1e-3), ((0.0, 0.5), 1e-4), ((0.3, 0.2), 1e-3)])
def test_the_error_of_a_slope_is_more_than_that_of_the_values(at, tol):
    """Of a smooth solution: the polynomial's slope misses ten times what the values below it make of it."""
    exact = lambda x: jnp.exp(2 * x[0]) * jnp.sin(5 * x[1])  # noqa: E731
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) + 21 * exact(x), {"boundary": js.dirichlet(exact)})
    slope = lambda sol: sol.grad(np.array([at]))[0, 0]  # noqa: E731
    found = js.adapt(problem, lambda h: js.from_polygon(SQUARE, h), tol, quantity=slope, progress=False)
    true = float(jax.grad(exact)(jnp.array(at))[0])
    assert found.reached and 0.5 < found.error / abs(found.quantity / true - 1.0) < 2.0


def test_what_limits_is_said():
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) + jnp.sin(40.0 * x[0]), ends(0.0, 0.0))
    few = js.adapt(problem, line, 1e-10, order=2, depth=0, max_particles=40)
    assert not few.reached and few.error > 1e-10 and len(few.cloud) <= 40
    assert any("max_particles" in line for line in few.messages)
    stiff = lambda spacing: js.interval(0.0, 1.0, 20) if callable(spacing) else line(spacing)
    same = js.adapt(problem, stiff, 1e-10, order=2, depth=0, start=0.05)
    assert not same.reached and len(same.history["particles"]) == 2 and "same particles again" in same.messages[0]
    short = js.adapt(problem, line, 1e-10, order=2, depth=0, max_rounds=1)
    assert not short.reached and any("max_rounds" in line for line in short.messages)


# ------------------------------------------------------------------ what is known before a solve


def test_a_peak_between_the_particles_is_seen():
    peak = lambda x: jnp.exp(-1e5 * ((x[0] - 0.51) ** 2 + (x[1] - 0.117) ** 2))
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 1e5 * peak(x), {"boundary": js.dirichlet(0.0)})
    cloud = js.from_polygon(SQUARE, 0.1)
    points, width = unresolved(data_of(problem, 2, 4), cloud, 0.1, 0.05, 1.0, 100_000)
    finest = points[width == width.min()]
    assert width.min() < 2e-3  # its width is 3e-3
    assert np.linalg.norm(finest - [0.51, 0.117], axis=1).max() < 0.02


def test_a_layer_within_a_line_is_told_by_the_drift():
    """eps u'' + x u' = 0 turns within sqrt(eps) about 0; with the other sign its layers are at the ends."""
    for sign, finest in ((1.0, 1e-3), (-1.0, 0.1)):
        problem = js.Problem(lambda u, x: 1e-6 * js.laplacian(u)(x) + sign * x[0] * js.grad(u)(x)[0], ends(-1.0, 1.0))  # noqa: B023
        points, width = unresolved(data_of(problem, 1, 4), js.interval(-1.0, 1.0, 21), 0.1, 0.05, 1.0, 10_000)
        assert finest / 2 < width.min(initial=0.1) < 2 * finest
        assert sign < 0 or abs(points[np.argmin(width), 0]) < 2 * finest


def test_a_kink_of_the_source_is_in_the_error():
    """u'' jumps at 0.3, between particles: rows of two orders miss it by the same, and their distance tells nothing."""
    bent = lambda x: jnp.sign(x[0] - 0.3) * (x[0] - 0.3) ** 2 / 2
    source = lambda x: jnp.where(x[0] > 0.3, 1.0, -1.0)
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - source(x), ends(-0.045, 0.245))
    found = js.adapt(problem, line, 1e-3, max_rounds=1)
    assert found.error < 5 * true_error(found, bent) and true_error(found, bent) < 3 * found.error
    # The same in a nonlinear equation, whose source is what it leaves of the solution.
    pde = lambda u, x: js.laplacian(u)(x) - u(x) ** 2 - source(x) + bent(x) ** 2
    found = js.adapt(js.Problem(pde, ends(-0.045, 0.245)), line, 1e-3, max_rounds=1)
    assert found.error < 5 * true_error(found, bent) and true_error(found, bent) < 3 * found.error
    exact = js.Problem(lambda u, x: js.laplacian(u)(x) - jnp.sin(40.0 * x[0]), ends(0.0, 0.0))
    smooth = js.solve(exact, js.interval(0.0, 1.0, 15)).correction()  # resolved by what rows know of it
    assert np.abs(smooth.missed[0]).max() < np.abs(smooth.error).max()


def test_a_smooth_source_asks_for_nothing():
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - jnp.exp(x[0] * x[1]), {"boundary": js.dirichlet(0.0)})
    points, _ = unresolved(data_of(problem, 2, 4), js.from_polygon(SQUARE, 0.1), 0.1, 0.05, 1.0, 100_000)
    assert not len(points)


def test_outflow_has_a_layer_and_inflow_none():
    problem = js.Problem(lambda u, x: -1e-3 * js.laplacian(u)(x) + js.grad(u)(x)[0] - 1.0, ends(0.0, 0.0))
    at, spacing = layers(data_of(problem, 1, 4), js.interval(0.0, 1.0, 11), np.full(11, 0.1))
    assert at.tolist() == [[1.0]]
    assert spacing == pytest.approx([1e-3])


def test_a_layer_of_convection_is_followed_along_its_whole_boundary():
    """Its width is 1e-2; along the sides that the wind blows past, and where it comes in, nothing is refined."""
    square = lambda spacing: js.from_polygon(SQUARE, spacing)
    wind = js.Problem(lambda u, x: 1e-2 * js.laplacian(u)(x) - js.grad(u)(x)[0] + 1.0, {"boundary": js.dirichlet(0.0)})
    points, data = np.asarray(square(0.1).points), data_of(wind, 2, 4)
    field = SpacingField(points, np.full(len(points), 0.1), 1.0)
    # At the corners normals are halfway to the sides, and halfway between two particles the spacing may have grown.
    followed, y = along_outflow(data, square, field, 5000), np.linspace(0.05, 0.95, 41)
    assert followed(np.stack([np.ones(41), y], axis=1)).max() <= (1.0 + GROWTH / 2.0) * 1e-2
    assert field(np.stack([np.ones(41), y], axis=1)).min() >= 0.099
    assert followed(np.stack([np.zeros(41), y], axis=1)).min() >= 0.099
    assert along_outflow(data, square, field, 300) is field  # too many particles
    still = js.Problem(lambda u, x: 1e-4 * js.laplacian(u)(x) - u(x) + 1.0, {"boundary": js.dirichlet(0.0)})
    assert along_outflow(data_of(still, 2, 4), square, field, 5000) is field


def test_a_search_begins_finer_where_a_region_is_thinner_than_its_first_spacing():
    """A wall of a tenth between two rooms: the maker's refusal of coarse spacings is no end."""
    box = lambda a, b: [(a, 0.0), (b, 0.0), (b, 1.0), (a, 1.0)]
    shapes = {"left": box(0, 1), "wall": box(1, 1.1), "right": box(1.1, 2)}
    k = {"left": 1.0, "wall": 1e-2, "right": 1.0}
    flux = {name: lambda u, x, n, k=k[name]: k * n @ js.grad(u)(x) for name in k}
    pdes = {name: lambda u, x, k=k[name]: k * js.laplacian(u)(x) + 1.0 for name in k}
    meet = {f"{a}|{b}": js.interface(flux={a: flux[a], b: flux[b]}) for a, b in (("left", "wall"), ("wall", "right"))}
    problem = js.Problem(pdes, {"boundary": js.dirichlet(0.0), **meet})
    make = lambda spacing: js.regions(shapes, spacing=spacing)
    with pytest.raises(ValueError, match="'wall'.*too small for the spacing"):
        make(0.3)
    found = js.adapt(problem, make, 1e-3, progress=False)
    at = np.array([[0.5, 0.5], [1.05, 0.5], [1.5, 0.3]])
    fine = js.solve(problem, make(0.04), order=6)
    assert found.reached
    assert np.abs(found.solution(at) - fine(at)).max() < 3e-3 * np.abs(fine.u).max()


@pytest.mark.parametrize(("long", "high"), [(3.0, 0.5), (5.0, 1.0), (40.0, 1.0), (1.0, 0.02)])
def test_the_first_cloud_suits_slender_shapes(long, high):
    strip = [(0, 0), (long, 0), (long, high), (0, high)]
    bounds = ((0, 0), (long, high))
    for make in (
        lambda spacing: js.from_polygon(strip, spacing),
        lambda spacing: js.from_sdf(js.sdf.rectangle(*bounds), bounds, spacing),
    ):
        cloud, spacing = first_cloud(make, None)
        assert len(cloud.groups["interior"]) > 0 and spacing.largest_used < high


def test_every_refusal_of_a_coarse_spacing_is_one_of_its_kind():
    """Searches go on after a ``TooCoarse``, and not after any other ``ValueError``."""
    for path in Path(js.__file__).parent.rglob("*.py"):
        for refusal in re.findall(r"raise ValueError\([^)]*too coarse[^)]*", path.read_text()):
            raise AssertionError(f"{path.name}: {refusal}")


def test_the_first_cloud_suits_any_size_of_domain():
    for size in (1e-3, 1.0, 1e4):
        cloud, _ = first_cloud(lambda spacing: js.from_polygon(np.multiply(SQUARE, size), spacing), None)  # noqa: B023
        assert 100 <= len(cloud) <= 400


# ------------------------------------------------------------------ spacings


def test_a_spacing_field_grows_no_faster_than_it_may():
    rng = np.random.default_rng(0)
    points = rng.uniform(size=(300, 2))
    wanted = np.where(np.arange(300) == 7, 1e-4, 0.2)
    field = SpacingField(points, wanted, 0.2)
    away = np.linalg.norm(points - points[7], axis=1)
    # From neighbour to neighbour a way is longer than straight, by up to a half here; at a point it is the own one.
    assert (field(points) <= np.minimum(0.2, 1e-4 + GROWTH * 2.0 * away) + 1e-12).all()
    assert field(points[7:8]) == pytest.approx([1e-4])
    assert field(np.array([[9.0, 9.0]])) <= 0.2


def marked(points, eta):
    none = np.zeros(len(points), bool)
    return Marks(points, np.full(len(points), 0.01), eta, np.full(len(points), 5.0), none, none, none)


def test_contributions_are_made_equal():
    """Of two halves whose contributions differ by 2^5, at a rate of 5 the worse one gets half the spacing."""
    points = np.linspace(0.0, 1.0, 100)[:, None]
    eta = np.where(points[:, 0] < 0.5, 1.0, 2.0**-5)
    found = marked(points, eta)
    made, count = next_spacing(found, 5.0, 1e-1, 2e-3, 100_000)
    assert made[0] < made[-1]
    assert made[-1] / made[0] == pytest.approx(2.0, rel=1e-6)
    assert next_spacing(found, 5.0, 1e-2, 1e-12, 150)[1] <= 150


def test_near_the_tolerance_no_spacing_grows():
    """What was coarsened there had to be refined again, round after round; but for what is no matter at all."""
    points = np.linspace(0.0, 1.0, 100)[:, None]
    found = marked(points, np.where(np.arange(100) < 50, 1.0, 1e-3))
    assert next_spacing(found, 5.0, 5e-3, 2e-3, 100_000)[0].max() == pytest.approx(0.01)
    assert next_spacing(found, 5.0, 2.5e-1, 2e-2, 100_000)[0].max() > 0.013
    found = marked(points, np.where(np.arange(100) < 50, 1.0, 1e-9))
    assert next_spacing(found, 5.0, 5e-3, 2e-3, 100_000)[0].max() > 0.013


def test_a_singular_point_found_twice_is_refined_by_far():
    """Contributions h^(2/3) about 0, on spacings that grow from it; those beside it are left to the gradation."""

    def round_of(tip, before):
        away = tip * (1.25 ** np.arange(1, 41) - 1.0) / 0.25
        points = np.concatenate([-away[::-1], [0.0], away])[:, None]
        eta = np.where(np.abs(points[:, 0]) < 0.5 * tip, tip ** (2 / 3), 1e-9)
        return marks(points, tip + np.abs(points[:, 0]) / 4, eta, 9.0, before)

    first = round_of(0.1, None)
    assert not first.singular.any()  # nobody knows a rate yet
    second = round_of(0.03, first)
    assert np.flatnonzero(second.singular).tolist() == [40] and not second.located.any()
    third = round_of(0.0015, second)
    assert np.flatnonzero(third.located).tolist() == [40]
    made, _ = next_spacing(third, 9.0, 1e-2, 1e-7, 100_000)
    assert made[40] < 0.05 * third.spacing[40]


def test_a_singular_point_beside_an_edge_is_the_edge():
    """The worst particle is beside the corner, and so is the largest mean; smoothness ends where the boundary turns."""
    cloud = js.from_polygon(CORNER, 0.1)
    points, edge = np.asarray(cloud.points), edges(cloud)
    assert len(cloud.boundary[edge[cloud.boundary]]) == 6
    assert np.linalg.norm(points[edge][:, None] - np.array(CORNER, float), axis=2).min(axis=1).max() < 1e-12
    beside = int(np.argmin(np.linalg.norm(points - [-0.05, 0.07], axis=1)))
    eta = np.exp(-np.linalg.norm(points - points[beside], axis=1) / 0.1)
    first = marks(points, np.full(len(points), 0.1), eta, 5.0, None, edge)
    found = marks(points, np.full(len(points), 0.07), 0.9 * eta, 5.0, first, edge)
    assert found.singular.sum() == 1 and np.linalg.norm(points[found.singular][0]) < 1e-12
    assert marks(points, np.full(len(points), 0.07), 0.9 * eta, 5.0, first).singular[beside]


@pytest.mark.parametrize("spacing", [0.15, 0.06, lambda x: np.clip(0.25 * np.linalg.norm(x, axis=1), 1e-5, 0.1)])
@pytest.mark.parametrize("notch", [[(1, -1), (1, -0.01)], [(1, -1), (1, -0.4)], [(-0.01, -1)]])
def test_edges_are_the_vertices_of_slits_and_wedges_too(notch, spacing):
    polygon = np.array([(0, 0), (1, 0), (1, 1), (-1, 1), (-1, -1), *notch], float)
    cloud = js.from_polygon(polygon, spacing)
    at = np.asarray(cloud.points)[edges(cloud)]
    apart = np.linalg.norm(at[:, None] - polygon, axis=2)
    assert apart.min(axis=0).max() < 1e-12
    assert np.linalg.norm(at[apart.min(axis=1) > 1e-12], axis=1).min(initial=1.0) > 0.5  # at the mouth, if any


def test_a_corner_that_nobody_sees_is_in_the_error():
    """Of 180.6 degrees: solutions of two orders are off by the same there, five times what parts them."""
    case = CASES["corner-180"]()
    found = js.adapt(case.problem, case.make, 1e-3, progress=False)
    assert found.reached and 1 / 3 < found.error / true_error(found, case.exact) < 5


@pytest.mark.parametrize("degrees", [188, 200, 215])
def test_a_weak_corner_stands_out_in_the_first_round(degrees):
    """The estimate of one round sees a tenth of it, what parts the corner's neighbours all of it."""
    case = reentrant(np.deg2rad(degrees), "weak")
    found = js.adapt(case.problem, case.make, 1e-2, progress=False)
    assert found.reached and len(found.history["particles"]) == 1
    assert 1 / 3 < found.error / true_error(found, case.exact) < 5


def test_a_gap_along_a_wall_does_not_stand_out():
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21)))
    points, h = np.stack([x, y], axis=1), np.full(441, 0.05)
    assert stands_out(points, h, np.exp(-20 * x)) == 0.0
    assert stands_out(points, h, np.exp(-20 * np.hypot(x, y))) == 1.0


def test_a_pole_that_the_solve_found_is_refined_at_once():
    """A cone: its source 1 / r is infinite between the particles, and nothing else is to be resolved."""
    cone = lambda x: jnp.sqrt((x[0] - 0.43) ** 2 + (x[1] - 0.52) ** 2)  # noqa: E731
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0 / cone(x), {"boundary": js.dirichlet(cone)})
    make = lambda spacing: js.from_polygon(SQUARE, spacing)  # noqa: E731
    first = js.solve(problem, make(0.08), order=4)
    assert len(first.poles) and np.abs(first.poles - [0.43, 0.52]).max() < 1e-6
    assert js.solve(GOOD, line(0.1)).poles.shape == (0, 1)
    found = js.adapt(problem, make, 1e-4, progress=False)
    assert found.reached and len(found.history["particles"]) <= 3
    assert found.history["smallest"][1] < found.history["smallest"][0] / 10
    assert 1 / 5 < found.error / true_error(found, cone) < 8


def test_the_round_before_is_a_witness():
    """Its solution was off by 0.01 and it had thought so: then the next estimate is believed, else it is doubled."""
    sol = js.solve(GOOD, line(0.05), order=4)
    before = remembered(sol)
    was = Earlier(before.points, before.values + 0.01 * np.abs(sol.u).max())
    rows = lambda thought, left, order=4: [(9, 6, 1.0, 0.0, 0.1), (20, 4, thought, 0, 0.1), (20, order, left, 0, 0.1)]  # noqa: E731
    assert unseen(sol, rows(0.0101, 1e-4), was) == pytest.approx(1.0, abs=1e-3)
    assert unseen(sol, rows(0.0067, 1e-4), was) == pytest.approx(0.01 / 0.0066, rel=1e-6)
    assert unseen(sol, rows(0.001, 1e-4), was) == 2.0
    for told in (rows(0.0101, 0.005), rows(0.0101, 1e-4, order=6), rows(np.inf, 1e-4)):
        assert unseen(sol, told, was) == 2.0
    assert unseen(sol, rows(0.0101, 1e-4), None) == 2.0


def test_where_a_side_stops_being_held_the_values_are_in_doubt():
    """r^(1/2) sin(t / 2), free left of 0 and held right of it: no particle of the side is where that changes."""
    free = lambda x: (x[:, 1] < 1e-12) & (x[:, 0] < 0) & (x[:, 0] > -1)
    groups = {"free": free, "held": lambda x: ~free(x)}
    cloud = js.from_polygon([(-1, 0), (1, 0), (1, 1), (-1, 1)], 0.13, groups=groups)
    bcs = {"free": js.neumann(0.0), "held": js.dirichlet(0.0)}
    x = np.asarray(cloud.points)
    r, t = np.hypot(*x.T), np.arctan2(x[:, 1], x[:, 0])
    values = (np.sqrt(r) * np.sin(t / 2))[:, None]
    off = lambda bcs, *told: off_at_free_ends(js.Problem(lambda u, x: js.laplacian(u)(x), bcs), cloud, values, *told)
    first = off(bcs, None, None)
    assert first.max() > 0.01 and r[first > 0].max() < 0.3  # not the corners at -1, where it changes too
    everywhere = np.ones(len(x), bool)
    vertex, moved = off(bcs, everywhere, x)[r < 0.3].max(), off(bcs, everywhere, x + 1e-3)[r < 0.3].max()
    assert moved == pytest.approx(vertex / 0.35)
    assert not off(bcs, ~everywhere, x).any()
    assert not off({"free": js.dirichlet(0.0), "held": js.dirichlet(0.0)}, everywhere, x).any()


def test_rounds_of_two_orders_tell_no_rates():
    """Contributions that only fell by half as the order grew are not those of a point where smoothness ends."""
    search, cloud = a_search(), js.interval(0.0, 1.0, 101)
    search.solution = js.solve(GOOD, cloud, order=4)
    x, none = np.asarray(cloud.points), np.zeros(101, bool)
    found, field = Measured(3e-4, np.full(101, 0.5), 1.0), SpacingField(x, np.full(101, 0.01), 0.01)
    search.before = Marks(x, np.full(101, 0.02), np.ones(101), np.full(101, 5.0), none, none, none)
    for orders, rate in (((4, 4), 1.0), ((2, 4), search._power(cloud))):
        search.rows = [(101, order, 1e-2, 0.0, 0.02) for order in orders]
        assert np.median(search._marks(found, cloud, field).rate) == pytest.approx(rate)


def test_rounds_do_not_undo_each_other():
    """A front: once a cloud resolves it, none after it is coarser anywhere by much."""
    radius = lambda x: jnp.sqrt((x[0] + 0.05) ** 2 + (x[1] + 0.05) ** 2)
    exact = lambda x: jnp.arctan(20.0 * (radius(x) - 0.7))
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x), {"boundary": js.dirichlet(exact)})
    found = js.adapt(problem, lambda spacing: js.from_polygon(SQUARE, spacing), 1e-2)
    error = np.abs(found.solution.u - jax.vmap(exact)(found.cloud.points)).max()
    assert found.reached and error < 1e-2 and len(found.history["particles"]) <= 4


def a_search(tol=1e-3):
    return Rounds(GOOD, line, tol, "auto", None, "max", 1000, 9, {}, 0.0)


def test_the_best_round_is_handed_out():
    """Beyond round-off every finer cloud is worse."""
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - x[0], ends(0.0, 0.0))
    found = js.adapt(problem, line, 1e-17, order=4)
    errors = found.history["error"]
    assert not found.reached and found.error == errors.min() < 0.1 * errors[-1]
    assert true_error(found, lambda x: (x[0] ** 3 - x[0]) / 6) < 1e-14 and "the best one" in found.diagnose()


def test_a_lower_order_that_does_worse_is_given_up():
    search = a_search()
    search.rows = [(10, 4, 3.0, 0.0, 0.1), (20, 4, 1.6, 0.0, 0.1)]
    search.orders.least = 2
    assert search.orders.following(search.rows, 1, False) == 4 and search.orders.shallow  # the depth goes first
    search.rows.append((40, 4, 1.5, 0.0, 0.1))
    assert search.orders.following(search.rows, 1, False) == 2 and search.orders.shallow
    search.rows.append((80, 2, 100.0, 0.0, 0.1))
    assert search.orders.following(search.rows, 1, False) == 4 and not search.orders.shallow
    search.rows.append((160, 4, 90.0, 0.0, 0.1))
    assert search.orders.following(search.rows, 1, False) == 4


def test_a_lower_order_is_left_where_nothing_is_rough_any_more():
    """A spike at a vertex of which the first clouds saw nothing ended at order 2, far from its tolerance."""
    search = a_search()
    search.rows = [(20, 4, 1.6, 0.0, 0.1), (40, 4, 1.5, 0.0, 0.1)]
    search.orders.least, search.orders.shallow = 2, True
    assert search.orders.following(search.rows, 1, False) == 2
    search.rows.append((80, 2, 0.2, 0.0, 0.1))
    assert search.orders.following(search.rows, 1, False) == 2
    search.rows.append((160, 2, 0.1, 0.0, 0.1))
    assert search.orders.following(search.rows, 1, False) == 4 and not search.orders.shallow


def test_a_steep_layer_of_a_nonlinear_equation():
    """u'' = k^2 sinh u, where the solution on the first cloud is no start for the next: the user's own is."""
    k, held = 30.0, 6.0
    exact = lambda x: 4 * jnp.arctanh(jnp.tanh(held / 4) * jnp.exp(-k * x[0]))
    ends_held = {"left": js.dirichlet(held), "right": js.dirichlet(exact)}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - k**2 * jnp.sinh(u(x)), ends_held)
    slope = -2 * k * np.sinh(held / 2)
    asked = {"quantity": lambda sol: sol.flux("left"), "order": 4}
    found = js.adapt(problem, line, 1e-4, **asked)
    assert found.reached and abs(found.quantity / -slope - 1) < 1e-4
    first = js.adapt(problem, line, 1e-4, max_rounds=1, **asked)
    assert not first.reached and first.error > 1e-2  # far more than the estimate of the number alone


def test_a_number_of_a_solution_without_an_estimate(monkeypatch):
    """It is handed out, and that nothing is known of its error."""

    def fails(sol):
        raise SolveError("nothing is determined", [])

    monkeypatch.setattr(measure, "_corrected", fails)
    found = js.adapt(GOOD, line, 1e-3, quantity=lambda sol: sol.flux("left"), max_rounds=1)
    assert not found.reached and found.error == np.inf and np.isfinite(found.solution.u).all()


def test_numbers_that_move_more_than_was_thought_are_not_believed():
    """A change of 0.03 after an error of 0.001 was estimated: all but two times that was foreseen by nobody."""
    search = a_search()
    search.rows = [(10, 4, 1e-3, 0.0, 0.1), (20, 4, 1e-9, 0.0, 0.1)]
    search.number, search.checked_before = 1.0, 1e-3
    assert search._disagreed() == 0.0
    search.number_before = 1.03
    assert search._disagreed() == pytest.approx(0.028)
    search.number_before = 1.0019
    assert search._disagreed() <= 0.0


def test_where_smoothness_ends_the_estimate_is_half_of_the_error():
    """Contributions that fell by 1.5 where the spacing was halved, at a place; by 2^5 elsewhere."""
    search, cloud = a_search(), js.interval(0.0, 1.0, 101)
    search.solution = js.solve(GOOD, cloud, order=4)
    x = np.asarray(cloud.points)
    rough = x[:, 0] < 0.2
    field = SpacingField(x, np.full(101, 0.01), 0.01)
    local = np.where(x[:, 0] < 0.3, 2e-4, 3e-4)  # contributions are the largest of some neighbours
    found = Measured(3e-4, np.where(rough, 1 / 1.5, 2.0**-5), 1.0, local=local)

    def doubted(found):
        return search._doubted(found, search._marks(found, cloud, field).rate)

    assert doubted(found) == 0.0  # nobody knows a rate yet
    none = np.zeros(101, bool)
    search.rows = [(101, 4, 1e-2, 0.0, 0.02), (101, 4, 3e-4, 0.0, 0.01)]
    search.before = Marks(x, np.full(101, 0.02), np.ones(101), np.full(101, 5.0), none, none, none)
    assert doubted(found) == pytest.approx(4e-4)
    # Of a source that is infinite there, what is seen between the particles is such a part too.
    missed = np.where(x[:, 0] < 0.05, 5e-4, 0.0)
    assert doubted(replace(found, missed=missed)) == pytest.approx(4e-4)  # a kink, perhaps
    infinite = js.Problem(lambda u, x: js.laplacian(u)(x) - x[0] ** -1.5, ends(0.0, 0.0))
    search.data = data_of(infinite, 1, 4)
    assert doubted(replace(found, missed=missed)) == pytest.approx(1e-3)


# ------------------------------------------------------------------ bad input


GOOD = js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"problem": 3}, "problem: expected a js.Problem, got int"),
        ({"make": 0.1}, "make: expected a function spacing -> js.Cloud, got float"),
        ({"make": lambda spacing: 3}, "make: returned int, expected a js.Cloud"),
        ({"make": lambda spacing: js.interval(0.0, 1.0, "x")}, "n: expected"),
        ({"tol": 0.0}, "tol: expected a relative error between 0 and 1"),
        ({"tol": "small"}, "tol: expected a relative error between 0 and 1"),
        ({"order": 13}, "order: 13 leaves no higher one"),
        ({"order": "best"}, 'order: expected "auto" or a whole number'),
        ({"start": -1.0}, "start: expected a positive spacing or a function"),
        ({"quantity": 3.0}, "quantity: expected a function of a Solution"),
        ({"norm": "maxx"}, "norm: 'maxx' is none of 'max', 'l2'"),
        ({"max_rounds": 0}, "max_rounds: expected a whole number from 1"),
        ({"max_particles": 2.5}, "max_particles: expected a whole number from 1"),
        ({"stencils": None}, "stencils: belongs to one cloud"),
        ({"throw": False}, "throw: js.adapt refines where a solve fails"),
        ({"formulaton": "loo"}, "formulaton: no argument of js.adapt or js.solve"),
        ({"u0": np.zeros(3)}, "u0: expected a function of x"),
    ],
)
def test_bad_input_is_told(change, said):
    given = {"problem": GOOD, "make": line, "tol": 1e-3, **change}
    with pytest.raises(ValueError) as told:
        js.adapt(given.pop("problem"), given.pop("make"), given.pop("tol"), **given)
    assert said in str(told.value)


def test_a_maker_that_never_asks_must_be_told_how_to_begin():
    with pytest.raises(ValueError, match="never asked for the spacing"):
        js.adapt(GOOD, lambda spacing: js.interval(0.0, 1.0, 9), 1e-3)


# ------------------------------------------------------------------ numbers


def poisson_square():
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) + 1.0, {"boundary": js.dirichlet(0.0)})
    return problem, lambda spacing: js.from_polygon(SQUARE, spacing)


@pytest.mark.parametrize("name", ["integral", "largest"])
def test_a_number_is_reached_on_two_clouds_at_least(name):
    """The estimate knows no error of a quadrature, nor that the largest value lies between the particles."""
    problem, make = poisson_square()
    k = np.arange(1, 4001, 2)
    exact = {"integral": 1 / 12 - 16 / np.pi**5 * np.sum(np.tanh(k * np.pi / 2) / k**5),
             "largest": 0.0736713532814}[name]  # fmt: skip
    quantity = {"integral": lambda s: s.integral(), "largest": lambda s: s.u.max()}[name]
    tol = {"integral": 1e-4, "largest": 2e-3}[name]
    found = js.adapt(problem, make, tol, quantity=quantity, progress=False)
    assert found.reached and len(found.history["particles"]) > 1
    assert abs(found.quantity / exact - 1) < 3 * tol


def test_what_is_no_number_is_refused():
    problem, make = poisson_square()
    with pytest.raises(ValueError, match="quantity: returns an array of shape .2,."):
        js.adapt(problem, make, 1e-3, quantity=lambda s: s([[0.5, 0.5], [0.2, 0.2]]), progress=False)
    with pytest.raises(ValueError, match="quantity: returns NaN on two clouds; is a point outside"):
        js.adapt(problem, make, 1e-3, quantity=lambda s: s([[7.5, 0.5]])[0], progress=False)


def test_an_error_that_is_not_reached_is_no_smaller_than_the_tolerance():
    """Fifty waves on a line: a first cloud that sees none of them agrees with itself at its particles."""
    k = 314.0
    problem = js.Problem(
        lambda u, x: js.laplacian(u)(x) + k**2 * u(x), {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    )
    found = js.adapt(problem, lambda h: js.interval(0.0, 1.0, spacing=h), 1e-4, max_rounds=4, progress=False)
    assert not found.reached and found.error > 1e-4
