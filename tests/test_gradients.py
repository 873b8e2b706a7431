"""Derivatives of a solve with respect to everything it was given, against central differences.

Central differences of fourth order: with a step of 5e-5 the truncation is below 1e-10 relative and
the rounding 1e-16 / 5e-5 times a condition number below 1e4, so an exact gradient agrees to below 1e-6.
Everything is smooth there: no particle sits near the edge of a support (asserted), and the
neighbour sets are held. Gradients are eager and by all numbers at once, on one line of order 3: that
makes one set of programs for each method, which is what these tests cost.
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
    "h", "d", "wall", "source", "diffusion", "reaction", "robin_a", "robin_b", "robin_value", "points"
)  # fmt: skip
ROBIN = ("robin_a", "robin_b", "robin_value")


class Case:
    """A problem of variable coefficients on a line, every number of it in one dict."""

    def __init__(self, n, order, reach):
        self.order = order
        # On a line the deeper recursion is exact to so many digits that the kernel hardly matters.
        self.depth = 0
        self.cloud = mm.jittered(1, n, jitter=0.2)
        self.stencils = js.stencils(self.cloud, radius=1.05 * reach / (n - 1))
        x = self.cloud.points
        self.weights = np.cos(3.0 * x.sum(axis=1)) + 0.5
        self.theta = {
            "h": reach / 3.0 / (n - 1), "d": 3.0, "wall": np.sin(1.0 + x[self.cloud.groups["right"]].sum(axis=1)),
            "source": 2.0, "diffusion": 0.4, "reaction": 1.5, "flux": 0.7,
            "robin_a": 2.0, "robin_b": 0.5, "robin_value": 0.3, "points": x,
        }  # fmt: skip
        self.each = self.theta | {"h": np.full(n, self.theta["h"])}  # a smoothing length for each particle

    def problem(self, t):
        def pde(u, x, p):
            a = lambda y: 1.0 + p["diffusion"] * jnp.sin(y[0])
            flux = lambda y: a(y) * js.grad(u)(y)
            return js.divergence(flux)(x) - p["reaction"] * u(x) - p["source"] * jnp.exp(x[0]) * jnp.cos(x[-1])

        bcs = {"left": js.robin(*(t[name] for name in ROBIN)), "right": js.dirichlet(t["wall"])}
        return js.Problem(pde, bcs, params={k: t[k] for k in ("source", "diffusion", "reaction")})

    def moved(self, t):
        return self.cloud.replace(points=t["points"])

    def solution(self, t, method="S", solver="dense", problem=None, order=None, form="auto"):
        return js.solve(
            problem or self.problem(t), self.moved(t), method=method, order=order or self.order, formulation=form,
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
    return Case(9, 3, 3.6)


def along(tree, direction):
    return float(sum(np.sum(np.asarray(a) * b) for a, b in zip(jax.tree.leaves(tree), jax.tree.leaves(direction))))


def difference(function, t, direction):
    def slope(step):
        ahead = jax.tree.map(lambda x, v: x + step * v, t, direction)
        back = jax.tree.map(lambda x, v: x - step * v, t, direction)
        return (float(function(ahead)) - float(function(back))) / (2 * step)

    return (4 * slope(STEP) - slope(2 * STEP)) / 3


def test_no_particle_sits_near_the_edge_of_a_support(line):
    """Otherwise a difference would compare two neighbour sets, and prove nothing."""
    x = line.cloud.points
    apart = np.linalg.norm(x[:, None] - x[None], axis=2)
    assert np.abs(apart - line.theta["h"] * line.theta["d"]).min() > 8 * STEP


def test_dense_and_sparse_gradients_agree(line):
    """The same adjoint by two factorisations: round-off times a condition number below 1e3."""
    dense, sparse = (jax.grad(line.objective)(line.theta, "S", solver) for solver in ("dense", "sparse"))
    for name in NAMES:
        scale = np.abs(dense[name]).max()
        assert np.abs(np.asarray(dense[name]) - np.asarray(sparse[name])).max() < 1e-10 * scale, name


def test_forward_mode_agrees_with_reverse_mode(line):
    f = lambda t: line.objective(t, "S", "sparse")
    reverse = jax.grad(f)(line.theta)
    for name in NAMES:
        direction = line.direction(name)
        forward, there = jax.jvp(f, (line.theta,), (direction,))[1], along(reverse, direction)
        assert abs(there) > 1e-7 and float(forward) == pytest.approx(there, rel=1e-9), name


def test_jit_returns_the_same(line):
    """By the sparse solver; the dense one and a map besides are below."""
    f = lambda t: line.u(t, "S", "auto")
    assert np.allclose(mm.quickly(f)(line.theta), f(line.theta), rtol=0, atol=1e-11)


def fixed(line):
    """What is solved at order 2, on the line as it stands."""
    kernel = js.SuperGaussian(line.theta["h"], 3.0)
    return {"cloud": line.cloud, "order": 2, "stencils": line.stencils, "kernel": kernel, "solver": "dense", "depth": 0}


def test_values_that_the_pde_closes_over(line):
    """A traced number that reaches the residual by closure, not through ``params``."""

    def f(k):
        problem = js.Problem(
            lambda u, x: js.laplacian(u)(x) - k * jnp.sin(x[0]) * u(x) - k**2,
            {"left": js.dirichlet(k), "right": js.neumann(lambda x: k * x[0])},
        )
        return jnp.sum(line.weights * js.solve(problem, **fixed(line)).u ** 2)

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


def held(t):
    """Values at both ends: one class of particles, and so half the programs to compile."""
    return {"left": js.dirichlet(0.3), "right": js.dirichlet(t["wall"])}


def open_to_the_left(t):
    return held(t) | {"left": js.robin(*(t[name] for name in ROBIN))}


def bent(t, ends=held):
    """u'' + u' = s (1 + q u^2) exp(x), of the derivatives of Case.problem and so of its programs."""
    def pde(u, x, p):
        force = p["source"] * jnp.exp(x[0]) * (1.0 + p["reaction"] * u(x) ** 2 / 4)
        return js.laplacian(u)(x) + js.grad(u)(x)[0] - force

    return js.Problem(pde, ends(t), params={k: t[k] for k in ("source", "reaction")})


