"""Global solves: values, derivatives, kept factorisations, singular systems, fallbacks."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jsmitsm.linear import backends, factor_cache, linsolve, ordering, solver_choice, sparse
from jsmitsm.linear.linsolve import SingularMatrix, factor, factorisations, solve
from jsmitsm.linear.ordering import nested_dissection
from jsmitsm.runtime.errors import SolveError

BACKENDS = ["dense", "sparse", "iterative"]


@pytest.fixture(autouse=True)
def empty_cache():
    """No test finds another's factorisation."""
    linsolve.clear_cache()
    yield
    linsolve.clear_cache()


def grid(m, pinned=True, seed=0):
    """Entries of a convection-diffusion operator on m x m jittered points, in random order.

    Every diagonal entry comes as the sum of several, so duplicates are always tested. Without
    `pinned` its rows add up to zero: constants are in the null space.
    """
    rng = np.random.default_rng(seed)
    index = rng.permutation(m * m).reshape(m, m)
    data, rows, cols = [], [], []
    for axis in (0, 1):
        a = index.take(range(m - 1), axis).ravel()
        b = index.take(range(1, m), axis).ravel()
        for i, j, weight in ((a, b, 1.0), (b, a, 1.3)):
            w = weight * rng.uniform(0.8, 1.2, len(i))
            data += [-w, w]
            rows += [i, i]
            cols += [j, i]
    if pinned:
        edge = index[:, 0]
        data, rows, cols = data + [np.full(m, 2.0)], rows + [edge], cols + [edge]
    points = np.empty((m * m, 2))
    points[index.ravel()] = np.stack(np.meshgrid(range(m), range(m), indexing="ij"), -1).reshape(-1, 2)
    shuffled = rng.permutation(sum(map(len, data)))
    data, rows, cols = (np.concatenate(a)[shuffled] for a in (data, rows, cols))
    return data, rows, cols, points + rng.uniform(-0.3, 0.3, points.shape)


def full(data, rows, cols, n):
    """The matrix as a numpy array."""
    matrix = np.zeros((n, n))
    np.add.at(matrix, (rows, cols), data)
    return matrix


@pytest.mark.parametrize("solver", ["auto", *BACKENDS])
@pytest.mark.parametrize("m", [6, 20])
@pytest.mark.parametrize("width", [(), (3,)])
def test_values(solver, m, width):
    data, rows, cols, points = grid(m)
    n = m * m
    b = np.random.default_rng(1).normal(size=(n, *width))
    info = {}
    x = solve(data, rows, cols, b, n=n, points=points, solver=solver, info=info)
    expected = np.linalg.solve(full(data, rows, cols, n), b)
    assert x.shape == b.shape and x.dtype == jnp.float64
    # the condition number is about 1e3, every method is refined to round-off
    np.testing.assert_allclose(x, expected, atol=1e-11 * abs(expected).max())
    assert info["residual"] < 1e-14 and not info["messages"] and info["cached"] is False
    assert set(info["seconds"]) == {"ordering", "factorisation", "solve"}


@pytest.mark.parametrize("points", [False, True])
@pytest.mark.parametrize("solver", BACKENDS)
def test_transposed_solve(solver, points):
    data, rows, cols, place = grid(19)
    f = factor(data, rows, cols, 361, place if points else None, solver)
    b = np.random.default_rng(2).normal(size=361)
    expected = np.linalg.solve(full(data, rows, cols, 361).T, b)
    np.testing.assert_allclose(f.solve(b, transpose=True), expected, rtol=0, atol=1e-11 * abs(expected).max())


