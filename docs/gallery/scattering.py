"""Waves around a cylinder

A plane wave meets a soft cylinder. Unknown is the complex scattered wave. It
leaves through a perfectly matched layer, a region of its own in which the
radius grows into the complex plane. Beside it stands the series of Bessel
functions that solves the whole plane.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js
from scipy.special import hankel1, jv

k, s = 3.0, 1 + 5j / 3  # waves fade by exp(-5) in the layer, and again back
circle = lambda r: js.sdf.circle((0, 0), r)
ring = lambda a, b: js.sdf.difference(circle(b), circle(a))
cloud = js.regions(
    {"air": ring(1, 2), "layer": ring(2, 3)}, ((-3, -3), (3, 3)), 0.2,
    groups={"near": lambda x: np.hypot(*x.T) < 2, "far": lambda x: x[:, 0] < 9},
)
wave = lambda x: jnp.exp(1j * k * x[0])
slope = lambda u, x, n: n @ js.grad(u)(x)


def fading(u, x):  # Helmholtz's equation with 2 + s (r - 2) for the radius
    r = jnp.sqrt(x @ x)
    deep, e = 2 + s * (r - 2), x / r
    out, bend = slope(u, x, e), e @ js.hessian(u)(x) @ e
    turn = (js.laplacian(u)(x) - bend - out / r) * (r / deep) ** 2
    return bend / s**2 + out / (s * deep) + turn + k**2 * u(x)


flux = {"air": slope, "layer": lambda u, x, n: slope(u, x, n) / s}
bcs = {"far": js.dirichlet(0.0), "air|layer": js.interface(flux=flux)}
bcs["near"] = js.dirichlet(lambda x: -wave(x))
pde = {"air": lambda u, x: js.laplacian(u)(x) + k**2 * u(x), "layer": fading}
sol = js.solve(js.Problem(pde, bcs, dtype=complex), cloud, order=6)
n = np.arange(-25, 26)
series = -(1j**n) * jv(n, k) / hankel1(n, k) * hankel1(n, 1.5 * k)
side = (series * np.exp(1j * n * np.pi / 2)).sum()
assert abs(sol([[0.0, 1.5]])[0] - side) < 3e-3
js.plot.values(cloud, np.real(sol.u + jax.vmap(wave)(cloud.points)))
plt.show()
