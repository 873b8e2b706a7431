"""Derivatives of a solve with respect to everything it was given, against central differences.

Central differences of fourth order: with a step of 5e-5 the truncation is below 1e-10 relative and
the rounding 1e-16 / 5e-5 times a condition number below 1e4, so an exact gradient agrees to below 1e-6.
Everything is smooth there: no particle sits near the edge of a support (asserted), and the
neighbour sets are held. Gradients are eager and by all numbers at once, on one line of order 3: that
and test_gradients_more.py make one set of programs for each method.
"""

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.linear import linsolve

STEP = 5e-5
BOUND = 1e-6
NAMES = (
    "h", "d", "wall", "source", "diffusion", "reaction", "flux", "robin_a", "robin_b", "robin_value", "points", "tilt"
)  # fmt: skip
IN_2D = ("flux", "tilt")  # a Neumann side, and the angle by which its normals are turned


def turned(cloud, t):
    """The cloud in the plane with the points of the dict, every normal turned by its angle."""
    inside = np.isnan(cloud.normals)
    c, s = jnp.cos(t["tilt"]), jnp.sin(t["tilt"])
    normals = np.where(inside, 0.0, cloud.normals) @ jnp.array([[c, s], [-s, c]])
    return cloud.replace(points=t["points"], normals=jnp.where(inside, jnp.nan, normals))


class Case:
    """A problem of variable coefficients on one cloud, every number of it in one dict."""

    def __init__(self, dim, n, order, reach):
        self.dim, self.order = dim, order
        # On a line the deeper recursion is exact to so many digits that the kernel hardly matters.
        self.depth = 0 if dim == 1 else "auto"
        self.names = [name for name in NAMES if dim > 1 or name not in IN_2D]
        self.cloud = mm.jittered(dim, n, jitter=0.2)
        self.stencils = js.stencils(self.cloud, radius=1.05 * reach / (n - 1))
        groups = self.cloud.groups
        x = self.cloud.points
        wall = "bottom" if dim > 1 else "right"
        self.weights = np.cos(3.0 * x.sum(axis=1)) + 0.5
        self.theta = {
            "h": reach / 3.0 / (n - 1), "d": 3.0, "wall": np.sin(1.0 + x[groups[wall]].sum(axis=1)),
            "source": 2.0, "diffusion": 0.4, "reaction": 1.5, "flux": 0.7,
            "robin_a": 2.0, "robin_b": 0.5, "robin_value": 0.3, "points": x, "tilt": 0.0,
        }  # fmt: skip

    def problem(self, t):
        def pde(u, x, p):
            a = lambda y: 1.0 + p["diffusion"] * jnp.sin(y[0])
            flux = lambda y: a(y) * js.grad(u)(y)
            return js.divergence(flux)(x) - p["reaction"] * u(x) - p["source"] * jnp.exp(x[0]) * jnp.cos(x[-1])

        robin = js.robin(t["robin_a"], t["robin_b"], t["robin_value"])
        if self.dim == 1:
            bcs = {"left": robin, "right": js.dirichlet(t["wall"])}
        else:
            slope = js.neumann(lambda x, p: p["flux"] * jnp.cos(x[1]))
            bcs = {"left": slope, "right": robin, "bottom": js.dirichlet(t["wall"]), "top": js.dirichlet(0.5)}
        return js.Problem(pde, bcs, params={k: t[k] for k in ("source", "diffusion", "reaction", "flux")})

    def moved(self, t):
        """The cloud with the points of the dict, every normal turned by its angle."""
        return turned(self.cloud, t) if self.dim > 1 else self.cloud.replace(points=t["points"])

    def solution(self, t, method="S", solver="dense", problem=None, order=None):
        return js.solve(
            problem or self.problem(t), self.moved(t), method=method, order=order or self.order,
            kernel=js.SuperGaussian(h=t["h"], d=t["d"]), stencils=self.stencils, solver=solver, depth=self.depth,
        )  # fmt: skip

    def u(self, t, method, solver):
        return self.solution(t, method, solver).u

    def objective(self, t, method="S", solver="dense"):
        return jnp.sum(self.weights * self.u(t, method, solver) ** 2)

    def direction(self, name):
        """A tangent that moves one entry of the dict only."""
        rng = np.random.default_rng(7)
        moved = rng.uniform(-1, 1, np.shape(self.theta[name]))
        return {k: moved if k == name else np.zeros(np.shape(v)) for k, v in self.theta.items()}


@pytest.fixture(scope="module")
def line():
    return Case(1, 9, 3, 3.6)


@pytest.fixture(scope="module")
def plane():
    return Case(2, 6, 2, 3.3)


