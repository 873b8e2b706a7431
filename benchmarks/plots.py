"""The paper's figures from this run's data; needs matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

STYLE = {"I": ("C0", "o"), "II": ("C1", "s"), "III": ("C2", "^"), "SSPH": ("C3", "x"), "S": ("C4", "d")}
STYLE["S, seven"] = STYLE["S"]


def _panels(nodes: list[str], ylabel: str, xlabel: str) -> tuple[Figure, Any]:
    figure = Figure(figsize=(12, 3.8), layout="constrained")
    axes = figure.subplots(1, len(nodes))
    for ax, n in zip(axes, nodes):
        ax.set_title(f"{n} nodes")
        ax.set_xlabel(xlabel)
    axes[0].set_ylabel(ylabel)
    return figure, axes


def temperatures(data: dict[str, Any]) -> Figure:
    """Figures 3 to 5."""
    lines = data["figures_3_to_5"]
    figure, axes = _panels(list(lines), "temperature at x = 2", "y")
    for ax, line in zip(axes, lines.values()):
        ax.plot(line["y"], line["exact"], "k-", lw=1, label="exact")
        for name in (n for n in STYLE if n in line):
            colour, mark = STYLE[name]
            ax.plot(line["y"], line[name], mark, color=colour, ms=4, mfc="none", label=name)
        ax.set_xlim(4.0, 9.1)
    axes[0].legend(fontsize=8)
    return figure


def _against(axis: str, xlabel: str) -> Callable[[dict[str, Any]], Figure]:
    def picture(data):
        curves = data["figures_7_to_15"]
        figure, axes = _panels(list(curves), "relative L2 error, percent", xlabel)
        for ax, by_method in zip(axes, curves.values()):
            for name, found in by_method.items():
                colour, mark = STYLE[name]
                x = sorted(found[axis], key=float)
                y = [np.nan if found[axis][v] is None else found[axis][v] for v in x]
                ax.semilogy([float(v) for v in x], y, "-" + mark, color=colour, ms=4, label=name)
            ax.grid(alpha=0.3)
        axes[0].legend(fontsize=8)
        return figure

    return picture


def rates(data: dict[str, Any]) -> Figure:
    """Figures 13 to 15: log error against log h."""
    figure = _against("h", "h / spacing")(data)
    for ax in figure.axes:
        ax.set_xscale("log")
        ax.set_xlim(0.75, 1.3)
        shown = [y for line in ax.lines for x, y in zip(line.get_xdata(), line.get_ydata()) if 0.75 <= x <= 1.3]
        ax.set_ylim(0.8 * min(shown), 1.25 * max(shown))
    return figure


def nonsmooth(data: dict[str, Any]) -> Figure:
    """Errors under nonsmooth sources."""
    figure = Figure(figsize=(12, 3.8), layout="constrained")
    for ax, order in zip(figure.subplots(1, 2), (2, 4)):
        rows = [r for r in data["nonsmooth"] if r["order"] == order]
        for k, name in enumerate(("I", "II", "III", "SSPH", "S")):
            at = np.arange(len(rows)) + 0.16 * (k - 2)
            ax.bar(at, [r[name] for r in rows], 0.15, color=STYLE[name][0], label=name)
        ax.set_yscale("log")
        ax.set_xticks(range(len(rows)), ["\n".join(r["source"].replace(",", "").split()) for r in rows], fontsize=8)
        ax.set_title(f"order {order}")
    figure.axes[0].set_ylabel("relative L2 error, percent")
    figure.axes[0].legend(fontsize=8, ncols=5)
    return figure


PICTURES: dict[str, Callable[[dict[str, Any]], Figure]] = {
    "figures_3_to_5": temperatures,
    "figures_7_to_9": _against("d", "support radius d"),
    "figures_10_to_12": _against("h", "h / spacing"),
    "figures_13_to_15": rates,
    "nonsmooth": nonsmooth,
}


def draw_all(data: dict[str, Any], folder: Path) -> list[str]:
    """Draw every picture into ``folder``; returns their file names."""
    folder.mkdir(exist_ok=True)
    for name, picture in PICTURES.items():
        picture(data).savefig(folder / f"{name}.png", dpi=90)
    return [f"{name}.png" for name in PICTURES]
