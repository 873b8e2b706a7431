"""Waves around a cylinder

A plane wave meets a soft cylinder. Unknown is the complex scattered wave; it
leaves through a circle by a condition of first order. Beside it stands the
series of Bessel functions that solves the whole plane.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

from scipy.special import hankel1, jv

k, far = 3.0, 3.0
ring = js.sdf.difference(js.sdf.circle((0, 0), far), js.sdf.circle((0, 0), 1))
cloud = js.from_sdf(
    ring, ((-far, -far), (far, far)), 0.25,
    groups={"near": lambda x: np.hypot(*x.T) < 2, "far": lambda x: x[:, 0] < 9},
)
wave = lambda x: jnp.exp(1j * k * x[0])
problem = js.Problem(
    lambda u, x: js.laplacian(u)(x) + k**2 * u(x),
    {
        "near": js.dirichlet(lambda x: -wave(x)),
        "far": js.robin(1 / (2 * far) - 1j * k, 1.0, 0.0),
    },
    dtype=complex,
)
sol = js.solve(problem, cloud, order=6)

n = np.arange(-25, 26)
series = -(1j**n) * jv(n, k) / hankel1(n, k) * hankel1(n, 1.5 * k)
side = (series * np.exp(1j * n * np.pi / 2)).sum()  # at (0, 1.5)
# the circle sends back about 1 / (8 k far)
assert abs(sol([[0.0, 1.5]])[0] - side) < 0.03

total = np.real(sol.u + jax.vmap(wave)(cloud.points))
js.plot.values(cloud, total, label="pressure")
plt.show()
