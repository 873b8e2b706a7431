"""The eigenvalues of a sparse pencil A v = lambda C v nearest to a number, differentiable in every way of JAX.

Found by Arnoldi's method on (A - s C)^-1 C, whose factor serves the left vectors too. With y^T C v = 1,

    d lambda = y^T (dA - lambda dC) v,
    [A - lambda C, -C v; v^T, 0] [dv; d lambda] = [-(dA - lambda dC) v; 0],

so vectors cost a factorisation each, where their derivatives are used. Values of a cluster have no derivatives one by
one; their mean has, and each of them is given that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import ad, batching, mlir

from jsmitsm.linear import linsolve
from jsmitsm.runtime.errors import SingularMatrix, SolveError
from jsmitsm.runtime.jaxprs import Primitive

# Up to so many unknowns, or where so large a part of all values is wanted, the matrix is dense.
_DENSE, _PART = 200, 0.25
# Values sought beyond those asked for: the rest of a cluster, and what a shift brings nearer.
_MORE = 6
# A value nearer to the shift than this part of the distance of the next takes digits from the others.
_NEAR = 1e-4


@dataclass(frozen=True, eq=False)
class Pattern:
    """Where the entries of a pencil stand, n unknowns; the same object stands for the same places.

    points (n, D): where the unknowns are; order: the degree of the expansions, which says how far the values of a
    cluster are parted; offset: by how much a shift is moved that meets a value; floating: whether zero is a value.
    """

    n: int
    rows_a: np.ndarray
    cols_a: np.ndarray
    rows_c: np.ndarray
    cols_c: np.ndarray
    points: np.ndarray | None
    order: int
    offset: float
    floating: bool

    @property
    def together(self) -> float:
        """Values whose relative distance is below this may be one, parted by the discretisation."""
        return 10.0 ** -(self.order / 2 + 1)


class Pairs(NamedTuple):
    """Values (k,) by their distance from what was asked for, vectors (n, k) and left ones with y^T C v = 1.

    Of a complex pair that is one double value, parted by the discretisation, vectors are the real and the imaginary
    part. cluster (k,): the number of each value's cluster; mean (k, k): averages over clusters.
    """

    values: np.ndarray
    right: np.ndarray
    left: np.ndarray
    cluster: np.ndarray
    mean: np.ndarray


def pairs(pattern: Pattern, a: np.ndarray, c: np.ndarray, near: float, count: int, whole: bool) -> Pairs:
    """``count`` values and vectors; ``whole``: and the rest of the last cluster."""
    op = _Inverse(pattern, a, c, near)
    values, right = op.largest(min(count + _MORE, op.most), transpose=False)
    values, right = _ascending(values, right, near)
    k = _cut(pattern, values, near, min(count, len(values)), whole)
    lefts, left = op.largest(min(k + _MORE, op.most), transpose=True)
    cluster = _clusters(pattern, values[:k], near)
    left = left[:, _matched(values[:k], lefts)]
    values, right, left = values[:k], right[:, :k], left
    # Left vectors dual to the right ones, cluster by cluster.
    product = left.T @ op.c @ right
    together = cluster[:, None] == cluster[None, :]
    left = left @ np.linalg.inv(np.where(together, product, 0.0)).T
    mean = together / together.sum(axis=1, keepdims=True)
    return Pairs(values, right, left, cluster, mean)


class _Inverse:
    """(A - s C)^-1 C with a shift s near the number asked for, as a matrix or by its factor."""

    def __init__(self, pattern: Pattern, a: np.ndarray, c: np.ndarray, near: float):
        from scipy.sparse import csr_matrix

        n = self.n = pattern.n
        self.pattern, self.a = pattern, a
        self.c_data = c
        self.c = csr_matrix((c, (pattern.rows_c, pattern.cols_c)), (n, n))
        self.most = n if n <= _DENSE else n - 2
        step = pattern.offset if pattern.floating and abs(near) < pattern.offset else 0.0
        for shift in (near - step, near - pattern.offset, near + 0.37 * pattern.offset):
            try:
                self._factorise(shift)
            except SingularMatrix:
                continue
            nearest = np.sort(1.0 / np.abs(self.largest(2, False)[0]))[:2]
            if nearest[0] > _NEAR * nearest[-1]:
                return
        if not hasattr(self, "factor"):
            raise SolveError(
                f"the operator is singular at every shift near {near}: is a condition missing, or a part of the cloud "
                "not connected?"
            )

    def _factorise(self, shift: float) -> None:
        p = self.pattern
        data = np.concatenate([self.a, -shift * self.c_data])
        rows, cols = np.concatenate([p.rows_a, p.rows_c]), np.concatenate([p.cols_a, p.cols_c])
        self.factor = linsolve.factor(data, rows, cols, self.n, p.points, elliptic=False)
        self.shift = shift
        self.found: dict[tuple[int, bool], tuple[np.ndarray, np.ndarray]] = {}

    def largest(self, k: int, transpose: bool) -> tuple[np.ndarray, np.ndarray]:
        """The k values nearest to the shift, and their vectors (n, k)."""
        k = max(1, min(k, self.most))
        for (many, turned), (values, vectors) in self.found.items():
            if turned == transpose and many >= k:
                return values[:k], vectors[:, :k]
        inverse, vectors = self._arnoldi(k, transpose)
        order = np.argsort(-np.abs(inverse), kind="stable")
        inverse, vectors = inverse[order][:k], vectors[:, order][:, :k]
        sound = np.abs(inverse) > 1e-14 * np.abs(inverse[0])  # the others belong to equations without a mass
        values = self.shift + 1.0 / inverse[sound]
        self.found[k, transpose] = values, vectors[:, sound]
        return self.found[k, transpose]

    def _arnoldi(self, k: int, transpose: bool) -> tuple[np.ndarray, np.ndarray]:
        from scipy.sparse.linalg import ArpackError, LinearOperator, eigs

        c = self.c.T.tocsr() if transpose else self.c

        def apply(x: np.ndarray) -> np.ndarray:
            return np.asarray(self.factor.solve(c @ x, transpose))

        if self.n <= _DENSE or k > min(_PART * self.n, self.n - 2):
            inverse, vectors = np.linalg.eig(apply(np.eye(self.n)))
            return inverse, vectors.astype(complex)
        start = apply(np.random.default_rng(0).uniform(0.5, 1.5, self.n))
        op = LinearOperator((self.n, self.n), matvec=lambda x: apply(np.ravel(x)), dtype=float)
        ncv = min(self.n, max(2 * k + 2, 24))
        try:
            inverse, vectors = eigs(op, k=k, which="LM", v0=start, ncv=ncv, tol=0, maxiter=200 * ncv)
        except ArpackError as error:
            raise SolveError(f"Arnoldi's method did not find {k} values near {self.shift}: {error}") from error
        # Once more through the operator: what equations without a mass left of their own is gone.
        parts = apply(np.concatenate([vectors.real, vectors.imag], axis=1))
        return inverse, (parts[:, :k] + 1j * parts[:, k:]) / inverse


def _ascending(values: np.ndarray, vectors: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """By distance, the partners of a pair side by side, the one with the positive imaginary part first."""
    distance = np.round(np.abs(values - near) / np.maximum(np.abs(values - near).max(), 1e-300), 13)
    order = np.lexsort((-values.imag, values.real, distance))
    return values[order], vectors[:, order]


def _clusters(pattern: Pattern, values: np.ndarray, near: float) -> np.ndarray:
    """The number of each value's cluster: values that are one but for the discretisation's error."""
    size = np.maximum(np.abs(values), np.abs(values - near))
    apart = np.abs(np.diff(values)) > pattern.together * np.maximum(size[1:], 1e-3 * size.max(initial=0.0))
    return np.concatenate([[0], np.cumsum(apart)]).astype(int)


def _cut(pattern: Pattern, values: np.ndarray, near: float, count: int, whole: bool) -> int:
    """How many of the values to keep: a pair stays together, and a cluster where it may."""
    cluster = _clusters(pattern, values, near)
    if whole:
        return int((cluster <= cluster[count - 1]).sum())
    return count


def _matched(values: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which of the ``others`` each value is, none of them twice."""
    left = list(range(len(others)))
    out = []
    for value in values:
        k = min(left, key=lambda j: abs(others[j] - value))
        out.append(k)
        left.remove(k)
    return np.array(out, int)


