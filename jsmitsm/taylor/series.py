"""Truncated multivariate Taylor arithmetic on arrays.

A value is an array (L, *shape, B): its Taylor coefficients about each particle come first, the
particles last.  L is the number of coefficients up to the degree beyond which they are known to
vanish (L = 1: independent of x), B the number of particles or 1 where all share the value.
Everything runs on numpy arrays with numpy and on JAX arrays with jax.numpy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jsmitsm.taylor.multi_indices import block_rows, count, degree_of_count, degrees, powers, product_rows, product_runs
from jsmitsm.taylor.pairing import pairing, product

Array = Any

# Rows of so many numbers are added up in place.
_LONG = 512


class Ring(NamedTuple):
    """Polynomials in ``dim`` variables truncated after total degree ``degree``."""

    dim: int
    degree: int


def on_host(*values: Array) -> bool:
    """Whether every array is a numpy array, so that numpy will do."""
    for v in values:
        if not isinstance(v, np.ndarray):
            return False
    return True


def xp_of(*values: Array) -> Any:
    return np if on_host(*values) else jnp


def degree_of(ring: Ring, x: Array) -> int:
    return degree_of_count(ring.dim, x.shape[0])


def truncate(ring: Ring, x: Array) -> Array:
    return x[: count(ring.dim, ring.degree)]


def pad_to(x: Array, terms: int) -> Array:
    """Append zero coefficients."""
    if x.shape[0] == terms:
        return x
    xp = xp_of(x)
    return xp.concatenate([x, xp.zeros((terms - x.shape[0], *x.shape[1:]), x.dtype)])


def align(*values: Array) -> list[Array]:
    """Give scalars the rank of the arrays they are combined with."""
    rank = max([v.ndim for v in values])
    return [v if v.ndim == rank else v.reshape(v.shape[0], *(1,) * (rank - 2), v.shape[-1]) for v in values]


def unify(*values: Array) -> list[Array]:
    """The same number of coefficients, rank and particles (shapes still broadcast)."""
    terms = max(v.shape[0] for v in values)
    batch = max(v.shape[-1] for v in values)
    out = [pad_to(v, terms) for v in align(*values)]
    return [v if v.shape[-1] == batch else xp_of(v).broadcast_to(v, (*v.shape[:-1], batch)) for v in out]


def add(x: Array, y: Array) -> Array:
    x, y = align(x, y)
    if x.shape[0] == y.shape[0]:
        return x + y
    if x.shape[0] > y.shape[0]:
        x, y = y, x
    n = x.shape[0]
    if on_host(x, y):
        shape = np.broadcast_shapes(x.shape[1:], y.shape[1:])
        out = np.empty((y.shape[0], *shape), np.result_type(x, y))
        np.add(x, y[:n], out=out[:n])
        out[n:] = y[n:]
        return out
    head = x + y[:n]
    return jnp.concatenate([head, jnp.broadcast_to(y[n:], (y.shape[0] - n, *head.shape[1:]))])


def mul(ring: Ring, x: Array, y: Array) -> Array:
    """The truncated Cauchy product."""
    x, y = align(x, y)
    if x.shape[0] == 1 or y.shape[0] == 1:
        if y.shape[0] == 1:
            x, y = y, x
        if isinstance(x, np.ndarray) and x.size == 1 and y.shape[0] > 1 and x.flat[0] == 0:
            return np.zeros((1, *np.broadcast_shapes(x.shape[1:], y.shape[1:])), x.dtype)
        return x * y
    if x.shape[0] > y.shape[0]:
        x, y = y, x
    left, right = degree_of(ring, x), degree_of(ring, y)
    degree = min(left + right, ring.degree)
    if not on_host(x, y):
        return pairing(x, y, product(ring.dim, left, right, 0, degree))
    # What is not finite is refused by name, with its particles, where the numbers are used.
    with np.errstate(over="ignore", invalid="ignore"):
        if degree == 1:
            out = x[:1] * y
            out[1:] += x[1:] * y[:1]
            return out
        shape = np.broadcast_shapes(x.shape[1:], y.shape[1:])
        out = np.zeros((count(ring.dim, degree), *shape), np.result_type(x, y))
        ours, theirs = _filled_rows(x), _filled_rows(y)
        if len(ours) > len(theirs):
            x, y, left, right, ours, theirs = y, x, right, left, theirs, ours
        sparse = 2 * len(theirs) < len(y)
        rows = product_rows(ring.dim, left, right, degree)
        if y[0].size >= _LONG:
            if sparse:
                _add_pairs(out, x, y, ours, theirs, rows)
            else:
                _add_products(out, x, y, ours, product_runs(ring.dim, left, right, degree))
            return out
        for a in ours:
            n, places = rows[a]
            if n and sparse:
                some = theirs[: np.searchsorted(theirs, n)]
                at = some + places.start if isinstance(places, slice) else places[some]
                out[at] += x[a] * y[some]
            elif n:
                out[places] += x[a] * y[:n]
    return out


def _add_products(out: np.ndarray, x: np.ndarray, y: np.ndarray, ours: np.ndarray, runs: Any) -> None:
    """Add x y to ``out``, by runs of rows: no array is made but one, which long rows would take time to be given."""
    product = np.empty((len(y), *out.shape[1:]), out.dtype)
    for a in ours:
        if not runs[a]:
            continue
        n = runs[a][-1][2]
        part = np.multiply(x[a], y[:n], out=product[:n])
        for first, low, high in runs[a]:
            place = out[first : first + high - low]
            np.add(place, part[low:high], out=place)


def _add_pairs(
    out: np.ndarray, x: np.ndarray, y: np.ndarray, ours: np.ndarray, theirs: np.ndarray, rows: Any
) -> None:
    """Add x y to ``out``, which is zero, where few coefficients do not vanish: pair by pair, most with a place of
    their own."""
    product, met = np.empty(out.shape[1:], out.dtype), set()
    for a in ours:
        n, places = rows[a]
        some = theirs[: np.searchsorted(theirs, n)]
        at = some + places.start if isinstance(places, slice) else places[some] if n else some
        for b, c in zip(some.tolist(), at.tolist(), strict=True):
            if c in met:
                out[c] += np.multiply(x[a], y[b], out=product)
            else:
                np.multiply(x[a], y[b], out=out[c, ...])
                met.add(c)


def _filled_rows(x: np.ndarray) -> np.ndarray:
    """The coefficients that do not vanish: few of a function of one coordinate alone."""
    flat = x.reshape(len(x), -1)
    if (flat[:, 0] != 0).all():
        return np.arange(len(x))
    return np.flatnonzero((flat != 0).any(axis=1))


def block(ring: Ring, x: Array, degree: int) -> Array:
    """The coefficients of exactly this degree."""
    return x[count(ring.dim, degree - 1) : count(ring.dim, degree)]


def product_block(ring: Ring, x: Array, y: Array, degree: int, first: int = 1, weighted: bool = False) -> Array:
    """Degree ``degree`` of x y, from x's terms of degree at least ``first`` and those of y at hand.

    ``weighted``: of E(x) y instead, E the Euler operator below.
    """
    dim = ring.dim
    left, right = min(degree_of(ring, x), degree), min(degree_of(ring, y), degree)
    if not on_host(x, y):
        pairs = product(dim, left, right, degree, degree, first, weighted)
        return pairing(x[: count(dim, left)], y[: count(dim, right)], pairs)
    if dim == 1 and left == 1 and first == 1:  # along a line: one term is left of the sum
        return x[1:2] * y[degree - 1 : degree] if degree <= right + 1 else 0.0 * (x[1:2] * y[:1])
    shape = np.broadcast_shapes(x.shape[1:], y.shape[1:])
    out = np.zeros((count(dim, degree) - count(dim, degree - 1), *shape), np.result_type(x, y))
    for j in range(max(first, degree - right), left + 1):
        a, b = block(ring, x, j), block(ring, y, degree - j)
        if weighted:
            a = a * x.dtype.type(j)
        if len(a) > len(b):
            a, b = b, a
            table = block_rows(dim, degree - j, j)
        else:
            table = block_rows(dim, j, degree - j)
        for c, places in zip(a, table, strict=True):
            out[places] += c * b
    return out


def euler(ring: Ring, x: Array) -> Array:
    """sum_i s_i dx/ds_i: every coefficient times its degree.  Turns g(x) into a recursion."""
    weights = degrees(ring.dim, degree_of(ring, x)).astype(x.dtype)
    return x * weights.reshape(-1, *(1,) * (x.ndim - 1))


def integrate(ring: Ring, start: Array, slope: Array) -> Array:
    """The series with this constant term whose ``euler`` is ``slope``."""
    if slope.shape[0] == 1:
        return start
    weights = degrees(ring.dim, degree_of(ring, slope))[1:].astype(slope.dtype)
    rest = slope[1:] / weights.reshape(-1, *(1,) * (slope.ndim - 1))
    xp = xp_of(start, rest)
    shape = np.broadcast_shapes(start.shape[1:], rest.shape[1:])
    return xp.concatenate([xp.broadcast_to(start, (1, *shape)), xp.broadcast_to(rest, (len(rest), *shape))])


def recursion(ring: Ring, starts: list[Array], step: Callable[[int, list[Array]], list[Array]]) -> list[Array]:
    """Grow series degree by degree; ``step(k, series)`` gives their degree k from the lower ones."""
    if not on_host(*starts):
        series = starts
        for k in range(1, ring.degree + 1):
            series = [jnp.concatenate([s, b]) for s, b in zip(series, step(k, series), strict=True)]
        return series
    full = [np.empty((count(ring.dim, ring.degree), *s.shape[1:]), s.dtype) for s in starts]
    for whole, s in zip(full, starts, strict=True):
        whole[:1] = s
    for k in range(1, ring.degree + 1):
        low, high = count(ring.dim, k - 1), count(ring.dim, k)
        for whole, b in zip(full, step(k, [w[:low] for w in full]), strict=True):
            whole[low:high] = b
    return full


def _term(ring: Ring, x: Array, degree: int) -> Array | float:
    """Degree ``degree`` of x, zero beyond its end."""
    return block(ring, x, degree) if degree_of(ring, x) >= degree else 0.0


def _like_product(*values: Array) -> Array:
    """A constant term of the common shape of several factors, and their dtype."""
    shape = np.broadcast_shapes(*(v.shape[1:] for v in values))
    return xp_of(*values).broadcast_to(values[0][:1], (1, *shape))


def div(ring: Ring, x: Array, y: Array) -> Array:
    """x / y from y w = x."""
    x, y = align(x, y)
    if y.shape[0] == 1:
        return x / y
    y0 = y[:1]

    def step(k: int, w: list[Array]) -> list[Array]:
        return [(_term(ring, x, k) - product_block(ring, y, w[0], k)) / y0]

    return recursion(ring, [_like_product(x[:1] / y0, y)], step)[0]


def power(ring: Ring, x: Array, r: Array, start: Array) -> Array:
    """x**r for an exponent independent of x, from x E(w) = r w E(x); ``start`` is x0**r."""
    x, r, start = align(x, r, start)
    x0 = x[:1]
    if ring.degree == 1 and on_host(x, r, start):
        return np.concatenate([start, r * (x[1:] * start) / x0])

    def step(k: int, w: list[Array]) -> list[Array]:
        right = r * product_block(ring, x, w[0], k, weighted=True)
        left = product_block(ring, x, euler(ring, w[0]), k) if k > 1 else 0.0
        return [(right - left) / (k * x0)]

    return recursion(ring, [_like_product(start, x)], step)[0]


def integer_power(ring: Ring, x: Array, n: int) -> Array:
    """x**n by repeated squaring, exact where x vanishes."""
    if n < 0:
        one = np.ones((1,) * x.ndim, x.dtype)
        return div(ring, one, integer_power(ring, x, -n))
    out = None
    square = x
    while n:
        if n & 1:
            out = square if out is None else mul(ring, out, square)
        n >>= 1
        if n:
            square = mul(ring, square, square)
    return np.ones((1,) * x.ndim, x.dtype) if out is None else out


def riccati(ring: Ring, x: Array, start: Array, c0: float, c1: float, c2: float) -> Array:
    """w(x) with dw/dx = c0 + c1 w + c2 w^2: exp, tan, tanh, logistic and their kin."""

    def rate(k: int, w: Array, last: Array) -> Array:
        """Degree k of c0 + c1 w + c2 w^2."""
        out = c1 * last if c1 else 0.0
        if c2:
            out = out + c2 * product_block(ring, w, w, k, first=0)
        return out + c0 if k == 0 else out

    def step(k: int, state: list[Array]) -> list[Array]:
        w, h = state
        new = product_block(ring, x, h, k, weighted=True) / k
        if k == ring.degree:
            return [new, new]  # the last rate is not asked for
        return [new, rate(k, xp_of(w, new).concatenate([w, new]), new)]

    start = _like_product(start, x)
    return recursion(ring, [start, rate(0, start, start)], step)[0]


def circle(ring: Ring, x: Array, sine: Array, cosine: Array, sign: float) -> tuple[Array, Array]:
    """(sin, cos) of x for sign -1, (sinh, cosh) for +1, together."""

    def step(k: int, state: list[Array]) -> list[Array]:
        s, c = state
        sine = product_block(ring, x, c, k, weighted=True) / k
        return [sine, sign * product_block(ring, x, s, k, weighted=True) / k]

    s, c = recursion(ring, [_like_product(sine, x), _like_product(cosine, x)], step)
    return s, c


def choose(condition: Array, x: Array, y: Array) -> Array:
    """x where the condition (independent of x) holds, y elsewhere."""
    x, y = unify(x, y)
    condition, x, y = align(condition, x, y)
    return xp_of(condition, x, y).where(condition, x, y)


def take(x: Array, places: Array) -> Array:
    """Elements of x by flat position; ``places`` is (*shape, 1) or (*shape, B)."""
    flat = x.reshape(x.shape[0], -1, x.shape[-1])
    xp = xp_of(x, places)
    if places.shape[-1] == 1:
        return xp.take(flat, places[..., 0], axis=1)
    if x.shape[-1] == 1:
        return xp.take(flat[..., 0], places, axis=1)
    rows = xp.take_along_axis(flat, places.reshape(1, -1, places.shape[-1]), axis=1)
    return rows.reshape(x.shape[0], *places.shape)


def along_line(ring: Ring, x: Array, function: Callable[[Ring, Array], Array]) -> Array | None:
    """A function of a linear x = x0 + a . s, from its series in one variable: g_k (a . s)^k; None for other x."""
    if ring.dim == 1 or ring.degree < 2 or x.shape[0] != 1 + ring.dim or not on_host(x):
        return None
    slope = x[1:, ..., :1]
    if x.shape[-1] > 1 and not (x[1:] == slope).all():
        return None
    line = function(Ring(1, ring.degree), np.concatenate([x[:1], np.ones_like(x[:1])]))
    degree = len(line) - 1
    exponents, weights = powers(ring.dim, degree)
    shape = (len(weights), ring.dim, *(1,) * (x.ndim - 1))
    monomials = (slope ** exponents.reshape(shape)).prod(axis=1) * weights.reshape(-1, *(1,) * (x.ndim - 1))
    monomials, degree_at = monomials.astype(x.dtype), degrees(ring.dim, degree)
    filled = _filled_rows(monomials)
    if 2 * len(filled) > len(monomials):
        return line[degree_at] * monomials
    out = np.zeros((len(monomials), *line.shape[1:]), line.dtype)
    for k in filled:
        np.multiply(line[degree_at[k]], monomials[k], out=out[k, ...])
    return out


def full_series(ring: Ring, x: Array, batch: int) -> Array:
    """All coefficients, for all particles."""
    x = pad_to(x, count(ring.dim, ring.degree))
    return xp_of(x).broadcast_to(x, (*x.shape[:-1], batch)) if x.shape[-1] != batch else x


def variable(points: Array, degree: int) -> Array:
    """The point itself as a series: (N, D) points to (1 + D, D, N)."""
    n, dim = points.shape
    if degree == 0:
        return points.T[None]
    xp = xp_of(points)
    slope = np.broadcast_to(np.eye(dim, dtype=points.dtype)[..., None], (dim, dim, n))
    return xp.concatenate([points.T[None], slope])
