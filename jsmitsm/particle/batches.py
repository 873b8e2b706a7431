"""What is written for one particle, mapped over many: their rows and their Taylor coefficients.

The moment systems are vmapped in blocks that stay in cache.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial, wraps
from inspect import signature
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.particle import closure, devices, moments
from jsmitsm.particle.closure import Recovery
from jsmitsm.particle.elimination import Elimination, Scheme, eliminate
from jsmitsm.particle.kernels import Kernel
from jsmitsm.particle.moments import Block, Row, Support
from jsmitsm.particle.recursion import fit_and_tail, row_lifts
from jsmitsm.particle.source_fit import source_weights
from jsmitsm.runtime import one_kernel
from jsmitsm.runtime.compiled import at_hand
from jsmitsm.runtime.compiler_options import on_cpu
from jsmitsm.runtime.size_classes import BLOCK, FEW, cloud_size, largest_at_hand, open_size, padded_size
from jsmitsm.runtime.tracers import closes_over_traced, is_traced, recorded
from jsmitsm.runtime.whole_program import COUNT, called, in_one_program, only_run

# A GPU is filled by many at once; these take some hundred megabytes.
_WIDE = 8192
# Options of XLA on CPUs. Its matrix products here are too small to share among threads; threads.py does that with whole
# pieces. Up to so many particles a program is compiled with less effort, in a half or a sixth of the time; what that
# costs in running is about a millisecond a call. Large systems take five times as long with the least effort.
_ALONE: Any = {"xla_cpu_multi_thread_eigen": False}
_PLAIN: Any = _ALONE | {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
QUICKLY: Any = _PLAIN | {"xla_backend_optimization_level": 0}
EFFORT = (
    (FEW, QUICKLY),
    (2048, _PLAIN | {"xla_backend_optimization_level": 1}),
    (np.inf, _ALONE),
)
# Fits of so many columns are large.
_LARGE = 28
# Up to so many Taylor coefficients, where all share an elimination, one kernel is faster than many and a library's
# matrix products. Where each particle has its own, it is as often slower and takes up to twice as long to compile.
SMALL = 66

# How often the local phase was compiled; read by the tests.
TRACES = {"rows": 0, "coefficients": 0, "joints": 0}


class Operands(NamedTuple):
    """The numbers behind the rows of n particles.

    jac (n, E, S, T): Taylor coefficients of the operator's coefficients, or (1, E, S, 1) where
    one set serves all, or (n,) the numbers of the eliminations to use; own (n, n_own, S_own): the
    particles' own conditions; data (N, n_data, S_data): the conditions neighbours contribute, of every
    particle of the cloud; shared: an elimination that is the same everywhere, with lifts for unit length,
    or several (B, ...) for the scales ``lengths`` (B,); count (): how many of the particles are wanted.
    """

    jac: Any
    own: Any
    data: Any
    shared: Elimination | None
    lengths: Any = None
    count: Any = None


def in_cloud_size(tree: Any, n: int) -> Any:
    """Arrays of all n particles padded to the size class of the cloud; what is padded is not padded again."""
    return widened(tree, n, cloud_size(n))


def _pad(x: Any, n: int, size: int) -> Any:
    """Repeat the first row until ``size`` rows, where the leading axis has n; others pass."""
    if x is None or np.ndim(x) == 0 or x.shape[0] != n or n == size:
        return x
    xp = np if isinstance(x, np.ndarray) else jnp
    return xp.concatenate([x, xp.broadcast_to(x[:1], (size - n, *x.shape[1:]))])


def widened(tree: Any, n: int, size: int) -> Any:
    """Every array of n particles padded to ``size``; those that are not traced stay on the host."""
    return tree if n == size else _all_padded(tree, n, size)


@partial(in_one_program, static=("n", "size"))
def _all_padded(tree: Any, n: int, size: int) -> Any:
    return jax.tree.map(lambda x: _pad(x, n, size), tree)


@partial(in_one_program, static=("m",))
def cut(tree: Any, m: int) -> Any:
    """The first m particles. On the host where nothing is traced: an eager slice would compile for every length."""
    return jax.tree.map(lambda x: x[:m] if isinstance(x, jax.core.Tracer) else _first(np.asarray(x), m), tree)


def _first(x: np.ndarray, m: int) -> np.ndarray:
    """The first m rows; not a part of a much larger array, which would stay in memory with them."""
    return x[:m] if len(x) <= 1.25 * m else x[:m].copy()


def effort(size: int, columns: int = 0) -> Any:
    """The compiler's options for programs over so many particles, whose fits have so many columns."""
    return on_cpu(next(some for most, some in EFFORT if size + (columns >= _LARGE) <= most))


