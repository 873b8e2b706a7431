"""Two drums that sound alike

One cannot hear the shape of a drum: Gordon, Webb and Wolpert (1992) found two
with all tones in common. The lowest values here are 10.1518 and 14.6231.
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

drums = [
    [(0, 0), (0, 1), (2, 3), (2, 2), (3, 2), (2, 1), (1, 1), (1, 0)],
    [(1, 0), (0, 1), (0, 2), (2, 2), (2, 3), (3, 2), (2, 1), (1, 1)],
]
membrane = js.Problem(
    lambda u, x: -js.laplacian(u)(x), {"boundary": js.dirichlet(0.0)}
)
_, axes = plt.subplots(2, 2, figsize=(8, 6.4), layout="constrained")
for row, drum in zip(axes, drums):
    cloud = js.from_polygon(drum, 0.15)
    modes = js.eigen(membrane, cloud, 2, order=4)
    for k, ax in enumerate(row):
        js.plot.values(cloud, modes.u[:, k], ax=ax, colorbar=False)
        ax.set_title(f"{modes.values[k]:.2f}")

    # modes have infinite slopes at inner corners, which an even cloud of this
    # spacing sees to one percent
    assert np.allclose(modes.values, [10.1518, 14.6231], rtol=2e-2)
plt.show()
