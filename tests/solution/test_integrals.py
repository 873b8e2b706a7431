"""Integral terms: exact solutions in one region and several, gradients, what is flagged and refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud.regions.node_weights import node_weights

ROD = js.interval(0.0, 1.0, 11)
ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}


def wave(x, y):
    return jnp.cos(2 * x[0] * y[0])


def of_exp(x):
    """The integral of cos(2 x y) exp(y) over the rod."""
    a = 2 * x
    return (jnp.e * (jnp.cos(a) + a * jnp.sin(a)) - 1) / (1 + a * a)


def equation(u, x):
    """u'' - 2 u + integral = what exp(x) makes of it."""
    return js.laplacian(u)(x) - 2 * u(x) + jnp.exp(x[0]) - of_exp(x[0])


def test_weights_of_the_particles_integrate_polynomials():
    square = js.rectangle((0.0, 0.0), (1.0, 1.0), (9, 9), jitter=0.2)
    powers = np.asarray(square.points)[:, :, None] ** np.arange(5)
    for i in range(5):
        for j in range(5 - i):
            found = node_weights(square, 4) @ (powers[:, 0, i] * powers[:, 1, j])
            assert abs(found - 1 / (i + 1) / (j + 1)) < 1e-13


def test_weights_are_public_and_refuse_what_they_cannot_take():
    weights = js.node_weights(ROD)
    assert abs(weights @ np.exp(ROD.points[:, 0]) - (np.e - 1)) < 1e-6  # exact to degree 4, at spacing 0.1
    for given, word in ((("rod",), "cloud: expected a js.Cloud, got str"), ((ROD, 2.5), "degree: expected a whole")):
        with pytest.raises(ValueError, match=word):
            js.node_weights(*given)


def test_an_integral_term_and_its_boundary_conditions():
    truth = np.exp(ROD.points[:, 0])
    cases = [
        {"left": js.dirichlet(1.0), "right": js.dirichlet(np.e)},
        {"left": js.neumann(-1.0), "right": js.neumann(np.e)},
    ]
    for bcs in cases:
        sol = js.solve(js.Problem(equation, bcs, integral=wave), ROD)
        # The weights are exact up to degree 6; 6e-10 and 8e-9 were measured.
        assert np.abs(sol.u - truth).max() < 2e-8 and sol.flags == []
        assert abs(sol([[0.33]])[0] - np.exp(0.33)) < 2e-8
        estimate = sol.error_estimate().max()
        assert 0.3 < estimate / np.abs(sol.u - truth).max() < 3.0
    # Its constant is known by the integral term alone.
    free = lambda u, x: js.laplacian(u)(x) - jnp.exp(x[0]) - of_exp(x[0])  # noqa: E731
    assert np.abs(js.solve(js.Problem(free, cases[1], integral=wave), ROD).u - truth).max() < 2e-8
    # Beside an unknown: the potential of the left end by the mean.
    held = {"left": js.dirichlet(lambda x, g: g["V"]), "right": js.dirichlet(np.e)}
    mean = [js.constraint(lambda s: s.integral(), np.e - 1)]
    problem = js.Problem(
        lambda u, x, g: equation(u, x), held, integral=wave, unknowns={"V": 0.0}, constraints=mean
    )
    assert abs(js.solve(problem, ROD).unknowns["V"] - 1.0) < 2e-8


def test_an_equation_of_the_second_kind_needs_no_conditions():
    """u(x) - x times the integral of exp(-y) u(y) = exp(x) - x: u = exp(x), whose integral is one."""
    ends = {"left": js.free(), "right": js.free()}
    problem = js.Problem(lambda u, x: u(x) - jnp.exp(x[0]) + x[0], ends, integral=lambda x, y: -x[0] * jnp.exp(-y[0]))
    sol = js.solve(problem, ROD)
    # The weights of the particles are exact up to degree 6.
    assert np.abs(sol.u - np.exp(ROD.points[:, 0])).max() < 1e-8 and sol.flags == []
    assert abs(sol([[0.33]])[0] - np.exp(0.33)) < 1e-8


def test_gradients_by_what_the_kernel_holds():
    def loss(p):
        kernel = lambda x, y, p: p["k"] * jnp.exp(-((x[0] - y[0]) ** 2) / p["w"])  # noqa: E731
        pde = lambda u, x, p: js.laplacian(u)(x) - 1.0  # noqa: E731
        ends = {"left": js.dirichlet(lambda x, p: p["b"]), "right": js.dirichlet(0.0)}
        sol = js.solve(js.Problem(pde, ends, params=p, integral=kernel), ROD, order=2)
        return jnp.sum(sol.u**2) + sol([[0.37]])[0]

    here = {"b": 0.3, "k": 2.0, "w": 0.5}
    value, slope = jax.value_and_grad(loss)(here)
    assert abs(value - loss(here)) < 1e-13
    for name in here:
        up, down = ({**here, name: here[name] + d} for d in (1e-5, -1e-5))
        assert abs(slope[name] - (loss(up) - loss(down)) / 2e-5) < 1e-8, name


def test_an_integral_over_several_regions():
    """u = exp(x) and x^3 + 1 in two layers, and the moments of both in the kernel 1 + x y, in one equation or both."""
    k, cloud = {"a": 1.0, "b": 3.0}, js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.1)
    exact = {"a": lambda x: jnp.exp(x[0]), "b": lambda x: x[0] ** 3 + 1.0}
    half = np.exp(0.5)
    moments = half - 1 + 15 / 64 + 0.5, half * -0.5 + 1 + 31 / 160 + 3 / 8
    flux = {n: lambda u, x, normal, c=c: c * normal @ js.grad(u)(x) for n, c in k.items()}
    ends = js.dirichlet(lambda x: jnp.where(x[0] < 0.5, exact["a"](x), exact["b"](x)))
    between = js.interface(flux, jump=half - 1.125, source=half - 2.25)
    kernel = lambda x, y: 1.0 + x[0] * y[0]  # noqa: E731
    truth = np.concatenate([jax.vmap(exact[n])(cloud.points[ids]) for n, ids in cloud.regions.items()])
    rest = {n: lambda u, x, n=n: k[n] * (js.laplacian(u)(x) - js.laplacian(exact[n])(x)) for n in k}
    whole = {n: lambda u, x, n=n: rest[n](u, x) - (moments[0] + x[0] * moments[1]) for n in k}
    for given in (kernel, {"b": kernel}):
        pdes = whole if given is kernel else {"a": rest["a"], "b": whole["b"]}
        sol = js.solve(js.Problem(pdes, {"boundary": ends, "a|b": between}, integral=given), cloud)
        assert np.abs(sol.u - truth).max() < 1e-9 and sol.flags == []
        assert abs(sol([[0.5]], region="b")[0] - 1.125) < 1e-9


def test_what_does_not_work_is_said():
    pde = lambda u, x: js.laplacian(u)(x) - 1.0  # noqa: E731

    def refused(told, pde=pde, integral=wave, cloud=ROD, **options):
        with pytest.raises(ValueError, match=told):
            js.solve(js.Problem(pde, ENDS, integral=integral), cloud, **options)

    refused("kinks or jumps", integral=lambda x, y: jnp.exp(-abs(x[0] - y[0])))
    refused("singular kernels are not made for", integral=lambda x, y: jnp.log((x - y) @ (x - y)))
    refused(r"returns shape \(1,\), expected \(\)", integral=lambda x, y: x * y)
    refused(r"it is called as kernel\(x, y\)", integral=lambda x: x[0])
    refused("nonlinear in u", pde=lambda u, x: js.laplacian(u)(x) - u(x) ** 2)
    refused('made for integral terms; use "S"', method="III")
    refused("couples all of the 5001", cloud=js.interval(0.0, 1.0, 5001))
    refused("expected a function kernel", integral=3.0)
    refused("the problem has no regions", integral={"a": wave})
    with pytest.raises(ValueError, match="the points are traced"):
        problem, near = js.Problem(pde, ENDS, integral=wave), js.stencils(ROD, size=5)
        jax.grad(lambda s: js.solve(problem, ROD.replace(points=s * ROD.points), stencils=near).u[3])(1.0)
    for ask in (lambda p: js.factorize(p, ROD), lambda p: js.eigen(p, ROD, 2)):
        with pytest.raises(ValueError, match="integral terms are for js.solve alone"):
            ask(js.Problem(pde, ENDS, integral=wave))
    narrow = js.solve(js.Problem(pde, ENDS, integral=lambda x, y: jnp.exp(-(((x[0] - y[0]) / 0.04) ** 2))), ROD)
    assert any("do not resolve the kernel" in flag for flag in narrow.flags)
