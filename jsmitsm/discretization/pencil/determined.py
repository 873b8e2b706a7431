"""Whether neighbours determine polynomials of a degree: on a lattice many of them lie on few lines.

Of q parallel lines the product vanishes, a polynomial of degree q that no value on them sees. The nearest particles
beside a wall are half a disc, which from degree 6 or 7 on has too few lines; a lattice that is finer along one axis
has too few along the other everywhere.
"""

from __future__ import annotations

import numpy as np

from jsmitsm.particle.polynomials import monomials_on_host, whitening

# A polynomial is unseen whose values are this part of those of others: on lattices 1e-15, on scattered clouds 1e-3.
_UNSEEN = 1e-5
# Neighbours are one-sided whose mean is so far away, in units of the farthest. Of all others so many are looked at, and
# all of them where one is found: what spoils them is the cloud's pattern.
_SIDED, _SAMPLE = 0.1, 100
# Stencils looked at together.
_CHUNK = 500


def undetermined(points: np.ndarray, near: np.ndarray, degree: int) -> np.ndarray:
    """The rows of ``near`` (n, w), particles themselves first, -1 for none, that do not determine a polynomial."""
    if degree < 2 or not len(near):
        return np.zeros(0, int)
    spoilt = _unseen(points, near[:: 1 + len(near) // _SAMPLE], degree).any()
    chosen = np.flatnonzero(spoilt | _sided(points, near))
    return chosen[_unseen(points, near[chosen], degree)]


def _offsets(points: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where neighbours are (n, w, D), in units of the farthest, and which ones there are."""
    there = near >= 0
    offset = np.where(there[..., None], points[np.maximum(near, 0)] - points[near[:, 0]][:, None], 0.0)
    far = np.sqrt((offset**2).sum(axis=2).max(axis=1))
    return offset / np.where(far > 0, far, 1.0)[:, None, None], there


def _sided(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    parts = [np.zeros(0)]
    for k in range(0, len(near), _CHUNK):
        offset, there = _offsets(points, near[k : k + _CHUNK])
        parts.append(np.linalg.norm(offset.sum(axis=1) / there.sum(axis=1)[:, None], axis=1))
    return np.concatenate(parts) > _SIDED


def _unseen(points: np.ndarray, near: np.ndarray, degree: int) -> np.ndarray:
    """Whether a polynomial of this degree vanishes at all neighbours but the particle itself, (n,)."""
    parts = [np.zeros(0, bool)]
    for k in range(0, len(near), _CHUNK):
        offset, there = _offsets(points, near[k : k + _CHUNK])
        root = np.exp(-2.0 * (offset**2).sum(axis=2)) * there
        root[:, 0] = 0.0
        powers = monomials_on_host(offset.reshape(-1, offset.shape[2]).T, degree).T @ whitening(offset.shape[2], degree)
        fit = powers.reshape(*there.shape, -1) * root[..., None]
        if fit.shape[1] <= fit.shape[2]:  # fewer neighbours than coefficients
            parts.append(np.ones(len(fit), bool))
            continue
        size = np.abs(np.diagonal(np.linalg.qr(fit, mode="r"), axis1=1, axis2=2))
        parts.append(size.min(axis=1) < _UNSEEN * size.max(axis=1))
    return np.concatenate(parts)

