"""Progress bars: one at a time, only where someone watches, and off when asked."""

import io
import sys
import threading
import time

import jax
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.discretization import sharing
from jsmitsm.linear import backends
from jsmitsm.runtime import progress

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
    monkeypatch.setattr(progress, "PAUSE", 0.0)
    monkeypatch.setattr(sharing, "PIECE", 4)
    monkeypatch.setattr(sys, "stderr", Terminal())
    return sys.stderr.getvalue


def told(seen):
    """What stood at the beginning of the bars that were drawn, in order, without repetitions."""
    lines = [line.split("[")[0].strip() for line in seen().split("\r")]
    return [line for line, before in zip(lines, [None, *lines]) if line and line != before]


def tuned(**options):
    start = js.SuperGaussian(h=2 * LINE.spacing, d=4.0)
    return js.tune(LINEAR, LINE, start, method="SSPH", order=2, steps=2, **options)


def test_every_long_phase_is_a_stage_of_one_bar(monkeypatch):
    seen = watch(monkeypatch)
    whole = js.solve(LINEAR, LINE, solver="iterative")
    iterative = "ilu" if not backends.installed("pyamg") else "amg"
    assert all(line.startswith("solve") for line in told(seen))
    for stage in ("solve, local fits 27%", f"solve, {iterative} on 15 unknowns", "solve, iterative solve 1"):
        assert stage in told(seen)
    with js.no_progress():
        at_once = js.solve(LINEAR, LINE, solver="iterative")
    assert np.allclose(whole.u, at_once.u, rtol=1e-12, atol=0), "the pieces are the whole"


def test_bars_of_everything_else_that_can_be_long(monkeypatch):
    seen = watch(monkeypatch)
    sol = js.solve(LINEAR, LINE, formulation="lsq")
    assert "solve, local fits 27%" in told(seen)
    with js.no_progress():
        assert np.allclose(sol.u, js.solve(LINEAR, LINE, formulation="lsq").u, rtol=1e-10, atol=0)
    sol = js.solve(BRATU, LINE)
    assert "solve, Newton steps 1, local fits 27%" in told(seen)
    coefficients, parts = sol.coefficients, told(seen)
    assert "fitting, Taylor coefficients 24%" in parts
    with js.no_progress():
        assert np.allclose(coefficients, js.solve(BRATU, LINE).coefficients, rtol=1e-9, atol=1e-12)
    sol.error_estimate()
    assert "error estimate, local fits 27%" in told(seen)
    js.factorize(LINEAR, LINE).solve(LINEAR)
    js.stencils(LINE, size=5)
    js.from_polygon([(0, 0), (1, 0), (0, 1)], 0.2)
    js.continuation(lambda c: js.Problem(lambda u, x: js.laplacian(u)(x) + c, ENDS), LINE, [1.0, 2.0])
    assert {"factorize, local fits 27%", "neighbours", "cloud"} <= set(told(seen))
    assert any(line.startswith("continuation:") and "1/2" in line for line in told(seen))


def test_a_search_shows_one_bar_and_none_of_its_solves(monkeypatch):
    seen = watch(monkeypatch)
    tuned()
    assert {line.split(":")[0] for line in told(seen)} == {"tune"} and "objective" in seen()


def test_the_clock_goes_on_while_one_call_says_nothing_and_stops_with_it(monkeypatch):
    seen = watch(monkeypatch)
    monkeypatch.setattr(progress, "TICK", 0.01)
    with pytest.raises(KeyboardInterrupt), progress.bar("deep in Fortran"):
        time.sleep(0.2)
        assert seen().count("deep in Fortran") > 3
        assert "clock of deep in Fortran" in [thread.name for thread in threading.enumerate()]
        raise KeyboardInterrupt
    assert not any(thread.name.startswith("clock of") for thread in threading.enumerate())
    with progress.bar("next"):
        pass
    assert told(seen)[-1] == "next", "an exception leaves no bar behind to be a stage of"


def test_a_notebook_shows_bars_and_still_has_its_numbers(monkeypatch):
    """In a real kernel: a bar on its stderr, none of it left, and silence in a block that asks for it."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    monkeypatch.delenv("PYTEST_CURRENT_TEST", raising=False)
    code = """
import sys
import jsmitsm as js
from jsmitsm.runtime import progress
seen, write = [], sys.stderr.write
sys.stderr.write = lambda text: (seen.append(text), write(text))[1]
progress.DELAY = progress.PAUSE = 0.0
with js.no_progress(), progress.bar("silent"):
    pass
with progress.bar("outer") as shown:
    with progress.bar("inner", 4) as stage:
        stage.update(2)