def along(tree, direction):
    return float(sum(np.sum(np.asarray(a) * b) for a, b in zip(jax.tree.leaves(tree), jax.tree.leaves(direction))))


def difference(function, t, direction):
    def slope(step):
        ahead = jax.tree.map(lambda x, v: x + step * v, t, direction)
        back = jax.tree.map(lambda x, v: x - step * v, t, direction)
        return (float(function(ahead)) - float(function(back))) / (2 * step)

    return (4 * slope(STEP) - slope(2 * STEP)) / 3


def test_no_particle_sits_near_the_edge_of_a_support(line, plane):
    """Otherwise a difference would compare two neighbour sets, and prove nothing."""
    for case in (line, plane):
        x = case.cloud.points
        apart = np.linalg.norm(x[:, None] - x[None], axis=2)
        assert np.abs(apart - case.theta["h"] * case.theta["d"]).min() > 8 * STEP


def check_every_derivative(case, method, solver):
    f = lambda t: case.objective(t, method, solver)
    gradient = jax.grad(f)(case.theta)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradient))
    for name in case.names:
        direction = case.direction(name)
        exact, measured = along(gradient, direction), difference(f, case.theta, direction)
        assert abs(exact - measured) <= BOUND * max(abs(measured), 1e-2), name
        assert abs(measured) > 1e-7, f"{name} does not move the objective: nothing was tested"


@pytest.mark.parametrize("method, solver", [("S", "sparse"), ("SSPH", "dense")])
def test_every_derivative_in_1d(line, method, solver):
    """The other methods are below, with all outputs at once."""
    check_every_derivative(line, method, solver)


def test_every_derivative_in_2d(plane):
    """With a Neumann side besides; one method, for the formulas of the others are the same in 1D."""
    check_every_derivative(plane, "S", "sparse")


def test_dense_and_sparse_gradients_agree(line):
    """The same adjoint by two factorisations: round-off times a condition number below 1e3."""
    dense, sparse = (jax.grad(line.objective)(line.theta, "S", solver) for solver in ("dense", "sparse"))
    for name in line.names:
        scale = np.abs(dense[name]).max()
        assert np.abs(np.asarray(dense[name]) - np.asarray(sparse[name])).max() < 1e-10 * scale, name


def test_forward_mode_agrees_with_reverse_mode(line):
    some = {name: line.theta[name] for name in ("points", "wall")}
    forward = jax.jacfwd(lambda t: line.objective({**line.theta, **t}))(some)
    reverse = jax.grad(line.objective)(line.theta)
    for name in some:
        there = reverse[name]
        assert np.allclose(forward[name], there, rtol=1e-9, atol=1e-9 * np.abs(there).max()), name


