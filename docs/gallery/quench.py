"""A hot disk in cold water

Time: the middle of a disk that is cooled at its rim, against Fourier's series
of Bessel functions. The start contradicts the rim, and may.
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

from scipy.special import j1, jn_zeros

disk = js.from_sdf(js.sdf.circle((0, 0), 1.0), ((-1, -1), (1, 1)), 0.15)
heat = js.Problem(
    lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x),
    {"boundary": js.dirichlet(0.0)},
)
run = js.evolve(
    heat, disk, lambda x: 1.0, t=(0.0, 0.4), steps=40, save=8, progress=False
)
zeros = jn_zeros(0, 30)
series = lambda t: (2 * np.exp(-(zeros**2) * t) / zeros / j1(zeros)).sum()
middle = run.at(0.2)([[0.0, 0.0]])[0]
assert abs(middle - series(0.2)) < 1e-3  # order 4 in space and in time

_, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
js.plot.solution(run.at(0.1), ax=left)
right.plot(run.t, [run.at(t)([[0.0, 0.0]])[0] for t in run.t], "o")
times = np.linspace(0.01, 0.4, 50)
right.plot(times, [series(t) for t in times], color="k", linewidth=1)
right.set(xlabel="t", ylabel="in the middle")
plt.show()
