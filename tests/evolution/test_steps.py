"""Schemes and steps alone: order conditions, orders on a stiff system, control, interpolation."""

import jax.numpy as jnp
import numpy as np
import pytest

from jsmitsm.discretization.pencil.sparse import Sparse
from jsmitsm.evolution.space.system import System
from jsmitsm.evolution.steps import dense_output
from jsmitsm.evolution.steps.control import controlled
from jsmitsm.evolution.steps.stepping import RadauStepper, Stepper, Stopped
from jsmitsm.evolution.steps.tableaux import EULER, KENCARP4, RADAU

EPS, LARGEST = 1e-14, lambda x: float(np.abs(x).max())


def test_kencarp4_meets_its_order_conditions():
    """All eight of order 4 for both halves, those of order 3 for the embedded weights; stiffly accurate."""
    b, c = KENCARP4.weights, KENCARP4.nodes
    for a in (KENCARP4.implicit, KENCARP4.explicit):
        assert np.allclose(a.sum(axis=1), c, atol=EPS)
        found = [b.sum(), b @ c, b @ c**2, b @ a @ c, b @ c**3, b @ (c * (a @ c)), b @ a @ c**2, b @ a @ a @ c]
        assert np.allclose(found, [1, 1 / 2, 1 / 3, 1 / 6, 1 / 4, 1 / 8, 1 / 12, 1 / 24], atol=EPS)
        less = KENCARP4.embedded
        assert np.allclose([less.sum(), less @ c, less @ c**2, less @ a @ c], [1, 1 / 2, 1 / 3, 1 / 6], atol=EPS)
    assert np.array_equal(KENCARP4.implicit[-1], b)


def test_radau_is_collocation():
    """Sum_j a_ij c_j^(k-1) = c_i^k / k for k = 1, 2, 3, and the eigenvectors rebuild the inverse."""
    for k in (1, 2, 3):
        assert np.allclose(RADAU.matrix @ RADAU.nodes ** (k - 1), RADAU.nodes**k / k, atol=EPS)
    assert np.allclose((RADAU.vectors * RADAU.values) @ RADAU.back, np.linalg.inv(RADAU.matrix), atol=1e-12)


def test_boundary_data_of_stages_are_what_the_scheme_makes_of_their_rates():
    """Of t^3: h sum_j a_ij 3 t_j^2, and the value itself at the end."""
    s = KENCARP4.sampling(True)
    expected = KENCARP4.implicit[1:] @ (3 * KENCARP4.nodes**2)
    expected[-1] = 1.0
    assert np.allclose(s.blend @ s.nodes**3, expected, atol=1e-11)


class Rod:
    """u_t = u_xx + s on a rod by Numerov's pencil; u = cos(3 t + x) is the answer, its boundary values the data."""

    def __init__(self, n=60):
        x = np.linspace(0.0, 1.0, n + 1)
        self.x, self.inner = x, x[1:-1]
        i = np.arange(1, n)
        rows = np.concatenate([i - 1] * 3)
        cols = np.concatenate([i - 1, i, i + 1])
        one = np.ones(n - 1)
        stiff = np.concatenate([-one / 2, one, -one / 2])
        mass = np.concatenate([one, 10 * one, one]) / (24 * n**2)
        self.a, self.b = (Sparse(v, rows, cols, (n - 1, n + 1)) for v in (stiff, mass))
        every = np.arange(n - 1)
        self.system = System(self.a.part(every, i), (self.b.part(every, i),), self.inner[:, None])

    def exact(self, t, x=None):
        return np.cos(3 * t + (self.inner if x is None else x))

    def force(self, t, ends):
        source = -3 * np.sin(3 * t + self.x) + np.cos(3 * t + self.x)
        held = np.zeros(len(self.x))
        held[[0, -1]] = ends
        return self.b.host @ source - self.a.host @ held, self.b.host @ held

    def start(self, t):
        ends = self.exact(t, self.x[[0, -1]])
        return (*self.force(t, ends), ends)

    def made(self, t, h, sampling):
        times = t + h * sampling.nodes
        ends = sampling.blend @ np.array([self.exact(v, self.x[[0, -1]]) for v in times])
        found = [self.force(v, e) for v, e in zip(times[sampling.stages], ends)]
        return (*(np.array(v) for v in zip(*found)), ends)

    def between(self, t, h, sampling):
        return self.made(t, h, sampling)[0]

    def stages(self, sampling):
        self.step = lambda t, h: self.made(t, h, sampling)
        return self


