"""Eigenvalues against known ones, their estimates, multiplicities and gradients, and bad input."""

import pickle

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest
from scipy.special import j0, jn_zeros, jnp_zeros

import jsmitsm as js

SIDES = ("left", "right", "bottom", "top")
CLAMPED = [js.dirichlet(0.0), js.neumann(0.0)]
PI2 = np.pi**2


def minus_laplacian(u, x):
    return -js.laplacian(u)(x)


def drum(bc=None):
    return js.Problem(minus_laplacian, {"boundary": js.dirichlet(0.0) if bc is None else bc})


def square(bc=None):
    return js.Problem(minus_laplacian, dict.fromkeys(SIDES, js.dirichlet(0.0) if bc is None else bc))


@pytest.fixture(scope="module")
def disk():
    return js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.1, -1.1), (1.1, 1.1)), 0.1)


@pytest.fixture(scope="module")
def lattice():
    return js.rectangle((0, 0), (1, 1), (13, 13), jitter=0.2)


@pytest.fixture(scope="module")
def modes(disk):
    return js.eigen(drum(), disk, 4)


def bessel(zeros, count, first=()):
    """Squares of the zeros of Bessel's functions of all orders, doubled but for order 0."""
    some = [np.repeat(zeros(m, 6) ** 2, 1 + (m > 0)) for m in range(12)]
    return np.sort(np.concatenate([*some, first]))[:count]


def test_a_round_drum(disk, modes):
    """A double value at the end is returned whole; its estimate is that of the error."""
    exact = bessel(jn_zeros, 5)
    assert modes.values.shape == (5,) and modes.values.dtype == float and modes.u.shape == (len(disk), 5)
    error = np.abs(modes.values - exact)
    assert (error < np.array([1e-7, 1e-5, 1e-5, 1e-4, 1e-4]) * exact).all()
    assert (error < 2 * modes.error_estimate()).all() and (modes.error_estimate() < 5 * error).all()
    assert modes.flags == [] and modes.residuals[0] < 1e-12 and "Modes 1 to 2 are of one value" in modes.diagnose()
    assert np.allclose((modes.u**2).mean(axis=0), 1.0)


def test_between_the_particles(modes):
    x = np.array([[0.31, 0.2], [0.0, -0.54], [0.7, 0.1]])
    k = jn_zeros(0, 1)[0]
    ratio = modes(0, x) / j0(k * np.linalg.norm(x, axis=1))
    assert np.ptp(ratio) < 1e-6 * ratio[0]
    h = 1e-5 * np.eye(2)
    slope = [(modes(1, x + step) - modes(1, x - step)) / 2e-5 for step in h]
    assert np.allclose(modes.grad(1, x), np.stack(slope, axis=1), atol=1e-6)
    assert np.isnan(modes(0, [[2.0, 0.0]])).all()


def test_a_free_drum_has_the_value_zero(disk):
    values = js.eigen(drum(js.neumann(0.0)), disk, 2).values
    exact = bessel(jnp_zeros, 3, [0.0])
    assert len(values) == 3 and abs(values[0]) < 1e-11
    assert (np.abs(values[1:] / exact[1:] - 1) < 1e-6).all()


def test_the_observed_order():
    """About p, as that of solutions."""
    error = [
        abs(js.eigen(square(), js.rectangle((0, 0), (1, 1), (n, n), jitter=0.2), 1, order=4).values[0] / (2 * PI2) - 1)
        for n in (9, 17)
    ]
    assert error[1] < 1e-4 and np.log2(error[0] / error[1]) > 3.5


def test_periodic_pairs_mass_and_near(lattice):
    strip = {"left": js.periodic("left", "right"), "bottom": js.dirichlet(0.0), "top": js.dirichlet(0.0)}
    modes = js.eigen(js.Problem(minus_laplacian, strip), lattice, 4)
    assert np.allclose(modes.values, PI2 * np.array([1, 4, 5, 5]), rtol=3e-4)
    left, right = lattice.groups["left"], lattice.groups["right"]
    assert np.array_equal(modes.u[left], modes.u[right])
    heavy = js.eigen(square(), lattice, 2, near=10 * PI2, mass=0.5).values  # twice those of mass 1
    assert np.allclose(heavy, 10 * PI2, rtol=1e-4)
    # Against a solution of order 8 on 576 particles.
    assert abs(js.eigen(square(), lattice, 1, mass=lambda x: 1 + x[0] * x[1]).values[0] / 15.6763508 - 1) < 1e-5


