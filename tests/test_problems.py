"""The table of problems: exact solutions solve their equations, and the committed measurements keep every bound."""

import json

import jax
import numpy as np
import pytest

from benchmarks.equations import DATA, MEASURED, good, missed, shown
from benchmarks.problems import CASES, table

# A source made by AD from the exact solution needs no check.
STATED = sorted(name for name, case in CASES.items() if case.source is not None)


@pytest.mark.parametrize("name", STATED)
def test_the_exact_solution_solves_its_equation(name):
    case = CASES[name]
    cloud = case.cloud()
    inside = np.asarray(cloud.points)[np.random.default_rng(0).choice(cloud.groups["interior"], 8)]
    wrong = lambda y: case.exact(y) + y[0] ** 4 * y[-1] ** 2
    residuals = jax.jit(jax.vmap(lambda x: (case.pde(case.exact, x), case.pde(wrong, x))))(inside)
    # Fourth derivatives by AD lose a few digits of round-off.
    assert np.abs(residuals[0]).max() < 1e-9 * np.abs(residuals[1]).max()


@pytest.fixture(scope="module")
def lines():
    return {(line["case"], line["order"]): line for line in json.loads(DATA.read_text())["lines"]}


def test_every_case_was_measured_and_keeps_its_bounds(lines):
    assert set(lines) == {(name, order) for name, case in MEASURED.items() for order in case.ceilings}
    for (name, order), line in lines.items():
        assert line["ceiling"] == MEASURED[name].ceilings[order]
        assert not missed(line), shown(line)


def test_the_error_estimate_is_good_on_ten_cases_or_more(lines):
    assert len({name for (name, _), line in lines.items() if good(line)}) >= 10


@pytest.mark.parametrize("worse", [{"error": 1.0}, {"steps": 9}, {"rate": 3.0}, {"before": 1.0}, {"rank": 0.5}])
def test_a_worse_number_misses(lines, worse):
    assert missed({**lines["quasilinear", 4], **worse})


def test_names_differ():
    with pytest.raises(ValueError, match="must differ"):
        table(CASES["rod"], CASES["rod"])
