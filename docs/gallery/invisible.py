"""An invisible fibre

A fibre conducts ten times better than the plate around it, and touches it
badly. For one resistance of the contact both cancel: nothing of it is seen
outside, where the temperature is that of the plate alone.
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

radius, better = 0.5, 10.0
fibre = js.sdf.circle((0.0, 0.0), radius)
sheet = js.sdf.rectangle((-1, -1), (1, 1))
shapes = {"fibre": fibre, "plate": js.sdf.difference(sheet, fibre)}
groups = {
    "hot": lambda x: x[:, 0] > 1 - 1e-9,
    "cold": lambda x: x[:, 0] < -1 + 1e-9,
    "insulated": lambda x: x[:, 0] > -2,
}
cloud = js.regions(shapes, ((-1, -1), (1, 1)), 0.1, groups=groups)
through = lambda k: lambda u, x, n: k * n @ js.grad(u)(x)
contact = js.interface(
    flux={"fibre": through(better), "plate": through(1.0)},
    resistance=radius * (1 - 1 / better),
)
bcs = {"hot": js.dirichlet(1.0), "cold": js.dirichlet(-1.0)}
bcs |= {"insulated": js.neumann(0.0), "fibre|plate": contact}
equations = {name: lambda u, x: js.laplacian(u)(x) for name in shapes}
sol = js.solve(js.Problem(equations, bcs), cloud)

outside = sol.region("plate")
assert abs(outside.u - outside.cloud.points[:, 0]).max() < 1e-9
inside = sol.region("fibre").grad(np.zeros((1, 2)))[0, 0]
assert abs(better * inside - 1) < 1e-9  # linear, so exact
js.plot.solution(sol)
plt.show()
