"""What the pictures of ``js.plot`` are made of: axes, colours, filled contours over a cloud's shape."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import Stencils, within
from jsmitsm.particle.kernels import Kernel
from jsmitsm.runtime.errors import IN_FUNCTIONS, in_words, is_number, is_whole, refuse_no_switch, short
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.show.pieces import AXES, Piece, clipped, pieces
from jsmitsm.solution.solution import Solution

# Okabe and Ito's palette, without its yellow, which is too light for dots on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = "os^Dv<>P"
GREY = "0.62"
# Domains so many times as long as high are low: their colour bar lies below them.
LOW = 2.5


def pyplot() -> Any:
    """matplotlib.pyplot, imported when the first picture is asked for."""
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        raise ImportError('js.plot needs matplotlib, an optional extra: pip install "jsmitsm[plot]"') from None
    return plt


def axes(given: Any, dim: int, size: tuple[float, float] = (5.6, 4.2)) -> Any:
    """The given axes, or those of a new figure; three-dimensional ones for dim 3."""
    if given is None:
        projection = {"projection": "3d"} if dim == 3 else {}
        return pyplot().subplots(figsize=size, layout="constrained", subplot_kw=projection)[1]
    if isinstance(given, (list, tuple, np.ndarray)):
        raise ValueError(f"ax: one axes is needed, {np.size(given)} came; pass one of them")
    _check_axes(given)
    if dim == 3 and not hasattr(given, "get_zlim"):
        raise ValueError('ax: three-dimensional axes are needed; make them with subplot_kw={"projection": "3d"}')
    return given


def _check_axes(given: Any) -> None:
    if not hasattr(given, "set_xlabel"):
        raise ValueError(f"ax: expected axes of matplotlib, as plt.subplots() makes them, got {type(given).__name__}")


def real(name: str, numbers: Any) -> np.ndarray:
    """Numbers as an array of floats, of a size that the arithmetic of a picture can bear."""
    if is_traced(numbers):
        raise ValueError(f"{name}: is traced by a JAX transform; draw outside of it")
    array = np.asarray(numbers)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name}: expected real numbers, got {array.dtype}")
    if np.nanmax(np.abs(array), initial=0.0) > 1e150 and np.isfinite(array).all():
        raise ValueError(
            f"{name}: numbers of size {np.abs(array).max():.0e} cannot be drawn; use another unit, or log10"
        )
    return array.astype(float)


def panels(given: Any, count: int, size: tuple[float, float], rows: bool = False, solid: bool = False) -> np.ndarray:
    """An array of ``count`` axes: the given ones, or a row or column in a new figure, three-dimensional if asked."""
    if given is not None:
        if np.size(given) != count:
            raise ValueError(f"ax: this picture has {count} panel(s), {np.size(given)} axes came; pass {count}")
        for one in np.atleast_1d(np.asarray(given, dtype=object)).ravel():
            _check_axes(one)
        return np.atleast_1d(np.asarray(given, dtype=object)).ravel()
    shape, both = ((count, 1), (size[0], size[1] * count)) if rows else ((1, count), (size[0] * count, size[1]))
    kind = {"projection": "3d"} if solid else {}
    more: dict[str, Any] = {"layout": "constrained", "squeeze": False, "sharex": rows, "subplot_kw": kind}
    return pyplot().subplots(*shape, figsize=both, **more)[1].ravel()


def rows_of(given: Any, count: int, wide: int, size: tuple[float, float]) -> np.ndarray:
    """Axes (count, wide): the given ones, or those of a new figure."""
    if given is not None:
        return panels(given, count * wide, size).reshape(count, wide)
    both = (size[0] * wide, size[1] * count)
    return pyplot().subplots(count, wide, figsize=both, layout="constrained", squeeze=False)[1]


def padded(points: np.ndarray, dim: int) -> np.ndarray:
    """Points of a line get a second coordinate to be drawn at."""
    return np.concatenate([points, np.zeros((len(points), 1))], axis=1) if dim == 1 else points


def dress(ax: Any, dim: int) -> None:
    """Equal scales and names of the axes."""
    if dim == 1:
        ax.set(yticks=[], xlabel="x")
        ax.spines[["left", "right", "top"]].set_visible(False)
        return
    labels(ax, *AXES[:2])
    if dim == 2:
        ax.set_aspect("equal")
        return
    ax.set_zlabel("z")
    ax.locator_params(nbins=5)  # more would run into one another in perspective
    for axis in (ax.xaxis, ax.yaxis):
        axis.labelpad = 9  # beyond the numbers, which lie aslant
    ax.zaxis.labelpad = 2
    ax.set_box_aspect(np.ptp([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()], axis=1), zoom=0.75)  # room for the names


def labels(ax: Any, x: str, y: str) -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    if not hasattr(ax, "get_zlim"):
        ax.spines[["right", "top"]].set_visible(False)


def gapped(pieces: np.ndarray) -> np.ndarray:
    """Pieces (M, L) of a curve as one array; NaN wherever one does not start where another ends."""
    return np.concatenate([pieces, np.full((len(pieces), 1), np.nan)], axis=1).ravel()


def field_of(numbers: Any, field: int) -> np.ndarray:
    """One field (N,) of values (N,) or (N, F)."""
    array = real("numbers", numbers)
    fields = 1 if array.ndim < 2 else array.shape[1]
    if not is_whole(field, 0, fields - 1):
        has = "the one field 0" if fields == 1 else f"fields 0 to {fields - 1}"
        raise ValueError(f"field: {short(field)}, but the solution has {has}")
    return array if array.ndim < 2 else array[:, field]


def name_of(sol: Solution, field: int, label: str | None = None) -> str:
    """What a field is called: as the user says, else as it is written."""
    return label or ("u" if np.ndim(sol.u) == 1 else f"u[{field}]")


def at_points(function: Callable, points: np.ndarray) -> np.ndarray:
    """A function of one point, written in jax.numpy or in numpy, at all of them."""
    if not callable(function):
        raise ValueError(f"exact: expected a function of one point x, got {short(function)}")
    try:
        try:
            return np.asarray(jax.vmap(function)(points), dtype=float)
        except jax.errors.JAXTypeError:
            return np.array([function(x) for x in points], dtype=float)
    except IN_FUNCTIONS as error:
        raise ValueError(
            f"exact: expected a function of one point x that returns a number, this one fails: {in_words(error)}"
        ) from error


def floor(numbers: np.ndarray) -> float:
    """Where a logarithmic scale ends: round-off at held particles must not stretch it."""
    positive = numbers[numbers > 0]
    if not len(positive):
        return 1e-16
    return float(max(np.median(positive) * 1e-2, positive.max() * 1e-8, positive.min()))


def tracks(name: str, values: Any, steps: int) -> dict[str, np.ndarray]:
    """The arrays of one entry of a history, with one row per step, by their names."""
    if isinstance(values, list):  # plain numbers, one per step, not a tree of them
        values = np.asarray(values, dtype=float)
    found: dict[str, np.ndarray] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(values)[0]:
        array = np.asarray(leaf, dtype=float)
        if array.ndim and len(array) == steps:
            found[name + jax.tree_util.keystr(path)] = array
    return found


def neighbours(what: Stencils | Solution) -> np.ndarray:
    """Padded neighbours (N, w) of stencils, or those that a solution was made with."""
    if isinstance(what, Stencils):
        return np.asarray(what.indices)
    fit = getattr(what, "_fit", None)
    if fit is None:
        raise ValueError("sol: a pickled solution has lost its neighbours; pass js.stencils(cloud, ...) instead")
    return np.asarray(fit.neighbours)


def draw_normals(ax: Any, cloud: Cloud, place: np.ndarray) -> None:
    if cloud.normals is None:
        raise ValueError("normals: this cloud has none; give them to js.Cloud or draw with normals=False")
    rim = cloud.boundary
    length = 0.06 * np.ptp(place, axis=0).max()
    arrows = padded(np.asarray(cloud.normals)[rim], cloud.dim) * length
    if cloud.dim == 3:
        ax.quiver(*place[rim].T, *arrows.T, color="0.3", linewidth=0.6)
    else:
        ax.quiver(*place[rim].T, *arrows.T, angles="xy", scale_units="xy", scale=1, color="0.3", units="inches",
                  width=0.012, zorder=1)  # fmt: skip
        ax.update_datalim(place[rim] + arrows)
        ax.autoscale_view()


def draw_support(ax: Any, cloud: Cloud, place: np.ndarray, particle: int, kernel: Any, found: Any,
                 size: float) -> None:  # fmt: skip
    """One particle, its neighbours ringed, and the ball of its kernel; ``size`` is that of the dots."""
    if not is_whole(particle, 0, len(cloud) - 1):
        raise ValueError(f"support: particle {particle!r}, but the cloud has particles 0 to {len(cloud) - 1}")
    if kernel is None and found is None:
        raise ValueError("support: pass kernel=..., stencils=... or a Solution in place of the cloud")
    if kernel is not None and not isinstance(kernel, Kernel):
        raise ValueError(f"kernel: expected a kernel such as js.SuperGaussian(h, d), got {kernel!r}")
    radius = None if kernel is None else float(kernel.d * kernel.at(particle).h)
    if found is None:
        found = within(np.asarray(cloud.points), radius, np.array([particle]))
        row = np.asarray(found.indices)[0]
    else:
        row = neighbours(found)[particle]
    row = row[row >= 0]
    ring = {"facecolors": "none", "edgecolors": "k", "linewidths": 0.9, "s": np.clip(3 * size, 15, 60), "zorder": 4}
    ax.scatter(*place[row].T, label=f"support of {particle} ({len(row)})", **ring)
    star = {"c": "k", "marker": "*", "s": np.clip(6 * size, 45, 110), "zorder": 5, "linewidths": 0}
    ax.scatter(*place[particle : particle + 1].T, **star)
    if radius is None:
        return
    if cloud.dim == 1:
        ax.axvspan(place[particle, 0] - radius, place[particle, 0] + radius, color=COLOURS[5], alpha=0.2, linewidth=0)
    elif cloud.dim == 2:
        from matplotlib.patches import Circle

        ax.add_patch(Circle(place[particle], radius, facecolor=COLOURS[5], alpha=0.35, edgecolor="none", zorder=0))
    else:
        u, v = np.mgrid[0 : 2 * np.pi : 25j, 0 : np.pi : 13j]  # type: ignore[misc]
        sphere = radius * np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
        ax.plot_wireframe(*(sphere + place[particle][:, None, None]), color=COLOURS[5], linewidth=0.4)


def decades(axis: Any) -> None:
    """Ticks at 1, 2 and 5 of every power of ten, in plain numbers where there are few powers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def at_ends(ax: Any, ends: list[tuple[float, float, str, str]]) -> None:
    """Words (x, y, words, colour) to the right of the lines' ends, pushed apart where lines end together."""
    points = [ax.transData.transform((x, y))[1] * 72.0 / ax.figure.dpi for x, y, *_ in ends]
    placed, last = dict[int, float](), -np.inf
    for k in np.argsort(points, kind="stable"):
        placed[k] = last = max(points[k], last + 11.0)
    for k, (x, y, words, colour) in enumerate(ends):
        ax.annotate(words, (x, y), (7, placed[k] - points[k]), textcoords="offset points", va="center", color=colour,
                    annotation_clip=False)  # fmt: skip


