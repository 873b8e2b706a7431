"""Pictures of clouds, solutions, vectors, errors, sparsity, tuning and convergence.

They need matplotlib, ``pip install "jsmitsm[plot]"``, imported when the first of them is drawn.
Every function takes ``ax`` and returns what it drew on, so that pictures can be composed: one axes, or an array of
axes where there are several (three slices in 3D, the panels of a tuning history). Colours are safe for the
colour-blind (Okabe-Ito for categories, viridis and cividis for numbers), categories differ by marker as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.cloud.triangulation import simplices
from jsmitsm.particle.kernels import Kernel
from jsmitsm.runtime.errors import explaining, refuse_no_switch, short
from jsmitsm.show import drawing
from jsmitsm.show.drawing import COLOURS, GREY, MARKERS
from jsmitsm.show.histories import adaptation, convergence, sparsity, tuning
from jsmitsm.show.series import animate
from jsmitsm.show.solid import solid, solids
from jsmitsm.show.vectors import deformed, names_of, principal, streamlines, vectors
from jsmitsm.solution.solution import Solution

__all__ = ["adaptation", "animate", "cloud", "convergence", "deformed", "error", "estimate", "fields", "principal",
           "solid", "solution", "sparsity", "streamlines", "tuning", "values", "vectors"]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


@explaining
def cloud(what: Cloud | Solution, *, normals: bool = False, support: int | None = None, kernel: Kernel | None = None,
          stencils: Stencils | None = None, legend: bool = True, ax: Any = None) -> Any:  # fmt: skip
    """The particles of a cloud, coloured by group; 1D, 2D or 3D.

    Parameters
    ----------
    what : Cloud or Solution
        A ``js.Cloud`` or a ``js.Solution``, whose cloud is taken.
    normals : bool
        Draw the boundary's normals.
    support : int, optional
        A particle whose support is shown: its neighbours are ringed, and with ``kernel`` the ball |x - x_i| <= d h
        is drawn.
    kernel, stencils : Kernel, Stencils, optional
        Where the support comes from; a Solution brings its own neighbours.
    legend : bool
        Name the groups and count their particles.
    ax : Axes, optional
        Axes to draw on; in 3D they need ``projection="3d"``.

    Returns
    -------
    Axes
        What it was drawn on.

    Raises
    ------
    ValueError
        For a particle that does not exist, or a support without kernel, stencils or Solution.

    Examples
    --------
    >>> import jsmitsm as js
    >>> square = js.rectangle((0, 0), (1, 1), (6, 6))
    >>> ax = js.plot.cloud(
    ...     square,
    ...     normals=True,
    ...     support=14,
    ...     kernel=js.Gaussian(h=square.spacing, d=2.0),
    ... )
    """
    shown: Cloud = what.cloud if isinstance(what, Solution) else what
    if not isinstance(shown, Cloud):
        raise ValueError(f"what: expected a js.Cloud or a js.Solution, got {type(what).__name__}")
    refuse_no_switch("normals", normals)
    if kernel is not None and not isinstance(kernel, Kernel):
        raise ValueError(f"kernel: expected a kernel such as js.SuperGaussian(h, d), got {short(kernel)}")
    ax = drawing.axes(ax, shown.dim, drawing.page(np.asarray(shown.points)))
    place = drawing.padded(np.asarray(shown.points), shown.dim)
    size = np.clip(6000.0 / len(shown), 3 if shown.dim < 3 else 8, 40)
    colour = 0
    for name, index in shown.groups.items():
        inside = name == INTERIOR
        style: dict[str, Any] = {"label": f"{name} ({len(index)})", "linewidths": 0}
        if inside:
            style |= {"c": GREY, "marker": "o", "s": 0.6 * size, "zorder": 2}
        else:
            style |= {"c": COLOURS[colour % 7], "marker": MARKERS[colour % 8], "s": size, "zorder": 3}
        if len(index):
            ax.scatter(*place[index].T, **style)
        colour += not inside
    if normals:
        drawing.draw_normals(ax, shown, place)
    if support is not None:
        found = what if stencils is None and isinstance(what, Solution) else stencils
        drawing.draw_support(ax, shown, place, support, kernel, found, size)
    drawing.dress(ax, shown.dim)
    if legend:
        outside = {"bbox_to_anchor": (1.08 if shown.dim == 3 else 1.02, 1.0), "borderaxespad": 0.0}
        handles = ax.legend(loc="upper left", frameon=False, fontsize="small", **outside).legend_handles
        for handle in handles:
            handle.set_sizes([30])
    return ax


@explaining
def solution(sol: Solution, *, field: int = 0, exact: Any = None, at: Mapping[str, float] | None = None,
             levels: int = 20, colorbar: bool = True, label: str | None = None, ax: Any = None) -> Any:  # fmt: skip
    """A solution: a curve in 1D, filled contours over the true shape in 2D, slices in 3D.

    Between the particles the local polynomials are drawn, not straight lines.

    Parameters
    ----------
    sol : Solution
        A ``js.Solution``.
    field : int
        The field of a system.
    exact : function, optional
        1D only: the exact solution to draw beside it, a function of one point x (1,).
    at : mapping, optional
        3D only: positions of the slices by axis, ``{"z": 0.5}``; the middle of every axis if not given.
    levels : int
        About how many contour levels.
    colorbar : bool
        Draw one, for 2D and 3D.
    label : str, optional
        What is drawn, with its unit, ``"temperature (K)"``; ``u`` or ``u[k]`` if not given.
    ax : Axes or array of Axes, optional
        Axes; in 3D one for every slice.

    Returns
    -------
    Axes or array of Axes
        In 3D an array, one per slice.

    Raises
    ------
    ValueError
        For a field, a slice or a number of axes that does not fit.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) + 1.0, ends)
    >>> ax = js.plot.solution(js.solve(problem, js.interval(0.0, 1.0, 9)))
    """
    _of(sol).refuse_stacked()
    numbers = drawing.field_of(sol.u, field)

    def anywhere(points, **side):
        return drawing.field_of(sol(points, blend=True, outside="extrapolate", **side), field)

    name = drawing.name_of(sol, field, label)
    if sol.cloud.dim > 1:
        return drawing.maps(sol.cloud, numbers, anywhere, at, levels, colorbar, ax, name, log=False)
    ax = drawing.axes(ax, 1)
    lines, heights = [], []
    for part, side in _regions(sol.cloud):
        ends = np.asarray(part.points)[simplices(part), 0]
        lines.append(ends[:, :1] + np.linspace(0.0, 1.0, 17) * (ends[:, 1:] - ends[:, :1]))
        heights.append(np.reshape(anywhere(lines[-1].reshape(-1, 1), **side), lines[-1].shape))
    line, height = np.concatenate(lines), np.concatenate(heights)
    # One NaN after every piece: where the domain has a gap the curve has one.
    ax.plot(drawing.gapped(line), drawing.gapped(height), color=COLOURS[0], label=name)
    ax.plot(np.asarray(sol.cloud.points)[:, 0], numbers, "o", color=COLOURS[0], markersize=4)
    if exact is not None:
        truth = drawing.at_points(exact, line.reshape(-1, 1)).reshape(line.shape)
        ax.plot(drawing.gapped(line), drawing.gapped(truth), "--", color="k", linewidth=1, label="exact")
        ax.legend(frameon=False)
    drawing.labels(ax, "x", name)
    return ax


@explaining
def fields(sol: Solution, *, names: Sequence[str] | None = None, ax: Any = None, **options: Any) -> Any:
    """Every field of a system, side by side.

    Parameters
    ----------
    sol : Solution
        Of a system.
    names : sequence of str, optional
        One for every field, with its unit; ``u[0]``, ``u[1]``, ... if not given.
    ax : array of Axes, optional
        As many as there are panels.
    **options : optional
        As in ``js.plot.solution``; in 3D ``cut`` and ``engine`` as in ``js.plot.solid``, which then draws the fields.

    Returns
    -------
    array of Axes or pyvista.Plotter
        One a field; in 3D a row of slices for each, or with ``cut`` or ``engine`` a solid.

    Raises
    ------
    ValueError
        For another number of names or axes than there are fields.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> pde = lambda u, x: jnp.stack(
    ...     [js.laplacian(u[0])(x) - u[1](x), js.laplacian(u[1])(x) - 1.0]
    ... )
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> beam = js.solve(js.Problem(pde, ends, fields=2), js.interval(0.0, 1.0, 9))
    >>> axes = js.plot.fields(beam, names=["deflection", "moment"])
    """
    _of(sol).refuse_stacked()
    count = 1 if np.ndim(sol.u) == 1 else sol.u.shape[1]
    titles = names_of(names, count)
    if sol.cloud.dim == 3 and ("cut" in options or "engine" in options):
        return solids(sol, titles, ax=ax, **options)
    if sol.cloud.dim == 3:
        slices = 3 if options.get("at") is None else len(options["at"])
        axes = drawing.rows_of(ax, count, slices, (3.6, 3.4))
    else:
        width, height = drawing.page(np.asarray(sol.cloud.points)) if sol.cloud.dim == 2 else (4.6, 3.4)
        axes = drawing.panels(ax, count, (width, height))
    for k, (one, title) in enumerate(zip(axes, titles)):
        solution(sol, field=k, ax=one, label=title, **options)
        if sol.cloud.dim < 3:
            one.set_title(title, fontsize="medium")
        else:
            one[0].set_title(f"{title}, {one[0].get_title()}", fontsize="medium")
    return axes


def _of(sol: Any) -> Solution:
    if not isinstance(sol, Solution):
        raise ValueError(f"sol: expected a js.Solution, got {type(sol).__name__}; plain numbers are for js.plot.values")
    return sol


def _regions(cloud: Cloud) -> list[tuple[Cloud, dict[str, str]]]:
    """A cloud, or those of its regions, and what a solution needs to be told of them."""
    if isinstance(cloud, RegionCloud):
        return [(cloud.region(name), {"region": name}) for name in cloud.regions]
    return [(cloud, {})]


@explaining
def values(cloud: Cloud, numbers: Any, *, log: bool = False, label: str = "", at: Mapping[str, float] | None = None,
           levels: int = 20, colorbar: bool = True, ax: Any = None) -> Any:  # fmt: skip
    """Any numbers at the particles as a map.

    Parameters
    ----------
    cloud : Cloud
        The particles.
    numbers : array_like (N,)
        One for each, finite.
    log : bool
        A logarithmic scale.
    label : str
        What the numbers are.
    at, levels, colorbar, ax : optional
        As in ``js.plot.solution``.

    Returns
    -------
    Axes or array of Axes
        In 3D an array, one per slice.

    Raises
    ------
    ValueError
        Unless ``numbers`` are (N,) and finite.

    Examples
    --------
    >>> import jsmitsm as js
    >>> square = js.rectangle((0, 0), (1, 1), (6, 6))
    >>> ax = js.plot.values(square, square.points[:, 0] ** 2, label="x squared")
    """
    if not isinstance(cloud, Cloud):
        raise ValueError(f"cloud: expected a js.Cloud, got {type(cloud).__name__}")
    refuse_no_switch("log", log)
    numbers = drawing.real("numbers", numbers)
    if numbers.shape != (len(cloud),):
        raise ValueError(f"numbers: expected shape ({len(cloud)},), one per particle, got {numbers.shape}")
    if not np.isfinite(numbers).all():
        raise ValueError(f"numbers: NaN or infinite at {int((~np.isfinite(numbers)).sum())} particles; set them first")
    if cloud.dim > 1:
        return drawing.maps(cloud, numbers, None, at, levels, colorbar, ax, label, log)
    ax = drawing.axes(ax, 1)
    shown = np.maximum(numbers, drawing.floor(numbers)) if log else numbers
    for ids in cloud.regions.values() if isinstance(cloud, RegionCloud) else (np.arange(len(cloud)),):
        order = ids[np.argsort(np.asarray(cloud.points)[ids, 0])]
        ax.plot(np.asarray(cloud.points)[order, 0], shown[order], "o-", color=COLOURS[1], markersize=4, linewidth=1)
    if log:
        ax.set_yscale("log")
    drawing.labels(ax, "x", label)
    return ax


@explaining
def error(sol: Solution, exact: Any, *, field: int = 0, log: bool = True, ax: Any = None, **options: Any) -> Any:
    """The error |u - exact| at the particles.

    Parameters
    ----------
    sol : Solution
        Whose error.
    exact : array_like (N,) or function
        The exact values, or a function of one point x (D,).
    field : int
        The field of a system.
    log, ax, **options : optional
        As in ``js.plot.values``.

    Returns
    -------
    Axes or array of Axes
        In 3D an array, one per slice.

    Raises
    ------
    ValueError
        For an exact solution of another size.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 12 * x[0] ** 2,
    ...                      {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)})
    >>> ax = js.plot.error(
    ...     js.solve(problem, js.interval(0.0, 1.0, 9), order=2), lambda x: x[0] ** 4
    ... )
    """
    _of(sol).refuse_stacked()
    truth = drawing.at_points(exact, np.asarray(sol.cloud.points)) if callable(exact) else exact
    truth = drawing.real("exact", truth)
    truth = truth if truth.ndim < 2 else drawing.field_of(truth, field)
    if truth.shape != (len(sol.cloud),):
        raise ValueError(f"exact: expected {len(sol.cloud)} numbers, one per particle, got shape {truth.shape}")
    numbers = np.abs(drawing.field_of(sol.u, field) - truth)
    return values(sol.cloud, numbers, log=log, ax=ax, **{"label": "error"} | options)


@explaining
def estimate(sol: Solution, *, field: int = 0, log: bool = True, ax: Any = None, **options: Any) -> Any:
    """The estimated error at the particles, ``js.Solution.error_estimate``, as a map.

    Parameters
    ----------
    sol : Solution
        Whose error.
    field : int
        The field of a system.
    log, ax, **options : optional
        As in ``js.plot.values``.

    Returns
    -------
    Axes or array of Axes
        In 3D an array, one per slice.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 12 * x[0] ** 2,
    ...                      {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)})
    >>> ax = js.plot.estimate(js.solve(problem, js.interval(0.0, 1.0, 9), order=2))
    """
    numbers = np.abs(drawing.field_of(_of(sol).error_estimate(), field))
    return values(sol.cloud, numbers, log=log, ax=ax, **{"label": "estimated error"} | options)
