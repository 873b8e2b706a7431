"""Small meshes, one for each thing that can be wrong in a file, and what must come of it: right, or refused."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud.mesh_facets import Block, Mesh
from jsmitsm.show.files import from_mesh

meshio = pytest.importorskip("meshio")

SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
CUBE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)
QUADS = [[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6], [4, 5, 8, 7]]  # of three times three nodes, the middle one 4
NINE = np.array([[x, y] for y in (0, 1, 2) for x in (0, 1, 2)], float)


def write(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


def grown(kind, points, cells, bend=lambda x: x):
    """A mesh of second order: middle nodes on edges, faces, cells as ``kind`` has them, in VTK's order; bent."""
    base, count = kind.rstrip("0123456789"), int(kind.lstrip("abcdefghijklmnopqrstuvwxyz"))
    edges = {"triangle": [(0, 1), (1, 2), (2, 0)], "quad": [(0, 1), (1, 2), (2, 3), (3, 0)],
             "tetra": [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)],
             "hexahedron": [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4),
                            (0, 4), (1, 5), (2, 6), (3, 7)],
             "wedge": [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)],
             "pyramid": [(0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4), (2, 4), (3, 4)]}[base]  # fmt: skip
    faces = {"hexahedron27": [(0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (2, 3, 7, 6), (0, 1, 2, 3), (4, 5, 6, 7),
                              range(8)],
             "wedge18": [(0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)], "pyramid14": [(0, 1, 2, 3)],
             "quad9": [range(4)]}.get(kind, [])  # fmt: skip
    points, known, out = [*map(tuple, points)], {}, []
    for cell in cells:
        row = list(cell)
        for place in [*edges, *faces]:
            corners = tuple(sorted(cell[k] for k in place))
            if corners not in known:
                known[corners] = len(points)
                points.append(tuple(np.mean([points[n] for n in corners], axis=0)))
            row.append(known[corners])
        out.append(row)
    assert len(out[0]) == count
    return Mesh(np.array([bend(np.array(p)) for p in points]), [Block(kind, np.array(out))])


def cubes(kind):
    """The cube [0, 2]^3 in hexahedra, wedges, pyramids or tetrahedra of its eight cubes."""
    points = np.array([[x, y, z] for x in (0, 1, 2) for y in (0, 1, 2) for z in (0, 1, 2)], float)
    number = np.arange(27).reshape(3, 3, 3)
    cells = []
    for i, j, k in np.ndindex(2, 2, 2):
        (a, e), (d, h) = number[i, j : j + 2, k : k + 2]
        (b, f), (c, g) = number[i + 1, j : j + 2, k : k + 2]
        if kind == "pyramid":
            points = np.concatenate([points, [[i + 0.5, j + 0.5, k + 0.5]]])
            faces = [(a, d, c, b), (e, f, g, h), (a, b, f, e), (b, c, g, f), (c, d, h, g), (d, a, e, h)]
            cells += [[*face, len(points) - 1] for face in faces]
        elif kind == "wedge":
            cells += [[a, b, c, e, f, g], [a, c, d, e, g, h]]
        elif kind == "tetra":
            ring = [b, c, d, h, e, f]
            cells += [[a, ring[n], ring[(n + 1) % 6], g] for n in range(6)]
        else:
            cells += [[a, b, c, d, e, f, g, h]]
    return points, cells


# ---- cells of second order


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("kind", ["tetra10", "hexahedron20", "hexahedron27", "wedge15", "wedge18", "pyramid13",
                                  "pyramid14"])  # fmt: skip
def test_all_nodes_of_solids_of_second_order(kind, shuffled):
    """Nodes on the faces of a cube are its boundary, with its normals, in whatever order a format has middle ones."""
    mesh = grown(kind, *cubes(kind.rstrip("0123456789")))
    if shuffled:
        cells = mesh.cells[0].data
        corners = {"t": 4, "h": 8, "w": 6, "p": 5}[kind[0]]
        order = np.random.default_rng(0).permutation(np.arange(corners, cells.shape[1]))
        mesh = Mesh(mesh.points, [Block(kind, cells[:, [*range(corners), *order]])])
    cloud = from_mesh(mesh)
    assert len(cloud) == len(mesh.points)
    on = (cloud.points == 0) | (cloud.points == 2)
    assert (cloud.boundary == np.flatnonzero(on.any(axis=1))).all()
    wanted = np.where(cloud.points == 0, -1.0, np.where(cloud.points == 2, 1.0, 0.0))[cloud.boundary]
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    # Where two triangles of a square meet at a corner, angle weights make the bisector exact; rounding of sums.
    np.testing.assert_allclose(cloud.normals[cloud.boundary], wanted, atol=1e-13)


@pytest.mark.parametrize("kind", ["triangle6", "quad8", "quad9"])
def test_curved_sides_of_second_order_have_their_own_normals(kind):
    """A quarter of a ring bent by x -> polar: sides of second order with uneven corners have the circle's normals to
    third order, chords to first only."""
    t = np.array([0.0, 0.08, 0.2, 0.34, 0.5, 0.62, 0.8, 0.9, 1.0])  # uneven
    flat = np.array([[r, a] for r in (1.0, 1.5, 2.0) for a in t])
    at = np.arange(27).reshape(3, 9)
    quads = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], axis=-1).reshape(-1, 4)
    cells = quads if kind.startswith("quad") else np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])

    def bend(x):
        return x[0] * np.array([np.cos(x[1] * np.pi / 2), np.sin(x[1] * np.pi / 2)])

    cloud = from_mesh(grown(kind, flat, cells.tolist(), bend))
    radius = np.linalg.norm(cloud.points, axis=1)
    inner = cloud.points[:, 0] * cloud.points[:, 1] > 1e-9  # not at the ends, where two sides meet
    rim = np.flatnonzero((abs(radius - 2.0) < 1e-9) & inner)
    assert len(rim) == 15 and np.isin(rim, cloud.boundary).all()
    error = np.linalg.norm(cloud.normals[rim] - cloud.points[rim] / 2.0, axis=1).max()
    # Angle between the parabola through a sixth of the quarter and its circle: (0.28 / 2)^3 / 6 = 5e-4.
    assert error < 1e-3


