"""Tuning: what it gains against the exact solution, and that it never returns anything unusable.

All on one line of 15 particles, so that compiled programs are shared.
"""

import re
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jsmitsm as js
from jsmitsm.particle import batches
from jsmitsm.tuning import objective as score_room
from jsmitsm.tuning import tune as room
from jsmitsm.tuning.descent import Descent
from jsmitsm.tuning.objective import Objective, hand_kernel, reference

N = 15


def exact(x):
    return jnp.sin(3.0 * x[0]) + x[0] ** 2


def line(pde=None, exact=exact):
    ends = {"left": js.dirichlet(exact), "right": js.dirichlet(exact)}
    return js.Problem(pde or (lambda u, x: js.laplacian(u)(x) - js.laplacian(exact)(x)), ends)


cloud = js.interval(0.0, 2.0, N)
problem = line()
s = cloud.spacing
true = np.array([float(exact(x)) for x in cloud.points])


def error(sol):
    return float(np.linalg.norm(np.asarray(sol.u) - true) / np.linalg.norm(true))


def solved(h, d, method="SSPH"):
    return js.solve(problem, cloud, method=method, order=2, kernel=js.SuperGaussian(h * s, d))


def tuned(kernel=None, **options):
    options = {"method": "SSPH", "order": 2, "progress": False, **options}
    return room.tune(problem, cloud, kernel or js.SuperGaussian(2 * s, 4.0), **options)


@pytest.fixture(scope="module")
def result():
    return tuned()


def test_it_gains_on_the_start_and_on_the_hand_choice(result):
    """0.8 is what tuning must gain on h = spacing, d = 4 to be worth its cost."""
    assert error(result.solution) < 0.8 * error(solved(1.0, 4.0)) < error(solved(2.0, 4.0))


def test_it_comes_near_a_grid_search_that_knows_the_answer(result):
    grid = [error(solved(h, d)) for h in (0.4, 0.6, 0.8, 1.0, 1.4) for d in (1.7, 2.3, 3.2, 4.2) if 1.1 < h * d < 5]
    assert error(result.solution) <= 1.2 * np.quantile(grid, 0.1)


def test_one_percent_of_h_or_d_changes_little(result):
    h, d, base = result.kernel.h / s, result.kernel.d, error(result.solution)
    for a, b in ((1.01, 1), (0.99, 1), (1, 1.01), (1, 0.99)):
        assert error(solved(h * a, d * b)) == pytest.approx(base, rel=0.2)


def test_the_history_is_ready_to_plot_and_the_best_of_it_is_returned(result):
    history = result.history
    assert set(history) == {"objective", "lebesgue", "h", "d"}
    assert {np.shape(v) for v in history.values()} == {(len(history["objective"]),)}
    assert history["h"][0] == pytest.approx(2 * s) and history["d"][0] == pytest.approx(4.0)
    at = np.argmin(np.abs(history["h"] - result.kernel.h) + np.abs(history["d"] - result.kernel.d))
    assert history["objective"][at] <= 1.01 * history["objective"].min()
    assert np.isfinite(np.concatenate(list(history.values()))).all()


def test_other_forms_of_the_kernel_are_tried(result):
    """Where the descent ends, other d at the same support are looked at: Adam alone moves by a tenth in a step."""
    assert np.abs(np.diff(np.log(result.history["d"]))).max() > 0.4


def test_the_result_says_itself_in_one_line(result):
    assert "\n" not in repr(result) and len(repr(result)) < 160 and "SuperGaussian" in repr(result)


def test_steps_compile_nothing(result):
    """More steps make no program; another kernel's own support, in the returned solution, may."""
    before = batches.TRACES["rows"]
    assert len(tuned(steps=6).history["h"]) > 5
    assert batches.TRACES["rows"] <= before + 1


def test_its_name_in_the_package_is_the_function():
    """The module of the same name must not take its place, however often it is asked for."""
    assert js.tune is room.tune and js.tune is room.tune


def test_no_steps_return_the_start():
    kernel = tuned(steps=0).kernel
    assert (kernel.h, kernel.d) == (2 * s, 4.0)


def test_one_parameter_leaves_the_other():
    found = tuned(parameters=("h",), steps=6)
    assert found.kernel.d == 4.0 and found.kernel.h < 2 * s and set(found.history) == {"objective", "lebesgue", "h"}
    assert tuned(parameters="d", steps=3).kernel.h == 2 * s


