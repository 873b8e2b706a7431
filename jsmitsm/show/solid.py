"""Solids: their surface in colours, opened by a cut. By pyvista where it is installed, else by matplotlib.

What is drawn are triangles with values at their corners, the same for both. A stage is what they are drawn on:
matplotlib's axes, or a plotter of pyvista's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jsmitsm.cloud.triangulation import boundary_facets
from jsmitsm.runtime.errors import explaining, is_one_of
from jsmitsm.show import drawing
from jsmitsm.show.pieces import pieces
from jsmitsm.solution.solution import Solution

_ENGINES = ("auto", "pyvista", "matplotlib")


@explaining
def solid(sol: Solution, *, field: int = 0, cut: Mapping[str, float] | None = None, label: str | None = None,
          engine: str = "auto", ax: Any = None) -> Any:  # fmt: skip
    """The surface of a solid, coloured by the solution, opened by cuts.

    Parameters
    ----------
    sol : Solution
        In 3D.
    field : int
        The field of a system.
    cut : mapping, optional
        From an axis to a position, ``{"x": 0.0}``: what lies beyond is taken away, and the section shows.
    label : str, optional
        What the colours are, with its unit, ``"temperature (K)"``; ``u`` or ``u[k]`` if not given.
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
    >>> sides = {
    ...     side: js.dirichlet(lambda x: x[0] * x[1])
    ...     for side in box.groups
    ...     if side != "interior"
    ... }
    >>> sol = js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), sides), box, order=2)
    >>> ax = js.plot.solid(sol, cut={"x": 0.5}, engine="matplotlib")
    """
    if not isinstance(sol, Solution):
        raise ValueError(f"sol: expected a js.Solution, got {type(sol).__name__}")
    if sol.cloud.dim != 3:
        raise ValueError(f"sol: a solid has three dimensions, this solution {sol.cloud.dim}; take js.plot.solution")
    sol.refuse_stacked()
    on = stage(engine, ax)
    _opened(on, sol, field, cut, drawing.name_of(sol, field, label))
    return on


def solids(sol: Solution, titles: Sequence[str], cut: Any = None, engine: str = "auto", ax: Any = None) -> Any:
    """Every field of a solid in a panel of its own: one plotter, or an array of axes."""
    made = None if ax is not None else _pyvista(engine)
    if made is not None:
        plotter = _plotter(made, shape=(1, len(titles)), window_size=(640 * len(titles), 640))
        for k, title in enumerate(titles):
            plotter.subplot(0, k)
            _opened(plotter, sol, k, cut, title)
        return plotter
    axes = drawing.panels(ax, len(titles), (6.0, 4.8), solid=True)
    for k, (one, title) in enumerate(zip(axes, titles)):
        _opened(drawing.axes(one, 3), sol, k, cut, title)
    return axes


def stage(engine: str, ax: Any = None) -> Any:
    """What a solid is drawn on: the axes given, a plotter, or new axes."""
    made = _pyvista(engine) if ax is None else None
    return drawing.axes(ax, 3, (6.0, 4.8)) if made is None else _plotter(made)


def _pyvista(engine: str) -> Any:
    """pyvista, or None where it is not asked for or not there."""
    if not is_one_of(engine, _ENGINES):
        raise ValueError(f"engine: expected one of {', '.join(map(repr, _ENGINES))}, got {engine!r}")
    if engine == "matplotlib":
        return None
    try:
        import pyvista
    except ImportError:
        if engine == "pyvista":
            raise ImportError('engine: pyvista is an optional extra: pip install "jsmitsm[solid]"') from None
        return None
    return pyvista


def _plotter(pyvista: Any, **panels: Any) -> Any:
    return pyvista.Plotter(off_screen=pyvista.OFF_SCREEN or None, **panels)


def is_plotter(on: Any) -> bool:
    """Whether a stage is pyvista's."""
    return hasattr(on, "add_mesh")


def _opened(on: Any, sol: Solution, field: int, cut: Mapping[str, float] | None, label: str) -> None:
    """The surface of a solid and its sections, on a stage."""
    numbers = drawing.field_of(sol.u, field)
    where = {} if cut is None else dict(drawing.places(sol.cloud, cut))

    def anywhere(points: np.ndarray, **side: str) -> np.ndarray:
        return drawing.field_of(sol(points, blend=True, outside="extrapolate", **side), field)

    facets = boundary_facets(sol.cloud)[0]
    corners, shades = np.asarray(sol.cloud.points, float)[facets], numbers[facets]
    for axis, position in where.items():
        corners, shades = _kept(corners, shades, axis, position)
    for axis, position in where.items():
        for one in pieces(sol.cloud, numbers, anywhere, axis, position, outlined=False):
            section = np.insert(one.places, axis, position, axis=1)[one.triangles], one.values[one.triangles]
            for other, limit in where.items():
                section = section if other == axis else _kept(*section, other, limit)
            corners, shades = (np.concatenate(both) for both in zip((corners, shades), section))
    faces(on, corners, shades, label)
    if not is_plotter(on):
        turned = {(0,): -30, (1,): 60, (0, 1): 45}.get(tuple(sorted({*where} - {2})), -60)
        on.view_init(40 if 2 in where else 28, turned)
    furnish(on)


def furnish(on: Any) -> None:
    """Names of the axes, and a view from a corner."""
    if not is_plotter(on):
        drawing.dress(on, 3)
        return
    on.show_grid(xtitle="x", ytitle="y", ztitle="z", color="grey", n_xlabels=3, n_ylabels=3, n_zlabels=3)
    on.view_isometric()
    on.camera.zoom(0.75)  # the bar lies below


def faces(on: Any, corners: np.ndarray, shades: np.ndarray, label: str) -> None:
    """Triangles (T, 3, 3) on a stage, coloured by numbers (T, 3) at their corners, with a colour bar."""
    if not is_plotter(on):
        _painted(on, corners, shades.mean(axis=1), label)
        return
    body = surface(corners)
    body.point_data[label] = shades.ravel()
    on.add_mesh(body, scalars=label, cmap="viridis", scalar_bar_args=bar(label), **LIGHT)


# VTK's own light leaves a section in the dark.
LIGHT = {"ambient": 0.45, "diffuse": 0.6}


def bar(label: str) -> dict[str, Any]:
    """How pyvista draws a colour bar: lying, where a long name with its unit has room, an empty line below it."""
    return {"title": f"{label}\n", "fmt": "%.3g", "vertical": False, "position_x": 0.2, "position_y": 0.02,
            "width": 0.6, "height": 0.09, "title_font_size": 16, "label_font_size": 14}  # fmt: skip


def surface(corners: np.ndarray) -> Any:
    """Triangles (T, 3, 3) as pyvista's mesh, with every corner for itself."""
    import pyvista

    faces: Any = np.arange(3 * len(corners)).reshape(-1, 3)
    return pyvista.PolyData.from_regular_faces(corners.reshape(-1, 3), faces)


def _painted(ax: Any, corners: np.ndarray, shades: np.ndarray, label: str) -> None:
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