def test_a_poisson_problem_on_twenty_node_bricks():
    """u = x^2 - 2 y^2 + z^2 + x y z is harmonic, of degree 3: exact at order 3 on any nodes that are read right."""
    points = np.array([[x, y, z] for x in range(3) for y in range(3) for z in range(3)], float)
    cloud = from_mesh(grown("hexahedron20", points, cubes("hexahedron")[1], lambda x: x + 0.05 * np.sin(3 * x[::-1])))

    def exact(x):
        return x[0] ** 2 - 2 * x[1] ** 2 + x[2] ** 2 + x[0] * x[1] * x[2]

    problem = js.Problem(lambda u, x: js.laplacian(u)(x), {"boundary": js.dirichlet(exact)})
    sol = js.solve(problem, cloud, order=3)
    np.testing.assert_allclose(sol.u, jax.vmap(exact)(cloud.points), atol=1e-10)  # round-off of a hundred unknowns


def test_middle_nodes_out_of_place_are_told():
    mesh = grown("triangle6", SQUARE, HALVES.tolist())
    mesh.points[mesh.cells[0].data[0, 3]] = [0.2, 3.0]
    pattern = r"mesh: the middle nodes of 'triangle6' cell 0, nodes \[0, 1, 2.*write the mesh"
    with pytest.raises(ValueError, match=pattern):
        from_mesh(mesh)


# ---- cells that hang, overlap, fold, cross or are flat


def parts(first, second):
    count = len(first)
    return meshio.Mesh(np.concatenate([first, second]), [("triangle", np.concatenate([HALVES, HALVES + count]))])