def test_units_do_not_matter():
    """Two coupled fields 18 decades apart, equations in any unit: no digits lost, no alarm."""
    data, rows, cols, points = grid(15)
    n, rng = 225, np.random.default_rng(3)
    data = np.concatenate([data, 0.3 * data, -0.2 * data, data])
    rows = np.concatenate([rows, rows, rows + n, rows + n])
    cols = np.concatenate([cols, cols + n, cols, cols + n])
    unit, own = np.repeat([1e9, 1e-9], n), 10.0 ** rng.integers(-12, 12, 2 * n)
    x = rng.uniform(1, 2, 2 * n)
    b = own * (full(data, rows, cols, 2 * n) @ x)
    entries, info = data * own[rows] * unit[cols], {}
    y = solve(entries, rows, cols, b, n=2 * n, points=np.tile(points, (2, 1)), info=info)
    np.testing.assert_allclose(y * unit, x, rtol=1e-11)
    assert not info["messages"]


def test_lagrange_row_without_coordinates():
    """Pure Neumann, bordered by the mean: zero diagonal, a dense row, no place for the multiplier."""
    data, rows, cols, points = grid(20, pinned=False)
    n, every = 400, np.arange(400)
    data = np.concatenate([data, np.ones(2 * n)])
    rows = np.concatenate([rows, np.full(n, n), every])
    cols = np.concatenate([cols, every, np.full(n, n)])
    points = np.concatenate([points, [[np.nan, np.nan]]])
    b = np.random.default_rng(4).normal(size=n + 1)
    for solver in ("auto", "iterative"):
        x = solve(data, rows, cols, b, n=n + 1, points=points, solver=solver)
        np.testing.assert_allclose(full(data, rows, cols, n + 1) @ x, b, atol=1e-10)


def test_nothing_to_solve():
    none = np.zeros(0)
    assert solve(none, none.astype(int), none.astype(int), none, n=0).shape == (0,)


def test_single_precision():
    data, rows, cols, points = grid(20)
    data, b = data.astype(np.float32), np.ones(400, np.float32)
    for run in (solve, lambda *a, **k: jax.jit(lambda d, b: solve(d, rows, cols, b, **k))(data, b)):
        x = run(data, rows, cols, b, n=400, points=points)
        assert x.dtype == jnp.float32
        np.testing.assert_allclose(full(data, rows, cols, 400) @ x, b, atol=1e-3)


# ------------------------------------------------------------------------------------ derivatives


def loss(solver, m=5, **options):
    """A nonlinear function of the entries and the right-hand side, its arguments, its matrix."""
    data, rows, cols, points = grid(m)
    b = np.random.default_rng(5).normal(size=m * m)

    def value(data, b):
        x = solve(data, rows, cols, b, n=m * m, points=points, solver=solver, **options)
        return jnp.sum(x**3)

    return value, jnp.asarray(data), jnp.asarray(b)


def difference(f, x, v, step=1e-5):
    """Central difference of f at x along v."""
    return (f(x + step * v) - f(x - step * v)) / (2 * step)


@pytest.mark.parametrize(
    "m, solver, wrap",
    [
        (5, "auto", jax.jit),
        (5, "dense", jax.jit),
        (5, "sparse", jax.checkpoint),
        (5, "iterative", lambda f: f),
        (18, "auto", jax.jit),
    ],
)
def test_first_derivatives(m, solver, wrap):
    value, data, b = loss(solver, m)
    rng = np.random.default_rng(6)
    v, w = rng.normal(size=data.shape), rng.normal(size=b.shape)
    value = wrap(value)
    by_data, by_b = jax.grad(value, (0, 1))(data, b)
    # central differences with steps of 1e-5: error about 1e-10 times the third derivative
    np.testing.assert_allclose(by_data @ v, difference(lambda d: value(d, b), data, v), rtol=1e-6)
    np.testing.assert_allclose(by_b @ w, difference(lambda c: value(data, c), b, w), rtol=1e-6)
    forward = jax.jvp(value, (data, b), (jnp.asarray(v), jnp.asarray(w)))[1]
    np.testing.assert_allclose(forward, by_data @ v + by_b @ w, rtol=1e-10)


