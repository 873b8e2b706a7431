"""An island

Iceland, drawn by hand from 35 places on its coast (degrees to kilometres).
Water rains evenly and seeps to the coast: what arrives there is the island's
area.
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

east = """-22.7 -22 -22.1 -21.9 -23 -24 -22.8 -21.9 -22.5 -24.4 -23.8 -22.5
-21.6 -21.4 -21.1 -20.6 -20.2 -19.6 -19 -18.2 -17.6 -16.9 -16.2 -14.6 -14.8
-13.6 -14 -14.6 -15.2 -16.6 -17.8 -18.9 -20.2 -20.9 -21.8"""
north = """63.85 64.15 64.35 64.5 64.75 64.87 65.05 65.1 65.45 65.5 65.9 66.45
66 65.5 65.3 65.7 66.1 65.75 66.1 65.9 66.15 66.2 66.5 66.35 65.8 65.3
64.9 64.4 64.25 63.85 63.6 63.4 63.55 63.85 63.85"""
coast = np.stack([np.array(s.split(), float) for s in (east, north)], axis=1)
coast = (coast - [-19, 65]) * 111.2 * [np.cos(np.radians(65)), 1]
ahead = np.roll(coast, -1, axis=0)
area = abs(coast[:, 0] @ ahead[:, 1] - coast[:, 1] @ ahead[:, 0]) / 2

island = js.from_polygon(coast, 16.0)
rain = js.Problem(
    lambda u, x: js.laplacian(u)(x) + 1.0, {"boundary": js.dirichlet(0.0)}
)
sol = js.solve(rain, island)
# slopes are infinite at inner corners, where an even cloud loses a part of them
assert abs(-sol.flux("boundary") / area - 1) < 0.1
assert abs(js.quadrature(island).weights.sum() / area - 1) < 1e-9  # rounding

js.plot.solution(sol)
plt.show()
