"""Pictures of what has a direction: arrows, stream lines, deformed shapes, principal stresses; and of many fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.cloud.triangulation import boundary_facets
from jsmitsm.runtime.errors import explaining, is_whole, listed, short
from jsmitsm.show import drawing
from jsmitsm.show.drawing import COLOURS
from jsmitsm.show.pieces import Piece, clipped, outline, pieces
from jsmitsm.show.solid import LIGHT, bar, faces, furnish, is_plotter, stage, surface
from jsmitsm.solution.solution import Solution

_INK = "0.2"


@explaining
def vectors(sol: Solution, *, of: Callable | None = None, count: int = 20, label: str = "size", engine: str = "auto",
            ax: Any = None) -> Any:  # fmt: skip
    """Arrows of a vector field, in 2D and 3D.

    Parameters
    ----------
    sol : Solution
        The first D fields of a system are drawn, of a single field its gradient.
    of : function, optional
        Another field to draw, of points (M, D) -> (M, D): ``sol.grad``, or a flux made of it.
    count : int
        Arrows along the longest side of the domain; in 3D half as many.
    label : str
        What the colours of arrows in 3D are, with its unit.
    engine : {"auto", "pyvista", "matplotlib"}
        What draws in 3D, as in ``js.plot.solid``.
    ax : Axes, optional
        Where to draw; three-dimensional ones in 3D.

    Returns
    -------
    Axes or pyvista.Plotter
        What it was drawn on.

    Raises
    ------
    ValueError
        In 1D, for a system of fewer than D fields, and for what ``of`` returns in another shape.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> square = js.rectangle((0, 0), (1, 1), (6, 6))
    >>> sides = {side: js.dirichlet(0.0) for side in ("left", "right", "bottom", "top")}
    >>> sol = js.solve(
    ...     js.Problem(lambda u, x: js.laplacian(u)(x) + 1.0, sides), square, order=2
    ... )
    >>> ax = js.plot.vectors(sol, count=8)
    """
    dim = _space(sol, "vectors")
    points = _grid(sol.cloud, count if dim == 2 else max(2, count // 2))[0]
    arrows = _directed(sol, of)(points)
    seen = np.isfinite(arrows).all(axis=1)
    points, arrows = points[seen], arrows[seen]
    longest = np.linalg.norm(arrows, axis=1).max(initial=0.0) or 1.0
    step = np.ptp(np.asarray(sol.cloud.points), axis=0).max() / (count if dim == 2 else max(2, count // 2))
    shafts = arrows * (1.2 * step / longest)
    if dim == 3:
        return _flying(stage(engine, ax), sol.cloud, points, arrows, shafts, label)
    ax = drawing.axes(ax, dim, drawing.page(np.asarray(sol.cloud.points)))
    ax.quiver(*points.T, *shafts.T, angles="xy", scale_units="xy", scale=1, pivot="middle", color=_INK,
              units="dots", width=1.3)  # fmt: skip
    _frame(ax, sol.cloud)
    drawing.dress(ax, dim)
    return ax


def _flying(on: Any, cloud: Cloud, points: np.ndarray, arrows: np.ndarray, shafts: np.ndarray, label: str) -> Any:
    """Arrows in space, coloured by their size, in the glass of the surface."""
    size, tails = np.linalg.norm(arrows, axis=1), points - shafts / 2
    skin = np.asarray(cloud.points, float)[boundary_facets(cloud)[0]]
    if is_plotter(on):
        on.add_mesh(surface(skin), color="grey", opacity=0.08)
        from pyvista import Arrow, PolyData

        dots = PolyData(tails)
        dots.point_data["way"], dots.point_data["length"] = shafts, np.linalg.norm(shafts, axis=1)
        dots.point_data[label] = size
        arrow = Arrow(tip_length=0.35, tip_radius=0.14, shaft_radius=0.05)
        on.add_mesh(dots.glyph(orient="way", scale="length", geom=arrow), scalars=label, cmap="viridis",
                    scalar_bar_args=bar(label), **LIGHT)  # fmt: skip
    else:
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection

        on.add_collection3d(Poly3DCollection(skin, facecolors="0.5", alpha=0.05))
        drawn = on.quiver(*tails.T, *shafts.T, cmap="viridis", linewidth=0.9)
        drawn.set_array(np.tile(size, 3))  # shafts, and both strokes of their heads
        on.figure.colorbar(drawn, ax=on, label=label, shrink=0.7, pad=0.12, ticks=drawing.round_ticks())
    furnish(on)
    return on


@explaining
def streamlines(sol: Solution, *, of: Callable | None = None, density: float = 1.0, ax: Any = None) -> Any:
    """Stream lines of a vector field in 2D.

    Parameters
    ----------
    sol : Solution
        The first two fields of a system are drawn, of a single field its gradient.
    of : function, optional
        Another field to draw, of points (M, 2) -> (M, 2).
    density : float
        How close the lines are; 1 fills the picture with some thirty across.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        What it was drawn on.

    Raises
    ------
    ValueError
        In 1D and in 3D, where ``js.plot.vectors`` has arrows.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> square = js.rectangle((0, 0), (1, 1), (6, 6))
    >>> sides = {
    ...     side: js.dirichlet(lambda x: x[0] * x[1])
    ...     for side in ("left", "right", "bottom", "top")
    ... }
    >>> sol = js.solve(
    ...     js.Problem(lambda u, x: js.laplacian(u)(x), sides), square, order=2
    ... )
    >>> ax = js.plot.streamlines(sol)
    """
    if _space(sol, "streamlines") == 3:
        raise ValueError("sol: stream lines are drawn in two dimensions; js.plot.vectors draws arrows in three")
    points, (x, y) = _grid(sol.cloud, 80)
    flow = _directed(sol, of)(points).reshape(len(y), len(x), 2)
    ax = drawing.axes(ax, 2, drawing.page(np.asarray(sol.cloud.points)))
    drawn = ax.streamplot(x, y, *np.moveaxis(np.ma.masked_invalid(flow), 2, 0), density=density, color=_INK,
                          linewidth=0.8, arrowsize=0.8)  # fmt: skip
    for one in (drawn.lines, drawn.arrows):
        clipped(ax, one, [] if isinstance(sol.cloud, RegionCloud) else outline(sol.cloud))
    _frame(ax, sol.cloud)
    drawing.dress(ax, 2)
    return ax


@explaining
def deformed(sol: Solution, *, scale: float | None = None, colour: Callable | None = None, label: str = "displacement",
             levels: int = 20, engine: str = "auto", ax: Any = None) -> Any:  # fmt: skip
    """The deformed shape of a body, of which the first D fields are displacements, in 2D and 3D.

    Parameters
    ----------
    sol : Solution
        Its first D fields are drawn as displacements.
    scale : float, optional
        By how much they are exaggerated; if not given, so that the largest is a tenth of the body.
    colour : function, optional
        What the colours show, of points (M, D) -> (M,) of the body at rest; the size of the displacement if not given.
    label : str
        What they are.
    levels : int
        About how many contour levels.
    engine : {"auto", "pyvista", "matplotlib"}
        What draws in 3D, as in ``js.plot.solid``.
    ax : Axes, optional
        Where to draw; three-dimensional ones in 3D.

    Returns
    -------
    Axes or pyvista.Plotter
        What it was drawn on.

    Raises
    ------
    ValueError
        In 1D, and for a solution of fewer than D fields.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> square = js.rectangle((0, 0), (1, 1), (6, 6))
    >>> sheared = js.dirichlet(lambda x: jnp.stack([0.2 * x[1], 0.0]))
    >>> sides = {side: sheared for side in ("left", "right", "bottom", "top")}
    >>> pde = lambda u, x: jnp.stack([js.laplacian(u[0])(x), js.laplacian(u[1])(x)])
    >>> ax = js.plot.deformed(
    ...     js.solve(js.Problem(pde, sides, fields=2), square, order=2)
    ... )
    """
    dim, numbers = _space(sol, "deformed"), drawing.real("sol", sol.u)
    if numbers.ndim < 2 or numbers.shape[1] < dim:
        raise ValueError(f"sol: a deformed shape needs {dim} fields, its displacements, this solution has "
                         f"{1 if numbers.ndim < 2 else numbers.shape[1]}")  # fmt: skip
    size = np.ptp(np.asarray(sol.cloud.points), axis=0).max()
    longest = np.linalg.norm(numbers[:, :dim], axis=1).max()
    factor = (0.1 * size / longest if longest > 0 else 1.0) if scale is None else float(scale)

    def anywhere(points: np.ndarray, **side: str) -> np.ndarray:
        return np.asarray(sol(points, blend=True, outside="extrapolate", **side))

    def shade(points: np.ndarray, moved: np.ndarray) -> np.ndarray:
        return np.linalg.norm(moved[:, :dim], axis=1) if colour is None else np.asarray(colour(points), float)

    title = f"displacements times {factor:.3g}"
    if dim == 3:
        on, facets, rest = stage(engine, ax), boundary_facets(sol.cloud)[0], np.asarray(sol.cloud.points, float)
        faces(on, (rest + factor * numbers[:, :3])[facets], shade(rest, numbers)[facets], label)
        if is_plotter(on):
            on.add_mesh(surface(rest[facets]), color="grey", opacity=0.15)
            on.add_text(title, font_size=9, color="black")
        else:
            on.set_title(title, fontsize="medium")
        furnish(on)
        return on
    ax = drawing.axes(ax, dim, drawing.page(np.asarray(sol.cloud.points)))
    shown = pieces(sol.cloud, numbers, anywhere)
    shades = [shade(one.places, one.values) for one in shown]
    bounds = drawing.steps(np.concatenate(shades), levels)
    for one, z in zip(shown, shades):
        ends = one.places[_rim(one.triangles)].transpose(1, 2, 0)
        ax.plot(*_strokes(ends), color="0.6", linewidth=0.8, linestyle="--")
        at = one.places + factor * one.values[:, :2]
        filled = drawing.painted(ax, Piece(at, one.triangles, z, []), bounds, "viridis")
        ax.plot(*_strokes(at[_rim(one.triangles)].transpose(1, 2, 0)), color=_INK, linewidth=0.8)
    drawing.colour_bar(filled, [ax], label)
    ax.set_title(title, fontsize="medium")
    drawing.dress(ax, 2)
    return ax


@explaining
def principal(sol: Solution, stress: Callable, *, count: int = 20, ax: Any = None) -> Any:
    """Principal stresses in 2D: crosses along their directions, tension in orange and compression in blue.

    Parameters
    ----------
    sol : Solution
        Its first two fields are displacements.
    stress : function
        Of the gradient (2, 2) of the displacements at one point, row k that of field k, to the stress (2, 2).
    count : int
        Crosses along the longer side of the domain.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        What it was drawn on.

    Raises
    ------
    ValueError
        In 1D and 3D, for a solution of one field, and for a stress of another shape.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> square = js.rectangle((0, 0), (1, 1), (6, 6))
    >>> sheared = js.dirichlet(lambda x: jnp.stack([0.2 * x[1], 0.0]))
    >>> sides = {side: sheared for side in ("left", "right", "bottom", "top")}
    >>> pde = lambda u, x: jnp.stack([js.laplacian(u[0])(x), js.laplacian(u[1])(x)])
    >>> sol = js.solve(js.Problem(pde, sides, fields=2), square, order=2)
    >>> ax = js.plot.principal(sol, lambda g: (g + g.T) / 2, count=8)
    """
    if _space(sol, "principal") == 3 or np.ndim(sol.u) < 2:
        raise ValueError("sol: principal stresses are drawn for two fields in two dimensions; in three write them out "
                         "with js.files.to_mesh")  # fmt: skip
    points = _grid(sol.cloud, count)[0]
    points = points[np.isfinite(np.asarray(sol(points))).reshape(len(points), -1).all(axis=1)]
    tensor = np.asarray(jax.vmap(stress)(sol.grad(points, outside="extrapolate")[:, :2]))
    if tensor.shape != (len(points), 2, 2):
        raise ValueError(f"stress: expected an array of shape (2, 2) at a point, got {tensor.shape[1:]}")
    sizes, axes_ = np.linalg.eigh(tensor)
    step = np.ptp(np.asarray(sol.cloud.points), axis=0).max() / count
    sizes = sizes * (0.55 * step / max(np.abs(sizes).max(), 1e-300))
    ax = drawing.axes(ax, 2, drawing.page(np.asarray(sol.cloud.points)))
    for k in (0, 1):
        half = axes_[:, :, k] * np.abs(sizes[:, k : k + 1])
        for pulled, tint, name in ((True, COLOURS[1], "tension"), (False, COLOURS[0], "compression")):
            some = (sizes[:, k] > 0) == pulled
            ends = np.stack([points - half, points + half], axis=2)[some].transpose(1, 0, 2)
            ax.plot(*_strokes(ends.transpose(2, 0, 1)), color=tint, linewidth=1.2, label=name if k else None)
    _frame(ax, sol.cloud)
    ax.legend(frameon=False, fontsize="small", loc="upper left", bbox_to_anchor=(1.02, 1.0), borderaxespad=0.0)
    drawing.dress(ax, 2)
    return ax


def _strokes(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pieces from ends (2, 2, M), by end and axis, as two arrays with NaN between them."""
    gap = np.full((2, 1, ends.shape[2]), np.nan)
    x, y = np.concatenate([ends.transpose(1, 0, 2), gap], axis=1).transpose(0, 2, 1).reshape(2, -1)
    return x, y