@pytest.mark.parametrize("solver", ["dense", "sparse"])
def test_second_derivatives(solver):
    value, data, b = loss(solver, 3)
    hessian = jax.jit(jax.hessian(value))(data, b)
    v = np.random.default_rng(7).normal(size=data.shape)
    slope = difference(jax.jit(lambda d: jax.grad(value)(d, b)), data, v)
    np.testing.assert_allclose(hessian @ v, slope, rtol=1e-6, atol=1e-7 * abs(slope).max())


@pytest.mark.parametrize("solver", ["sparse", "iterative"])
def test_one_factorisation_for_all_derivatives(solver):
    """Eager and compiled transformations agree and share one factorisation."""
    value, data, b = loss(solver, 3)
    transformed = [
        value,
        jax.grad(value, (0, 1)),
        jax.jacfwd(value, 1),
        jax.hessian(value, 1),
        jax.grad(jax.checkpoint(value)),
        lambda data, b: jax.vmap(jax.grad(value, 1), (None, 0))(data, jnp.stack([b, 2 * b])),
        lambda data, b: jax.jvp(jax.grad(value), (data, b), (data, b)),
    ]
    before = factorisations()
    for f in transformed:
        for eager, compiled in zip(jax.tree.leaves(f(data, b)), jax.tree.leaves(jax.jit(f)(data, b))):
            np.testing.assert_allclose(eager, compiled, rtol=1e-10, atol=1e-12)
    assert factorisations() - before == 1


