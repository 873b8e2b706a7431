"""A shrink fit

A hub that was put on hot has cooled: the shaft is one part in ten too thick
for the hole, a jump of the displacements. The rim is held. What pressure holds
the shaft follows from Lame's solutions (1852) for a disk and a ring.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

shaft = js.sdf.circle((0, 0), 1.0)
hub = js.sdf.difference(js.sdf.circle((0, 0), 2.0), shaft)
cloud = js.regions({"shaft": shaft, "hub": hub}, ((-2, -2), (2, 2)), 0.2)
lame = {"shaft": 3.0, "hub": 1.0}  # both constants
law = lambda c, g: c * (jnp.trace(g) * jnp.eye(2) + g + g.T)
force = lambda c: lambda u, x, n: law(c, js.grad(u)(x)) @ n
forces = {name: force(c) for name, c in lame.items()}
bcs = {
    "boundary": js.dirichlet(0.0),
    "shaft|hub": js.interface(forces, jump=lambda x: -0.1 * x),
}
balance = lambda u, x: js.laplacian(u)(x) + 2 * js.grad(js.divergence(u))(x)
equations = dict.fromkeys(lame, balance)
sol = js.solve(js.Problem(equations, bcs, fields=2), cloud)

for name, c in lame.items():
    g = sol.grad(np.array([[1.0, 0.0]]), region=name)[0]
    # order 4, five particles across the ring
    assert abs(law(c, g)[0, 0] / -0.3 - 1) < 2e-2
js.plot.solution(sol)
plt.show()
