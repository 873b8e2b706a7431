"""The semidiscrete equations E y' + A y = F(t), of first order in time, and those of second order written so."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.pencil.sparse import Sparse, combined
from jsmitsm.evolution.space.factors import ComplexFactor, RealFactor
from jsmitsm.linear import linsolve
from jsmitsm.linear.sparse import Factor
from jsmitsm.runtime.tracers import is_traced

# A step of so small a part moves nothing that has a rate.
VANISHING = 1e-7


class System:
    """E y' + A y = F(t) for the n free unknowns.

    masses: (M1,), then y = u (n,); or (M1, M2) for M2 u'' + M1 u' + A u = F, then y = (u, u') (2n,). The second form
    is never made: its resolvent is that of A + M1 / h + M2 / h^2.
    """

    def __init__(self, stiffness: Sparse, masses: tuple[Sparse, ...], points: np.ndarray | None = None):
        self.stiffness, self.masses, self.points = stiffness, masses, points
        self.n = stiffness.shape[0]
        self._factors: dict[Any, Any] = {}

    @property
    def second(self) -> bool:
        return len(self.masses) == 2

    @property
    def size(self) -> int:
        return self.n * len(self.masses)

    @property
    def values(self) -> tuple[Any, ...]:
        """The values of all matrices, what may be differentiated."""
        return (self.stiffness.values, *(m.values for m in self.masses))

    def with_values(self, values: tuple[Any, ...]) -> System:
        masses = tuple(m.with_values(v) for m, v in zip(self.masses, values[1:]))
        return System(self.stiffness.with_values(values[0]), masses, self.points)

    def mass(self, y: Any) -> Any:
        """E y."""
        if not self.second:
            return self.masses[0].times(y)
        return _joined(y[: self.n], self.masses[1].times(y[self.n :]))

    def stiff(self, y: Any) -> Any:
        """A y."""
        if not self.second:
            return self.stiffness.times(y)
        u, v = y[: self.n], y[self.n :]
        return _joined(-v, self.stiffness.times(u) + self.masses[0].times(v))

    def mass_transposed(self, z: np.ndarray) -> np.ndarray:
        if not self.second:
            return self.masses[0].host_transposed @ z
        return np.concatenate([z[: self.n], self.masses[1].host_transposed @ z[self.n :]])

    def stiff_transposed(self, z: np.ndarray) -> np.ndarray:
        if not self.second:
            return self.stiffness.host_transposed @ z
        top, low = z[: self.n], z[self.n :]
        return np.concatenate([self.stiffness.host_transposed @ low, self.masses[0].host_transposed @ low - top])

    def force(self, f: Any) -> Any:
        """A force (n,) on the equations of the free unknowns, on those of y."""
        return f if not self.second else _joined((jnp if is_traced(f) else np).zeros_like(f), f)

    def resolvent(self, h: Any) -> Resolvent:
        """The inverse of E + h A, factorised once per h."""
        key = h if isinstance(h, (float, complex)) else None
        if key is None:
            return Resolvent(self, h)
        if key not in self._factors:
            self._factors[key] = Resolvent(self, h)
        return self._factors[key]

    def settled(self, h: Any) -> Resolvent:
        """The inverse of E. What has no rate holds after it too: there a vanishing part of a step h is taken."""
        none = self.undriven().any()
        return self.resolvent(VANISHING * h if none else jnp.zeros(()) if is_traced(h) else 0.0)

    @property
    def factorisations(self) -> int:
        return len(self._factors)

    def inverse(self, parts: list[tuple[Any, Any]], h: Any, kept: bool = True) -> tuple[Any, Any]:
        """The entries of a sum of factor * matrix, and what solves with it; None where the entries are traced.

        kept: among the factors of the package, for the next one that asks for the same.
        """
        entries = combined(parts)
        if is_traced(entries[0]):
            return entries, None
        if not kept:
            return entries, Factor(*entries, self.n, self.points, "sparse", False, 0)
        return entries, (ComplexFactor if isinstance(h, complex) else RealFactor)(entries, self.n, self.points)

    def largest(self, x: Any) -> float:
        """The largest size of a value, NaN where one is none."""
        return float(np.abs(x).max(initial=0.0))

    def undriven(self) -> np.ndarray:
        """The equations (size,) without any rate: what holds at every moment."""
        m = self.masses[-1]
        moved = np.zeros(self.n, bool)
        moved[m.rows if is_traced(m.values) else m.rows[np.asarray(m.values) != 0]] = True
        if self.second:
            return np.concatenate([np.zeros(self.n, bool), ~moved])
        return ~moved


def _joined(x: Any, y: Any) -> Any:
    return (jnp if is_traced(x, y) else np).concatenate([x, y])


class Resolvent:
    """Solves (E + h A) y = r, for a real or complex h, and with the transpose."""

    def __init__(self, system: System, h: Any):
        self.system, self.h = system, h
        parts = [(1.0, system.masses[-1]), (h if not system.second else h * h, system.stiffness)]
        if system.second:
            parts.append((h, system.masses[0]))
        self.entries, self._factor = system.inverse(parts, h)

    def _inner(self, r: Any, transpose: bool) -> Any:
        if self._factor is not None and not is_traced(r):
            return self._factor.solve(r, transpose)
        values, rows, cols = self.entries
        rows, cols = (cols, rows) if transpose else (rows, cols)
        return linsolve.solve(
            values, rows, cols, r, n=self.system.n, points=self.system.points, solver="sparse", elliptic=False, refine=0
        )

    def solve(self, r: Any) -> Any:
        if not self.system.second:
            return self._inner(r, False)
        # [I, -h; h A, M2 + h M1] (u, v) = (top, low)
        n, h = self.system.n, self.h
        top, low = r[:n], r[n:]
        v = self._inner(low - h * self.system.stiffness.times(top), False)
        return _joined(top + h * v, v)

    def solve_transposed(self, r: np.ndarray) -> np.ndarray:
        if not self.system.second:
            return self._inner(r, True)
        n, h = self.system.n, self.h
        top, low = r[:n], r[n:]
        b = self._inner(low + h * top, True)
        return np.concatenate([top - h * (self.system.stiffness.host_transposed @ b), b])
