"""Clouds of the table of problems: lattices, scattered squares, density jumps, stars, plates with holes, balls."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

import jsmitsm as js

NORMALS = {"left": (-1.0, 0.0), "right": (1.0, 0.0), "bottom": (0.0, -1.0), "top": (0.0, 1.0)}


def lattice(lo: tuple, hi: tuple, shape: Any, jitter: float = 0.0, seed: int = 0) -> Callable[..., js.Cloud]:
    """What makes lattices of one box: of ``shape`` particles (a number is the same along every axis).

    ``jitter`` moves interior particles by up to that part of the spacing, on a line too.
    """
    dim = len(lo)

    def cloud(shape: Any = shape, jitter: float = jitter, seed: int = seed) -> js.Cloud:
        shape = (shape,) * dim if np.ndim(shape) == 0 else shape
        if dim > 1:
            return (js.rectangle if dim == 2 else js.box)(lo, hi, shape, jitter=jitter, seed=seed)
        made = js.interval(lo[0], hi[0], shape[0])
        if not jitter:
            return made
        points, inside = np.array(made.points), made.groups["interior"]
        move = np.random.default_rng(seed).uniform(-1, 1, (len(inside), 1))
        points[inside] += jitter * (hi[0] - lo[0]) / (shape[0] - 1) * move
        return js.Cloud(points, made.groups, made.normals)

    return cloud


def halton(n: int, seed: int) -> np.ndarray:
    """n points of a scrambled Halton sequence in the unit square, (n, 2)."""
    from scipy.stats import qmc

    return qmc.Halton(2, seed=seed).random(n)


def sided(inside: np.ndarray, x: np.ndarray, left: np.ndarray, right: np.ndarray) -> js.Cloud:
    """A cloud of the unit square: interior points, and particles of its sides.

    ``x``: abscissae along bottom and top, ``left`` and ``right``: ordinates with both corners.
    """
    sides = {
        "left": np.stack([0 * left, left], axis=1),
        "right": np.stack([0 * right + 1, right], axis=1),
        "bottom": np.stack([x, 0 * x], axis=1),
        "top": np.stack([x, 0 * x + 1], axis=1),
    }
    parts = {"interior": inside, **sides}
    ends = np.cumsum([0, *map(len, parts.values())])
    groups = {name: np.arange(i, j) for name, i, j in zip(parts, ends[:-1], ends[1:])}
    points = np.concatenate(list(parts.values()))
    normals = np.full(points.shape, np.nan)
    for name, normal in NORMALS.items():
        normals[groups[name]] = normal
    return js.Cloud(points, groups, normals)


def _away(points: np.ndarray, distance: float) -> np.ndarray:
    """Those points of the unit square that keep a distance from its sides."""
    return points[(points.min(axis=1) > distance) & (points.max(axis=1) < 1 - distance)]


def square(n: int = 1600, seed: int = 11, scattered: str = "halton") -> js.Cloud:
    """The unit square: about n interior particles (Halton or uniformly random), sides as dense as they are."""
    m = round(n**0.5)
    points = halton(n, seed) if scattered == "halton" else np.random.default_rng(seed).random((n, 2))
    t = np.linspace(0.0, 1.0, m + 1)
    return sided(_away(points, 0.3 / m), t[1:-1], t, t)


def step(sparse: float = 0.12, ratio: float = 10.0, at: float = 0.75, seed: int = 12) -> js.Cloud:
    """The unit square with a jump of the spacing at x = ``at``: ``sparse`` before, ``ratio`` times finer after."""
    dense = sparse / ratio
    parts = []
    for lo, hi, h in ((0.0, at, sparse), (at, 1.0, dense)):
        inside = halton(round((hi - lo) / h**2), seed) * [hi - lo, 1.0] + [lo, 0.0]
        parts.append(_away(inside, 0.3 * h))
    x = np.concatenate([_line(0.0, at, sparse)[1:], _line(at, 1.0, dense)[1:-1]])
    return sided(np.concatenate(parts), x, _line(0.0, 1.0, sparse), _line(0.0, 1.0, dense))


def stepped_lattice(seed: int = 14) -> js.Cloud:
    """The unit square with two slightly jittered lattices side by side, the right one ten times as fine."""
    grid = lambda x, y: np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    coarse = grid(np.arange(0.04, 0.9, 0.08), np.arange(0.08, 0.95, 0.08))
    dense = grid(np.arange(0.92, 0.999, 0.008), np.arange(0.008, 0.999, 0.008))
    inside = np.concatenate([coarse, dense])
    inside = inside + np.random.default_rng(seed).uniform(-0.001, 0.001, inside.shape)
    t = np.linspace(0.0, 1.0, 31)
    return sided(inside, t[1:-1], t, t)


def cluster(
    sparse: float = 0.07, ratio: float = 10.0, centre: tuple[float, float] = (0.62, 0.43), radius: float = 0.12,
    seed: int = 13,
) -> js.Cloud:  # fmt: skip
    """The unit square with a disc in which the spacing is ``ratio`` times finer, without transition."""
    dense = sparse / ratio
    around = _away(halton(round(1 / sparse**2), seed), 0.3 * sparse)
    around = around[np.linalg.norm(around - centre, axis=1) > radius]
    disc = (2 * halton(round(4 * radius**2 / dense**2), seed) - 1) * radius
    disc = disc[np.linalg.norm(disc, axis=1) < radius] + centre
    t = _line(0.0, 1.0, sparse)
    return sided(np.concatenate([around, disc]), t[1:-1], t, t)


def _line(lo: float, hi: float, spacing: float) -> np.ndarray:
    return np.linspace(lo, hi, max(round((hi - lo) / spacing), 1) + 1)


def star_radius(angle: Any) -> Any:
    return 1.0 + 0.2 * jnp.sin(5 * angle + 0.6)


def star(spacing: float = 0.0285, groups: Mapping[str, Callable] | None = None, seed: int = 3) -> js.Cloud:
    """A smooth star with five arms; about 4200 particles at the spacing 0.0285."""

    def inside(x):
        # 1e-300 keeps the gradient finite at the centre.
        return jnp.sqrt(x[0] ** 2 + x[1] ** 2 + 1e-300) - star_radius(jnp.arctan2(x[1], x[0]))

    return js.from_sdf(inside, ((-1.3, -1.3), (1.3, 1.3)), spacing, seed=seed, groups=groups)


STAR_PARTS = {"lower": lambda x: x[:, 1] < -0.2, "upper": lambda x: x[:, 1] >= -0.2}


def amoeba(spacing: float = 0.027) -> js.Cloud:
    """The amoeba r < 1 + 0.2 cos 5t; about 5000 particles at the spacing 0.027."""
    return js.from_sdf(amoeba_level, ((-1.3, -1.3), (1.3, 1.3)), spacing)


def disk(spacing: float = 0.05) -> js.Cloud:
    """The unit disk."""
    return js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.1, -1.1), (1.1, 1.1)), spacing)


def amoeba_level(x: Any) -> Any:
    return jnp.sqrt(x[0] ** 2 + x[1] ** 2 + 1e-300) - 1 - 0.2 * jnp.cos(5 * jnp.arctan2(x[1], x[0]))


def two_holes(spacing: float = 0.1) -> js.Cloud:
    """A plate with two holes; groups outer, hot, cold."""
    shape = js.sdf.difference(
        js.sdf.rectangle((0.0, 0.0), (3.0, 2.0)), js.sdf.circle((0.9, 1.2), 0.35), js.sdf.circle((2.1, 0.7), 0.45)
    )

    def near(x, centre, radius):
        return np.abs(np.linalg.norm(x - np.array(centre), axis=1) - radius) < 1e-6

    groups = {
        "hot": lambda x: near(x, (0.9, 1.2), 0.35),
        "cold": lambda x: near(x, (2.1, 0.7), 0.45),
        "outer": lambda x: x[:, 0] > -1,
    }
    return js.from_sdf(shape, ((0.0, 0.0), (3.0, 2.0)), spacing, groups=groups)


def holed_plate(half: float = 3.0, near: float = 0.05, growth: float = 0.15, seed: int = 4) -> js.Cloud:
    """The square [-half, half]^2 with a hole of radius 1; the spacing grows from ``near`` away from the hole."""
    shape = js.sdf.difference(js.sdf.rectangle((-half, -half), (half, half)), js.sdf.circle((0.0, 0.0), 1.0))

    def spacing(x):
        return near + growth * (np.linalg.norm(x, axis=1) - 1.0)

    return js.from_sdf(shape, ((-half, -half), (half, half)), spacing, seed=seed, groups={
        "hole": lambda x: np.linalg.norm(x, axis=1) < 1.5, "outer": lambda x: np.linalg.norm(x, axis=1) > 1.5,
    })  # fmt: skip


def ball(n: int = 5500, surface: int = 1800, seed: int = 5) -> js.Cloud:
    """The unit ball: n uniformly random particles inside, a Fibonacci spiral on the sphere."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    # No particle within a third of a spacing of the sphere.
    reach = 1.0 - (4.19 / (n + surface)) ** (1 / 3) / 3
    inside = direction * reach * rng.random((n, 1)) ** (1 / 3)
    k = np.arange(surface) + 0.5
    z = 1.0 - 2.0 * k / surface
    angle = np.pi * (1.0 + 5**0.5) * k
    r = np.sqrt(1.0 - z**2)
    sphere = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    groups = {"interior": np.arange(n), "sphere": np.arange(n, n + surface)}
    normals = np.concatenate([np.full(inside.shape, np.nan), sphere])
    return js.Cloud(np.concatenate([inside, sphere]), groups, normals)
