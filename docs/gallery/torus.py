"""A heated torus

A solid, given by its signed distance. All the heat made in it leaves through
its surface: 2 pi^2 R r^2, the volume (Pappus).
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

big, small = 1.0, 0.45
torus = js.sdf.torus((0, 0, 0), big, small)
cloud = js.from_sdf(torus, ((-1.5, -1.5, -0.5), (1.5, 1.5, 0.5)), 0.2)
problem = js.Problem(
    lambda u, x: js.laplacian(u)(x) + 1.0, {"boundary": js.dirichlet(0.0)}
)
sol = js.solve(problem, cloud)

volume = 2 * np.pi**2 * big * small**2
assert abs(-sol.flux("boundary") / volume - 1) < 1e-2  # 4 particles a radius

js.plot.solid(sol, cut={"y": 0.0}, engine="matplotlib")
plt.show()
