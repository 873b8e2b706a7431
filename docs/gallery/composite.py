"""Fibres in a matrix

How well does a material conduct that holds round fibres, ten times better, in
a square pattern? A quarter of a cell, two regions, against Rayleigh's formula
(1892).
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

fibre = js.sdf.circle((0.0, 0.0), 0.3)
cell = js.sdf.rectangle((0, 0), (0.5, 0.5))
shapes = {
    "fibre": js.sdf.intersection(cell, fibre),
    "matrix": js.sdf.difference(cell, fibre),
}
groups = {
    "cold": lambda x: x[:, 0] < 1e-9,
    "hot": lambda x: x[:, 0] > 0.5 - 1e-9,
    "mirror": lambda x: x[:, 0] > -1,
}
cloud = js.regions(shapes, ((0, 0), (0.5, 0.5)), 0.05, groups=groups)
carried = {"fibre": 10.0, "matrix": 1.0}
through = lambda k: lambda u, x, n: k * n @ js.grad(u)(x)
bcs = {"cold": js.dirichlet(0.0), "hot": js.dirichlet(1.0)}
bcs |= {"mirror": js.neumann(0.0)}
flux = {name: through(k) for name, k in carried.items()}
bcs["fibre|matrix"] = js.interface(flux=flux)
equations = {name: lambda u, x: js.laplacian(u)(x) for name in shapes}
sol = js.solve(js.Problem(equations, bcs), cloud)

f, t = np.pi * 0.3**2, (1 + 10) / (1 - 10)
known = 1 - 2 * f / (t + f - 0.305827 * f**4 * t / (t**2 - 1.402958 * f**8))
parts = [sol.region(name).flux("cold", k) for name, k in carried.items()]
assert abs(-sum(parts) / known - 1) < 1e-3  # order 4, 11 particles a side

js.plot.solution(sol)
plt.show()
