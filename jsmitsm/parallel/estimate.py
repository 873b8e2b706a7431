"""The error estimate of js.Solution on several processes."""

from __future__ import annotations

import numpy as np

from jsmitsm.parallel.pencil.modes import ParallelModes, errors
from jsmitsm.parallel.solution import ParallelSolution
from jsmitsm.parallel.team import collective


@collective
def error_estimate(sol: ParallelSolution | ParallelModes) -> np.ndarray:
    """Estimated error |u - u_exact| at the own particles, or of eigenvalues; see ``js.Solution.error_estimate``.

    As there what leads to the solution by method S of order p + 2, or to that of a lower order where this knows more.

    Parameters
    ----------
    sol : ParallelSolution or ParallelModes
        What ``jp.solve`` found; or ``jp.eigen``, whose values are found once more by order p + 2.

    Returns
    -------
    array (n,) or (n, F), or (k,)
        In units of u, for this process's particles; of eigenvalues the same on all, for those of a cluster that of the
        cluster, and infinite where there is no other order.

    Raises
    ------
    ValueError
        Where order + 2 is beyond the highest.
    SolveError
        Where the system of the other order is not solved.

    Examples
    --------
    ``largest = jp.norm(jp.error_estimate(sol))``
    """
    if isinstance(sol, ParallelModes):
        return errors(sol)
    error = sol._corrected()
    return error[:, 0] if sol._recipe.fields == 1 else error
