"""Pictures of clouds, solutions, errors, sparsity, tuning and convergence.

They need matplotlib, ``pip install "jsmitsm[plot]"``, imported when the first of them is drawn.
Every function takes ``ax`` and returns what it drew on, so that pictures can be composed: one axes, or an array of
axes where there are several (three slices in 3D, the panels of a tuning history). Colours are safe for the
colour-blind (Okabe-Ito for categories, viridis and cividis for numbers), categories differ by marker as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.cloud.triangulation import simplices
from jsmitsm.particle.kernels import Kernel
from jsmitsm.show import drawing
from jsmitsm.show.drawing import COLOURS, GREY, MARKERS
from jsmitsm.solution.solution import Solution

__all__ = ["adaptation", "cloud", "convergence", "error", "estimate", "solution", "sparsity", "tuning", "values"]


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
    >>> ax = js.plot.cloud(square, normals=True, support=14, kernel=js.Gaussian(h=square.spacing, d=2.0))
    """
    shown: Cloud = what.cloud if isinstance(what, Solution) else what
    if not isinstance(shown, Cloud):
        raise ValueError(f"what: expected a js.Cloud or a js.Solution, got {type(what).__name__}")
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


def solution(sol: Solution, *, field: int = 0, exact: Any = None, at: Mapping[str, float] | None = None,
             levels: int = 20, colorbar: bool = True, ax: Any = None) -> Any:  # fmt: skip
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
    if not isinstance(sol, Solution):
        raise ValueError(f"sol: expected a js.Solution, got {type(sol).__name__}; plain numbers are for js.plot.values")
    sol.refuse_stacked()
    numbers = drawing.field_of(sol.u, field)

    def anywhere(points, **side):
        return drawing.field_of(sol(points, blend=True, outside="extrapolate", **side), field)

    label = "u" if np.ndim(sol.u) == 1 else f"u[{field}]"
    if sol.cloud.dim > 1:
        return drawing.maps(sol.cloud, numbers, anywhere, at, levels, colorbar, ax, label, log=False)
    ax = drawing.axes(ax, 1)
    lines, heights = [], []
    for part, side in _regions(sol.cloud):
        ends = np.asarray(part.points)[simplices(part), 0]
        lines.append(ends[:, :1] + np.linspace(0.0, 1.0, 17) * (ends[:, 1:] - ends[:, :1]))
        heights.append(np.reshape(anywhere(lines[-1].reshape(-1, 1), **side), lines[-1].shape))
    line, height = np.concatenate(lines), np.concatenate(heights)
    # One NaN after every piece: where the domain has a gap the curve has one.
    ax.plot(drawing.gapped(line), drawing.gapped(height), color=COLOURS[0], label=label)
    ax.plot(np.asarray(sol.cloud.points)[:, 0], numbers, "o", color=COLOURS[0], markersize=4)
    if exact is not None:
        truth = drawing.at_points(exact, line.reshape(-1, 1)).reshape(line.shape)
        ax.plot(drawing.gapped(line), drawing.gapped(truth), "--", color="k", linewidth=1, label="exact")
        ax.legend(frameon=False)
    drawing.labels(ax, "x", label)
    return ax