def run(name, steps):
    rod = Rod()
    if name == "radau":
        stepper = RadauStepper(rod.system, rod.stages(RADAU.sampling(True)))
    else:
        scheme = EULER if name == "euler" else KENCARP4
        stepper = Stepper(rod.system, rod.stages(scheme.sampling(True)), scheme)
    step, h = stepper.first(rod.exact(0.0), 0.0), 1.0 / steps
    for k in range(steps):
        step = stepper.advance(step, k * h, h)
    return np.abs(step.y - rod.exact(1.0)).max()


@pytest.mark.parametrize(("name", "steps", "order", "most"), [
    ("euler", 20, 1, 3e-2), ("esdirk", 10, 4, 1e-5), ("radau", 5, 5, 1e-5),
])  # fmt: skip
def test_the_full_order_under_boundary_data_that_change_in_time(name, steps, order, most):
    """Half an order is left to reduction at stiff boundaries; Numerov's own error is 1e-9 here."""
    coarse, fine = run(name, steps), run(name, 2 * steps)
    assert coarse < most and np.log2(coarse / fine) > order - 0.5


@pytest.mark.parametrize("kind", ["esdirk", "radau"])
def test_controlled_steps_keep_the_tolerance_with_few_sizes(kind):
    rod = Rod()
    drive = rod.stages((RADAU if kind == "radau" else KENCARP4).sampling(True))
    stepper = RadauStepper(rod.system, drive) if kind == "radau" else Stepper(rod.system, drive, KENCARP4)
    seen = []
    counts = controlled(
        stepper, rod.exact(0.0), 0.0, 1.0, 1e-6, lambda t, s: seen.append((t, s.y)), lambda part: None,
        lambda error: np.abs(error).max(),
    )  # fmt: skip
    assert seen[-1][0] == 1.0 and counts["steps"] == len(seen) - 1
    assert max(np.abs(y - rod.exact(t)).max() for t, y in seen) < 2e-5  # of a few steps together
    assert rod.system.factorisations <= 6


class Modes:
    """y' = z y + f(t), each component by itself, from what its answer, e^(z t) unless told, is at the start."""

    def __init__(self, z, answer=None):
        every = np.arange(len(z))
        self.z, self.answer = z, answer or (lambda t: np.exp(z * t))
        a, b = (Sparse(v, every, every, (len(z), len(z))) for v in (-z, np.ones(len(z))))
        self.system = System(a, (b,), every[:, None].astype(float))

    def force(self, t):
        if self.answer(0.0)[0] == 1.0:
            return np.zeros(len(self.z))
        return (self.answer(t + 1e-4) - self.answer(t - 1e-4)) / 2e-4 - self.z * self.answer(t)

    def start(self, t):
        return self.force(t), np.zeros(len(self.z)), np.zeros(0)

    def between(self, t, h, sampling):
        return np.array([self.force(t + h * c) for c in sampling.nodes[sampling.stages]])

    def step(self, t, h):
        made = self.between(t, h, self.sampling)
        return made, np.zeros_like(made), np.zeros((len(made), 0))

    def estimate(self, kind, h=1.0):
        """What a step says of its error, over its error."""
        self.sampling = (RADAU if kind == "radau" else KENCARP4).sampling(True)
        stepper = RadauStepper(self.system, self) if kind == "radau" else Stepper(self.system, self, KENCARP4)
        step = stepper.advance(stepper.first(self.answer(0.0), 0.0), 0.0, h, True)
        return np.abs(step.error / (step.y - self.answer(h)))


@pytest.mark.parametrize(("kind", "most"), [("esdirk", 8.0), ("radau", 2.5)])
def test_what_a_step_says_of_its_error_is_of_its_size(kind, most):
    """Of all that dies out, from what is resolved to what is over at once."""
    found = Modes(-np.geomspace(0.05, 1e5, 60)).estimate(kind)
    assert (found > 0.4).all() and (found < most).all()


@pytest.mark.parametrize("w", [0.5, 1.0, 2.0])
def test_radau_sees_what_forces_make_of_its_error(w):
    """y = 2 + sin(w t), from what hardly moves by itself to what is stiff."""
    z = -np.geomspace(1e-2, 1e3, 30)
    found = Modes(z, lambda t: 2.0 + np.sin(w * t) * np.ones(len(z))).estimate("radau")
    assert (found > 0.4).all() and (found < 8.0).all()


