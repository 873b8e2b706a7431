"""What must not matter does not: units, place, direction and numbering; and a linear problem is linear.

One cloud and one problem with parameters, so that no example compiles anything.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jsmitsm as js

# Round-off is all that may differ: the moment systems are the same in every frame. Its size against
# the discretisation error (some 1e-6 here) bounds the ratio of the errors.
FACTOR = 1.00001
# Far away the coordinates themselves are rounded, to 1e-10 of the domain at 1e6 of its sizes.
FACTOR_FAR = 1.001
# III eliminates along a coordinate axis: turned, it is another method (7.8 times the error at a right angle).
FACTOR_TURNED = 10.0

SIDES = ("left", "right", "bottom", "top")
HOME = {"turn": np.eye(2), "at": np.zeros(2), "size": 1.0, "amount": np.array([1.0, 0.0])}
BASE = js.rectangle((0, 0), (1, 1), (11, 11), jitter=0.2, seed=3)
FEW = settings(
    max_examples=6, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)


def exact(x, q):
    """A sum of two functions, neither symmetric, in the frame of the cloud."""
    y = jnp.asarray(q["turn"]).T @ ((x - jnp.asarray(q["at"])) / q["size"])
    first = jnp.exp(y[0]) * jnp.sin(2.0 * y[1] + 0.3)
    second = jnp.cos(3.0 * y[0] - y[1]) + y[0] ** 2
    return q["amount"][0] * first + q["amount"][1] * second


def pde(u, x, q):
    return js.laplacian(u)(x) - js.laplacian(lambda y: exact(y, q))(x)


def slope(side):
    """The flux through a side, whose outward normal is that of the frame."""
    normal = {"left": (-1.0, 0.0), "right": (1.0, 0.0)}[side]
    return lambda x, q: jnp.dot(jnp.asarray(q["turn"]) @ jnp.array(normal), js.grad(lambda y: exact(y, q))(x))


def laid_out(q, order=None):
    """The cloud in another frame, and in another numbering."""
    points = np.asarray(q["at"]) + q["size"] * (BASE.points @ np.asarray(q["turn"]).T)
    normals = BASE.normals @ np.asarray(q["turn"]).T
    order = np.arange(len(BASE)) if order is None else order
    number = np.argsort(order)
    return js.Cloud(points[order], {k: number[v] for k, v in BASE.groups.items()}, normals[order])


def solved(method, q, order=None):
    bcs = {**{side: js.dirichlet(exact) for side in SIDES}, "left": js.neumann(slope("left"))}
    cloud = laid_out(q, order)
    kernel = None if method == "S" else js.SuperGaussian(h=0.14 * q["size"], d=3.0)
    return js.solve(js.Problem(pde, bcs, params=q), cloud, method=method, order=4, kernel=kernel)


VALUES = jax.jit(jax.vmap(exact, (0, None)))


def error(sol, q):
    # In the frame of the cloud: far from the origin the coordinates have lost digits.
    true = np.asarray(VALUES(sol.cloud.points, q))
    return float(np.linalg.norm(np.asarray(sol.u) - true) / np.linalg.norm(true))


@pytest.fixture(scope="module")
def usual():
    return {m: error(solved(m, HOME), HOME) for m in ("S", "III", "SSPH")}


def same(method, q, usual, factor, order=None):
    ratio = error(solved(method, q, order), q) / usual[method]
    assert 1.0 / factor < ratio < factor, f"{method}: the error changes by a factor of {ratio}"


def turned(angle, mirrored):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]]) @ np.diag([1.0, -1.0 if mirrored else 1.0])


@pytest.mark.parametrize("method", ["S", "III", "SSPH"])
@FEW
@given(st.floats(-8.0, 8.0))
def test_units(method, usual, exponent):
    same(method, {**HOME, "size": 10.0**exponent}, usual, FACTOR)


@pytest.mark.parametrize("method", ["S", "III", "SSPH"])
@FEW
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.sampled_from([1.0, 1e3, 1e6]))
def test_place(method, usual, x, y, far):
    factor = FACTOR if far < 1e2 else FACTOR_FAR
    same(method, {**HOME, "at": far * np.array([x, y])}, usual, factor)


@pytest.mark.parametrize("method, factor", [("S", FACTOR), ("III", FACTOR_TURNED), ("SSPH", FACTOR)])
@FEW
@given(st.floats(0.0, 2 * np.pi), st.booleans())
def test_direction(method, factor, usual, angle, mirrored):
    same(method, {**HOME, "turn": turned(angle, mirrored)}, usual, factor)


@pytest.mark.parametrize("method", ["S", "III", "SSPH"])
@FEW
@given(st.integers(0, 10**6))
def test_numbering(method, usual, seed):
    order = np.random.default_rng(seed).permutation(len(BASE))
    same(method, HOME, usual, FACTOR, order)


@pytest.mark.parametrize("method", ["S", "III", "SSPH"])
@FEW
@given(st.floats(0.1, 10.0), st.floats(-10.0, 10.0))
def test_sums_and_multiples(method, usual, a, b):
    """The answer to a f + b g is a times that to f and b times that to g."""
    one, two, both = (
        np.asarray(solved(method, {**HOME, "amount": np.array(c)}).u) for c in ((1.0, 0.0), (0.0, 1.0), (a, b))
    )
    size = abs(a) * np.abs(one).max() + abs(b) * np.abs(two).max()
    assert np.abs(both - a * one - b * two).max() < 1e-12 * size


@pytest.mark.parametrize("method", ["S", "III", "SSPH"])
def test_twice_the_data_is_twice_the_answer(method):
    """A power of two changes no rounding: not one bit of the answer may differ."""
    one = np.asarray(solved(method, HOME).u)
    two = np.asarray(solved(method, {**HOME, "amount": np.array([2.0, 0.0])}).u)
    assert np.abs(two - 2.0 * one).max() <= 1e-14 * np.abs(two).max()
