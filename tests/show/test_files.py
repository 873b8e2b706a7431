"""Clouds from meshes, polygons and tables, solutions to them; each against a geometry known by hand."""

import builtins

import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.cloud.shapes import from_polygon
from jsmitsm.cloud.triangulation import simplices
from jsmitsm.show.files import from_csv, from_mesh, from_shapely, to_csv, to_mesh, to_pandas, to_xarray

meshio = pytest.importorskip("meshio")


def lattice(kind):
    """Nodes of the unit square or cube, three to a side, and their cells of one kind."""
    dim = 2 if kind in ("triangle", "quad", "triangle6", "quad9") else 3
    axes = [np.linspace(0.0, 1.0, 3)] * dim
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
    number = np.arange(3**dim).reshape((3,) * dim)
    if kind == "triangle6":  # two triangles of second order, the middles of their sides lattice nodes
        cells = [number[[0, 2, 2, 1, 2, 1], [0, 0, 2, 0, 1, 1]], number[[0, 2, 0, 1, 1, 0], [0, 2, 2, 1, 2, 1]]]
    elif kind == "quad9":
        cells = [number[[0, 2, 2, 0, 1, 2, 1, 0, 1], [0, 0, 2, 2, 0, 1, 2, 1, 1]]]
    else:
        cells = []
        for corner in np.ndindex((2,) * dim):
            part = number[tuple(slice(c, c + 2) for c in corner)]
            if dim == 2:
                (a, d), (b, c) = part
                cells += [[a, b, c, d]] if kind == "quad" else [[a, b, c], [a, c, d]]
                continue
            (a, e), (d, h) = part[0]
            (b, f), (c, g) = part[1]
            if kind == "hexahedron":
                cells += [[a, b, c, d, e, f, g, h]]
            elif kind == "wedge":
                cells += [[a, b, c, e, f, g], [a, c, d, e, g, h]]
            else:  # six tetrahedra round the diagonal from a to g
                ring = [b, c, d, h, e, f]
                cells += [[a, ring[k], ring[(k + 1) % 6], g] for k in range(6)]
    return meshio.Mesh(np.pad(points, ((0, 0), (0, 3 - dim))), [(kind, np.array(cells))]), points


@pytest.mark.parametrize("kind", ["triangle", "quad", "triangle6", "quad9", "tetra", "hexahedron", "wedge"])
def test_boundary_and_normals_of_every_kind_of_cell(kind):
    """Of 3^D nodes all but the middle one are boundary; its normal is the sum of the faces' it lies on."""
    mesh, points = lattice(kind)
    cloud = from_mesh(mesh)
    assert (cloud.points == points).all()
    assert sorted(cloud.groups) == ["boundary", "interior"]
    assert cloud.groups["interior"].tolist() == [len(points) // 2]
    expected = np.where(points == 0, -1.0, np.where(points == 1, 1.0, 0.0))[cloud.boundary]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    # Angle weights make corners exact bisectors; a node amid a face between triangles is exact to rounding.
    np.testing.assert_allclose(cloud.normals[cloud.boundary], expected, atol=1e-14)


def test_a_pyramid_has_its_five_faces():
    points = [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 1.0]]
    cloud = from_mesh(meshio.Mesh(points, [("pyramid", [[0, 1, 2, 3, 4]])]))
    np.testing.assert_allclose(cloud.normals[4], [0, 0, 1], atol=1e-14)
    assert cloud.normals[0] @ [1, 1, 1] < 0 and len(cloud.groups["boundary"]) == 5


