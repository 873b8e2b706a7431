"""A plate with a hole

A round hole in a plate under tension triples the stress beside it (Kirsch,
1898). Far away the plate is held as the infinite one moves.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

def kirsch(x):  # displacements; both Lame constants are 1
    r, t = jnp.hypot(*x), jnp.arctan2(x[1], x[0])
    c, s = jnp.array([3.0, -1.0]), jnp.stack([jnp.cos(t), jnp.sin(t)])
    s3 = jnp.stack([jnp.cos(3 * t), jnp.sin(3 * t)])
    near = jnp.array([3.0, -1.0]) * s + s3
    return (r * c * s + 2 / r * near - 2 / r**3 * s3) / 8


def stress(g):
    return jnp.trace(g) * jnp.eye(2) + g + g.T


hole = js.sdf.difference(js.sdf.circle((0, 0), 3.0), js.sdf.circle((0, 0), 1.0))
plate = js.from_sdf(
    hole, ((-3, -3), (3, 3)), lambda x: 0.12 * np.hypot(*x.T),
    groups={"hole": lambda x: np.hypot(*x.T) < 2, "far": lambda x: x[:, 0] < 4},
)
force = lambda u, x, n: stress(js.grad(u)(x)) @ n
balance = lambda u, x: js.laplacian(u)(x) + 2 * js.grad(js.divergence(u))(x)
bcs = {"hole": js.condition(force), "far": js.dirichlet(kirsch)}
sol = js.solve(js.Problem(balance, bcs, fields=2), plate)

beside = stress(sol.grad([[0.0, 1.0]])[0])[0, 0]
assert abs(beside / 3 - 1) < 1e-2  # spacing an eighth of the radius

js.plot.principal(sol, stress)
plt.show()
