"""The zero level of a signed-distance-like function: evaluation in batches, projection, boundary particles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jsmitsm.cloud import filling
from jsmitsm.cloud.filling import Spacing
from jsmitsm.runtime.compiled import fingerprint, kept
from jsmitsm.runtime.errors import IN_FUNCTIONS, in_words
from jsmitsm.runtime.jaxprs import inlined
from jsmitsm.runtime.snapshot import snapshot

_BATCH = 1024  # every call is padded to this size: one compilation per function and dimension
LEAST = 5.0  # spacings round a boundary component below which its shape is lost


class Boundary(NamedTuple):
    """Boundary particles (B, D) with unit outward normals (B, D)."""

    points: np.ndarray
    normals: np.ndarray


def _value_and_gradient(sdf: ClosedJaxpr, dim: int) -> Callable[[np.ndarray], tuple[jax.Array, jax.Array]]:
    """Of a batch of points; one program for all functions that record the same."""
    batch = jax.ShapeDtypeStruct((_BATCH, dim), jnp.float64)
    closed = jax.make_jaxpr(jax.vmap(jax.value_and_grad(lambda x: jaxpr_as_fun(sdf)(x)[0])))(batch)
    jaxpr = closed.jaxpr
    program = kept(("sdf", fingerprint(jaxpr)), lambda: jax.jit(lambda consts, x: inlined(jaxpr, consts, [x])))
    return lambda x: program(closed.consts, x)


class SdfRegion:
    """The part of the box lo, hi where ``sdf`` is negative."""

    def __init__(self, sdf: Callable[..., Any], lo: np.ndarray, hi: np.ndarray):
        self.lo, self.hi = lo, hi
        self.size = float((hi - lo).max())
        self._recorded = _value_and_gradient(_recorded(sdf, len(lo)), len(lo))
        self._check_faces()

    def _check_faces(self) -> None:
        """Raise where the domain reaches through the box."""
        dim = len(self.lo)
        ticks = [np.linspace(a, b, {1: 2, 2: 257, 3: 41}[dim]) for a, b in zip(self.lo, self.hi)]
        for axis in range(dim):
            for end in (self.lo, self.hi):
                sides = [np.array([end[i]]) if i == axis else t for i, t in enumerate(ticks)]
                x = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, dim)
                value = self.evaluate(x)[0]
                if value.min() < -1e-9 * self.size:
                    raise ValueError(
                        f"bounds: cut the domain, sdf = {value.min():.3g} at {x[value.argmin()]} on a face of the box "
                        f"from {self.lo} to {self.hi}; enlarge the bounds until sdf >= 0 on every face"
                    )

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (M,) and gradients (M, D); outside of the box everything is positive."""
        count = len(x)
        value, gradient = np.empty(count), np.empty(x.shape)
        for i in range(0, count, _BATCH):
            part = x[i : i + _BATCH]
            padded = np.concatenate([part, np.broadcast_to(part[:1], (_BATCH - len(part), x.shape[1]))])
            v, g = self._recorded(padded)
            value[i : i + _BATCH], gradient[i : i + _BATCH] = (np.asarray(a)[: len(part)] for a in (v, g))
        beyond = np.maximum(self.lo - x, x - self.hi)
        out = beyond.max(axis=1)
        bad = np.flatnonzero(~np.isfinite(value) & (out <= 0))
        if len(bad):
            raise ValueError(
                f"sdf: returned {value[bad[0]]} at {x[bad[0]]}, expected a finite number everywhere in the bounds; "
                "guard square roots, logarithms and divisions with jnp.where"
            )
        # Other parts of {sdf < 0} may lie beyond the box; the box cuts them off.
        cut = np.flatnonzero((out > 0) & ~(value > 0))
        value[cut] = out[cut]
        gradient[cut] = np.where(beyond[cut] == out[cut, None], np.sign(x[cut] - (self.lo + self.hi) / 2), 0.0)
        return value, gradient

    def distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First-order distance sdf / |grad sdf| (M,) and unit gradient (M, D)."""
        value, gradient = self.evaluate(x)
        slope = np.linalg.norm(gradient, axis=1)
        # Where the gradient vanishes or is NaN (a centre, a ridge) the value has to do.
        good = np.isfinite(slope) & (slope > 0)
        slope[~good] = 1.0
        gradient[~good] = 0.0
        return value / slope, gradient / slope[:, None]

    def project(self, x: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Newton steps of at most ``reach`` (M,) to the zero level; points (M, D) and whether they arrived."""
        x = x.copy()
        best, found = np.full(len(x), np.inf), x.copy()
        live = np.arange(len(x))
        for _ in range(40):
            distance, outward = self.distance(x[live])
            better = np.abs(distance) < best[live]
            at = live[better]
            best[at], found[at] = np.abs(distance[better]), x[at]
            step = np.clip(distance, -reach[live], reach[live])
            going = np.abs(distance) > 4e-16 * self.size
            live, step, outward = live[going], step[going], outward[going]
            if not len(live):
                break
            x[live] -= step[:, None] * outward
        return found, best <= 1e-13 * self.size

    def normals(self, x: np.ndarray) -> np.ndarray:
        """Unit gradients (M, D) at points of the zero level."""
        outward = self.distance(x)[1]
        lost = np.flatnonzero(~outward.any(axis=1))
        if len(lost):
            raise ValueError(
                f"sdf: its gradient vanishes or is not finite at the boundary point {x[lost[0]]}; the function must "
                "cross zero with a slope (not be a square or an absolute value)"
            )
        return outward


