"""Sources with kinks and jumps: where a Taylor series misses the neighbours' values, a fit of them takes its place."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program
from jsmitsm.taylor.multi_indices import multi_indices

# A quadratic fit takes the place of the series where its misfit is less than the first part of the series', and that is
# more than the second times its last two degrees and more than the third of the source; or where these last degrees are
# the fourth times the source, beyond its radius of convergence.
BETTER, MISLED, FAINT, DIVERGED = 0.5, 3.0, 1e-6, 3.0
DEGREE = 2
RIDGE = 1e-10
# Where a value is held a source is as good as infinite from so many times any value around on.
BEYOND = 100.0


def softened(disc: Discretization, ids: np.ndarray, source: Any, values: Any) -> Any:
    """The source's Taylor coefficients (rows, n) at the particles ``ids``, without the series that mislead.

    values (E, N): the source at all particles. Beside a kink a series tells of one side only, and the deeper the
    recursion goes the more it makes of it. What is smooth, resolved or not, stays as it is. Where coefficients have
    kinks as well the source stays: both may belong together, and the series of one side are those of a solution on it.
    """
    place = np.full(len(disc.cloud), -1)
    place[ids] = np.arange(len(ids))
    classes = [(cls.ids, place[cls.ids], cls.neighbours, _owners(disc, cls)) for cls in disc.classes]
    row_index = disc.rec.row_index
    equations = tuple(
        (degree, tuple(k for k, (e, _) in enumerate(row_index) if e == equation))
        for equation, degree in enumerate(disc.rec.degrees)
    )
    return _softened(source, values, disc.points, classes, disc.held.all(axis=1), equations)


def _owners(disc: Discretization, cls: Class) -> Any:
    """Whose values the neighbours (n, w) of a class have, images' those of their particles; their own where none is."""
    xp = jnp if is_traced(cls.neighbours) else np
    return disc.images.owners(xp.where(cls.neighbours >= 0, cls.neighbours, cls.ids[:, None]))


def offsets(points: Any, ids: Any, near: Any, xp: Any) -> Any:
    """From particles (n,) to their neighbours (n, w), (n, w, D); none where there is no neighbour."""
    return xp.where((near >= 0)[..., None], points[xp.where(near >= 0, near, 0)] - points[ids][:, None], 0.0)


@partial(in_one_program, static=("equations",))
def _softened(
    source: Any, values: Any, points: Any, classes: list[Any], held: np.ndarray, equations: tuple[Any, ...]
) -> Any:  # fmt: skip
    """classes: of each one its ids, their places in the source, neighbours and owners; equations: degree and rows."""
    xp = jnp if is_traced(source, values, points, classes) else np
    source, values, points = xp.array(source), xp.asarray(values), xp.asarray(points)
    for ids, at, near, whose in classes:
        offset = offsets(points, ids, near, xp)
        for there, (degree, rows) in zip(values, equations):
            some = np.array(rows)[:, None], at
            counts = _telling(near >= 0, there[whose], xp.asarray(held)[whose], xp)
            new = _judged(offset, counts, there[whose], degree, source[some], xp)
            if xp is np:
                source[some] = new
            else:
                source = source.at[some].set(new)
    return source


def endless(values: np.ndarray, held: Any) -> bool:
    """Whether a source of values (E, N) is infinite, or as good as that where the particles (N,) are held."""
    size = np.abs(values)
    there, around = size[:, held].max(axis=1, initial=0.0), size[:, ~held].max(axis=1, initial=0.0)
    return not np.isfinite(size).all() or bool(((there > BEYOND * around) & (around > 0.0)).any())


def _telling(valid: Any, there: Any, held: Any, xp: Any) -> Any:
    """Which of the source's values (n, w) at neighbours tell of it around.

    Not the infinite ones, on the boundary, nor what is as good as infinite: beyond any value at a particle with an
    equation, where the value is held.
    """
    size = xp.where(valid & xp.isfinite(there), xp.abs(there), 0.0)
    most = xp.max(xp.where(held, 0.0, size), axis=1, keepdims=True)
    return valid & xp.isfinite(there) & ~(held & (size > BEYOND * most) & (most > 0.0))


