"""``jsmitsm.parallel`` against one process, with 2 and 3 of them; skipped where there is no MPI or PETSc."""

import importlib.util
import json
import os
import shutil
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


def run(processes, *script):
    """A script on so many processes, to its end."""
    allowed = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1",
               "OMPI_MCA_rmaps_base_oversubscribe": "1", "OMPI_MCA_mpi_yield_when_idle": "1",
               "PYTHONPATH": str(HERE.parent.parent)}  # fmt: skip
    command = ["mpiexec", "-n", str(processes), sys.executable, *script]
    return subprocess.run(command, env=os.environ | allowed, capture_output=True, text=True, timeout=900)


@pytest.fixture(scope="module", params=[2, 3])
def found(request):
    """What on_several.py found with so many processes; all of it in one run, since each start takes seconds."""
    done = run(request.param, str(HERE / "on_several.py"))
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.strip().splitlines()[-1]) | {"processes": request.param}


def test_rows_are_those_of_one_process(found):
    # Sums of 15 terms below one in another order differ by less than 1e-14.
    assert found["rows"] < 1e-14
    # Weights of weak stencils reach several units.
    assert found["graded rows"] < 1e-13


def test_values_are_those_of_one_process(found):
    # Round-off times the condition of a system of 400 unknowns, some 1e3.
    for name in ("values gamg", "values mumps", "graded", "kernel", "III", "system", "cube", "read"):
        assert found[name] < 1e-11, name
    assert found.get("values hypre", 0.0) < 1e-11


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


def test_the_estimate_is_that_of_one_process(found):
    assert found["estimate"] < 1e-8


def test_newton_takes_the_steps_of_one_process(found):
    assert found["newton"] < 1e-11 and found["newton anywhere"] < 1e-11
    assert found["steps"][0] == found["steps"][1] > 3


def test_factors_are_kept(found):
    assert found["factorize"] < 1e-11 and found["kept"]


def test_heat_is_that_of_one_process(found):
    # Rounding of three steps, each of which solves four systems to a backward error of 1e-15.
    assert found["heat"] < 1e-11 and found["times"] == [0.0, 0.25, 0.5]


def test_modes_are_those_of_one_process(found):
    if "modes" not in found:
        pytest.skip("modes need slepc4py")
    # Vectors lose the digits that a residual of 1e-13 leaves, over the gap to the next value.
    assert found["values of modes"] < 1e-11 and found["modes"] < 1e-9


def test_parts_of_a_shape_are_the_whole(found):
    assert found["filled"] == 0.0
    assert found["on a shape"] < 1e-3  # of order 2 at a spacing of 0.05, where 2e-4 was measured


def test_the_failure_of_one_ends_all_with_its_message():
    done = run(2, "-c", "import jsmitsm.parallel as jp, mpi4py.MPI as m\njp.norm([1.0])\n"
               "if m.COMM_WORLD.rank: raise RuntimeError('the second one fell')\njp.norm([1.0])")  # fmt: skip
    assert done.returncode != 0
    assert "process 1 of 2" in done.stderr and "the second one fell" in done.stderr


def test_gradients_are_those_of_one_process(found):
    assert found["value"] < 1e-9 and found["gradient"] < 1e-9
    # Central differences of step 1e-5 have errors of round-off over the step, and of its square.
    assert found["by points"] < 1e-6


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
        assert set(mesh.point_data) == {"u", "error"}
    assert abs(area - 1.0) < 1e-12


@pytest.mark.parametrize(
    "what, words",
    [
        ("floating", "nothing fixes"), ("nonlinear", "nonlinear"), ("II", "'II' is none of"),
        ("periodic", "js.periodic is not made"), ("in time", "nonlinear problems in time"), ("lattice", "jp.read"),
        ("first order", "information travels"), ("one process", "on process 0"), ("array", "shape (3,)"),
        ("mass", "write the operator"),
    ],
)  # fmt: skip
def test_what_is_not_made_is_refused_in_words(found, what, words):
    if what == "one process":  # the one that failed says it without
        words = "expected a js.Cloud"
    if what == "mass" and "modes" not in found:
        pytest.skip("modes need slepc4py")
    assert words in found["refused"][what]
