"""Patterns that grow by themselves

Schnakenberg's reaction (1979) with an inhibitor that diffuses ten times
faster. An even state is unstable against waves; this one first grows at the
rate that the linearised equations tell, then becomes spots.
"""

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

spread = jnp.array([1.0, 10.0])


def reaction(u, x, t):
    both = u(x)[0] ** 2 * u(x)[1]
    made = jnp.stack([0.1 - u(x)[0] + both, 0.9 - both])
    return js.dt(u)(x) - spread * js.laplacian(u)(x) - made


wave = np.pi / 24 * np.array([3.0, 3.0])  # along x and y
linear = np.array([[0.8, 1.0], [-1.8, -1.0]]) - np.diag(spread) * (wave @ wave)
rates, modes = np.linalg.eig(linear)
rate, mode = rates.real.max(), modes[:, rates.real.argmax()].real
ripple = lambda x: 1e-3 * mode * jnp.prod(jnp.cos(wave * x))
start = lambda x: jnp.array([1.0, 0.9]) + ripple(x)

dish = js.rectangle((0, 0), (24, 24), (19, 19))
closed = dict.fromkeys(("left", "right", "bottom", "top"), js.neumann(0.0))
run = js.evolve(
    js.Problem(reaction, closed, fields=2), dish, start, t=(0, 160), steps=160,
    save=[20, 40], progress=False,
)
growth = np.log(np.ptp(run.u[2][:, 0]) / np.ptp(run.u[1][:, 0])) / 20
assert abs(growth / rate - 1) < 2e-2  # of a wave of twelve particles

js.plot.solution(run.at(160.0))
plt.show()
