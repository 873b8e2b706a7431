"""A Solution owns its numbers: what it says later is said of the problem that was solved, whatever became of it."""

import copy
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js

ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
ROD = js.interval(0.0, 1.0, 9)
K = 1.0  # a global that a test changes


class Setting:
    """A problem with everything about it that can change: ``change()`` changes it all."""

    def __init__(self, nonlinear=False, fields=1, order=4, params=False):
        self.k, self.table, self.box = 1.0, np.array([1.0, 2.0]), {"k": 1.0}
        self.params = {"k": np.array(1.0), "more": [np.ones(2)]} if params else None
        self.edge, self.slope = np.array([1.0]), np.array([0.5])
        power, more = (2 if nonlinear else 1), ((lambda p: p["k"] * p["more"][0][0]) if params else (lambda p: 1.0))

        def pde(u, x, *p):
            source = self.k * self.table[0] * self.box["k"] * (more(*p) if p else 1.0) * K
            first = js.laplacian(u if fields == 1 else u[0])(x) - (u(x) if fields == 1 else u(x)[0]) ** power - source
            if fields == 1:
                return first
            return jnp.stack([first, js.laplacian(u[1])(x) - u(x)[0] - self.k])

        def residual(u, x, n, *p):
            flux = [n @ js.grad(u if fields == 1 else u[f])(x) - self.slope[0] for f in range(fields)]
            return flux[0] if fields == 1 else jnp.stack(flux)

        left = js.dirichlet(self.edge) if fields == 1 else js.dirichlet(lambda x, *p: self.edge[0] * jnp.ones(fields))
        self.problem = js.Problem(
            pde, {"left": left, "right": js.condition(residual)}, fields=fields, params=self.params
        )
        self.options = {"order": order}

    def change(self):
        global K
        self.k, self.table[:], self.box["k"], self.edge[:], self.slope[:] = 7.0, 5.0, 3.0, -2.0, 9.0
        K = 11.0
        if self.params is not None:
            self.params["k"] = np.array(4.0)
            self.params["more"][0][:] = 6.0


@pytest.fixture(autouse=True)
def global_restored():
    global K
    K = 1.0
    yield
    K = 1.0


POINTS = np.array([[0.0], [0.03], [0.55], [1.0]])
ASKED = {
    "values": lambda sol: sol(POINTS),
    "slopes": lambda sol: sol.grad(POINTS),
    "coefficients": lambda sol: sol.coefficients,
    "estimate": lambda sol: sol.error_estimate(),
    "flux": lambda sol: [sol.flux("left"), sol.integral()],
    "conditions": lambda sol: sol.condition_numbers()[0],
    "flags": lambda sol: len(sol.flags),
    "pickled": lambda sol: pickle.loads(pickle.dumps(sol)).coefficients,
    "copied": lambda sol: copy.deepcopy(sol)(POINTS),
    "mapped": lambda sol: jax.tree.map(lambda x: x, sol).grad(POINTS),
    "jitted": lambda sol: jax.jit(lambda s, x: s(x))(sol, POINTS),
}
CASES = {
    "linear": ({}, {}),
    "params": ({"params": True}, {}),
    "nonlinear": ({"nonlinear": True, "params": True}, {}),
    "system": ({"fields": 2}, {}),
    "least squares": ({}, {"formulation": "lsq"}),
    "nonlinear least squares": ({"nonlinear": True}, {"formulation": "lsq"}),
    # II asks what I does.
    **{method: ({"nonlinear": method == "III"}, {"method": method}) for method in ("I", "III", "SSPH")},
}


@pytest.mark.parametrize("case", CASES)
def test_a_solution_is_that_of_the_problem_as_it_was(case):
    """Two settings alike; one is asked before everything about it has changed, the other after."""
    made, options = CASES[case]
    before, after = Setting(**made), Setting(**made)
    one, two = (js.solve(s.problem, ROD, **s.options, **options) for s in (before, after))
    told = {name: ask(one) for name, ask in ASKED.items()}
    after.change()
    for name, ask in ASKED.items():
        np.testing.assert_allclose(ask(two), told[name], rtol=1e-9, atol=1e-11, err_msg=name)


def test_the_example_of_two_loads():
    """u'' = k, u = 0 at the ends: u(0.55) = -0.12375 k, u'(0) = -k / 2; the closure ends at k = 10."""
    sols = [js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - k, ENDS), ROD) for k in (1.0, 10.0)]  # noqa: B023
    np.testing.assert_allclose([s([[0.55]])[0] for s in sols], [-0.12375, -1.2375], rtol=1e-12)
    np.testing.assert_allclose([s.grad([[0.0]])[0, 0] for s in sols], [-0.5, -5.0], rtol=1e-12)


def test_a_problem_solved_again_is_the_problem_as_it_is_then():
    setting = Setting(params=True)
    first = js.solve(setting.problem, ROD).u[4]
    setting.change()
    assert abs(js.solve(setting.problem, ROD).u[4] - first) > 1.0


def test_one_array_changed_in_place_inside_of_a_jitted_helper():
    table = np.array([1.0])
    source = jax.jit(lambda x: x[0] * 0 + jnp.asarray(table)[0])
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - source(x), ENDS), ROD)
    table[:] = 50.0
    np.testing.assert_allclose(sol.grad([[0.0]])[0, 0], -0.5, rtol=1e-12)