def _space(sol: Any, name: str) -> int:
    """The dimension of a solution that has directions to draw."""
    if not isinstance(sol, Solution):
        raise ValueError(f"sol: expected a js.Solution, got {type(sol).__name__}")
    sol.refuse_stacked()
    if sol.cloud.dim == 1:
        raise ValueError(f"sol: js.plot.{name} draws in two dimensions or three; js.plot.solution draws lines")
    return sol.cloud.dim


def _grid(cloud: Cloud, count: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Points (M, D) of a lattice over the domain's box, ``count`` along its longest side, and the lattice's axes."""
    if not is_whole(count, 2):
        raise ValueError(f"count: expected a number from 2, got {count!r}")
    points = np.asarray(cloud.points, float)
    lo, hi = points.min(axis=0), points.max(axis=0)
    numbers = np.maximum(2, np.round(count * (hi - lo) / (hi - lo).max()).astype(int))
    axes = [a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(lo, hi, numbers)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, cloud.dim), axes


def _directed(sol: Solution, of: Callable | None) -> Callable[[np.ndarray], np.ndarray]:
    """The vector field to draw, NaN outside of the domain."""
    dim, fields = sol.cloud.dim, 1 if np.ndim(sol.u) == 1 else sol.u.shape[1]
    if of is None and 1 < fields < dim:
        raise ValueError(f"sol: {fields} fields are no vectors in {dim} dimensions; pass of=, a function of points")

    def directed(points: np.ndarray) -> np.ndarray:
        values = np.asarray(sol(points))
        inside = np.isfinite(values).reshape(len(points), -1).all(axis=1)
        if sol.cloud._shape is not None and not isinstance(sol.cloud, RegionCloud):
            inside &= sol.cloud._shape.distance(points)[0] <= 0
        if of is None:
            found = drawing.real("sol", sol.grad(points) if fields == 1 else values[:, :dim])
        else:
            found = drawing.real("of", of(points))
        if found.shape != (len(points), dim):
            raise ValueError(f"of: expected {(len(points), dim)} numbers at {len(points)} points, got {found.shape}")
        return np.where(inside[:, None], found, np.nan)

    return directed


def _frame(ax: Any, cloud: Cloud) -> None:
    """The outline of a domain in 2D."""
    if isinstance(cloud, RegionCloud):
        for name in cloud.regions:
            _frame(ax, cloud.region(name))
        return
    loops = outline(cloud)
    for loop in loops:
        ax.plot(*np.concatenate([loop, loop[:1]]).T, color="0.5", linewidth=0.8)
    if not loops:
        ends = np.asarray(cloud.points)[boundary_facets(cloud)[0]]
        ax.plot(*_strokes(ends.transpose(1, 2, 0)), color="0.5", linewidth=0.8)


def _rim(triangles: np.ndarray) -> np.ndarray:
    """Sides (M, 2) that belong to one triangle only."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    found, count = np.unique(sides, axis=0, return_counts=True)
    return found[count == 1]


def names_of(given: Sequence[str] | None, count: int) -> Sequence[str]:
    """One name for every field."""
    if given is None:
        return [f"u[{k}]" for k in range(count)]
    if isinstance(given, str) or len(names := listed("names", given, f"{count} texts")) != count:
        raise ValueError(f"names: expected {count}, one for every field, got {short(given)}")
    return [str(name) for name in names]