def test_no_callback_outside_jit(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("callback")

    value, data, b = loss("sparse")
    monkeypatch.setattr(linsolve.mlir, "emit_python_callback", refuse)
    jax.grad(value)(data, b)
    with pytest.raises(AssertionError, match="callback"):
        jax.jit(value)(data, b)


@pytest.mark.parametrize(
    "solver, compiled", [("auto", False), ("auto", True), ("sparse", True)]
)
def test_vmap_over_everything(solver, compiled):
    """Nested vmaps over matrices, right-hand sides and positions, against a loop."""
    data, rows, cols, points = grid(5)
    rng = np.random.default_rng(8)
    many = jnp.asarray(data * rng.uniform(0.9, 1.1, (3, len(data))))
    sides = jnp.asarray(rng.normal(size=(2, 25)))
    shuffles = [rng.permutation(25) for _ in range(3)]
    turned_rows, turned_cols = (jnp.stack([p[a] for p in shuffles]) for a in (rows, cols))

    def one(data, rows, cols, b):
        return solve(data, rows, cols, b, n=25, points=points, solver=solver)

    def slope(data, rows, cols, b):
        return jax.grad(lambda d: jnp.sum(one(d, rows, cols, b) ** 3))(data)

    for f in (one, slope):
        inner = jax.vmap(f, (None, None, None, 0))
        mapped = jax.vmap(inner, (0, 0, 0, None), out_axes=1)
        mapped = jax.jit(mapped) if compiled else mapped
        got = mapped(many, turned_rows, turned_cols, sides)
        alone = jax.jit(f) if compiled else f
        for i, k in ((0, 0), (0, 2), (1, 1)):
            expected = alone(many[k], turned_rows[k], turned_cols[k], sides[i])
            np.testing.assert_allclose(got[i, k], expected, rtol=1e-9, atol=1e-10)
    across = jax.vmap(jax.vmap(one, (0, None, None, None)), (None, None, None, 0))
    got = across(many, rows, cols, sides)
    np.testing.assert_allclose(got[1, 2], one(many[2], rows, cols, sides[1]), rtol=1e-9, atol=1e-11)


def test_gradients_of_several_matrices_factorise_each_once():
    value, data, b = loss("sparse")
    before = factorisations()
    jax.vmap(jax.grad(value), (0, None))(jnp.stack([data, 1.1 * data, 1.2 * data]), b)
    assert factorisations() - before == 3


# ------------------------------------------------------------------------------------------ cache


def test_kept_by_value_not_by_name():
    data, rows, cols, points = grid(18)
    b = np.ones(324)
    first = solve(data, rows, cols, b, n=324, points=points)
    info, before = {}, factorisations()
    again = solve(data.copy(), rows.copy(), cols, b, n=324, points=points.copy(), info=info)
    assert info["cached"] and factorisations() == before
    np.testing.assert_array_equal(first, again)
    data *= 2.0  # in place: an array that was changed must not be taken for its old self
    np.testing.assert_allclose(solve(data, rows, cols, b, n=324, points=points), first / 2)
    assert factorisations() == before + 1


def test_changes_in_place_are_seen_under_grad():
    """JAX arrays may share the memory of the numpy array they were made of."""
    n, index = 512, np.arange(512)
    memory = np.empty(n + 8)
    data = memory[(-memory.ctypes.data // 8) % 8 :][:n]  # aligned to 64 bytes: shared
    for value in (2.0, 4.0):
        data[:] = value
        slope = jax.grad(lambda b: solve(data, index, index, b, n=n).sum())(jnp.ones(n))  # noqa: B023
        np.testing.assert_allclose(slope, 1 / value)


def test_order_is_found_once_for_one_pattern(monkeypatch):
    data, rows, cols, points = grid(18)
    solve(data, rows, cols, np.ones(324), n=324, points=points)
    monkeypatch.setattr(sparse, "nested_dissection", None)
    solve(2 * data, rows, cols, np.ones(324), n=324, points=points)


def test_what_is_hardly_a_number_is_solved_for():
    data, rows, cols, points = grid(18)
    b = np.sin(np.arange(324.0))
    whole, little = (solve(data, rows, cols, size * b, n=324, points=points) for size in (1.0, 1e-310))
    assert np.abs(little * 2.0**600 / (1e-310 * 2.0**600) - whole).max() < 1e-10 * np.abs(whole).max()


def test_cache_is_bounded(monkeypatch):
    monkeypatch.setattr(factor_cache, "CACHE_ENTRIES", 2)
    index = np.arange(3)
    for k in range(1, 5):
        factor(np.full(3, float(k)), index, index, 3)
    assert len(factor_cache._kept) == 2
    monkeypatch.setattr(factor_cache, "CACHE_BYTES", 1)
    f = factor(np.full(3, 9.0), index, index, 3)
    assert factor_cache._kept == [f]


# ------------------------------------------------------------------------------------------ order


@pytest.mark.parametrize("dim, m", [(1, 50), (2, 25), (3, 9)])
def test_order_is_a_permutation(dim, m):
    rng = np.random.default_rng(9)
    points = rng.uniform(size=(m**dim, dim))
    points[::7] = points[0]  # points on top of each other, as the fields of a system
    points[5] = np.nan
    rows, cols = rng.integers(0, m**dim, (2, 5 * m**dim))
    order = nested_dissection(rows, cols, points)
    assert sorted(order) == list(range(m**dim))
    assert order[-1] == 5


def test_separators_separate():
    """Without the last separator the first half of the order does not touch the second."""
    _, rows, cols, points = grid(32)
    order = nested_dissection(rows, cols, points)
    place = np.empty(1024, int)
    place[order] = np.arange(1024)
    low, high = np.minimum(place[rows], place[cols]), np.maximum(place[rows], place[cols])
    last = 1024 - 33  # a column of the lattice, and a little for the jitter
    crossing = [np.sum((low < k) & (high >= k) & (high < last)) for k in range(300, 700)]
    assert min(crossing) == 0


@pytest.mark.parametrize("dim, finest, most", [(2, 9, 0.6), (3, 6, 0.85)])
def test_cuts_go_across_what_is_graded(monkeypatch, dim, finest, most):
    """Layers towards a wall, each with half the spacing of the one before: most particles are along the wall."""
    rng = np.random.default_rng(4)
    layers = []
    for level in range(2, finest):
        h = 0.5**level
        middles = [h * (np.arange(2**level) + 0.5)] * (dim - 1)
        layers.append(np.stack(np.meshgrid([1.25 * h, 1.75 * h], *middles), -1).reshape(-1, dim))
        layers[-1] += 0.1 * h * rng.uniform(-1, 1, layers[-1].shape)
    points = np.concatenate(layers)
    n, k = len(points), 6 * dim
    rows, cols = np.repeat(np.arange(n), k), cKDTree(points).query(points, k)[1].ravel()
    data = np.where(rows == cols, float(k), -rng.uniform(size=n * k))
    graded = factor(data, rows, cols, n, points, "sparse").info["factor_entries"]
    monkeypatch.setattr(ordering, "_FEWER", 0.0)
    linsolve.clear_cache()
    assert graded < most * factor(data, rows, cols, n, points, "sparse").info["factor_entries"]


def test_order_saves_fill_in():
    data, rows, cols, points = grid(60)
    entries = [factor(data, rows, cols, 3600, p, "sparse").info["factor_entries"] for p in (points, None)]
    assert entries[0] < 0.85 * entries[1]


# ---------------------------------------------------------------------------------------- failures


@pytest.mark.parametrize("m", [6, 20])
@pytest.mark.parametrize("solver", ["auto", "sparse", "iterative"])
@pytest.mark.parametrize("consistent", [False, True])
def test_singular_to_working_precision(m, solver, consistent):
    """Constants in the null space: every unknown is named, whether or not a solution exists."""
    data, rows, cols, points = grid(m, pinned=False)
    x = np.random.default_rng(10).normal(size=m * m)
    b = full(data, rows, cols, m * m) @ x if consistent else x
    with pytest.raises(SingularMatrix, match="singular") as raised:
        solve(data, rows, cols, b, n=m * m, points=points, solver=solver)
    assert isinstance(raised.value, SolveError)
    assert sorted(raised.value.unknowns) == list(range(m * m))


@pytest.mark.parametrize("m", [6, 20])
def test_unknowns_at_fault_are_named(m):
    data, rows, cols, points = grid(m)
    n, b = m * m, np.ones(m * m)
    options = dict(n=n, points=points)
    with pytest.raises(SingularMatrix, match="without any coefficient") as raised:
        solve(np.where(rows == 7, 0.0, data), rows, cols, b, **options)
    assert raised.value.unknowns == (7,)
    with pytest.raises(SingularMatrix, match="no equation contains") as raised:
        solve(np.where(cols == 8, 0.0, data), rows, cols, b, **options)
    assert raised.value.unknowns == (8,)
    with pytest.raises(SingularMatrix, match="not finite") as raised:
        solve(np.where(np.arange(len(data)) == 3, np.nan, data), rows, cols, b, **options)
    assert raised.value.unknowns == (rows[3],)
    with pytest.raises(SingularMatrix, match="right-hand side") as raised:
        solve(data, rows, cols, np.where(np.arange(n) == 9, np.inf, b), **options)
    assert raised.value.unknowns == (9,)


@pytest.mark.parametrize("size", [4, 400])
def test_exact_zero_pivot(size):
    """Two equal equations in two unknowns of their own: named, and nobody else."""
    index = np.arange(size)
    rows = np.concatenate([index, [2, 3]])
    cols = np.concatenate([index, [3, 2]])
    with pytest.raises(SingularMatrix) as raised:
        solve(np.ones(size + 2), rows, cols, np.ones(size), n=size)
    assert set(raised.value.unknowns) == {2, 3}


@pytest.mark.parametrize("size", [4, 400])
def test_structurally_singular(size):
    """Three equations in two unknowns, with nonzero rows and columns throughout."""
    index = np.arange(size)
    rows = np.concatenate([index[3:], [0, 0, 1, 1, 2, 2, 3]])
    cols = np.concatenate([index[3:], [0, 1, 0, 1, 0, 1, 2]])
    values = np.random.default_rng(11).uniform(1, 2, len(rows))
    with pytest.raises(SingularMatrix) as raised:
        solve(values, rows, cols, np.ones(size), n=size, solver="sparse")
    assert raised.value.unknowns


@pytest.mark.parametrize("m", [6, 20])
def test_singular_under_jit_gives_nan(m):
    data, rows, cols, points = grid(m)
    run = jax.jit(lambda d, b: solve(d, rows, cols, b, n=m * m, points=points))
    assert not jnp.isfinite(run(jnp.where(rows == 7, 0.0, data), np.ones(m * m))).all()
    assert jnp.isfinite(run(data, np.ones(m * m))).all()


def test_nan_passes_through_derivatives():
    """A NaN cotangent is no fault of the matrix."""
    data, rows, cols, points = grid(20)
    x = jax.grad(lambda b: jnp.nan * solve(data, rows, cols, b, n=400, points=points).sum())(np.ones(400))
    assert jnp.isnan(x).all()


def test_condition_and_null_vector():
    data, rows, cols, points = grid(20, pinned=False)
    weak = np.concatenate([data, [1e-9]]), np.concatenate([rows, [5]]), np.concatenate([cols, [5]])
    f = factor(*weak, 400, points)
    scaled = f.matrix.toarray()
    exact = np.linalg.cond(scaled, 1)
    assert exact / 10 < f.condition() <= exact * 1.01
    null = f.near_null_vector()
    np.testing.assert_allclose(abs(null * f.col_scale) / abs(null * f.col_scale).max(), 1.0, rtol=1e-6)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"solver": "magic"}, "solver: got 'magic', expected one of auto"),
        ({"rows": np.arange(3)}, "data, rows, cols: .* got shapes"),
        ({"cols": np.array([0.0, 1.0])}, "cols: got dtype float64, expected integers"),
        ({"rows": np.array([0, 2])}, "rows: got indices from 0 to 2, expected 0 to 1"),
        ({"b": np.ones(3)}, r"b: got shape \(3,\), expected \(2,\)"),
        ({"b": np.ones(2) * 1j}, "complex"),
        ({"points": np.ones((3, 2))}, r"points: got shape \(3, 2\), expected \(2, D\)"),
    ],
)
def test_bad_input(change, message):
    good = dict(data=np.ones(2), rows=np.arange(2), cols=np.arange(2), b=np.ones(2), n=2)
    with pytest.raises(ValueError, match=message):
        solve(**{**good, **change})