def test_gmsh_file_with_physical_names(tmp_path):
    """A Gmsh file: an orphan node, named sides, a tag within the domain that is no boundary."""
    points = [[9, 9, 0], *([x, y, 0] for y in range(3) for x in range(3))]
    quads = [[1, 2, 5, 4], [2, 3, 6, 5], [4, 5, 8, 7], [5, 6, 9, 8]]
    lines = [[1, 2], [2, 3], [3, 6], [6, 9], [4, 5]]
    mesh = meshio.Mesh(
        points,
        [("quad", quads), ("line", lines)],
        cell_data={"gmsh:physical": [[5] * 4, [2, 2, 8, 8, 3]], "gmsh:geometrical": [[1] * 4, [1, 1, 2, 2, 3]]},
        field_data={k: np.array(v) for k, v in
                    {"right": [8, 1], "bottom": [2, 1], "inner": [3, 1], "all": [5, 2]}.items()},
    )  # fmt: skip
    mesh.write(tmp_path / "square.msh", file_format="gmsh22", binary=False)
    cloud = from_mesh(tmp_path / "square.msh")
    assert len(cloud) == 9 and cloud.points.max() == 2.0
    # The file lists names by number: "bottom" takes the corner; "inner" is no side, also where it ends on the boundary.
    assert {k: cloud.points[v].tolist() for k, v in cloud.groups.items()} == {
        "interior": [[1, 1]],
        "right": [[2, 1], [2, 2]],
        "bottom": [[0, 0], [1, 0], [2, 0]],
        "boundary": [[0, 1], [0, 2], [1, 2]],
    }
    inside = {k: cloud.points[v].tolist() for k, v in cloud.cell_groups.items() if k != "all"}
    assert inside == {"inner": [[0, 1], [1, 1]]}
    assert len(cloud.cell_groups["all"]) == 9
    np.testing.assert_allclose(cloud.normals[cloud.groups["bottom"]][1], [0, -1])
    # In memory "right" is named first.
    assert from_mesh(mesh).points[from_mesh(mesh).groups["right"]].tolist() == [[2, 0], [2, 1], [2, 2]]


def ring():
    """A quarter of a ring between the radii 1 and 2, its four sides tagged; the arcs first: the corners are theirs."""
    radius, angle = np.linspace(1, 2, 9), np.linspace(0, np.pi / 2, 17)
    points = np.array([[r * np.cos(t), r * np.sin(t), 0] for r in radius for t in angle])
    at = np.arange(points.shape[0]).reshape(9, 17)
    quads = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], axis=-1).reshape(-1, 4)
    sides = {"hole": at[0], "rim": at[-1], "bottom": at[:, 0], "left": at[:, -1]}
    lines = [np.stack([side[:-1], side[1:]], axis=1) for side in sides.values()]
    tags = np.repeat(np.arange(1, 5), [len(line) for line in lines])
    return meshio.Mesh(points, [("quad", quads), ("line", np.concatenate(lines))],
                       cell_data={"gmsh:physical": [np.full(len(quads), 9), tags]},
                       field_data={name: np.array([k + 1, 1]) for k, name in enumerate(sides)})  # fmt: skip


def test_at_corners_between_groups_the_normal_is_that_of_the_own_side():
    """Mesh normals of regular arcs are the circle's, to their very ends: not the bisectors of the corners there."""
    cloud = from_mesh(ring())
    for name, outward in (("hole", lambda x: -x), ("rim", lambda x: x / 2), ("bottom", lambda x: [0, -1]),
                          ("left", lambda x: [-1, 0])):  # fmt: skip
        wanted = np.array([outward(x) for x in cloud.points[cloud.groups[name]]])
        np.testing.assert_allclose(cloud.normals[cloud.groups[name]], wanted, atol=1e-14)