PYRAMID = np.vstack([CUBE, [0.5, 0.5, 2.0]])
WRONG = {
    "hanging node": (
        meshio.Mesh([*SQUARE, [2, 0], [2, 1], [2, 0.5], [1, 0.5]],
                    [("quad", [[0, 1, 2, 3], [1, 4, 6, 7], [7, 6, 5, 2]])]),
        r"the nodes \[7\] lie on sides.*\[1, 2\].*hanging nodes.*conforming"),
    "hanging middle": (
        meshio.Mesh([*SQUARE, [1, 0.5], [0.5, 0], [0.5, 1], [0, 0.5], [2, 0], [2, 1], [2, 0.5]],
                    [("quad8", [[0, 1, 2, 3, 5, 4, 6, 7]]), ("quad", [[1, 8, 10, 4], [4, 10, 9, 2]])]),
        "a middle one is a corner of another cell: a hanging node"),
    "nodes not merged": (parts(SQUARE, SQUARE + [1, 0]), r"2 of its nodes stand where others do, as \[1, 4\]; merge"),
    "nodes not quite merged": (parts(SQUARE, SQUARE + [1 + 1e-9, 0]), r"\[1, 2, 4, 7\] lie on sides.*merge the nodes"),
    "a side not merged": (parts(SQUARE, SQUARE + [1, 0.5]), r"the nodes \[2, 4\] lie on sides.*merge the nodes"),
    "seam of a wrong diagonal": (
        meshio.Mesh(PYRAMID, [("hexahedron", [range(8)]), ("tetra", [[4, 5, 6, 8], [4, 6, 7, 8]])]),
        "facets lie on sides.*hanging nodes"),
    "parts that overlap": (parts(SQUARE, 0.9 * SQUARE + [0.57, 0.43]), "lie|crosses|lies in"),
    "bars that cross": (parts(SQUARE * [3, 0.2], SQUARE * [0.2, 3] + [0.4, -2.6]), r"crosses the facet.*overlap"),
    "a part in a part": (parts(SQUARE, 0.2 * SQUARE + 0.4), "lies in 'triangle' cell 0 .*cells overlap; take them"),
    "a fold": (
        meshio.Mesh([*SQUARE, [1.5, 0.5]], [("triangle", [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])]),
        "lie on the same side of it.*inverted or overlap; untangle"),
    "both diagonals": (
        meshio.Mesh(SQUARE, [("triangle", [[0, 1, 2], [0, 2, 3], [0, 1, 3], [1, 2, 3]])]),
        "same side|given twice|2 cells"),
    "three cells at a side": (
        meshio.Mesh([*SQUARE, [0.4, 0.9]], [("triangle", [[0, 1, 2], [0, 2, 3], [0, 2, 4]])]), "belongs to 3 cells"),
    "a flat cell": (
        meshio.Mesh([*SQUARE, [0.5, 0.5]], [("triangle", [[0, 1, 2], [0, 2, 4]])]),
        r"without volume.*\[0, 2, 4\].*remove"),
    "a flat cell inside": (
        meshio.Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1], [0.5, 0.5, -1]],
                    [("tetra", [[0, 1, 2, 3], [0, 1, 2, 4], [0, 2, 3, 4], [0, 1, 3, 5], [1, 2, 3, 5]])]),
        r"without volume has the nodes \[0, 1, 2, 3\]"),
    "a bow tie": (meshio.Mesh(SQUARE, [("quad", [[0, 2, 1, 3]])]), r"whose sides cross has the nodes \[0, 2, 1, 3\]"),
    "a twisted brick": (meshio.Mesh(CUBE, [("hexahedron", [[0, 1, 2, 3, 6, 7, 4, 5]])]), "whose sides cross"),
    "a brick by rows": (meshio.Mesh(CUBE, [("hexahedron", [[0, 1, 3, 2, 4, 5, 7, 6]])]), "whose sides cross"),
    "corners that touch": (
        meshio.Mesh([*SQUARE, [2, 1], [2, 2], [1, 2]], [("quad", [[0, 1, 2, 3], [2, 4, 5, 6]])]),
        r"touches itself at the nodes \[2\]"),
    "bricks that touch along an edge": (
        meshio.Mesh([*CUBE, *(CUBE[[1, 2, 3, 5, 6, 7]] + [1, 1, 0])],
                    [("hexahedron", [range(8), [2, 8, 9, 10, 6, 11, 12, 13]])]),
        r"touches itself at the nodes \[2, 6\]"),
    "a tent on the plane": (
        meshio.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0.1]], [("triangle", [[0, 1, 2]])]), "surface in space"),
    "another plane": (
        meshio.Mesh([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [("triangle", [[0, 1, 2]])]),
        r"axes \[0, 2\]: pass points\[:, \[0, 2\]\]"),
    "two dimensions": (
        meshio.Mesh([*SQUARE, [2, 0.5]], [("triangle", HALVES), ("line", [[1, 4]])]),
        r"'line' cells.*\[1, 4\].*two dimensions"),
    "nodes too many": (meshio.Mesh(SQUARE, [("triangle", [[0, 1, 2, 3]])]), r"shape \(1, 4\).*expected.*\(M, 3\)"),
    "lines on lines": (meshio.Mesh([[0.0], [1], [2], [0.5]], [("line", [[0, 1], [3, 2]])]), "lies in 'line' cell 0"),
    "masked points": (meshio.Mesh(SQUARE, [("triangle", HALVES)]), "its points: 1 of its 8 entries are masked"),
}  # fmt: skip
WRONG["masked points"][0].points = np.ma.array(SQUARE, mask=np.arange(8).reshape(4, 2) == 5)


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.filterwarnings("error")
def test_wrong_cells_are_told(name):
    mesh, text = WRONG[name]
    with pytest.raises(ValueError, match=f"(?s)mesh: .*({text})"):
        from_mesh(mesh)


@pytest.mark.filterwarnings("error")
def test_harmless_cells_are_read():
    """Whichever way round nodes run, flat but real cells, darts, voids, parts side by side, thin walls."""
    both = from_mesh(meshio.Mesh(NINE, [("quad", QUADS)]))
    turned = [QUADS[0], QUADS[1][::-1], QUADS[2][2:] + QUADS[2][:2], QUADS[3][::-1]]
    cloud = from_mesh(meshio.Mesh(NINE, [("quad", turned)]))
    assert cloud.groups == both.groups and (cloud.points == both.points).all()
    np.testing.assert_allclose(cloud.normals, both.normals, atol=1e-15)
    upside = from_mesh(meshio.Mesh(CUBE, [("hexahedron", [[4, 5, 6, 7, 0, 1, 2, 3]])]))
    np.testing.assert_allclose(upside.normals, (2 * CUBE - 1) / np.sqrt(3), atol=1e-15)
    dart = from_mesh(meshio.Mesh([[0, 0], [1, 0], [0.05, 0.05], [0, 1]], [("quad", [[0, 1, 2, 3]])]))
    assert dart.normals[2] @ [1, 1] > 1.4 and dart.normals[0] @ [1, 1] < -1.4
    layer = np.array([[x, y] for y in (0, 1e-6, 1) for x in (0, 1, 2)])
    assert from_mesh(meshio.Mesh(layer, [("quad", QUADS)])).groups["interior"].tolist() == [4]
    assert len(from_mesh(parts(SQUARE, SQUARE + [1.01, 0]))) == 8
    rounded = np.pad(SQUARE, ((0, 0), (0, 1))) + 1e-10 * np.arange(12).reshape(4, 3)
    assert len(from_mesh(meshio.Mesh(rounded, [("triangle", HALVES)]))) == 4
    x, y, z = np.meshgrid(*[np.linspace(0, 1, 5)] * 2, [0, 1e-5], indexing="ij")  # its sides are warped by more
    shell = np.stack([x, y, z + 0.2 * np.sin(5 * x) * np.cos(4 * y)], axis=-1).reshape(-1, 3)
    at = np.arange(50).reshape(5, 5, 2)
    ring = [at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]]
    bricks = np.stack([corner[..., k].ravel() for k in (0, 1) for corner in ring], axis=1)
    assert len(from_mesh(meshio.Mesh(shell, [("hexahedron", bricks)])).groups["boundary"]) == 50
    orphan = from_mesh(meshio.Mesh([*SQUARE, [0.5, 0.4]], [("triangle", HALVES), ("vertex", [[4]])]))
    assert len(orphan) == 4