def test_beams_of_fourth_order():
    beam = js.Problem(lambda u, x: js.partial(u, (4,))(x), {"left": CLAMPED, "right": CLAMPED})
    values = js.eigen(beam, js.interval(0.0, 1.0, 31), 2, order=8).values
    assert np.allclose(values**0.25, [4.730040744862704, 7.853204624095838], rtol=1e-5)


def test_a_plate_buckles():
    """52.34469 and a double value, of which only the sum of both parts counts; the mass is an operator."""
    biharmonic = lambda u, x: js.laplacian(js.laplacian(u))(x)  # noqa: E731
    problem = js.Problem(biharmonic, dict.fromkeys(SIDES, CLAMPED))
    modes = js.eigen(problem, js.rectangle((0, 0), (1, 1), (11, 11)), 2, order=4, mass=minus_laplacian)
    error = np.abs(modes.values / [52.34469, 92.12444, 92.12444] - 1)
    assert modes.values.dtype == float and modes.flags == [] and (error < [0.01, 0.03, 0.03]).all()
    assert (0.3 * error < modes.error_estimate() / modes.values).all()
    assert "Modes 1 to 2 are of one value" in modes.diagnose() and modes.residuals.max() < 1e-10
    assert modes(0, [[0.5, 0.5]])[0] > 0.9 * np.abs(modes.u[:, 0]).max()


def test_gradients_through_an_operator_as_the_mass():
    ends = dict.fromkeys(("left", "right"), js.dirichlet(0.0))
    column = js.Problem(lambda u, x, a: -(1 + a * x[0]) * js.laplacian(u)(x), ends, params=0.3)
    rod = js.interval(0.0, 1.0, 15)

    def load(a):
        mass = lambda u, x, a: u(x) + a * x[0] * js.grad(u)(x)[0]  # noqa: E731
        return js.eigen(column.replace(params=a), rod, 1, order=2, mass=mass).values[0]

    slope = difference(load, 0.3)
    assert abs(jax.grad(load)(0.3) - slope) < 1e-6 * abs(slope)


def test_double_values_of_a_ring_are_real():
    """The parts of a double value stand apart by as much as its error, one above the other here."""
    ring = js.Problem(minus_laplacian, {"left": js.periodic("left", "right")})
    modes = js.eigen(ring, js.interval(0.0, 1.0, 31), 4)
    assert modes.values.dtype == float and modes.flags == []
    assert np.allclose(modes.values, 4 * PI2 * np.array([0, 1, 1, 4, 4]), atol=1e-9, rtol=1e-4)


def test_an_elastic_square_between_rollers(lattice):
    """Pressure waves (lambda + 2 mu) k^2 and shear waves mu k^2, k^2 = pi^2 (m^2 + n^2), of a square of density 2."""
    nu = 0.3
    mu, lame = 0.5 / (1 + nu), nu / (1 - nu**2)

    def operator(u, x):
        h = [js.hessian(u[k])(x) for k in range(2)]
        spread = jnp.stack([h[0][0, 0] + h[1][0, 1], h[0][0, 1] + h[1][1, 1]])
        return -mu * jnp.stack([jnp.trace(h[0]), jnp.trace(h[1])]) - (lame + mu) * spread

    def shear(u, x, n):
        return js.grad(u[0])(x)[1] + js.grad(u[1])(x)[0]

    bcs = {side: [js.dirichlet(0.0, field=k), js.condition(shear)] for k, pair in enumerate((SIDES[:2], SIDES[2:]))
           for side in pair}  # fmt: skip
    modes = js.eigen(js.Problem(operator, bcs, fields=2), lattice, 3, mass=(2.0, 2.0), order=4)
    exact = np.sort([mu * 2, lame + 2 * mu, lame + 2 * mu]) * PI2 / 2
    assert modes.u.shape == (169, 3, 2) and np.allclose(modes.values, exact, rtol=1e-3)


