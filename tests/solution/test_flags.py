"""Solutions say what speaks against them; healthy ones say nothing."""

import pickle
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.solution import flags

SIDES = ("left", "right", "bottom", "top")
smooth = lambda x: jnp.sin(2 * x[0]) * jnp.exp(x[1])


def posed(operator, exact, **bcs):
    held = {side: js.dirichlet(exact) for side in SIDES}
    return js.Problem(lambda u, x: operator(u, x) - operator(exact, x), held | bcs)


def laplace(u, x):
    return js.laplacian(u)(x)


def square(n=21):
    return js.rectangle((0, 0), (1, 1), (n, n), jitter=0.3)


@pytest.mark.parametrize("order", [2, 4, 6])
def test_a_healthy_solution_has_none(order):
    slope = js.condition(lambda u, x, n: n @ (js.grad(u)(x) - js.grad(smooth)(x)))
    sol = js.solve(posed(laplace, smooth, right=slope), square(), order=order)
    assert sol.flags == []
    sol.error_estimate()
    assert sol.flags == [] and "FLAG" not in sol.diagnose()


def test_a_layer_thinner_than_the_spacing():
    eps = 0.01
    layer = lambda x: x[0] - jnp.expm1(x[0] / eps) / jnp.expm1(1 / eps)
    steep = posed(lambda u, x: -eps * js.laplacian(u)(x) + js.grad(u)(x)[0], layer)
    sol = js.solve(steep, square())
    assert np.abs(sol.u - jax.vmap(layer)(sol.cloud.points)).max() > 0.3
    assert any("layer" in flag for flag in sol.flags) and "FLAG" in sol.diagnose()


def test_waves_too_short_for_the_cloud():
    k = 60.0
    wave = lambda x: jnp.sin(k * (0.6 * x[0] + 0.8 * x[1]))
    sol = js.solve(posed(lambda u, x: js.laplacian(u)(x) + k**2 * u(x), wave), square())
    assert any("particles a length" in flag for flag in sol.flags)


def test_a_large_estimate_is_a_flag():
    """Asked for where no cheap test clears the solution: of a system always."""
    wave = lambda x: jnp.sin(22 * x[0]) * jnp.cos(17 * x[1])
    sol = js.solve(posed(laplace, wave), square(11), order=2)
    assert len(sol.flags) > 1 and "estimated error" in sol.flags[-1]
    two = js.Problem(
        lambda u, x: jnp.stack([js.laplacian(u[k])(x) - js.laplacian(wave)(x) for k in range(2)]),
        {side: [js.dirichlet(wave, field=k) for k in range(2)] for side in SIDES},
        fields=2,
    )
    sol = js.solve(two, square(11), order=2)
    told = sol.flags
    assert "estimated error" in told[-1]
    sol.error_estimate()
    assert sol.flags == told


def front(width, **options):
    """A steep front between particles of a line: its source has two signs, its values change little by little."""
    front = lambda x: jnp.tanh((x[0] - 0.506) / width)
    ends = {side: js.dirichlet(front) for side in ("left", "right")}
    line = js.interval(0.0, 1.0, 41)
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - js.laplacian(front)(x), ends), line, **options)
    exact = np.asarray(jax.vmap(front)(jnp.asarray(line.points)))
    return sol, np.linalg.norm(sol.u - exact) / np.linalg.norm(exact)


def test_a_front_that_the_cheap_tests_hardly_see():
    """It stays below their bounds, and the estimate, asked for from a third of them on, confirms it."""
    sol, error = front(0.005, order=6)
    assert error > 1.0 and any("estimated error" in flag for flag in sol.flags)


def test_a_layer_that_the_solution_follows_is_no_flag():
    """eps^2 u'' = u with eps a tenth of the spacing: the values fall to nothing within one spacing, and rightly."""
    eps = 0.1 / 40
    layer = lambda x: jnp.exp(-x[0] / eps) + jnp.exp((x[0] - 1.0) / eps)
    ends = {side: js.dirichlet(layer) for side in ("left", "right")}
    sol = js.solve(js.Problem(lambda u, x: eps**2 * js.laplacian(u)(x) - u(x), ends), js.interval(0.0, 1.0, 41))
    assert sol.flags == []
    exact = np.asarray(jax.vmap(layer)(jnp.asarray(sol.cloud.points)))
    assert np.linalg.norm(sol.u - exact) < 0.01 * np.linalg.norm(exact)


def test_least_squares_squares_the_operator():
    """u_xy from two sides at order 6 has a condition of 4e7 on 17 x 17 particles, and six digits."""
    sides = {side: js.free() for side in SIDES} | {side: js.dirichlet(smooth) for side in ("left", "bottom")}
    cross = lambda u, x: js.partial(u, (1, 1))(x)
    sol = js.solve(js.Problem(lambda u, x: cross(u, x) - cross(smooth, x), sides), square(25), order=6)
    assert sol.stats["formulation"] == "lsq" and sol.flags == []
    assert np.abs(sol.u - jax.vmap(smooth)(sol.cloud.points)).max() < 1e-4


@pytest.mark.parametrize("form", ["loo", "lsq"])
@pytest.mark.filterwarnings("error")
def test_squares_of_huge_values_do_not_overflow(form):
    """1e200 squared is no number; the flags are those of the same problem in other units."""
    harmonic = lambda size: js.dirichlet(lambda x: size * jnp.sin(2 * x[0]) * jnp.exp(2 * x[1]))
    for size in (1.0, 1e200):
        sol = js.solve(js.Problem(laplace, dict.fromkeys(SIDES, harmonic(size))), square(13), formulation=form)
        assert sol.flags == [] and np.max(sol.error_estimate()) < 1e-2 * size
        assert sol.flags == []  # with the estimate


