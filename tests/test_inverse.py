"""Inverse problems: what went into a solution, found again from noisy readings inside the domain.

The readings come from a finer cloud at a higher order, with a scatter of known size, so that the
model is not its own judge. With J the Jacobian of the readings, the estimate of Gauss-Newton has the covariance
scatter^2 (J^T J)^-1: the truth must lie within it, and a wrong Jacobian would not get there.
"""

from functools import cache

import jax
import jax.numpy as jnp
import manufactured as mm
import numpy as np
import pytest

import jsmitsm as js

# A compiler's effort is not repaid by a few dozen calls.
PLATE = ((0.0, 0.0), (1.0, 1.0))
TRUTH = {"conductivity": np.array([0.2, 0.6]), "source": np.array([0.6, 0.35]), "robin": np.array([1.7])}
GUESS = {"conductivity": np.array([0.0, 0.0]), "source": np.array([0.45, 0.5]), "robin": np.array([1.0])}
# Chi-square of one and two degrees of freedom: one in a thousand is farther off.
FARTHEST = {1: 10.8, 2: 13.8, 5: 20.5}


def heated(p):
    """div(exp(a + b x) grad u) + a spot of heat = 0; two cold sides, two that lose heat to the air."""
    def pde(u, x, p):
        a, b = p["conductivity"]
        spot = 20.0 * jnp.exp(-jnp.sum((x - p["source"]) ** 2) / 0.3**2)
        return js.divergence(lambda y: jnp.exp(a + b * y[0]) * js.grad(u)(y))(x) + spot

    loss = js.robin(p["robin"][0], 1.0, 0.0)
    cold = js.dirichlet(0.0)
    return js.Problem(pde, {"left": cold, "bottom": cold, "right": loss, "top": loss}, params=p)


class Plate:
    """The model: readings of sixteen thermometers, and their Jacobian, as one compiled program."""

    def __init__(self):
        self.cloud = js.rectangle(*PLATE, (13, 13), jitter=0.2, seed=2)
        stencils = js.stencils(self.cloud, size=21)
        self.places = np.stack(np.meshgrid([0.2, 0.4, 0.6, 0.8], [0.2, 0.4, 0.6, 0.8]), axis=-1).reshape(-1, 2)
        near = np.argmin(np.linalg.norm(self.cloud.points - self.places[:, None], axis=2), axis=1)

        def readings(p):
            u = js.solve(heated(p), self.cloud, stencils=stencils, solver="dense", depth=0).u[near]
            return u, u

        self.places = self.cloud.points[near]
        self.model = mm.quickly(jax.jacfwd(readings, has_aux=True))
        fine = js.solve(heated(TRUTH), js.rectangle(*PLATE, (23, 23)), order=5, depth=0)
        clean = np.asarray(fine(self.places))
        self.scatter = 0.01 * np.abs(clean).max()
        self.data = clean + self.scatter * np.random.default_rng(4).standard_normal(len(clean))
        assert np.abs(self.model(TRUTH)[1] - clean).max() < 0.2 * self.scatter, "the model is worse than the readings"


@pytest.fixture(scope="module")
def plate():
    return Plate()


def gauss_newton(plate, unknown):
    """The unknown entries by least squares, the others known: estimate and covariance, flat."""
    p = TRUTH | {name: GUESS[name] for name in unknown}
    for _ in range(8):
        jacobian, u = plate.model(p)
        J = np.concatenate([jacobian[name] for name in unknown], axis=1)
        step = np.linalg.lstsq(J, plate.data - u)[0]
        parts = np.split(step, np.cumsum([len(p[name]) for name in unknown])[:-1])
        p = p | {name: p[name] + part for name, part in zip(unknown, parts)}
    assert np.abs(step).max() < 1e-6, "Gauss-Newton has not settled"
    flat = lambda q: np.concatenate([q[name] for name in unknown])
    return flat(p), flat(TRUTH), plate.scatter**2 * np.linalg.inv(J.T @ J)


@pytest.mark.parametrize(
    "unknown, known_to",
    [(("conductivity",), 0.05), (("source",), 0.01), (("robin",), 0.05), (("conductivity", "source", "robin"), 0.25)],
)
def test_found_within_its_covariance(plate, unknown, known_to):
    found, truth, covariance = gauss_newton(plate, unknown)
    off = found - truth
    assert off @ np.linalg.solve(covariance, off) < FARTHEST[len(off)]
    assert np.sqrt(np.diag(covariance)).max() < known_to, "the readings tell nothing: nothing was tested"


@cache
def bulged(n, order):
    """A plate whose insulated top is y = 1 + s sin^2(pi x), its particles and normals moved with s."""
    flat = js.rectangle(*PLATE, (n, n))
    near = js.stencils(flat, size={4: 21, 5: 27}[order])
    x, y = flat.points.T
    problem = js.Problem(
        lambda u, x: js.laplacian(u)(x) + 8.0 * jnp.exp(x[0]),
        {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0), "bottom": js.dirichlet(0.0), "top": js.neumann(0.0)},
    )

    def solution(s):
        points = jnp.stack([x, y * (1.0 + s * np.sin(np.pi * x) ** 2)], axis=1)
        slope = s * np.pi * np.sin(2 * np.pi * x)
        up = jnp.stack([-slope, jnp.ones_like(slope)], axis=1) / jnp.sqrt(1.0 + slope**2)[:, None]
        normals = jnp.where(np.isin(np.arange(len(x)), flat.groups["top"])[:, None], up, flat.normals)
        moved = flat.replace(points=points, normals=normals)
        return js.solve(problem, moved, order=order, stencils=near, solver="dense", depth=0)

    return solution


def test_a_shape_found_by_gradient_descent():
    """The bulge of an insulated top from six temperatures well below it, through the particles' positions."""
    places = np.stack(np.meshgrid([0.25, 0.5, 0.75], [0.6, 0.85]), axis=-1).reshape(-1, 2)
    clean = np.asarray(bulged(21, 5)(0.18)(places))
    data = clean + 2e-3 * np.random.default_rng(1).standard_normal(len(clean))
    misfit = lambda s: 0.5 * jnp.sum((bulged(11, 4)(s)(places) - data) ** 2)
    graded = mm.quickly(jax.value_and_grad(misfit))
    ahead, back = (float(graded(0.05 + step)[0]) for step in (1e-4, -1e-4))
    assert float(graded(0.05)[1]) == pytest.approx((ahead - back) / 2e-4, rel=1e-5)
    s = 0.0
    for _ in range(12):
        value, slope = graded(s)
        s = float(s - 0.15 * slope)  # the misfit's curvature is about 6
    # The scatter over what the readings move with the bulge, between 0.4 and 1.4 each; three times that.
    assert abs(s - 0.18) < 3 * 2e-3 / 0.3 / np.sqrt(len(data))
    assert abs(slope) < 1e-3, "the descent has not settled"
