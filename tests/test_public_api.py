"""The package from outside: its names, what importing it costs, what it leaves alone."""

import ast
import inspect
import logging
import os
import pathlib
import pickle
import subprocess
import sys
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest

import jsmitsm as js
from benchmarks.problems import CASES
from jsmitsm.particle import batches
from jsmitsm.runtime.size_classes import padded_size

NAMES = """
    Cloud interval rectangle box from_sdf from_polygon
    Kernel SuperGaussian Gaussian Wendland CubicSpline Constant
    Problem dirichlet neumann robin condition periodic fix free
    grad laplacian divergence hessian partial multi_indices
    solve stencils factorize Solution SolveError
""".split()
PACKAGE = pathlib.Path(js.__file__).parent


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_is_there_and_says_what_it_is(name):
    member = getattr(js, name)
    assert callable(member)
    if not inspect.isclass(member) or "__init__" in vars(member):
        assert inspect.getdoc(member), f"{name} has no docstring"


def test_completion_offers_every_public_name():
    """In a fresh process: what is imported when first used must be seen before."""
    for module in (js.sdf, js.plot, js.files):
        assert dir(module) == sorted(module.__all__)
    seen = in_a_fresh_process("import jsmitsm as js; print([n for n in dir(js) if n[0] != '_'])")
    assert set(ast.literal_eval(seen)) == set(js.__all__) >= {*NAMES, "tune", "TuneResult", "plot", "files", "sdf"}
    assert all(getattr(js, name) is not None for name in js.__all__)


def test_the_signature_of_solve():
    parameters = inspect.signature(js.solve).parameters
    usual = {k: p.default for k, p in parameters.items() if p.kind is p.KEYWORD_ONLY}
    expected = {"method": "S", "order": 4, "kernel": None, "stencils": None, "basis_terms": None,
                "formulation": "auto", "solver": "auto", "u0": None, "throw": True}  # fmt: skip
    assert list(parameters)[:2] == ["problem", "cloud"]
    assert {k: usual[k] for k in expected} == expected


# ------------------------------------------------------------------ importing


def in_a_fresh_process(code, **environment):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120,
                          env={**os.environ, "PYTHONPATH": str(PACKAGE.parent), **environment})  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip()


def test_importing_is_light_and_changes_nothing():
    """No scipy.spatial, scipy.sparse, matplotlib, Pallas; not one option of JAX, nor numpy's, nor a backend started."""
    code = """
import sys, warnings
import jax, numpy as np
import jax._src.xla_bridge as bridge
before = dict(jax.config.values), np.geterr(), np.get_printoptions(), list(warnings.filters)
import jsmitsm
assert before == (dict(jax.config.values), np.geterr(), np.get_printoptions(), list(warnings.filters))
assert not bridge._backends, "importing started a backend"
heavy = ("scipy.spatial", "scipy.sparse", "scipy.optimize", "matplotlib", "optax", "pyamg", "meshio", "shapely", "tqdm",
         "jax.extend.pallas")
print([name for name in heavy if name in sys.modules])
"""
    before = "import jax, sys; print([n for n in sys.modules if n.startswith(('scipy.', 'jax.extend.'))])"
    by_jax = ast.literal_eval(in_a_fresh_process(before))
    assert set(ast.literal_eval(in_a_fresh_process(code))) <= set(by_jax)


def test_parts_of_jaxprs_are_those_of_jax():
    """Imported from where they are defined, they are what JAX gives to everybody."""
    from jax.extend import core

    from jsmitsm.runtime import jaxprs

    for name in ("ClosedJaxpr", "Jaxpr", "Literal", "Primitive", "jaxpr_as_fun"):
        assert getattr(jaxprs, name) is getattr(core, name)


def test_importing_takes_few_modules_beyond_those_of_jax():
    """What importing costs is modules read; the seconds are a benchmark's (`benchmarks.cold`)."""
    code = """
import sys, jax
before = set(sys.modules)
import jsmitsm
print(sorted(set(sys.modules) - before))
"""
    read = ast.literal_eval(in_a_fresh_process(code))
    own = [name for name in read if name.startswith("jsmitsm")]
    of_all = len(list(PACKAGE.rglob("*.py")))
    assert len(own) < of_all / 3, f"{len(own)} of {of_all} modules: {own}"
    assert len(read) - len(own) < 20, [name for name in read if name not in own]


