"""The processes of one run: what they tell one another, and how the failure of one becomes that of all."""

from __future__ import annotations

import ctypes
import sys
import time
import traceback
from functools import cache
from importlib import import_module
from types import TracebackType
from typing import Any

import numpy as np

from jsmitsm.runtime.errors import SolveError, some

# Seconds that the others leave the first process for the message.
PATIENCE = 5.0
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

    def gather(self, value: Any) -> list[Any]:
        """The values of all processes, in their order; raises where one of them failed instead of coming here."""
        found = self.comm.allgather((None, value))
        failed = [(rank, fault) for rank, (fault, _) in enumerate(found) if fault is not None]
        if failed:
            rank, (kind, text, particles) = failed[0]
            raise _as_told(kind, f"{text} (on process {rank} of {self.size})", particles)
        return [value for _, value in found]

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
            self.team.comm.allgather(((what, str(error), getattr(error, "particles", ())), None))
            error.told = True  # type: ignore[attr-defined]


def _as_told(kind: str, text: str, particles: tuple[int, ...]) -> Exception:
    known: dict[str, type[Exception]] = {"ValueError": ValueError, "ImportError": ImportError, "TypeError": TypeError}
    error = known[kind](text) if kind in known else Elsewhere(text, particles)
    error.told = True  # type: ignore[attr-defined]
    return error


@cache
def team() -> Team:
    """The processes under mpiexec. From now on an error that leaves one of them ends them all, with its message."""
    mpi = engine("mpi4py.MPI")
    found = Team(mpi.COMM_WORLD)
    _large_apart()
    if found.size > 1:

        def stop(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
            if getattr(error, "told", False) and found.rank:
                time.sleep(PATIENCE)  # the first process tells the error of all, and ends them
            print(f"process {found.rank} of {found.size}:", file=sys.stderr)
            traceback.print_exception(kind, error, trace)
            sys.stderr.flush()
            found.comm.Abort(1)

        sys.excepthook = stop
    return found
