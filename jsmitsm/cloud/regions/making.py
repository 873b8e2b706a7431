"""Clouds of several regions made from their shapes: boundaries shared, copies paired, each region filled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jsmitsm.cloud import filling, levelset
from jsmitsm.cloud.cloud import INTERIOR
from jsmitsm.cloud.filling import SpacingLike
from jsmitsm.cloud.packing.octree import Spacing
from jsmitsm.cloud.regions.lattice import cut_lattice
from jsmitsm.cloud.regions.probes import directions, on_boundary, outward, share_a_side
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.cloud.regions.shapes import Interval, Shape, shape_of
from jsmitsm.cloud.shapes import Predicate, checked_bounds, checked_seed, grouped, own_normals
from jsmitsm.runtime.arrays import ArrayLike
from jsmitsm.runtime.errors import TooCoarse, explaining, short
from jsmitsm.runtime.progress import bar

# A particle is on the boundary of a shape if it is nearer to it than this part of the whole domain.
_ON = 1e-9
# Probes around a particle, at this part of the spacing, tell which regions meet there.
_PROBE = 0.02
# Boundaries nearer to one another than this part of the spacing, or crossing by it, were meant to be one.
_GAP, _OVERLAP = 0.4, 0.02


@explaining
@bar("cloud")
def regions(
    shapes: Mapping[str, Any],
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
    spacing: SpacingLike | None = None,
    *,
    seed: int = 0,
    groups: Mapping[str, Predicate] | None = None,
    lattice: Sequence[int] | None = None,
) -> RegionCloud:
    """Particles of a domain made of several regions, with a copy for each side wherever two of them meet.

    Parameters
    ----------
    shapes : mapping
        Maps the name of each region to its shape: a signed distance as for ``js.from_sdf``, a polygon (V,
        2), a shapely Polygon or MultiPolygon, or in 1D the ends (a, b) of a layer. Regions touch one another and do
        not overlap: what surrounds an inclusion is ``js.sdf.difference(outer, inclusion)``.
    bounds : pair of array_like (2,), optional
        (lo, hi), each (D,), a box that contains the domain; needed for signed distances.
    spacing : float or function
        Distance between neighbours in length units, a number or a function (M, D) -> (M,) of numpy arrays.
    seed : int
        The same seed gives the same cloud.
    groups : mapping, optional
        Maps names of groups of the outer boundary to predicates as for ``js.from_sdf``; without it the
        outer boundary is the group ``"boundary"``.
    lattice : sequence of int (D,), optional
        In place of ``spacing``: the particles of a lattice on the box ``bounds``, so many along each axis, cut by
        predicates (M, D) -> (M,) of booleans, or signed distances. A cell belongs to the region that holds its middle,
        to none where no region does; interfaces follow the sides of cells.

    Returns
    -------
    RegionCloud
        The particles region by region. Where "a" and "b" touch there is the group ``"a|b"``, its name in the order
        of ``shapes``, its normals from a to b. Ends of interfaces belong to the groups of the outer boundary.

    Raises
    ------
    ValueError
        For shapes that overlap, leave a gap too thin for the spacing or are too small for it; for names that are no
        strings or hold "|"; for bad bounds, spacing or groups, as ``js.from_sdf``; and in 3D where an
        interface ends on a curve: interfaces are closed surfaces there.

    Examples
    --------
    >>> import jsmitsm as js
    >>> disk = js.sdf.circle((0.0, 0.0), 0.5)
    >>> around = js.sdf.difference(js.sdf.rectangle((-1, -1), (1, 1)), disk)
    >>> cloud = js.regions({"disk": disk, "plate": around}, ((-1, -1), (1, 1)), 0.1)
    >>> sorted(cloud.groups), len(cloud.interfaces["disk|plate"])
    (['boundary', 'disk|plate', 'interior'], 31)
    """
    _check_names(shapes)
    if lattice is not None:
        if spacing is not None or bounds is None:
            raise ValueError("lattice: takes bounds (lo, hi) and no spacing, which its shape says already")
        return cut_lattice(shapes, checked_bounds(bounds), lattice, groups)
    if spacing is None:
        raise ValueError("spacing: not given; give the distance between neighbouring particles")
    rule, seed = filling.spacing_function(spacing), checked_seed(seed)
    box = None if bounds is None else checked_bounds(bounds)
    made = {name: shape_of(name, shape, box, rule) for name, shape in shapes.items()}
    if len({len(shape.lo) for shape in made.values()}) > 1:
        raise ValueError("shapes: of different dimensions; give layers, or shapes of the plane, or of space")
    sketch = _shared(made, rule, seed)
    _meet(sketch)
    _check_gaps(sketch)
    cloud = _put_together(sketch, _filled(sketch, seed, not callable(spacing)), groups)
    cloud._shape = made
    return cloud


def _check_names(shapes: Any) -> None:
    if not isinstance(shapes, Mapping) or not shapes:
        raise ValueError(f"shapes: expected a dict from the name of a region to its shape, got {short(shapes)}")
    for name in shapes:
        if not isinstance(name, str) or not name or "|" in name or name in (INTERIOR, "boundary"):
            raise ValueError(
                f'shapes: {name!r} cannot name a region; take a string without "|", not "interior" nor "boundary"'
            )


@dataclass
class _Sketch:
    """Shapes and the particles of their boundaries, those of several shapes once."""

    shapes: dict[str, Shape]
    spacing: Spacing
    points: np.ndarray  # (L, D)
    on: dict[str, np.ndarray]  # of each shape the particles of its boundary, ascending
    normals: dict[str, np.ndarray]  # and its outward normals there
    # Per pair of shapes that touch, in order, the particles of both; and those of the outer boundary.
    interfaces: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    outer: np.ndarray = field(default_factory=lambda: np.zeros(0, int))

    @property
    def size(self) -> float:
        return _size(self.shapes)


def _size(shapes: dict[str, Shape]) -> float:
    lo = np.min([shape.lo for shape in shapes.values()], axis=0)
    return float((np.max([shape.hi for shape in shapes.values()], axis=0) - lo).max())


def _shared(shapes: dict[str, Shape], spacing: Spacing, seed: int) -> _Sketch:
    """The particles of all boundaries. A shape takes over what earlier ones have on its boundary and makes the rest."""
    tolerance = _ON * _size(shapes)
    forced = _distinct(np.concatenate([shape.corners(spacing) for shape in shapes.values()]), tolerance)
    dim = forced.shape[1]
    points, on, normals = np.zeros((0, dim)), {}, {}
    earlier: list[Shape] = []
    probing = lambda x: _PROBE * spacing(x)  # noqa: E731
    for name, shape in shapes.items():
        taken = np.flatnonzero(on_boundary(shape, points, probing, tolerance))
        whole = not earlier or not len(taken)
        own = shape.boundary(spacing, seed, forced)
        new = np.ones(len(own.points), bool)
        for other in earlier:
            new &= ~on_boundary(other, own.points, probing, tolerance)
        if not whole and shape.curved:
            new &= _apart(own.points, points[taken], spacing)
        made = np.arange(len(points), len(points) + int(new.sum()))
        direction = outward(shape, points[taken], spacing)
        _check_corners(shape, name, own, new, points[taken], probing)
        points = np.concatenate([points, own.points[new]])
        on[name] = np.concatenate([taken, made])
        normals[name] = np.concatenate([direction, own.normals[new]])
        earlier.append(shape)
    return _Sketch(shapes, spacing, points, on, normals)


def _distinct(points: np.ndarray, tolerance: float) -> np.ndarray:
    """The points without those that repeat earlier ones."""
    from scipy.spatial import cKDTree

    if not len(points):
        return points
    pairs = cKDTree(points).query_pairs(tolerance, output_type="ndarray")
    return np.delete(points, np.unique(pairs.max(axis=1)) if len(pairs) else [], axis=0)


def _apart(points: np.ndarray, others: np.ndarray, spacing: Spacing) -> np.ndarray:
    from scipy.spatial import cKDTree

    return cKDTree(others).query(points)[0] > 0.5 * spacing(points)


def _check_corners(
    shape: Shape, name: str, own: levelset.Boundary, new: np.ndarray, taken: np.ndarray, probing: Spacing
) -> None:
    """What a shape leaves to earlier ones must have been made by them: nearby, at the least."""
    left = own.points[~new]
    if not len(left):
        return
    from scipy.spatial import cKDTree

    away = cKDTree(taken).query(left)[0] if len(taken) else np.full(len(left), np.inf)
    gap = np.median(cKDTree(own.points).query(own.points, k=2)[0][:, 1]) if len(own.points) > 1 else np.inf
    if (away > 2.0 * gap).any():
        if not on_boundary(shape, left, probing, np.inf).all():  # the probes step over the shape
            raise _too_small(name)
        raise ValueError(
            f"shapes[{name!r}]: lies on the zero level of another shape at {left[away.argmax()]}, which is no part of "
            "that one's boundary; overlapping regions? subtract one from the other with js.sdf.difference"
        )


def _meet(sketch: _Sketch) -> None:
    """Which shapes meet at every particle, and whether there is nothing on some side of it."""
    points, h = sketch.points, sketch.spacing(sketch.points)
    member = np.zeros((len(sketch.shapes), len(points)), bool)
    probes = directions(points.shape[1])
    names = list(sketch.shapes)
    inside = np.zeros((len(names), len(probes), len(points)), bool)
    for k, shape in enumerate(sketch.shapes.values()):
        member[k, sketch.on[names[k]]] = True
        for m, step in enumerate(probes):
            distance = shape.distance(points + _PROBE * h[:, None] * step)[0]
            inside[k, m] = distance < _PROBE * _PROBE * h  # a little outside counts: interfaces curve
        _check_overlap(sketch, names[k], points[~member[k]], h[~member[k]])
    outer = np.asarray(~inside.any(axis=0).all(axis=0))
    sketch.outer = np.flatnonzero(outer)
    for i, first in enumerate(names):
        for j in range(i + 1, len(names)):
            both = np.flatnonzero(member[i] & member[j])
            both = both[np.flatnonzero(share_a_side(inside[i], inside[j], member, both, points.shape[1]))]
            if len(both):
                sketch.interfaces[first, names[j]] = both
    count = member.sum(axis=0)
    lonely = np.flatnonzero((count == 1) & ~outer)
    if len(lonely):
        name, at = names[int(member[:, lonely[0]].argmax())], points[lonely[:1]]
        others = {n: shape.distance(at)[0][0] for n, shape in sketch.shapes.items() if n != name}
        other = min(others, key=lambda n: others[n])
        if others[other] > 0:
            raise _touching(name, other, at[0])
        raise ValueError(
            f"shapes: the boundary of {name!r} at {at[0]} lies inside of {other!r}: they overlap; subtract one from "
            "the other with js.sdf.difference"
        )
    if points.shape[1] == 3:
        ends = np.flatnonzero((count > 1) & outer)
        many = np.flatnonzero(count > 2)
        if len(ends) or len(many):
            at = points[ends[0] if len(ends) else many[0]]
            raise ValueError(
                f"shapes: in 3D an interface ends or meets others near {at}; interfaces must be closed surfaces there, "
                "as an inclusion's. Cut a lattice by predicates, js.regions(..., lattice=...), or mesh the regions and "
                "read js.files.from_mesh(mesh, regions=True)"
            )
    _check_touching(sketch, member)


def _check_touching(sketch: _Sketch, member: np.ndarray) -> None:
    """Shapes that meet at a particle share a piece of boundary there, with one another or with a third."""
    for k, name in enumerate(sketch.shapes):
        bound = np.zeros(len(sketch.points), bool)
        for pair, ids in sketch.interfaces.items():
            bound[ids] |= name in pair
        alone = np.flatnonzero(member[k] & (member.sum(axis=0) > 1) & ~bound)
        if len(alone):
            other = next(n for n, there in zip(sketch.shapes, member[:, alone[0]]) if there and n != name)
            raise _touching(name, other, sketch.points[alone[0]])


def _touching(name: str, other: str, at: np.ndarray) -> ValueError:
    return ValueError(
        f"shapes: {name!r} and {other!r} touch in a point alone at {at}, and no particles fit into the gap beside it; "
        "let them share a piece of boundary, or move them apart by a spacing"
    )


def _check_overlap(sketch: _Sketch, name: str, points: np.ndarray, h: np.ndarray) -> None:
    """No boundary of another region runs inside of this one."""
    deep = sketch.shapes[name].distance(points)[0] if len(points) else np.zeros(0)
    bad = np.flatnonzero(deep < -_OVERLAP * h)
    if len(bad):
        raise ValueError(
            f"shapes: {name!r} overlaps another region, whose boundary runs inside of it at {points[bad[0]]}; subtract "
            "one from the other with js.sdf.difference, or correct the polygons"
        )


def _check_gaps(sketch: _Sketch) -> None:
    """No two boundaries so near that they were meant to be one, no region that touches none."""
    points, h = sketch.points, sketch.spacing(sketch.points)
    for name, shape in sketch.shapes.items():
        away = np.setdiff1d(sketch.outer, sketch.on[name])
        distance = shape.distance(points[away])[0] if len(away) else np.zeros(0)
        near = away[(distance > 0) & (distance < _GAP * h[away])]
        # Next to where they touch, two boundaries part from one another at some angle.
        ends = [ids for pair, ids in sketch.interfaces.items() if name in pair]
        if len(near) and ends:
            joint = points[np.concatenate(ends)]
            gap = np.linalg.norm(points[near][:, None] - joint[None], axis=2).min(axis=1)
            near = near[gap > 2.0 * h[near]]
        if len(near):
            # A thin region between them is no gap.
            height, way = shape.distance(points[near])
            middle = points[near] - 0.5 * height[:, None] * way
            near = near[np.min([other.distance(middle)[0] for other in sketch.shapes.values()], axis=0) > 0]
        if len(near):
            other = next(n for n, ids in sketch.on.items() if near[0] in ids)
            raise TooCoarse(
                f"shapes: a gap between {other!r} and {name!r} at {points[near[0]]}, thinner than the spacing; let "
                "them touch exactly (the same function, the same vertices), or reduce the spacing"
            )
    touching = {name for pair in sketch.interfaces for name in pair}
    alone = [name for name in sketch.shapes if name not in touching]
    if alone and len(sketch.shapes) > 1:
        raise ValueError(
            f"shapes: {alone[0]!r} touches no other region; is there a gap? let them touch exactly (the same function, "
            "the same vertices, the same ends), and make a region that stands apart a cloud of its own"
        )


def _filled(sketch: _Sketch, seed: int, uniform: bool) -> dict[str, np.ndarray]:
    """The interior particles of every region."""
    inside = {}
    for name, shape in sketch.shapes.items():
        boundary = sketch.points[sketch.on[name]]
        if not len(boundary):
            raise TooCoarse(f"shapes[{name!r}]: no boundary was found; is it empty? reduce the spacing")
        if isinstance(shape, Interval):
            inside[name] = filling.divide(np.linspace(shape.lo, shape.hi, 2001), sketch.spacing)[0][1:-1]
        else:
            inside[name] = filling.fill(shape, sketch.spacing, shape.lo, shape.hi, boundary, seed, uniform)
        if not len(inside[name]):
            raise _too_small(name)
        for other, there in sketch.shapes.items():
            if other != name:
                deep = there.distance(inside[name])[0]
                bad = np.flatnonzero(deep < -0.1 * sketch.spacing(inside[name]))
                if len(bad):
                    raise ValueError(
                        f"shapes: {name!r} and {other!r} overlap at {inside[name][bad[0]]}; subtract one from the "
                        "other with js.sdf.difference, or correct the polygons"
                    )
    return inside


def _too_small(name: str) -> TooCoarse:
    return TooCoarse(
        f"shapes[{name!r}]: the region is too small for the spacing, no particle fits between those of its boundary; "
        "reduce the spacing there (it may be a function of the position)"
    )


def _put_together(sketch: _Sketch, inside: dict[str, np.ndarray], groups: Any) -> RegionCloud:
    """Particles region by region: the interior first, then the boundary's."""
    dim = sketch.points.shape[1]
    start, number, members, points = 0, {}, {}, []
    for name in sketch.shapes:
        count, at = len(inside[name]), sketch.on[name]
        number[name] = np.full(len(sketch.points), -1)
        number[name][at] = start + count + np.arange(len(at))
        members[name] = np.arange(start, start + count + len(at))
        points += [inside[name], sketch.points[at]]
        start += count + len(at)
    made = np.concatenate(points)
    normals = np.full((start, dim), np.nan)
    interior = [ids[: len(inside[name])] for name, ids in members.items()]
    index: dict[str, Any] = {INTERIOR: np.concatenate(interior)}
    all_of_it = {"boundary": np.arange(len(sketch.outer))}
    named = all_of_it if groups is None else grouped(sketch.points[sketch.outer], groups)
    free = np.ones(start, bool)
    for label, some in named.items():
        places, own = sketch.outer[some], []
        for name in sketch.shapes:
            here = places[number[name][places] >= 0]
            if len(here):
                own.append(number[name][here])
                normals[own[-1]] = _side_normals(sketch, name, here)
        index[label] = np.sort(np.concatenate(own))
        free[index[label]] = False
    pairs, pair_normals = {}, {}
    for (first, second), places in sketch.interfaces.items():
        name = f"{first}|{second}"
        if name in index:
            raise ValueError(f"groups: the name {name!r} is taken by an interface; choose another")
        pairs[name] = np.stack([number[first][places], number[second][places]], axis=1)
        pair_normals[name] = _side_normals(sketch, first, places)
        own_ones = []
        for column in pairs[name].T:
            here = free[column]
            own_ones.append(column[here])
            normals[column[here]] = pair_normals[name][here]
            free[column[here]] = False
        index[name] = np.sort(np.concatenate(own_ones))
    return RegionCloud(made, index, normals, members, pairs, pair_normals)


def _side_normals(sketch: _Sketch, name: str, places: np.ndarray) -> np.ndarray:
    """Outward normals of a region along one side of it: at its ends those of this side, not of a corner."""
    at, shape = sketch.on[name], sketch.shapes[name]
    here = np.isin(at, places)
    boundary = levelset.Boundary(sketch.points[at], sketch.normals[name])
    # Along the other sides, the normals at corners are no matter here.
    named = {"here": np.flatnonzero(here), "rest": np.flatnonzero(~here)}
    named = {label: some for label, some in named.items() if len(some)}
    found = own_normals(shape, sketch.spacing, boundary, named)
    order = np.searchsorted(at[np.argsort(at)], places)
    return found[np.argsort(at)[order]]