# ------------------------------------------------------------------ objects

CLOUD = mm.jittered(1, 12)
EXACT = mm.polynomial(1, 4)
PROBLEM = CASES["poisson 1D"].solved_by(EXACT).problem()


@pytest.fixture(scope="module")
def solution():
    return js.solve(PROBLEM, CLOUD)


def test_a_solution_pickles_without_the_users_functions(solution):
    """Lambdas do not pickle, and need not: the local polynomials do."""
    points = np.array([[0.13], [0.77]])
    back = pickle.loads(pickle.dumps(solution))
    assert np.array_equal(back.u, solution.u)
    assert np.array_equal(back(points), solution(points)) and np.array_equal(back.grad(points), solution.grad(points))
    assert np.array_equal(back.coefficients, solution.coefficients)
    assert back.converged and back.method == "S" and back.order == 4
    assert back.diagnose() == solution.diagnose()


def test_a_solution_is_a_pytree(solution):
    leaves, shape = jax.tree.flatten(solution)
    back = jax.tree.unflatten(shape, leaves)
    assert np.array_equal(back.u, solution.u) and back.order == solution.order
    doubled = jax.tree.map(lambda x: x, solution)
    assert np.array_equal(doubled(np.array([[0.4]])), solution(np.array([[0.4]])))


def test_what_a_solution_holds(solution):
    n, k = len(CLOUD), len(js.multi_indices(1, 4 + solution.stats["depth"]))
    assert solution.u.shape == (n,) and solution.coefficients.shape == (n, k)
    points = np.array([[0.1], [0.2], [0.3]])
    assert solution(points).shape == (3,) and solution.grad(points).shape == (3, 1)
    assert solution.iterations == 1 and bool(solution.converged)
    assert isinstance(solution.stats, dict) and isinstance(solution.diagnose(), str)
    # The polynomial of degree 4 itself: coefficients d^a u / a! at the particle, round-off times a
    # condition number below 1e4 (and the fourth power of 1 / h in the highest one).
    x = CLOUD.points[:, 0]
    assert np.allclose(solution.coefficients[:, 0], mm.values(EXACT, CLOUD.points), atol=1e-12)
    assert np.allclose(solution.coefficients[:, 1], [float(js.grad(EXACT)(v)[0]) for v in CLOUD.points], atol=1e-10)
    assert np.allclose(solution(points), mm.values(EXACT, points), atol=1e-12) and len(x) == n


def test_a_problem_is_a_pytree_of_its_numbers():
    bcs = {"left": js.dirichlet(1.0), "right": js.neumann(2.0)}
    problem = js.Problem(lambda u, x, p: js.laplacian(u)(x) - p["s"], bcs, params={"s": 3.0})
    leaves, shape = jax.tree.flatten(problem)
    assert sorted(leaves) == [1.0, 2.0, 3.0]
    back = jax.tree.unflatten(shape, leaves)
    assert back.pde is problem.pde and back.params == {"s": 3.0} and back.bcs["left"][0].value == 1.0
    assert problem.replace(params={"s": 4.0}).params == {"s": 4.0} and problem.params == {"s": 3.0}