def test_two_parts_apart_are_two_problems():
    """Two squares a gap apart, each with its own plane u = x + y, u = -x: exact at any order on both."""
    part = js.rectangle((0, 0), (1, 1), (7, 7))
    cells = [[k, k + 1, k + 8, k + 7] for k in range(42) if k % 7 < 6]
    points = np.concatenate([part.points, part.points + [9, 0]])
    cloud = from_mesh(meshio.Mesh(points, [("quad", np.concatenate([cells, np.array(cells) + 49]))]))
    exact = jnp.where(points[:, 0] < 5, points.sum(axis=1), -points[:, 0])
    bcs = {"boundary": js.dirichlet(exact[cloud.groups["boundary"]])}
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), bcs), cloud, order=2)
    np.testing.assert_allclose(sol.u, exact, atol=1e-11)  # round-off of a few dozen unknowns


# ---- groups


def tagged(sets, kind="line", **more):
    """The nine nodes in four squares, with sets of sides by name."""
    cells = [("quad", QUADS), *((kind, rows) for rows in sets.values())]
    tags = [np.full(4, 9), *(np.full(len(rows), k + 1) for k, rows in enumerate(sets.values()))]
    field = {name: np.array([k + 1, 1]) for k, name in enumerate(sets)} | {"plate": np.array([9, 2])}
    return meshio.Mesh(NINE, cells, cell_data={"gmsh:physical": tags}, field_data=field, **more)


def names(cloud):
    return {name: index.tolist() for name, index in cloud.groups.items()}


def test_every_side_keeps_a_node():
    """"corner" has the side between 0 and 1 alone, both claimed before; it keeps one. A copy of a side is told."""
    cloud = from_mesh(tagged({"left": [[0, 3], [3, 6]], "bottom": [[0, 1], [1, 2]], "corner": [[0, 1]]}))
    assert names(cloud) == {"interior": [4], "left": [0, 3, 6], "bottom": [2], "corner": [1], "boundary": [5, 7, 8]}
    sides = {"left": [[0, 3], [3, 6]], "bottom": [[0, 1], [1, 2]], "low": [[3, 0]], "right": [[2, 5]]}
    cloud = from_mesh(tagged(sides))
    assert all(len(cloud.groups[name]) for name in ("left", "bottom", "low", "right"))
    with pytest.raises(ValueError, match=r"the group 'all' would have no node: .*belong to 'a', 'b'; .*tags="):
        from_mesh(tagged({"a": [[0, 1], [1, 2], [2, 5], [5, 8]], "b": [[8, 7], [7, 6], [6, 3], [3, 0]],
                          "all": [[0, 1], [1, 2], [2, 5], [5, 8], [8, 7], [7, 6], [6, 3], [3, 0]]}))  # fmt: skip


def test_a_list_of_names_chooses_groups_and_who_is_first():
    mesh = tagged({"left": [[0, 3], [3, 6]], "bottom": [[0, 1], [1, 2]], "low": [[0, 1], [1, 2]]})
    assert names(from_mesh(mesh, tags=["bottom", "left"])) == {
        "interior": [4], "bottom": [0, 1, 2], "left": [3, 6], "boundary": [5, 7, 8]}  # fmt: skip
    with pytest.raises(ValueError, match=r"tags: 'botom' is none of the mesh's groups .*did you mean 'bottom'\?"):
        from_mesh(mesh, tags=["botom"])
    with pytest.raises(ValueError, match=r"tags: 'gmsh:phisical' is none.*did you mean 'gmsh:physical'\?"):
        from_mesh(mesh, tags="gmsh:phisical")
    with pytest.raises(ValueError, match="tags: 'left' is none .*chosen by a list"):
        from_mesh(mesh, tags="left")
    sets = {"anchor": np.array([9]), "left": np.array([0, 3])}
    loose = meshio.Mesh([*NINE, [5, 5]], [("quad", QUADS)], point_sets=sets)
    assert names(from_mesh(loose))["left"] == [0, 3]
    with pytest.raises(ValueError, match="tags: the group 'anchor' has no node in the domain"):
        from_mesh(loose, tags=["left", "anchor"])
    for wrong in (3, [], [3], {"a": 1}):
        with pytest.raises(ValueError, match="tags: expected the name of cell data, or a list"):
            from_mesh(mesh, tags=wrong)
    mesh.cell_data["gmsh:geometrical"] = mesh.cell_data["gmsh:physical"]  # numbers of their own, without names
    assert list(from_mesh(mesh, tags="gmsh:geometrical").groups) == ["interior", "1", "2", "3", "boundary"]
    del mesh.cell_data["gmsh:geometrical"]
    plain = meshio.Mesh(NINE, [("quad", QUADS)], cell_data={"mark": [[1, 1, 1, 1]]})
    with pytest.raises(ValueError, match="tags: the cell data 'mark' name no side .*tag its boundary facets"):
        from_mesh(plain, tags="mark")


