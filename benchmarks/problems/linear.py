"""Linear equations of one field: every kind of operator of order one to four."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks import scenes
from benchmarks.problems.case import (
    SIDES,
    Case,
    curved,
    diffusion,
    laplace,
    on_box,
    scattered,
    slope,
    smooth,
    table,
    zero,
)

# ------------------------------------------------------------------ on scattered particles of the square


def _anisotropic(u, x):
    return 1000 * js.partial(u, (2, 0))(x) + js.partial(u, (0, 2))(x)


def _rotated(angle: float) -> Callable:
    c, s = math.cos(angle), math.sin(angle)
    rotation = np.array([[c, -s], [s, c]])
    tensor = rotation @ np.diag([1000.0, 1.0]) @ rotation.T
    return lambda u, x: jnp.sum(jnp.asarray(tensor) * js.hessian(u)(x))


def _helmholtz(u, x):
    return js.laplacian(u)(x) + 10.5**2 * u(x)


def _plane_wave(x):
    # 0.28^2 + 0.96^2 = 1
    return jnp.cos(10.5 * (0.28 * x[0] + 0.96 * x[1]) + 0.5)


def _convective(u, x):
    return -1e-3 * js.laplacian(u)(x) + jnp.array([0.8, -0.4 + x[0]]) @ js.grad(u)(x)


def _heat(u, x):
    return js.partial(u, (0, 1))(x) - 0.25 * js.partial(u, (2, 0))(x)


def _cooling(x):
    decay = lambda k: jnp.exp(-0.25 * (k * math.pi) ** 2 * x[1])
    return decay(1) * jnp.sin(math.pi * x[0]) + 0.3 * decay(2) * jnp.sin(2 * math.pi * x[0]) + 1.0 + x[0]


def _wave(u, x):
    return js.partial(u, (0, 2))(x) - js.partial(u, (2, 0))(x)


def _travelling(x):
    return jnp.cos(2.5 * (x[0] - x[1]) + 0.2) + jnp.sin(2 * (x[0] + x[1]))


def _mixed_derivative(u, x):
    return js.partial(u, (1, 1))(x) + u(x)


def _transported(u, x):
    return jnp.array([1.0, 0.4 + 0.2 * x[0]]) @ js.grad(u)(x) + u(x)


def _dispersive(u, x):
    return js.partial(u, (0, 1))(x) + js.partial(u, (3, 0))(x)


def _biharmonic(u, x):
    return js.laplacian(js.laplacian(u))(x)


_CONDUCTIVITY = diffusion(lambda y: 1.5 + jnp.sin(3 * y[0] - y[1]) * y[1])
SCATTERED = (
    scattered(
        "diffusion", "div(a(x) grad u) = f on random particles", _CONDUCTIVITY, smooth,
        {4: 8.4e-9, 6: 2.1e-12, 8: 1e-12},
        cloud=lambda: scenes.square(scattered="random"),
    ),
    scattered("anisotropy", "1000 u_xx + u_yy = f", _anisotropic, smooth, {4: 1e-6, 6: 1e-9}, estimates=(4, 6)),
    scattered("rotated", "conductivity 1000:1 at 0.5 rad", _rotated(0.5), smooth, {4: 1e-6, 6: 1e-9}, estimates=(4, 6)),
    scattered(
        "helmholtz", "laplacian(u) + 10.5^2 u = 0, a plane wave", _helmholtz, _plane_wave,
        {4: 2e-5, 6: 2.9e-8, 8: 6e-11},
        source=zero, estimates=(4, 6, 8),
    ),
    scattered(
        "convection", "-1e-3 laplacian(u) + b(x) . grad u = f, smooth", _convective, smooth,
        {4: 1e-5, 6: 1e-8, 8: 1e-11}, estimates=(4, 6),
    ),
    scattered(
        "heat", "u_t = u_xx/4 in space-time", _heat, _cooling, {4: 1e-3, 6: 1e-5, 8: 1e-6},
        source=zero, bcs={"top": js.free()}, estimates=(4, 6),  # at order 8 round-off of the form is in the error
    ),
    scattered(
        "wave", "u_tt = u_xx in space-time", _wave, _travelling, {6: 1e-7}, source=zero,
        bcs={"bottom": [js.dirichlet(_travelling), slope(_travelling)], "top": js.free()}, estimates=(6,),
    ),
    scattered(
        "u_xy", "u_xy + u = f, data on two sides", _mixed_derivative, smooth, {4: 1e-5, 6: 1e-8},
        bcs={"right": js.free(), "top": js.free()}, estimates=(4,),
    ),
    scattered(
        "transport", "b(x) . grad u + u = f, data where it flows in", _transported, smooth, {4: 5e-7, 6: 1e-9},
        bcs={"right": js.free(), "top": js.free()},
    ),
    scattered(
        "dispersion", "u_t + u_xxx = f in space-time", _dispersive, smooth, {6: 1e-5, 8: 1e-7},
        bcs={"right": [js.dirichlet(smooth), slope(smooth)], "top": js.free()},
    ),
    scattered(
        "biharmonic", "laplacian^2(u) = f, clamped", _biharmonic, smooth, {4: 1e-5, 6: 1e-8, 8: 1e-11},
        bcs={side: [js.dirichlet(smooth), slope(smooth)] for side in SIDES[:4]}, estimates=(4, 6, 8),
    ),
)  # fmt: skip


# ------------------------------------------------------------------ on lattices, in one to three dimensions


def _every_term(u: Any, x: Any) -> Any:
    """div(a grad u) + b u_x - c u: every kind of term, no coefficient constant."""
    a = lambda y: 1.0 + 0.3 * jnp.sin(jnp.sum(y)) + 0.2 * y[0]
    convected = (1.0 + x[0]) * js.partial(u, (1,) + (0,) * (len(x) - 1))(x)
    return diffusion(a)(u, x) + convected - jnp.exp(x[-1]) * u(x)


def _plain(x: Any) -> Any:
    """Smooth, without symmetry, no polynomial, the same size everywhere."""
    value = jnp.exp(x[0]) * jnp.sin(2.0 * x[-1] + 0.4)
    return value if len(x) < 3 else value + jnp.cos(x[0] + 2.0 * x[1])


def _skew_wave(x: Any) -> Any:
    return jnp.sin(2 * x[0] + x[1])


def _growing(x: Any) -> Any:
    return jnp.exp(x[0]) * jnp.sin(x[1])


def _steep(x: Any) -> Any:
    return jnp.exp(x[0]) * jnp.sin(3 * x[1])


def _load(x: Any) -> Any:
    return jnp.cos(jnp.pi * x[0] / 2) * jnp.cos(jnp.pi * x[1] / 2)


def layer(eps: float, **more: Any) -> Case:
    """A wind from left to right with little diffusion: a layer of thickness eps at x = 1."""
    return on_box(
        f"layer {eps:g}", "-eps laplacian(u) + u_x = 1", lambda u, x: -eps * js.laplacian(u)(x) + js.grad(u)(x)[0],
        lambda x: x[0] - jnp.expm1(x[0] / eps) / jnp.expm1(1 / eps), source=lambda x: 1.0, shape=31, jitter=0.3, **more,
    )  # fmt: skip


_UNIT = {d: ((0.0,) * d, (1.0,) * d) for d in (1, 2, 3)}
_WIDE = ((-1.0, -1.0), (1.0, 1.0), 19, 0.3)
_RESTING = [js.dirichlet(0.0), js.condition(lambda u, x, n: js.laplacian(u)(x))]
_SHAPE = {1: 41, 2: 31, 3: 9}
_JITTERED = {1: {4: 4e-7}, 2: {4: 1e-7}, 3: {4: 2e-5}}
_DEEP = {"poisson": {4: 5e-9, 6: 3.8e-12}, "every term": {4: 5.1e-9, 6: 3.9e-12}}

ON_LATTICES = (
    *(
        on_box(f"{name} {d}D", about, operator, exact, *_UNIT[d], _SHAPE[d], 0.3,
               ceilings=_DEEP.get(name, _JITTERED[d]) if d == 2 else _JITTERED[d])
        for name, about, operator, exact in (
            ("poisson", "laplacian(u) = f", laplace, curved), ("plain", "laplacian(u) = f, u plain", laplace, _plain),
            ("every term", "div(a grad u) + b u_x - c u = f", _every_term, curved),
        )
        for d in (1, 2, 3)
    ),
    on_box("harmonic", "laplacian(u) = 0, u = exp(x) sin y", laplace, _growing, source=zero, ceilings={4: 2e-8}),
    on_box("steep", "laplacian(u) = f, u = exp(x) sin 3y", laplace, _steep, source=lambda x: -8 * _steep(x),
           ceilings={4: 5e-6}),
    on_box("conductor", "div(exp(x y) grad u) = f, u = sin(2x + y)", diffusion(lambda y: jnp.exp(y[0] * y[1])),
           _skew_wave, *_WIDE, ceilings={4: 1e-6, 6: 2.4e-9, 8: 4.7e-12}),
    on_box(
        "resting plate", "laplacian^2(w) = q = cos(pi x/2) cos(pi y/2), w = 4 q / pi^4", _biharmonic,
        lambda x: 4 * _load(x) / jnp.pi**4, *_WIDE, source=_load, bcs={side: _RESTING for side in SIDES[:4]},
        ceilings={8: 5e-5},
    ),
    on_box(
        "oscillating rod", "u'' = -16 sin 4x, u = sin 4x + x", laplace, lambda x: jnp.sin(4 * x[0]) + x[0],
        (0.0,), (2.0,), 21, source=lambda x: -16 * jnp.sin(4 * x[0]), ceilings={6: 1e-5},
    ),
    layer(0.05, ceilings={4: 3e-5, 6: 4.5e-7}),
    on_box(
        "third order", "u''' + (1 + x) u' = f",
        lambda u, x: js.partial(u, (3,))(x) + (1 + x[0]) * js.partial(u, (1,))(x), curved, *_UNIT[1], 41, 0.3,
        bcs={"left": [js.dirichlet(curved), slope(curved)]}, ceilings={6: 1e-5, 8: 1e-7},
    ),
)  # fmt: skip


# ------------------------------------------------------------------ what kernels are tuned on, and then used on


def _peak(width: float) -> Callable[[Any], Any]:
    return lambda x: jnp.exp(-((x[0] - 0.45) ** 2 + (x[1] - 0.55) ** 2) / width**2)


_WAVY = diffusion(lambda y: 1.0 + 0.5 * jnp.sin(y[0] + 2 * y[1]))
TUNED = (
    on_box("oscillatory", "laplacian(u) = f, u = sin(9x + 1) cos 8y", laplace,
           lambda x: jnp.sin(9 * x[0] + 1) * jnp.cos(8 * x[1]), shape=15,
           ceilings={4: 5.9e-5, 6: 3e-6, 8: 6e-7}),
    on_box("jittered", "div((1 + sin(x + 2y)/2) grad u) = f", _WAVY, curved, shape=14, jitter=0.25, seed=5,
           ceilings={4: 2.3e-7, 6: 5.4e-10}),
    on_box("narrow peak", "laplacian(u) = f, u a Gauss peak of width 0.12", laplace, _peak(0.12), shape=17,
           ceilings={4: 6.6e-4, 6: 3.9e-4, 8: 6.4e-4}),
    on_box("solid", "laplacian(u) = f in 3D, u = exp(x) sin 2y cos z", laplace,
           lambda x: jnp.exp(x[0]) * jnp.sin(2 * x[1]) * jnp.cos(x[2]), *_UNIT[3], 7, 0.1, 2, ceilings={4: 1.7e-6}),
    on_box("solid wave", "laplacian(u) = f in 3D, u = sin(4x + 1) cos 3y cos(3z - 1/2)", laplace,
           lambda x: jnp.sin(4 * x[0] + 1) * jnp.cos(3 * x[1]) * jnp.cos(3 * x[2] - 0.5), *_UNIT[3], 8, 0.1, 3,
           ceilings={4: 2.7e-5}),
)  # fmt: skip

LINEAR = table(*SCATTERED, *ON_LATTICES, *TUNED)