@pytest.mark.parametrize("what", ["solution", "kernel", "problem", "cloud"])
def test_checkpoint_tools_may_put_names_in_the_place_of_leaves(what, solution):
    """What orbax does: a tree of names, one per leaf, with the structure of the tree itself."""
    problem = PROBLEM.replace(bcs={"left": js.dirichlet(1.0), "right": js.robin(1.0, 2.0, lambda x: x[0])})
    things = {"solution": solution, "kernel": js.SuperGaussian(0.1, 3.0), "problem": problem, "cloud": CLOUD}
    thing = things[what]
    names = jax.tree_util.tree_map_with_path(lambda path, _: jax.tree_util.keystr(path), thing)
    assert jax.tree.structure(names) == jax.tree.structure(thing)
    stored = dict(zip(jax.tree.leaves(names), map(np.asarray, jax.tree.leaves(thing))))
    back = jax.tree.map(stored.get, names)
    assert len(stored) == len(jax.tree.leaves(thing)) and type(back) is type(thing)
    if what == "solution":
        points = np.array([[0.4]])
        assert np.array_equal(back(points), solution(points)) and np.array_equal(back.u, solution.u)
        assert np.array_equal(back.error_estimate(), solution.error_estimate())


def test_reprs_are_short(solution):
    kernel = js.SuperGaussian(np.full(12, 0.1), 3.0)
    things = (
        solution, CLOUD, PROBLEM, kernel, js.stencils(CLOUD, size=5), js.dirichlet(np.zeros(1000)), js.free(),
        js.quality(CLOUD), js.factorize(PROBLEM, CLOUD), js.fix(np.arange(1000), 0.0), js.periodic("left", "right"),
        js.quadrature(CLOUD, "left"), js.Problem(residual, PROBLEM.bcs),
    )  # fmt: skip
    for thing in things:
        assert len(repr(thing)) < 200 and "\n" not in repr(thing), repr(thing)


def residual(u, x):
    return js.laplacian(u)(x)


def test_what_can_be_pickled_and_what_says_that_it_cannot():
    things = (
        CLOUD, js.Problem(residual, {"left": js.dirichlet(1.0)}), js.Wendland(np.full(12, 0.1), 3.0),
        js.stencils(CLOUD, size=5), js.robin(1.0, np.ones(3), 0.0), js.quality(CLOUD),
    )  # fmt: skip
    for thing in things:
        back = pickle.loads(pickle.dumps(thing))
        assert repr(back) == repr(thing)
        jax.tree.map(np.testing.assert_array_equal, jax.tree.leaves(back), jax.tree.leaves(thing))
    with pytest.raises(TypeError, match="call js.factorize again"):
        pickle.dumps(js.factorize(PROBLEM, CLOUD))


# ------------------------------------------------------------------ compilations


class Compilations:
    """How often JAX compiled anything between two looks, by its own monitoring events."""

    def __init__(self):
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event, *_, **__):
        self.count += event == "/jax/core/compile/backend_compile_duration"


@pytest.fixture(scope="module")
def compiled():
    return Compilations()


def wave(strength):
    """A fresh lambda at every call, with another number in it."""
    return js.Problem(lambda u, x: js.laplacian(u)(x) - jnp.asarray(strength) * jnp.sin(x[0]),
                      {"left": js.dirichlet(0.0), "right": js.robin(1.0, 1.0, strength)})  # fmt: skip


def stirred(cloud, seed):
    x = cloud.points.copy()
    inside = cloud.groups["interior"]
    x[inside] += 0.1 * cloud.spacing * np.random.default_rng(seed).uniform(-1, 1, x[inside].shape)
    return js.Cloud(x, cloud.groups, cloud.normals)


AGAIN = {
    "the same": lambda: (wave(1.0), CLOUD),
    "a fresh lambda with another number": lambda: (wave(2.0), CLOUD),
    "other particles": lambda: (wave(1.0), stirred(CLOUD, 3)),
    "another number of particles": lambda: (wave(1.0), mm.jittered(1, 14, seed=5)),
    "a scaled domain": lambda: (wave(1.0), js.Cloud(3.0 * CLOUD.points, CLOUD.groups, CLOUD.normals)),
}


@pytest.mark.parametrize("again", AGAIN)
def test_a_second_solve_compiles_nothing(again, compiled):
    js.solve(wave(1.0), CLOUD)
    problem, cloud = AGAIN[again]()
    before, traces = compiled.count, dict(batches.TRACES)
    sol = js.solve(problem, cloud)
    assert sol.converged
    assert batches.TRACES == traces
    assert compiled.count == before


