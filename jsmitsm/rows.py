"""The rows and the Taylor coefficients of all particles, class by class."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm import assembly, moments
from jsmitsm.assembly import Operands
from jsmitsm.closure import Recovery
from jsmitsm.eager import in_one_program
from jsmitsm.kernels import Kernel
from jsmitsm.layout import Class, Discretization
from jsmitsm.moments import Elimination, Row
from jsmitsm.neighbours import nearest, within
from jsmitsm.numbers import Numbers
from jsmitsm.progress import each, shown
from jsmitsm.repeats import SMALLEST, Repeats, repeats
from jsmitsm.supports import default_kernel
from jsmitsm.threads import cores, side_by_side
from jsmitsm.tracers import closes_over_traced, is_traced, recorded

# Particles that the cores share in pieces, between whose ends a progress bar moves. Every piece costs a millisecond, so
# it has some four of work: _WORK entries of matrices to be made, about.
PIECE, MOST_PIECES, _WORK = 16384, 32, 1_200_000
# Bytes of an array that takes longer to copy than to be sent apart.
_LARGE = 1 << 20
# What the systems of other methods take, measured by those of S.
_TIMES = {"I": 8, "II": 8, "III": 4}
# Lengths that share an elimination differ by less than this ratio; particles that each elimination must serve.
_STEP, _WORTH = 1.25, 50


class Around(NamedTuple):
    """What particles look up of the whole cloud, padded once for all pieces: (M, ...) with periodic images."""

    points: Any
    kernel: Kernel | None
    data: Any


def around(disc: Discretization, nums: Numbers) -> Around:
    """What the particles of all classes look up."""
    given = disc.points, disc.kernel, disc.images.extend_values(nums.data)
    return Around(*_sent(assembly.in_cloud_size(given, len(disc.points))))


def _sent(tree: Any) -> Any:
    """Large arrays sent to the device once, not again with every piece."""
    large = lambda x: isinstance(x, np.ndarray) and x.nbytes > _LARGE  # noqa: E731
    return jax.tree.map(lambda x: jax.device_put(x) if large(x) else x, tree)


def operands(disc: Discretization, nums: Numbers, cls: Class, shared: Elimination | None, data: Any) -> Operands:
    """What the particles of a class need; the particle axis first."""
    ids, jac, lengths = cls.ids, nums.jac, None
    if jac.shape[-1] > 1:
        jac = _particles_first(jac, np.searchsorted(nums.ids, ids), len(ids))
    elif shared is not None:
        jac = np.zeros((1, 1, 1, 1))
    else:
        some = _eliminations(disc, nums, cls)
        if some is None:
            jac = _particles_first(jac, None, 1)
        else:
            shared, lengths, jac = some
    return Operands(jac, _own_conditions(nums, cls), data, shared, lengths)


def _own_conditions(nums: Numbers, cls: Class) -> Any:
    """The conditions of the particles of a class, (n, n_own, S_own)."""
    if not cls.scheme.n_own:
        return np.zeros((len(cls.ids), 0, len(cls.scheme.own)))
    return _first_columns(nums.own, np.searchsorted(nums.own_ids, cls.ids), cls.scheme.n_own)


def _eliminations(disc: Discretization, nums: Numbers, cls: Class) -> tuple[Elimination, np.ndarray, np.ndarray] | None:
    """A constant operator of terms of several orders (laplacian(u) + k^2 u): one elimination for each of a few lengths.

    Returns the eliminations (B, ...), their lengths (B,) and each particle's number (n,); None where that does not pay,
    and where something is traced.
    """
    points, near, kernel = disc.points, cls.neighbours, disc.kernel
    if not disc.traced.constant or cls.scheme.method != "S" or is_traced(points, near, kernel, nums.jac):
        return None
    if isinstance(nums.jac, jax.Array):
        return None
    own = default_kernel(points, cls.ids, near) if kernel is None else kernel.at(cls.ids)
    length = np.broadcast_to(np.asarray(own.length), cls.ids.shape)
    if not (length > 0).all():
        return None
    steps, place = np.unique(np.rint(np.log(length) / np.log(_STEP)).astype(int), return_inverse=True)
    if len(cls.ids) < _WORTH * len(steps):
        return None
    disc.lengths = max(disc.lengths, len(steps))
    # One program for any number of lengths up to the next power of two.
    steps = np.concatenate([steps, np.full(max(4, 1 << (len(steps) - 1).bit_length()) - len(steps), steps[-1])])
    lengths = float(_STEP) ** steps
    made = [moments.eliminate_on_host(cls.scheme, nums.jac[..., 0], float(x)) for x in lengths]
    return Elimination(*(np.stack(part) for part in zip(*made))), lengths, place


def shared_elimination(disc: Discretization, nums: Numbers) -> Elimination | None:
    """One elimination for all particles, where the operator allows it."""
    if not (disc.traced.constant and disc.rec.scale_free):
        return None
    if is_traced(nums.jac) or isinstance(nums.jac, jax.Array):
        return moments.eliminate(disc.scheme, jnp.asarray(nums.jac[..., 0]), 1.0)
    return moments.eliminate_on_host(disc.scheme, nums.jac[..., 0])


def all_rows(disc: Discretization, nums: Numbers) -> tuple[list[Class], list[Row]]:
    """The rows of all particles: of every class in its pieces, with the neighbours that the rows reach."""
    shared = shared_elimination(disc, nums)
    if disc.scheme.method in ("I", "II"):
        return _two_stage_rows(disc, nums, shared)
    found = [_repeats(disc, nums, cls) for cls in disc.classes]
    distinct = [cls if same is None else same.few(cls) for cls, same in zip(disc.classes, found)]
    cut = pieces(disc, nums, distinct)
    made = iter(_piece_rows(disc, nums, [piece for some in cut for piece in some], shared))
    classes, rows = [], []
    for cls, same, some in zip(disc.classes, found, cut):
        parts = list(islice(made, len(some)))
        if same is None:
            classes += some
            rows += parts
        else:
            disc.repeated += len(cls.ids) - len(same.first)
            classes.append(replace(cls, neighbours=same.neighbours))
            rows.append(jax.tree.map(lambda x, of=same.of: x[of], _joined(parts)))
    return classes, rows


def _repeats(disc: Discretization, nums: Numbers, cls: Class) -> Repeats | None:
    """Repeated stencils of a constant operator, which are set up once."""
    if _work(nums, cls) < SMALLEST or nums.jac.shape[-1] > 1 or cls.scheme.n_data:
        return None
    one_size = disc.kernel is None or (not is_traced(disc.kernel) and np.ndim(disc.kernel.h) == 0)
    own = _own_conditions(nums, cls)
    if not one_size or is_traced(cls.neighbours, disc.points, own):
        return None
    return repeats(np.asarray(disc.points), cls.ids, cls.neighbours, np.asarray(own))


def _two_stage_rows(disc: Discretization, nums: Numbers, shared: Any) -> tuple[list[Class], list[Row]]:
    """Methods I and II: recover every particle's coefficients, then insert them into the rows."""
    there = around(disc, nums)
    wide, far = _recovery_kernel(disc)
    wide = assembly.in_cloud_size(wide, len(far))
    conditioned = np.zeros(len(disc.cloud), int)
    for group in disc.groups:
        conditioned[group.ids] = 0 if group.held else group.n_rows
    wholes = []
    for count in np.unique(conditioned):
        ids = np.flatnonzero(conditioned == count)
        wholes.append(Class(ids, far[ids], replace(disc.scheme, n_own=int(count))))

    def recoveries(cls: Class) -> Recovery:
        given, sides = operands(disc, nums, cls, shared, there.data), right_sides(disc, nums, cls)
        return assembly.recoveries(cls.scheme, there.points, wide, cls.ids, cls.neighbours, given, sides)

    cut = in_pieces(disc, nums, wholes)
    parts = _on_all_cores("recoveries", recoveries, disc, nums, cut)
    xp = jnp if is_traced(parts) else np
    back = np.argsort(np.concatenate([cls.ids for cls in cut]))
    recovered = jax.tree.map(lambda *x: xp.concatenate(x)[back], *parts)
    reach = _reach(disc.stencils.indices, far)
    known = _sent(assembly.in_cloud_size((far, recovered), len(far)))

    def closed(cls: Class) -> Row:
        given, reached = operands(disc, nums, cls, shared, there.data), (reach[cls.ids],)
        return assembly.closed_rows(
            cls.scheme, there.points, there.kernel, cls.ids, cls.neighbours, given, reached, known
        )

    classes = in_pieces(disc, nums, disc.classes)
    made = _on_all_cores("local fits", closed, disc, nums, classes)
    return [replace(cls, neighbours=reach[cls.ids]) for cls in classes], made


