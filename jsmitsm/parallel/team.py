"""The processes of one run: what they tell one another, and how the failure of one becomes that of all."""

from __future__ import annotations

import atexit
import ctypes
import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from functools import cache, wraps
from importlib import import_module
from importlib.util import find_spec
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from jsmitsm.runtime.errors import SolveError, explaining, some

_Function = TypeVar("_Function", bound=Callable[..., Any])

# Seconds that the others leave the first process for the message, and that the launcher has to pass it on.
PATIENCE, PASSED_ON = 5.0, 0.5
# Where launchers say how many processes they started: Open MPI's, MPICH's and Intel's, MVAPICH's, Slurm's.
LAUNCHED = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE", "SLURM_STEP_NUM_TASKS")
# What a process that left the script tells those that go on with it.
LEFT = ("SolveError", "the script ended, while other processes go on with it", ())
# The option of glibc's mallopt, and the bytes from which on an array is large.
_MMAP_THRESHOLD, _LARGE = -3, 1 << 18


def engine(name: str) -> Any:
    """mpi4py or petsc4py, or an error that says how to install them."""
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(
            f'{name} is needed for jsmitsm.parallel ({error}): install MPI and PETSc, then pip install "jsmitsm[mpi]"; '
            "see docs/parallel.md"
        ) from None


def give_back() -> None:
    """Memory that was let go, given back to the system: what comes next is of other sizes and would stand beside it."""
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "malloc_trim"):
        ctypes.CDLL(None).malloc_trim(0)


def _large_apart() -> None:
    """Large arrays are to come from the system one by one, and go back to it at once, whatever was let go before."""
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        ctypes.CDLL(None).mallopt(_MMAP_THRESHOLD, _LARGE)


class Elsewhere(SolveError):
    """Another process failed; its message."""


class Team:
    """The processes of a communicator, which all call the same functions in the same order."""

    def __init__(self, comm: Any):
        self.comm, self.rank, self.size = comm, comm.Get_rank(), comm.Get_size()
        self.calls = 0  # of public functions, by which all are seen to be in the same one

    def gather(self, value: Any) -> list[Any]:
        """The values of all processes, in their order; raises where one of them failed instead of coming here."""
        found = self.meet(None, value)
        failed = [(rank, fault) for rank, (fault, _, _) in enumerate(found) if fault is not None]
        if failed:
            rank, (kind, text, particles) = failed[0]
            raise _as_told(kind, f"{text} (on process {rank} of {self.size})", particles)
        calls = [call for _, call, _ in found]
        if min(calls) < max(calls):
            raise _as_told(
                "SolveError",
                f"process {calls.index(max(calls))} of {self.size} has gone on to another call, after an error of its "
                "own or without the others; all must call the same functions in the same order",
            )
        return [value for _, _, value in found]

    def meet(self, fault: Any, value: Any = None) -> list[Any]:
        """What every process says: its fault, the call it is in, a value."""
        return self.comm.allgather((fault, self.calls, value))

    def total(self, array: Any) -> Any:
        """The sum over all processes."""
        return sum(self.gather(array))

    def largest(self, numbers: dict[Any, Any]) -> dict[Any, Any]:
        """Of numbers by name the largest of all processes."""
        out: dict[Any, Any] = {}
        for mine in self.gather(numbers):
            for name, value in mine.items():
                out[name] = max(value, out.get(name, value))
        return out

    def most(self, value: float) -> float:
        return self.largest({"": value})[""]

    def phase(self, names: Any = None) -> Phase:
        """A ``with`` block of local work; see ``Phase``. names: numbers in the whole cloud of local particles."""
        return Phase(self, names)

    def trade(self, parcels: list[Any]) -> list[Any]:
        """To every process its parcel, from every process one."""
        self.gather(None)  # who failed says so here
        return self.comm.alltoall(parcels)


class Phase:
    """Local work in which any process may fail: all leave it with the error of the first that did.

    Inside, processes meet in ``Team.gather`` alone; one that failed comes to the others' next meeting and says so.
    """

    def __init__(self, team: Team, names: Any):
        self.team, self.names = team, names

    def __enter__(self) -> Team:
        return self.team

    def __exit__(self, kind: Any, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is None:
            self.team.gather(None)
        elif isinstance(error, Exception) and not getattr(error, "told", False):
            if isinstance(error, SolveError) and self.names is not None and len(error.particles):
                error.particles = tuple(np.asarray(self.names)[list(error.particles)].tolist())
                error.args = (f"{error.args[0]}; its numbers are those of the part of process {self.team.rank}, in the "
                              f"whole cloud they are {some(error.particles)}",)  # fmt: skip
            what = "SolveError" if isinstance(error, SolveError) else type(error).__name__
            self.team.meet((what, str(error), getattr(error, "particles", ())))
            error.told = True  # type: ignore[attr-defined]


def _as_told(kind: str, text: str, particles: tuple[int, ...] = ()) -> Exception:
    known: dict[str, type[Exception]] = {"ValueError": ValueError, "ImportError": ImportError, "TypeError": TypeError}
    error = known[kind](text) if kind in known else Elsewhere(text, particles)
    error.told = True  # type: ignore[attr-defined]
    return error


@cache
def team() -> Team:
    """The processes under mpiexec. From now on an error that leaves one of them ends them all, with its message."""
    mpi = engine("mpi4py.MPI")
    # A communicator of their own: what the script tells by another is not mistaken for theirs.
    found = Team(mpi.COMM_WORLD.Dup())
    _large_apart()
    if found.size > 1:
        end_together()
    return found


def collective(function: _Function) -> _Function:
    """``@collective``: a public function that all processes call together, explained as by ``@explaining``."""
    explained = explaining(function)

    @wraps(function)
    def counted(*args: Any, **options: Any) -> Any:
        team().calls += 1
        return explained(*args, **options)

    return counted  # type: ignore[return-value]


def launched_with_others() -> bool:
    """Whether this process is one of several that a launcher of MPI started, as far as the environment tells."""
    told = [os.environ.get(name, "") for name in LAUNCHED]
    several = any(one.isdecimal() and int(one) > 1 for one in told)
    return several and multiprocessing.parent_process() is None and find_spec("mpi4py") is not None


@cache
def end_together() -> None:
    """From now on a process that an error ends takes the others with it, and one that leaves tells them."""
    before = sys.excepthook

    def stop(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if getattr(error, "told", False) and team().rank:
            time.sleep(PATIENCE)  # the first process tells the error of all, and ends them
        before(kind, error, trace)
        world = engine("mpi4py.MPI").COMM_WORLD
        if world.Get_size() > 1:
            print(f"process {world.Get_rank()} of {world.Get_size()} ends them all", file=sys.stderr, flush=True)
            time.sleep(PASSED_ON)
            world.Abort(1)

    sys.excepthook = stop
    atexit.register(_leave)


def _leave() -> None:
    """Meet those that go on with the script, until all have left it: they would wait for this process for ever."""
    if engine("mpi4py.MPI").Is_finalized():
        return
    us = team()
    while any(fault != LEFT for fault, _, _ in us.meet(LEFT)):
        pass