BENT = ("h", "d", "wall", "source", "reaction", "points")


@pytest.mark.parametrize("problem, solver", [(None, "dense"), (bent, "sparse")])
def test_every_output_with_respect_to_everything(line, problem, solver):
    """All outputs at once: the Jacobian in reverse mode, its columns against differences."""
    def outputs(t):
        sol = line.solution(t, "S", solver, problem and problem(t))
        return jnp.stack([make(line, sol) for make in OUTPUTS.values()])

    values, pull = jax.vjp(outputs, line.theta)
    rows = [pull(unit)[0] for unit in np.eye(len(values))]
    for name in NAMES if problem is None else BENT:
        direction = line.direction(name)
        measured = vector_difference(outputs, line.theta, direction)
        for row, output, there in zip(rows, OUTPUTS, measured):
            assert along(row, direction) == pytest.approx(there, rel=BOUND, abs=10 * BOUND), (output, name)
        assert np.abs(measured).min() > 0, f"{name} moves nothing: nothing was tested"


# The evaluation is the same code for every method, and so are the coefficients but for SSPH and III; of I and of the
# least-squares form is what is nonlinear, below.
@pytest.mark.parametrize("method, order", [("II", 2), ("III", 2), ("SSPH", 3)])
def test_the_other_methods_with_respect_to_everything(line, method, order):
    """SSPH by every particle's smoothing length."""
    wanted = ["values"] if method == "II" else ["values", "coefficients"]

    def outputs(t):
        sol = line.solution(t, method, order=order)
        return jnp.stack([OUTPUTS[name](line, sol) for name in wanted])

    check_jacobian(outputs, line.each if method == "SSPH" else line.theta, NAMES)


