"""What is static about a problem on a cloud: conditions, methods and classes of particles, decided once on the host."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import numpy as np

from jsmitsm.cloud.cloud import Cloud, kept
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.cloud.sight.walls import Walls, seen
from jsmitsm.discretization.parts.whole import Part
from jsmitsm.discretization.periodic import Images, periodic_images, with_corners
from jsmitsm.discretization.resolution.digits import carries, room, suited_depth, warn_of_float32
from jsmitsm.discretization.resolution.field_sizes import field_sizes
from jsmitsm.discretization.supports import check_supports, cut_off, default_kernel, find_stencils, walls_of
from jsmitsm.equation.branches import FIELD
from jsmitsm.equation.closing import closed
from jsmitsm.equation.conditions import Group, check_collocated, group_conditions
from jsmitsm.equation.field import RATE
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.regions.per_region import PerRegion
from jsmitsm.equation.traced import Traced
from jsmitsm.equation.tracing import trace
from jsmitsm.equation.unknowns.extras import refuse_extras
from jsmitsm.particle.elimination import Scheme
from jsmitsm.particle.kernels import Constant, Kernel
from jsmitsm.particle.recursion import Recursion, free_indices, recursion
from jsmitsm.runtime.compiled import at_hand
from jsmitsm.runtime.errors import IN_FUNCTIONS, is_whole, of_the_pde
from jsmitsm.runtime.tracers import concrete, is_traced, owned

_LARGE = 1 << 22  # bytes of the user's stencils that are quickly compared


@dataclass
class Class:
    """Particles whose moment systems have the same shape.

    ids (n,) ascending, neighbours (n, w), the particle itself first and -1 for none; wide: whether their stencils are
    wider than those of most; kept: what others found for the class, which lasts as long as it does.
    """

    ids: np.ndarray
    neighbours: Any
    scheme: Scheme
    wide: bool = False
    kept: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)


@dataclass
class Placed:
    """What a discretisation takes from the cloud and from the form of the problem alone, whatever its numbers are."""

    held: np.ndarray  # (N, F) bool, values given or taken from a periodic partner
    partner: np.ndarray  # (N,) the particle whose value each one has: itself but for periodic images
    images: Images
    n_own: np.ndarray  # (N,) own conditions of each particle
    walls: Walls | None  # what hides particles from one another
    stencils: Stencils
    unknowns: np.ndarray  # (N, F) the number of each unknown among all values; -1 for held ones
    classes: list[Class]  # none until they are sorted


@dataclass(kw_only=True)
class Discretization(Placed):
    """What is static about a problem on a cloud: decided once, on the host."""

    problem: Problem  # closed: nothing of it is the user's any more
    cloud: Cloud
    kernel: Kernel | None
    traced: Traced
    rec: Recursion
    groups: list[Group]
    scheme: Scheme  # of interior particles
    given_stencils: bool  # the user's: nothing outside them is looked at
    basis_terms: int | None = None  # free coefficients kept, all of them if not given
    repeated: int = 0  # particles whose moment system was that of another
    cut_off: tuple[int, ...] = ()  # particles whose support reaches outside of the given stencil
    lengths: int = 0  # eliminations of a constant operator, where one for all is not enough
    # Where the equation degenerates, (N,): rows of the recursion that add nothing, conditions that it implies.
    lost: np.ndarray | None = None
    dropped: np.ndarray | None = None
    part: Part | None = None  # of a cloud that several processes share

    @property
    def points(self) -> Any:
        """The particles (N, D), followed by their periodic images."""
        return self.images.extend(self.cloud.points)

    @property
    def linear(self) -> bool:
        return self.traced.linear and all(g.linear for g in self.groups)

    @property
    def floating(self) -> tuple[int, ...]:
        """Fields that the problem determines only up to a constant: no value of theirs enters."""
        zero = (0,) * self.rec.dim
        values = {f for f, b in (*self.rec.slots, *self.scheme.own) if b == zero}
        return tuple(f for f in range(self.rec.fields) if f not in values)

    @property
    def active(self) -> np.ndarray:
        """The particles that carry equations, ascending."""
        return np.flatnonzero(~self.held.all(axis=1) & (True if self.part is None else self.part.own))


def discretize(
    problem: Problem, cloud: Cloud, method: str, order: int, kernel: Kernel | None,
    stencils: Stencils | None, basis_terms: int | None, sources: bool = True, depth: int | str = "auto",
    part: Part | None = None, region: bool = False,
) -> Discretization:  # fmt: skip
    """Trace the problem, lay out its recursion and conditions, and find neighbours.

    sources: whether the weights of the source are wanted even where it is zero; part: where the cloud is a part.
    region: where it is one of several, which share fits at their interfaces, and so the units of their fields.
    """
    if isinstance(cloud, RegionCloud) or isinstance(problem.pde, PerRegion):
        raise ValueError("problem: several regions are for js.solve, js.factorize, js.evolve, js.eigen; not for this")
    refuse_extras(problem)
    warn_of_float32(cloud)
    kernel = kernel and kernel.recorded()
    traced = _traced(problem, cloud.dim)
    _check_operator(traced, problem, order)
    problem, (kernel, stencils) = closed(problem, traced), jax.tree.map(owned, (kernel, stencils))
    sourced = sources or not traced.linear or traced.source != "zero"
    rec = recursion(cloud.dim, order, problem.fields, traced.slots, traced.pattern, traced.order)
    flat = traced.constant and rec.scale_free
    groups = group_conditions(problem, with_corners(problem, cloud), order, traced.order, part is None)
    if depth == "auto":
        held = [g.ids for g in groups if g.held]
        depth = suited_depth(method, rec, flat, sourced, traced, cloud, problem.params, held, part)
        depth = depth and min(depth, room(rec, order))
    rec = recursion(cloud.dim, order, problem.fields, traced.slots, traced.pattern, traced.order, int(depth))
    if method == "S" and not region:
        rec = replace(rec, sizes=field_sizes(rec, traced, cloud, problem.params, groups, part))
    scheme = _scheme(method, rec, traced, problem, cloud, basis_terms)
    carried = method == "S" and bool(depth) and carries(rec, traced, cloud, problem.params, part)
    scheme = replace(scheme, **_conditions_layout(groups, rec), sourced=sourced, flat=flat, carried=carried)
    if scheme.n_data and method in ("I", "II", "III"):
        raise ValueError(
            f"method: {method} takes one condition where values are held, but a boundary has more (as a clamped "
            'plate has); use "S" or "SSPH"'
        )
    if method == "SSPH":
        check_collocated(groups, problem.fields)
    if kernel is not None and not is_traced(kernel) and np.shape(kernel.h) not in ((), (len(cloud),)):
        raise ValueError(f"kernel: h has shape {np.shape(kernel.h)}, expected a number or ({len(cloud)},), one each")
    if isinstance(kernel, Constant) and method in ("II", "III"):
        raise ValueError(
            f"kernel: the derivatives of js.Constant vanish, and method {method} tests with them; use another kernel"
        )
    place = _placed(problem, cloud, kernel, stencils, scheme, groups, part)
    if kernel is None and method in ("I", "II"):
        kernel = default_kernel(cloud.points, np.arange(len(cloud)), place.stencils.indices)
    disc = Discretization(
        problem=problem, cloud=cloud, kernel=kernel, traced=traced, rec=rec, groups=groups, scheme=scheme,
        given_stencils=stencils is not None, basis_terms=basis_terms, part=part, **vars(place),
    )  # fmt: skip
    if stencils is not None or kernel is not None:
        check_supports(scheme, disc.stencils, kernel, disc.points, disc.n_own, disc.active)
    if stencils is not None and kernel is not None:
        disc.cut_off = cut_off(disc.stencils, kernel, disc.points, disc.active)
    place.classes = place.classes or sorted_classes(disc, disc.active, disc.stencils)
    disc.classes = list(place.classes)
    if traced.branches is not None and not traced.branches.depends & FIELD:
        refuse_jumps(disc, problem)
    return disc


def _placed(
    problem: Problem, cloud: Cloud, kernel: Kernel | None, stencils: Stencils | None, scheme: Scheme,
    groups: list[Group], part: Part | None,
) -> Placed:  # fmt: skip
    """Who is held, who is whose neighbour: kept with the cloud, where all that decides is the same."""
    pairs = tuple(dict.fromkeys(c.groups for cs in problem.bcs.values() for c in cs if c.kind == "periodic"))
    conditions = tuple((g.name, g.ids.tobytes(), tuple(g.held), g.n_rows) for g in groups)

    def place() -> Placed:
        held = np.zeros((len(cloud), problem.fields), bool)
        n_own = np.zeros(len(cloud), int)
        for group in groups:
            held[group.ids[:, None], list(group.held)] = True
            n_own[group.ids] = group.n_rows + len(group.held)
        images, partner = periodic_images(problem, cloud, np.asarray(held.all(axis=1)))
        held[partner != np.arange(len(cloud))] = True
        if len(images.owner) and scheme.method in ("I", "II"):
            raise ValueError(f"method: {scheme.method} does not follow periodic conditions; use S, III or SSPH")
        around = lambda: walls_of(problem, cloud, images, part)  # the same for all orders
        walls, found = around() if part is not None else kept(cloud, ("walls", pairs), around), stencils
        if found is None:
            conditioned = np.flatnonzero((n_own > 0) & ~held.all(axis=1))
            found = find_stencils(cloud, kernel, scheme, images, conditioned, walls, part)
        elif len(found) != len(cloud):
            raise ValueError(
                f"stencils: built for {len(found)} particles, the cloud has {len(cloud)}; build them again"
            )
        elif found.radius is not None and not is_traced(found):  # those of a former solve were looked at then
            found = seen(found, None, walls)
        free = ~held.reshape(-1)
        unknowns = np.where(free, np.cumsum(free) - 1, -1).reshape(held.shape)[partner]
        return Placed(held, partner, images, n_own, walls, found, unknowns, [])

    given = [] if stencils is None else jax.tree.leaves(stencils)
    large = part is not None or sum(x.nbytes for x in given) > _LARGE
    if large or is_traced(given) or (stencils is None and kernel is not None):
        return place()
    numbers = tuple((x.shape, x.dtype.str, x.tobytes()) for x in map(np.asarray, given))
    return kept(cloud, (scheme, conditions, pairs, numbers), place)


def mean_spacing(disc: Discretization) -> float:
    """The edge of the cube that each particle has for itself."""
    if disc.part is not None:
        return disc.part.spacing
    points = np.asarray(concrete(disc.cloud.points))
    return float((np.prod(np.ptp(points, axis=0)) / len(points)) ** (1.0 / disc.rec.dim))


def refuse_jumps(disc: Discretization, problem: Problem, slots: Any = None) -> None:
    """Refuse a problem whose operator differentiates a jump inside of the cloud.

    slots (S, N): the derivatives of the field that decide where the branches depend on them.
    """
    near = disc.stencils.indices
    if slots is None:  # periodic images have no values of their own
        found = disc.traced.jumps(disc.points, near, params=problem.params)
    else:
        found = disc.traced.jumps(disc.cloud.points, disc.images.owners(near), params=problem.params, slots=slots)
    if found is not None:
        raise ValueError(f"pde: {found}")


def sorted_classes(disc: Discretization, ids: np.ndarray, stencils: Stencils) -> list[Class]:
    """The particles ``ids`` sorted by the number of their own conditions and the width of their stencils."""
    near = stencils.indices
    if is_traced(near):
        wide = np.zeros(len(ids), bool)
        used = [near.shape[1]] * 2
    else:
        counts = np.max(np.where(near[ids] >= 0, np.arange(near.shape[1]), 0), axis=1, initial=0) + 1
        narrow = _most_need(counts, disc.part)
        wide = counts > 1.25 * narrow
        widest = [int(counts[~wide].max(initial=1)), int(near.shape[1])]
        if disc.part is not None:
            widest = list(disc.part.largest(dict(enumerate(widest))).values())
        used = [_width_at_hand(disc.scheme, rounded_width(width)) for width in widest]
        near = np.pad(near, ((0, 0), (0, max(0, max(used) - near.shape[1]))), constant_values=-1)
    classes = []
    for k, width in enumerate(used):
        some = ids[wide == k]
        if len(some):
            classes += split(disc, Class(some, near[some, :width], disc.scheme, bool(k)))
    return classes


def _most_need(counts: np.ndarray, part: Part | None) -> int:
    """How many neighbours four fifths of all particles have at the most."""
    if part is None:
        return int(np.sort(counts)[4 * (len(counts) - 1) // 5]) if len(counts) else 1
    widest = part.largest({"": int(counts.max(initial=1))})[""]
    upto = part.total(np.bincount(counts, minlength=widest + 1)).cumsum()
    return int(np.searchsorted(upto, 4 * (upto[-1] - 1) // 5, side="right"))


def split(disc: Discretization, cls: Class) -> list[Class]:
    """The particles of a class sorted by the number of their own conditions and of the rows that count."""
    own = disc.n_own[cls.ids] - (0 if disc.dropped is None else disc.dropped[cls.ids])
    lost = np.zeros(len(cls.ids), int) if disc.lost is None else disc.lost[cls.ids]
    parts = []
    for count, less in sorted(set(zip(own.tolist(), lost.tolist()))):
        at = np.flatnonzero((own == count) & (lost == less))
        scheme = cls.scheme.with_own(count, less)
        parts.append(Class(cls.ids[at], cls.neighbours[at], scheme, cls.wide))
    return parts


def rounded_width(width: int, step: int = 4) -> int:
    """Widths of stencils come in steps, so that another support seldom needs another program."""
    return width if width <= 5 else -(-width // step) * step


# The widths that programs of a scheme were asked for; forgotten ones only compile again.
_widths: dict[Scheme, set[int]] = {}
_MOST_SCHEMES = 256


def _width_at_hand(scheme: Scheme, width: int) -> int:
    """This width, or one little larger that another cloud had: it finds its program compiled.

    In 3D, where widths vary more and compiling takes longer, up to a quarter larger; else an eighth.
    """
    if len(_widths) >= _MOST_SCHEMES:
        _widths.clear()
    most = (1.25 if scheme.rec.dim == 3 else 1.125) * width
    return at_hand(_widths.setdefault(scheme, set()), width, most, width)


def table(disc: Discretization) -> Any:
    """All stencils in one padded array (N, w), repaired ones too."""
    near = disc.stencils.indices
    if is_traced(near) or not disc.classes:
        return near
    width = max(near.shape[1], *(c.neighbours.shape[1] for c in disc.classes))
    out = np.full((len(near), width), -1, np.int32)
    out[:, : near.shape[1]] = near
    for c in disc.classes:
        out[c.ids] = -1
        out[c.ids, : c.neighbours.shape[1]] = c.neighbours
    return out


def _conditions_layout(groups: list[Group], rec: Recursion) -> dict[str, Any]:
    """The slots of all own conditions, and of those that only neighbours can use.

    A particle has one equation for every field. What a group has more than that (the slope of a clamped plate, whose
    values are held, the moment beside the shear force of a free end) reaches the others as data of the neighbours.
    """
    zero = (0,) * rec.dim
    own = tuple(dict.fromkeys(slot for g in groups for slot in [*((k, zero) for k in g.held), *g.slots]))
    passed = [g for g in groups if crowded(g, rec)]
    data = tuple(dict.fromkeys(slot for g in passed for slot in g.slots))
    return {"own": own, "data": data, "n_data": max((g.n_rows for g in passed), default=0)}


def crowded(group: Group, rec: Recursion) -> bool:
    """Whether a group has more conditions than its particles have equations to carry them."""
    return bool(group.parts) and len(group.held) + group.n_rows > rec.fields


def _traced(problem: Problem, dim: int) -> Traced:
    """The residual recorded; whatever goes wrong in it is said to be the pde's."""
    if isinstance(problem.pde, Traced):
        return problem.pde
    expected = "pde(u, x)" if problem.params is None else "pde(u, x, params)"
    try:
        inspect.signature(problem.pde).bind(*([None] * (2 if problem.params is None else 3)))
    except TypeError as error:
        raise ValueError(
            f"pde: {error}; it is called as {expected}, with params last where the problem has them"
        ) from None
    except ValueError:  # a callable without a signature
        pass
    try:
        return trace(problem.pde, dim, problem.fields, params=problem.params)
    except IN_FUNCTIONS as error:
        raise ValueError(of_the_pde(error)) from error


