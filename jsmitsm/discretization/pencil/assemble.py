"""The pencil of a problem on a cloud: sparse A, B and Bg with A u = B f + Bg g."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.neighbours import Stencils
from jsmitsm.discretization.coefficients import Numbers, numbers
from jsmitsm.discretization.layout import Class, Discretization, discretize
from jsmitsm.discretization.local_data import shared_elimination
from jsmitsm.discretization.pencil import kept
from jsmitsm.discretization.pencil.grades import Fitness, graded, told
from jsmitsm.discretization.pencil.local import Part, part_of, source_stencil_size, source_stencils
from jsmitsm.discretization.pencil.sparse import Sparse
from jsmitsm.equation.problem import Problem
from jsmitsm.runtime.errors import SolveError, some
from jsmitsm.runtime.tracers import concrete, is_traced
from jsmitsm.runtime.whole_program import in_one_program

# The depth that is taken for "auto", by the dimension.
_DEPTH = {1: 2, 2: 2, 3: 0}
# What of a problem's numbers may be traced.
_NUMBERS = ("jac", "source", "own", "given", "held", "data", "gamma")


class Layout:
    """What of a pencil is static: who the neighbours are, and what was found when they were chosen."""

    def __init__(
        self, disc: Any, classes: Sequence[tuple[Class, np.ndarray | None]], fitness: Fitness | None
    ):
        self.disc, self.classes, self.fitness = disc, classes, fitness


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["A", "B", "Bg", "held_values", "conditions"],
    meta_fields=["free", "held", "slaved", "health", "layout"],
)
@dataclass
class Pencil:
    """A u = B f + Bg g over all N F values; u and f are numbered particle by particle, k F + field.

    L is the linear part of the residual as it was written, and f = L u: of -laplacian(u)(x) it is minus the
    Laplacian. Rows without an equation (of held values) are empty.

    Attributes
    ----------
    A, B : (N F, N F). Of f every particle's values take part, those of held particles too; a column belongs to
        particle and equation. At p = m B is diagonal.
    Bg : (N F, G), the columns of the conditions' values.
    held_values : (N, F), the values u of the held, zero elsewhere.
    conditions : (G,), the values g of all other conditions; with the held ones again, where a particle has both.
    free, held : numbers of the values with an equation, and of those that conditions hold. Values that periodic
        partners lend are neither: columns name the lender (``layout.disc.partner``).
    slaved : numbers among ``free`` of the particles that follow their neighbours: u_i - sum v_g u_g = Bg g, rows of A
        without an entry in B. For u_t = L u they are algebraic equations.
    health : in words, what was repaired and what stays.
    """

    A: Sparse
    B: Sparse
    Bg: Sparse
    held_values: Any
    conditions: Any
    free: np.ndarray
    held: np.ndarray
    slaved: np.ndarray
    health: tuple[str, ...]
    layout: Layout

    __hash__ = object.__hash__


def assemble_pencil(
    problem: Problem, cloud: Cloud, *, order: int, mass: Sequence[bool] | None = None,
    stencils: Stencils | None = None, depth: int | str = 0, taylor: Any = None,
) -> Pencil:  # fmt: skip
    """The pencil of a linear problem, or of one that is linearised at the expansions ``taylor`` (N, F, K).

    mass (F,): which equations have a source that matters (u_t, or lambda u); all, if not given. stencils: the user's,
    which are not repaired. depth: degrees beyond the order of both the recursion and the fit of the source; "auto" is
    2 in 1D and 2D, where errors of values were 30 to 400 times smaller and no mode grew in time, 0 in 3D, where the
    source's stencils would be too wide, and where given ones are too narrow for it or the cloud has too few particles.

    Raises ValueError for stencils that are too narrow, SolveError for rows that determine nothing.
    """
    free, depth = depth == "auto", default_depth(depth, cloud.dim)
    disc = discretize(problem, cloud, "S", order, None, stencils, None, depth=depth)
    if free and stencils is not None and _narrowest(stencils) < source_stencil_size(disc.rec, 0):
        disc = discretize(problem, cloud, "S", order, None, stencils, None, depth=0)
    if taylor is None and not disc.linear:
        raise ValueError(
            "problem: its pde or a condition is nonlinear in u, but a pencil, and modes, are those of a linear "
            "operator; linearise it about a state first"
        )
    nums = numbers(disc, disc.problem, taylor)
    massed = np.ones(problem.fields, bool) if mass is None else np.asarray(mass, bool)
    made = kept.found(disc, nums, massed)
    if made is not None:
        layout = Layout(disc, made.layout.classes, made.layout.fitness)
        return replace(made, held_values=nums.held, conditions=condition_values(nums), layout=layout)
    try:
        made = pencil_of(*laid_out(disc, nums, massed), nums)
    except SolveError:
        if not free or not disc.rec.depth:
            raise
        return assemble_pencil(problem, cloud, order=order, mass=mass, stencils=stencils, depth=0, taylor=taylor)
    layout = Layout(None, made.layout.classes, made.layout.fitness)  # without the cloud, which must not live by it
    kept.keep(disc, nums, massed, replace(made, held_values=None, conditions=None, layout=layout))
    return made


def default_depth(depth: int | str, dim: int) -> int:
    """The depth that is meant by "auto"."""
    return _DEPTH[dim] if isinstance(depth, str) else depth


def _narrowest(stencils: Stencils) -> int:
    """The least number of neighbours; those of traced stencils are not counted."""
    index = stencils.indices
    return index.shape[1] if is_traced(index) else int((np.asarray(index) >= 0).sum(axis=1).min())


def laid_out(disc: Discretization, nums: Numbers, massed: np.ndarray) -> tuple[Layout, list[Part] | None]:
    """Neighbours of all rows and sources, chosen by what the numbers are now where they are known.

    The rows too, where nothing is traced.
    """
    if is_traced(disc.stencils.indices):
        raise ValueError(
            "stencils: they are traced by a JAX transform, and those of the sources are found on the host; let the "
            "function close over js.stencils(cloud, size=...) instead of taking it as an argument"
        )
    still, known = _stilled(disc, nums)
    if concrete(disc.cloud.points) is None:
        pairs = [(cls, _given(disc, cls)) for cls in disc.classes]
    else:
        pairs = [(cls, _far(still, cls)) for cls in disc.classes]
    if known is None:
        return Layout(disc, pairs, None), None
    shared = shared_elimination(still, known)
    parts = [part_of(still, known, cls, far, shared) for cls, far in pairs]
    parts, fitness = graded(still, known, parts, massed, not disc.given_stencils, shared)
    if len(fitness.undetermined):
        bad = np.sort(fitness.undetermined)
        raise SolveError(
            f"the moment systems of {len(bad)} particle(s) do not determine the solution, first {some(bad)}: too few "
            "neighbours, or neighbours in a special position; widen the stencils, lower the order, or move the "
            "particles",
            [int(i) for i in bad[:100]],
        )
    layout = Layout(disc, [(part.cls, part.far) for part in parts], fitness)
    return layout, None if is_traced(disc.cloud, [getattr(nums, name) for name in _NUMBERS]) else parts


def _far(disc: Discretization, cls: Class) -> np.ndarray:
    """The neighbours of a class whose sources take part."""
    if disc.given_stencils:
        return _given(disc, cls)
    size = source_stencil_size(disc.rec, cls.neighbours.shape[1])
    return source_stencils(disc, cls.ids, size, disc.rec.degree, strict=disc.part is None)


def _given(disc: Discretization, cls: Class) -> np.ndarray:
    """The user's stencils serve the sources too, where they are wide enough."""
    size = source_stencil_size(disc.rec, 0)
    if size <= 1:
        return cls.neighbours[:, :1]
    width = (cls.neighbours >= 0).sum(axis=1)
    if width.min() < size:
        raise ValueError(
            f"stencils: particle {int(cls.ids[width.argmin()])} has {int(width.min())} neighbours, but the source's "
            f"fit at this order takes {size}; build js.stencils(cloud, size={size}) or larger"
        )
    return cls.neighbours