def test_new_params_compile_nothing(compiled):
    problem = js.Problem(
        lambda u, x, p: js.laplacian(u)(x) - p["k"] * u(x) - p["s"],
        {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}, params={"k": 1.0, "s": 2.0},
    )  # fmt: skip
    first = js.solve(problem, CLOUD)
    before, traces = compiled.count, dict(batches.TRACES)
    second = js.solve(problem.replace(params={"k": 3.0, "s": -1.0}), CLOUD)
    assert np.abs(np.asarray(first.u) - np.asarray(second.u)).max() > 0.1
    assert batches.TRACES == traces and compiled.count == before


def total(cloud, near):
    """A function of every kind of number, which an eager gradient is asked of."""

    def value(t):
        pde = lambda u, x, p: js.divergence(lambda y: (1.0 + p * y[0]) * js.grad(u)(y))(x) - jnp.sin(x[0])
        bcs = {"left": js.dirichlet(t["wall"]), "right": js.robin(1.0, 1.0, t["wall"])}
        problem = js.Problem(pde, bcs, params=t["k"])
        kernel = js.SuperGaussian(t["h"], t["d"])
        moved = cloud.replace(points=t["points"])
        sol = js.solve(problem, moved, order=3, kernel=kernel, stencils=near, solver="sparse")
        return jnp.sum(sol.u**2)

    return value


def given(cloud, factor=1.0):
    h = 2.4 / (len(cloud) - 1)
    return {"h": factor * h, "d": 3.0, "k": 0.3 * factor, "wall": 0.5 * factor, "points": cloud.points}


@contextmanager
def compiling():
    """What is compiled, as JAX tells it."""
    names = []
    logger = logging.getLogger("jax._src.interpreters.pxla")
    handler = logging.Handler()
    handler.emit = lambda record: names.append(record.getMessage())
    logger.addHandler(handler)
    try:
        with jax.log_compiles():
            yield names
    finally:
        logger.removeHandler(handler)


def test_a_gradient_runs_the_local_phase_that_the_solve_compiled():
    value, here = total(CLOUD, js.stencils(CLOUD, size=9)), given(CLOUD)
    by_k = lambda k: value({**here, "k": k})  # noqa: E731
    by_k(0.3)
    with compiling() as names:
        jax.grad(by_k)(0.3)
    assert any("Compiling jit(pulled_moved_rows)" in name for name in names), "nothing was listened to"
    assert not [name for name in names if "Compiling jit(rows)" in name]


@pytest.fixture(scope="module")
def graded():
    """The programs of a first gradient."""
    near = js.stencils(CLOUD, size=9)
    return near, jax.grad(total(CLOUD, near))(given(CLOUD))


@pytest.mark.parametrize("cloud", [CLOUD, stirred(CLOUD, 3)], ids=["other numbers", "other particles"])
def test_a_second_eager_gradient_compiles_nothing(graded, compiled, cloud):
    near, first = graded
    before, traces = compiled.count, dict(batches.TRACES)
    second = jax.grad(total(cloud, near))(given(cloud, 1.01))
    assert batches.TRACES == traces and compiled.count == before
    assert abs(first["k"] - second["k"]) > 1e-6, "the same numbers: nothing was tested"


def test_a_gradient_on_a_cloud_of_similar_size_reuses_the_local_phase(graded):
    """Its derivative too: what is compiled is small, for the exact shapes of the global system."""
    cloud = mm.jittered(1, len(CLOUD) + 1, seed=5)
    assert padded_size(len(cloud)) == padded_size(len(CLOUD))
    traces = dict(batches.TRACES)
    with compiling() as names:
        jax.grad(total(cloud, js.stencils(cloud, size=9)))(given(cloud))
    assert batches.TRACES == traces
    assert any("Compiling jit(pulled_moved__entries)" in name for name in names), "nothing was listened to"
    assert not [name for name in names if "rows)" in name]


def test_the_counter_of_compilations_works(compiled):
    before = compiled.count
    jax.jit(lambda x: x * 3.0 + jnp.tan(x))(np.ones(17))
    assert compiled.count > before