def test_one_smoothing_length_per_particle(result):
    found = tuned(js.SuperGaussian(np.full(N, 2.0 * s), 4.0), steps=8)
    assert np.shape(found.kernel.h) == (N,) and found.history["h"].shape == (len(found.history["objective"]), N)
    assert np.ptp(found.kernel.h[1:-1]) > 0 and (found.kernel.h > 0).all()
    assert error(found.solution) < error(solved(2.0, 4.0))


def test_particles_of_a_group_share_a_factor():
    start = s * np.linspace(1.5, 2.0, N)
    found = tuned(js.SuperGaussian(start, 4.0), groups=np.arange(N) // 8, steps=4)
    factor = found.kernel.h / start
    assert np.ptp(factor[:8]) < 1e-12 and np.ptp(factor[8:]) < 1e-12 and factor[0] != factor[-1] and factor[0] < 1


def test_parameters_of_a_profile_of_ones_own():
    profile = lambda r, p: jnp.exp(-p["sharpness"] * r**2) + 0.0 * p["count"]
    kernel = js.Kernel(profile, 2 * s, 2.5, params={"sharpness": 0.3, "count": 2})
    found = tuned(kernel, parameters=("h", "params"), steps=8)
    assert found.kernel.params["sharpness"] > 0 and found.kernel.params["count"] == 2 and found.kernel.d == 2.5
    assert found.kernel.params["sharpness"] != 0.3
    assert found.history["params"]["sharpness"].shape == found.history["objective"].shape
    assert found.history["objective"].min() < found.history["objective"][0]


def peak(x):
    return jnp.exp(-(((x[0] - 1.02) / 0.1) ** 2))


@pytest.mark.parametrize("function, order", [(exact, 6), (peak, 4)])
def test_the_reference_is_the_best_of_its_candidates(function, order):
    """The smooth function wants the higher order; a peak that no particle resolves makes it the worst of all."""
    posed, hand = line(exact=function), hand_kernel(cloud.points)
    there = np.array([float(function(x)) for x in cloud.points])
    kernels = (hand, hand.replace(h=0.8 * hand.h))
    made = {
        (p, k): js.solve(posed, cloud, order=p, kernel=kernel).u for p in (6, 4) for k, kernel in enumerate(kernels)
    }
    best = min(made, key=lambda key: np.linalg.norm(made[key] - there))
    chosen, solves = reference(posed, cloud, {"order": 2})
    assert best[0] == order and solves == 4
    assert [key for key, u in made.items() if np.array_equal(u, chosen[:, 0])] == [best]


def test_a_reference_goes_on_where_candidates_fail(monkeypatch):
    """No kernel given serves order 6: its default is tried. Nothing serves: the error names the orders."""
    solve = score_room.solve

    def without(fails):
        def some(problem, cloud, **options):
            if fails(options):
                raise js.SolveError("singular")
            return solve(problem, cloud, **options)

        return some

    monkeypatch.setattr(score_room, "solve", without(lambda o: o["order"] == 6 and o["kernel"] is not None))
    assert reference(problem, cloud, {"order": 2})[1] == 5
    monkeypatch.setattr(score_room, "solve", without(lambda o: True))
    with pytest.raises(js.SolveError, match="no reference solution of order 4 or 6"):
        reference(problem, cloud, {"order": 2})


def test_an_objective_of_ones_own():
    """Readings at two sensors; the scale of the objective must not matter."""
    places = np.array([[0.55], [1.31]])
    readings = np.array([float(exact(x)) for x in places])
    found = tuned(objective=lambda sol: 1e-9 * jnp.sum((sol(places) - readings) ** 2), steps=12)
    assert found.history["objective"].min() < 0.3 * found.history["objective"][0]
    assert found.solves == len(found.history["objective"]) + 3  # the Lebesgue bound, the scale, the solution


def test_any_optimizer():
    for optimizer in (optax.sgd(0.02), optax.polyak_sgd(0.1)):  # the second asks for the value too
        found = tuned(optimizer=optimizer, steps=4)
        assert found.history["objective"].min() < 0.9 * found.history["objective"][0]


def test_a_wild_optimizer_is_held(result):
    """Steps of a factor e^100: cut, bounded from below, and never worse than the start."""
    found = tuned(optimizer=optax.sgd(1e4), steps=8)
    assert np.isfinite([found.kernel.h, found.kernel.d]).all() and found.kernel.h > 0 and found.kernel.d > 0
    assert error(found.solution) <= 1.01 * error(solved(2.0, 4.0))


def test_an_objective_that_turns_nan_is_backed_off_from(result):
    """NaN where h falls below 1.5 spacings: the best kernel before that is returned."""
    def objective(sol):
        h = sol._fit.kernel.h
        return jnp.where(h > 1.5 * s, h / s, jnp.nan)

    found = tuned(objective=objective, steps=20)
    assert 1.5 * s < found.kernel.h < 1.7 * s and np.isfinite(found.history["objective"]).all()
    assert any("nan" in m for m in found.messages)


def test_a_support_that_turns_singular_is_backed_off_from():
    """An objective that rewards ever smaller supports: they end where the polynomials are just determined."""
    found = tuned(objective=lambda sol: sol._fit.kernel.h * sol._fit.kernel.d, method="III", steps=20)
    assert np.isfinite([found.kernel.h, found.kernel.d]).all() and found.solution.converged
    assert 0.99 * s < found.kernel.h * found.kernel.d < 4 * s


def test_a_start_that_is_too_narrow_is_widened():
    found = tuned(js.SuperGaussian(0.4 * s, 2.0), steps=3)
    assert found.kernel.h * found.kernel.d > s and "start" in found.messages[0]
    assert found.solution.converged


def test_a_hopeless_start_is_named():
    with pytest.raises(ValueError, match="too few neighbours"):
        tuned(js.SuperGaussian(0.4 * s, 2.0), order=4, stencils=js.stencils(cloud, size=2))


def test_the_support_stays_inside_given_stencils():
    near = js.stencils(cloud, radius=4.2 * s)
    reach = lambda sol: sol._fit.kernel.h * sol._fit.kernel.d
    found = tuned(js.SuperGaussian(s, 4.0), objective=lambda sol: -reach(sol), steps=8, stencils=near)
    assert 4.1 * s < found.kernel.h * found.kernel.d <= 4.2 * s * (1 + 1e-6)
    assert any("held inside the given stencils" in m for m in found.messages)


def test_the_pattern_is_rebuilt_only_when_outgrown(monkeypatch):
    built, made = [], Objective.discretized
    monkeypatch.setattr(Objective, "discretized", lambda *a: built.append(1) or made(*a))
    tuned(steps=8)
    assert len(built) == 1, "a shrinking support needs no new pattern"
    tuned(js.SuperGaussian(0.5 * s, 4.0), objective=lambda sol: -sol._fit.kernel.h * sol._fit.kernel.d, steps=8)
    assert 2 <= len(built) - 1 <= 4, "a growing one does"


def test_a_nonlinear_problem():
    bent = line(lambda u, x: js.laplacian(u)(x) - u(x) ** 2 - js.laplacian(exact)(x) + exact(x) ** 2)
    missed = lambda sol: jnp.mean((sol.u - true) ** 2)
    found = room.tune(
        bent, cloud, js.SuperGaussian(1.5 * s, 4.0), objective=missed, method="SSPH", order=2, steps=3, progress=False
    )
    assert found.history["objective"].min() < 0.9 * found.history["objective"][0]
    assert found.solution.converged


@pytest.mark.parametrize(
    "change, said",
    [
        (
            {"parameters": ("h", "sigma")},
            r"parameters: 'sigma' is no parameter of SuperGaussian; it has 'h', 'd' \(docs: gradients\)$",
        ),
        ({"parameters": ("params",)}, "it has 'h', 'd'"),
        ({"parameters": ()}, "parameters: expected some of 'h', 'd'"),
        ({"parameters": ("h", "h")}, "each once"),
        ({"objective": "error"}, 'objective: expected "estimate" or a function'),
        ({"objective": lambda sol: sol.u}, "objective: expected a function that returns a real scalar"),
        ({"objective": lambda sol: "small"}, "objective: expected a function that returns a real scalar"),
        ({"objective": lambda sol: jnp.nan}, "objective: it is nan at the start"),
        ({"optimizer": "adam"}, "optimizer: expected an optax transformation"),
        ({"steps": -1}, "steps: expected a whole number"),
        ({"steps": 2.5}, "steps: expected a whole number"),
        ({"groups": np.zeros(3, int)}, r"groups: expected \(15,\) whole numbers"),
        ({"groups": np.zeros(N, int), "parameters": ("d",)}, 'does not tune "h"'),
        ({"colour": 1}, "colour: no argument of js.tune or js.solve"),
        ({"method": "IV"}, "method: 'IV' is none of"),
    ],
)  # fmt: skip
def test_bad_input(change, said):
    with pytest.raises(ValueError, match=said):
        tuned(js.SuperGaussian(s, 4.0), **change)


def test_what_is_told_is_of_the_kernel_that_is_returned(result):
    """Not of another with a smaller objective that was not taken."""
    history = {"objective": np.array([4.0, 0.25, 2.0])}
    told = js.TuneResult(result.kernel, result.solution, history, step=2)
    assert "objective 4 -> 2," in repr(told) and "4 to 2" in told._repr_html_() and "to 0.25" not in told._repr_html_()
    gauge = Objective(problem, cloud, result.kernel, "estimate", {"method": "SSPH", "order": 2})
    at = result.history["objective"][result.step]
    assert float(gauge.measured(result.solution)) == pytest.approx(at, rel=1e-6)
    assert (result.history["h"][result.step], result.history["d"][result.step]) == (result.kernel.h, result.kernel.d)


def searched(*found, best):
    """A search that has evaluated kernels with these objectives and Lebesgue constants."""
    search = Descent.__new__(Descent)
    search.points = [SimpleNamespace(score=SimpleNamespace(objective=o, lebesgue=l)) for o, l in found]
    search.best, search.messages, search.objective = search.points[best], [], SimpleNamespace(bound=9.0)
    return search


def test_kernels_that_the_bound_holds_off_are_told():
    search = searched((4.0, 9.0), (1.0, 22.0), (0.5, 82.0), (5.0, 7.0), best=0)
    search._tell_not_taken()
    assert search.place == 0 and len(search.messages) == 1
    said = r"^Not taken: 2 kernel\(s\) .* down to 0.5 \(place 2 of the history\).* there 82, are above the bound 9\.$"
    assert re.match(said, search.messages[0])
    search = searched((4.0, 9.0), (1.0, 8.0), best=1)
    search._tell_not_taken()
    assert search.place == 1 and not search.messages


def test_a_solve_without_a_kernel_that_is_nearer_is_told():
    search = searched((2.0, 1.0), best=0)
    search.tell_nearer(1.999)
    assert not search.messages
    search.tell_nearer(1.0)
    assert "leave the kernel out" in search.messages[0]


def test_it_starts_from_the_stencils_that_solve_repaired():
    """Of method III on an uneven cloud: narrower supports begin with rows three times as weak."""
    plane = lambda x: jnp.sin(4 * x[0] + 0.5) * jnp.exp(x[1])
    square = js.rectangle((0, 0), (1, 1), (9, 9), jitter=0.3)
    ends = {side: js.dirichlet(plane) for side in ("left", "right", "bottom", "top")}
    posed = js.Problem(lambda u, x: js.laplacian(u)(x) - js.laplacian(plane)(x), ends)
    kernel, plain = room._chosen(posed, square, {"method": "III", "order": 4})
    near, some = np.asarray(plain._fit.neighbours), plain.stats["repaired"]
    away = np.linalg.norm(square.points[near] - square.points[:, None], axis=2)
    reach = np.where(near >= 0, away, 0.0).max(axis=1)
    first = np.asarray(room.discretized(posed, square, "III", 4).stencils.radius)
    assert len(some) and (reach[some] > 1.05 * first[some]).any()
    np.testing.assert_allclose(kernel.h * kernel.d, reach)


def test_the_kernel_of_solve_where_none_is_given():
    """It starts where solve stands, and moves all smoothing lengths by one factor."""
    found = room.tune(problem, cloud, order=2, steps=3, progress=False)
    start = js.solve(problem, cloud, order=2)
    np.testing.assert_allclose(found.history["h"][0] / found.kernel.h, (found.history["h"][0] / found.kernel.h)[0])
    kernel = found.kernel.replace(h=found.history["h"][0], d=found.history["d"][0])
    apart = np.linalg.norm(np.asarray(js.solve(problem, cloud, order=2, kernel=kernel).u - start.u))
    assert apart < 1e-12 * np.linalg.norm(start.u)
    assert found.history["objective"].min() <= found.history["objective"][0]
    with pytest.raises(ValueError, match="kernel: expected a kernel such as"):
        room.tune(problem, cloud, 3.0)
