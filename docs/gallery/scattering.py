"""Waves around a cylinder

A plane wave meets a soft cylinder. Unknown is the complex scattered wave; it
leaves through a layer on all sides, beyond 2, in which the coordinates are
complex and waves die out without an echo (a perfectly matched layer). Beside
it stands the series of Hankel functions that solves the whole plane.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

from scipy.special import hankel1, jv

k = 3.0
square = js.sdf.rectangle((-3, -3), (3, 3))
cloud = js.from_sdf(
    js.sdf.difference(square, js.sdf.circle((0, 0), 1)), ((-3, -3), (3, 3)), 0.2,
    groups={"near": lambda x: np.hypot(*x.T) < 2, "far": lambda x: x[:, 0] < 9},
)

def twice(u, x, i):  # the derivative along i, divided by s, two times
    deep = jnp.maximum(x[i] - 2, 0) + jnp.minimum(x[i] + 2, 0)
    s, bend = 1 + 25j * deep**4 / k, 100j * deep**3 / k
    return js.hessian(u)(x)[i, i] / s**2 - bend / s**3 * js.grad(u)(x)[i]


leaving = lambda u, x: twice(u, x, 0) + twice(u, x, 1) + k**2 * u(x)
wave = lambda x: jnp.exp(1j * k * x[0])
bcs = {"near": js.dirichlet(lambda x: -wave(x)), "far": js.dirichlet(0.0)}
sol = js.solve(js.Problem(leaving, bcs, dtype=complex), cloud, order=6)

n = np.arange(-25, 26)
series = -(1j**n) * jv(n, k) / hankel1(n, k) * hankel1(n, 1.5 * k)
side = (series * np.exp(1j * n * np.pi / 2)).sum()  # at (0, 1.5)
assert abs(sol([[0.0, 1.5]])[0] - side) < 1e-3

total = np.real(sol.u + jax.vmap(wave)(cloud.points))
js.plot.values(cloud, total, label="pressure")
plt.show()
