"""Pieces of a cloud side by side: the same numbers, one compilation, the caller's precision, errors passed on."""

import threading

import jax
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm import assembly, rows, threads

SIDES = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
PROBLEM = js.Problem(lambda u, x: (1.0 + x[0]) * js.laplacian(u)(x) + 1.0, SIDES)  # no two particles alike


@pytest.fixture
def two_cores(monkeypatch):
    monkeypatch.setattr(rows, "PIECE", 64)
    for module in (rows, threads):
        monkeypatch.setattr(module, "cores", lambda: 2)


def solved(seed):
    return js.solve(PROBLEM, js.rectangle((0, 0), (1, 1), (21, 21), jitter=0.2, seed=seed))


def test_pieces_make_the_whole_and_compile_once(two_cores, monkeypatch):
    before = assembly.TRACES["rows"]
    shared = solved(1)
    assert assembly.TRACES["rows"] == before + 1
    assert len(set(np.round(shared.u, 12))) > 300
    monkeypatch.setattr(rows, "cores", lambda: 1)
    alone = solved(1)
    np.testing.assert_allclose(shared.u, alone.u, rtol=1e-11)
    np.testing.assert_allclose(shared.coefficients, alone.coefficients, rtol=1e-12, atol=1e-9)


def test_work_is_done_in_other_threads(two_cores):
    names = list(threads.side_by_side(lambda _: threading.current_thread().name, range(6), "names"))
    assert names[0] == threading.main_thread().name and threading.main_thread().name not in names[1:]
    again = list(threads.side_by_side(lambda _: threading.current_thread().name, range(6), "names"))
    assert threading.main_thread().name not in again, "nothing is left to compile"


def test_the_precision_of_the_caller_holds(two_cores):
    narrow = jax.enable_x64 if hasattr(jax, "enable_x64") else jax.experimental.enable_x64
    with narrow(False):
        kinds = list(threads.side_by_side(lambda _: jax.numpy.ones(3).dtype, range(4), "kinds"))
    assert set(kinds) == {np.dtype(np.float32)}


def test_an_error_reaches_the_caller(two_cores):
    def fails(k):
        if k == 3:
            raise ValueError("the third")
        return k

    with pytest.raises(ValueError, match="the third"):
        list(threads.side_by_side(fails, range(6), "errors"))