def maps(cloud: Cloud, numbers: np.ndarray, anywhere: Callable | None, at: Mapping[str, float] | None, levels: int,
         colorbar: bool, given: Any, label: str, log: bool) -> Any:  # fmt: skip
    """Filled contours of a 2D cloud, or of slices through a 3D one, all on one scale."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    if not is_whole(levels, 0, 10_000):
        raise ValueError(f"levels: expected a number of contour levels, such as 20, got {short(levels)}")
    refuse_no_switch("colorbar", colorbar)
    if not np.isfinite(numbers).all():
        raise ValueError("sol: has values that are not finite, and did not converge; see sol.diagnose()")

    shown = [pieces(cloud, numbers, anywhere, *where) for where in places(cloud, at)]
    if log:
        low = floor(np.concatenate([one.values for some in shown for one in some]))
        shown = [[one._replace(values=np.log10(np.maximum(one.values, low))) for one in some] for some in shown]
    bounds = steps(np.concatenate([one.values for some in shown for one in some]), levels)
    many = cloud.dim == 3
    size = (3.6, 3.4) if many else page(np.asarray(cloud.points))
    drawn = panels(given, len(shown), size)
    for ax, some, (axis, position) in zip(drawn, shown, places(cloud, at)):
        for one in some:
            filled = painted(ax, one, bounds, "cividis" if log else "viridis")
        ax.set_aspect("equal")
        names = [n for k, n in enumerate(AXES[: cloud.dim]) if k != axis]
        ax.set(xlabel=names[0], ylabel=names[1])
        if many:
            ax.set_title(f"{AXES[axis]} = {position:.4g}", fontsize="medium")
    if colorbar:
        bar = colour_bar(filled, drawn, label)
        if log:
            whole = bool(np.floor(bounds[-1]) - np.ceil(bounds[0]) >= 1)
            bar.long_axis.set_major_locator(MaxNLocator(6, integer=whole))
            power = FuncFormatter(lambda k, _: f"$10^{{{k:.0f}}}$" if whole else f"{10**k:.2g}")
            bar.long_axis.set_major_formatter(power)
    return drawn if many else drawn[0]


def steps(values: np.ndarray, levels: int) -> np.ndarray:
    """Levels of a picture: round numbers, and at the ends the smallest and the largest value there is."""
    from matplotlib.ticker import MaxNLocator

    lo, hi = float(values.min()), float(values.max())
    if hi - lo <= 1e-12 * max(abs(lo), abs(hi), 1e-300):
        lo, hi = lo - 0.5, hi + 0.5
    between: Any = MaxNLocator(levels + 1).tick_values(lo, hi)
    slack = 1e-2 * (hi - lo)  # a band that rounding alone makes would promise values that do not occur
    return np.concatenate([[lo], between[(between > lo + slack) & (between < hi - slack)], [hi]])


def colour_bar(filled: Any, drawn: Any, label: str) -> Any:
    """Beside the pictures, or below one that is long and low, where its numbers would collide."""
    first = drawn[0]
    low = len(drawn) == 1 and first.dataLim.width > LOW * first.dataLim.height
    return first.figure.colorbar(
        filled, ax=list(drawn), label=label, shrink=0.85, ticks=round_ticks(),
        **({"location": "bottom", "pad": 0.3, "aspect": 30} if low else {}),
    )  # fmt: skip


def round_ticks() -> Any:
    """Round numbers beside a colour bar, whatever it begins and ends with."""
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(7)


def painted(ax: Any, piece: Piece, bounds: np.ndarray, cmap: str) -> Any:
    """One piece in filled contours that end where the domain does."""
    # Matplotlib leaves white what lies on the highest level.
    z = np.clip(piece.values, bounds[0], bounds[-1] - 1e-9 * (bounds[-1] - bounds[0]))
    filled = ax.tricontourf(*piece.places.T, piece.triangles, z, levels=bounds, cmap=cmap)
    clipped(ax, filled, piece.outline)
    return filled


def page(points: np.ndarray) -> tuple[float, float]:
    """A figure's size for a domain: its shape, within limits, and a colour bar or legend."""
    if points.shape[1] != 2:
        return (5.6, 1.6) if points.shape[1] == 1 else (7.6, 5.0)
    width, height = np.ptp(points, axis=0)
    ratio = float(np.clip(height / width, 0.2, 2.2)) if width > 0 else 1.0 if height == 0 else 2.2
    wide = 4.6 if ratio < 1 else 4.6 / ratio
    return wide + 1.3, wide * ratio + (0.5 if ratio > 1 / LOW else 1.6)


def places(cloud: Cloud, at: Mapping[str, float] | None) -> list[tuple[int, float]]:
    """Axis and position of every slice; a 2D cloud is its own only one."""
    if cloud.dim == 2:
        if at is not None:
            raise ValueError("at: slices are for 3D clouds, this one has 2 dimensions; leave it out")
        return [(-1, 0.0)]
    points = np.asarray(cloud.points)
    if at is None:
        lo, hi = points.min(axis=0), points.max(axis=0)
        digits = 2 - int(np.floor(np.log10((hi - lo).max())))
        return [(k, float(np.round((lo[k] + hi[k]) / 2, digits)) + 0.0) for k in (2, 1, 0)]
    if not isinstance(at, Mapping) or not at or set(at) - set(AXES):
        raise ValueError(f'at: {at!r} is not a dict of positions by axis, such as {{"x": 0.5, "z": 0.2}}')
    for name, position in at.items():
        if not is_number(position):
            raise ValueError(f"at: expected a number for {name!r}, got {position!r}")
    return [(AXES.index(name), float(position)) for name, position in at.items()]