@pytest.mark.parametrize("w", [0.3, 1.0, 2.0, 4.0, 10.0, 30.0, 100.0])
def test_radau_sees_its_error_in_waves(w):
    """u'' = -w^2 u, resolved and not."""
    one, w2 = (Sparse(np.array([v]), np.zeros(1, int), np.zeros(1, int), (1, 1)) for v in (1.0, w**2))
    drive = Modes(np.zeros(2), lambda t: np.array([np.cos(w * t), -w * np.sin(w * t)]))
    drive.force, drive.sampling = lambda t: np.zeros(2), RADAU.sampling(False)
    stepper = RadauStepper(System(w2, (one.with_values(np.zeros(1)), one)), drive)
    step = stepper.advance(stepper.first(drive.answer(0.0), 0.0), 0.0, 1.0, True)
    ratio = np.linalg.norm(step.error / [1, w]) / np.linalg.norm((step.y - drive.answer(1.0)) / [1, w])
    assert 0.5 < ratio < 4.0


def test_a_step_that_never_does_is_named():
    class Hopeless:
        order = 4

        def first(self, y, t):
            return None

        def advance(self, last, t, h, estimate):
            raise Stopped("nothing goes")

    with pytest.raises(Stopped, match="no step is small enough at t = 0: nothing goes"):
        controlled(Hopeless(), np.zeros(1), 0.0, 1.0, 1e-6, lambda t, s: None, lambda p: None, lambda e: 0.0)


def test_second_order_in_time_is_its_first_order_form():
    """The resolvent of (u, u') against the dense block matrix, and its transpose."""
    rng = np.random.default_rng(0)
    n, h = 5, 0.3
    a, m1, m2 = (rng.standard_normal((n, n)) + 3 * np.eye(n) for _ in range(3))
    rows, cols = (v.ravel() for v in np.mgrid[:n, :n])
    first, *masses = (Sparse(m.ravel(), rows, cols, (n, n)) for m in (a, m1, m2))
    system = System(first, tuple(masses))
    zero, one = np.zeros((n, n)), np.eye(n)
    mass, stiff = np.block([[one, zero], [zero, m2]]), np.block([[zero, -one], [a, m1]])
    y = rng.standard_normal(2 * n)
    assert np.allclose(system.mass(y), mass @ y) and np.allclose(system.stiff(y), stiff @ y)
    assert np.allclose(system.mass_transposed(y), mass.T @ y) and np.allclose(system.stiff_transposed(y), stiff.T @ y)
    assert np.allclose(system.resolvent(h).solve(y), np.linalg.solve(mass + h * stiff, y))
    assert np.allclose(system.resolvent(h).solve_transposed(y), np.linalg.solve((mass + h * stiff).T, y))
    z = complex(0.2, 0.4)
    assert np.allclose(system.resolvent(z).solve(y + 0j), np.linalg.solve(mass + z * stiff, y))


def test_interpolation_is_exact_for_polynomials_of_degree_five():
    nodes = np.array([0.0, 0.1, 0.25, 0.3, 0.5, 0.6, 0.8, 1.0])
    times = np.array([0.0, 0.03, 0.4, 0.6, 0.97, 1.0])
    index, weights = dense_output.weights(nodes, times)
    for k in range(6):
        assert np.allclose((weights * nodes[index] ** k).sum(axis=1), times**k, atol=1e-12)
    assert np.allclose(dense_output.derivative(nodes, nodes[:, None] ** 4, 0.45, 2), 12 * 0.45**2)
    assert jnp.shape(weights) == (6, 6)


@pytest.mark.parametrize("place", [0, 3, 6])
@pytest.mark.parametrize("rate", [-0.1, -0.5, -2.0, -10.0, -1e3, 0.3j, 1.0j])
def test_how_far_off_interpolation_is(place, rate):
    """Of modes that are over within a step too, from the start or from a later jump on, alone and beside a slow one."""
    nodes = np.arange(11.0)
    answer = lambda t: np.exp(rate * np.maximum(t - place, 0.0) - 0.02 * t).real
    for beside in (0.0, 1.0):
        made = lambda t: answer(t) + beside * np.exp(-0.02 * t)  # noqa: B023
        for part in (0.02, 0.2, 0.5, 0.8, 0.98):
            t = place + part
            index, weights = dense_output.weights(nodes, np.array([t]))
            error = abs((weights * made(nodes)[index]).sum() - made(np.array([t]))[0])
            (told,) = dense_output.doubts(nodes, list(made(nodes)[:, None, None]), np.array([t]), LARGEST)
            assert told[0] > error / 5 - 1e-12
            assert told[0] < 50 * error + 1e-6 or part == 0.02
    assert not dense_output.doubts(nodes, list(made(nodes)[:, None, None]), nodes, LARGEST).any()
