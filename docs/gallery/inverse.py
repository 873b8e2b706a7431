"""Finding a hidden inclusion

Where is a spot of other conductivity, and how strong? Gauss and Newton with
derivatives of the whole solve, from temperatures read at twelve places.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

square = js.rectangle((0, 0), (1, 1), (11, 11))
near = js.stencils(square, size=13)
k = lambda y, p: 1 + p[0] * jnp.exp(-20 * jnp.sum((y - p[1:]) ** 2))
problem = js.Problem(
    lambda u, x, p: js.divergence(lambda y: k(y, p) * js.grad(u)(y))(x) + 1.0,
    {"left": js.dirichlet(0.0), "right": js.neumann(0.0)}
    | dict.fromkeys(("bottom", "top"), js.dirichlet(0.0)),
    params=jnp.zeros(3),
)
inside = np.asarray(square.groups["interior"])[::7]


def readings(p):
    made = problem.replace(params=p)
    u = js.solve(made, square, order=2, stencils=near, depth=0).u
    return u[inside]


truth, guess = jnp.array([1.5, 0.6, 0.3]), jnp.array([1.0, 0.5, 0.5])
measured, slopes = readings(truth), jax.jacfwd(readings)
for _ in range(6):
    step = jnp.linalg.lstsq(slopes(guess), readings(guess) - measured)[0]
    guess = guess - step

assert abs(guess - truth).max() < 1e-6  # Newton's method has converged

found = jax.vmap(lambda y: k(y, guess))(square.points)
js.plot.values(square, found, label="k")
plt.plot(*square.points[inside].T, "wo", markersize=4)
plt.show()
