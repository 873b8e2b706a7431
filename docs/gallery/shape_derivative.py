"""How stiffness depends on shape

Which way should the boundary move to make a bar stiffer? The derivative of the
membrane's mean by every coordinate of every particle, in one backward solve.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

disk = js.from_sdf(js.sdf.circle((0, 0), 1.0), ((-1, -1), (1, 1)), 0.2)
near = js.stencils(disk, size=12)
bar = js.Problem(
    lambda u, x: js.laplacian(u)(x) + 2.0, {"boundary": js.dirichlet(0.0)}
)
ellipse = disk.points * np.array([1.5, 1.0])


def mean(points):
    moved = disk.replace(points=points)
    sol = js.solve(bar, moved, order=2, depth=0, stencils=near, solver="dense")
    return sol.u.mean()


value, slope = jax.value_and_grad(mean)(jnp.asarray(ellipse))

# The mean of an ellipse is that of the disk times a^2 b^2 / (a^2 + b^2); by a:
by_a = (slope[:, 0] * disk.points[:, 0]).sum() / value
assert abs(by_a - (2 / 1.5 - 3.0 / (1.5**2 + 1))) < 1e-6  # rounding

rim = disk.groups["boundary"]
plt.figure(figsize=(5.6, 3.8), layout="constrained")
plt.plot(*ellipse[rim].T, "o", color="0.5", markersize=3)
plt.quiver(*ellipse[rim].T, *slope[rim].T, color="C0")
plt.axis("equal")
plt.margins(0.15)
plt.show()
