"""Flow in a cavity, without and with inertia

The lid moves. Stokes' flow is symmetric; at a Reynolds number of 100 the
vortex moves with the lid. On the middle line u is -0.2058 at half height
(Ghia, 1982).
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import jsmitsm as js

def flow(u, x, reynolds):  # u[:2] is the velocity, u[2] the pressure
    inertia = reynolds * js.grad(u[:2])(x) @ u(x)[:2]
    force = inertia - js.laplacian(u[:2])(x) + js.grad(u[2])(x)
    return jnp.append(force, js.divergence(u[:2])(x))


square = js.rectangle((0, 0), (1, 1), (17, 17))
still = [js.dirichlet(0.0, field=k) for k in (0, 1)]
bcs = dict.fromkeys(("left", "right", "bottom"), still)
bcs["top"] = [
    js.dirichlet(lambda x, re: 1.0, field=0),
    js.dirichlet(0.0, field=1),
]
problem = js.Problem(flow, bcs, fields=3, params=0.0)
stokes = js.solve(problem, square, depth=0)
faster = problem.replace(params=100.0)
navier = js.solve(faster, square, depth=0, u0=stokes.u)

# the pressure is infinite in the upper corners: 3 % of the lid's speed
assert abs(navier([[0.5, 0.5]])[0, 0] + 0.2058) < 0.03

_, axes = plt.subplots(1, 2, figsize=(8, 4), layout="constrained")
for ax, sol, name in zip(axes, (stokes, navier), ("Re = 0", "Re = 100")):
    js.plot.streamlines(sol, ax=ax)
    ax.set_title(name)
plt.show()
