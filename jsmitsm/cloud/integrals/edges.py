"""Integrals over facets that reach across an edge of a solid whose shape is known.

The particles of a solid do not stand on its edges, so facets cut them off. The ways from such a facet still end on the
sides that meet there, and its Gauss points are laid so that none of their sums crosses the line where one side ends.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jsmitsm.cloud.integrals.swept import Swept, simplex_rule

# Where normals differ by less than 30 degrees the boundary is taken for one smooth side.
SMOOTH = np.cos(np.radians(30.0))
# Facets are halved so often around corners, and where an edge bends too much for them. The rule that tells the error
# of the first halves less often, as more halvings agree on what none of them sees, and has Gauss points more.
_LEVELS, _FEWER, _MORE = 4, 2, 2
# The boundary is sought so many widths of a facet away at most, in so many strides.
_FAR, _STRIDES = 1.0, 8
# Looks for the line between two sides along a ray, and for the end of a way.
_LOOKS, _NEWTON = 8, 60
# The corners of a triangle and the middles of the opposite sides; its quarters.
_SPOTS = np.array([[2, 0, 0], [0, 2, 0], [0, 0, 2], [0, 1, 1], [1, 0, 1], [1, 1, 0]]) / 2.0
_QUARTERS = _SPOTS[[[0, 5, 4], [5, 1, 3], [4, 3, 2], [3, 4, 5]]]


def open_ways(
    points: np.ndarray, facets: np.ndarray, normal: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The ways (M, 3, 3) from the corners of all facets (M, 3) of a solid, and which facets (M,) come near an edge.

    A particle has one way in all its facets, or their layers would overlap, or gape: its normal ``own`` (N, 3), and
    where one of the facets around looks elsewhere than its corners, the mean of these facets' normals, weighted by
    their angles.
    """
    across = (np.einsum("mkd,md->mk", own[facets], normal) < SMOOTH).any(axis=1)
    at = np.isin(np.arange(len(points)), facets[across])
    total = np.zeros(points.shape)
    for k in range(3):
        here, one, other = (points[facets[:, (k + i) % 3]] for i in range(3))
        a, b = one - here, other - here
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("md,md->m", a, b))
        np.add.at(total, facets[:, k], angle[:, None] * normal)
    mean = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return np.where(at[:, None], mean, own)[facets], at[facets].any(axis=1)


