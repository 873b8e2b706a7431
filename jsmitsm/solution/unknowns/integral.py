"""The integral term of a problem as a part of its global matrix.

The integral of kernel(x, y) u(y) is sum_j w_j kernel(x, y_j) u_j over the particles, with weights of quadrature. To the
rows of method S it is a source: they take its Taylor series in x, and so become, of every u_j, w_j times what they make
of the source kernel(x, y_j). That is dense.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.quadrature import Quadrature, quadrature
from jsmitsm.cloud.regions.node_weights import weights_by
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.unknowns.integral import recorded_kernel
from jsmitsm.particle.recursion import Recursion, source_rows
from jsmitsm.runtime.tracers import is_traced

# So many unknowns are coupled at the most: the matrix of more takes above a gigabyte.
MOST = 5000
# Of so many places x the integral of the kernel is compared with a finer one; they differ by this part of it.
_PLACES, _COARSE = 12, 1e-2
# The weights' degree beyond the order, by the dimension: in space a fit takes too many neighbours as it is.
_MORE = {1: 2, 2: 2, 3: 0}

# More particles than these are worth a compilation.
_FEW = 400

Sources = Callable[[Callable[[str | None, Any, Recursion], Any]], Any]


def _nothing(_: str | None, points: Any, rec: Recursion) -> np.ndarray:
    return np.zeros((rec.n_rows, 1))


def known_points(cloud: Any) -> np.ndarray:
    """The particles (N, D) that integrals go over; ValueError where JAX traces them."""
    if is_traced(cloud.points):
        raise ValueError(
            "integral: the points are traced by a JAX transform, and the weights of integrals over them are found on "
            "the host; differentiate by the kernel's parameters, or leave the integral term out"
        )
    return np.asarray(cloud.points, float)


class IntegralTerm:
    """Kernels by region (None: the only one), and the weights (N,) of the particles."""

    def __init__(self, problem: Problem, cloud: Any):
        assert problem.extras is not None
        self.points, self.fields, self.params = known_points(cloud), problem.fields, problem.params
        if self.points.shape[0] * self.fields > MOST:
            raise ValueError(
                f"integral: couples all of the {self.points.shape[0] * self.fields} unknowns, and {MOST} are the most "
                "that are made for; take a coarser cloud at a higher order, or for a kernel that is a sum of a few "
                "products a(x) b(y) an unknown and a constraint for each (js.constraint)"
            )
        dim = self.points.shape[1]
        kernels = dict(problem.extras.kernels)
        self.records = {n: recorded_kernel(k, dim, self.fields, problem.params) for n, k in kernels.items()}
        if not is_traced(self.params):
            for name in self.records:  # where x and y meet
                self._finite(name, self.points, 2, self.points)
        self.weights, self.finer = np.zeros(0), Quadrature(*(np.zeros(0),) * 3)
        self.block: Any = np.zeros((0, 0))  # what the matrix gets, (n, n), once assembled
        self._known: Any = np.zeros((0, 0))  # what stands before the held values, (n, N F)

    def weigh(self, cloud: Any, order: int, otherwise: bool = False) -> None:
        """Find the weights that an order of the solution takes; otherwise: those that tell the error of its rule."""
        self.weights = weights_by(cloud, order + _MORE[cloud.dim], otherwise)
        self.finer = quadrature(cloud, None, order)

    def carried(self, values: Any) -> Any:
        """The values (N, F) times their weights."""
        return values * self.weights[:, None]

    def shift_of(self, held: Any) -> Any:
        """What held values (N, F) add to the right-hand side (n,)."""
        return self._known @ held.reshape(-1)

    def assemble(self, right_of: Callable[[Any], Any], sources: Sources, number: np.ndarray) -> None:
        """Find what the matrix and the right-hand side get.

        right_of: the right-hand side (n,) of numbers; sources: numbers without values of any kind whose source series
        (rows, n) a function of a region's name, its points and recursion gives. number (N, F): of every value the
        unknown it is, -1 where it is held.
        """
        fields, none = self.fields, right_of(sources(_nothing))

        def column(y: Any) -> Any:
            """Of one y the rows (F, n)."""
            made = []
            for g in range(fields):
                made.append(right_of(sources(partial(self._series, y=y, g=g))) - none)
            return (jnp if is_traced(made) else np).stack(made)

        if is_traced(self.params, none, [r._record.consts for r in self.records.values()]):
            rows = jax.lax.map(jax.checkpoint(column), jnp.asarray(self.points))
        elif len(self.points) > _FEW:
            rows = np.asarray(jax.jit(lambda y: jax.lax.map(column, y))(self.points))
        else:
            rows = np.stack([column(y) for y in self.points])
        self._place(rows * self.weights[:, None, None], number)

    def _place(self, rows: Any, number: np.ndarray) -> None:
        """rows (N, F, n): what stands before every value."""
        n, known = rows.shape[2], number.reshape(-1)
        rows, free = rows.reshape(len(known), n), np.flatnonzero(known >= 0)
        self._known = (rows * (known < 0)[:, None]).T
        if not is_traced(rows):
            block = np.zeros((n, n))
            np.subtract.at(block, known[free], rows[free])  # type: ignore[arg-type]
            self.block = block.T
        else:
            self.block = jnp.zeros((n, n)).at[:, known[free]].add(-rows[free].T)

    def _series(self, name: str | None, points: Any, rec: Recursion, y: Any, g: int) -> Any:
        """The source (rows, n) that kernel(x, y) makes in all equations of field g."""
        if name not in self.records:
            return np.zeros((rec.n_rows, 1))
        at = (jnp if is_traced(y) else np).broadcast_to(y, (len(points), len(y)))
        res = self._finite(name, points, rec.degree, at)
        if res is None:
            return np.zeros((rec.n_rows, 1))
        return source_rows(rec, res.reshape(self.fields, self.fields, *res.shape[1:])[:, g])

    def _finite(self, name: str | None, points: Any, degree: int, y: Any) -> Any:
        """Taylor coefficients (F F, T, n) of kernel(x, y) in x at pairs of points; None of a kernel that is zero."""
        _, res = self.records[name].coefficients(points, degree, extras=(y,), params=self.params)
        if res is not None and not is_traced(res) and not np.isfinite(res).all():
            bad = int(np.flatnonzero(~np.isfinite(np.asarray(res)).all(axis=(0, 1)))[0])
            raise ValueError(
                f"integral: the kernel or a derivative of it is NaN or infinite at x = {np.asarray(points)[bad]}, "
                f"y = {np.asarray(y)[bad]}; singular kernels are not made for: write it smoothly, as "
                "sqrt(|x - y|^2 + w^2) for |x - y| with w of two spacings or more"
            )
        return res

    def coarse(self) -> str | None:
        """In words, that the particles are too few for the kernel's integral over y; None where they are enough."""
        if is_traced(self.params):
            return None
        places = self.points[np.linspace(0, len(self.points) - 1, _PLACES).astype(int)]
        worst = 0.0
        for record in self.records.values():
            for x in places:
                fine, own = (self._values(record, x, y) for y in (self.finer.points, self.points))
                whole = fine @ self.finer.weights
                size = np.abs(fine) @ np.abs(self.finer.weights)
                off = np.abs(whole - own @ self.weights)
                worst = max(worst, float((off / np.where(size > 0, size, 1.0)).max()))
        if worst < _COARSE:
            return None
        return (
            f"The particles do not resolve the kernel of the integral term: its integral over y differs by {worst:.0%} "
            "from that between them; refine, or make it wider."
        )

    def _values(self, record: Any, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """kernel(x, y) for one x and many y, (F F, M)."""
        res = record.coefficients(np.broadcast_to(x, y.shape), 0, extras=(y,), params=self.params)[1]
        return np.zeros((1, len(y))) if res is None else np.broadcast_to(np.asarray(res)[:, 0], (len(res), len(y)))
