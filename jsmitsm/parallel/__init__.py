"""Several processes, one problem: particles shared by bisection, rows as on one, solved under PETSc.

Imports show and what stands before it.

``import jsmitsm.parallel as jp``; run as ``mpiexec -n 4 python script.py``.
"""

from jsmitsm.parallel.distributed import ParallelCloud
from jsmitsm.parallel.estimate import error_estimate
from jsmitsm.parallel.factorization import ParallelFactorization, factorize
from jsmitsm.parallel.files.reading import read
from jsmitsm.parallel.files.saving import save
from jsmitsm.parallel.filling import cloud_from
from jsmitsm.parallel.gradient import value_and_grad
from jsmitsm.parallel.pencil.evolution import ParallelEvolution, evolve
from jsmitsm.parallel.pencil.modes import ParallelModes, eigen
from jsmitsm.parallel.solution import ParallelSolution, evaluate, norm
from jsmitsm.parallel.solving import solve
from jsmitsm.parallel.team import end_together, launched_with_others

__all__ = [
    "ParallelCloud", "ParallelEvolution", "ParallelFactorization", "ParallelModes", "ParallelSolution",
    "cloud_from", "eigen", "error_estimate", "evaluate", "evolve", "factorize", "norm", "read", "save", "solve",
    "value_and_grad",
]  # fmt: skip

if launched_with_others():
    end_together()