def in_real_numbers(found: Pairs, double: np.ndarray) -> Pairs:
    """The complex values that ``double`` (k,) marks, double ones parted by the discretisation, in real numbers.

    Of v = r + i s and its left vector y = p + i q, turned so that r and s are orthogonal, r and s stay, and 2 p and
    -2 q, which are dual to them. Where nothing complex is left, the arrays are real.
    """
    values, right, left = (np.array(x) for x in found[:3])
    k = 0
    while k < len(values):
        if double[k] and values[k].imag != 0.0:
            turn = np.exp(-0.5j * np.angle(right[:, k] @ right[:, k]))
            v, y = turn * right[:, k], left[:, k] / turn
            both = k + 1 < len(values) and abs(values[k + 1] - values[k].conjugate()) <= 1e-6 * abs(values[k])
            for j, (of, dual) in enumerate(((v.real, 2.0 * y.real), (v.imag, -2.0 * y.imag))[: 1 + both]):
                values[k + j], right[:, k + j], left[:, k + j] = values[k].real, of, dual
            k += both
        k += 1
    if not values.imag.any():
        # An eigenvector of a real value may carry any complex factor.
        turn = np.exp(-0.5j * np.angle(np.einsum("nk,nk->k", right, right)))
        values, right, left = values.real, (turn * right).real, (left / turn).real
    return found._replace(values=values, right=right, left=left)


