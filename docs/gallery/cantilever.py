"""A cantilever

Timoshenko's beam as a plane body: an exact solution of the third degree, so
that order 3 has it to rounding. The wall moves as that solution does.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import jsmitsm as js

length, height, young, poisson, load = 4.0, 1.0, 1000.0, 0.3, 1.0
mu, lam = young / 2 / (1 + poisson), young * poisson / (1 - poisson**2)
stiff = young * height**3 / 12


def exact(x):
    a, b = x
    along = (6 * length - 3 * a) * a + (2 + poisson) * (b**2 - height**2 / 4)
    down = 3 * poisson * b**2 * (length - a) + (3 * length - a) * a**2
    down += (4 + 5 * poisson) * height**2 * a / 4
    return load / 6 / stiff * jnp.stack([b * along, -down])


stress = lambda g: lam * jnp.trace(g) * jnp.eye(2) + mu * (g + g.T)
shear = lambda x: -load * 6 / height**3 * (height**2 / 4 - x[1] ** 2)
free = js.condition(lambda u, x, n: stress(js.grad(u)(x)) @ n)
end = js.condition(
    lambda u, x, n: stress(js.grad(u)(x)) @ n - jnp.stack([0.0, shear(x)])
)
beam = js.rectangle((0, -height / 2), (length, height / 2), (25, 7))
balance = lambda u, x: (
    mu * js.laplacian(u)(x) + (lam + mu) * js.grad(js.divergence(u))(x)
)
bcs = {"left": js.dirichlet(exact), "right": end, "top": free, "bottom": free}
problem = js.Problem(balance, bcs, fields=2)
sol = js.solve(problem, beam, order=3, depth=0)

tip = exact(jnp.array([length, 0.0]))[1]
assert abs(sol([[length, 0.0]])[0, 1] / tip - 1) < 1e-8  # rounding

js.plot.deformed(sol)
plt.show()
