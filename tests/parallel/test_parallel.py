"""``jsmitsm.parallel`` against one process, with 2 and 3 of them; skipped where there is no MPI or PETSc."""

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest

HERE = Path(__file__).parent
MISSING = [name for name in ("mpi4py", "petsc4py") if importlib.util.find_spec(name) is None]
MISSING += [] if shutil.which("mpiexec") else ["mpiexec"]
pytestmark = pytest.mark.skipif(bool(MISSING), reason=f"several processes need {', '.join(MISSING)}")


def begun(processes, *script, **more):
    """A script on so many processes."""
    allowed = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1",
               "OMPI_MCA_rmaps_base_oversubscribe": "1", "OMPI_MCA_mpi_yield_when_idle": "1",
               "MPIR_CVAR_POLLS_BEFORE_YIELD": "1", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
               "PYTHONPATH": str(HERE.parent.parent)}  # fmt: skip
    command = ["mpiexec", "-n", str(processes), sys.executable, *script]
    return subprocess.Popen(
        command, env=os.environ | allowed | more, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Folders that the runs share: what one process finds, and compiled programs."""
    return tmp_path_factory.mktemp("alone"), tmp_path_factory.mktemp("programs")


@pytest.fixture(scope="module", params=[2, 3])
def found(request, kept):
    """What on_several.py found with so many processes; all of it in one run, since each start takes seconds."""
    what = "whole" if request.param == 2 else "some"
    done = begun(request.param, str(HERE / "on_several.py"), str(kept[0]), what, JAX_COMPILATION_CACHE_DIR=str(kept[1]))
    out, err = done.communicate(timeout=900)
    assert done.returncode == 0, err[-3000:]
    return json.loads(out.strip().splitlines()[-1]) | {"processes": request.param}


@pytest.fixture
def of_two(found):
    """Of two processes alone, what does not hang on their number."""
    if found["processes"] != 2:
        pytest.skip("asked of two processes")
    return found


def test_rows_are_those_of_one_process(found):
    # Sums of 15 terms below one in another order differ by less than 1e-14.
    assert found["rows"] < 1e-14
    # Weights of weak stencils reach several units.
    assert found["graded rows"] < 1e-13


def test_values_are_those_of_one_process(found):
    # Round-off times the condition of a system of 400 unknowns, some 1e3.
    for name in ("values gamg", "graded", "read", "reaction"):
        assert found[name] < 1e-11, name


def test_so_they_are_by_other_solvers_methods_and_problems(of_two):
    for name in ("values mumps", "kernel", "III", "system", "cube", "axis"):
        assert of_two[name] < 1e-11, name
    assert of_two.get("values hypre", 0.0) < 1e-11
    assert of_two["repaired on the axis"] == 2


def test_particles_are_shared_evenly(found):
    # A column of the lattice stays together.
    assert sum(found["own"]) == 400 and max(found["own"]) - min(found["own"]) <= 20
    assert len(found["own"]) == found["processes"]


def test_the_same_stencils_are_repaired(found):
    assert found["repaired"][0] == found["repaired"][1] and found["repaired"][0]


def test_multigrid_takes_few_iterations(found):
    assert 1 <= found["iterations gamg"] <= 10 and found.get("iterations hypre", 1) <= 8


def test_the_solution_anywhere(found):
    assert found["anywhere"] < 1e-11
    assert found["slopes"] < 1e-9  # a derivative divides by the spacing


def test_the_estimate_is_that_of_one_process(of_two):
    assert of_two["estimate"] < 1e-8


def test_flags_are_those_of_one_process(of_two):
    (healthy, alone), (told, same) = of_two["steady flags"]
    assert healthy == alone == []
    assert told == same and len(told) > 1


def test_newton_takes_the_steps_of_one_process(of_two):
    assert of_two["newton"] < 1e-11
    assert of_two["steps"][0] == of_two["steps"][1] > 3


def test_factors_are_kept(of_two):
    assert of_two["factorize"] < 1e-11 and of_two["kept"]


def test_time_is_that_of_one_process(of_two):
    # Newton's stages end where the state changes by 1e-11 of itself.
    assert of_two["reacting"] < 1e-10 and of_two["times"] == [0.0, 0.01, 0.02]
    assert of_two["pencils"][0] == of_two["pencils"][1] > 1 and of_two["flags"][0] == of_two["flags"][1]


def test_modes_are_those_of_one_process(of_two):
    if "modes" not in of_two:
        pytest.skip("modes need slepc4py")
    # Vectors lose the digits that a residual of 1e-13 leaves, over the gap to the next value.
    assert of_two["values of modes"] < 1e-11 and of_two["modes"] < 1e-9
    # One process takes what is missed to first order, several the difference of the values themselves: at order 2 on
    # 144 particles a quarter apart.
    assert of_two["errors of modes"] < 0.5


def test_parts_of_a_shape_are_the_whole(found):
    assert found["filled"] == 0.0 and found["dealt"] == 0.0


def test_what_ends_one_ends_all():
    """Runs at a time, whose second process falls, leaves, works while the other waits in MPI, or goes on without it."""
    start = "import jsmitsm.parallel as jp, mpi4py.MPI as m, time, sys\nif m.COMM_WORLD.rank: "
    fails = begun(2, "-c", start + "raise RuntimeError('the second one fell')\njp.norm([1.0])")
    leaves = begun(2, "-c", start + "jp.norm([1.0]); sys.exit(0)\njp.norm([1.0]); jp.norm([2.0])")
    drifts = begun(2, "-c", "\n".join([
        "from jsmitsm.parallel.team import collective, team",
        "def meets(fails): 1 / (not fails); return team().gather(1)",
        "try: collective(meets)(team().rank == 1)",
        "except ZeroDivisionError: pass",
        "collective(meets)(False)",
    ]))  # fmt: skip
    waits = begun(2, "-c", start + "print('begun', flush=True); time.sleep(600)\njp.norm([1.0])")
    assert waits.stdout.readline().strip() == "begun"
    waits.send_signal(signal.SIGINT)  # what Ctrl-C sends
    assert waits.wait(timeout=60) != 0
    for run, words in ((fails, ("the second one fell", "process 1 of 2 ends them all")),
                       (leaves, ("the script ended, while other processes go on", "on process 1 of 2")),
                       (drifts, ("process 1 of 2 has gone on to another call",))):  # fmt: skip
        _, said = run.communicate(timeout=120)
        assert run.returncode != 0
        assert all(some in said for some in words), said


def test_gradients_are_those_of_one_process(of_two):
    # Differences of step 5e-4 and fourth order miss some 1e-11.
    assert of_two["value"] < 1e-11 and of_two["gradient"] < 1e-9 and of_two["nonlinear gradient"] < 1e-9
    # Central differences of step 1e-5 have errors of round-off over the step, and of its square.
    assert of_two["by points"] < 1e-6


def test_files(found):
    """All pieces together have the triangles of the square, each once."""
    folder = Path(found["folder"])
    assert (folder / "u.pvtu").read_text().count("<Piece") == found["processes"]
    area = 0.0
    for rank in range(found["processes"]):
        mesh = meshio.read(folder / f"u_{rank}.vtu")
        corners = mesh.points[mesh.cells[0].data][..., :2]
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area += np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2.0
        assert set(mesh.point_data) == {"u", "twice"}
    assert abs(area - 1.0) < 1e-12


def test_hdf5(found):
    """Particles come back as they were written, and the cells cover the square."""
    if "hdf5" not in found:
        pytest.skip("HDF5 needs h5py")
    assert found["hdf5"] == 0.0 and found["hdf5 groups"] == 0.0
    mesh = meshio.read(Path(found["folder"]) / "v.xdmf")
    assert set(mesh.point_data) == {"u", "twice"}
    x, cells = mesh.points, mesh.cells[0].data
    a, b = x[cells[:, 1]] - x[cells[:, 0]], x[cells[:, 2]] - x[cells[:, 0]]
    assert abs(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2.0 - 1.0) < 1e-12
    # Of order 2 at a spacing of 0.05.
    assert np.abs(mesh.point_data["u"] - np.sin(2.0 * x[:, 0]) * np.exp(x[:, 1])).max() < 2e-2
    np.testing.assert_array_equal(mesh.point_data["twice"], 2.0 * mesh.point_data["u"])


@pytest.mark.parametrize(
    "what, words",
    [
        ("floating", "nothing fixes"), ("nonlinear", "nonlinear"), ("II", "'II' is none of"),
        ("periodic", "js.periodic is not made"), ("in time", "'radau' is none of"), ("a line", "in 1D"),
        ("first order", "information travels"), ("one process", "on process 0"), ("array", "shape (3,)"),
        ("mass", "write the operator"), ("axis", "lose their weight"),
        ("by params", "JAX transform"), ("by start", "JAX transform"),
    ],
)  # fmt: skip
def test_what_is_not_made_is_refused_in_words(of_two, what, words):
    if what == "one process":  # the one that failed says it without
        words = "expected a js.Cloud"
    if what == "mass" and "modes" not in of_two:
        pytest.skip("modes need slepc4py")
    assert words in of_two["refused"][what]
