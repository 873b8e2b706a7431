"""The three problems of Karamanli (2015), and sources with a kink, a jump or a narrow peak."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks.problems.case import SIDES, Case, laplace, on_box, table, zero

# ------------------------------------------------------------------ the paper's three problems


def _heated(x: Any) -> Any:
    """The series (34): a rectangle [0, 4] x [0, 9] heated to 100 on its top."""
    k = jnp.arange(1, 400, 2) * (math.pi / 4)
    # sinh(k y) / sinh(9 k) without overflow.
    ratio = jnp.exp(k * (x[1] - 9)) * (1 - jnp.exp(-2 * k * x[1])) / (1 - jnp.exp(-18 * k))
    return 100 * jnp.sum(jnp.sin(k * x[0]) * ratio / k)


def _heated_edges(points: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The series does not converge on the top: 100 there, and 0 at its two corners."""
    x, y = points.T
    return np.where((x <= 0) | (x >= 4), 0.0, np.where(y >= 9, 100.0, values))


def _wave(x: Any) -> Any:
    return jnp.sin(x[0]) * jnp.cos(x[1])


PAPER = table(
    on_box(
        "rod", "u'' = x^3, u = x^5/20 + 2x + 1 (section 4.1)", laplace, lambda x: x[0] ** 5 / 20 + 2 * x[0] + 1,
        (0.0,), (2.0,), 20, source=lambda x: x[0] ** 3, bcs={"left": js.dirichlet(1.0), "right": js.dirichlet(6.6)},
        ceilings={5: 1e-12},
    ),
    on_box(
        "plate", "laplacian(T) = 0, T = 100 on top, else 0 (section 4.2)", laplace, _heated, (0.0, 0.0), (4.0, 9.0),
        (9, 19), source=zero, corrected=_heated_edges, smooth=False, ceilings={4: 5e-2},
        bcs={side: js.dirichlet(100.0 if side == "top" else 0.0) for side in SIDES[:4]},
    ),
    on_box(
        "source", "laplacian(T) = -2 sin x cos y, T = sin x cos y, dT/dy = 0 at y = 0 (section 4.3)", laplace, _wave,
        (0.0, 0.0), (4.0, 9.0), (9, 19), source=lambda x: -2 * _wave(x), bcs={"bottom": js.neumann(0.0)},
        ceilings={4: 1e-2, 8: 1e-3},
    ),
)  # fmt: skip


# ------------------------------------------------------------------ nonsmooth sources

# Every singularity has a free place, so that it can be moved relative to the particles.


def _rough(name: str, about: str, source: Callable, exact: Callable, ceilings: dict[int, float]) -> Case:
    """laplacian(u) = source on the unit interval or square."""
    dim = 1 if name.endswith("1D") else 2
    return on_box(
        name, about, laplace, exact, (0.0,) * dim, (1.0,) * dim, 41, jitter=0.3 * (dim > 1),
        source=source, ceilings=ceilings, smooth=False,
    )  # fmt: skip


def kink_1d(at: float = 0.4472) -> Case:
    """u'' = |x - at|."""
    return _rough(
        "kink 1D", "u'' = |x - c|, u = |x - c|^3/6",
        lambda x: jnp.abs(x[0] - at), lambda x: jnp.abs(x[0] - at) ** 3 / 6, {4: 1e-2},
    )  # fmt: skip


def jump_1d(at: float = 0.4472) -> Case:
    """u'' = 1 to the right of ``at``, else 0."""
    return _rough(
        "jump 1D", "u'' = [x > c], u = max(x - c, 0)^2/2", lambda x: jnp.where(x[0] > at, 1.0, 0.0),
        lambda x: jnp.maximum(x[0] - at, 0.0) ** 2 / 2, {4: 0.1},
    )  # fmt: skip


def peak_1d(at: float = 0.4472, width: float = 0.05) -> Case:
    """u'' = a peak of area 1 and the given width: a smoothed point load."""
    return _rough(
        "peak 1D", "u'' = w^2/(2 s^3), u = s/2, s = sqrt((x - c)^2 + w^2)",
        lambda x: 0.5 * width**2 / ((x[0] - at) ** 2 + width**2) ** 1.5,
        lambda x: 0.5 * jnp.sqrt((x[0] - at) ** 2 + width**2), {4: 5e-4},
    )  # fmt: skip


def _distance(x: Any, centre: tuple[float, ...]) -> Any:
    return jnp.sqrt(sum((x[k] - c) ** 2 for k, c in enumerate(centre)))


def kink_2d(at: float = 0.8, centre: tuple[float, float] = (-0.2, -0.1)) -> Case:
    """laplacian(u) = |r - at|, a kink along a circle whose centre lies outside the square."""

    def exact(x):
        r, c = _distance(x, centre), at
        inside = c * r**2 / 4 - r**3 / 9
        return jnp.where(r < c, inside, -inside + c**3 * (5 / 18 + jnp.log(r / c) / 3))

    return _rough("kink 2D", "laplacian(u) = |r - c|", lambda x: jnp.abs(_distance(x, centre) - at), exact, {4: 5e-4})


def jump_2d(at: float = 0.3, centre: tuple[float, float] = (0.4472, 0.5345)) -> Case:
    """laplacian(u) = 1 inside a circle, else 0."""

    def exact(x):
        r2, c = sum((x[k] - centre[k]) ** 2 for k in range(2)), at
        return jnp.where(r2 < c**2, r2 / 4, c**2 / 4 * (1 + jnp.log(jnp.maximum(r2, c**2) / c**2)))

    def source(x):
        return jnp.where(sum((x[k] - centre[k]) ** 2 for k in range(2)) < at**2, 1.0, 0.0)

    return _rough("jump 2D", "laplacian(u) = [r < c]", source, exact, {4: 1e-2})


def peak_2d(centre: tuple[float, float] = (0.4472, 0.5345), width: float = 0.05) -> Case:
    """laplacian(u) = a peak of volume 1 and the given width: a smoothed point load."""

    def square(x):
        return sum((x[k] - centre[k]) ** 2 for k in range(2)) + width**2

    return _rough(
        "peak 2D", "laplacian(u) = w^2/(pi s^2), u = log(s)/(4 pi), s = r^2 + w^2",
        lambda x: width**2 / (math.pi * square(x) ** 2), lambda x: jnp.log(square(x)) / (4 * math.pi), {4: 1e-2},
    )  # fmt: skip


NONSMOOTH = table(kink_1d(), jump_1d(), peak_1d(), kink_2d(), jump_2d(), peak_2d())