# --------------------------------------------------------------------------------------- fallbacks


def test_without_pyamg(monkeypatch):
    data, rows, cols, points = grid(20)
    monkeypatch.setattr(solver_choice, "installed", lambda _: False)
    info = {}
    x = solve(data, rows, cols, np.ones(400), n=400, points=points, solver="iterative", info=info)
    assert info["backend"] == "ilu" and 0 < info["iterations"] < 100
    np.testing.assert_allclose(full(data, rows, cols, 400) @ x, 1.0, atol=1e-12)
    monkeypatch.setattr(solver_choice, "ITERATIVE_MIN", {2: 350})
    assert solver_choice.choose_backends(400, 2000, points, "auto", True)[0] == "nested dissection"


def test_auto_takes_multigrid_for_large_elliptic_problems_only(monkeypatch):
    monkeypatch.setattr(solver_choice, "ITERATIVE_MIN", {2: 350})
    points = grid(20)[3]
    first = lambda points, elliptic: solver_choice.choose_backends(400, 2000, points, "auto", elliptic)[0]  # noqa: E731
    assert first(points, True) == "amg" and first(points, False) == "nested dissection"
    bordered = np.where(np.arange(400)[:, None] == 399, np.nan, points)
    assert first(bordered, True) == "nested dissection"