def test_a_line_inside_is_no_boundary_its_nodes_are_there_by_name():
    cloud = from_mesh(tagged({"weld": [[3, 4], [4, 5]], "bottom": [[0, 1], [1, 2]]}))
    assert names(cloud) == {"interior": [4], "bottom": [0, 1, 2], "boundary": [3, 5, 6, 7, 8]}
    assert cloud.cell_groups["weld"].tolist() == [3, 4, 5] and len(cloud.cell_groups["plate"]) == 9
    with pytest.raises(ValueError, match=r"1 facets of the group 'left'.*no side of any cell.*\[0, 6\]"):
        from_mesh(tagged({"left": [[0, 6]]}))


def test_materials_are_cell_groups():
    """Nodes between two materials belong to both; they survive pickling, pytrees, jit and replace."""
    mesh = meshio.Mesh(NINE, [("quad", QUADS)], cell_data={"gmsh:physical": [[1, 2, 1, 2]]},
                       field_data={"steel": [1, 2], "glass": [2, 2], "time": [0.5]})  # fmt: skip
    cloud = from_mesh(mesh)
    wanted = {"steel": [0, 1, 3, 4, 6, 7], "glass": [1, 2, 4, 5, 7, 8]}
    for again in (cloud, pickle.loads(pickle.dumps(cloud)), jax.tree.map(lambda x: x, cloud),
                  jax.jit(lambda c: c)(cloud), cloud.replace(points=cloud.points + 1)):  # fmt: skip
        assert {k: v.tolist() for k, v in again.cell_groups.items()} == wanted
        assert names(again) == names(cloud) == {"interior": [4], "boundary": [0, 1, 2, 3, 5, 6, 7, 8]}
    assert "cell groups {steel: 6, glass: 6}" in repr(cloud)
    with pytest.raises(ValueError, match=r"cell_groups\['a'\]: indices from 0 to 9, expected 0 to 8"):
        js.Cloud(cloud.points, cloud.groups, cell_groups={"a": [0, 9]})
    with pytest.raises(ValueError, match="cell_groups: expected a dict"):
        js.Cloud(cloud.points, cloud.groups, cell_groups=[3])


# ---- Gmsh


MSH2 = """$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
3
1 7 "wall"
1 8 "lid"
2 5 "fluid"
$EndPhysicalNames
$Nodes
9
{nodes}
$EndNodes
$Elements
{count}
{elements}
$EndElements
"""


def msh2(lines):
    nodes = "\n".join(f"{k + 1} {x} {y} 0" for k, (x, y) in enumerate(NINE))
    cells = [*lines, *(f"3 2 5 1 {' '.join(str(n + 1) for n in quad)}" for quad in QUADS)]
    return MSH2.format(nodes=nodes, count=len(cells), elements="\n".join(f"{k + 1} {c}" for k, c in enumerate(cells)))


def test_gmsh_2_with_a_tag_of_none(tmp_path):
    """A zero is no tag in Gmsh; partitions are noise."""
    text = msh2(["1 2 7 1 1 2", "1 2 7 1 2 3", "1 2 8 2 9 8", "1 2 0 3 8 7"])
    cloud = from_mesh(write(tmp_path, "a.MSH", text))
    assert names(cloud) == {"interior": [4], "wall": [0, 1, 2], "lid": [7, 8], "boundary": [3, 5, 6]}
    assert list(cloud.cell_groups) == ["fluid"]


def test_gmsh_2_writes_a_cell_of_two_groups_twice(tmp_path):
    """Once for each; the same again within one group is a fault."""
    copies = [f"3 2 6 1 {' '.join(str(n + 1) for n in quad)}" for quad in QUADS[:2]]
    cloud = from_mesh(write(tmp_path, "a.msh", msh2(["1 2 7 1 1 2", "1 2 8 1 1 2", "1 2 7 1 2 3", *copies])))
    assert names(cloud) == {"interior": [4], "wall": [2], "lid": [0, 1], "boundary": [3, 5, 6, 7, 8]}
    assert {k: len(v) for k, v in cloud.cell_groups.items()} == {"fluid": 9, "6": 6}
    with pytest.raises(ValueError, match="mesh: .*belongs to 4 cells"):
        from_mesh(write(tmp_path, "a.msh", msh2([*copies, *copies])))


