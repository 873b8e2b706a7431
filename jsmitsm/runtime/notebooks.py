"""What a notebook shows of an object: a small table, and dots for the particles. Nothing is imported for it."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import Any

import numpy as np

# Viridis from its dark to its light end, and the colours of groups, the interior's first.
_VIRIDIS = ("#440154", "#46327e", "#365c8d", "#277f8e", "#1fa187", "#4ac16d", "#a0da39", "#fde725")
_GROUPS = ("#9e9e9e", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# Pixels across, and dots drawn at most: more would make a notebook heavy.
_WIDTH, _MOST = 220, 1500


def shown(title: str, rows: Iterable[tuple[str, Any]], picture: str = "") -> str:
    """A table of names and values under a title, a picture beside it."""
    cells = "".join(
        f"<tr><td style='text-align:left'><b>{escape(str(name))}</b></td>"
        f"<td style='text-align:left'>{escape(str(value))}</td></tr>"
        for name, value in rows
    )
    table = f"<table><caption style='text-align:left'><b>{escape(title)}</b></caption>{cells}</table>"
    return f"<div style='display:flex;align-items:center;gap:1em;flex-wrap:wrap'>{table}{picture}</div>"


def dots(points: np.ndarray, kinds: np.ndarray, count: int) -> str:
    """Particles (N, D) as an SVG: in 1D on a line, in 3D from above. kinds (N,): their groups, the interior 0, or with
    ``count`` 0 numbers, which become colours."""
    points, kinds = np.asarray(points, float), np.asarray(kinds, float)
    if not np.isfinite(points).all() or not len(points):
        return ""
    if len(points) > _MOST:
        some = np.linspace(0, len(points) - 1, _MOST).astype(int)
        points, kinds = points[some], kinds[some]
    flat = np.stack([points[:, 0], points[:, 1] if points.shape[1] > 1 else 0 * points[:, 0]], axis=1)
    lo, size = flat.min(axis=0), max(float(np.ptp(flat, axis=0).max()), 1e-300)
    at = (flat - lo) / size * (_WIDTH - 12) + 6
    height = float(at[:, 1].max()) + 6
    if count:
        colours = [_GROUPS[0] if k < 1 else _GROUPS[1 + (int(k) - 1) % 6] for k in kinds]
    else:
        lo_, range_ = np.nanmin(kinds, initial=np.inf), np.ptp(kinds[np.isfinite(kinds)]) if len(kinds) else 0.0
        share = np.nan_to_num((kinds - lo_) / (range_ or 1.0))
        colours = [_VIRIDIS[min(7, int(8 * s))] for s in share]
    radius = float(np.clip(60.0 / np.sqrt(len(points)), 1.2, 4.0))
    circles = "".join(
        f"<circle cx='{x:.1f}' cy='{height - y:.1f}' r='{radius:.1f}' fill='{c}'/>" for (x, y), c in zip(at, colours)
    )
    return f"<svg width='{_WIDTH}' height='{height:.0f}' role='img' aria-label='particles'>{circles}</svg>"


def span(values: Any) -> str:
    """The range of some numbers in words."""
    array = np.asarray(values)
    if array.dtype.kind == "c":
        return f"modulus {span(np.abs(array))}"
    return f"{np.min(array):.4g} to {np.max(array):.4g}" if array.size else "none"