def over_edges(
    shape: Any, corners: np.ndarray, ways: np.ndarray, normal: np.ndarray, degree: int, otherwise: bool = False
) -> tuple[Swept, np.ndarray]:
    """Gauss points of facets (M, 3, 3) with their ways and outward normals (M, 3), one in each row, by the shape; and
    the facets (P,) they are of.

    A triangle that an edge parts into one corner and two is summed along rays from that corner, either side of the
    edge by itself: then the sums converge as fast as on smooth sides. Others are quartered.
    """
    rays, found, levels = _Rays(shape, corners, ways, normal), [], _FEWER if otherwise else _LEVELS
    facet, part = np.arange(len(corners)), np.broadcast_to(np.eye(3), corners.shape)
    for level in range(levels + 1):
        count = max(3, 2 * (degree // 4 + 1) - level) + _MORE * otherwise
        spots = np.einsum("sk,tkc->tsc", _SPOTS, part)
        _, outward, there = rays.ends(np.repeat(facet, 6), spots.reshape(-1, 3))
        outward, there = outward.reshape(-1, 6, 3), np.asarray(there.reshape(-1, 6).all(axis=1))
        alike = np.einsum("tsd,trd->tsr", outward, outward) >= SMOOTH
        lone = np.stack([_alone(alike, k) for k in range(3)], axis=1) & there[:, None]
        parted = np.asarray(lone.any(axis=1))
        whole = np.asarray(there & alike.all(axis=(1, 2))) if level < levels else ~parted
        left = ~(whole | parted)
        turn = (np.where(parted, lone.argmax(axis=1), 0)[:, None] + np.arange(3)) % 3
        part, outward = (np.take_along_axis(x, turn[..., None], axis=1) for x in (part, outward[:, :3]))
        for which, (owner, at, weights), sides in (
            (whole, _plain(facet[whole], part[whole], count), outward[whole, :1]),
            (parted, _parted(rays, facet[parted], part[parted], count), np.tile(outward[parted, :2], (1, count, 1))),
        ):
            # The rule holds if its points see what the corners do: an edge may bend into a triangle between them.
            pieces = len(sides), sides.shape[1], len(at) // max(len(sides) * sides.shape[1], 1), 3
            seen = rays.ends(owner, at)[1].reshape(pieces)
            good = (np.einsum("tsqd,tsd->tsq", seen, sides) >= SMOOTH).all(axis=(1, 2)) | (level == levels)
            left[np.flatnonzero(which)[~good]] = True
            keep = np.repeat(good, len(owner) // max(len(good), 1))
            found.append((owner[keep], at[keep], weights[keep] * 4.0**-level))
        facet = np.repeat(facet[left], 4)
        part = np.einsum("qsk,tkc->tqsc", _QUARTERS, part[left]).reshape(-1, 3, 3)
    facet, at, weights = (np.concatenate(pieces) for pieces in zip(*found))
    reach, outward, _ = rays.ends(facet, at)
    base, way = rays.starts(facet, at)
    sides, turns = (x[:, 1:] - x[:, :1] for x in (corners, ways))
    handed = np.sign(np.linalg.det(np.concatenate([sides, normal[:, None]], axis=1)))
    return Swept(base[:, None], way[:, None], reach[:, None], weights[:, None], sides[facet], turns[facet],
                 handed[facet, None], outward[:, None]), facet  # fmt: skip


def _alone(alike: np.ndarray, k: int) -> np.ndarray:
    """Which triangles (T,) an edge parts once, between their corner k and the other two, by which spots (T, 6, 6) are
    alike."""
    one, other = (k + 1) % 3, (k + 2) % 3
    opposite = alike[:, one, other] & alike[:, one, 3 + k] & alike[:, other, 3 + k]
    apart = ~alike[:, k, one] & ~alike[:, k, other] & ~alike[:, k, 3 + k]
    first = alike[:, 3 + other, k] | alike[:, 3 + other, one]
    return opposite & apart & first & (alike[:, 3 + one, k] | alike[:, 3 + one, other])


def _plain(facet: np.ndarray, part: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Facets (P,), places in them (P, 3) and weights (P,) of Gauss points in triangles (T, 3, 3) of facets (T,)."""
    at, weights = simplex_rule(2, count)
    spots = np.einsum("qk,tkc->tqc", at, part)
    return np.repeat(facet, len(at)), spots.reshape(-1, 3), np.tile(weights, len(facet))


def _parted(rays: _Rays, facet: np.ndarray, part: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same in triangles whose first corner stands beyond an edge: along rays, before and behind it."""
    x, w = np.polynomial.legendre.leggauss(count)
    x, w = (x + 1.0) / 2.0, w / 2.0
    far = part[:, None, 1] + x[:, None] * (part[:, None, 2] - part[:, None, 1])  # (T, count, 3)
    near = np.broadcast_to(part[:, None, 0], far.shape)
    share = rays.between(np.repeat(facet, count), near.reshape(-1, 3), far.reshape(-1, 3)).reshape(far.shape[:2])
    at = np.concatenate([share[..., None] * x, share[..., None] + (1.0 - share[..., None]) * x], axis=2)
    weights = np.concatenate([share[..., None] * w, (1.0 - share[..., None]) * w], axis=2) * at * w[:, None]
    spots = near[:, :, None] + at[..., None] * (far - near)[:, :, None]
    return np.repeat(facet, 2 * count**2), spots.reshape(-1, 3), weights.ravel()


class _Plane(NamedTuple):
    """Where some rays' ways end, and the side they end on."""

    at: np.ndarray  # (P, 3)
    outward: np.ndarray  # (P, 3)

    def where(self, new: np.ndarray, other: _Plane) -> _Plane:
        return _Plane(*(np.where(new[:, None], x, y) for x, y in zip(other, self)))


class _Rays:
    """The ways from places in facets to the boundary, as the shape has it."""

    def __init__(self, shape: Any, corners: np.ndarray, ways: np.ndarray, normal: np.ndarray):
        self._shape, self._corners, self._ways, self._normal = shape, corners, ways, normal
        self._far = _FAR * np.linalg.norm(np.ptp(corners, axis=1), axis=1)
        self._near = 1e-13 * np.ptp(corners, axis=(0, 1)).max() if len(corners) else 0.0

    def starts(self, facet: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (P, 3) of facets (P,) by their barycentric coordinates (P, 3), and the ways there."""
        base, way = (np.einsum("pk,pkd->pd", at, x[facet]) for x in (self._corners, self._ways))
        return base, way

    def ends(self, facet: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How many ways (P,) it is to the boundary, its normals (P, 3) there, and whether it was found (P,)."""
        base, way = self.starts(facet, at)
        value, outward = self._shape.distance(base)
        on, sense = np.abs(value) <= self._near, -np.sign(value)
        stride = self._far[facet] / np.maximum(np.linalg.norm(way, axis=1), 1e-300) / _STRIDES * sense
        last, beyond = np.zeros(len(base)), np.full(len(base), np.nan)
        live = np.flatnonzero(~on)
        for k in range(1, _STRIDES + 1):
            t = k * stride[live]
            crossed = self._shape.distance(base[live] + t[:, None] * way[live])[0] * value[live] <= 0.0
            beyond[live[crossed]] = t[crossed]
            last[live[~crossed]] = t[~crossed]
            live = live[~crossed]
        reach, there = np.zeros(len(base)), on | ~np.isnan(beyond)
        live = np.flatnonzero(there & ~on)
        inner, outer = np.where(sense > 0, last, beyond), np.where(sense > 0, beyond, last)
        reach[live], outward[live] = self._root(base[live], way[live], inner[live], outer[live])
        lost = self._normal[facet[~there]]
        outward[~there] = np.copysign(1.0, np.einsum("pd,pd->p", lost, way[~there]))[:, None] * lost
        return reach, outward, there

    def _root(
        self, base: np.ndarray, way: np.ndarray, inner: np.ndarray, outer: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The zeros (P,) between numbers of ways inside and outside, and the normals (P, 3): Newton's method, halving
        where it leaves them."""
        t, outward = (inner + outer) / 2.0, np.zeros(base.shape)
        inner, outer, live = inner.copy(), outer.copy(), np.arange(len(base))
        for _ in range(_NEWTON):
            if not len(live):
                break
            value, outward[live] = self._shape.distance(base[live] + t[live, None] * way[live])
            inner[live], outer[live] = (
                np.where(value < 0, t[live], inner[live]), np.where(value < 0, outer[live], t[live])
            )  # fmt: skip
            steep = np.einsum("pd,pd->p", outward[live], way[live])
            live, value, steep = (x[np.abs(value) > self._near] for x in (live, value, steep))
            new = t[live] - value / np.where(np.abs(steep) > 1e-3, steep, np.inf)
            low, high = np.minimum(inner[live], outer[live]), np.maximum(inner[live], outer[live])
            t[live] = np.where((new > low) & (new < high), new, (low + high) / 2.0)
        return t, outward

    def between(self, facet: np.ndarray, near: np.ndarray, far: np.ndarray) -> np.ndarray:
        """At which share (P,) of the line from near to far (P, 3) its ways begin to end on the other side.

        Where the planes touch that the two sides have where they were last seen. That comes closer to the edge by the
        square if both are looked at, so every other look goes a little past it, to the side not seen last.
        """
        base, way = self.starts(facet, near)
        along, turn = (x - y for x, y in zip(self.starts(facet, far), (base, way)))

        def seen(share: np.ndarray) -> _Plane:
            reach, outward, _ = self.ends(facet, near + share[:, None] * (far - near))
            return _Plane(base + share[:, None] * along + reach[:, None] * (way + share[:, None] * turn), outward)

        low, high = np.zeros(len(facet)), np.ones(len(facet))
        one, other = seen(low), seen(high)
        stale = np.ones(len(facet), bool)  # whether the far side was seen longer ago
        for look in range(_LOOKS):
            share = _touching(base, along, way, turn, one, other, low, high)
            if look % 2:
                share = share + 0.1 * (np.where(stale, high, low) - share)
            new = seen(share)
            first = np.einsum("pd,pd->p", new.outward, one.outward) > np.einsum("pd,pd->p", new.outward, other.outward)
            low, high = np.where(first, share, low), np.where(first, high, share)
            one, other, stale = one.where(first, new), other.where(~first, new), first
        return _touching(base, along, way, turn, one, other, low, high)


def _touching(
    base: np.ndarray, along: np.ndarray, way: np.ndarray, turn: np.ndarray, one: _Plane, other: _Plane,
    low: np.ndarray, high: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """The share (P,) of a line, between two, from which it is as far to one plane as to the other."""

    def heights(plane: _Plane) -> tuple[np.ndarray, ...]:
        dot = lambda x: np.einsum("pd,pd->p", x, plane.outward)  # noqa: E731
        return dot(plane.at - base), -dot(along), dot(way), dot(turn)

    (a, da, v, dv), (b, db, w, dw) = heights(one), heights(other)
    # (a + s da) / (v + s dv) = (b + s db) / (w + s dw)
    c0, c1, c2 = a * w - b * v, a * dw + da * w - b * dv - db * v, da * dw - db * dv
    with np.errstate(divide="ignore", invalid="ignore"):
        half = -0.5 * (c1 + np.copysign(np.sqrt(np.maximum(c1**2 - 4.0 * c0 * c2, 0.0)), c1))
        roots = np.stack([c0 / half, half / c2])
    good = (roots >= low) & (roots <= high)
    return np.where(good[0], roots[0], np.where(good[1], roots[1], (low + high) / 2.0))
