"""Which solvers there are, which suits a linear system, and whether that fits in memory."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import numpy as np

from jsmitsm.linear.backends import AMG, ILU, Lapack, Mixed, Pardiso, SuperLU, installed
from jsmitsm.linear.on_device import DeviceAMG
from jsmitsm.runtime.errors import SolveError
from jsmitsm.runtime.threads import cores

BACKENDS: dict[str, Callable[[Any], Any]] = {
    "lapack": Lapack,
    "nested dissection": lambda matrix: SuperLU(matrix, ordered=True),
    "pardiso": Pardiso,
    "float32 factors": Mixed,
    "colamd": lambda matrix: SuperLU(matrix, ordered=False),
    "amg": AMG,
    "device amg": DeviceAMG,
    "ilu": ILU,
}
ITERATIVE = ("amg", "device amg", "ilu", "float32 factors")

# Unknowns up to which LAPACK is asked. It beats the sparse codes a little further, but uses several
# threads there, which on a busy machine wait for one another a hundred times longer than they work.
DENSE_MAX = 140
# Unknowns from which multigrid was faster than LU, refined to round-off and with one adjoint solve.
ITERATIVE_MIN = {2: 200_000, 3: 6_000}
# Unknowns from which factors in float32, with refinement, were faster than those in float64.
MIXED_MIN = 15_000
# Unknowns from which PARDISO on two cores was faster than either.
PARDISO_MIN = {2: 200_000, 3: 2_000}


def choose_backends(n: int, nnz: int, points: np.ndarray | None, solver: str, elliptic: bool) -> list[str]:
    """Backends to be tried in turn."""
    if solver == "dense" or (solver == "auto" and n <= DENSE_MAX):
        return ["lapack"]
    # Without coordinates there is no good order, so the direct solver finds its own.
    direct = ["colamd"] if points is None or n <= DENSE_MAX else ["nested dissection", "colamd"]
    dim = 2 if points is None else points.shape[1]
    if n >= PARDISO_MIN.get(dim, n + 1) and cores() > 1 and installed("pypardiso"):
        direct = ["pardiso", "colamd"]
    needed, there = estimate_memory(n, nnz, dim), _memory()
    too_large = needed > 0.8 * there
    multigrid = "amg" if jax.default_backend() == "cpu" else "device amg"
    iterative = [multigrid] if installed("pyamg") else ["ilu"]
    bordered = points is not None and bool(np.isnan(points).any())
    if solver == "auto" and elliptic and not bordered:
        if too_large or (n >= ITERATIVE_MIN.get(dim, n + 1) and iterative == [multigrid]):
            solver = "iterative"
        elif n >= MIXED_MIN and direct[0] == "nested dissection":
            solver = "mixed"
    if solver == "iterative":
        return iterative if too_large else iterative + direct
    if solver == "mixed" and points is not None and n > DENSE_MAX and 0.7 * needed <= 0.8 * there:
        return ["float32 factors"] if too_large else ["float32 factors", *direct]
    if too_large:
        raise SolveError(
            f"the direct solver would need about {needed / 1e9:.1f} GB for {n} unknowns, of {there / 1e9:.1f} GB of "
            'memory; use solver="iterative", fewer particles or a lower order'
        )
    return direct


def estimate_memory(n: int, nnz: int, dim: int) -> int:
    """Bytes the direct solver needs for n unknowns and nnz entries in `dim` dimensions, roughly.

    Fitted to nested dissection of meshless matrices with 12 to 100 entries a row (1e4 to 4e5
    unknowns in 2D, 4e3 to 5e4 in 3D), within some 25%: with s = nnz / n entries a row, the factors
    have n s (1.3 log2 n - 8) entries in 2D and 0.45 n^1.45 s^0.9 in 3D, of 12 bytes each, and the
    matrix and its copies take 50 bytes an entry. The iterative solver needs no more than about 70
    bytes for every entry of the matrix.

    Example:
      >>> round(estimate_memory(102_400, 2_037_720, 2) / 1e6)
      435
    """
    n, per_row = max(int(n), 2), nnz / max(int(n), 1)
    if dim >= 3:
        fill = 0.45 * n**1.45 * per_row**0.9
    elif dim == 2:
        fill = n * per_row * max(1.3 * np.log2(n) - 8.0, 2.0)
    else:
        fill = 3.0 * nnz
    return int(12 * min(fill, float(n) * n) + 50 * nnz)


def assembly_memory(entries: int) -> int:
    """Bytes that the rows of all particles and the global matrix need, for so many entries in them.

    Fitted to 1.4e4 to 1.6e5 particles with 16 to 40 neighbours, 2D and 3D: the rows, the triplets and
    their copies take 84 to 90 bytes an entry beyond the compiled programs.
    """
    return 90 * int(entries)


def refuse_too_large(
    n: int, entries: int, points: np.ndarray | None, solver: str, elliptic: bool, made: int | None = None
) -> None:
    """Raise SolveError where a system of n unknowns would not fit in memory, before any of it is made.

    entries: of its matrix; made: those of the matrix and of what it is assembled from, where they are more.
    """
    needed, there = assembly_memory(entries if made is None else made), _memory()
    if needed > 0.8 * there:
        raise SolveError(
            f"the rows and the matrix would need about {needed / 1e9:.2g} GB for {n} unknowns, of {there / 1e9:.2g} GB "
            "of memory; use fewer particles, a lower order or smaller supports"
        )
    choose_backends(n, entries, points, solver, elliptic)


@cache
def _memory() -> float:
    """Bytes of memory that the machine, or the container, has; infinite where it cannot be known."""
    sizes = [float("inf")]
    try:
        sizes.append(float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")))
    except (AttributeError, ValueError, OSError):
        pass
    try:
        with open("/sys/fs/cgroup/memory.max") as limit:
            sizes.append(float(limit.read()))
    except (OSError, ValueError):  # no such limit, or "max"
        pass
    return min(sizes)
