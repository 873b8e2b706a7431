"""Factorisations of real and of complex matrices, kept among those of the package, solved with as they are."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.linear import linsolve


class ComplexFactor:
    """The factors of P + i Q as those of the real matrix [P, -Q; Q, P]; the transpose is not conjugated."""

    def __init__(self, entries: tuple[Any, Any, Any], n: int, points: np.ndarray | None):
        values, rows, cols = entries
        real, imag = values.real, values.imag
        self._factor = linsolve.factor(
            np.concatenate([real, real, -imag, imag]), np.concatenate([rows, rows + n, rows, rows + n]),
            np.concatenate([cols, cols + n, cols + n, cols]), 2 * n,
            None if points is None else np.concatenate([points, points]), "sparse", False, 0,
        )  # fmt: skip
        self.n = n

    def solve(self, b: np.ndarray, transpose: bool = False) -> np.ndarray:
        # The real transpose is that of the conjugate.
        b = b.conj() if transpose else b
        x = self._factor.plain(np.concatenate([b.real, b.imag]), transpose)
        x = x[: self.n] + 1j * x[self.n :]
        return x.conj() if transpose else x


class RealFactor:
    """A factorisation of a real matrix."""

    def __init__(self, entries: tuple[Any, Any, Any], n: int, points: np.ndarray | None):
        self._factor = linsolve.factor(*entries, n, points, "sparse", False, 0)

    def solve(self, b: np.ndarray, transpose: bool = False) -> np.ndarray:
        return self._factor.plain(b, transpose)
