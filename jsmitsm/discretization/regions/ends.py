"""Where interfaces end on the outer boundary: conditions between the copies that follow from those they carry there.

A free surface at right angles to an interface leaves no shear on either side, and so says already that it is the same
on both. What follows from the others is no condition more, and would make the fit singular.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from jsmitsm.cloud.regions.region_cloud import sides
from jsmitsm.discretization.regions.layout import Meeting, Regions
from jsmitsm.runtime.tracers import concrete, is_traced

# A row follows from others that leave less than this of it: normals are right to this angle.
_FOLLOWS = 1e-5
# Its value is theirs up to this part of the largest.
_AGREES = 1e-4
# ... and below this part of all that is given it is round-off.
_NOTHING = 1e-12


def independent(
    regions: Regions, nums: Any, m: Meeting, places: list[int], own: list[int], keep: tuple[tuple[bool, ...], ...]
) -> tuple[tuple[bool, ...], ...]:
    """``keep``, the rows of each condition between the copies that count, without those that follow from others.

    places: the number of each copy in its region; own: how many conditions it carries of its own.

    ValueError where what follows from the others contradicts them. Under a transform that knows no numbers all count.
    """
    known = [regions.points, *(nums.parts[k].own for k in m.parts), *(coef for coef, _ in nums.between.values())]
    if not any(own) or any(concrete(x) is None for x in known):
        return keep
    columns: dict[Any, int] = {}
    first = list(_carried(regions, nums, m, places, own, columns))
    between = list(_between(regions, nums, m, columns))
    size = _sizes(regions, m, columns, [row for *_, row, _ in between])
    basis: list[np.ndarray] = []
    made: list[tuple[np.ndarray, Any]] = []

    def adds(row: np.ndarray) -> bool:
        left = row.copy()
        for _ in range(2):
            for q in basis:
                left = left - (q @ left) * q
        length = float(np.linalg.norm(left))
        if length > _FOLLOWS:
            basis.append(left / length)
        return length > _FOLLOWS

    for row, value in first:
        one, value = _unit(row, value, size)
        if adds(one):
            made.append((one, value))
    out = [list(rows) for rows in keep]
    for t, k, row, value in between:
        if not keep[t][k]:
            continue
        one, value = _unit(row, value, size)
        if adds(one):
            made.append((one, value))
            continue
        out[t][k] = False
        if regions.linear:
            _check_agrees(regions, nums, m, t, one, value, made)
    return tuple(tuple(rows) for rows in out)


def _carried(
    regions: Regions, nums: Any, m: Meeting, places: list[int], own: list[int], columns: dict[Any, int]
) -> Iterator[tuple[dict[int, float], Any]]:
    """What the copies carry of the outer boundary, held values and conditions, as rows over the columns."""
    zero = (0,) * regions.rec.dim
    for c, (part, copy, place, count) in enumerate(zip(m.parts, m.copies, places, own)):
        for f in np.flatnonzero(regions.held[copy]):
            yield {_column(columns, c, (int(f), zero)): 1.0}, nums.held[copy, f]
        mine = nums.parts[part]
        at = int(np.searchsorted(mine.own_ids, place)) if count else 0
        for k in range(count):
            coef = np.asarray(concrete(mine.own))[at, k]
            slots = regions.parts[part].disc.scheme.own
            yield {_column(columns, c, slot): float(x) for slot, x in zip(slots, coef)}, mine.given[at, k]


def _between(regions: Regions, nums: Any, m: Meeting, columns: dict[Any, int]) -> Iterator[Any]:
    """The conditions between the copies: interface, row, coefficients by column, and value."""
    names = [p.name for p in regions.parts]
    for t, (name, pair) in enumerate(m.pairs):
        copy = [m.parts.index(names.index(side)) for side in sides(name)]
        coef, value = nums.between[name]
        for k, row in enumerate(np.asarray(concrete(coef))[pair]):
            slots = regions.interfaces[name].slots
            yield t, k, {_column(columns, copy[s], slot): float(x) for (s, slot), x in zip(slots, row)}, value[pair, k]


def _column(columns: dict[Any, int], copy: int, slot: Any) -> int:
    return columns.setdefault((copy, slot), len(columns))


def _sizes(regions: Regions, m: Meeting, columns: dict[Any, int], rows: list[dict[int, float]]) -> np.ndarray:
    """What every column is multiplied with: derivatives by the spacing, and each side by what it conducts, so that
    both sides of a flux count alike."""
    points, near = np.asarray(concrete(regions.points)), regions.near[m.copies[0]]
    length = float(np.linalg.norm(points[near[near >= 0]] - points[m.copies[0]], axis=1).max())
    conducts = np.zeros(len(m.copies))
    for (c, (_, b)), j in columns.items():
        if sum(b) == 1:
            conducts[c] = max(conducts[c], *(abs(row.get(j, 0.0)) for row in rows))
    conducts = np.where(conducts > 0, conducts, 1.0)
    return np.array([(length * conducts[c]) ** -float(sum(b)) for c, (_, b) in columns])


def _unit(row: dict[int, float], value: Any, size: np.ndarray) -> tuple[np.ndarray, Any]:
    """The row as an array of unit length, and its value."""
    out = np.zeros(len(size))
    for j, x in row.items():
        out[j] += x * size[j]
    length = float(np.linalg.norm(out)) or 1.0
    return out / length, value / length


def _check_agrees(
    regions: Regions, nums: Any, m: Meeting, t: int, row: np.ndarray, value: Any, made: list[tuple[np.ndarray, Any]]
) -> None:
    everywhere = [nums.held, *(own.given for own in nums.parts), *(v for _, v in nums.between.values())]
    if is_traced(everywhere):
        return
    rows, given = np.array([r for r, _ in made]), np.array([float(v) for _, v in made])
    parts = np.linalg.lstsq(rows.T, row, rcond=_FOLLOWS)[0] * given
    off = abs(float(value) - parts.sum())
    largest = max(float(np.abs(v).max(initial=0.0)) for v in everywhere)
    if off > _AGREES * max(abs(float(value)), *np.abs(parts)) + _NOTHING * largest:
        at = np.asarray(regions.points)[m.copies[0]]
        raise ValueError(
            f"bcs[{m.pairs[t][0]!r}]: the interface ends on the boundary at {at}, where its conditions contradict "
            f"those of the boundary on its sides ({off:.3g} is left); correct one of them"
        )
