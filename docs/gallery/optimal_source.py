"""The best heating

Which source makes a temperature as wanted, if heating costs? The conditions of
an optimum are two equations: one for the temperature, one for its multiplier.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

cost = 1e-3
wanted = lambda x: jnp.sin(jnp.pi * x[0]) * jnp.sin(jnp.pi * x[1])


def optimum(u, x):  # the source is u[1] / cost
    heat = js.laplacian(u[0])(x) + u(x)[1] / cost
    return jnp.stack([heat, js.laplacian(u[1])(x) + wanted(x) - u(x)[0]])


square = js.rectangle((0, 0), (1, 1), (13, 13))
cold = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
sol = js.solve(js.Problem(optimum, cold, fields=2), square, order=6)

# a wave of the Laplacian is scaled by 1 / (1 + cost (2 pi^2)^2)
reached = sol([[0.5, 0.5]])[0, 0]
assert abs(reached * (1 + cost * (2 * np.pi**2) ** 2) - 1) < 1e-4  # order 6

js.plot.fields(sol, names=["temperature", "multiplier"])
plt.show()
