"""The units in which the fields of a system are given change nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.discretization.layout import discretize

SIDES = ("left", "right", "bottom", "top")


@pytest.fixture(scope="module")
def square():
    return js.rectangle((0, 0), (1, 1), (11, 11), jitter=0.2)


def wave(x):
    return jnp.stack([jnp.sin(2 * x[0] + x[1]) + 2, jnp.exp(x[0] - x[1])])


def reaction(u, x):
    return jnp.stack([-2 * u[0](x) + u[1](x), u[0](x) - u[1](x)])


def in_units(size, nonlinear=False):
    """Two fields that react with each other, the second in other units, and their values."""

    def left(u, x):
        v = [u[0], lambda y: u[1](y) / size]
        more = v[0](x) * v[1](x) ** 2 if nonlinear else 0.0
        parts = jnp.stack([js.laplacian(v[0])(x), js.laplacian(v[1])(x)]) + reaction(v, x) + more
        return parts * jnp.array([1.0, size])

    exact = lambda x: wave(x) * jnp.array([1.0, size])  # noqa: E731
    both = [lambda x: exact(x)[0], lambda x: exact(x)[1]]
    return js.Problem(
        lambda u, x: left(u, x) - left(both, x), dict.fromkeys(SIDES, js.dirichlet(exact)), fields=2
    ), exact


def errors(problem, exact, cloud, **options):
    sol = js.solve(problem, cloud, order=4, **options)
    values = np.asarray(jax.vmap(exact)(cloud.points))
    size = np.abs(values).max(axis=0)
    return np.abs(sol.u - values).max(axis=0) / size, np.asarray(sol.error_estimate()).max(axis=0) / size, sol


@pytest.mark.parametrize("nonlinear", [False, True], ids=["linear", "nonlinear"])
@pytest.mark.parametrize("size", [1e4, 1e-7, 1e15])
def test_a_field_in_other_units(square, size, nonlinear):
    plain = errors(*in_units(1.0, nonlinear), square)[0]
    assert plain.max() < 1e-6
    found, told, sol = errors(*in_units(size, nonlinear), square)
    np.testing.assert_allclose(found, plain, rtol=0.2)  # units are right to a factor of two
    np.testing.assert_allclose(told, found, rtol=0.5)
    assert sol.flags == [] and sol.converged


def test_the_estimate_of_collocation_knows_them_too(square):
    found, told, sol = errors(*in_units(1e9), square, method="SSPH")
    assert sol.flags == [] and (told < 2 * found).all() and (told > found / 2).all()


def test_a_potential_beside_concentrations():
    """Poisson, Nernst and Planck in SI units between walls 20 nm apart, against the same without units."""
    charge, permittivity, thermal, far = 1.602e-19, 6.95e-10, 0.0257, 6.0e24
    width = 2e-8

    def solved(length, volt, count):
        k = charge * far / permittivity * width**2 / thermal * volt / count / length**2

        def pde(u, x):
            phi, ions = (lambda y: u[0](y) / volt), [lambda y: u[1](y), lambda y: u[2](y)]
            flux = [lambda y, s=s, c=c: js.grad(c)(y) + s * c(y) * js.grad(phi)(y) for s, c in zip((1.0, -1.0), ions)]
            charges = k * (ions[0](x) - ions[1](x))
            return jnp.stack([js.laplacian(u[0])(x) + charges, *(js.divergence(f)(x) for f in flux)])

        walls = {
            "left": js.dirichlet(jnp.array([0.0, count, count])),
            "right": js.dirichlet(jnp.array([2.0 * volt, 0.5 * count, 2.0 * count])),
        }
        start = lambda x: jnp.stack([2 * volt * x[0] / length, count + 0 * x[0], count + 0 * x[0]])  # noqa: E731
        sol = js.solve(js.Problem(pde, walls, fields=3), js.interval(0, length, 31), order=4, u0=start)
        assert sol.converged and sol.flags == []
        return np.asarray(sol.u) / np.array([volt, count, count])

    np.testing.assert_allclose(solved(width, thermal, far), solved(1.0, 1.0, 1.0), rtol=0, atol=1e-5)


def test_modes_and_their_conditions(square):
    """-lap u + 3 v / s, -lap v + 2 s u: the first values are 2 pi^2 - and + the root of 6."""
    exact = 2 * np.pi**2 + np.sqrt(6) * np.array([-1, 1])
    for size in (1.0, 1e6, 1e-7):
        left = lambda u, x: jnp.stack([3 * u[1](x) / size, 2 * size * u[0](x)])  # noqa: B023, E731
        pde = lambda u, x: left(u, x) - jnp.stack([js.laplacian(u[0])(x), js.laplacian(u[1])(x)])  # noqa: B023, E731
        found = js.eigen(js.Problem(pde, dict.fromkeys(SIDES, js.dirichlet(0.0)), fields=2), square, 2, order=4)
        missed = np.abs(found.values - exact)
        assert found.flags == [] and missed.max() < 1e-3
        assert (found.error_estimate() < 2 * missed).all() and (found.error_estimate() > missed / 2).all()


def test_gradients_in_other_units(square):
    def total(a, size=1e6):
        def pde(u, x):
            return jnp.stack([
                js.laplacian(u[0])(x) - u[1](x) / size + a, js.laplacian(u[1])(x) - a * size * u[0](x) + size
            ])  # fmt: skip

        held = js.dirichlet(lambda x: jnp.array([x[0], size * x[1]]))
        return js.solve(js.Problem(pde, dict.fromkeys(SIDES, held), fields=2), square, order=4).u[:, 0].sum()

    slope = jax.grad(total)(1.0)
    np.testing.assert_allclose(slope, (total(1.001) - total(0.999)) / 0.002, rtol=1e-6)
    np.testing.assert_allclose(slope, jax.grad(lambda a: total(a, 1.0))(1.0), rtol=1e-7)


def units(problem, cloud):
    return discretize(problem, cloud, "S", 4, None, None, None).rec.sizes


def held(value):
    return dict.fromkeys(SIDES, js.dirichlet(value))


def test_what_sizes_come_from(square):
    """Boundary values, sources, and what one field makes of another; fields of a size keep their units."""
    one = lambda *more: lambda u, x: jnp.stack([js.laplacian(u[0])(x), js.laplacian(u[1])(x)]) + jnp.stack([  # noqa: E731
        f(u, x) for f in more])  # fmt: skip
    nothing = lambda u, x: 0.0 * u[0](x)  # noqa: E731
    assert units(js.Problem(one(nothing, nothing), held(jnp.array([1.0, 1e4])), fields=2), square) == (4.0**-7, 1.0)
    source = one(lambda u, x: 1.0 + 0 * u[1](x), lambda u, x: 1e-4 + 0 * u[0](x))
    assert units(js.Problem(source, held(0.0), fields=2), square) == (1.0, 4.0**-7)
    driven = one(nothing, lambda u, x: 1e8 * u[0](x))
    assert units(js.Problem(driven, held(jnp.array([1.0, 0.0])), fields=2), square) == (4.0**-12, 1.0)
    # Parts of a wave drive each other hundredfold, and are no larger than each other for that.
    parts = one(lambda u, x: 1e4 * u[1](x), lambda u, x: -1e4 * u[0](x))
    assert units(js.Problem(parts, held(jnp.array([1.0, 0.0])), fields=2), square) == ()
    infinite = one(lambda u, x: 1.0 / x[0] + 0 * u[1](x), nothing)
    assert units(js.Problem(infinite, held(jnp.array([1.0, 2.0])), fields=2), square) == ()


def test_velocities_have_one_unit_and_a_temperature_its_own(square):
    """A pressure has the units of stresses; of two velocities one may be held at zero."""

    def heated(u, x):
        v, p, heat = [u[0], u[1]], u[2], u[3]
        buoyancy = jnp.array([0.0, 1e-8]) * heat(x)
        balance = jnp.stack([js.laplacian(w)(x) for w in v]) - js.grad(p)(x) + buoyancy
        return jnp.stack([*balance, js.grad(v[0])(x)[0] + js.grad(v[1])(x)[1], js.laplacian(heat)(x)])

    bcs = {s: [js.dirichlet(1e-6 * (s == "top"), field=0), js.dirichlet(0.0, field=1), js.dirichlet(300.0, field=3)]
           for s in SIDES}  # fmt: skip
    sizes = units(js.Problem(heated, bcs, fields=4), square)
    assert sizes[0] == sizes[1] == 4.0**-14 and sizes[2] == sizes[3] == 1.0