def test_an_equation_without_a_mass():
    """-u'' = w, -w'' = lambda u with u = w = 0 at the ends: u'''' = lambda u, values (k pi)^4."""
    ends = dict.fromkeys(("left", "right"), js.dirichlet(0.0))

    def operator(u, x):
        return jnp.stack([-js.laplacian(u[1])(x), -js.laplacian(u[0])(x) - u(x)[1]])

    modes = js.eigen(js.Problem(operator, ends, fields=2), js.interval(0.0, 1.0, 31), 2, mass=(1.0, 0.0))
    assert np.allclose(modes.values, [np.pi**4, 16 * np.pi**4], rtol=1e-5)
    u, w = modes(0, [[0.5]])[0]
    assert abs(w / u / np.pi**2 - 1) < 1e-4


def test_complex_values_of_a_drift_and_the_warning_of_a_strong_one(lattice):
    """On a torus drift turns waves of the axis: lambda = k^2 +- i b k, and k^2 for those across it."""
    torus = {"left": js.periodic("left", "right"), "bottom": js.periodic("bottom", "top")}
    modes = js.eigen(js.Problem(lambda u, x: -js.laplacian(u)(x) + 5 * js.grad(u)(x)[0], torus), lattice, 5)
    assert np.iscomplexobj(modes.values) and abs(modes.values[0]) < 1e-10
    assert np.allclose(sorted(modes.values[1:].imag), [-10 * np.pi, 0, 0, 10 * np.pi], atol=1e-2)
    with pytest.raises(ValueError, match="k: mode 3 is complex"):
        modes(3, [[0.5, 0.5]])
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    strong = js.Problem(lambda u, x: -js.laplacian(u)(x) + 30 * js.grad(u)(x)[0], ends)
    assert "far from self-adjoint" in js.eigen(strong, js.interval(0.0, 1.0, 31), 2).flags[0]


def test_what_a_coarse_cloud_does_not_resolve_is_flagged():
    modes = js.eigen(square(), js.rectangle((0, 0), (1, 1), (7, 7)), 20, order=4)
    off = np.abs(modes.values / np.sort([i**2 + j**2 for i in range(1, 9) for j in range(1, 9)])[:20] / np.pi**2 - 1)
    assert "are not resolved, or spurious" in " ".join(modes.flags)
    assert (modes.error_estimate()[off > 0.1] > 0.02 * modes.values[off > 0.1]).all() and (off > 0.1).sum() > 5
    modes._errors = np.zeros(20)  # short waves are told whatever the estimate sees
    assert "shorter than four particles" in " ".join(modes.flags)
    assert js.eigen(square(), js.rectangle((0, 0), (1, 1), (9, 9)), 1, order=4).flags == []


@pytest.fixture(scope="module")
def plate():
    """A plate of varying stiffness, whose values are simple."""
    cloud = js.rectangle((0, 0), (1.3, 1), (12, 10), jitter=0.25)

    def operator(u, x, a):
        return -js.divergence(lambda y: (1 + a * y[0]) * js.grad(u)(y))(x)

    return cloud, js.Problem(operator, dict.fromkeys(SIDES, js.dirichlet(0.0)), params=0.3)


def difference(f, a, step=1e-4):
    return (f(a + step) - f(a - step)) / (2 * step)


def test_gradients_of_values_and_modes(plate):
    cloud, problem = plate
    inner = cloud.groups["interior"][7]

    def some(a):
        modes = js.eigen(problem.replace(params=a), cloud, 2, order=2, mass=lambda x: 1 + a * x[1])
        return modes.values[1] + modes.u[inner, 0] + 2 * modes.u[inner, 1]

    slope = difference(some, 0.3)
    assert abs(jax.grad(some)(0.3) - slope) < 1e-6 * abs(slope)