def _regions(cloud: Cloud) -> list[tuple[Cloud, dict[str, str]]]:
    """A cloud, or those of its regions, and what a solution needs to be told of them."""
    if isinstance(cloud, RegionCloud):
        return [(cloud.region(name), {"region": name}) for name in cloud.regions]
    return [(cloud, {})]


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
    >>> ax = js.plot.error(js.solve(problem, js.interval(0.0, 1.0, 9), order=2), lambda x: x[0] ** 4)
    """
    sol.refuse_stacked()
    truth = drawing.at_points(exact, np.asarray(sol.cloud.points)) if callable(exact) else exact
    truth = drawing.field_of(drawing.real("exact", truth), field)
    if truth.shape != (len(sol.cloud),):
        raise ValueError(f"exact: expected {len(sol.cloud)} numbers, one per particle, got shape {truth.shape}")
    numbers = np.abs(drawing.field_of(sol.u, field) - truth)
    return values(sol.cloud, numbers, log=log, ax=ax, **{"label": "error"} | options)


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
    numbers = np.abs(drawing.field_of(sol.error_estimate(), field))
    return values(sol.cloud, numbers, log=log, ax=ax, **{"label": "estimated error"} | options)


def sparsity(what: Any, *, ax: Any = None) -> Any:
    """Which particles each particle looks at, as a matrix: row i has a dot for every neighbour of particle i.

    Parameters
    ----------
    what : Stencils, Solution, matrix or array
        A matrix of scipy.sparse will do.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        What it was drawn on.

    Examples
    --------
    >>> import jsmitsm as js
    >>> ax = js.plot.sparsity(js.stencils(js.rectangle((0, 0), (1, 1), (6, 6)), size=9))
    """
    if isinstance(what, (Stencils, Solution)):
        index = drawing.neighbours(what)
        rows, columns = np.nonzero(index >= 0)
        columns, shape = index[rows, columns], (len(index), len(index))
        names = ("neighbour", "particle")
    else:
        from scipy.sparse import coo_matrix

        matrix = coo_matrix(what)
        rows, columns, shape = matrix.row, matrix.col, matrix.shape
        names = ("column", "row")
    ax = drawing.axes(ax, 2)
    # More rows than a screen has pixels: one pixel stands for a block, the darker the fuller.
    bins = [-(-n // -(-n // 600)) for n in shape]
    picture = np.histogram2d(rows, columns, bins=bins, range=[(-0.5, n - 0.5) for n in shape])[0]
    extent = (-0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5)
    ax.imshow(picture ** 0.5, cmap="Greys", vmin=0, extent=extent, interpolation="nearest")
    ax.set(xlabel=names[0], ylabel=names[1])
    ax.set_title(f"{shape[0]} rows, {len(rows)} entries, {len(rows) / shape[0]:.1f} a row", fontsize="medium")
    return ax


def tuning(result: Any, *, ax: Any = None) -> Any:
    """The history of a tuning: the objective and every parameter over the steps.

    A parameter with one number per particle is drawn as its median and its range.

    Parameters
    ----------
    result : TuneResult or mapping
        What ``js.tune`` returned, or its ``history``: from ``"objective"`` and the parameters' names to one entry
        per step, or a pytree of such.
    ax : array of Axes, optional
        As many as there are panels.

    Returns
    -------
    array of Axes
        One per panel.

    Raises
    ------
    ValueError
        For a history without ``"objective"``.

    Examples
    --------
    >>> import jsmitsm as js
    >>> axes = js.plot.tuning({"objective": [1e-2, 3e-3, 2e-3], "h": [0.10, 0.09, 0.085], "d": [4.0, 3.9, 3.9]})
    """
    history = getattr(result, "history", result)
    if not isinstance(history, (Mapping, list, tuple)) or not len(history):
        raise ValueError(f"result: expected what js.tune returned or its history, got {type(result).__name__}")
    if not isinstance(history, Mapping):  # one record per step
        history = {name: [step[name] for step in history] for name in history[0]}
    if "objective" not in history:
        raise ValueError(f'history: has {list(history)} but no "objective"; pass what js.tune returned')
    panels = {"objective": np.asarray(history["objective"], dtype=float)}
    for name, track in history.items():
        if name != "objective":
            panels |= drawing.tracks(name, track, len(panels["objective"]))
    axes = drawing.panels(ax, len(panels), (4.8, 1.7), rows=True)
    for k, (one, (name, track)) in enumerate(zip(axes, panels.items())):
        step, flat = np.arange(len(track)), track.reshape(len(track), -1)
        if flat.shape[1] > 1:
            one.fill_between(step, flat.min(axis=1), flat.max(axis=1), color=COLOURS[k % 7], alpha=0.25, linewidth=0)
        one.plot(step, np.median(flat, axis=1), ".-", color=COLOURS[k % 7])
        if name == "objective":
            if (track[np.isfinite(track)] > 0).all():
                one.set_yscale("log")
            best = int(np.nanargmin(track))
            one.plot(best, track[best], "o", color="k", markersize=7, fillstyle="none")
            one.set_title(f"best {track[best]:.3g} at step {best}", loc="right", fontsize="small")
        else:
            one.ticklabel_format(axis="y", useOffset=False)
        one.xaxis.get_major_locator().set_params(integer=True)
        drawing.labels(one, "step" if k == len(panels) - 1 else "", name)
    return axes


def convergence(spacing: Any, errors: Any, *, floor: float = 1e-13, xlabel: str = "spacing", ylabel: str = "error",
                ax: Any = None) -> Any:  # fmt: skip
    """Errors against the spacing on logarithmic axes, the observed order written on every line.

    Parameters
    ----------
    spacing : array_like (M,)
        (M,) distances between particles, in any order.
    errors : array_like (M,) or mapping
        (M,) errors, or a mapping from a name to them for several lines.
    floor : float
        Errors below it are round-off and take no part in the order, which is the slope of the least-squares line
        through the others.
    xlabel, ylabel : str
        Names of the axes.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        What it was drawn on.

    Raises
    ------
    ValueError
        For errors that are not positive, or not as many as there are spacings.

    Examples
    --------
    >>> import jsmitsm as js
    >>> ax = js.plot.convergence([0.1, 0.05, 0.025], {"S, order 4": [1e-4, 6.3e-6, 3.9e-7]})
    >>> [text.get_text() for text in ax.texts]
    ['order 4.00']
    """
    spacing = np.asarray(spacing, dtype=float)
    lines = errors if isinstance(errors, Mapping) else {"": errors}
    ax = drawing.axes(ax, 1)
    ends = []
    for k, (name, values_) in enumerate(lines.items()):
        y = np.asarray(values_, dtype=float)
        if y.shape != spacing.shape or y.ndim != 1 or len(y) < 2 or not (y > 0).all() or not (spacing > 0).all():
            raise ValueError(
                f"errors{f'[{name!r}]' if name else ''}: expected {spacing.shape} positive numbers like spacing and at "
                f"least two of them, got {y}"
            )
        colour, order = COLOURS[k % 7], np.argsort(spacing)
        ax.plot(spacing[order], y[order], marker=MARKERS[k % 8], color=colour, markersize=5, label=name)
        fit = y > floor
        if fit.sum() >= 2 and np.ptp(np.log(spacing[fit])) > 0:
            slope = np.polyfit(np.log(spacing[fit]), np.log(y[fit]), 1)[0]
            ends.append((spacing[order[-1]], y[order[-1]], f"order {slope:.2f}", colour))
    ax.set(xscale="log", yscale="log")
    ax.margins(x=0.12)
    drawing.decades(ax.xaxis)
    drawing.at_ends(ax, ends)
    if any(lines):
        ax.legend(frameon=False, fontsize="small")
    drawing.labels(ax, xlabel, ylabel)
    return ax


def adaptation(found: Any, *, ax: Any = None) -> np.ndarray:
    """What :func:`jsmitsm.adapt` did, in three panels: spacings, the estimated error, and the rounds.

    Spacings are distances to the nearest particle, as colours of the particles in 2D, else against x or, in 3D, against
    the distance from the finest place; a round is a dot with its order.

    ``found``: a :class:`jsmitsm.Adapted`. ``ax``: three axes. Returns them. Raises ValueError for anything else.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 2.0, ends)
    >>> axes = js.plot.adaptation(js.adapt(problem, lambda spacing: js.interval(0.0, 1.0, spacing=spacing), 1e-4))
    """
    if not all(hasattr(found, name) for name in ("solution", "cloud", "history", "tol")):
        raise ValueError(f"found: expected what js.adapt returned, got {type(found).__name__}")
    from scipy.spatial import cKDTree

    shown: Cloud = found.cloud
    axes = drawing.panels(ax, 3, (4.6, 3.8))
    points = np.asarray(shown.points)
    gap = cKDTree(points).query(points, k=2)[0][:, 1]
    error_ = np.abs(np.asarray(found.solution.error_estimate())).reshape(len(points), -1).max(axis=1)
    error_ = np.maximum(error_, drawing.floor(error_))
    if shown.dim == 2:
        scale = {"norm": "log", "s": np.clip(12000.0 / len(points), 1, 25), "linewidths": 0}
        for one, numbers, cmap, name in ((axes[0], gap, "viridis", "spacing"), (axes[1], error_, "cividis", "error")):
            dots = one.scatter(*points.T, c=numbers, cmap=cmap, **scale)
            one.figure.colorbar(dots, ax=one, label="estimated error" if name == "error" else name)
            drawing.dress(one, 2)
    else:
        place = points[:, 0] if shown.dim == 1 else np.linalg.norm(points - points[np.argmin(gap)], axis=1)
        order = np.argsort(place)
        for one, numbers, name in ((axes[0], gap, "spacing"), (axes[1], error_, "estimated error")):
            one.semilogy(place[order], numbers[order], ".", color=COLOURS[1], markersize=3)
            drawing.labels(one, "x" if shown.dim == 1 else "distance from the finest place", name)
    axes[0].set_title(f"{len(points)} particles", fontsize="medium")
    history = found.history
    error_ = np.where(np.isfinite(history["error"]), history["error"], np.nan)
    axes[2].loglog(history["particles"], error_, ".-", color=COLOURS[4], markersize=9)
    axes[2].axhline(found.tol, color="k", linewidth=0.8, linestyle="--")
    for n, e, p in zip(history["particles"], error_, history["order"]):
        axes[2].annotate(str(p), (n, e), xytext=(4, 4), textcoords="offset points", fontsize="small")
    axes[2].set_title("tolerance dashed, orders written", fontsize="medium")
    drawing.decades(axes[2].xaxis)
    drawing.labels(axes[2], "particles", "estimated relative error")
    return axes