def test_a_ring_under_pressure_from_a_mesh():
    """Lame's thick-walled tube in plane strain: u = a r + b / r, pressure inside alone, two planes of symmetry."""
    mu = lam = 1.0
    pressure, cloud = 0.3, from_mesh(ring())

    def stress(u, x):
        slope = js.grad(u)(x)
        return lam * jnp.trace(slope) * jnp.eye(2) + mu * (slope + slope.T)

    def sheared(u, x, n):
        return stress(u, x)[0, 1]

    problem = js.Problem(
        lambda u, x: js.divergence(lambda y: stress(u, y))(x),
        {
            "hole": js.condition(lambda u, x, n: stress(u, x) @ n + pressure * n),
            "rim": js.condition(lambda u, x, n: stress(u, x) @ n),
            "bottom": [js.dirichlet(0.0, field=1), js.condition(sheared)],
            "left": [js.dirichlet(0.0, field=0), js.condition(sheared)],
        },
        fields=2,
    )
    square = (cloud.points**2).sum(axis=1, keepdims=True)
    a, b = pressure / 3 / (2 * (lam + mu)), pressure * 4 / 3 / (2 * mu)  # radii 1 and 2
    exact = (a + b / square) * cloud.points
    assert abs(js.solve(problem, cloud, order=6).u - exact).max() < 1e-3 * abs(exact).max()


def test_cell_sets_point_sets_and_a_chosen_tag():
    mesh, _ = lattice("triangle")
    side = [[0, 1], [1, 2]]
    cells = [*mesh.cells, ("line", side)]
    named = meshio.Mesh(mesh.points, cells, cell_sets={"west": [np.array([], int), np.array([0, 1])]})
    assert from_mesh(named).groups["west"].tolist() == [0, 1, 2]
    points = meshio.Mesh(mesh.points, mesh.cells, point_sets={"east": np.array([6, 7, 8])})
    assert from_mesh(points).groups["east"].tolist() == [6, 7, 8]
    tagged = meshio.Mesh(mesh.points, cells, cell_data={"mark": [[0] * 8, [4, 4]]})
    assert from_mesh(tagged, tags="mark").groups["4"].tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="'colour' is none of the mesh's cell data"):
        from_mesh(tagged, tags="colour")


def test_a_problem_on_a_mesh_file_is_solved_and_written_back(tmp_path):
    """u = x^2 + y is a polynomial: exact on the nodes of any mesh; VTU brings it back to the last bit."""
    hole = [(0.8, 0.4), (1.2, 0.4), (1.2, 0.6), (0.8, 0.6)]
    cloud = from_polygon([(0, 0), (2, 0), (2, 1), (0, 1)], 0.2, holes=[hole])
    mesh = meshio.Mesh(np.pad(cloud.points, ((0, 0), (0, 1))), [("triangle", simplices(cloud))])
    mesh.write(tmp_path / "plate.vtk")
    cloud = from_mesh(tmp_path / "plate.vtk")
    exact = cloud.points[:, 0] ** 2 + cloud.points[:, 1]
    problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 2.0, {"boundary": js.dirichlet(lambda x: x[0] ** 2 + x[1])})
    sol = js.solve(problem, cloud, order=3)
    np.testing.assert_allclose(sol.u, exact, atol=1e-11)  # round-off of some hundred unknowns
    to_mesh(sol, twice=2 * exact).write(tmp_path / "u.vtu")
    back = meshio.read(tmp_path / "u.vtu")
    assert (back.point_data["u"] == sol.u).all() and (back.point_data["twice"] == 2 * exact).all()
    # The hole stays open: 2 x 1 less 0.4 x 0.2.
    corner = back.points[back.cells_dict["triangle"]]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() / 2
    assert abs(area - 1.92) < 1e-12


def test_bad_meshes_are_named():
    flat = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]
    for mesh, text in (
        (meshio.Mesh(flat, []), "has no cells"),
        (meshio.Mesh(flat, [("triangle", [[0, 1, 2], [0, 1, 3]])]), "a surface in space is no domain"),
        (meshio.Mesh(flat, [("polygon", [[0, 1, 2]])]), "'polygon' are not understood"),
        (3, "expected a meshio.Mesh or the path"),
    ):
        with pytest.raises(ValueError, match=text):
            from_mesh(mesh)


CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5]], float)
FAN = ("triangle", [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
SIDE = ("line", [[0, 1]])


def moved(value):
    points = CORNERS.copy()
    points[4, 0] = value
    return points


@pytest.mark.parametrize("points, cells, more, text", [
    (moved(np.nan), [FAN], {}, r"mesh: NaN or infinite coordinates at the points \[4\].*remove"),
    (moved(np.inf), [FAN], {}, r"mesh: NaN or infinite coordinates at the points \[4\].*remove"),
    (CORNERS + 0j, [FAN], {}, "mesh: its points.*complex128.*real numbers"),
    (CORNERS[:, :1], [FAN], {}, r"mesh: its points have shape \(5, 1\).*D at least 2"),
    (CORNERS * 1e300, [FAN], {}, "coordinates of size 1e.300.*another unit of length"),
    (CORNERS * 1e-300, [FAN], {}, "coordinates of size 1e-300.*another unit of length"),
    (CORNERS, [("triangle", [[0, 1, 9]])], {},
     "nodes from 0 to 9, but there are only the points 0 to 4; write the mesh"),
    (CORNERS, [("triangle", [[0, 1, -1]])], {}, "nodes from -1 to 1"),
    (CORNERS, [("triangle", [[0, 1, 1]])], {}, "has a node twice"),
    ([*CORNERS, [0.5, 0.0]], [("triangle", [*FAN[1], [0, 5, 1]])], {}, "cell without volume has the nodes .*remove"),
    (CORNERS, [FAN, FAN], {}, "given twice; remove the copies"),
    (CORNERS, [("triangle", np.zeros((0, 3), int))], {}, "has no cells"),
    (CORNERS, [("vertex", [[0]])], {}, "has no cells"),
    (CORNERS, [("line", [[0, 4]])], {}, "1-dimensional but its points"),
    (CORNERS, [("triangle10", [[0, 1, 2, 3, 4, 0, 1, 2, 3, 4]])], {}, "'triangle10' are not understood; save it"),
    (CORNERS, [FAN, SIDE], {"cell_data": {"mark": [[1.0] * 4, [2.5]]}},
     "tags: the cell data 'mark' are no whole numbers"),
    (CORNERS, [FAN, SIDE], {"cell_data": {"mark": [[1.0] * 4, [np.nan]]}},
     "tags: .* no whole numbers; number the sides"),
    (CORNERS, [FAN, SIDE], {"cell_data": {"mark": [[1] * 4, [2]]}, "field_data": {"interior": np.array([2, 1])}},
     "tagged 'interior'.*rename"),
])  # fmt: skip
@pytest.mark.filterwarnings("error")
def test_a_damaged_mesh_is_refused(points, cells, more, text):
    mesh = meshio.Mesh(points, cells, **more)
    with pytest.raises(ValueError, match=f"(?s){text}"):
        from_mesh(mesh, tags="mark" if more else None)


@pytest.mark.filterwarnings("error")
def test_odd_meshes_that_are_right():
    """In another unit, far away, at another height; two kinds of cells."""
    for points in (CORNERS * 1e-6, CORNERS + 1e6, np.pad(CORNERS, ((0, 0), (0, 1)), constant_values=3.0)):
        cloud = from_mesh(meshio.Mesh(points, [FAN]))
        assert cloud.groups["interior"].tolist() == [4] and len(cloud.groups["boundary"]) == 4
    two = [("quad", [[0, 1, 2, 3]]), ("triangle", [[1, 4, 2]])]
    assert len(from_mesh(meshio.Mesh([*CORNERS[:4], [2.0, 0.5]], two)).groups["boundary"]) == 5


@pytest.mark.parametrize("name", ["a.msh", "a.vtk", "a.vtu", "a.inp", "a.xdmf", "a.su2", "a.unknown", "none"])
@pytest.mark.filterwarnings("ignore")
def test_what_is_no_mesh_file(name, tmp_path):
    """meshio raises what it likes, ends the program, or never comes back from some of these."""
    path = tmp_path / name
    with pytest.raises(ValueError, match="mesh: there is no file.*give the path"):
        from_mesh(path)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="mesh: the file.*is empty; write it again"):
        from_mesh(path)
    path.write_bytes(bytes(np.random.default_rng(0).integers(0, 256, 300, dtype=np.uint8)))
    with pytest.raises(ValueError, match="(?s)mesh: .*(cannot read.*expected a whole file|convert it)"):
        from_mesh(path)


@pytest.mark.parametrize("form, kind", [("msh", "gmsh"), ("msh", "gmsh22"), ("vtk", "vtk"), ("vtu", "vtu"),
                                        ("tec", "tecplot"), ("mdpa", "mdpa")])  # fmt: skip
def test_a_file_cut_short(form, kind, tmp_path):
    path = tmp_path / f"whole.{form}"
    meshio.Mesh(np.pad(CORNERS, ((0, 0), (0, 1))), [FAN]).write(path, file_format=kind)
    assert len(from_mesh(path)) == 5
    whole = path.read_bytes()
    for part in (0.05, 0.3, 0.6, 0.9):
        path.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(ValueError, match="mesh: .*(cut short|cannot read|has no cells|name nodes)"):
            from_mesh(path)


def test_what_meshio_would_read_for_ever(tmp_path):
    """A text of triangles, and TetGen's two files of which one is empty or missing."""
    (tmp_path / "a.wkt").write_text("TIN (((0 0, 1 0")
    with pytest.raises(ValueError, match="mesh: .*WKT.*write the mesh as .msh"):
        from_mesh(tmp_path / "a.wkt")
    (tmp_path / "a.node").write_text("4 3 0 0\n0 0 0 0\n1 1 0 0\n2 0 1 0\n3 0 0 1\n")
    with pytest.raises(ValueError, match="mesh: there is no file .*a.ele"):
        from_mesh(tmp_path / "a.node")
    (tmp_path / "a.ele").write_text("# nothing\n")
    with pytest.raises(ValueError, match="mesh: the file .*a.ele' is empty"):
        from_mesh(tmp_path / "a.node")


def test_shapely_polygon_and_text():
    shapely = pytest.importorskip("shapely")
    ring = shapely.Point(0, 0).buffer(1.0).difference(shapely.box(-0.3, -0.3, 0.3, 0.3))
    cloud = from_shapely(ring, 0.1)
    assert sorted(cloud.groups) == ["boundary", "hole0", "interior"]
    hole = cloud.points[cloud.groups["hole0"]]
    np.testing.assert_allclose(np.abs(hole).max(axis=1), 0.3, atol=1e-12)
    again = from_shapely(ring.wkt, 0.1)
    assert len(again) == len(cloud)
    with pytest.raises(ValueError, match="got MultiPolygon"):
        from_shapely(shapely.MultiPolygon([shapely.box(0, 0, 1, 1), shapely.box(2, 2, 3, 3)]), 0.1)
    with pytest.raises(ValueError, match="is empty"):
        from_shapely(shapely.Polygon(), 0.1)
    with pytest.raises(ValueError, match="polygon: 'ring' is no well-known text, as 'POLYGON"):
        from_shapely("ring", 0.1)


@pytest.mark.parametrize("cloud", [js.interval(0, 1 / 3, 4), js.rectangle((0, 0), (1, 2), (4, 5), jitter=0.3)], ids=str)
def test_csv_there_and_back(cloud, tmp_path):
    to_csv(cloud, tmp_path / "cloud.csv")
    back = from_csv(tmp_path / "cloud.csv")
    assert (back.points == cloud.points).all()
    assert dict(back.groups).keys() == dict(cloud.groups).keys()
    assert all((back.groups[k] == cloud.groups[k]).all() for k in cloud.groups)
    np.testing.assert_array_equal(back.normals, cloud.normals)


def test_bad_csv_is_named(tmp_path):
    path = tmp_path / "bad.csv"
    for text, message in (
        ("x,y\n0,1\n", r"columns \['x', 'y'\]; expected x \(and y, z\) and group"),
        ("x,group\n0,left\none,interior\n", "line 3: x = 'one' is no number"),
        ("x,group\n", "no rows"),
        ("x,group\n0,left\n,interior\n", "NaN or infinite"),
        ("x,group\n1e999,left\n1,interior\n", "NaN or infinite.*remove"),
        ("x,group\n0,left\n0,interior\n", "duplicate.*keep one"),
        ("x,y,group\n0,0,left\n1\n", "line 3: has no group; expected interior"),
        ("x,group\n0,\n1,interior\n", "line 2: has no group"),
        ("x;group\n0;left\n", "expected x .and y, z. and group"),
        ("x,z,group\n0,0,left\n", "expected x .and y, z. and group"),
        ("x,group,nx\n0,left,abc\n1,interior,\n", "line 2: nx = 'abc' is no number"),
        ("x,group,nx\n0,left,-3\n1,interior,\n", "normals: not of unit length.*divide by"),
        ('x,group\n"0,5",left\n1,interior\n', "line 2: x = '0,5' is no number"),
        ("", "no rows"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            from_csv(path)
    path.write_bytes("x,group\n0,left\n".encode("utf-16"))
    with pytest.raises(ValueError, match="path: .*no text in UTF-8.*save it as CSV"):
        from_csv(path)
    for wrong in (tmp_path / "missing.csv", tmp_path, None, 3.5):
        with pytest.raises(ValueError, match="path: cannot read.*give the path of a CSV file"):
            from_csv(wrong)


def test_bad_columns_are_named():
    ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), ends), js.interval(0.0, 1.0, 9), order=3)
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    for write in (to_mesh, to_pandas, to_xarray):
        for value in (np.ones(3), 1.0, "text", None, np.ones((8, 9))):
            with pytest.raises(ValueError, match="e: values of shape .* came, expected 9, one per particle"):
                write(sol, e=value)
        with pytest.raises(ValueError, match="expected a .*js.Solution, got int"):
            write(3)
    for write in (to_pandas, to_xarray):
        with pytest.raises(ValueError, match="x: is a column already.*another name"):
            write(sol, x=np.ones(9))
    with pytest.raises(ValueError, match="what: expected a js.Cloud or js.Solution, got ndarray"):
        to_csv(sol.u, "nowhere.csv")