def test_pardiso_where_installed(monkeypatch):
    pytest.importorskip("pypardiso")
    monkeypatch.setattr(solver_choice, "PARDISO_MIN", {2: 350})
    monkeypatch.setattr(solver_choice, "cores", lambda: 2)
    data, rows, cols, points = grid(20)
    data = data * (1 + 0.1 * np.sin(np.arange(len(data))))  # not symmetric
    f = sparse.Factor(data, rows, cols, 400, points, "sparse")
    assert f.info["backend"] == "pardiso" and f.info["factor_entries"] > len(data)
    matrix, b = full(data, rows, cols, 400), np.random.default_rng(0).random((400, 2))
    np.testing.assert_allclose(matrix @ f.solve(b), b, atol=1e-12)
    np.testing.assert_allclose(matrix.T @ f.solve(b, transpose=True), b, atol=1e-12)
    matrix[8] = matrix[7]  # a pivot vanishes, which PARDISO replaces by a small number
    rows, cols = np.nonzero(matrix)
    with pytest.raises(SingularMatrix):
        sparse.Factor(matrix[rows, cols], rows, cols, 400, points, "sparse")


def test_multigrid_that_stalls_leaves_an_order_for_elimination(monkeypatch):
    """Its own, which only keeps neighbours together, would fill the factors."""
    pytest.importorskip("pyamg")
    data, rows, cols, points = grid(40)
    b = np.random.default_rng(0).random(1600)
    want = sparse.Factor(data, rows, cols, 1600, points, "sparse")
    smooth = sparse.Factor(data, rows, cols, 1600, points, "iterative")
    assert smooth.info["backend"] == "amg" and (smooth.order != want.order).any()
    np.testing.assert_allclose(smooth.solve(b), want.solve(b), rtol=1e-10)
    monkeypatch.setattr(backends.Krylov, "most", 2)
    stalled = sparse.Factor(data, rows, cols, 1600, points, "iterative")
    for transpose in (False, True):
        np.testing.assert_allclose(stalled.solve(b, transpose), want.solve(b, transpose), rtol=1e-10)
    assert stalled.info["backend"] == "nested dissection"
    assert stalled.info["factor_entries"] < 1.2 * want.info["factor_entries"]


