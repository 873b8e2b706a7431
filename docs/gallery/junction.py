"""A p-n junction

Potential across a semiconductor in balance, in units of the thermal voltage
and the Debye length: free charges follow Boltzmann, the doping jumps. The
field at the junction is known in closed form.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

doping = 50.0
side = {"p": -doping, "n": doping}
cloud = js.regions({"p": (-2.0, 0.0), "n": (0.0, 2.0)}, spacing=0.025)
charge = lambda given: lambda u, x: js.laplacian(u)(x) - jnp.sinh(u(x)) + given
ends = js.dirichlet(lambda x: jnp.sign(x[0]) * jnp.arcsinh(doping))
slope = lambda u, x, n: n @ js.grad(u)(x)
problem = js.Problem(
    {name: charge(given) for name, given in side.items()},
    {"boundary": ends, "p|n": js.interface(flux={"p": slope, "n": slope})},
)
start = np.arcsinh(doping) * np.tanh(np.asarray(cloud.points[:, 0]) / 0.5)
sol = js.solve(problem, cloud, order=6, u0=start)

top = np.arcsinh(doping)
field = np.sqrt(2 * (1 - np.cosh(top) + doping * top))
found = sol.grad(np.array([[0.0]]), region="n")[0, 0]
assert abs(found / field - 1) < 1e-6  # order 6

js.plot.solution(sol)
plt.show()
