"""A catalyst pellet

A gas diffuses into a porous ball and reacts. On the axis r = 0 the equation
says by itself what holds; how much of the ball is used is 3 (m coth m - 1) /
m^2 for Thiele's modulus m.
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

radius = js.interval(0.0, 1.0, 25)
ball = js.Problem(
    lambda u, r, m: (
        r[0] * js.laplacian(u)(r) + 2 * js.grad(u)(r)[0] - m**2 * r[0] * u(r)
    ),
    {"left": js.neumann(0.0), "right": js.dirichlet(1.0)},
    params=1.0,
)
for modulus in (1.0, 2.0, 4.0, 8.0):
    sol = js.solve(ball.replace(params=modulus), radius, order=6)
    used = 3 * sol.flux("right") / modulus**2
    known = 3 * (modulus / np.tanh(modulus) - 1) / modulus**2
    assert abs(used / known - 1) < 1e-5  # order 6
    plt.plot(radius.points[:, 0], sol.u, label=f"{modulus:g}: {used:.0%} used")
plt.xlabel("r")
plt.ylabel("concentration")
plt.legend(title="modulus")
plt.show()
