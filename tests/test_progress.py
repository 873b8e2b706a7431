"""Progress bars: one at a time, only where someone watches, and off when asked."""

import io
import sys

import jax
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm import progress

pytest.importorskip("tqdm")
ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
LINE = js.interval(0.0, 1.0, 17)
LINEAR = js.Problem(lambda u, x: (1.0 + x[0]) * js.laplacian(u)(x) + 1.0, ENDS)  # no two particles alike
BRATU = js.Problem(lambda u, x: js.laplacian(u)(x) + jax.numpy.exp(u(x)), ENDS)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def watch(monkeypatch):
    """Sit at a terminal, bars without delay; what was seen. Not a fixture: pytest sets its variable after those."""
    monkeypatch.delenv("PYTEST_CURRENT_TEST", raising=False)
    monkeypatch.delenv("TQDM_DISABLE", raising=False)
    monkeypatch.setattr(progress, "DELAY", 0.0)
    monkeypatch.setattr(sys, "stderr", Terminal())
    return sys.stderr.getvalue


def tuned(**options):
    start = js.SuperGaussian(h=2 * LINE.spacing, d=4.0)
    return js.tune(LINEAR, LINE, start, order=3, steps=2, **options)


def test_every_long_phase_has_its_bar(monkeypatch):
    seen = watch(monkeypatch)
    monkeypatch.setattr(progress, "PIECE", 4)
    whole = js.solve(LINEAR, LINE, solver="iterative")
    assert "local fits" in seen() and "iterative solve" in seen()
    with js.no_progress():
        at_once = js.solve(LINEAR, LINE, solver="iterative")
    assert np.allclose(whole.u, at_once.u, rtol=1e-12, atol=0), "the pieces are the whole"
    js.solve(BRATU, LINE)
    assert "Newton steps" in seen()
    js.continuation(lambda c: js.Problem(lambda u, x: js.laplacian(u)(x) + c, ENDS), LINE, [1.0, 2.0])
    assert "continuation" in seen()


def test_a_search_shows_one_bar_and_none_of_its_solves(monkeypatch):
    seen = watch(monkeypatch)
    monkeypatch.setattr(progress, "PIECE", 4)
    tuned()
    assert "tune" in seen() and "local fits" not in seen()


def test_bars_can_be_turned_off(monkeypatch):
    seen = watch(monkeypatch)
    tuned(progress=False)
    with js.no_progress():
        js.solve(BRATU, LINE)
    monkeypatch.setenv("TQDM_DISABLE", "1")
    js.solve(BRATU, LINE)
    assert seen() == ""


def test_no_bar_in_a_pipe_nor_under_tests_nor_for_what_is_quick(monkeypatch):
    seen = watch(monkeypatch)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    js.solve(BRATU, LINE)
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("PYTEST_CURRENT_TEST", "here")
    js.solve(BRATU, LINE)
    assert seen() == sys.stderr.getvalue() == ""
    monkeypatch.delenv("PYTEST_CURRENT_TEST")
    monkeypatch.setattr(progress, "DELAY", 60.0)
    js.solve(BRATU, LINE)
    assert sys.stderr.getvalue() == ""


def test_a_compiled_solve_is_not_cut_up(monkeypatch):
    seen = watch(monkeypatch)
    monkeypatch.setattr(progress, "PIECE", 4)
    near = js.stencils(LINE, size=6)
    jax.jit(lambda c: js.solve(LINEAR, LINE, stencils=near, solver="dense").u * c)(2.0).block_until_ready()
    assert "local fits" not in seen()
