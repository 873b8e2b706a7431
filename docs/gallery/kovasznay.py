"""Flow behind a grid

Kovasznay's flow (1948) solves the equations of Navier and Stokes exactly. The
velocity is given at the boundary, the pressure nowhere: its mean is zero.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

reynolds = 40.0
rate = reynolds / 2 - (reynolds**2 / 4 + 4 * np.pi**2) ** 0.5


def exact(x, _):
    wave, decay = 2 * jnp.pi * x[1], jnp.exp(rate * x[0])
    along = 1 - decay * jnp.cos(wave)
    return jnp.stack([along, rate / 2 / jnp.pi * decay * jnp.sin(wave)])


def flow(u, x, reynolds):  # u[:2] is the velocity, u[2] the pressure
    inertia = reynolds * js.grad(u[:2])(x) @ u(x)[:2]
    force = inertia - js.laplacian(u[:2])(x) + js.grad(u[2])(x)
    return jnp.append(force, js.divergence(u[:2])(x))


cloud = js.rectangle((-0.5, -0.5), (1.0, 0.5), (13, 9))
along = js.dirichlet(lambda x, re: exact(x, re)[0], field=0)
across = js.dirichlet(lambda x, re: exact(x, re)[1], field=1)
bcs = dict.fromkeys(("left", "right", "bottom", "top"), [along, across])
problem = js.Problem(flow, bcs, fields=3, params=reynolds)
sol = js.solve(problem, cloud, order=3, depth=0)

error = abs(sol.u[:, :2] - jax.vmap(exact, (0, None))(cloud.points, 0)).max()
assert error < 2e-2  # order 3 with eight particles a wave

ax = js.plot.solution(sol, field=2)
js.plot.streamlines(sol, ax=ax)
plt.show()
