"""Which neighbours a moment system sees: how many it needs, who they are, and whether given ones suffice."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud
from jsmitsm.cloud.neighbours import Stencils, evenly_spaced, in_line, jumps, replaced, within
from jsmitsm.cloud.sight.walls import Walls, nearest_seen, within_seen
from jsmitsm.discretization.parts.whole import Part
from jsmitsm.discretization.periodic import Images
from jsmitsm.equation.problem import Problem
from jsmitsm.particle.elimination import Scheme
from jsmitsm.particle.kernels import EDGE, Kernel, fitted
from jsmitsm.particle.recursion import fit_and_tail
from jsmitsm.runtime.tracers import concrete, is_traced

# Neighbours for every free coefficient, by the order of the expansions, where the particles are evenly spaced.
_EVEN_RATIO = {4: 1.5, 5: 1.5, 6: 1.5, 7: 1.65, 8: 1.65, 9: 1.8, 10: 1.8, 11: 1.8, 12: 1.8}
# Particles whose given stencils are compared with their supports, at the most.
_LOOKED_AT = 500


def scheme_size(scheme: Scheme) -> int:
    """Free coefficients per field: how many neighbours a fit needs at the least."""
    rec = scheme.rec
    if scheme.method == "SSPH":
        return rec.size
    if scheme.free:
        return len(scheme.free)
    columns, _, rows, _ = fit_and_tail(rec)
    return -(-(len(columns) - len(rows)) // rec.fields)


def default_size(scheme: Scheme, even: bool = False) -> int:
    """Neighbours, the particle itself counted, that make a good fit.

    even: the particles keep their distance from one another. There smaller stencils of method S have errors two to
    three times smaller; elsewhere, and at high orders near boundaries, too many of them would be weak.
    """
    free, rec = scheme_size(scheme), scheme.rec
    if rec.dim == 1 and scheme.method == "SSPH":
        # Polynomials through all neighbours: of more of them the errors were ten times larger, of twice as many
        # as there are coefficients a hundred thousand times.
        return max(free, 5)
    if rec.dim == 1 and rec.fields == 1:
        return min(2 * free + 2, 5)
    ratio = _EVEN_RATIO.get(rec.order, 2.0) if even else 2.0
    return round(ratio * free) + 2


def walls_of(problem: Problem, cloud: Cloud, images: Images, part: Part | None = None) -> Walls | None:
    """The boundary as what hides particles from one another; None where nothing is known of it."""
    host, normals = concrete(cloud.points), concrete(cloud.normals)
    if host is None or (cloud.normals is not None and normals is None):
        return None
    points, n = images.searched(np.asarray(host, float)), len(cloud)
    open_ = {name for cs in problem.bcs.values() for c in cs if c.kind == "periodic" for name in c.groups}
    wall, interior = np.zeros(n, bool), np.zeros(n, bool)
    interior[cloud.groups[INTERIOR]] = True
    for name, ids in cloud.groups.items():
        wall[ids] = name != INTERIOR and name not in open_
    given = np.full((n, cloud.dim), np.nan) if normals is None else np.asarray(normals, float)
    ids = np.flatnonzero(images.extend_values(wall))
    judged = wall if part is None else wall & part.own
    groups = {name: members[judged[members]] for name, members in cloud.groups.items() if name != INTERIOR}
    return Walls(points, ids, images.extend_values(given)[ids], images.extend_values(interior), groups)


def find_stencils(
    cloud: Cloud, kernel: Kernel | None, scheme: Scheme, images: Images, conditioned: np.ndarray, walls: Walls | None,
    part: Part | None = None,
) -> Stencils:  # fmt: skip
    """Neighbours that each particle sees, see ``jsmitsm.cloud.sight.walls``; outward normals are checked by the way."""
    found = _found_stencils(cloud, kernel, scheme, images, conditioned, walls, part)
    if walls is not None and cloud.dim == 1:
        walls.check_outward(np.asarray(found.indices))
    if walls is not None and kernel is None:
        counts = (np.asarray(found.indices) >= 0).sum(axis=1)
        needed = scheme_size(scheme) + 1
        few = np.flatnonzero((counts < min(needed, counts.max())) & (True if part is None else part.own))
        if len(few):
            raise ValueError(
                f"cloud: {len(few)} particle(s), e.g. particle {few[0]}, see only {counts[few[0]]} of the {needed} "
                "that a stencil of this order needs, themselves counted: the boundary cuts the others off; add "
                "particles to that part of the domain, or lower the order"
            )
    return found


def _found_stencils(
    cloud: Cloud, kernel: Kernel | None, scheme: Scheme, images: Images, conditioned: np.ndarray, walls: Walls | None,
    part: Part | None,
) -> Stencils:  # fmt: skip
    """Neighbours from the kernel's support, or as many of the nearest as the method needs without a kernel.

    conditioned: the particles with conditions of their own, one-sided all of them.
    """
    if is_traced(cloud.points) or is_traced(kernel):
        what = "kernel's h or d" if is_traced(kernel) else "points"
        raise ValueError(
            f"stencils: the {what} is traced by a JAX transform, and neighbours are found on the host; "
            "build stencils = js.stencils(cloud, radius=...) before the transform and pass stencils=stencils to solve"
        )
    points = images.searched(np.asarray(cloud.points))
    which = np.arange(len(cloud)) if len(images.owner) else None
    if kernel is None:
        needed = scheme_size(scheme)
        if len(points) < needed + 1:
            raise ValueError(
                f"cloud: {len(points)} particles are too few for this order, which needs at least {needed + 1} "
                "in every stencil; lower the order or add particles"
            )
        if cloud.dim == 1:
            normals = None if len(images.owner) or walls is None else walls.all_normals()
            return in_line(points, min(default_size(scheme), len(points)), which, normals)
        even = scheme.method == "S" and (evenly_spaced(points) if part is None else part.even)
        size = min(default_size(scheme, even), len(points))
        found, full = nearest_seen(points, size, which, walls), min(default_size(scheme), len(points))
        if size == full:
            return found
        wide = jumps(np.asarray(found.radius), images.owners(found.indices))
        if cloud.dim == 3:  # there a Neumann side with small stencils has an error ten times that of the rest
            wide = np.union1d(wide, conditioned)
        return replaced(found, wide, nearest_seen(points, full, wide, walls)) if len(wide) else found
    return within_seen(points, np.asarray(kernel.d) * np.asarray(kernel.h), which, walls)


def default_kernel(points: Any, ids: np.ndarray, near: Any, decay: float = 2.0) -> Kernel:
    """The kernel of the particles ``ids`` (n,) without one of the user's: it fits their neighbours ``near`` (n, w)."""
    xp = jnp if is_traced(near, points) else np
    near, points = xp.asarray(near), xp.asarray(points)
    offset = points[xp.where(near >= 0, near, ids[:, None])] - points[ids][:, None]
    return fitted(xp.sqrt(xp.max(xp.sum(offset**2, axis=2), axis=1)), decay)


