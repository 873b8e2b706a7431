"""Solves of the global linear system, differentiable by every transformation of JAX.

With A x = b the derivatives are solves with the same matrix,

    dx = A^-1 (db - dA x),        b_bar = A^-T x_bar,    A_bar = -b_bar x^T at A's entries,

so a sparse solve is a JAX primitive of our own: its implementation calls scipy on concrete arrays
and finds the factorisation again by the matrix's values. Outside `jit` no callback is involved, and
a gradient, a Hessian or a vmap over right-hand sides costs one factorisation in all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import partial
from typing import Any, Literal, TypeAlias, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import ad, batching, mlir

from jsmitsm.linear.factor_cache import Settings, clear_cache, factorisations, lookup
from jsmitsm.linear.solver_choice import DENSE_MAX, refuse_too_large
from jsmitsm.linear.sparse import Factor
from jsmitsm.runtime.errors import SingularMatrix, SolveError, is_one_of
from jsmitsm.runtime.jaxprs import Primitive
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program

__all__ = [
    "Factor",
    "SingularMatrix",
    "clear_cache",
    "factor",
    "factorisations",
    "refuse_too_large",
    "solve",
]

Solver: TypeAlias = Literal["auto", "dense", "sparse", "mixed", "iterative"]
"""What ``solver`` may be, a type for annotations."""
SOLVERS = get_args(Solver)


def solve(
    data: jax.Array,
    rows: jax.Array | np.ndarray,
    cols: jax.Array | np.ndarray,
    b: jax.Array,
    *,
    n: int,
    points: np.ndarray | None = None,
    solver: str = "auto",
    elliptic: bool = True,
    refine: int = 1,
    info: dict[str, Any] | None = None,
) -> Any:
    """Solution x of A x = b, with A given by its entries: a numpy array where nothing is traced.

    Args:
      data: (nnz,) float, the entries; those at one place add up.
      rows, cols: (nnz,) integers, their places.
      b: (n,) or (n, m) float, one or several right-hand sides.
      n: number of unknowns.
      points: (n, D) concrete coordinates of the unknowns, or None. They serve the order of
        elimination (two to three times faster, half the memory); a row of NaN, as for a Lagrange
        multiplier, is an unknown without a place and is eliminated last.
      solver: "dense" (LAPACK; pure JAX where anything is traced), "sparse" (LU, by PARDISO where that is
        installed and faster), "mixed" (LU in float32, corrected to float64 by BiCGSTAB), "iterative"
        (BiCGSTAB with multigrid, where pyamg is installed, or incomplete LU) or "auto": dense up to 140
        unknowns, then LU, mixed and multigrid for the elliptic systems that are large enough for them
        to be faster. Mixed and iterative fall back to LU where they stall.
      elliptic: False keeps "auto" away from multigrid.
      refine: steps of iterative refinement done in any case; 0 switches it off.
      info: a dict to be filled with what was done (`Factor.info`, and "cached"), where nothing is
        traced.

    Returns:
      x, of the shape of `b`. It may be differentiated with respect to `data` and `b`, forward and
      backward, to any order, mapped by vmap and compiled by jit.

    Raises:
      ValueError: shapes, indices or names that do not fit.
      SingularMatrix: a singular or not finite system, naming the unknowns. Under jit nothing is
        raised: x is NaN.

    Under jit let `rows` and `cols` be arguments rather than constants of the compiled function:
    millions of constants take seconds to compile.

    Example:
      >>> import numpy as np
      >>> rows, cols = np.array([0, 0, 1]), np.array([0, 1, 1])
      >>> x = solve(np.array([2.0, 1.0, 4.0]), rows, cols, np.array([4.0, 8.0]), n=2)
      >>> x.tolist()
      [1.0, 2.0]
    """
    traced = is_traced(data, rows, cols, b)
    if isinstance(points, jax.core.Tracer):
        points = None
    points = _check(data, rows, cols, b, n, points, solver)
    dtype = jnp.result_type(data, b, float)
    if n == 0:
        return jnp.asarray(b, dtype)
    if not traced:
        _refuse_nonfinite(np.asarray(b))
        found, cached = lookup((data, rows, cols), Settings(n, points, solver, elliptic, refine))
        x = found.solve(b)
        if info is not None:
            info.update(deepcopy(found.info), cached=cached)
        return x.astype(dtype, copy=False)
    # Every operation that changes nothing takes a tenth of a millisecond under an eager gradient.
    alike = lambda v: isinstance(v, jax.Array) and v.dtype == dtype  # noqa: E731
    data, b = (v if alike(v) else jnp.asarray(v, dtype) for v in (data, b))
    wide = b[:, None] if b.ndim == 1 else b
    if solver == "dense":
        return _dense(data, rows, cols, wide, n=n).reshape(b.shape)
    settings = Settings(n, points, solver, elliptic, refine)
    x = solve_p.bind(data, rows, cols, wide, settings=settings, transpose=False)
    return x.reshape(b.shape)


def _check(data: Any, rows: Any, cols: Any, b: Any, n: int, points: Any, solver: str) -> np.ndarray | None:
    """Refuse what does not fit; the points as a numpy array."""
    if not is_one_of(solver, SOLVERS):
        raise ValueError(f"solver: got {solver!r}, expected one of {', '.join(SOLVERS)}")
    if np.ndim(data) != 1 or np.shape(rows) != np.shape(data) or np.shape(cols) != np.shape(data):
        raise ValueError(
            "data, rows, cols: expected three one-dimensional arrays of one length, got shapes "
            f"{np.shape(data)}, {np.shape(rows)}, {np.shape(cols)}"
        )
    if np.ndim(b) not in (1, 2) or np.shape(b)[0] != n:
        raise ValueError(f"b: got shape {np.shape(b)}, expected ({n},) or ({n}, m) for n = {n} unknowns")
    if jnp.issubdtype(jnp.result_type(data, b), jnp.complexfloating):
        raise ValueError(
            "data, b: got complex numbers, expected real ones; solve for the real and imaginary parts as two fields"
        )
    for name, index in (("rows", rows), ("cols", cols)):
        if not jnp.issubdtype(jnp.result_type(index), jnp.integer):
            raise ValueError(f"{name}: got dtype {jnp.result_type(index)}, expected integers")
        if not isinstance(index, jax.core.Tracer) and np.size(index):
            low, high = int(np.min(index)), int(np.max(index))
            if low < 0 or high >= n:
                raise ValueError(
                    f"{name}: got indices from {low} to {high}, expected 0 to {n - 1} for n = {n} unknowns"
                )
    if points is None:
        return None
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or len(points) != n:
        raise ValueError(f"points: got shape {points.shape}, expected ({n}, D), a row per unknown")
    return points


def _refuse_nonfinite(b: np.ndarray) -> None:
    """Raise for a right-hand side with NaN or infinities."""
    bad = ~np.isfinite(b).all(axis=tuple(range(1, b.ndim)))
    if bad.any():
        raise SingularMatrix("the right-hand side is not finite", np.flatnonzero(bad))


# ---------------------------------------------------------------------------------------- dense


def _assemble_and_solve(data: Any, rows: Any, cols: Any, b: Any, n: int) -> jax.Array:
    """Dense solve in plain JAX, (n, m)."""
    matrix = jnp.zeros((n, n), data.dtype).at[rows, cols].add(data)
    return jnp.linalg.solve(matrix, b)


# One compiled program where it is called eagerly, instead of one for each operation.
_dense = jax.jit(_assemble_and_solve, static_argnames="n")


def factor(
    data: Any,
    rows: Any,
    cols: Any,
    n: int,
    points: np.ndarray | None = None,
    solver: str = "auto",
    elliptic: bool = True,
    refine: int = 1,
) -> Factor:
    """Factorisation of a matrix, the kept one where there is one. Arguments: see `Factor`.

    Example:
      >>> import numpy as np
      >>> index = np.arange(3)
      >>> f = factor(np.array([1.0, 2.0, 4.0]), index, index, 3)
      >>> f is factor(np.array([1.0, 2.0, 4.0]), index, index, 3)
      True
    """
    points = _check(data, rows, cols, np.zeros(n), n, points, solver)
    return lookup((data, rows, cols), Settings(n, points, solver, elliptic, refine))[0]


# ------------------------------------------------------------------------------------- primitive
#
# solve_p: data (nnz,), rows, cols, b (n, m) -> x (n, m). Any operand may carry one leading batch
# axis; where one of the first three does, b does too. Linear in b.

solve_p = Primitive("jsmitsm_solve")


def _batched(data: Any, rows: Any, cols: Any) -> bool:
    return max(data.ndim, rows.ndim, cols.ndim) > 1


def _on_host(arrays: Sequence[Any], b: Any, settings: Settings, transpose: bool) -> np.ndarray:
    """Solve concrete arrays, batch element by batch element."""
    if not _batched(*arrays):
        return lookup(arrays, settings)[0].solve(b, transpose).astype(b.dtype)
    arrays, b = [np.asarray(a) for a in arrays], np.asarray(b)
    out = np.empty(b.shape, b.dtype)
    for k in range(b.shape[0]):
        one = [a[k] if a.ndim > 1 else a for a in arrays]
        out[k] = lookup(one, settings)[0].solve(b[k], transpose)
    return out


def _impl(data: Any, rows: Any, cols: Any, b: Any, *, settings: Settings, transpose: bool) -> Any:
    return jax.device_put(_on_host((data, rows, cols), b, settings, transpose))  # asarray would compile, by length


def _jvp(primals: Any, tangents: Any, *, settings: Settings, transpose: bool) -> Any:
    """dx = A^-1 (db - dA x)."""
    data, rows, cols, b = primals
    d_data, _, _, d_b = tangents
    again = partial(solve_p.bind, settings=settings, transpose=transpose)
    x = again(data, rows, cols, b)
    rhs = None if type(d_b) is ad.Zero else d_b
    if type(d_data) is not ad.Zero:
        i, j = (cols, rows) if transpose else (rows, cols)
        rhs = _without(rhs, d_data, i, j, x)
    if rhs is None:
        return x, jnp.zeros_like(x)
    return x, again(data, rows, cols, rhs)


def _transpose(ct: Any, data: Any, rows: Any, cols: Any, b: Any, *, settings: Settings, transpose: bool) -> Any:
    """b_bar = A^-T x_bar."""
    if ad.is_undefined_primal(data):
        raise NotImplementedError("a solve is linear in its right-hand side only")
    if type(ct) is ad.Zero:
        return [None, None, None, ad.Zero(b.aval)]
    back = solve_p.bind(data, rows, cols, ct, settings=settings, transpose=not transpose)
    return [None, None, None, back]


def _batch(args: Any, axes: Any, *, settings: Settings, transpose: bool) -> Any:
    """Several right-hand sides are one wide one; several matrices are solved in turn."""
    size = next(a.shape[k] for a, k in zip(args, axes) if k is not None)
    bind = partial(solve_p.bind, settings=settings, transpose=transpose)
    data, rows, cols, b = args
    if all(k is None for k in axes[:3]):
        b = jnp.moveaxis(b, axes[3], -2)
        x = bind(data, rows, cols, b.reshape(*b.shape[:-2], -1))
        return x.reshape(b.shape), b.ndim - 2
    front = [a if k is None else jnp.moveaxis(a, k, 0) for a, k in zip(args, axes)]
    mapped = [k is not None for k in axes]
    core = (1, 1, 1, 2)  # axes of an operand without any batch
    inner = max(a.ndim - m - c for a, m, c in zip(front, mapped, core))  # an older batch axis
    depth = next((a.shape[m] for a, m, c in zip(front, mapped, core) if a.ndim - m > c), 1)
    flat = []
    for position, (a, m, c) in enumerate(zip(front, mapped, core)):
        own = a.ndim - m > c
        if m or own or position == 3:
            a = a if m else a[None]
            a = a if own else a[:, None]
            a = jnp.broadcast_to(a, (size, depth, *a.shape[2:])).reshape(-1, *a.shape[2:])
        flat.append(a)
    x = bind(*flat)
    return (x.reshape(size, depth, *x.shape[1:]) if inner else x), 0


def times(data: Any, rows: Any, cols: Any, x: Any) -> Any:
    """A x (n,) of a square matrix by its entries."""
    if is_traced(data, x):
        return jnp.zeros(len(x)).at[rows].add(data * x[cols])
    return np.bincount(rows, data * x[cols], len(x))


def _without(b: Any, data: Any, rows: Any, cols: Any, x: Any) -> Any:
    """b - A x, with the batch axes of the primitive; b may be None."""
    if not _batched(data, rows, cols):
        return _scattered(b, data, rows, cols, x)
    axes = [0 if a.ndim > 1 else None for a in (data, rows, cols)]
    return jax.vmap(_scattered, (None if b is None else 0, *axes, 0))(b, data, rows, cols, x)


@in_one_program
@jax.jit
def _scattered(b: Any, data: Any, rows: Any, cols: Any, x: Any) -> Any:
    """b - A x, (n, m)."""
    return (jnp.zeros_like(x) if b is None else b).at[rows].add(-data[:, None] * x[cols])


def _lower(ctx: Any, data: Any, rows: Any, cols: Any, b: Any, *, settings: Settings, transpose: bool) -> Any:
    """Under jit: small systems in plain JAX, the others by a call back to the host.

    `pure_callback` hands JAX arrays to the host, and waiting for those hangs on a machine with one
    core. The callback emitted here gets numpy views instead and never calls JAX.
    """
    aval = ctx.avals_in[3]
    if settings.solver == "auto" and settings.n <= DENSE_MAX:
        lowered = mlir.lower_fun(partial(_plain, n=settings.n, transpose=transpose), False)
        return lowered(ctx, data, rows, cols, b)

    def call(*args: np.ndarray) -> tuple[np.ndarray]:
        try:
            return (_on_host(args[:3], args[3], settings, transpose),)
        except SolveError:  # an exception would tear down the whole program
            return (np.full(aval.shape, np.nan, aval.dtype),)

    results, _, _ = mlir.emit_python_callback(
        ctx, call, None, [data, rows, cols, b], ctx.avals_in, ctx.avals_out, has_side_effect=False
    )
    return results


def _plain(data: Any, rows: Any, cols: Any, b: Any, n: int, transpose: bool) -> Any:
    """The primitive in plain JAX."""
    if transpose:
        rows, cols = cols, rows
    one: Callable[..., Any] = partial(_assemble_and_solve, n=n)
    if _batched(data, rows, cols):
        axes = [0 if a.ndim > 1 else None for a in (data, rows, cols)]
        return jax.vmap(one, (*axes, 0))(data, rows, cols, b)
    return one(data, rows, cols, b)


solve_p.def_impl(_impl)
solve_p.def_abstract_eval(lambda data, rows, cols, b, **_: jax.core.ShapedArray(b.shape, b.dtype))
ad.primitive_jvps[solve_p] = _jvp
ad.primitive_transposes[solve_p] = _transpose
batching.primitive_batchers[solve_p] = _batch
mlir.register_lowering(solve_p, _lower)
