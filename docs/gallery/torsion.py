"""Torsion of a square bar

Prandtl's stress function: a membrane over the section. The stiffness of a
square of side 1 is 0.140577 G (Saint-Venant), the lines are those of shear.
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

square = js.rectangle((0, 0), (1, 1), (15, 15))
held = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
bar = js.Problem(lambda u, x: js.laplacian(u)(x) + 2.0, held)
sol = js.solve(bar, square, order=6)

# the corners, where the solution is not smooth, leave 1e-5
assert abs(2 * sol.integral() / 0.1405770 - 1) < 1e-4

ax = js.plot.solution(sol)
shear = lambda x: sol.grad(x)[:, ::-1] * np.array([1, -1])
js.plot.streamlines(sol, of=shear, ax=ax)
plt.show()
