"""Equations of every kind against the bounds of the table of problems.

A quick part of ``python -m benchmarks.equations``: the default kernel and stencils, clouds and
solutions that nothing was tuned on. Each line asserts the error, further errors (pressure, stress
concentration), Newton steps and observed orders that the table states.
"""

from dataclasses import replace

import numpy as np
import pytest

import jsmitsm as js
from benchmarks.equations import estimated, good, missed, run, shown
from benchmarks.problems import CASES

LINEAR = [
    ("diffusion", 4), ("diffusion", 8), ("anisotropy", 4), ("rotated", 6), ("helmholtz", 6), ("heat", 4),
    ("convection", 4), ("wave", 6), ("u_xy", 6), ("biharmonic", 4), ("transport", 4), ("third order", 6),
    ("dispersion", 6),
]  # fmt: skip
SHAPES = [("star", 4), ("star mixed", 4), ("star neumann", 4), ("ball", 4), ("step", 4), ("step", 8), ("cluster", 6),
          ("amoeba", 4), ("lattice step", 4)]  # fmt: skip
NONLINEAR = [("bratu 1D", 8), ("quasilinear", 4), ("burgers", 4)]
SYSTEMS = [
    ("elasticity", 4), ("kirsch", 6), ("cantilever", 4), ("stokes", 6), ("reaction-diffusion", 4), ("elasticity 3D", 4)
]  # fmt: skip


@pytest.mark.parametrize(("name", "order"), [*LINEAR, *SHAPES, *NONLINEAR, *SYSTEMS])
def test_error_is_below_its_ceiling(name, order):
    line = run(replace(CASES[name], coarse=None), order, estimate=False)
    assert not missed(line), shown(line)


def test_newton_keeps_the_order():
    line = run(CASES["bratu 2D"], 4, estimate=False)
    assert not missed(line), shown(line)
    assert line["rate"] > 3.5


@pytest.mark.parametrize(("name", "form"), [("heat", "lsq"), ("diffusion", "loo"), ("wave", "lsq"), ("u_xy", "lsq")])
def test_global_form_follows_the_operator(name, form):
    """Where information travels, in time too, least squares; elliptic equations, leave-one-out."""
    assert CASES[name].solve(4 if name != "wave" else 6).stats["formulation"] == form


@pytest.mark.parametrize("name", ["anisotropy", "heat"])
def test_error_estimate_knows_size_and_place(name):
    case = CASES[name]
    assert good(estimated(case, case.solve(4)))


@pytest.mark.parametrize("name", ["step", "cluster"])
def test_nearest_neighbours_alone_fail_where_the_density_jumps(name):
    """The ceilings of these clouds ask for the repair of weak stencils."""
    case = CASES[name]
    cloud = case.cloud()
    plain = case.solve(6, cloud, stencils=js.stencils(cloud, size=28), throw=False)
    assert plain.stats["lebesgue_max"] > 100
    assert not case.error(plain) < 10 * case.error(case.solve(6, cloud))


def test_a_wrong_solution_misses():
    """The measure itself: an error of 1e-4 in one of two fields is seen, a constant in a floating field is not."""
    case = CASES["stokes"]
    cloud = case.cloud()
    true = case.values(cloud.points)

    class Fake:
        u = true + np.array([0.0, 0.0, 7.0])

    Fake.cloud = cloud
    assert case.error(Fake) == 0.0
    assert np.abs(case.errors(Fake)).max() < 1e-14
    Fake.u = true * np.array([1.0, 1.0 + 1e-4, 1.0])
    assert np.isclose(case.error(Fake), 1e-4)