def _check_operator(traced: Traced, problem: Problem, order: int) -> None:
    if traced.n_equations != problem.fields:
        raise ValueError(
            f"pde: returns {traced.n_equations} residual(s) for fields={problem.fields}; "
            "a system of F fields needs F residuals"
        )
    if any(f >= RATE for f, _ in traced.slots):
        raise ValueError("pde: js.dt(u) is a rate in time, of which a steady problem knows nothing; use js.evolve")
    for e, m in enumerate(traced.order):
        if m < 0:
            raise ValueError(f"pde: residual {e} does not depend on u; use u(x), js.grad(u)(x), js.laplacian(u)(x) ...")
        if m > order:
            raise ValueError(
                f"order: {order} is below the order {m} of the equation; use order={m} or more (even orders pay)"
            )
    for k in range(problem.fields):
        if not any(f == k for f, _ in traced.slots):
            raise ValueError(f"pde: field {k} appears in no equation; lower fields={problem.fields} or use it")


def _scheme(method: str, rec: Recursion, traced: Traced, problem: Problem, cloud: Cloud, basis_terms: Any) -> Scheme:
    """The method and its free coefficients."""
    if method in ("S", "SSPH"):
        if basis_terms is not None:
            raise ValueError(f"basis_terms: only I, II and III keep single free coefficients, not method={method!r}")
        return Scheme(method, rec)
    if problem.fields > 1:
        raise ValueError(f'method: {method} treats one field, the problem has {problem.fields}; use method="S"')
    slots = None if traced.linear else np.zeros((len(traced.slots), 1, len(cloud)))
    jac, _ = traced.coefficients(cloud.points, 0, params=problem.params, slots=slots)
    jac = None if is_traced(jac) else np.asarray(jac)[0, :, 0]
    free, dependent = free_indices(rec, jac)
    if basis_terms is not None:
        whole = is_whole(basis_terms)
        if not whole or not 1 <= basis_terms <= len(free):
            raise ValueError(
                f"basis_terms: expected 1 to {len(free)} free coefficients at this order, got {basis_terms!r}"
            )
        free = free[:basis_terms]
    return Scheme(method, rec, tuple(map(int, free)), tuple(map(int, dependent)))
