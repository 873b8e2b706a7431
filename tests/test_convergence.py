"""Observed orders of method S on Poisson's equation with smooth solutions.

The solution is analytic. A method of even order p is expected to converge at order p (the odd error
terms of a nearly symmetric stencil cancel); p - 0.3 leaves room for jitter. A single jittered cloud
scatters by a factor 1.5, so errors are geometric means over several seeds, and every refinement is
by two or more. Each error has a ceiling besides: a method may converge at the right rate and still
be bad.
"""

import manufactured as mm
import numpy as np
import pytest

import jsmitsm as js
from benchmarks.problems import CASES

# dim, order: particles along an axis, coarse and fine, and ceilings of the fine error with Dirichlet
# sides and with one Neumann side, about three times what was seen.
SIZES = {
    (1, 2): (11, 41, 2e-4, 5e-3), (1, 4): (11, 41, 1.2e-7, 2e-6), (1, 6): (11, 25, 6e-10, 1e-7),
    (2, 2): (11, 31, 1.2e-4, 1e-4), (2, 4): (11, 21, 4e-7, 1.2e-6), (2, 6): (11, 21, 6e-10, 2e-8),
    (3, 2): (6, 11, 8e-4, 1.3e-3), (3, 4): (6, 11, 4e-6, 4e-5), (3, 6): (8, 13, 2e-8, None),
}  # fmt: skip
# Clouds with a Neumann side scatter no more, but cost more: a new shape for every set of repaired particles.
SEEDS = {(1, "dirichlet"): 8, (1, "neumann"): 4, (2, "dirichlet"): 4, (2, "neumann"): 2, (3, "dirichlet"): 2,
         (3, "neumann"): 1}  # fmt: skip


def solve(order, kind, cloud):
    case = CASES[f"plain {cloud.dim}D"]
    return js.solve(case.problem(**mm.conditions(cloud.dim, case.exact, kind)), cloud, order=order)


def relative_l2(sol):
    return CASES[f"plain {sol.cloud.dim}D"].error(sol)


def typical_error(dim, n, order, kind):
    errors = [relative_l2(solve(order, kind, mm.jittered(dim, n, 0.25, seed))) for seed in range(SEEDS[dim, kind])]
    return float(np.exp(np.mean(np.log(errors))))


# Of order 6 in space the Neumann side is left out: it is the dearest by far, and the same code as of order 4.
TABLE = [(*size, kind) for size in SIZES for kind in ("dirichlet", "neumann") if (*size, kind) != (3, 6, "neumann")]


@pytest.mark.parametrize("dim, order, kind", TABLE)
def test_observed_order(dim, order, kind):
    coarse, fine, *ceilings = SIZES[dim, order]
    errors = [typical_error(dim, n, order, kind) for n in (coarse, fine)]
    rate = np.log(errors[0] / errors[1]) / np.log((fine - 1) / (coarse - 1))
    assert rate >= order - 0.3, f"order {rate:.2f} from errors {errors}"
    assert errors[1] < ceilings[kind == "neumann"]


def test_a_thousand_scattered_particles_at_order_six():
    """About 1000 particles of a Halton sequence in the unit square: below 1e-9."""
    from scipy.stats import qmc

    side = np.linspace(0.0, 1.0, 33)
    inner = qmc.Halton(2, scramble=False).random(901)[1:] * 0.96 + 0.02
    edges = [np.stack([np.zeros(33), side], 1), np.stack([np.ones(33), side], 1),
             np.stack([side[1:-1], np.zeros(31)], 1), np.stack([side[1:-1], np.ones(31)], 1)]  # fmt: skip
    points = np.concatenate([inner, *edges])
    ends = np.cumsum([900, 33, 33, 31, 31])
    groups = dict(zip(("interior", *mm.SIDES[:4]), np.split(np.arange(len(points)), ends[:-1])))
    sol = solve(6, "dirichlet", js.Cloud(points, groups))
    assert sol.converged and relative_l2(sol) < 1e-9


def test_the_polynomials_converge_between_particles():
    """sol(points) and sol.grad(points) at order 4 away from particles: orders 4 and 3, loosely."""
    points = np.random.default_rng(0).uniform(0.1, 0.9, (200, 2))
    exact = CASES["plain 2D"].exact
    true = mm.values(exact, points)
    slopes = np.array([np.asarray(js.grad(exact)(x)) for x in points])
    errors = []
    for n in SIZES[2, 4][:2]:
        sol = solve(4, "dirichlet", mm.jittered(2, n, 0.25, seed=2))
        errors.append((np.abs(sol(points) - true).max(), np.abs(sol.grad(points) - slopes).max()))
    rates = np.log2(np.array(errors[0]) / np.array(errors[1]))
    # The largest of 200 errors, not a norm: a unit of order is left to chance.
    assert (rates > (3.0, 2.0)).all(), rates
    assert errors[1][0] < 1e-4 and errors[1][1] < 1e-2
