"""The package's own exceptions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


class SolveError(RuntimeError):
    """A solve that failed: a singular system, values that are not finite, no convergence.

    Attributes:
      particles: indices of the particles at fault, the worst first; empty where none can be named.

    Example:
      >>> str(SolveError("the system is singular at particle 3", particles=[3]))
      'the system is singular at particle 3'
    """

    def __init__(self, message: str, particles: Sequence[int] = ()) -> None:
        super().__init__(message)
        self.particles: tuple[int, ...] = tuple(int(i) for i in particles)


class SingularMatrix(SolveError):
    """A linear system without a unique finite solution; `unknowns` at fault, the worst first."""

    def __init__(self, message: str, unknowns: Any = ()) -> None:
        super().__init__(message)
        self.unknowns: tuple[int, ...] = tuple(int(i) for i in unknowns)


def some(index: Any, most: int = 6) -> str:
    """A short list of particle numbers (n,) for a message.

    >>> some([3, 1, 4], most=2)
    '[3, 1, ...]'
    """
    return f"[{', '.join(str(int(i)) for i in index[:most])}{', ...' if len(index) > most else ''}]"


def refuse_masked(value: Any, name: str) -> None:
    """Refuse a masked array with masked entries: as an ordinary array it would show what the mask hides.

    >>> import numpy as np
    >>> refuse_masked(np.ma.array([1.0, 2.0], mask=[False, True]), "points")
    Traceback (most recent call last):
      ...
    ValueError: points: 1 of its 2 entries are masked, as [1]; fill them (np.ma.filled) or drop them
    """
    if np.ma.isMaskedArray(value) and (hidden := np.ma.getmaskarray(value)).any():
        first = np.argwhere(hidden)[0].tolist()
        raise ValueError(
            f"{name}: {hidden.sum()} of its {hidden.size} entries are masked, as {first}; fill them (np.ma.filled) or "
            "drop them"
        )
