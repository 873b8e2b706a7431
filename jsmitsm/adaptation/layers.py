"""Boundary layers that an operator makes, told by its coefficients: how fast solutions decay from the boundary."""

from __future__ import annotations

import numpy as np

from jsmitsm.adaptation.data import Data
from jsmitsm.cloud.cloud import Cloud

# Spacing at the boundary, in decay lengths; a spacing that is not larger than this many needs no help.
_FINE = 1.0


def layers(data: Data, cloud: Cloud, spacing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boundary particles (n, D) at which solutions decay within the spacing (N,), and the spacing that shows it.

    Solutions of a n'' + b n' + c n = 0 across the boundary, with a, b and c of the operator along the normal n, go like
    exp(k s): outflow has k = -b / a, reaction k = sqrt(-c / a). Where the conditions excite none, the particles go
    again with the next cloud.
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
    thin = decay * spacing[rim] > _FINE
    return points[thin], _FINE / decay[thin]
