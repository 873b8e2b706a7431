"""Flow in a cavity at Re = 100

The lid moves, and the fluid turns round. Without divergence a flow is one
stream function, whose contours are the stream lines: one field, one equation
of fourth order. -0.103423 is the least of it (Ghia, Ghia and Shin, 1982). The
flags name the upper corners, where the lid's speed jumps.
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js


def flow(stream, x, reynolds):
    vorticity = lambda y: -js.laplacian(stream)(y)
    (down, along), slope = js.grad(stream)(x), js.grad(vorticity)(x)
    carried = along * slope[0] - down * slope[1]  # by (along, -down)
    return reynolds * carried - js.laplacian(vorticity)(x)


square = js.rectangle((0, 0), (1, 1), (25, 25))
wall = [js.dirichlet(0.0), js.neumann(0.0)]
bcs = dict.fromkeys(("left", "right", "bottom"), wall)
bcs["top"] = [js.dirichlet(0.0), js.neumann(1.0)]  # the slope is the speed
problem = js.Problem(flow, bcs, params=100.0)
sol = js.solve(problem, square, order=6, depth=0)

assert abs(sol.u.min() / -0.103423 - 1) < 0.005

x = np.linspace(0, 1, 101)
grid = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
stream = sol(grid).reshape(101, 101)
ax = js.plot.solution(sol)
levels = np.linspace(-0.1, -0.005, 15)
ax.contour(x, x, stream, levels, colors="black", linestyles="solid")
plt.show()