def normalised(found: Pairs, size: float) -> Pairs:
    """Vectors of the square sum ``size``, their largest entry positive."""
    norm = np.sqrt(np.sum(np.abs(found.right) ** 2, axis=0) / size)
    # Of entries that are equal but for rounding, the first.
    top = np.argmax(np.abs(found.right) > (1.0 - 1e-6) * np.abs(found.right).max(axis=0), axis=0)
    entry = found.right[top, np.arange(len(norm))]
    factor = norm * entry / np.abs(entry)
    return found._replace(right=found.right / factor, left=found.left * factor)


# ------------------------------------------------------------------------------------- primitive
#
# modes_p: a (nnz,), c (nnz,) -> values (k,), right and left vectors (n, k), mean (k, k), all of them real; NaN where
# they are not. The number of values is fixed.

modes_p = Primitive("jsmitsm_modes")
modes_p.multiple_results = True


def modes(pattern: Pattern, a: Any, c: Any, near: float, count: int, size: float) -> list[Any]:
    """The primitive: ``count`` values and their vectors, of the square sum ``size``."""
    return modes_p.bind(a, c, pattern=pattern, near=near, count=count, size=size)


def _on_host(a: Any, c: Any, pattern: Pattern, near: float, count: int, size: float) -> list[np.ndarray]:
    found = pairs(pattern, np.asarray(a, float), np.asarray(c, float), near, count, False)
    if len(found.values) < count:
        raise SolveError(f"{count} values were asked for, and the operator has {len(found.values)}")
    small = np.abs(found.values.imag) <= pattern.together * np.abs(found.values)
    if not small.all():
        raise SolveError(
            f"the value {found.values[~small][0]:.6g} is complex: derivatives are those of real values and modes; "
            "ask outside of the JAX transform"
        )
    made = normalised(in_real_numbers(found, small), size)
    return [np.asarray(x, float) for x in (made.values, made.right, made.left, made.mean)]


def _impl(a: Any, c: Any, **given: Any) -> list[Any]:
    return jax.device_put(_on_host(a, c, **given))


def _avals(a: Any, c: Any, *, pattern: Pattern, near: float, count: int, size: float) -> list[Any]:
    shapes = (count,), (pattern.n, count), (pattern.n, count), (count, count)
    return [jax.core.ShapedArray(shape, np.dtype(float)) for shape in shapes]