def test_stalled_iteration_falls_back(monkeypatch):
    data, rows, cols, points = grid(20)
    monkeypatch.setattr(backends.Krylov, "most", 2)
    info = {}
    x = solve(data, rows, cols, np.ones(400), n=400, points=points, solver="iterative", info=info)
    assert info["backend"] == "nested dissection" and "stalled" in info["messages"][0]
    np.testing.assert_allclose(full(data, rows, cols, 400) @ x, 1.0, atol=1e-12)


def test_poor_pivots_fall_back():
    """Small pivots kept on the diagonal for the order's sake: full pivoting must take over."""
    n = 400
    rng = np.random.default_rng(12)
    index, partner = np.arange(n), (np.arange(n) + 1) % n
    rows, cols = np.concatenate([index, index]), np.concatenate([index, partner])
    data = np.concatenate([np.full(n, 0.02), np.ones(n)])  # LU grows like 50^k without pivoting
    info, x = {}, rng.normal(size=n)
    b = full(data, rows, cols, n) @ x
    y = solve(data, rows, cols, b, n=n, points=rng.uniform(size=(n, 2)), info=info)
    np.testing.assert_allclose(y, x, atol=1e-9)
    assert info["residual"] < 1e-9


def test_wrong_answers_are_not_believed(monkeypatch):
    """A backend that answers nonsense is replaced, and the solution says so."""

    class Wrong(backends.SuperLU):
        def apply(self, b, transpose):
            return 1.5 * super().apply(b, transpose) + 0.1 * abs(b).max()

    monkeypatch.setitem(sparse.BACKENDS, "nested dissection", lambda matrix: Wrong(matrix, True))
    data, rows, cols, points = grid(20)
    info = {}
    x = solve(data, rows, cols, np.ones(400), n=400, points=points, info=info)
    assert info["backend"] == "colamd" and "colamd took over" in info["messages"][0]
    np.testing.assert_allclose(full(data, rows, cols, 400) @ x, 1.0, atol=1e-12)


def test_refinement_reaches_roundoff():
    """Multigrid alone stops at 1e-10; refined it is as good as LU."""
    data, rows, cols, points = grid(40)
    b = np.ones(1600)
    errors = {}
    for refine in (0, 1):
        info = {}
        solve(data, rows, cols, b, n=1600, points=points, solver="iterative", refine=refine, info=info)
        errors[refine] = info["residual"]
        assert info["backend"] == "amg"
    assert errors[1] < 1e-15 < errors[0]