def _reach(near: Any, far: Any) -> np.ndarray:
    """The neighbours of every particle's neighbours, those included: (N, w), -1 for none."""
    n = len(near)
    if is_traced(near, far):  # nothing is known of them but that they are in the cloud
        return np.broadcast_to(np.arange(n), (n, n))
    one, two = (_pattern(np.asarray(x), n) for x in (near, far))
    both = (one @ two + one).tocsr()
    both.sort_indices()
    count = np.diff(both.indptr)
    out = np.full((n, count.max()), -1, np.int32)
    out[np.arange(out.shape[1]) < count[:, None]] = both.indices
    return out


def _pattern(near: np.ndarray, n: int) -> Any:
    """Who is whose neighbour, as a sparse matrix (N, N) of ones."""
    from scipy.sparse import csr_matrix

    i, k = np.nonzero(near >= 0)
    return csr_matrix((np.ones(len(i), np.float32), (i, near[i, k])), (n, n))


# Smoothing lengths at which a Gauss function has fallen to 1e-4: a fit without LAPACK forms its normal
# equations, which in float32 cannot use much less.
_FAR = 3.0


def _recovery_kernel(disc: Discretization) -> tuple[Kernel, Any]:
    """The kernel of stage 1 and its neighbours: wide enough to hold 1.5 times the free coefficients."""
    points, kernel, near = disc.points, disc.kernel, disc.stencils.indices
    assert kernel is not None  # layout gives I and II one
    count = math.ceil(1.5 * len(disc.scheme.free)) + 1
    if disc.given_stencils or is_traced(near, points, kernel):
        xp = jnp if is_traced(near, points) else np
        near, points = xp.asarray(near), xp.asarray(points)
        away = xp.where(near >= 0, xp.sum((points[xp.maximum(near, 0)] - points[:, None]) ** 2, axis=2), xp.inf)
        reach = xp.sqrt(xp.sort(away, axis=1)[:, min(count, near.shape[1]) - 1])
        reach = xp.where(xp.isfinite(reach), reach, 0.0)
    else:
        near = None
        reach = nearest(np.asarray(points), min(count, len(points))).radius
    xp = jnp if is_traced(reach, kernel) else np
    # Inside the support, and where the weight is not yet lost to rounding.
    wide = kernel.replace(h=xp.maximum(kernel.h, reach / xp.minimum(0.9 * kernel.d, _FAR)))
    if near is None:
        near = within(np.asarray(points), np.maximum(kernel.h * np.asarray(kernel.d), reach / 0.9)).indices
    return wide, near