def check_jacobian(outputs, theta, names):
    """The gradient of a sum of all outputs, each of size one, along a direction of every name."""
    sizes = np.abs(np.asarray(outputs(theta)))
    weights = np.random.default_rng(8).uniform(0.5, 1.5, len(sizes)) / sizes
    total = lambda t: weights @ outputs(t)
    for name, exact, measured in both_ways(total, theta, names):
        assert abs(exact - measured) <= BOUND * max(abs(measured), 1.0), name
        assert abs(measured) > 1e-6, f"{name} moves nothing: nothing was tested"


def both_ways(f, theta, names):
    """One eager gradient by everything, along a direction of every name, beside differences."""
    gradient = jax.grad(f)(theta)
    rng = np.random.default_rng(7)
    for name in names:
        moved = rng.uniform(-1, 1, np.shape(theta[name]))
        direction = {k: moved if k == name else np.zeros(np.shape(v)) for k, v in theta.items()}
        yield name, float(np.sum(np.asarray(gradient[name]) * moved)), difference(f, theta, direction)


def check(f, theta, names):
    """A number f of everything, to a part of its own size."""
    size = abs(float(f(theta)))
    for name, exact, measured in both_ways(f, theta, names):
        assert abs(exact - measured) <= BOUND * max(abs(measured), size), name
        assert abs(measured) > 100 * BOUND * size, f"{name} moves next to nothing: nothing was tested"


def away(case, values):
    """Weighted squares, so that no entry hides another."""
    return jnp.sum(case.weights.reshape(-1, *[1] * (values.ndim - 1)) * values**2)


@pytest.mark.parametrize("method, order, form, ends", [
    ("I", 2, "loo", held), ("III", 2, "loo", held), ("SSPH", 3, "auto", open_to_the_left),
    ("S", 3, "lsq", open_to_the_left),
])  # fmt: skip
def test_newtons_method_by_every_method(line, method, order, form, ends):
    f = lambda t: away(line, line.solution(t, method, "auto", bent(t, ends), order, form).u)
    names = ("h", "source", "wall") if ends is held else ("h", "source", "wall", "points", *ROBIN)
    check(f, line.each if method == "SSPH" else line.theta, names)


@pytest.mark.parametrize("method, order, form", [("II", 2, "loo"), ("S", 3, "lsq")])
def test_error_estimates_of_other_methods(line, method, order, form):
    """Of a linear problem; its derivative is that of the values as well."""
    def straight(t):
        pde = lambda u, x, p: js.laplacian(u)(x) + js.grad(u)(x)[0] - (1.0 + x[0]) * u(x) - p * jnp.exp(x[0])
        return js.Problem(pde, held(t), params=t["source"])

    f = lambda t: away(line, line.solution(t, method, "auto", straight(t), order, form).error_estimate())
    check(f, line.theta, ("h", "wall"))


def pair(t, product):
    """Two fields that reach each other, and multiply each other where ``product`` is not zero: a value of one and
    the slope of the other at both ends."""

    def pde(u, x, p):
        one = js.laplacian(u[0])(x) - p["reaction"] * (u[1](x) + product * u[0](x) * u[1](x))
        force = p["source"] * jnp.cos(x[0])
        return jnp.stack([one - force, js.laplacian(u[1])(x) + p["diffusion"] * js.grad(u[0])(x)[0] - x[0]])

    slope = [js.robin(t["robin_a"], t["robin_b"], t[value], field=1) for value in ("robin_value", "flux")]
    values = [js.dirichlet(value, field=0) for value in (0.3, t["wall"])]
    bcs = dict(zip(("left", "right"), map(list, zip(values, slope))))
    return js.Problem(pde, bcs, fields=2, params={k: t[k] for k in ("source", "diffusion", "reaction")})


@pytest.mark.parametrize("method, product", [("S", 0.5), ("SSPH", 0.0)])
def test_two_fields_with_respect_to_everything(line, method, product):
    """Nonlinear by method S, every output; linear by SSPH, the values."""
    def outputs(t):
        sol = line.solution(t, method, "dense", pair(t, product), order=2)
        values = [away(line, sol.u)]
        if method == "S":
            values += [jnp.sum(sol(PLACES) ** 2), jnp.sum(sol.grad(PLACES) ** 2)]
            values += [jnp.sum(jnp.sin(line.weights[:, None, None] * sol.coefficients[:, 1:3]))]
        return jnp.stack(values)

    check_jacobian(outputs, line.theta, [*NAMES, "flux"])