def _jvp(primals: Sequence[Any], tangents: Sequence[Any], **given: Any) -> tuple[list[Any], list[Any]]:
    pattern: Pattern = given["pattern"]
    p, (a, c) = pattern, primals
    da, dc = (jnp.zeros_like(x) if type(t) is ad.Zero else t for x, t in zip(primals, tangents))
    values, right, left, mean = modes_p.bind(a, c, **given)

    def times(data: Any, rows: np.ndarray, cols: np.ndarray, x: Any) -> Any:
        return jnp.zeros(x.shape, data.dtype).at[rows].add(data[:, None] * x[cols])

    moved = times(da, p.rows_a, p.cols_a, right) - values * times(dc, p.rows_c, p.cols_c, right)
    slope = mean @ jnp.einsum("nk,nk->k", left, moved)
    turned = times(da, p.cols_a, p.rows_a, left) - values * times(dc, p.cols_c, p.rows_c, left)
    cv, cy = times(c, p.rows_c, p.cols_c, right), times(c, p.cols_c, p.rows_c, left)
    n, last, every, whole = p.n, np.full(p.n, p.n), np.arange(p.n), np.arange(p.n + 1)
    d_right, d_left = [], []
    for k in range(given["count"]):
        # Vectors of a cluster turn freely among themselves: they have no derivative, their matrix no inverse.
        simple = mean[k, k] > 0.99
        inner = jnp.where(simple, jnp.concatenate([a, -values[k] * c]), 0.0)
        rows, cols = np.concatenate([p.rows_a, p.rows_c]), np.concatenate([p.cols_a, p.cols_c])
        points = None if p.points is None else np.concatenate([p.points, np.full((1, p.points.shape[1]), np.nan)])

        def bordered(rows, cols, column, row, right_side, inner=inner, points=points, simple=simple):
            border = jnp.where(simple, jnp.concatenate([column, row]), 0.0)
            data = jnp.concatenate([inner, border, jnp.where(simple, 0.0, jnp.ones(n + 1))])
            at = np.concatenate([rows, every, last, whole]), np.concatenate([cols, last, every, whole])
            found = linsolve.solve(data, *at, right_side, n=n + 1, points=points, elliptic=False)[:n]
            return jnp.where(simple, found, jnp.nan)

        dv = bordered(rows, cols, -cv[:, k], right[:, k], jnp.append(-moved[:, k], 0.0))
        scale = left[:, k] @ times(dc, p.rows_c, p.cols_c, right[:, k : k + 1])[:, 0] + cy[:, k] @ dv
        d_right.append(dv)
        d_left.append(bordered(cols, rows, -cy[:, k], cv[:, k], jnp.append(-turned[:, k], -scale)))
    out = [slope, jnp.stack(d_right, axis=1), jnp.stack(d_left, axis=1), jnp.zeros_like(mean)]
    return [values, right, left, mean], out


def _batch(arguments: Sequence[Any], axes: Sequence[Any], **given: Any) -> tuple[list[Any], list[int]]:
    size = next(x.shape[k] for x, k in zip(arguments, axes) if k is not None)
    front = [x if k is None else jnp.moveaxis(x, k, 0) for x, k in zip(arguments, axes)]
    some = [modes_p.bind(*(x if k is None else x[j] for x, k in zip(front, axes)), **given) for j in range(size)]
    return [jnp.stack(x) for x in zip(*some)], [0] * 4


def _lower(ctx: Any, *arguments: Any, **given: Any) -> Any:
    """Under jit a call back to the host, which gets numpy's views and never calls JAX."""

    def call(a: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, ...]:
        try:
            return tuple(_on_host(a, c, **given))
        except (SolveError, np.linalg.LinAlgError):  # an exception would tear down the whole program
            return tuple(np.full(x.shape, np.nan, x.dtype) for x in ctx.avals_out)

    results, _, _ = mlir.emit_python_callback(
        ctx, call, None, list(arguments), ctx.avals_in, ctx.avals_out, has_side_effect=False
    )
    return results


modes_p.def_impl(_impl)
modes_p.def_abstract_eval(_avals)
ad.primitive_jvps[modes_p] = _jvp
batching.primitive_batchers[modes_p] = _batch
mlir.register_lowering(modes_p, _lower)