def _judged(offset: Any, valid: Any, there: Any, degree: int, series: Any, xp: Any) -> Any:
    """The series (T, n) of one equation's source, or what is fitted to its values (n, w) at the offsets (n, w, D)."""
    there = xp.where(valid, there, 0.0)
    count = xp.maximum(xp.sum(valid, axis=1), 1)
    mean = lambda x: xp.sum(xp.where(valid, x, 0.0) ** 2, axis=1) / count
    whole, last = _summed(offset, degree, series, xp)
    misled, promised = mean(whole - there), mean(last)
    fitted, missed = fitted_series(offset, valid, there, len(series), xp)
    size = mean(there)
    astray = (misled > MISLED**2 * promised) | (promised > DIVERGED**2 * size)
    switch = (missed < BETTER**2 * misled) & astray & (misled > FAINT**2 * size)
    return xp.where(switch, fitted, series)


def fitted_series(offset: Any, valid: Any, there: Any, terms: int, xp: Any) -> tuple[Any, Any]:
    """Series (terms, n) of quadratic functions fitted to values (n, w) at the offsets (n, w, D), and their mean square
    misfit; valid (n, w): which of the values count."""
    length = xp.sqrt(xp.max(xp.sum(offset**2, axis=2), axis=1))
    fit, missed = _fitted(offset / length[:, None, None], valid, there, xp)
    scaled = fit.T / length ** np.array([sum(c) for c in multi_indices(offset.shape[2], DEGREE)])[:, None]
    kept = min(len(scaled), terms)
    return xp.concatenate([scaled[:kept], xp.zeros((terms - kept, len(fit)))]), missed


def _summed(offset: Any, degree: int, series: Any, xp: Any) -> tuple[Any, Any]:
    """The series (T, n) at the offsets (n, w, D) and what its last two degrees have of that, (n, w) each."""
    parts: list[Any] = [0.0] * (degree + 1)
    for c, power, f in zip(multi_indices(offset.shape[2], degree), _monomials(offset, degree, xp), series):
        parts[sum(c)] = parts[sum(c)] + power * f[:, None]
    last = parts[max(degree - 2, 0) + 1 :]
    return sum(parts), sum(last, xp.zeros(offset.shape[:2]))


def _monomials(offset: Any, degree: int, xp: Any) -> list[Any]:
    """All monomials (n, w) up to the degree, in their order, each by one product."""
    made: dict[tuple[int, ...], Any] = {}
    for c in multi_indices(offset.shape[2], degree):
        axis = next((k for k, power in enumerate(c) if power), None)
        if axis is None:
            made[c] = xp.ones(offset.shape[:2])
        else:
            made[c] = made[tuple(power - (k == axis) for k, power in enumerate(c))] * offset[..., axis]
    return list(made.values())


def _fitted(offset: Any, valid: Any, values: Any, xp: Any) -> tuple[Any, Any]:
    """Coefficients (n, M) of quadratic functions fitted to the values (n, w), and their mean square misfit."""
    p = xp.stack(_monomials(offset, DEGREE, xp), axis=2)
    weight = xp.where(valid, xp.exp(-4.0 * xp.sum(offset**2, axis=2)), 0.0)
    moments = xp.einsum("nwa,nw,nwb->nab", p, weight, p)
    moments = moments + RIDGE * np.eye(moments.shape[1])
    fit = xp.linalg.solve(moments, xp.einsum("nwa,nw,nw->na", p, weight, values)[..., None])[..., 0]
    missed = xp.where(valid, xp.einsum("nwa,na->nw", p, fit) - values, 0.0)
    return fit, xp.sum(missed**2, axis=1) / xp.sum(valid, axis=1)
