"""The table of problems: every exact solution satisfies its own equation."""

import jax
import numpy as np
import pytest

from benchmarks.problems import ALL, EXAMPLES, NONSMOOTH

SMOOTH = sorted(set(ALL) - set(NONSMOOTH))


@pytest.mark.parametrize("name", SMOOTH)
def test_the_exact_solution_solves_its_equation(name):
    """At points away from the boundary, where the paper's series converges slowly."""
    case = ALL[name]
    lo, hi = np.array(case.lo), np.array(case.hi)
    points = lo + (hi - lo) * np.random.default_rng(0).uniform(0.1, 0.8, (8, case.dim))
    residual = jax.vmap(lambda x: case.pde(case.exact, x))(points)
    wrong = jax.vmap(lambda x: case.pde(lambda y: case.exact(y) + y[0] ** 4 * y[-1] ** 2, x))(points)
    # Fourth derivatives by AD lose a few digits of round-off.
    assert np.abs(residual).max() < 1e-9 * np.abs(wrong).max()


def test_names_say_which_case_it_is():
    assert all(name == case.name and case.about for name, case in ALL.items() if name in EXAMPLES)