print([text.strip() for text in seen if "inner" in text or "silent" in text][-1].split(" [")[0])
"""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)])
    nbclient.NotebookClient(notebook, timeout=120).execute()
    text = {out.name: out.text for out in notebook.cells[0].outputs}
    assert text["stdout"] == "outer, inner 50%\n" and text["stderr"].strip() == "", "the bar is wiped out in the end"


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


def test_solves_in_threads_of_their_own_show_no_bars(monkeypatch):
    seen = watch(monkeypatch)
    thread = threading.Thread(target=js.stencils, args=(LINE,), kwargs={"size": 5})
    thread.start()
    thread.join()
    assert seen() == ""


def test_a_compiled_solve_is_not_cut_up(monkeypatch):
    seen = watch(monkeypatch)
    near = js.stencils(LINE, size=6)
    jax.jit(lambda c: js.solve(LINEAR, LINE, stencils=near, solver="dense").u * c)(2.0).block_until_ready()
    assert "local fits 27%" not in seen()


def test_the_rest_of_a_whole_call_is_told_by_its_parts(monkeypatch):
    """Half of the first of two parts is a quarter of the call, so that three times what is gone is left."""
    seen = watch(monkeypatch)
    with progress.bar("solve", parts=(("local fits", 1.0), ("unknowns", 1.0))) as shown:
        shown._bar.start_t -= 60.0
        with progress.bar("neighbours"):
            assert "[01:00<?]" in seen()
        with progress.bar("local fits", 4) as stage:
            stage.start -= 60.0
            stage.update(2)
            assert "solve, local fits 50% [01:00<03:00] 25%" in seen()
        with progress.bar("cholmod on 9 unknowns"):
            assert "cholmod on 9 unknowns [01:00<01:00] 50%" in seen()


def test_long_calls_tell_their_rest(monkeypatch):
    """The parts that they name are the stages that they have."""
    whole = {}

    def seen(self, part):
        whole.setdefault(self.what, []).append(part)

    watch(monkeypatch)
    monkeypatch.setattr(progress._Bar, "reach", seen)
    sol = js.solve(LINEAR, LINE, order=2, solver="sparse")
    sol.error_estimate()
    modes = js.eigen(js.Problem(lambda u, x: -js.laplacian(u)(x), ENDS), LINE, 2, order=2)
    with js.no_progress():
        found = js.eigen(js.Problem(lambda u, x: -js.laplacian(u)(x), ENDS), LINE, 2, order=2)
    modes.error_estimate(), found.error_estimate()
    heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ENDS)
    run = js.evolve(heat, LINE, lambda x: x[0] * (1 - x[0]), t=(0.0, 0.1), steps=4, order=2)
    js.adapt(LINEAR, lambda h: js.interval(0.0, 1.0, spacing=h), 1e-4, start=0.2, order=2)
    assert set(whole) >= {"solve", "error estimate", "eigen", "evolve", "adapt"}
    for what in whole.keys() - {"error estimate", "eigen"}:
        assert max(whole[what]) > 0.99, f"{what} arrives"
    whole.clear()
    run.error_estimate()
    assert whole["error estimate"][-1] == 1.0


def test_what_has_begun_is_judged_by_its_time_and_not_by_its_share(monkeypatch):
    """Ten of a thousand steps took nine seconds, after one of preparation: 891 are left, whatever the shares say."""
    watch(monkeypatch)
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(progress._Bar, "elapsed", lambda self: now[0])
    with progress.bar("evolve", parts=(("local fits", 1.0), ("steps", 8.0))) as shown:
        with progress.bar("local fits", 4):
            now[0] = 1.0
        with progress.bar("steps", 1000) as stage:
            now[0] = 10.0
            stage.update(10)
            assert shown._foretold == pytest.approx(901.0)
            now[0] = 500.0
            shown._compiles(False)
            assert shown._bar.n == pytest.approx(500.0 / 901.0), "goes on by the clock where nothing reports"


def test_whatever_compiles_is_seen(monkeypatch):
    """The clock looks whether the caller's thread is in JAX's compiler: a program of the user's own is told too."""
    seen, here, done = [], threading.get_ident(), threading.Event()

    def clock():
        while not done.wait(1e-3):
            seen.append(progress.in_compiler(here))

    assert not progress.in_compiler(here)
    ticking = threading.Thread(target=clock)
    ticking.start()
    jax.jit(lambda x: sum(jax.numpy.sin(k * x) for k in range(60)))(1.0)
    done.set()
    ticking.join()
    assert any(seen)


def test_compiling_and_what_is_left_are_told(monkeypatch):
    """A stage that lasts tells the rest by what is done; a program's first run tells that it is compiled."""
    seen = watch(monkeypatch)
    monkeypatch.setattr(progress, "LASTING", 0.0)
    with progress.bar("solve"), progress.bar("rows", 4) as stage:
        with progress.first_call():
            pass
        stage.start -= 10.0
        stage.update(2)
    assert "solve, rows 0%, compiling (first call)" in told(seen) and "solve, rows 50%, 10 s left" in told(seen)
    with progress.bar("tune", 3) as outer, progress.bar("solve"), progress.first_call():
        outer.update(1)
    assert "tune" in told(seen)[-1] and progress.COMPILING in seen().rpartition("tune")[2]