def test_factorised_continued_and_tuned_solutions():
    k = {"k": 1.0}
    ready = js.factorize(js.Problem(lambda u, x: js.laplacian(u)(x) - k["k"], ENDS), ROD)
    one = ready.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 2 * k["k"], ENDS))
    stages = js.continuation(
        lambda c: js.Problem(lambda u, x: js.laplacian(u)(x) - c * k["k"] + 0 * u(x) ** 2, ENDS), ROD, [1, 2]
    )
    tuned = js.tune(js.Problem(lambda u, x: js.laplacian(u)(x) - 2 * k["k"], ENDS), ROD, js.SuperGaussian(0.125, 2.5),
                    order=4, steps=1, progress=False).solution  # fmt: skip
    k["k"] = 100.0
    for sol in (one, stages[1], tuned):
        np.testing.assert_allclose(sol.grad([[0.0]])[0, 0], -1.0, rtol=1e-9)


def test_a_solution_that_left_jit_is_complete():
    """Its closure over a traced number became numbers of its own."""
    near = js.stencils(ROD, size=5)

    def solved(k):
        problem = js.Problem(lambda u, x: js.laplacian(u)(x) - k, ENDS)
        return js.solve(problem, ROD, stencils=near, solver="dense")

    def slope_and_bend(k):
        sol = solved(k)
        return sol.grad(np.array([[0.0]]))[0, 0] + sol.coefficients[0, 2]

    sol = jax.jit(solved)(2.0)
    np.testing.assert_allclose(sol.grad([[0.0]])[0, 0], -1.0, rtol=1e-12)
    assert sol.error_estimate().max() < 1e-12
    np.testing.assert_allclose(jax.grad(slope_and_bend)(2.0), -0.5 + 0.5, atol=1e-12)


HANDED = {
    "u": lambda sol: sol.u,
    "coefficients": lambda sol: sol.coefficients,
    "estimate": lambda sol: sol.error_estimate(),
    "points": lambda sol: sol.cloud.points,
    "normals": lambda sol: sol.cloud.normals,
    "groups": lambda sol: sol.cloud.groups["left"],
}


@pytest.mark.parametrize("kept", ["itself", "pickled", "copied"])
@pytest.mark.parametrize("what", HANDED)
def test_what_is_handed_out_cannot_be_changed(what, kept):
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, ENDS), ROD)
    sol.error_estimate()
    sol = {"itself": lambda s: s, "pickled": lambda s: pickle.loads(pickle.dumps(s)), "copied": copy.deepcopy}[kept](
        sol
    )
    with pytest.raises(ValueError, match="read-only"):
        HANDED[what](sol)[...] = 0


def test_a_cloud_is_not_changed():
    points = np.linspace(0.0, 1.0, 5)[:, None]
    cloud = js.Cloud(points, {"interior": [1, 2, 3], "ends": [0, 4]})
    points *= 2.0
    assert cloud.points.max() == 1.0
    with pytest.raises(ValueError, match="read-only"):
        cloud.points *= 2.0
    with pytest.raises(AttributeError, match=r"cloud.replace\(points=...\)"):
        cloud.points = points


def test_kernel_and_stencils_changed_in_place():
    h = np.full(9, 0.125)
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, ENDS), ROD, kernel=js.SuperGaussian(h, 3.0))
    near = js.stencils(ROD, size=5)
    other = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, ENDS), ROD, stencils=near)
    h[:], near.indices[:] = 3.0, 0
    for s in (sol, other):
        np.testing.assert_allclose(s.grad([[0.0]])[0, 0], -0.5, rtol=1e-9)


def test_a_cloud_of_regions_is_not_changed():
    """Nor what came out of a file or a program with it."""
    made = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
    for cloud in (made, pickle.loads(pickle.dumps(made)), jax.tree.map(lambda x: x, made)):
        with pytest.raises(ValueError, match="read-only"):
            cloud.interface_normals["a|b"][0] = -1.0
        with pytest.raises(TypeError):
            cloud.interface_normals["a|b"] = cloud.normals
        for name in ("interface_normals", "interfaces", "regions"):
            with pytest.raises(AttributeError, match=f"{name}: a RegionCloud does not change; make another one"):
                setattr(cloud, name, {})


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy])
def test_a_copy_knows_what_the_solution_knows(copied):
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, ENDS), ROD)
    other = copied(sol)
    assert (other.error_estimate() == sol.error_estimate()).all() and other.flags == sol.flags
    np.testing.assert_array_equal(other.condition_numbers()[0], sol.condition_numbers()[0])


def test_a_setting_of_ranks_is_about_the_arrays_of_the_user():
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, ENDS)
    with jax.numpy_rank_promotion("raise"):
        sol = js.solve(problem, js.interval(0.0, 1.0, len(ROD)))
        assert sol.flags == [] and sol.coefficients.shape[0] == len(ROD)
        assert (np.asarray(sol(POINTS)) == np.asarray(js.solve(problem, ROD)(POINTS))).all()
        with pytest.raises(ValueError, match="rank_promotion"):
            jnp.ones((2, 1)) + jnp.ones(1)