def _stilled(disc: Discretization, nums: Numbers) -> tuple[Discretization, Numbers | None]:
    """The same with the numbers behind what only carries derivatives; None for numbers that are not known."""
    points, normals = (concrete(x) for x in (disc.cloud.points, disc.cloud.normals))
    if points is None:
        return disc, None
    if is_traced(disc.cloud):
        still = replace(disc, cloud=Cloud(np.asarray(points), disc.cloud.groups, normals))
    else:
        still = disc
    values: dict[str, Any] = {name: concrete(getattr(nums, name)) for name in _NUMBERS}
    if any(value is None for value in values.values()):
        return still, None
    values = {name: np.asarray(value) for name, value in values.items()}
    return still, replace(nums, **values)


def pencil_of(layout: Layout, parts: list[Part] | None, nums: Numbers) -> Pencil:
    """The pencil with these neighbours and numbers; ``parts``: its rows, where they are made already."""
    disc, fitness = layout.disc, layout.fitness
    if parts is None:
        shared = shared_elimination(disc, nums)
        parts = [part_of(disc, nums, cls, far, shared) for cls, far in layout.classes]
    n = len(disc.cloud) * disc.rec.fields
    entries: dict[str, list[tuple[Any, np.ndarray, np.ndarray]]] = {"A": [], "B": [], "Bg": []}
    for part in parts:
        for name, value, rows, cols in _entries(disc, nums, part):
            entries[name].append((value, rows, cols))
    free = np.flatnonzero(~disc.held)
    entries["A"].append((np.ones(len(free)), free, free))
    given, gamma = nums.given, nums.gamma
    columns = int(np.prod(given.shape)) + int(np.prod(gamma.shape))
    lent = disc.held & (disc.partner != np.arange(len(disc.cloud)))[:, None]
    following = [cls.ids for cls, far in layout.classes if far is None]
    slaved = np.zeros(disc.held.shape, bool)
    slaved[np.concatenate([np.zeros(0, int), *following])] = True
    return Pencil(
        _sparse(entries["A"], (n, n)), _sparse(entries["B"], (n, n)), _sparse(entries["Bg"], (n, columns)),
        nums.held, condition_values(nums), free, np.flatnonzero(disc.held & ~lent),
        np.flatnonzero(slaved & ~disc.held), tuple(told(fitness)) if fitness else (), layout,
    )  # fmt: skip