def test_tables():
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)})
    sol = js.solve(problem, js.interval(0.0, 1.0, 9), order=3)
    pytest.importorskip("pandas")
    frame = to_pandas(sol, error=sol.u - sol.cloud.points[:, 0])
    assert list(frame) == ["x", "group", "nx", "u", "error"] and frame.error.abs().max() < 1e-13
    assert frame.set_index("group").u["right"] == 1.0
    pytest.importorskip("xarray")
    data = to_xarray(sol, twice=2 * sol.u)
    assert float(data.u.where(data.group == "right", drop=True)[0]) == 1.0
    assert data.attrs == {"method": "S", "order": 3, "converged": 1} and data.twice.dims == ("particle",)


def test_a_missing_library_is_named_with_its_extra(monkeypatch):
    real = builtins.__import__
    missing = ("meshio", "pandas", "xarray", "shapely")

    def blocked(name, *rest):
        if name in missing:
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr("importlib.import_module", blocked)
    cloud = js.interval(0.0, 1.0, 3)
    for call, extra in (
        (lambda: from_mesh("a.msh"), "mesh"),
        (lambda: from_shapely("POINT (0 0)", 0.1), "mesh"),
        (lambda: to_pandas(cloud), "tables"),
    ):
        with pytest.raises(ImportError, match=rf'pip install "jsmitsm\[{extra}\]"'):
            call()


def test_a_file_of_comments_alone(tmp_path):
    """meshio would look for its first number for ever."""
    path = tmp_path / "cube.node"
    path.write_text("# nothing but\n# comments\n\n")
    with pytest.raises(ValueError, match="mesh: .*empty"):
        js.files.from_mesh(path)
