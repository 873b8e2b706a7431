"""Manufactured solutions of random sharpness, functions (x, p) of one point with numbers p."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.particle.batches import QUICKLY
from jsmitsm.runtime.compiler_options import on_cpu


def _along(x: Any, p: Any) -> Any:
    return p["direction"] @ (x - p["centre"])


def _rest(x: Any, p: Any) -> Any:
    return p["constant"] + p["slope"] @ x


def smooth(x: Any, p: Any) -> Any:
    return _rest(x, p) + p["size"] * jnp.exp(0.6 * _along(x, p)) * jnp.sin(2.0 * x[-1] + x[0] + p["phase"])


def wave(x: Any, p: Any) -> Any:
    return _rest(x, p) + p["size"] * jnp.sin(_along(x, p) / p["width"] + p["phase"])


def standing(x: Any, p: Any) -> Any:
    s = p["direction"] * (x - p["centre"]) / p["width"] + p["phase"]
    return _rest(x, p) + p["size"] * jnp.sin(s[0]) * (jnp.cos(s[-1]) if len(x) > 1 else 1.0)


def peak(x: Any, p: Any) -> Any:
    return _rest(x, p) + p["size"] * jnp.exp(-jnp.sum((x - p["centre"]) ** 2) / p["width"] ** 2)


def pole(x: Any, p: Any) -> Any:
    return _rest(x, p) + p["size"] / (1.0 + jnp.sum((x - p["centre"]) ** 2) / p["width"] ** 2)


def front(x: Any, p: Any) -> Any:
    return _rest(x, p) + p["size"] * jnp.tanh(_along(x, p) / p["width"])


def layer(x: Any, p: Any) -> Any:
    return _rest(x, p) + p["size"] * jnp.exp(-(p["direction"] @ x - p["start"]) / p["width"])


def laminate(x: Any, q: Any) -> Any:
    """The integral of 1 / k along the direction in which the conductivity k = 1 + c (1 + tanh s) steps."""
    s = q["across"] @ (x - q["at"]) / q["steep"]
    a, c = 1.0 + q["contrast"], q["contrast"]
    # log(a cosh s + c sinh s), which does not overflow.
    log = jnp.abs(s) + jnp.log(0.5 * (a + c * jnp.sign(s) + (a - c * jnp.sign(s)) * jnp.exp(-2.0 * jnp.abs(s))))
    return (a * s - c * log) / (a**2 - c**2)


SOLUTIONS: dict[str, Callable[[Any, Any], Any]] = {
    f.__name__: f for f in (smooth, wave, standing, peak, pole, front, layer)
}


@cache
def exact(name: str, fields: int) -> Callable[[Any, Any], Any]:
    """The solution (x, q), a scalar or (F,), from the numbers q["fields"]."""
    if name == "laminate":
        return laminate
    one = SOLUTIONS[name]
    if fields == 1:
        return lambda x, q: one(x, q["fields"][0])
    return lambda x, q: jnp.stack([one(x, p) for p in q["fields"]])


@cache
def _compiled(name: str, fields: int, slopes: bool) -> Callable[[Any, Any], Any]:
    f = exact(name, fields)
    return jax.jit(jax.vmap(jax.jacfwd(f) if slopes else f, (0, None)), compiler_options=on_cpu(QUICKLY))


def values(name: str, fields: int, points: Any, q: Any, slopes: bool = False) -> np.ndarray:
    """The solution at points (N, D): (N,) or (N, F); with ``slopes`` its gradient, one axis more."""
    points = np.asarray(points)
    n = len(points)
    size = max(16, 1 << (n - 1).bit_length())  # few shapes, few programs
    padded = np.concatenate([points, np.repeat(points[:1], size - n, axis=0)])
    return np.asarray(_compiled(name, fields, slopes)(padded, q))[:n]


def numbers(rng: np.random.Generator, name: str, points: np.ndarray, spacing: float, width: float) -> dict[str, Any]:
    """Numbers of a solution whose features are ``width`` spacings wide, on a cloud of these points."""
    dim = points.shape[1]
    direction = rng.normal(size=dim)
    direction = direction / np.linalg.norm(direction)
    if name == "layer" and rng.random() < 0.5:
        direction = np.eye(dim)[rng.integers(dim)] * rng.choice([-1.0, 1.0])
    offset = rng.choice([0.0, 1.0, 3.0], p=[0.5, 0.35, 0.15])
    return {
        "direction": direction,
        "centre": points[rng.integers(len(points))] + spacing * rng.uniform(-0.5, 0.5, dim),
        "start": np.float64((points @ direction).min()),
        "width": np.float64(width * spacing),
        "phase": np.float64(rng.uniform(0.0, 6.3)),
        "size": np.float64(rng.uniform(0.5, 2.0) * rng.choice([-1.0, 1.0])),
        "constant": np.float64(offset * rng.choice([-1.0, 1.0])),
        "slope": rng.uniform(-0.5, 0.5, dim) * rng.choice([0.0, 1.0]),
    }
