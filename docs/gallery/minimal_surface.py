"""A minimal surface

A film of soap over a bent frame: Scherk's surface (1835), the logarithm of a
ratio of cosines. The equation is nonlinear, and written as it stands.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import jsmitsm as js

exact = lambda x: jnp.log(jnp.cos(x[0]) / jnp.cos(x[1]))


def film(u, x):
    p, (a, b) = js.grad(u)(x), js.hessian(u)(x)
    bent = (1 + p[1] ** 2) * a[0] + (1 + p[0] ** 2) * b[1]
    return bent - 2 * p[0] * p[1] * a[1]


frame = js.rectangle((-1.2, -1.2), (1.2, 1.2), (15, 15))
held = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(exact))
sol = js.solve(js.Problem(film, held), frame, order=4)

place = jnp.array([0.5, 0.8])
assert abs(sol(place[None])[0] - exact(place)) < 1e-3  # order 4

ax = plt.figure(figsize=(5, 4.4)).add_subplot(projection="3d")
ax.plot_trisurf(*frame.points.T, sol.u, cmap="viridis")
ax.set(xlabel="x", ylabel="y", zlabel="u")
plt.show()
