"""Multigrid and BiCGSTAB as one JAX program, for devices other than the CPU.

pyamg sets the hierarchy up on the host, as for the CPU; its cycle runs where JAX does. Gauss-Seidel sweeps, which go
from unknown to unknown, give way to Jacobi's.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.linear.backends import AMG
from jsmitsm.runtime.size_classes import padded_size

# Jacobi sweeps before and after each coarser level.
_SWEEPS = 2


class _Sparse(NamedTuple):
    """A sparse matrix by its entries, sorted by row; sizes are padded to classes, with entries of zero."""

    data: Any  # (nnz,)
    rows: Any  # (nnz,)
    cols: Any  # (nnz,)

    def times(self, x: Any, size: int) -> Any:
        """The product with x, of ``size`` rows."""
        return jax.ops.segment_sum(self.data * x[self.cols], self.rows, size, indices_are_sorted=True)


class _Level(NamedTuple):
    matrix: _Sparse
    smooth: Any  # (n,), what a residual is multiplied with
    prolong: _Sparse
    restrict: _Sparse


def _padded(matrix: Any) -> _Sparse:
    entries = matrix.tocsr().tocoo()
    more = (0, padded_size(entries.nnz) - entries.nnz)
    last = padded_size(matrix.shape[0]) - 1
    return _Sparse(
        np.pad(entries.data, more), np.pad(entries.row, more, constant_values=last), np.pad(entries.col, more)
    )  # fmt: skip


def _smoother(matrix: Any) -> np.ndarray:
    """Jacobi by the row sums of |a_ij|, which damps whatever the signs of the entries are."""
    sums = np.asarray(abs(matrix).sum(axis=1)).ravel()
    signs = np.where(matrix.diagonal() < 0, -1.0, 1.0)
    return np.pad(signs / np.where(sums > 0, sums, 1.0), (0, padded_size(len(sums)) - len(sums)))


class DeviceAMG(AMG):
    """Multigrid on JAX's default device."""

    def __init__(self, matrix: Any) -> None:
        super().__init__(matrix)
        size = padded_size(len(self.coarse_inverse)) - len(self.coarse_inverse)
        self.coarse_inverse = np.pad(self.coarse_inverse, (0, size))
        self.hierarchies: dict[bool, tuple[Any, Any, Any]] = {}

    def _hierarchy(self, transpose: bool) -> tuple[Any, Any, Any]:
        """The matrix, the levels and the inverse at the bottom, on the device."""
        if transpose not in self.hierarchies:
            turned = [(a.T.tocsr() if transpose else a, p, r) for a, p, r in self.levels]
            levels = [_Level(_padded(a), _smoother(a), _padded(p), _padded(r)) for a, p, r in turned]
            bottom = self.coarse_inverse.T if transpose else self.coarse_inverse
            self.hierarchies[transpose] = jax.device_put((_padded(self.matrices[transpose]), levels, bottom))
        return self.hierarchies[transpose]

    def apply(self, b: np.ndarray, transpose: bool, tolerance: float = 1e-10) -> np.ndarray:
        """Solve, (n, m) to (n, m), column by column."""
        x, n = np.zeros_like(b), len(b)
        for k in range(b.shape[1]):
            column = np.pad(b[:, k], (0, padded_size(n) - n))
            best, steps, gain = _bicgstab(*self._hierarchy(transpose), column, tolerance, self.most)
            x[:, k] = np.asarray(best)[:n]
            self.iterations += int(steps)
            self.stalled |= bool(gain > 1e-6)
        return x


def _cycle(levels: list[_Level], bottom: Any, b: Any) -> Any:
    """A V-cycle."""
    if not levels:
        return bottom @ b
    here, *coarser = levels
    size = len(b)
    x = here.smooth * b
    for _ in range(_SWEEPS - 1):
        x = x + here.smooth * (b - here.matrix.times(x, size))
    below = len(coarser[0].smooth) if coarser else len(bottom)
    rest = here.restrict.times(b - here.matrix.times(x, size), below)
    x = x + here.prolong.times(_cycle(coarser, bottom, rest), size)
    for _ in range(_SWEEPS):
        x = x + here.smooth * (b - here.matrix.times(x, size))
    return x


class _Iterate(NamedTuple):
    x: Any
    r: Any
    p: Any
    shadow: Any
    best: Any
    least: Any
    rho: Any
    step: Any


@partial(jax.jit, static_argnames="most")
def _bicgstab(matrix: _Sparse, levels: Any, bottom: Any, b: Any, tolerance: Any, most: int) -> tuple[Any, Any, Any]:
    """Best iterate, steps taken, and its residual relative to b: that of ``backends``, as one program."""
    guess = partial(_cycle, levels, bottom)
    times = lambda x: matrix.times(x, len(b))  # noqa: E731
    over = lambda a, c: jnp.where(c == 0, 0.0, a / jnp.where(c == 0, 1.0, c))  # noqa: E731
    start = b @ b

    def unfinished(now: _Iterate) -> Any:
        return (now.step < most) & (now.least > tolerance**2 * start) & jnp.isfinite(now.rho) & (now.rho != 0)

    def advance(now: _Iterate) -> _Iterate:
        p_hat = guess(now.p)
        v = times(p_hat)
        alpha = over(now.rho, now.shadow @ v)
        s = now.r - alpha * v
        s_hat = guess(s)
        t = times(s_hat)
        omega = over(t @ s, t @ t)
        x, r = now.x + alpha * p_hat + omega * s_hat, s - omega * t
        size, rho = r @ r, now.shadow @ r
        p = r + over(rho, now.rho) * over(alpha, omega) * (now.p - omega * v)
        # Broken down, as it happens where b has one nonzero entry alone: start afresh from r.
        broken = jnp.abs(rho) < 1e-10 * jnp.sqrt((now.shadow @ now.shadow) * size)
        rho, p, shadow = (jnp.where(broken, new, old) for new, old in ((size, rho), (r, p), (r, now.shadow)))
        better = size < now.least
        best, least = (jnp.where(better, new, old) for new, old in ((x, now.best), (size, now.least)))
        return _Iterate(x, r, p, shadow, best, least, rho, now.step + 1)

    zero = jnp.zeros_like(b)
    done = jax.lax.while_loop(unfinished, advance, _Iterate(zero, b, b, b, zero, start, start, 0))
    return done.best, done.step, jnp.sqrt(over(done.least, start))