def test_the_error_estimate_of_a_system(line):
    """Linear, and by method S: its derivative is that of the values as well."""
    def linked(t):
        def pde(u, x, p):
            one = js.laplacian(u[0])(x) - u[1](x) - p
            return jnp.stack([one, js.laplacian(u[1])(x) + js.grad(u[0])(x)[0] - x[0]])

        return js.Problem(pde, held(t) | {"right": js.dirichlet(t["wall"][0])}, fields=2, params=t["source"])

    f = lambda t: away(line, line.solution(t, "S", "auto", linked(t), order=2).error_estimate())
    check(f, line.theta, ("h", "wall"))


def turned(cloud, t):
    """The cloud in the plane with the points of the dict, every normal turned by its angle."""
    inside = np.isnan(cloud.normals)
    c, s = jnp.cos(t["tilt"]), jnp.sin(t["tilt"])
    normals = np.where(inside, 0.0, cloud.normals) @ jnp.array([[c, s], [-s, c]])
    return cloud.replace(points=t["points"], normals=jnp.where(inside, jnp.nan, normals))


def elastic(t):
    """An elastic square that slips along its left side, is pulled at its right one, and held below."""

    def pde(u, x, p):
        stress = lambda y: js.grad(u)(y) + js.grad(u)(y).T + p * jnp.trace(js.grad(u)(y)) * jnp.eye(2)
        return js.divergence(stress)(x) + jnp.array([0.0, 1.0])

    def traction(u, x, n, p):
        stress = js.grad(u)(x) + js.grad(u)(x).T + p * jnp.trace(js.grad(u)(x)) * jnp.eye(2)
        return stress @ n - jnp.array([0.3, 0.1 * x[1]])

    def slip(u, x, n, p):
        tangent = jnp.array([-n[1], n[0]])
        return jnp.stack([u(x) @ n - 0.1, tangent @ (js.grad(u)(x) + js.grad(u)(x).T) @ n])

    bcs = {"left": js.condition(slip), "right": js.condition(traction)}
    bcs |= {"bottom": js.dirichlet(0.0), "top": js.dirichlet(0.2)}
    return js.Problem(pde, bcs, fields=2, params=t["modulus"])


def test_traction_and_slip_with_respect_to_normals():
    """In the plane; the angle turns every normal."""
    cloud = mm.jittered(2, 5, jitter=0.2)
    near = js.stencils(cloud, size=14)
    theta = {"h": 0.3, "modulus": 1.3, "points": cloud.points, "tilt": 0.0}
    weights = np.cos(3.0 * cloud.points.sum(axis=1))[:, None] + 0.5

    def f(t):
        kernel = js.Gaussian(h=t["h"], d=10.0)
        sol = js.solve(elastic(t), turned(cloud, t), order=2, kernel=kernel, stencils=near, depth=0, solver="sparse")
        return jnp.sum(weights * sol.u**2)

    check(f, theta, ("h", "modulus", "points", "tilt"))


# ------------------------------------------------------------------ transforms

BATCHES = {
    "numbers": lambda t: {"source": jnp.array([0.5, 2.0]), "wall": jnp.array([[0.1], [-0.3]])},
    "kernels": lambda t: {"h": t["h"] * jnp.array([0.95, 1.0])},
    "clouds": lambda t: {"points": t["points"] * jnp.array([1.0, 0.99])[:, None, None]},
}
SOLVERS = ("dense", "sparse", "iterative")


@pytest.mark.parametrize("over", BATCHES)
def test_vmap_returns_the_same(line, over):
    """As one solve after the other by the dense solver, which is plain JAX; the condition number is below 1e3."""
    batch = BATCHES[over](line.theta)
    alone = [line.u({**line.theta, **{k: v[i] for k, v in batch.items()}}, "S", "dense") for i in range(2)]
    assert np.abs(alone[0] - alone[1]).max() > 1e-9, "it does not matter: nothing was tested"
    for solver in SOLVERS:
        found = jax.vmap(lambda b, s=solver: line.u({**line.theta, **b}, "S", s))(batch)
        within = 1e-11 if solver == "dense" else 1e-8 * np.abs(alone).max()
        assert np.allclose(found, alone, rtol=1e-8 * (solver != "dense"), atol=within), solver