def _by_row(
    points: Any, kernel: Any, ids: Any, neighbours: Any, given: Operands, each: Any, whole: Any
) -> list[Any]:  # fmt: skip
    """Which of the arguments have a row for each particle of the class; COUNT for the number of these."""
    no, yes = (lambda tree, flag=flag: jax.tree.map(lambda _: flag, tree) for flag in (False, True))
    own = Operands(
        (no if given.jac.shape[0] == 1 else yes)(given.jac), yes(given.own), no(given.data), no(given.shared),
        no(given.lengths), COUNT,
    )  # fmt: skip
    return [no(points), no(kernel), yes(ids), yes(neighbours), own, yes(each), no(whole)]


def _in_size_classes(function: Any) -> Any:
    """Compile ``function(scheme, points, kernel, ids, neighbours, operands, each, whole)``, and call it
    with every particle axis padded: that of ``ids``, and that of the cloud."""
    inner, names = jax.jit(function, static_argnames="scheme"), list(signature(function).parameters)[1:]
    compiled: dict[Any, set[int]] = {}

    @wraps(function)
    def padded(scheme, points, kernel, ids, neighbours, operands, each=(), whole=()):
        n, m = points.shape[0], ids.shape[0]
        jac, one_for_all = operands.jac, operands.jac.shape[0] == 1
        big = cloud_size(n)
        # What is only run stops after m particles; derivatives are taken of all.
        inside = recorded()
        loose = not (inside or is_traced(points, kernel, ids, neighbours, operands, each, whole))
        # What is differentiated is run first, by the same program where that has no more rows than it should.
        form = scheme, big, neighbours.shape[1], jac.shape[1:], one_for_all, operands.shared is None, inside
        known = compiled.setdefault(form, set())
        if loose:
            size = at_hand(known, m, largest_at_hand(m), open_size(m))
        else:
            size = at_hand(known, m, max(1.25 * m, FEW), padded_size(m))
        mesh = devices.of_rows(m) if loose else None
        if mesh is not None:
            size = -(-size // mesh.size) * mesh.size
        points, kernel, data, whole = in_cloud_size((points, kernel, operands.data, whole), n)
        ids, neighbours, jac, own, each = widened(
            (ids, neighbours, None if one_for_all else jac, operands.own, each), m, size
        )
        jac, count = operands.jac if one_for_all else jac, np.int32(m)
        given = Operands(jac, own, data, operands.shared, operands.lengths, count)
        arguments = dict(zip(names, (points, kernel, ids, neighbours, given, each, whole)))
        if inside or (kernel is not None and closes_over_traced(kernel.tree_flatten()[1])):
            return cut(inner(scheme, **arguments), m)
        if mesh is not None:
            arguments["operands"] = given._replace(count=None)
            by_row = _by_row(points, kernel, ids, neighbours, given, each, whole)
            by_row[names.index("operands")] = by_row[names.index("operands")]._replace(count=None)
            return cut(devices.side_by_side(function, scheme, arguments, dict(zip(names, by_row)), mesh), m)
        options = effort(size, len(fit_and_tail(scheme.rec)[0]))
        few = operands.shared is not None and scheme.rec.size * scheme.rec.fields <= SMALL
        small = few and one_kernel.available()
        share = dict(zip(names, _by_row(points, kernel, ids, neighbours, given, each, whole)))
        return cut(called(function, {"scheme": scheme}, arguments, tuple(options.items()), small, share), m)

    return padded


@_in_size_classes
def rows(
    scheme: Scheme, points: Any, kernel: Kernel | None, ids: Any, neighbours: Any, operands: Operands,
    each: tuple = (), whole: tuple = (),
) -> Row:  # fmt: skip
    """The rows of the particles ``ids`` (n,) with ``neighbours`` (n, w); particle axis first."""
    TRACES["rows"] += 1

    def particle(i, near_ids, jac, own):
        return moments.row(scheme, *_prepared(scheme, points, kernel, i, near_ids, operands, jac, own))

    return _mapped(particle, ids, neighbours, operands)


@_in_size_classes
def sources(
    scheme: Scheme, points: Any, kernel: Kernel | None, ids: Any, neighbours: Any, operands: Operands,
    each: tuple[Any], whole: tuple = (),
) -> Any:  # fmt: skip
    """Weights (n, F, w, E) of the sources at ``neighbours`` (n, w) in the rows of the particles ``ids``.

    each: what the rows say of the Taylor coefficients of the sources, (n, F, rows).
    """
    TRACES["rows"] += 1

    def particle(i, near_ids, jac, own, sensitivity):
        return source_weights(scheme.rec, moments.support(points, i, near_ids, None), sensitivity)

    return _mapped(particle, ids, neighbours, operands, *each)


@_in_size_classes
def coefficients(
    scheme: Scheme, points: Any, kernel: Kernel | None, ids: Any, neighbours: Any, operands: Operands,
    each: tuple[Any, Any], whole: tuple[Any, Any],
) -> Any:  # fmt: skip
    """Taylor coefficients (n, F, K) of the particles ``ids`` from all values.

    each: source (n, rows) and values of the own conditions (n, n_own); whole: all values u (N, F)
    and the values gamma (N, n_data) of the neighbours' conditions.
    """
    TRACES["coefficients"] += 1
    u, gamma = whole

    def particle(i, near_ids, jac, own, source, given):
        prepared = _prepared(scheme, points, kernel, i, near_ids, operands, jac, own)
        index = jnp.where(near_ids >= 0, near_ids, i)
        values = jnp.concatenate([u[index].reshape(-1), gamma[index].reshape(-1)])
        return moments.coefficients(scheme, *prepared, values, source, given)

    return _mapped(particle, ids, neighbours, operands, *each)


@_in_size_classes
def blocks(
    scheme: Scheme, points: Any, kernel: Kernel | None, ids: Any, neighbours: Any, operands: Operands,
    each: tuple = (), whole: tuple = (),
) -> Block:  # fmt: skip
    """The least-squares blocks of the particles ``ids`` (n,) with ``neighbours`` (n, w); particle axis first."""
    TRACES["rows"] += 1

    def particle(i, near_ids, jac, own):
        near, solution, own, data, _ = _prepared(scheme, points, kernel, i, near_ids, operands, jac, own)
        return moments.block(scheme, near, solution, own, data)

    return _mapped(particle, ids, neighbours, operands)


def _mapped(particle: Any, ids: Any, neighbours: Any, operands: Operands, *more: Any) -> Any:
    """``particle`` over all particles, in blocks; intermediates are made again in the adjoint."""
    one_for_all = operands.jac.shape[0] == 1

    def one(args):
        i, near_ids, jac, own, *rest = args
        made = particle(i, near_ids, operands.jac[0] if one_for_all else jac, own, *rest)
        empty.update({k: x.shape for k, x in enumerate(jax.tree.leaves(made)) if not x.size})
        return _without_empty(made)

    # Arrays without numbers cannot be cut into blocks: None stands for them on the way.
    empty: dict[int, tuple[int, ...]] = {}
    each = _without_empty([None if one_for_all else operands.jac, operands.own, *more])
    made = in_blocks(one, (ids, neighbours, *each), operands.count)
    leaves, shape = jax.tree.flatten(made, is_leaf=lambda x: x is None)
    full = [jnp.zeros((ids.shape[0], *empty[k])) if k in empty else x for k, x in enumerate(leaves)]
    return jax.tree.unflatten(shape, full)


def in_blocks(one: Any, arrays: Any, count: Any) -> Any:
    """``one`` of every particle; of the first ``count`` alone where no derivative will be taken."""
    n, on_cpu = jax.tree.leaves(arrays)[0].shape[0], jax.default_backend() == "cpu"
    block = min(n, BLOCK if on_cpu else _WIDE)
    if not (only_run() and on_cpu):
        return jax.lax.map(jax.checkpoint(one), arrays, batch_size=block)
    some = jax.jit(jax.vmap(one), inline=True)  # traced once for both

    def step(k: Any, out: Any) -> Any:
        start = k * block
        made = some(jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, block), arrays))
        return jax.tree.map(lambda x, y: jax.lax.dynamic_update_slice_in_dim(x, y, start, 0), out, made)

    made = jax.eval_shape(some, jax.tree.map(lambda x: x[:block], arrays))
    out = jax.tree.map(lambda x: jnp.zeros((n, *x.shape[1:]), x.dtype), made)
    return jax.lax.fori_loop(0, (count + block - 1) // block, step, out)


def _without_empty(tree: Any) -> Any:
    return jax.tree.map(lambda x: x if x.size else None, tree)


def _prepared(scheme, points, kernel, i, near_ids, operands: Operands, jac, own):
    """The support, elimination and conditions of one particle."""
    near = moments.support(points, i, near_ids, kernel, scheme.decay)
    if operands.shared is None:
        if scheme.method == "S" and jac.shape[-1] == 1:  # of a constant operator, which others may share
            near = moments.at_common_length(near)
        solution = eliminate(scheme, jac, near.length)
    elif operands.lengths is not None:
        near = moments.at_length(near, operands.lengths[jac])
        solution = jax.tree.map(lambda x: x[jac], operands.shared)
    else:
        lift = operands.shared.lift * row_lifts(scheme.rec, near.length)
        solution = operands.shared._replace(lift=lift)
    data = None
    if scheme.n_data:
        data = operands.data[jnp.where(near_ids >= 0, near_ids, i)]
        data = jnp.where(near.inside[:, None, None], data, 0.0).at[0].set(0.0)
    return near, solution, own, data, _tests(scheme, near)


def _tests(scheme: Scheme, near: Support) -> Any:
    return closure.tests_iii(scheme, near) if scheme.method == "III" else None


@_in_size_classes
def moment_matrices(
    scheme: Scheme, points: Any, kernel: Kernel | None, ids: Any, neighbours: Any, operands: Operands,
    each: tuple = (), whole: tuple = (),
) -> Any:  # fmt: skip
    """The moment matrices (n, rows, free) of the particles ``ids``, in the last stage of I and II."""

    def particle(i, near_ids, jac, own):
        near, solution, own, data, tests = _prepared(scheme, points, kernel, i, near_ids, operands, jac, own)
        if scheme.method in ("I", "II"):
            return moments.moment_matrix(closure.closing_system(scheme, near, solution, own))
        skip_self = scheme.method != "SSPH"
        return moments.moment_matrix(moments.local_system(scheme, near, solution, own, data, tests, skip_self))

    return _mapped(particle, ids, neighbours, operands)


@_in_size_classes
def recoveries(
    scheme: Scheme, points: Any, kernel: Kernel, ids: Any, neighbours: Any, operands: Operands,
    each: tuple[Any, Any], whole: tuple = (),
) -> Recovery:  # fmt: skip
    """Stage 1 of I and II for the particles ``ids``; ``operands.own`` without held values.

    each: source (n, rows) and values of the own conditions (n, n_own).
    """
    TRACES["rows"] += 1

    def particle(i, near_ids, jac, own, source, given):
        near, solution, own, *_ = _prepared(replace(scheme, method=""), points, kernel, i, near_ids, operands, jac, own)
        return closure.recover(scheme, near, solution, own, source, given)

    return _mapped(particle, ids, neighbours, operands, *each)


@_in_size_classes
def closed_rows(
    scheme: Scheme, points: Any, kernel: Kernel, ids: Any, neighbours: Any, operands: Operands,
    each: tuple[Any], whole: tuple[Any, Recovery],
) -> Row:  # fmt: skip
    """The rows of I and II over values only.

    each: the particles that a row reaches, (n, w); whole: every particle's neighbours in stage 1 and its recovery.
    """
    TRACES["rows"] += 1
    far_ids, recovered = whole

    def particle(i, near_ids, jac, own, reach):
        near, solution, own, *_ = _prepared(scheme, points, kernel, i, near_ids, operands, jac, own)
        made = closure.closing(scheme, near, solution, own)
        weights, more = closure.composed(near_ids, made, far_ids, recovered, reach)
        size = jnp.sum(jnp.abs(weights))
        # A row is not determined where the recovery of a neighbour is not; rounding there averages out.
        missed = jnp.max(jnp.where(near.inside, recovered.defect[jnp.maximum(near_ids, 0)], 0.0))
        missed = jnp.where(missed > jnp.sqrt(jnp.finfo(missed.dtype).eps), missed, 0.0)
        return Row(
            weights[None, :, None], jnp.zeros((1, reach.shape[0], 0)), made.source[None], made.condition[None],
            size[None], jnp.maximum(made.defect, missed), more[None],
        )  # fmt: skip

    return _mapped(particle, ids, neighbours, operands, *each)