def _recorded(sdf: Any, dim: int) -> ClosedJaxpr:
    """The function as it is now, of one point."""
    if not callable(sdf):
        raise ValueError(f"sdf: expected a function x (D,) -> scalar, got {sdf!r}")
    if jax.dtypes.canonicalize_dtype(np.float64) != np.float64:
        raise ValueError(
            "sdf: JAX computes in float32 here, boundary particles to 1e-10 need float64; put "
            'jax.config.update("jax_enable_x64", True) at the beginning of the program'
        )
    try:
        closed, out = snapshot(sdf, jax.ShapeDtypeStruct((dim,), jnp.float64))
    except IN_FUNCTIONS as error:
        raise ValueError(
            f"sdf: failed for one point x of shape ({dim},), the dimension of the bounds; write it with "
            "jax.numpy, jnp.where in place of if, for points of that dimension "
            f"({type(error).__name__}: {in_words(error).splitlines()[0]})"
        ) from error
    if getattr(out, "shape", None) != () or not jnp.issubdtype(out.dtype, jnp.floating):
        raise ValueError(
            f"sdf: returned {out} for one point x of shape ({dim},), expected a real scalar; "
            "it is mapped over points here, write it for a single one"
        )
    if out.dtype != jnp.float64:
        raise ValueError(
            f"sdf: computes in {out.dtype}, float64 was expected; drop casts and constants of lower precision"
        )
    return closed


def checked(region: SdfRegion, boundary: Boundary) -> Boundary:
    """The same boundary, once all of it is seen to lie on the zero level."""
    value, gradient = region.evaluate(boundary.points)
    slope = np.maximum(np.nan_to_num(np.linalg.norm(gradient, axis=1)), 1.0)
    off = np.flatnonzero(np.abs(value) > 1e-11 * max(1.0, region.size) * slope)
    if len(off):
        raise ValueError(
            f"sdf: {len(off)} boundary points could not be brought to its zero level, e.g. sdf = {value[off[0]]:.3g} "
            f"at {boundary.points[off[0]]}; the function must be continuous and cross zero with a slope"
        )
    return boundary


def cells_near(region: SdfRegion, spacing: Spacing, fraction: float) -> tuple[filling.Cells, filling.Cells]:
    """Octree cells near the zero level, and the coarse ones around; raises for an empty domain."""
    pad = 1.01 * region.size / filling.BASE[len(region.lo)]
    cells, coarse = filling.refine(region, spacing, region.lo - pad, region.hi + pad, fraction, False)
    if not ((cells.distance < 0).any() or (coarse.distance < 0).any()):
        raise ValueError(
            f"sdf: never negative in the bounds from {region.lo} to {region.hi} (looked at "
            f"{len(cells.distance) + len(coarse.distance)} points); negative is inside: check its sign and the bounds"
        )
    return cells, coarse


def root(region: SdfRegion, a: np.ndarray, b: np.ndarray, tolerance: float) -> np.ndarray:
    """Zeros on the segments from a to b (M, D), whose ends differ in sign: Illinois, bisection every third step."""
    fa, fb = region.evaluate(a)[0], region.evaluate(b)[0]
    s, t = np.zeros(len(a)), np.ones(len(a))
    result, live = np.zeros(len(a)), np.arange(len(a))
    for step in range(90):
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.where(step % 3 == 2, (s + t) / 2, s - fa * (t - s) / (fb - fa))
        u = np.clip(np.where(np.isfinite(u), u, (s + t) / 2), s, t)
        result[live] = u
        f = region.evaluate(a[live] + u[:, None] * (b - a)[live])[0]
        left = (f < 0) == (fa < 0)  # the zero lies between u and t
        s, t = np.where(left, u, s), np.where(left, t, u)
        fa, fb = np.where(left, f, fa / 2), np.where(left, fb / 2, f)
        going = (t - s > tolerance) & (f != 0)
        live, s, t, fa, fb = live[going], s[going], t[going], fa[going], fb[going]
        if not len(live):
            break
    return a + result[:, None] * (b - a)