def test_gradients_under_jit(plate):
    cloud, problem = plate

    def first(a):
        return js.eigen(problem.replace(params=a), cloud, 1, order=2).values[0]

    slope = difference(first, 0.3)
    value, made = mm.quickly(jax.value_and_grad(first))(0.3)
    assert abs(made - slope) < 1e-6 * abs(slope) and abs(value - first(0.3)) < 1e-10 * value


def test_gradients_in_the_points(plate):
    cloud, problem = plate
    shift = np.random.default_rng(1).normal(size=cloud.points.shape)
    shift = shift * np.isin(np.arange(len(cloud)), cloud.groups["interior"])[:, None]
    stencils = js.stencils(cloud, size=20)

    def second(step):
        moved = js.Cloud(cloud.points + step * shift, cloud.groups, cloud.normals)
        return js.eigen(problem, moved, 2, order=2, stencils=stencils).values[1]

    slope = difference(second, 0.0, 1e-5)
    assert abs(jax.grad(second)(0.0) - slope) < 1e-5 * abs(slope)


def test_values_of_a_cluster_move_with_their_mean():
    around = {"left": js.periodic("left", "right")}
    even = js.interval(0.0, 1.0, 15)
    moved = 0.2 * even.spacing * np.random.default_rng(0).uniform(-1, 1, (13, 1))
    cloud = even.replace(points=even.points + np.pad(moved, ((1, 1), (0, 0))))

    def both(a):
        problem = js.Problem(lambda u, x, a: -a * js.laplacian(u)(x), around, params=a)
        return js.eigen(problem, cloud, 2, order=2).values

    assert both(1.5).shape == (3,)
    assert np.allclose(slopes := jax.jacfwd(both)(1.5), both(1.5) / 1.5, rtol=1e-2, atol=1e-8)
    assert slopes[1] == slopes[2] and abs(slopes[1:].sum() - both(1.5)[1:].sum() / 1.5) < 1e-8


def test_pickled_and_through_jit(modes, disk):
    estimate = modes.error_estimate()
    again = pickle.loads(pickle.dumps(modes))
    assert np.array_equal(again.values, modes.values) and np.array_equal(again.error_estimate(), estimate)
    with pytest.raises(ValueError, match="keep values and u"):
        again(0, [[0.0, 0.0]])
    assert np.array_equal(jax.tree.map(lambda x: x, modes).u, modes.u)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"count": 500}, "count: 500 values asked for, but only 49 of"),
        ({"count": 0}, "count: expected a whole number"),
        ({"count": 2.0}, "count: expected a whole number"),
        ({"near": 1j}, "near: expected a finite real number"),
        ({"near": np.nan}, "near: expected a finite real number"),
        ({"method": "III"}, "method: 'III' has no pencil"),
        ({"mass": [1.0, 2.0]}, r"mass: expected a scalar, or \(1,\)"),
        ({"mass": "heavy"}, "mass: expected a number"),
        ({"mass": 0.0}, "mass: zero in every equation"),
        ({"mass": lambda x: jnp.nan * x[0]}, "mass: NaN or infinite at particle 0"),
        ({"mass": lambda x: x}, "mass: expected a scalar"),
        ({"mass": lambda u, x: js.laplacian(u)(x)}, "mass: an operator of order 2, but the pde is of order 2"),
        ({"mass": lambda u, x: js.grad(u)(x)}, r"mass: the operator returns 2 value\(s\)"),
        ({"mass": lambda u, x: u(x) ** 2}, "mass: an operator is linear in u"),
        ({"depth": -1}, "depth: expected"),
        ({"order": 1}, "order: 1 is below the order 2"),
    ],
)
def test_bad_arguments(change, message):
    given = {"count": 2, "order": 4, **change}
    with pytest.raises(ValueError, match=message):
        js.eigen(square(), js.rectangle((0, 0), (1, 1), (9, 9)), given.pop("count"), **given)