def test_gmsh_4_1(tmp_path):
    """Two groups on one curve, one of them turned round, which its sign says."""
    text = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
3
1 1 "low"
1 2 "whole"
2 3 "plate"
$EndPhysicalNames
$Entities
0 2 1 0
1 0 0 0 2 0 0 2 1 2 0
2 0 0 0 2 2 0 1 -2 0
1 0 0 0 2 2 0 1 3 0
$EndEntities
$Nodes
1 9 1 9
2 1 0 9
1
2
3
4
5
6
7
8
9
""" + "\n".join(f"{x} {y} 0" for x, y in NINE) + """
$EndNodes
$Elements
3 8 1 8
1 1 1 2
1 1 2
2 2 3
1 2 1 2
3 3 6
4 6 9
2 1 3 4
""" + "\n".join(f"{k + 5} {' '.join(str(n + 1) for n in quad)}" for k, quad in enumerate(QUADS)) + "\n$EndElements\n"
    cloud = from_mesh(write(tmp_path, "a.msh", text))
    # "whole" holds all of "low", so "low" goes first.
    assert names(cloud) == {"interior": [4], "low": [0, 1, 2], "whole": [5, 8], "boundary": [3, 6, 7]}
    assert len(cloud.cell_groups["plate"]) == 9


# ---- SU2


def su2(gap=" ", index=True, marks=(("hot wall", [(0, 1), (1, 2)]), ("3", [(2, 5)])), head="NDIME= 2"):
    lines = ["% a comment", head, "NELEM= 4"]
    lines += [gap.join(map(str, [9, *quad, *([k] if index else [])])) for k, quad in enumerate(QUADS)]
    lines += ["NPOIN= 9"]
    for k, (x, y) in enumerate(NINE):
        lines.append(gap.join([f"{0.1 * x:.3f}", f"{0.1 * y:.3f}", *([str(k)] if index else [])]))
    lines += [f"NMARK= {len(marks)}"]
    for name, sides in marks:
        lines += [f"MARKER_TAG= {name}", f"MARKER_ELEMS= {len(sides)}"]
        lines += [gap.join(map(str, [3, *side])) for side in sides]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("gap", [" ", "\t", "  \t "])
@pytest.mark.parametrize("index", [True, False])
@pytest.mark.parametrize("head", ["NDIME= 2", "NDIME=2", "NDIME = 2   % plane"])
def test_su2_of_every_spacing_keeps_the_names_of_its_markers(gap, index, head, tmp_path):
    cloud = from_mesh(write(tmp_path, "a.su2", su2(gap, index, head=head)))
    np.testing.assert_allclose(cloud.points, 0.1 * NINE, atol=1e-15)
    assert names(cloud) == {"interior": [4], "hot wall": [0, 1, 2], "3": [5], "boundary": [3, 6, 7, 8]}


@pytest.mark.parametrize("old, new, text", [
    ("NPOIN= 9", "NPOIN= 12", "cannot read.*expected a point, got 'NMARK= 2'"),
    ("NELEM= 4", "NELEM= 5", "cannot read.*expected a cell, got 'NPOIN= 9'"),
    ("NELEM= 4", "NELEM= 3", "cannot read.*the line .* is none of SU2"),
    ("NDIME= 2", "NDIME= 3", "cannot read.*(could not convert|numbers; expected 3|dimension)|surface|no side"),
    ("NDIME= 2", "NZONE= 2", "cannot read.*one zone is read"),
    ("NMARK= 2", "NMARK= 3", r"cannot read.*NMARK= 3, but there are 2 markers"),
    ("9 0 1 4 3", "77 0 1 4 3", "cannot read.*none of SU2"),
    ("0.100 0.100 4", "0.100 x 4", "cannot read"),
    ("0.100 0.100 4", "0.300 0.100 4", "sides cross"),
    ("9 0 1 4 3", "9 0 1 4 33", "name nodes from 0 to 33"),
])  # fmt: skip
def test_su2_that_is_wrong(old, new, text, tmp_path):
    whole = su2()
    assert old in whole
    with pytest.raises(ValueError, match=f"(?s)mesh: .*({text})"):
        from_mesh(write(tmp_path, "a.su2", whole.replace(old, new)))


# ---- Abaqus and CalculiX


def deck(*cards, nset="Nall", kind="CPS4"):
    """A plate in an Abaqus file; its nodes and elements are numbered 10, 20, ..."""
    nodes = [f"{10 * k + 10}, {x}, {y}, 0." for k, (x, y) in enumerate(NINE)]
    quads = [f"{10 * k + 10}, " + ", ".join(str(10 * n + 10) for n in quad) for k, quad in enumerate(QUADS)]
    return "\n".join(["*HEADING", "a plate", f"*NODE, NSET={nset}", *nodes, f"*ELEMENT, TYPE={kind}, ELSET=Eall",
                      *quads, *cards]) + "\n"  # fmt: skip


def test_a_set_of_all_nodes_is_no_side(tmp_path):
    """It comes first in every CalculiX file; sides may be named in capitals or not, generated, made of other sets."""
    text = deck("** a comment", "*NSET, NSET=left", "10, 40,", "70", "*Nset, nset=Bottom, generate", "10, 30, 10",
                "*NSET, NSET=rest", "60,90", "*NSET, NSET=right", "REST, 80", "*ELSET, ELSET=west", "10, 30",
                "*ELSET, ELSET=east, GENERATE", "20, 40, 20")  # fmt: skip
    cloud = from_mesh(write(tmp_path, "a.inp", text))
    assert names(cloud) == {"interior": [4], "left": [0, 3, 6], "Bottom": [1, 2], "rest": [5, 8], "right": [7]}
    assert {k: v.tolist() for k, v in cloud.cell_groups.items()} == {
        "Eall": [*range(9)], "west": [0, 1, 3, 4, 6, 7], "east": [1, 2, 4, 5, 7, 8], "Nall": [*range(9)]}  # fmt: skip


def test_surfaces_of_abaqus_are_sides(tmp_path):
    text = deck("*SURFACE, NAME=low, TYPE=ELEMENT", "10, S1", "20, S1", "*ELSET, ELSET=up", "30, 40",
                "*SURFACE, NAME=high", "up, S3")  # fmt: skip
    cloud = from_mesh(write(tmp_path, "a.inp", text))
    assert names(cloud) == {"interior": [4], "low": [0, 1, 2], "high": [6, 7, 8], "boundary": [3, 5]}
    np.testing.assert_allclose(cloud.normals[cloud.groups["high"]], [[0, 1]] * 3, atol=1e-15)


def test_a_brick_of_calculix(tmp_path):
    """C3D20 over two lines, heat elements too; its faces by number."""
    mesh = grown("hexahedron20", CUBE, [list(range(8))])
    nodes = [f"{k + 1}, {x}, {y}, {z}" for k, (x, y, z) in enumerate(mesh.points)]
    numbers = [str(n + 1) for n in mesh.cells[0].data[0]]
    for kind in ("C3D20", "C3D20R", "DC3D20"):
        lines = ["*NODE, NSET=NALL", *nodes, f"*ELEMENT, TYPE={kind}, ELSET=EALL",
                 "1, " + ", ".join(numbers[:11]) + ",", ", ".join(numbers[11:]),
                 "*SURFACE, NAME=top", "EALL, S2", "*SURFACE, NAME=front", "1, S3"]  # fmt: skip
        cloud = from_mesh(write(tmp_path, "a.inp", "\n".join(lines)))
        assert len(cloud) == 20 and (cloud.points[cloud.groups["top"]][:, 2] == 1).all()
        assert len(cloud.groups["top"]) == 8 and len(cloud.groups["front"]) == 5 and len(cloud.groups["boundary"]) == 7
        np.testing.assert_allclose(cloud.normals[cloud.groups["top"]], [[0, 0, 1]] * 8, atol=1e-14)


@pytest.mark.parametrize("cards, text", [
    (["*NODE", "10, 5., 5., 0."], "the node 10 comes twice.*flat mesh"),
    (["*ELEMENT, TYPE=CPS3", "10, 10, 20, 50"], "the element 10 comes twice"),
    (["*ELEMENT, TYPE=SPRINGA", "50, 10, 20"], "type 'SPRINGA' are not understood"),
    (["*ELEMENT, TYPE=CPS3", "50, 10, 20, 55"], "the node 55, which does not come"),
    (["*ELEMENT, TYPE=CPS3", "50, 10, 20"], "'CPS3' have 3 nodes, 3 numbers came"),
    (["*NSET, NSET=a", "left"], "names 'left', which is neither"),
    (["*NSET, NSET=a", "10, 4"], "the set 'a' has node 4, which does not come"),
    (["*NSET; NSET=a", "10"], "has no keyword"),
    (["*SURFACE, NAME=a", "10, S7"], "the face 'S7' of the element '10'"),
    (["*INSTANCE, NAME=a, PART=p", "1., 0., 0."], "an?(.*)instances, or one that is moved"),
    (["*ELEMENT, TYPE=CPS3", "50, 10, 20, 50"], "belongs to 3 cells|same side|lie on"),
])  # fmt: skip
def test_abaqus_that_is_wrong(cards, text, tmp_path):
    with pytest.raises(ValueError, match=f"(?s)mesh: .*({text})"):
        from_mesh(write(tmp_path, "a.inp", deck(*cards)))


# ---- other files


def test_cells_that_meshio_leaves_out_are_told(tmp_path):
    """A triangle strip of VTK: meshio says so in passing and returns the rest."""
    text = """# vtk DataFile Version 2.0