TRANSFORMS = {
    "jacfwd": lambda f, t: jax.jacfwd(lambda x: f({**t, "wall": x}))(t["wall"]),
    "vmap of grad": lambda f, t: jax.vmap(jax.grad(lambda x: f({**t, "source": x})[2]))(jnp.array([1.0, 2.0])),
    "grad of grad": lambda f, t: jax.grad(jax.grad(lambda x: f({**t, "source": x})[2] ** 2))(2.0),
    "jit of vmap": lambda f, t: mm.quickly(jax.vmap(lambda x: f({**t, "source": x})))(jnp.array([1.0, 2.0])),
}


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_the_sparse_solvers_follow_every_transform(line, transform):
    """As the dense solver does; forward mode is above."""
    apply = TRANSFORMS[transform]
    dense = apply(lambda t: line.u(t, "S", "dense"), line.theta)
    for solver in SOLVERS[1:]:
        other = apply(lambda t, s=solver: line.u(t, "S", s), line.theta)
        assert np.allclose(other, dense, rtol=1e-8, atol=1e-8 * np.abs(dense).max()), solver
    if transform == "jit of vmap":
        assert np.allclose(dense[1], line.u(line.theta, "S", "dense"), rtol=0, atol=1e-11)  # of source 2


def test_a_factorization_follows_transforms_of_the_right_hand_side(line):
    """One factorisation serves values, gradients and maps; a traced operator is set up anew."""
    def problem(source, wall, reaction=1.0):
        pde = lambda u, x, p: js.laplacian(u)(x) - p[1] * jnp.sin(x[0]) * u(x) - p[0] * jnp.exp(x[0])
        ends = {"left": js.dirichlet(wall), "right": js.neumann(lambda x, p: wall + 0.3)}
        return js.Problem(pde, ends, params=(source, reaction))

    ready = js.factorize(problem(1.0, 0.0), **fixed(line))
    u = lambda *numbers: ready.solve(problem(*numbers)).u
    before = linsolve.factorisations()
    slopes = jax.grad(lambda s, w: jnp.sum(u(s, w)), (0, 1))(2.0, 0.4)
    assert slopes[0] == pytest.approx(np.sum(u(3.0, 0.4)) - np.sum(u(2.0, 0.4)), rel=1e-9)  # linear in both
    assert slopes[1] == pytest.approx(np.sum(u(2.0, 1.4)) - np.sum(u(2.0, 0.4)), rel=1e-9)
    for mapped in (jax.vmap(lambda s: u(s, 0.0)), mm.quickly(jax.vmap(lambda s: u(s, 0.0)))):
        assert np.allclose(mapped(jnp.array([1.0, 2.0]))[1], u(2.0, 0.0), rtol=0, atol=1e-11)
    assert linsolve.factorisations() <= before + 1
    total = lambda k: jnp.sum(u(k, k, k))
    assert jax.grad(total)(1.2) == pytest.approx(difference(total, 1.2, 1.0), rel=BOUND)


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


def test_a_blended_value_has_a_slope_everywhere():
    """Against central differences where the weights are smooth; finite, and the same under jit, at every point:
    anywhere, at a particle, as far from four."""
    lattice = js.rectangle((0, 0), (1, 1), (5, 5))
    sides = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, sides), lattice, order=2, depth=0)
    value = lambda x: sol(x[None], blend=True)[0]
    jitted = jax.jit(value)
    for at in (0.4, 0.55), (0.5, 0.5), (0.375, 0.375):
        at, slope = np.array(at), jax.grad(value)(jnp.array(at))
        assert jnp.isfinite(slope).all()
        assert abs(jitted(jnp.array(at)) - value(at)) < 1e-12
        if at[0] == 0.4:
            steps = 1e-5 * np.eye(2)
            differences = [(value(at + s) - value(at - s)) / 2e-5 for s in steps]
            assert np.allclose(slope, differences, atol=1e-7)
