"""Evolutions as moving pictures, and as series of files."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from jsmitsm.cloud.triangulation import simplices
from jsmitsm.runtime.errors import explaining, is_whole
from jsmitsm.show import drawing
from jsmitsm.show.mesh_files import needed


@explaining
def animate(run: Any, *, field: int = 0, frames: int | None = None, interval: float = 50.0, ax: Any = None) -> Any:
    """An evolution as a ``matplotlib.animation.FuncAnimation``: a curve in 1D, colours over the cloud in 2D.

    Parameters
    ----------
    run : Evolution
        What ``js.evolve`` returned.
    field : int
        The field of a system.
    frames : int, optional
        So many moments, equally spaced and interpolated between the steps; the saved ones if not given.
    interval : float
        Milliseconds between two of them.
    ax : matplotlib axes, optional
        Where it is drawn.

    Returns
    -------
    matplotlib.animation.FuncAnimation
        Write it with ``.save("u.gif")``.

    Raises
    ------
    ValueError
        For what is no evolution, for a field that does not exist, and in 3D, where ``js.files.to_pvd`` writes a series
        for ParaView.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ends)
    >>> run = js.evolve(
    ...     heat,
    ...     js.interval(0.0, 1.0, 11),
    ...     lambda x: jnp.sin(jnp.pi * x[0]),
    ...     t=(0, 0.1),
    ...     steps=8,
    ...     save=4,
    ... )
    >>> js.plot.animate(run).to_jshtml().count("data:image/png")
    5
    """
    cloud = _evolution(run).cloud
    if cloud.dim == 3:
        raise ValueError("run: moving pictures are of one or two dimensions; js.files.to_pvd writes those of three")
    if frames is not None and not is_whole(frames, 1):
        raise ValueError(f"frames: expected a number of moments, got {frames!r}")
    from matplotlib.animation import FuncAnimation

    times = np.asarray(run.t) if frames is None else np.linspace(float(run.t[0]), float(run.t[-1]), frames)
    states = run.u if frames is None else [run.at(t).u for t in times]
    values = np.stack([drawing.field_of(u, field) for u in states])
    low, high = float(values.min()), float(values.max())
    room = 0.05 * (high - low) or 0.5
    points = np.asarray(cloud.points)
    ax = drawing.axes(ax, cloud.dim)
    title = ax.set_title("")
    if cloud.dim == 1:
        order = np.argsort(points[:, 0])
        (line,) = ax.plot(points[order, 0], values[0][order])
        ax.set_ylim(low - room, high + room)

        def show(k: int) -> Any:
            line.set_ydata(values[k][order])
            title.set_text(f"t = {times[k]:.4g}")
            return line, title
    else:
        surface = ax.tripcolor(points[:, 0], points[:, 1], np.asarray(simplices(cloud)), values[0],
                               shading="gouraud", vmin=low, vmax=high)  # fmt: skip
        ax.set_aspect("equal")
        ax.figure.colorbar(surface, ax=ax)

        def show(k: int) -> Any:
            surface.set_array(values[k])
            title.set_text(f"t = {times[k]:.4g}")
            return surface, title

    return FuncAnimation(ax.figure, show, frames=len(times), interval=interval)


@explaining
def to_pvd(run: Any, path: Any) -> None:
    """Write an evolution as a series for ParaView: ``path`` (.pvd) lists the saved times, a .vtu file each beside it.

    Needs meshio: ``pip install "jsmitsm[mesh]"``.

    Parameters
    ----------
    run : Evolution
        What ``js.evolve`` returned.
    path : str or path
        Of a .pvd file in a folder that exists.

    Returns
    -------
    None

    Raises
    ------
    ValueError
        For what is no evolution, and for another path.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import os, tempfile, jax.numpy as jnp, jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ends)
    >>> run = js.evolve(
    ...     heat,
    ...     js.interval(0.0, 1.0, 11),
    ...     lambda x: jnp.sin(jnp.pi * x[0]),
    ...     t=(0, 0.1),
    ...     steps=8,
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     js.files.to_pvd(run, os.path.join(folder, "rod.pvd"))
    ...     len(os.listdir(folder))
    3
    """
    meshio = needed("meshio", "mesh")
    cloud = _evolution(run).cloud
    try:
        root, ending = os.path.splitext(os.fspath(path))
    except TypeError:
        raise ValueError(f"path: expected the name of a .pvd file, got {path!r}") from None
    if ending != ".pvd" or not os.path.isdir(os.path.dirname(root) or "."):
        raise ValueError(f"path: expected the name of a .pvd file in a folder that exists, got {path!r}")
    points = np.zeros((len(cloud), 3))
    points[:, : cloud.dim] = cloud.points
    cells = [({1: "line", 2: "triangle", 3: "tetra"}[cloud.dim], simplices(cloud))]
    lines = []
    for k, (t, u) in enumerate(zip(np.asarray(run.t), np.asarray(run.u))):
        name = f"{root}_{k:05d}.vtu"
        meshio.Mesh(points, cells, point_data={"u": u}).write(name)
        lines.append(f'    <DataSet timestep="{float(t)!r}" file="{os.path.basename(name)}"/>')
    with open(f"{root}.pvd", "w", encoding="utf-8") as file:
        file.write('<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n')
        file.write("\n".join(lines) + "\n  </Collection>\n</VTKFile>\n")


def _evolution(run: Any) -> Any:
    """``run``, or an error where it is no evolution."""
    if not all(hasattr(run, name) for name in ("t", "u", "at", "cloud")):
        raise ValueError(f"run: expected a js.Evolution, got {type(run).__name__}")
    return run
