"""Solids: their surface in colours, opened by a cut. By pyvista where it is installed, else by matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.triangulation import boundary_facets, simplices
from jsmitsm.runtime.errors import explaining
from jsmitsm.show import drawing
from jsmitsm.show.pieces import AXES, pieces
from jsmitsm.solution.solution import Solution

_ENGINES = ("auto", "pyvista", "matplotlib")


@explaining
def solid(sol: Solution, *, field: int = 0, cut: Mapping[str, float] | None = None, engine: str = "auto",
          ax: Any = None) -> Any:  # fmt: skip
    """The surface of a solid, coloured by the solution, opened by cuts.

    Parameters
    ----------
    sol : Solution
        In 3D.
    field : int
        The field of a system.
    cut : mapping, optional
        From an axis to a position, ``{"x": 0.0}``: what lies beyond is taken away, and the section shows.
    engine : {"auto", "pyvista", "matplotlib"}
        What draws. "auto" is pyvista (``pip install "jsmitsm[solid]"``) where it is installed and no ``ax`` is given.
    ax : Axes, optional
        Three-dimensional axes of matplotlib.

    Returns
    -------
    pyvista.Plotter or Axes
        A plotter, to ``.show()`` or to write with ``.screenshot(path)``; from matplotlib the axes.

    Raises
    ------
    ValueError
        In 1D and 2D, for a cut that meets nothing, and for axes of another kind.
    ImportError
        For ``engine="pyvista"`` where it is not installed.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> box = js.box((0, 0, 0), (1, 1, 1), (4, 4, 4))
    >>> sides = {side: js.dirichlet(lambda x: x[0] * x[1]) for side in box.groups if side != "interior"}
    >>> sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), sides), box, order=2)
    >>> ax = js.plot.solid(sol, cut={"x": 0.5}, engine="matplotlib")
    """
    if not isinstance(sol, Solution):
        raise ValueError(f"sol: expected a js.Solution, got {type(sol).__name__}")
    if sol.cloud.dim != 3:
        raise ValueError(f"sol: a solid has three dimensions, this solution {sol.cloud.dim}; take js.plot.solution")
    if engine not in _ENGINES:
        raise ValueError(f"engine: expected one of {', '.join(map(repr, _ENGINES))}, got {engine!r}")
    sol.refuse_stacked()
    numbers = drawing.field_of(sol.u, field)
    label = "u" if np.ndim(sol.u) == 1 else f"u[{field}]"
    where = {} if cut is None else dict(drawing.places(sol.cloud, cut))
    made = _pyvista(engine) if ax is None and engine != "matplotlib" else None
    if made is not None:
        return _plotter(made, sol.cloud, numbers, where, label)

    def anywhere(points: np.ndarray, **side: str) -> np.ndarray:
        return drawing.field_of(sol(points, blend=True, outside="extrapolate", **side), field)

    ax = drawing.axes(ax, 3, (6.0, 4.8))
    points = np.asarray(sol.cloud.points, float)
    facets = boundary_facets(sol.cloud)[0]
    corners, shades = points[facets], numbers[facets]
    for axis, position in where.items():
        corners, shades = _kept(corners, shades, axis, position)
    for axis, position in where.items():
        for one in pieces(sol.cloud, numbers, anywhere, axis, position):
            section = np.insert(one.places, axis, position, axis=1)[one.triangles], one.values[one.triangles]
            for other, limit in where.items():
                section = section if other == axis else _kept(*section, other, limit)
            corners, shades = (np.concatenate(both) for both in zip((corners, shades), section))
    faces(ax, corners, shades.mean(axis=1), label)
    ax.view_init(40 if 2 in where else 28, {(0,): -30, (1,): 60, (0, 1): 45}.get(tuple(sorted({*where} - {2})), -60))
    drawing.dress(ax, 3)
    return ax


def faces(ax: Any, corners: np.ndarray, shades: np.ndarray, label: str) -> None:
    """Triangles (T, 3, 3) in three-dimensional axes, coloured by numbers (T,), with a colour bar."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    scale = ScalarMappable(Normalize(float(shades.min()), float(shades.max())), "viridis")
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    light = np.abs(normal / np.where(length > 0, length, 1.0) @ np.array([0.35, -0.45, 0.82]))
    colours = scale.to_rgba(shades)
    colours[:, :3] *= (0.72 + 0.28 * light)[:, None]
    ax.add_collection3d(Poly3DCollection(corners, facecolors=colours, edgecolors=colours, linewidths=0.2))
    lo, hi = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    ax.set(xlim=(lo[0], hi[0]), ylim=(lo[1], hi[1]), zlim=(lo[2], hi[2]))
    ax.figure.colorbar(scale, ax=ax, label=label, shrink=0.7, pad=0.12, ticks=drawing.round_ticks())


def _kept(corners: np.ndarray, shades: np.ndarray, axis: int, position: float) -> tuple[np.ndarray, np.ndarray]:
    """What of triangles (T, 3, 3) with numbers (T, 3) lies below a plane, cut along it."""
    below = corners[:, :, axis] <= position
    count = below.sum(axis=1)
    out = [(corners[count == 3], shades[count == 3])]
    both = np.concatenate([corners, shades[:, :, None]], axis=2)
    for lone, mask in ((count == 1, below), (count == 2, ~below)):
        one = mask[lone].argmax(axis=1)
        row = np.arange(len(one))
        a, b, c = (both[lone][row, (one + k) % 3] for k in range(3))
        ab, ac = (a + (position - a[:, axis])[:, None] / (q - a)[:, axis][:, None] * (q - a) for q in (b, c))
        for triangle in ((a, ab, ac),) if mask is below else ((ab, b, c), (ab, c, ac)):
            made = np.stack(triangle, axis=1)
            out.append((made[:, :, :3], made[:, :, 3]))
    return np.concatenate([x for x, _ in out]), np.concatenate([z for _, z in out])


def _pyvista(engine: str) -> Any:
    try:
        import pyvista
    except ImportError:
        if engine == "pyvista":
            raise ImportError('engine: pyvista is an optional extra: pip install "jsmitsm[solid]"') from None
        return None
    return pyvista


def _plotter(pyvista: Any, cloud: Cloud, numbers: np.ndarray, where: dict[int, float], label: str) -> Any:
    """A plotter with the tetrahedra between the particles, cut by planes."""
    cells = simplices(cloud)
    padded = np.concatenate([np.full((len(cells), 1), 4), cells], axis=1).ravel()
    points = np.asarray(cloud.points, float)
    grid = pyvista.UnstructuredGrid(padded, np.full(len(cells), pyvista.CellType.TETRA, np.uint8), points)
    grid.point_data[label] = numbers
    for axis, position in where.items():
        grid = grid.clip(normal=AXES[axis], origin=np.eye(3)[axis] * position)
    plotter = pyvista.Plotter(off_screen=pyvista.OFF_SCREEN or None)
    # VTK's title lies on its bar's numbers without an empty line; its light alone leaves a section in the dark.
    bar = {"title": f"{label}\n", "fmt": "%.3g", "vertical": True, "position_x": 0.9, "position_y": 0.2, "height": 0.6}
    plotter.add_mesh(grid, scalars=label, cmap="viridis", ambient=0.45, diffuse=0.6, scalar_bar_args=bar)
    plotter.show_grid(xtitle="x", ytitle="y", ztitle="z", color="grey", n_xlabels=3, n_ylabels=3, n_zlabels=3)
    plotter.view_isometric()
    plotter.camera.zoom(0.85)  # the bar stands at its side
    return plotter