def condition_values(nums: Numbers) -> Any:
    """The values g (G,) of all conditions, those of every particle's own first, then those that neighbours use."""
    xp = jnp if is_traced(nums.given, nums.gamma) else np
    return xp.concatenate([xp.asarray(nums.given).reshape(-1), xp.asarray(nums.gamma).reshape(-1)])


def _entries(disc: Discretization, nums: Numbers, part: Part) -> list[tuple[str, Any, np.ndarray, np.ndarray]]:
    """What a part adds to the matrices: the name, all entries, and the places of those that count (-1: none)."""
    cls, row = part.cls, part.row
    fields, ids = disc.rec.fields, cls.ids
    own = np.where(disc.held[ids], -1, ids[:, None] * fields + np.arange(fields))  # (n, F)
    near = _values_of(disc, cls.neighbours)
    out = [("A", row.weights, own[:, :, None, None], near[:, None])]
    if part.far is not None:
        out.append(("B", part.sources, own[:, :, None, None], _values_of(disc, part.far)[:, None]))
    most = int(np.shape(nums.given)[1]) if np.ndim(nums.given) > 1 else 0
    if cls.scheme.n_own:
        at = np.searchsorted(nums.own_ids, ids)[:, None] * most + np.arange(cls.scheme.n_own)
        out.append(("Bg", row.condition, own[:, :, None], at[:, None]))
    if cls.scheme.n_data:
        first, owner = int(np.prod(np.shape(nums.given))), disc.images.owners(cls.neighbours)
        at = np.where(owner >= 0, first + owner * cls.scheme.n_data, -1)[..., None]
        at = np.where(at >= 0, at + np.arange(cls.scheme.n_data), -1)
        out.append(("Bg", row.data, own[:, :, None, None], at[:, None]))
    placed = []
    for name, values, r, c in out:
        r, c = (np.broadcast_to(x, np.shape(values)) for x in (r, c))
        keep = np.flatnonzero((r >= 0) & (c >= 0))
        chosen = _kept(values, keep, -1.0 if name == "A" else 1.0)
        placed.append((name, chosen, r.reshape(-1)[keep], c.reshape(-1)[keep]))
    return placed


@partial(in_one_program, static=("sign",))
def _kept(values: Any, keep: np.ndarray, sign: float) -> Any:
    return sign * (values if is_traced(values) else np.asarray(values)).reshape(-1)[keep]


def _values_of(disc: Discretization, near: np.ndarray) -> np.ndarray:
    """The numbers (n, w, F) of the neighbours' values, those of partners where they lend them; -1 for none."""
    owner = disc.images.owners(near)
    lender = disc.partner[np.maximum(owner, 0)]
    fields = disc.rec.fields
    return np.where((owner >= 0)[..., None], lender[..., None] * fields + np.arange(fields), -1)


def _sparse(entries: list[tuple[Any, np.ndarray, np.ndarray]], shape: tuple[int, int]) -> Sparse:
    if not entries:
        return Sparse(np.zeros(0), np.zeros(0, int), np.zeros(0, int), shape)
    values, rows, cols = zip(*entries)
    join = jnp.concatenate if is_traced(values) else np.concatenate
    return Sparse(join(values), np.concatenate(rows), np.concatenate(cols), shape)
