"""A domain from a mesh

Nodes of a mesh become particles, its physical names become groups. This one is
written here; `js.files.from_mesh("ring.msh")` reads a file.
"""

import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import jsmitsm as js

import meshio

r, turn = np.linspace(1, 2, 7), np.linspace(0, np.pi / 2, 11)
nodes = np.stack(
    [np.outer(r, np.cos(turn)), np.outer(r, np.sin(turn))], axis=-1
).reshape(-1, 2)
number = np.arange(77).reshape(7, 11)
a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
quads = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
side = lambda ids: np.stack([ids[:-1], ids[1:]], axis=1)
lines = [side(x) for x in (number[0], number[-1], number[:, 0], number[:, -1])]
tags = np.repeat([1, 2, 3, 3], [10, 10, 6, 6])
mesh = meshio.Mesh(
    nodes,
    [("quad", quads), ("line", np.concatenate(lines))],
    cell_data={"gmsh:physical": [np.full(60, 9), tags]},
    field_data={"hot": [1, 1], "cold": [2, 1], "insulated": [3, 1]},
)
bcs = {"hot": js.dirichlet(1.0), "cold": js.dirichlet(0.0)}
bcs["insulated"] = js.neumann(0.0)
problem = js.Problem(lambda u, x: js.laplacian(u)(x), bcs)
sol = js.solve(problem, js.files.from_mesh(mesh), order=4)

# 1 - log2 r; normals of a mesh are those of its straight facets
assert abs(sol([[1.5, 0.0]])[0] - (1 - np.log2(1.5))) < 1e-2
js.plot.solution(sol)
plt.show()