def test_what_does_not_fit_in_memory_is_refused(monkeypatch):
    """By estimate, before the factors are allocated; iteration, which needs little, stays allowed."""
    import jsmitsm as js

    cloud = js.rectangle((0, 0), (1, 1), (25, 25), jitter=0.2)
    sides = {side: js.dirichlet(lambda x: x[0]) for side in ("left", "right", "bottom", "top")}
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), sides)
    js.solve(problem, cloud, solver="sparse")
    linsolve.clear_cache()
    monkeypatch.setattr(solver_choice, "_memory", lambda: 5e7)
    monkeypatch.setattr(solver_choice, "estimate_memory", lambda *_: 10**8)  # of the factors; the rows fit
    with pytest.raises(js.SolveError, match=r'about 0\.1 GB for 529 unknowns.*solver="iterative"'):
        js.solve(problem, cloud, solver="sparse")
    assert js.solve(problem, cloud, solver="iterative").converged
    monkeypatch.setattr(solver_choice, "_memory", lambda: 1e5)
    with pytest.raises(js.SolveError, match="the rows and the matrix would need about .* fewer particles"):
        js.solve(problem, cloud, solver="iterative")


def test_memory_estimate():
    """Within a factor of two of the measured factor (8 bytes an entry and the row numbers)."""
    data, rows, cols, points = grid(60)
    entries = factor(data, rows, cols, 3600, points, "sparse").info["factor_entries"]
    estimate = solver_choice.estimate_memory(3600, 5 * 3600, 2)
    assert 6 * entries < estimate < 40 * entries
    assert solver_choice.estimate_memory(10**5, 2 * 10**6, 2) < solver_choice.estimate_memory(10**5, 2 * 10**6, 3)


def test_jit_does_not_hang_on_one_core():
    """The host callback must not wait for JAX: with one core nobody would be left to answer."""
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("cores cannot be taken away here")
    code = """
import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax, numpy as np, jax.numpy as jnp
from jsmitsm.linear.linsolve import solve
n = 30000
i = np.arange(n)
run = jax.jit(jax.grad(lambda d: solve(d, i, i, jnp.sin(d), n=n, solver="sparse").sum()))
d = jnp.linspace(1.0, 2.0, n)
for _ in range(5):
    d = d + 0.001 * run(jnp.sort(d))
print(bool(jnp.isfinite(d).all()))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "True", done.stderr


def test_matrices_that_differ_in_their_entries_alone_share_the_places():
    """As an optimisation makes them: each is found again, and the places are compared once for all."""
    rows, cols, b = np.arange(5), np.arange(5), np.ones(5)
    several = [solve(np.full(5, scale), rows.copy(), cols.copy(), b, n=5, solver="sparse") for scale in (1.0, 2.0, 4.0)]
    solve(np.full(6, 1.0), np.arange(6), np.arange(6), np.ones(6), n=6, solver="sparse")
    assert len({id(factor_cache._known[f].pattern) for f in factor_cache._kept}) == 2
    before = factorisations()
    for scale, x in zip((1.0, 2.0, 4.0), several):
        assert np.array_equal(solve(np.full(5, scale), rows, cols, b, n=5, solver="sparse"), x)
        assert np.allclose(x, 1.0 / scale)
    assert factorisations() == before


def test_the_condition_of_a_saddle_knows_no_units():
    """A velocity, a pressure in units of ``unit``, and the multiplier of its mean, as ``Run`` puts them together."""
    found = []
    for unit in (1.0, 2.0**-30, 2.0**30):
        a = np.array([[3.0, unit, 0.0], [unit, 2.0 * unit**2, unit], [0.0, unit, 0.0]])
        r, c = np.nonzero(a)
        found.append(sparse.Factor(a[r, c], r, c, 3).condition())
    assert max(found) < 1.5 * min(found) < 50.0