two cells
ASCII
DATASET UNSTRUCTURED_GRID
POINTS 5 double
0 0 0 1 0 0 1 1 0 0 1 0 2 0 0
CELLS 2 9
4 0 1 2 3
3 1 4 2
CELL_TYPES 2
9
{kind}
"""
    assert len(from_mesh(write(tmp_path, "a.vtk", text.format(kind=5)))) == 5
    with pytest.raises(ValueError, match="(?s)mesh: the file .* was read in part only|mesh: cannot read"):
        from_mesh(write(tmp_path, "a.vtk", text.format(kind=6)))


def test_files_of_another_kind_than_their_name(tmp_path):
    meshio.Mesh(np.pad(NINE, ((0, 0), (0, 1))), [("quad", QUADS)]).write(tmp_path / "a.vtu")
    assert names(from_mesh(tmp_path / "a.vtu")) == {"interior": [4], "boundary": [0, 1, 2, 3, 5, 6, 7, 8]}
    text = msh2([])
    for name in ("a.su2", "a.inp", "a.vtk", "a.vtu", "a.xdmf", "a.mesh", "a.txt"):
        with pytest.raises(ValueError, match="mesh: cannot read.*expected a whole file"):
            from_mesh(write(tmp_path, name, text))
    words = "\u00e4\u20ac".encode() * 9
    for junk in (b"\x00" * 50, bytes(range(256)), words, b"*NODE\n\xff\xfe\n", b"NDIME= 2\nNPOIN= x\n"):
        for name in ("a.su2", "a.inp", "a.vtk", "a.msh"):
            path = tmp_path / name
            path.write_bytes(junk)
            with pytest.raises(ValueError, match="mesh: "):
                from_mesh(path)


# ---- tables and arrays


def test_csv_that_would_be_misread(tmp_path):
    for text, message in (
        ("x,x,group\n0,5,left\n1,6,interior\n", "several columns of the name 'x'; keep one"),
        ("x,group,group\n0,left,right\n1,interior,interior\n", "several columns of the name 'group'"),
        ("x,y,group,nx\n0,0,left,-1\n1,0,interior,\n", r"expected all of \['nx', 'ny'\] for normals, or none"),
        ("x,group\n0,left\n\n1,5,interior\n", "line 4: has 3 cells under 2 columns"),
        ("x,group\n1_000,left\n1,interior\n", "line 2: x = '1_000' is no number"),
        ("x,group\n0,left\n1,Interior\n", "line 3: has the group 'Interior'; expected interior"),
        ('x,group\n0,"left\n1,interior\n', "path: .*save it as CSV"),
    ):
        with pytest.raises(ValueError, match=message):
            js.files.from_csv(write(tmp_path, "a.csv", text))
    good = " x , group , note\n0,left,a,,\n \n1, interior ,b\n2,right,c\n"
    assert names(js.files.from_csv(write(tmp_path, "a.csv", good))) == {"interior": [1], "left": [0], "right": [2]}
    cloud = js.interval(0.0, 1.0, 3)
    for wrong in (0, True, 3.5, None):
        with pytest.raises(ValueError, match="path: cannot read .*give the path"):
            js.files.from_csv(wrong)
        with pytest.raises(ValueError, match="path: .*give the path"):
            js.files.to_csv(cloud, wrong)
    spaced = js.Cloud([[0.0], [1.0]], {"interior": [0], " left": [1]})
    with pytest.raises(ValueError, match="what: the name ' left' of a group would not read back"):
        js.files.to_csv(spaced, tmp_path / "b.csv")


def test_masked_entries_are_told():
    """As an ordinary array a masked one shows the numbers under the mask."""
    hidden = np.ma.array([[0.0], [1.0], [99.0]], mask=[[False], [False], [True]])
    with pytest.raises(ValueError, match=r"points: 1 of its 3 entries are masked, as \[2, 0\]; fill"):
        js.Cloud(hidden, {"interior": [0, 1, 2]})
    with pytest.raises(ValueError, match=r"groups\['interior'\]: 1 of its 2 entries are masked"):
        js.Cloud([[0.0], [1.0]], {"interior": np.ma.array([0, 1], mask=[False, True])})
    end = js.Cloud([[0.0], [1.0]], {"interior": [0], "end": [1]}, np.ma.array([[0.0], [1.0]], mask=[[True], [True]]))
    assert np.isnan(end.normals).all()  # none, which is told where a condition asks for one
    one = np.ma.array([1.0, 2.0], mask=[False, True])
    for call, name in ((lambda: js.dirichlet(one), "value"), (lambda: js.fix(one.astype(int), 0.0), "indices")):
        with pytest.raises(ValueError, match=f"{name}: 1 of its 2 entries are masked"):
            call()
    assert len(js.Cloud(np.ma.array([[0.0], [1.0]]), {"interior": [0, 1]})) == 2
    pandas = pytest.importorskip("pandas")
    missing = pandas.array([0.0, 1.0, None], dtype="Float64")
    with pytest.raises(ValueError, match="points: |NaN"):
        js.Cloud(pandas.DataFrame({"x": missing}), {"interior": [0, 1, 2]})
    cloud = js.interval(0.0, 1.0, 3)
    with pytest.raises(ValueError, match="e: 1 of its 3 entries are masked"):
        js.files.to_pandas(cloud, e=np.ma.array([1, 2, 3], mask=[False, False, True]))
