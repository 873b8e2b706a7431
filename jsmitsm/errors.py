"""The package's own exception."""

from __future__ import annotations

from collections.abc import Sequence


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