def test_one_smoothing_length_per_particle(line):
    """The gradient with respect to h_i, one difference for each particle; their sum is dJ/dh."""
    n = len(line.cloud)
    f = lambda h: line.objective({**line.theta, "h": h})
    each = np.asarray(jax.grad(line.objective)({**line.theta, "h": jnp.full(n, line.theta["h"])})["h"])
    alone = float(jax.grad(line.objective)(line.theta)["h"])
    assert each.sum() == pytest.approx(alone, rel=1e-9)
    for i in (1, n // 2, 0):
        measured = difference(f, np.full(n, line.theta["h"]), np.eye(n)[i])
        assert each[i] == pytest.approx(measured, rel=BOUND, abs=BOUND * abs(alone))


@pytest.mark.parametrize("solver", ["dense", "auto"])
def test_jit_returns_the_same(line, solver):
    f = lambda t: line.u(t, "S", solver)
    assert np.allclose(mm.quickly(f)(line.theta), f(line.theta), rtol=0, atol=1e-11)


def test_vmap_over_numbers_returns_the_same(line):
    """A batch of source strengths and boundary values against one solve after the other."""
    strength, wall = np.array([0.5, 1.0, 2.0]), np.array([[0.1], [0.2], [-0.3]])
    f = lambda s, w: line.u({**line.theta, "source": s, "wall": w}, "S", "dense")
    batch = jax.vmap(f)(strength, wall)
    assert batch.shape == (3, len(line.cloud))
    for k in range(3):
        assert np.allclose(batch[k], f(strength[k], wall[k]), rtol=0, atol=1e-11)


def test_vmap_over_smoothing_lengths_returns_the_same(line):
    h = line.theta["h"] * np.array([0.95, 1.0])
    f = lambda h: line.u({**line.theta, "h": h}, "S", "dense")
    batch = jax.vmap(f)(h)
    for k in range(2):
        assert np.allclose(batch[k], f(h[k]), rtol=0, atol=1e-11)
    assert np.abs(batch[0] - batch[1]).max() > 1e-9, "h does not matter: nothing was tested"


def test_values_that_the_pde_closes_over(line):
    """A traced number that reaches the residual by closure, not through ``params``."""

    def f(k):
        problem = js.Problem(
            lambda u, x: js.laplacian(u)(x) - k * jnp.sin(x[0]) * u(x) - k**2,
            {"left": js.dirichlet(k), "right": js.neumann(lambda x: k * x[0])},
        )
        sol = js.solve(problem, line.cloud, order=2, stencils=line.stencils,
                       kernel=js.SuperGaussian(line.theta["h"], 3.0), solver="dense", depth=0)  # fmt: skip
        return jnp.sum(line.weights * sol.u**2)

    assert float(jax.grad(f)(1.3)) == pytest.approx(difference(f, 1.3, 1.0), rel=BOUND)


def test_values_that_a_profile_closes_over(line):
    """As what it is given in ``params``, whether other numbers are traced or not."""
    pde = lambda u, x: js.laplacian(u)(x) - (1.0 + x[0]) * u(x) - jnp.exp(x[0])
    problem = js.Problem(pde, {"left": js.dirichlet(0.3), "right": js.dirichlet(1.0)})

    def f(t, kernel):
        sol = js.solve(problem, line.cloud, method="SSPH", order=2, kernel=kernel(t), stencils=line.stencils)
        return jnp.sum(line.weights * sol.u**2)

    closed = lambda t: js.Kernel(lambda r: jnp.exp(-t["decay"] * r**2), t["h"], 3.0)
    given = lambda t: js.Kernel(lambda r, a: jnp.exp(-a * r**2), t["h"], 3.0, t["decay"])
    numbers = {"decay": 1.1, "h": line.theta["h"]}
    expected = jax.grad(f)(numbers, given)
    both = mm.quickly(jax.grad(lambda t: f(t, closed)))(numbers)
    alone = jax.grad(lambda a: f({**numbers, "decay": a}, closed))(1.1)
    for found, name in (both["decay"], "decay"), (both["h"], "h"), (alone, "decay"):
        assert float(found) == pytest.approx(float(expected[name]), rel=1e-9)


# ------------------------------------------------------------------ every output of a solution

PLACES = np.array([[0.21], [0.68]])
# Sums with weights, so that no entry hides another; the estimate smoothed where |x| has its kink.
OUTPUTS = {
    "values": lambda case, sol: jnp.sum(case.weights * sol.u**2),
    "coefficients": lambda case, sol: jnp.sum(case.weights[:, None] * jnp.sin(sol.coefficients[:, 1:3])),
    "values between particles": lambda case, sol: jnp.sum(sol(PLACES) * np.array([1.0, 0.7])),
    "gradient between particles": lambda case, sol: jnp.sum(sol.grad(PLACES) * np.array([[1.0], [0.7]])),
    "error estimate": lambda case, sol: 1e3 * jnp.sum(case.weights**2 * sol.error_estimate() ** 2),
}


def bent(t):
    """u'' + u' = s (1 + q u^2) exp(x), of the derivatives of Case.problem and so of its programs."""
    def pde(u, x, p):
        force = p["source"] * jnp.exp(x[0]) * (1.0 + p["reaction"] * u(x) ** 2 / 4)
        return js.laplacian(u)(x) + js.grad(u)(x)[0] - force

    params = {k: t[k] for k in ("source", "reaction")}
    return js.Problem(pde, {"left": js.dirichlet(0.3), "right": js.dirichlet(t["wall"])}, params=params)


BENT = ("h", "d", "wall", "source", "reaction", "points")  # with a Robin side: test_gradients_more.py


@pytest.mark.parametrize("problem, solver", [(None, "dense"), (bent, "sparse")])
def test_every_output_with_respect_to_everything(line, problem, solver):
    """All outputs at once: the Jacobian in reverse mode, its columns against differences."""
    def outputs(t):
        sol = line.solution(t, "S", solver, problem and problem(t))
        return jnp.stack([make(line, sol) for make in OUTPUTS.values()])

    values, pull = jax.vjp(outputs, line.theta)
    rows = [pull(unit)[0] for unit in np.eye(len(values))]
    for name in line.names if problem is None else BENT:
        direction = line.direction(name)
        measured = vector_difference(outputs, line.theta, direction)
        for row, output, there in zip(rows, OUTPUTS, measured):
            assert along(row, direction) == pytest.approx(there, rel=BOUND, abs=10 * BOUND), (output, name)
        assert np.abs(measured).min() > 0, f"{name} moves nothing: nothing was tested"


# The error estimate is the same code for every method, and tested above. Rows of I and II reach the neighbours'
# neighbours, which is dear at order 3.
@pytest.mark.parametrize("method, form", [("I", "loo"), ("II", "loo"), ("III", "loo"), ("SSPH", "loo"), ("S", "lsq")])
def test_the_other_methods_and_forms_with_respect_to_everything(line, method, form):
    order = 2 if method in ("I", "II", "III") else 3

    def outputs(t):
        sol = js.solve(
            line.problem(t), line.moved(t), method=method, order=order, formulation=form, solver="dense",
            kernel=js.SuperGaussian(h=t["h"], d=t["d"]), stencils=line.stencils, depth=line.depth,
        )  # fmt: skip
        return jnp.stack([make(line, sol) for name, make in OUTPUTS.items() if name != "error estimate"])

    check_jacobian(outputs, line.theta, line.names)


def check_jacobian(outputs, theta, names):
    """The gradient of a sum of all outputs, each of size one, along a direction of every name."""
    sizes = np.abs(np.asarray(outputs(theta)))
    weights = np.random.default_rng(8).uniform(0.5, 1.5, len(sizes)) / sizes
    total = lambda t: weights @ outputs(t)
    gradient = jax.grad(total)(theta)
    rng = np.random.default_rng(7)
    for name in names:
        moved = rng.uniform(-1, 1, np.shape(theta[name]))
        direction = {k: moved if k == name else np.zeros(np.shape(v)) for k, v in theta.items()}
        measured = difference(total, theta, direction)
        assert abs(np.sum(np.asarray(gradient[name]) * moved) - measured) <= BOUND * max(abs(measured), 1.0), name
        assert abs(measured) > 1e-6, f"{name} moves nothing: nothing was tested"


def pair(t):
    """Two coupled fields: a value of one and the slope of the other on the right, a condition for both on the left."""

    def pde(u, x, p):
        one = js.laplacian(u[0])(x) - p["reaction"] * u[1](x) - p["source"] * jnp.cos(x[0])
        return jnp.stack([one, js.laplacian(u[1])(x) + p["diffusion"] * js.grad(u[0])(x)[0] - x[0]])

    right = [js.dirichlet(t["wall"], field=0), js.neumann(t["flux"], field=1)]
    bcs = {"left": js.robin(t["robin_a"], t["robin_b"], t["robin_value"]), "right": right}
    return js.Problem(pde, bcs, fields=2, params={k: t[k] for k in ("source", "diffusion", "reaction")})


@pytest.mark.parametrize("method", ["S", "SSPH"])
def test_two_fields_with_respect_to_everything(line, method):
    def outputs(t):
        sol = line.solution(t, method, "dense", pair(t), order=2)
        return jnp.stack([
            jnp.sum(line.weights[:, None] * sol.u**2), jnp.sum(sol(PLACES) ** 2), jnp.sum(sol.grad(PLACES) ** 2),
            jnp.sum(jnp.sin(line.weights[:, None, None] * sol.coefficients[:, 1:3])),
        ])  # fmt: skip

    check_jacobian(outputs, line.theta, [*line.names, "flux"])


TRANSFORMS = {
    "vmap over a source": lambda f, t: jax.vmap(lambda x: f({**t, "source": x}))(jnp.array([1.0, 2.0])),
    "vmap over kernels": lambda f, t: jax.vmap(lambda x: f({**t, "h": x * t["h"]}))(jnp.array([1.0, 0.98])),
    "vmap over clouds": lambda f, t: jax.vmap(lambda x: f({**t, "points": x * t["points"]}))(jnp.array([1.0, 0.99])),
    "jvp": lambda f, t: jax.jvp(lambda x: f({**t, "robin_a": x}), (t["robin_a"],), (1.0,))[1],
    "jacfwd": lambda f, t: jax.jacfwd(lambda x: f({**t, "wall": x}))(t["wall"]),
    "vmap of grad": lambda f, t: jax.vmap(jax.grad(lambda x: f({**t, "source": x})[2]))(jnp.array([1.0, 2.0])),
    "grad of grad": lambda f, t: jax.grad(jax.grad(lambda x: f({**t, "source": x})[2] ** 2))(2.0),
    "jit of vmap": lambda f, t: mm.quickly(jax.vmap(lambda x: f({**t, "source": x})))(jnp.array([1.0, 2.0])),
}


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_the_sparse_solvers_follow_every_transform(line, transform):
    """As the dense solver does, which is plain JAX; the condition number is below 1e3."""
    apply = TRANSFORMS[transform]
    dense = apply(lambda t: line.u(t, "S", "dense"), line.theta)
    for solver in ("sparse", "iterative"):
        other = apply(lambda t, s=solver: line.u(t, "S", s), line.theta)
        assert np.allclose(other, dense, rtol=1e-8, atol=1e-8 * np.abs(dense).max()), solver


def test_a_factorization_follows_transforms_of_the_right_hand_side(line):
    """One factorisation serves values, gradients and maps; a traced operator is set up anew."""
    def problem(source, wall, reaction=1.0):
        pde = lambda u, x, p: js.laplacian(u)(x) - p[1] * u(x) - p[0] * jnp.exp(x[0])
        return js.Problem(pde, {"left": js.dirichlet(wall), "right": js.neumann(0.3)}, params=(source, reaction))

    ready = js.factorize(problem(1.0, 0.0), line.cloud, order=2, depth=0)
    u = lambda *numbers: ready.solve(problem(*numbers)).u
    before = linsolve.factorisations()
    slopes = jax.grad(lambda s, w: jnp.sum(u(s, w)), (0, 1))(2.0, 0.4)
    assert slopes[0] == pytest.approx(np.sum(u(3.0, 0.4)) - np.sum(u(2.0, 0.4)), rel=1e-9)  # linear in both
    assert slopes[1] == pytest.approx(np.sum(u(2.0, 1.4)) - np.sum(u(2.0, 0.4)), rel=1e-9)
    for mapped in (jax.vmap(lambda s: u(s, 0.0)), mm.quickly(jax.vmap(lambda s: u(s, 0.0)))):
        assert np.allclose(mapped(jnp.array([1.0, 2.0]))[1], u(2.0, 0.0), rtol=0, atol=1e-11)
    assert linsolve.factorisations() <= before + 1
    total = lambda k: float(jnp.sum(u(1.0, 0.0, k)))
    assert jax.grad(lambda k: jnp.sum(u(1.0, 0.0, k)))(1.2) == pytest.approx(difference(total, 1.2, 1.0), rel=BOUND)


def test_an_error_estimate_is_mapped_and_refuses_abstract_points(line):
    """Over parameters it is what it is alone; where the points are abstract it says what cannot be, and what to do."""
    def estimate(source, scale=1.0):
        t = {**line.theta, "source": source, "points": scale * line.theta["points"]}
        return line.solution(t).error_estimate()

    batch = jax.vmap(estimate)(jnp.array([1.0, 2.0]))
    for k in range(2):
        assert np.allclose(batch[k], estimate(k + 1.0), rtol=1e-7, atol=1e-12)
    with pytest.raises(ValueError, match="the points are traced by a JAX transform.*ask for it outside"):
        jax.jit(estimate)(1.0, 1.0)


def vector_difference(function, t, direction):
    at = lambda step: np.asarray(function(jax.tree.map(lambda x, v: x + step * v, t, direction)))
    return (8 * (at(STEP) - at(-STEP)) - (at(2 * STEP) - at(-2 * STEP))) / (12 * STEP)


def test_gradient_through_evaluation_between_particles(line):
    """d/dk of sol(points) and of sol.grad(points) by a deeper recursion: local polynomials carry derivatives too."""

    def f(s):
        t = {**line.theta, "source": s}
        sol = js.solve(line.problem(t), line.cloud, order=2, stencils=line.stencils,
                       kernel=js.SuperGaussian(t["h"], t["d"]), solver="dense")  # fmt: skip
        return jnp.sum(sol(PLACES)) + 0.1 * jnp.sum(sol.grad(PLACES))

    assert float(jax.grad(f)(2.0)) == pytest.approx(difference(f, 2.0, 1.0), rel=BOUND)


@pytest.mark.parametrize(
    "at", [(0.4, 0.55), (0.5, 0.5), (0.375, 0.375)], ids=["anywhere", "a particle", "as far from four"]
)
def test_a_blended_value_has_a_slope_everywhere(at):
    """Against central differences where the weights are smooth; finite, and the same under jit, at every point."""
    lattice = js.rectangle((0, 0), (1, 1), (5, 5))
    sides = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, sides), lattice, order=2, depth=0)
    value = lambda x: sol(x[None], blend=True)[0]
    at, slope = jnp.array(at), jax.grad(value)(jnp.array(at))
    assert jnp.isfinite(slope).all()
    assert abs(jax.jit(value)(at) - value(np.asarray(at))) < 1e-12
    if at[0] == 0.4:
        steps = 1e-5 * np.eye(2)
        differences = [(value(at + s) - value(at - s)) / 2e-5 for s in steps]
        assert np.allclose(slope, differences, atol=1e-7)