def test_what_does_not_settle_is_a_doubt_that_the_estimate_clears():
    """Newton's method may end with particles whose expansions it kept from moving."""
    for frequency, flagged in ((2.0, False), (22.0, True)):
        wave = lambda x, k=frequency: jnp.sin(k * x[0])
        pde = lambda u, x, f=wave: js.laplacian(u)(x) - js.laplacian(f)(x) - u(x) ** 3 + f(x) ** 3
        ends = {"left": js.dirichlet(wave), "right": js.dirichlet(wave)}
        sol = js.solve(js.Problem(pde, ends), js.interval(0.0, 1.0, 11), order=2)
        sol._report.unsettled = np.array([4])
        assert any("1 particle(s), first [4], do not settle" in flag for flag in sol.flags) == flagged


def test_flags_survive_pickling():
    eps = 0.01
    layer = lambda x: x[0] - jnp.expm1(x[0] / eps) / jnp.expm1(1 / eps)
    sol = js.solve(posed(lambda u, x: -eps * js.laplacian(u)(x) + js.grad(u)(x)[0], layer), square())
    assert pickle.loads(pickle.dumps(sol)).flags == sol.flags != []


def test_a_factorisation_tells_too():
    ready = js.factorize(posed(laplace, smooth), square())
    assert ready.solve(posed(laplace, smooth)).flags == []
    spike = posed(laplace, lambda x: jnp.exp(-4000 * jnp.sum((x - 0.5) ** 2)))
    first, second = ready.solve(spike), ready.solve(posed(laplace, smooth))
    assert first.flags and second.flags == []  # asked for after the second solve


@pytest.mark.parametrize("method", ["S", "I", "SSPH"])
def test_condition_numbers_of_the_local_fits_and_of_the_whole(method):
    """Against the matrices themselves: the global one, and that of a corner's neighbour in scaled monomials."""
    cloud = square(9)
    sol = js.solve(posed(laplace, smooth), cloud, method=method, order=2)
    local, whole = sol.condition_numbers()
    inside = cloud.groups["interior"]
    assert np.isnan(local).sum() == len(cloud) - len(inside)
    assert (local[inside] >= 1.0).all() and local[inside].max() < 10.0
    factor = sol._report.factor
    exact = np.linalg.cond(factor.matrix.toarray(), 1)
    assert exact / 3.0 < whole <= exact * 1.001
    if method == "SSPH":
        return
    with pytest.raises(ValueError, match="before pickling"):
        pickle.loads(pickle.dumps(sol)).condition_numbers()


def test_neighbours_on_a_line_have_a_condition_without_bound():
    """In a box 1000 times as high as wide, neighbours differ across it only; the other derivatives are all but free."""
    thin = js.rectangle((0, 0), (1e-3, 1), (9, 9), jitter=0.2)
    solved = (js.solve(posed(laplace, smooth), cloud, method="SSPH", order=2) for cloud in (square(9), thin))
    usual, bad = (sol.condition_numbers() for sol in solved)
    inside = thin.groups["interior"]
    assert bad[0][inside].max() > 100.0 * usual[0][inside].max()


def test_float32_is_told_once_unless_the_particles_are_given_in_it():
    """Values come as float64 from the global solve: their dtype does not tell."""
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) + 1.0, dict.fromkeys(("left", "right"), js.dirichlet(0.0)))
    line = js.interval(0.0, 1.0, 9)
    meant = js.Cloud(line.points.astype(np.float32), line.groups, line.normals)
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("error")
        assert abs(float(js.solve(problem, meant).u[4]) - 0.125) < 1e-5  # a hundred units of round-off
        with pytest.raises(UserWarning, match="float32.*jax_enable_x64"):
            js.solve(problem, line)
        warnings.simplefilter("always")
        with pytest.warns(UserWarning, match="float32.*jax_enable_x64") as told:
            js.solve(problem, line), js.solve(problem, line)
        assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        js.solve(problem, js.interval(0.0, 1.0, 9))


def test_coordinates_that_float32_cannot_hold():
    """At 1e4 sizes from the origin float32 rounds them to a twentieth of the spacing."""
    with jax.enable_x64(False):
        for far, told in ((0.0, False), (1e4, True)):
            line = js.interval(far, far + 1.0, 41)
            held = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
            sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, held), line)
            assert told == any("known to" in flag for flag in sol.flags)


def test_an_estimate_that_is_there_clears_a_large_cloud_as_well(monkeypatch):
    """Nobody is asked for one beyond so many particles; one that is known is looked at."""
    exact = lambda x: jnp.sin(9 * x[0]) * jnp.exp(x[1])
    problem = posed(laplace, exact)
    monkeypatch.setattr(flags, "MANY", 100)
    monkeypatch.setattr(flags, "CLEAR", dict.fromkeys(flags.CLEAR, 0.0))
    doubt = lambda run, values, nums, out, found: out.append("Who knows?")
    monkeypatch.setattr(flags, "DOUBTS", (*flags.DOUBTS, doubt))
    sol, known = (js.solve(problem, js.rectangle((0, 0), (1, 1), (21, 21))) for _ in range(2))
    known.error_estimate()
    assert [f[:10] for f in sol.flags] == ["Who knows?"] and known.flags == []