def test_a_mass_at_a_field_that_nothing_differentiates():
    """Buckling by w = lap u, whose values came out 13 % off; fields without derivatives in their own equation may."""
    def buckling(u, x):
        return jnp.stack([u(x)[1] - js.laplacian(u[0])(x), -js.laplacian(js.laplacian(u[0]))(x)])

    def two_states(u, x):
        return jnp.stack([-js.laplacian(u[0])(x) + u(x)[1], u(x)[1] - u(x)[0]])

    line = js.interval(0.0, 1.0, 17)
    clamped = [js.dirichlet(0.0, field=0), js.neumann(0.0, field=0)]
    with pytest.raises(ValueError, match=r"mass: equation 1 has one, which multiplies u\[1\].*write the operator"):
        js.eigen(js.Problem(buckling, {"left": clamped, "right": clamped}, fields=2), line, 1, mass=(0.0, 1.0))
    held = js.dirichlet(0.0, field=0)
    found = js.eigen(js.Problem(two_states, {"left": held, "right": held}, fields=2), line, 1, near=12.0, order=4)
    # (pi^2 - l) (1 - l) + 1 = 0
    assert abs(found.values[0] - (np.pi**2 + 1 + np.sqrt((np.pi**2 - 1) ** 2 - 4)) / 2) < 1e-4


@pytest.mark.parametrize(
    "pde, top, message",
    [
        (lambda u, x: js.laplacian(u)(x) + u(x) ** 2, js.dirichlet(0.0), "nonlinear in u"),
        (lambda u, x: js.laplacian(u)(x) + 1.0, js.dirichlet(0.0), "pde: it has a source"),
        (minus_laplacian, js.dirichlet(1.0), "bcs: the condition of 'top' has a value other than zero"),
        (minus_laplacian, js.neumann(lambda x: x[0]), "bcs: the condition of 'top' has a value other than zero"),
        (minus_laplacian, js.condition(lambda u, x, n: u(x) ** 2), "nonlinear in u"),
    ],
)
def test_problems_without_modes(pde, top, message):
    bcs = {**dict.fromkeys(SIDES, js.dirichlet(0.0)), "top": top}
    with pytest.raises(ValueError, match=message):
        js.eigen(js.Problem(pde, bcs), js.rectangle((0, 0), (1, 1), (9, 9)), 2)


def test_bad_stencils_and_numbers_of_modes(modes):
    cloud = js.rectangle((0, 0), (1, 1), (9, 9))
    with pytest.raises(ValueError, match="stencils: particle .* has .* but the source's fit at this order takes 30"):
        js.eigen(square(), cloud, 2, stencils=js.stencils(cloud, size=20))
    for k in (9, 1.0, True):
        with pytest.raises(ValueError, match="k: expected the number of a mode"):
            modes(k, [[0.0, 0.0]])


@pytest.mark.parametrize(
    ("counts", "order", "free", "most"),
    [((17, 17), 8, False, 1e-7), ((17, 17), 6, True, 1e-6), ((9, 25), 4, False, 1e-4), ((6, 6), 6, False, 3e-3)],
)
def test_lattices_with_few_lines_beside_their_walls(counts, order, free, most):
    """Half a disc of particles lies on too few lines to fit the source on them; so does all of a stretched lattice."""
    bcs = {side: js.neumann(0.0) if free else js.dirichlet(0.0) for side in ("right", "bottom", "top")}
    square = js.Problem(lambda u, x: -js.laplacian(u)(x), {"left": js.dirichlet(0.0), **bcs})
    modes = js.eigen(square, js.rectangle((0, 0), (1, 1), counts), 1, order=order)
    exact = np.pi**2 * (0.25 if free else 2.0)
    error = abs(float(modes.values[0]) / exact - 1)
    assert error < most and float(modes.error_estimate()[0]) / exact < 20 * most and not modes.flags


def test_a_depth_that_a_cloud_is_too_small_for_is_refused():
    sides = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
    square = js.Problem(lambda u, x: -js.laplacian(u)(x), sides)
    with pytest.raises(js.SolveError, match="too few particles in a row"):
        js.eigen(square, js.rectangle((0, 0), (1, 1), (6, 6)), 1, order=6, depth=2)
