"""Pieces of a cloud side by side: the same numbers, one compilation, the caller's precision, errors passed on."""

import threading
import time

import jax
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.discretization import sharing
from jsmitsm.particle import batches
from jsmitsm.runtime import threads

SIDES = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
PROBLEM = js.Problem(lambda u, x: (1.0 + x[0]) * js.laplacian(u)(x) + 1.0, SIDES)  # no two particles alike


@pytest.fixture
def two_cores(monkeypatch):
    monkeypatch.setattr(sharing, "PIECE", 64)
    for module in (sharing, threads):
        monkeypatch.setattr(module, "cores", lambda: 2)


def solved(seed):
    return js.solve(PROBLEM, js.rectangle((0, 0), (1, 1), (21, 21), jitter=0.2, seed=seed), order=2, depth=0)


def test_pieces_make_the_whole_and_compile_once(two_cores, monkeypatch):
    before = batches.TRACES["rows"]
    shared = solved(1)
    assert batches.TRACES["rows"] == before + 1
    assert len(set(np.round(shared.u, 12))) > 300
    monkeypatch.setattr(sharing, "cores", lambda: 1)
    alone = solved(1)
    np.testing.assert_allclose(shared.u, alone.u, rtol=1e-11)
    np.testing.assert_allclose(shared.coefficients, alone.coefficients, rtol=1e-12, atol=1e-9)


def named(_):
    time.sleep(0.02)
    return threading.current_thread().name


def test_this_thread_and_others_share_the_work(two_cores):
    here = threading.main_thread().name
    first = list(threads.side_by_side(named, range(1), lambda _: "names"))
    assert first == [here], "what must be compiled runs here"
    shared = list(threads.side_by_side(named, range(6), lambda _: "names"))
    assert here in shared and len(set(shared)) == 2
    assert set(threads.side_by_side(named, range(6), lambda k: ("names of", k))) == {here}, "all are compiled here"


def test_results_come_in_order_and_calls_inside_of_calls_end(two_cores):
    def inner(k):
        return list(
            threads.side_by_side(lambda j: time.sleep(0.001 * (j % 3)) or 10 * k + j, range(10), lambda _: "in")
        )

    for _ in range(3):
        rows = list(threads.side_by_side(inner, range(10), lambda _: "out"))
    assert np.ravel(rows).tolist() == list(range(100))


def test_results_are_handed_on_while_others_are_made(two_cores):
    """Another thread has done item 1 long before this one would be through with the rest: it moves a bar at once."""
    list(threads.side_by_side(lambda k: k, range(1), lambda _: "handed on"))
    seen = threading.Event()

    def made(k):
        if k != 1:
            time.sleep(0.1)
        return seen.wait(5.0) if k == 5 else True

    for k, result in enumerate(threads.side_by_side(made, range(6), lambda _: "handed on")):
        if k == 1:
            seen.set()
        assert result, "item 5 waited in vain for item 1 to arrive"


def test_who_looks_for_a_fault_gets_it_here(two_cores):
    list(threads.side_by_side(named, range(1), lambda _: "names"))
    with jax.debug_nans(True):
        assert set(threads.side_by_side(named, range(4), lambda _: "names")) == {threading.main_thread().name}


def test_flags_do_not_depend_on_how_the_cloud_was_cut(two_cores, monkeypatch):
    cloud = js.rectangle((0, 0), (1, 1), (21, 21))
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - jax.numpy.sin(8 * x[0]), SIDES)
    sol = js.solve(problem, cloud, method="I", order=2, kernel=js.Gaussian(2.2 * cloud.spacing, 2.0))
    monkeypatch.setattr(sharing, "cores", lambda: 1)
    assert isinstance(sol.flags, list)


def test_methods_of_two_stages_share_programs_too():
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)})
    counts = []
    for n in (150, 151, 153):
        before = batches.TRACES["rows"]
        js.solve(problem, js.interval(0.0, 1.0, n), method="II", order=4, kernel=js.Gaussian(2.2 / (n - 1), 2.0))
        counts.append(batches.TRACES["rows"] - before)
    assert counts[0] >= 2 and counts[1:] == [0, 0]


def test_the_precision_of_the_caller_holds(two_cores):
    narrow = jax.enable_x64 if hasattr(jax, "enable_x64") else jax.experimental.enable_x64
    with narrow(False):
        kinds = list(threads.side_by_side(lambda _: jax.numpy.ones(3).dtype, range(4), lambda _: "kinds"))
    assert set(kinds) == {np.dtype(np.float32)}


def test_an_error_reaches_the_caller(two_cores):
    def fails(k):
        if k == 3:
            raise ValueError("the third")
        return k

    for _ in range(2):  # from this thread, and from another
        with pytest.raises(ValueError, match="the third"):
            list(threads.side_by_side(fails, range(6), lambda _: "errors"))


def test_after_an_error_nothing_new_is_begun(two_cores):
    begun = []

    def fails(k):
        begun.append(k)
        time.sleep(0.05)
        if k == 0:
            raise ValueError("the first")

    list(threads.side_by_side(lambda k: k, range(1), lambda _: "cut short"))
    with pytest.raises(ValueError, match="the first"):
        list(threads.side_by_side(fails, range(100), lambda _: "cut short"))
    time.sleep(0.2)
    assert len(begun) < 10
