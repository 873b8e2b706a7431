"""Charged cylinders in salt water

The equation of Poisson and Boltzmann between two charged cylinders. What
leaves their surfaces is the charge in the water (Gauss).
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

left, right = (js.sdf.circle((side, 0), 0.6) for side in (-1.1, 1.1))
water = js.sdf.difference(js.sdf.circle((0, 0), 3.5), js.sdf.union(left, right))
away = lambda x: np.hypot(abs(x[:, 0]) - 1, x[:, 1])
cloud = js.from_sdf(
    water, ((-3.5, -3.5), (3.5, 3.5)),
    lambda x: 0.14 + 0.16 * np.maximum(0, away(x) - 1),
    groups={"far": lambda x: np.hypot(*x.T) > 3, "ions": lambda x: x[:, 0] < 9},
)
problem = js.Problem(
    lambda u, x: js.laplacian(u)(x) - jnp.sinh(u(x)),
    {"ions": js.dirichlet(2.0), "far": js.neumann(0.0)},
)
sol = js.solve(problem, cloud, depth=0)

water = js.quadrature(cloud)
charge = water.weights @ np.sinh(sol(water.points, outside="extrapolate"))
# order 4, eight particles across a layer
assert abs(sol.flux("ions") / charge - 1) < 2e-2

js.plot.solution(sol)
plt.show()
