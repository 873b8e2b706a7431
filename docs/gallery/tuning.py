"""Tuning a kernel

`js.tune` finds the smoothing length and the support radius that suit a
problem, without knowing its solution, here exp(x).
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import jsmitsm as js

rod = js.interval(0.0, 1.0, 21)
problem = js.Problem(
    lambda u, x: js.laplacian(u)(x) - jnp.exp(x[0]),
    {"left": js.dirichlet(1.0), "right": js.dirichlet(jnp.e)},
)
wide = js.SuperGaussian(h=2 * rod.spacing, d=4.0)
options = {"method": "III", "order": 2}
before = js.solve(problem, rod, kernel=wide, **options)
found = js.tune(problem, rod, wide, steps=20, progress=False, **options)

error = lambda sol: abs(sol.u - jnp.exp(rod.points[:, 0])).max()
assert error(found.solution) < 0.3 * error(before)  # the grid's best is 0.2

js.plot.tuning(found)
plt.show()