def pieces(disc: Discretization, nums: Numbers, classes: list[Class], *more: Any) -> list[list[Class]]:
    """Every class in pieces of about one size (one program serves all), for the cores to share or a bar to move."""
    if not _to_share(disc, nums, classes, *more) or not (shown() or (cores() > 1 and jax.default_backend() == "cpu")):
        return [[cls] for cls in classes]
    total, worth = _total(classes), _worth(nums, classes)
    rounds = -(-min(-(-total // PIECE), MOST_PIECES) // cores())  # as many pieces for each core
    return [_cut(cls, max(-(-total // (rounds * cores())), worth)) for cls in classes]


def in_pieces(disc: Discretization, nums: Numbers, classes: list[Class], *more: Any) -> list[Class]:
    """The pieces of all classes."""
    return [piece for some in pieces(disc, nums, classes, *more) for piece in some]


def _total(classes: list[Class]) -> int:
    return sum(len(cls.ids) for cls in classes)


def _worth(nums: Numbers, classes: list[Class]) -> int:
    """The least number of particles worth a piece of their own."""
    return min(PIECE, _WORK // max((_work(nums, cls) for cls in classes), default=1) + 1)


def _to_share(disc: Discretization, nums: Numbers, classes: list[Class], *more: Any) -> bool:
    """Whether the classes are worth several cores; not where JAX traces something, which this thread alone may do."""
    if _total(classes) < 2 * _worth(nums, classes) or recorded():
        return False
    if is_traced(disc.points, disc.kernel, vars(nums), [cls.neighbours for cls in classes], more):
        return False
    return disc.kernel is None or not closes_over_traced(disc.kernel.tree_flatten()[1])


def _work(nums: Numbers, cls: Class) -> int:
    """How much the system of one particle is to make, in numbers."""
    columns = cls.scheme.rec.size * cls.scheme.rec.fields
    matrix = cls.neighbours.shape[1] * columns * _TIMES.get(cls.scheme.method, 1)
    return matrix + (columns**3 // 4 if nums.jac.shape[-1] > 1 else 0)


def _cut(cls: Class, size: int) -> list[Class]:
    """A class in equal pieces of about this size; one that is a piece already stays as it is."""
    n = len(cls.ids)
    step = -(-n // max(1, round(n / size)))
    cuts = [slice(start, start + step) for start in range(0, n, step)]
    return [replace(cls, ids=cls.ids[some], neighbours=cls.neighbours[some]) for some in cuts]


def _on_all_cores(
    what: str, one: Any, disc: Discretization, nums: Numbers, classes: list[Class], *more: Any
) -> list[Any]:
    """``one`` of all classes, or pieces of them, side by side where nothing is traced."""

    def program(cls: Class) -> Any:
        sizes = assembly.cloud_size(len(disc.points)), assembly.padded_size(len(cls.ids), 4), cls.neighbours.shape[1]
        return what, cls.scheme, sizes, disc.kernel is None

    mapped = partial(side_by_side, program=program) if _to_share(disc, nums, classes, *more) else map
    return each(what, one, classes, mapped)


def _joined(parts: list[Any]) -> Any:
    """Pytrees with the particle axis first, one after another."""
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _piece_rows(disc: Discretization, nums: Numbers, cut: list[Class], shared: Any) -> list[Row]:
    """The rows of pieces of classes."""
    there = around(disc, nums)

    def one(cls: Class) -> Row:
        given = operands(disc, nums, cls, shared, there.data)
        return assembly.rows(cls.scheme, there.points, there.kernel, cls.ids, cls.neighbours, given)

    return _on_all_cores("local fits", one, disc, nums, cut)


def class_rows(disc: Discretization, nums: Numbers, cls: Class, shared: Any) -> Row:
    """The rows of one class of particles."""
    return _joined(_piece_rows(disc, nums, in_pieces(disc, nums, [cls]), shared))


def class_moment_matrices(disc: Discretization, nums: Numbers, cls: Class, shared: Any) -> Any:
    """The moment matrices (n, rows, free) of one class of particles."""
    there = around(disc, nums)
    given = operands(disc, nums, cls, shared, there.data)
    return assembly.moment_matrices(cls.scheme, there.points, there.kernel, cls.ids, cls.neighbours, given)


def right_sides(disc: Discretization, nums: Numbers, cls: Class) -> tuple[Any, Any]:
    """The recursion's right-hand side (n, rows) and the own conditions' values (n, n_own)."""
    n, source = len(cls.ids), nums.source
    here = np.searchsorted(nums.ids, cls.ids) if source.shape[1] > 1 else None
    source = _particles_first(source, here, n)
    if not cls.scheme.n_own:
        return source, np.zeros((n, 0))
    return source, _first_columns(nums.given, np.searchsorted(nums.own_ids, cls.ids), cls.scheme.n_own)


@partial(in_one_program, static=("n",))
def _particles_first(values: Any, here: np.ndarray | None, n: int) -> Any:
    """The n particles ``here`` of an array with the particle axis last, that axis first; None: one serves all."""
    xp = jnp if is_traced(values) else np
    values = xp.asarray(values)
    chosen = xp.broadcast_to(values, (*values.shape[:-1], n)) if here is None else values[..., here]
    return xp.moveaxis(chosen, -1, 0)


@partial(in_one_program, static=("count",))
def _first_columns(values: Any, here: np.ndarray, count: int) -> Any:
    return values[here, :count]


def all_coefficients(disc: Discretization, nums: Numbers, values: Any) -> Any:
    """Taylor coefficients (N, F, K) of the particles of all classes, from all values u (N, F); zeros elsewhere."""
    shared, there = shared_elimination(disc, nums), around(disc, nums)
    known = disc.images.extend_values(values), disc.images.extend_values(nums.gamma)
    known = _sent(assembly.in_cloud_size(known, len(disc.points)))

    def one(cls: Class) -> Any:
        given = operands(disc, nums, cls, shared, there.data)
        sides = right_sides(disc, nums, cls)
        return assembly.coefficients(
            cls.scheme, there.points, there.kernel, cls.ids, cls.neighbours, given, sides, known
        )

    cut = in_pieces(disc, nums, disc.classes, values)
    parts = _on_all_cores("Taylor coefficients", one, disc, nums, cut, values)
    shape = (len(disc.cloud), disc.rec.fields, disc.rec.size)
    return _scattered(parts, np.concatenate([c.ids for c in cut]), disc.partner, shape)


@partial(in_one_program, static=("shape",))
def _scattered(parts: list[Any], ids: np.ndarray, partner: np.ndarray, shape: tuple[int, ...]) -> Any:
    """The coefficients of all classes at their particles, and every particle's taken from its partner."""
    if is_traced(parts):
        return jnp.zeros(shape).at[ids].set(jnp.concatenate(parts))[partner]
    out = np.zeros(shape)
    out[ids] = np.concatenate([np.asarray(p) for p in parts])
    return out[partner]
