"""Stresses in a heated pipe

Three fields, two displacements and a temperature: a quarter of a pipe that is
hot inside. The stress around the bore is Timoshenko's.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

ring = js.sdf.difference(js.sdf.circle((0, 0), 2.0), js.sdf.circle((0, 0), 1.0))
quarter = js.sdf.intersection(ring, js.sdf.rectangle((0, 0), (3, 3)))
groups = {
    "bottom": lambda x: x[:, 1] < 1e-9,
    "left": lambda x: x[:, 0] < 1e-9,
    "bore": lambda x: np.hypot(*x.T) < 1.5,
    "skin": lambda x: x[:, 0] > -1,
}
pipe = js.from_sdf(quarter, ((0, 0), (2, 2)), 0.12, groups=groups)
# both Lame constants and the expansion are 1
law = lambda g, heat: (jnp.trace(g) - 5 * heat) * jnp.eye(2) + g + g.T
stress = lambda u, x: law(js.grad(u[:2])(x), u(x)[2])
free = js.condition(lambda u, x, n: stress(u, x) @ n)
smooth = js.condition(lambda u, x, n: js.grad(u[0])(x)[1] + js.grad(u[1])(x)[0])
mirror = [smooth, js.neumann(0.0, field=2)]
swelling = lambda u: lambda x: 2 * js.divergence(u[:2])(x) - 5 * u(x)[2]
squeeze = lambda u, x: js.grad(swelling(u))(x)
balance = lambda u, x: js.laplacian(u)(x) + jnp.append(squeeze(u, x), 0.0)
bcs = {
    "bottom": [js.dirichlet(0.0, field=1), *mirror],
    "left": [js.dirichlet(0.0, field=0), *mirror],
    "bore": [free, js.dirichlet(1.0, field=2)],
    "skin": [free, js.dirichlet(0.0, field=2)],
}
sol = js.solve(js.Problem(balance, bcs, fields=3), pipe, depth=0)

around = law(sol.grad([[1.0, 0.0]])[0, :2], 1.0)[1, 1]
known = 5 / 3 * (1 / np.log(2) - 8 / 3)  # young 2.5, poisson 1/4
assert abs(around / known - 1) < 1e-2  # order 4, eight particles across
js.plot.deformed(sol)
plt.show()