def check_supports(
    scheme: Scheme, stencils: Stencils, kernel: Kernel | None, points: Any, n_own: np.ndarray, active: np.ndarray
) -> None:
    """Every moment system needs as many neighbours as it has unknowns: ValueError otherwise.

    n_own (N,): the number of each particle's own conditions; active: those that have a moment system.
    """
    near = stencils.indices
    if is_traced(near, kernel, points):
        return
    near, points = np.asarray(near), np.asarray(points)
    inside = near >= 0
    if kernel is not None:
        reach = np.broadcast_to(np.asarray(kernel.h) * np.asarray(kernel.d), (len(near),)) * EDGE
        index = np.maximum(near, 0)
        squared = sum((x[index] - x[: len(near), None]) ** 2 for x in np.ascontiguousarray(points.T))
        inside &= squared <= reach[:, None] ** 2
    counts = inside.sum(axis=1) - (scheme.method != "SSPH")
    # I and II widen the supports of their first stage themselves.
    needed = np.full(len(near), 2 if scheme.method in ("I", "II") else scheme_size(scheme))
    needed -= np.where(n_own > 0, n_own, 0) // scheme.rec.fields
    few = active[(counts < needed)[active]]
    if len(few):
        i = few[0]
        what = "stencils" if kernel is None else "kernel"
        raise ValueError(
            f"{what}: {len(few)} particle(s) have too few neighbours, e.g. particle {i} has {counts[i]} of at least "
            f"{needed[i]} that method {scheme.method} of order {scheme.rec.order} needs; choose larger supports "
            "(increase h, d, size or radius) or a lower order"
        )


def cut_off(stencils: Stencils, kernel: Kernel, points: Any, active: np.ndarray) -> tuple[int, ...]:
    """Particles whose kernel would see more particles than their given stencil holds; none where that is traced.

    Of many doubtful ones some are looked at: a search for all would cost as much as the stencils did.
    """
    radius, near = stencils.radius, stencils.indices
    if radius is None or is_traced(kernel, points, near):
        return ()
    reach = np.broadcast_to(np.asarray(kernel.h) * np.asarray(kernel.d), (len(near),)) * EDGE
    doubtful = active[(reach > np.asarray(radius) * EDGE)[active]]
    if not len(doubtful):
        return ()
    doubtful = doubtful[:: -(-len(doubtful) // _LOOKED_AT)]
    within_reach = within(np.asarray(points), reach[doubtful], doubtful).indices >= 0
    held = (np.asarray(near)[doubtful] >= 0).sum(axis=1)
    return tuple(int(i) for i in doubtful[within_reach.sum(axis=1) > held])
