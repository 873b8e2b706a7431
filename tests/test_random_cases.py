"""The random sweep: cases that can be made again one by one, and a few of them judged."""

import dataclasses

import jax
import numpy as np
import pytest

from benchmarks.random_cases import sweep
from benchmarks.random_cases.cases import DIMS, MEMBERS, case
from benchmarks.random_cases.judging import KINDS, WRONG, another, attempt, error_of, judged
from benchmarks.random_cases.operators import OPERATORS


def test_a_case_is_made_again_from_its_seed_and_number():
    for number in (3, 1234):
        one, again = case(7, number), case(7, number)
        assert dataclasses.replace(one, numbers=0) == dataclasses.replace(again, numbers=0)
        same = jax.tree.map(np.array_equal, one.numbers, again.numbers)
        assert all(jax.tree.leaves(same))
        assert not all(jax.tree.leaves(jax.tree.map(np.array_equal, one.numbers, case(8, number).numbers)))


def test_classes_and_dimensions_have_their_shares():
    """Of 4,000 cases a third or more nonlinear or systems, a fifth in 3D, and every method."""
    made = [case(0, k * MEMBERS) for k in range(75)]
    assert np.mean([one.kind != "linear" for one in made]) >= 1 / 3
    assert np.mean([one.dim == 3 for one in made]) == pytest.approx(DIMS.count(3) / len(DIMS))
    assert {one.method for one in made} == {"S", "I", "II", "III", "SSPH"}
    assert len({one.operator for one in made}) >= 0.7 * len(OPERATORS)


def test_some_cases_are_solved_and_judged():
    """In 1D, of a linear operator: estimates within a factor 10 wherever nothing is flagged."""
    number = next(k for k in range(0, 4000, MEMBERS) if case(0, k).dim == 1 and case(0, k).kind == "linear")
    records = [attempt(case(0, k)) for k in range(number, number + 4)]
    assert {r["kind"] for r in records} <= set(KINDS) - {"silently wrong"}
    tables = sweep.report(records, 0)
    assert tables["random"]["rows"][-1][1] == 4
    assert sum(tables["random"]["rows"][-1][2:]) == 4


def test_what_is_wrong_and_what_is_said():
    quiet, loud = {"flags": []}, {"flags": ["!"]}
    kind = lambda error, said: judged({"error": error, **said})["kind"]
    assert kind(0.2, quiet) == "silently wrong" and kind(0.2, loud) == "wrong and flagged"
    assert kind(np.nan, quiet) == "silently wrong"
    assert kind(0.2, {**quiet, "another": True}) == "another solution"
    assert kind(0.2, {**loud, "another": True}) == "wrong and flagged"
    assert kind(1e-3, {**quiet, "another": True}) == "accurate"
    assert kind(0.05, quiet) == kind(0.05, loud) == "between"
    assert kind(1e-3, quiet) == "accurate" and kind(1e-3, loud) == "right, yet flagged"
    one = case(0, 0)
    assert error_of(one, one.exact) == 0.0 and error_of(one, 1.5 * one.exact) == pytest.approx(0.5)


def test_another_solution_of_the_same_equations_is_told_from_a_wrong_one():
    """Burgers' equation with a source, found at a solution that its own start does not lead to."""
    one = case(60611, 453)
    sol = one.solve()
    assert error_of(one, sol.u) > WRONG
    assert another(one, sol)
    its_own = one.solve(u0=one.exact)
    assert not another(one, its_own)
    linear = next(made for made in (case(0, k) for k in range(0, 4000, MEMBERS)) if made.kind == "linear")
    assert not another(linear, sol)
