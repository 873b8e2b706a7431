"""Stokes' flow in a cavity

The lid moves, and the fluid turns round. 0.1001 of it flows between the middle
of the vortex and the wall, in units of the lid's speed and length; the pressure
is infinite in the upper corners.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js


def flow(u, x):  # u[:2] is the velocity, u[2] the pressure
    force = js.grad(u[2])(x) - js.laplacian(u[:2])(x)
    return jnp.append(force, js.divergence(u[:2])(x))


square = js.rectangle((0, 0), (1, 1), (21, 21))
still = [js.dirichlet(0.0, field=k) for k in (0, 1)]
bcs = dict.fromkeys(("left", "right", "bottom"), still)
bcs["top"] = [js.dirichlet(1.0, field=0), js.dirichlet(0.0, field=1)]
sol = js.solve(js.Problem(flow, bcs, fields=3), square)

height = np.linspace(0, 1, 101)
along = sol(np.stack([0.5 + 0 * height, height], axis=1))[:, 0]
turning = -np.cumsum(along).min() / 100
assert abs(turning / 0.1001 - 1) < 0.03, turning  # the corners spread that far

ax = js.plot.solution(sol, field=0)
js.plot.streamlines(sol, ax=ax)
plt.show()
