"""The global matrix of a linear problem and its factor, kept for further right-hand sides."""

from __future__ import annotations

from typing import Any, NoReturn

import numpy as np

from jsmitsm.runtime.tracers import is_traced
from jsmitsm.solution.run import Run


class KeptMatrix:
    """What prepared problems have in common, on a cloud of one region or of several."""

    def __init__(self, matrix: tuple[Any, Any, Any]):
        self._matrix = matrix  # entries, rows and columns
        self._factor: Any = None  # kept as long as this is, whatever else is solved

    def _solved(self, run: Run, right: Any) -> tuple[Any, bool]:
        """The unknowns for one more right-hand side, and whether they can be trusted."""
        x, good = run.solved(*self._matrix, right)
        if self._factor is None and not is_traced(self._matrix, x):
            self._factor = run.factor_of(*self._matrix)
        return x, good

    def __reduce__(self):
        raise TypeError(
            "a Factorization is not pickled, nor copied: keep the problem and the cloud, and call js.factorize again"
        )


def same_matrix(new: Any, old: Any) -> bool:
    """Whether the matrix of some numbers, of one region or of several, is that of others; not known of traced ones."""
    pairs = list(zip(new.of_matrix, old.of_matrix, strict=True))
    return not is_traced(pairs) and all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)


def refuse_nonlinear(disc: Any, verb: str = "js.solve") -> None:
    """A discretised problem, of one region or of several, whose matrix is not one and the same."""
    if not disc.linear:
        raise ValueError(f"problem: it is nonlinear, so its matrix changes in every step; use {verb}")


def refuse_other() -> NoReturn:
    """A problem of another form than the one that was prepared."""
    raise ValueError(
        "problem: its operator or the kind of its conditions differs from the one that was factorised; "
        "call js.factorize again"
    )
