"""Equations of fourth order where nothing is held: a particle has one equation, and its neighbours hear of the rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js

fourth = lambda u, x: js.partial(u, (4,))(x)
slope = lambda u, x, n: n @ js.grad(u)(x)
moment = lambda u, x, n: js.partial(u, (2,))(x)
shear = lambda u, x, n: js.partial(u, (3,))(x)


def meeting(exact, *functionals):
    return [js.condition(lambda u, x, n, f=f: f(u, x, n) - f(exact, x, n)) for f in functionals]


@pytest.mark.parametrize("end", [(moment, shear), (slope, shear)], ids=["free", "guided"])
def test_a_clamped_beam_with_a_free_end_is_exact_for_a_quartic(end):
    """Under a constant load; alone with its own conditions the end leaves one parabola undetermined."""
    exact = lambda x: x[0] ** 2 * (6.0 - 4.0 * x[0] + x[0] ** 2) / 3.0
    bcs = {"left": [js.dirichlet(0.0), js.neumann(0.0)], "right": meeting(exact, *end)}
    cloud = js.interval(0.0, 1.0, 21)
    sol = js.solve(js.Problem(lambda u, x: fourth(u, x) - 8.0, bcs), cloud)
    assert np.abs(sol.u - jax.vmap(exact)(cloud.points)).max() < 1e-9  # round-off times a condition of 1e7


def test_a_free_end_keeps_the_order():
    exact = lambda x: jnp.sin(2 * x[0])
    bcs = {"left": [js.dirichlet(exact), *meeting(exact, slope)], "right": meeting(exact, moment, shear)}
    errors = []
    for n in (11, 21, 41):
        cloud = js.interval(0.0, 1.0, n)
        problem = js.Problem(lambda u, x: fourth(u, x) - fourth(exact, x), bcs)
        sol = js.solve(problem, cloud, order=8, depth=0)  # deeper is round-off
        errors.append(np.abs(sol.u - jax.vmap(exact)(cloud.points)).max())
    assert errors[2] < 1e-6 and errors[0] / errors[1] > 2**5 < errors[1] / errors[2], errors


def test_a_plate_with_a_free_edge():
    """Clamped on three sides; the neighbours' share is worth two digits here and three on 25 x 25 particles."""
    exact = lambda x: jnp.sin(2 * x[0] + 0.3) * jnp.exp(x[1])
    plate = lambda u, x: js.laplacian(js.laplacian(u))(x)
    bent = lambda u, x, n: js.partial(u, (2, 0))(x) + 0.3 * js.partial(u, (0, 2))(x)
    sheared = lambda u, x, n: js.partial(u, (3, 0))(x) + 1.7 * js.partial(u, (1, 2))(x)
    bcs = dict.fromkeys(("left", "bottom", "top"), [js.dirichlet(exact), *meeting(exact, slope)])
    cloud = js.rectangle((0, 0), (1, 1), (13, 13), jitter=0.2)
    task = js.Problem(lambda u, x: plate(u, x) - plate(exact, x), bcs | {"right": meeting(exact, bent, sheared)})
    sol = js.solve(task, cloud, order=6)
    error = np.abs(sol.u - jax.vmap(exact)(cloud.points)).max()
    assert error < 1e-4 and 0.3 < sol.error_estimate().max() / error < 3.0


def test_round_off_of_the_least_squares_form_is_told():
    """All conditions at one end, as in time: the squared operator on 81 particles has a condition of 4e14."""
    exact = lambda x: jnp.sin(3 * x[0]) + x[0] ** 2
    bcs = {"left": [js.dirichlet(exact), *meeting(exact, slope, moment, shear)], "right": js.free()}
    off = {}
    for n in (21, 81):
        cloud = js.interval(0.0, 2.0, n)
        task = js.Problem(lambda u, x: fourth(u, x) - fourth(exact, x), bcs)
        sol = js.solve(task, cloud, order=8, formulation="lsq")
        off[n] = np.abs(sol.u - jax.vmap(exact)(cloud.points)).max(), any("Round-off" in flag for flag in sol.flags)
    assert off[21][0] < 1e-3 and not off[21][1] and off[81][1], off
