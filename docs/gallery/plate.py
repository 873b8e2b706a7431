"""A clamped plate

An elliptic plate, clamped all round under an even load: the fourth order, with
two conditions. Its deflection is a polynomial of the fourth degree.
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

a, b = 1.5, 1.0
disk = js.from_sdf(js.sdf.circle((0, 0), 1.0), ((-1, -1), (1, 1)), 0.17)
# An ellipse: normals of the stretched circle point along (x / a^2, y / b^2).
normals = disk.normals / [a, b]
normals /= np.linalg.norm(normals, axis=1, keepdims=True)
plate = disk.replace(disk.points * [a, b], normals)
clamped = [js.dirichlet(0.0), js.neumann(0.0)]
problem = js.Problem(
    lambda u, x: js.laplacian(js.laplacian(u))(x) - 1.0, {"boundary": clamped}
)
sol = js.solve(problem, plate, order=4)

middle = 1 / (8 * (3 / a**4 + 2 / (a * b) ** 2 + 3 / b**4))
assert abs(sol([[0.0, 0.0]])[0] / middle - 1) < 1e-8  # rounding

ax = plt.figure(figsize=(6, 3.6)).add_subplot(projection="3d")
ax.plot_trisurf(*plate.points.T, -sol.u, cmap="viridis")
ax.set(xlabel="x", ylabel="y", zticks=[], box_aspect=(3, 2, 0.8))
plt.show()
