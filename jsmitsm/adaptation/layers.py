"""Boundary layers that an operator makes, told by its coefficients: how fast solutions decay from the boundary."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jsmitsm.adaptation.data import Data
from jsmitsm.adaptation.spacing_field import SpacingField
from jsmitsm.cloud.cloud import Cloud
from jsmitsm.runtime.errors import TooCoarse, TooFine

# Spacing at the boundary, in decay lengths; a spacing that is not larger than this many needs no help.
_FINE = 1.0
# Beyond this error a layer of convection that is not resolved may spoil everything.
LOST = 0.03
# How often particles along a boundary are looked at: each time those between two of the last are seen.
_TIMES = 12


def layers(data: Data, cloud: Cloud, spacing: np.ndarray, outflow: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Boundary particles (n, D) at which solutions decay within the spacing (N,), and the spacing that shows it.

    Solutions of a n'' + b n' + c n = 0 across the boundary, with a, b and c of the operator along the normal n, go like
    exp(k s): outflow has k = -b / a, reaction k = sqrt(-c / a); with ``outflow`` the first alone count. Where the
    conditions excite none, the particles go again with the next cloud.
    """
    t, dim = data.traced, cloud.dim
    rim = cloud.boundary
    nothing = np.zeros((0, dim)), np.zeros(0)
    if not t.linear or t.n_equations > 1 or t.order != (2,) or not len(rim) or cloud.normals is None:
        return nothing
    points, normals = np.asarray(cloud.points)[rim], np.asarray(cloud.normals)[rim]
    with np.errstate(all="ignore"):
        jac = data.series(points, 0)[0][0, :, 0]
        part = [np.prod(normals ** np.array(b), axis=1) for _, b in t.slots]
        a, b, c = (
            sum((jac[s] * part[s] for s, (_, m) in enumerate(t.slots) if sum(m) == k), np.zeros(len(rim)))
            for k in (2, 1, 0)
        )
        root = np.sqrt(np.maximum(b**2 - 4.0 * a * c, 0.0))
        decay = np.maximum((-b + root) / (2.0 * a), (-b - root) / (2.0 * a))
    decay = np.where(np.isfinite(decay) & (b**2 - 4.0 * a * c >= 0), np.maximum(decay, 0.0), 0.0)
    carried = np.abs(b) > np.sqrt(np.abs(4.0 * a * c))
    thin = decay * spacing[rim] > _FINE
    if outflow:
        thin &= carried
    return points[thin], _FINE / decay[thin]


def along_outflow(data: Data | None, make: Callable[[Any], Cloud], field: SpacingField, most: int) -> SpacingField:
    """The spacing, as fine along all of a boundary as the layer is that convection makes there.

    Until such a layer is resolved everywhere, nothing upstream of it is right. Left as it is where that takes more
    than ``most`` particles, or a cloud that cannot be made.
    """
    if data is None or not any(sum(b) == 1 for _, b in data.traced.slots):
        return field
    finer = field
    for _ in range(_TIMES):
        try:
            cloud = make(finer)
        except (TooCoarse, TooFine):
            return field
        if len(cloud) > most:
            return field
        at, thin = layers(data, cloud, finer(np.asarray(cloud.points)), outflow=True)
        if not len(at):
            break
        finer = finer.joined(at, thin)
    return finer
