"""A method of order p reproduces every polynomial solution of degree p.

If L u = f with u a polynomial of degree p, then the Taylor coefficients of u satisfy the recursion
exactly, and every moment row vanishes at them, whatever the weights: the discrete solution is u up
to round-off. The bound is 1e-10 relative: machine precision 2e-16 times a local condition number of
at most about 1e4 and a global one of about 1e2.
"""

import manufactured as mm
import pytest

import jsmitsm as js
from benchmarks.problems import CASES

BOUND = 1e-10
# dim: particles along an axis, order, support in lattice spacings. The supports hold about
# twice the free coefficients (SSPH: the monomials) even in a corner of the box.
SIZES = {1: (12, 5, 5.5), 2: (8, 4, 4.5), 3: (5, 3, 4.0)}


def solve(method, dim, equation, kind):
    n, order, reach = SIZES[dim]
    if dim > 1 and method in ("I", "II"):  # their rows reach the neighbours' neighbours: dear at high order
        order, reach = (3, 3.6) if dim == 2 else (2, 2.3)
    exact = mm.polynomial(dim, order)
    problem = CASES[f"{equation} {dim}D"].solved_by(exact).problem(**mm.conditions(dim, exact, kind))
    cloud = mm.jittered(dim, n)
    return js.solve(problem, cloud, method=method, order=order, kernel=mm.lattice_kernel(dim, n, reach)), exact


EASY, HARD, CROSSED = ("poisson", "dirichlet"), ("every term", "mixed"), ("poisson", "mixed")
# Every method meets every term in every dimension, and one set of coefficients for all particles in the first two; the
# mixed middle only where it is cheap.
TABLE = [
    *((method, dim, *HARD) for method in mm.METHODS for dim in SIZES),
    *((method, dim, *EASY) for method in mm.METHODS for dim in (1, 2)),
    ("S", 3, *EASY),
    *((method, 1, *CROSSED) for method in mm.METHODS),
    ("S", 2, *CROSSED),
]


@pytest.mark.parametrize("method, dim, equation, kind", TABLE)
def test_polynomials_are_reproduced(method, dim, equation, kind):
    sol, exact = solve(method, dim, equation, kind)
    assert sol.converged
    assert mm.error(sol, exact) < BOUND
