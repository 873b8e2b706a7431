"""Pictures of what is no field: which particles see which, how a search went, how errors fall."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.runtime.errors import explaining, numbers
from jsmitsm.show import drawing
from jsmitsm.show.drawing import COLOURS, MARKERS
from jsmitsm.solution.solution import Solution


@explaining
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

        try:
            matrix = coo_matrix(what)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(
                f"what: expected js.Stencils, a js.Solution or a matrix, got {type(what).__name__}"
            ) from None
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


@explaining
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
    >>> axes = js.plot.tuning(
    ...     {
    ...         "objective": [1e-2, 3e-3, 2e-3],
    ...         "h": [0.10, 0.09, 0.085],
    ...         "d": [4.0, 3.9, 3.9],
    ...     }
    ... )
    """
    history = getattr(result, "history", result)
    if not isinstance(history, (Mapping, list, tuple)) or not len(history):
        raise ValueError(f"result: expected what js.tune returned or its history, got {type(result).__name__}")
    if not isinstance(history, Mapping) and all(isinstance(step, Mapping) for step in history):  # one record per step
        history = {name: [step[name] for step in history] for name in history[0]}
    if not isinstance(history, Mapping) or "objective" not in history:
        raise ValueError(f'history: has {list(history)} but no "objective"; pass what js.tune returned')
    panels = {"objective": numbers("objective", history["objective"])}
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


@explaining
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
    >>> ax = js.plot.convergence(
    ...     [0.1, 0.05, 0.025], {"S, order 4": [1e-4, 6.3e-6, 3.9e-7]}
    ... )
    >>> [text.get_text() for text in ax.texts]
    ['order 4.00']
    """
    spacing = numbers("spacing", spacing)
    lines = errors if isinstance(errors, Mapping) else {"": errors}
    ax = drawing.axes(ax, 1)
    ends = []
    for k, (name, values_) in enumerate(lines.items()):
        y = numbers("errors", values_)
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


@explaining
def adaptation(found: Any, *, ax: Any = None) -> np.ndarray:
    """What ``js.adapt`` did, in three panels: spacings, the estimated error, and the rounds.

    Spacings are distances to the nearest particle, as colours of the particles in 2D, else against x or, in 3D, against
    the distance from the finest place; a round is a dot with its order.

    Parameters
    ----------
    found : Adapted
        What ``js.adapt`` returned.
    ax : sequence of matplotlib axes, optional
        Three of them, to be drawn on.

    Returns
    -------
    numpy.ndarray
        The three axes.

    Raises
    ------
    ValueError
        For what is no ``js.Adapted``.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    >>> problem = js.Problem(lambda u, x: js.laplacian(u)(x) - 2.0, ends)
    >>> axes = js.plot.adaptation(
    ...     js.adapt(
    ...         problem, lambda spacing: js.interval(0.0, 1.0, spacing=spacing), 1e-4
    ...     )
    ... )
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
