"""Stresses in a heated pipe

Three fields, two displacements and a temperature: a quarter of a pipe that is hot
inside. The stress around the bore is Timoshenko's.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

quarter = js.sdf.intersection(
    js.sdf.difference(js.sdf.circle((0, 0), 2.0), js.sdf.circle((0, 0), 1.0)),
    js.sdf.rectangle((0, 0), (3, 3)),
)
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


def balance(u, x):
    squeeze = 2 * js.grad(js.divergence(u[:2]))(x) - 5 * js.grad(u[2])(x)
    return jnp.append(js.laplacian(u[:2])(x) + squeeze, js.laplacian(u[2])(x))


bcs = {
    "bottom": [js.dirichlet(0.0, field=1), *mirror],
    "left": [js.dirichlet(0.0, field=0), *mirror],
    "bore": [free, js.dirichlet(1.0, field=2)],
    "skin": [free, js.dirichlet(0.0, field=2)],
}
sol = js.solve(js.Problem(balance, bcs, fields=3), pipe)

around = law(sol.grad([[1.0, 0.0]])[0, :2], 1.0)[1, 1]
known = 2.5 / 1.5 / np.log(2) * (1 - 8 / 3 * np.log(2))  # young 2.5, poisson 1/4
assert abs(around / known - 1) < 1e-2  # order 4, eight particles across

js.plot.deformed(sol, colour=lambda x: sol(x, outside="extrapolate")[:, 2], label="heat")
plt.show()
