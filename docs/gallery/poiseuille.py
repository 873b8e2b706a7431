"""Flow through a triangular duct

Poiseuille's flow in an equilateral triangle is a polynomial of the third
degree; sqrt(3) / 320 flows through a side of length 1 (Boussinesq, 1868).
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

triangle = [(0.0, 0.0), (1.0, 0.0), (0.5, np.sqrt(3) / 2)]
duct = js.from_polygon(triangle, 0.07)
problem = js.Problem(
    lambda u, x: js.laplacian(u)(x) + 1.0, {"boundary": js.dirichlet(0.0)}
)
sol = js.solve(problem, duct, order=4)

assert abs(sol.integral() / (np.sqrt(3) / 320) - 1) < 1e-8  # rounding

js.plot.solution(sol)
plt.show()
